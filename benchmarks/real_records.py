"""Real records of `real.py`: logs, splits, models, published parameters and judges.  Nothing happens when this is run.

| record | training | held out |
|---|---|---|
| pendulum-A0 | runs 00, 01, 02 | runs 03, 04, 05, 11, 12, 13 |
| pendulum-A0-one-run | run 03 | runs 00, 01, 02, 04, 05, 11, 12, 13 |
| pendulum-C0 | runs 00, 01, 02 | runs 03, 04, 05, 06, 12, 13 |
| pendulum-C0-one-run | run 03 | runs 00, 01, 02, 04, 05, 06, 12, 13 |
| emps | first half | second half |
| silverbox, silverbox-offset | rows 45,000 to 52,999 | the arrow, rows 1,000 to 38,999 |
| crazyflie | log15 | log16 |
| crazyflie-log15 | first half of log15 | second half |
| go2-FL, go2-FR, go2-RL, go2-RR | first half | second half |
| arm | a Fourier series of 50 s | another one of 30 s, and ten points |
| tanks, tanks-k5 | the estimation record | the validation record |
| px4 | all of it | nothing: no method should answer |

The splits are fixed.  The single run is the first that the row before holds out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from real_simulation import CAP, Array, Inputs, Motion, OutputError, Simulator, Windows, overall

import diransac as dr

Found = tuple[Mapping[str, float], Inputs]
"""Parameters, and how inputs act between samples."""


@dataclass(frozen=True)
class Score:
    """Held-out error in `unit`, and its parts by horizon or signal."""

    error: float
    parts: Mapping[str, float]


@dataclass(frozen=True)
class Record:
    """A real record, split.

    Parameters
    ----------
    name : of the record
    model : to identify
    train : logs to identify from
    judge : held-out score of parameters; None where nothing may be identified
    reference : score without a model: positions that stay, a constant signal; it stands for a refusal
    unit : of the score
    published : parameters of the machine, where they are known
    baselines : further methods by name
    """

    name: str
    model: dr.Model
    train: Sequence[dr.Log]
    judge: Callable[[Mapping[str, float], Inputs], Score] | None = None
    reference: Score | None = None
    unit: str = "spread"
    published: Mapping[str, float] = field(default_factory=dict)
    baselines: Mapping[str, Callable[[], Found]] = field(default_factory=dict)


# ---------------------------------------------------------------------- machines in windows


def double_pendulum(upper_length: float) -> Callable[[Array, Array, Array], Array]:
    """Rates of the two links, apart from the package; parameters in the order of `dr.models.double_pendulum`."""

    def rates(x: Array, u: Array, p: Array) -> Array:
        q1, q2, v1, v2 = x
        inertia1, moment1, inertia2, moment2, rotor, b1, c1, b2, c2 = p
        coupling, s2 = upper_length * moment2 * np.cos(q2), upper_length * moment2 * np.sin(q2)
        m11 = inertia1 + inertia2 + 2.0 * coupling + 37.0 * rotor
        m12 = inertia2 + coupling - 6.0 * rotor
        m22 = inertia2 + 36.0 * rotor
        g2 = 9.81 * moment2 * np.sin(q1 + q2)
        f1 = u[0] + s2 * (2.0 * v1 + v2) * v2 - 9.81 * moment1 * np.sin(q1) - g2 - b1 * v1 - c1 * np.arctan(100.0 * v1)
        f2 = u[1] - s2 * v1**2 - g2 - b2 * v2 - c2 * np.arctan(100.0 * v2)
        determinant = m11 * m22 - m12**2
        return np.stack([v1, v2, (m22 * f1 - m12 * f2) / determinant, (m11 * f2 - m12 * f1) / determinant])

    return rates


def servo_axis(x: Array, u: Array, p: Array) -> Array:
    """Rates of the axis; its friction changes sign within 1 mm/s."""
    mass, viscous, dry, offset = p
    return np.stack([x[1], (u[0] - viscous * x[1] - dry * np.tanh(x[1] / 1e-3) - offset) / mass])


def oscillator(x: Array, u: Array, p: Array) -> Array:
    """Rates of the Silverbox; p is m, d, k1, k3 and, where they are modelled, k2, c."""
    y, v = x
    force = u[0] - p[1] * v - p[2] * y - p[3] * y**3
    if len(p) > 4:
        force = force - p[4] * y**2 - p[5]
    return np.stack([v, force / p[0]])


def scored(by_horizon: Mapping[float, Array]) -> Score:
    """Score of robust errors at horizons."""
    parts = {f"{h:g} s": float(np.sqrt(np.mean(np.square(x)))) for h, x in by_horizon.items()}
    return Score(overall(by_horizon), parts)


def low_bounds(model: dr.Model) -> Array:
    """Least admissible value of each parameter; a positive one is at least a hundred-millionth."""
    return np.array([max(x.lower, 1e-8) if x.positive else x.lower for x in model.parameters.values()])


def in_windows(
    name: str,
    model: dr.Model,
    rates: Callable[[Array, Array, Array], Array],
    train: Sequence[dr.Log],
    held: Sequence[dr.Log],
    guess: Mapping[str, float],
    *,
    published: Mapping[str, float],
    width: int,
    length: float,
    horizons: Sequence[float] = (0.1, 0.3, 1.0),
    extra: Mapping[str, Callable[[], Found]] | None = None,
) -> Record:
    """Record of a machine whose positions are measured, judged by open-loop prediction from smoothed states."""
    own, others = ([motion(model, log) for log in logs] for logs in (train, held))
    spread = np.std(np.concatenate([log.y for log in (*own, *others)]), axis=0)
    simulator = Simulator(rates)
    windows = Windows(simulator, others, spread, horizons, width)
    problem = OutputError(Simulator(rates, 1), own, low_bounds(model), spread, length, width)
    names = list(model.parameters)

    def judge(parameters: Mapping[str, float], inputs: Inputs) -> Score:
        return scored(windows(np.array([parameters[n] for n in names]), inputs))

    def output_error() -> Found:
        values, inputs = problem(np.array([guess[n] for n in names]), least_squares(model, train))
        return dict(zip(names, values.tolist(), strict=True)), inputs

    baselines = {"output error": output_error, **(extra or {})}
    return Record(
        name, model, train, judge, scored(windows.at_rest()), published=published, baselines=baselines
    )  # fmt: skip


def motion(model: dr.Model, log: dr.Log) -> Motion:
    """Positions and inputs of a log, with gaps, of a few milliseconds in these records, interpolated."""

    def bridged(name: str) -> Array:
        seen = np.isfinite(log[name])
        return np.interp(log.time, log.time[seen], log[name][seen])

    y, u = (np.column_stack([bridged(name) for name in names]) for names in (model.coordinates, model.inputs))
    return Motion(y, u, log.dt)


def least_squares(model: dr.Model, train: Sequence[dr.Log]) -> Array | None:
    """Filtered least squares, a start of output error; None if it refuses."""
    try:
        return np.array(list(dr.identify(model, list(train), "ols", differentiate=True).parameters.values()))
    except dr.DiransacError:
        return None


# ---------------------------------------------------------------------- the records


PENDULUM = {
    "inertia1": 0.1, "moment1": 0.3, "inertia2": 0.05, "moment2": 0.1, "rotor_inertia": 1e-4,
    "viscous_friction1": 0.01, "dry_friction1": 0.1, "viscous_friction2": 0.01, "dry_friction2": 0.1,
}  # fmt: skip
"""Round numbers."""
A0 = {
    "inertia1": 0.10786, "moment1": 0.34912, "inertia2": 0.023924, "moment2": 0.11107, "rotor_inertia": 7.66e-5,
    "viscous_friction1": 0.001, "dry_friction1": 0.093, "viscous_friction2": 0.001, "dry_friction2": 0.078,
}  # fmt: skip
"""Base parameters of model 2.0 of design A.0, as published beside the records."""
C0 = {
    "inertia1": 0.049268, "moment1": 0.24113, "inertia2": 0.053878, "moment2": 0.18117, "rotor_inertia": 9.94e-5,
    "viscous_friction1": 0.001, "dry_friction1": 0.093, "viscous_friction2": 0.001, "dry_friction2": 0.078,
}  # fmt: skip
"""Those of model 3.0 of design C.0."""


def pendulum(data: Path, design: str, one_run: bool) -> Record:
    """Double pendulum: positions, velocities and torques at 500 Hz."""
    folder, length, known = {
        "A0": ("dfki_double_pendulum", 0.3, A0),
        "C0": ("dfki_double_pendulum_c0", 0.2, C0),
    }[design]
    columns = {"t": "time"}
    for i in "12":
        columns |= {f"q{i}": f"pos_meas{i}", f"q{i}_dot": f"vel_meas{i}", f"torque{i}": f"tau_meas{i}"}
    files = sorted((data / folder).glob(f"{design}_*.parquet"))
    logs = [dr.read_log(file, rename=columns, resample=500.0) for file in files]
    chosen = [3] if one_run else [0, 1, 2]
    train, held = [logs[i] for i in chosen], [log for i, log in enumerate(logs) if i not in chosen]
    return in_windows(
        f"pendulum-{design}{'-one-run' if one_run else ''}", dr.models.double_pendulum(upper_length=length),
        double_pendulum(length), train, held, PENDULUM, published=known, width=21, length=0.5,
        horizons=(0.1, 0.25, 0.5),
    )  # fmt: skip


def emps(data: Path) -> Record:
    """Servo axis: position and force at 1 kHz, under feedback."""
    model = dr.models.servo_axis()
    log = dr.read_log(data / "emps" / "DATA_EMPS.csv", rename={"t": "t_s", "position": "q_m", "force": "force_N"})
    first, second = log.split(0.5)
    guess = {"mass": 100.0, "viscous_friction": 100.0, "dry_friction": 10.0, "offset": -1.0}
    janot = {"mass": 95.1089, "viscous_friction": 203.5034, "dry_friction": 20.3935, "offset": -3.1648}

    def mujoco_sysid() -> Found:
        from gauntlet_mujoco import fitted

        derived = dr.differentiate(first, model)
        return fitted(model, derived, dict(dr.identify(model, derived, "ols").parameters)), Inputs()

    return in_windows(
        "emps", model, servo_axis, [first], [second], guess, published=janot, width=41, length=1.0,
        extra={"mujoco.sysid": mujoco_sysid},
    )  # fmt: skip


def silverbox_model(with_offset: bool) -> dr.Model:
    """Model ``m y'' + d y' + k1 y + k3 y^3 = u``, with ``+ k2 y^2 + c`` on the left if asked for."""
    parameters = {name: dr.Parameter(positive=True) for name in ("m", "d", "k1", "k3")}
    parameters |= {name: dr.Parameter() for name in ("k2", "c")} if with_offset else {}

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        force = p.m * a.y + p.d * v.y + p.k1 * q.y + p.k3 * q.y**3 - u.u
        return [force + p.k2 * q.y**2 + p.c if with_offset else force]

    return dr.Model("silverbox", {"y": "V"}, {"u": "V"}, parameters, equations)


