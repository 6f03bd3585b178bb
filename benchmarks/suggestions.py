"""Suggested terms: machines whose model lacks a known force, and machines whose model is exact.

Run: ``python benchmarks/suggestions.py [--seeds N] [--first SEED] [--without PART] [CASE ...]``.  Simulations are
independent of the package: classical Runge-Kutta in NumPy, 8 or 10 steps a sample, parameters drawn for every seed.  Of
each case one line says in how many logs the missing term was the first suggestion, or both missing terms were among the
suggestions; of exact models, how many suggestions there were.  A part of the method is left out for an ablation.
The two real machines need the logs of ``../shared/data`` and are left out, with a line that says so, where they are
missing.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import casadi as ca
import numpy as np

import diransac as dr

Actuator = Callable[[float], float]
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
G = 9.81
Array = np.ndarray


# ---------------------------------------------------------------------- simulation


def simulate(rates: Callable, x0: Array, control: Callable, n_rows: int, dt: float, substeps: int) -> tuple:
    """States (n_rows, n_x), inputs (n_rows, n_u): classical Runge-Kutta; ``control(t, x)`` is held for a sample."""
    x, h = np.array(x0, float), dt / substeps
    states, inputs = np.zeros((n_rows, len(x))), []
    for k in range(n_rows):
        u = control(k * dt, x)
        states[k] = x
        inputs.append(u)
        for _ in range(substeps):
            k1 = rates(x, u)
            k2 = rates(x + h / 2 * k1, u)
            k3 = rates(x + h / 2 * k2, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, u))
    return states, np.array(inputs)


class Multisine:
    """Sum of sines of random frequency and phase; ``f(t)`` and its derivative ``f(t, 1)``."""

    def __init__(self, rng: np.random.Generator, amplitude: float, low: float, high: float, n: int = 7) -> None:
        self.frequency = 2 * np.pi * np.exp(rng.uniform(np.log(low), np.log(high), n))
        self.phase = rng.uniform(0, 2 * np.pi, n)
        self.amplitude = amplitude / np.sqrt(n / 2)

    def __call__(self, t: float, order: int = 0) -> float:
        """Value of the order-th derivative."""
        wave = np.sin(self.frequency * t + self.phase + order * np.pi / 2)
        return float(self.amplitude * (self.frequency**order * wave).sum())


def drawn(rng: np.random.Generator, **typical: float) -> dict[str, float]:
    """Parameters around typical values, each by a factor of at most 1.5."""
    return {name: value * np.exp(rng.uniform(-0.4, 0.4)) for name, value in typical.items()}


def log_of(rng: np.random.Generator, dt: float, signals: dict, noise: dict, inputs: dict, source: str) -> dr.Log:
    """The measured signals with white noise of the given standard deviations, and the inputs."""
    measured = {n: signals[n] + s * rng.standard_normal(len(signals[n])) for n, s in noise.items()}
    return dr.Log.from_arrays(dt * np.arange(len(next(iter(inputs.values())))), {**measured, **inputs}, source=source)


def parameters(units: dict[str, str]) -> dict[str, dr.Parameter]:
    """Parameters; masses, inertias and lengths are positive."""
    return {n: dr.Parameter(unit, positive=unit in ("kg", "kg m^2", "m")) for n, unit in units.items()}


# ---------------------------------------------------------------------- machines


def pendulum(seed: int, missing: bool, actuator: Actuator = float) -> tuple[dr.Model, list[dr.Log]]:
    """A driven pendulum; missing: Coulomb friction of 1 to 4 % of its weight's moment."""
    rng = np.random.default_rng([1, seed])
    p = drawn(rng, inertia=0.05, damping=0.03, moment=1.2)
    coulomb = missing * p["moment"] * rng.uniform(0.01, 0.04)
    wave = Multisine(rng, 0.6, 0.1, 2.0)

    def rates(x: Array, u: Array) -> Array:
        friction = p["damping"] * x[1] + coulomb * np.tanh(x[1] / 0.005)
        return np.array([x[1], (actuator(u[0]) - friction - p["moment"] * np.sin(x[0])) / p["inertia"]])

    states, inputs = simulate(rates, [0, 0], lambda t, x: [wave(t)], 2000, 0.01, 10)
    model = dr.Model(
        "pendulum",
        {"q": "rad"},
        {"torque": "N m"},
        parameters({"inertia": "kg m^2", "damping": "N m s/rad", "moment": "N m"}),
        lambda q, v, a, u, p: [p.inertia * a.q + p.damping * v.q + p.moment * ca.sin(q.q) - u.torque],
    )
    return model, [log_of(rng, 0.01, {"q": states[:, 0]}, {"q": 3e-4}, {"torque": inputs[:, 0]}, f"pendulum {seed}")]


