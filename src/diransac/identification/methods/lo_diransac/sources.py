"""Candidates of the competition, and least squares of all rows: of signals as recorded, and at several bandwidths."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError, LogError, SettingsError
from diransac.identification.methods.lo_diransac.segments import ActingInputs
from diransac.identification.regression.rows import regression
from diransac.identification.regression.uncertainty import student_quantile
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.data.log import Log
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.model import Model, Parameter

N_BLOCKS = 10
"""Number of blocks, of which each is left out in turn."""
_KEPT = 0.5
"""Part of a positive parameter that is left at least, where blocks are left out."""
_BANDWIDTHS = (0.5, 1.0, 2.0, 4.0)
"""Of filtered least squares, over the bandwidth that the package chooses for a log."""
_MOST_ROWS = 3000
"""Rows of nonlinear least squares at most: neighbours of filtered signals tell the same."""


@dataclass(frozen=True, eq=False, repr=False)
class Blocks:
    """Stretches of time of about equal length, each of which is left out in turn.

    Parameters
    ----------
    of_row : (N,) int array
        Block of each row of the intervals.
    n : int
    """

    of_row: IntArray
    n: int

    @classmethod
    def of(cls, intervals: ShootingIntervals, *, each: bool = False) -> Blocks:
        """Blocks of the rows that count, as one log; of each log if asked, or where logs have own parameters."""
        found = np.zeros(len(intervals.is_logged), int)
        parts = intervals.rows_of_logs if each or not intervals.layout.is_shared else [slice(None)]
        for rows in parts:
            counted = np.cumsum(intervals.counted[rows]) - 1
            found[rows] = np.clip(N_BLOCKS * counted // max(counted[-1] + 1, 1), 0, N_BLOCKS - 1)
        return cls(found, N_BLOCKS)


@dataclass(frozen=True, eq=False, repr=False)
class Candidate:
    """An estimate of the parameters, and what it is without each block of the logs.

    Parameters
    ----------
    name : str
        Source and variant.
    parameters : (n,) array
    without : (n_blocks, n) array
    acting : ActingInputs
        Inputs with which it was estimated.
    intervals : ShootingIntervals
        The logs, corrected of the errors of their sensors with which it was estimated.
    estimate : callable, optional
        The estimate with its covariance; None: that of the jackknife over blocks.
    """

    name: str
    parameters: FloatArray
    without: FloatArray
    acting: ActingInputs
    intervals: ShootingIntervals
    estimate: Callable[[], ProjectedEstimate] | None = None

    def without_blocks(self, left_out: BoolArray) -> FloatArray:
        """Parameters ``(K, n)`` without K sets ``(K, n_blocks)`` of blocks, to first order."""
        found = self.parameters + left_out @ (self.without - self.parameters)
        for j, bound in enumerate(self.intervals.layout.bounds):
            least = max(bound.lower, _KEPT * self.parameters[j]) if bound.positive else bound.lower
            found[:, j] = np.clip(found[:, j], least, bound.upper)
        return np.asarray(found)


def jackknife(without: FloatArray) -> FloatArray:
    """Covariance ``(n, n)`` from estimates without each block, increased by Student's t for their number."""
    K = len(without)
    apart = without - without.mean(axis=0)
    more = student_quantile(K - 1, 0.975) / student_quantile(10_000, 0.975)
    return np.asarray(more**2 * (K - 1.0) / K * apart.T @ apart)


# ---------------------------------------------------------------------- least squares of all rows


def least_squares_candidates(dataset: Dataset, intervals: ShootingIntervals, blocks: Blocks) -> Iterator[Candidate]:
    """Least squares of all rows, of signals as they were recorded and as they are filtered at several bandwidths.

    Parameters
    ----------
    dataset : Dataset
    intervals : ShootingIntervals
        Of the same logs.
    blocks : Blocks

    Yields
    ------
    Candidate
        Those that the logs and the model admit.
    """
    from diransac.data.dataset import Dataset

    model = dataset.model.with_sensors(())
    acting, whole = ActingInputs.recorded(intervals, dataset.hold), _filtered(dataset, model)
    usual = len(whole) - len(_BANDWIDTHS) + _BANDWIDTHS.index(1.0) if len(whole) >= len(_BANDWIDTHS) else 0
    for k, (label, logs) in enumerate(whole):
        try:
            own = replace(Dataset.of(model, logs), layout=dataset.layout)
        except LogError:
            continue
        block = _blocks_of_rows(own, dataset, intervals, blocks)
        kinds = [_ordinary] if model.is_affine else []
        kinds += [_nonlinear] if k == usual else []
        for kind in kinds:
            check_time()
            try:
                parameters, without = kind(own, block, blocks.n)
            except (IdentificationError, np.linalg.LinAlgError):
                continue
            if np.isfinite(parameters).all() and dataset.layout.admits(parameters[None])[0]:
                name = f"{'ols' if kind is _ordinary else 'nls'}{label}"
                yield Candidate(name, parameters, without, acting, intervals)


