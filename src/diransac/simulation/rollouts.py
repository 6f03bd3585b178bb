"""Compiled rollouts: the simulator that runs on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
from itertools import chain
from threading import RLock
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from diransac.arrays import FloatArray
from diransac.errors import ModelError, SettingsError
from diransac.simulation.batch import (
    ClosedLoopBatch,
    GaussNewtonBatch,
    LinearFeedback,
    LinearizedErrors,
    Measurements,
    RolloutBatch,
    ScoreBatch,
    Simulator,
)
from diransac.simulation.compiler.graph import check_compilable
from diransac.simulation.compiler.lanes import (
    ARGUMENTS,
    Lanes,
    aligned,
    arranged_directions,
    arranged_feedback,
    arranged_lanes,
    arranged_measurements,
    arranged_weights,
    checked_array,
    run_time_loop,
    squared_thresholds,
)
from diransac.simulation.compiler.machine_code import LANES, MachineCode, Part, Target, compile_function
from diransac.simulation.integrators import (
    CALLED,
    HOLDS,
    INTEGRATORS,
    Sensitivities,
    called_dynamics,
    calls_dynamics,
    input_columns,
    loop_specification,
    sensitivities_of,
)

if TYPE_CHECKING:
    from diransac.simulation.compiler.time_loop import LoopSpecification
    from diransac.simulation.compiler.vectors import Value
    from diransac.simulation.integrators import SimulatedModel

OutputName: TypeAlias = Literal[
    "ScoreOutput", "ErrorOutput", "SignalOutput", "GaussNewtonOutput", "LinearizedErrorOutput", "ClosedLoopOutput"
]
InputName: TypeAlias = Literal["inputs_from_log", "inputs_by_feedback", "inputs_by_shared_feedback"]
"""Outputs of a time loop and sources of its inputs: names in modules that are imported only to emit code."""


def rollouts(
    model: SimulatedModel,
    signals: Sequence[str] | None = None,
    *,
    integrator: str = "rk4",
    substeps: int = 1,
    hold: str = "zero-order",
    target: Target | None = None,
) -> Simulator:
    """Rollouts of a model, compiled or by MuJoCo; the same object again for an equal model and equal options.

    Parameters
    ----------
    model : Model, DisturbedModel or MujocoModel
        The model to simulate, or `Plant.simulated`: its `dynamics` are an SX function (x, u, p) -> (dx/dt,
        accelerations).  MuJoCo has an integrator and steps of its own.
    signals : sequence of str, optional
        Signals that are compared with measurements, in the order of their columns; all by default.
    integrator : {"rk4", "euler", "semi-implicit-euler"}
        The last one steps velocities first, then coordinates with the new velocities.
    substeps : int
        Integration steps from one row to the next.
    hold : {"zero-order", "linear", "smooth"}
        Inputs from one row to the next: those of the row, or interpolated to those of the next at the time of every
        stage of every step, linearly or by parabolas; after the last row of the log, its own.  A closed loop has a
        zero-order hold.
    target : Target, optional
        Processor to compile for; this one by default.

    Raises
    ------
    SettingsError
        A signal, the integrator or the hold is unknown, or there is no integration step.
    ModelError
        The dynamics hold an operation that cannot be compiled.
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
    if hold not in HOLDS:
        raise SettingsError(f"hold {hold!r} is unknown; choose one of {', '.join(HOLDS)}.")
    if not getattr(model, "has_equations", True):
        return _by_mujoco(model, scored, hold)
    if substeps < 1:
        raise SettingsError(f"substeps is {substeps}, but a row takes at least 1 integration step.")
    if not model.dynamics.is_a("SXFunction"):
        raise ModelError(f"the dynamics of model {model.name!r} are not made of SX symbols; expand them: .expand().")
    return _rollouts(model, scored, integrator, int(substeps), hold, target)


@lru_cache(maxsize=32)
def _by_mujoco(model: SimulatedModel, signals: tuple[str, ...], hold: str) -> Simulator:
    """Rollouts by MuJoCo, by value of what defines them."""
    from diransac.model.mjcf import MujocoModel
    from diransac.simulation.mujoco import MujocoRollouts

    assert isinstance(model, MujocoModel)
    return MujocoRollouts(model, signals, hold)