def cart_pole(seed: int, missing: bool, actuator: Actuator = float) -> tuple[dr.Model, list[dr.Log]]:
    """A hanging pole on a cart; missing: Coulomb friction of the cart."""
    rng = np.random.default_rng([2, seed])
    p = drawn(rng, cart=1.2, pole=0.25, length=0.4, damping=0.8, hinge=0.005)
    coulomb = missing * rng.uniform(0.2, 0.8)
    wave = Multisine(rng, 4.0, 0.2, 2.5, 8)

    def rates(x: Array, u: Array) -> Array:
        ml, sine, cosine = p["pole"] * p["length"], np.sin(x[1]), np.cos(x[1])
        M = np.array([[p["cart"] + p["pole"], ml * cosine], [ml * cosine, ml * p["length"]]])
        friction = p["damping"] * x[2] + coulomb * np.tanh(x[2] / 0.005)
        force = [actuator(u[0]) + ml * x[3] ** 2 * sine - friction, -ml * G * sine - p["hinge"] * x[3]]
        return np.array([x[2], x[3], *np.linalg.solve(M, force)])

    states, inputs = simulate(rates, [0, 0, 0, 0], lambda t, x: [wave(t) - 4 * x[0] - x[2]], 2000, 0.01, 10)
    model = dr.Model(
        "cart-pole",
        {"x": "m", "theta": "rad"},
        {"force": "N"},
        parameters({"cart": "kg", "pole": "kg", "length": "m", "damping": "N s/m", "hinge": "N m s/rad"}),
        lambda q, v, a, u, p: [
            (p.cart + p.pole) * a.x
            + p.pole * p.length * (a.theta * ca.cos(q.theta) - v.theta**2 * ca.sin(q.theta))
            + p.damping * v.x
            - u.force,
            p.pole * p.length * (p.length * a.theta + a.x * ca.cos(q.theta) + G * ca.sin(q.theta)) + p.hinge * v.theta,
        ],
    )
    signals = {"x": states[:, 0], "theta": states[:, 1]}
    return model, [log_of(rng, 0.01, signals, {"x": 3e-4, "theta": 1e-3}, {"force": inputs[:, 0]}, f"cart-pole {seed}")]


def slipping_joint(seed: int, missing: bool, actuator: Actuator = float) -> tuple[dr.Model, list[dr.Log]]:
    """Two rotors with an elastic joint; missing: dry friction between them."""
    rng = np.random.default_rng([7, seed])
    return _joint(rng, missing * rng.uniform(0.05, 0.2), 0.0, actuator)


def stiffening_joint(seed: int, missing: bool, actuator: Actuator = float) -> tuple[dr.Model, list[dr.Log]]:
    """Two rotors with an elastic joint; missing: a cubic spring between them."""
    rng = np.random.default_rng([8, seed])
    return _joint(rng, 0.0, missing * rng.uniform(200.0, 800.0), actuator)


def _joint(rng: np.random.Generator, coulomb: float, cubic: float, actuator: Actuator) -> tuple[dr.Model, list[dr.Log]]:
    p = drawn(rng, rotor=0.02, inertia=0.05, stiffness=12.0, damping=0.03, friction=0.05)
    wave = Multisine(rng, 1.5, 0.3, 6.0, 8)

    def rates(x: Array, u: Array) -> Array:
        twist, slip = x[0] - x[1], x[2] - x[3]
        torque = p["stiffness"] * twist + cubic * twist**3 + p["damping"] * slip + coulomb * np.tanh(slip / 0.01)
        return np.array(
            [x[2], x[3], (actuator(u[0]) - torque - p["friction"] * x[2]) / p["rotor"], torque / p["inertia"]]
        )

    states, inputs = simulate(rates, [0, 0, 0, 0], lambda t, x: [wave(t)], 3000, 0.005, 10)
    units = {
        "rotor": "kg m^2",
        "inertia": "kg m^2",
        "stiffness": "N m/rad",
        "damping": "N m s/rad",
        "friction": "N m s/rad",
    }

    def equations(q, v, a, u, p):  # noqa: ANN001, ANN202
        torque = p.stiffness * (q.motor - q.load) + p.damping * (v.motor - v.load)
        return [p.rotor * a.motor + torque + p.friction * v.motor - u.torque, p.inertia * a.load - torque]

    model = dr.Model("joint", {"motor": "rad", "load": "rad"}, {"torque": "N m"}, parameters(units), equations)
    signals = {"motor": states[:, 0], "load": states[:, 1]}
    noise = {"motor": 1e-3, "load": 1e-3}
    return model, [log_of(rng, 0.005, signals, noise, {"torque": inputs[:, 0]}, "joint")]


