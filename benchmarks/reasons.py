"""The reason that a user is told for a refusal or a bad answer, beside its true cause: mistakes x machines.

Run it as ``python benchmarks/reasons.py [--cases deg,reactor] [--seed 1000] [-o docs/tables/reasons.md]``.  A case is a
machine of the regimes, or one below, whose log or model has one mistake.  A reason is *true* if a finding, or the
refusal, that a user is shown names the cause; *silent* if the answer is refused or bad and none does; *false* if one
says what is not so.
"""

import argparse
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import regime_machines as machines
from regime_flights import REGIMES, Recording, recordings, rk4
from regime_machines import Array

import diransac as dr
from diransac.identification.findings import shown

DEGREE, MILLI, G = np.pi / 180.0, 1e-3, 9.81
UNRELIABLE = "do not rely on this"
FALSE = re.compile(r"does not excite|no effect in the equations|NaN in every row|signs? of \S+ reversed|multiplied by")
"""Claims that are false unless they are the cause."""


@dataclass(frozen=True)
class Case:
    """One mistake.

    Parameters
    ----------
    name : of the row
    cause : in words
    named : what a true reason matches
    made : ``seed -> (model, log)``
    method : of the identification
    """

    name: str
    cause: str
    named: str
    made: Callable[[int], tuple[dr.Model, dr.Log]]
    method: str = "lo-diransac"


@dataclass(frozen=True)
class Told:
    """What a user is told of one case: refusal or verdict, and what is shown, the most serious first."""

    case: Case
    answer: str
    shown: tuple[str, ...]

    @property
    def truth(self) -> str:
        """The reason is "true", "silent" or "false"; "fine" for an answer that is neither refused nor bad."""
        if any(FALSE.search(x) and not re.search(self.case.named, x) for x in self.shown):
            return "false"
        if re.search(self.case.named, " ".join(self.shown)):
            return "true"
        return "silent" if self.answer in ("refused", UNRELIABLE) else "fine"

    @property
    def message(self) -> str:
        """The sentence that names the cause, else the first."""
        naming = [x for x in self.shown if re.search(self.case.named, x)]
        return (naming or [*self.shown, "-"])[0]


# ---------------------------------------------------------------------- mistakes


def _log(recording: Recording, columns: Mapping[str, Array] | None = None, **factors: float) -> dr.Log:
    changed = {**recording.columns, **(columns or {})}
    return dr.Log.from_arrays(recording.time, {n: x * factors.get(n, 1.0) for n, x in changed.items()})


def scaled(regime: str, **factors: float) -> Callable[[int], tuple[dr.Model, dr.Log]]:
    """A regime whose columns are multiplied."""

    def made(seed: int) -> tuple[dr.Model, dr.Log]:
        (one,) = recordings(REGIMES[regime], [seed])
        return REGIMES[regime].machine.model, _log(one, **factors)

    return made


def modelled(regime: str, model: Callable[[], dr.Model]) -> Callable[[int], tuple[dr.Model, dr.Log]]:
    """A regime with another model."""
    return lambda seed: (model(), _log(recordings(REGIMES[regime], [seed])[0]))


def constants(build: Callable[[], dr.Model], **changed: float) -> Callable[[], dr.Model]:
    """A model of the regimes with other constants."""

    def model() -> dr.Model:
        known = {name: getattr(machines, name) for name in changed}
        try:
            vars(machines).update(changed)
            return build()
        finally:
            vars(machines).update(known)

    return model


def timed(regime: str, factor: float) -> Callable[[int], tuple[dr.Model, dr.Log]]:
    """A regime with its time in another unit."""

    def made(seed: int) -> tuple[dr.Model, dr.Log]:
        (one,) = recordings(REGIMES[regime], [seed])
        return REGIMES[regime].machine.model, _log(replace(one, time=one.time * factor))

    return made


def thinned(regime: str, name: str, every: int) -> Callable[[int], tuple[dr.Model, dr.Log]]:
    """A regime one of whose signals is measured every few rows."""

    def made(seed: int) -> tuple[dr.Model, dr.Log]:
        (one,) = recordings(REGIMES[regime], [seed])
        slow = np.where(np.arange(len(one.time)) % every == 0, one.columns[name], np.nan)
        return REGIMES[regime].machine.model, _log(one, {name: slow})

    return made


