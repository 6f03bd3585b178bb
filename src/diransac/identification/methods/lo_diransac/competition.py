"""Competition of estimates: sources propose them, and the judge compares their predictions.

Where the exact model of a fit predicts a log within its noise, there is no competition.  Elsewhere the estimates of the
joint fit compete with least squares of all rows and with simulation error.  Where one of these contradicts the
fit, which may be at a local optimum, another one begins with its parameters and its motion, and the likelier counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import IdentificationError, TimeLimitError
from diransac.identification.estimate import Competition, Competitor, predicts
from diransac.identification.method import report, within
from diransac.identification.methods.lo_diransac.forward import Reference
from diransac.identification.methods.lo_diransac.interval_effects import effect_of_intervals
from diransac.identification.methods.lo_diransac.judge import Selection, judge
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
    prospects_of,
    searched,
)
from diransac.identification.methods.lo_diransac.segments import ActingInputs, inlying_samples
from diransac.identification.methods.lo_diransac.simulation_error import simulation_error_candidates
from diransac.identification.methods.lo_diransac.sources import (
    Blocks,
    Candidate,
    jackknife,
    least_squares_candidates,
)
from diransac.simulation import HOLDS

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.windows import Windows
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.smoothing import Motion

_INLYING = 0.5
"""Probability of no outlier from which on a sample counts, and fraction of outliers that is a majority."""
_TINY = 1e-300


def is_settled(explanation: Explanation, motion: Motion) -> bool:
    """True if the exact model predicts the log within the noise of its most accurate signal.

    That noise is small beside the spread of the smoothed motion (a fifth at most), and hardly correlated from sample to
    sample (a half).  Outliers are the minority of every signal: a fit that has lost one takes the rest for them.
    """
    if not explanation.exact:
        return False
    known, fit = explanation.intervals.known, explanation.refinement.fit
    measured = known.any(axis=0)
    share = np.where(measured, fit.noise.sigma / np.maximum(motion.spread, _TINY), np.inf)
    best = int(np.argmin(share))
    inlying = fit.noise.inlying(fit.residuals, known)[:, best] > _INLYING
    e, both = fit.residuals[:, best] / fit.noise.sigma[best], inlying[1:] & inlying[:-1]
    correlation = (e[1:] * e[:-1])[both].mean() if both.any() else 0.0
    return bool(share[best] < 0.2 and correlation < 0.5 and (fit.noise.pi < _INLYING)[measured].all())


def compete(
    settings: LoDiransacSettings,
    dataset: Dataset,
    whole: tuple[Windows, Motion, tuple[str, ...]],
    seed: int,
    callback: Callback | None,
) -> Searched:
    """The likeliest explanation of the logs, `prepared`, with the estimate that predicts best.

    Where no search from samples succeeds, or its fit is challenged, another one begins with the best of the other
    estimates; the likeliest counts.  Not so where the equations hold with impossible parameters alone, which no search
    changes.

    Raises
    ------
    IdentificationError
        The search fails, and no other estimate predicts much better than that nothing changes.
    TimeLimitError
        The time limit was reached before a search had converged.
    """
    first, refusal, (intervals, motion, notes) = None, None, whole
    prospects = prospects_of(dataset, intervals, motion)
    for warning in prospects.sentences():
        report(callback, "least squares of all rows", 0.05, warning=warning)
    try:
        first = likeliest(settings, dataset, seed, callback, whole)
    except (IdentificationError, np.linalg.LinAlgError) as error:
        refusal = error
        if prospects.contradict_bounds:
            raise
    else:
        if not first.likeliest.complete or is_settled(first.likeliest, first.motion):
            return first
        of_fit, motion, notes = first.likeliest.intervals, first.motion, first.notes
        intervals = replace(intervals, substeps=of_fit.substeps, recorded=of_fit.recorded)
    try:
        search = Contest(settings, dataset, intervals, motion, notes, seed, callback).outcome(first)
    except TimeLimitError:
        if first is None:
            raise
        return replace(first, likeliest=replace(first.likeliest, complete=False))
    if search is not None and (first is not None or search.decided is None or search.decided.summary.predicts):
        return search
    if isinstance(refusal, IdentificationError):
        raise refusal
    failed = f"the joint fit fails numerically ({refusal}), and no other estimate predicts the log"
    raise IdentificationError(f"{dataset.source}: {failed}; compare the model's constants with the machine")


@dataclass(frozen=True, eq=False)
class Contest:
    """Competition of the estimates of one dataset.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset
    intervals : Windows
        With inputs and measurements as recorded.
    motion : Motion
        Smoothed motion over their rows.
    notes : tuple of str
        Of the preparation.
    seed : int
    callback : callable or None
    """

    settings: LoDiransacSettings
    dataset: Dataset
    intervals: Windows
    motion: Motion
    notes: tuple[str, ...]
    seed: int
    callback: Callback | None

    def outcome(self, first: Searched | None) -> Searched | None:
        """The likeliest search, with the estimate that predicts best; None where none succeeds.

        The first search stays as it is where the logs are too short to be compared.
        """
        blocks, search = Blocks.of(self.intervals), first
        of_fit = [] if first is None else list(self._of_fit(first, blocks))
        others = self._others(first, of_fit, blocks)
        candidates = [*of_fit, *others]
        selection = self._judged(first, candidates, blocks)
        if selection is None:
            return first
        rival = _best_other(candidates, selection)
        if rival is not None and (first is None or self.is_challenged(first, rival)):
            other = self._searched_from(rival, first)
            if other is not None and (first is None or other.likeliest.cost < first.likeliest.cost):
                search = other
        if search is None:
            return None
        if search is not first:
            if is_settled(search.likeliest, search.motion):
                return search
            candidates = [*self._of_fit(search, blocks), *others]
            selection = self._judged(search, candidates, blocks)
        return search if selection is None else self._decided(search, candidates, selection)

    def _of_fit(self, search: Searched, blocks: Blocks) -> Iterator[Candidate]:
        """Parameters read from a fit: by least squares on its motion over windows of each length, and its own."""
        intervals, fit = search.likeliest.intervals, search.likeliest.refinement.fit
        timing = search.timing(forced=self.settings.forces_timing)
        acting = ActingInputs(intervals.inputs, intervals.hold, timing, fitted=True)
        block, K = blocks.of_row[intervals.starts], blocks.n

        def candidate(
            name: str, estimate: Callable[[], ProjectedEstimate], p: FloatArray, parts: FloatArray
        ) -> Candidate:
            sums = np.array([parts[block == k].sum(axis=0) for k in range(K)])
            return Candidate(name, p, p + K / (K - 1.0) * sums, acting, intervals, estimate)

        if not search.likeliest.exact:
            for seconds, estimate, p, parts in projected_candidates(intervals, fit):
                if not intervals.layout.violations(p) and np.isfinite(p).all():
                    yield candidate(f"least squares on the fitted motion, {seconds:.2g} s", estimate, p, parts)
        own = fitted_parameters(intervals, fit)
        yield candidate("joint fit", lambda: own, own.parameters, -effect_of_intervals(intervals, fit).steps)

    def _others(self, first: Searched | None, of_fit: Sequence[Candidate], blocks: Blocks) -> list[Candidate]:
        """Least squares of all rows, and simulation error, which starts from all other estimates."""
        settings, dataset = self.settings, self.dataset
        holds = [dataset.input_hold] if dataset.input_hold else list(HOLDS)
        actings, found, intervals = [ActingInputs.recorded(self.intervals, x) for x in holds], [], self.intervals
        if first is not None:
            own, intervals = of_fit[0].acting, first.corrected(self.intervals)
            actings = [own] if settings.forces_timing else [*actings, own] if own.differs(actings) else actings
        if not settings.forces_timing:
            report(self.callback, "least squares", 0.88)
            candidates = least_squares_candidates(dataset, self.intervals, blocks)
            found = [replace(x, motion=self.motion) for x in candidates]
        report(self.callback, "simulation error", 0.885)
        every = [*(x.parameters for x in (*of_fit, *found)), settings.start_of(dataset.layout)]
        every += [] if first is None else [first.result.parameters, of_fit[-1].parameters]
        known = [x for x in every if x is not None and dataset.layout.admits(x[None])[0]]
        starts = np.array(known or [np.ones(len(dataset.layout))])
        simulated = simulation_error_candidates(
            intervals, self.motion, starts, actings, self.seed, blocks, outliers=settings.outliers
        )
        return [*found, *(replace(x, motion=motion) for x, motion in simulated)]

    def is_challenged(self, search: Searched, rival: Candidate) -> bool:
        """True if a fit is exact although its noise is not white, or if a rival contradicts an estimate that counts.

        Two estimates contradict each other if their 95 % intervals of a parameter are disjoint.
        """
        errors = np.sqrt(np.diag(jackknife(rival.without))) + np.sqrt(np.diag(search.result.covariance))
        apart = np.abs(rival.parameters - search.result.parameters)
        return search.likeliest.exact or bool((apart > 1.96 * errors).any() and search.likeliest.is_comparable)

    def _searched_from(self, rival: Candidate, first: Searched | None) -> Searched | None:
        """A search from an estimate that no fit gave, and its simulated motion; None where it fails."""
        assert rival.motion is not None
        intervals = rival.intervals
        while intervals.length > 25 and (parts := fewest_parts(intervals.length)):
            intervals = intervals.split(parts)
        try:
            return searched(
                self.settings, replace(intervals, hold=rival.acting.hold), rival.motion, self.notes, self.seed,
                self.dataset, within(self.callback, 0.89, 0.895), rival.parameters[None],
                None if first is None else first.likeliest,
            )  # fmt: skip
        except (IdentificationError, np.linalg.LinAlgError):
            return None

    def _judged(self, search: Searched | None, candidates: Sequence[Candidate], blocks: Blocks) -> Selection | None:
        """Comparison of all candidates; outliers before a prediction, and the noise, are those of the search."""
        report(self.callback, "comparing predictions", 0.89)
        spread = self.motion.spread
        if search is None or search.explains_nothing:
            inlying, noise = inlying_samples(self.intervals, self.motion), spread
        else:
            known, fit = search.likeliest.intervals.known, search.likeliest.refinement.fit
            inlying = (fit.noise.inlying(fit.residuals, known) >= _INLYING) | ~known
            noise = np.where(np.isfinite(fit.noise.sigma) & (fit.noise.sigma > 0.0), fit.noise.sigma, spread)
        noise = np.maximum(noise, np.maximum(1e-4 * spread, _TINY))
        reference = Reference(self.intervals, self.motion, blocks, inlying, noise)
        selection = judge(reference, candidates, self.settings.horizon)
        if selection is not None:
            winner, errors = candidates[selection.best], selection.scores[selection.best].errors
            said = ", ".join(f"{x:.2g}" for x in errors)
            note = f"best so far: {winner.name}, held-out errors {said} of those of no change"
            report(self.callback, "comparing predictions", 0.89, note, parameters=self._by_name(winner))
        return selection

    def _by_name(self, candidate: Candidate) -> dict[str, float]:
        return dict(zip(self.dataset.layout.names, candidate.parameters.tolist(), strict=True))

    def _decided(self, search: Searched, candidates: Sequence[Candidate], selection: Selection) -> Searched:
        """A search with the estimate that predicts best, whose covariance covers those that predict as well."""
        winner, weights, dt = candidates[selection.best], selection.weights, self.intervals.dt
        intervals, fit, impossible = search.likeliest.intervals, search.likeliest.refinement.fit, search.impossible
        if winner.estimate is not None:
            result, acting = with_parameters(intervals, fit, winner.estimate(), winner.parameters), None
        else:
            result, acting, impossible = self._of_blocks(winner, search.likeliest), winner.acting, ()
        apart = np.array([x.parameters for x in candidates]) - winner.parameters
        apart[weights == 0.0] = 0.0
        result = replace(result, covariance=result.covariance + (weights * apart.T) @ apart / weights.sum())
        rows = zip(candidates, selection.scores, selection.losses.tolist(), selection.as_good.tolist(), strict=True)
        competitors = tuple(
            Competitor(x.name, tuple(scores.errors.tolist()), loss, as_good, self._by_name(x))
            for x, scores, loss, as_good in rows
        )
        summary = Competition(winner.name, tuple(float(n * dt) for n in selection.steps), competitors)
        n_rows = selection.steps[int(np.argmin(selection.scores[selection.best].errors))]
        decided = Decided(summary, acting, winner, n_rows)
        return replace(search, motion=self.motion, result=result, decided=decided, impossible=impossible)

    def _of_blocks(self, winner: Candidate, explanation: Explanation) -> ProjectedEstimate:
        """An estimate that no fit gave, with the covariance of the jackknife over blocks."""
        intervals, fit, p = explanation.intervals, explanation.refinement.fit, winner.parameters
        covariance, stuck = jackknife(winner.without), self.dataset.layout.on_bounds(p)
        covariance[stuck] = covariance[:, stuck] = 0.0
        covariance[stuck, stuck] = np.inf
        of_z = np.zeros((len(intervals), fit.x.shape[1] + fit.d.shape[1], len(p)))
        left, every, of_s = unexplained(intervals, fit, p), np.arange(len(intervals)), np.eye(len(fit.shared), len(p))
        return ProjectedEstimate(p, covariance, left, every, of_z, of_s, fit.shared[: len(p)])


def _best_other(candidates: Sequence[Candidate], selection: Selection) -> Candidate | None:
    """The best estimate that no fit gave; None where a fit predicts better, or no estimate predicts."""
    others = [k for k, x in enumerate(candidates) if x.estimate is None and selection.as_good[k]]
    best = min(others, key=lambda k: selection.losses[k], default=None)
    return None if best is None or not predicts(selection.scores[best].errors) else candidates[best]
