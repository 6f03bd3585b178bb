"""lo-diransac for a model without equations: an estimate by `prediction_error`, with its diagnosis.

Nothing here regresses, smooths or differentiates; hypotheses are the nominal values, or the user's start.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.input_timing import InputTiming
from diransac.errors import IdentificationError, LogError, SettingsError, TimeLimitError
from diransac.identification.diagnosis import Diagnosis, Resolution
from diransac.identification.estimate import TIME_LIMIT, Estimate
from diransac.identification.finding import Finding
from diransac.identification.method import report
from diransac.identification.methods.lo_diransac.diagnosing import diagnosis_of
from diransac.identification.methods.lo_diransac.interval_filter import IntervalFilter
from diransac.identification.methods.lo_diransac.prediction_error import Minimum, minimised, over_spread, settled
from diransac.identification.methods.lo_diransac.preparation import FEWEST_INTERVALS, cut, screened
from diransac.identification.methods.lo_diransac.recording_errors import LEAST_DELAY
from diransac.identification.regression.uncertainty import CLEAR

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.windows import Windows
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings

USED = ("criteria", "smoothing_half_width", "outliers", "input_delay", "start")
"""Settings that are used without equations."""
LACKING = 0.1
"""Part of each change of velocity that a model lacks, from which on its motion is another one."""


def estimated_by_simulation(
    settings: LoDiransacSettings, dataset: Dataset, seed: int, callback: Callback | None = None
) -> Estimate:
    """Parameters of a model without equations from the logs.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset
    seed : int
        Of further starts.
    callback : callable, optional
        Called with a `Progress` at every pass.

    Returns
    -------
    Estimate

    Raises
    ------
    SettingsError
        A setting is given that belongs to equations.
    LogError
        The logs are too short.
    IdentificationError
        Simulations diverge in most of the logs.
    TimeLimitError
        The time limit was reached before a pass over the logs had ended.
    """
    for field in fields(settings):
        if field.name not in USED and getattr(settings, field.name) != field.default:
            raise SettingsError(f"{field.name} is given, for which a model without equations has no use; leave it out")
    report(callback, "following the motion", 0.0)
    intervals, notes = _intervals(settings, dataset)
    begin = settings.start_of(dataset.layout)
    begin = np.ones(len(dataset.layout)) if begin is None else begin
    free = settings.input_delay is not False and bool(np.ptp(intervals.recorded, axis=0).any())
    latest, ends = list[Minimum](), list[Minimum]()

    def progress(k: int, found: Minimum) -> None:
        latest[:] = [found]
        text = f"pass {k + 1}: negative log-likelihood {found.last.loss:.6g}"
        report(callback, "prediction errors", 0.85 if ends else min(0.05 + 0.05 * k, 0.85), text)

    first, limited = IntervalFilter.of(intervals, outliers=settings.outliers, free_delay=free), False
    try:
        for start in _starts(dataset, begin, seed):
            ends.append(minimised(first, start, outliers=settings.outliers, progress=progress))
            if _follows(ends[-1]):
                break
        best = min(ends, key=lambda end: end.last.loss)
        if _follows(best):
            best = over_spread(best, outliers=settings.outliers, progress=progress)
    except TimeLimitError:
        if not latest:
            raise
        limited, best = True, min([*ends, *latest], key=lambda end: end.last.loss)
    if best.last.lost.mean() > 0.5:
        raise IdentificationError(
            f"{dataset.source}: simulations diverge in most of the log from the file's values; correct these, or give "
            "start= or --start"
        )
    ended = TIME_LIMIT if limited else "converged" if best.converged else "limit of passes"
    return _estimate(settings, dataset, best, ended, notes)


def _follows(end: Minimum) -> bool:
    """True unless a fit lacks much of the motion, or takes most samples of a state for outliers."""
    n_x = len(end.kalman.intervals.model.state)
    return end.kalman.lack <= LACKING and bool((end.kalman.noise.pi[:n_x] <= 0.5).all())


def _starts(dataset: Dataset, begin: FloatArray, seed: int) -> Iterator[FloatArray]:
    """Starts ``(n,)``: one that is given, and further ones with a third to three times its positive parameters."""
    lower, upper = np.array([(x.lower, x.upper) for x in dataset.layout.bounds]).T
    positive = np.array([x.positive for x in dataset.layout.bounds]) | (lower >= 0.0)
    yield begin
    for k in range(3 if (positive & (begin != 0.0)).any() else 0):
        rng = np.random.default_rng([abs(seed), int(seed < 0), k])
        factors = 3.0 ** rng.uniform(-1.0, 1.0, len(begin))
        yield np.clip(np.where(positive, factors, 1.0) * begin, lower, upper)


@dataclass(frozen=True)
class Followed:
    """Motion of logs as a model without equations follows it.

    Parameters
    ----------
    signals : (N, n_signals) array
        Over the rows of the intervals.
    noise : (n_signals,) array
    outliers : (N, n_signals) bool array
    length : int
        Rows of an interval, whose samples determine its state.
    """

    signals: FloatArray
    noise: FloatArray
    outliers: BoolArray
    length: int


def followed(
    settings: LoDiransacSettings, dataset: Dataset, parameters: FloatArray, resolution: Resolution
) -> Followed:
    """Motion of logs with given parameters.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset
    parameters : (n,) array
    resolution : Resolution
        With the timing of the inputs.

    Raises
    ------
    LogError
        The logs are too short.
    """
    intervals, _ = _intervals(settings, dataset)
    delays = resolution.timing.delays
    late = float(delays[0]) / dataset.dt if len(delays) else 0.0
    first = IntervalFilter.of(replace(intervals, hold=resolution.hold), outliers=True, free_delay=False)
    last, now = settled(replace(first, delay=late), parameters)
    outliers = intervals.known & (last.noise.inlying(now.residuals, intervals.known) < 0.5)
    return Followed(last.trajectories(parameters, now.states), last.noise.sigma, outliers, intervals.length)


def _intervals(settings: LoDiransacSettings, dataset: Dataset) -> tuple[Windows, tuple[str, ...]]:
    """Intervals of the logs, and findings of the screening.  Raises LogError: the logs are too short."""
    samples, notes = screened(dataset)
    length = int(np.clip(round(settings.smoothing_half_width / dataset.dt), 5, 25))
    n_rows, least = sum(map(len, dataset.segments)), FEWEST_INTERVALS * length
    if n_rows < least:
        raise LogError(f"{dataset.source}: {n_rows} rows are too few; it needs at least {least}. Give a longer log")
    return replace(cut(settings, dataset, samples, length), discrepancies=False), notes


def _estimate(
    settings: LoDiransacSettings, dataset: Dataset, best: Minimum, ended: str, notes: tuple[str, ...]
) -> Estimate:
    """The estimate of the best fit."""
    n, names, free = len(best.parameters), dataset.layout.names, best.kalman.free_delay
    delay, delay_error = best.kalman.delay, float(np.sqrt(best.covariance[-1, -1])) if free else np.inf
    # A delay that is negligible, or not significant and less than a sample, is none.
    is_late = abs(delay) > max(LEAST_DELAY, min(CLEAR * delay_error, 1.0)) or settings.input_delay
    values, covariance = best.parameters, best.covariance[:n, :n]
    if free and not is_late:
        values, covariance = best.without_delay()
    lost = _lost(dataset, best)
    covariance = np.where(lost | lost[:, None], np.inf, covariance)
    late, none = np.full(dataset.model.n_u, delay * dataset.dt if is_late else 0.0), np.zeros((2, dataset.model.n_u))
    return Estimate(
        parameters=dict(zip(names, values.tolist(), strict=True)),
        covariance=covariance,
        degrees_of_freedom=10_000,  # noise is Gaussian
        n_fitted=sum(int(np.isfinite(one.measured).any(axis=1).sum()) for one in dataset.segments),
        estimator="prediction errors",
        stop_reason=ended,
        resolution=Resolution("rk4", 1, best.kalman.intervals.hold, InputTiming.of(late, *none)),
        notes=notes,
        diagnosis=_diagnosis(dataset, best, tuple(n for n, x in zip(names, lost, strict=True) if x), delay_error),
        checks=tuple(_checks(dataset, best, ended, delay_error)),
    )


def _lost(dataset: Dataset, best: Minimum) -> BoolArray:
    """Parameters ``(n,)`` that the logs do not determine to their size: nothing depends on them, or too little."""
    n = len(best.parameters)
    nominal = np.abs([x.value or 0.0 for x in dataset.layout.bounds])
    size = np.maximum(np.maximum(np.abs(best.parameters), nominal), 0.01)
    errors, has_prior = np.sqrt(np.diag(best.covariance)[:n]), np.isfinite(dataset.layout.prior_std)
    return np.asarray(~has_prior & ~((errors > 0.0) & (errors < size)))


def _checks(dataset: Dataset, best: Minimum, ended: str, delay_error: float) -> Iterator[Finding]:
    """Findings on the fit."""
    early, closer = -best.kalman.delay, "begin closer, with start= or --start"
    if early - CLEAR * delay_error > 1.0:
        text = f"The inputs seem to act {1e3 * early * dataset.dt:.2g} ms before they are recorded"
        yield Finding("bad", text, f"check their clock, {closer}, or give input_delay=False")
    if best.kalman.lack > LACKING:
        text = f"The model lacks {100.0 * best.kalman.lack:.0f} % of each change of velocity"
        yield Finding("bad", text, f"{closer}, or correct the file")
    if ended not in ("converged", TIME_LIMIT):
        yield Finding("bad", "Passes over the log did not converge within their limit", closer)


def _diagnosis(dataset: Dataset, best: Minimum, lost: tuple[str, ...], delay_error: float) -> Diagnosis:
    """Noise, outliers and unmodelled accelerations, by name and over the rows of the given logs."""
    intervals, last, delay = best.kalman.intervals, best.last, best.kalman.delay
    unmodelled = last.jumps[:, intervals.model.n_q :] / intervals.duration
    fitted = best.kalman.noise, last.residuals, last.states
    return replace(
        diagnosis_of(dataset, intervals, fitted, unmodelled, (lost, tuple(map(_sentence, lost)))),
        input_delay=delay * intervals.dt,
        input_delay_error=delay_error * intervals.dt,
        input_delay_significant=abs(delay) > max(LEAST_DELAY, CLEAR * delay_error),
    )


def _sentence(name: str) -> str:
    """Sentence on a parameter that the logs do not determine."""
    cause = "the sensors show nothing of it in this motion"
    if name.startswith(("geom/", "pair/")) and ".friction" in name:
        cause = "no such contact slips in this log"
    return f'{name} is not identifiable: {cause}; record another motion, or fix it, by fixed={{"{name}": ...}}'
