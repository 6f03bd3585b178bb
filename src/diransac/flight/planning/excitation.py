"""Periodic motions that excite a machine within limits: Fourier series, limits, information on parameters.

References
----------
Swevers et al. 1997, "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13(5): Fourier
series, D-optimality. Park 2006, "Fourier-based optimal excitation trajectories for the dynamic identification of
robots", Robotica 24(5): series at rest at their ends.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import PlanningError, SettingsError

if TYPE_CHECKING:
    from diransac.model import Model

Limit: TypeAlias = float | tuple[float, float]
"""Largest magnitude, or lowest and highest value."""


@dataclass(frozen=True)
class FourierSeries:
    """Functions of time with a period, at whose ends velocity and acceleration are zero.

    ``c + sum_l s_l sin(l w t) + c_l cos(l w t)`` with ``sum_l l s_l = 0`` and ``sum_l l^2 c_l = 0``: the coefficients
    are those of an orthonormal basis of the sines and cosines that satisfy both, followed by the constant.

    Parameters
    ----------
    period : float
        s.
    n_harmonics : int
        At least 2.
    """

    period: float
    n_harmonics: int

    @property
    def n_coefficients(self) -> int:
        """Coefficients of a function."""
        return 2 * self.n_harmonics - 1

    @property
    def highest(self) -> float:
        """Angular frequency of the fastest sine, rad/s."""
        return 2.0 * np.pi * self.n_harmonics / self.period

    @cached_property
    def _bases(self) -> tuple[FloatArray, FloatArray]:
        """Bases of sines and cosines, each ``(n_harmonics, n_harmonics - 1)``."""
        harmonics = np.arange(1.0, self.n_harmonics + 1.0)
        return _complement(harmonics), _complement(harmonics**2)

    def basis(self, t: FloatArray) -> FloatArray:
        """Values of the basis functions and their two derivatives ``(3, K, n_coefficients)`` at times (K,)."""
        w = 2.0 * np.pi / self.period * np.arange(1.0, self.n_harmonics + 1.0)
        sines, cosines = self._bases
        found = np.zeros((3, len(t), self.n_coefficients))
        for k, derivative in enumerate(found):
            angle = np.outer(t, w) + k * np.pi / 2.0
            derivative[:, :-1] = np.hstack([(w**k * np.sin(angle)) @ sines, (w**k * np.cos(angle)) @ cosines])
        found[0, :, -1] = 1.0
        return found

    def drawn(self, rng: np.random.Generator) -> FloatArray:
        """Coefficients (n_coefficients,) of a sum of sines with random amplitudes and phases about zero."""
        # Range of the amplitudes of a drawn motion, as of `multisine`.
        size = rng.uniform(0.2, 0.6, self.n_harmonics)
        phase = rng.uniform(0.0, 2.0 * np.pi, self.n_harmonics)
        sines, cosines = self._bases
        return np.concatenate([sines.T @ (size * np.cos(phase)), cosines.T @ (size * np.sin(phase)), [0.0]])


def _complement(w: FloatArray) -> FloatArray:
    """Orthonormal basis ``(n, n - 1)`` of the vectors orthogonal to one with a positive first element (Householder)."""
    u = w / np.linalg.norm(w)
    u[0] += 1.0
    reflection: FloatArray = np.eye(len(w)) - 2.0 * np.outer(u, u) / (u @ u)
    return reflection[:, 1:]


def motion_of(z: FloatArray, basis: FloatArray) -> FloatArray:
    """Positions, velocities and accelerations ``(3 n, K)`` of coefficients (n_coefficients, n)."""
    values: FloatArray = np.einsum("dkb,bn->dnk", basis, z).reshape(-1, basis.shape[1])
    return values


# Limits --------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Limited:
    """Quantities of a motion with limits.

    Parameters
    ----------
    names : tuple of str
    function : casadi.Function
        ``(3 n) -> (m)`` from positions, velocities and accelerations.
    lower, upper : (m,) arrays
        Each in the quantity's unit; one of both may be infinite.
    """

    names: tuple[str, ...]
    function: ca.Function
    lower: FloatArray
    upper: FloatArray

    @cached_property
    def scale(self) -> FloatArray:
        """Half the range of each quantity (m,), or the size of its only limit."""
        one_sided = np.where(np.isfinite(self.upper), self.upper, self.lower)
        half = 0.5 * (self.upper - self.lower)
        return np.where(np.isfinite(half), half, np.maximum(np.abs(one_sided), 1e-12))

    def distances(self, x: FloatArray) -> FloatArray:
        """Distance to the nearer limit (m, K) in the rows of a motion (3 n, K), 1 in the middle, negative beyond."""
        values, scale = np.array(self.function(x)), self.scale[:, None]
        return np.minimum(self.upper[:, None] - values, values - self.lower[:, None]) / scale

    def margin(self, x: FloatArray) -> FloatArray:
        """Least distance to a limit (m,) over the rows of a motion (3 n, K)."""
        return np.asarray(self.distances(x).min(axis=1))

    def extremes(self, x: FloatArray) -> dict[str, tuple[float, float]]:
        """Smallest and largest value of each quantity over the rows of a motion (3 n, K)."""
        values = np.array(self.function(x))
        pairs = zip(values.min(axis=1).tolist(), values.max(axis=1).tolist(), strict=True)
        return dict(zip(self.names, pairs, strict=True))

    def shrunk(self, z: FloatArray, pose: FloatArray, basis: FloatArray, narrowed: float) -> FloatArray:
        """Coefficients between those of rest in a pose (n,) and the given ones, as near to these as limits allow.

        Parameters
        ----------
        z : (n_coefficients, n) array
        pose : (n,) array
        basis : (3, K, n_coefficients) array
            Of the rows in which the limits hold.
        narrowed : float
            What limits are narrowed by, over their scales.
        """
        rest = np.zeros_like(z)
        rest[-1] = pose

        def scaled(share: float) -> FloatArray:
            return np.asarray(rest + share * (z - rest))

        def fits(share: float) -> bool:
            return bool((self.margin(motion_of(scaled(share), basis)) >= narrowed).all())

        tried = 1.0
        if fits(tried):
            return scaled(tried)
        # Shares one after the other, not by bisection alone: limits of forces may hold, fail and hold again.
        for share in (*(1.0 - 0.002 * 2.0 ** np.arange(9.0)), *0.25 ** np.arange(1.0, 5.0), 0.0):
            if fits(share):
                break
            tried = share
        for _ in range(6):
            middle = 0.5 * (share + tried)
            share, tried = (middle, tried) if fits(middle) else (share, middle)
        return scaled(share)


def ranges_of(limits: Mapping[str, Limit], model: Model) -> dict[str, tuple[float, float]]:
    """Range of each limited quantity.

    Raises SettingsError: a limit is no range, a motion with it cannot rest, or a coordinate has no limit.
    """
    found = {}
    moving = (*model.velocities, *model.accelerations)
    for name, given in limits.items():
        try:
            pair = np.asarray(given if isinstance(given, tuple | list) else (-given, given), np.float64)
        except (TypeError, ValueError):
            pair = np.zeros(0)
        if pair.shape != (2,) or not pair[0] < pair[1] or not np.isfinite(pair).any():
            raise SettingsError(f'limits: "{name}" is {given!r:.60}; give a positive number, or (lowest, highest)')
        if name in model.coordinates and not np.isfinite(pair).all():
            raise SettingsError(f'limits: "{name}" is {given!r:.60}; give a coordinate two finite limits, or none')
        if name in moving and not pair[0] < 0.0 < pair[1]:
            raise SettingsError(f'limits: "{name}" is {given!r:.60}; the motion is at rest at both ends: include zero')
        found[name] = (float(pair[0]), float(pair[1]))
    for q, v in zip(model.coordinates, model.velocities, strict=False):
        if q not in found and v not in found:
            raise SettingsError(f'limits: neither "{q}" nor "{v}" has one; give one of them')
    return found


def check_rest(model: Model, limited: Limited, pose: FloatArray) -> None:
    """Raise PlanningError if a limit is exceeded at rest in the best pose."""
    rest = np.concatenate([pose, np.zeros(2 * len(pose))])[:, None]
    margins = limited.margin(rest)
    if not (margins > 0.0).all():
        worst = limited.names[int(np.argmin(margins))]
        value = limited.extremes(rest)[worst][0]
        where = ", ".join(f"{n} = {x:.3g}" for n, x in zip(model.coordinates, pose, strict=True))
        raise PlanningError(
            f"no pose was found in which the machine rests within its limits: nearest, at {where}, {worst} is "
            f"{value:.4g}; widen its limits, or check the parameters"
        )


def resting_pose(limited: Limited, lower: FloatArray, upper: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Pose (n,) whose distance from all limits at rest is largest, of the middle one and random ones.

    Parameters
    ----------
    limited : Limited
    lower, upper : (n,) arrays
        Limits of the coordinates; where they are infinite, the pose is zero.
    rng : Generator
    """
    bounded = np.isfinite(upper - lower)
    middle, half = np.zeros(len(lower)), np.zeros(len(lower))
    middle[bounded] = 0.5 * (lower + upper)[bounded]
    # Fraction of the ranges of the coordinates in which poses are drawn.
    half[bounded] = 0.5 * 0.8 * (upper - lower)[bounded]
    poses = np.vstack([middle, middle + half * rng.uniform(-1.0, 1.0, (200, len(middle)))])
    rest = np.zeros((3 * len(middle), 1))
    margins = np.empty(len(poses))
    for k, pose in enumerate(poses):
        rest[: len(pose), 0] = pose
        margins[k] = limited.margin(rest).min()
    return np.asarray(poses[np.argmax(margins)])


