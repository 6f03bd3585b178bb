"""Competition of estimates: sources propose them, and the judge compares their predictions.

Where the exact model of a fit predicts a log within its noise, there is no competition.  Elsewhere the estimates of the
joint fit compete with least squares of all rows and with simulation error.  Where one of these beats or contradicts the
fit, which may be at a local optimum, another one begins with its parameters and its motion, and the likelier counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError, TimeLimitError
from diransac.identification.estimate import Competition, Competitor, predicts
from diransac.identification.method import report, within
from diransac.identification.methods.lo_diransac.interval_effects import effect_of_intervals
from diransac.identification.methods.lo_diransac.judge import Comparison, Judge, Scores
from diransac.identification.methods.lo_diransac.local_search import fewest_parts
from diransac.identification.methods.lo_diransac.motion_equations import unexplained
from diransac.identification.methods.lo_diransac.projection import (
    ProjectedEstimate,
    fitted_parameters,
    projected_candidates,
    with_parameters,
)
from diransac.identification.methods.lo_diransac.search import (
    Decided,
    Searched,
    likeliest,
    searched,
)
from diransac.identification.methods.lo_diransac.segments import ActingInputs, inlying_samples
from diransac.identification.methods.lo_diransac.simulation_error import simulation_error_candidates
from diransac.identification.methods.lo_diransac.smoothing import Motion
from diransac.identification.methods.lo_diransac.sources import (
    Blocks,
    Candidate,
    jackknife,
    least_squares_candidates,
)
from diransac.simulation import HOLDS

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

# Noise over the spread of the signal, and its correlation from sample to sample, up to which an exact model is right.
_WITHIN, _WHITE = 0.2, 0.5
_INLYING, _TINY, _LEAST_NOISE = 0.5, 1e-300, 1e-4
# Half width of an interval of 95 %, standard errors.
_INTERVAL = 1.96
# Samples of the intervals of a fit from an estimate at most, as far as their number has divisors.
_SHORT = 25


def is_settled(explanation: Explanation, motion: Motion) -> bool:
    """True if the exact model predicts the log within the noise of its most accurate signal.

    That noise is small beside the signal, and hardly correlated from sample to sample.  Outliers are the minority of
    every signal: a fit that has lost one takes the rest for them.

    Parameters
    ----------
    explanation : Explanation
    motion : Motion
        Smoothed motion over the rows of the intervals.

    Returns
    -------
    bool
    """
    if not explanation.exact:
        return False
    intervals, fit = explanation.intervals, explanation.refinement.fit
    share = np.where(intervals.known.any(axis=0), fit.noise.sigma / np.maximum(motion.spread, _TINY), np.inf)
    best = int(np.argmin(share))
    inlying = fit.noise.inlying(fit.residuals, intervals.known)[:, best] > _INLYING
    e = fit.residuals[:, best] / fit.noise.sigma[best]
    both = inlying[1:] & inlying[:-1]
    correlation = (e[1:] * e[:-1])[both].mean() if both.any() else 0.0
    explains_most = (fit.noise.pi < _INLYING)[intervals.known.any(axis=0)].all()
    return bool(share[best] < _WITHIN and correlation < _WHITE and explains_most)


def compete(
    settings: LoDiransacSettings,
    dataset: Dataset,
    whole: tuple[ShootingIntervals, Motion, tuple[str, ...]],
    seed: int,
    callback: Callback | None,
) -> Searched:
    """The likeliest explanation of the logs, with the estimate that predicts best.

    Where no search from samples succeeds, or its fit is challenged, another one begins with the best of the other
    estimates; the likeliest counts.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset
    whole : (ShootingIntervals, Motion, tuple of str)
        As from `prepared`.
    seed : int
    callback : callable or None

    Returns
    -------
    Searched

    Raises
    ------
    IdentificationError
        The search fails, and no other estimate predicts much better than that nothing changes.
    TimeLimitError
        The time limit was reached before a search had converged.
    """
    refused: Exception | None = None
    try:
        first = likeliest(settings, dataset, seed, callback, whole)
    except (IdentificationError, np.linalg.LinAlgError) as error:
        first, refused = None, error
    if first is not None and not first.likeliest.complete:
        return first
    if first is not None and is_settled(first.likeliest, first.motion):
        return first
    intervals, motion, notes = whole
    if first is not None:
        own, motion, notes = first.likeliest.intervals, first.motion, first.notes
        intervals = replace(intervals, substeps=own.substeps, recorded=own.recorded)
    contest = Contest(settings, dataset, intervals, motion, seed, callback)
    try:
        contest.add_sources(first)
        found = contest.outcome(first, notes)
    except TimeLimitError:
        if first is None:
            raise
        return replace(first, likeliest=replace(first.likeliest, complete=False))
    if found is not None and (first is not None or found.decided is None or found.decided.summary.predicts):
        return found
    if isinstance(refused, IdentificationError):
        raise refused
    failed = f"the joint fit fails numerically ({refused}), and no other estimate predicts the log"
    raise IdentificationError(f"{dataset.source}: {failed}; compare the model's constants with the machine")


class _Entry(NamedTuple):
    """A candidate, and the fit or the motion that it came from."""

    candidate: Candidate
    origin: Motion | Explanation


class _Judgement(NamedTuple):
    """Scores of all candidates, in their order, and their comparison."""

    judge: Judge
    scores: list[Scores]
    comparison: Comparison


@dataclass
class Contest:
    """Candidates of one dataset, and their comparison.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset
    intervals : ShootingIntervals
        With inputs and measurements as recorded.
    motion : Motion
        Smoothed motion over their rows.
    seed : int
    callback : callable or None
    """

    settings: LoDiransacSettings
    dataset: Dataset
    intervals: ShootingIntervals
    motion: Motion
    seed: int
    callback: Callback | None

    def __post_init__(self) -> None:
        self.blocks = Blocks.of(self.intervals)
        self.entries: list[_Entry] = []

    @property
    def candidates(self) -> list[Candidate]:
        """In the order in which they are preferred where they predict as well."""
        return [x.candidate for x in self.entries]

    def add_fit(self, found: Searched) -> None:
        """Let the estimates of a joint fit take part, before the others, and instead of those of another fit."""
        some = _estimates_of_fit(found.likeliest, self._acting(found), self.blocks, projection=self.settings.projection)
        others = [x for x in self.entries if isinstance(x.origin, Motion)]
        self.entries = [*(_Entry(x, found.likeliest) for x in some), *others]

    def _acting(self, found: Searched) -> ActingInputs:
        """Inputs as they act in a fit."""
        intervals = found.likeliest.intervals
        return ActingInputs(
            intervals.inputs, intervals.hold, found.timing(forced=self.settings.forces_timing), fitted=True
        )

    def add_sources(self, first: Searched | None) -> None:
        """Add a fit's estimates, least squares of all rows, and simulation error, which starts from all of these."""
        sources, dataset = self.settings.sources, self.dataset
        intervals = self.intervals if first is None else first.corrected(self.intervals)
        holds = [dataset.input_hold] if dataset.input_hold else list(HOLDS)
        actings = [ActingInputs.recorded(self.intervals, hold) for hold in holds]
        if first is not None:
            self.add_fit(first)
            own = self._acting(first)
            actings = [own] if self.settings.forces_timing else [*actings, own] if own.differs(actings) else actings
        if "least squares" in sources and not self.settings.forces_timing:
            report(self.callback, "least squares", 0.88)
            found = least_squares_candidates(dataset, self.intervals, self.blocks)
            self.entries += [_Entry(x, self.motion) for x in found]
        if "simulation error" in sources:
            report(self.callback, "simulation error", 0.885)
            simulated = simulation_error_candidates(
                intervals, self.motion, self._starts(first), actings, self.seed, self.blocks,
                outliers=self.settings.outliers,
            )  # fmt: skip
            self.entries += [_Entry(x, motion) for x, motion in simulated]

    def _starts(self, first: Searched | None) -> FloatArray:
        """Parameters ``(m, n)`` from which simulation error starts, within the bounds."""
        found, given = [x.parameters for x in self.candidates], self.settings.start_of(self.dataset.layout)
        found += [] if given is None else [given]
        if first is not None:
            found += [first.result.parameters, first.likeliest.refinement.fit.shared[: self.intervals.n_p]]
        found = [x for x in found if self.dataset.layout.admits(x[None])[0]]
        return np.array(found or [np.ones(len(self.dataset.layout))])

    def outcome(self, first: Searched | None, notes: tuple[str, ...]) -> Searched | None:
        """The likeliest search, with the estimate that predicts best; None where none succeeds.

        The first search stays as it is where the logs are too short to be compared.
        """
        found, judged = first, self._judged(first)
        if judged is None:
            return first
        best = self._best_other(judged)
        if best is not None and (first is None or self.is_challenged(first, judged, best)):
            other = self._searched_from(best, notes, None if first is None else first.likeliest)
            if other is not None and (first is None or other.likeliest.cost < first.likeliest.cost):
                found = other
        if found is None:
            return None
        if first is None or found.likeliest is not first.likeliest:
            if is_settled(found.likeliest, found.motion):
                return found
            self.add_fit(found)
            judged = self._judged(found)
        return found if judged is None else self._decided(found, judged)

    def is_challenged(self, search: Searched, judged: _Judgement, rival: int) -> bool:
        """True if a fit is exact although its noise is not white, or if a rival beats or contradicts its estimates.

        Two estimates contradict each other if their intervals of a parameter are disjoint.
        """
        fitted = np.array([not isinstance(x.origin, Motion) for x in self.entries])
        if search.likeliest.exact or not (judged.comparison.as_good & fitted).any():
            return True
        one, variances = self.candidates[rival], np.diag(search.result.covariance)
        spans = _INTERVAL * (np.sqrt(np.diag(jackknife(one.without))) + np.sqrt(variances))
        return bool((np.abs(one.parameters - search.result.parameters) > spans).any())

    def _best_other(self, judged: _Judgement) -> int | None:
        """The best estimate that no fit gave; None where a fit predicts better, or no estimate predicts."""
        as_good, losses = judged.comparison.as_good, judged.comparison.losses
        others = [k for k, x in enumerate(self.entries) if isinstance(x.origin, Motion) and as_good[k]]
        best = min(others, key=lambda k: losses[k], default=None)
        return best if best is not None and predicts(judged.scores[best].errors) else None

    def _decided(self, search: Searched, judged: _Judgement) -> Searched:
        """A search with the estimate that predicts best."""
        winner, origin = self.entries[judged.comparison.best]
        of_fit = not isinstance(origin, Motion)
        result = self._result(judged, search.likeliest)
        n_rows = judged.judge.steps[int(np.argmin(judged.scores[judged.comparison.best].errors))]
        answer = replace(winner, parameters=result.parameters)
        outcome = Decided(self._summary(judged), None if of_fit else winner.acting, answer, n_rows)
        impossible = search.impossible if of_fit else ()
        return replace(search, motion=self.motion, result=result, decided=outcome, impossible=impossible)

    def _searched_from(self, best: int, notes: tuple[str, ...], rival: Explanation | None) -> Searched | None:
        """A search from an estimate that no fit gave, and its simulated motion; None where it fails."""
        one, motion = self.entries[best]
        assert isinstance(motion, Motion)
        intervals = one.intervals
        while intervals.length > _SHORT and (parts := fewest_parts(intervals.length)):
            intervals = intervals.split(parts)
        try:
            return searched(
                self.settings, replace(intervals, hold=one.acting.hold), motion, notes, self.seed, self.dataset,
                within(self.callback, 0.89, 0.895), one.parameters[None], rival,
            )  # fmt: skip
        except (IdentificationError, np.linalg.LinAlgError):
            return None

    def _judged(self, search: Searched | None) -> _Judgement | None:
        """Comparison of all candidates; None where the logs are too short for one, or nothing takes part.

        Outliers before a prediction, and the noise, are those of the search.
        """
        if not self.entries:
            return None
        report(self.callback, "comparing predictions", 0.89)
        inlying, noise = self._noise_of(search)
        acting, horizon = self.entries[0].candidate.acting, self.settings.horizon
        judge = Judge.of(acting, self.intervals, self.motion, inlying, noise, self.blocks, horizon)
        if judge is None:
            return None
        judge, scores = judge.compared(self.candidates)
        if not any(np.isfinite(x.losses).any() for x in scores):
            return None
        judged = _Judgement(judge, scores, Comparison.of(scores))
        best = judged.comparison.best
        winner = self.candidates[best]
        errors = ", ".join(f"{x:.2g}" for x in scores[best].errors)
        best_so_far = f"best so far: {winner.name}, held-out errors {errors} of those of no change"
        parameters = dict(zip(self.dataset.layout.names, winner.parameters.tolist(), strict=True))
        report(self.callback, "comparing predictions", 0.89, best_so_far, parameters=parameters)
        return judged

    def _noise_of(self, search: Searched | None) -> tuple[BoolArray, FloatArray]:
        """Samples that are no outliers ``(N, n_s)``, and the noise ``(n_s,)`` of each signal."""
        floor = np.maximum(_LEAST_NOISE * self.motion.spread, _TINY)
        if search is None or search.explains_nothing:
            return inlying_samples(self.intervals, self.motion), np.maximum(self.motion.spread, floor)
        own, fit = search.likeliest.intervals, search.likeliest.refinement.fit
        inlying = fit.noise.inlying(fit.residuals, own.known) >= _INLYING
        noise = np.where(np.isfinite(fit.noise.sigma) & (fit.noise.sigma > 0.0), fit.noise.sigma, self.motion.spread)
        return inlying | ~own.known, np.maximum(noise, floor)

    def _result(self, judged: _Judgement, fit_of: Explanation) -> ProjectedEstimate:
        """The winner, with a covariance that covers those that predict as well."""
        best, weights = judged.comparison.best, judged.comparison.weights
        one = self.candidates[best]
        parameters = np.array([x.parameters for x in self.candidates])
        apart = np.where(weights[:, None] > 0.0, parameters - one.parameters, 0.0)
        spread = (weights * apart.T) @ apart / weights.sum()
        found = one.estimate() if one.estimate is not None else self._of_blocks(one, fit_of)
        found = replace(found, covariance=found.covariance + spread)
        return with_parameters(fit_of.intervals, fit_of.refinement.fit, found, one.parameters)

    def _of_blocks(self, one: Candidate, fit_of: Explanation) -> ProjectedEstimate:
        """An estimate that no fit gave, with the covariance of the jackknife over blocks."""
        intervals, fit = fit_of.intervals, fit_of.refinement.fit
        covariance, stuck = jackknife(one.without), self.dataset.layout.on_bounds(one.parameters)
        covariance[stuck] = covariance[:, stuck] = 0.0
        covariance[stuck, stuck] = np.inf
        left = unexplained(intervals, fit, one.parameters)
        n, k = len(one.parameters), fit.x.shape[1] + fit.d.shape[1]
        of_z, of_s = np.zeros((len(intervals), k, n)), np.eye(len(fit.shared), n)
        of_fit = fit.shared[:n]
        return ProjectedEstimate(one.parameters, covariance, left, np.arange(len(intervals)), of_z, of_s, of_fit)

    def _summary(self, judged: _Judgement) -> Competition:
        """The comparison, for the result."""
        names, c = self.dataset.layout.names, judged.comparison
        rows = zip(self.candidates, judged.scores, c.losses, c.as_good, strict=True)
        competitors = tuple(
            Competitor(
                one.name, tuple(x.errors.tolist()), float(loss), bool(as_good),
                dict(zip(names, one.parameters.tolist(), strict=True)),
            )
            for one, x, loss, as_good in rows
        )  # fmt: skip
        return Competition(self.candidates[c.best].name, judged.judge.horizons, competitors)


