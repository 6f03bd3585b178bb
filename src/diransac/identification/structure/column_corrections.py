"""Corrections of columns, tested by the equations: another unit or sign, exchanged columns, inputs that act later.

Each is a hypothesis.  It is accepted where equations that are fitted to one half of the rows with the correction
predict the other half much better than without it, explain most of it, and do so better than every rival: another
correction, and the model with the factor inside of its nonlinear functions alone; half or twice the factor must fit
worse by a fifth.  A scale inside a nonlinear term takes a unit up: multiplied by a small factor, a column makes
``tanh(v / s)`` linear.

Parameters are those within their bounds.  Without bounds, a reversed sign changes no residual where parameters take it
up, with signs that are impossible.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data.units import conversion, one_turn
from diransac.identification.core.rows import Rows, Solution, inclusive_bounds
from diransac.identification.regression.rows import (
    EXACT,
    MotionRows,
    outside_bounds,
    robust_fit,
    scaled_equations,
)
from diransac.model.expressions import applied, steps

if TYPE_CHECKING:
    from diransac.data.dataset import ParameterLayout
    from diransac.model import Model

_UNITS = (
    "rad, deg, rad/s, deg/s, rpm, deg/s^2, rad/s^2, m, mm, cm, m/s, mm/s, km/h, m/s^2, g, mm/s^2, N, mN, kN, N m, "
    "mN m, Pa, kPa, bar, V, mV, A, mA, K, s, ms"
)
"""Units in which columns are recorded by mistake; those of another dimension than the model's are none."""
SAME_FACTOR = 0.1
"""Largest logarithm of a ratio of factors that are those of one unit."""
MUCH_BETTER = 0.5
"""Residual with a correction over that without it, up to which it explains a log much better."""
DISTINCT = 1.5
"""Residual of a rival over that of a correction, from which on it is refuted."""
EXPLAINED = 0.3
"""Residual over the size of the known terms up to which equations are explained."""


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
        """Some rows of a motion, corrected, with the derivatives of the signals."""
        names, chains = (*model.state, *model.accelerations, *model.inputs), {x[0]: x for x in model.chains}
        recorded = dict(zip(names, np.hstack([rows.q, rows.v, rows.a, rows.u]).T, strict=True))
        found = {name: x[some] for name, x in recorded.items()}
        for name, other in zip(self.names, reversed(self.names) if self.exchanged else self.names, strict=True):
            for target, source in zip(chains.get(name, (name,)), chains.get(other, (other,)), strict=True):
                x = recorded[source]
                late = np.r_[np.repeat(x[:1], self.delay), x][: len(x)] if self.delay else x
                found[target] = late[some] * self.factor + self.offset * (target == name)
        sizes = np.cumsum([rows.q.shape[1], rows.v.shape[1], rows.a.shape[1]])
        q, v, a, u = np.split(np.array(list(found.values())).T, sizes, axis=1)
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
        terms; infinite where the equations overflow.
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
        better = other.residuals < MUCH_BETTER * self.residuals
        return np.asarray(better & (other.residuals < DISTINCT * self.residuals).all())

    def rivals(self, other: CorrectedEquations) -> bool:
        """True if another correction, neither a part of this one nor the reverse, explains a log nearly as well."""
        a, b = (set(x.correction.names) for x in (self, other))
        alike = replace(self.correction, names=()) == replace(other.correction, names=())
        return not (alike and (a <= b or b <= a)) and other.residual < DISTINCT * self.residual


