"""Checked symbolic parts of a residual function: ``r = W p - b`` and ``r = M a + c``.

Affinity is decided by evaluation at random points, because the expression graph does not settle it: ``sign(p.k)`` has a
vanishing second derivative without being affine, and ``m * (a + k / m * v)`` is affine although its graph has a
quotient of parameters.
"""

from __future__ import annotations

import keyword
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, size_or_one
from diransac.errors import DiransacError, ModelError
from diransac.limits import MOST_NAMES, MOST_SOLVED, beyond
from diransac.model import expressions
from diransac.plain_text import is_one_line
from diransac.user_files import in_words

if TYPE_CHECKING:
    from diransac.model.parameter import Parameter

_N_POINTS = 40
_TOLERANCE = 1e-8


class Symbols:
    """Named scalars: ``q.theta`` or ``q["theta"]``, iterable in order.

    Raises ModelError: a name that the model does not declare.
    """

    def __init__(self, label: str, kind: str, named: Mapping[str, ca.SX]) -> None:
        self._label, self._kind, self._named = label, kind, dict(named)

    def __getattr__(self, name: str) -> ca.SX:
        if name.startswith("__"):
            raise AttributeError(name)
        return self[name]

    def __getitem__(self, name: str) -> ca.SX:
        if name not in self._named:
            raise ModelError(f"{self._label}: {self._kind} have no {name!r}; found {', '.join(self._named) or 'none'}")
        return self._named[name]

    def __iter__(self) -> Iterator[ca.SX]:
        return iter(self._named.values())

    def __len__(self) -> int:
        return len(self._named)


def call_user(label: str, what: str, function: Callable[..., Any], *arguments: Symbols) -> ca.SX:
    """Return value of a user's function as one column of SX.

    Raises ModelError: it branches on a symbol, fails, or returns anything but numbers and expressions of the model's
    own symbols.
    """
    try:
        returned = function(*arguments)
    except (DiransacError, KeyboardInterrupt):
        raise
    except BaseException as error:  # users' code raises anything
        said = in_words(error)
        if "truth value" in said:
            raise ModelError(
                f"{label}: {what} branch on a symbol (if, and, or, min, max); use casadi.if_else, fmin or fmax"
            ) from error
        raise ModelError(f"{label}: {what} failed: {said:.300}") from error
    values = list(returned.values()) if isinstance(returned, Mapping) else returned
    try:
        column = ca.vertcat(*(values if isinstance(values, list | tuple) else [values]), ca.SX(0, 1))
    except (TypeError, NotImplementedError) as error:
        raise ModelError(f"{label}: {what} return {returned!r:.80}; return a list of expressions") from error
    own = {symbol.element_hash() for symbols in arguments for symbol in symbols}
    foreign = [str(symbol) for symbol in ca.symvar(column) if symbol.element_hash() not in own]
    if foreign:
        raise ModelError(f"{label}: {what} hold a symbol {foreign[0]} of their own; declare it, or give its value")
    return column


def call_sensor(label: str, name: str, equation: Callable[..., Any], *arguments: Symbols) -> ca.SX:
    """Value of a sensor's measurement equation.

    Raises ModelError: as `call_user`, or it is not one value.
    """
    what = f"equations of sensor {name!r}"
    value = call_user(label, what, equation, *arguments)
    if value.shape != (1, 1):
        raise ModelError(f"{label}: {what} return {value.size1()} x {value.size2()} values; return one for each sensor")
    return value


def check_texts(given: Mapping[str, object]) -> None:
    """Raises ModelError: the name or description of a model is no text, or not of one line."""
    for what, value in given.items():
        if not is_one_line(value):
            raise ModelError(f"the {what} of a model is {value!r:.60}; give a text of one line")


def check_groups(label: str, units: Mapping[str, object], parameters: object) -> None:
    """Raises ModelError: signals are not mappings from names to units, or parameters from names to `Parameter`."""
    for kind, group in units.items():
        if not isinstance(group, Mapping):
            raise ModelError(f'{label}: {kind} = {group!r}; give a mapping from name to unit, such as {{"x": "m"}}')
        for name, unit in group.items():
            if not is_one_line(unit):
                raise ModelError(f'{label}: the unit of {name!r} is {unit!r:.60}; give a text of one line, such as "m"')
    if not isinstance(parameters, Mapping):
        raise ModelError(f"{label}: parameters = {parameters!r}; give a mapping from name to dr.Parameter")
    for name, parameter in parameters.items():
        if not hasattr(parameter, "admits"):
            raise ModelError(f'{label}: parameter {name!r} is {parameter!r}; give dr.Parameter("kg") or the like')


