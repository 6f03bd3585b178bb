"""Parameters that no log determines, by the equations alone: null spaces of ``dr/dp`` at random motions.

References
----------
Bellman and Astrom 1970 (structural identifiability); Gautier and Khalil 1990 (base parameters); Stigter and Molenaar
2015 (rank of sensitivities).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.data.dataset import ParameterLayout
from diransac.errors import IdentificationError
from diransac.identification.regression.rows import NullSpace, residual_slopes
from diransac.identification.structure.free_units import KnownUpTo
from diransac.identification.structure.identifiability import (
    Ambiguity,
    ambiguity_of,
    collinear,
    components,
    equations_in_words,
    in_words,
    joined,
    of_logs,
)
from diransac.model import Model, Parameter

_HALF_RANGE = 10.0
"""Half the range of a signal of which no log shows it, in its unit."""
_RANK = 1e-9
"""Singular value of dr/dp over the largest, up to which it is zero."""
_RANK_OF_OUTPUTS = 1e-11
"""The same of sensitivities, whose sizes differ by decades, and which are rounded to a few 1e-12."""
Ranges = tuple[tuple[str, float, float], ...]
"""Smallest and largest value of states and inputs, by name."""


@lru_cache(maxsize=64)
def structural(
    model: Model, measured: tuple[str, ...] | None = None, ranges: Ranges | None = None
) -> tuple[Ambiguity, ...]:
    """Parameters that no log determines one by one, from the null space of ``dr/dp`` at random motions.

    Where states are not measured, it is the null space of the sensitivities of the measured signals, for any initial
    state, in short random motions.

    Accelerations satisfy the equations, so that the scale of homogeneous equations is in the null space.  A null space
    that does not depend on the parameters leaves sums, one of ``dp/p`` that does not leaves products and ratios.  A
    parameter whose bounds coincide is known.

    Random motions are of several magnitudes.  A term may vanish at all of them, as a rate ``exp(-E/T)`` does at a few
    kelvin: with the ranges of a log, an ambiguity is also one of motions in these ranges.

    Parameters
    ----------
    model : Model
    measured : tuple of str, optional
        Signals that are measured; None: all.
    ranges : tuple of (str, float, float), optional
        Of states and inputs, in which a log's motion is.

    Returns
    -------
    tuple of Ambiguity
        Empty where each parameter is identifiable from these signals, random motions give no finite equations, or the
        number of ambiguities depends on the parameters.
    """
    if ranges is not None and not structural(model, measured):
        return ()
    rng = np.random.default_rng(20240607)
    bounds = list(model.parameters.values())
    free = np.flatnonzero([x.lower < x.upper for x in bounds])
    jacobian = _random_jacobian if measured is None else partial(_output_jacobian, measured=measured)
    vectors, motions = [_random_parameters(bounds, rng) for _ in range(3)], [x for x in ((), ranges) if x is not None]
    jacobians = [np.concatenate([jacobian(model, p, rng, x) for x in motions])[:, free] for p in vectors]
    if not len(free) or min(map(len, jacobians)) < len(free):
        return ()
    spaces = [_null_space(J, _RANK if measured is None else _RANK_OF_OUTPUTS) for J in jacobians]
    if len({len(x.directions) for x in spaces}) > 1:
        return ()
    names, found = np.array(list(model.parameters))[free], list[Ambiguity]()
    for group in components(spaces[0].directions, 1e-5):
        own, reason = [p[free][group] for p in vectors], ""
        one = ambiguity_of(names[group].tolist(), [x.of(group) for x in spaces], own)
        if measured is not None and one.n_determined:
            reason = "since not all states are measured"
        elif measured is None and one.noun == "ratio" and not model.nonlinear_parameters:
            reason = "since each term has one of them as a factor (b = 0 in W p = b)"
        found.append(replace(one, reason=reason))
    every = joined(found)
    if any(not x.n_determined and _in_equations(model) & set(x.names) for x in every):
        where = "at random motions" if ranges is None else "at any motion in the ranges of the log"
        every = tuple(replace(x, reason=x.reason if x.n_determined else where) for x in every)
    return every


def _in_equations(model: Model) -> set[str]:
    """Parameters that are in the equations or in a sensor, whatever their values."""
    columns = residual_slopes(model).sparsity_out(0).get_triplet()[1]
    return {list(model.parameters)[k] for k in columns}


def check_structure(
    model: Model, source: str, allow: int = 0, measured: tuple[str, ...] | None = None, ranges: Ranges | None = None
) -> None:
    """Raise IdentificationError for parameters that the equations do not determine, whatever the motion.

    Parameters
    ----------
    model : Model
    source : str
        Name of the logs in the message.
    allow : int, optional
        Number of such parameters that the caller can do with.
    measured : tuple of str, optional
        Signals that are measured; None: all.
    ranges : tuple of (str, float, float), optional
        As `structural`.
    """
    found = structural(model, measured, ranges)
    if sum(len(x.names) for x in found) > allow:
        raise IdentificationError(f"{source}: {equations_in_words(found)}")


def structural_slopes(model: Model, parameters: FloatArray, given: IntArray) -> FloatArray:
    """Changes of the parameters that leave every motion as it is, per change of some of them.

    Parameters
    ----------
    model : Model
        Whose equations do not determine all parameters.
    parameters : (n_p,) array
        Each in its unit.
    given : (k,) int array
        Positions of parameters which, if they were known, would make the others identifiable.

    Returns
    -------
    (n_p, k) array
        1 and 0 in the rows of the given ones.
    """
    space = _null_space(_random_jacobian(model, parameters, np.random.default_rng(20240607), ()), _RANK)
    directions = space.directions / space.scale
    return np.asarray((np.linalg.pinv(directions[:, given]) @ directions).T)


def _random_parameters(bounds: Sequence[Parameter], rng: np.random.Generator) -> FloatArray:
    """A vector ``(n_p,)`` within the bounds, of order one where they are open."""
    lower = np.array([max(x.lower, 0.0) if x.positive else x.lower for x in bounds])
    upper = np.array([x.upper for x in bounds])
    draw, sign = rng.uniform(0.5, 2.5, len(bounds)), rng.choice([-1.0, 1.0], len(bounds))
    has_lower, has_upper = np.isfinite(lower), np.isfinite(upper)
    low, high = np.where(has_lower, lower, 0.0), np.where(has_upper, upper, 0.0)
    open_ended = np.where(has_lower, low + draw, np.where(has_upper, high - draw, sign * draw))
    return np.where(has_lower & has_upper, low + draw / 3.0 * (high - low), open_ended)


def _centres(model: Model, ranges: Ranges) -> tuple[FloatArray, FloatArray]:
    """Middle and half width ``(n_x + n_u,)`` of the range of each state and input."""
    found = {name: (0.5 * (low + high), 0.5 * (high - low)) for name, low, high in ranges}
    pairs = [found.get(name, (0.0, 0.0)) for name in (*model.state, *model.inputs)]
    middle, half = np.array(pairs).reshape(-1, 2).T
    return middle, np.where(half > 0.0, half, _HALF_RANGE)


def _random_jacobian(model: Model, p: FloatArray, rng: np.random.Generator, ranges: Ranges) -> FloatArray:
    """Rows ``(n, n_p)`` of ``dr/dp`` and ``dy/dp`` at random motions that satisfy the equations, each of unit size."""
    n = max(60, 4 * model.n_p)
    middle, half = (x[:, None] for x in _centres(model, ranges))
    sizes = (model.n_q, model.n_v, model.n_u)
    # Numbers of both signs, up to 1 and over three decades: a saturation is neither always on nor never.
    parts = [rng.choice([-1.0, 1.0], (size, n)) * 10.0 ** rng.uniform(-3.0, 0.0, (size, n)) for size in sizes]
    q, v, u = np.split(middle + half * np.concatenate(parts), np.cumsum(sizes)[:2])
    for four in model.quaternions:
        q[list(four)] /= np.linalg.norm(q[list(four)], axis=0)
    repeated = np.repeat(p[:, None], n, axis=1)
    a = np.array(model.dynamics(np.vstack([q, v]), u, repeated)[1])
    slope = residual_slopes(model)
    J = np.array(ca.densify(slope(q, v, a, u, repeated))).reshape(-1, model.n_p)
    size = np.abs(J).max(axis=1)
    usable = np.isfinite(size) & (size > 0.0) & (size < 1e100)
    return np.asarray(J[usable] / size[usable, None])


def _output_jacobian(
    model: Model, p: FloatArray, rng: np.random.Generator, ranges: Ranges, measured: Sequence[str]
) -> FloatArray:
    """Derivatives ``(n, n_p)`` of measured signals in random motions, without what initial states can explain.

    Four motions are sequences of Euler's steps, which have the symmetries of the equations: two per unknown, each a
    fifth of the fastest time constant.
    """
    n_x, n_p, sensor_slopes = len(model.state), model.n_p, _sensor_slopes(model)
    middle, half = _centres(model, ranges)
    half = half / (1.0 if ranges else _HALF_RANGE)
    rows, of_parameters, blocks = [model.signals.index(n) for n in measured], np.eye(n_x + n_p)[n_x:], []
    for _ in range(4):
        x, step, seen = middle[:n_x] + half[:n_x] * rng.normal(size=n_x), 0.0, list[FloatArray]()
        changes = np.eye(n_x, n_x + n_p)  # of the state, by the initial state and the parameters
        for _ in range(2 * (n_x + n_p)):
            for four in model.quaternions:
                x[list(four)] /= np.linalg.norm(x[list(four)])
            u = middle[n_x:] + half[n_x:] * rng.normal(size=model.n_u)
            A, _, P = (np.array(ca.DM(J)) for J in model.rate_jacobians(x, u, p))
            step = step or 0.2 / max(1.0, float(np.linalg.norm(A)))
            moved = A @ changes + P @ of_parameters
            x_dot, a = (np.array(value).ravel() for value in model.dynamics(x, u, p))
            of_sensors = np.array(ca.DM(sensor_slopes(x, a, u, p)))
            motion = np.vstack([changes, moved[model.n_q :]])
            seen.append(np.vstack([motion, of_sensors @ np.vstack([motion, of_parameters])])[rows])
            x, changes = x + step * x_dot, changes + step * moved
        J = np.concatenate(seen)
        if np.isfinite(J).all():
            U, sizes, _ = np.linalg.svd(J[:, :n_x], full_matrices=False)
            U = U[:, sizes > _RANK_OF_OUTPUTS * sizes[0]]
            blocks.append(J[:, n_x:] - U @ (U.T @ J[:, n_x:]))
    return np.concatenate(blocks) if blocks else np.zeros((0, n_p))


def _sensor_slopes(model: Model) -> ca.Function:
    """Function ``(x, a, u, p) -> dy/d(x, a, p)`` of the sensors."""
    x, a, u, p = symbols = model.readings.sx_in()
    return ca.Function("sensor_slopes", symbols, [ca.jacobian(model.readings(x, a, u, p), ca.vertcat(x, a, p))])


def _null_space(J: FloatArray, rank: float) -> NullSpace:
    """Null space of the rows of J, with columns of unit norm; singular values below ``rank`` are zero."""
    scale = size_or_one(np.linalg.norm(J, axis=0))
    _, sizes, rows = np.linalg.svd(J / scale, full_matrices=False)
    return NullSpace(rows[sizes <= rank * sizes.max(initial=0.0)], scale)


def unidentifiable(
    model: Model,
    layout: ParameterLayout,
    values: FloatArray,
    covariance: FloatArray,
    uncertain: BoolArray,
    measured: tuple[str, ...] | None = None,
    ranges: Ranges | None = None,
    excited: BoolArray | None = None,
    of_units: Sequence[KnownUpTo] = (),
) -> tuple[BoolArray, tuple[str, ...], tuple[KnownUpTo, ...]]:
    """Parameters of an estimate that are not identifiable, by the equations or from the log.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Of the n parameters, per-log ones of every log included.
    values : (n,) array
        Estimates, each in its unit.
    covariance : (n, n) array
    uncertain : (n,) bool array
        Parameters whose error is too large for the estimate to be of use.
    measured : tuple of str, optional
        Signals that are measured; None: all.
    ranges : tuple of (str, float, float), optional
        As `structural`.
    excited : (n,) bool array, optional
        Parameters about which the motion informs at the estimate; None: it is not known of any.
    of_units : sequence of KnownUpTo, optional
        Parameters whose unit is that of a state that nothing measures.

    Returns
    -------
    mask : (n,) bool array
        The uncertain parameters, and those that the equations do not determine.
    sentences : tuple of str
        The names, the combinations that are determined, and what to do.
    known_up_to : tuple of KnownUpTo
        Those of these sentences in which a combination is determined, with the names.
    """
    of_model = structural(model, measured, ranges)
    of_units = [x for x in of_units if not any(set(x[0]) <= set(one.names) for one in of_model)]
    ambiguous = {name for x in of_model for name in x.names} | {name for names, _ in of_units for name in names}
    by_equations = np.array([name in ambiguous for name in layout.owners])
    from_log = collinear(layout.names, values, covariance, uncertain & ~by_equations)
    known = [*of_units, *((x.names, x.sentence(x.of_equations())) for x in of_model if x.n_determined)]
    known += [(x.names, in_words([x], layout.n_logs)) for x in from_log if x.n_determined]
    sentences = [*(text for _, text in known), *(x.sentence(x.of_equations()) for x in of_model if not x.n_determined)]
    alone = [n for x in from_log if not x.n_determined for n in x.names]
    seen = set() if excited is None else {n for n, x in zip(layout.names, excited, strict=True) if x}
    for is_seen in (False, True):
        names = tuple(n for n in alone if (n in seen) == is_seen)
        if names:
            x = Ambiguity(names, 0, ())
            sentences.append(x.sentence(x.of_noise() if is_seen else x.of_motion(), of_logs(layout.n_logs)))
    return uncertain | by_equations, tuple(sentences), tuple(known)
