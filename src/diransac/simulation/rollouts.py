"""Compiled rollouts: arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from threading import RLock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diransac.arrays import FloatArray
from diransac.errors import ModelError, SettingsError
from diransac.simulation.compiler.lanes import (
    Lanes,
    aligned,
    arranged_lanes,
    arranged_laws,
    arranged_measurements,
    arranged_weights,
    run_time_loop,
    squared_thresholds,
)
from diransac.simulation.compiler.machine_code import LANES, MachineCode, Target, compile_function
from diransac.simulation.integrators import INTEGRATORS, Equations, Sensitivities, plan_of, sensitivities_of
from diransac.simulation.outcomes import Flights, GaussNewton, LinearizedErrors, Scores, gauss_newton_of

if TYPE_CHECKING:
    from diransac.model import Model
    from diransac.model.plant import DisturbedModel
    from diransac.simulation.compiler.time_loop import Inputs, Kept, Plan
    from diransac.simulation.feedback import Law

__all__ = ["Rollouts", "rollouts"]


def rollouts(
    model: Model | DisturbedModel,
    signals: Sequence[str] | None = None,
    *,
    integrator: str = "rk4",
    substeps: int = 1,
    target: Target | None = None,
) -> Rollouts:
    """Compiled rollouts of a model; the same ones again for the same equations and options.

    Parameters
    ----------
    model : what is simulated, a `Model` or what `Plant.simulated` gives: its `dynamics`, an SX function (x, u, p) ->
        (dx/dt, accelerations)
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
    dynamics, parameters = model.dynamics.serialize(), tuple(model.parameters)
    equations = Equations(dynamics, sizes, parameters, names, quaternions, integrator, int(substeps), model)
    return _rollouts(equations, scored, target)


