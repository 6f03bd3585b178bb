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
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import chain, combinations_with_replacement, count
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.identification.structure.lacking_terms import INPUT_GAIN, KINDS, Suggestion, name_of_term, unit_over
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
    equation : str
        Coordinate or velocity whose equation has the code; the input, for a change of one, which acts in every equation
        that the input enters.
    place : str
        Coordinate, velocity, difference of these, or input in sentences.
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
    also : mapping of str to str, optional
        Further equations in which the term acts, and their code.
    option : str, optional
        Option that makes a constant of the model a parameter, in place of code.
    """

    kind: str
    equation: str
    place: str
    formula: str
    code: str
    parameter: str
    unit: str
    residuals: ca.SX
    bounds: tuple[float, float] = (-np.inf, np.inf)
    name: str = ""
    also: Mapping[str, str] = field(default_factory=dict)
    option: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class RelativeMotion:
    """A motion of several velocities on which a term of the model depends, as a spring or damper between two bodies.

    Parameters
    ----------
    velocities : (n_v,) array
        Factors of the velocities whose sum it is; the first that is not zero is 1.
    forces : (n_v,) array
        Residuals of each equation by what it drives; the first that is not zero is 1 or -1.
    speed : float
        RMS.
    """

    velocities: FloatArray
    forces: FloatArray
    speed: float


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
        stacked = ca.sparsify(ca.horzcat(*(x.residuals for x in self.terms)))
        rows, columns = (np.array(x) for x in stacked.sparsity().get_triplet())
        nonzeros = ca.vertcat(*(stacked[i, j] for i, j in zip(rows.tolist(), columns.tolist(), strict=True)))
        entries = ca.Function("entries", list(self.symbols), [nonzeros])
        means: FloatArray = np.zeros((len(weights) // length, self.terms[0].residuals.numel(), len(self)))
        step, mapped = max(1, 256 // length), cache(entries.map)
        for k in range(0, len(means), step):
            part = slice(k * length, (k + step) * length)
            values = _in_every_row(mapped(len(weights[part])), [x[part] for x in motion]) * weights[part, None]
            means[k : k + step, rows, columns] = values.reshape(-1, length, len(rows)).sum(axis=1)
        return means

    def suggestion(
        self, k: int, value: float, error: float, explained: float, rivals: Sequence[int] = ()
    ) -> Suggestion:
        """Term k in words and as a line of model code.

        Parameters
        ----------
        k : int
        value, error : float
            Coefficient and its standard error.
        explained : float
            Fraction of the mean square of the unmodelled force that the term explains.
        rivals : sequence of int, optional
            Terms that explain the same in its place.

        Returns
        -------
        Suggestion
        """
        term = self.terms[k]
        digits = max(0, 1 - int(np.floor(np.log10(error)))) if error > 0.0 else 3
        size, spread = (f"{x:.{digits}f}" if digits < 6 else f"{x:.3g}" for x in (value, error))
        unit = f" {term.unit}" if term.unit not in ("", "1") else ""
        others = tuple(dict.fromkeys(self.terms[j].name for j in rivals))
        share = f"explains {100.0 * explained:.0f} % of the unmodelled force"
        share += f", and this log does not exclude {' or '.join(others)} in its place" if others else ""
        if term.kind == INPUT_GAIN:
            text = f"Gain of {term.place}: an error of {size} ± {spread} {share}"
        else:
            formula = f" {term.formula}" if term.formula else ""
            text = f"{term.name[0].upper()}{term.name[1:]}: {size} ± {spread}{unit}{formula} {share}"
        h = ca.Function("term", list(self.symbols), [ca.densify(term.residuals)], list("qvaup"), ["h"])
        return Suggestion(
            term.kind, term.equation, text, term.parameter, value, error, term.unit, explained,
            term.code, expressions.stored(f"term {term.parameter}", h), term.name, term.also, others, term.option,
        )  # fmt: skip


def _in_every_row(mapped: ca.Function, arrays: Sequence[FloatArray]) -> FloatArray:
    """Values (N, n) of a function of vectors over rows (N, n_i), by CasADi: these are too many terms to compile."""
    inputs, values = [np.ascontiguousarray(x) for x in arrays], np.empty(mapped.size_out(0)[::-1])
    buffer, evaluate = mapped.buffer()
    for k, rows in enumerate(inputs):
        buffer.set_arg(k, rows.data)  # type: ignore[call-arg]  # a buffer has a size
    buffer.set_res(0, values.data)  # type: ignore[call-arg]
    evaluate()
    return values


def candidate_terms(
    model: Model,
    speeds: FloatArray,
    inputs: FloatArray,
    relative: Sequence[RelativeMotion] = (),
    library: TermLibrary | None = None,
) -> CandidateTerms:
    """The library of candidates of a model.

    In the equation of each velocity v: ``sign(v)``, Stribeck friction at several speeds, ``v``, ``|v| v``, ``|v|``
    (drag in a current), a constant, the position, its square and cube, harmonics of every angle, other velocities and
    all products of velocities.  Friction, drag, springs and constants also act between what the model connects.
    Besides them the user's expressions, and of each input a gain, an offset, ``|u| u``, a dead band of several widths
    and a saturation at several levels.

    Parameters
    ----------
    model : Model
    speeds : (n_v,) array
        RMS of each velocity, its unit; velocities that are zero get no friction.
    inputs : (n_u, 2) array
        RMS of each input, its unit, and the size up to which it mostly goes; inputs that are zero get a gain alone.
    relative : sequence of RelativeMotion, optional
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
    symbols = tuple(ca.SX.sym(n, size) for n, size in model.argument_sizes.items())
    maker = _Maker(model, symbols, speeds, inputs)
    terms = [x for i in range(model.n_v) for x in maker.of_equation(i)]
    terms += [x for one in relative for x in maker.of_place(maker.place(one))]
    terms += maker.of_held()
    if library is not None:
        terms += maker.of_user(library)
    return CandidateTerms(symbols, (*terms, *maker.of_inputs()))


