"""Noise, outliers and unmodelled accelerations of a fit, by name and over the rows of the given logs."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.diagnosis import Diagnosis

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.noise import Mixture
    from diransac.identification.core.windows import Windows


def diagnosis_of(
    dataset: Dataset,
    intervals: Windows,
    fitted: tuple[Mixture, FloatArray, FloatArray],
    unexplained: FloatArray,
    unidentifiable: tuple[tuple[str, ...], tuple[str, ...]],
) -> Diagnosis:
    """Diagnosis without forces and without a delay of the inputs.

    Parameters
    ----------
    dataset : Dataset
    intervals : Windows
        Of its logs.
    fitted : (Mixture, (N, n_s) array, (W, n_x) array)
        Noise, simulated less measured signals, and the states at the intervals' starts.
    unexplained : (W, n_v) array
        Accelerations that the model does not explain.
    unidentifiable : (tuple of str, tuple of str)
        Parameters that the logs do not determine, and sentences about them.

    Returns
    -------
    Diagnosis
    """
    (noise, residuals, states), dt = fitted, intervals.dt
    columns = {name: dataset.model.signals.index(name) for name in dataset.signals}
    known = intervals.known
    seen = known.any(axis=0)
    sigma, fraction = (np.where(seen, x, np.nan) for x in (noise.sigma, noise.pi))
    outliers = known & (noise.inlying(residuals, known) < 0.5)
    counted = outliers.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    fraction = np.where(noise.has_outliers, fraction, np.where(seen, counted, np.nan))
    shown = intervals.is_logged[intervals.starts]
    window_log = intervals.log_of[shown]
    begins = np.array([one.log.time[one.offset] for one in dataset.segments])[window_log]
    place = intervals.starts[shown] - intervals.first_of_log[window_log]
    logs = list(zip(intervals.rows_of_logs, dataset.segments, strict=True))
    return Diagnosis(
        noise_std={name: float(sigma[k]) for name, k in columns.items()},
        outlier_fraction={name: float(fraction[k]) for name, k in columns.items()},
        outliers={
            name: dataset.on_given_logs([outliers[rows, k][: len(one)] for rows, one in logs])
            for name, k in columns.items()
        },
        window_log=window_log,
        unmodelled_time=begins + dt * (place + 0.5 * (intervals.length - 1)),
        unmodelled_accelerations=by_acceleration(intervals, unexplained),
        unmodelled_forces={},
        smoothed_time=begins + dt * place.astype(float),
        smoothed_states=dict(zip(dataset.model.state, states[shown].T.copy(), strict=True)),
        input_delay=0.0,
        input_delay_error=np.inf,
        input_delay_significant=False,
        unidentifiable=unidentifiable[0],
        combinations=unidentifiable[1],
    )


def by_acceleration(intervals: Windows, values: FloatArray) -> dict[str, FloatArray]:
    """Figures ``(W, n_v)`` of intervals by the name of the acceleration, of those that begin in a log."""
    shown = intervals.is_logged[intervals.starts]
    return dict(zip(intervals.model.accelerations, values[shown].T.copy(), strict=True))
