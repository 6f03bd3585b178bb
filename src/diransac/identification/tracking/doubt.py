"""Changes of parameters that a window cannot exclude, and for which intervals allow.

- What was known of a parameter before the window contradicts the window, but unmodelled forces explain that nearly as
  well as a change does: it may be either value.
- A machine of which one parameter has changed may have changed in others, as a payload takes its inertia with it.  Each
  may have changed by the same ratio until the motion since then tells that it has not.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.tracking.step_tests import ChangeTests

__all__ = ["Doubt"]

# Evidence, nats, from which on a change counts that no force has been asked to explain.
_CLEAR = 3.0


class Doubt:
    """Variances that possible changes add to those of n parameters.

    Parameters
    ----------
    n : int

    Attributes
    ----------
    variance : (n,) array
    """

    def __init__(self, n: int) -> None:
        self.variance = np.zeros(n)
        self._ratio = 0.0

    def since(self, ratio: float) -> None:
        """Doubt all parameters: one has changed by this ratio where the window begins."""
        self._ratio = min(abs(ratio), 1.0)

    def update(self, tests: ChangeTests, values: FloatArray, certain: Sequence[int], *, full: bool) -> None:
        """Doubt what the tests of a window leave open.

        Parameters
        ----------
        tests : ChangeTests
        values : (n,) array
            Parameters.
        certain : sequence of int
            Parameters that are known to have changed.
        full : bool
            Whether the window is full, so that it has begun with no change.
        """
        self._ratio = 0.0 if full else self._ratio
        contradicted = tests.gain(values)[:, -1] > _CLEAR
        possible = np.square(self._ratio * values)
        possible[list(certain)] = 0.0
        self.variance = np.where(contradicted, np.square(tests.size[:, -1]), 0.0).max(axis=0)
        self.variance += possible / (1.0 + possible * tests.information[0, -1])
