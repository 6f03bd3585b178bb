"""Sensors that stop while a machine runs, and that return."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from diransac.identification.tracking.setup import Setup
    from diransac.identification.tracking.stream import Stream
    from diransac.identification.tracking.window import Window

__all__ = ["SensorWatch"]

# Usual intervals between samples after which a sensor without one has stopped: one in 22,000 of a sensor that loses
# samples at random.
_USUAL_INTERVALS = 10.0


class SensorWatch:
    """Findings on sensors and inputs of a stream that stop.

    Parameters
    ----------
    setup : Setup
    """

    def __init__(self, setup: Setup) -> None:
        self.names = (*setup.model.signals, *setup.model.inputs)
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
        if self.began < 0:
            self.began = first
        known = np.isfinite(stream.values[first - stream.first : window.end - stream.first])
        some = known.any(axis=0)
        newest = first + len(known) - 1 - np.argmax(known[::-1], axis=0)
        self.last, self.count = np.where(some, newest, self.last), self.count + known.sum(axis=0)
        self.seen = window.end
        usual = (window.end - self.began) / np.maximum(self.count, 1.0)
        silent = window.end - 1 - self.last > np.maximum(stream.silence, _USUAL_INTERVALS * usual)
        stops = np.flatnonzero((self.count > 0) & silent & ~self.stopped)
        returns = np.flatnonzero(self.stopped & ~silent)
        self.stopped = (self.count > 0) & silent
        time = stream.time(window.end - 1)
        lost = [f"{self.names[k]} is not measured any more, at t = {time:.6g} s" for k in stops]
        return lost + [f"{self.names[k]} is measured again, at t = {time:.6g} s" for k in returns]
