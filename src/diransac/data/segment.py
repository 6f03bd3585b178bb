"""`Segment`: one log bound to a model, as arrays that every method reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, bulk_range, long_runs, runs
from diransac.data import preprocessing
from diransac.data.checks import other_spelling, rows_per_sample
from diransac.data.log import Log
from diransac.data.preprocessing.continuity import interpolated
from diransac.errors import LogError, check_known

if TYPE_CHECKING:
    from diransac.model import Model

_LONG_HOLD = 3
"""Rows that an input is held for, beyond which the motion is no longer the one that it made."""


@dataclass(frozen=True)
class Segment:
    """Arrays of one model over one log.

    Parameters
    ----------
    model : Model
    log : Log
        The log in the model's units, with continuous coordinates; see `preprocessing.in_units` and `continuous`.
    offset : int
        Row of the log that is row 0 of the arrays: the first that counts.
    signals : tuple of str
        Names of the n_s signals of the model that the dataset has, in the model's order.
    measured : (N, n_s) array
        Measured signals, each in its unit; NaN where missing.
    inputs : (N, n_u) array
        Inputs, each in its unit; NaN is replaced by the last good sample, in lost rows by interpolation.
    valid : (N,) bool array
        Rows in which every signal in use is finite, outside of gaps.
    notes : tuple of str
        Findings and changes, a sentence each.
    gaps : (N,) bool array
        Rows of gaps of several samples in an input, or of 0.25 s in all sensors: no simulation passes through them.
    """

    model: Model
    log: Log
    offset: int
    signals: tuple[str, ...]
    measured: FloatArray
    inputs: FloatArray
    valid: BoolArray
    notes: tuple[str, ...]
    gaps: BoolArray

    def __len__(self) -> int:
        return len(self.valid)

    @property
    def n_rows(self) -> int:
        """Rows that count."""
        return int(self.valid.sum())

    @cached_property
    def stretches(self) -> tuple[slice, ...]:
        """Rows from each gap to the next, from the first one that counts; the whole log where there is no gap."""
        parts = (x for x in runs(~self.gaps) if self.valid[x].any())
        return tuple(slice(x.start + int(np.argmax(self.valid[x])), x.stop) for x in parts)

    def part(self, rows: slice) -> Segment:
        """The segment of some of the rows alone; the segment itself if these are all."""
        if rows == slice(0, len(self)):
            return self
        arrays = {name: getattr(self, name)[rows] for name in ("measured", "inputs", "valid", "gaps")}
        return replace(self, offset=self.offset + rows.start, **arrays)

    def first_row_in(self, given: Log) -> int:
        """Row of the log as it was given that is row 0 here."""
        return round(float(self.log.time[self.offset] - given.time[0]) / given.dt)

    def column(self, name: str) -> FloatArray:
        """A measured signal (N,)."""
        return self.measured[:, self.signals.index(name)]

    @cached_property
    def present(self) -> tuple[str, ...]:
        """Signals of which this log has at least one sample."""
        some: BoolArray = np.asarray(np.isfinite(self.measured).any(axis=0))
        return tuple(n for n, x in zip(self.signals, some, strict=True) if x)

    @cached_property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """Smallest and largest value of the bulk of each signal; see `bulk_range`."""
        return tuple(bulk_range(x) for x in self.measured.T)

    def state_arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Coordinates ``(N, n_q)``, velocities and accelerations ``(N, n_v)``; 0 in what the log lacks."""
        full = np.zeros((len(self), len(self.model.signals)))
        for name in self.present:
            full[:, self.model.signals.index(name)] = self.column(name)
        n_q, n_v = self.model.n_q, self.model.n_v
        return full[:, :n_q], full[:, n_q : n_q + n_v], full[:, n_q + n_v : n_q + 2 * n_v]

    def sensor_samples(self) -> FloatArray:
        """Measured sensors ``(N, n_y)`` of the model; NaN where one, or a signal in it, is missing."""
        model, samples = self.model, np.full((len(self), len(self.model.sensors)), np.nan)
        for k, name in enumerate(model.sensors):
            needed = [name, *(n for n in model.sensor_arguments[name] if n in model.signals)]
            if set(needed) <= set(self.present):
                usable = np.all([np.isfinite(self.column(n)) for n in needed], axis=0)
                samples[usable, k] = self.column(name)[usable]
        return samples

    def acting_inputs(self) -> FloatArray:
        """Inputs ``(N, n_u)`` that belong to each row's accelerations; see `preprocessing.acting_inputs`."""
        return preprocessing.acting_inputs(self.log.filter, self.inputs)

    def initial_state(self, rule: str | Mapping[str, float]) -> FloatArray:
        """State ``(n_x,)`` at row 0 by a rule of ``Settings.initial_state``.

        A state that the log lacks and on which no measured signal depends starts at 0, a quaternion at (1, 0, 0, 0).

        Raises
        ------
        LogError
            A state is missing on which a measured signal depends.
        SettingsError
            The rule names an unknown state.
        """
        given = rule if isinstance(rule, Mapping) else {}
        check_known(given, self.model.state, "initial_state names", "the state is")
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
            return self._line(coordinate, 25)[1]
        raise LogError(
            f'{self.log.source}: a simulation needs the initial value of "{name}", which the log lacks; give '
            f"initial_state = {{{name} = ...}}"
        )

    def _first(self, name: str) -> float:
        column = self.column(name)
        return float(column[np.flatnonzero(np.isfinite(column))[0]])

    def _robust(self, name: str) -> float:
        """The first sample, unless it is far from the line through the first few: then the line's value at row 0.

        A line through seven samples bears two outliers, and is short against any motion that is sampled well.
        """
        column = self.column(name)
        rows = np.flatnonzero(np.isfinite(column))[:7]
        value, slope = self._line(name, 7)
        distances = np.abs(column[rows] - value - slope * rows * self.log.dt)
        return float(column[rows[0]]) if distances[0] <= 5.0 * np.median(distances) else value

    def _line(self, name: str, n_rows: int) -> tuple[float, float]:
        """Value and slope at row 0 of the line through a signal's first samples, by Theil and Sen."""
        column = self.column(name)
        rows = np.flatnonzero(np.isfinite(column))[:n_rows]
        y, t = column[rows], rows * self.log.dt
        if len(rows) < 2:
            return float(y[0]), 0.0
        i, j = np.triu_indices(len(rows), 1)
        slope = float(np.median((y[j] - y[i]) / (t[j] - t[i])))
        return float(np.median(y) - slope * np.median(t)), slope

    def with_signals(self, signals: tuple[str, ...]) -> Segment:
        """The segment with exactly these signals, NaN where its log has none."""
        if self.signals == signals:
            return self
        measured = np.full((len(self), len(signals)), np.nan)
        for i, name in enumerate(signals):
            if name in self.signals:
                measured[:, i] = self.column(name)
        return replace(self, signals=signals, measured=measured)