@dataclass(frozen=True)
class _Expression:
    """An expression as it is read, its Python code, and its unit; None if that is unknown."""

    formula: str
    code: str
    unit: str | None

    def power(self, n: int) -> _Expression:
        """Its n-th power."""
        formula, code = _single(self.formula), _single(self.code)
        if n > 1:
            formula, code = f"{formula}^{n}", f"{code} ** {n}"
        return _Expression(formula, code, f"({self.unit})^{n}" if n > 1 else self.unit)


@dataclass(frozen=True)
class _Place:
    """A place of terms: a coordinate or a velocity, or between several.

    Parameters
    ----------
    name, label : str
        In sentences, and in the names of parameters.
    motion : RelativeMotion
    speed : _Expression
    position : _Expression or None
        None without coordinates that are the integrals of the velocities.
    unit : str
        That of the position; empty if the force on it has no usual name.
    """

    name: str
    label: str
    motion: RelativeMotion
    speed: _Expression
    position: _Expression | None
    unit: str


@dataclass(frozen=True, eq=False, repr=False)
class _Maker:
    """Makes the candidates of one model."""

    model: Model
    symbols: tuple[ca.SX, ...]
    speeds: FloatArray
    inputs: FloatArray

    @cached_property
    def value(self) -> Callable[[str], ca.SX]:
        """Value of a term from the model's signals, as its code computes it; 1 without code."""
        signals = {"ca": ca, **dict(zip("qvau", self.model.named(*self.symbols[:4]), strict=True))}
        return cache(lambda code: ca.SX(eval(code or "1", signals)))

    def alone(self, i: int) -> _Place:
        """One velocity and its equation."""
        one = np.eye(self.model.n_v)[i]
        sign = -1.0 if self.model.force_sign < 0 else 1.0
        return self.place(RelativeMotion(one, sign * one, float(self.speeds[i])))

    def place(self, motion: RelativeMotion) -> _Place:
        """The place of the terms of a motion."""
        model, names = self.model, self.model.rate_names
        used = [names[k] for k in np.flatnonzero(motion.velocities)]
        speed = _sum(motion.velocities, model.velocities, names, "v")
        position, unit = None, model.coordinates.get(used[0], "")
        if model.kinematics is None and used[0] in model.coordinates:
            position = _sum(motion.velocities[: model.n_q], model.coordinates, names, "q")
        name = (position or speed).formula if len(used) > 1 else used[0]
        return _Place(name, "_".join(used), motion, speed, position, unit)

    def of_equation(self, i: int) -> Iterator[CandidateTerm]:
        """Candidates in one equation, the simplest first."""
        place = self.alone(i)
        yield from self.of_place(place)
        for name, unit in self.model.coordinates.items():
            if unit == "rad":
                yield from self._of_angle(place, name)
        yield from self._of_other_speeds(place)

    def of_place(self, place: _Place) -> Iterator[CandidateTerm]:
        """Friction and drag, or decay of states of first order, a constant, and springs."""
        first_order = self.model.rate_names[int(np.flatnonzero(place.motion.velocities)[0])] in self.model.first_order
        if first_order:
            yield self._term("linear term", place, "linear", place.speed.power(1))
            yield self._term("quadratic term", place, "quadratic", place.speed.power(2))
        elif place.motion.speed > 0.0:
            yield from self._of_speed(place)
        constant = _Expression("", "", "")
        yield self._term("constant term" if first_order else "constant force", place, "bias", constant)
        if place.position is not None:
            for n, label in ((1, "stiffness"), (2, "quadratic_stiffness"), (3, "cubic_stiffness")):
                yield self._term(label.replace("_", " "), place, label, place.position.power(n))

    def _of_speed(self, place: _Place) -> Iterator[CandidateTerm]:
        speed, unit, rms = place.speed, place.speed.unit, place.motion.speed
        name, code, v, v_code = speed.formula, speed.code, _single(speed.formula), _single(speed.code)
        sign = _Expression(f"sign({name})", f"ca.tanh({v_code} / {float(f'{0.01 * rms:.1g}'):g})", "")
        yield self._term("Coulomb friction", place, "coulomb", sign)
        if np.count_nonzero(place.motion.velocities) == 1:
            yield from self._of_load(place, sign)
        yield self._term("viscous friction", place, "viscous", speed.power(1))
        drag = _Expression(f"|{name}| {v}", f"ca.fabs({code}) * {v_code}", f"({unit})^2")
        yield self._term("quadratic drag", place, "quadratic", drag)
        yield self._term("asymmetric drag", place, "current", _Expression(f"|{name}|", f"ca.fabs({code})", unit))
        for factor in (0.03, 0.06, 0.12, 0.25):
            slow = f"{float(f'{factor * rms:.2g}'):g}"
            formula = f"{sign.formula} exp(-({v} / {slow})^2)"
            decay = _Expression(formula, f"{sign.code} * ca.exp(-(({v_code} / {slow}) ** 2))", "")
            yield self._term("Stribeck friction", place, "stribeck", decay)

    def _of_angle(self, place: _Place, name: str) -> Iterator[CandidateTerm]:
        for n, many, times, label in ((1, "", "", ""), (2, "2 ", "2 * ", "2"), (3, "3 ", "3 * ", "3")):
            kind = f"harmonic {n} of {name}" if n > 1 else f"gravity or first harmonic of {name}"
            for function in ("sin", "cos"):
                harmonic = _Expression(f"{function}({many}{name})", f"ca.{function}({times}q.{name})", "")
                yield self._term(kind, place, f"{function}{label}_{name}", harmonic)

    def _of_other_speeds(self, place: _Place) -> Iterator[CandidateTerm]:
        rates = self.model.rate_names
        i = rates.index(place.name)
        speeds = [
            _Expression(signal, f"v.{rate}", unit)
            for rate, (signal, unit) in zip(rates, self.model.velocities.items(), strict=True)
        ]
        # What two coordinates dissipate together acts on both alike (Rayleigh).
        n_reciprocal = self.model.n_q if place.position is not None else 0
        for j, other in enumerate(speeds):
            if j > i or (j < i and j >= n_reciprocal):
                back = [(j, float(place.motion.forces[i]), speeds[i])] if j < n_reciprocal else []
                yield self._term(f"coupling to {other.formula}", place, f"coupling_{rates[j]}", other, back)
        for (j, x), (k, y) in combinations_with_replacement(enumerate(speeds), 2):
            product = _Expression(f"{x.formula} {y.formula}", f"{x.code} * {y.code}", f"({x.unit}) ({y.unit})")
            yield self._term("product of velocities", place, f"product_{rates[j]}_{rates[k]}", product)

    def of_held(self) -> Iterator[CandidateTerm]:
        """Changes of the constants that the model holds, such as masses of bodies."""
        for x in self.model.held:
            h = x.effect(*self.symbols[:4])
            acts = self.model.rate_names[h.sparsity().row()[0]]
            called = KINDS[x.kind][0].format(x=x.place)
            label, bounds = self._free(x.label), (x.least, np.inf)
            yield CandidateTerm(x.kind, acts, x.place, "", "", label, x.unit, h, bounds, called, option=x.option)

    def _of_load(self, place: _Place, sign: _Expression) -> Iterator[CandidateTerm]:
        """Friction that is proportional to the force of the drives in the equation, as that of gears is."""
        u, i = self.symbols[3], int(np.flatnonzero(place.motion.velocities)[0])
        slopes = ca.jacobian(self.model.residual(*self.symbols)[i], u)
        acting, inputs = slopes.sparsity().get_col(), list(self.model.inputs)
        if acting and slopes.is_constant():
            load = " + ".join(f"{float(slopes[0, j])!r} * u.{inputs[j]}" for j in acting)
            formula = f"|{inputs[acting[0]] if len(acting) == 1 else 'load'}| {sign.formula}"
            friction = _Expression(formula, f"ca.fabs({load}) * {sign.code}", "")
            yield replace(self._term("load-dependent friction", place, "load_friction", friction), unit="1")

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
                yield self._term(name, self.alone(i), name, _Expression(name, name, None), value=value)

    def of_inputs(self) -> Iterator[CandidateTerm]:
        """Changes of each input, in every equation that it enters, the simplest first."""
        r, u = self.model.residual(*self.symbols), self.symbols[3]
        for j, (name, unit) in enumerate(self.model.inputs.items()):
            slope = ca.jacobian(r, u[j])
            for kind, label, formula, code, of_value, bounds in self._changes(name, unit, *self.inputs[j].tolist()):
                parameter, factor = self._free(f"{label}_{name}"), f" * {code}" if code else ""
                line = f"u.{name} * (1 + p.{parameter})" if kind == INPUT_GAIN else f"u.{name} + p.{parameter}{factor}"
                h, called = ca.densify(slope * self.value(code)), KINDS[kind][0].format(x=name)
                yield CandidateTerm(kind, name, name, formula, line, parameter, of_value, h, bounds, called)

    def _changes(
        self, name: str, unit: str, size: float, largest: float
    ) -> Iterator[tuple[str, str, str, str, str, tuple[float, float]]]:
        """Kind, label, formula, code, and unit and bounds of the coefficient of changes of one input.

        Within the bounds, but for an error of half of the coefficient, what the actuator gives does not fall with its
        input; a dead band and saturation take from it.
        """
        most, u = 1.5, f"u.{name}"
        yield INPUT_GAIN, "gain_error", name, u, "1", (-0.5, 0.5)
        if not size > 0.0:
            return
        yield "input offset", "offset", "", "", unit, (-np.inf, np.inf)
        per_unit, least = unit_over("1", "" if unit == "1" else unit), -most / (2.0 * largest)
        yield "curved input", "curvature", f"|{name}| {name}", f"ca.fabs({u}) * {u}", per_unit, (least, np.inf)
        for factor in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8):
            width = float(f"{factor * size:.2g}")
            formula, limited = f"sign({name}) beyond {width:g}", f"ca.fmax(-1, ca.fmin(1, {u} / {width:g}))"
            yield "dead band", "dead_band", formula, limited, unit, (-most * width, 0.0)
        for factor in (0.6, 0.8, 1.0, 1.3, 1.7):
            level = f"{float(f'{factor * size:.2g}'):g}"
            beyond = f"({u} - ca.fmax(-{level}, ca.fmin({level}, {u})))"
            yield "saturation", "saturation", f"({name} beyond {level})", beyond, "1", (-most, 0.0)

    def _term(
        self,
        kind: str,
        place: _Place,
        label: str,
        expression: _Expression,
        others: Sequence[tuple[int, float, _Expression]] = (),
        value: ca.SX | None = None,
    ) -> CandidateTerm:
        """A term at a place, which has a value if its code has none; it also acts in other equations, with a factor."""
        forces, names, parameter = place.motion.forces, self.model.rate_names, self._free(f"{label}_{place.label}")
        known = self.model.kinematics is None and self.model.force_sign
        force = {"m": "N", "rad": "N m"}.get(place.unit, "") if known else ""
        parts = [*((k, float(forces[k]), expression) for k in np.flatnonzero(forces).tolist()), *others]
        residuals = ca.SX(self.model.n_v, 1)
        for k, factor, summand in parts:
            residuals[k] = factor * (self.value(summand.code) if value is None else value)
        (first, code), *also = ((names[k], _summand(factor, parameter, x)) for k, factor, x in parts)
        unit = "" if expression.unit is None or not force else unit_over(force, expression.unit)
        name = name_of_term(kind, place.name, expression.formula, place.unit)
        return CandidateTerm(
            kind, first, place.name, expression.formula, code, parameter, unit, residuals, name=name, also=dict(also)
        )

    def _free(self, name: str) -> str:
        """The name, or the next that no signal and no parameter has."""
        taken = {*self.model.units, *self.model.parameters}
        return next(x for x in chain([name], (f"{name}_{k}" for k in count(2))) if x not in taken)


def _sum(factors: FloatArray, signals: Mapping[str, str], names: Sequence[str], vector: str) -> _Expression:
    """A weighted sum of signals; its unit is that of the first, whose factor is 1."""
    formula, code, used = "", "", np.flatnonzero(factors).tolist()
    for k in used:
        sign, size = "" if k == used[0] else " - " if factors[k] < 0.0 else " + ", abs(float(factors[k]))
        formula += f"{sign}{'' if size == 1.0 else f'{size:g} '}{list(signals)[k]}"
        code += f"{sign}{'' if size == 1.0 else f'{size!r} * '}{vector}.{names[k]}"
    return _Expression(formula, code, list(signals.values())[used[0]])


def _summand(factor: float, parameter: str, x: _Expression) -> str:
    """Code of a summand of a residual, with its sign."""
    size = "" if abs(factor) == 1.0 else f"{abs(factor)!r} * "
    return f"{'-' if factor < 0.0 else '+'} {size}p.{parameter}{f' * {x.code}' if x.code else ''}"


def _single(text: str) -> str:
    """A sum in parentheses."""
    return f"({text})" if " " in text else text
