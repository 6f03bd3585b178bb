"""A start from the first seconds of a stream, by the default method, in a thread of its own."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.data.log import Log
from diransac.errors import DiransacError
from diransac.identification.identify import identify
from diransac.identification.methods.lo_diransac import LoDiransac
from diransac.identification.tracking.starting import Start

if TYPE_CHECKING:
    from diransac.identification.result import Result
    from diransac.identification.tracking.setup import Setup
    from diransac.identification.tracking.stream import Stream

__all__ = ["ColdStart", "Found"]


@dataclass(frozen=True)
class Found:
    """A start that was found, the timing of its inputs, and what is to be said."""

    setup: Setup
    start: Start
    notes: tuple[str, ...]


class ColdStart:
    """Identification of the rows that a stream holds: of one window, then of twice as many, a window apart at least.

    Parameters
    ----------
    setup : Setup
    seed : int
    window : float
        Time from which on the first rows are identified, s.
    background : bool
        Whether `sought` returns while an identification runs.

    Attributes
    ----------
    refused : str
        Why there is no start yet.
    """

    def __init__(self, setup: Setup, seed: int, window: float, *, background: bool) -> None:
        self.setup, self.seed, self.window, self.background = setup, seed, window, background
        self._running: Future[Result] | None = None
        self._needed, self._not_before = window, 0
        self.refused = f"there are fewer than {window:g} s of rows"

    def restart(self) -> None:
        """Begin again with the rows of one window."""
        self._running, self._needed = None, self.window

    def sought(self, stream: Stream, end: int) -> Found | None:
        """The start, once there is one that is usable.

        Parameters
        ----------
        stream : Stream
        end : int
            Row after the newest one.
        """
        first = max(stream.first, stream.fresh)
        enough = (end - first) * stream.dt >= self._needed and end >= self._not_before
        if self._running is None and enough:
            self._not_before = end + round(self.window / stream.dt)
            self._running = self._identified(stream, first, end)
        if self._running is None or (self.background and not self._running.done()):
            return None
        running, self._running = self._running, None
        seconds = f"an identification of {self._needed:.3g} s"
        try:
            result = running.result()
            self.refused = f'{seconds} says "{result.verdict}"'
        except DiransacError as error:
            self.refused = f"{seconds} fails: {error}"
            result = None
        if result is None or result.verdict == "do not rely on this":
            self._needed = min(2.0 * self._needed, len(stream.values) * stream.dt - self.window)
            return None
        resolution = result.estimate.resolution
        setup = replace(self.setup, timing=resolution.timing, exact=result.estimate.competition is None)
        said = f"identified from the first {self._needed:.3g} s ({result.verdict})"
        start = Start(np.array(list(result.parameters.values())), holds=(resolution.hold,))
        return Found(setup, start, (said,))

    def _identified(self, stream: Stream, first: int, end: int) -> Future[Result]:
        """The identification of some rows, which runs."""
        rows = stream.values[first - stream.first : end - stream.first]
        names = (*self.setup.model.signals, *self.setup.model.inputs)
        columns = {n: x.copy() for n, x in zip(names, rows.T, strict=True) if np.isfinite(x).any()}
        log = Log.from_arrays(stream.time(first) + stream.dt * np.arange(len(rows)), columns, source="the stream")
        method = LoDiransac(suggestions=False)
        if self.background:
            pool = ThreadPoolExecutor(1, thread_name_prefix="identification")
            running = pool.submit(identify, self.setup.model, log, method, seed=self.seed)
            pool.shutdown(wait=False)
            return running
        done: Future[Result] = Future()
        try:
            done.set_result(identify(self.setup.model, log, method, seed=self.seed))
        except DiransacError as error:
            done.set_exception(error)
        return done