def bind_log(model: Model, log: Log, also: Sequence[str] = (), *, pointwise: bool = True) -> Segment:
    """Segment of ``log`` under ``model``.

    Parameters
    ----------
    model : Model
    log : Log
    also : sequence of str, optional
        Signals in use besides those that the equations name.
    pointwise : bool, optional
        Whether the equations are evaluated at each row, which needs every signal that they name.

    Returns
    -------
    Segment

    Raises
    ------
    LogError
        A signal is missing, all NaN, infinite, too large to square, or of another dimension; too few rows; a coordinate
        is missing that a column may be in another spelling, and is not said to be unmeasured.
    """
    needed = model.required_signals if pointwise else tuple(model.inputs)
    for name in needed:
        if name not in log:
            _raise_missing(model, log, name)
    signals = tuple(n for n in model.signals if n in log)
    if not signals:
        _raise_missing(model, log, model.signals[0])
    _check_spelling(model, log)
    used = [n for n in (*signals, *model.inputs) if n in log]
    log.check(used)
    log = preprocessing.continuous(preprocessing.in_units(log, model), model)
    inputs, missing, lost = _known_inputs(model, log)
    measured = np.column_stack([log[n] for n in signals])
    gaps = long_runs(missing, _LONG_HOLD) | silent_rows(np.isfinite(measured), log.dt)
    critical = [i for i, n in enumerate(signals) if n in needed or n in also]
    known = np.isfinite(measured[:, critical])
    is_sensor = np.array([signals[i] in model.sensors for i in critical], bool)
    valid = _complete(known, is_sensor, pointwise) & np.isfinite(inputs).all(axis=1) & ~gaps
    if not valid.any():
        raise LogError(
            f"{log.source}: no row has a value in every signal in use ({', '.join(used)}); found NaN in each"
            f"{_slow_signals(log, used)}"
        )
    offset = int(np.argmax(valid))
    notes = (
        *log.notes,
        *_unmeasured_notes(model, log, signals),
        *spelling_notes(model, log, [n for n in model.signals if n not in model.coordinates]),
        *_row_notes(valid, missing & ~gaps & ~lost, lost & ~gaps, sampled=known.any(axis=1) | gaps),
        *_gap_notes(log, gaps, offset),
    )
    return Segment(
        model, log, offset, signals, measured[offset:], inputs[offset:], valid[offset:], notes, gaps[offset:]
    )