def arm(seed: int, missing: bool) -> tuple[dr.Model, list[dr.Log]]:
    """Two links under computed torques; missing: the rise of dry friction at rest (Stribeck), 30 to 60 %."""
    rng = np.random.default_rng([3, seed])
    p = drawn(rng, a1=0.40, a2=0.15, h1=1.3, h2=0.35, viscous1=0.6, coulomb1=0.9, viscous2=0.25, coulomb2=0.4)
    stribeck, speed, l1 = missing * rng.uniform(0.3, 0.6), 0.05, 0.35
    reference = Multisine(rng, 0.6, 0.1, 1.0, 5), Multisine(rng, 0.6, 0.1, 1.0, 5)
    model_mass = dict(p)

    def friction(i: int, w: float) -> float:
        dry = p[f"coulomb{i}"] * np.tanh(w / 0.01) * (1 + stribeck * np.exp(-((w / speed) ** 2)))
        return p[f"viscous{i}"] * w + dry

    def rates(x: Array, u: Array) -> Array:
        sine, h = np.sin(x[1]), l1 * p["h2"]
        m12 = p["a2"] + h * np.cos(x[1])
        M = np.array([[p["a1"] + m12 + h * np.cos(x[1]), m12], [m12, p["a2"]]])
        g2 = G * p["h2"] * np.sin(x[0] + x[1])
        force = [
            u[0] + h * sine * (2 * x[2] + x[3]) * x[3] - G * p["h1"] * np.sin(x[0]) - g2 - friction(1, x[2]),
            u[1] - h * sine * x[2] ** 2 - g2 - friction(2, x[3]),
        ]
        return np.array([x[2], x[3], *np.linalg.solve(M, force)])

    def control(t: float, x: Array) -> list[float]:
        e = [reference[i](t) - x[i] for i in (0, 1)]
        de = [reference[i](t, 1) - x[2 + i] for i in (0, 1)]
        g2 = G * model_mass["h2"] * np.sin(x[0] + x[1])
        return [60 * e[0] + 9 * de[0] + G * model_mass["h1"] * np.sin(x[0]) + g2, 25 * e[1] + 3 * de[1] + g2]

    x0 = [reference[0](0), reference[1](0), reference[0](0, 1), reference[1](0, 1)]
    states, inputs = simulate(rates, x0, control, 4000, 0.005, 10)

    def equations(q, w, a, u, p):  # noqa: ANN001, ANN202
        c2, s2, h = ca.cos(q.q2), ca.sin(q.q2), l1 * p.h2
        g2 = G * p.h2 * ca.sin(q.q1 + q.q2)
        f1 = p.viscous1 * w.q1 + p.coulomb1 * ca.tanh(w.q1 / 0.01)
        f2 = p.viscous2 * w.q2 + p.coulomb2 * ca.tanh(w.q2 / 0.01)
        return [
            (p.a1 + p.a2 + 2 * h * c2) * a.q1 + (p.a2 + h * c2) * a.q2 - h * s2 * (2 * w.q1 + w.q2) * w.q2
            + G * p.h1 * ca.sin(q.q1) + g2 + f1 - u.torque1,
            (p.a2 + h * c2) * a.q1 + p.a2 * a.q2 + h * s2 * w.q1**2 + g2 + f2 - u.torque2,
        ]  # fmt: skip

    units = {"a1": "kg m^2", "a2": "kg m^2", "h1": "kg m", "h2": "kg m", "viscous1": "N m s/rad", "coulomb1": "N m"}
    model = dr.Model(
        "arm",
        {"q1": "rad", "q2": "rad"},
        {"torque1": "N m", "torque2": "N m"},
        parameters({**units, "viscous2": "N m s/rad", "coulomb2": "N m"}),
        equations,
    )
    signals = {"q1": states[:, 0], "q2": states[:, 1]}
    torques = {"torque1": inputs[:, 0], "torque2": inputs[:, 1]}
    return model, [log_of(rng, 0.005, signals, {"q1": 1e-4, "q2": 1e-4}, torques, f"arm {seed}")]


