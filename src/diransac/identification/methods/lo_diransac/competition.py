"""Competition of estimates: sources propose them, and the arbiter compares their predictions.

Where the exact model of a fit predicts a log within its noise, there is no competition.  Elsewhere the estimates of the
joint fit compete with least squares of all rows and with simulation error.  If one of these predicts better, or as well
and contradicts the fit, which may be at a local optimum, a second joint fit begins with its parameters and its motion,
and its estimates compete, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError, TimeLimitError
from diransac.identification.estimate import Competition, Competitor, LogEstimate, predicts
from diransac.identification.method import report, within
from diransac.identification.methods.lo_diransac.arbiter import Arbiter, Comparison, Scores
from diransac.identification.methods.lo_diransac.interval_effects import effect_of_intervals
from diransac.identification.methods.lo_diransac.local_search import fewest_parts
from diransac.identification.methods.lo_diransac.motion_equations import unexplained
from diransac.identification.methods.lo_diransac.projection import (
    ProjectedEstimate,
    fitted_parameters,
    projected_candidates,
    with_parameters,
)
from diransac.identification.methods.lo_diransac.search import Decided, Searched, likeliest, searched
from diransac.identification.methods.lo_diransac.segments import ActingInputs, inlying_samples
from diransac.identification.methods.lo_diransac.simulation_error import estimates_of_logs, simulation_error_candidates
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
# Samples of the intervals of a second search at most, as far as their number has divisors.
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

    A search that fails, or whose estimates another one beats, is followed by a second one, from that estimate.

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
        The first search fails, and no other estimate predicts much better than that nothing changes.
    TimeLimitError
        The time limit was reached before a search had converged.
    """
    refused: Exception | None = None
    try:
        first = likeliest(settings, dataset, seed, callback, whole)
    except (IdentificationError, np.linalg.LinAlgError) as error:
        first, refused = None, error
    if first is not None and is_settled(first.likeliest, first.motion):
        return first
    if first is not None and not first.likeliest.complete:
        return first
    intervals, motion = whole[:2]
    if first is not None:
        intervals, motion = replace(intervals, substeps=first.likeliest.intervals.substeps), first.motion
    contest = Contest(settings, dataset, intervals, motion, seed, callback)
    try:
        found = _decided(contest, first, whole[2])
    except TimeLimitError:
        if first is None:
            raise
        return replace(first, likeliest=replace(first.likeliest, complete=False))
    if first is None and (found is None or found.decided is None or not found.decided.summary.predicts):
        if isinstance(refused, IdentificationError):
            raise refused
        failed = f"the joint fit fails numerically ({refused}), and no other estimate predicts the log"
        raise IdentificationError(f"{dataset.source}: {failed}; compare the model's constants with the machine")
    return found or first  # type: ignore[return-value]  # one of them is there


def _decided(contest: Contest, first: Searched | None, notes: tuple[str, ...]) -> Searched | None:
    """The search whose estimate predicts best; None where nothing could be compared."""
    contest.add_sources(first)
    winner = contest.decide(first)
    if winner is None:
        return None
    searches = [] if first is None else [first]
    other = contest.challenger(first) if "second fit" in contest.settings.sources else None
    second = contest.second(other, notes) if other is not None else None
    if first is not None and second is not None and is_settled(second.likeliest, second.motion):
        return second
    if second is not None and other is not None:
        contest.add_fit(second, f" from {contest.candidates[other].source}")
        searches.append(second)
        winner = contest.decide(min(searches, key=lambda x: x.likeliest.cost))
        assert winner is not None
    if not searches:
        return None
    of_fit = next((x for x in searches if x.likeliest is contest.origins[winner]), None)
    chosen = of_fit or min(searches, key=contest.loss_of)
    result = contest.result(winner, chosen.likeliest)
    acting = None if of_fit else contest.candidates[winner].acting
    decided = Decided(contest.summary(winner), acting, contest.of_logs(winner, result.parameters))
    impossible = of_fit.impossible if of_fit else ()
    return replace(chosen, motion=contest.motion, result=result, decided=decided, impossible=impossible)


