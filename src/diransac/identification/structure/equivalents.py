"""Other parameters with which the measured signals would be the same, as two time constants that change places.

Where states are not measured, signals may determine the parameters up to a few solutions.  `structural` finds those
that form a continuum, this module isolated ones.  About a motion, signals follow inputs by the transfer function

    G(s) = C (s I - A)^-1 B + D

of the linearised model.  Parameters with the same G about several random motions are sought from random starts, by the
method of Levenberg and Marquardt.  Those that also give the same signals of a random motion of the model are returned.

References
----------
Bellman and Astrom 1970 (structural identifiability); Walter and Pronzato 1997 (global identifiability).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.regression.multistart import least_squares
from diransac.identification.structure.structural import Ranges, centres, outputs, random_motion
from diransac.model import Model

# Motions about which transfer functions are equal; frequencies, over the fastest and beyond the slowest eigenvalue.
_N_MOTIONS, _N_FREQUENCIES, _BEYOND = 3, 8, 3.0
# Starts, fewer of large models: elements of their matrices together; spread of the starts, the logarithm of a factor;
# steps; slope over the largest of a parameter that a response shows.
_STARTS, _ELEMENTS, _SPREAD, _N_STEPS, _SHOWN = (8, 48), 6000, 1.5, 40, 1e-6
# Relative errors of transfer functions, and of signals, up to which both are equal; relative change of a parameter.
_EQUAL, _SAME, _OTHER = 1e-7, 1e-6, 0.02
_SEED, _ROUNDING = 20240607, 1e-12
Response = Callable[[FloatArray], FloatArray]


def equivalent_parameters(
    model: Model, parameters: FloatArray, measured: Sequence[str], ranges: Ranges | None = None
) -> list[FloatArray]:
    """Parameters within their bounds that give the same measured signals as an estimate, whatever the inputs.

    Parameters
    ----------
    model : Model
        Whose parameters `structural` finds identifiable from these signals.
    parameters : (n_p,) array
        The estimate, each in its unit.
    measured : sequence of str
        Signals that are measured.
    ranges : tuple of (str, float, float), optional
        Of states and inputs, in which a log's motion is.

    Returns
    -------
    list of (n_p,) array
        Without the estimate.
    """
    if not model.n_u:
        return []
    rng, bounds = np.random.default_rng(_SEED), list(model.parameters.values())
    middle, half = centres(model, ranges or ())
    half = half if ranges else 0.1 * half
    found = [parameters]
    with np.errstate(all="ignore"):
        response = _response(model, parameters, measured, middle, half, rng)
        for start in _with_same_response(response, parameters, len(model.state), rng):
            other = _with_same_signals(model, parameters, start, measured, middle, half)
            if other is not None and not any(is_close(other, x).all() for x in found):
                found.append(other)
    return [x for x in found[1:] if all(b.lower <= y <= b.upper for b, y in zip(bounds, x, strict=True))]


def is_close(a: FloatArray, b: FloatArray) -> BoolArray:
    """Mask of the parameters that are the same in both vectors, up to 2 %."""
    return np.asarray(np.abs(a - b) <= _OTHER * np.maximum(np.abs(a), np.abs(b)))


@lru_cache(maxsize=16)
def _linear(model: Model) -> ca.Function:
    """Function ``(x, u, p) -> (A, B, C, D)`` of all signals."""
    sizes = {"x": len(model.state), "u": model.n_u, "p": model.n_p}
    x, u, p = (ca.SX.sym(name, n) for name, n in sizes.items())
    x_dot, a = model.dynamics(x, u, p)
    signals = ca.vertcat(x, a, model.readings(x, a, u, p))
    slopes = [ca.densify(ca.jacobian(y, z)) for y in (x_dot, signals) for z in (x, u)]
    return ca.Function("linear", [x, u, p], slopes)


def _response(
    model: Model,
    parameters: FloatArray,
    measured: Sequence[str],
    middle: FloatArray,
    half: FloatArray,
    rng: np.random.Generator,
) -> Response:
    """Function ``(S, n_p) -> (S, M)``: real and imaginary parts of transfer functions, over the estimate's largest."""
    n_x, rows = len(model.state), [model.signals.index(n) for n in measured]
    points = middle[:, None] + half[:, None] * rng.uniform(-1.0, 1.0, (len(middle), _N_MOTIONS))

    def slopes(p: FloatArray) -> list[FloatArray]:
        """A, B, C, D: (S n, ., .) each."""
        x = np.tile(points, len(p))
        matrices = _linear(model)(x[:n_x], x[n_x:], np.repeat(p, _N_MOTIONS, axis=0).T)
        parts = [np.array(y) for y in matrices]
        return [np.moveaxis(y.reshape(len(y), x.shape[1], -1), 0, 1) for y in parts]

    A, *_ = slopes(parameters[None])
    rates = np.abs(np.linalg.eigvals(np.where(np.isfinite(A), A, 0.0))).ravel()
    rates = rates[rates > _ROUNDING * rates.max(initial=0.0)]
    slowest, fastest = (rates.min(), rates.max()) if len(rates) else (1.0, 1.0)
    s = 1j * np.geomspace(slowest / _BEYOND, fastest * _BEYOND, _N_FREQUENCIES)[:, None, None, None]

    def transfer(p: FloatArray) -> FloatArray:
        A, B, C, D = slopes(p)
        G = C[:, rows] @ np.linalg.solve(s * np.eye(n_x) - A, B.astype(complex)) + D[:, rows]
        return np.stack([G.real, G.imag])

    size = np.abs(transfer(parameters[None])).max(axis=(0, 1), keepdims=True)
    size[size == 0.0] = np.inf

    def response(p: FloatArray) -> FloatArray:
        values = transfer(p).reshape(2, _N_FREQUENCIES, len(p), *size.shape[2:]) / size
        return np.asarray(np.moveaxis(values, 2, 0).reshape(len(p), -1))

    return response