def _estimates_of_fit(
    explanation: Explanation, acting: ActingInputs, blocks: Blocks, *, projection: bool
) -> Iterator[Candidate]:
    """Parameters read from a fit: by least squares on its motion over windows of each length, and its own."""
    intervals, fit = explanation.intervals, explanation.refinement.fit
    block = blocks.of_row[intervals.starts]
    if projection and not explanation.exact:
        for seconds, estimate, parameters, parts in projected_candidates(intervals, fit):
            if intervals.layout.violations(parameters) or not np.isfinite(parameters).all():
                continue
            name = f"least squares on the fitted motion, {seconds:.2g} s"
            yield Candidate(
                name, parameters, _left_out(parameters, parts, block, blocks.n), acting, intervals, estimate
            )
    own = fitted_parameters(intervals, fit)
    steps = effect_of_intervals(intervals, fit).steps
    without = _left_out(own.parameters, -steps, block, blocks.n)
    yield Candidate("joint fit", own.parameters, without, acting, intervals, lambda: own)


def _left_out(parameters: FloatArray, parts: FloatArray, block: IntArray, K: int) -> FloatArray:
    """Parameters without each of K blocks, to first order, from the contribution of each interval to their error."""
    sums = np.array([parts[block == k].sum(axis=0) for k in range(K)])
    return np.asarray(parameters + K / (K - 1.0) * sums)
