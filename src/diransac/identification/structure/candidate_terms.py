"""Candidate terms of equations of motion: friction, drag, stiffness, harmonics, products, inputs, a user's own.

A candidate is an addition ``theta h(q, v, a, u, p)`` to the residuals of a model, with one new parameter theta.
Friction switches smoothly over a hundredth of the RMS speed, so that columns, printed code and simulations are the same
function.

References
----------
Armstrong-Helouvry, Dupont, Canudas de Wit 1994 (models of friction); Brunton, Proctor, Kutz 2016 (libraries of
candidate terms); Fossen 2011, section 8 (currents); Tao, Kokotovic 1996 (dead bands of actuators).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.errors import ModelError
from diransac.identification.structure.lacking_terms import INPUT_GAIN, KINDS, Suggestion
from diransac.model import Model, expressions
from diransac.model.derivation import Symbols, call_user

TermLibrary = Callable[[Symbols, Symbols, Symbols], Mapping[str, Any]]
"""A user's candidates: ``library(q, v, u)`` returns expressions by name, each of which is tried in every equation."""


@dataclass(frozen=True)
class CandidateTerm:
    """One addition to the residuals of a model, up to its coefficient.

    Parameters
    ----------
    kind : str
        Effect, such as ``"Coulomb friction"``.
    equation : int
        Index of the equation; -1 for a change of an input, which acts in every equation that the input enters.
    place : str
        Coordinate, velocity or input in the name of the parameter and in sentences.
    formula : str
        The term for readers, such as ``sign(x_dot)``.
    code : str
        Python code, with CasADi as ``ca``: a summand of the residual with its sign, or what replaces the input.
    parameter : str
        Name of the new parameter.
    unit : str
        Unit of its coefficient; empty if unknown.
    residuals : casadi.SX
        ``h (n_v)`` of the symbols of `CandidateTerms`.
    bounds : (float, float), optional
        Smallest and largest coefficient that is possible.
    name : str, optional
        Name in an engineer's words, such as ``dry friction of x``.
    """

    kind: str
    equation: int
    place: str
    formula: str
    code: str
    parameter: str
    unit: str
    residuals: ca.SX
    bounds: tuple[float, float] = (-np.inf, np.inf)
    name: str = ""


