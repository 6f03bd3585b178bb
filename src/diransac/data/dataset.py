"""`Dataset`: one or more logs bound to a model, as arrays that every method reads."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data import preprocessing
from diransac.data.log import Log
from diransac.data.units import conversion, same_unit
from diransac.errors import LogError, SettingsError

if TYPE_CHECKING:
    from diransac.model import Model, Parameter

__all__ = ["Dataset", "ParameterLayout", "Segment", "as_logs", "bind_log"]


# A line through seven samples bears two outliers, and is short against any motion that is sampled well; the slope that
# stands for a missing velocity needs a longer one.
_ROWS_FOR_VALUE, _ROWS_FOR_SLOPE = 7, 25
_FAR = 5.0
# Rows that an input is held for, beyond which the motion is no longer the one that it made.
_LONG_HOLD = 3
# Relative difference of two sampling times below which they are one rate with another jitter.
_SAME_RATE = 1e-3


class ParameterLayout:
    """Positions of every log's parameters in one vector: shared ones once, per-log ones once per log.

    Parameters
    ----------
    parameters : of the model
    n_logs : logs that are identified together

    Attributes
    ----------
    names : (n,)   the model's names; ``bias[0]``, ``bias[1]``, ... for a per-log parameter of several logs
    bounds : (n,)   the `Parameter` of each
    index : (n_logs, n_p)   positions of each log's parameters in the vector
    """

    def __init__(self, parameters: Mapping[str, Parameter], n_logs: int = 1) -> None:
        self.parameters, self.n_logs = dict(parameters), n_logs
        names: list[str] = []
        columns: list[list[int]] = []
        for name, parameter in parameters.items():
            own = [f"{name}[{i}]" for i in range(n_logs)] if parameter.per_log and n_logs > 1 else [name]
            columns.append([len(names) + (i if len(own) > 1 else 0) for i in range(n_logs)])
            names += own
        self.names = tuple(names)
        self.bounds = tuple(self.parameters[name.partition("[")[0]] for name in names)
        self.index: IntArray = np.array(columns, np.int64).reshape(len(columns), n_logs).T

    def __len__(self) -> int:
        return len(self.names)

    @property
    def is_shared(self) -> bool:
        """Whether every log has the same parameters."""
        return len(self.names) == len(self.parameters)

    def of_log(self, values: FloatArray, i: int) -> FloatArray:
        """The model's parameters ``(..., n_p)`` of log ``i`` from vectors ``(..., n)``."""
        return values if self.is_shared else values[..., self.index[i]]

    def scattered(self, columns: FloatArray, i: int) -> FloatArray:
        """Columns ``(..., n_p)`` of log ``i`` in their places ``(..., n)``; zero elsewhere."""
        if self.is_shared:
            return columns
        full = np.zeros((*columns.shape[:-1], len(self)))
        full[..., self.index[i]] = columns
        return full

    @cached_property
    def mean_map(self) -> FloatArray:
        """Matrix ``(n_p, n)`` from the vector to one value per parameter: the mean over logs of a per-log one."""
        mean = np.zeros((len(self.parameters), len(self)))
        for own in self.index:
            mean[np.arange(len(own)), own] += 1.0 / self.n_logs
        return mean

    def admits(self, values: FloatArray) -> BoolArray:
        """Whether every parameter of vectors ``(n_vectors, n)`` is within its bounds, ``(n_vectors,)``."""
        return np.asarray(np.all([x.admits(values[:, i]) for i, x in enumerate(self.bounds)], axis=0))

    def violations(self, values: FloatArray) -> tuple[str, ...]:
        """Names of the parameters of a vector ``(n,)`` that are outside their bounds."""
        return tuple(n for n, x, value in zip(self.names, self.bounds, values, strict=True) if not x.admits(value))


