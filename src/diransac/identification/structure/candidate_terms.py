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
from itertools import combinations_with_replacement
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
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
        step, mapped = max(1, 256 // length), cache(entries.map)
        for k in range(0, n, step):
            part = slice(k * length, (k + step) * length)
            own = [x[part] for x in motion]
            values = _in_every_row(mapped(len(own[0])), own) * weights[part, None]
            found[k : k + step, rows, columns] = values.reshape(-1, length, len(rows)).sum(axis=1)
        return found

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
    inputs, found = [np.ascontiguousarray(x) for x in arrays], np.empty(mapped.size_out(0)[::-1])
    buffer, evaluate = mapped.buffer()
    for k, rows in enumerate(inputs):
        buffer.set_arg(k, rows.data)  # type: ignore[call-arg]  # a buffer has a size
    buffer.set_res(0, found.data)  # type: ignore[call-arg]
    evaluate()
    return found


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
    terms += [x for one in relative for x in maker.between(one)]
    terms += maker.of_held()
    if library is not None:
        terms += maker.of_user(library)
    return CandidateTerms(symbols, (*terms, *maker.of_inputs()))


@dataclass(frozen=True)
class _Expression:
    """An expression, as it is read, as code, and its unit; None if that is unknown."""

    value: ca.SX
    formula: str
    code: str
    unit: str | None


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

    def alone(self, i: int) -> _Place:
        """One velocity and its equation."""
        one = np.eye(self.model.n_v)[i]
        sign = -1.0 if self.model.force_sign < 0 else 1.0
        return self.place(RelativeMotion(one, sign * one, float(self.speeds[i])))

    def place(self, motion: RelativeMotion) -> _Place:
        """The place of the terms of a motion."""
        model, (q, v, *_), names = self.model, self.symbols, self.model.rate_names
        used = [names[k] for k in np.flatnonzero(motion.velocities)]
        speed = _sum(motion.velocities, v, model.velocities, names, "v")
        position, unit = None, model.coordinates.get(used[0], "")
        if model.kinematics is None and used[0] in model.coordinates:
            position = _sum(motion.velocities[: model.n_q], q, model.coordinates, names, "q")
        return _Place(
            (position or speed).formula if len(used) > 1 else used[0], "_".join(used), motion, speed, position, unit
        )

    def of_equation(self, i: int) -> Iterator[CandidateTerm]:
        """Candidates in one equation, the simplest first."""
        place = self.alone(i)
        yield from self.of_own_motion(place)
        for k, (name, unit) in enumerate(self.model.coordinates.items()):
            if place.position is not None and name == place.name:
                yield from self._of_springs(place)
            if unit == "rad":
                yield from self._of_angle(place, self.symbols[0][k], name)
        yield from self._of_other_speeds(place)

    def between(self, motion: RelativeMotion) -> Iterator[CandidateTerm]:
        """Candidates that act between what a term of the model connects."""
        place = self.place(motion)
        yield from self.of_own_motion(place)
        if place.position is not None:
            yield from self._of_springs(place)

    def of_own_motion(self, place: _Place) -> Iterator[CandidateTerm]:
        """Friction and drag, or decay of states of first order, and a constant."""
        first_order = self.model.rate_names[int(np.flatnonzero(place.motion.velocities)[0])] in self.model.first_order
        if first_order:
            yield self._term("linear term", place, "linear", _power(place.speed, 1))
            yield self._term("quadratic term", place, "quadratic", _power(place.speed, 2))
        elif place.motion.speed > 0.0:
            yield from self._of_speed(place)
        one = _Expression(ca.SX(1), "", "", "")
        yield self._term("constant term" if first_order else "constant force", place, "bias", one)

    def _of_speed(self, place: _Place) -> Iterator[CandidateTerm]:
        v, speed = place.speed.value, place.speed
        name, code, unit = speed.formula, speed.code, speed.unit
        slow = float(f"{0.01 * place.motion.speed:.1g}")
        sign, smooth = ca.tanh(v / slow), f"ca.tanh({_single(code)} / {slow:g})"
        yield self._term("Coulomb friction", place, "coulomb", _Expression(sign, f"sign({name})", smooth, ""))
        if np.count_nonzero(place.motion.velocities) == 1:
            yield from self._of_load(place, _Expression(sign, f"sign({name})", smooth, ""))
        yield self._term("viscous friction", place, "viscous", _power(speed, 1))
        drag = f"|{name}| {_single(name)}", f"ca.fabs({code}) * {_single(code)}", f"({unit})^2"
        yield self._term("quadratic drag", place, "quadratic", _Expression(ca.fabs(v) * v, *drag))
        size = f"|{name}|", f"ca.fabs({code})", unit
        yield self._term("asymmetric drag", place, "current", _Expression(ca.fabs(v), *size))
        for factor in (0.03, 0.06, 0.12, 0.25):
            slow = float(f"{factor * place.motion.speed:.2g}")
            formula = f"sign({name}) exp(-({_single(name)} / {slow:g})^2)"
            decay = f"{smooth} * ca.exp(-(({_single(code)} / {slow:g}) ** 2))"
            value = sign * ca.exp(-((v / slow) ** 2))
            yield self._term("Stribeck friction", place, "stribeck", _Expression(value, formula, decay, ""))

    def _of_springs(self, place: _Place) -> Iterator[CandidateTerm]:
        assert place.position is not None
        for n, kind in ((1, ""), (2, "quadratic "), (3, "cubic ")):
            label = f"{kind}stiffness".replace(" ", "_")
            yield self._term(f"{kind}stiffness", place, label, _power(place.position, n))

    def _of_angle(self, place: _Place, q: ca.SX, name: str) -> Iterator[CandidateTerm]:
        for n in (1, 2, 3):
            many, times = (f"{n} ", f"{n} * ") if n > 1 else ("", "")
            kind = f"harmonic {n} of {name}" if n > 1 else f"gravity or first harmonic of {name}"
            for function in ("sin", "cos"):
                value = getattr(ca, function)(n * q)
                of_angle = _Expression(value, f"{function}({many}{name})", f"ca.{function}({times}q.{name})", "")
                yield self._term(kind, place, f"{function}{n if n > 1 else ''}_{name}", of_angle)

    def _of_other_speeds(self, place: _Place) -> Iterator[CandidateTerm]:
        v, signals, rates = self.symbols[1], list(self.model.velocities), self.model.rate_names
        units, i = list(self.model.velocities.values()), rates.index(place.name)
        speeds = [_Expression(v[j], signals[j], f"v.{rates[j]}", units[j]) for j in range(self.model.n_v)]
        # What two coordinates dissipate together acts on both alike (Rayleigh).
        n_reciprocal = self.model.n_q if place.position is not None else 0
        for j, other in enumerate(speeds):
            if j > i or (j < i and j >= n_reciprocal):
                back = [(j, float(place.motion.forces[i]), speeds[i])] if j < n_reciprocal else []
                yield self._term(f"coupling to {signals[j]}", place, f"coupling_{rates[j]}", other, back)
        for j, k in combinations_with_replacement(range(self.model.n_v), 2):
            formula, code = f"{signals[j]} {signals[k]}", f"v.{rates[j]} * v.{rates[k]}"
            product = _Expression(v[j] * v[k], formula, code, f"({units[j]}) ({units[k]})")
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
        acting = slopes.sparsity().get_col()
        if not acting or not slopes.is_constant():
            return
        names = [f"u.{list(self.model.inputs)[j]}" for j in acting]
        factors = [float(slopes[0, j]) for j in acting]
        load = " + ".join(f"{c!r} * {n}" for c, n in zip(factors, names, strict=True))
        formula = f"|{names[0][2:] if len(names) == 1 else 'load'}| {sign.formula}"
        value = ca.fabs(ca.dot(ca.DM(factors), ca.vertcat(*(u[j] for j in acting))))
        friction = _Expression(value * sign.value, formula, f"ca.fabs({load}) * {sign.code}", "")
        term = self._term("load-dependent friction", place, "load_friction", friction)
        yield replace(term, unit="1")

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
                yield self._term(name, self.alone(i), name, _Expression(value, name, name, None))

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
                yield CandidateTerm(kind, name, name, formula, line, parameter, of_value, h, bounds, called)

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
        code, per_unit = f"u.{name}", unit_over("1", "" if unit == "1" else unit)
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
        self,
        kind: str,
        place: _Place,
        label: str,
        expression: _Expression,
        others: Sequence[tuple[int, float, _Expression]] = (),
    ) -> CandidateTerm:
        """A term at a place; it also acts in other equations, with a factor."""
        forces, names, parameter = place.motion.forces, self.model.rate_names, self._free(f"{label}_{place.label}")
        known = self.model.kinematics is None and self.model.force_sign
        force = {"m": "N", "rad": "N m"}.get(place.unit, "") if known else ""
        parts = [*((k, float(forces[k]), expression) for k in np.flatnonzero(forces).tolist()), *others]
        residuals = ca.SX(self.model.n_v, 1)
        for k, factor, summand in parts:
            residuals[k] = factor * summand.value
        (first, code), *also = ((names[k], _summand(factor, parameter, x)) for k, factor, x in parts)
        return CandidateTerm(
            kind,
            first,
            place.name,
            expression.formula,
            code,
            parameter,
            "" if expression.unit is None or not force else unit_over(force, expression.unit),
            residuals,
            name=name_of_term(kind, place.name, expression.formula, place.unit),
            also=dict(also),
        )

    def _free(self, name: str) -> str:
        """The name, or the next that no signal and no parameter has."""
        model = self.model
        taken = {*model.units, *model.parameters}
        names = (name, *(f"{name}_{k}" for k in range(2, len(taken) + 3)))
        return next(x for x in names if x not in taken)


