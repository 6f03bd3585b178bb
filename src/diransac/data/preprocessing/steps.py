"""Steps that need no model: names, factors, rates and delays."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray, runs
from diransac.data.checks import ROUNDING, is_implausible
from diransac.data.clock import Aligned
from diransac.data.preprocessing.continuity import interpolated, unwrap
from diransac.data.preprocessing.degrees import in_degrees
from diransac.data.preprocessing.spikes import despike
from diransac.data.units import conversion, same_unit
from diransac.errors import LogError, SettingsError
from diransac.limits import MOST_ROWS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from diransac.data.log import Log
    from diransac.model import Model

Column = TypeVar("Column")


# ---------------------------------------------------------------------- names and factors


def rename(log: Log, names: Mapping[str, str]) -> Log:
    """Log with signals under other names.

    Parameters
    ----------
    log : Log
    names : mapping of str to str
        New name -> present name.  A signal may be given several new names.

    Raises
    ------
    LogError
        The log has no such signal, or another signal has the new name.
    """
    signals = rename_columns(log.signals, names, log.source)
    origins = origins_of(log.signals, names)
    units = {new: log.units[old] for new, old in origins.items() if old in log.units}
    renamed = log.with_step({"step": "rename", "names": dict(names)}, signals=signals, units=units)
    return renamed if log.filter is None else replace(renamed, filter=log.filter.renamed(origins))


def rename_columns(columns: Mapping[str, Column], names: Mapping[str, str], source: str) -> dict[str, Column]:
    """Columns under their new names, ``names`` mapping new to old ones; others keep theirs.

    Raises LogError: an old name is missing, or a new one belongs to another column.
    """
    for new, old in names.items():
        if old not in columns:
            raise LogError(f'{source}: there is no column "{old}" to call "{new}"; found {", ".join(columns)}')
        if new in columns and new not in names.values():
            raise LogError(
                f'{source}: "{old}" cannot be called "{new}", there is a column of that name; '
                f"give that one another name, too (--map {new}={old},{new}_other={new})"
            )
    return {new: columns[old] for new, old in origins_of(columns, names).items()}


def origins_of(columns: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, str]:
    """New name -> old name of every column, in the columns' order; a column may be given several names."""
    origins: dict[str, str] = {}
    for column in columns:
        news = [new for new, old in names.items() if old == column]
        origins.update(dict.fromkeys(news or [column], column))
    return origins


def scale(log: Log, factors: Mapping[str, float]) -> Log:
    """Log with signals multiplied by factors.

    Parameters
    ----------
    log : Log
    factors : mapping of str to float
        Signal -> factor.

    Returns
    -------
    Log
        A signal whose magnitude changes has no unit any more.

    Raises
    ------
    LogError
        The log has no such signal.
    SettingsError
        A factor is zero or not finite.
    """
    for name, factor in factors.items():
        check_factor(name, factor)
    signals = {**log.signals, **{name: log[name] * factor for name, factor in factors.items()}}
    units = {name: unit for name, unit in log.units.items() if abs(factors.get(name, 1.0)) == 1.0}
    step = {"step": "scale", "factors": {name: float(factor) for name, factor in factors.items()}}
    return log.with_step(step, signals=signals, units=units)


def unit_factors(units: Mapping[str, str], model: Model, source: str) -> dict[str, float]:
    """Factors that bring signals and inputs of other units into those of a model.

    Raises LogError: a unit has another dimension than the model's.
    """
    factors: dict[str, float] = {}
    for name in (n for n in (*model.signals, *model.inputs) if n in units):
        found, wanted = units[name], model.units[name]
        if same_unit(found, wanted):
            continue
        factor = conversion(found, wanted)
        if factor is None:
            raise LogError(
                f'{source}: signal "{name}" is in {found}, the model needs {wanted}; check the column and its unit'
            )
        factors[name] = factor
    return factors


def in_units(log: Log, model: Model) -> Log:
    """Log with the signals and inputs of a model in the model's units; the same log if they are.

    Parameters
    ----------
    log : Log
        A whole recording. A signal without a known unit is in the model's, or in degrees: see `in_degrees`.
    model : Model

    Raises
    ------
    LogError
        As `in_stated_units`.
    """
    return in_stated_units(in_degrees(log, model), model)