@dataclass(frozen=True)
class Segment:
    """Arrays of one model over one log.

    Parameters
    ----------
    model, log : what was put together
    offset : row of the log that is row 0 here; rows before it have no usable initial state or input
    signals : signals of the model that the dataset has, in the model's order
    measured : (N, n_s)   them, NaN where missing
    inputs : (N, n_u)   inputs, held over NaN
    valid : (N,)   rows in which every signal in use is finite
    notes : what was found and done, a sentence each
    """

    model: Model
    log: Log
    offset: int
    signals: tuple[str, ...]
    measured: FloatArray
    inputs: FloatArray
    valid: BoolArray
    notes: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.valid)

    @property
    def n_rows(self) -> int:
        """Rows that count."""
        return int(self.valid.sum())

    def column(self, name: str) -> FloatArray:
        """A measured signal (N,)."""
        return self.measured[:, self.signals.index(name)]

    @cached_property
    def present(self) -> tuple[str, ...]:
        """Signals of which this log has at least one sample."""
        some: BoolArray = np.asarray(np.isfinite(self.measured).any(axis=0))
        return tuple(n for n, x in zip(self.signals, some, strict=True) if x)

    def state_arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coordinates ``(N, n_q)``, velocities and accelerations ``(N, n_v)``; 0 in what the log lacks."""
        full = np.zeros((len(self), len(self.model.signals)))
        for name in self.present:
            full[:, self.model.signals.index(name)] = self.column(name)
        n_q, n_v = self.model.n_q, self.model.n_v
        return full[:, :n_q], full[:, n_q : n_q + n_v], full[:, n_q + n_v :]

    def acting_inputs(self) -> FloatArray:
        """Inputs ``(N, n_u)`` that belong to each row's accelerations; see `preprocessing.acting_inputs`."""
        return preprocessing.acting_inputs(self.log.filter, self.inputs)

    def initial_state(self, rule: str | Mapping[str, float]) -> FloatArray:
        """State ``(n_x,)`` at row 0, by ``Settings.initial_state``'s rule.

        A state that the log lacks and on which nothing measured depends starts at 0, a quaternion at (1, 0, 0, 0).
        Raises LogError: another state is missing; it is named.
        """
        given = rule if isinstance(rule, Mapping) else {}
        unknown = [n for n in given if n not in self.model.state]
        if unknown:
            raise SettingsError(f'initial_state names "{unknown[0]}"; the state is {", ".join(self.model.state)}')
        matter = self.model.states_behind(self.present)
        start = np.zeros(len(self.model.state))
        start[[four[0] for four in self.model.quaternions]] = 1.0
        for i, name in enumerate(self.model.state):
            if name in given:
                start[i] = given[name]
            elif name in self.present:
                start[i] = self._first(name) if rule != "robust" else self._robust(name)
            elif name in matter:
                start[i] = self._start_of_missing(name, rule)
        return start

    def _start_of_missing(self, name: str, rule: str | Mapping[str, float]) -> float:
        coordinate = name.removesuffix("_dot")
        if rule == "robust" and self.model.kinematics is None and coordinate in self.present:
            return self._line(coordinate, _ROWS_FOR_SLOPE)[1]
        raise LogError(
            f'{self.log.source}: a simulation needs the initial value of "{name}", which the log lacks; pass '
            f"--differentiate, or give initial_state = {{{name} = ...}}"
        )

    def _first(self, name: str) -> float:
        column = self.column(name)
        return float(column[np.flatnonzero(np.isfinite(column))[0]])

    def _robust(self, name: str) -> float:
        """The first sample, unless it is far from the line through the first few: then the line's value at row 0."""
        column = self.column(name)
        rows = np.flatnonzero(np.isfinite(column))[:_ROWS_FOR_VALUE]
        value, slope = self._line(name, _ROWS_FOR_VALUE)
        distances = np.abs(column[rows] - value - slope * rows * self.log.dt)
        return float(column[rows[0]]) if distances[0] <= _FAR * np.median(distances) else value

    def _line(self, name: str, n_rows: int) -> tuple[float, float]:
        """Value and slope at row 0 of the line through a signal's first samples, by Theil and Sen."""
        from scipy.stats import theilslopes

        column = self.column(name)
        rows = np.flatnonzero(np.isfinite(column))[:n_rows]
        slope, intercept, *_ = theilslopes(column[rows], rows * self.log.dt)
        return float(intercept), float(slope)


def as_logs(logs: Log | Iterable[Log]) -> tuple[Log, ...]:
    """One log, or a sequence of logs, as a tuple.

    Raises
    ------
    SettingsError
        It is something else, or empty.
    """
    several = (logs,) if isinstance(logs, Log) or not isinstance(logs, Iterable) else tuple(logs)
    for one in several:
        if not isinstance(one, Log):
            raise SettingsError(f"log is a {type(one).__name__}; give a dr.Log, such as dr.read_log(path), or several")
    if not several:
        raise SettingsError("there is no log; give one dr.Log or several")
    return several