def check_names(label: str, groups: Sequence[Mapping[str, object]], *, masks: bool = False) -> None:
    """Check names of coordinates, velocities, states of first order, derivatives, inputs, parameters and sensors.

    Parameters that equations do not name may be masks.

    Raises ModelError: a name is not an identifier or is used twice, or there are no states or parameters.
    """
    names = [n for group in groups for n in group]
    if len(names) > MOST_NAMES:
        raise ModelError(f"{label}: there are {beyond(MOST_NAMES, 'names', len(names))}")
    known = set[object]()
    for name in names:
        free = masks and name in groups[-2]
        is_symbol = str(name) == name and name.isidentifier() and not keyword.iskeyword(name)
        if not free and (not is_symbol or name.startswith("__")):
            raise ModelError(
                f"{label}: {name!r} cannot name a signal or parameter; use letters, digits and underscores"
            )
        if name == "t":
            raise ModelError(f'{label}: the name "t" is reserved for time; choose another')
        if name in known:
            raise ModelError(f"{label}: the name {name!r} is used twice; signals and parameters need different names")
        known.add(name)
    for kind, group in (("coordinates or first_order states", [*groups[0], *groups[2]]), ("parameters", groups[-2])):
        if not group:
            raise ModelError(f"{label}: there are no {kind}; give at least one")


def check_residual(label: str, residual: ca.Function, accelerations: Sequence[str]) -> None:
    """Raises ModelError: not one residual per acceleration, or a NaN constant in one."""
    if residual.size1_out(0) != len(accelerations) or residual.size2_out(0) != 1:
        raise ModelError(
            f"{label}: equations return {residual.numel_out(0)} residuals, but there are {len(accelerations)} "
            f"accelerations ({', '.join(accelerations)}); return one residual for each"
        )
    for i in _nan_outputs(residual):
        raise ModelError(
            f"{label}: equation {i + 1} of {len(accelerations)} contains NaN; a function of Python's math module gives "
            "NaN for a symbol: use casadi's"
        )


def check_kinematics(label: str, kinematics: ca.Function) -> None:
    """Raises ModelError: not one rate per coordinate, or a NaN constant in one."""
    n = kinematics.size1_in(0)
    if kinematics.size1_out(0) != n:
        raise ModelError(
            f"{label}: kinematics return {kinematics.numel_out(0)} rates; return one for each of {n} coordinates"
        )
    check_constants(label, "kinematics", kinematics)


def check_readings(label: str, measurement: ca.Function, names: Sequence[str]) -> None:
    """Raises ModelError: a NaN constant in a sensor's equation."""
    for i in _nan_outputs(measurement):
        raise ModelError(f"{label}: sensor {names[i]!r} contains NaN; use casadi's functions, not Python's math")


def check_sensors(label: str, probe: Probe, names: Sequence[str]) -> None:
    """Raises ModelError: a sensor is finite at no random point."""
    finite: BoolArray = np.asarray(np.isfinite(np.array(probe.residual(*probe.points))).any(axis=1))
    for name in (n for n, x in zip(names, finite, strict=True) if not x):
        raise ModelError(
            f"{label}: sensor {name!r} is not finite at any of {_N_POINTS} random points; check roots and logarithms"
        )


def check_constants(label: str, what: str, function: ca.Function) -> None:
    """Raises ModelError: a NaN constant in one of the function's results."""
    for i in _nan_outputs(function):
        raise ModelError(
            f"{label}: {what} {i + 1} of {function.numel_out(0)} contains NaN; use casadi's functions, not "
            "Python's math"
        )


def _nan_outputs(function: ca.Function) -> Iterator[int]:
    """Indices of the outputs whose expression holds a NaN constant."""
    if not expressions.has_nan(function):
        return
    arguments = function.sx_in()
    for i, expression in enumerate(ca.vertsplit(function(*arguments))):
        if expressions.has_nan(ca.Function("one", arguments, [expression])):
            yield i