def _complete(known: BoolArray, is_sensor: BoolArray, pointwise: bool) -> BoolArray:
    """Rows ``(N,)`` that count, of samples ``(N, n)`` that are known.

    Sensors are compared where they have a sample.  Without equations at each row, so are slow signals, which have
    samples in fewer than half of the rows.  A row without a sample of any signal does not count.
    """
    slow = is_sensor if pointwise else is_sensor | (known.mean(axis=0) < 0.5)
    if not slow.any():
        return np.asarray(known.all(axis=1))
    return np.asarray(known.any(axis=1) & (known | slow).all(axis=1))


def _slow_signals(log: Log, names: Sequence[str]) -> str:
    """Clause that names the signals that are sampled less often than the log, with their rates; empty without any."""
    apart = {n: rows_per_sample(np.isfinite(log[n])) for n in names}
    slow = [f'"{n}" is sampled at {1.0 / (x * log.dt):.4g} Hz' for n, x in apart.items() if x > 1]
    if not slow:
        return ""
    return f": {', '.join(slow)}, the log at {1.0 / log.dt:.4g} Hz; use lo-diransac, which needs no complete rows"


def silent_rows(known: BoolArray, dt: float) -> BoolArray:
    """Rows of gaps in all sensors: 0.25 s, eight rows and four usual intervals or more without a sample.

    Parameters
    ----------
    known : (N, n_s) bool array
        Samples that there are.
    dt : float
        Sampling time, s.

    Returns
    -------
    (N,) bool array
    """
    some: BoolArray = np.asarray(known.any(axis=1))
    usual = np.median(np.diff(np.flatnonzero(some))) if some.sum() > 1 else 1.0
    return long_runs(~some, max(8, round(0.25 / dt), round(4 * usual)))


def _raise_missing(model: Model, log: Log, name: str) -> None:
    hint = "name its column with --map"
    if name in model.first_order:
        hint = "estimate it by lo-diransac, of all methods the only one that can"
    elif name in model.velocities or name in model.accelerations:
        hint = "pass --differentiate to estimate velocities and accelerations, or use lo-diransac, which needs none"
    if name in log.unusable:
        raise LogError(f'{log.source}: signal "{name}" {log.unusable[name]}; correct the column, or {hint}')
    absent = dict.fromkeys(n for n in (name, *model.inputs, *model.coordinates) if n not in log)
    pairs = [f"{n}={near}" for n in absent if (near := other_spelling(n, log.names, model)) is not None]
    found, also = ", ".join(("t", *log.names)), f"; by their names, --map {','.join(pairs)}" if pairs else ""
    also += f"; {drive}" if (drive := other_drive(model, log)) else ""
    raise LogError(f'{log.source}: signal "{name}" is missing; found {found}. Give it, or {hint}{also}.')


_DRIVES = {
    "_target": "--control kp=NUMBER,kd=NUMBER (dr.PositionControl)",
    "_current": "--motor constant=NUMBER,gear=NUMBER (dr.MotorCurrents)",
    "_torque": "dr.JointTorques, the default: leave out --control and --motor",
}
"""Drive of a robot's joint by the ending of its column in the log."""


def other_drive(model: Model, log: Log) -> str:
    """Advice where a log lacks the columns of a robot's drives, and has those of another kind; empty elsewhere."""
    missing = [n for n in model.inputs if n not in log]
    joints = [q for q in model.coordinates for end in _DRIVES if f"{q}{end}" in missing]
    found = [(f"{q}{end}", option) for q in joints for end, option in _DRIVES.items() if f"{q}{end}" in log]
    return "" if not found else f'"{found[0][0]}" is the column of another drive: {found[0][1]}'


