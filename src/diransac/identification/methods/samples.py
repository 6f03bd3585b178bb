"""Hypotheses of a search: random samples and sets of inliers, fitted, and scored by simulation of all logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError
from diransac.identification.diagnosis import Resolution
from diransac.identification.evaluation.scoring import Scoring, mean_squared_error, rms_error
from diransac.identification.evaluation.simulation import Scores, Simulation, starts_of
from diransac.simulation.compiler.machine_code import LANES

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.regression.estimators import BoundEstimator
    from diransac.identification.settings import Settings

Sampler = Callable[[int, IntArray, int, int, int], IntArray]


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


class ScoredBatch:
    """Scores of a batch of hypotheses, and the rows that are their inliers.

    Parameters
    ----------
    scores : Scores
    weights : (n_s,) array
        Weights of eq. (2), one over each signal's unit.
    valid : sequence of (N,) bool array
        Rows of each log that count.
    """

    def __init__(self, scores: Scores, weights: FloatArray, valid: Sequence[BoolArray]) -> None:
        self._scores, self._weights, self._valid = scores, weights, valid
        self._n_rows = sum(int(rows.sum()) for rows in valid)

    def scores(self, *, squared_error: bool) -> list[Score]:
        """Score of each hypothesis, by the mean squared error or its root."""
        error_of = mean_squared_error if squared_error else rms_error
        errors = error_of(self._scores.sum_squares, self._n_rows, self._weights)
        fractions = self._scores.inlier_count / self._n_rows
        return [Score(e, f) for e, f in zip(errors.tolist(), fractions.tolist(), strict=True)]

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
    settings : Settings
        Integrator, initial state and threads.

    Raises
    ------
    LogError
        A log lacks its initial state.
    """

    def __init__(self, dataset: Dataset, scoring: Scoring, settings: Settings) -> None:
        judged = scoring.judged
        self._layout = dataset.layout
        self._weights, self._thresholds = scoring.weights[judged], scoring.thresholds[judged]
        self._min_inlier_signals = scoring.min_inlier_signals
        self._valid = [one.valid for one in dataset.segments]
        resolution = Resolution(settings.integrator, settings.substeps, dataset.hold)
        self._starts = [starts_of(one, settings.initial_state) for one in dataset.segments]
        self._simulation = Simulation(dataset, judged, resolution, settings.threads)

    def admits(self, parameters: FloatArray) -> BoolArray:
        """Preliminary test of ``(n_vectors, n)`` parameters: every one within its bounds."""
        return self._layout.admits(parameters)

    def score(self, parameters: FloatArray) -> ScoredBatch:
        """Error, inlier fraction and inliers of every hypothesis ``(n_vectors, n)``."""
        scores = self._simulation.score(self._starts, parameters, self._thresholds, self._min_inlier_signals)
        return ScoredBatch(scores, self._weights, self._valid)


