"""Inputs as they act on a machine: recorded ones after delays and a first-order lag, with a gain that may drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diransac.arrays import FloatArray

__all__ = ["InputTiming", "acting_inputs"]


@dataclass(frozen=True)
class InputTiming:
    """Delays and lag after which recorded inputs act, and the drift of their gains; none by default.

    Parameters
    ----------
    delay : float, optional
        Time from the recorded sample of an input to its effect, s; negative where the recording is late.
    lag : float, optional
        Time constant of a first-order lag of the actuators, s; 0 without one.
    own_delays : tuple of float, optional
        Further delay of each input, s; empty without any.
    gain_drifts : tuple of float, optional
        Relative change of each input's gain over a log; empty without any.
    """

    delay: float = 0.0
    lag: float = 0.0
    own_delays: tuple[float, ...] = ()
    gain_drifts: tuple[float, ...] = ()

    def acting(self, recorded: FloatArray, dt: float) -> FloatArray:
        """Inputs ``(N, n_u)`` that act at each row; `recorded` itself if they act as recorded.

        Parameters
        ----------
        recorded : (N, n_u) array
            Recorded inputs, each in its unit.
        dt : float
            Sampling time, s.

        Returns
        -------
        (N, n_u) array
        """
        delays = self.delay + np.array(self.own_delays or (0.0,) * recorded.shape[1])
        drifts = np.array(self.gain_drifts or (0.0,) * recorded.shape[1])
        return acting_inputs(recorded, delays / dt, self.lag / dt, drifts)


def acting_inputs(
    recorded: FloatArray, delays: FloatArray, lag: float, drifts: FloatArray, n_rows: int | None = None
) -> FloatArray:
    """Recorded inputs after delays and a first-order lag, with gains that drift.

    A fraction of a sample of delay interpolates linearly.  For interpolated inputs that is their delayed value; for
    held ones, which step within the sample, their mean over it.  The lag is the exact response to held inputs, of
    actuators at rest when a log begins.  A gain that drifts is one when a log begins and changes in proportion to time;
    a row has its mean over the sample.

    Parameters
    ----------
    recorded : (N, n_u) array
        Inputs, each in its unit; the first and the last row continue beyond the log.
    delays : (n_u,) array
        Samples.
    lag : float
        Samples.
    drifts : (n_u,) array
        Relative change of each gain over the log.
    n_rows : int, optional
        Rows of the log, if others follow that pad it; N by default.

    Returns
    -------
    (N, n_u) array
    """
    acting = recorded
    if delays.any():
        acting = np.stack([_delayed(u, float(x)) for u, x in zip(recorded.T, delays, strict=True)], axis=1)
    if lag:
        from scipy.signal import lfilter

        decay = np.exp(-1.0 / lag)
        acting = lfilter([0.0, 1.0 - decay], [1.0, -decay], acting, axis=0, zi=acting[:1])[0]
    if drifts.any():
        share = (np.arange(len(recorded)) + 0.5) / (n_rows or len(recorded))
        acting = acting * (1.0 + np.minimum(share, 1.0)[:, None] * drifts)
    return acting


def _delayed(recorded: FloatArray, delay: float) -> FloatArray:
    """One input ``(N,)`` after a delay in samples."""
    last, whole = len(recorded) - 1, int(np.floor(delay))
    later, earlier = (recorded[np.clip(np.arange(last + 1) - k, 0, last)] for k in (whole, whole + 1))
    return later if delay == whole else np.asarray(later + (delay - whole) * (earlier - later))