def _filtered(dataset: Dataset, model: Model) -> list[tuple[str, list[Log]]]:
    """Logs as they are where all signals are measured, and filtered at several bandwidths; with labels."""
    from diransac.data.preprocessing.differentiation import differentiate

    logs = [one.log for one in dataset.segments]
    needed = (*model.coordinates, *model.velocities, *model.accelerations)
    found = [("", logs)] if all(name in log for log in logs for name in needed) else []
    try:
        usual = [differentiate(log, model) for log in logs]
    except (LogError, SettingsError):
        return found
    for factor in _BANDWIDTHS:
        try:
            bands = [factor * one.filter.bandwidth for one in usual if one.filter is not None]
            some = usual if factor == 1.0 else [differentiate(x, model, f) for x, f in zip(logs, bands, strict=True)]
        except (LogError, SettingsError):
            continue
        found.append((f", {float(np.median(bands)):.3g} Hz", some))
    return found


def _blocks_of_rows(own: Dataset, dataset: Dataset, intervals: ShootingIntervals, blocks: Blocks) -> IntArray:
    """Block of each usable row of prepared logs."""
    places = []
    for one, given, rows in zip(own.segments, dataset.segments, intervals.rows_of_logs, strict=True):
        time = one.log.time[one.offset : one.offset + len(one)][one.valid]
        place = rows.start + np.round((time - given.log.time[given.offset]) / given.log.dt).astype(int)
        places.append(np.clip(place, rows.start, rows.stop - 1))
    return np.asarray(blocks.of_row[np.concatenate(places)])


def _ordinary(own: Dataset, block: IntArray, n_blocks: int) -> tuple[FloatArray, FloatArray]:
    """Ordinary least squares within the bounds, of all rows and without each block."""
    W, b = regression(own)
    columns = np.concatenate([W, b[:, :, None]], axis=2)
    scale = np.sqrt(np.square(columns).mean(axis=(0, 1)))
    columns = columns / np.where(scale > 0.0, scale, 1.0)
    sums = np.array([np.einsum("nri,nrj->ij", x, x) for x in (columns[block == k] for k in range(n_blocks))])
    gram = sums.sum(axis=0)
    unit = scale[-1] / np.where(scale > 0.0, scale, 1.0)[:-1]
    precision = unit**2 / np.square(own.layout.prior_std)
    if precision.any():
        p = np.linalg.lstsq(gram[:-1, :-1], gram[:-1, -1], rcond=None)[0]
        variance = (gram[-1, -1] - p @ gram[:-1, -1]) / b.size
        gram[:-1, :-1] += variance * np.diag(precision)
        gram[:-1, -1] += variance * precision * own.layout.prior_mean / unit
    every = [gram, *(gram - x for x in sums)]
    if not np.isfinite(every).all():  # LAPACK would report it on the terminal
        raise np.linalg.LinAlgError("a number overflows")
    found = np.array([_within_bounds(G, unit, own.layout.bounds) for G in every])
    return found[0], found[1:]


def _within_bounds(gram: FloatArray, unit: FloatArray, bounds: Sequence[Parameter]) -> FloatArray:
    """Least squares ``(n,)`` from sums with the right-hand side as last column; those that leave a bound stay on it."""
    p, stuck = np.zeros(len(unit)), np.zeros(len(unit), bool)
    lower, upper = (np.array([getattr(x, name) for x in bounds]) / unit for name in ("lower", "upper"))
    for _ in range(len(unit)):
        free = ~stuck
        right = gram[:-1, -1] - gram[:-1, :-1][:, stuck] @ p[stuck]
        p[free] = np.linalg.lstsq(gram[:-1, :-1][np.ix_(free, free)], right[free], rcond=1e-12)[0]
        outside = free & ((p < lower) | (p > upper))
        if not outside.any():
            break
        p, stuck = np.clip(p, lower, upper), stuck | outside
    return np.asarray(p * unit)


def _nonlinear(own: Dataset, block: IntArray, n_blocks: int) -> tuple[FloatArray, FloatArray]:
    """Least squares of the accelerations, of all rows and without each block; of an affine model from `_ordinary`."""
    from diransac.identification.regression.nonlinear import NonlinearLeastSquares

    method = NonlinearLeastSquares(n_starts=1, n_followed=0) if own.model.is_affine else NonlinearLeastSquares()
    bound = method.bind(own)
    rows = np.arange(0, bound.n_rows, max(1, bound.n_rows // _MOST_ROWS))
    found = bound.fit_from(rows, bound.of_all_rows)
    groups = [np.flatnonzero(block[rows] == k) for k in range(n_blocks)]
    return found, bound.steps_without(groups, rows, found)
