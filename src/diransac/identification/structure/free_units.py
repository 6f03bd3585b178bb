"""Parameters that are known up to a factor, because nothing measures a state whose unit is theirs.

A state that nothing measures may be counted in other units, if parameters take them up: the level of an upper tank, the
thrust behind a lag, the load of a drive.  A change of scale of the states, ``h -> s^g h``, of the parameters,
``p_j -> s^(e_j) p_j``, and of the equations, ``r_i -> s^(m_i) r_i``, that leaves every residual and every reading as it
is, is a symmetry (Lie): to first order, with columns for g, e and m,

    (dr/dh h) g + (dr/dp_j p_j) e_j - r_i m_i = 0

whatever the motion: signals are taken from different rows of the log, since those of one row satisfy the equations.

References
----------
Olver 1993 (symmetries of equations); Yates, Evans, Chappell 2009 (symmetries and structural identifiability).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, size_or_one
from diransac.data.dataset import ParameterLayout
from diransac.identification.regression.rows import MotionRows
from diransac.model import Model
from diransac.text_table import number

KnownUpTo = tuple[tuple[str, ...], str]
"""Names of parameters of which only a combination is determined, and a sentence about them."""


def known_up_to_units(
    model: Model,
    layout: ParameterLayout,
    rows: Sequence[MotionRows],
    parameters: FloatArray,
    unmeasured: Sequence[str],
    readings: Sequence[str],
) -> list[KnownUpTo]:
    """Parameters that a free unit of an unmeasured state leaves known up to a factor.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    rows : sequence of MotionRows
        Of each log.
    parameters : (n,) array
        Estimate, each in its unit.
    unmeasured : sequence of str
        States that nothing measures.
    readings : sequence of str
        Sensors that are measured.
    """
    chains = [x for x in model.chains if not set(x).isdisjoint(unmeasured)]
    if not chains or not layout.is_shared:
        return []
    A = _changes(model, rows, parameters, tuple(chains), readings)
    found, n = dict[tuple[str, ...], str](), model.n_p
    values, pinned = dict(zip(layout.names, parameters, strict=True)), np.isfinite(layout.prior_std)
    for k, chain in enumerate(chains):
        others, of_unit = np.delete(A, n + k, axis=1), A[:, n + k]
        others[:, :n][:, pinned] = 0.0
        x = np.linalg.lstsq(others, -of_unit, rcond=1e-9)[0]
        exponents = {name: e for name, e in zip(layout.names, x[:n], strict=True) if abs(e) > 1e-3}
        if exponents and np.linalg.norm(others @ x + of_unit) <= 1e-6 * np.linalg.norm(of_unit):
            found[tuple(exponents)] = _sentence(chain[0], exponents, values)
    return list(found.items())


def _sentence(state: str, exponents: dict[str, float], values: dict[str, float]) -> str:
    """The parameters, the reason, and the remedy."""
    first = max(exponents, key=lambda name: abs(exponents[name]))
    scaled = {n: number(e / exponents[first], 2) for n, e in exponents.items() if n != first}
    powers = ", ".join(f"{n} as {'c' if e == '1' else f'c^{e}'}" for n, e in scaled.items())
    alike = f" ({powers} where {first} changes by c)" if powers else ""
    verb = "are" if len(exponents) > 1 else "is"
    return (
        f"{', '.join(exponents)} {verb} known up to a factor{alike}: nothing measures {state}, whose unit is free; "
        f"measure {state}, or fix one of them: --fix {first}={number(values[first], 3)}"
    )


def _changes(
    model: Model,
    rows: Sequence[MotionRows],
    parameters: FloatArray,
    chains: tuple[tuple[str, ...], ...],
    readings: Sequence[str],
) -> FloatArray:
    """Columns ``(K, n_p + n_chains + n_v)``: changes of residuals and readings by parameters, units and equations."""
    function, parts, rng = _generators(model, chains), [], np.random.default_rng(0)
    kept = [*range(model.n_v), *(model.n_v + k for k, name in enumerate(model.sensors) if name in readings)]
    for one in rows:
        every = max(1, len(one.q) // 1000)  # enough for ranks
        motion = [rng.permuted(x[::every], axis=0).T for x in (one.q, one.v, one.a, one.u)]
        n = motion[0].shape[1]
        both = np.array(ca.densify(function(*motion, np.repeat(parameters[:, None], n, axis=1))))
        columns = both.reshape(both.shape[0], n, -1).transpose(1, 0, 2)[:, kept]
        of_equations = -columns[:, :, -1:] * np.eye(len(kept), model.n_v)
        parts.append(np.concatenate([columns[:, :, :-1], of_equations], axis=2))
    A = np.concatenate(parts)
    A = A[np.isfinite(A).all(axis=(1, 2))]
    size = np.sqrt(np.square(A).mean(axis=(0, 2))) if len(A) else np.ones(len(kept))
    return np.asarray((A / size_or_one(size)[:, None]).reshape(-1, A.shape[2]))


@lru_cache(maxsize=64)
def _generators(model: Model, chains: tuple[tuple[str, ...], ...]) -> ca.Function:
    """Function ``(q, v, a, u, p) -> (n_r, n_p + n_chains + 1)``: changes by p, by each chain's unit, and the residual.

    The rows are those of the equations, then of the sensors.
    """
    symbols = [ca.SX.sym(n, size) for n, size in model.argument_sizes.items()]
    outputs = model.residual(*symbols)
    if model.measurement is not None:
        outputs = ca.vertcat(outputs, model.measurement(*symbols))
    motion, names = ca.vertcat(*symbols[:3]), (*model.coordinates, *model.velocities, *model.accelerations)
    units = [ca.DM([float(name in chain) for name in names]) * motion for chain in chains]
    columns = [ca.jacobian(outputs, symbols[4]) @ ca.diag(symbols[4]), *(ca.jtimes(outputs, motion, x) for x in units)]
    return ca.Function("generators", symbols, [ca.horzcat(*columns, outputs)])
