"""Systematic errors of the sensors: a delay of each signal or group of signals, and a bias.

A sensor is here whatever measures a signal, with a measurement equation or without.

An error of a sensor that no parameter and no discrepancy explains is in the residuals: a delay in
proportion to the signal's rate, a bias a constant.  A score test finds the most significant error, given all
else that is estimated; it costs a call of the simulator, and no fit.  The error is then estimated jointly with all
other unknowns, by one Newton step and a new fit.

References
----------
Rao 1948 (score test); Furgale, Rehder, Siegwart 2013 (delays of sensors).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.methods.lo_diransac.normal_equations import linearize
from diransac.identification.methods.lo_diransac.refinement import weights_of

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

__all__ = ["SensorError", "clear_errors", "error_of_sensor", "with_error"]

# Standard errors from which on an error of a sensor is tried, and its least delay, samples.
_CLEAR, _LEAST_DELAY = 3.0, 0.1
# Groups of which a fit is made at a time.
_GROUPS = 4
# Signals that are known in fewer rows than this are not tested.
_FEWEST = 50


@dataclass(frozen=True)
class SensorError:
    """An error of one signal or of a group.

    Parameters
    ----------
    signals : (n_s,) bool array
        Signals that have it.
    is_delay : bool
        A delay in samples, or a bias in the signal's unit.
    size : float
        Its estimate.
    ratio : float
        Its size over its standard error.
    """

    signals: BoolArray
    is_delay: bool
    size: float
    ratio: float


def clear_errors(
    intervals: ShootingIntervals, fit: Fit, among: BoolArray, *, delays: bool, biases: bool
) -> list[SensorError]:
    """Errors of the sensors that the residuals show most clearly: one of a single signal, and some of groups.

    Groups that are late alike show nearly as clearly as others that are early; fits of each tell them apart.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.
    among : (n_s,) bool array
        Signals whose errors are tested.
    delays, biases : bool
        Kinds of errors that are tested.

    Returns
    -------
    list of SensorError
        Empty if no error is clear.
    """
    tested = [x for x in _candidates(intervals, among) if (delays if x[1] else biases)]
    found = _score_tests(intervals, fit, tested) if tested else []
    clear = [x for x in found if x.ratio > _CLEAR and (not x.is_delay or abs(x.size) > _LEAST_DELAY)]
    clear.sort(key=lambda x: x.ratio, reverse=True)
    single = [x for x in clear if x.signals.sum() == 1]
    return [*single[:1], *[x for x in clear if x.signals.sum() > 1][:_GROUPS]]


def error_of_sensor(intervals: ShootingIntervals, fit: Fit, name: str, *, is_delay: bool) -> SensorError | None:
    """The error of one signal, clear or not.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.
    name : str
        Signal of the model.
    is_delay : bool
        A delay, or a bias.

    Returns
    -------
    SensorError or None
        None if the log does not determine it.
    """
    signal = np.array([x == name for x in intervals.model.signals])
    return next(iter(_score_tests(intervals, fit, [(signal, is_delay)])), None)


def _score_tests(intervals: ShootingIntervals, fit: Fit, candidates: list[tuple[BoolArray, bool]]) -> list[SensorError]:
    """Estimates of errors of the sensors, each given all else that is estimated."""
    weights, rates = weights_of(intervals, fit), signal_rates(intervals, fit)
    at = linearize(intervals, fit, weights)
    batch = np.arange(0, len(intervals), max(1, round(np.sqrt(len(intervals)))))
    found: list[SensorError] = []
    for signals, is_delay in candidates:
        sensitivity = np.where(signals, -rates if is_delay else 1.0, 0.0)
        # The gradient J' W e with errors that are larger by the sensitivity, of which no derivative is needed.
        moved = linearize(replace(intervals, measured=intervals.measured - sensitivity), fit, weights)
        of_z, of_s = at.data_z - moved.data_z, (at.data_s - moved.data_s).sum(axis=0)
        z, s = (x[..., 0] for x in at.system.functional(of_z[:, :, None], of_s[:, None]))
        information = float((weights * np.square(sensitivity)).sum() - (of_z * z).sum() - of_s @ s)
        rows = (weights * sensitivity * fit.residuals).sum(axis=1)
        scores = rows.reshape(len(intervals), -1).sum(axis=1) + (at.data_z * z).sum(axis=1) + at.data_s @ s
        score = float(rows.sum())
        # An error that is there has a score of one sign in each batch; only the rest of the scores scatters.
        share = (weights * np.square(sensitivity)).sum(axis=1).reshape(len(intervals), -1).sum(axis=1)
        scores = scores - score * share / max(share.sum(), 1e-300)
        variance = max(information, float(np.square(np.add.reduceat(scores, batch)).sum()))
        if information > 0.0:
            found.append(SensorError(signals, is_delay, -score / information, abs(score) / np.sqrt(variance)))
    return found


def with_error(intervals: ShootingIntervals, fit: Fit, error: SensorError) -> ShootingIntervals:
    """The intervals with measurements that are corrected of an error, too.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Of which the rates of signals are taken.
    error : SensorError

    Returns
    -------
    ShootingIntervals
    """
    n = len(error.signals)
    old = intervals.sensor_errors
    delay = np.zeros(n) if old is None else old.delay
    bias = np.zeros(n) if old is None else old.bias
    more = np.where(error.signals, error.size, 0.0)
    delay, bias = (delay + more, bias) if error.is_delay else (delay, bias + more)
    return intervals.corrected(delay, bias, signal_rates(intervals, fit))


def signal_rates(intervals: ShootingIntervals, fit: Fit) -> FloatArray:
    """Change of each simulated signal per sample.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    (N, n_s) array
    """
    series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d))
    signals = series.reshape(intervals.measured.shape)
    rates = np.zeros_like(signals)
    for rows in intervals.rows_of_logs:
        if rows.stop - rows.start > 1:
            rates[rows] = np.gradient(signals[rows], axis=0)
    return np.nan_to_num(rates, nan=0.0, posinf=0.0, neginf=0.0)


def _candidates(intervals: ShootingIntervals, among: BoolArray) -> list[tuple[BoolArray, bool]]:
    """Signals and kinds of the errors that are tested: of each signal, and delays of groups.

    A group are the coordinates, the velocities, ..., or those of one unit, as one instrument measures them.  The bias
    of a sensor that has one as a parameter is not tested.
    """
    model = intervals.model
    seen = intervals.known.sum(axis=0) >= _FEWEST
    n = len(model.velocities_of_motion)
    kind = np.repeat([0, 1, 3, 2, 3, 4], [model.n_q, n, model.n_v - n, n, model.n_v - n, len(model.sensors)])
    single = [np.arange(len(seen)) == i for i in np.flatnonzero(seen & among)]
    unit = np.array([model.units[n] for n in model.signals])
    masks = [kind == g for g in (0, 1, 2, 4)]
    masks += [mask & (unit == u) for mask in masks for u in dict.fromkeys(unit[mask])]
    groups = {x.tobytes(): x for x in (mask & seen & among for mask in masks) if 1 < x.sum() < seen.sum()}.values()
    delays = [(x, True) for x in [*groups, *single] if not (x == seen).all()]
    biased = np.array([n in model.biased_sensors for n in model.signals])
    return [*delays, *((x, False) for x in single if not biased[x].any())]
