"""Algorithm 1: random minimal samples, scored by simulation of all logs, refitted to their inliers.

Samples do not depend on earlier results, so hypotheses are fitted and simulated a batch at a time ("speculate"); their
scores are then walked in order exactly as in the algorithm ("replay"), and only a chain of refits runs on its own.
The answer is that of the sequential algorithm, whatever the batch size.
"""

from __future__ import annotations

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

# Reason for the rejection of a hypothesis that fails the preliminary test.
_OUT_OF_BOUNDS = "out of bounds"


# ---------------------------------------------------------------------- variants


@dataclass(frozen=True)
class Diransac:
    """DIRANSAC, the predecessor: the smallest mean squared error is stored and refitted, up to the iteration limit.

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

    References
    ----------
    Dimmig et al. 2023, section III, on its reference [22].
    """

    criteria: Settings = field(default_factory=Settings)
    estimator: object = None

    name: ClassVar[str] = "diransac"
    uses: ClassVar[tuple[str, ...]] = ("sample_size", "max_iterations", "refit", *JUDGING, *SIMULATION)
    squared_error: ClassVar[bool] = True
    needs_all_signals: ClassVar[bool] = True

    def __post_init__(self) -> None:
        # A search that never ends early is what stop_inlier_fraction = None says.
        early = () if self.criteria.stop_inlier_fraction else ("stop_inlier_fraction",)
        check_used(self.criteria, (*self.uses, *early), self.name)
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
            state = search(self, self._samples(bound, dataset, int(seed)), callback)
        except NothingAcceptedError as error:
            if set(error.rejected) != {_OUT_OF_BOUNDS}:
                raise
            cause = cause_of_refusal(dataset.model, dataset.layout, motion_rows(dataset))
            raise IdentificationError(f"{dataset.source}: {error.counts}: {cause}") from error
        assert state.best is not None
        return fitted(
            bound, dataset, state.best.parameters, np.sort(state.best.rows), estimator=name_of(estimator),
            resolution=Resolution(settings.integrator, settings.substeps, dataset.hold),
            squared_error=self.squared_error, iterations=state.iterations, n_hypotheses=state.n_hypotheses,
            stop_reason=state.stop_reason, rejected=dict(state.rejected),
        )  # fmt: skip

    def regresses(self, model: Model) -> bool:
        """True unless the estimator is nonlinear."""
        return not isinstance(self._estimator(model), NonlinearLeastSquares)

    def _estimator(self, model: Model) -> Estimator:
        if self.estimator is not None:
            return as_estimator(self.estimator)
        return NonlinearLeastSquares() if model.nonlinear_parameters else OrdinaryLeastSquares()

    def _samples(self, bound: BoundEstimator, dataset: Dataset, seed: int) -> Samples:
        """Samples of the dataset, which methods that draw, fit and simulate them alike share."""
        settings = self.criteria

        def make() -> Samples:
            evaluator = Evaluator(dataset, choose_scoring(dataset, settings), settings)
            return Samples(bound, evaluator, sample_rows, settings.sample_size, seed)

        alike = [getattr(settings, name) for name in ("sample_size", *JUDGING, *SIMULATION)]
        return dataset.kept((Samples, bound, seed, alike), make)

    def improves(self, new: Score, best: Score) -> bool:
        """Condition under which a hypothesis is considered further (Algorithm 1, line 19): less error."""
        return new.error < best.error

    def accepts(self, new: Score, best: Score) -> bool:
        """Condition under which an improving hypothesis is stored (line 20): always."""
        return True

    def refits(self, *, stored: bool) -> bool:
        """Condition under which an improving hypothesis is refitted to its inliers (lines 25-31): it was stored."""
        return stored

    def is_finished(self, best: Score) -> bool:
        """Condition under which the stored hypothesis ends the search early (line 3): never."""
        return False


@dataclass(frozen=True)
class IDiransac(Diransac):
    """I-DIRANSAC: RMS error, eq. (3), a refit of the inliers of every improving hypothesis, a stop by inlier fraction.

    References
    ----------
    Dimmig et al. 2023, Algorithm 1.
    """

    name = "i-diransac"
    uses = (*Diransac.uses[:3], "stop_inlier_fraction", "acceptance_weights", *JUDGING, *SIMULATION)
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

    def is_finished(self, best: Score) -> bool:
        """The stored fraction of inliers has reached the threshold."""
        threshold = self.criteria.stop_inlier_fraction
        return threshold is not None and best.inlier_fraction >= threshold


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


def search(variant: Diransac, samples: Samples, callback: Callback | None = None) -> SearchState:
    """State at the end of Algorithm 1 in the given variant.

    Parameters
    ----------
    variant : Diransac
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
    state = SearchState()
    try:
        for iterations in _batches(variant.criteria):
            batch = samples.batch(iterations)
            for i, score in enumerate(batch.scores(squared_error=variant.squared_error)):
                check_time()
                state.iterations += 1
                if _improves(score, state, variant):
                    _follow(batch.hypothesis(i, score), state, variant, samples)
                    if variant.is_finished(state.score):
                        break
            fraction = state.iterations / variant.criteria.max_iterations
            report(callback, "searching", fraction, f"{state.score.inlier_fraction:.0%} inliers")
            if variant.is_finished(state.score):
                break
    except TimeLimitError:
        if state.best is None:
            raise
        state.stop_reason = TIME_LIMIT
        return state
    if state.best is None:
        raise NothingAcceptedError(state)
    finished = variant.is_finished(state.score)
    state.stop_reason = "inlier fraction reached" if finished else "iteration limit reached"
    return state


def _batches(settings: Settings) -> Iterator[range]:
    """Iterations in batches, which grow from 16 to ``batch_size`` where the search may stop early."""
    start, size = 0, settings.batch_size if settings.stop_inlier_fraction is None else min(16, settings.batch_size)
    while start < settings.max_iterations:
        yield range(start, min(start + size, settings.max_iterations))
        start, size = start + size, min(2 * size, settings.batch_size)


def _improves(score: Score | None, state: SearchState, variant: Diransac) -> TypeGuard[Score]:
    """True if a hypothesis improves (line 19); otherwise it is rejected, None because of the preliminary test."""
    state.n_hypotheses += 1
    if score is not None and variant.improves(score, state.score):
        return True
    state.rejected[_OUT_OF_BOUNDS if score is None else _reason(score, "no improvement")] += 1
    return False


def _reason(score: Score, otherwise: str) -> str:
    """Reason for a rejection."""
    return "diverged" if score.error == np.inf else otherwise


def _follow(hypothesis: Hypothesis, state: SearchState, variant: Diransac, samples: Samples) -> None:
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
        if limit or variant.is_finished(state.score):
            return
        if fingerprint(inliers, n_rows) in used or (refitted := samples.refit(inliers)) is None:
            return
        check_time()
        (score,) = refitted.scores(squared_error=variant.squared_error)
        if not _improves(score, state, variant):
            return
        hypothesis = refitted.hypothesis(0, score)
