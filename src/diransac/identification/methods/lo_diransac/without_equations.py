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
from diransac.identification.methods.lo_diransac.following import Predictor
from diransac.identification.methods.lo_diransac.prediction_error import Minimum, minimised, over_spread, settled
from diransac.identification.methods.lo_diransac.preparation import cut, screened
from diransac.identification.regression.uncertainty import CLEAR

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings

_SHORTEST, _LONGEST, _FEWEST_INTERVALS = 5, 25, 4
"""Samples of an interval; intervals of the logs at least."""
_NOTHING_KNOWN, _SMALL = 1.0, 0.01
"""Standard error of a parameter over its size from which on a log tells nothing of it; size at least."""
_USED = ("criteria", "smoothing_half_width", "outliers", "input_delay", "start")
"""Settings that are used without equations."""
_LACKING, _MORE_STARTS = 0.1, 3
"""Part of each change of velocity that a model lacks where its motion is another one; starts from elsewhere then."""
_LEAST_DELAY = 0.05
"""Delay, samples, that is none."""
_OUTLIER, _GAUSSIAN = 0.5, 10_000


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
    _check_settings(settings)
    report(callback, "following the motion", 0.0)
    intervals, notes = _intervals(settings, dataset)
    begin = settings.start_of(dataset.layout)
    begin = np.ones(len(dataset.layout)) if begin is None else begin
    free = settings.input_delay is not False and bool(np.ptp(intervals.recorded, axis=0).any())
    so_far, ends = list[Minimum](), list[Minimum]()

    def progress(k: int, found: Minimum) -> None:
        so_far[:] = [found]
        text = f"pass {k + 1}: negative log-likelihood {found.last.losses.sum():.6g}"
        report(callback, "prediction errors", 0.85 if ends else min(0.05 + 0.05 * k, 0.85), text)

    predictor, limited = Predictor.of(intervals, outliers=settings.outliers, free_delay=free), False
    try:
        for start in _starts(dataset, begin, seed):
            ends.append(minimised(predictor, start, outliers=settings.outliers, progress=progress))
            if _follows(ends[-1]):
                break
    except TimeLimitError:
        if not so_far:
            raise
        limited = True
    found = min([*ends, *so_far] if limited else ends, key=lambda end: float(end.last.losses.sum()))
    if _follows(found) and not limited:
        try:
            found = over_spread(found, outliers=settings.outliers, progress=progress)
        except TimeLimitError:
            limited = True
    ended = TIME_LIMIT if limited else "converged" if found.converged else "limit of passes"
    if found.last.lost.sum() > 0.5 * 10.0 * float(intervals.known.sum()):
        raise IdentificationError(
            f"{dataset.source}: simulations diverge in most of the log from the file's values; correct these, or give "
            "start= or --start"
        )
    return _Found(settings, dataset, found, ended, notes).estimate()


def _follows(end: Minimum) -> bool:
    """True unless a fit lacks much of the motion, or takes most samples of a state for outliers."""
    n_x = len(end.predictor.intervals.model.state)
    return end.predictor.lacks <= _LACKING and bool((end.predictor.noise.pi[:n_x] <= _OUTLIER).all())


def _starts(dataset: Dataset, begin: FloatArray, seed: int) -> Iterator[FloatArray]:
    """Starts ``(n,)``: one that is given, and further ones with a third to three times its positive parameters."""
    lower, upper = np.array([(x.lower, x.upper) for x in dataset.layout.bounds]).T
    positive = np.array([x.positive for x in dataset.layout.bounds]) | (lower >= 0.0)
    yield begin
    for k in range(_MORE_STARTS if (positive & (begin != 0.0)).any() else 0):
        rng = np.random.default_rng([abs(seed), int(seed < 0), k])
        factors = 3.0 ** rng.uniform(-1.0, 1.0, len(begin))
        yield np.clip(np.where(positive, factors, 1.0) * begin, lower, upper)


def _check_settings(settings: LoDiransacSettings) -> None:
    """Raise SettingsError: a setting is given for which a model without equations has no use."""
    for field in fields(settings):
        if field.name not in _USED and getattr(settings, field.name) != field.default:
            raise SettingsError(f"{field.name} is given, for which a model without equations has no use; leave it out")


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
    predictor = Predictor.of(replace(intervals, hold=resolution.hold), outliers=True, free_delay=False)
    predictor, now = settled(replace(predictor, delay=late), parameters)
    series = predictor.trajectories(parameters, now.states)
    known = intervals.known
    outliers = known & (predictor.noise.inlying(now.residuals, known) < _OUTLIER)
    return Followed(series, predictor.noise.sigma, outliers, intervals.length)


