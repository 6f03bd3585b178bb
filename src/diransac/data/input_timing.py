"""Inputs as they act on a machine: recorded ones after delays and first-order lags, with gains that may drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from diransac.arrays import FloatArray


@dataclass(frozen=True)
class InputTiming:
    """Delays and lags after which recorded inputs act, and the drift of their gains; none by default.

    Parameters
    ----------
    delay : float, optional
        Time from the recorded sample of an input to its effect, s; negative where the recording is late.
    lag : float, optional
        Time constant of a first-order lag of all actuators, s; 0 without one.
    own_delays : tuple of float, optional
        Further delay of each input, s; empty without any.
    own_lags : tuple of float, optional
        By how much longer the time constant of each input's actuator is, s; empty where they are equal.
    gain_drifts : tuple of float, optional
        Relative change of each input's gain over a log; empty without any.
    """

    delay: float = 0.0
    lag: float = 0.0
    own_delays: tuple[float, ...] = ()
    own_lags: tuple[float, ...] = ()
    gain_drifts: tuple[float, ...] = ()

    @classmethod
    def of(cls, delays: FloatArray, lags: FloatArray, drifts: FloatArray) -> InputTiming:
        """Of each input: those that all have alike as one.

        Parameters
        ----------
        delays, lags : (n_u,) array
            s.
        drifts : (n_u,) array
            Relative change of each gain over a log.

        Returns
        -------
        InputTiming
        """
        (delay, own_delays), (lag, own_lags) = _shared(delays), _shared(lags)
        return cls(delay, lag, own_delays, own_lags, tuple(drifts.tolist()) if drifts.any() else ())

    @property
    def delays(self) -> tuple[float, ...]:
        """Delay of each input, s; of all as one where they are equal."""
        return tuple(self.delay + x for x in self.own_delays or (0.0,))

    @property
    def lags(self) -> tuple[float, ...]:
        """Time constant of each input's actuator, s; of all as one where they are equal."""
        return tuple(self.lag + x for x in self.own_lags or (0.0,))

    def acting(self, recorded: FloatArray, dt: float, hold: str) -> FloatArray:
        """Inputs ``(N, n_u)`` that act at each row; `recorded` itself if they act as recorded.

        Parameters
        ----------
        recorded : (N, n_u) array
            Recorded inputs, each in its unit.
        dt : float
            Sampling time, s.
        hold : str
            Of the simulation in which they act, as in `Resolution`.

        Returns
        -------
        (N, n_u) array
        """
        delays, lags = (np.broadcast_to(x, recorded.shape[1:]) for x in (self.delays, self.lags))
        drifts = np.array(self.gain_drifts or (0.0,) * recorded.shape[1])
        return acting_inputs(recorded, delays / dt, lags / dt, drifts, hold)


def acting_inputs(
    recorded: FloatArray,
    delays: FloatArray,
    lags: FloatArray,
    drifts: FloatArray,
    hold: str = "zero-order",
    n_rows: int | None = None,
) -> FloatArray:
    """Recorded inputs after delays and first-order lags, with gains that drift.

    A fraction of a sample of delay interpolates linearly.  For interpolated inputs that is their delayed value; for
    held ones, which step within the sample, their mean over it.  A lag is the response to held inputs of an
    actuator at rest when a log begins: its mean over the sample, which that of interpolated inputs is up to changes of
    curvature from row to row.  A gain that drifts is one when a log begins and changes in proportion to time;
    a row has its mean over the sample.

    Parameters
    ----------
    recorded : (N, n_u) array
        Inputs, each in its unit; the first and the last row continue beyond the log.
    delays : (n_u,) array
        Samples.
    lags : (n_u,) array
        Time constants, samples; 0 without a lag.
    drifts : (n_u,) array
        Relative change of each gain over the log.
    hold : str, optional
        Of the simulation in which they act, as in `Resolution`.
    n_rows : int, optional
        Rows of the log, if others follow that pad it; N by default.

    Returns
    -------
    (N, n_u) array
    """
    acting = recorded
    if delays.any():
        acting = np.stack([_delayed(u, float(x)) for u, x in zip(recorded.T, delays, strict=True)], axis=1)
    if lags.any():
        acting = np.stack([_lagging(u, float(x), hold) for u, x in zip(acting.T, lags, strict=True)], axis=1)
    if drifts.any():
        share = (np.arange(len(recorded)) + 0.5) / (n_rows or len(recorded))
        acting = acting * (1.0 + np.minimum(share, 1.0)[:, None] * drifts)
    return acting


def _shared(values: FloatArray) -> tuple[float, tuple[float, ...]]:
    """Values as that of all and no own ones, or as 0 and each."""
    same = bool(np.all(values == values[:1]))
    return (float(values[0]) if same and len(values) else 0.0, () if same else tuple(values.tolist()))


def _delayed(recorded: FloatArray, delay: float) -> FloatArray:
    """One input ``(N,)`` after a delay in samples."""
    last, whole = len(recorded) - 1, int(np.floor(delay))
    later, earlier = (recorded[np.clip(np.arange(last + 1) - k, 0, last)] for k in (whole, whole + 1))
    return later if delay == whole else np.asarray(later + (delay - whole) * (earlier - later))


def _decaying(x: FloatArray, decay: float) -> FloatArray:
    """Solution ``(N,)`` of ``y[k] = x[k] + decay * y[k - 1]`` by doubling: after k sums, each has 2^k terms.

    Terms below rounding are left out.
    """
    y, power, n = x.copy(), decay, 1
    while n < len(y) and power > 1e-18:
        y[n:] += power * y[:-n]
        power, n = power**2, 2 * n
    return y


def _lagging(u: FloatArray, lag: float, hold: str) -> FloatArray:
    """Response ``(N,)`` of an actuator with a time constant in samples, as it acts in a simulation."""
    if not lag:
        return u
    decay = np.exp(-1.0 / lag)
    at_rows = _decaying(np.concatenate([u[:1], (1.0 - decay) * u[:-1]]), float(decay))
    means: FloatArray = u + (at_rows - u) * lag * (1.0 - decay)
    if hold == "zero-order":
        return means
    # Straight lines from row to row lack the mean of the curves between them.
    lacking = means - 0.5 * (at_rows + np.append(at_rows[1:], at_rows[-1:]))
    return np.asarray(at_rows + 0.5 * (lacking + np.append(lacking[:1], lacking[:-1])))
