"""What rollouts give."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from diransac.arrays import FloatArray
from diransac.simulation.compiler.lanes import squared_thresholds
from diransac.simulation.compiler.machine_code import LANES

if TYPE_CHECKING:
    from diransac.simulation.integrators import Sensitivities

__all__ = ["Flights", "GaussNewton", "LinearizedErrors", "Scores", "gauss_newton_of", "inlier_mask"]


@dataclass(frozen=True)
class Scores:
    """How well each rollout agrees with a log.

    Attributes
    ----------
    sum_squares : (n_lanes, n_signals)   sum over valid rows of squared errors, each signal's unit squared; infinite in
        every signal where the rollout diverged
    inlier_count : (n_lanes,)   valid rows in which enough signals are near; rows from a divergence on are not
    diverged : (n_lanes,)   whether some state or acceleration became infinite or NaN
    inlier_bits : (n_lanes / 8, n_rows)   which rows those are, a bit a lane; `inliers` reads them
    """

    sum_squares: FloatArray
    inlier_count: NDArray[np.int64]
    diverged: NDArray[np.bool_]
    inlier_bits: NDArray[np.uint8]

    def inliers(self, lane: int) -> NDArray[np.bool_]:
        """Which rows ``(n_rows,)`` are inliers of one lane."""
        block, place = divmod(lane, 8)
        return np.asarray(self.inlier_bits[block] & (1 << place) != 0)


@dataclass(frozen=True)
class GaussNewton:
    """Least-squares sums of each rollout, for a Gauss-Newton step d z = -(J' W J)^-1 J' W e in its unknowns z.

    Attributes
    ----------
    unknowns : names of z: parameters, and states, whose initial values are meant
    cost : (n_lanes,)   e' W e, without a factor of one half; infinite where the rollout diverged
    gradient : (n_lanes, n_z)   J' W e; zero where it diverged
    normal_matrix : (n_lanes, n_z, n_z)   J' W J; zero where it diverged
    final_states : (n_lanes, n_x)   one row after the last, where the next window begins; NaN where it diverged
    final_slopes : (n_lanes, n_x, n_z)   d(final state)/dz; NaN where it diverged
    diverged : (n_lanes,)   whether a signal, a derivative of the final state or a sum became infinite or NaN
    """

    unknowns: tuple[str, ...]
    cost: FloatArray
    gradient: FloatArray
    normal_matrix: FloatArray
    final_states: FloatArray
    final_slopes: FloatArray
    diverged: NDArray[np.bool_]


def gauss_newton_of(sensitivities: Sensitivities, n_lanes: int, sums: FloatArray, final: FloatArray) -> GaussNewton:
    """What the compiled loop wrote block by block, by its names.

    Parameters
    ----------
    sensitivities : what was differentiated
    n_lanes : without those that fill the last block
    sums : (n_blocks, 1 + n_z + n_z (n_z + 1) / 2, 8)   e' W e, J' W e, and the upper triangle of J' W J
    final : (n_blocks, n_states, 8)   state, then its varying derivatives
    """
    sums, final = (
        array.swapaxes(1, 2).reshape(len(array) * LANES, array.shape[1])[:n_lanes] for array in (sums, final)
    )
    n_x, n_z = sensitivities.initial.shape
    upper = np.triu_indices(n_z)
    normal_matrix = np.empty((n_lanes, n_z, n_z))
    normal_matrix[:, *upper] = normal_matrix[:, *upper[::-1]] = sums[:, 1 + n_z :]
    cost, gradient = sums[:, 0].copy(), sums[:, 1 : 1 + n_z].copy()
    diverged = np.isinf(cost)
    slopes = sensitivities.matrix(final[:, n_x:])
    slopes[diverged] = np.nan
    return GaussNewton(sensitivities.unknowns, cost, gradient, normal_matrix, final[:, :n_x].copy(), slopes, diverged)


@dataclass(frozen=True)
class LinearizedErrors:
    """Errors of each rollout and their derivatives, row by row; NaN from a divergence on.

    Attributes
    ----------
    unknowns : names of z, as `GaussNewton` has them
    errors : (n_lanes, n_rows, n_s)   simulated less measured, each signal's unit
    jacobian : (n_lanes, n_rows, n_s, n_z)   their derivatives
    """

    unknowns: tuple[str, ...]
    errors: FloatArray
    jacobian: FloatArray


@dataclass(frozen=True)
class Flights:
    """Rollouts under feedback, row by row; NaN from a divergence on.

    Attributes
    ----------
    signals : (n_lanes, n_rows, n_signals)   states and accelerations
    inputs : (n_lanes, n_rows, n_u)   those that were applied from each row to the next
    """

    signals: FloatArray
    inputs: FloatArray


def inlier_mask(
    errors: FloatArray, valid: NDArray[np.bool_], thresholds: ArrayLike, min_inlier_signals: int
) -> NDArray[np.bool_]:
    """Which rows `Rollouts.score` counts as inliers, from `Rollouts.errors`.

    Parameters
    ----------
    errors : (n_lanes, n_rows, n_s)   each signal's unit
    valid : (n_rows,) or (n_lanes, n_rows)   rows that count
    thresholds : (n_s,)   each signal's unit
    min_inlier_signals : near signals that make a row an inlier

    Returns
    -------
    (n_lanes, n_rows)
    """
    with np.errstate(over="ignore", under="ignore"):
        near = np.square(errors) < squared_thresholds(thresholds, errors.shape[-1])
    diverged = np.isnan(errors).any(axis=-1)
    return np.asarray((near.sum(axis=-1) >= min_inlier_signals) & ~diverged & valid)
