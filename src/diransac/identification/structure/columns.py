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
    EXPLAINED,
    SAME_FACTOR,
    CorrectedEquations,
    CorrectionTests,
    corrections,
    drives_of,
    explained,
    other_units,
    reversed_drives,
)
from diransac.text_table import listed, number

if TYPE_CHECKING:
    from diransac.data.log import Log
    from diransac.model import Model

FITTED_MOTION = "rows of the fitted motion"
"""Key under which a dataset keeps the rows of each log that a fit of its motion has."""
_SPANS = (1, 4, 16, 64, 256)
"""Samples over which changes are compared with integrals of derivatives."""


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


def mistakes_of_columns(dataset: Dataset, *, delays: bool = True) -> tuple[list[Mistake], int]:
    """Mistakes that explain a bad answer, the clearest first, and the number of corrections that were tested.

    Parameters
    ----------
    dataset : Dataset
    delays : bool, optional
        Whether delays of inputs are tested, which an estimate may include.
    """
    certain = contradictions(dataset.model, dataset.given) or _zero_inputs(dataset)
    if certain:
        return certain, 0
    try:
        return explanations(_tests(dataset.model, dataset.given, delays), dataset.given)
    except TimeLimitError:
        raise
    except (DiransacError, np.linalg.LinAlgError):
        rows = dataset.kept(FITTED_MOTION, list[MotionRows])
        if not rows:
            return [], 0  # the equations cannot be evaluated on the logs
        return explanations(CorrectionTests(dataset.model, dataset.layout, rows, delays), dataset.given)


def reversed_signs(model: Model, logs: Sequence[Log]) -> list[Mistake]:
    """The reversed signs of columns that drive one equation each: see `reversed_drives`.

    Parameters
    ----------
    model : Model
        Without equations that are affine in its parameters, it has none.
    logs : sequence of Log
        Derivatives may be missing.
    """
    if not model.has_equations or model.nonlinear_parameters or not drives_of(model):
        return []
    try:
        with np.errstate(all="ignore"):  # equations that overflow prove nothing
            tests = _tests(model, logs, delays=False)
            accepted = reversed_drives(tests)
            return [_of_correction(tests, logs, accepted)] if accepted else []
    except TimeLimitError:
        raise
    except (DiransacError, np.linalg.LinAlgError):  # the equations cannot be evaluated on the logs
        return []


def _tests(model: Model, logs: Sequence[Log], delays: bool) -> CorrectionTests:
    """Tests of corrections by rows of logs, with the derivatives that these may lack.

    Raises DiransacError: the equations cannot be evaluated on the logs.
    """
    parts, model = [_middle(in_units(log, model)) for log in logs], model.with_sensors(())
    complete = all(set(model.required_signals) <= set(log.signals) for log in parts)
    derived = Dataset.of(model, parts if complete else [differentiate(x, model) for x in parts], pointwise=True)
    return CorrectionTests(model, derived.layout, motion_rows(derived), delays)


def explanations(tests: CorrectionTests, logs: Sequence[Log]) -> tuple[list[Mistake], int]:
    """The correction of columns that explains logs, and the number of those that were tested.

    Parameters
    ----------
    tests : CorrectionTests
    logs : sequence of Log
        With the columns that a correction names.
    """
    if tests.need_no_correction:
        return [], sum(1 for _ in corrections(tests.model))
    accepted, n_tested = explained(tests)
    return ([_of_correction(tests, logs, accepted)] if accepted else []), n_tested


def _of_correction(tests: CorrectionTests, logs: Sequence[Log], accepted: Sequence[CorrectedEquations]) -> Mistake:
    """The mistake that one of alternative corrections mends, and how much better the equations hold with it."""
    one, without, model = accepted[0].correction, tests.without, tests.model
    columns, ratio = _columns(model, logs, one.names), float((without.residuals / accepted[0].residuals).max())
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
    if len(accepted) > 1:
        what = f"The sign of {' or '.join(listed(x.correction.names) for x in accepted)} is reversed"
    mended = [n for n in without.outside if n not in accepted[0].outside]
    if mended:
        values = dict(zip(tests.layout.names, without.parameters, strict=True))
        impossible = ", ".join(f"{n} = {values[n]:.4g}" for n in mended)
        are = "is" if len(mended) == 1 else "are"
        why += f", and {impossible}, outside the bounds as recorded, {are} within"
    return Mistake(what, f"with {them} multiplied by {one.factor:.4g}, {why}", _scaled(columns, one.factor))