@dataclass(frozen=True)
class _SameResponse:
    """Least squares of the differences of responses; the unknowns are logarithms of factors of some parameters."""

    response: Response
    parameters: FloatArray
    free: IntArray

    def at(self, z: FloatArray) -> FloatArray:
        """Parameters ``(S, n_p)``."""
        p = np.tile(self.parameters, (len(z), 1))
        p[:, self.free] *= np.exp(z)
        return p

    def slopes(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Differences of the responses ``(S, M)``, and their derivatives ``(S, M, n)`` by differences."""
        moved = z[:, None] + np.vstack([np.zeros(z.shape[1]), 1e-7 * np.eye(z.shape[1])])
        found = self.response(self.at(moved.reshape(-1, z.shape[1]))).reshape(*moved.shape[:2], -1)
        left = found[:, 0] - self.response(self.parameters[None])
        return left, np.moveaxis(found[:, 1:] - found[:, :1], 1, 2) / 1e-7

    def moved(self, now: FloatArray, step: FloatArray) -> FloatArray:
        """Unknowns after a step of a factor e at most."""
        return np.asarray(now + np.clip(step, -1.0, 1.0))

    def linearized(self, z: FloatArray, lanes: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Cost, half its gradient, and normal matrix."""
        left, J = self.slopes(z)
        cost = np.square(left).sum(axis=1)
        cost[~(np.isfinite(cost) & np.isfinite(J).all(axis=(1, 2)))] = np.inf
        return cost, np.einsum("sij,si->sj", J, left), np.einsum("sij,sik->sjk", J, J)


def _with_same_response(
    response: Response, parameters: FloatArray, n_x: int, rng: np.random.Generator
) -> list[FloatArray]:
    """Parameters with the same response, in which something differs, each once."""
    known = np.flatnonzero(parameters)
    _, slopes = _SameResponse(response, parameters, known).slopes(np.zeros((1, len(known))))
    size = np.abs(slopes[0]).max(axis=0, initial=0.0)
    problem = _SameResponse(response, parameters, known[size > _SHOWN * size.max(initial=0.0)])
    n = len(problem.free)
    starts = _SPREAD * rng.standard_normal((int(np.clip(_ELEMENTS // ((n + 1) * n_x**2), *_STARTS)), n))
    z, cost = least_squares(problem, starts, _N_STEPS)
    found = [parameters]
    for one in problem.at(z[cost < np.square(_EQUAL) * slopes.shape[1]]):
        if not any(is_close(one, x).all() for x in found):
            found.append(one)
    return found[1:]


def _with_same_signals(
    model: Model,
    parameters: FloatArray,
    start: FloatArray,
    measured: Sequence[str],
    middle: FloatArray,
    half: FloatArray,
) -> FloatArray | None:
    """Parameters near a start that give the signals of a random motion, from some initial state; None if none do."""
    x, inputs = random_motion(model, middle, half, np.random.default_rng(_SEED))
    step = 0.2 / max(1.0, float(np.linalg.norm(np.array(model.rate_jacobians(x, inputs[0], parameters)[0]))))
    target = outputs(model, x.copy(), inputs, parameters, measured, step)[0]
    p, x = start.copy(), x.copy()
    for _ in range(12):
        y, J_x, J_p = outputs(model, x.copy(), inputs, p, measured, step)
        if not (np.isfinite(y).all() and np.isfinite(J_x).all() and np.isfinite(J_p).all()):
            return None
        if np.abs(y - target).max() < _SAME * np.abs(target).max():
            return p
        J = np.hstack([J_x, J_p])
        size = np.linalg.norm(J, axis=0) + 1e-300
        change = np.linalg.lstsq(J / size, target - y, rcond=1e-12)[0] / size
        x, p = x + change[: len(x)], p + change[len(x) :]
    return None