@dataclass(frozen=True, eq=False)
class CorrectionTests:
    """Rows of logs, half of which are fitted, and half predicted.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    rows : sequence of MotionRows
    delays : bool, optional
        Whether delays of inputs are tested, which an estimate may include.
    """

    model: Model
    layout: ParameterLayout
    rows: Sequence[MotionRows]
    delays: bool = True

    @cached_property
    def without(self) -> CorrectedEquations:
        """The equations as the log was recorded."""
        return self.of(Correction())

    @property
    def need_no_correction(self) -> bool:
        """True if the equations hold as recorded, with all parameters within their bounds, or overflow."""
        largest = self.without.residuals.max()
        return not np.isfinite(largest) or (not self.without.outside and bool(largest < 0.05))

    def of(self, correction: Correction, model: Model | None = None) -> CorrectedEquations:
        """The equations with a correction, or those of another model of the same signals."""
        model = model or self.model
        parts, held = self._parts(correction, model)
        predict = self._nonlinear if model.nonlinear_parameters else self._affine
        found = predict(model, parts, held)
        if found is None:
            return CorrectedEquations(correction, np.full(len(self.layout), np.nan), np.array([np.inf]), [])
        parameters, errors, residuals = found
        outside = outside_bounds(self.layout, parameters, errors)
        return CorrectedEquations(correction, parameters, np.maximum(residuals, EXACT), outside)

    def one_by_one(self, correction: Correction) -> FloatArray:
        """Residuals ``(n_eq,)`` with a correction of equations that are affine, each with parameters of its own."""
        parts, held = self._parts(correction, self.model)
        rows, finite = scaled_equations(self.model, self.layout, parts)
        residuals = np.full(rows.b.shape[1], np.inf)
        for i in range(len(residuals)):
            own = np.flatnonzero(rows.W[:, i].any(axis=0))
            bounds = tuple(x[own] for x in inclusive_bounds(self.layout.bounds, zero=True))
            one = Rows(rows.W[:, i : i + 1, own], rows.b[:, i : i + 1])
            found = _predicted(one, np.concatenate(held)[finite], (bounds[0], bounds[1]))
            residuals[i] = np.inf if found is None else found[1][0]
        return residuals

    def _parts(self, correction: Correction, model: Model) -> tuple[list[MotionRows], list[BoolArray]]:
        """Some rows of each log with a correction, and a mask of those that are predicted."""
        # 600 rows of each log are enough.
        some = [np.arange(0, len(x.q), max(1, len(x.q) // 600)) for x in self.rows]
        parts = [correction.of_rows(model, *pair) for pair in zip(self.rows, some, strict=True)]
        # Blocks of rows that alternate: neighbours in time have correlated errors.
        return parts, [np.arange(len(x)) * 20 // max(1, len(x)) % 2 == 1 for x in some]

    def _affine(
        self, model: Model, parts: Sequence[MotionRows], held: Sequence[BoolArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Parameters, standard errors and residuals of ``W p = b``; None without a known term."""
        rows, finite = scaled_equations(model, self.layout, parts)
        found = _predicted(rows, np.concatenate(held)[finite], inclusive_bounds(self.layout.bounds, zero=True))
        return None if found is None else (found[0].p, found[0].errors(), found[1])

    def _nonlinear(
        self, model: Model, parts: Sequence[MotionRows], held: Sequence[BoolArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray] | None:
        """Parameters, no errors, and residuals of accelerations over their sizes."""
        from diransac.identification.regression.nonlinear import solved_nonlinear

        pairs = list(zip(parts, held, strict=True))
        fitted, predicted = (
            [Correction().of_rows(model, x, np.flatnonzero(mask == which)) for x, mask in pairs]
            for which in (False, True)
        )
        solution = solved_nonlinear(model, self.layout, fitted)
        if solution is None:
            return None
        errors = []
        for i, one in enumerate(predicted):
            p = np.repeat(self.layout.of_log(solution.parameters, i)[:, None], len(one.q), axis=1)
            errors.append(np.abs(one.a - np.array(model.dynamics(np.hstack([one.q, one.v]).T, one.u.T, p)[1]).T))
        size = np.sqrt(np.square(np.concatenate([x.a for x in predicted])).mean(axis=0)) + EXACT**2
        residuals = np.median(np.concatenate(errors), axis=0) / size
        return solution.parameters, solution.errors, np.where(np.isfinite(residuals), residuals, np.inf)


def _predicted(
    rows: Rows, predicted: BoolArray, bounds: tuple[FloatArray, FloatArray]
) -> tuple[Solution, FloatArray] | None:
    """Solution of some rows, and residuals of the others with it, within its bounds; None without a known term."""
    if not predicted.any() or predicted.all() or not rows.b.any():
        return None
    fitted = Rows(rows.W[~predicted], rows.b[~predicted])
    found = robust_fit(fitted)
    if found is None:
        return None
    is_possible = (np.clip(found.p, *bounds) == found.p).all()
    possible = found if is_possible else (robust_fit(fitted, bounds) or found)
    W, b = rows.W[predicted], rows.b[predicted]
    residuals = np.median(np.abs(W @ possible.p - b), axis=0)
    # Zero solves an equation without a known term: its residual is that over its terms.
    whole = np.median(np.abs(W) @ np.abs(possible.p), axis=0)
    of_terms = np.where(whole > EXACT, residuals / np.maximum(whole, EXACT), 1.0)
    return found, np.where(b.any(axis=0), residuals, of_terms)


# ---------------------------------------------------------------------- acceptance


def explained(tests: CorrectionTests) -> tuple[list[CorrectedEquations], int]:
    """The correction with which the equations hold much better, if it is proved, and its alternatives.

    Several signs are reversed one after another, as long as more equations hold.  Two signs of one equation, those of a
    force and of a motion, are alternatives.  Delays are tested where nothing else explains the log.

    Returns
    -------
    accepted : list of CorrectedEquations
    n_tested : int
        Number of corrections that were tested.
    """
    tested = [tests.of(x) for x in corrections(tests.model)]
    accepted = _accepted(tests, [*tested, *_several_signs(tests, tests.without)])
    if not accepted and tests.delays:
        accepted = _accepted(tests, list(_delays(tests)))
    return accepted, len(tested)


def reversed_drives(tests: CorrectionTests) -> list[CorrectedEquations]:
    """The sign of the inputs that drive one equation each, where it is reversed, and of coordinates as an alternative.

    Each of these equations, whatever the others are, is explained with the other sign alone: parameters within their
    bounds fit it much worse as it was recorded, since armature, damping and friction would be negative, and gravity
    points upwards.
    """
    model, drives = tests.model, drives_of(tests.model)
    recorded = tests.one_by_one(Correction())
    other = tests.one_by_one(Correction(tuple(drives.values()), factor=-1.0))
    found = [i for i in drives if other[i] < min(MUCH_BETTER * recorded[i], EXPLAINED)]
    if not found:
        return []
    forces = tests.of(Correction(tuple(drives[i] for i in found), factor=-1.0))
    # Shared parameters show a sign that many parameters of one equation hide.
    for more in _several_signs(tests, forces):
        forces = more if forces.improved_by(more).any() else forces
    if model.n_q < model.n_v:
        return [forces]
    motion = tests.of(Correction(tuple(list(model.coordinates)[i] for i in found), factor=-1.0))
    return [forces, motion] if motion.residual < DISTINCT * forces.residual else [forces]


def drives_of(model: Model) -> dict[int, str]:
    """Input of each equation that has one, and shares it with no other; a target is no force."""
    equations, inputs = (np.array(x) for x in model.residual.jac_sparsity(0, 3).get_triplet())
    names = list(model.inputs)
    pairs = zip(equations.tolist(), inputs.tolist(), strict=True)
    own = {i: names[k] for i, k in pairs if np.sum(equations == i) == np.sum(inputs == k) == 1}
    return {i: name for i, name in own.items() if name not in model.targets}


def _accepted(tests: CorrectionTests, tested: Sequence[CorrectedEquations]) -> list[CorrectedEquations]:
    """The best of some corrections, and its alternatives, if no rival explains the log nearly as well."""
    better = [x for x in tested if not x.outside and tests.without.improved_by(x).any()]
    better.sort(key=lambda x: (x.residual, len(x.correction.names)))
    rivals = [x for x in better[1:] if better[0].rivals(x)]
    if any(x.correction.factor > 0.0 for x in rivals) or not better or not _is_proved(tests, better[0]):
        return []
    return sorted([better[0], *rivals], key=lambda x: x.correction.names[0] not in tests.model.inputs)


def _is_proved(tests: CorrectionTests, best: CorrectedEquations) -> bool:
    """True if the equations are explained, the log determines the factor, and no constant of the model takes it up.

    Bounds determine it, too, where parameters are clearly outside of them as recorded.
    """
    one, improved = best.correction, tests.without.improved_by(best)
    if (best.residuals[improved] > EXPLAINED).any():
        return False
    if not one.unit or tests.without.outside:
        return True
    others = (
        replace(one, offset=one.offset * x) if one.offset else replace(one, factor=one.factor * x) for x in (0.5, 2)
    )
    if any(tests.of(x).residual < 1.2 * best.residual for x in others):
        return False
    rival = tests.of(Correction(), with_factor_inside(tests.model, one))
    return bool((rival.improved_by(best) & improved).any())


# ---------------------------------------------------------------------- the hypotheses


def other_units(wanted: str) -> list[tuple[str, float]]:
    """Other units of a dimension, with the factors that convert from them."""
    found = dict[float, tuple[str, float]]()
    for unit in _UNITS.split(", "):
        factor = conversion(unit, wanted)
        if factor is not None and abs(np.log(factor)) > SAME_FACTOR:
            found.setdefault(round(factor, 12), (unit, factor))
    return list(found.values())


def conversions(kind: Mapping[str, str]) -> Iterator[Correction]:
    """Units and signs of signals: of single ones, of several, and of all of a unit."""
    for unit in dict.fromkeys(kind.values()):
        names = tuple(n for n, x in kind.items() if x == unit)
        # All subsets of few signals of a unit are tested.
        sizes = range(1, len(names) + 1) if len(names) <= 3 else (1, len(names))
        for group in (group for size in sizes for group in combinations(names, size)):
            yield from (Correction(group, other, factor) for other, factor in other_units(unit))
            yield Correction(group, factor=-1.0)
            if unit == "K":
                yield Correction(group, "degC", offset=273.15)


def corrections(model: Model) -> Iterator[Correction]:
    """Units, signs and exchanges of signals of a kind, and units of all.

    A thermometer in another unit than all others is rare: states and inputs have their offsets together, too.
    """
    moving = model.coordinates if model.kinematics is None else model.velocities_of_motion
    for kind in (model.inputs, moving, model.first_order):
        yield from conversions(kind)
        yield from (Correction(x, exchanged=True) for x in combinations(kind, 2) if kind[x[0]] == kind[x[1]])
    if len(set(model.inputs.values())) > 1:
        yield Correction(tuple(model.inputs), factor=-1.0)
    kelvin = tuple(n for n, unit in (model.first_order | model.inputs).items() if unit == "K")
    if len(kelvin) > 1:
        yield Correction(kelvin, "degC", offset=273.15)


def _several_signs(tests: CorrectionTests, best: CorrectedEquations) -> Iterator[CorrectedEquations]:
    """Signs of more and more inputs, each that with which fewer parameters are outside of their bounds."""
    while best.outside:
        names = best.correction.names
        more = [tests.of(Correction((*names, n), factor=-1.0)) for n in tests.model.inputs if n not in names]
        fewer = [x for x in more if len(x.outside) < len(best.outside)]
        if not fewer:
            return
        best = min(fewer, key=lambda x: (len(x.outside), x.residual))
        yield best


def _delays(tests: CorrectionTests) -> Iterator[CorrectedEquations]:
    """The best delay of all inputs, and of each: powers of two, then, if it is of any use, those around the best."""
    inputs = tuple(tests.model.inputs)
    for names in dict.fromkeys([inputs, *((n,) for n in inputs)] if inputs else ()):
        tried = [tests.of(Correction(names, delay=2**k)) for k in range(6)]
        best = min(tried, key=lambda x: x.residual)
        step = best.correction.delay // 2
        while step and best.residual < 0.9 * tests.without.residual:
            near = [tests.of(replace(best.correction, delay=best.correction.delay + x)) for x in (-step, step)]
            best = min([best, *near], key=lambda x: x.residual)
            step //= 2
        yield best


def with_factor_inside(model: Model, correction: Correction) -> Model:
    """The model with some signals multiplied inside of its nonlinear functions alone, as by another constant there.

    Sines of angles have no such constant: an angle is its own unit.
    """
    residual, rows = model.residual, model.residual.sparsity_out(0).row()
    own = [[n in correction.names for n in names] for names in model.argument_names[:4]]
    passed = {"assign", "add", "sub", "neg", "mul", "twice", "sq", "fabs", "sign", "not"}
    if all(one_turn(model.units[n]) is not None for n in correction.names if n in model.units):
        passed |= {"sin", "cos", "tan"}

    def equations(*named: Sequence[ca.SX]) -> list[ca.SX]:
        symbols, results = [list(x) for x in named], [ca.SX(0)] * residual.numel_out(0)
        values = list[tuple[ca.SX, ca.SX]]()  # without the factor, and with it
        for step in steps(residual):
            i, k = step.place
            outside, inside = ([values[j][which] for j in step.operands] for which in (0, 1))
            if step.operation == "output":
                results[rows[k]] = outside[0]
                values.append((outside[0], inside[0]))
            elif step.operation == "input":
                x = symbols[i][k]
                values.append((x, x * correction.factor + correction.offset if i < len(own) and own[i][k] else x))
            elif step.operation == "const":
                values.append((ca.SX(step.constant), ca.SX(step.constant)))
            else:
                scaled = applied(step.operation, *inside)
                if step.operation in passed:
                    values.append((applied(step.operation, *outside), scaled))
                else:
                    values.append(
                        (applied("div", outside[0], inside[1]) if step.operation == "div" else scaled, scaled)
                    )
        return results

    return model.with_equations(model.name, model.parameters, equations, {})
