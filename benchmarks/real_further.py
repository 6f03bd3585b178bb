"""Records of `real.py` that no window of RK4 judges by positions alone: a six-axis arm, and two tanks.

Nothing happens when this file is run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from real_records import Found, Record, Score
from real_simulation import STARTS, Array, Inputs
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import butter, filtfilt

import diransac as dr

# ---------------------------------------------------------------------- six-axis arm

CUTOFF = 5.0
"""Of the filter of held-out positions, velocities and torques, Hz: above the motion, below the noise of torques."""
HORIZONS = (0.1, 0.3)


def arm(data: Path) -> Record:
    """Industrial arm, 58 base parameters; error of the torques of two held-out runs, and of their open-loop prediction.

    The error is the geometric mean over joints and runs of RMS error over RMS torque, of filtered signals.  The parts
    are those of the runs, and the worst joint's robust error of position over its change, by horizon, as
    ``dr.validate`` has it.
    """
    folder = data / "ur10e"
    names = ("armature", "damping", "friction", "offset")
    model = dr.models.robot(str(folder / "ur10e.urdf"), unknown=names, bodies="all", actuation=dr.JointTorques())
    train, *held = (dr.read_log(folder / f"{x}.parquet") for x in ("train_50s", "held_30s", "held_points"))
    measured = {log.source: _filtered(model, log) for log in held}

    def judge(parameters: Mapping[str, float], _: Inputs) -> Score:
        p = np.array([parameters[n] for n in model.parameters])
        errors = {Path(name).stem: _torque_errors(model, x, p) for name, x in measured.items()}
        parts = {name: _geometric(x) for name, x in errors.items()}
        plant = dr.Plant(model, parameters)
        for horizon in HORIZONS:
            scores = [dr.validate(plant, log, horizon=horizon).judged for log in held]
            parts[f"{horizon:g} s"] = max(x.robust_rmse[n] / x.hold_last[n] for x in scores for n in model.coordinates)
        return Score(_geometric(np.concatenate(list(errors.values()))), parts)

    return Record("arm", model, [train], judge, Score(100.0, {}), "%")


def _filtered(model: dr.Model, log: dr.Log) -> list[Array]:
    """Positions, velocities, accelerations and torques ``(K, n)``, filtered alike, without the ends of the log."""
    b, a = butter(4, CUTOFF, fs=1.0 / log.dt)
    q, v, u = (
        filtfilt(b, a, np.column_stack([log[n] for n in names]), axis=0)
        for names in (model.coordinates, model.velocities, model.inputs)
    )
    cut = slice(round(1.0 / log.dt), -round(1.0 / log.dt))
    return [x[cut] for x in (q, v, np.gradient(v, log.dt, axis=0), u)]


def _torque_errors(model: dr.Model, motion: list[Array], p: Array) -> Array:
    """RMS error of each joint's torque over the RMS of the torque, %."""
    q, v, a, u = (x.T for x in motion)
    residual = np.array(model.residual(q, v, a, u, np.repeat(p[:, None], q.shape[1], axis=1)))
    return np.asarray(100.0 * np.sqrt(np.square(residual).mean(axis=1) / np.square(u).mean(axis=1)))


def _geometric(values: Array) -> float:
    return float(np.exp(np.mean(np.log(values))))


# ---------------------------------------------------------------------- two tanks

SUBSTEPS, EMPTY, STEP = 1, 1e-3, 1e-6
"""Of the simulation, a sample; level under a square root at least, V; step of derivatives."""
TANKS = {"k1": 0.1, "k2": 0.05, "k3": 0.05, "k4": 0.1, "k5": 0.0}
"""Round numbers."""