def in_stated_units(log: Log, model: Model) -> Log:
    """Log with the signals and inputs of a model in the model's units; the same log if they are.

    Parameters
    ----------
    log : Log
        A signal without a known unit is in the model's.
    model : Model

    Raises
    ------
    LogError
        A unit has another dimension than the model's.
    """
    factors = unit_factors({name: unit for name, unit in log.units.items() if name in log}, model, log.source)
    if not factors:
        return log
    return log.with_step(
        {"step": "units", "from": {n: log.units[n] for n in factors}, "to": {n: model.units[n] for n in factors}},
        signals={**log.signals, **{n: log[n] * factor for n, factor in factors.items()}},
        units={**log.units, **{n: model.units[n] for n in factors}},
        notes=[f"converted: {', '.join(f'{n} from {log.units[n]} to {model.units[n]}' for n in factors)}"],
    )


def keep_while(log: Log, events: Sequence[str]) -> Log:
    """Log without the rows at which an event does not hold, such as those on the ground.

    Rows before the first and after the last are cut; of those between, every sample is missing.

    Parameters
    ----------
    log : Log
    events : sequence of str
        Signals that are 1 where an event holds; all of them must.

    Returns
    -------
    Log

    Raises
    ------
    LogError
        The log has no such signal, or they hold together in fewer than 2 rows.
    """
    kept, together = np.logical_and.reduce([log[name] == 1.0 for name in events]), " and ".join(events)
    if kept.sum() < 2:
        raise LogError(f"{log.source}: no stretch of it is {together}; leave that out, or look at the event's topic")
    return _kept(log, kept, {"step": "keep_while", "events": list(events)}, f"not {together}", events)


def leave_out(log: Log, stretches: Sequence[tuple[float, float]]) -> Log:
    """Log without some stretches, such as those in which it is in the hand.

    Parameters
    ----------
    log : Log
    stretches : sequence of (float, float)
        First and last time of each, s.  At the ends of the log they are cut; of those between, every sample is missing.

    Returns
    -------
    Log

    Raises
    ------
    LogError
        Fewer than 2 rows are left.
    SettingsError
        A stretch does not end after its start.
    """
    kept = np.ones(len(log), bool)
    for start, stop in stretches:
        if not start < stop:
            raise SettingsError(f"the stretch {start:g}:{stop:g} is to be left out; give START:END, s")
        kept &= (log.time < start) | (log.time > stop)
    if kept.sum() < 2:
        raise LogError(f"{log.source}: of {len(log)} rows, all but {kept.sum()} are to be left out")
    return _kept(log, kept, {"step": "leave_out"}, "as asked", ())


def _kept(log: Log, kept: npt.NDArray[np.bool_], step: dict[str, Any], why: str, events: Sequence[str]) -> Log:
    """Log of the rows ``kept`` (N,): the ends are cut, and between them samples of signals but events are missing."""
    rows = np.flatnonzero(kept)
    part, inside = log[int(rows[0]) : int(rows[-1]) + 1], kept[rows[0] : rows[-1] + 1]
    signals = {n: x if n in events else np.where(inside, x, np.nan) for n, x in part.signals.items()}
    stretches = [[float(log.time[x.start]), float(log.time[x.stop - 1])] for x in runs(~kept)]
    step |= {"left_out": stretches}
    if not stretches:
        return log.with_step(step)
    said = ", ".join(f"{a:.4g} to {b:.4g} s" for a, b in stretches[:5]) + ", ..." * (len(stretches) > 5)
    note = f"{int((~kept).sum())} of {len(kept)} rows are left out, {why}: {said}"
    return part.with_step(step, notes=[note], signals=signals)


def prepared(log: Log, steps: Mapping[str, Any]) -> Log:
    """Log after steps that need no model, by the keys of a mapping file; others are not done.

    Parameters
    ----------
    log : Log
    steps : mapping of str to object
        In this order: ``from`` and ``until`` (s), ``while`` (events), ``leave_out`` (stretches), ``unwrap``
        (periods by signal), ``despike`` (signals, or ``"all"``) and ``shift`` (delays by signal); None is none.

    Raises
    ------
    LogError, SettingsError
        As each step.
    """
    found = {name: x for name, x in steps.items() if x is not None}
    named = {name: [x] if isinstance(x, str) else x for name, x in found.items() if name in ("while", "despike")}
    if "from" in found or "until" in found:
        log = log.between(found.get("from", -math.inf), found.get("until", math.inf))
    log = keep_while(log, named["while"]) if "while" in named else log
    log = leave_out(log, found["leave_out"]) if "leave_out" in found else log
    log = unwrap(log, found["unwrap"]) if found.get("unwrap") else log
    log = despike(log, None if named["despike"] == ["all"] else named["despike"]) if "despike" in named else log
    return shift(log, found["shift"]) if found.get("shift") else log