class Probe:
    """A residual function evaluated at fixed random points, for properties that expression graphs do not settle.

    Parameters
    ----------
    residual : ``(q, v, a, u, p) -> r (r)``
    parameters : bounds that the points respect

    Points are ``(n, n_points)`` for each argument; ``everywhere`` holds parameters of both signs and many magnitudes.
    """

    def __init__(self, residual: ca.Function, parameters: Collection[Parameter]) -> None:
        rng = np.random.default_rng(20231001)
        self.residual = residual
        sizes = [residual.size1_in(i) for i in range(5)]
        self.points = [rng.uniform(-2.0, 2.0, (n, _N_POINTS)) for n in sizes[:4]]
        self.points[3][:, ::2] = np.abs(self.points[3][:, ::2])
        self.points.append(np.array([_within(x, rng) for x in parameters]).reshape(sizes[4], _N_POINTS))
        signs = rng.choice([-1.0, 1.0], (sizes[4], _N_POINTS))
        self.everywhere = signs * 10.0 ** rng.uniform(-1.5, 1.5, (sizes[4], _N_POINTS))

    def affine_parts(self, argument: str, symbols: Sequence[ca.SX]) -> tuple[ca.SX, ca.SX]:
        """``(J, c)`` with ``r = J z + c`` for the argument ``z``, if ``r`` is affine in it.

        They are taken at ``z = 0`` where the graph is affine in ``z``, elsewhere at a point within the bounds.
        """
        k = "qvaup".index(argument)
        z, r = symbols[k], self.residual(*symbols)
        J = ca.jacobian(r, z)
        if not ca.depends_on(J, z):
            return J, ca.substitute(r, z, ca.DM.zeros(z.shape))
        z0 = ca.DM(self.points[k][:, 0])
        J0, r0 = ca.simplify(ca.substitute(J, z, z0)), ca.substitute(r, z, z0)
        return J0, r0 - J0 @ z0

    def is_affine(self, argument: str, values: FloatArray) -> bool:
        """True if ``r = J z + c`` wherever ``r`` is finite, with ``values (n, n_points)`` of the argument ``z``."""
        symbols, k = self.residual.sx_in(), "qvaup".index(argument)
        J, c = self.affine_parts(argument, symbols)
        z = symbols[k]
        size = ca.fabs(J) @ ca.fabs(z) + ca.fabs(c) + 1.0
        error = ca.Function("error", symbols, [(self.residual(*symbols) - J @ z - c) / size])
        points = [*self.points[:k], values, *self.points[k + 1 :]]
        found = np.abs(np.array(error(*points)))
        finite = np.isfinite(np.array(self.residual(*points)))
        return bool((found[finite] < _TOLERANCE).all())

    def is_affine_in_parameters(self) -> bool:
        """True if ``r`` is affine in ``p`` within the bounds and everywhere."""
        return self.is_affine("p", self.points[4]) and self.is_affine("p", self.everywhere)


def _within(parameter: Parameter, rng: np.random.Generator) -> FloatArray:
    """Random values ``(n_points,)`` near a parameter's nominal value, or within its bounds, away from a strict zero.

    Bounds of single parameters do not keep the mass matrix of a robot definite; values near those of a machine do.
    """
    lower = max(parameter.lower, 0.0) if parameter.positive else parameter.lower
    draw = rng.uniform(0.1, 0.9, _N_POINTS)
    if parameter.value is not None:
        near = parameter.value + 1e-3 * (abs(parameter.value) or 1e-3) * (draw - 0.5)
        return np.where(parameter.admits(near), near, parameter.value)
    if np.isfinite(lower) and np.isfinite(parameter.upper):
        return lower + draw * (parameter.upper - lower)
    if np.isfinite(lower):
        return lower + 2.5 * draw
    if np.isfinite(parameter.upper):
        return parameter.upper - 2.5 * draw
    return rng.choice([-1.0, 1.0], _N_POINTS) * 2.5 * draw


def affine_in_acceleration(
    label: str, probe: Probe, accelerations: Mapping[str, str]
) -> tuple[ca.Function, ca.Function]:
    """Functions ``M(q, v, u, p)`` and ``c(q, v, u, p)`` with ``r = M a + c``.

    Raises ModelError: the residuals are not affine in ``a``, or cannot be evaluated.
    """
    if not np.isfinite(np.array(probe.residual(*probe.points))).all(axis=0).any():
        raise ModelError(
            f"{label}: the equations are not finite at any of {_N_POINTS} random points; check roots and logarithms"
        )
    if not probe.is_affine("a", probe.points[2]):
        raise ModelError(
            f"{label}: the equations are not affine in the accelerations {', '.join(accelerations)}; "
            "write them as M a + c = 0, with a to the first power only"
        )
    q, v, a, u, p = probe.residual.sx_in()
    M, c = probe.affine_parts("a", (q, v, a, u, p))
    return ca.Function("M", [q, v, u, p], [M]), ca.Function("c", [q, v, u, p], [c])