def tanks_model(with_inflow: bool) -> dr.Model:
    """Levels of two tanks, the upper one unmeasured; with a constant inflow k5 if asked for."""
    parameters = {name: dr.Parameter(positive=True) for name in ("k1", "k2", "k3", "k4")}
    parameters |= {"k5": dr.Parameter()} if with_inflow else {}

    def equations(_: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        upper, lower = (ca.sqrt(ca.fmax(x, EMPTY)) for x in (v.h1, v.h2))
        inflow = p.k4 * u.pump + (p.k5 if with_inflow else 0.0)
        return [a.h1 + p.k1 * upper - inflow, a.h2 - p.k2 * upper + p.k3 * lower]

    return dr.Model("tanks", {}, {"pump": "V"}, parameters, equations, first_order={"h1": "V", "h2": "V"})


def tanks(data: Path, with_inflow: bool) -> Record:
    """Two tanks in a cascade; RMSE of one simulation of the whole validation record, V, its first level h1 fitted."""
    model, names = tanks_model(with_inflow), [n for n in TANKS if with_inflow or n != "k5"]
    train, held = (
        dr.read_log(data / "cascaded_tanks" / f"{x}.csv", scale={"t": 1.0}) for x in ("estimation", "validation")
    )

    def judge(parameters: Mapping[str, float], inputs: Inputs) -> Score:
        p = np.array([parameters.get(n, 0.0) for n in TANKS])
        highest = 10.0 * max(p[3] / p[0], 1e-6) ** 2

        def error(root: float) -> float:
            return _rms(_levels(p[:, None], np.array([root**2 * highest]), held, inputs)[:, 0] - held["h2"])

        first = min(np.linspace(0.05, 2.0, 9), key=error)
        found = minimize_scalar(error, bounds=(max(first - 0.25, 0.0), first + 0.25), method="bounded")
        return Score(float(found.fun), {})

    def output_error() -> Found:
        """Simulation of the whole estimation record; logarithms of the positive parameters and of the first level."""
        rng, size = np.random.default_rng(0), np.array(list(TANKS.values()))

        def parameters(z: Array) -> Array:
            """Parameters ``(5, L)`` of ``(L, 6)``."""
            return np.vstack([size[:4, None] * np.exp(z.T[:4]), z.T[5:] * with_inflow])

        def errors(z: Array) -> Array:
            lanes = np.atleast_2d(z)
            found = _levels(parameters(lanes), np.exp(lanes[:, 4]), train, Inputs("linear")) - train["h2"][:, None]
            return found.T.reshape(*z.shape[:-1], -1)

        def slopes(z: Array) -> Array:
            return ((errors(z + STEP * np.eye(len(z))) - errors(z)) / STEP).T

        starts = np.column_stack([rng.uniform(-1.0, 1.0, (STARTS, 4)), np.full(STARTS, np.log(5.0)), np.zeros(STARTS)])
        fits = [least_squares(errors, z, slopes, loss="soft_l1", f_scale=0.3, max_nfev=30) for z in starts]
        best = parameters(min(fits, key=lambda fit: fit.cost).x[None])[:, 0]
        return dict(zip(names, best.tolist(), strict=False)), Inputs("linear")

    still = _rms(held["h2"] - float(np.median(train["h2"])))
    name = f"tanks{'-k5' if with_inflow else ''}"
    return Record(name, model, [train], judge, Score(still, {}), "V", baselines={"output error": output_error})


def _levels(p: Array, upper: Array, log: dr.Log, inputs: Inputs) -> Array:
    """Lower level ``(K, L)`` of simulations from upper levels ``(L,)`` and the first lower one, by RK4; p is (5, L)."""
    stages = inputs.between(log["pump"][:, None], log.dt, SUBSTEPS)[:, :, 0]
    h, found = log.dt / SUBSTEPS, np.empty((len(log), len(upper)))
    k1, k2, k3, k4, k5 = p

    def rates(x: Array, u: float) -> Array:
        a, b = np.sqrt(np.maximum(x, EMPTY))
        return np.stack([k4 * u + k5 - k1 * a, k2 * a - k3 * b])

    x = np.stack([upper, np.full(len(upper), log["h2"][0])])
    found[0] = x[1]
    for k, u in enumerate(stages):
        for i in range(0, 2 * SUBSTEPS, 2):
            s1 = rates(x, u[i])
            s2 = rates(x + 0.5 * h * s1, u[i + 1])
            s3 = rates(x + 0.5 * h * s2, u[i + 1])
            x = x + h / 6.0 * (s1 + 2.0 * s2 + 2.0 * s3 + rates(x + h * s3, u[i + 2]))
        found[k + 1] = x[1]
    return found


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


RECORDS: dict[str, Callable[[Path], Record]] = {
    "arm": arm,
    "tanks": lambda data: tanks(data, False),
    "tanks-k5": lambda data: tanks(data, True),
}
