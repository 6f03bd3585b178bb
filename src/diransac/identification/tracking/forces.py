"""Other sizes of the unmodelled accelerations of a linearised window: what they change, and what they gain."""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.fit import innovation_std, innovations

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import ShootingIntervals
    from diransac.identification.tracking.window import Linearization

# Correlations of unmodelled accelerations that are larger than usual, and number of their sizes.
_GUST, _SLOW = 0.9, 0.98
_SIZES = 5


class _Terms(NamedTuple):
    """Terms of the innovations in the normal equations: diagonals, those below, right-hand side, cost, log density."""

    diagonal: FloatArray
    below: FloatArray
    right: FloatArray
    cost: float
    log_std: float


def _terms(intervals: ShootingIntervals, fit: Fit) -> _Terms:
    std = innovation_std(intervals, fit)
    own, rho = np.square(1.0 / std), np.where(intervals.following[1:, None], fit.rho, 0.0)
    scaled = innovations(intervals, fit)
    deviation = scaled / std
    diagonal, right = own.copy(), -deviation
    diagonal[:-1] += np.square(rho) * own[1:]
    right[:-1] += rho * deviation[1:]
    return _Terms(
        diagonal, -rho * own[1:], right, float(np.square(scaled).sum()), float(np.log(std[np.isfinite(std)]).sum())
    )


@dataclass(frozen=True, eq=False)
class Forces:
    """Unmodelled accelerations.

    Parameters
    ----------
    tau : (n_v,) or (W, n_v) array
        Their size.
    rho : (n_v,) array
        Their correlation from interval to interval.
    """

    tau: FloatArray
    rho: FloatArray


def with_forces(found: Linearization, forces: Forces) -> Linearization:
    """The linearised window with other scales of the unmodelled accelerations.

    Parameters
    ----------
    found : Linearization
    forces : Forces

    Returns
    -------
    Linearization
        Its solution is still that of the former scales.
    """
    at, fit = found.at, replace(found.fit, tau=forces.tau, rho=forces.rho)
    old, new, n_x = _terms(found.intervals, found.fit), _terms(found.intervals, fit), fit.x.shape[1]
    diagonal, below, right = at.system.diagonal.copy(), at.system.below.copy(), at.right_z.copy()
    np.einsum("wii->wi", diagonal)[:, n_x:] += new.diagonal - old.diagonal
    np.einsum("wii->wi", below)[:, n_x:] += new.below - old.below
    right[:, n_x:] += new.right - old.right
    system = replace(at.system, diagonal=diagonal, below=below)
    return replace(found, fit=fit, at=replace(at, system=system, right_z=right))


def likeliest_forces(
    found: Linearization, least: FloatArray, most: FloatArray, ages: Iterable[int]
) -> Generator[None, None, Forces]:
    """Unmodelled accelerations that explain a linearised window best: its own, or larger ones, as a gust has.

    All become larger from a time on, and then each by itself, as long as the evidence grows.

    Parameters
    ----------
    found : Linearization
    least, most : (n_v,) array
        Sizes between which they are sought, where its own are not larger.
    ages : iterable of int
        Intervals at the end of the window in which they may be larger.

    Returns
    -------
    generator
        Yields where it may be interrupted, and returns the accelerations.
    """
    usual = Forces(np.broadcast_to(found.fit.tau, found.fit.d.shape), found.fit.rho)
    low, rho = np.maximum(usual.tau, least), np.maximum(usual.rho, _GUST)
    sizes = [low * (np.maximum(most, low) / low) ** share for share in np.linspace(0.0, 1.0, _SIZES)]
    best = likeliest(found, [Forces(tau, rho) for tau in sizes])[0]
    best = likeliest(found, [since(usual, age, best) for age in ages])[0]
    now = np.any(best.tau > usual.tau, axis=1, keepdims=True)
    trials = [usual, *(Forces(np.where(now, tau, usual.tau), rho) for tau in sizes)]
    best, evidence = likeliest(found, [*trials, Forces(best.tau, np.maximum(rho, _SLOW))])
    for k in np.flatnonzero((low < most).any(axis=0)):
        yield
        axis = np.arange(len(least)) == k
        of_axis = [usual.tau, *(np.where(best.tau > usual.tau, tau, usual.tau) for tau in sizes)]
        trials = [Forces(np.where(axis, tau, best.tau), best.rho) for tau in of_axis]
        best, evidence = max((best, evidence), likeliest(found, trials), key=lambda x: x[1])
    return best


def since(usual: Forces, age: int, larger: Forces) -> Forces:
    """Unmodelled accelerations as usual, and larger ones in some intervals at the end."""
    now = np.arange(len(usual.tau)) >= len(usual.tau) - age
    return Forces(np.where(now[:, None], larger.tau, usual.tau), larger.rho)


def likeliest(found: Linearization, trials: Sequence[Forces]) -> tuple[Forces, float]:
    """Those of some unmodelled accelerations with the largest evidence, and that."""
    return max(((x, _evidence(with_forces(found, x))) for x in trials), key=lambda x: x[1])


def gain_of_freedom(found: Linearization, least: FloatArray, expected: FloatArray, most: FloatArray) -> float:
    """Evidence, nats, that unmodelled accelerations gain over a model that is exact.

    Parameters
    ----------
    found : Linearization
    least, expected : (n_v,) array
        Sizes of the unmodelled accelerations of an exact model, and those that are expected of any other.
    most : (n_v,) array
        The largest ones.

    Returns
    -------
    float
        The larger one of the sizes of the fit, where they are larger than the least, and of some others.
    """
    none = np.zeros_like(least)
    others = [Forces(expected, none), Forces(np.minimum(30.0 * expected, most), none + _GUST)]
    if (found.fit.tau > least).any():
        others = [Forces(found.fit.tau, found.fit.rho)]
    return likeliest(found, others)[1] - likeliest(found, [Forces(least, none)])[1]


def _evidence(found: Linearization) -> float:
    """Logarithm of the evidence of a linearised window, up to terms that do not depend on unmodelled accelerations."""
    at, terms = found.at, _terms(found.intervals, found.fit)
    solved = at.system.solve(at.right_z, at.right_s)
    gained = (at.right_z * solved.step_z).sum() + at.right_s @ solved.step_p
    return float(0.5 * (gained - terms.cost - solved.log_det) - terms.log_std)
