"""The one entry: a model and a log in, a `Result` out, whatever the method."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.blas import single_threaded
from diransac.data import preprocessing
from diransac.data.dataset import Observations, observe
from diransac.data.log import Log
from diransac.errors import DiransacError, IdentificationError, LogError, SettingsError
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.estimators import (
    BoundEstimator,
    Estimator,
    OrdinaryLeastSquares,
    TotalLeastSquares,
    as_estimator,
    name_of,
)
from diransac.identification.evaluation import Scoring, Simulation, as_diagnosed, choose_scoring, judged_signals
from diransac.identification.methods.consensus import Diransac, InlierBiasedDiransac, Score, Variant
from diransac.identification.methods.search import Hypothesis, Outcome, Progress, search
from diransac.identification.nonlinear import NonlinearLeastSquares
from diransac.identification.result import LogSummary, Result
from diransac.identification.sampling import sample_rows
from diransac.identification.settings import Settings
from diransac.identification.uncertainty import N_BLOCKS, jackknife_covariance
from diransac.model import Model

if TYPE_CHECKING:
    from collections.abc import Callable

    from diransac.identification.methods.lo_diransac import Findings

__all__ = ["METHODS", "identify"]


_ESTIMATORS: dict[str, Callable[[], Estimator]] = {
    "ols": OrdinaryLeastSquares,
    "tls": TotalLeastSquares,
    "nls": NonlinearLeastSquares,
}
_VARIANTS: dict[str, Callable[[Settings], Variant]] = {
    "diransac": lambda _: Diransac(),
    "i-diransac": lambda settings: InlierBiasedDiransac(settings.acceptance_weights),
}
_LOCALLY_OPTIMISED = "lo-diransac"
_GAUSSIAN = 10_000
"""Degrees of freedom of an interval whose covariance is not itself an estimate from few numbers."""
METHODS = (*_ESTIMATORS, *_VARIANTS, _LOCALLY_OPTIMISED)


def identify(
    model: Model,
    log: Log,
    method: str = _LOCALLY_OPTIMISED,
    *,
    seed: int = 0,
    settings: Settings | None = None,
    estimator: object = None,
    differentiate: bool = False,
    bandwidth: float | None = None,
    progress: Progress | None = None,
) -> Result:
    """Parameters of ``model`` from ``log``.

    Parameters
    ----------
    method : "lo-diransac", which asks for nothing and says most; "ols", "tls", "nls" (least squares of the whole log:
        ordinary, total, nonlinear); "diransac", "i-diransac", the paper's
    seed : sample k of a RANSAC method depends on (seed, k) alone
    settings : `Settings`; those of a search serve the paper's methods alone, those of the simulation serve the fit
        error and the inliers of every method
    estimator : inside a RANSAC method, `OrdinaryLeastSquares()` (default; `NonlinearLeastSquares()` where the model is
        not affine in its parameters), another of ours, or any scikit-learn linear regressor
    differentiate : derive the velocities and accelerations that the log lacks, and filter both sides of the
        equations alike; the identification is then repeated at half and twice the bandwidth, for
        ``result.bandwidth_sensitivity``.  lo-diransac leaves unmeasured what the log lacks, and has no such filter
    bandwidth : of that filter, Hz; None: chosen from the log
    progress : called with (samples drawn, max_iterations, score of the stored hypothesis)

    Raises LogError: the log cannot serve; SettingsError: an argument has no meaning; ModelError: a linear method meets
    a model that is not affine in its parameters; IdentificationError: the log does not determine the parameters, or
    no hypothesis was accepted.
    References: Dimmig et al. 2023, Algorithm 1.
    """
    settings = Settings() if settings is None else settings
    _check_arguments(model, log, method, estimator, seed, settings)
    task = _Task(model, log, method, seed, settings, _estimator(model, method, estimator))
    if bandwidth is not None and (not differentiate or method == _LOCALLY_OPTIMISED):
        raise SettingsError(
            "bandwidth is given without differentiate=True, which alone uses it (and lo-diransac does not)"
        )
    if method == _LOCALLY_OPTIMISED:
        return task.optimise(derivable=differentiate)
    if not differentiate:
        return task.run(log, progress)
    derived = preprocessing.differentiate(log, model, bandwidth)
    result = task.run(derived, progress)
    return task.with_sensitivity(result, derived)


def _check_arguments(
    model: object, log: object, method: object, estimator: object, seed: object, settings: object
) -> None:
    if not isinstance(model, Model):
        raise SettingsError(f"model is {model!r}; give a dr.Model, such as dr.models.planar_rotorcraft()")
    if not isinstance(log, Log):
        raise SettingsError(f"log is a {type(log).__name__}; give a dr.Log, such as dr.read_log(path)")
    if method not in METHODS:
        raise SettingsError(f'there is no method "{method}"; there are {", ".join(METHODS)}')
    if estimator is not None and method not in _VARIANTS:
        raise SettingsError(f'estimator serves the RANSAC methods; method "{method}" is an estimator itself')
    if not isinstance(settings, Settings):
        raise SettingsError(f"settings is {settings!r}; give a dr.Settings, such as dr.Settings(sample_size=75)")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise SettingsError(f"seed is {seed!r}; give a whole number")


def _estimator(model: Model, method: str, candidate: object) -> Estimator:
    if candidate is not None:
        return as_estimator(candidate)
    if method in _ESTIMATORS:
        return _ESTIMATORS[method]()
    return NonlinearLeastSquares() if model.nonlinear_parameters else OrdinaryLeastSquares()


@dataclass(frozen=True)
class _Task:
    """One identification, apart from how its log is prepared."""

    model: Model
    given: Log
    method: str
    seed: int
    settings: Settings
    estimator: Estimator

    def run(self, log: Log, progress: Progress | None = None) -> Result:
        """Identify from a prepared log."""
        observations = observe(self.model, log, judged_signals(self.model, log, self.settings))
        bound = self.estimator.bind(observations)
        if not bound.well_defined([np.arange(bound.n_rows)])[0]:
            raise IdentificationError(self._undetermined(log, bound.unidentifiable()))
        scoring = choose_scoring(observations, self.settings)
        simulation = self._simulation(observations, scoring)
        outcome = self._estimate(bound, simulation, progress)
        best = outcome.best
        assert best is not None
        rows = np.sort(best.rows)
        return Result(
            **self._judged(log, observations, simulation, best.parameters),
            covariance=jackknife_covariance(bound, rows),
            degrees_of_freedom=max(1, min(N_BLOCKS, len(rows)) - 1),
            n_fitted=len(rows),
            estimator=name_of(self.estimator),
            iterations=outcome.iterations,
            n_hypotheses=outcome.n_hypotheses,
            stop_reason=outcome.stop_reason,
            rejected=dict(outcome.rejected),
            notes=(*observations.notes, *scoring.notes),
        )

    def optimise(self, *, derivable: bool) -> Result:
        """Identify by lo-diransac; velocities and accelerations may be missing where they are derivable."""
        from diransac.identification.methods.lo_diransac import find

        judged = judged_signals(self.model, self.given, self.settings)
        observations = observe(self.model, self.given, judged, pointwise=not derivable)
        with single_threaded():  # its matrices are small: other cores would only wait
            findings = find(observations, int(self.seed))
        scoring = choose_scoring(observations, self.settings)
        diagnosis = self._diagnosis(observations, findings)
        acting, settings = as_diagnosed(observations, self.settings, diagnosis)
        simulation = Simulation(acting, scoring, settings, self._variant())
        covariance = findings.covariance.copy()
        covariance[findings.unidentifiable] = covariance[:, findings.unidentifiable] = np.inf
        return Result(
            **self._judged(self.given, observations, simulation, findings.parameters),
            covariance=covariance,
            degrees_of_freedom=_GAUSSIAN,
            n_fitted=int(np.isfinite(observations.measured).any(axis=1).sum()),
            estimator="multiple shooting",
            iterations=findings.samples,
            n_hypotheses=findings.hypotheses,
            stop_reason="settled" if findings.settled else "limit of steps",
            rejected={},
            notes=(*observations.notes, *findings.notes, *scoring.notes),
            diagnosis=diagnosis,
        )

    def _judged(
        self, log: Log, observations: Observations, simulation: Simulation | None, parameters: FloatArray
    ) -> dict[str, Any]:
        """What a result says of how it was made, and of the parameters that it returns."""
        score, inliers = Score(np.nan, np.nan), np.zeros(len(observations), dtype=bool)
        if simulation is not None:
            score, inliers = simulation.scores(parameters[None])[0], simulation.inlier_mask(parameters)
        given = self.given
        return {
            "model": self.model,
            "parameters": dict(zip(self.model.parameters, parameters.tolist(), strict=True)),
            "inliers": self._on_given_log(observations, inliers),
            "inlier_fraction": score.inlier_fraction,
            "fit_error": score.error,
            "method": self.method,
            "seed": int(self.seed),
            "settings": self.settings,
            "violations": self._violations(parameters),
            "log": LogSummary(given.source, given.fingerprint, float(given.time[0]), given.dt, len(given)),
            "preparation": tuple(log.history),
        }

    def _diagnosis(self, observations: Observations, findings: Findings) -> Diagnosis:
        """What lo-diransac found beside the parameters, by name and over the rows of the log that the user gave."""
        model, dt = self.model, observations.log.dt
        columns = {name: model.signals.index(name) for name in observations.signals}
        begin = observations.log.time[observations.offset]
        forces = (
            ()
            if findings.unmodelled_forces is None
            else zip(model.accelerations, findings.unmodelled_forces.T, strict=True)
        )
        return Diagnosis(
            noise_std={name: float(findings.noise_std[k]) for name, k in columns.items()},
            outlier_fraction={name: float(findings.outlier_fraction[k]) for name, k in columns.items()},
            outliers={name: self._on_given_log(observations, findings.outliers[:, k]) for name, k in columns.items()},
            unmodelled_time=begin + dt * findings.latent_middles,
            unmodelled_accelerations=dict(
                zip(model.accelerations, findings.unmodelled_accelerations.T.copy(), strict=True)
            ),
            unmodelled_forces={name: force.copy() for name, force in forces},
            smoothed_time=begin + dt * (findings.latent_middles - findings.latent_middles[0]),
            smoothed_states=dict(zip(model.state, findings.states.T.copy(), strict=True)),
            input_delay=findings.input_delay,
            input_delay_error=findings.input_delay_error,
            input_delay_significant=findings.input_delay_significant,
            unidentifiable=tuple(np.array(list(model.parameters))[findings.unidentifiable].tolist()),
        )

    def _variant(self) -> Variant:
        """The variant that searches; least squares is judged by I-DIRANSAC's error, eq. (2)."""
        return _VARIANTS.get(self.method, _VARIANTS["i-diransac"])(self.settings)

    def _simulation(self, observations: Observations, scoring: Scoring) -> Simulation | None:
        """What judges hypotheses; None where a least-squares method meets a log that nothing can be simulated from."""
        try:
            return Simulation(observations, scoring, self.settings, self._variant())
        except LogError:
            if self.method in _VARIANTS:
                raise
            return None

    def _estimate(self, bound: BoundEstimator, simulation: Simulation | None, progress: Progress | None) -> Outcome:
        if simulation is None or self.method not in _VARIANTS:
            rows = np.arange(bound.n_rows)
            parameters = bound.fit([rows])[0]
            if not np.isfinite(parameters).all():
                raise IdentificationError(
                    f"{self.given.source}: {self.method} finds no finite parameters; try another method"
                )
            best = Hypothesis(parameters, rows, Score(np.nan, np.nan))
            return Outcome(best, n_hypotheses=1, stop_reason="whole log fitted")
        if bound.n_rows < self.settings.sample_size:
            raise LogError(
                f"{self.given.source}: {bound.n_rows} usable rows are fewer than sample_size = "
                f"{self.settings.sample_size}; give a longer log or a smaller sample_size"
            )
        return search(self._variant(), self.settings, bound, simulation, sample_rows, self.seed, progress)

    def _violations(self, parameters: FloatArray) -> tuple[str, ...]:
        pairs = zip(self.model.parameters.items(), parameters, strict=True)
        return tuple(name for (name, bounds), x in pairs if not bounds.admits(x))

    def _undetermined(self, log: Log, indices: tuple[int, ...]) -> str:
        names = [list(self.model.parameters)[i] for i in indices] or list(self.model.parameters)
        return (
            f"{log.source}: the log does not determine {', '.join(names)}: the motion that would show "
            f"{'it' if len(names) == 1 else 'them'} is missing or moves with another; record a livelier motion, or fix "
            "parameters in the model"
        )

    def _on_given_log(self, observations: Observations, inliers: BoolArray) -> BoolArray:
        """Inliers ``(N,)`` over the rows of the log that the user gave."""
        begin = observations.log.time[observations.offset]
        first = round(float(begin - self.given.time[0]) / self.given.dt)
        mask = np.zeros(len(self.given), dtype=bool)
        mask[first : first + len(inliers)] = inliers
        return mask

    def with_sensitivity(self, result: Result, derived: Log) -> Result:
        """The result with each parameter's relative change at half and twice the differentiating bandwidth."""
        bandwidth = float(derived.history[-1]["bandwidth"])
        changes = [self._change(result, bandwidth * factor) for factor in (0.5, 2.0)]
        pairs = {n: (changes[0][n], changes[1][n]) for n in result.parameters}
        return dataclasses.replace(result, bandwidth_sensitivity=pairs)

    def _change(self, result: Result, bandwidth: float) -> dict[str, float]:
        """Relative change of each parameter at another bandwidth; NaN where nothing was identified there."""
        try:
            other = self.run(preprocessing.differentiate(self.given, self.model, bandwidth)).parameters
        except DiransacError:
            return dict.fromkeys(result.parameters, np.nan)
        return {n: (other[n] - x) / abs(x) if x else np.inf for n, x in result.parameters.items()}
