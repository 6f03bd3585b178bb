"""Competition of estimates: sources propose them, and the arbiter compares their predictions.

Where the exact model predicts a log within its noise, there is no competition.  Elsewhere the estimates of the joint
fit compete with least squares of all rows and with simulation error.  If one of these predicts better, a second joint
fit begins with its parameters and its simulated motion, and its estimates compete, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.estimate import Competition, Competitor
from diransac.identification.method import report
from diransac.identification.methods.lo_diransac.arbiter import compared
from diransac.identification.methods.lo_diransac.projection import (
    ProjectedEstimate,
    effect_of_intervals,
    fitted_parameters,
    projected_candidates,
    unexplained,
)
from diransac.identification.methods.lo_diransac.segments import ActingInputs
from diransac.identification.methods.lo_diransac.simulation_error import simulation_error_candidates
from diransac.identification.methods.lo_diransac.sources import (
    Blocks,
    Candidate,
    jackknife,
    least_squares_candidates,
)

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.data.input_timing import InputTiming
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.arbiter import Comparison
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.method import _Searched
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.methods.lo_diransac.smoothing import Motion

__all__ = ["Contest", "is_settled"]

# Noise over the spread of the signal, and its correlation from sample to sample, up to which an exact model is right.
_WITHIN, _WHITE = 0.2, 0.5
# Error of the best estimate over that of the prediction that nothing changes, where a search was refused.
_PREDICTS = 0.5
_INLYING, _TINY = 0.5, 1e-300
_LEAST_NOISE = 1e-4


def is_settled(explanation: Explanation, motion: Motion) -> bool:
    """True if the exact model predicts the log within the noise of its most accurate signal.

    That noise is small beside the signal, and hardly correlated from sample to sample.

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
    return bool(share[best] < _WITHIN and correlation < _WHITE)


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
        self.candidates: list[Candidate] = []
        self.origins: list[Motion | Explanation] = []
        self.comparison: Comparison | None = None

    def add_fit(self, explanation: Explanation, timing: InputTiming) -> None:
        """Add the estimates of a joint fit, before those that are there."""
        found = list(_estimates_of_fit(explanation, timing, self.blocks, projection=self.settings.projection))
        self.candidates = [*found, *self.candidates]
        self.origins = [*[explanation] * len(found), *self.origins]

    def add_sources(self, starts: Sequence[FloatArray], actings: Sequence[ActingInputs]) -> None:
        """Add least squares of all rows and simulation error, which starts from it and from other parameters."""
        sources = self.settings.sources
        if "least squares" in sources:
            report(self.callback, "least squares", 0.88)
            for one in least_squares_candidates(self.dataset, self.intervals, self.blocks):
                self.candidates.append(one)
                self.origins.append(self.motion)
        if "simulation error" in sources:
            report(self.callback, "simulation error", 0.885)
            known = [x.parameters for x in self.candidates] + list(starts)
            known = [x for x in known if self.dataset.layout.admits(x[None])[0]]
            found = simulation_error_candidates(
                self.intervals, self.motion, np.array(known or [np.ones(len(self.dataset.layout))]), actings, self.seed,
                self.blocks, outliers=self.settings.outliers,
            )  # fmt: skip
            for one, motion in found:
                self.candidates.append(one)
                self.origins.append(motion)

    def decide(self, inlying: BoolArray, noise: FloatArray) -> int | None:
        """Index of the winner; None where the logs are too short to be compared, or nothing takes part."""
        if not self.candidates:
            return None
        report(self.callback, "comparing predictions", 0.89)
        floor = _LEAST_NOISE * self.motion.spread
        sizes = np.where(np.isfinite(noise) & (noise > 0.0), noise, self.motion.spread)
        sizes = np.maximum(np.maximum(sizes, floor), 1e-300)
        self.comparison = compared(
            self.candidates, self.intervals, self.motion, inlying, sizes, self.blocks, self.settings.horizon,
            self.intervals.length,
        )  # fmt: skip
        return None if self.comparison is None else self.comparison.best

    @property
    def predicts(self) -> bool:
        """True if the best estimate predicts much better than that nothing changes."""
        return self.comparison is not None and bool(self.comparison.errors[self.comparison.best].min() < _PREDICTS)

    def is_as_good(self, search: _Searched | None) -> bool:
        """True if an estimate of a search's fit predicts as well as the best."""
        if search is None or self.comparison is None:
            return False
        own = np.array([x is search.likeliest for x in self.origins])
        return bool((own & self.comparison.as_good).any())

    def result(self, winner: int, fit_of: Explanation) -> ProjectedEstimate:
        """The winner's parameters, and a covariance that covers all that predict as well."""
        assert self.comparison is not None
        one = self.candidates[winner]
        if one.estimate is not None:
            found = one.estimate()
        else:
            intervals, fit = fit_of.intervals, fit_of.refinement.fit
            covariance = jackknife(one.without)
            stuck = self.dataset.layout.on_bounds(one.parameters)
            covariance[stuck] = covariance[:, stuck] = 0.0
            covariance[stuck, stuck] = np.inf
            left = unexplained(intervals, fit, one.parameters)
            n, k = len(one.parameters), fit.x.shape[1] + fit.d.shape[1]
            of_z, of_s = np.zeros((len(intervals), k, n)), np.eye(len(fit.shared), n)
            found = ProjectedEstimate(one.parameters, covariance, left, np.arange(len(intervals)), of_z, of_s)
        apart, weights = np.array([x.parameters for x in self.candidates]) - found.parameters, self.comparison.weights
        spread = (weights * apart.T) @ apart / weights.sum()
        return replace(found, covariance=found.covariance + spread)

    def summary(self, winner: int) -> Competition:
        """The comparison, for the result."""
        assert self.comparison is not None
        c = self.comparison
        names = self.dataset.layout.names
        return Competition(
            self.candidates[winner].name,
            c.horizons,
            tuple(
                Competitor(
                    one.name,
                    tuple(e.tolist()),
                    float(m),
                    bool(ok),
                    dict(zip(names, one.parameters.tolist(), strict=True)),
                )
                for one, e, m, ok in zip(self.candidates, c.errors, c.means, c.as_good, strict=True)
            ),
        )


