"""Samples of a stream on the uniform grid of its clock, in arrays of fixed size.

Rows are numbered by the grid: the sample of a row is the nearest one to its stamp.  A late sample goes to its own row
as long as that is held, and a repeated one fills what is missing of it.  Several stamps in a row that are far from
those before are a gap, or a clock that restarts: the rows that follow are the beginning of a new stretch, which starts
with an interval of its own.  A single such stamp is an error of the clock, and is left out.
`SensorWatch` finds sensors that stop, and that return.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import LogError

if TYPE_CHECKING:
    from diransac.identification.tracking.window import Window
    from diransac.model import Model

_FEWEST_SILENT = 8
"""Rows without a stamp from which on a new stretch may begin: as `data.segment.silent_rows`."""

Row = tuple[float, FloatArray]


@dataclass
class Stream:
    """Rows of a window, and those that wait for an interval.

    Parameters
    ----------
    n_columns, n_inputs : int
        Number of columns, the last of which are inputs.
    step : float
        Time between estimates, s.
    duration : float
        Time over which rows are held, s.
    parts : int, optional
        Intervals of a step.

    Attributes
    ----------
    dt : float
        Sampling time, s; 0 until it is known.
    length : int
        Rows of a step.
    values : (n, n_columns) array
        The rows that are held, NaN where nothing is measured; row ``first`` of the stream is the first of them.
    ended : (n,) bool array
        Rows that no simulation passes through: the last ones of each stretch.
    first, newest : int
        Number of the first row that is held, and of the newest one.
    fresh : int
        Number of the first row of the present stretch.
    lag : int
        Rows by which inputs come late, a step at most: an interval is complete when they are there.
    """

    n_columns: int
    n_inputs: int
    step: float
    duration: float
    parts: int = 1
    dt: float = 0.0
    length: int = 0
    values: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    ended: BoolArray = field(default_factory=lambda: np.zeros(0, bool))
    first: int = 0
    newest: int = -1
    fresh: int = 0
    lag: int = 0
    _origin: float = 0.0
    # Stamps from which the interval of the grid is measured first.
    _n_rows: int = 25
    _early: list[Row] = field(default_factory=list)
    _suspects: list[Row] = field(default_factory=list)
    _notes: list[str] = field(default_factory=list)

    def feed(self, time: FloatArray, values: FloatArray) -> Iterator[int]:
        """Take rows in the order in which they come, and yield the row after the last complete one at each new row.

        Parameters
        ----------
        time : (n,) array
            Stamps, s.
        values : (n, n_columns) array
            NaN where nothing is measured.

        Raises
        ------
        LogError
            The stream is too slow for the step.
        """
        for t, row in zip(time.tolist(), values, strict=True):
            for stamp, cells in self._begun(t, row) if not self.dt else [(t, row)]:
                before = self.newest
                self._take(stamp, cells)
                if self.newest > before:
                    yield self.newest + 1 - self.lag

    def time(self, row: int) -> float:
        """Time of a row of the present stretch, s."""
        return self._origin + row * self.dt

    def taken_notes(self) -> list[str]:
        """Findings since the last call, a sentence each."""
        notes, self._notes = self._notes, []
        return notes

    def drop(self, n: int) -> None:
        """Forget the first ``n`` rows."""
        self.values[:-n], self.values[-n:] = self.values[n:].copy(), np.nan
        self.ended[:-n], self.ended[-n:] = self.ended[n:].copy(), False
        self.first += n

    # ------------------------------------------------------------------ the grid

    def _begun(self, t: float, row: FloatArray) -> list[Row]:
        """The first rows once the grid is known; none before."""
        self._early.append((t, row.copy()))
        if len(self._early) > 1000:
            raise LogError(f"the time of the stream stands still at t = {t:.6g} s; give the time of each sample")
        stamps = np.unique([t for t, _ in self._early])
        if len(stamps) < self._n_rows:
            return []
        apart = np.diff(stamps)
        n_rows = np.round(apart / np.median(apart)).clip(1.0)
        usual = n_rows < _FEWEST_SILENT  # a gap, or a clock that restarts, is no part of it
        self.dt, self._origin = float(apart[usual].sum() / n_rows[usual].sum()), self._early[0][0]
        self.length = self.parts * round(self.step / (self.parts * self.dt))
        if self.length < 2 * self.parts:
            raise LogError(
                f"the stream has a sample every {self.dt:.3g} s, which is too slow for a step of {self.step:g} s; "
                f"give a step of at least {2.0 * self.dt:.3g} s"
            )
        n = (round(self.duration / self.dt) // self.length + 2) * self.length
        self.values, self.ended = np.full((n, self.n_columns), np.nan), np.zeros(n, bool)
        early, self._early = self._early, []
        return early

    @property
    def silence(self) -> int:
        """Rows without a stamp from which on a new stretch begins."""
        return max(_FEWEST_SILENT, round(0.25 / self.dt))

    def _take(self, t: float, cells: FloatArray) -> None:
        """Write a row to its place, or suspect its stamp."""
        place = (t - self._origin) / self.dt
        row = round(place) if abs(place) < 1e15 else -1
        if not max(self.first, self.fresh) <= row <= self.newest + self.silence or self._repeats(row, cells):
            self._suspect(t, cells)
            return
        self._suspects.clear()
        if row > self.newest:
            self._follow(row, place - row)
        elif np.isfinite(cells[-self.n_inputs :]).any():
            self.lag = max(self.lag, min(self.newest - row, self.length))
        self._write(row, cells)

    def _follow(self, row: int, late: float) -> None:
        """Move the grid by a stamp that is late by a part of a row: recursive least squares of a line."""
        # Beyond 400 rows the line forgets older ones.
        self._n_rows = min(self._n_rows + 1, 400)
        n = self._n_rows
        change = 6.0 / (n * (n + 1)) * late * self.dt
        self._origin += (4 * n - 2) / (n * (n + 1)) * late * self.dt - change * row
        self.dt += change

    def _repeats(self, row: int, cells: FloatArray) -> bool:
        """True for a row from before the newest one that is known already, as after a clock that restarts."""
        return row < self.newest - 1 and bool((np.isnan(cells) | np.isfinite(self.values[row - self.first])).all())

    def _write(self, row: int, cells: FloatArray) -> None:
        """Fill what is missing of a row, which may lie beyond the rows that are held."""
        beyond = row - self.first - len(self.values) + 1
        if beyond > 0:
            self.drop(-(-beyond // self.length) * self.length)
        own = self.values[row - self.first]
        np.copyto(own, cells, where=np.isnan(own))
        self.newest = max(self.newest, row)

    # ------------------------------------------------------------------ jumps of the clock

    def _suspect(self, t: float, cells: FloatArray) -> None:
        """Keep a row whose stamp is far from those before; several that follow one another are a new stretch."""
        if self._suspects and not 0.0 <= t - self._suspects[-1][0] < self.silence * self.dt:
            self._suspects.clear()
        self._suspects.append((t, cells.copy()))
        # One or two such stamps in a row are errors of the clock.
        if len({stamp for stamp, _ in self._suspects}) == 3:
            rows, self._suspects = self._suspects, []
            self._begin_stretch(rows[0][0])
            for stamp, row in rows:
                self._write(round((stamp - self._origin) / self.dt), row)

    def _begin_stretch(self, t: float) -> None:
        """Number the rows on from the next step, from a stamp on."""
        if self.newest >= 0:
            last = self.time(self.newest)
            self._notes.append(
                f"a gap of {t - last:.3g} s after t = {last:.6g} s"
                if t > last
                else f"the clock restarts at t = {t:.6g} s, after t = {last:.6g} s"
            )
            end = (self.newest // self.length + 1) * self.length
            self._write(end - 1, np.full(self.n_columns, np.nan))
            self.ended[self.newest - self.first] = True
        self.fresh = self.newest + 1
        self._origin = t - self.fresh * self.dt


class SensorWatch:
    """Findings on sensors and inputs of a stream that stop.

    Parameters
    ----------
    model : Model
    """

    def __init__(self, model: Model) -> None:
        self.names = (*model.signals, *model.inputs)
        self.last = np.full(len(self.names), -1)
        self.count = np.zeros(len(self.names))
        self.stopped = np.zeros(len(self.names), bool)
        self.began, self.seen = -1, -1

    def notes(self, stream: Stream, window: Window) -> list[str]:
        """Findings of the rows since the last call, a sentence each.

        Parameters
        ----------
        stream : Stream
        window : Window
        """
        first = max(self.seen, window.first)
        if first >= window.end:  # a window that has begun anew, with rows that were seen before
            return []
        if self.began < 0:
            self.began = first
        known = np.isfinite(stream.values[first - stream.first : window.end - stream.first])
        some = known.any(axis=0)
        newest = first + len(known) - 1 - np.argmax(known[::-1], axis=0)
        self.last, self.count = np.where(some, newest, self.last), self.count + known.sum(axis=0)
        self.seen = window.end
        usual = (window.end - self.began) / np.maximum(self.count, 1.0)
        # A sensor that loses samples at random is silent over ten of its usual intervals once in 22,000.
        silent = window.end - 1 - self.last > np.maximum(stream.silence, 10.0 * usual)
        stops = np.flatnonzero((self.count > 0) & silent & ~self.stopped)
        returns = np.flatnonzero(self.stopped & ~silent)
        self.stopped = (self.count > 0) & silent
        time = stream.time(window.end - 1)
        lost = [f"{self.names[k]} is not measured any more, at t = {time:.6g} s" for k in stops]
        return lost + [f"{self.names[k]} is measured again, at t = {time:.6g} s" for k in returns]