def _intervals(settings: LoDiransacSettings, dataset: Dataset) -> tuple[ShootingIntervals, tuple[str, ...]]:
    """Intervals of the logs, and findings of the screening.  Raises LogError: the logs are too short."""
    samples, notes = screened(settings, dataset)
    length = int(np.clip(round(settings.smoothing_half_width / dataset.dt), _SHORTEST, _LONGEST))
    n_rows = sum(map(len, dataset.segments))
    if n_rows < _FEWEST_INTERVALS * length:
        least = _FEWEST_INTERVALS * length
        raise LogError(f"{dataset.source}: {n_rows} rows are too few; it needs at least {least}. Give a longer log")
    return replace(cut(settings, dataset, samples, length), discrepancies=False), notes


@dataclass(frozen=True)
class _Found:
    """Outcome of passes over the logs."""

    settings: LoDiransacSettings
    dataset: Dataset
    found: Minimum
    ended: str
    notes: tuple[str, ...]

    def estimate(self) -> Estimate:
        """The estimate."""
        dataset, n = self.dataset, len(self.found.parameters)
        whole, names = self.found.covariance, dataset.layout.names
        delay_error = float(np.sqrt(whole[-1, -1])) if self.found.predictor.free_delay else np.inf
        late, lost = self._delay(delay_error), self._lost(whole)
        values, covariance = self.found.parameters, whole[:n, :n].copy()
        if self.found.predictor.free_delay and not late:
            values, covariance = self.found.without_delay()
        covariance[lost] = covariance[:, lost] = np.inf
        timing = InputTiming.of(np.full(dataset.model.n_u, late * dataset.dt), *np.zeros((2, dataset.model.n_u)))
        return Estimate(
            parameters=dict(zip(names, values.tolist(), strict=True)),
            covariance=covariance,
            degrees_of_freedom=_GAUSSIAN,
            n_fitted=sum(int(np.isfinite(one.measured).any(axis=1).sum()) for one in dataset.segments),
            estimator="prediction errors",
            stop_reason=self.ended,
            resolution=Resolution("rk4", 1, self.found.predictor.intervals.hold, timing),
            notes=self.notes,
            diagnosis=self._diagnosis(tuple(n for n, x in zip(names, lost, strict=True) if x), delay_error),
            checks=tuple(self._checks(delay_error)),
        )

    def _delay(self, error: float) -> float:
        """Delay of the inputs, samples; 0 where it is negligible, or not significant and less than a sample."""
        size = abs(self.found.predictor.delay)
        late = float(self.found.predictor.delay)
        return late if size > max(_LEAST_DELAY, min(3.0 * error, 1.0)) or self.settings.input_delay else 0.0

    def _lost(self, covariance: FloatArray) -> BoolArray:
        """Parameters ``(n,)`` that the logs do not determine: nothing depends on them, or too little."""
        n = len(self.found.parameters)
        nominal = np.abs([x.value or 0.0 for x in self.dataset.layout.bounds])
        size = np.maximum(np.maximum(np.abs(self.found.parameters), nominal), _SMALL)
        errors, has_prior = np.sqrt(np.diag(covariance)[:n]), np.isfinite(self.dataset.layout.prior_std)
        return np.asarray(~has_prior & ~((errors > 0.0) & (errors < _NOTHING_KNOWN * size)))

    def _checks(self, delay_error: float) -> Iterator[Finding]:
        """Findings on the fit."""
        early = -self.found.predictor.delay
        if early - CLEAR * delay_error > 1.0:
            yield Finding(
                "bad",
                f"The inputs seem to act {1e3 * early * self.dataset.dt:.2g} ms before they are recorded",
                "check their clock, begin closer, with start= or --start, or give input_delay=False",
            )
        if self.found.predictor.lacks > _LACKING:
            yield Finding(
                "bad",
                f"The model lacks {100.0 * self.found.predictor.lacks:.0f} % of each change of velocity",
                "begin closer, with start= or --start, or correct the file",
            )
        if self.ended not in ("converged", TIME_LIMIT):
            yield Finding(
                "bad",
                "Passes over the log did not converge within their limit",
                "begin closer, with start= or --start",
            )

    def _diagnosis(self, lost: tuple[str, ...], delay_error: float) -> Diagnosis:
        """Noise, outliers and unmodelled accelerations, by name and over the rows of the given logs."""
        now, predictor = self.found.last, self.found.predictor
        one, fitted = predictor.intervals, (predictor.noise, now.residuals, now.states)
        unmodelled = now.jumps[:, one.model.n_q :] / one.duration
        return replace(
            diagnosis_of(self.dataset, one, fitted, unmodelled, (lost, tuple(map(_untold, lost)))),
            input_delay=predictor.delay * one.dt,
            input_delay_error=delay_error * one.dt,
            input_delay_significant=abs(predictor.delay) > max(_LEAST_DELAY, 3.0 * delay_error),
        )


def _untold(name: str) -> str:
    """Sentence on a parameter that the logs do not determine."""
    cause = "the sensors show nothing of it in this motion"
    if name.startswith(("geom/", "pair/")) and ".friction" in name:
        cause = "no such contact slips in this log"
    return f'{name} is not identifiable: {cause}; record another motion, or fix it, by fixed={{"{name}": ...}}'
