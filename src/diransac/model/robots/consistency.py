"""Physically consistent parameters nearest to a description that explain estimates of base parameters.

A body is possible if its pseudo-inertia J is positive definite: its mass is positive, and its principal inertias
satisfy the triangle inequality. The distance from the description is the log-determinant divergence
``D(J) = tr(J J_0^-1) - log det(J J_0^-1) - 4``, which is convex, does not depend on frames and units, and is infinite
on the boundary: the optimum is consistent without further constraints, and Newton's method finds it.

References
----------
Wensing, Kim, Slotine 2018, "Linear matrix inequalities for physically consistent inertial parameter identification".
Lee, Wensing, Park 2020, "Geometric robot dynamic identification: a convex programming approach", eq. (22).
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, size_or_one
from diransac.errors import ModelError
from diransac.model.robots.rigid_body import inertial_parameters, pseudo_inertia

_BASIS = [np.array(ca.DM(pseudo_inertia([float(i == k) for i in range(10)]))) for k in range(10)]


def consistent_parameters(
    bodies: FloatArray, constants: FloatArray, combinations: FloatArray, values: FloatArray, covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Parameters nearest to those of a description whose combinations are estimated.

    They minimise ``(B x - b)' C^-1 (B x - b) / 2 + sum_i D(J_i)``: a described value that changes by itself costs about
    as much as one standard error of an estimate.

    Parameters
    ----------
    bodies : (n_bodies, 10) array
        Inertial parameters in the description, in the order of `INERTIAL_NAMES`.
    constants : (n_constants,) array
        Further parameters there, not negative; those that are 0 remain so.
    combinations : (n_b, 10 n_bodies + n_constants) array
        B, which combines parameters of the bodies, one body after the other, and constants.
    values, covariance : (n_b,), (n_b, n_b) arrays
        Estimates b, and their covariance C.

    Returns
    -------
    bodies, constants : arrays like the arguments
        All bodies have a positive definite pseudo-inertia, all constants are positive or as they were.

    Raises
    ------
    ModelError
        A body of the description is impossible: its mass or inertia is negative.
    """
    x = _solution(_Problem(bodies, constants, combinations, values, covariance), 1.0)
    n = bodies.size
    return x[:n].reshape(bodies.shape), x[n:]


def inconsistency(combinations: FloatArray, n_bodies: int, values: FloatArray, covariance: FloatArray) -> FloatArray:
    """Least changes of estimated combinations by which they are those of possible bodies, over standard errors.

    The changes minimise ``e' C^-1 e``; constants are not negative.

    Parameters
    ----------
    combinations : (n_b, 10 n_bodies + n_constants) array
        B, as of `consistent_parameters`.
    n_bodies : int
    values, covariance : (n_b,), (n_b, n_b) arrays
        Estimates b, and their covariance C.

    Returns
    -------
    (n_b,) array
        Near 0 where the estimates are those of possible bodies.
    """
    moment, n_constants = 0.01, combinations.shape[1] - 10 * n_bodies
    # A possible body, from which the search for others begins.
    bodies = np.tile([1.0, 0.0, 0.0, 0.0, moment, moment, moment, 0.0, 0.0, 0.0], (n_bodies, 1))
    problem = _Problem(bodies, np.full(n_constants, moment), combinations, values, covariance)
    # Weight of the divergence where only the error counts.
    change = combinations @ _solution(problem, 1e-3) - values
    return np.asarray(change / np.sqrt(np.diag(covariance)))


def _solution(problem: _Problem, last_weight: float) -> FloatArray:
    """Optimum with a weight of the divergence, by an interior-point method."""
    x = problem.start
    weight = max(last_weight, problem.at(x, 1.0)[0])
    while True:
        x = _minimized(problem, x, weight)
        if weight == last_weight:
            return x
        # Ratio of successive weights of the divergence, which begins as heavy as the error is (interior-point
        # method).
        weight = max(last_weight, 0.1 * weight)


def _minimized(problem: _Problem, x: FloatArray, prior_weight: float) -> FloatArray:
    """Optimum by Newton's method with a line search."""
    cost, gradient, hessian = problem.at(x, prior_weight)
    # Of Newton's method: steps, decrease of the cost, fraction of a step.
    for _ in range(200):
        step, decrease = _newton_step(gradient, hessian, problem.free)
        length = 1.0
        while not (found := problem.at(x + length * step, prior_weight))[0] <= cost - 0.1 * length * decrease:
            length *= 0.5
            if length < 1e-10:
                return x
        x, (cost, gradient, hessian) = x + length * step, found
        if decrease < 1e-12 * prior_weight:
            break
    return x