@dataclass(frozen=True)
class CandidateTerms:
    """Candidates over common symbols.

    Parameters
    ----------
    symbols : tuple of casadi.SX
        q, v, a, u, p.
    terms : tuple of CandidateTerm
    """

    symbols: tuple[ca.SX, ...]
    terms: tuple[CandidateTerm, ...]

    def __len__(self) -> int:
        return len(self.terms)

    @cached_property
    def _entries(self) -> tuple[ca.Function, IntArray, IntArray]:
        """Function of the terms' structurally nonzero entries; equation and term of each."""
        stacked = ca.sparsify(ca.horzcat(*(x.residuals for x in self.terms)))
        rows, columns = stacked.sparsity().get_triplet()
        nonzeros = ca.vertcat(*(stacked[i, j] for i, j in zip(rows, columns, strict=True)))
        entries = ca.Function("entries", list(self.symbols), [nonzeros])
        return entries, np.array(rows), np.array(columns)

    def means(self, motion: Sequence[FloatArray], weights: FloatArray, length: int) -> FloatArray:
        """Weighted means of every term over intervals of ``length`` rows.

        Parameters
        ----------
        motion : sequence of (N, n) array
            q, v, a, u and p of every row.
        weights : (N,) array
            Sum over each interval is 1.
        length : int

        Returns
        -------
        (N / length, n_v, n_terms) array
        """
        entries, rows, columns = self._entries
        n = len(weights) // length
        found = np.zeros((n, self.terms[0].residuals.numel(), len(self)))
        step = max(1, 4096 // length)
        for k in range(0, n, step):
            part = slice(k * length, (k + step) * length)
            values = _in_every_row(entries, [x[part] for x in motion]) * weights[part, None]
            found[k : k + step, rows, columns] = values.reshape(-1, length, len(rows)).sum(axis=1)
        return found

    def suggestion(self, k: int, value: float, error: float, explained: float) -> Suggestion:
        """Term k in words and as a line of model code.

        Parameters
        ----------
        k : int
        value, error : float
            Coefficient and its standard error.
        explained : float
            Fraction of the mean square of the unmodelled force that the term explains.

        Returns
        -------
        Suggestion
        """
        term = self.terms[k]
        digits = max(0, 1 - int(np.floor(np.log10(error)))) if error > 0.0 else 3
        size, spread = (f"{x:.{digits}f}" if digits < 6 else f"{x:.3g}" for x in (value, error))
        unit = f" {term.unit}" if term.unit not in ("", "1") else ""
        share = f"explains {100.0 * explained:.0f} % of the unmodelled force"
        if term.kind == INPUT_GAIN:
            text = f"Gain of {term.place}: an error of {size} ± {spread} {share}"
        else:
            formula = f" {term.formula}" if term.formula else ""
            text = f"{term.name[0].upper()}{term.name[1:]}: {size} ± {spread}{unit}{formula} {share}"
        h = ca.Function("term", list(self.symbols), [ca.densify(term.residuals)], list("qvaup"), ["h"])
        return Suggestion(
            term.kind, term.place, text, term.parameter, value, error, term.unit, explained,
            term.code, expressions.stored(f"term {term.parameter}", h), term.name,
        )  # fmt: skip


def _in_every_row(function: ca.Function, arrays: Sequence[FloatArray]) -> FloatArray:
    """Values (N, n) of a function of vectors over rows (N, n_i), by CasADi: these are too many terms to compile."""
    inputs, found = [np.ascontiguousarray(x) for x in arrays], np.empty((len(arrays[0]), function.numel_out(0)))
    buffer, evaluate = function.map(len(found)).buffer()
    for k, rows in enumerate(inputs):
        buffer.set_arg(k, rows.data)  # type: ignore[call-arg]  # a buffer has a size
    buffer.set_res(0, found.data)  # type: ignore[call-arg]
    evaluate()
    return found


def candidate_terms(
    model: Model, speeds: FloatArray, inputs: FloatArray, library: TermLibrary | None = None
) -> CandidateTerms:
    """The library of candidates of a model.

    In the equation of each velocity v: ``sign(v)``, Stribeck friction at several speeds, ``v``, ``|v| v``, ``|v|``
    (drag in a current), a constant, the position, its square and cube, harmonics of every angle, other velocities and
    all products of velocities; besides them the user's expressions, and of each input a gain, an offset, ``|u| u``, a
    dead band of several widths and a saturation at several levels.

    Parameters
    ----------
    model : Model
    speeds : (n_v,) array
        RMS of each velocity, its unit; velocities that are zero get no friction.
    inputs : (n_u, 2) array
        RMS of each input, its unit, and the size up to which it mostly goes; inputs that are zero get a gain alone.
    library : callable, optional
        The user's expressions by name.

    Returns
    -------
    CandidateTerms

    Raises
    ------
    ModelError
        The user's library fails, or returns a name that cannot be that of a parameter.
    """
    symbols = tuple(ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup"))
    maker = _Maker(model, symbols, speeds, inputs)
    terms = [x for i in range(model.n_v) for x in maker.of_equation(i)]
    if library is not None:
        terms += maker.of_user(library)
    return CandidateTerms(symbols, (*terms, *maker.of_inputs()))


@dataclass(frozen=True)
class _Maker:
    """Makes the candidates of one model."""

    model: Model
    symbols: tuple[ca.SX, ...]
    speeds: FloatArray
    inputs: FloatArray

    def of_equation(self, i: int) -> Iterator[CandidateTerm]:
        """Candidates in one equation, the simplest first."""
        first_order = self.model.rate_names[i] in self.model.first_order
        if first_order:
            yield from self._of_own_state(i)
        elif self.speeds[i] > 0.0:
            yield from self._of_own_speed(i)
        yield self._term("constant term" if first_order else "constant force", i, "bias", "", "", ca.SX(1), "")
        yield from self._of_positions(i)
        yield from self._of_other_speeds(i)

    def _of_own_speed(self, i: int) -> Iterator[CandidateTerm]:
        v, name, code = self.symbols[1][i], list(self.model.velocities)[i], f"v.{self.model.rate_names[i]}"
        unit = list(self.model.velocities.values())[i]
        speed = float(f"{0.01 * self.speeds[i]:.1g}")
        sign, smooth = ca.tanh(v / speed), f"ca.tanh({code} / {speed:g})"
        yield self._term("Coulomb friction", i, "coulomb", f"sign({name})", smooth, sign, "")
        yield self._term("viscous friction", i, "viscous", name, code, v, unit)
        drag = f"ca.fabs({code}) * {code}"
        yield self._term("quadratic drag", i, "quadratic", f"|{name}| {name}", drag, ca.fabs(v) * v, f"({unit})^2")
        yield self._term("asymmetric drag", i, "current", f"|{name}|", f"ca.fabs({code})", ca.fabs(v), unit)
        for factor in (0.03, 0.06, 0.12, 0.25):
            slow = float(f"{factor * self.speeds[i]:.2g}")
            yield self._term(
                "Stribeck friction",
                i,
                "stribeck",
                f"sign({name}) exp(-({name} / {slow:g})^2)",
                f"{smooth} * ca.exp(-(({code} / {slow:g}) ** 2))",
                sign * ca.exp(-((v / slow) ** 2)),
                "",
            )

    def _of_own_state(self, i: int) -> Iterator[CandidateTerm]:
        s, name = self.symbols[1][i], self.model.rate_names[i]
        unit = self.model.first_order[name]
        yield self._term("linear term", i, "linear", name, f"v.{name}", s, unit)
        yield self._term("quadratic term", i, "quadratic", f"{name}^2", f"v.{name} ** 2", s**2, f"({unit})^2")

    def _of_positions(self, i: int) -> Iterator[CandidateTerm]:
        derived = self.model.kinematics is None
        for k, (name, unit) in enumerate(self.model.coordinates.items()):
            q = self.symbols[0][k]
            if derived and k == i:
                yield self._term("stiffness", i, "stiffness", name, f"q.{name}", q, unit)
                for n, kind in ((2, "quadratic"), (3, "cubic")) if unit != "rad" else ():
                    code = f"q.{name} ** {n}"
                    yield self._term(
                        f"{kind} stiffness", i, f"{kind}_stiffness", f"{name}^{n}", code, q**n, f"({unit})^{n}"
                    )
            for n in (1, 2, 3) if unit == "rad" else ():
                many = f"{n} " if n > 1 else ""
                kind = f"harmonic {n} of {name}" if n > 1 else f"gravity or first harmonic of {name}"
                for function in ("sin", "cos"):
                    code = f"ca.{function}({n} * q.{name})" if n > 1 else f"ca.{function}(q.{name})"
                    value = getattr(ca, function)(n * q)
                    label = f"{function}{n if n > 1 else ''}_{name}"
                    yield self._term(kind, i, label, f"{function}({many}{name})", code, value, "")

    def _of_other_speeds(self, i: int) -> Iterator[CandidateTerm]:
        v, signals, rates = self.symbols[1], list(self.model.velocities), self.model.rate_names
        units = list(self.model.velocities.values())
        for j in range(self.model.n_v):
            if j != i:
                yield self._term(
                    f"coupling to {signals[j]}", i, f"coupling_{rates[j]}", signals[j], f"v.{rates[j]}", v[j], units[j]
                )
        for j, k in combinations_with_replacement(range(self.model.n_v), 2):
            formula, code = f"{signals[j]} {signals[k]}", f"v.{rates[j]} * v.{rates[k]}"
            unit = f"({units[j]}) ({units[k]})"
            label = f"product_{rates[j]}_{rates[k]}"
            yield self._term("product of velocities", i, label, formula, code, v[j] * v[k], unit)

    def of_user(self, library: TermLibrary) -> Iterator[CandidateTerm]:
        """The user's expressions in every equation."""
        q, v, _, u, _ = self.model.named(*self.symbols)
        label, names = f'model "{self.model.name}"', list[str]()

        def expressions(q: Symbols, v: Symbols, u: Symbols) -> list[Any]:
            found = library(q, v, u)
            if not isinstance(found, Mapping):
                raise TypeError(f"{found!r:.60} is no mapping from names to expressions")
            names.extend(found)
            return list(found.values())

        column = call_user(label, "candidate terms", expressions, q, v, u)
        for name, value in zip(names, ca.vertsplit(column) if names else [], strict=True):
            if not str(name).isidentifier():
                raise ModelError(f"{label}: {name!r} cannot name a candidate term; use letters, digits and underscores")
            for i in range(self.model.n_v):
                yield self._term(name, i, name, name, name, value, None)

    def of_inputs(self) -> Iterator[CandidateTerm]:
        """Changes of each input, in every equation that it enters, the simplest first."""
        q, v, a, u, p = self.symbols
        r = self.model.residual(q, v, a, u, p)
        for j, (name, unit) in enumerate(self.model.inputs.items()):
            slope = ca.jacobian(r, u[j])
            for kind, label, formula, code, value, of_value, bounds in self._changes(name, u[j], unit, *self.inputs[j]):
                parameter = self._free(f"{label}_{name}")
                line = f"u.{name}" + (" * (1 + p.{0})" if kind == INPUT_GAIN else f" + p.{{0}}{code}").format(parameter)
                h = ca.densify(slope * value)
                called = KINDS[kind][0].format(x=name)
                yield CandidateTerm(kind, -1, name, formula, line, parameter, of_value, h, bounds, called)

    def _changes(
        self, name: str, u: ca.SX, unit: str, size: float, largest: float
    ) -> Iterator[tuple[str, str, str, str, ca.SX, str, tuple[float, float]]]:
        """Kind, label, formula, factor in code, value, and unit and bounds of the coefficient of changes of one input.

        Within the bounds, but for an error of half of the coefficient, what the actuator gives does not fall with its
        input; a dead band and saturation take from it.
        """
        most = 1.5
        yield INPUT_GAIN, "gain_error", name, "", u, "1", (-0.5, 0.5)
        if not size > 0.0:
            return
        code, per_unit = f"u.{name}", _over("1", "" if unit == "1" else unit)
        yield "input offset", "offset", "", "", ca.SX(1), unit, (-np.inf, np.inf)
        curve, least = f" * ca.fabs({code}) * {code}", -most / (2.0 * largest)
        yield "curved input", "curvature", f"|{name}| {name}", curve, ca.fabs(u) * u, per_unit, (least, np.inf)
        for factor in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8):
            width = float(f"{factor * size:.2g}")
            limited = f" * ca.fmax(-1, ca.fmin(1, {code} / {width:g}))"
            value = ca.fmax(-1.0, ca.fmin(1.0, u / width))
            formula = f"sign({name}) beyond {width:g}"
            yield "dead band", "dead_band", formula, limited, value, unit, (-most * width, 0.0)
        for factor in (0.6, 0.8, 1.0, 1.3, 1.7):
            level = float(f"{factor * size:.2g}")
            beyond = f" * ({code} - ca.fmax(-{level:g}, ca.fmin({level:g}, {code})))"
            value = u - ca.fmax(-level, ca.fmin(level, u))
            yield "saturation", "saturation", f"({name} beyond {level:g})", beyond, value, "1", (-most, 0.0)

    def _term(
        self, kind: str, i: int, label: str, formula: str, code: str, value: ca.SX, unit: str | None
    ) -> CandidateTerm:
        """A term in one equation; ``unit`` is that of the expression, None if unknown."""
        place = self.model.rate_names[i]
        sign, parameter = -1 if self.model.force_sign < 0 else 1, self._free(f"{label}_{place}")
        residuals = ca.SX(self.model.n_v, 1)
        residuals[i] = sign * value
        factor = f" * {code}" if code else ""
        line = f"{'-' if sign < 0 else '+'} p.{parameter}{factor}"
        known = self.model.kinematics is None and self.model.force_sign
        force = {"m": "N", "rad": "N m"}.get(self.model.coordinates.get(place, ""), "") if known else ""
        whole = "" if unit is None or not force else _over(force, unit)
        name = _name(kind, place, formula, self.model.coordinates.get(place, ""))
        return CandidateTerm(kind, i, place, formula, line, parameter, whole, residuals, name=name)

    def _free(self, name: str) -> str:
        """The name, or the next that no signal and no parameter has."""
        model = self.model
        taken = {*model.units, *model.parameters}
        names = (name, *(f"{name}_{k}" for k in range(2, len(taken) + 3)))
        return next(x for x in names if x not in taken)


def _name(kind: str, place: str, formula: str, unit: str) -> str:
    """Name of a term in the equation of a coordinate with a unit, or of a velocity without one."""
    force, first = {"m": "force along", "rad": "torque about"}.get(unit, "force on"), kind.partition(" ")[0]
    if kind in KINDS and KINDS[kind][0]:
        return KINDS[kind][0].format(x=place, force=force)
    if first in ("gravity", "harmonic"):
        angle = kind.rpartition(" ")[2]
        if first == "harmonic":
            return f"ripple of the {force} {place}, {kind.split()[1]} periods per turn of {angle}"
        return f"gravity {force.removeprefix('force ')} {place}" + (f", as {angle} tilts" if angle != place else "")
    if first == "coupling":
        return f"viscous coupling of {place} to {kind.rpartition(' ')[2]}"
    if kind == "product of velocities":
        a, b = formula.split(" ")
        cause = "Coriolis" if a != b else "centrifugal"
        return f"{cause} {force} {place}, by {a if a == b else f'{a} and {b}'}"
    return f"{kind} on {place}"


_QUOTIENTS = {
    "m": "/m", "rad": "/rad", "m/s": " s/m", "rad/s": " s/rad", "(m/s)^2": " s^2/m^2", "(rad/s)^2": " s^2/rad^2",
    "(m/s) (m/s)": " s^2/m^2", "(rad/s) (rad/s)": " s^2/rad^2", "(m/s) (rad/s)": " s^2/(m rad)",
    "(rad/s) (m/s)": " s^2/(m rad)", "N": "/N",
}  # fmt: skip


def _over(force: str, unit: str) -> str:
    """Unit of a force over that of an expression: ``N`` over ``m/s`` is ``N s/m``."""
    return force + _QUOTIENTS.get(unit, f"/({unit})") if unit else force
