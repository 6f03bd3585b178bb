"""Riccati sweep of time-varying LQR, compiled: linearised rows, and a backward recurrence over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import PlanningError
from diransac.flight.trajectory import Trajectory
from diransac.model import Model
from diransac.simulation import linearized_step
from diransac.simulation.compiler import Map, Scan, compile_map, compile_scan


@dataclass(frozen=True)
class Problem:
    """One sweep: parameters (n_p,), trajectory, and the weights of `tvlqr` as matrices."""

    parameters: FloatArray
    trajectory: Trajectory
    Q: FloatArray
    R: FloatArray
    Qf: FloatArray


def gains_of(model: Model, problems: Sequence[Problem], threads: int) -> list[FloatArray]:
    """Gains (K, n_u, n_x) of each problem as `tvlqr` defines them, eight problems per vector.

    Raises PlanningError: derivatives or gains that are not finite.
    """
    compiled = _compiled(model)
    entries = [_entries(model, compiled.linearize, problem, threads) for problem in problems]
    rows = np.empty((len(problems), max(len(own) for own in entries), entries[0].shape[1]))
    for backward, own in zip(rows, entries, strict=True):
        backward[: len(own)] = own[::-1]
        backward[len(own) :] = own[0]  # padding of shorter ones; its outputs are not used
    weights = [one.trajectory.dt * np.concatenate([_upper(one.Q), _upper(one.R)]) for one in problems]
    ends = [_upper(one.Qf) for one in problems]
    found = compiled.recurrence(np.array(ends), rows, np.array(weights), threads=threads)
    return [_checked(model, problem, gains) for problem, gains in zip(problems, found, strict=True)]


def _entries(model: Model, linearize: Map, problem: Problem, threads: int) -> FloatArray:
    """Varying entries of A and B (K, n_entries).

    Raises PlanningError: one is not finite.
    """
    trajectory = problem.trajectory
    arrays = (trajectory.states, trajectory.inputs, problem.parameters, np.array([trajectory.dt]))
    (entries,) = linearize(*arrays, threads=threads)
    lost = np.flatnonzero(~np.isfinite(entries).all(axis=1))
    if len(lost):
        t, x, u = (array[lost[0]].tolist() for array in (trajectory.time, trajectory.states, trajectory.inputs))
        raise PlanningError(
            f'model "{model.name}" has no finite derivatives on the trajectory at t = {t:g} s: x = {x}, u = {u}, '
            f"parameters {problem.parameters.tolist()}; check the parameters, or plan a trajectory around this state"
        )
    return entries


def _checked(model: Model, problem: Problem, outputs: FloatArray) -> FloatArray:
    """Gains (K, n_u, n_x) from the outputs of the recurrence, last row first.

    Raises PlanningError: some of them are not finite.
    """
    time = problem.trajectory.time
    gains = outputs[: len(time)][::-1].reshape(len(time), len(model.state), model.n_u).swapaxes(1, 2)
    lost = np.flatnonzero(~np.isfinite(gains).all(axis=(1, 2)))
    if len(lost):
        raise PlanningError(
            f'the Riccati sweep of model "{model.name}" did not stay finite and positive '
            f"definite back from t = {time[lost[-1]]:g} s; raise R, lower Q and Qf, or shorten the trajectory"
        )
    return gains


# Compilation ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Compiled:
    """Compiled linearisation of rows, which are independent of each other, and recurrence over them.

    Parameters
    ----------
    linearize : (x, u, p, h) -> entries of A and B that vary
    recurrence : upper triangle of S, entries, upper triangles of Q dt and R dt -> S a row earlier, gains
    """

    linearize: Map
    recurrence: Scan


@lru_cache(maxsize=64)
def _compiled(model: Model) -> _Compiled:
    """Compiled linearisation and recurrence of a model; the same ones again for an equal model."""
    step = linearized_step(model)
    arguments = [ca.SX.sym(name, step.sparsity_in(name)) for name in step.name_in()]
    _, A, B = step(*arguments)
    varying = [e for M in (A, B) for e in ca.vertsplit(M.nz[:]) if not e.is_constant()]
    linearize = ca.Function("linearize", arguments, [ca.vertcat(*varying)])
    return _Compiled(compile_map(linearize), compile_scan(_recurrence(A, B)))


def _recurrence(A: ca.SX, B: ca.SX) -> ca.Function:
    """Function: S, varying entries of A and B, [Q dt; R dt] -> S a row earlier, gains column by column.

    A pivot of R dt + B'S B that is not positive becomes NaN: precision is lost there.
    """
    n_x, n_u = B.shape
    entries: list[ca.SX] = []
    A, B = (_with_symbols(M, entries) for M in (A, B))
    S, Q, R = (ca.SX.sym(name, ca.Sparsity.upper(n)) for name, n in (("S", n_x), ("Q", n_x), ("R", n_u)))
    SA, SB = ca.triu2symm(S) @ A, ca.triu2symm(S) @ B
    G = ca.densify(B.T @ SA)
    D, LT, order = ca.ldl(ca.densify(ca.triu2symm(R) + B.T @ SB))
    K = ca.ldl_solve(G, ca.if_else(D > 0, D, np.nan), LT, order)
    before = ca.triu(Q + A.T @ SA - G.T @ K)
    arguments = [S.nz[:], ca.vertcat(*entries), ca.vertcat(Q.nz[:], R.nz[:])]
    return ca.Function("riccati", arguments, [before.nz[:], ca.vec(K)], ["S", "row", "weights"], ["before", "K"])


def _with_symbols(matrix: ca.SX, entries: list[ca.SX]) -> ca.SX:
    """Matrix with a new symbol, also appended to `entries`, for every entry that is not constant."""
    values = ca.vertsplit(matrix.nz[:])
    for k, value in enumerate(values):
        if not value.is_constant():
            values[k] = ca.SX.sym(f"e{len(entries)}")
            entries.append(values[k])
    return ca.SX(matrix.sparsity(), ca.vertcat(*values))


def _upper(matrix: FloatArray) -> FloatArray:
    """Upper triangle, column by column."""
    return matrix.T[np.tril_indices(len(matrix))]