@dataclass(frozen=True)
class Dataset:
    """Logs bound to a model: segments that are never tied across a boundary; made by `Dataset.of`.

    Parameters
    ----------
    model : what is identified
    given : logs as the user gave them
    segments : one per log, in the same order; all have the same ``signals``
    layout : where each log's parameters stand in the vector of all parameters
    """

    model: Model
    given: tuple[Log, ...]
    segments: tuple[Segment, ...]
    layout: ParameterLayout

    @classmethod
    def of(
        cls,
        model: Model,
        logs: Log | Iterable[Log],
        also: Sequence[str] = (),
        *,
        pointwise: bool = True,
        given: Sequence[Log] | None = None,
    ) -> Dataset:
        """The dataset of one log or several.

        Parameters
        ----------
        also : signals that are in use beside those that the equations name (weights, thresholds)
        pointwise : whether the equations are evaluated at each row, which needs every signal that they name
        given : the logs as the user gave them, where ``logs`` were derived from them

        Raises
        ------
        LogError
            As `bind_log`, naming the log.
        """
        several = as_logs(logs)
        segments = [bind_log(model, log, also, pointwise=pointwise) for log in several]
        found = {name for one in segments for name in one.signals}
        signals = tuple(name for name in model.signals if name in found)
        layout = ParameterLayout(model.parameters, len(several))
        return cls(
            model, several if given is None else tuple(given), tuple(_widened(x, signals) for x in segments), layout
        )

    def __len__(self) -> int:
        """Rows of all segments."""
        return sum(map(len, self.segments))

    @property
    def n_rows(self) -> int:
        """Rows that count."""
        return sum(one.n_rows for one in self.segments)

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals of the model that at least one log has, in the model's order."""
        return self.segments[0].signals

    @property
    def source(self) -> str:
        """How messages name the logs."""
        return ", ".join(dict.fromkeys(one.source for one in self.given))

    @cached_property
    def common_signals(self) -> tuple[str, ...]:
        """Signals of the model that every log has."""
        return tuple(n for n in self.signals if all(n in one.present for one in self.segments))

    @property
    def dt(self) -> float:
        """Sampling time of all logs, s.

        Raises
        ------
        LogError
            Logs are sampled at different rates.
        """
        steps = [one.log.dt for one in self.segments]
        for one in self.segments:
            if abs(one.log.dt - steps[0]) > _SAME_RATE * steps[0]:
                raise LogError(
                    f"{self.segments[0].log.source} is sampled at {1.0 / steps[0]:.6g} Hz, {one.log.source} at "
                    f"{1.0 / one.log.dt:.6g} Hz; resample them to one rate (--resample)"
                )
        return float(np.mean(steps)) if len(steps) > 1 else steps[0]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was found and done, a sentence each; with the log's name where there are several."""
        if len(self.segments) == 1:
            return self.segments[0].notes
        return tuple(f"{one.log.source}: {note}" for one in self.segments for note in one.notes)

    @cached_property
    def scales(self) -> dict[str, float]:
        """Spread of each measured signal over the rows that count, in its unit; 0 where it is constant."""
        values = np.concatenate([one.measured[one.valid] for one in self.segments])
        return {n: _spread(values[:, i]) for i, n in enumerate(self.signals)}

    def by_signal(self, values: Mapping[str, float]) -> FloatArray:
        """Values ``(n_s,)`` in the signals' order, 0 for what is not named.

        Raises
        ------
        SettingsError
            A name that the model or the logs do not have.
        """
        for name, value in values.items():
            if name not in self.model.signals:
                known = ", ".join(self.model.signals)
                raise SettingsError(f'model "{self.model.name}" has no signal "{name}"; it has {known}')
            if value > 0.0 and name not in self.common_signals:
                lacking = next(one.log.source for one in self.segments if name not in one.present)
                raise SettingsError(f'{lacking}: a setting names "{name}", which the log lacks; leave it out')
        return np.array([values.get(name, 0.0) for name in self.signals])

    def subset(self, logs: Sequence[int]) -> Dataset:
        """The dataset of some of the logs."""
        segments = tuple(self.segments[i] for i in logs)
        found = {n for one in segments for n in one.present}
        signals = tuple(n for n in self.signals if n in found)
        narrowed = tuple(_widened(one, signals) for one in segments)
        given = tuple(self.given[i] for i in logs)
        return replace(self, given=given, segments=narrowed, layout=ParameterLayout(self.model.parameters, len(logs)))

    def on_given_logs(self, masks: Sequence[BoolArray]) -> BoolArray:
        """Masks over the segments' rows as one over the rows of the logs that the user gave, log after log."""
        whole = []
        for one, log, mask in zip(self.segments, self.given, masks, strict=True):
            begin = one.log.time[one.offset]
            first = round(float(begin - log.time[0]) / log.dt)
            rows = np.zeros(len(log), dtype=bool)
            rows[first : first + len(mask)] = mask
            whole.append(rows)
        return np.concatenate(whole)


def _widened(segment: Segment, signals: tuple[str, ...]) -> Segment:
    """The segment with exactly these signals, NaN where its log has none."""
    if segment.signals == signals:
        return segment
    measured = np.full((len(segment), len(signals)), np.nan)
    for i, name in enumerate(signals):
        if name in segment.signals:
            measured[:, i] = segment.column(name)
    return replace(segment, signals=signals, measured=measured)