def silverbox(data: Path, with_offset: bool) -> Record:
    """Electronic oscillator: output in V at 610.35 Hz; RMSE of the arrow's simulation from rest, mV."""
    u, y = np.loadtxt(data / "silverbox" / "SNLS80mV.csv", delimiter=",", skiprows=1, usecols=(0, 1)).T
    model, dt, part = silverbox_model(with_offset), 1.0 / 610.35, slice(45_000, 53_000)
    log = dr.Log.from_arrays(dt * np.arange(8_000), {"y": y[part], "u": u[part]})
    simulator, names = Simulator(oscillator, 3), list(model.parameters)
    low, spread = low_bounds(model), np.array([np.std(y[part])])
    problem = OutputError(simulator, [motion(model, log)], low, spread, 250 * dt, 5)
    guess = {"m": 1e-5, "d": 1e-4, "k1": 1.0, "k3": 1.0, "k2": 0.1, "c": 0.01}

    def judge(parameters: Mapping[str, float], inputs: Inputs) -> Score:
        """Chunks of 1,000 rows, each after 1,000 rows from rest, far longer than the oscillator rings."""
        begins = np.arange(0, 38_000, 1_000)
        p = np.repeat(np.array([[parameters[n]] for n in names]), len(begins), axis=1)
        stages = inputs.between(u[:39_001, None], dt, simulator.substeps)
        x = simulator(p, np.zeros((2, len(begins))), stages, begins, 2_000, dt)[1_000:2_000, 0]
        error = np.clip(x - y[begins + np.arange(1_000, 2_000)[:, None]], -CAP, CAP) * 1e3
        return Score(float(np.sqrt(np.mean(error**2))), {"first half": rms(error[:, :19]), "rest": rms(error[:, 19:])})

    def output_error() -> Found:
        values, inputs = problem(np.array([guess[n] for n in names]), least_squares(model, [log]))
        return dict(zip(names, values.tolist(), strict=True)), inputs

    nothing = rms(1e3 * (y[1_000:39_000] - np.mean(y[part])))
    return Record(
        f"silverbox{'-offset' if with_offset else ''}", model, [log], judge, Score(nothing, {}), "mV",
        baselines={"output error": output_error},
    )  # fmt: skip


def rms(x: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


RECORDS: dict[str, Callable[[Path], Record]] = {
    "pendulum-A0": lambda data: pendulum(data, "A0", False),
    "pendulum-A0-one-run": lambda data: pendulum(data, "A0", True),
    "pendulum-C0": lambda data: pendulum(data, "C0", False),
    "pendulum-C0-one-run": lambda data: pendulum(data, "C0", True),
    "emps": emps,
    "silverbox": lambda data: silverbox(data, False),
    "silverbox-offset": lambda data: silverbox(data, True),
}