@dataclass(frozen=True)
class _Entry:
    """A candidate, the fit or the motion that it came from, and its scores once it has been compared."""

    candidate: Candidate
    origin: Motion | Explanation
    scores: Scores | None = None

    def scored(self, arbiter: Arbiter) -> _Entry:
        """The entry with its scores."""
        return self if self.scores is not None else replace(self, scores=arbiter.scores(self.candidate))


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
        self.judge: Searched | None = None
        self.arbiter: Arbiter | None = None
        self.comparison: Comparison | None = None

    @property
    def candidates(self) -> list[Candidate]:
        """In the order in which they are preferred where they predict as well."""
        return [x.candidate for x in self.entries]

    @property
    def origins(self) -> list[Motion | Explanation]:
        """The fit or the motion that each came from."""
        return [x.origin for x in self.entries]

    @property
    def scores(self) -> list[Scores]:
        """Of all candidates that have been compared."""
        return [x.scores for x in self.entries if x.scores is not None]

    def add_fit(self, found: Searched, origin: str = "") -> None:
        """Add the estimates of a joint fit, before those that are there, but after those of a likelier one."""
        acting = self._acting(found)
        some = _estimates_of_fit(found.likeliest, acting, self.blocks, origin, projection=self.settings.projection)
        k = sum(not isinstance(x, Motion) and x.cost < found.likeliest.cost for x in self.origins)
        self.entries[k:k] = [_Entry(x, found.likeliest) for x in some]

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

    def decide(self, search: Searched | None) -> int | None:
        """Index of the winner; None where the logs are too short to be compared, or nothing takes part.

        Outliers and noise are those of a search; another one than before scores all candidates again.
        """
        if not self.entries:
            return None
        report(self.callback, "comparing predictions", 0.89)
        if self.arbiter is None or search is not self.judge:
            self.judge, self.arbiter = search, self._judged_by(search)
            self.entries = [replace(x, scores=None) for x in self.entries]
        if self.arbiter is None:
            return None
        self.entries = [x.scored(self.arbiter) for x in self.entries]
        scores = self.scores
        if not any(np.isfinite(x.losses).any() for x in scores):
            return None
        self.comparison = Comparison.of(scores)
        best = self.comparison.best
        winner = self.entries[best].candidate
        errors = ", ".join(f"{x:.2g}" for x in scores[best].errors)
        best_so_far = f"best so far: {winner.name}, held-out errors {errors} of those of no change"
        parameters = dict(zip(self.dataset.layout.names, winner.parameters.tolist(), strict=True))
        report(self.callback, "comparing predictions", 0.89, best_so_far, parameters=parameters)
        return best

    def _judged_by(self, search: Searched | None) -> Arbiter | None:
        """The arbiter with the outliers and the noise of a search."""
        inlying, noise = self._noise_of(search)
        acting, horizon = self.entries[0].candidate.acting, self.settings.horizon
        return Arbiter.of(acting, self.intervals, self.motion, inlying, noise, self.blocks, horizon)

    def _noise_of(self, search: Searched | None) -> tuple[BoolArray, FloatArray]:
        """Samples that are no outliers ``(N, n_s)``, and the noise ``(n_s,)`` of each signal."""
        floor = np.maximum(_LEAST_NOISE * self.motion.spread, _TINY)
        if search is None or search.explains_nothing:
            return inlying_samples(self.intervals, self.motion), np.maximum(self.motion.spread, floor)
        own, fit = search.likeliest.intervals, search.likeliest.refinement.fit
        inlying = fit.noise.inlying(fit.residuals, own.known) >= _INLYING
        noise = np.where(np.isfinite(fit.noise.sigma) & (fit.noise.sigma > 0.0), fit.noise.sigma, self.motion.spread)
        return inlying | ~own.known, np.maximum(noise, floor)

    def challenger(self, search: Searched | None) -> int | None:
        """Index of the best estimate that no fit gave, where it predicts, and beats a fit or contradicts one as good.

        Two estimates contradict each other if their intervals of a parameter are disjoint.  An exact model whose noise
        is not white is contradicted by that.
        """
        assert self.comparison is not None
        as_good, fitted = self.comparison.as_good, np.array([not isinstance(x, Motion) for x in self.origins])
        found = int(np.argmin(np.where(as_good & ~fitted, self.comparison.losses, np.inf)))
        if fitted[found] or not as_good[found] or not predicts(self.scores[found].errors):
            return None
        if search is None or search.likeliest.exact or not (as_good & fitted).any():
            return found
        one, variances = self.candidates[found], np.diag(search.result.covariance)
        spans = _INTERVAL * (np.sqrt(np.diag(jackknife(one.without))) + np.sqrt(variances))
        return found if (np.abs(one.parameters - search.result.parameters) > spans).any() else None

    def loss_of(self, search: Searched) -> float:
        """Least loss of the estimates of a search's fit."""
        assert self.comparison is not None
        own = [x for x, y in zip(self.comparison.losses, self.origins, strict=True) if y is search.likeliest]
        return float(min(own, default=np.inf))

    def of_logs(self, winner: int, parameters: FloatArray) -> tuple[LogEstimate, ...]:
        """Estimates of each of several logs alone, over the horizon at which the winner predicts best.

        None after the time limit: what was decided stays.
        """
        if len(self.dataset.segments) < 2:
            return ()
        assert self.arbiter is not None
        report(self.callback, "comparing logs", 0.895)
        n_rows = self.arbiter.steps[int(np.argmin(self.scores[winner].errors))]
        one = replace(self.candidates[winner], parameters=parameters)
        try:
            return estimates_of_logs(one, self.motion, n_rows, outliers=self.settings.outliers)
        except TimeLimitError:
            return ()

    def second(self, winner: int, notes: tuple[str, ...]) -> Searched | None:
        """A search from an estimate and its simulated motion; None where it fails."""
        one, motion = self.candidates[winner], self.origins[winner]
        assert isinstance(motion, Motion)
        intervals = one.intervals
        while intervals.length > _SHORT and (parts := fewest_parts(intervals.length)):
            intervals = intervals.split(parts)
        try:
            return searched(
                self.settings, replace(intervals, hold=one.acting.hold), motion, notes, self.seed, self.dataset,
                within(self.callback, 0.89, 0.895), hypotheses=one.parameters[None],
            )  # fmt: skip
        except (IdentificationError, np.linalg.LinAlgError):
            return None

    def result(self, winner: int, fit_of: Explanation) -> ProjectedEstimate:
        """Mean of the winner and of those that predict as well, and a covariance that covers them.

        Those whose inputs act at another time than the winner's count in the covariance alone.  Where their mean
        predicts clearly worse than the winner, its own parameters stay.
        """
        assert self.comparison is not None
        assert self.arbiter is not None
        one, weights = self.candidates[winner], self.comparison.weights
        alike = weights * np.array([x.acting.timing == one.acting.timing for x in self.candidates])
        share = alike / alike.sum()
        parameters = np.array([x.parameters for x in self.candidates])
        mean = replace(
            one, parameters=share @ parameters, without=np.tensordot(share, [x.without for x in self.candidates], 1)
        )
        alone = Comparison.of([self.scores[winner], self.arbiter.scores(mean)])
        centre = mean.parameters if alone.as_good[1] else one.parameters
        apart = parameters - centre
        spread = (weights * apart.T) @ apart / weights.sum()
        found = one.estimate() if one.estimate is not None else self._of_blocks(one, fit_of)
        found = replace(found, covariance=found.covariance + spread)
        return with_parameters(fit_of.intervals, fit_of.refinement.fit, found, centre)

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

    def summary(self, winner: int) -> Competition:
        """The comparison, for the result."""
        assert self.comparison is not None
        assert self.arbiter is not None
        names, c = self.dataset.layout.names, self.comparison
        rows = zip(self.candidates, self.scores, c.losses, c.as_good, strict=True)
        competitors = tuple(
            Competitor(
                one.name, tuple(x.errors.tolist()), float(loss), bool(as_good),
                dict(zip(names, one.parameters.tolist(), strict=True)),
            )
            for one, x, loss, as_good in rows
        )  # fmt: skip
        return Competition(self.candidates[winner].name, self.arbiter.horizons, competitors)