def _estimates_of_fit(
    explanation: Explanation, timing: InputTiming, blocks: Blocks, *, projection: bool
) -> Iterator[Candidate]:
    """Parameters read from a fit: by least squares on its motion over windows of each length, and its own."""
    intervals, fit = explanation.intervals, explanation.refinement.fit
    acting = ActingInputs.of_fit(intervals, fit, timing)
    block = blocks.of_row[intervals.starts]
    if projection and not explanation.exact:
        for seconds, estimate, parameters, parts in projected_candidates(intervals, fit):
            if intervals.layout.violations(parameters) or not np.isfinite(parameters).all():
                continue
            name = f"least squares on the fitted motion, {seconds:.2g} s"
            yield Candidate(
                name, parameters, _left_out(parameters, parts, block, blocks, intervals), acting, intervals, estimate
            )
    own = fitted_parameters(intervals, fit)
    steps = effect_of_intervals(intervals, fit).steps
    without = _left_out(own.parameters, -steps, block, blocks, intervals)
    yield Candidate("joint fit", own.parameters, without, acting, intervals, lambda: own)


def _left_out(
    parameters: FloatArray, parts: FloatArray, block: IntArray, blocks: Blocks, intervals: ShootingIntervals
) -> FloatArray:
    """Parameters without each block, to first order, from the contribution of each interval to their error."""
    K = blocks.n
    sums = np.array([parts[block == k].sum(axis=0) for k in range(K)])
    found = parameters + K / (K - 1.0) * sums
    for j, bound in enumerate(intervals.layout.bounds):
        least = max(bound.lower, 0.5 * parameters[j]) if bound.positive else bound.lower
        found[:, j] = np.clip(found[:, j], least, bound.upper)
    return found