def check_factor(name: str, factor: float) -> None:
    """Raise SettingsError for a factor that is zero or not finite."""
    if not math.isfinite(factor) or factor == 0.0:
        raise SettingsError(f'the scale of "{name}" is {factor}; give a finite factor other than 0')


# ---------------------------------------------------------------------- time


def resample(log: Log, rate: float | str = "median") -> Log:
    """Log at a uniform rate, by linear interpolation; wrapped angles and quaternions along the shorter way.

    Parameters
    ----------
    log : Log
    rate : float or "median"
        Hz; ``"median"`` for one sample per median interval.

    Returns
    -------
    Log
        Signals are NaN where their samples are NaN, and in gaps of the clock.

    Raises
    ------
    SettingsError
        The rate is not a positive number.
    LogError
        Fewer than 2 samples are left, or more than ten million would be made.

    Notes
    -----
    There is no anti-aliasing filter: at a lower rate, components above half of it are folded to lower frequencies, and
    a note says so.
    """
    made = resampled(log.time, log.signals, rate, log.source)
    return log.with_step(made.steps[0], time=made.time, signals=made.signals, notes=made.notes)


def resampled(time: FloatArray, signals: Mapping[str, FloatArray], rate: float | str, source: str) -> Aligned:
    """Columns at a uniform rate; ``time`` (N,) increases."""
    grid, hertz = resampling_grid(time, rate, source)
    step, notes = describe_resampling(time, grid, hertz)
    return Aligned(grid, interpolate_at(time, signals, grid, hertz), steps=(step,), notes=tuple(notes))


def describe_resampling(time: FloatArray, grid: FloatArray, hertz: float) -> tuple[dict[str, Any], list[str]]:
    """Step of the history, and notes, of a clock (N,) that is resampled to a grid (n,) of a rate."""
    gaps = _gaps(time, hertz)
    rows = [len(time), len(grid)]
    step = {"step": "resample", "rate": hertz, "method": "linear", "rows": rows, "gaps": int(gaps.sum())}
    return step, _resampling_notes(time, gaps, _in_gaps(time, grid, gaps)[2], hertz)


def resampling_grid(time: FloatArray, rate: float | str, source: str) -> tuple[FloatArray, float]:
    """Uniform time (n,) over that of a clock, and its rate in Hz.  Raises LogError, SettingsError: as `resample`."""
    hertz = _rate(rate, float(np.median(np.diff(time))))
    n = _new_rows(float(time[-1] - time[0]), hertz, source)
    if is_implausible(n, len(time)):
        steps = np.diff(time)
        row = int(np.argmax(steps))
        raise LogError(
            f"{source}: resampling at {hertz:.6g} Hz would make {n:,} rows of {len(time)}: {steps[row]:.4g} s pass "
            f"after t = {time[row]:.6g} s (row {row}); split the log there, or correct its time"
        )
    return time[0] + np.arange(n) / hertz, hertz


def interpolate_at(
    time: FloatArray, signals: Mapping[str, FloatArray], grid: FloatArray, hertz: float
) -> dict[str, FloatArray]:
    """Signals interpolated linearly at the times (n,) of a grid; NaN in gaps of the clock and beyond its ends.

    An interval of more than three and a half median ones (and more than one new sample) is a gap.
    """
    left, weight, blank = _in_gaps(time, grid, _gaps(time, hertz))
    slack = ROUNDING / hertz
    blank |= (grid < time[0] - slack) | (grid > time[-1] + slack)
    return {name: np.where(blank, np.nan, x) for name, x in interpolated(signals, left, weight).items()}


def _gaps(time: FloatArray, hertz: float) -> npt.NDArray[np.bool_]:
    """Intervals (N - 1,) that are not bridged."""
    steps = np.diff(time)
    # More than three and a half median intervals, and more than one new sample.
    return np.asarray(steps > max(3.5 * float(np.median(steps)), 1.0 / hertz))


