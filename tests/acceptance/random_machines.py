"""Small machines that nobody chose: equations, sizes, excitation, sensors and faults are drawn from a seed.

A machine has one or two coordinates.  Terms are present or not; parameters follow from a natural frequency, a damping
ratio and an amplitude, so that each term matters.  Machines of even seeds have the exact model; those of odd seeds lack
something, by `WRONG` in turn.  `benchmarks/random_machines.py` judges 200 of them, `test_random_machines.py` forty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import exp, sin, tanh
from typing import Any

import casadi as ca
import numpy as np

import diransac as dr
from acceptance.integration import coloured, multisine

Array = np.ndarray[Any, Any]

REPORTED, RESERVED = range(580_000, 580_200), range(590_000, 591_000)
"""Seeds that are reported; and those that nobody looks at while a method is developed, for a final judgement alone."""
WRONG = ("missing term", "gust", "dead band", "drifting gain", "payload", "noisy input", "late sensor", "Stribeck")
UNITS = {
    "inertia": "kg m^2", "viscous": "N m s/rad", "dry": "N m", "spring": "N m/rad", "cubic": "N m/rad^3",
    "gravity": "N m", "drag": "N m s^2/rad^2", "offset": "N m", "gain": "1", "lag": "s", "joint": "N m/rad",
    "joint_damping": "N m s/rad", "coupling": "kg m^2",
}  # fmt: skip
ROWS = (300, 700)
"""Least and greatest number of rows of a log."""


@dataclass(frozen=True)
class RandomMachine:
    """A machine as its seed draws it.

    Parameters
    ----------
    seed : of everything
    wrong : what the model lacks; empty where it is exact
    terms : values of every term of the plant by name, SI units, ``viscous1`` that of the first coordinate
    unknown : names of `terms` that are parameters; the model has no others but ``inertia1`` where the gain is unknown
    n : number of coordinates
    hidden : whether the force of the first input follows it with a lag
    rate, amplitude : natural frequency, rad/s, and size of the motion, rad
    speed : of dry friction, rad/s, by which it is smooth
    """

    seed: int
    wrong: str
    terms: Mapping[str, float]
    unknown: tuple[str, ...]
    n: int
    hidden: bool
    rate: float
    amplitude: float
    speed: float

    @property
    def truth(self) -> dict[str, float]:
        """Values of the parameters."""
        return {name: self.terms[name] for name in self.unknown}

    @property
    def force(self) -> float:
        """Size of a torque that moves the first coordinate by the amplitude at its natural frequency, N m."""
        return self.terms["inertia1"] * self.rate**2 * self.amplitude


# ---------------------------------------------------------------------- a machine


def machine(seed: int) -> RandomMachine:
    """The machine of a seed."""
    rng = np.random.default_rng([58, seed])
    wrong = WRONG[seed // 2 % len(WRONG)] if seed % 2 else ""
    n, rate, amplitude = int(rng.integers(1, 3)), float(np.exp(rng.uniform(0.7, 2.5))), float(rng.uniform(0.3, 1.2))
    terms: dict[str, float] = {}
    for k in range(1, n + 1):
        terms |= _terms(rng, k, rate, amplitude, wrong)
    if n == 2:
        least = min(terms["inertia1"], terms["inertia2"])
        if rng.random() < 0.5:
            terms["coupling"] = least * float(rng.uniform(0.2, 0.6))
        else:
            terms["joint"] = least * rate**2 * float(rng.uniform(0.5, 2.0))
            terms["joint_damping"] = least * rate * float(rng.uniform(0.05, 0.3))
    hidden = bool(rng.random() < 0.1)
    if hidden:
        terms["lag"] = float(rng.uniform(0.1, 0.5)) / rate
    of_gain = bool(rng.random() < 0.2) and not hidden
    if of_gain:
        terms["gain"] = float(rng.uniform(0.6, 1.6))
    missing = _missing(rng, terms) if wrong == "missing term" else ""
    unknown = tuple(x for x in terms if x != missing and not (of_gain and x == "inertia1"))
    return RandomMachine(
        seed, wrong, terms, unknown, n, hidden, rate, amplitude, float(rng.uniform(0.01, 0.04)) * amplitude * rate
    )


def _terms(rng: np.random.Generator, k: int, rate: float, amplitude: float, wrong: str) -> dict[str, float]:
    """Terms of a coordinate: an inertia, mostly damping, and others that are there or not."""
    inertia = float(np.exp(rng.uniform(-3.0, 1.5)))
    force, speed = inertia * rate**2 * amplitude, amplitude * rate
    sizes = {
        "viscous": 2.0 * float(rng.uniform(0.05, 0.4)) * inertia * rate,
        "dry": float(rng.uniform(0.03, 0.12)) * force,
        "spring": float(rng.uniform(0.4, 1.0)) * inertia * rate**2,
        "cubic": float(rng.uniform(0.1, 0.5)) * force / amplitude**3,
        "gravity": float(rng.uniform(0.4, 1.0)) * inertia * rate**2,
        "drag": float(rng.uniform(0.1, 0.4)) * force / speed**2,
        "offset": float(rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.2)) * force,
    }
    there = {"viscous": 0.9, "dry": 0.4, "spring": 0.4, "cubic": 0.2, "gravity": 0.4, "drag": 0.25, "offset": 0.25}
    chosen = [name for name, share in there.items() if rng.random() < share]
    if wrong == "Stribeck" and "dry" not in chosen:
        chosen.append("dry")
    return {f"inertia{k}": inertia} | {f"{name}{k}": sizes[name] for name in chosen}


def _missing(rng: np.random.Generator, terms: Mapping[str, float]) -> str:
    """A term that the model lacks: one of those that a user may forget."""
    forgotten = ("dry", "cubic", "drag", "offset", "viscous", "spring", "gravity", "joint_damping")
    names = [x for x in terms if x.startswith(forgotten)]
    return str(rng.choice(names)) if names else "viscous1"


def model_of(one: RandomMachine) -> dr.Model:
    """The model as a user writes it, with bounds as users write them."""
    rng = np.random.default_rng([59, one.seed])
    parameters = {name: _parameter(rng, name, one.terms[name]) for name in one.unknown}

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
        def of(name: str, k: int | str, signal: Any) -> Any:
            full = f"{name}{k}"
            return p[full] * signal if full in one.unknown else 0.0

        found = []
        for k in range(1, one.n + 1):
            x, w, acc = (s[f"q{k}"] for s in (q, v, a))
            inertia = p[f"inertia{k}"] if f"inertia{k}" in one.unknown else one.terms[f"inertia{k}"]
            left = inertia * acc + of("viscous", k, w) + of("dry", k, ca.tanh(w / one.speed)) + of("spring", k, x)
            left += of("cubic", k, x**3) + of("gravity", k, ca.sin(x)) + of("drag", k, ca.fabs(w) * w)
            left += of("offset", k, 1.0)
            other = f"q{3 - k}"
            if one.n == 2:
                left += of("joint", "", x - q[other]) + of("joint_damping", "", w - v[other])
                apart = x - q[other]
                left += of("coupling", "", ca.cos(apart) * a[other] + ca.sin(apart) * v[other] ** 2)
            drive = u[f"torque{k}"]
            if k == 1 and one.hidden:
                drive = v.drive
            left -= p.gain * drive if k == 1 and "gain" in one.unknown else drive
            found.append(left)
        return [*found, p.lag * a.drive + v.drive - u.torque1] if one.hidden else found

    names = range(1, one.n + 1)
    return dr.Model(
        f"machine-{one.seed}", {f"q{k}": "rad" for k in names}, {f"torque{k}": "N m" for k in names}, parameters,
        equations, first_order={"drive": "N m"} if one.hidden else {},
    )  # fmt: skip


def _parameter(rng: np.random.Generator, name: str, value: float) -> dr.Parameter:
    kind = name.rstrip("12")
    if kind in ("inertia", "lag", "gain", "coupling"):
        return dr.Parameter(UNITS[kind], positive=True)
    bounded = rng.random() < 0.5 and kind != "offset"
    far = float(10.0 * abs(value)) if rng.random() < 0.2 else np.inf
    return dr.Parameter(UNITS[kind], lower=0.0 if bounded else -np.inf, upper=far)


# ---------------------------------------------------------------------- its log

Rates = Callable[[list[float], list[float], int], list[float]]
"""``(angles, velocities and force of the first drive; inputs; row) -> rates``."""


def log_of(one: RandomMachine) -> dr.Log:
    """Log of a machine: moved, simulated with fine steps, measured."""
    rng = np.random.default_rng([60, one.seed])
    period = 2.0 * np.pi / one.rate
    dt = period / int(rng.integers(20, 50))
    rows = int(np.clip(rng.uniform(12, 30) * period / dt, *ROWS))
    fault = _fault(one, rng, rows, dt)
    late = float(rng.uniform(0.3, 3.0)) * dt if rng.random() < 0.15 else 0.0
    states, inputs = _moved(one, rng, rows, dt, fault, late)
    return dr.Log.from_arrays(dt * np.arange(rows), _measured(one, rng, states, inputs))


@dataclass(frozen=True)
class Fault:
    """What the model lacks, as the simulation has it; each by the row."""

    gust: Array
    gain: Array
    inertia: Array
    dead: float = 0.0
    stribeck: float = 0.0


def _fault(one: RandomMachine, rng: np.random.Generator, rows: int, dt: float) -> Fault:
    """Sizes are those at which an engineer would still use the model; parameters are those of the beginning."""
    none, share = np.zeros(rows), np.linspace(0.0, 1.0, rows)
    gust = coloured(rng, float(rng.uniform(0.05, 0.2)) * one.force, float(rng.uniform(1, 5)) / one.rate, rows, dt)
    drift, load = float(rng.uniform(0.1, 0.3)), float(rng.uniform(0.2, 0.5))
    return Fault(
        gust if one.wrong == "gust" else none,
        1.0 + drift * share if one.wrong == "drifting gain" else none + 1.0,
        1.0 + load * (share > 0.5) if one.wrong == "payload" else none + 1.0,
        float(rng.uniform(0.05, 0.15)) * one.force if one.wrong == "dead band" else 0.0,
        float(rng.uniform(0.3, 0.8)) * one.terms["dry1"] if one.wrong == "Stribeck" else 0.0,
    )


def exact_rates(one: RandomMachine) -> Rates:
    """Rates of the machine without any fault, as it is simulated."""
    whole = np.ones(1)
    return _rates(one, Fault(0.0 * whole, whole, whole))


def _excitation(one: RandomMachine, rng: np.random.Generator, rows: int, dt: float) -> Callable[[float], float]:
    """Multisine, steps or a chirp, of RMS 1, around the natural frequency."""
    middle, length = one.rate / (2.0 * np.pi), rows * dt
    kind = rng.integers(3)
    if kind == 0:
        return multisine(rng, 1.0, 0.15 * middle, 1.5 * middle, 8)
    if kind == 1:
        levels, hold = rng.uniform(-1.7, 1.7, 200), float(rng.uniform(0.5, 1.5)) / middle
        return lambda t: float(levels[int(t / hold) % 200])
    low, high = 0.15 * middle, 1.5 * middle
    return lambda t: 1.4 * sin(2.0 * np.pi * (low + (high - low) * t / (2.0 * length)) * t)


def _moved(
    one: RandomMachine, rng: np.random.Generator, rows: int, dt: float, fault: Fault, late: float
) -> tuple[Array, Array]:
    """States (rows, 2 n + 1) and inputs (rows, n); machines without a spring or weight are under feedback."""
    waves = [_excitation(one, rng, rows, dt) for _ in range(one.n)]
    size = float(rng.uniform(0.3, 0.8))
    held = [any(f"{x}{k}" in one.terms for x in ("spring", "gravity")) for k in range(1, one.n + 1)]
    closed = not all(held) or bool(rng.random() < 0.25)
    rates = _rates(one, fault)
    stiffest = max(one.terms.get(f"dry{k}", 0.0) / one.terms[f"inertia{k}"] for k in range(1, one.n + 1))
    substeps = int(np.clip(np.ceil(dt * max(5.0 * stiffest / one.speed, 20.0 * one.rate)), 8, 80))
    x, h, delay = [0.0] * (2 * one.n + 1), dt / substeps, round(late * substeps / dt)
    states, inputs = np.empty((rows, 2 * one.n + 1)), np.empty((rows, one.n))
    for row in range(rows):
        states[row] = x
        for k in range(one.n):
            force = one.terms[f"inertia{k + 1}"] * one.rate**2
            wave = size * waves[k](row * dt)
            back = 2.0 * (one.amplitude * wave - x[k]) - x[one.n + k] / one.rate
            inputs[row, k] = force * (back if closed else one.amplitude * wave)
        for i in range(substeps):
            acting = inputs[max(0, (row * substeps + i - delay) // substeps)]
            x = _step(rates, x, acting.tolist(), row, h)
    return states, inputs


def _step(rates: Rates, x: list[float], u: list[float], row: int, h: float) -> list[float]:
    """Classical Runge-Kutta in plain numbers, which small machines are simulated by faster."""
    k1 = rates(x, u, row)
    k2 = rates([a + h / 2 * b for a, b in zip(x, k1, strict=True)], u, row)
    k3 = rates([a + h / 2 * b for a, b in zip(x, k2, strict=True)], u, row)
    k4 = rates([a + h * b for a, b in zip(x, k3, strict=True)], u, row)
    steps = zip(x, k1, k2, k3, k4, strict=True)
    return [a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in steps]


def _rates(one: RandomMachine, fault: Fault) -> Rates:
    """Rates of angles, their velocities and the force of the first drive."""
    n, get = one.n, one.terms.get
    sides = [
        [get(f"{name}{k}", 0.0) for name in ("viscous", "dry", "spring", "cubic", "gravity", "drag", "offset")]
        for k in range(1, n + 1)
    ]
    own = [one.terms[f"inertia{k}"] for k in range(1, n + 1)]
    joint, damping, coupling, gain, lag = (get(x, 0.0) for x in ("joint", "joint_damping", "coupling", "gain", "lag"))

    def rates(x: list[float], u: list[float], row: int) -> list[float]:
        drive = x[-1] if one.hidden else u[0]
        if fault.dead:
            drive = max(drive - fault.dead, 0.0) + min(drive + fault.dead, 0.0)
        forces = [drive * (gain or 1.0) * fault.gain[row] + fault.gust[row], *u[1:]]
        for k, (b, dry, spring, cubic, weight, drag, offset) in enumerate(sides):
            q, v = x[k], x[n + k]
            slip = tanh(v / one.speed)
            forces[k] -= b * v + dry * slip + spring * q + cubic * q**3 + weight * sin(q) + drag * abs(v) * v + offset
        if fault.stribeck:
            forces[0] -= fault.stribeck * tanh(x[n] / one.speed) * exp(-((x[n] / (5.0 * one.speed)) ** 2))
        inertia = own[0] * fault.inertia[row]
        if n == 1:
            return [x[1], forces[0] / inertia, (u[0] - x[-1]) / lag if one.hidden else 0.0]
        apart, faster = x[0] - x[1], x[2] - x[3]
        pull, s, c = joint * apart + damping * faster, coupling * sin(apart), coupling * np.cos(apart)
        f1, f2 = forces[0] - pull - s * x[3] ** 2, forces[1] + pull + s * x[2] ** 2
        d = inertia * own[1] - c * c
        return [
            x[2], x[3], (own[1] * f1 - c * f2) / d, (inertia * f2 - c * f1) / d,
            (u[0] - x[-1]) / lag if one.hidden else 0.0,
        ]  # fmt: skip

    return rates


def _measured(one: RandomMachine, rng: np.random.Generator, states: Array, inputs: Array) -> dict[str, Array]:
    """Columns with noise; some logs have velocities, outliers and a gap."""
    rows, n = len(states), one.n
    names = [f"q{k}" for k in range(1, n + 1)]
    sizes = dict.fromkeys(names, one.amplitude * 10.0 ** rng.uniform(-3.5, -2.0))
    if rng.random() < 0.4:
        speed = one.amplitude * one.rate * 10.0 ** rng.uniform(-2.5, -1.7)
        sizes |= dict.fromkeys([f"{name}_dot" for name in names], speed)
    shown = dict(zip([*names, *(f"{name}_dot" for name in names)], states[:, : 2 * n].T, strict=True))
    columns = {name: shown[name] + size * rng.standard_normal(rows) for name, size in sizes.items()}
    if one.wrong == "late sensor":
        late = int(rng.integers(1, 4))
        columns["q1"] = np.concatenate([np.repeat(columns["q1"][:1], late), columns["q1"][:-late]])
    if rng.random() < 0.3:
        share = float(rng.uniform(0.01, 0.06))
        for name, x in columns.items():
            hit = rng.random(rows) < share
            columns[name] = np.where(hit, x + 3.0 * np.std(shown[name]) * rng.uniform(-1.0, 1.0, rows), x)
    if rng.random() < 0.2:
        begin, length = int(rng.integers(rows // 4, rows // 2)), int(rng.integers(rows // 30, rows // 10))
        columns = {name: np.where(_within(rows, begin, length), np.nan, x) for name, x in columns.items()}
    for k, x in enumerate(inputs.T, start=1):
        error = float(rng.uniform(0.04, 0.12)) * np.std(x) * rng.standard_normal(rows)
        columns[f"torque{k}"] = x + error if one.wrong == "noisy input" else x
    return columns


def _within(rows: int, begin: int, length: int) -> Array:
    row = np.arange(rows)
    return (row >= begin) & (row < begin + length)
