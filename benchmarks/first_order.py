"""Errors of lo-diransac on machines with states of first order, or with states that nothing measures.

Run it as ``python benchmarks/first_order.py [--seeds 0:5] [--cases oven,joint]``.  Every seed has a machine of its own:
each parameter is 0.5 to 2 times the nominal one.  The equations are linear, and are solved exactly, by the matrix
exponential, under inputs that are held.  The same log is taken clean, and with noise of 0.5 % of each signal's standard
deviation and outliers of up to five of them in a tenth of its samples.
"""

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

import diransac as dr

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Case:
    """A machine ``x' = A x + B u`` with nominal parameters, and what is measured and known of it."""

    model: dr.Model
    nominal: Mapping[str, float]
    matrices: Callable[..., tuple[Array, Array]]
    states: tuple[str, ...]
    measured: tuple[str, ...]
    dt: float
    start: tuple[float, ...]
    inputs: Callable[[Array, np.random.Generator], dict[str, Array]]
    known: tuple[str, ...] = ()


def _sines(t: Array, rng: np.random.Generator, highest: float) -> Array:
    """Six sines up to a frequency in Hz, of unit variance."""
    w, phase = 2.0 * np.pi * highest * rng.uniform(0.1, 1.0, 6), rng.uniform(0.0, 2.0 * np.pi, 6)
    return np.asarray(np.sin(np.outer(t, w) + phase).sum(axis=1) / np.sqrt(3.0))


def _oven(capacity: float, loss: float) -> tuple[Array, Array]:
    return np.array([[-loss / capacity]]), np.array([[1.0, loss]]) / capacity


def _motor(
    inertia: float, viscous_friction: float, torque_constant: float, resistance: float, inductance: float
) -> tuple[Array, Array]:
    rows = [
        [0.0, 1.0, 0.0],
        [0.0, -viscous_friction / inertia, torque_constant / inertia],
        [0.0, -torque_constant / inductance, -resistance / inductance],
    ]
    return np.array(rows), np.array([[0.0], [0.0], [1.0 / inductance]])


def _joint(
    motor_inertia: float,
    load_inertia: float,
    stiffness: float,
    damping: float,
    motor_friction: float,
    load_friction: float,
) -> tuple[Array, Array]:
    k, d, inertia = stiffness, damping, np.array([[motor_inertia], [load_inertia]])
    forces = np.array([[-k, k, -d - motor_friction, d], [k, -k, d, -d - load_friction]]) / inertia
    return np.vstack([np.eye(2, 4, 2), forces]), np.array([[0.0], [0.0], [1.0 / motor_inertia], [0.0]])


OVEN = dr.Model(
    name="oven",
    coordinates={},
    first_order={"temperature": "K"},
    inputs={"power": "W", "ambient": "K"},
    parameters={"capacity": dr.Parameter("J/K", positive=True), "loss": dr.Parameter("W/K", positive=True)},
    equations=lambda q, v, a, u, p: [p.capacity * a.temperature + p.loss * (v.temperature - u.ambient) - u.power],
)
MOTOR = {"inertia": 3e-4, "viscous_friction": 2e-4, "torque_constant": 0.05, "resistance": 1.2, "inductance": 0.02}
JOINT = {"motor_inertia": 0.02, "load_inertia": 0.06, "stiffness": 30.0, "damping": 0.05}
JOINT |= {"motor_friction": 0.05, "load_friction": 0.08}


def _heating(t: Array, rng: np.random.Generator) -> dict[str, Array]:
    power = 400.0 * (_sines(t, rng, 0.01) + 1.5).clip(0.0)
    return {"power": power, "ambient": 293.0 + 2.0 * np.sin(t / 300.0)}


def _voltage(t: Array, rng: np.random.Generator) -> dict[str, Array]:
    return {"voltage": 4.0 * _sines(t, rng, 8.0) + 3.0 * np.sign(_sines(t, rng, 2.0))}


def _torque(t: Array, rng: np.random.Generator) -> dict[str, Array]:
    return {"torque": 0.8 * _sines(t, rng, 8.0) + 0.5 * np.sign(_sines(t, rng, 2.0))}


