"""Algorithm 1: random minimal samples, scored by simulation of all logs, refitted to their inliers.

Samples do not depend on earlier results, so hypotheses are fitted and simulated a batch at a time ("speculate"); their
scores are then walked in order exactly as in the algorithm ("replay"), and only a chain of refits runs on its own.
The answer is that of the sequential algorithm, whatever the batch size.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError, LogError, TimeLimitError
from diransac.identification.estimate import TIME_LIMIT, Estimate, Resolution
from diransac.identification.estimators import Estimator, OrdinaryLeastSquares, as_estimator, name_of
from diransac.identification.evaluation import (
    Scores,
    Scoring,
    Simulation,
    choose_scoring,
    mean_squared_error,
    rms_error,
    stretches_of,
)
from diransac.identification.method import report
from diransac.identification.methods.least_squares import bound_to, fitted
from diransac.identification.nonlinear import NonlinearLeastSquares
from diransac.identification.refusal import cause_of_refusal, motion_rows
from diransac.identification.sampling import sample_rows
from diransac.identification.settings import JUDGING, SIMULATION, Settings, check_used
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.estimators import BoundEstimator
    from diransac.identification.method import Callback
    from diransac.model import Model

__all__ = [
    "Diransac",
    "Evaluator",
    "Hypothesis",
    "IDiransac",
    "NothingAcceptedError",
    "RansacMethod",
    "Score",
    "ScoredBatch",
    "SearchState",
    "search",
]

Sampler = Callable[[int, IntArray, int, int, int], IntArray]

_FIRST_BATCH = 16
_OUT_OF_BOUNDS = "out of bounds"
_SEARCH = ("sample_size", "max_iterations", "refit")


# ---------------------------------------------------------------------- consensus


@dataclass(frozen=True)
class Score:
    """Score of a hypothesis.

    Parameters
    ----------
    error : float, optional
        Eq. (2), or its mean square; infinite where the simulation diverged.
    inlier_fraction : float, optional
        Number of inliers over the number of rows that count.
    """

    error: float = np.inf
    inlier_fraction: float = 0.0


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
        evaluator = Evaluator(dataset, choose_scoring(dataset, settings), self)
        if bound.n_rows < settings.sample_size:
            raise LogError(
                f"{dataset.source}: {bound.n_rows} usable rows are fewer than sample_size = "
                f"{settings.sample_size}; give a longer log or a smaller sample_size"
            )
        try:
            found = search(self, bound, evaluator, sample_rows, int(seed), callback)
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


# ---------------------------------------------------------------------- hypotheses


class ScoredBatch:
    """Scores of a batch of hypotheses, and the rows that are their inliers.

    Parameters
    ----------
    scores : Scores
    errors : (n_lanes,) array
        Model-fit error of each hypothesis.
    n_rows : int
        Number of rows that count.
    valid : sequence of (N,) bool array
        Rows of each log that count.
    """

    def __init__(self, scores: Scores, errors: FloatArray, n_rows: int, valid: Sequence[BoolArray]) -> None:
        self._scores, self._valid = scores, valid
        fractions = scores.inlier_count / n_rows
        self.scores = [Score(e, f) for e, f in zip(errors.tolist(), fractions.tolist(), strict=True)]

    def inliers(self, lane: int) -> IntArray:
        """Usable rows, numbered log after log, that are inliers of one hypothesis, ascending."""
        masks = self._scores.inlier_masks(lane)
        return np.flatnonzero(np.concatenate([m[v] for m, v in zip(masks, self._valid, strict=True)]))


class Evaluator:
    """Preliminary test, simulation, error and inliers of hypotheses over a dataset.

    Parameters
    ----------
    dataset : Dataset
    scoring : Scoring
        Weights and thresholds.
    variant : RansacMethod
        Method whose error and criteria are used.

    Raises
    ------
    LogError
        A log lacks its initial state.
    """

    def __init__(self, dataset: Dataset, scoring: Scoring, variant: RansacMethod) -> None:
        settings, judged = variant.criteria, scoring.judged
        self._dataset = dataset
        self._error_of = mean_squared_error if variant.squared_error else rms_error
        self._weights, self._thresholds = scoring.weights[judged], scoring.thresholds[judged]
        self._min_inlier_signals = scoring.min_inlier_signals
        self._valid = [one.valid for one in dataset.segments]
        resolution = Resolution(settings.integrator, settings.substeps, dataset.hold)
        stretches = [stretches_of(one, settings.initial_state) for one in dataset.segments]
        self._simulation = Simulation(dataset, judged, resolution, stretches, settings.threads)
        self._simulation.starts  # noqa: B018  refuses a log without an initial state

    def admits(self, parameters: FloatArray) -> BoolArray:
        """Preliminary test of ``(n_vectors, n)`` parameters: every one within its bounds."""
        return self._dataset.layout.admits(parameters)

    def score(self, parameters: FloatArray) -> ScoredBatch:
        """Error, inlier fraction and inliers of every hypothesis ``(n_vectors, n)``."""
        scores = self._simulation.score(parameters, self._thresholds, self._min_inlier_signals)
        n_rows = self._dataset.n_rows
        return ScoredBatch(scores, self._error_of(scores.sum_squares, n_rows, self._weights), n_rows, self._valid)


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis and its place in a scored batch.

    Parameters
    ----------
    parameters : (n,) array
        Each in its unit.
    rows : (n_fitted,) int array
        Usable rows that the parameters were fitted to, ascending.
    score : Score
        Error and inlier fraction.
    batch : ScoredBatch
        Scores of the batch that the hypothesis belongs to.
    lane : int
        Index of the hypothesis in the batch.
    """

    parameters: FloatArray
    rows: IntArray
    score: Score
    batch: ScoredBatch
    lane: int


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


