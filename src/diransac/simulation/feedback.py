"""Feedback laws: inputs that answer to the state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from diransac.arrays import FloatArray
from diransac.errors import SettingsError

__all__ = ["Law"]


@dataclass(frozen=True)
class Law:
    """`u[k] = clip(u_ref[k] - K[k] (x - x_ref[k]), u_min, u_max)` from the state at row k, held to the next row.

    One law, or a table of them: then every array but the limits has a leading axis of n_laws. Errors are plain
    differences: angles are not wrapped. A quaternion takes the sign that is nearer to the reference's first.

    Parameters
    ----------
    u_ref : (n_rows, n_u) or (n_laws, n_rows, n_u)   feed-forward
    x_ref : (n_rows, n_x) or (n_laws, n_rows, n_x)   state to be held
    gains : (n_rows, n_u, n_x) or (n_laws, n_rows, n_u, n_x)   K, each input's unit over each state's
    u_min, u_max : (n_u,)   limits of the inputs, infinite where there is none

    Raises SettingsError: an array of another shape, a number that isn't finite, limits that leave no room.
    """

    u_ref: FloatArray
    x_ref: FloatArray
    gains: FloatArray
    u_min: FloatArray
    u_max: FloatArray

    def __init__(
        self,
        u_ref: ArrayLike,
        x_ref: ArrayLike,
        gains: ArrayLike,
        u_min: ArrayLike = -np.inf,
        u_max: ArrayLike = np.inf,
    ) -> None:
        u, x, K = (np.array(array, np.float64) for array in (u_ref, x_ref, gains))
        fits = u.ndim in (2, 3) and x.ndim == u.ndim and x.shape[:-1] == u.shape[:-1]
        if not fits or K.shape != (*u.shape, x.shape[-1]):
            raise SettingsError(
                f"a law needs u_ref (n_rows, n_u), x_ref (n_rows, n_x) and gains (n_rows, n_u, n_x), or all of them "
                f"with a leading axis of n_laws; found {u.shape}, {x.shape} and {K.shape}."
            )
        low, high = _limits(u.shape[-1], u_min, u_max)
        for name, array in {"u_ref": u, "x_ref": x, "gains": K, "u_min": low, "u_max": high}.items():
            if not (name.startswith("u_m") or np.isfinite(array).all()):
                raise SettingsError(f"the law's {name} holds a NaN or an infinity.")
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def n_rows(self) -> int:
        """Rows of each law."""
        return int(self.u_ref.shape[-2])

    @property
    def n_u(self) -> int:
        """Inputs that it gives."""
        return int(self.u_ref.shape[-1])

    @property
    def n_x(self) -> int:
        """States that it answers to."""
        return int(self.x_ref.shape[-1])

    @property
    def n_laws(self) -> int | None:
        """Laws of the table; None if there is no table."""
        return self.u_ref.shape[0] if self.u_ref.ndim == 3 else None

    def table(self) -> FloatArray:
        """All numbers of a row side by side, (n_laws, n_rows, n_u + n_x + n_u n_x)."""
        gains = self.gains.reshape(*self.gains.shape[:-2], -1)
        rows = np.concatenate([self.u_ref, self.x_ref, gains], axis=-1)
        return np.ascontiguousarray(rows.reshape(-1, *rows.shape[-2:]))


def _limits(n_u: int, u_min: ArrayLike, u_max: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Smallest and largest inputs (n_u,)."""
    try:
        low, high = (np.broadcast_to(np.array(limit, np.float64), (n_u,)).copy() for limit in (u_min, u_max))
    except ValueError as error:
        raise SettingsError(f"u_min and u_max must be {n_u} numbers each: {error}.") from error
    if not (low <= high).all():
        raise SettingsError(f"the law's limits leave no room: u_min {low.tolist()}, u_max {high.tolist()}.")
    return low, high