def mass_matrix_sign(label: str, probe: Probe, mass_matrix: ca.Function, accelerations: Mapping[str, str]) -> int:
    """1 or -1 where ``M`` is symmetric and positive or negative definite at every point, else 0.

    Raises ModelError: ``M`` is singular at every point; the message names the undetermined accelerations.
    """
    q, v, _, u, p = probe.points
    stacked = np.array(ca.densify(mass_matrix(q, v, u, p)))
    n = len(accelerations)
    M = stacked.reshape(n, _N_POINTS, n).transpose(1, 0, 2)
    M = M[np.isfinite(M).all(axis=(1, 2))]
    scaled = M / size_or_one(np.abs(M).max(axis=2, keepdims=True, initial=0.0))
    columns = size_or_one(np.abs(scaled).max(axis=1, keepdims=True, initial=0.0))
    _, values, vectors = np.linalg.svd(scaled / columns)
    if len(M) == 0 or (values[:, -1] <= 1e-10 * values[:, 0]).all():
        loose = np.abs(vectors[:, -1]).max(axis=0, initial=0.0) > 1e-6
        names = [x for x, l in zip(accelerations, loose, strict=True) if l] or list(accelerations)
        raise ModelError(
            f"{label}: the mass matrix dr/da is singular; the equations do not determine {', '.join(names)}"
        )
    if not np.allclose(M, M.transpose(0, 2, 1), rtol=1e-9, atol=1e-12 * np.abs(M).max()):
        return 0
    eigenvalues = np.linalg.eigvalsh(M)
    return int((eigenvalues > 0.0).all()) - int((eigenvalues < 0.0).all())


def check_solution(label: str, mass_matrix: ca.Sparsity, n_columns: int, *, symmetric: bool) -> None:
    """Raises ModelError: the solution for so many columns has more operations than memory and compiler can take.

    LDL^T: the sum over columns of the factor of half the square of their numbers, and each number twice for each
    right-hand side.  A general solution is dense: ``2 n^3 + 2 n^2`` for each right-hand side.
    """
    n = mass_matrix.size1()
    if symmetric:
        factor, _ = mass_matrix.ldl()
        numbers = np.diff(factor.colind())
        operations = int((numbers * (numbers + 3)).sum()) // 2 + 2 * int(numbers.sum()) * n_columns
    else:
        operations = 2 * n * n * (n + n_columns)
    if operations > MOST_SOLVED:
        raise ModelError(
            f"{label}: the accelerations of {n} equations take {beyond(MOST_SOLVED, 'operations', operations)}. "
            "Simplify the equations, or split the machine into independent parts"
        )


def nonlinear_parameters(probe: Probe, names: Sequence[str]) -> tuple[str, ...]:
    """Names of the parameters in which the residual is not affine, by evaluation within the bounds and everywhere."""
    if probe.is_affine_in_parameters():
        return ()
    symbols = probe.residual.sx_in()
    r = probe.residual(*symbols)
    both = ca.Function("both", symbols, [r, ca.densify(ca.jacobian(r, symbols[4]))])
    start = np.hstack([probe.points[4][:, ::2], probe.everywhere[:, ::2]])
    found = [name for i, name in enumerate(names) if _is_curved(both, probe.points[:4], start, i)]
    return tuple(found) or tuple(names)


def _is_curved(both: ca.Function, others: Sequence[FloatArray], start: FloatArray, i: int) -> bool:
    """True if a step in ``p_i`` alone leaves its tangent, or a step in the others changes the slope."""
    n_p = len(start)

    def evaluate(p: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, J = (np.array(x) for x in both(*others, p))
        return r, J.reshape(len(r), _N_POINTS, n_p)[:, :, i]

    along, across = start.copy(), start[:, ::-1].copy()
    along[i] = start[i, ::-1]
    across[i] = start[i]
    r, slope = evaluate(start)
    r_along, _ = evaluate(along)
    _, slope_across = evaluate(across)
    step = along[i] - start[i]
    leaves = np.abs(r_along - r - slope * step) > _TOLERANCE * (
        np.abs(r_along) + np.abs(r) + np.abs(slope * step) + 1.0
    )
    turns = np.abs(slope_across - slope) > _TOLERANCE * (np.abs(slope_across) + np.abs(slope) + 1.0)
    return bool(leaves.any() or turns.any())


def find_quaternions(kinematics: ca.Function) -> tuple[tuple[int, int, int, int], ...]:
    """Runs of four coordinates whose norm the kinematics conserve, but not the norm of fewer of them."""
    rng = np.random.default_rng(20231002)
    q = rng.normal(size=(kinematics.size1_in(0), _N_POINTS))
    rates = np.array(kinematics(q, rng.normal(size=(kinematics.size1_in(1), _N_POINTS))))
    found: list[tuple[int, int, int, int]] = []
    start = 0
    while start + 4 <= len(q):
        four = slice(start, start + 4)
        work = q[four] * rates[four]
        small = _TOLERANCE * max(1.0, np.abs(rates[four]).max())
        fewer = [*work, *(work[0] + work[i] for i in (1, 2, 3))]
        if np.abs(work.sum(axis=0)).max() < small <= min(np.abs(x).max() for x in fewer):
            found.append((start, start + 1, start + 2, start + 3))
            start += 4
        else:
            start += 1
    return tuple(found)