def drawn_motion(
    series: FourierSeries, limited: Limited, pose: FloatArray, sizes: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Coefficients (n_coefficients, n) of a plain multisine about a pose, as large as the limits allow.

    Each coordinate alone is as large as the limits allow, then all are reduced in proportion.

    Parameters
    ----------
    series : FourierSeries
    limited : Limited
    pose : (n,) array
        Within the limits at rest.
    sizes : (n,) array
        Amplitude of each coordinate, at most, in its unit.
    rng : Generator
    """
    basis, whole = series.basis(grid(series)), np.zeros((series.n_coefficients, len(pose)))
    for j, size in enumerate(sizes):
        alone = np.zeros_like(whole)
        alone[-1] = pose
        alone[:-1, j] = size * series.drawn(rng)[:-1]
        whole[:, j] = limited.shrunk(alone, pose, basis, 0.0)[:, j]
    return limited.shrunk(whole, pose, basis, 0.0)


def grid(series: FourierSeries, density: int = 1) -> FloatArray:
    """Times of a period at which the optimisation evaluates a motion, s; as many times denser."""
    # Rows per period of the fastest sine in which the optimisation evaluates the information. Limits hold in
    # twice as many: forces have products of sines, of twice the frequency.
    n = density * 12 * series.n_harmonics
    return np.linspace(0.0, series.period, n, endpoint=False)


# Information ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Observed:
    """Equations of motion as observations of the parameters: their derivatives, with noise of unit variance.

    Parameters
    ----------
    function : casadi.Function
        ``(3 n) -> (n_p, n_v)``, the transposed derivatives over the noise, from positions, velocities, accelerations.
    directions : (n_p, n_r) array
        Basis of the directions of the parameters that motions show, scaled by the size of their columns.
    identifiable : (n_p,) bool array
        Parameters that lie in these directions.
    """

    function: ca.Function
    directions: FloatArray
    identifiable: BoolArray

    @classmethod
    def of(cls, function: ca.Function, motions: FloatArray) -> Observed:
        """Observations with the directions that random motions (3 n, K) show."""
        J = np.array(function(motions)).T
        sizes = np.linalg.norm(J, axis=0)
        sizes[sizes == 0.0] = 1.0
        _, strengths, axes = np.linalg.svd(J / sizes, full_matrices=True)
        # Size of a direction, relative to the largest, below which no motion shows it; columns have unit
        # length.
        n_shown = int((strengths > 1e-6 * max(strengths[0], 1e-300)).sum())
        hidden = np.linalg.norm(axes[n_shown:], axis=0)
        # Share of a parameter in such directions above which it is not identifiable.
        return cls(function, axes[:n_shown].T / sizes[:, None], hidden < 1e-3)

    def information(self, x: FloatArray) -> FloatArray:
        """Fisher information (n_r, n_r) of the directions over the rows of a motion (3 n, K)."""
        M = self.directions.T @ np.array(self.function(x))
        return np.asarray(M @ M.T)

    def log_determinant(self, x: FloatArray) -> float:
        """Logarithm of the determinant of the information; minus infinity where it is singular."""
        sign, value = np.linalg.slogdet(self.information(x))
        return float(value) if sign > 0.0 else -np.inf

    def standard_errors(self, x: FloatArray) -> FloatArray:
        """Standard errors (n_p,) of least squares from the rows of a motion (3 n, K); infinite if not identifiable."""
        information = self.information(x)
        whole = np.full(len(self.identifiable), np.inf)
        if np.linalg.cond(information) < 1.0 / np.finfo(float).eps:
            variances = np.einsum("ij,jk,ik->i", self.directions, np.linalg.inv(information), self.directions)
            whole[self.identifiable] = np.sqrt(variances[self.identifiable])
        return whole
