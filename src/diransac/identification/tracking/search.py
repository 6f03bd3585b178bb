"""Search for the explanation of a window in which tests have found a change: a step, or larger forces.

It takes as long as many updates and is spread over some, while the window moves on: it has a copy of the window.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.identification.tracking.forces import Forces, with_forces
from diransac.identification.tracking.step_tests import change_tests
from diransac.identification.tracking.stepped_fits import SteppedFit, SteppedFits

if TYPE_CHECKING:
    from diransac.identification.core.boundary import BoundaryPrior
    from diransac.identification.tracking.window import Window


@dataclass(frozen=True)
class Found:
    """Likeliest step of a window, and its rivals.

    Parameters
    ----------
    fits : SteppedFits
        All explanations.
    step : SteppedFit
    known : (m,) array
        Inverse variances of its sizes.
    scatter : float
        Variance of the ratios of its tests where nothing changes.
    larger : Forces
        Unmodelled accelerations that may explain the window instead.
    over_usual, over_rivals : float
        Evidence, nats, by which the step is likelier than the usual unmodelled accelerations, and than any.
    """

    fits: SteppedFits
    step: SteppedFit
    known: FloatArray
    scatter: float
    larger: Forces
    over_usual: float
    over_rivals: float


def sought(
    window: Window, usual: Forces, kept: BoundaryPrior | None, ages: IntArray, scatter: FloatArray
) -> Generator[None, None, tuple[int, Found | None]]:
    """Search of a window.

    Parameters
    ----------
    window : Window
        That does not move on.
    usual : Forces
        Unmodelled accelerations from before the window.
    kept : BoundaryPrior, optional
        What was known before the window, where it begins with a change.
    ages : (A,) int array
        Intervals since the changes that are compared.
    scatter : (A, n_p) array
        Variance of the ratios of their tests where nothing changes.

    Returns
    -------
    generator
        Yields after each fit, and returns the age of the likeliest change with the explanation; None if no parameter
        has changed.
    """
    fits = yield from SteppedFits.of(window, usual, kept)
    tests = change_tests(with_forces(fits.motion, usual), ages)
    of_steps, chosen = tests.steps_at_once(window.fit.shared, scatter)
    place = int(np.argmax(of_steps))
    if not chosen[place].any():
        return int(ages[place]), None
    few, first, sizes = np.flatnonzero(chosen[place]), len(window) - int(ages[place]), tests.sizes(place, chosen[place])
    step, forces = (yield from fits.nearby(first, few, sizes, usual)), usual
    # A change may have been taken for forces until it is found: the model may be exact with it.
    exact = Forces(np.broadcast_to(window.least, window.fit.d.shape), np.zeros_like(window.least))
    if (usual.tau > window.expected).any() and fits.stepped(first, few, sizes, exact).evidence > step.evidence:
        step, forces = (yield from fits.nearby(first, few, sizes, exact)), exact
    larger, unchanged = fits.larger_since(len(window) - step.first), dict[Forces, float]()
    for x in (usual, forces, larger):
        unchanged[x] = unchanged[x] if x in unchanged else fits.unchanged(x)
        yield
    without = max(unchanged.values())
    if step.evidence < without:
        step, forces = fits.stepped(step.first, few, step.sizes, larger), larger
    if step.evidence > without:
        step = yield from fits.simplest(step, forces)
    known, of_step = tests.information[0, place, step.changed], float(scatter[place, step.changed].max())
    over_usual, over_rivals = step.evidence - unchanged[usual], step.evidence - without
    return int(ages[place]), Found(fits, step, known, of_step, larger, over_usual, over_rivals)
