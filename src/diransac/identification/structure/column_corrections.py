"""Corrections of columns, tested by the equations: another unit or sign, exchanged columns, inputs that act later.

Each is a hypothesis.  It is said where equations that are fitted to one half of the rows with the correction predict
the other half much better than without it, and are explained by it, too, not only better; and where no other parameter
and no constant of the model takes the unit up.  A scale inside a nonlinear term does: multiplied by a small factor, a
column makes ``tanh(v / s)`` linear.  So a factor must be one that the log determines, and the model with the factor
inside of its nonlinear functions alone, which leaves the column in its unit, must be worse.

Parameters are those within their bounds.  Without bounds, a reversed sign changes no residual where parameters take it
up, with signs that are impossible.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data.units import conversion, one_turn
from diransac.identification.core.rows import Rows, inclusive_bounds
from diransac.identification.regression.rows import (
    EXACT,
    MotionRows,
    outside_bounds,
    robust_fit,
    scaled_equations,
)
from diransac.model.expressions import applied, steps

if TYPE_CHECKING:
    from collections.abc import Callable

    from diransac.data.dataset import ParameterLayout
    from diransac.identification.regression.rows import RowsSolution
    from diransac.model import Model

    Solver = Callable[[Model, ParameterLayout, Sequence[MotionRows]], RowsSolution | None]

# Units in which columns are recorded by mistake; those of another dimension than the model's are none.
_UNITS: tuple[str, ...] = ("rad", "deg", "rad/s", "deg/s", "rpm", "deg/s^2", "rad/s^2", "m", "mm", "cm", "m/s")
_UNITS += ("mm/s", "km/h", "m/s^2", "g", "mm/s^2", "N", "mN", "kN", "N m", "mN m", "Pa", "kPa", "bar", "V", "mV")
_UNITS += ("A", "mA", "K", "s", "ms")
_OFFSETS = {"K": ("degC", 1.0, 273.15)}
SAME_FACTOR = 0.1
"""Largest logarithm of a ratio of factors that are those of one unit."""
# Rows of each log that are fitted, and as many that are predicted; blocks of them that alternate.
_ROWS, _BLOCKS = 300, 20
# Delays of inputs that are tried first, rows; then their neighbours, if the residual is below this share.
_DELAYS, _USEFUL = (1, 2, 4, 8, 16, 32), 0.9
# Residual over that without the correction from which on it explains a log much better, and that of other equations or
# of the next best correction over it.
_MUCH_BETTER, _DISTINCT = 0.5, 1.5
# Residual over the size of the known terms at which equations are explained; at which there is nothing to explain.
_EXPLAINED, _NOTHING_LEFT = 0.3, 0.05
# A factor that the log determines: residual over that of the unit, at least, with this factor off either way.
_OFF, _WORSE = 2.0, 1.2
# Operations that a factor passes, and those of angles that have no scale.
_LINEAR = ("add", "sub", "neg", "mul", "twice", "sq", "fabs", "sign", "not")
_OF_ANGLES = ("sin", "cos", "tan")


@dataclass(frozen=True)
class Correction:
    """Signals in another unit or with another sign, two that are exchanged, or inputs that act later.

    Parameters
    ----------
    names : tuple of str
        Coordinates, velocities of kinematics, states of first order or inputs.
    unit : str, optional
        In which they were recorded.
    factor, offset : float, optional
        By which they are converted.
    exchanged : bool, optional
        Whether two signals change places.
    delay : int, optional
        Rows by which they act later.
    """

    names: tuple[str, ...] = ()
    unit: str = ""
    factor: float = 1.0
    offset: float = 0.0
    exchanged: bool = False
    delay: int = 0

    def of_rows(self, model: Model, rows: MotionRows, some: IntArray | slice = slice(None)) -> MotionRows:
        """Some rows of a motion, corrected."""
        groups = (tuple(model.coordinates), model.rate_names, model.rate_names, tuple(model.inputs))
        found = list[FloatArray]()
        for k, (names, x) in enumerate(zip(groups, (rows.q, rows.v, rows.a, rows.u), strict=True)):
            own = np.array([n in self.names for n in names], bool)
            moved = own & np.array([k in (0, 3) or (k == 1 and n in model.first_order) for n in names], bool)
            part = x[some] * np.where(own, self.factor, 1.0) + self.offset * moved
            if self.exchanged and own.any():
                part[:, own] = part[:, own][:, ::-1]
            found.append(part)
        if self.delay:
            own = np.array([n in self.names for n in model.inputs], bool)
            earlier = np.clip(np.arange(len(rows.u))[some] - self.delay, 0, len(rows.u) - 1)
            found[3][:, own] = rows.u[earlier][:, own]
        q, v, a, u = found
        return MotionRows(q, v, a, u, rows.y[some])


@dataclass(frozen=True, eq=False)
class CorrectedEquations:
    """A correction, and the equations with it.

    Parameters
    ----------
    correction : Correction
    parameters : (n,) array
        Of the rows that were fitted.
    residuals : (n_eq,) array
        Median size of the residuals of the other rows with parameters within their bounds, over that of the known
        terms.
    outside : list of str
        Parameters that are clearly outside of their bounds.
    """

    correction: Correction
    parameters: FloatArray
    residuals: FloatArray
    outside: list[str]

    @cached_property
    def residual(self) -> float:
        """Product of the residuals of the equations, as in a likelihood: those that nothing changes do not matter."""
        return float(np.prod(self.residuals))

    def improved_by(self, other: CorrectedEquations) -> BoolArray:
        """Mask ``(n_eq,)`` of the equations that hold much better with another one; none if others hold worse.

        A unit that makes the terms of an equation vanish silences what contradicts the others, and explains nothing.
        """
        better = other.residuals < _MUCH_BETTER * self.residuals
        return np.asarray(better & (other.residuals < _DISTINCT * self.residuals).all())

    def rivals(self, other: CorrectedEquations) -> bool:
        """True if another correction, neither a part of this one nor the reverse, explains a log nearly as well."""
        a, b = self.correction, other.correction
        own, others = set(a.names), set(b.names)
        alike = (a.factor, a.offset, a.exchanged) == (b.factor, b.offset, b.exchanged)
        nested = alike and (own <= others or others <= own)
        return not nested and other.residual < _DISTINCT * self.residual


@dataclass(frozen=True, eq=False)
class CorrectionTests:
    """Rows of logs, half of which are fitted, and half predicted.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    rows : sequence of MotionRows
    nonlinear : callable
        Solution of a model that is not affine in its parameters, as `solved`.
    delays : bool, optional
        Whether delays of inputs are tested, which an estimate may include.
    """

    model: Model
    layout: ParameterLayout
    rows: Sequence[MotionRows]
    nonlinear: Solver
    delays: bool = True

    @cached_property
    def _some(self) -> list[tuple[IntArray, BoolArray]]:
        """Rows of each log that take part, and a mask of those that are predicted."""
        found = []
        for one in self.rows:
            some = np.arange(0, len(one.q), max(1, len(one.q) // (2 * _ROWS)))
            found.append((some, np.arange(len(some)) * _BLOCKS // max(1, len(some)) % 2 == 1))
        return found

    @cached_property
    def without(self) -> CorrectedEquations | None:
        """The equations as the log was recorded."""
        return self.of(Correction())

    def of(self, correction: Correction, model: Model | None = None) -> CorrectedEquations | None:
        """The equations with a correction, or those of another model of the same signals; None if they overflow."""
        model = model or self.model
        parts = [correction.of_rows(model, one, some) for one, (some, _) in zip(self.rows, self._some, strict=True)]
        held = [mask for _, mask in self._some]
        found = self._nonlinear(model, parts, held) if model.nonlinear_parameters else self._affine(model, parts, held)
        if found is None:
            return None
        parameters, errors, residuals = found
        outside = outside_bounds(self.layout, parameters, errors)
        return CorrectedEquations(correction, parameters, np.maximum(residuals, EXACT), outside)

    def _affine(
        self, model: Model, parts: Sequence[MotionRows], held: Sequence[BoolArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Parameters, standard errors and residuals of ``W p = b``; None without a known term."""
        rows, finite = scaled_equations(model, self.layout, parts)
        predicted = np.concatenate(held)[finite]
        if not predicted.any() or predicted.all() or not rows.b.any():
            return None
        fitted = Rows(rows.W[~predicted], rows.b[~predicted])
        bounds, found = inclusive_bounds(self.layout.bounds, zero=True), robust_fit(fitted)
        if found is None:
            return None
        is_possible = (np.clip(found.p, *bounds) == found.p).all()
        possible = found if is_possible else (robust_fit(fitted, bounds) or found)
        W, b = rows.W[predicted], rows.b[predicted]
        residuals = np.median(np.abs(W @ possible.p - b), axis=0)
        # Zero solves an equation without a known term: its residual is that over its terms.
        whole = np.median(np.abs(W) @ np.abs(possible.p), axis=0)
        of_terms = np.where(whole > EXACT, residuals / np.maximum(whole, EXACT), 1.0)
        residuals = np.where(b.any(axis=0), residuals, of_terms)
        return found.p, found.errors(), residuals

    def _nonlinear(
        self, model: Model, parts: Sequence[MotionRows], held: Sequence[BoolArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Parameters, no errors, and residuals of accelerations over their sizes."""
        halves = [
            [MotionRows(*(x[mask == which] for x in (one.q, one.v, one.a, one.u, one.y))) for one, mask in both]
            for both in [list(zip(parts, held, strict=True))]
            for which in (False, True)
        ]
        found = self.nonlinear(model, self.layout, halves[0])
        if found is None:
            return None
        errors, sizes = [], []
        for i, one in enumerate(halves[1]):
            p = np.repeat(self.layout.of_log(found.parameters, i)[:, None], len(one.q), axis=1)
            a = np.array(model.dynamics(np.hstack([one.q, one.v]).T, one.u.T, p)[1]).T
            errors.append(np.abs(one.a - a))
            sizes.append(np.abs(one.a))
        size = np.sqrt(np.square(np.concatenate(sizes)).mean(axis=0)) + EXACT**2
        residuals = np.median(np.concatenate(errors), axis=0) / size
        return found.parameters, np.zeros_like(found.parameters), np.where(np.isfinite(residuals), residuals, np.inf)


# ---------------------------------------------------------------------- what explains a log


def nothing_to_explain(tests: CorrectionTests) -> bool:
    """True if the equations hold as recorded, with all parameters within their bounds."""
    without = tests.without
    return without is not None and not without.outside and bool((without.residuals < _NOTHING_LEFT).all())


def explained(tests: CorrectionTests) -> tuple[list[CorrectedEquations], int]:
    """The correction with which the equations hold much better, if it is proved; none where several do.

    Several signs are reversed one after another, as long as more equations hold.  Two signs of one equation, those of a
    force and of a motion, are alternatives.  Delays are tested where nothing else explains the log.

    Parameters
    ----------
    tests : CorrectionTests

    Returns
    -------
    found : list of CorrectedEquations
        The correction, and its alternatives.
    n_tested : int
        Number of corrections that were tested.
    """
    without = tests.without
    assert without is not None
    tested = [x for one in corrections(tests.model) if (x := tests.of(one)) is not None]
    found = _best(tests, without, [*tested, *_several_signs(tests, without)])
    if not found and tests.delays:
        found = _best(tests, without, list(_delays(tests, without)))
    return found, len(tested)


def _best(
    tests: CorrectionTests, without: CorrectedEquations, tested: Sequence[CorrectedEquations]
) -> list[CorrectedEquations]:
    """The best of some corrections, and its alternatives, if it is proved."""
    better = [x for x in tested if not x.outside and without.improved_by(x).any()]
    better.sort(key=lambda x: (x.residual, len(x.correction.names)))
    rivals = [x for x in better[1:] if better[0].rivals(x)]
    if any(x.correction.factor > 0.0 for x in rivals) or not better or not _is_proved(tests, without, better[0]):
        return []
    return sorted([better[0], *rivals], key=lambda x: x.correction.names[0] not in tests.model.inputs)


def _several_signs(tests: CorrectionTests, best: CorrectedEquations) -> Iterator[CorrectedEquations]:
    """Signs of more and more inputs, each that with which fewer parameters are outside of their bounds."""
    for _ in range(len(tests.model.inputs)):
        names = best.correction.names
        more = [tests.of(Correction((*names, n), factor=-1.0)) for n in tests.model.inputs if n not in names]
        fewer = [x for x in more if x is not None and len(x.outside) < len(best.outside)]
        if not fewer:
            return
        best = min(fewer, key=lambda x: (len(x.outside), x.residual))
        yield best


def _is_proved(tests: CorrectionTests, without: CorrectedEquations, best: CorrectedEquations) -> bool:
    """True if the equations are explained, the log determines the factor, and no constant of the model takes it up.

    Bounds determine it, too, where parameters are clearly outside of them as recorded.
    """
    one, improved = best.correction, without.improved_by(best)
    if (best.residuals[improved] > _EXPLAINED).any():
        return False
    if not one.unit or without.outside:
        return True
    for off in (_OFF, 1.0 / _OFF):
        factor = one.factor * off if not one.offset else one.factor
        other = tests.of(replace(one, factor=factor, offset=one.offset * off))
        if other is not None and other.residual < _WORSE * best.residual:
            return False
    rival = tests.of(Correction(), with_factor_inside(tests.model, one))
    return rival is None or bool((rival.improved_by(best) & improved).any())


# ---------------------------------------------------------------------- the hypotheses


def other_units(wanted: str) -> list[tuple[str, float]]:
    """Other units of a dimension, with the factors that convert from them."""
    found: dict[float, str] = {}
    for unit in _UNITS:
        factor = conversion(unit, wanted)
        if factor is not None and abs(np.log(factor)) > SAME_FACTOR:
            found.setdefault(round(factor, 12), unit)
    return [(unit, conversion(unit, wanted) or 1.0) for unit in found.values()]


def corrections(model: Model) -> Iterator[Correction]:
    """Units, signs and exchanges of signals: of single ones, of several, and of all of a kind and unit.

    A thermometer in another unit than all others is rare: states and inputs have their offsets together, too.
    """
    moving = model.coordinates if model.kinematics is None else model.velocities_of_motion
    for kind in (model.inputs, moving, model.first_order):
        for unit in dict.fromkeys(kind.values()):
            names = tuple(n for n, x in kind.items() if x == unit)
            # All subsets of few signals of a unit are tested.
            sizes = range(1, len(names) + 1) if len(names) <= 3 else (1, len(names))
            groups = [group for size in sizes for group in combinations(names, size)]
            yield from (Correction(g, other, factor) for g in groups for other, factor in other_units(unit))
            yield from (Correction(g, factor=-1.0) for g in groups)
            yield from (Correction(g, *_OFFSETS[unit]) for g in groups if unit in _OFFSETS)
            yield from (Correction(pair, exchanged=True) for pair in combinations(names, 2))
    if len(set(model.inputs.values())) > 1:
        yield Correction(tuple(model.inputs), factor=-1.0)
    for unit, other in _OFFSETS.items():
        every = tuple(n for n, x in (model.first_order | model.inputs).items() if x == unit)
        if len(every) > 1:
            yield Correction(every, *other)


def _delays(tests: CorrectionTests, without: CorrectedEquations) -> Iterator[CorrectedEquations]:
    """The best delay of all inputs, and of each, where it is of any use."""
    inputs = tuple(tests.model.inputs)
    for names in dict.fromkeys([inputs, *((n,) for n in inputs)]):
        found = {k: tests.of(Correction(names, delay=k)) for k in _DELAYS} if names else {}
        known = {k: x for k, x in found.items() if x is not None}
        while known:
            best = min(known, key=lambda k: known[k].residual)
            near = [k for k in (best - 1, best + 1) if k > 0 and k not in found]
            if not near or known[best].residual > _USEFUL * without.residual:
                yield known[best]
                break
            found |= {k: tests.of(Correction(names, delay=k)) for k in near}
            known = {k: x for k, x in found.items() if x is not None}


def with_factor_inside(model: Model, correction: Correction) -> Model:
    """The model with some signals multiplied inside of its nonlinear functions alone, as by another constant there.

    Sines of angles have no such constant: an angle is its own unit.
    """
    residual, groups = model.residual, (model.coordinates, model.rate_names, model.rate_names, model.inputs)
    own = [[n in correction.names for n in names] for names in groups]
    angles = all(one_turn(model.units[n]) is not None for n in correction.names if n in model.units)
    plain = (*_LINEAR, *_OF_ANGLES) if angles else _LINEAR
    rows = residual.sparsity_out(0).row()

    def equations(*named: Sequence[ca.SX]) -> list[ca.SX]:
        symbols = [list(x) for x in named]
        values, results = list[tuple[ca.SX, ca.SX]](), [ca.SX(0)] * residual.numel_out(0)
        for step in steps(residual):
            i, k = step.place
            outside, inside = ([values[j][which] for j in step.operands] for which in (0, 1))
            if step.operation == "output":
                results[rows[k]] = outside[0]
                value = outside[0], inside[0]
            elif step.operation == "input":
                x = symbols[i][k]
                value = x, x * correction.factor + correction.offset if i < len(own) and own[i][k] else x
            elif step.operation == "const":
                value = (ca.SX(step.constant),) * 2
            elif step.operation == "assign":
                value = outside[0], inside[0]
            elif step.operation in plain:
                value = applied(step.operation, *outside), applied(step.operation, *inside)
            else:
                scaled = applied(step.operation, *inside)
                value = applied("div", outside[0], inside[1]) if step.operation == "div" else scaled, scaled
            values.append(value)
        return results

    return model.with_equations(model.name, model.parameters, equations, {})
