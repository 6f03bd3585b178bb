"""Mistakes of a log's columns: another unit, another sign, a counter that wraps, exchanged or late columns, zeros.

Each is a hypothesis that is tested, not a guess.  A coordinate leaps by the period of a counter, or a column whose
derivative is measured, too, contradicts it by the factor of a unit (`contradictions`).  Others are tested by the
equations (`column_corrections`).

References
----------
Theil 1950 (slopes by medians).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import Dataset
from diransac.data.preprocessing import continuous, differentiate, in_units, wrap_period
from diransac.data.units import conversion, one_turn
from diransac.errors import DiransacError, TimeLimitError
from diransac.identification.regression.rows import MotionRows, motion_rows
from diransac.identification.structure.column_corrections import (
    SAME_FACTOR,
    CorrectedEquations,
    CorrectionTests,
    corrections,
    explained,
    nothing_to_explain,
    other_units,
)
from diransac.text_table import listed, number

if TYPE_CHECKING:
    from diransac.data.log import Log
    from diransac.identification.structure.column_corrections import Solver
    from diransac.model import Model

FITTED_MOTION = "rows of the fitted motion"
"""Key under which a dataset keeps the rows of each log that a fit of its motion has."""
_TINY = 1e-300
# Samples over which changes are compared with integrals of derivatives; scatter of their ratios that is agreement;
# changes that are enough.
_SPANS, _AGREES, _CHANGES = (1, 4, 16, 64, 256), 0.25, 2000
# Mismatch of kinematics over that without the correction, and of the next best correction over it.
_MUCH_BETTER, _DISTINCT = 0.5, 1.5


@dataclass(frozen=True)
class Mistake:
    """A mistake of columns, its evidence, and the option that corrects it.

    Parameters
    ----------
    what : str
        The mistake: ``theta is in deg, not in rad``.
    evidence : str
        Why, as a clause.
    action : str
        What to do: identify again with an option, where there is one.
    explains : bool, optional
        Whether the mistake explains all that is bad.
    """

    what: str
    evidence: str
    action: str
    explains: bool = True

    @property
    def claim(self) -> str:
        """The mistake with its evidence."""
        return f"{self.what}: {self.evidence}"


def _again(option: str, values: Mapping[str, object]) -> str:
    """Action with an option and its values."""
    return f"identify again with --{option} {','.join(f'{n}={x}' for n, x in values.items())}"


def _scaled(names: Iterable[str], factor: float) -> str:
    """Action that multiplies columns."""
    return _again("scale", dict.fromkeys(names, f"{factor:.6g}"))


def mistakes_of_columns(dataset: Dataset, nonlinear: Solver, *, delays: bool = True) -> tuple[list[Mistake], int]:
    """Mistakes that explain a bad answer, the clearest first, and the number of corrections that were tested.

    Parameters
    ----------
    dataset : Dataset
    nonlinear : callable
        Solution of a model that is not affine in its parameters, as `solved`.
    delays : bool, optional
        Whether delays of inputs are tested, which an estimate may include.
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
        return explanations(CorrectionTests(model, other.layout, motion_rows(other), nonlinear, delays), dataset.given)
    except TimeLimitError:
        raise
    except (DiransacError, np.linalg.LinAlgError):
        rows = dataset.kept(FITTED_MOTION, list[MotionRows])
        if not rows:
            return [], 0  # the equations cannot be evaluated on the logs
        return explanations(CorrectionTests(dataset.model, dataset.layout, rows, nonlinear, delays), dataset.given)


def explanations(tests: CorrectionTests, logs: Sequence[Log]) -> tuple[list[Mistake], int]:
    """The correction of columns that explains logs, and the number of those that were tested.

    Parameters
    ----------
    tests : CorrectionTests
    logs : sequence of Log
        With the columns that a correction names.
    """
    without = tests.without
    if without is None:
        return [], 0
    if nothing_to_explain(tests):
        return [], sum(1 for _ in corrections(tests.model))
    found, n_tested = explained(tests)
    return ([_of_correction(tests, logs, found)] if found else []), n_tested


def _of_correction(tests: CorrectionTests, logs: Sequence[Log], found: Sequence[CorrectedEquations]) -> Mistake:
    """The mistake that one of alternative corrections mends, and how much better the equations hold with it."""
    one, without, model = found[0].correction, tests.without, tests.model
    assert without is not None
    columns, ratio = _columns(model, logs, one.names), float((without.residuals / found[0].residuals).max())
    why = f"the equations hold up to {number(ratio, 2)} times as well"
    if one.exchanged:
        pairs = zip(_columns(model, logs, one.names[:1]), _columns(model, logs, one.names[1:]), strict=True)
        renamed = {new: old for a, b in pairs for new, old in ((a, b), (b, a))}
        exchanged, other_way = f"{listed(one.names)} are exchanged", f"with them the other way round, {why}"
        return Mistake(exchanged, other_way, _again("map", renamed))
    if one.delay:
        late = one.delay * logs[0].dt
        what = f"{listed(one.names)} act{'s' * (len(one.names) == 1)} {number(late, 2)} s later than recorded"
        return Mistake(what, f"with this delay, {why}", _again("shift", dict.fromkeys(columns, f"{late:.4g}")))
    them = "it" if len(one.names) == 1 else "them"
    what = _in_unit(one.names, one.unit, model.units[one.names[0]])
    if one.offset:
        return Mistake(what, f"with {them} plus {one.offset:g}, {why}", f"add {one.offset:g} to {listed(columns)}")
    if len(found) > 1:
        what = f"The sign of {' or '.join(listed(x.correction.names) for x in found)} is reversed"
    if without.outside:
        values = dict(zip(tests.layout.names, without.parameters, strict=True))
        impossible = ", ".join(f"{n} = {values[n]:.4g}" for n in without.outside)
        why += (
            f", and {impossible}, outside the bounds as recorded, {'is' if len(without.outside) == 1 else 'are'} within"
        )
    return Mistake(what, f"with {them} multiplied by {one.factor:.4g}, {why}", _scaled(columns, one.factor))


