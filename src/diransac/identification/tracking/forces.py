"""Other sizes of the unmodelled accelerations of a linearised window: what they change, and what they gain."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.normal_equations import innovation_std, innovations

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.tracking.window import Linearization

# Correlation of unmodelled accelerations that are larger than usual.
_GUST = 0.9


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


def with_forces(found: Linearization, tau: FloatArray, rho: FloatArray) -> Linearization:
    """The linearised window with other scales of the unmodelled accelerations.

    Parameters
    ----------
    found : Linearization
    tau : (n_v,) or (W, n_v) array
        Their size.
    rho : (n_v,) array
        Their correlation from interval to interval.

    Returns
    -------
    Linearization
        Its solution is still that of the former scales.
    """
    at, fit = found.at, replace(found.fit, tau=tau, rho=rho)
    old, new, n_x = _terms(found.intervals, found.fit), _terms(found.intervals, fit), fit.x.shape[1]
    diagonal, below, right = at.system.diagonal.copy(), at.system.below.copy(), at.right_z.copy()
    np.einsum("wii->wi", diagonal)[:, n_x:] += new.diagonal - old.diagonal
    np.einsum("wii->wi", below)[:, n_x:] += new.below - old.below
    right[:, n_x:] += new.right - old.right
    system = replace(at.system, diagonal=diagonal, below=below)
    return replace(found, fit=fit, at=replace(at, system=system, right_z=right))


def explanations_by_forces(found: Linearization, expected: FloatArray) -> Iterator[tuple[Linearization, float]]:
    """The linearised window with its unmodelled accelerations, and with larger ones, as a gust has, from a time on.

    One after the other becomes larger, as long as the evidence does; that which matters most, by every factor.

    Parameters
    ----------
    found : Linearization
    expected : (n_v,) array
        Size of the unmodelled accelerations of any model.

    Yields
    ------
    Linearization
    float
        Its evidence, nats.
    """
    fit, W = found.fit, len(found.fit.x)
    usual, least = np.broadcast_to(fit.tau, fit.d.shape), np.maximum(fit.tau, expected)
    rho = np.maximum(fit.rho, _GUST)
    best, evidence = usual, _evidence(found)
    yield found, evidence
    larger = [
        np.where((np.arange(W) >= W - age)[:, None], factor * least, usual)
        for age in (min(8, W), W)
        for factor in 6.0 ** np.arange(4)
    ]
    strongest: list[tuple[Linearization, float]] = []
    most = 0.0
    for axis in np.eye(len(expected), dtype=bool):
        trials = [np.where(axis, tau, best) for tau in larger]
        scaled = [with_forces(found, tau, rho) for tau in trials]
        evidences = [_evidence(x) for x in scaled]
        k = int(np.argmax(evidences))
        if evidences[k] - evidence > most:
            strongest, most = list(zip(scaled, evidences, strict=True)), evidences[k] - evidence
        if evidences[k] > evidence:
            best, evidence = trials[k], evidences[k]
            yield scaled[k], evidence
    yield from strongest


def gain_of_freedom(found: Linearization, least: FloatArray, expected: FloatArray) -> float:
    """Evidence, nats, that unmodelled accelerations gain over a model that is exact.

    Parameters
    ----------
    found : Linearization
    least, expected : (n_v,) array
        Sizes of the unmodelled accelerations of an exact model, and those that are expected of any other.

    Returns
    -------
    float
        The larger one of the sizes of the fit, where they are larger than the least, and of some others.
    """
    none = np.zeros_like(least)
    exact = _evidence(with_forces(found, least, none))
    others = [(expected, none), (30.0 * expected, none + _GUST)]
    if (found.fit.tau > least).any():
        others = [(found.fit.tau, found.fit.rho)]
    return max(_evidence(with_forces(found, *x)) for x in others) - exact


def _evidence(found: Linearization) -> float:
    """Logarithm of the evidence of a linearised window, up to terms that do not depend on unmodelled accelerations."""
    at, terms = found.at, _terms(found.intervals, found.fit)
    solved = at.system.solve(at.right_z, at.right_s)
    gained = (at.right_z * solved.step_z).sum() + at.right_s @ solved.step_p
    return float(0.5 * (gained - terms.cost - solved.log_det) - terms.log_std)
