"""The problem that a tracker solves: a model, its intervals, and how they are cut from the rows of a stream."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.input_timing import InputTiming
from diransac.data.segment import long_runs
from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

if TYPE_CHECKING:
    from diransac.data.dataset import ParameterLayout
    from diransac.identification.tracking.stream import Stream
    from diransac.model import Model

__all__ = ["Setup"]

# Rows without an input from which on no simulation passes through them; as `data.segment.bind_log`.
_LONG_HOLD = 3


@dataclass(frozen=True)
class Setup:
    """Model, settings and timing of a tracker.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Of one log.
    hold : str, optional
        Inputs between samples, one of `HOLDS`.
    timing : InputTiming, optional
        Delay and lag after which recorded inputs act.
    settings : LoDiransacSettings, optional
        Of the joint fit.
    exact : bool, optional
        Whether an identification has predicted its logs within their noise.
    """

    model: Model
    layout: ParameterLayout
    hold: str = "zero-order"
    timing: InputTiming = field(default_factory=InputTiming)
    settings: LoDiransacSettings = field(default_factory=LoDiransacSettings)
    exact: bool = False

    @property
    def n_signals(self) -> int:
        """Number of the columns of a stream that are signals; the others are inputs."""
        return len(self.model.signals)

    def intervals(self, stream: Stream, first: int, n: int) -> ShootingIntervals:
        """Intervals of a stream.

        Parameters
        ----------
        stream : Stream
        first : int
            Row of the stream with which they begin.
        n : int
            Number of intervals.

        Returns
        -------
        ShootingIntervals
        """
        length = stream.length // stream.parts
        held = stream.values[: first - stream.first + n * length]
        rows = slice(first - stream.first, len(held))
        measured = held[rows, : self.n_signals]
        known = np.isfinite(measured)
        missing = np.asarray(np.isnan(held[:, self.n_signals :]).any(axis=1))
        inputs = _interpolated(held[:, self.n_signals :])
        acting = self.timing.acting(inputs, stream.dt, self.hold)[rows]
        return ShootingIntervals(
            model=self.model,
            layout=self.layout,
            measured=np.where(known, measured, 0.0),
            sampled=known,
            recorded=acting,
            is_logged=np.ones(n * length, bool),
            gaps=(stream.ended[: len(held)] | long_runs(missing, _LONG_HOLD))[rows],
            log_of=np.zeros(n, np.int64),
            dt=stream.dt,
            length=length,
            substeps=self.settings.substeps,
            hold=self.hold,
            discrepancies=False,
        )


def _interpolated(inputs: FloatArray) -> FloatArray:
    """Inputs ``(N, n_u)`` with missing samples interpolated, and held at both ends; 0 without any sample."""
    filled, rows = inputs.copy(), np.arange(len(inputs))
    for column in filled.T:
        known = np.isfinite(column)
        if not known.all():
            column[:] = np.interp(rows, rows[known], column[known]) if known.any() else 0.0
    return filled