def rotorcraft(seed: int, missing: bool, actuator: Actuator = float) -> tuple[dr.Model, list[dr.Log]]:
    """The planar rotorcraft under feedback; missing: quadratic drag, 3 to 10 % of its weight at 2 m/s."""
    rng = np.random.default_rng([4, seed])
    p = drawn(rng, mass=0.25, inertia=0.004, drag=0.025)
    quadratic = missing * p["mass"] * G / 4 * rng.uniform(0.03, 0.1)
    x_of, z_of = Multisine(rng, 2.0, 0.05, 0.3, 5), Multisine(rng, 1.0, 0.05, 0.3, 5)

    def rates(x: Array, u: Array) -> Array:
        sine, cosine = np.sin(x[2]), np.cos(x[2])
        thrust = actuator(u[0])
        induced = p["drag"] * abs(thrust)
        fx = -thrust * sine - induced * x[3] * cosine - quadratic * abs(x[3]) * x[3]
        fz = thrust * cosine - induced * x[4] * sine - quadratic * abs(x[4]) * x[4]
        return np.array([x[3], x[4], x[5], fx / p["mass"], fz / p["mass"] - G, 0.177 * u[1] / p["inertia"]])

    def control(t: float, x: Array) -> list[float]:
        ax = x_of(t, 2) + 4 * (x_of(t) - x[0]) + 3.5 * (x_of(t, 1) - x[3])
        az = z_of(t, 2) + 6 * (z_of(t) - x[1]) + 4.0 * (z_of(t, 1) - x[4]) + G
        tilt = np.clip(-np.arctan2(ax, max(az, 3.0)), -0.8, 0.8)
        thrust = p["mass"] * np.clip(np.hypot(ax, az), 2.0, 20.0)
        return [thrust, p["inertia"] / 0.177 * (80 * (tilt - x[2]) - 15 * x[5])]

    x0 = [x_of(0), z_of(0), 0, x_of(0, 1), z_of(0, 1), 0]
    states, inputs = simulate(rates, x0, control, 2500, 0.01, 8)
    noise = {"x": 2e-3, "z": 2e-3, "theta": 3e-3, "x_dot": 0.02, "z_dot": 0.02, "theta_dot": 0.02}
    signals = dict(zip(noise, states.T, strict=True))
    applied = {"thrust": inputs[:, 0], "moment": inputs[:, 1]}
    return dr.models.planar_rotorcraft(), [log_of(rng, 0.01, signals, noise, applied, f"rotorcraft {seed}")]


def underwater_vehicle(seed: int, missing: bool) -> tuple[dr.Model, list[dr.Log]]:
    """An underwater vehicle in one degree of freedom; missing: a current of 0.05 to 0.15 m/s."""
    rng = np.random.default_rng([5, seed])
    p = drawn(rng, mass=180.0, linear=40.0, quadratic=120.0, bias=5.0)
    current = missing * rng.uniform(0.05, 0.15) * rng.choice([-1.0, 1.0])
    wave = Multisine(rng, 90.0, 0.01, 0.25, 8)

    def rates(x: Array, u: Array) -> Array:
        w = x[1] - current
        return np.array([x[1], (u[0] - p["linear"] * w - p["quadratic"] * abs(w) * w - p["bias"]) / p["mass"]])

    states, inputs = simulate(rates, [0, 0], lambda t, x: [wave(t)], 1800, 0.1, 10)
    noise = {"x": 0.02, "x_dot": 0.01}
    signals = dict(zip(noise, states.T, strict=True))
    return dr.models.underwater_vehicle(), [log_of(rng, 0.1, signals, noise, {"thrust": inputs[:, 0]}, f"uuv {seed}")]


# ---------------------------------------------------------------------- real machines


