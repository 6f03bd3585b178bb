"""Candidates of the competition, and least squares of all rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import IdentificationError, LogError, SettingsError
from diransac.identification.core.rows import Rows, inclusive_bounds, solve
from diransac.identification.methods.lo_diransac.segments import ActingInputs
from diransac.identification.regression.estimators import OrdinaryLeastSquares
from diransac.identification.regression.rows import regression
from diransac.identification.regression.uncertainty import student_quantile
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.methods.lo_diransac.smoothing import Motion

N_BLOCKS = 10
"""Number of blocks, of which each is left out in turn."""
_KEPT = 0.5
"""Part of a positive parameter that is left at least, where blocks are left out."""


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
    def of(cls, intervals: Windows, *, each: bool = False) -> Blocks:
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
    intervals : Windows
        The logs, corrected of the errors of their sensors with which it was estimated.
    estimate : callable, optional
        The estimate with its covariance; None: no fit gave it, and its covariance is that of the jackknife over blocks.
    motion : Motion, optional
        With which a fit may begin from an estimate that no fit gave.
    """

    name: str
    parameters: FloatArray
    without: FloatArray
    acting: ActingInputs
    intervals: Windows
    estimate: Callable[[], ProjectedEstimate] | None = None
    motion: Motion | None = None

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


def least_squares_candidates(dataset: Dataset, intervals: Windows, blocks: Blocks) -> Iterator[Candidate]:
    """Estimates of the methods `ols` and `nls`: of signals as recorded where all are measured, else as filtered.

    Those that the logs determine and the bounds admit.
    """
    from diransac.data.dataset import Dataset
    from diransac.data.preprocessing.differentiation import differentiate

    model, logs = dataset.model.with_sensors(()), [x.log for x in dataset.segments]
    needed = (*model.coordinates, *model.velocities, *model.accelerations)
    try:
        complete = all(name in x for x in logs for name in needed)
        own = Dataset.of(model, logs if complete else [differentiate(x, model) for x in logs])
    except (LogError, SettingsError):
        return
    if len(own.layout) != len(dataset.layout):  # sensors have parameters of their own
        return
    own = replace(own, layout=dataset.layout)
    block = _blocks_of_rows(own, dataset, intervals, blocks)
    for name in ("ols", "nls") if model.is_affine else ("nls",):
        check_time()
        with suppress(IdentificationError, np.linalg.LinAlgError):
            p, without = (_ordinary if name == "ols" else _nonlinear)(own, block, blocks.n)
            if np.isfinite([p, *without]).all() and dataset.layout.admits(p[None])[0]:
                yield Candidate(name, p, without, ActingInputs.recorded(intervals, dataset.hold), intervals)


def _blocks_of_rows(own: Dataset, dataset: Dataset, intervals: Windows, blocks: Blocks) -> IntArray:
    """Block of each usable row of prepared logs."""
    places = []
    for one, given, rows in zip(own.segments, dataset.segments, intervals.rows_of_logs, strict=True):
        time = one.log.time[one.offset : one.offset + len(one)][one.valid]
        place = rows.start + np.round((time - given.log.time[given.offset]) / given.log.dt).astype(int)
        places.append(np.clip(place, rows.start, rows.stop - 1))
    return np.asarray(blocks.of_row[np.concatenate(places)])


def _ordinary(own: Dataset, block: IntArray, n_blocks: int) -> tuple[FloatArray, FloatArray]:
    """Ordinary least squares within the bounds, of all rows and without each block: to first order on a bound."""
    bound = OrdinaryLeastSquares().bind(own)
    rows = np.arange(bound.n_rows)
    groups = [np.flatnonzero(block == k) for k in range(n_blocks)]
    p, without = bound.select([rows]).fit()[0], bound.fit_without(groups, rows)
    lower, upper = inclusive_bounds(own.layout.bounds, zero=True)
    if ((p >= lower) & (p <= upper)).all():
        return p, without
    within = solve(Rows(*regression(own)), bounds=(lower, upper)).p
    return within, np.clip(within + without - p, lower, upper)


def _nonlinear(own: Dataset, block: IntArray, n_blocks: int) -> tuple[FloatArray, FloatArray]:
    """Least squares of the accelerations, of all rows and without each block; of an affine model from `_ordinary`."""
    from diransac.identification.regression.nonlinear import NonlinearLeastSquares

    method = NonlinearLeastSquares(n_starts=1, n_followed=0) if own.model.is_affine else NonlinearLeastSquares()
    bound = method.bind(own)
    rows = np.arange(0, bound.n_rows, max(1, bound.n_rows // 3000))
    parameters = bound.fit_from(rows, bound.of_all_rows)
    groups = [np.flatnonzero(block[rows] == k) for k in range(n_blocks)]
    return parameters, bound.steps_without(groups, rows, parameters)