def at_rest(regime: str) -> Callable[[int], tuple[dr.Model, dr.Log]]:
    """A regime whose machine stands still; its sensors have their noise."""

    def made(seed: int) -> tuple[dr.Model, dr.Log]:
        (one,) = recordings(REGIMES[regime], [seed])
        noise, rng = REGIMES[regime].machine.noise, np.random.default_rng(seed)
        still = {n: noise.get(n, 0.0) * rng.standard_normal(len(x)) for n, x in one.columns.items()}
        return REGIMES[regime].machine.model, _log(one, still)

    return made


# ---------------------------------------------------------------------- machines that the regimes lack


def _pendulum_without_gravity() -> dr.Model:
    known = {"J": dr.Parameter("kg m^2", positive=True), "b": dr.Parameter("N m s/rad", lower=0.0)}
    return dr.Model(
        "rotor", {"q": "rad"}, {"torque": "N m"}, known, lambda q, v, a, u, p: [p.J * a.q + p.b * v.q - u.torque]
    )


def _vehicle_without_drag() -> dr.Model:
    known = {
        "mass": dr.Parameter("kg", positive=True),
        "drag": dr.Parameter("N s/m", lower=0.0),
        "bias": dr.Parameter("N"),
    }
    equations = lambda q, v, a, u, p: [p.mass * a.x + p.drag * v.x + p.bias - u.thrust]  # noqa: E731
    return dr.Model("vehicle", {"x": "m"}, {"thrust": "N"}, known, equations)


def _two_masses() -> dr.Model:
    known = {n: dr.Parameter("kg", positive=True) for n in ("mass", "added_mass")}
    known |= {n: dr.Parameter("N s/m") for n in ("d1", "d2", "b")}
    return dr.Model(
        "vehicle", {"x": "m"}, {"thrust": "N"}, known,
        lambda q, v, a, u, p: [
            (p.mass + p.added_mass) * a.x + p.d1 * v.x + p.d2 * ca.fabs(v.x) * v.x + p.b - u.thrust
        ],
    )  # fmt: skip