def _columns(model: Model, logs: Sequence[Log], names: Sequence[str]) -> list[str]:
    """All columns of signals: derivatives change with a coordinate."""
    chains = {chain[0]: chain for chain in model.chains}
    return [n for name in names for n in chains.get(name, (name,)) if any(n in x.measured for x in logs)]


def _middle(log: Log) -> Log:
    """The middle of a long log, which is enough to find a mistake."""
    enough = 5_000
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
    wrapped = wraps(model, logs)
    if wrapped:
        return wrapped
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
        return [Mistake(f"The time is in {slow}, not in s", why, _scaled(["t"], _factor(slow, "s")))]
    found = list[Mistake]()
    for unit, factor in dict.fromkeys(culprit[1:] for _, culprit in named):
        same = [(x, culprit[0]) for x, culprit in named if culprit[1:] == (unit, factor)]
        names, (first, _) = list(dict.fromkeys(name for _, name in same)), same[0]
        derivative = "second derivative" if first.order == 2 else "derivative"
        why = f"the {derivative} of {first.low} is {number(first.ratio, 3)} times {first.high}"
        why += f" (or the time is in {slow}: --scale t={_factor(slow, 's'):g})" if slow else ""
        found.append(Mistake(_in_unit(names, unit, model.units[names[0]]), why, _scaled(names, factor)))
    return found


def wraps(model: Model, logs: Sequence[Log]) -> list[Mistake]:
    """Coordinates that leap by the period of a counter, or by a turn in another unit than theirs.

    Parameters
    ----------
    model : Model
    logs : sequence of Log
    """
    found = dict[str, float]()
    for log in logs:
        log = in_units(log, model)
        for name in (n for n in model.coordinates if n in log and n not in found):
            own = one_turn(model.units[name])
            period = wrap_period(log[name], (*_turns(model.units[name]), *([own] if own else [])))
            found |= {} if period in (None, own) else {name: period}
    return [_of_wrap(model, name, period) for name, period in found.items()]


def _turns(unit: str) -> dict[float, str]:
    """One turn in other units of angles than that of a coordinate, as numbers that its column has, with the unit."""
    return {turn: other for other, _ in other_units(unit) if one_turn(unit) and (turn := one_turn(other))}


def _of_wrap(model: Model, name: str, period: float) -> Mistake:
    """The mistake of a coordinate that wraps."""
    unit = model.units[name]
    leaps = f"it leaps by {number(period)} from one of its ends to the other, and nowhere else"
    if (other := _turns(unit).get(period)) is not None:
        return Mistake(
            _in_unit([name], other, unit),
            f"{leaps}, which is one turn in {other}",
            _scaled([name], _factor(other, unit)),
        )
    return Mistake(
        f"{name} wraps, as a counter of limited bits does", leaps, _again("unwrap", {name: f"{period:.10g}"})
    )


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
                found += [(mismatch(group, x), group, other, x) for other, x in [*other_units(unit), ("", -1.0)]]
    found.sort(key=lambda x: (x[0], len(x[1])))
    best, group, unit, factor = found[0]
    if best > min(_AGREES, _MUCH_BETTER * as_recorded) or found[1][0] < _DISTINCT * best:
        return []
    ratio = number(as_recorded / best, 2)
    why = f"with this corrected, the kinematics of the model hold {ratio} times as well"
    return [Mistake(_in_unit(group, unit, model.units[group[0]]), why, _scaled(group, factor))]


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
    found = [(high, unit, factor, factor) for unit, factor in other_units(model.units[high])]
    found += [(low, unit, factor, 1.0 / factor) for unit, factor in other_units(model.units[low])]
    found.append((high, "", -1.0, -1.0))
    near = [x for x in found if _is_near(ratio, x[3])]
    return min(near, key=lambda x: abs(np.log(ratio / x[3])))[:3] if near else None


def _is_near(ratio: float, factor: float) -> bool:
    return bool(ratio / factor > 0.0 and abs(np.log(ratio / factor)) < SAME_FACTOR)


def _factor(unit: str, wanted: str) -> float:
    """Factor between units of one dimension."""
    factor = conversion(unit, wanted)
    assert factor is not None
    return factor


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
    some = np.arange(0, both.shape[1] - order * span, max(1, (both.shape[1] - order * span) // _CHANGES))
    if order == 1:
        return both[:, some + span] - both[:, some]
    return both[:, some + 2 * span] - 2.0 * both[:, some + span] + both[:, some]


def _filled(x: FloatArray) -> FloatArray | None:
    """A column without single outliers, with its gaps interpolated; None where too few samples are known."""
    known = np.flatnonzero(np.isfinite(x))
    if len(known) < max(5, 0.05 * len(x)):
        return None
    middle = np.median(np.lib.stride_tricks.sliding_window_view(x[known], 5), axis=1)
    return np.interp(np.arange(len(x)), known[2:-2], middle)
