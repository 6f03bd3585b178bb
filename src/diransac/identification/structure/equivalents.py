"""Other parameters with the same transfer function at rest, as two time constants that change places.

Where states are not measured, signals may determine the parameters up to a few solutions.  `structural` finds those
that form a continuum, this module isolated ones.  About rest, signals follow inputs by the transfer function

    G(s) = C (s I - A)^-1 B + D

of the linearised model.  Parameters with the same G are sought from random starts, by the method of Levenberg and
Marquardt.  Those of a linear model explain every log as well; those of others may be another optimum of a fit.

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
from diransac.identification.structure.structural import Ranges
from diransac.model import Model

_N_FREQUENCIES = 8
"""Frequencies at which transfer functions are compared."""
_BEYOND = 3.0
"""Factor by which frequencies reach beyond the slowest and the fastest eigenvalue."""
_STARTS = (8, 48)
"""Fewest and most random starts."""
_ELEMENTS = 6000
"""Elements of the matrices of all starts together: large models have fewer starts."""
_EQUAL = 1e-7
"""Relative error of a transfer function up to which it is equal."""
_OTHER = 0.02
"""Relative change of a parameter that is another one."""
Response = Callable[[FloatArray], FloatArray]


def equivalent_parameters(
    model: Model, parameters: FloatArray, measured: Sequence[str], ranges: Ranges | None = None
) -> list[FloatArray]:
    """Parameters with which measured signals follow the inputs about rest as with given ones.

    Parameters
    ----------
    model : Model
        Whose parameters `structural` finds identifiable from these signals.
    parameters : (n_p,) array
        Each in its unit.
    measured : sequence of str
        Signals that are measured.
    ranges : tuple of (str, float, float), optional
        Of states and inputs, in which a log's motion is; rest is in the middle of those that do not contain zero.

    Returns
    -------
    list of (n_p,) array
        Without the given ones; each differs from the others by more than 2 % in a parameter.
    """
    if not model.n_u:
        return []
    with np.errstate(all="ignore"):
        response = _response(model, parameters, measured, ranges or ())
        known = np.flatnonzero(parameters)
        _, slopes = _SameResponse(response, parameters, known).slopes(np.zeros((1, len(known))))
        size = np.nan_to_num(np.abs(slopes[0])).max(axis=0, initial=0.0)
        problem = _SameResponse(response, parameters, known[size > 1e-6 * size.max(initial=0.0)])
        if not len(problem.free):
            return []
        n, rng = len(problem.free), np.random.default_rng(0)
        n_starts = int(np.clip(_ELEMENTS // ((n + 1) * len(model.state) ** 2), *_STARTS))
        z, cost = least_squares(problem, 1.5 * rng.standard_normal((n_starts, n)), 40)
    found = [parameters]
    for one in problem.at(z[cost < np.square(_EQUAL) * slopes.shape[1]]):
        if not any(is_close(one, x).all() for x in found):
            found.append(one)
    return found[1:]


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


def _rest(model: Model, ranges: Ranges) -> tuple[FloatArray, FloatArray]:
    """States and inputs, zero where their range contains it or none is known, else in its middle."""
    middle = {name: 0.0 if low <= 0.0 <= high else 0.5 * (low + high) for name, low, high in ranges}
    x, u = (np.array([middle.get(n, 0.0) for n in names]) for names in (model.state, model.inputs))
    for four in model.quaternions:
        x[list(four)] = [1.0, 0.0, 0.0, 0.0]
    return x, u


def _response(model: Model, parameters: FloatArray, measured: Sequence[str], ranges: Ranges) -> Response:
    """Function ``(S, n_p) -> (S, M)``: real and imaginary parts of the transfer functions, over the given ones'."""
    rows, (rest, input_) = [model.signals.index(n) for n in measured], _rest(model, ranges)

    def slopes(p: FloatArray) -> list[FloatArray]:
        """A, B, C, D: (S, ., .) each."""
        x, u = (np.repeat(y[:, None], len(p), axis=1) for y in (rest, input_))
        parts = [np.array(y) for y in _linear(model)(x, u, p.T)]
        return [np.moveaxis(y.reshape(len(y), len(p), -1), 0, 1) for y in parts]

    A, *_ = slopes(parameters[None])
    rates = np.abs(np.linalg.eigvals(np.nan_to_num(A))).ravel()
    rates = rates[rates > 1e-12 * rates.max(initial=0.0)]
    slowest, fastest = (rates.min(), rates.max()) if len(rates) else (1.0, 1.0)
    s = 1j * np.geomspace(slowest / _BEYOND, fastest * _BEYOND, _N_FREQUENCIES)[:, None, None, None]

    def transfer(p: FloatArray) -> FloatArray:
        A, B, C, D = slopes(p)
        G = C[:, rows] @ np.linalg.solve(s * np.eye(len(rest)) - A, B.astype(complex)) + D[:, rows]
        return np.stack([G.real, G.imag])

    size = np.abs(transfer(parameters[None])).max(axis=(0, 1))
    size[size == 0.0] = np.inf

    def response(p: FloatArray) -> FloatArray:
        return np.asarray(np.moveaxis(transfer(p) / size, 2, 0).reshape(len(p), -1))

    return response


@dataclass(frozen=True, eq=False, repr=False)
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