def _in_gaps(
    time: FloatArray, grid: FloatArray, gaps: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.intp], FloatArray, npt.NDArray[np.bool_]]:
    """Sample before each new one, the new one's weight between the two, and whether it lies in a gap: (n,) each."""
    left = np.clip(np.searchsorted(time, grid, side="right") - 1, 0, len(time) - 2)
    weight = np.clip((grid - time[left]) / np.diff(time)[left], 0.0, 1.0)
    return left, weight, gaps[left] & (weight > ROUNDING) & (weight < 1.0 - ROUNDING)


def _rate(rate: float | str, usual: float) -> float:
    if rate == "median":
        return 1.0 / usual
    if isinstance(rate, str) or not 0.0 < rate < math.inf:
        raise SettingsError(f'resampling to {rate!r} has no meaning; give a rate in Hz, or "median"')
    return float(rate)


def _new_rows(seconds: float, hertz: float, source: str) -> int:
    """Number of rows at a rate.  Raises LogError: fewer than 2, or more than `MOST_ROWS`."""
    rows = seconds * hertz * (1.0 + 1e-12) + 1e-9
    if rows < 1.0:
        raise LogError(f"{source}: resampling at {hertz:.6g} Hz leaves 1 row of {seconds:.6g} s")
    if rows >= MOST_ROWS:
        raise LogError(
            f"{source}: resampling {seconds:.6g} s at {hertz:.6g} Hz would make {rows:.4g} rows; at most "
            f"{MOST_ROWS:,} are made: give a lower rate, or --scale t=FACTOR if t is not in seconds"
        )
    return math.floor(rows) + 1


def _resampling_notes(
    time: FloatArray, gaps: npt.NDArray[np.bool_], blank: npt.NDArray[np.bool_], hertz: float
) -> list[str]:
    notes = [f"resampled from {len(time)} to {len(blank)} rows at {hertz:.6g} Hz, by linear interpolation"]
    if hertz * np.median(np.diff(time)) < 0.9:
        notes.append(f"no filter went before it: motion and noise above {hertz / 2.0:.4g} Hz now appear below")
    if gaps.any():
        steps = np.where(gaps, np.diff(time), 0.0)
        row = int(steps.argmax())
        notes.append(
            f"{gaps.sum()} gap{'s' * bool(gaps.sum() > 1)} in time, the longest {steps[row]:.4g} s after "
            f"t = {time[row]:.6g} s: {blank.sum()} rows are NaN"
        )
    return notes


def shift(log: Log, delays: Mapping[str, float]) -> Log:
    """Log with delayed signals: the new signal at ``t`` is the old one at ``t - delay``.

    Parameters
    ----------
    log : Log
    delays : mapping of str to float
        Signal -> seconds; positive for a command that acts late, negative for a measurement that arrived late.

    Returns
    -------
    Log
        Without the rows at both ends that a delayed signal does not cover.

    Raises
    ------
    LogError
        There is no such signal, or fewer than 2 rows are left.
    SettingsError
        A delay is not finite.

    Notes
    -----
    Fractions of a sample are interpolated linearly; wrapped angles, and quaternions whose components have one delay,
    along the shorter way.
    """
    n = np.arange(len(log), dtype=float)
    signals, covered = dict(log.signals), np.ones(len(log), dtype=bool)
    for name, delay in delays.items():
        if not math.isfinite(delay):
            raise SettingsError(f'the delay of "{name}" is {delay}; give seconds')
    for delay in dict.fromkeys(delays.values()):
        rows = n - delay / log.dt
        covered &= (rows >= -ROUNDING) & (rows <= n[-1] + ROUNDING)
        rows = np.clip(rows, 0.0, n[-1])
        left = np.minimum(rows.astype(np.intp), len(log) - 2)
        late = {name: log[name] for name, x in delays.items() if x == delay}
        signals |= interpolated(late, left, rows - left)
    if covered.sum() < 2:
        raise LogError(f"{log.source}: delays of {dict(delays)} s leave no row of {len(log) * log.dt:.6g} s")
    step = {"step": "shift", "delays": {name: float(delay) for name, delay in delays.items()}}
    note = f"{(~covered).sum()} rows cut at the ends, which delayed signals do not cover"
    kept = {name: values[covered] for name, values in signals.items()}
    return log.with_step(step, time=log.time[covered], signals=kept, notes=[note] if not covered.all() else [])
