"""Base parameters: the combinations of parameters that any motion can show.

Forces are linear in the parameters, ``F = Y(q, v, a) x``.  Columns of Y that vanish, or that are combinations of others
for every motion, are found numerically, from many random motions (Gautier 1991, "Numerical calculation of the base
inertial parameters of robots", Journal of Robotic Systems 8(4)).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray


@dataclass(frozen=True)
class Grouping:
    """Base parameters ``b = x[kept] + weights x[dropped]``.

    Parameters
    ----------
    kept : tuple of int
        Indices of the parameters after which the base parameters are named.
    dropped : tuple of int
        Indices of the others.
    weights : (n_kept, n_dropped) array
    """

    kept: tuple[int, ...]
    dropped: tuple[int, ...]
    weights: FloatArray

    def combination(self, i: int) -> dict[int, float]:
        """Weight of every parameter in a base parameter, by index."""
        others = zip(self.dropped, self.weights[i].tolist(), strict=True)
        return {self.kept[i]: 1.0, **{k: weight for k, weight in others if weight != 0.0}}

    @property
    def vanishing(self) -> tuple[int, ...]:
        """Indices of the parameters that are in no base parameter: no motion shows them."""
        return tuple(k for k, column in zip(self.dropped, self.weights.T, strict=True) if not column.any())


def base_parameters(regressor: ca.Function, seed: int = 0) -> Grouping:
    """Base parameters of forces that are linear in parameters, the first of dependent ones kept.

    Parameters
    ----------
    regressor : casadi.Function
        ``(q, v, a) -> Y (n, n_x)``, or ``(q, v, a, w, dw, f) -> Y`` with the motion of a base.
    seed : int, optional
        Seed of the random motions.
    """
    n, n_x = regressor.size1_in(0), regressor.size2_out(0)
    # Rounding error of a column relative to the largest, and of weights between columns of unit length.
    rounding = 1e-9
    rng = np.random.default_rng(seed)
    n_points = 3 * n_x // n + 10
    sizes = [regressor.size1_in(k) for k in range(regressor.n_in())]
    # Of random motions: position, velocity, acceleration; angular velocity and acceleration of a base, specific
    # force.
    motion = [
        rng.uniform(-x, x, (size, n_points))
        for x, size in zip((np.pi, 3.0, 10.0, 3.0, 10.0, 15.0), sizes, strict=False)
    ]
    stacked = np.hsplit(np.array(ca.densify(regressor(*motion))), n_points)
    Y = np.vstack(stacked)
    lengths = np.linalg.norm(Y, axis=0)
    seen = lengths > rounding * lengths.max()
    Y, lengths = np.where(seen, Y / np.where(seen, lengths, 1.0), 0.0), np.where(seen, lengths, 1.0)
    kept = _independent_columns(Y)
    dropped = tuple(k for k in range(n_x) if k not in kept)
    weights = np.linalg.lstsq(Y[:, kept], Y[:, dropped])[0] if kept and dropped else np.zeros((len(kept), len(dropped)))
    weights[np.abs(weights) < rounding] = 0.0
    weights *= lengths[list(dropped)] / lengths[kept, None]
    # Decimal digits of weights, which are products of lengths in m.
    return Grouping(tuple(kept), dropped, np.round(weights, 10))


def _independent_columns(Y: FloatArray) -> list[int]:
    """Indices of the columns of unit length that are no combination of those before them, by Gram-Schmidt, twice."""
    kept, basis = list[int](), np.zeros((len(Y), 0))
    for k, column in enumerate(Y.T):
        rest = column - basis @ (basis.T @ column)
        rest = rest - basis @ (basis.T @ rest)
        size = float(np.linalg.norm(rest))
        # Share of a column, at most, that is left of it beside the others where it is their combination.
        # Angles in descriptions are rounded: 1.5708 is a right angle. What such an error shows of a parameter
        # is nothing.
        if size > 1e-4:
            kept.append(k)
            basis = np.column_stack([basis, rest / size])
    return kept
