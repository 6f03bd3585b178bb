"""Mistakes of a log's columns: another unit, another sign, an input that is zero.

Each is a hypothesis that is tested, not a guess.  A column whose derivative is measured, too, contradicts it by the
factor of a unit (`contradictions`).  A column in another unit or with another sign makes the equations hold much better
once it is corrected, or brings all parameters within their bounds (`explanations`).

References
----------
Theil 1950 (slopes by medians).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import Dataset
from diransac.data.preprocessing import continuous, differentiate, in_units
from diransac.data.units import conversion
from diransac.errors import DiransacError, TimeLimitError
from diransac.identification.regression.rows import motion_rows, outside_bounds, solved
from diransac.text_table import listed, number

if TYPE_CHECKING:
    from collections.abc import Callable

    from diransac.data.dataset import ParameterLayout
    from diransac.data.log import Log
    from diransac.identification.regression.rows import MotionRows, Solution
    from diransac.model import Model

    Solver = Callable[[Model, ParameterLayout, Sequence[MotionRows]], Solution | None]

# Units in which columns are recorded by mistake; those of another dimension than the model's are none.
_UNITS: tuple[str, ...] = ("rad", "deg", "rad/s", "deg/s", "rpm", "deg/s^2", "rad/s^2", "m", "mm", "cm", "m/s")
_UNITS += ("mm/s", "km/h", "m/s^2", "g", "mm/s^2", "N", "mN", "kN", "N m", "mN m", "Pa", "kPa", "bar", "V", "mV")
_UNITS += ("A", "mA", "K", "s", "ms")
_TINY = 1e-300
_OFFSETS = {"K": ("degC", 1.0, 273.15)}
# Samples over which changes are compared with integrals of derivatives; scatter of their ratios that is agreement, and
# largest logarithm of a ratio over that of a unit.
_SPANS, _AGREES, _SAME_FACTOR = (1, 4, 16, 64, 256), 0.25, 0.1
# Residual over that without the correction from which on it explains a log much better; that of the next best
# correction over it.
_MUCH_BETTER, _DISTINCT = 0.5, 1.5


@dataclass(frozen=True)
class Mistake:
    """A mistake of columns, its evidence, and the option that corrects it.

    Parameters
    ----------
    factors : mapping of str to float
        Factor by which each column is to be multiplied; empty where that does not help.
    what : str
        The mistake: ``theta is in deg, not in rad``.
    evidence : str
        Why, as a clause.
    otherwise : str, optional
        What to do where no factor helps.
    explains : bool, optional
        Whether the mistake explains all that is bad.
    """

    factors: Mapping[str, float]
    what: str
    evidence: str
    otherwise: str = ""
    explains: bool = True

    @property
    def claim(self) -> str:
        """The mistake with its evidence."""
        return f"{self.what}: {self.evidence}"

    @property
    def action(self) -> str:
        """Remedy, as an option where there is one."""
        option = ",".join(f"{n}={x:.6g}" for n, x in self.factors.items())
        return f"identify again with --scale {option}" if option else self.otherwise


def mistakes_of_columns(dataset: Dataset, nonlinear: Solver) -> tuple[list[Mistake], int]:
    """Mistakes that explain a bad answer, the clearest first, and the number of corrections that were tested.

    Parameters
    ----------
    dataset : Dataset
    nonlinear : callable
        Solution of a model that is not affine in its parameters, as `solved`.
    """
    found = contradictions(dataset.model, dataset.given) or _zero_inputs(dataset)
    if found:
        return found, 0
    try:
        model = dataset.model.with_sensors(())
        parts = [_middle(log) for log in dataset.given]
        complete = all(set(model.required_signals) <= set(log.signals) for log in parts)
        logs = parts if complete else [differentiate(log, model) for log in parts]
        other = Dataset.of(model, logs, pointwise=True)
        solve = nonlinear if model.nonlinear_parameters else solved
        return explanations(model, other.layout, motion_rows(other), dataset.given, solve)
    except TimeLimitError:
        raise
    except (DiransacError, np.linalg.LinAlgError):
        return [], 0  # the equations cannot be evaluated on the logs


def _middle(log: Log) -> Log:
    """The middle of a long log, which is enough to find a mistake."""
    enough = 20_000
    first = max(0, (len(log) - enough) // 2)
    return log[first : first + enough] if first else log


def _zero_inputs(dataset: Dataset) -> list[Mistake]:
    """Inputs of the equations that are zero throughout."""
    used = set(dataset.model.required_signals)
    inputs = [n for n in dataset.model.inputs if n in used]
    zero = [n for n in inputs if all(n in log and not np.nan_to_num(log[n]).any() for log in dataset.given)]
    if not zero:
        return []
    verb = "is" if len(zero) == 1 else "are"
    evidence = f"{'its force is' if len(zero) == 1 else 'their forces are'} not in the equations"
    return [
        Mistake(
            {},
            f"{listed(zero)} {verb} zero throughout",
            evidence,
            f"give the column that was recorded: --map {zero[0]}=COLUMN",
            explains=False,
        )
    ]


# ---------------------------------------------------------------------- columns and their derivatives


def contradictions(model: Model, logs: Sequence[Log]) -> list[Mistake]:
    """Columns that are not the derivatives of each other, but are so up to the factor of a unit, or a sign.

    Parameters
    ----------
    model : Model
    logs : sequence of Log
    """
    prepared = [continuous(in_units(_middle(log).measured, model), model) for log in logs]
    if model.kinematics is not None and not model.quaternions:
        return _of_kinematics(model, prepared)
    ratios = list(_ratios(model, prepared))
    named = [(x, culprit) for x in ratios if (culprit := _culprit(model, x.low, x.high, x.ratio)) is not None]
    slow = next(
        (u for u in ("ms", "us") if ratios and all(_is_near(x.ratio, _factor(u, "s") ** x.order) for x in ratios)), ""
    )
    if slow and len(ratios) > 1:
        why = f"all derivatives are those of a clock that is {number(1.0 / _factor(slow, 's'))} times as fast"
        return [Mistake({"t": _factor(slow, "s")}, f"The time is in {slow}, not in s", why)]
    found = list[Mistake]()
    for unit, factor in dict.fromkeys(culprit[1:] for _, culprit in named):
        same = [(x, culprit[0]) for x, culprit in named if culprit[1:] == (unit, factor)]
        names, (first, _) = list(dict.fromkeys(name for _, name in same)), same[0]
        derivative = "second derivative" if first.order == 2 else "derivative"
        why = f"the {derivative} of {first.low} is {number(first.ratio, 3)} times {first.high}"
        why += f" (or the time is in {slow}: --scale t={_factor(slow, 's'):g})" if slow else ""
        found.append(Mistake(dict.fromkeys(names, factor), _in_unit(names, unit, model.units[names[0]]), why))
    return found


def _of_kinematics(model: Model, logs: Sequence[Log]) -> list[Mistake]:
    """Coordinates or velocities in other units, with which the kinematics ``dq/dt = k(q, v)`` hold much better."""
    rates = model.velocities_of_motion
    names = (*model.coordinates, *rates)
    if not all(n in log for log in logs for n in names):
        return []
    columns = [(np.stack([np.nan_to_num(log[n]) for n in names]), log.dt) for log in logs]

    def mismatch(group: Sequence[str], factor: float) -> float:
        factors = np.where([n in group for n in names], factor, 1.0)[:, None]
        return min(_mismatch(model, [(x * factors, dt) for x, dt in columns], span) for span in _SPANS[:4])

    found, as_recorded = list[tuple[float, tuple[str, ...], str, float]](), mismatch((), 1.0)
    for kind in (model.coordinates, rates):
        for unit in dict.fromkeys(kind.values()):
            same = tuple(n for n, x in kind.items() if x == unit)
            for group in dict.fromkeys([*((n,) for n in same), same]):
                found += [(mismatch(group, x), group, other, x) for other, x in [*_other_units(unit), ("", -1.0)]]
    found.sort(key=lambda x: (x[0], len(x[1])))
    best, group, unit, factor = found[0]
    if best > min(_AGREES, _MUCH_BETTER * as_recorded) or found[1][0] < _DISTINCT * best:
        return []
    ratio = number(as_recorded / best, 2)
    why = f"with this corrected, the kinematics of the model hold {ratio} times as well"
    return [Mistake(dict.fromkeys(group, factor), _in_unit(group, unit, model.units[group[0]]), why)]


def _mismatch(model: Model, columns: Sequence[tuple[FloatArray, float]], span: int) -> float:
    """Changes of coordinates over some samples less the integrals of their rates, over the changes, by medians."""
    assert model.kinematics is not None
    errors, changes = [], []
    for both, dt in columns:
        q, v = both[: model.n_q], both[model.n_q :]
        whole = np.zeros((len(q) + len(model.velocities) - len(v), q.shape[1]))
        rates = np.array(model.kinematics(q, np.vstack([v, whole[len(q) :]])))
        steps = np.cumsum(0.5 * dt * (rates[:, 1:] + rates[:, :-1]), axis=1)
        change = q[:, span + 1 :] - q[:, 1:-span]
        errors.append(change - (steps[:, span:] - steps[:, :-span]))
        changes.append(change)
    sizes = np.median(np.abs(np.concatenate(changes, axis=1)), axis=1) + _TINY
    found = float((np.median(np.abs(np.concatenate(errors, axis=1)), axis=1) / sizes).mean())
    return found if np.isfinite(found) else np.inf


@dataclass(frozen=True)
class _Ratio:
    """Ratio of a derivative of a column, of order 1 or 2, and the column that should be it."""

    low: str
    high: str
    order: int
    ratio: float


def _ratios(model: Model, logs: Sequence[Log]) -> Iterator[_Ratio]:
    """Ratios of all columns whose derivative is measured, too, where derivative and column agree but for a factor."""
    for chain in model.chains:
        known = [n for n in chain if all(n in log for log in logs)]
        for low, high in pairwise(known):
            order = chain.index(high) - chain.index(low)
            ratio = _ratio([(log[low], log[high], log.dt) for log in logs], order)
            if ratio is not None:
                yield _Ratio(low, high, order, ratio)


def _in_unit(names: Sequence[str], unit: str, wanted: str) -> str:
    """``theta is in deg, not in rad``; or that a sign is reversed, for an empty unit."""
    one = len(names) == 1
    if not unit:
        return f"The {'sign' if one else 'signs'} of {listed(names)} {'is' if one else 'are'} reversed"
    return f"{listed(names)} {'is' if one else 'are'} in {unit}, not in {wanted}"


def _culprit(model: Model, low: str, high: str, ratio: float) -> tuple[str, str, float] | None:
    """Column, unit and factor that explain the ratio of a derivative and its column; None without one."""
    found = [(high, unit, factor, factor) for unit, factor in _other_units(model.units[high])]
    found += [(low, unit, factor, 1.0 / factor) for unit, factor in _other_units(model.units[low])]
    found.append((high, "", -1.0, -1.0))
    near = [x for x in found if _is_near(ratio, x[3])]
    return min(near, key=lambda x: abs(np.log(ratio / x[3])))[:3] if near else None


def _is_near(ratio: float, factor: float) -> bool:
    return bool(ratio / factor > 0.0 and abs(np.log(ratio / factor)) < _SAME_FACTOR)


def _factor(unit: str, wanted: str) -> float:
    """Factor between units of one dimension."""
    factor = conversion(unit, wanted)
    assert factor is not None
    return factor


def _other_units(wanted: str) -> list[tuple[str, float]]:
    """Other units of a dimension, with the factors that convert from them."""
    found: dict[float, str] = {}
    for unit in _UNITS:
        factor = conversion(unit, wanted)
        if factor is not None and abs(np.log(factor)) > _SAME_FACTOR:
            found.setdefault(round(factor, 12), unit)
    return [(unit, _factor(unit, wanted)) for unit in found.values()]


def _ratio(pairs: Sequence[tuple[FloatArray, FloatArray, float]], order: int) -> float | None:
    """Ratio of the derivatives of columns and other columns of several logs; None where nothing agrees.

    Changes over some samples are compared with integrals, which need no derivative of noise.
    """
    filled = [(_filled(low), _filled(high), dt) for low, high, dt in pairs]
    known = [(low, high, dt) for low, high, dt in filled if low is not None and high is not None]
    least, found = _AGREES, None
    for span in _SPANS:
        changes = [_changes(*one, order, span) for one in known if order * span <= len(one[0]) // 4]
        if not changes:
            break
        y, x = np.concatenate(changes, axis=1)
        large = np.abs(x) > max(float(np.median(np.abs(x))), _TINY)
        ratios = y[large] / x[large]
        middle = float(np.median(ratios)) if len(ratios) else 0.0
        scatter = float(np.median(np.abs(ratios - middle))) / (abs(middle) + _TINY) if len(ratios) else np.inf
        if scatter < least:
            least, found = scatter, middle
    return found


def _changes(low: FloatArray, high: FloatArray, dt: float, order: int, span: int) -> FloatArray:
    """Changes (2, n) of a column, and of the integral of another one, over some samples, each as often as the order."""
    for _ in range(order):
        high = np.concatenate([[0.0], np.cumsum(0.5 * dt * (high[1:] + high[:-1]))])
    both = np.stack([low, high])
    for _ in range(order):
        both = both[:, span:] - both[:, :-span]
    return both


def _filled(x: FloatArray) -> FloatArray | None:
    """A column without single outliers, with its gaps interpolated; None where too few samples are known."""
    known = np.flatnonzero(np.isfinite(x))
    if len(known) < max(5, 0.05 * len(x)):
        return None
    middle = np.median(np.lib.stride_tricks.sliding_window_view(x[known], 5), axis=1)
    return np.interp(np.arange(len(x)), known[2:-2], middle)


# ---------------------------------------------------------------------- columns and the equations


def explanations(
    model: Model, layout: ParameterLayout, rows: Sequence[MotionRows], logs: Sequence[Log], solve: Solver
) -> tuple[list[Mistake], int]:
    """Corrections of columns with which the equations hold much better, and the number of those that were tested.

    Where parameters are clearly outside of their bounds, equations that hold as well, with all parameters within,
    are enough.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    rows : sequence of MotionRows
    logs : sequence of Log
        With the columns that a correction names.
    solve : callable
        `solved`, or as that.
    """
    found = solve(model, layout, rows)
    if found is None or not found.has_known_terms:
        return [], 0
    tested = list[_Correction]()
    for names, unit, factor, offset in _corrections(model):
        other = solve(model, layout, [one.corrected(model, names, factor, offset) for one in rows])
        if other is not None:
            tested.append(_Correction(names, unit, factor, offset, other))
    possible = [x for x in tested if layout.admits(x.solution.parameters[None])[0]]
    possible.sort(key=lambda x: (x.solution.residual, len(x.names)))
    mistakes = _much_better(model, logs, found, possible) or _within_bounds(model, layout, logs, found, possible)
    return mistakes, len(tested)


@dataclass(frozen=True)
class _Correction:
    """Signals that are converted from a unit, or multiplied by -1, and the solution with them."""

    names: tuple[str, ...]
    unit: str
    factor: float
    offset: float
    solution: Solution

    def rivals(self, other: _Correction) -> bool:
        """True if another correction, neither a part of this one nor the reverse, explains a log nearly as well."""
        own, others = set(self.names), set(other.names)
        nested = (self.factor, self.offset) == (other.factor, other.offset) and (own <= others or others <= own)
        return not nested and other.solution.residual < _DISTINCT * self.solution.residual


def _much_better(model: Model, logs: Sequence[Log], found: Solution, possible: Sequence[_Correction]) -> list[Mistake]:
    """The one correction with which the equations hold much better; none where several do."""
    better = [x for x in possible if x.solution.residual < _MUCH_BETTER * found.residual]
    # Units of parameters change the weights of the equations, and with them each residual by a little.
    clear = [x for x in better if (x.solution.residuals < _MUCH_BETTER * found.residuals).any()]
    # A unit that makes the terms of an equation vanish silences what contradicts the others, and explains nothing.
    clear = [x for x in clear if (x.solution.residuals < _DISTINCT * found.residuals).all()]
    if not clear or any(clear[0].rivals(x) for x in clear[1:]):
        return []
    best, ratio = clear[0], number(float((found.residuals / clear[0].solution.residuals).max()), 2)
    them = "it" if len(best.names) == 1 else "them"
    how = f"plus {best.offset:g}" if best.offset else f"multiplied by {best.factor:.4g}"
    why = f"with {them} {how}, the equations hold up to {ratio} times as well"
    return [_mistake(model, logs, best, why)]


def _within_bounds(
    model: Model, layout: ParameterLayout, logs: Sequence[Log], found: Solution, possible: Sequence[_Correction]
) -> list[Mistake]:
    """The correction of the fewest signals that brings parameters within their bounds: of a sign, or the only one.

    Equations that leave most of their terms are those of noise, whose least squares gives any sign.
    """
    outside = outside_bounds(layout, found)
    holding = [x for x in possible if (x.solution.residuals < 0.5).all()]
    as_good = [x for x in holding if outside and x.solution.residual < 1.05 * found.residual]
    fewest = min((len(x.names) for x in as_good), default=0)
    as_good = [x for x in as_good if len(x.names) == fewest]
    signs = [x for x in as_good if x.factor < 0.0]
    chosen = sorted(signs, key=lambda x: x.names[0] not in model.inputs) or (as_good if len(as_good) == 1 else [])
    if not chosen:
        return []
    values = dict(zip(layout.names, found.parameters, strict=True))
    given = ", ".join(f"{n} = {values[n]:.4g}" for n in outside)
    why = f"as recorded, least squares gives {given}, outside the bounds, and within them once this is corrected"
    mistake = _mistake(model, logs, chosen[0], why)
    if len(chosen) == 1:
        return [mistake]
    which = " or ".join(listed(x.names) for x in chosen)
    return [replace(mistake, what=f"The sign of {which} is reversed")]


def _mistake(model: Model, logs: Sequence[Log], found: _Correction, why: str) -> Mistake:
    """The mistake of signals, with all of their columns: derivatives change with a coordinate."""
    chains = {chain[0]: chain for chain in model.chains}
    columns = [n for name in found.names for n in chains.get(name, (name,)) if any(n in x.measured for x in logs)]
    what = _in_unit(found.names, found.unit, model.units[found.names[0]])
    if found.offset:
        return Mistake({}, what, why, f"add {found.offset:g} to {listed(columns)}")
    return Mistake(dict.fromkeys(columns, found.factor), what, why)


def _corrections(model: Model) -> Iterator[tuple[tuple[str, ...], str, float, float]]:
    """Signals, unit, factor and offset of each correction: of single ones, of several, and of all of a kind and unit.

    A thermometer in another unit than all others is rare: states and inputs have their offsets together, too.
    """
    moving = model.coordinates if model.kinematics is None else model.velocities_of_motion
    for kind in (model.inputs, moving, model.first_order):
        for unit in dict.fromkeys(kind.values()):
            names = tuple(n for n, x in kind.items() if x == unit)
            # All subsets of few signals of a unit are tested.
            sizes = range(1, len(names) + 1) if len(names) <= 3 else (1, len(names))
            groups = [group for size in sizes for group in combinations(names, size)]
            yield from ((g, other, factor, 0.0) for g in groups for other, factor in _other_units(unit))
            yield from ((g, "", -1.0, 0.0) for g in groups)
            yield from ((g, *_OFFSETS[unit]) for g in groups if unit in _OFFSETS)
    if len(set(model.inputs.values())) > 1:
        yield tuple(model.inputs), "", -1.0, 0.0
    for unit, other in _OFFSETS.items():
        every = tuple(n for n, x in (model.first_order | model.inputs).items() if x == unit)
        if len(every) > 1:
            yield every, *other
