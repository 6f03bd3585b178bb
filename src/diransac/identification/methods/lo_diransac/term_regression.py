"""The regression of what a fit leaves on terms that its model lacks, with all else that is estimated beside them.

A term accelerates the model by a known function of the motion, as the unmodelled accelerations do: its slopes are
theirs, times that function.  One solution of the normal equations for all terms gives what each changes in the states,
the parameters and the unmodelled accelerations, and so in every residual: of the measurements, of continuity, and of
the unmodelled accelerations from their prior.  Long logs are solved section by section, and a batch of neighbouring
intervals is kept as the triangle of its residuals, which takes a fraction of the memory.

Estimates of single terms are those of a score test (`core`).  The residuals themselves are needed beside them:
their products scatter from interval to interval as unmodelled forces do, which no score of the measurements alone
shows, and terms are tested beside others that have been selected.

References
----------
Frisch, Waugh 1933 (regression on what other columns leave).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import chain, pairwise
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, size_or_one
from diransac.identification.core.equations import linearize
from diransac.identification.core.fit import innovation_std, weights_of
from diransac.identification.core.theta import of_logs, sum_of_products
from diransac.identification.methods.lo_diransac.interval_effects import batch_sums

if TYPE_CHECKING:
    from diransac.identification.core.equations import NormalEquations
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.simulation import GaussNewtonBatch

ROUNDING = 1e-12
"""Part of an information, or of a squared size, that is rounding."""

# Numbers of the equations that are solved at once, at most: 80 MB, a tenth of a second.
_NUMBERS = 1e7
# Numbers of a section of more.
_SECTION = 2e6
# Rows of residuals, over their columns, of which a triangle is made at once: of fewer, it takes most of the time.
_ROWS = 8
# Factor of the prior of discrepancies, which stand for the forces of terms, that holds them at zero.
_HELD = 1e-3


@dataclass(frozen=True, eq=False, repr=False)
class TermRegression:
    """Residuals of a fit as linear functions of the coefficients of K effects, all else estimated with them.

    Parameters
    ----------
    effects : (n, K) array
        Change of the parameters per unit of each coefficient.
    direct : (K,) array
        Information of each coefficient, if all else were known.
    residuals : (G, m) array
        Of each interval, or of each group of neighbouring ones, over their standard deviations.
    columns : (G, m, K) array
        Their derivatives with respect to the coefficients.
    force : (W, e) array
        Unmodelled force in each equation, mean of each interval.
    forces : (W, e, K) array
        Its derivatives.
    acts : (e, K) bool array
        Equations in which each effect acts.
    inertia : (n,) array
        Slopes of the logarithm of the inertia by the parameters.
    batch : int, optional
        Rows of a batch of correlated ones, as in `batch_sums`.
    """

    effects: FloatArray
    direct: FloatArray
    residuals: FloatArray
    columns: FloatArray
    force: FloatArray
    forces: FloatArray
    acts: BoolArray
    inertia: FloatArray
    batch: int | None = None

    def estimates(self) -> tuple[FloatArray, FloatArray]:
        """Estimate and variance ``(K,)`` of each coefficient alone; 0 and infinite where the log determines none."""
        by_interval = np.einsum("wmk,wmk->wk", self.columns, self.columns)
        scores = np.einsum("wmk,wm->wk", self.columns, self.residuals)
        information = by_interval.sum(axis=0)
        determined = information > ROUNDING * self.direct
        information = np.where(determined, information, 1.0)
        values = np.where(determined, -scores.sum(axis=0) / information, 0.0)
        scatter = np.square(batch_sums(scores + by_interval * values, self.batch)).sum(axis=0)
        return values, np.where(determined, np.maximum(information, scatter) / np.square(information), np.inf)

    def of(self, some: Sequence[int]) -> TermRegression:
        """The regression on some of the effects."""
        return replace(
            self,
            effects=self.effects[:, some],
            direct=self.direct[some],
            columns=self.columns[:, :, some],
            forces=self.forces[:, :, some],
            acts=self.acts[:, some],
        )

    def beside(self, *chosen: int) -> TermRegression:
        """The regression with the chosen effects among all else that is estimated."""
        if not chosen:
            return self
        k, *others = chosen
        own, (value, shares) = self.columns[:, :, k], self._along(k)
        regression = replace(
            self,
            effects=self.effects - self.effects[:, k, None] * shares,
            residuals=self.residuals + own * value,
            columns=self.columns - own[:, :, None] * shares,
            force=self.force + self.forces[:, :, k] * value,
            forces=self.forces - self.forces[:, :, k, None] * shares,
        )
        return regression.beside(*others)

    def divisor(self, changes: FloatArray) -> FloatArray:
        """Divisor, 1 or more, of coefficients and of the changes ``(n, ...)`` of the parameters with them.

        Accelerations are linear in forces over the inertia, and in its inverse.  Where a term makes the inertia
        smaller, the forces are smaller with it.
        """
        return np.maximum(1.0 - np.tensordot(self.inertia, changes, 1), 1.0)

    def together(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Estimates ``(c,)`` of the chosen coefficients, each beside the others, and their covariance."""
        columns = self.columns[:, :, list(chosen)]
        covariance = np.linalg.inv(np.einsum("wmk,wml->kl", columns, columns))
        values = -covariance @ np.einsum("wmk,wm->k", columns, self.residuals)
        errors = np.einsum("wmk,wm->wk", columns, self.residuals + columns @ values) @ covariance
        wider = np.sqrt(np.maximum(np.square(batch_sums(errors, self.batch)).sum(axis=0) / np.diag(covariance), 1.0))
        return values, covariance * np.outer(wider, wider)

    def joint(self, chosen: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Coefficients ``(c,)`` of the chosen effects, each beside the others, and their standard errors."""
        values, covariance = self.together(chosen)
        divisor = self.divisor(self.effects[:, list(chosen)] @ values)
        return values / divisor, np.sqrt(np.diag(covariance)) / divisor

    def explained(self, k: int, members: Sequence[int] = ()) -> float:
        """Fraction of the mean square unmodelled force that effect k explains, in the equations where it acts.

        Beside the others of a set of effects.
        """
        others = [x for x in members if x != k]
        own = self.of([k, *others]).beside(*range(1, 1 + len(others)))
        acts, (value, _) = own.acts[:, 0], own._along(0)
        before, after = (
            np.square(x[:, acts]).sum(axis=0) for x in (own.force, own.force + own.forces[:, :, 0] * value)
        )
        return float(1.0 - (after / size_or_one(before)).mean())

    def _along(self, k: int) -> tuple[float, FloatArray]:
        """The coefficient of effect k alone, and coefficients ``(K,)`` of the others' columns on its column."""
        own = self.columns[:, :, k]
        along = own / size_or_one(np.square(own).sum())
        return -float((along * self.residuals).sum()), np.einsum("wm,wmk->k", along, self.columns)


def parts_of_intervals(intervals: Windows, fit: Fit, n_terms: int) -> int:
    """Parts of each interval over which terms are constant: samples, if the regression then fits into the memory.

    Terms change with each reversal, within intervals over which the unmodelled acceleration is constant: a mean would
    count a friction that reverses as one that is small.
    """
    most = _NUMBERS / (len(intervals) * _numbers(fit, n_terms))
    return max(x for x in range(1, intervals.length + 1) if intervals.length % x == 0 and (x == 1 or x < most))


def term_regression(
    intervals: Windows,
    fit: Fit,
    result: ProjectedEstimate,
    accelerations: FloatArray,
    inertia: FloatArray,
    acts: BoolArray,
    slopes: FloatArray,
) -> TermRegression:
    """The regression on effects that accelerate the model.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    result : ProjectedEstimate
        Of a fit whose intervals were split.
    accelerations : (W, n_v, K) array
        Of each term per unit of its coefficient, constant over each interval.
    inertia : (W_e, n_v, n_v) array
        Means of the intervals of the estimate.
    acts, slopes : array
        As in `TermRegression`.

    Returns
    -------
    TermRegression
    """
    prior = fit.prior.copy()
    prior[intervals.n_p :] *= _HELD
    fit = replace(fit, prior=prior)
    at, n_x = linearize(intervals, fit, weights_of(intervals, fit)), fit.x.shape[1]
    n, parts = len(inertia), len(intervals) // len(inertia)
    pushed = _Pushed(intervals, fit, accelerations, at)
    sections = _sections(len(intervals), parts, _numbers(fit, accelerations.shape[2]))
    direct, of_s = (np.sum(x, axis=0) for x in zip(*map(pushed.of_shared, sections), strict=True))
    windows, s = at.system.functional_in_sections(pushed.of_windows, np.column_stack([of_s, at.right_s]), sections)
    rows, batches, length = list[FloatArray](), list[list[FloatArray]](), 1 if len(sections) == 1 else round(np.sqrt(n))
    effects, moved = result.of_s.T @ s[:, :-1], np.empty((n, inertia.shape[1], s.shape[1]))
    for part, (before, z, after) in zip(sections, _with_neighbours(windows), strict=True):
        own = slice(part.start // parts, part.stop // parts)
        found = pushed.residuals(part, z, before, after, s)
        found = found.reshape(-1, parts * found.shape[1], found.shape[2])
        if length == 1:
            rows.append(found)
        else:
            _gather(batches, found, own.start, length)
        # Of each interval of the estimate: the state at its start, and the mean unmodelled acceleration.
        z = z.reshape(-1, parts, *z.shape[1:])
        z = np.concatenate([z[:, 0, :n_x], z[:, :, n_x:].mean(axis=1)], axis=1)
        effects = effects + np.einsum("wkp,wke->pe", result.of_z[own], z[:, :, :-1], optimize=True)
        np.matmul(inertia[own], z[:, n_x:], out=moved[own])
    rows += [_triangle(x)[None] for x in batches]
    d = fit.d.reshape(n, parts, -1).mean(axis=1)
    force = (inertia @ d[:, :, None])[:, :, 0] + moved[:, :, -1]
    beforehand = np.column_stack([s, fit.shared - fit.prior_mean]) / prior[:, None]
    more = np.pad(beforehand, ((0, -len(beforehand) % rows[0].shape[1]), (0, 0)))
    together = np.concatenate([*rows, more.reshape(-1, *rows[0].shape[1:])])
    left, columns = together[:, :, -1] + together[:, :, -2], together[:, :, :-2]
    batch = None if length == 1 else 1
    return TermRegression(effects, direct, left, columns, force, moved[:, :, :-1], acts, slopes, batch)


@dataclass(frozen=True, eq=False, repr=False)
class _Pushed:
    """A fit that accelerations (W, n_v, K) of K terms push, and its normal equations."""

    intervals: Windows
    fit: Fit
    accelerations: FloatArray
    at: NormalEquations

    @cached_property
    def n_measured(self) -> int:
        """Largest number of measurements of an interval."""
        return int(self.intervals.known.reshape(len(self.intervals), -1).sum(axis=1).max())

    @cached_property
    def of_measurements(self) -> Callable[[int, int], GaussNewtonBatch]:
        """Sums of the measurements of intervals from one to before another; the last ones are kept."""
        intervals, at = self.intervals, (self.fit.shared, self.fit.x, self.fit.d, self.at.weights)
        # Without a reference to this object, which would keep its equations until a collection of garbage.
        return lru_cache(maxsize=1)(lambda *some: intervals.gauss_newton(*at, chosen=np.arange(*some)))

    def by_d(self, part: slice) -> FloatArray:
        """Columns ``(n, n, n_v)`` of the unmodelled accelerations in the information of the measurements."""
        return self.of_measurements(part.start, part.stop).normal_matrix[
            :, :, self.fit.x.shape[1] : self.at.right_z.shape[1]
        ]

    def jumps(self, links: slice) -> tuple[FloatArray, FloatArray]:
        """Change ``(n, n_x, K)`` of the jumps at the ends of some intervals, and that times their precision."""
        n_x, k = self.fit.x.shape[1], self.at.right_z.shape[1]
        jumps = -self.at.slopes[links, :, n_x:k] @ self.accelerations[:-1][links]
        return jumps, self.at.precision[links, :, None] * jumps

    def of_shared(self, part: slice) -> tuple[FloatArray, FloatArray]:
        """Of some intervals: information (K,) of each coefficient alone, and right-hand sides (n_s, K)."""
        n_x, k = self.fit.x.shape[1], self.at.right_z.shape[1]
        links = slice(part.start, min(part.stop, len(self.at.jumps)))
        own, by_d, (jumps, force) = self.accelerations[part], self.by_d(part), self.jumps(links)
        direct = (own * (by_d[:, n_x:k] @ own)).sum(axis=(0, 1)) + (jumps * force).sum(axis=(0, 1))
        of_jumps = sum_of_products(self.intervals, self.at.slopes[links, :, k:].swapaxes(1, 2), force, part)
        return direct, of_jumps - sum_of_products(self.intervals, by_d[:, k:], own, part)

    def of_windows(self, part: slice) -> FloatArray:
        """Right-hand sides ``(n, k, K + 1)``: what takes up each term, and the step of all else.

        The step is what an unfinished fit, or one without discrepancies, gives up.
        """
        n_x, k, first = self.fit.x.shape[1], self.at.right_z.shape[1], max(part.start - 1, 0)
        links = slice(first, min(part.stop, len(self.at.jumps)))
        found = np.empty((part.stop - part.start, k, self.accelerations.shape[2] + 1))
        found[:, :, :-1] = -self.by_d(part)[:, :k] @ self.accelerations[part]
        found[:, :, -1] = self.at.right_z[part]
        _, force = self.jumps(links)
        own = force[part.start - first :]
        found[: len(own), :, :-1] += self.at.slopes[part.start : links.stop, :, :k].swapaxes(1, 2) @ own
        reached = force[: part.stop - 1 - first]
        found[first + 1 - part.start :][: len(reached), :n_x, :-1] -= reached
        return found

    def residuals(self, part: slice, z: FloatArray, before: FloatArray, after: FloatArray, s: FloatArray) -> FloatArray:
        """Whitened residuals of a section: slopes by each coefficient, the change by the step, and what the fit leaves.

        Of the measurements, of continuity, and of the unmodelled accelerations from their prior.

        Parameters
        ----------
        part : slice
            Intervals of the section.
        z, before, after, s : (n, k, K + 1), (1, k, K + 1), (0 or 1, k, K + 1) and (n_s, K + 1) array
            Solutions of the section, of the intervals before and after it, and of the shared unknowns.

        Returns
        -------
        (n, m, K + 2) array
        """
        at, intervals, fit = self.at, self.intervals, self.fit
        sums = self.of_measurements(part.start, part.stop)
        n_x, k, K = fit.x.shape[1], z.shape[1], s.shape[1]
        moved, of_log = z.copy(), of_logs(intervals, s, part)
        moved[:, n_x:, :-1] += self.accelerations[part]
        root, residuals = _whitened(sums.normal_matrix, sums.gradient, self.n_measured)
        found: FloatArray = np.zeros((len(z), root.shape[1] + k, K + 1))
        measured, ahead, driven = np.split(found, [root.shape[1], root.shape[1] + n_x], axis=1)
        np.matmul(root[:, :, :k], moved, out=measured[:, :, :K])
        measured[:, :, :K] += root[:, :, k:] @ of_log
        measured[:, :, K] = residuals
        following = np.concatenate([z[1:], after])
        n, links = len(following), slice(part.start, part.start + len(following))
        slopes = at.slopes[links]
        ahead[:n, :, :K] = following[:, :n_x] - slopes[:, :, :k] @ moved[:n] - slopes[:, :, k:] @ of_log[:n]
        ahead[:n, :, K] = at.jumps[links]
        ahead[:n] *= np.sqrt(at.precision[links])[:, :, None]
        rho = np.where(intervals.following[part, None], fit.rho, 0.0)[:, :, None]
        driven[:, :, :K] = z[:, n_x:] - rho * np.concatenate([before, z[:-1]])[:, n_x:]
        driven[:, :, K] = fit.d[part] - rho[:, :, 0] * np.concatenate([fit.d[:1], fit.d[:-1]])[part]
        driven /= innovation_std(intervals, fit)[part, :, None]
        return found


def _sections(n_intervals: int, parts: int, numbers: float) -> list[slice]:
    """All intervals, if their numbers are few; otherwise sections of whole intervals."""
    if n_intervals * numbers <= _NUMBERS:
        return [slice(0, n_intervals)]
    length = parts * max(int(_SECTION / (parts * numbers)), 1)
    return [slice(k, min(k + length, n_intervals)) for k in range(0, n_intervals, length)]


def _numbers(fit: Fit, n_terms: int) -> float:
    """Numbers that an interval takes in the regression on terms."""
    k = fit.x.shape[1] + fit.d.shape[1]
    n = k + len(fit.shared)
    return float(n_terms * (n + 2 * k) + n**2)


def _with_neighbours(sections: Iterator[FloatArray]) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Each section (n, ...) between the last row before it and the first row after it, which the last one lacks."""
    z = next(sections)
    before = z[-1:]
    for after in chain(sections, [z[:0]]):
        yield before, z, after[:1]
        before, z = z[-1:], after


def _gather(batches: list[list[FloatArray]], rows: FloatArray, first: int, length: int) -> None:
    """Append residuals (n, m, c) of intervals from a first one on to batches of a length, as the triangles of many."""
    c = rows.shape[2]
    for begin, end in pairwise([0, *range(-first % length or length, len(rows), length), len(rows)]):
        if (first + begin) % length == 0:
            batches.append([])
        pieces = batches[-1]
        pieces.append(rows[begin:end].reshape(-1, c))
        if sum(map(len, pieces)) > _ROWS * c:
            pieces[:] = [_triangle(pieces)]


def _triangle(pieces: Sequence[FloatArray]) -> FloatArray:
    """Rows (c, c) with the squares and products of others (m, c): the triangle of a QR decomposition."""
    found = np.asarray(np.linalg.qr(np.concatenate(pieces), mode="r"), float)
    return np.pad(found, ((0, found.shape[1] - len(found)), (0, 0)))


def _whitened(H: FloatArray, gradient: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Slopes (W, m, n) of whitened measurements by the unknowns of each interval, and residuals (W, m).

    As many rows as there are unknowns, or measurements, ``most``, say all of the measurements: a square root of their
    information H (W, n, n), and residuals that have their gradient.
    """
    size = size_or_one(np.sqrt(np.einsum("wii->wi", H)))
    values, vectors = (x[..., -most:] for x in np.linalg.eigh(H / (size[:, :, None] * size[:, None, :])))
    known = values > ROUNDING * values[:, -1:]
    root = np.sqrt(np.where(known, values, 0.0))
    slopes = np.ascontiguousarray((vectors * size[:, :, None] * root[:, None, :]).swapaxes(1, 2))
    return slopes, np.einsum("wji,wj->wi", vectors, gradient / size) / np.where(known, root, np.inf)