@lru_cache(maxsize=64)
def _rollouts(equations: Equations, signals: tuple[str, ...], target: Target | None) -> Rollouts:
    """Rollouts by value of what defines them."""
    return Rollouts(equations, signals, target)


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

    def __init__(self, equations: Equations, signals: tuple[str, ...], target: Target | None) -> None:
        self.signals = signals
        self._equations = equations
        self._target = target
        self._plans: dict[tuple[str, ...], tuple[Plan, Sensitivities]] = {}
        self._code: dict[tuple[Any, ...], MachineCode] = {}
        self._lock = RLock()
        self._plan(())  # refuses now what could not be compiled later

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
        """Sums of squared errors and inliers of every lane; row by row, one bit of each is stored.

        The squares are added row after row, so `errors` reproduces the sums exactly.

        Parameters
        ----------
        thresholds : (n_s,)   a signal is near where `|error| < threshold`; 0 switches it off
        min_inlier_signals : near signals that make a row an inlier
        """
        from diransac.simulation.compiler import kept

        n_signals = len(self.signals)
        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        sums, counts = np.empty((n_signals, lanes.n_padded)), np.empty((2, lanes.n_padded), np.int64)
        bits = np.zeros((lanes.n_padded // LANES, lanes.n_rows), np.uint8)
        values = {
            **arranged_measurements(lanes, n_signals, measured, valid),
            "squared_thresholds": squared_thresholds(thresholds, n_signals),
            "min_inlier_signals": int(min_inlier_signals),
            "sums": sums,
            "counts": counts,
            "inlier_bits": bits,
        }
        self._run(kept.Scores, lanes, dt, values, threads)
        n = lanes.n_lanes
        return Scores(sums[:, :n].T.copy(), counts[0, :n].copy(), counts[1, :n] != 0, bits)

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
    ) -> FloatArray:
        """Simulated less measured, (n_lanes, n_rows, n_s), NaN from a divergence on; the ones that `score` sums.

        A quaternion's sign is ignored: its four simulated numbers change sign where that brings them nearer.
        """
        from diransac.simulation.compiler import kept

        n_signals = len(self.signals)
        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        series = np.empty((lanes.n_lanes, lanes.n_rows, n_signals))
        measurements = arranged_measurements(lanes, n_signals, measured, valid)
        self._run(kept.Errors, lanes, dt, {**measurements, "series": series}, threads)
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
    ) -> FloatArray:
        """All signals of the model, (n_lanes, n_rows, n_signals): states, accelerations; NaN from a divergence on."""
        from diransac.simulation.compiler import kept

        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        series = np.empty((lanes.n_lanes, lanes.n_rows, len(self._equations.signals)))
        self._run(kept.Signals, lanes, dt, {"series": series}, threads)
        return series

    def gauss_newton(
        self,
        parameters: ArrayLike,
        initial_states: ArrayLike,
        inputs: ArrayLike,
        measured: ArrayLike,
        valid: ArrayLike,
        dt: float,
        weights: ArrayLike,
        *,
        unknowns: Sequence[str] | None = None,
        start_rows: ArrayLike | None = None,
        n_rows: int | None = None,
        threads: int = 1,
    ) -> GaussNewton:
        """Sums e' W e, J' W e and J' W J of every lane, J the exact derivative of the errors that `errors` gives.

        A kink (`fabs`, `if_else`) has the derivative of the branch that is taken; at the kink itself, CasADi's choice.

        Parameters
        ----------
        weights : (n_s,) or (n_log, n_s)   W, inverse of each signal's unit squared: 1 / sigma^2, or what robust
            reweighting makes of it. A measurement whose weight is 0 may be NaN
        unknowns : names of parameters, and of states, whose initial values are meant; all parameters, then all states
            by default
        """
        from diransac.simulation.compiler import kept

        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        names, sensitivities = self._unknowns(unknowns)
        n_z, n_blocks = len(names), lanes.n_padded // LANES
        sums = aligned((n_blocks, 1 + n_z + n_z * (n_z + 1) // 2, LANES))
        final = aligned((n_blocks, self._equations.n_x + int(sensitivities.varying.sum()), LANES))
        weighted = arranged_weights(lanes, len(self.signals), measured, valid, weights)
        values = {
            **weighted,
            "initial_states": sensitivities.appended(lanes.arrays["initial_states"]),
            "sums": sums,
            "final": final,
        }
        self._run(kept.Sums, lanes, dt, values, threads, unknowns=names)
        return gauss_newton_of(sensitivities, lanes.n_lanes, sums, final)

    def linearized_errors(
        self,
        parameters: ArrayLike,
        initial_states: ArrayLike,
        inputs: ArrayLike,
        measured: ArrayLike,
        valid: ArrayLike,
        dt: float,
        *,
        unknowns: Sequence[str] | None = None,
        start_rows: ArrayLike | None = None,
        n_rows: int | None = None,
        threads: int = 1,
    ) -> LinearizedErrors:
        """Errors and Jacobian row by row, those that `gauss_newton` sums; for a few lanes, because all is stored.

        Parameters
        ----------
        unknowns : as `gauss_newton` has them
        """
        from diransac.simulation.compiler import kept

        lanes = self._lanes(parameters, initial_states, inputs, start_rows, n_rows)
        names, sensitivities = self._unknowns(unknowns)
        n_s, n_z = len(self.signals), len(names)
        series = np.empty((lanes.n_lanes, lanes.n_rows, n_s * (1 + n_z)))
        measurements = arranged_measurements(lanes, n_s, measured, valid)
        values = {
            **measurements,
            "initial_states": sensitivities.appended(lanes.arrays["initial_states"]),
            "series": series,
        }
        self._run(kept.LinearizedErrors, lanes, dt, values, threads, unknowns=names)
        jacobian = series[..., n_s:].reshape(*series.shape[:2], n_s, n_z)
        return LinearizedErrors(names, series[..., :n_s], jacobian)

    def fly(
        self,
        parameters: ArrayLike,
        initial_states: ArrayLike,
        law: Law,
        dt: float,
        *,
        law_of_lane: ArrayLike | None = None,
        start_rows: ArrayLike | None = None,
        n_rows: int | None = None,
        threads: int = 1,
    ) -> Flights:
        """Signals of closed loops, and the inputs that were applied.

        Parameters
        ----------
        law : gives the inputs of every row; its rows are the log's
        law_of_lane : (n_lanes,)   which law of a table steers each lane; by default the first lane's is the first, ...
        """
        from diransac.simulation.compiler import inputs, kept

        n_signals, n_u, n_x = len(self._equations.signals), self._equations.sizes[2], self._equations.n_x
        if (law.n_x, law.n_u) != (n_x, n_u):
            raise SettingsError(
                f"the law is for {law.n_x} states and {law.n_u} inputs, but the model has {n_x} and {n_u}."
            )
        lanes = self._lanes(parameters, initial_states, np.zeros((law.n_rows, n_u)), start_rows, n_rows)
        values = arranged_laws(lanes, law.table(), law.n_laws, law_of_lane)
        series = np.empty((lanes.n_lanes, lanes.n_rows, n_signals + n_u))
        values |= {"limits": np.array([law.u_min, law.u_max]), "series": series}
        source = inputs.fed_back if "law_starts" in values else inputs.fed_back_alike
        self._run(kept.Flights, lanes, dt, values, threads, inputs=source)
        return Flights(series[..., :n_signals], series[..., n_signals:])

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

    def _unknowns(self, unknowns: Sequence[str] | None) -> tuple[tuple[str, ...], Sensitivities]:
        """Check names of unknowns, and find what there is to differentiate."""
        known = (*self._equations.parameters, *self._equations.states)
        names = known if unknowns is None else tuple(unknowns)
        if not names or len(set(names)) < len(names) or not set(names) <= set(known):
            raise SettingsError(
                f"unknowns are {', '.join(names) or 'none'}, but at least one is needed, each a parameter or a state, "
                f"once; there are {', '.join(known)}."
            )
        return names, self._plan(names)[1]

    def _run(
        self,
        kept: type[Kept],
        lanes: Lanes,
        dt: float,
        values: dict[str, Any],
        threads: int,
        *,
        inputs: Inputs | None = None,
        unknowns: tuple[str, ...] = (),
    ) -> None:
        """Run the time loop over all blocks of lanes; `values` are its other arguments by name."""
        from diransac.simulation.compiler.inputs import held

        if not (np.isfinite(dt) and dt > 0):
            raise SettingsError(f"dt is {dt}, but the time from row to row must be positive seconds.")
        if lanes.n_lanes:
            code = self._compiled(kept, inputs or held, unknowns, lanes.has_windows)
            run_time_loop(code, lanes, {"step": dt / self._equations.substeps, **values}, threads)

    def _plan(self, unknowns: tuple[str, ...]) -> tuple[Plan, Sensitivities]:
        """Expressions of a row and their derivatives with respect to some unknowns, made when first needed."""
        with self._lock:
            if unknowns not in self._plans:
                sensitivities = sensitivities_of(self._equations, unknowns)
                self._plans[unknowns] = plan_of(self._equations, self.signals, sensitivities), sensitivities
            return self._plans[unknowns]

    def _compiled(self, kept: type[Kept], inputs: Inputs, unknowns: tuple[str, ...], windows: bool) -> MachineCode:
        """Machine code of a variant of the time loop, compiled when first needed."""
        from diransac.simulation.compiler.time_loop import ARGUMENTS, emit_time_loop

        variant = (kept, inputs, unknowns, windows)
        with self._lock:
            if variant not in self._code:
                module = emit_time_loop(self._plan(unknowns)[0], kept, inputs, windows=windows)
                self._code[variant] = compile_function(module, "time_loop", ARGUMENTS.values(), self._target)
            return self._code[variant]