@dataclass(frozen=True, eq=False, repr=False)
class Hypothesis:
    """A hypothesis and its place in a scored batch.

    Parameters
    ----------
    parameters : (n,) array
        Each in its unit.
    rows : (n_fitted,) int array
        Usable rows that the parameters were fitted to.
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


@dataclass(frozen=True, eq=False, repr=False)
class FittedSamples:
    """Random samples, their parameters, and the scores of those that pass the preliminary test.

    Parameters
    ----------
    samples : list of (n_rows,) int array
        Usable rows of each sample.
    parameters : (n_samples, n) array
        Each in its unit.
    admitted : (n_samples,) bool array
        Samples that pass the preliminary test; their places in the scored batch are in the same order.
    scored : ScoredBatch, optional
        None where all of them fail it.
    """

    samples: list[IntArray]
    parameters: FloatArray
    admitted: BoolArray
    scored: ScoredBatch | None

    def scores(self, *, squared_error: bool) -> list[Score | None]:
        """The score of every sample, None where it fails the preliminary test."""
        scores = iter([] if self.scored is None else self.scored.scores(squared_error=squared_error))
        return [next(scores) if admitted else None for admitted in self.admitted]

    def hypothesis(self, i: int, score: Score) -> Hypothesis:
        """The hypothesis of a sample that passes the preliminary test."""
        assert self.scored is not None
        lane = int(self.admitted[:i].sum())
        return Hypothesis(self.parameters[i], self.samples[i], score, self.scored, lane)


class Samples:
    """Random samples of a dataset, which are drawn, fitted and scored a batch at a time.

    Searches that differ in what they accept can share them: batches and refits are kept, up to 16 MiB in all.

    Parameters
    ----------
    estimator : BoundEstimator
        Fit of samples and inlier sets.
    evaluator : Evaluator
        Preliminary test and scores of hypotheses.
    sampler : callable
        ``(seed, iterations, n_rows, start, stop) -> rows``, as `sampling.sample_rows`.
    sample_size : int
        Least number of rows in a sample.
    seed : int
    """

    def __init__(
        self, estimator: BoundEstimator, evaluator: Evaluator, sampler: Sampler, sample_size: int, seed: int
    ) -> None:
        self.estimator, self._evaluator = estimator, evaluator
        self._sampler, self._sample_size, self._seed = sampler, sample_size, seed
        self._kept: dict[range | bytes, FittedSamples] = {}
        self._room = 2**24  # bytes

    def batch(self, iterations: range) -> FittedSamples:
        """Samples of consecutive iterations."""
        return self._kept.get(iterations) or self._keep(iterations, self._drawn(np.array(iterations)))

    def refit(self, inliers: IntArray) -> FittedSamples | None:
        """A set of inliers as the only sample; None where it is not well-defined."""
        key = fingerprint(inliers, self.estimator.n_rows)
        if key in self._kept:
            return self._kept[key]
        selected = self.estimator.select([inliers])
        if not selected.well_defined()[0]:
            return None
        return self._keep(key, self._scored([inliers], selected.fit()))

    def _keep(self, key: range | bytes, found: FittedSamples) -> FittedSamples:
        """The samples themselves, which are found under the key from now on, if there is room."""
        n_blocks = -(-len(found.samples) // LANES)
        size = sum(rows.nbytes for rows in found.samples) + n_blocks * self.estimator.n_rows
        if size <= self._room:
            self._kept[key], self._room = found, self._room - size
        return found

    def _drawn(self, iterations: IntArray) -> FittedSamples:
        """New samples, of which those that are not well-defined grow."""
        estimator = self.estimator
        samples = list(self._sampler(self._seed, iterations, estimator.n_rows, 0, self._sample_size))
        selected = estimator.select(samples)
        poor = np.flatnonzero(~selected.well_defined())
        for i in poor:
            samples[i] = self._grown(samples[i], iterations[i : i + 1])
        return self._scored(samples, (estimator.select(samples) if len(poor) else selected).fit())

    def _scored(self, samples: list[IntArray], parameters: FloatArray) -> FittedSamples:
        """Samples with their parameters ``(n_samples, n)``, and the scores of those that are admitted."""
        admitted = self._evaluator.admits(parameters)
        scored = self._evaluator.score(parameters[admitted]) if admitted.any() else None
        return FittedSamples(samples, parameters, admitted, scored)

    def _grown(self, sample: IntArray, k: IntArray) -> IntArray:
        """The sample with as many more random observations as make it well-defined (lines 6-10).

        Adding an observation never lowers the smallest eigenvalue: the least number is found by doubling, then
        bisection.
        """
        estimator, low, whole = self.estimator, len(sample), sample
        while not estimator.select([whole]).well_defined()[0]:
            low = len(whole)
            if low == estimator.n_rows:
                raise IdentificationError("the whole log is not well-defined: its parameters are not identifiable")
            more = self._sampler(self._seed, k, estimator.n_rows, low, min(2 * low, estimator.n_rows))[0]
            whole = np.concatenate([whole, more])
        high = len(whole)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if estimator.select([whole[:middle]]).well_defined()[0] else (middle, high)
        return whole[:high]


def fingerprint(rows: IntArray, n_rows: int) -> bytes:
    """One bit per row: a chain of thousands of refits keeps all its inlier sets."""
    chosen = np.zeros(n_rows, bool)
    chosen[rows] = True
    return np.packbits(chosen).tobytes()


def sample_rows(seed: int, iterations: npt.ArrayLike, n_rows: int, start: int, stop: int) -> IntArray:
    """Positions ``start`` to ``stop`` of the keyed permutations of ``range(n_rows)``.

    Sample ``k`` is the beginning of a pseudo-random permutation of the rows whose key is ``(seed, k)``.  No state is
    carried from one sample to the next, a sample is extended by reading on, and all arithmetic is integer, so that
    samples are the same on every machine.

    Parameters
    ----------
    seed : int
        Any integer.
    iterations : (n,) array_like
        Index k of each sample.
    n_rows : int
        Length of the permutation.
    start, stop : int
        Positions that are read, ``0 <= start <= stop <= n_rows``.

    Returns
    -------
    (n, stop - start) int array
        Distinct rows of the log for each sample; other positions of the same permutation do not repeat them.

    References
    ----------
    Luby and Rackoff 1988 (a Feistel network of random round functions is a random permutation); Black and Rogaway 2002
    (cycle walking to a domain of any size); Steele, Lea, Flood 2014 (the SplitMix64 mixer); Salmon et al. 2011
    (counter-based random numbers).
    """
    half = max(1, -(-(n_rows - 1).bit_length() // 2))
    of_sample = _mixed(_mixed(np.array([int(seed) % 2**64], np.uint64)) + np.asarray(iterations, np.uint64))
    # Six rounds pass a chi-square test of pairs of positions from 30 rows on; fewer rows need twelve.
    rounds = np.arange(1, 7 if half > 3 else 13, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    keys = _mixed(of_sample + rounds[:, None])
    positions = np.tile(np.arange(start, stop, dtype=np.uint64), (len(of_sample), 1))
    found = _permuted(positions, keys[:, :, None], half)
    while (outside := found >= n_rows).any():  # until the network takes all of them into the range
        found[outside] = _permuted(found[outside], keys[:, np.nonzero(outside)[0]], half)
    return found.astype(np.int64)


def _permuted(x: npt.NDArray[np.uint64], keys: npt.NDArray[np.uint64], half: int) -> npt.NDArray[np.uint64]:
    """A Feistel network: numbers of ``2 half`` bits, permuted by the keys of its rounds."""
    shift, low = np.uint64(half), np.uint64(2**half - 1)
    left, right = x >> shift, x & low
    for key in keys:
        left, right = right, left ^ (_mixed(right + key) & low)
    return left << shift | right


def _mixed(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """SplitMix64's finalizer, a bijection of 64-bit words."""
    for places, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> np.uint64(places))) * np.uint64(factor)
    return x ^ (x >> np.uint64(31))