def _sum(
    factors: FloatArray, values: ca.SX, signals: Mapping[str, str], names: Sequence[str], vector: str
) -> _Expression:
    """A weighted sum of signals; its unit is that of the first, whose factor is 1."""
    formula, code, used = "", "", np.flatnonzero(factors).tolist()
    for k in used:
        sign = "" if k == used[0] else " - " if factors[k] < 0.0 else " + "
        size = abs(float(factors[k]))
        formula += f"{sign}{'' if size == 1.0 else f'{size:g} '}{list(signals)[k]}"
        code += f"{sign}{'' if size == 1.0 else f'{size!r} * '}{vector}.{names[k]}"
    value = sum((float(factors[k]) * values[k] for k in used[1:]), values[used[0]])
    return _Expression(value, formula, code, list(signals.values())[used[0]])


def _summand(factor: float, parameter: str, x: _Expression) -> str:
    """Code of a summand of a residual, with its sign."""
    size = "" if abs(factor) == 1.0 else f"{abs(factor)!r} * "
    return f"{'-' if factor < 0.0 else '+'} {size}p.{parameter}{f' * {x.code}' if x.code else ''}"


def _power(x: _Expression, n: int) -> _Expression:
    if n == 1:
        return replace(x, formula=_single(x.formula), code=_single(x.code))
    return _Expression(x.value**n, f"{_single(x.formula)}^{n}", f"{_single(x.code)} ** {n}", f"({x.unit})^{n}")


def _single(text: str) -> str:
    """A sum in parentheses."""
    return f"({text})" if " " in text else text