def _newton_step(gradient: FloatArray, hessian: FloatArray, free: BoolArray) -> tuple[FloatArray, float]:
    """Newton's step of the free parameters, each scaled by its own curvature, and the decrease that it promises."""
    scale = np.where(free, 1.0 / np.sqrt(np.where(free, np.diag(hessian), 1.0)), 0.0)
    # Added to a Hessian with a diagonal of one, which is singular where a body is almost impossible.
    H = hessian * np.outer(scale, scale) + np.diag(1.0 - free + 1e-13)
    step = -scale * np.linalg.solve(H, scale * gradient)
    return step, float(-gradient @ step)


class _Problem:
    """Cost of parameters, with its derivatives."""

    def __init__(
        self, bodies: FloatArray, constants: FloatArray, B: FloatArray, values: FloatArray, covariance: FloatArray
    ) -> None:
        spread = np.sqrt(np.diag(covariance))
        scale = size_or_one(spread)
        # Added to correlations, which may be singular.
        correlation = covariance / np.outer(scale, scale) + np.diag(np.where(spread > 0.0, 1e-9, 1.0))
        # Least standard error of a combination relative to the sum of its parts' magnitudes in the
        # description.
        spread = np.maximum(spread, 1e-4 * np.abs(B) @ np.abs([*bodies.ravel(), *constants]))
        self.weight: FloatArray = np.linalg.inv(correlation) / np.outer(spread, spread)
        self.B, self.b, self.weighted, self.curvature = B, values, B.T @ self.weight, B.T @ self.weight @ B
        self.constants, self.n_bodies = constants, len(bodies)
        self.start: FloatArray = np.concatenate([bodies.ravel(), constants])
        self.inverses = [np.asarray(np.linalg.inv(_regular(_pseudo_inertia(x))), float) for x in bodies]
        self.free = np.concatenate([np.ones(bodies.size, bool), constants > 0.0])

    def at(self, x: FloatArray, prior_weight: float) -> tuple[float, FloatArray, FloatArray]:
        """Cost, gradient and Hessian; an infinite cost of impossible bodies."""
        error = self.B @ x - self.b
        cost, gradient, hessian = 0.5 * float(error @ self.weight @ error), self.weighted @ error, self.curvature.copy()
        for i, inverse in enumerate(self.inverses):
            body = slice(10 * i, 10 * i + 10)
            part = _divergence(_pseudo_inertia(x[body]), inverse)
            cost += prior_weight * part[0]
            gradient[body] += prior_weight * part[1]
            hessian[body, body] += prior_weight * part[2]
        own, scale = 10 * self.n_bodies + np.flatnonzero(self.constants), self.constants[self.constants > 0.0]
        ratio = x[own] / scale
        if (ratio <= 0.0).any():
            return np.inf, gradient, hessian
        gradient[own] += prior_weight * (1.0 - 1.0 / ratio) / scale
        hessian[own, own] += prior_weight / x[own] ** 2
        cost += prior_weight * float(np.sum(ratio - np.log(ratio) - 1.0))
        return cost, gradient, hessian


def _divergence(J: FloatArray, inverse: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """``tr(J J_0^-1) - log det(J J_0^-1) - 4`` with gradient (10,) and Hessian (10, 10) by inertial parameters."""
    ratio = J @ inverse
    eigenvalues = np.linalg.eigvalsh(J)
    sign, logarithm = np.linalg.slogdet(ratio)
    # Ratio of eigenvalues of a pseudo-inertia that is taken as singular.
    if eigenvalues[0] <= 1e-12 * eigenvalues[-1] or sign <= 0.0:
        return np.inf, np.zeros(10), np.zeros((10, 10))
    own = np.linalg.inv(J)
    products = np.array([own @ E for E in _BASIS])
    gradient = np.array([np.sum(E * (inverse - own)) for E in _BASIS])
    hessian = np.einsum("kij,lji->kl", products, products)
    return float(np.trace(ratio) - logarithm - 4.0), gradient, hessian


def _pseudo_inertia(body: Sequence[float] | FloatArray) -> FloatArray:
    return np.asarray(np.tensordot(np.asarray(body), np.array(_BASIS), 1))


def _regular(J: FloatArray) -> FloatArray:
    """Pseudo-inertia of a body of the description, of which thin ones are given some thickness.

    Raises ModelError: it is impossible.
    """
    mass = J[3, 3]
    centre = J[:3, 3] / mass if mass > 0.0 else np.full(3, np.nan)
    moments = J[:3, :3] - mass * np.outer(centre, centre)
    mean = np.trace(moments) / 3.0
    least = 1e-6 * mean  # of thin bodies, whose pseudo-inertia is singular
    if not (mass > 0.0 and mean > 0.0 and np.linalg.eigvalsh(moments)[0] > -least):
        raise ModelError(
            f"a body with mass {mass:g} kg and inertia {inertial_parameters(J)[4:7]} kg m^2 about its origin is "
            "impossible: give it a positive mass, and principal inertias that satisfy the triangle inequality"
        )
    thicker = J.copy()
    thicker[:3, :3] += 2.0 * least * np.eye(3)
    return thicker
