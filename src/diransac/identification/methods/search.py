"""Algorithm 1: random minimal samples, simulated over the whole log, judged by consensus, refitted to their inliers.

Samples do not depend on what was found so far, so hypotheses are fitted and simulated a batch at a time
("speculate"); their scores are then walked in order exactly as the algorithm says ("replay"), and only a chain of
refits runs on its own.  The answer is that of the sequential algorithm, whatever the batch size.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError
from diransac.identification.methods.consensus import Score, Variant

if TYPE_CHECKING:
    from diransac.identification.estimators import BoundEstimator
    from diransac.identification.settings import Settings

__all__ = ["Evaluator", "Hypothesis", "Outcome", "Progress", "search"]

Sampler = Callable[[int, IntArray, int, int, int], IntArray]
Progress = Callable[[int, int, Score], None]

_FIRST_BATCH = 16


class Evaluator(Protocol):
    """What simulates hypotheses over the whole log."""

    def admits(self, parameters: FloatArray) -> BoolArray:
        """Preliminary test of ``(n, n_p)`` parameters: the model's bounds."""

    def scores(self, parameters: FloatArray) -> list[Score]:
        """Error and inlier fraction of every hypothesis ``(n, n_p)``."""

    def inliers(self, parameters: FloatArray) -> IntArray:
        """Usable rows that are inliers of one hypothesis ``(n_p,)``, ascending."""


@dataclass(frozen=True)
class Hypothesis:
    """Parameters ``(n_p,)``, the usable rows that they were fitted to, ascending, and their score."""

    parameters: FloatArray
    rows: IntArray
    score: Score