def _check_spelling(model: Model, log: Log) -> None:
    """Raise LogError for a coordinate that the log seems to have under another spelling, and that may be unmeasured."""
    steps = [step.get("signals") for step in log.history if step.get("step") == "unmeasured"]
    stated = [name for names in steps if isinstance(names, list) for name in names]
    for name in model.coordinates:
        near = None if name in log or name in stated else other_spelling(name, log.names, model)
        if near is not None:
            raise LogError(
                f'{log.source}: "{name}" is not in it, but "{near}" is, which the model has not. If it is the same, '
                f"pass --map {name}={near}; if {name} is unmeasured, pass --unmeasured {name}, or leave the column out"
            )


def spelling_notes(model: Model, log: Log, names: Sequence[str]) -> list[str]:
    """Notes on signals and inputs of these names that the log lacks, and seems to have under another spelling."""
    found = {name: other_spelling(name, log.names, model) for name in names if name not in log}
    return [f'"{near}" is not used; if it is {name}, pass --map {name}={near}' for name, near in found.items() if near]


def _known_inputs(model: Model, log: Log) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Inputs ``(N, n_u)`` without NaN, and in which rows (N,) one was missing, and one was interpolated.

    A missing input is held from the last good sample.  In a few lost rows, in which nothing has a sample, it is
    interpolated instead: there it is the log that lacks a sample, not the input that has none.
    """
    some = [np.isfinite(log[n]) for n in (*model.signals, *model.inputs) if n in log]
    absent: BoolArray = ~np.any(some, axis=0)
    lost = absent & ~long_runs(absent, _LONG_HOLD)
    missing, rows = np.zeros(len(log), dtype=bool), np.arange(len(log))
    columns = []
    for name in model.inputs:
        column = log[name] if name in log else np.zeros(len(log))
        good = np.isfinite(column)
        last = np.maximum.accumulate(np.where(good, rows, -1))
        missing |= ~good & (last >= 0)
        column = np.where(last >= 0, column[last], np.nan)
        between = rows[lost & ~good & (last >= 0)]
        known = rows[good]
        if len(between) and len(known) > 1:
            left = np.clip(np.searchsorted(known, between) - 1, 0, len(known) - 2)
            weight = np.minimum((between - known[left]) / np.diff(known)[left], 1.0)
            column[between] = interpolated({name: column[known]}, left, weight)[name]
        columns.append(column)
    return np.column_stack(columns) if columns else np.zeros((len(log), 0)), missing, missing & lost


def _unmeasured_notes(model: Model, log: Log, signals: Sequence[str]) -> list[str]:
    """A note on coordinates that act on what is measured, and that the log lacks; none where it has all."""
    absent = [n for n in model.coordinates if n not in log]
    acting = absent and set(model.states_behind(signals))
    hidden = [f'"{n}"' for n in absent if n in acting]
    are = "is not in the log, and counts" if len(hidden) == 1 else "are not in the log, and count"
    return [f"{', '.join(hidden)} {are} as unmeasured; found {', '.join(('t', *log.names))}"] if hidden else []


def _row_notes(valid: BoolArray, held: BoolArray, lost: BoolArray, sampled: BoolArray) -> list[str]:
    notes = []
    skipped = int((~valid & sampled).sum())
    if skipped:
        notes.append(f"{skipped} of {len(valid)} rows were skipped: a signal in use is NaN there")
    if held.any():
        notes.append(f"inputs were held from the last good sample in {held.sum()} rows, where they are NaN")
    if lost.any():
        notes.append(f"inputs were interpolated in {lost.sum()} lost rows")
    return notes


def _gap_notes(log: Log, gaps: BoolArray, first_row: int) -> list[str]:
    """A note on the gaps between rows that count; none without gaps."""
    found = [rows for rows in runs(gaps) if rows.start > first_row]
    if not found:
        return []
    longest = max(found, key=lambda rows: rows.stop - rows.start)
    seconds = (longest.stop - longest.start + 1) * log.dt
    return [
        f"inputs or all sensors are unknown in {len(found)} gap{'s' * (len(found) > 1)}, the longest {seconds:.4g} s "
        f"after t = {log.time[longest.start - 1]:.6g} s: simulations end there and begin again after it"
    ]
