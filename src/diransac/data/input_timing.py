"""Inputs as they act on a machine: recorded ones after a delay and a first-order lag."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diransac.arrays import FloatArray

__all__ = ["InputTiming", "acting_inputs"]


@dataclass(frozen=True)
class InputTiming:
    """Delay and lag after which recorded inputs act; none by default.

    Parameters
    ----------
    delay : float, optional
        Time from the recorded sample of an input to its effect, s; negative where the recording is late.
    lag : float, optional
        Time constant of a first-order lag of the actuators, s; 0 without one.
    """

    delay: float = 0.0
    lag: float = 0.0

    def acting(self, recorded: FloatArray, dt: float) -> FloatArray:
        """Inputs ``(N, n_u)`` that act at each row; `recorded` itself without delay and lag.

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
        return acting_inputs(recorded, self.delay / dt, self.lag / dt)


def acting_inputs(recorded: FloatArray, delay: float, lag: float) -> FloatArray:
    """Recorded inputs after a delay and a first-order lag.

    A fraction of a sample of delay interpolates linearly.  For interpolated inputs that is their delayed value; for
    held ones, which step within the sample, their mean over it.  The lag is the exact response to held inputs, of
    actuators at rest when a log begins.

    Parameters
    ----------
    recorded : (N, n_u) array
        Inputs, each in its unit; the first and the last row continue beyond the log.
    delay, lag : float
        Samples.

    Returns
    -------
    (N, n_u) array
    """
    acting = recorded
    if delay:
        last, whole = len(recorded) - 1, int(np.floor(delay))
        later, earlier = (recorded[np.clip(np.arange(last + 1) - k, 0, last)] for k in (whole, whole + 1))
        acting = later if delay == whole else later + (delay - whole) * (earlier - later)
    if lag:
        from scipy.signal import lfilter

        decay = np.exp(-1.0 / lag)
        acting = lfilter([0.0, 1.0 - decay], [1.0, -decay], acting, axis=0, zi=acting[:1])[0]
    return acting