def reactor(zero: float, every: int) -> Callable[[int], tuple[dr.Model, dr.Log]]:
    """A stirred tank reactor with Arrhenius' law: temperature from `zero` K on, concentration every few rows."""
    dilution, k, energy, heat, cooling, dt, n = 1 / 60, 1 / 60, 0.875, 120.0, 2.09 / 60, 6.0, 500

    def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:  # noqa: ARG001
        T = v.T + zero
        rate = p.k * ca.exp(-1e4 * p.E * (1 / T - 1 / 350)) * v.c
        of_c = a.c - dilution * (u.feed - v.c) + rate
        return [of_c, a.T - dilution * (350 - T) - p.H * rate + p.U * (T - u.coolant)]

    units = {"k": "1/s", "E": "1e4 K", "H": "K L/mol", "U": "1/s"}
    known = {name: dr.Parameter(unit, positive=True) for name, unit in units.items()}
    states = {"c": "mol/L", "T": "K"}
    model = dr.Model("reactor", {}, {"coolant": "K", "feed": "mol/L"}, known, equations, first_order=states)

    def rates(t: float, x: Array, u: Array) -> Array:  # noqa: ARG001
        rate = k * np.exp(-1e4 * energy * (1 / x[1] - 1 / 350)) * x[0]
        heating = dilution * (350 - x[1]) + heat * rate - cooling * (x[1] - u[0])
        return np.array([dilution * (u[1] - x[0]) - rate, heating])

    def made(seed: int) -> tuple[dr.Model, dr.Log]:
        rng = np.random.default_rng(seed)
        levels = np.repeat(rng.uniform(-1.0, 1.0, (n // 25 + 1, 2)), 25, axis=0)[:n]
        u, x, rows = np.array([300.0, 1.0]) + levels * (15.0, 0.25), np.array([0.8, 325.0]), []
        for k_row in range(n):
            rows.append(x)
            for _ in range(20):
                x = rk4(rates, 0.0, x, u[k_row], dt / 20)
        c, T = (np.array(rows) + rng.standard_normal((n, 2)) * (0.003, 0.1)).T
        c = np.where(np.arange(n) % every == 0, c, np.nan)
        columns = {"c": c, "T": T - zero, "coolant": u[:, 0], "feed": u[:, 1]}
        return model, dr.Log.from_arrays(dt * np.arange(n), columns)

    return made


def lift(pressure: float) -> Callable[[int], tuple[dr.Model, dr.Log]]:
    """A hydraulic lift of known mass and piston, whose pressure is multiplied by a factor."""
    mass, area, b, fc, dt, n = 120.0, 8e-4, 900.0, 60.0, 0.01, 1500
    known = {"b": dr.Parameter("N s/m", lower=0.0), "fc": dr.Parameter("N", lower=0.0)}
    model = dr.Model(
        "lift", {"z": "m"}, {"pressure": "Pa"}, known,
        lambda q, v, a, u, p: [
            mass * (a.z + G) + p.b * v.z + p.fc * ca.tanh(v.z / 0.01) - area * u.pressure
        ],
    )  # fmt: skip

    def made(seed: int) -> tuple[dr.Model, dr.Log]:
        rng = np.random.default_rng(seed)
        reference, p = machines.Multisine([rng], (0.15,), 0.1, 0.8), np.zeros(n)
        x, rows = np.zeros(2), []
        for k in range(n):
            rows.append(x)
            r, r1, r2 = (reference(k * dt, i).item() for i in range(3))
            p[k] = (mass * (G + r2 + 60.0 * (r - x[0]) + 15.0 * (r1 - x[1])) + b * r1) / area
            for _ in range(10):
                force = area * p[k] - b * x[1] - fc * np.tanh(x[1] / 0.01)
                x = x + dt / 10 * np.array([x[1], force / mass - G])
        z = np.array(rows)[:, 0] + 1e-4 * rng.standard_normal(n)
        return model, dr.Log.from_arrays(dt * np.arange(n), {"z": z, "pressure": p * pressure})

    return made


# ---------------------------------------------------------------------- cases


def _unit(
    name: str, regime: str, cause: str, column: str, factor: str, method: str = "lo-diransac", **by: float
) -> Case:
    """A column in a wrong unit: the reason names the option that corrects it."""
    return Case(name, cause, rf"--scale {column}={factor}", scaled(regime, **by), method)


def _cases() -> Iterator[Case]:
    rotor, deg = "rotor noise 1x", 1.0 / DEGREE
    yield _unit(
        "rotor theta, theta_dot deg",
        rotor,
        "theta and theta_dot are in deg",
        "theta",
        "0.0174",
        theta=deg,
        theta_dot=deg,
    )
    yield _unit("rotor theta deg", rotor, "theta is in deg, theta_dot in rad/s", "theta", "0.0174", theta=deg)
    yield _unit("rotor theta_dot deg/s", rotor, "theta_dot is in deg/s", "theta_dot", "0.0174", theta_dot=deg)
    yield _unit("rotor x, z mm", rotor, "x and z are in mm", "x", "0.001", x=1e3, z=1e3)
    yield _unit(
        "rotor accelerations g", rotor, "x_ddot and z_ddot are in g", "[xz]_ddot", "9.8", x_ddot=1 / G, z_ddot=1 / G
    )
    yield _unit("rotor thrust kN, ols", rotor, "none is seen: mass takes it up", "thrust", "1000", "ols", thrust=MILLI)
    yield _unit("pendulum q deg", "pendulum noisy", "q is in deg", "q", "0.0174", q=deg)
    yield _unit("pendulum q deg, ols", "pendulum noisy", "q is in deg", "q", "0.0174", "ols", q=deg)
    yield _unit("arm q1, q2 deg", "arm noisy", "q1 and q2 are in deg", "q1", "0.0174", q1=deg, q2=deg)
    yield _unit("arm q2 deg", "arm noisy", "q2 is in deg, q1 in rad", "q2", "0.0174", q2=deg)
    yield _unit("cart-pole theta deg", "cart-pole 40 Hz", "theta is in deg", "theta", "0.0174", theta=deg)
    yield _unit("cart-pole x mm", "cart-pole 40 Hz", "x is in mm", "x", "0.001", x=1e3)
    yield _unit(
        "car steering deg",
        "car all measured",
        "none is seen: Cf takes part of it up",
        "steering",
        "0.0174",
        steering=deg,
    )
    yield _unit("car yaw_dot deg/s", "car all measured", "yaw_dot is in deg/s", "yaw_dot", "0.0174", yaw_dot=deg)
    yield _unit("car speed km/h", "car all measured", "speed is in km/h", "speed", "0.277", speed=3.6)
    yield _unit("underwater x_dot mm/s", "underwater noisy", "x_dot is in mm/s", "x_dot", "0.001", x_dot=1e3)
    yield _unit(
        "drive wheels rpm",
        "differential drive all measured",
        "wl and wr are in rpm",
        "w[lr]",
        "0.104",
        wl=30 / np.pi,
        wr=30 / np.pi,
    )
    yield _unit("drive yaw deg", "differential drive all measured", "yaw is in deg", "yaw", "0.0174", yaw=deg)
    yield Case(
        "lift pressure bar", "pressure is in bar", r"--scale pressure=1e\+05|--scale pressure=100000", lift(1e-5)
    )
    yield Case("lift pressure Pa", "none: a check of the case above", r"$^", lift(1.0))
    yield Case("rotor time ms", "time is in ms", r"time.*\bms\b|--scale t=0.001", timed(rotor, 1e3))
    yield Case("underwater time ms", "time is in ms", r"time.*\bms\b|--scale t=0.001", timed("underwater noisy", 1e3))

    reversed_ = r"sign of {0}\b|signs of [^.]*{0}\b|{0} reversed"
    for regime, name in (
        (rotor, "thrust"), (rotor, "moment"), ("pendulum noisy", "torque"), ("cart-pole 40 Hz", "force"),
        ("underwater noisy", "thrust"), ("car all measured", "steering"), ("motor noisy", "torque"),
    ):  # fmt: skip
        yield Case(
            f"{regime.split()[0]} {name} reversed",
            f"{name} has the wrong sign",
            reversed_.format(name),
            scaled(regime, **{name: -1.0}),
        )
    yield Case(
        "rotor theta reversed",
        "theta and theta_dot have the wrong sign",
        reversed_.format("(theta|thrust)"),
        scaled(rotor, theta=-1.0, theta_dot=-1.0),
    )
    yield Case(
        "pendulum torque reversed, ols",
        "torque has the wrong sign",
        reversed_.format("torque"),
        scaled("pendulum noisy", torque=-1.0),
        "ols",
    )

    for regime, name, named in (
        (rotor, "moment", "moment is zero"), ("pendulum noisy", "torque", "torque is zero"),
        ("arm noisy", "t2", "t2 is zero"), ("car all measured", "steering", "steering is zero"),
    ):  # fmt: skip
        yield Case(
            f"{regime.split()[0]} {name} missing", f"the column {name} is zero", named, scaled(regime, **{name: 0.0})
        )

    term = r"(term|constant)s? of the model|seems to lack|lacks? a term|model explains almost nothing"
    yield Case(
        "arm link .6 for .4 m",
        "a length of the model is wrong",
        term,
        modelled("arm noisy", constants(machines._arm_model, _LINK=0.6)),
    )
    yield Case(
        "arm gravity upside down",
        "gravity of the model has the wrong sign",
        term,
        modelled("arm noisy", constants(machines._arm_model, G=-G)),
    )
    yield Case(
        "car mass 3 t for 1.3 t",
        "a mass of the model is wrong",
        term,
        modelled("car all measured", constants(machines._car_model, _CAR_MASS=3000.0)),
    )
    yield Case(
        "car axles exchanged",
        "lengths of the model are exchanged",
        term,
        modelled("car all measured", constants(machines._car_model, _FRONT=1.42, _REAR=1.05)),
    )
    yield Case(
        "cart-pole gravity upside down",
        "gravity of the model has the wrong sign",
        term,
        modelled("cart-pole 40 Hz", constants(machines._cart_model, G=-G)),
    )
    yield Case(
        "pendulum without gravity",
        "the model lacks gravity",
        r"[Gg]ravity",
        modelled("pendulum noisy", _pendulum_without_gravity),
    )
    yield Case(
        "vehicle without quadratic drag",
        "the model lacks quadratic drag",
        r"[Qq]uadratic drag",
        modelled("underwater noisy", _vehicle_without_drag),
    )
    yield Case(
        "vehicle of two masses",
        "only a sum is identifiable",
        r"combination mass \+ added_mass",
        modelled("underwater noisy", _two_masses),
    )
    yield Case(
        "vehicle of two masses, ols",
        "only a sum is identifiable",
        r"combination mass \+ added_mass",
        modelled("underwater noisy", _two_masses),
        "ols",
    )

    yield Case("pendulum at rest", "nothing moves", r"nothing moves", at_rest("pendulum noisy"))
    yield Case("underwater x every 20th row", "none: x is slow", r"$^", thinned("underwater noisy", "x", 20))
    yield Case(
        "underwater x_dot every 40th row, ols",
        "x_dot is slow",
        r"x_dot.*every 40 rows",
        thinned("underwater noisy", "x_dot", 40),
        "ols",
    )
    for method in ("lo-diransac", "nls"):
        slow = r"every 10 rows|every 10th row|c has a sample" if method == "nls" else r"$^"
        yield Case(f"reactor, kelvin, {method}", "none: an exact model", r"$^", reactor(0.0, 1), method)
        yield Case(f"reactor, c slow, {method}", "c is measured every tenth row", slow, reactor(350.0, 10), method)
        yield Case(f"reactor, degC for K, {method}", "T lacks 273.15", r"273|degC|°C", _celsius, method)
    for regime, cause, named in (
        ("rotor moment 20 ms later", "moment acts 20 ms late", r"moment acts|delay|lag"),
        ("rotor payload -30 %", "the mass changes", r"mass changes|changes during"),
        ("rotor battery sag 15 %", "the gain of the inputs falls", r"falls by|changes during"),
        ("pendulum Coulomb friction", "the model lacks dry friction", r"[Dd]ry friction|Coulomb"),
        ("motor dead band", "the input has a dead band", r"[Dd]ead band|friction"),
        ("rotor curved thrust", "the input is curved", r"[Cc]urved|[Gg]ain of thrust"),
        ("motor backlash", "the load has backlash", r"lacks|unexplained|disagree"),
        ("underwater lag .5 s", "the input lags", r"lag"),
    ):
        yield Case(regime, cause, named, scaled(regime))


def _celsius(seed: int) -> tuple[dr.Model, dr.Log]:
    """The reactor in kelvin, with a log in degrees Celsius."""
    model, log = reactor(0.0, 1)(seed)
    columns = {n: log[n] - (273.15 if n in ("T", "coolant") else 0.0) for n in log.names}
    return model, dr.Log.from_arrays(log.time, columns)


CASES = {one.name: one for one in _cases()}
"""Cases by name, in the order of the table."""


# ---------------------------------------------------------------------- what a user is told


def told(case: Case, seed: int) -> Told:
    """The answer to one case, and what a user sees of its reasons."""
    model, log = case.made(seed)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = dr.identify(model, log, case.method, differentiate=True)
    except dr.DiransacError as error:
        return Told(case, "refused", (str(error),))
    return Told(case, result.verdict, tuple(map(str, shown(result.findings)[0])))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default="", metavar="A,B", help="parts of names; all by default")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("-o", "--output", type=Path, help="a file to write the same to")
    parser.add_argument("--all", action="store_true", help="every sentence that is shown, not one")
    chosen = parser.parse_args(arguments)
    parts = chosen.cases.split(",")
    rows, counts = list[str](), dict[str, int]()
    for case in CASES.values():
        if any(part in case.name for part in parts):
            found = told(case, chosen.seed)
            counts[found.truth] = counts.get(found.truth, 0) + 1
            message = "<br>".join(found.shown) if chosen.all else found.message
            rows.append(
                f"| {' | '.join([case.name, case.cause, found.answer, found.truth, message.replace('|', '&#124;')])} |"
            )
            print(rows[-1], file=sys.stderr, flush=True)
    total = ", ".join(f"{n} {name}" for name, n in sorted(counts.items(), key=lambda x: -x[1]))
    text = "\n".join(
        [
            f"Of {len(rows)} cases: {total}.\n",
            "| case | true cause | answer | reason | message |",
            "|---" * 5 + "|",
            *rows,
            "",
        ]
    )
    if chosen.output:
        chosen.output.write_text(text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