@lru_cache(maxsize=64)
def _rollouts(
    model: SimulatedModel, signals: tuple[str, ...], integrator: str, substeps: int, hold: str, target: Target | None
) -> Rollouts:
    """Rollouts by value of what defines them."""
    return Rollouts(model, signals, integrator, substeps, hold, target)


class Rollouts(Simulator):
    """Compiled rollouts of one model, integrator, hold and choice of scored signals; made by `rollouts`.

    Each method compiles a variant of the time loop when it is first called.
    """

    def __init__(
        self,
        model: SimulatedModel,
        signals: tuple[str, ...],
        integrator: str,
        substeps: int,
        hold: str,
        target: Target | None,
    ) -> None:
        self.signals = signals
        self._model, self._integrator, self._substeps, self._target = model, integrator, substeps, target
        self._hold = hold
        self._sensitivities: dict[tuple[str, ...], Sensitivities] = {}
        self._specifications: dict[tuple[str, ...], LoopSpecification] = {}
        self._code: dict[tuple[Any, ...], MachineCode] = {}
        self._lock = RLock()
        check_compilable(model.dynamics)

    def score(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        thresholds: ArrayLike,
        min_inlier_signals: int,
        *,
        threads: int = 1,
    ) -> ScoreBatch:
        """Sums of squared errors and inliers of every lane; see `Simulator.score`."""
        n_signals = len(self.signals)
        lanes = self._lanes(batch)
        sums, counts = np.empty((n_signals, lanes.n_padded)), np.empty((2, lanes.n_padded), np.int64)
        bits = np.zeros((lanes.n_padded // LANES, lanes.n_rows), np.uint8)
        values = {
            **arranged_measurements(lanes, n_signals, measurements.values, measurements.valid),
            "squared_thresholds": squared_thresholds(thresholds, n_signals),
            "min_inlier_signals": int(min_inlier_signals),
            "sums": sums,
            "counts": counts,
            "inlier_bits": bits,
        }
        self._run("ScoreOutput", batch, lanes, values, threads)
        n = lanes.n_lanes
        return ScoreBatch(batch, sums[:, :n].T.copy(), counts[0, :n].copy(), counts[1, :n] != 0, bits)

    def errors_and_ends(
        self, batch: RolloutBatch, measurements: Measurements, *, threads: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Errors, and the states (n_lanes, n_x) one row after the last; see `Simulator.errors_and_ends`."""
        n_signals = len(self.signals)
        lanes = self._lanes(batch)
        series = np.empty((lanes.n_lanes, lanes.n_rows, n_signals))
        final = np.empty((lanes.n_lanes, len(self._model.state)))
        values = arranged_measurements(lanes, n_signals, measurements.values, measurements.valid)
        self._run("ErrorOutput", batch, lanes, {**values, "series": series, "final": final}, threads)
        return series, final

    def trajectories(self, batch: RolloutBatch, *, threads: int = 1) -> FloatArray:
        """All signals of the model, (n_lanes, n_rows, n_signals): states, accelerations; NaN from a divergence on."""
        if self.signals != (every := tuple(self._model.signals)):  # whose code is the same
            rest = self._integrator, self._substeps, self._hold, self._target
            return _rollouts(self._model, every, *rest).trajectories(batch, threads=threads)
        lanes = self._lanes(batch)
        if lanes.n_lanes <= LANES:  # one vector reads rows of its own as fast: one machine code less
            lanes = lanes.with_windows()
        series = np.empty((lanes.n_lanes, lanes.n_rows, len(self._model.signals)))
        final = np.empty((lanes.n_lanes, len(self._model.state)))
        self._run("SignalOutput", batch, lanes, {"series": series, "final": final}, threads)
        return series

    def gauss_newton(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        weights: ArrayLike,
        *,
        unknowns: Sequence[str] | None = None,
        normal_matrix: bool = True,
        directions: ArrayLike | None = None,
        threads: int = 1,
    ) -> GaussNewtonBatch:
        """Sums e' W e, J' W e, J' W J and those along directions of every lane; see `Simulator.gauss_newton`."""
        lanes = self._lanes(batch)
        names, sensitivities = self._unknowns(unknowns)
        n, n_x, n_z = lanes.n_lanes, len(self._model.state), len(names)
        first, matrix = np.empty((n, 1 + n_z)), np.empty((n if normal_matrix else 0, n_z, n_z))
        final = np.zeros((n, n_x + n_x * n_z))  # derivatives that are always zero are not written
        places = sensitivities.places
        of_directions = arranged_directions(lanes, len(self.signals), directions)
        along = np.empty((n, of_directions["n_directions"], 1 + n_z))
        n_vectors = len(places) - n_z * (n_z + 1) // 2 + along.shape[1] * along.shape[2]
        values = {
            **arranged_weights(lanes, len(self.signals), measurements.values, measurements.valid, weights),
            **of_directions,
            "along": along,
            "products": int(normal_matrix),
            "places": places,
            "scratch": aligned((lanes.n_padded // LANES, n_vectors, LANES)),
            "first": first,
            "matrix": matrix,
            "final": final,
        }
        self._run("GaussNewtonOutput", batch, lanes, values, threads, unknowns=names)
        cost, slopes = first[:, 0].copy(), final[:, n_x:].reshape(n, n_x, n_z)
        diverged = np.isinf(cost)
        if diverged.any():
            slopes[diverged] = np.nan
        return GaussNewtonBatch(names, cost, first[:, 1:], matrix, final[:, :n_x].copy(), slopes, diverged, along)

    def linearized_errors(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        *,
        unknowns: Sequence[str] | None = None,
        threads: int = 1,
    ) -> LinearizedErrors:
        """Errors and Jacobian row by row; see `Simulator.linearized_errors`."""
        lanes = self._lanes(batch)
        names, sensitivities = self._unknowns(unknowns)
        n_s, n_z = len(self.signals), len(names)
        series = np.empty((lanes.n_lanes, lanes.n_rows, n_s * (1 + n_z)))
        values = {
            **arranged_measurements(lanes, n_s, measurements.values, measurements.valid),
            "series": series,
        }
        self._run("LinearizedErrorOutput", batch, lanes, values, threads, unknowns=names)
        columns = series[..., n_s:].reshape(*series.shape[:2], n_z, n_s)
        jacobian = np.empty((*series.shape[:2], n_s, n_z))
        jacobian[..., list(chain(*sensitivities.groups))] = columns.swapaxes(-1, -2)
        return LinearizedErrors(names, series[..., :n_s], jacobian)

    def fly(
        self,
        batch: RolloutBatch,
        feedback: LinearFeedback,
        *,
        feedback_of_lane: ArrayLike | None = None,
        threads: int = 1,
    ) -> ClosedLoopBatch:
        """Signals of closed loops, and the inputs that were applied; see `Simulator.fly`."""
        model, n_signals = self._model, len(self._model.signals)
        if self._hold != "zero-order":
            raise SettingsError(f"a closed loop holds its inputs from row to row; these rollouts are {self._hold}.")
        if (feedback.n_x, feedback.n_u) != (len(model.state), model.n_u):
            raise SettingsError(
                f"the feedback is for {feedback.n_x} states and {feedback.n_u} inputs, but the model has "
                f"{len(model.state)} and {model.n_u}."
            )
        if batch.n_log != feedback.n_rows:
            raise SettingsError(f"the batch's inputs have {batch.n_log} rows, but the feedback has {feedback.n_rows}.")
        lanes = self._lanes(batch, np.zeros((batch.n_log, model.n_u)))
        values = arranged_feedback(lanes, feedback.table(), feedback.n_laws, feedback_of_lane)
        series = np.empty((lanes.n_lanes, lanes.n_rows, n_signals + model.n_u))
        values |= {"limits": np.array([feedback.u_min, feedback.u_max]), "series": series}
        source: InputName = "inputs_by_feedback" if "feedback_starts" in values else "inputs_by_shared_feedback"
        self._run("ClosedLoopOutput", batch, lanes, values, threads, inputs=source)
        return ClosedLoopBatch(series[..., :n_signals], series[..., n_signals:])

    def _lanes(self, batch: RolloutBatch, inputs: FloatArray | None = None) -> Lanes:
        """Lanes of a batch as the time loop reads them, with other inputs where given."""
        n_u = self._model.n_u
        u = checked_array("inputs", batch.inputs if inputs is None else inputs, (None, n_u))
        return arranged_lanes(
            (self._model.n_p, len(self._model.state), 3 * n_u if self._varies else n_u),
            batch.parameters,
            batch.initial_states,
            input_columns(self._hold, u, self._substeps, batch.logs),
            batch.start_rows,
            batch.rows_per_lane,
        )

    def _unknowns(self, unknowns: Sequence[str] | None) -> tuple[tuple[str, ...], Sensitivities]:
        """Names of the unknowns, checked, and the derivatives with respect to them."""
        known = (*self._model.parameters, *self._model.state)
        names = known if unknowns is None else tuple(unknowns)
        if not names or len(set(names)) < len(names) or not set(names) <= set(known):
            raise SettingsError(
                f"unknowns are {', '.join(names) or 'none'}, but at least one is needed, each a parameter or a state, "
                f"once; there are {', '.join(known)}."
            )
        return names, self._derivatives(names)

    def _run(
        self,
        output: OutputName,
        batch: RolloutBatch,
        lanes: Lanes,
        values: dict[str, Any],
        threads: int,
        *,
        inputs: InputName = "inputs_from_log",
        unknowns: tuple[str, ...] = (),
    ) -> None:
        """Run the time loop over all blocks of lanes; `values` are its other arguments by name."""
        if lanes.n_lanes:
            code = self._compiled(output, inputs, unknowns, lanes.has_windows)
            steps = {"step": batch.dt / self._substeps, "substeps": self._substeps}
            run_time_loop(code, lanes, {**steps, **values}, threads)

    @property
    def _is_divided(self) -> bool:
        """True for code of rows with several sub-steps, which serves any number of them."""
        return self._substeps > 1

    @property
    def _varies(self) -> bool:
        """True for code that serves both holds in which inputs vary between rows."""
        return self._hold != "zero-order"

    def _derivatives(self, unknowns: tuple[str, ...]) -> Sensitivities:
        """Structure of the derivatives with respect to some unknowns, found when first needed."""
        with self._lock:
            if unknowns not in self._sensitivities:
                self._sensitivities[unknowns] = sensitivities_of(self._model, unknowns)
            return self._sensitivities[unknowns]

    def _specified(self, unknowns: tuple[str, ...]) -> LoopSpecification:
        """Expressions of a row and their derivatives with respect to some unknowns, made when first needed."""
        with self._lock:
            if unknowns not in self._specifications:
                self._specifications[unknowns] = loop_specification(
                    self._model,
                    self.signals,
                    self._integrator,
                    self._derivatives(unknowns) if unknowns else None,
                    varying=self._varies,
                    divided=self._is_divided,
                )
            return self._specifications[unknowns]

    def _compiled(self, output: OutputName, inputs: InputName, unknowns: tuple[str, ...], windows: bool) -> MachineCode:
        """Machine code of a variant of the time loop, compiled when first needed."""

        def emit() -> Value:
            from diransac.simulation.compiler import outputs, time_loop

            variant = getattr(outputs, output), getattr(time_loop, inputs)
            return time_loop.emit_time_loop(self._specified(unknowns), *variant, windows=windows)

        variant = (output, inputs, unknowns, windows)
        with self._lock:
            if variant not in self._code:
                definition = (*self._definition(unknowns), output, inputs, repr(windows))
                self._code[variant] = compile_function(
                    emit, definition, "time_loop", ARGUMENTS.values(), self._target, self._parts
                )
            return self._code[variant]

    @property
    def _parts(self) -> tuple[Part, ...]:
        """The dynamics, where the loop calls them: the same machine code for all variants."""
        model = self._model

        def emit() -> Value:
            from diransac.simulation.compiler.stage_function import stage_module

            return stage_module(called_dynamics(model))

        sizes = repr((len(model.state), model.n_u))
        return (Part(emit, (sizes, self._dynamics), CALLED),) if calls_dynamics(model) else ()

    def _definition(self, unknowns: tuple[str, ...]) -> list[str]:
        """Texts that determine `loop_specification`: all that it reads of the model, and its other arguments."""
        model = self._model
        sizes = (model.n_q, model.n_u, model.n_p, tuple(model.parameters), model.state, model.signals)
        options = (self.signals, unknowns, self._integrator, self._is_divided, self._varies)
        jacobians = [model.rate_jacobians.serialize()] if unknowns else []
        return [repr((sizes, model.quaternions, options)), self._dynamics, *jacobians]

    @cached_property
    def _dynamics(self) -> str:
        """The dynamics as a text, for the keys of all variants."""
        text: str = self._model.dynamics.serialize()
        return text