@dataclass
class Outcome:
    """What a search found.

    Parameters
    ----------
    best : the stored hypothesis; None while nothing was accepted
    iterations : k, samples drawn
    n_hypotheses : hypotheses looked at, refits included
    rejected : hypotheses that went no further, by reason
    stop_reason : why it ended
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


def search(
    variant: Variant,
    settings: Settings,
    estimator: BoundEstimator,
    evaluator: Evaluator,
    sampler: Sampler,
    seed: int,
    progress: Progress | None = None,
) -> Outcome:
    """Algorithm 1 in the given variant.

    Parameters
    ----------
    sampler : ``(seed, iterations, n_rows, start, stop) -> rows``, as `sampling.sample_rows`
    progress : called with (k, max_iterations, score of the stored hypothesis) after every batch

    Raises IdentificationError: the whole log is not well-defined, or nothing was ever accepted.
    References: Dimmig et al. 2023, Algorithm 1.
    """
    outcome = Outcome()
    for batch in _batches(settings):
        drawn = _speculate(batch, settings, estimator, evaluator, sampler, seed)
        for hypothesis in drawn:
            if variant.is_finished(outcome.score, settings.stop_inlier_fraction):
                break
            outcome.iterations += 1
            _replay(hypothesis, outcome, variant, settings, estimator, evaluator)
        if progress is not None:
            progress(outcome.iterations, settings.max_iterations, outcome.score)
        if variant.is_finished(outcome.score, settings.stop_inlier_fraction):
            break
    if outcome.best is None:
        raise IdentificationError(_nothing_accepted(outcome))
    finished = variant.is_finished(outcome.score, settings.stop_inlier_fraction)
    outcome.stop_reason = "inlier fraction reached" if finished else "iteration limit reached"
    return outcome


def _batches(settings: Settings) -> Iterator[IntArray]:
    """Iterations in batches that grow from a few to ``batch_size`` where the search may stop early, as many do."""
    may_stop = settings.stop_inlier_fraction is not None
    start, size = 0, min(_FIRST_BATCH, settings.batch_size) if may_stop else settings.batch_size
    while start < settings.max_iterations:
        stop = min(start + size, settings.max_iterations)
        yield np.arange(start, stop)
        start, size = stop, min(2 * size, settings.batch_size)


def _speculate(
    batch: IntArray,
    settings: Settings,
    estimator: BoundEstimator,
    evaluator: Evaluator,
    sampler: Sampler,
    seed: int,
) -> list[Hypothesis | None]:
    """The hypothesis of every sample in the batch, None where it fails the preliminary test."""
    samples: list[IntArray] = list(sampler(seed, batch, estimator.n_rows, 0, settings.sample_size))
    for i in np.flatnonzero(~estimator.well_defined(samples)):
        samples[i] = _grow(samples[i], batch[i : i + 1], estimator, sampler, seed)
    parameters = estimator.fit(samples)
    admitted = np.flatnonzero(evaluator.admits(parameters))
    scores = dict(zip(admitted.tolist(), evaluator.scores(parameters[admitted]), strict=True)) if len(admitted) else {}
    return [Hypothesis(parameters[i], np.sort(s), scores[i]) if i in scores else None for i, s in enumerate(samples)]


def _grow(sample: IntArray, k: IntArray, estimator: BoundEstimator, sampler: Sampler, seed: int) -> IntArray:
    """The sample with as many more random observations as make it well-defined (lines 6-10).

    Adding an observation never lowers the smallest eigenvalue: the least number is found by doubling, then bisection.
    """
    low, whole = len(sample), sample
    while not estimator.well_defined([whole])[0]:
        low = len(whole)
        if low == estimator.n_rows:
            raise IdentificationError("the whole log is not well-defined: it does not determine the parameters")
        more = sampler(seed, k, estimator.n_rows, low, min(2 * low, estimator.n_rows))[0]
        whole = np.concatenate([whole, more])
    high = len(whole)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if estimator.well_defined([whole[:middle]])[0] else (middle, high)
    return whole[:high]


def _replay(
    hypothesis: Hypothesis | None,
    outcome: Outcome,
    variant: Variant,
    settings: Settings,
    estimator: BoundEstimator,
    evaluator: Evaluator,
) -> None:
    """One sample and the chain of refits that it starts (lines 13-34)."""
    used: set[bytes] = set()
    while True:
        outcome.n_hypotheses += 1
        if hypothesis is None:
            outcome.rejected["out of bounds"] += 1
            return
        stored = _judge(hypothesis, outcome, variant)
        if stored is None or settings.refit == "none" or not variant.refits(stored=stored):
            return
        used.add(_fingerprint(hypothesis.rows, estimator.n_rows))
        inliers = evaluator.inliers(hypothesis.parameters)
        if _fingerprint(inliers, estimator.n_rows) in used or not estimator.well_defined([inliers])[0]:
            return
        limit = outcome.iterations >= settings.max_iterations
        if limit or variant.is_finished(outcome.score, settings.stop_inlier_fraction):
            return
        hypothesis = _refit(inliers, estimator, evaluator)


def _fingerprint(rows: IntArray, n_rows: int) -> bytes:
    """A bit a row: a chain may be thousands of refits long, and knows every set of inliers that it has met."""
    chosen = np.zeros(n_rows, bool)
    chosen[rows] = True
    return np.packbits(chosen).tobytes()


def _judge(hypothesis: Hypothesis, outcome: Outcome, variant: Variant) -> bool | None:
    """Whether a hypothesis was stored; None where it does not even improve (lines 19-23)."""
    score = hypothesis.score
    if not variant.improves(score, outcome.score):
        outcome.rejected["diverged" if np.isinf(score.error) else "no improvement"] += 1
        return None
    if not variant.accepts(score, outcome.score):
        outcome.rejected["diverged" if np.isinf(score.error) else "not accepted"] += 1
        return False
    outcome.best = hypothesis
    return True


def _refit(inliers: IntArray, estimator: BoundEstimator, evaluator: Evaluator) -> Hypothesis | None:
    """The hypothesis of an inlier set, None where it fails the preliminary test."""
    parameters = estimator.fit([inliers])
    if not evaluator.admits(parameters)[0]:
        return None
    return Hypothesis(parameters[0], inliers, evaluator.scores(parameters)[0])


def _nothing_accepted(outcome: Outcome) -> str:
    counts: Sequence[str] = [f"{n} {reason}" for reason, n in outcome.rejected.most_common()]
    return (
        f"no hypothesis was accepted in {outcome.iterations} samples ({', '.join(counts)}); check units and signs of "
        "the inputs, widen the parameter bounds or the inlier thresholds, or clean the log"
    )