def search(
    variant: RansacMethod,
    estimator: BoundEstimator,
    evaluator: Evaluator,
    sampler: Sampler,
    seed: int,
    callback: Callback | None = None,
) -> SearchState:
    """State at the end of Algorithm 1 in the given variant.

    Parameters
    ----------
    variant : RansacMethod
    estimator : BoundEstimator
        Fit of samples and inlier sets.
    evaluator : Evaluator
        Preliminary test and scores of hypotheses.
    sampler : callable
        ``(seed, iterations, n_rows, start, stop) -> rows``, as `sampling.sample_rows`.
    seed : int
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
        for batch in _batches(settings):
            drawn = _speculate(batch, settings.sample_size, estimator, evaluator, sampler, seed)
            for hypothesis in drawn:
                if variant.is_finished(state.score, settings.stop_inlier_fraction):
                    break
                state.iterations += 1
                _replay(hypothesis, state, variant, estimator, evaluator)
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


def _batches(settings: Settings) -> Iterator[IntArray]:
    """Iterations in batches, which grow from 16 to ``batch_size`` where the search may stop early."""
    may_stop = settings.stop_inlier_fraction is not None
    start, size = 0, min(_FIRST_BATCH, settings.batch_size) if may_stop else settings.batch_size
    while start < settings.max_iterations:
        stop = min(start + size, settings.max_iterations)
        yield np.arange(start, stop)
        start, size = stop, min(2 * size, settings.batch_size)


def _speculate(
    batch: IntArray,
    sample_size: int,
    estimator: BoundEstimator,
    evaluator: Evaluator,
    sampler: Sampler,
    seed: int,
) -> list[Hypothesis | None]:
    """The hypothesis of every sample in the batch, None where it fails the preliminary test."""
    samples: list[IntArray] = list(sampler(seed, batch, estimator.n_rows, 0, sample_size))
    selected = estimator.select(samples)
    poor = np.flatnonzero(~selected.well_defined())
    for i in poor:
        samples[i] = _grow(samples[i], batch[i : i + 1], estimator, sampler, seed)
    parameters = (estimator.select(samples) if len(poor) else selected).fit()
    admitted = np.flatnonzero(evaluator.admits(parameters))
    if not len(admitted):
        return [None] * len(samples)
    scored, lanes = evaluator.score(parameters[admitted]), {int(i): lane for lane, i in enumerate(admitted)}
    return [
        Hypothesis(parameters[i], np.sort(rows), scored.scores[lanes[i]], scored, lanes[i]) if i in lanes else None
        for i, rows in enumerate(samples)
    ]


def _grow(sample: IntArray, k: IntArray, estimator: BoundEstimator, sampler: Sampler, seed: int) -> IntArray:
    """The sample with as many more random observations as make it well-defined (lines 6-10).

    Adding an observation never lowers the smallest eigenvalue: the least number is found by doubling, then bisection.
    """
    low, whole = len(sample), sample
    while not estimator.select([whole]).well_defined()[0]:
        low = len(whole)
        if low == estimator.n_rows:
            raise IdentificationError("the whole log is not well-defined: its parameters are not identifiable")
        more = sampler(seed, k, estimator.n_rows, low, min(2 * low, estimator.n_rows))[0]
        whole = np.concatenate([whole, more])
    high = len(whole)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if estimator.select([whole[:middle]]).well_defined()[0] else (middle, high)
    return whole[:high]


def _replay(
    hypothesis: Hypothesis | None,
    state: SearchState,
    variant: RansacMethod,
    estimator: BoundEstimator,
    evaluator: Evaluator,
) -> None:
    """One sample and the chain of refits that it starts (lines 13-34)."""
    settings = variant.criteria
    used: set[bytes] = set()
    while True:
        check_time()
        state.n_hypotheses += 1
        if hypothesis is None:
            state.rejected[_OUT_OF_BOUNDS] += 1
            return
        stored = _judge(hypothesis, state, variant)
        if stored is None or settings.refit == "none" or not variant.refits(stored=stored):
            return
        used.add(_fingerprint(hypothesis.rows, estimator.n_rows))
        inliers = hypothesis.batch.inliers(hypothesis.lane)
        if _fingerprint(inliers, estimator.n_rows) in used:
            return
        selected = estimator.select([inliers])
        if not selected.well_defined()[0]:
            return
        limit = state.iterations >= settings.max_iterations
        if limit or variant.is_finished(state.score, settings.stop_inlier_fraction):
            return
        hypothesis = _refit(inliers, selected.fit(), evaluator)


def _fingerprint(rows: IntArray, n_rows: int) -> bytes:
    """One bit per row: a chain of thousands of refits keeps all its inlier sets."""
    chosen = np.zeros(n_rows, bool)
    chosen[rows] = True
    return np.packbits(chosen).tobytes()


def _judge(hypothesis: Hypothesis, state: SearchState, variant: RansacMethod) -> bool | None:
    """True if a hypothesis was stored, False if it improves only, None otherwise (lines 19-23)."""
    score = hypothesis.score
    if not variant.improves(score, state.score):
        state.rejected["diverged" if np.isinf(score.error) else "no improvement"] += 1
        return None
    if not variant.accepts(score, state.score):
        state.rejected["diverged" if np.isinf(score.error) else "not accepted"] += 1
        return False
    state.best = hypothesis
    return True


def _refit(inliers: IntArray, parameters: FloatArray, evaluator: Evaluator) -> Hypothesis | None:
    """The hypothesis of an inlier set with its parameters ``(1, n)``, None where it fails the preliminary test."""
    if not evaluator.admits(parameters)[0]:
        return None
    scored = evaluator.score(parameters)
    return Hypothesis(parameters[0], inliers, scored.scores[0], scored, 0)