def _columns(model: Model, logs: Sequence[Log], names: Sequence[str]) -> list[str]:
    """All columns of signals: derivatives change with a coordinate."""
    chains = {x[0]: x for x in model.chains}
    return [n for name in names for n in chains.get(name, (name,)) if any(n in x.measured for x in logs)]


def _middle(log: Log) -> Log:
    """The middle of a long log: 5,000 rows are enough to find a mistake."""
    first = max(0, (len(log) - 5_000) // 2)
    return log[first : first + 5_000] if first else log


def _zero_inputs(dataset: Dataset) -> list[Mistake]:
    """Inputs of the equations that are zero throughout."""
    inputs = [n for n in dataset.model.inputs if n in dataset.model.required_signals]
    zero = [n for n in inputs if all(n in log and not np.nan_to_num(log[n]).any() for log in dataset.given)]
    if not zero:
        return []
    are, forces = ("is", "its force is") if len(zero) == 1 else ("are", "their forces are")
    action = f"give the column that was recorded: --map {zero[0]}=COLUMN"
    return [Mistake(f"{listed(zero)} {are} zero throughout", f"{forces} not in the equations", action, explains=False)]


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
    prepared = [continuous(_middle(in_units(log.measured, model)), model) for log in logs]
    ratios = list(_ratios(model, prepared))
    clocks = {unit: conversion(unit, "s") or 1.0 for unit in ("ms", "us")}
    slow = [u for u, x in clocks.items() if ratios and all(_is_near(r.ratio, x**r.order) for r in ratios)]
    if slow and len(ratios) > 1:
        why = f"all derivatives are those of a clock that is {number(1.0 / clocks[slow[0]])} times as fast"
        return [Mistake(f"The time is in {slow[0]}, not in s", why, _scaled(["t"], clocks[slow[0]]))]
    named = dict[tuple[str, float], list[tuple[_Ratio, tuple[str, ...]]]]()
    for ratio in ratios:
        for names, unit, factor in _culprits(model, ratio)[:1]:
            named.setdefault((unit, factor), []).append((ratio, names))
    found = list[Mistake]()
    for (unit, factor), same in named.items():
        columns, first = list(dict.fromkeys(n for _, names in same for n in names)), same[0][0]
        what = f"the {'second derivative' if first.order == 2 else 'derivative'} of {first.low}"
        why = f"{what} is {number(first.ratio, 3)} times {first.should_be}"
        why += f" (or the time is in {slow[0]}: --scale t={clocks[slow[0]]:g})" if slow else ""
        found.append(Mistake(_in_unit(columns, unit, model.units[columns[0]]), why, _scaled(columns, factor)))
    return found


def wraps(model: Model, logs: Sequence[Log]) -> list[Mistake]:
    """Coordinates that leap by the period of a counter, or by a turn in another unit than theirs.

    Parameters
    ----------
    model : Model
    logs : sequence of Log
    """
    found = dict[str, Mistake]()
    for log in (in_units(x, model) for x in logs):
        for name in (n for n in model.coordinates if n in log and n not in found):
            unit = model.units[name]
            own = one_turn(unit)
            turns = {turn: (u, x) for u, x in other_units(unit) if own and (turn := one_turn(u))}
            period = wrap_period(log[name], (*turns, *([own] if own else [])))
            if period in (None, own):
                continue
            leaps = f"it leaps by {number(period)} from one of its ends to the other, and nowhere else"
            if period in turns:
                other, factor = turns[period]
                why = f"{leaps}, which is one turn in {other}"
                found[name] = Mistake(_in_unit([name], other, unit), why, _scaled([name], factor))
            else:
                what = f"{name} wraps, as a counter of limited bits does"
                found[name] = Mistake(what, leaps, _again("unwrap", {name: f"{period:.10g}"}))
    return list(found.values())


@dataclass(frozen=True)
class _Ratio:
    """Ratio of a derivative of a column, of order 1 or 2, and what it should be: a column, or kinematics of several."""

    low: str
    high: tuple[str, ...]
    order: int
    ratio: float
    should_be: str


def _ratios(model: Model, logs: Sequence[Log]) -> Iterator[_Ratio]:
    """Ratios of all columns whose derivative is measured, too, where derivative and column agree but for a factor."""
    chains, motion = model.chains, (*model.coordinates, *model.velocities_of_motion)
    if model.kinematics is not None and not model.quaternions and all(n in log for log in logs for n in motion):
        chains, by_log = chains[model.n_q :], [_coordinate_rates(model, log) for log in logs]
        equations, arguments = model.kinematics.jac_sparsity(0, 1).get_triplet()
        for i, low in enumerate(model.coordinates):
            speeds = tuple(list(model.velocities)[k] for row, k in zip(equations, arguments, strict=True) if row == i)
            columns = [(log[low], rates[i], log.dt) for log, rates in zip(logs, by_log, strict=True)]
            yield from (_Ratio(low, speeds, 1, x, "that of the kinematics") for x in _ratio(columns, 1) if speeds)
    for names in chains:
        for low, high in pairwise(n for n in names if all(n in log for log in logs)):
            order = names.index(high) - names.index(low)
            columns = [(log[low], log[high], log.dt) for log in logs]
            yield from (_Ratio(low, (high,), order, x, high) for x in _ratio(columns, order))


def _coordinate_rates(model: Model, log: Log) -> FloatArray:
    """Derivatives ``(n_q, N)`` of the coordinates by the kinematics ``k(q, v)``."""
    assert model.kinematics is not None
    names = (*model.coordinates, *model.velocities_of_motion)
    columns = {n: np.zeros(len(log)) for n in model.state} | {n: np.nan_to_num(log[n]) for n in names}
    q, v = (np.stack([columns[n] for n in x]) for x in (model.coordinates, model.velocities))
    return np.array(model.kinematics(q, v))


def _in_unit(names: Sequence[str], unit: str, wanted: str) -> str:
    """``theta is in deg, not in rad``; or that a sign is reversed, for an empty unit."""
    signs, are = ("sign", "is") if len(names) == 1 else ("signs", "are")
    return (
        f"{listed(names)} {are} in {unit}, not in {wanted}"
        if unit
        else f"The {signs} of {listed(names)} {are} reversed"
    )


def _culprits(model: Model, ratio: _Ratio) -> list[tuple[tuple[str, ...], str, float]]:
    """Columns, units and factors that explain the ratio of a derivative and its column, the likeliest first."""
    units = ((ratio.high, 1.0), ((ratio.low,), -1.0))
    found = [(names, unit, x, x**way) for names, way in units for unit, x in other_units(model.units[names[0]])]
    near = [x for x in [*found, (ratio.high, "", -1.0, -1.0)] if _is_near(ratio.ratio, x[3])]
    return [x[:3] for x in sorted(near, key=lambda x: abs(np.log(ratio.ratio / x[3])))]


def _is_near(ratio: float, factor: float) -> bool:
    return bool(ratio / factor > 0.0 and abs(np.log(ratio / factor)) < SAME_FACTOR)


def _ratio(pairs: Sequence[tuple[FloatArray, FloatArray, float]], order: int) -> list[float]:
    """Ratio of the derivatives of columns and other columns of several logs; none where nothing agrees.

    Changes over some samples are compared with integrals, which need no derivative of noise.
    """
    filled = [(_filled(low), _filled(high), dt) for low, high, dt in pairs]
    known = [(low, high, dt) for low, high, dt in filled if low is not None and high is not None]
    least, found, tiny = EXPLAINED, list[float](), np.finfo(float).tiny
    for span in _SPANS:
        changes = [_changes(*one, order, span) for one in known if 4 * order * span <= len(one[0])]
        if not changes:
            break
        y, x = np.concatenate(changes, axis=1)
        large = np.abs(x) > max(float(np.median(np.abs(x))), tiny)
        ratios = y[large] / x[large]
        middle = float(np.median(ratios)) if len(ratios) else 0.0
        if middle and (scatter := float(np.median(np.abs(ratios / middle - 1.0)))) < least:
            least, found = scatter, [middle]
    return found


def _changes(low: FloatArray, high: FloatArray, dt: float, order: int, span: int) -> FloatArray:
    """Changes (2, n) of a column, and of the integral of another one, over some samples, each as often as the order."""
    for _ in range(order):
        high = np.r_[0.0, np.cumsum(0.5 * dt * (high[1:] + high[:-1]))]
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