def bind_log(model: Model, log: Log, also: Sequence[str] = (), *, pointwise: bool = True) -> Segment:
    """The arrays of ``model`` over ``log``; arguments as in `Dataset.of`.

    Raises
    ------
    LogError
        A signal is missing, all NaN, infinite, too large to square, or in another unit; too few rows.
    """
    needed = model.required_signals if pointwise else tuple(model.inputs)
    for name in needed:
        if name not in log:
            _raise_missing(model, log, name)
    signals = tuple(n for n in model.signals if n in log)
    if not signals:
        _raise_missing(model, log, model.signals[0])
    used = [n for n in (*signals, *model.inputs) if n in log]
    log.check(used)
    _check_units(model, log, used)
    log = preprocessing.unwrap(log, [n for n in model.coordinates if n in log and model.coordinates[n] == "rad"])
    inputs, held = _held_inputs(model, log)
    measured = np.column_stack([log[n] for n in signals])
    critical = [i for i, n in enumerate(signals) if n in needed or n in also]
    valid = np.all(np.isfinite(np.hstack([measured[:, critical], inputs])), axis=1)
    if not valid.any():
        raise LogError(
            f"{log.source}: no row has a value in every signal in use ({', '.join(used)}); found NaN in each"
        )
    offset = int(np.argmax(valid))
    notes = [*log.notes, *_row_notes(log, valid, held)]
    return Segment(model, log, offset, signals, measured[offset:], inputs[offset:], valid[offset:], tuple(notes))


def _raise_missing(model: Model, log: Log, name: str) -> None:
    derivable = name in model.velocities or name in model.accelerations
    hint = (
        "pass --differentiate to estimate velocities and accelerations" if derivable else "name its column with --map"
    )
    if name in log.unusable:
        raise LogError(f'{log.source}: signal "{name}" {log.unusable[name]}; mend the column, or {hint}')
    found = ", ".join(("t", *log.names))
    raise LogError(f'{log.source}: signal "{name}" is missing; found {found}. Give it, or {hint}.')


def _check_units(model: Model, log: Log, names: Sequence[str]) -> None:
    for name in names:
        found, wanted = log.units.get(name), model.units[name]
        if found is None or same_unit(found, wanted):
            continue
        factor = conversion(found, wanted)
        hint = f"pass --scale {name}={factor:.6g}" if factor is not None else "check the column"
        raise LogError(f'{log.source}: signal "{name}" is in {found}, the model needs {wanted}; {hint}')


def _held_inputs(model: Model, log: Log) -> tuple[FloatArray, BoolArray]:
    """Inputs ``(N, n_u)`` with NaN held from the last good sample, and in which rows (N,) one was."""
    held = np.zeros(len(log), dtype=bool)
    columns = []
    for name in model.inputs:
        column = log[name] if name in log else np.zeros(len(log))
        good = np.isfinite(column)
        last = np.maximum.accumulate(np.where(good, np.arange(len(column)), -1))
        held |= ~good & (last >= 0)
        columns.append(np.where(last >= 0, column[last], np.nan))
    return np.column_stack(columns) if columns else np.zeros((len(log), 0)), held


def _row_notes(log: Log, valid: BoolArray, held: BoolArray) -> list[str]:
    notes = []
    skipped = int((~valid).sum())
    if skipped:
        notes.append(f"{skipped} of {len(valid)} rows were skipped: a signal in use is NaN there")
    if held.any():
        notes.append(f"inputs were held from the last good sample in {held.sum()} rows, where they are NaN")
    return [*notes, *_gap_notes(log, held)]


def _gap_notes(log: Log, held: BoolArray) -> list[str]:
    """That inputs were held for too long to believe a simulation from there on, where they were."""
    edges = np.flatnonzero(np.diff(np.r_[False, held, False]))
    first, length = edges[::2], edges[1::2] - edges[::2]
    n_gaps = int((length >= _LONG_HOLD).sum())
    if not n_gaps:
        return []
    longest = int(length.argmax())
    return [
        f"inputs are unknown in {n_gaps} gap{'s' * (n_gaps > 1)}, the longest {(length[longest] + 1) * log.dt:.4g} s "
        f"after t = {log.time[first[longest] - 1]:.6g} s: a simulation through it drifts, which fit error and "
        "inliers count; a log cut there is scored without it"
    ]


def _spread(values: FloatArray) -> float:
    """Standard deviation by the MAD; where half the samples rest at one value, by the central 80 %."""
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return 0.0
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9])
    mad = 1.4826 * float(np.median(np.abs(values - median)))
    wide = float(high - low) / 2.563
    if mad > 1e-2 * wide > 0.0:
        return mad
    spread = wide if wide > 0.0 else float(values.std())
    return spread if spread > 1e-12 * float(np.abs(values).max(initial=0.0)) else 0.0
