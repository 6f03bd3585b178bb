"""Many rollouts of a model at once, scored against a log on the way.

Observation `j` is the state at `t_j`; then the input `u_j` is held to `t_{j+1}`; the acceleration at `t_j` is the one
under `u_j`. The integrators are written here, once, as expressions; `time_loop.py` turns them into machine code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from diransac.errors import ModelError, SettingsError
from diransac.kernel.graph import read_graph
from diransac.kernel.lanes import Lanes, arranged_lanes, arranged_measurements, squared_thresholds
from diransac.kernel.machine_code import LANES, MachineCode, Target, compile_function, run_blocks

if TYPE_CHECKING:
    from diransac.kernel.time_loop import Keep, Plan
    from diransac.model import Model

__all__ = ["INTEGRATORS", "Rollouts", "Scores", "inlier_mask", "rollouts"]

Floats = NDArray[np.float64]
Dynamics = Callable[[ca.SX], ca.SX]
"""State -> its derivative, with inputs and parameters held."""


@dataclass(frozen=True)
class Scores:
    """How well each rollout agrees with a log.

    Attributes
    ----------
    sum_squares : (n_lanes, n_signals)   sum over valid rows of squared errors, each signal's unit squared; infinite in
        every signal where the rollout diverged
    inlier_count : (n_lanes,)   valid rows in which enough signals are near; rows from a divergence on are not
    diverged : (n_lanes,)   whether some state or acceleration became infinite or NaN
    """

    sum_squares: Floats
    inlier_count: NDArray[np.int64]
    diverged: NDArray[np.bool_]


def rollouts(
    model: Model,
    signals: Sequence[str] | None = None,
    *,
    integrator: str = "rk4",
    substeps: int = 1,
    target: Target | None = None,
) -> Rollouts:
    """Compiled rollouts of a model; the same ones again for the same equations and options.

    Parameters
    ----------
    model : what is simulated: its `dynamics`, an SX function (x, u, p) -> (dx/dt, accelerations)
    signals : those that are compared with measurements, in the order of their columns; all by default
    integrator : `rk4`, `euler` or `semi-implicit-euler` (velocities first, then coordinates with the new velocities)
    substeps : integration steps from one row to the next
    target : processor to compile for; this one by default

    Raises SettingsError: an unknown signal or integrator, or no sub-step.
    Raises ModelError: the dynamics hold an operation that cannot be compiled.
    """
    names = tuple(model.signals)
    scored = names if signals is None else tuple(signals)
    missing = [name for name in scored if name not in names]
    if missing or len(set(scored)) < len(scored):
        raise SettingsError(
            f"signals {', '.join(scored)} cannot be scored: each must be one of model {model.name!r}, once; "
            f"it has {', '.join(names)}."
        )
    if integrator not in INTEGRATORS:
        raise SettingsError(f"integrator {integrator!r} is unknown; choose one of {', '.join(INTEGRATORS)}.")
    if substeps < 1:
        raise SettingsError(f"substeps is {substeps}, but a row takes at least 1 integration step.")
    if not model.dynamics.is_a("SXFunction"):
        raise ModelError(f"the dynamics of model {model.name!r} are not made of SX symbols; expand them: .expand().")
    quaternions = tuple(tuple(int(k) for k in four) for four in model.quaternions)
    sizes = (model.n_q, model.n_v, model.n_u, model.n_p)
    return _rollouts(
        _Equations(model.dynamics.serialize(), sizes, names, quaternions), scored, integrator, substeps, target
    )


@dataclass(frozen=True)
class _Equations:
    """A model's equations of motion, as a value: equal ones are compiled once.

    Attributes
    ----------
    dynamics : (x, u, p) -> (dx/dt, accelerations), serialised
    sizes : of coordinates, velocities, inputs and parameters
    signals : names of the states and accelerations
    quaternions : positions in q
    """

    dynamics: str
    sizes: tuple[int, int, int, int]
    signals: tuple[str, ...]
    quaternions: tuple[tuple[int, ...], ...]


@lru_cache(maxsize=64)
def _rollouts(
    equations: _Equations, signals: tuple[str, ...], integrator: str, substeps: int, target: Target | None
) -> Rollouts:
    """Rollouts by value of what defines them."""
    return Rollouts(equations, signals, integrator, substeps, target)


# Integrators ---------------------------------------------------------------------------------------------------------
def _euler(_dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, _n_q: int) -> ca.SX:
    """Explicit Euler: x + h dx/dt, order 1."""
    return x + h * slope


def _semi_implicit_euler(dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, n_q: int) -> ca.SX:
    """v+ = v + h a(q, v), q+ = q + h dq/dt(q, v+), order 1."""
    v = x[n_q:] + h * slope[n_q:]
    return ca.vertcat(x[:n_q] + h * dynamics(ca.vertcat(x[:n_q], v))[:n_q], v)


def _rk4(dynamics: Dynamics, x: ca.SX, h: ca.SX, slope: ca.SX, _n_q: int) -> ca.SX:
    """The classical Runge-Kutta step, order 4."""
    second = dynamics(x + h / 2 * slope)
    third = dynamics(x + h / 2 * second)
    fourth = dynamics(x + h * third)
    return x + h / 6 * (slope + fourth + 2 * (second + third))


INTEGRATORS = {"rk4": _rk4, "euler": _euler, "semi-implicit-euler": _semi_implicit_euler}
"""One step of each integrator: (dynamics, x, h, dx/dt at x, n_q) -> x after h seconds."""


def _plan(equations: _Equations, signals: tuple[str, ...], integrator: str, substeps: int) -> Plan:
    """Expressions of one row, as graphs."""
    from diransac.kernel.time_loop import PARAMETER, STEP, Plan

    function = ca.Function.deserialize(equations.dynamics)
    n_q, n_v, n_u, n_p = equations.sizes
    x, u = ca.SX.sym("x", n_q + n_v), ca.SX.sym("u", n_u)
    p, h = ca.SX.sym("p", n_p), ca.SX.sym("h")
    slope, acceleration = function(x, u, p)
    after = INTEGRATORS[integrator](lambda state: function(state, u, p)[0], x, h, slope, n_q)
    after = _normalised(after, equations.quaternions)
    step, further_step = (
        read_graph(ca.Function("step", [x, u, p, h], results), (PARAMETER, STEP), reciprocals=True)
        for results in ([after, ca.vertcat(x, acceleration)], [after])
    )
    return Plan(
        step=step,
        further_step=further_step,
        substeps=substeps,
        n_states=n_q + n_v,
        n_inputs=n_u,
        n_signals=len(equations.signals),
        scored=tuple(equations.signals.index(name) for name in signals),
        quaternions=_scored_quaternions(equations, signals),
    )


def _normalised(x: ca.SX, quaternions: Sequence[Sequence[int]]) -> ca.SX:
    """Return the state with every quaternion scaled to length one."""
    elements = ca.vertsplit(x)
    for four in quaternions:
        scale = 1 / ca.sqrt(ca.sumsqr(ca.vertcat(*(elements[k] for k in four))))
        for k in four:
            elements[k] = elements[k] * scale
    return ca.vertcat(*elements)


def _scored_quaternions(equations: _Equations, signals: tuple[str, ...]) -> tuple[tuple[int, ...], ...]:
    """Positions among the scored signals of the quaternions that are scored whole."""
    named = [[equations.signals[k] for k in four] for four in equations.quaternions]
    return tuple(tuple(signals.index(name) for name in four) for four in named if set(four) <= set(signals))


# Running -------------------------------------------------------------------------------------------------------------
class Rollouts:
    """Rollouts of one model, integrator and choice of scored signals; made by `rollouts`.

    A lane is one rollout: its parameters, its initial state, and with `start_rows` a window of the log of its own. What
    a lane gives depends on nothing but its own data: not on the other lanes, their number, `threads`, or what is kept.
    All methods share these arguments:

    Parameters
    ----------
    parameters : (n_lanes, n_p)   each parameter's unit
    initial_states : (n_x,) or (n_lanes, n_x)   coordinates, then velocities
    inputs : (n_log, n_u)   held from each row to the next
    measured : (n_log, n_s)   in the order of `signals`; NaN is allowed where `valid` is false
    valid : (n_log,)   rows that count; the others are simulated through
    dt : s   from row to row
    start_rows : (n_lanes,)   row at which each lane starts; row 0 by default
    n_rows : rows that a lane simulates; all of the log by default, required with `start_rows`
    threads : how many blocks of lanes run at a time

    Raises SettingsError: an array of another shape, a window outside the log, a time step that isn't positive.
    """

    def __init__(
        self, equations: _Equations, signals: tuple[str, ...], integrator: str, substeps: int, target: Target | None
    ) -> None:
        self.signals = signals
        self._equations = equations
        self._substeps = substeps
        self._target = target
        self._plan = _plan(equations, signals, integrator, substeps)
        self._code: dict[tuple[Keep, bool], MachineCode] = {}
        self._lock = Lock()

    def score(
        self,
        parameters: ArrayLike,
        initial_states: ArrayLike,
        inputs: ArrayLike,
        measured: ArrayLike,
        valid: ArrayLike,
        dt: float,
        thresholds: ArrayLike,
        min_inlier_signals: int,
        *,
        start_rows: ArrayLike | None = None,
        n_rows: int | None = None,
        threads: int = 1,
    ) -> Scores:
        """Sums of squared errors and inlier counts of every lane; nothing is stored row by row.

        The squares are added row after row, so `errors` reproduces the sums exactly.

        Parameters
        ----------
        thresholds : (n_s,)   a signal is near where `|error| < threshold`; 0 switches it off
        min_inlier_signals : near signals that make a row an inlier
        """
        from diransac.kernel.time_loop import Keep

        n_signals = len(self.signals)
        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        sums, counts = np.empty((n_signals, lanes.n_padded)), np.empty((2, lanes.n_padded), np.int64)
        values = {
            **arranged_measurements(lanes, n_signals, measured, valid),
            "squared_thresholds": squared_thresholds(thresholds, n_signals),
            "min_inlier_signals": int(min_inlier_signals),
            "sums": sums,
            "counts": counts,
        }
        self._run(Keep.SCORES, lanes, dt, values, threads)
        n = lanes.n_lanes
        return Scores(sums[:, :n].T.copy(), counts[0, :n].copy(), counts[1, :n] != 0)

    def errors(
        self,
        parameters: ArrayLike,
        initial_states: ArrayLike,
        inputs: ArrayLike,
        measured: ArrayLike,
        valid: ArrayLike,
        dt: float,
        *,
        start_rows: ArrayLike | None = None,
        n_rows: int | None = None,
        threads: int = 1,
    ) -> Floats:
        """Simulated less measured, (n_lanes, n_rows, n_s), NaN from a divergence on; the ones that `score` sums.

        A quaternion's sign is ignored: its four simulated numbers change sign where that brings them nearer.
        """
        from diransac.kernel.time_loop import Keep

        n_signals = len(self.signals)
        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        series = np.empty((lanes.n_lanes, lanes.n_rows, n_signals))
        measurements = arranged_measurements(lanes, n_signals, measured, valid)
        self._run(Keep.ERRORS, lanes, dt, {**measurements, "series": series}, threads)
        return series

    def trajectories(
        self,
        parameters: ArrayLike,
        initial_states: ArrayLike,
        inputs: ArrayLike,
        dt: float,
        *,
        start_rows: ArrayLike | None = None,
        n_rows: int | None = None,
        threads: int = 1,
    ) -> Floats:
        """All signals of the model, (n_lanes, n_rows, n_signals): states, accelerations; NaN from a divergence on."""
        from diransac.kernel.time_loop import Keep

        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        series = np.empty((lanes.n_lanes, lanes.n_rows, len(self._equations.signals)))
        self._run(Keep.SIGNALS, lanes, dt, {"series": series}, threads)
        return series

    def _lanes(
        self,
        parameters: ArrayLike,
        initial_states: ArrayLike,
        inputs: ArrayLike,
        start_rows: ArrayLike | None,
        n_rows: int | None,
    ) -> Lanes:
        """Check and arrange what every kind of run starts from."""
        n_q, n_v, n_u, n_p = self._equations.sizes
        return arranged_lanes((n_p, n_q + n_v, n_u), parameters, initial_states, inputs, start_rows, n_rows)

    def _run(self, keep: Keep, lanes: Lanes, dt: float, values: dict[str, Any], threads: int) -> None:
        """Run the time loop over all blocks of lanes; `values` are its other arguments by name."""
        from diransac.kernel.time_loop import ARGUMENTS

        if not (np.isfinite(dt) and dt > 0):
            raise SettingsError(f"dt is {dt}, but the time from row to row must be positive seconds.")
        if not lanes.n_lanes:
            return
        values = {"step": dt / self._substeps, "n_lanes": lanes.n_lanes, **lanes.arrays, **values}
        values |= {"n_padded": lanes.n_padded, "n_rows": lanes.n_rows}
        arguments = [
            array.ctypes.data if isinstance(array := values.get(name), np.ndarray) else array or 0
            for name in ARGUMENTS
            if not name.endswith("_block")
        ]
        code = self._compiled(keep, lanes.has_windows)
        run_blocks(code.call, arguments, lanes.n_padded // LANES, threads)

    def _compiled(self, keep: Keep, windows: bool) -> MachineCode:
        """Machine code of a variant of the time loop, compiled when first needed."""
        from diransac.kernel.time_loop import ARGUMENTS, emit_time_loop

        with self._lock:
            if (keep, windows) not in self._code:
                module = emit_time_loop(self._plan, keep, windows=windows)
                self._code[keep, windows] = compile_function(module, "time_loop", ARGUMENTS.values(), self._target)
            return self._code[keep, windows]


def inlier_mask(
    errors: Floats, valid: NDArray[np.bool_], thresholds: ArrayLike, min_inlier_signals: int
) -> NDArray[np.bool_]:
    """Which rows `Rollouts.score` counts as inliers, from `Rollouts.errors`.

    Parameters
    ----------
    errors : (n_lanes, n_rows, n_s)   each signal's unit
    valid : (n_rows,) or (n_lanes, n_rows)   rows that count
    thresholds : (n_s,)   each signal's unit
    min_inlier_signals : near signals that make a row an inlier

    Returns
    -------
    (n_lanes, n_rows)
    """
    with np.errstate(over="ignore", under="ignore"):
        near = np.square(errors) < squared_thresholds(thresholds, errors.shape[-1])
    diverged = np.isnan(errors).any(axis=-1)
    return np.asarray((near.sum(axis=-1) >= min_inlier_signals) & ~diverged & valid)