def emps(seed: int, missing: bool) -> tuple[dr.Model, list[dr.Log]]:
    """A servo axis (EMPS), 12 s of its log from a random moment on at 200 Hz; missing: its dry friction."""
    log = dr.read_log(SHARED / "emps" / "DATA_EMPS.csv", rename={"t": "t_s", "position": "q_m", "force": "force_N"})
    start = np.random.default_rng([6, seed]).uniform(0.0, 12.5)
    kept = log.between(start, start + 12.0)
    rows = slice(0, None, 5)
    signals = {"position": kept.signals["position"][rows], "force": kept.signals["force"][rows]}
    known = dr.models.servo_axis()

    def equations(_q, v, a, u, p):  # noqa: ANN001, ANN202
        return [p.mass * a.position + p.viscous_friction * v.position + p.offset - u.force]

    own = {n: x for n, x in known.parameters.items() if n != "dry_friction"}
    model = dr.Model("servo axis", known.coordinates, known.inputs, own, equations) if missing else known
    return model, [dr.Log.from_arrays(kept.time[rows], signals, source=f"emps from {start:.1f} s")]


RUNS = ("00", "01", "02", "03", "04", "05", "11", "12", "13")


def double_pendulum(seed: int, missing: bool) -> tuple[dr.Model, list[dr.Log]]:
    """A double pendulum (DFKI), three random runs of nine at 125 Hz; missing: its dry friction."""
    runs = np.random.default_rng([7, seed]).choice(RUNS, 3, replace=False)
    columns = {"t": "time"}
    columns |= {new + k: old + k for k in "12" for new, old in (("q", "pos_meas"), ("torque", "tau_meas"))}
    files = [SHARED / "dfki_double_pendulum" / f"A0_{run}.parquet" for run in runs]
    read = [dr.read_log(file, rename=columns, resample=125.0) for file in files]
    measured = ("q1", "q2", "torque1", "torque2")
    logs = [dr.Log.from_arrays(x.time, {n: x.signals[n] for n in measured}, source=x.source) for x in read]
    known = dr.models.double_pendulum()
    own = {n: x for n, x in known.parameters.items() if not n.startswith("dry")}

    def equations(q, v, a, u, p):  # noqa: ANN001, ANN202
        values = [0.0 if n.startswith("dry") else p[n] for n in known.parameters]
        vectors = [ca.vertcat(*x) for x in (q, v, a, u, values)]
        return list(ca.vertsplit(known.residual(*vectors)))

    model = dr.Model("double pendulum", known.coordinates, known.inputs, own, equations) if missing else known
    return model, logs


# ---------------------------------------------------------------------- the benchmark


DEFAULT = dr.LoDiransac()


def dead_band(width: float) -> Actuator:
    """An actuator that does not answer inputs below a width."""
    return lambda u: float(u - np.clip(u, -width, width))


def curved(curvature: float) -> Actuator:
    """An actuator whose gain grows with its input."""
    return lambda u: float(u * (1.0 + curvature * abs(u)))


def saturated(level: float) -> Actuator:
    """An actuator with a limit."""
    return lambda u: float(np.clip(u, -level, level))


@dataclass(frozen=True)
class Case:
    """A machine, the suggestion that is right for it, and settings that its motion needs.

    With an actuator, that of one input is missing, and nothing else, or both.
    """

    make: Callable[..., tuple[dr.Model, list[dr.Log]]]
    kinds: tuple[str, ...]
    equations: tuple[str, ...]
    data: str = ""
    method: dr.LoDiransac = DEFAULT
    actuator: Actuator | None = None
    both: bool = False

    def is_right(self, found: Sequence[dr.Suggestion]) -> bool:
        """True if the first suggestion is a missing term, or if there is one of each kind that is missing."""
        kinds = [x.kind if x.equation in self.equations else "" for x in found]
        return set(self.kinds) <= set(kinds) if self.both else kinds[0] in self.kinds


