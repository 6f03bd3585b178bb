"""Algorithm 1: random minimal samples, scored by simulation of all logs, refitted to their inliers.

Samples do not depend on earlier results, so hypotheses are fitted and simulated a batch at a time ("speculate"); their
scores are then walked in order exactly as in the algorithm ("replay"), and only a chain of refits runs on its own.
The answer is that of the sequential algorithm, whatever the batch size.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard

import numpy as np

from diransac.errors import IdentificationError, LogError, TimeLimitError
from diransac.identification.diagnosis import Resolution
from diransac.identification.estimate import TIME_LIMIT, Estimate
from diransac.identification.evaluation.scoring import choose_scoring
from diransac.identification.method import report
from diransac.identification.methods.least_squares import bound_to, fitted
from diransac.identification.methods.samples import Evaluator, Hypothesis, Samples, Score, fingerprint, sample_rows
from diransac.identification.regression.estimators import Estimator, OrdinaryLeastSquares
from diransac.identification.regression.nonlinear import NonlinearLeastSquares
from diransac.identification.regression.rows import motion_rows
from diransac.identification.regression.scikit_learn import as_estimator, name_of
from diransac.identification.settings import JUDGING, SIMULATION, Settings, check_used
from diransac.identification.structure.refusal import cause_of_refusal
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.method import Callback
    from diransac.identification.regression.estimators import BoundEstimator
    from diransac.model import Model

_OUT_OF_BOUNDS = "out of bounds"
_SEARCH = ("sample_size", "max_iterations", "refit")


# ---------------------------------------------------------------------- variants


@dataclass(frozen=True)
class RansacMethod(ABC):
    """Algorithm 1; variants differ in which hypotheses improve, are stored, are refitted, and end the search.

    Parameters
    ----------
    criteria : Settings, optional
        Settings of the search and of the evaluation.
    estimator : object, optional
        Estimator of a sample; None: `OrdinaryLeastSquares`, or `NonlinearLeastSquares` where the model is not affine in
        its parameters.

    Raises
    ------
    SettingsError
        A setting is not used by the method, or the estimator is not an estimator.
    """

    criteria: Settings = field(default_factory=Settings)
    estimator: object = None

    name: ClassVar[str]
    uses: ClassVar[tuple[str, ...]]
    squared_error: ClassVar[bool]
    needs_all_signals = True

    def __post_init__(self) -> None:
        check_used(self.criteria, self.uses, self.name)
        if self.estimator is not None:
            as_estimator(self.estimator)

    def options(self) -> Mapping[str, Any]:
        """An empty mapping: the criteria and the estimator have the settings."""
        return {}

    def fit(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> Estimate:
        """The best hypothesis of the search, with its jackknife covariance.

        Parameters
        ----------
        dataset : Dataset
        seed : int
            Sample k depends on (seed, k) alone.
        callback : callable, optional
            Called with a `Progress` after every batch of hypotheses.

        Returns
        -------
        Estimate

        Raises
        ------
        IdentificationError
            A parameter is not identifiable from the dataset, or no hypothesis was accepted.
        LogError
            There are fewer rows than in a sample, or an initial state is missing.
        """
        settings, estimator = self.criteria, self._estimator(dataset.model)
        bound = bound_to(estimator, dataset)
        if bound.n_rows < settings.sample_size:
            raise LogError(
                f"{dataset.source}: {bound.n_rows} usable rows are fewer than sample_size = "
                f"{settings.sample_size}; give a longer log or a smaller sample_size"
            )
        try:
            found = search(self, self._samples(bound, dataset, int(seed)), callback)
        except NothingAcceptedError as error:
            if set(error.rejected) != {_OUT_OF_BOUNDS}:
                raise
            cause = cause_of_refusal(dataset.model, dataset.layout, motion_rows(dataset))
            raise IdentificationError(f"{dataset.source}: {error.counts}: {cause}") from error
        assert found.best is not None
        return fitted(
            bound,
            dataset,
            found.best.parameters,
            np.sort(found.best.rows),
            estimator=name_of(estimator),
            resolution=Resolution(settings.integrator, settings.substeps, dataset.hold),
            squared_error=self.squared_error,
            iterations=found.iterations,
            n_hypotheses=found.n_hypotheses,
            stop_reason=found.stop_reason,
            rejected=dict(found.rejected),
        )

    def regresses(self, model: Model) -> bool:
        """True unless the estimator is nonlinear."""
        return not isinstance(self._estimator(model), NonlinearLeastSquares)

    def _samples(self, bound: BoundEstimator, dataset: Dataset, seed: int) -> Samples:
        """Samples of the dataset, which methods that draw, fit and simulate them alike share."""
        settings = self.criteria

        def make() -> Samples:
            evaluator = Evaluator(dataset, choose_scoring(dataset, settings), settings)
            return Samples(bound, evaluator, sample_rows, settings.sample_size, seed)

        alike = [getattr(settings, name) for name in ("sample_size", *JUDGING, *SIMULATION)]
        return dataset.kept((Samples, bound, seed, alike), make)

    def _estimator(self, model: Model) -> Estimator:
        if self.estimator is not None:
            return as_estimator(self.estimator)
        return NonlinearLeastSquares() if model.nonlinear_parameters else OrdinaryLeastSquares()

    @abstractmethod
    def improves(self, new: Score, best: Score) -> bool:
        """Condition under which a hypothesis is considered further (Algorithm 1, line 19)."""

    @abstractmethod
    def accepts(self, new: Score, best: Score) -> bool:
        """Condition under which an improving hypothesis is stored (line 20)."""

    @abstractmethod
    def refits(self, *, stored: bool) -> bool:
        """Condition under which an improving hypothesis is refitted to its inliers (lines 25-31)."""

    @abstractmethod
    def is_finished(self, best: Score, stop_inlier_fraction: float | None) -> bool:
        """Condition under which the stored hypothesis ends the search early (line 3)."""


@dataclass(frozen=True)
class IDiransac(RansacMethod):
    """I-DIRANSAC: RMS error, eq. (3), a refit of the inliers of every improving hypothesis, a stop by inlier fraction.

    References
    ----------
    Dimmig et al. 2023, Algorithm 1.
    """

    name = "i-diransac"
    uses = (*_SEARCH, "stop_inlier_fraction", "acceptance_weights", *JUDGING, *SIMULATION)
    squared_error = False

    def improves(self, new: Score, best: Score) -> bool:
        """More inliers or less error."""
        return new.inlier_fraction > best.inlier_fraction or new.error < best.error

    def accepts(self, new: Score, best: Score) -> bool:
        """``nu_e e^2 + nu_f / f^2`` is less, eq. (3); a term of zero weight is left out."""
        if self.criteria.acceptance_weights[1] > 0.0 and new.inlier_fraction == 0.0:
            return False
        return self._cost(new) < self._cost(best)

    def _cost(self, score: Score) -> float:
        for_error, for_inliers = self.criteria.acceptance_weights
        # A product overflows to infinity, where a power of a Python float raises.
        cost = for_error * (score.error * score.error) if for_error > 0.0 else 0.0
        if for_inliers > 0.0:
            cost += for_inliers * (1.0 / score.inlier_fraction) ** 2 if score.inlier_fraction > 0.0 else np.inf
        return cost

    def refits(self, *, stored: bool) -> bool:
        """Always: improving hypotheses that were not stored, too."""
        return True

    def is_finished(self, best: Score, stop_inlier_fraction: float | None) -> bool:
        """The stored fraction of inliers has reached the threshold."""
        return stop_inlier_fraction is not None and best.inlier_fraction >= stop_inlier_fraction


@dataclass(frozen=True)
class Diransac(RansacMethod):
    """DIRANSAC, the predecessor: the smallest mean squared error is stored and refitted, up to the iteration limit.

    References
    ----------
    Dimmig et al. 2023, section III, on its reference [22].
    """

    name = "diransac"
    uses = (*_SEARCH, *JUDGING, *SIMULATION)
    squared_error = True

    def __post_init__(self) -> None:
        # It never ends early, which is what stop_inlier_fraction = None says.
        early = () if self.criteria.stop_inlier_fraction else ("stop_inlier_fraction",)
        check_used(self.criteria, (*self.uses, *early), self.name)

    def improves(self, new: Score, best: Score) -> bool:
        """Less error; inliers play no part."""
        return new.error < best.error

    def accepts(self, new: Score, best: Score) -> bool:
        """Always: whatever improves is stored."""
        return True

    def refits(self, *, stored: bool) -> bool:
        """Only of what was stored."""
        return stored

    def is_finished(self, best: Score, stop_inlier_fraction: float | None) -> bool:
        """Never early."""
        return False


# ---------------------------------------------------------------------- the search


@dataclass
class SearchState:
    """State of a search.

    Parameters
    ----------
    best : Hypothesis, optional
        Stored hypothesis; None while nothing was accepted.
    iterations : int, optional
        Number of samples drawn, the paper's k.
    n_hypotheses : int, optional
        Number of hypotheses evaluated, refits included.
    rejected : Counter of str, optional
        Number of rejected hypotheses by reason.
    stop_reason : str, optional
        Reason why the search ended.
    """

    best: Hypothesis | None = None
    iterations: int = 0
    n_hypotheses: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    stop_reason: str = ""

    @property
    def score(self) -> Score:
        """Score of the stored hypothesis; infinite error and no inliers while there is none."""
        return Score() if self.best is None else self.best.score


class NothingAcceptedError(IdentificationError):
    """No hypothesis of a search was accepted.

    Parameters
    ----------
    state : SearchState
        State at the end of the search.

    Attributes
    ----------
    rejected : mapping of str to int
        Number of rejected hypotheses by reason.
    counts : str
        The number of samples, and these numbers, as a clause.
    """

    def __init__(self, state: SearchState) -> None:
        self.rejected = dict(state.rejected)
        counts = ", ".join(f"{n} {reason}" for reason, n in state.rejected.most_common())
        self.counts = f"no hypothesis was accepted in {state.iterations} samples ({counts})"
        super().__init__(
            f"{self.counts}; check units and signs of the inputs, widen the parameter bounds or the inlier thresholds, "
            "or clean the log"
        )


def search(variant: RansacMethod, samples: Samples, callback: Callback | None = None) -> SearchState:
    """State at the end of Algorithm 1 in the given variant.

    Parameters
    ----------
    variant : RansacMethod
    samples : Samples
        Random samples, and refits to inliers.
    callback : callable, optional
        Called with a `Progress` after every batch.

    Returns
    -------
    SearchState

    Raises
    ------
    NothingAcceptedError
        No hypothesis was accepted.
    IdentificationError
        The whole log is not well-defined.
    TimeLimitError
        The time limit was reached before a hypothesis was accepted.

    References
    ----------
    Dimmig et al. 2023, Algorithm 1.
    """
    settings, state = variant.criteria, SearchState()
    try:
        for iterations in _batches(settings):
            batch = samples.batch(iterations)
            for i, score in enumerate(batch.scores(squared_error=variant.squared_error)):
                check_time()
                state.iterations += 1
                if _improves(score, state, variant):
                    _follow(batch.hypothesis(i, score), state, variant, samples)
                    if variant.is_finished(state.score, settings.stop_inlier_fraction):
                        break
            fraction = state.iterations / settings.max_iterations
            report(callback, "searching", fraction, f"{state.score.inlier_fraction:.0%} inliers")
            if variant.is_finished(state.score, settings.stop_inlier_fraction):
                break
    except TimeLimitError:
        if state.best is None:
            raise
        state.stop_reason = TIME_LIMIT
        return state
    if state.best is None:
        raise NothingAcceptedError(state)
    finished = variant.is_finished(state.score, settings.stop_inlier_fraction)
    state.stop_reason = "inlier fraction reached" if finished else "iteration limit reached"
    return state


def _batches(settings: Settings) -> Iterator[range]:
    """Iterations in batches, which grow from 16 to ``batch_size`` where the search may stop early."""
    may_stop = settings.stop_inlier_fraction is not None
    start, size = 0, min(16, settings.batch_size) if may_stop else settings.batch_size
    while start < settings.max_iterations:
        stop = min(start + size, settings.max_iterations)
        yield range(start, stop)
        start, size = stop, min(2 * size, settings.batch_size)


def _improves(score: Score | None, state: SearchState, variant: RansacMethod) -> TypeGuard[Score]:
    """True if a hypothesis improves (line 19); otherwise it is rejected, None because of the preliminary test."""
    state.n_hypotheses += 1
    if score is not None and variant.improves(score, state.score):
        return True
    state.rejected[_OUT_OF_BOUNDS if score is None else _reason(score, "no improvement")] += 1
    return False


def _reason(score: Score, otherwise: str) -> str:
    """Reason for a rejection."""
    return "diverged" if score.error == np.inf else otherwise


def _follow(hypothesis: Hypothesis, state: SearchState, variant: RansacMethod, samples: Samples) -> None:
    """Acceptance of an improving hypothesis, and of those in the chain of refits that it starts (lines 20-34)."""
    settings, n_rows = variant.criteria, samples.estimator.n_rows
    used: set[bytes] = set()
    while True:
        stored = variant.accepts(hypothesis.score, state.score)
        if stored:
            state.best = hypothesis
        else:
            state.rejected[_reason(hypothesis.score, "not accepted")] += 1
        if settings.refit == "none" or not variant.refits(stored=stored):
            return
        used.add(fingerprint(hypothesis.rows, n_rows))
        inliers = hypothesis.batch.inliers(hypothesis.lane)
        limit = state.iterations >= settings.max_iterations
        if limit or variant.is_finished(state.score, settings.stop_inlier_fraction):
            return
        if fingerprint(inliers, n_rows) in used or (refitted := samples.refit(inliers)) is None:
            return
        check_time()
        (score,) = refitted.scores(squared_error=variant.squared_error)
        if not _improves(score, state, variant):
            return
        hypothesis = refitted.hypothesis(0, score)