def _estimates_of_fit(
    explanation: Explanation, acting: ActingInputs, blocks: Blocks, origin: str, *, projection: bool
) -> Iterator[Candidate]:
    """Parameters read from a fit: by least squares on its motion over windows of each length, and its own."""
    intervals, fit = explanation.intervals, explanation.refinement.fit
    block = blocks.of_row[intervals.starts]
    if projection and not explanation.exact:
        for seconds, estimate, parameters, parts in projected_candidates(intervals, fit):
            if intervals.layout.violations(parameters) or not np.isfinite(parameters).all():
                continue
            name = f"least squares on the fitted motion{origin}, {seconds:.2g} s"
            yield Candidate(
                name, parameters, _left_out(parameters, parts, block, blocks.n), acting, intervals, estimate
            )
    own = fitted_parameters(intervals, fit)
    steps = effect_of_intervals(intervals, fit).steps
    without = _left_out(own.parameters, -steps, block, blocks.n)
    yield Candidate(f"joint fit{origin}", own.parameters, without, acting, intervals, lambda: own)


def _left_out(parameters: FloatArray, parts: FloatArray, block: IntArray, K: int) -> FloatArray:
    """Parameters without each of K blocks, to first order, from the contribution of each interval to their error."""
    sums = np.array([parts[block == k].sum(axis=0) for k in range(K)])
    return np.asarray(parameters + K / (K - 1.0) * sums)