PARTS: dict[str, tuple[str, object]] = {
    "connections": ("missing_terms.connections", lambda *_: []),
    "samples": ("missing_terms.parts_of_intervals", lambda *_: 1),
    "pairs": ("missing_terms.Candidates._pairs", lambda _: (np.zeros((0, 2), int), np.zeros(0))),
}
"""What can be left out: terms between bodies, tests at every sample, pairs of terms."""
CASES = {
    "pendulum without Coulomb friction": Case(pendulum, ("Coulomb friction",), ("q",)),
    "cart-pole without Coulomb friction": Case(
        cart_pole, ("Coulomb friction",), ("x",), method=dr.LoDiransac(smoothing_half_width=0.08)
    ),
    "arm without Stribeck friction": Case(arm, ("Stribeck friction",), ("q1", "q2")),
    "rotorcraft without quadratic drag": Case(rotorcraft, ("quadratic drag",), ("x", "z")),
    "underwater vehicle in a current": Case(underwater_vehicle, ("asymmetric drag",), ("x",)),
    "joint without dry friction between rotors": Case(slipping_joint, ("Coulomb friction",), ("motor",)),
    "joint without a cubic spring": Case(stiffening_joint, ("cubic stiffness",), ("motor",)),
    "pendulum with a dead band": Case(pendulum, ("dead band",), ("torque",), actuator=dead_band(0.05)),
    "pendulum with a curved torque": Case(pendulum, ("curved input",), ("torque",), actuator=curved(0.1)),
    "cart-pole with a dead band": Case(cart_pole, ("dead band",), ("force",), actuator=dead_band(0.4)),
    "cart-pole with saturation": Case(cart_pole, ("saturation",), ("force",), actuator=saturated(3.5)),
    "rotorcraft with a curved thrust": Case(rotorcraft, ("curved input",), ("thrust",), actuator=curved(0.02)),
    "pendulum without friction, with a dead band": Case(
        pendulum, ("Coulomb friction", "dead band"), ("q", "torque"), actuator=dead_band(0.05), both=True
    ),
    "joint without a cubic spring, with a curved torque": Case(
        stiffening_joint, ("cubic stiffness", "curved input"), ("motor", "torque"), actuator=curved(0.1), both=True
    ),
    "rotorcraft without drag, with a curved thrust": Case(
        rotorcraft, ("quadratic drag", "curved input"), ("x", "z", "thrust"), actuator=curved(0.02), both=True
    ),
    "EMPS without dry friction (real)": Case(emps, ("Coulomb friction",), ("position",), "emps"),
    "double pendulum without dry friction (real)": Case(
        double_pendulum, ("Coulomb friction",), ("q1", "q2"), "dfki_double_pendulum"
    ),
}


def identified(case: Case, seed: int, missing: bool) -> tuple[dr.Suggestion, ...] | str:
    """Suggestions for one log, or the error in a word."""
    model, logs = case.make(seed, case.both, case.actuator) if case.actuator else case.make(seed, missing)
    try:
        result = dr.identify(model, logs, case.method, differentiate=True, compare_logs=False)
    except dr.DiransacError as error:
        return type(error).__name__
    return result.suggestions


def row(name: str, case: Case, seeds: Sequence[int]) -> None:
    """Print in how many logs the missing term came first, and what came first elsewhere."""
    begin, right, others = time.process_time(), 0, []
    for seed in seeds:
        found = identified(case, seed, missing=True)
        if isinstance(found, str) or not found:
            others.append(f"{seed}: {found or 'nothing'}")
        elif case.is_right(found):
            right += 1
        else:
            others.append(f"{seed}: {found[0].text}")
    seconds = (time.process_time() - begin) / len(seeds)
    print(f"{name:45} {right:3} of {len(seeds)}  {seconds:5.1f} s each  {'; '.join(others)}", flush=True)


def exact(cases: Sequence[Case], seeds: Sequence[int]) -> None:
    """Print the number of suggestions for logs whose model is exact."""
    found = [(case.make.__name__, seed, identified(case, seed, missing=False)) for case in cases for seed in seeds]
    false = [f"{name} {seed}: {x.text}" for name, seed, some in found if not isinstance(some, str) for x in some]
    failed = [f"{name} {seed}: {some}" for name, seed, some in found if isinstance(some, str)]
    print(f"{'exact models':45} {len(false)} suggestions in {len(found)} logs  {'; '.join(false + failed)}", flush=True)


def main() -> None:
    """Run all cases, or those whose name contains one of the given words."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="*", metavar="CASE")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--without", choices=PARTS, metavar="PART", help=", ".join(PARTS))
    given = parser.parse_args()
    if given.without:
        name, nothing = PARTS[given.without]
        patch(f"diransac.identification.methods.lo_diransac.{name}", nothing).start()
    seeds = range(given.first, given.first + given.seeds)
    for name, case in CASES.items():
        if given.words and not any(word in name for word in given.words):
            continue
        if case.data and not (SHARED / case.data).exists():
            print(f"{name:45} LEFT OUT: {SHARED / case.data} is missing", flush=True)
        else:
            row(name, case, seeds)
    if not given.words or "exact" in given.words:
        exact([case for case in CASES.values() if not case.data and not case.actuator], seeds)


if __name__ == "__main__":
    main()