def _motor_case(measured: tuple[str, ...], known: tuple[str, ...] = ()) -> Case:
    states = ("angle", "angle_dot", "current")
    return Case(dr.models.dc_motor(), MOTOR, _motor, states, measured, 0.002, (0.0, 0.0, 0.0), _voltage, known)


def _joint_case(measured: tuple[str, ...]) -> Case:
    states = ("motor", "load", "motor_dot", "load_dot")
    return Case(dr.models.flexible_joint(), JOINT, _joint, states, measured, 0.005, (0.0,) * 4, _torque)


CASES = {
    "oven": Case(
        OVEN, {"capacity": 900.0, "loss": 3.0}, _oven, ("temperature",), ("temperature",), 1.0, (293.0,), _heating
    ),
    "motor: angle, current": _motor_case(("angle", "current")),
    "motor: angle; constant, resistance known": _motor_case(("angle",), ("torque_constant", "resistance")),
    "joint: motor, load": _joint_case(("motor", "load")),
    "joint: motor": _joint_case(("motor",)),
}


def recorded(case: Case, seed: int, noise: float, outliers: float) -> tuple[dr.Log, dict[str, float]]:
    """Log of a machine of 1500 samples, and its parameters."""
    rng = np.random.default_rng([seed, 77])
    truth = {name: value * float(rng.uniform(0.5, 2.0)) for name, value in case.nominal.items()}
    t = case.dt * np.arange(1500)
    inputs = case.inputs(t, rng)
    A, B = case.matrices(**truth)
    n, u = len(A), np.column_stack(list(inputs.values()))
    step = expm(case.dt * np.block([[A, B], [np.zeros((u.shape[1], n + u.shape[1]))]]))
    x = [np.array(case.start)]
    for held in u[:-1]:
        x.append(step[:n, :n] @ x[-1] + step[:n, n:] @ held)
    columns = {}
    for name, y in zip(case.states, np.transpose(x), strict=True):
        if name in case.measured:
            wild = (rng.random(len(t)) < outliers) * rng.uniform(-5.0, 5.0, len(t))
            columns[name] = y + y.std() * (noise * rng.standard_normal(len(t)) + wild)
    return dr.Log.from_arrays(t, {**columns, **inputs}), truth


def main() -> None:
    """Print a table: the worst error of a parameter, median and worst over seeds, and verdicts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:5", metavar="A:B", help="from A to B - 1")
    parser.add_argument("--cases", default="", metavar="A,B", help="names or parts of names; all by default")
    chosen = parser.parse_args()
    seeds = range(*map(int, chosen.seeds.split(":")))
    parts = chosen.cases.split(",")
    print("| measured | log | worst error of a parameter, %: median, worst | usable / with care / not / refused | s |")
    print("|---|---|---|---|--:|")
    for name, case in CASES.items():
        if any(part in name for part in parts):
            for kind, noise, outliers in (("clean", 0.0, 0.0), ("10 % outliers", 0.005, 0.1)):
                print(f"| {name} | {kind} | {_row(case, seeds, noise, outliers)} |", flush=True)


def _row(case: Case, seeds: range, noise: float, outliers: float) -> str:
    """Cells of one kind of log: errors of the results that are not refused."""
    verdicts, errors, seconds = dict.fromkeys(("usable", "usable with care", "do not rely on this", ""), 0), [], []
    for seed in seeds:
        log, truth = recorded(case, seed, noise, outliers)
        begin = time.perf_counter()
        try:
            found = dr.identify(case.model, log, differentiate=True, fixed={n: truth[n] for n in case.known})
        except dr.IdentificationError:
            verdicts[""] += 1
            continue
        finally:
            seconds.append(time.perf_counter() - begin)
        verdicts[found.verdict] += 1
        errors.append(max(100.0 * abs(found.parameters[n] / x - 1.0) for n, x in truth.items()))
    cells = f"{median(errors):.2g}, {max(errors):.2g}" if errors else "–"
    return f"{cells} | {' / '.join(map(str, verdicts.values()))} | {median(seconds):.1f}"


if __name__ == "__main__":
    main()
