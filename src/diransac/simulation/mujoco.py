"""Rollouts by MuJoCo: the simulator of a `MujocoModel`.

All lanes of a call are rollouts of `mujoco.rollout` on all threads.  Derivatives are differences, for which each lane
is simulated again with every unknown moved: states lane by lane, parameters in copies of MuJoCo's model; readings are
shifted by biases.  A row takes as many of MuJoCo's steps as its time step goes into it.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from diransac.arrays import BoolArray, FloatArray, IntArray, size_or_one
from diransac.errors import SettingsError
from diransac.model.mjcf.model import write
from diransac.model.robots.compiled import mujoco_module, without_warnings
from diransac.simulation.batch import (
    ClosedLoopBatch,
    GaussNewtonBatch,
    LinearFeedback,
    LinearizedErrors,
    Measurements,
    RolloutBatch,
    ScoreBatch,
    Simulator,
    inlier_mask,
)
from diransac.simulation.compiler.machine_code import default_threads
from diransac.simulation.integrators import input_columns, interpolated

if TYPE_CHECKING:
    from diransac.model.mjcf import MujocoModel

_STEP, _STEP_OF_PARAMETERS = 1e-7, 1e-5
"""Differences of states, and of parameters over their sizes: wider ones meet contacts that begin a step earlier."""
_LANES = 4096
"""Rollouts of one call of MuJoCo at most, which stores all their states."""
_DIVERGED = 1e8


class MujocoRollouts(Simulator):
    """Rollouts of one model, with a choice of scored signals and a hold of the inputs.

    Parameters
    ----------
    model : MujocoModel
    signals : tuple of str
    hold : str
    """

    def __init__(self, model: MujocoModel, signals: tuple[str, ...], hold: str) -> None:
        self.signals, self._model, self._hold = signals, model, hold
        self._columns = np.array([model.signals.index(n) for n in signals], int)
        self._copies: list[Any] = []  # of MuJoCo's model, to write parameters in; as many as were needed so far

    # ------------------------------------------------------------------ the interface

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
        counted = np.where(measurements.valid[:, None], measurements.values, 0.0)
        errors = self.errors(batch, Measurements(counted, measurements.valid), threads=threads)
        valid = measurements.valid[self._rows(batch)]
        diverged: BoolArray = np.asarray(~np.isfinite(errors).all(axis=(1, 2)))
        squares = np.where(valid[:, :, None], np.square(errors), 0.0).sum(axis=1)
        squares[diverged] = np.inf
        inliers = inlier_mask(errors, valid, thresholds, min_inlier_signals)
        bits = np.packbits(inliers, axis=0, bitorder="little")
        return ScoreBatch(batch, squares, inliers.sum(axis=1), diverged, bits)

    def errors_and_ends(
        self, batch: RolloutBatch, measurements: Measurements, *, threads: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Errors and the states after the last row; see `Simulator.errors_and_ends`."""
        n = batch.n_lanes
        errors = np.empty((n, batch.rows_per_lane, len(self.signals)))
        ends = np.empty((n, len(self._model.state)))
        for part in _parts(n, _LANES):
            series, ends[part] = self._simulated(batch, np.arange(n)[part], threads)
            errors[part] = self._compared(series, batch, measurements, part)
        return errors, ends

    def trajectories(self, batch: RolloutBatch, *, threads: int = 1) -> FloatArray:
        """All signals of the model; see `Simulator.trajectories`."""
        found = np.empty((batch.n_lanes, batch.rows_per_lane, len(self._model.signals)))
        for part in _parts(batch.n_lanes, _LANES):
            found[part] = self._simulated(batch, np.arange(batch.n_lanes)[part], threads)[0]
        return found

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
        """Sums of every lane, from differences; see `Simulator.gauss_newton`."""
        names, n, n_x = self._unknowns(unknowns), batch.n_lanes, len(self._model.state)
        n_z = len(names)
        W = np.broadcast_to(np.asarray(weights, float), measurements.values.shape)
        known = Measurements(np.nan_to_num(measurements.values), measurements.valid)
        cost, gradient = np.empty(n), np.empty((n, n_z))
        d = np.asarray(np.empty((len(W), 0, W.shape[1])) if directions is None else directions, float)
        along = np.empty((n, d.shape[1], 1 + n_z))
        matrix = np.empty((n if normal_matrix else 0, n_z, n_z))
        final, slopes = np.empty((n, n_x)), np.empty((n, n_x, n_z))
        for part in _parts(n, max(1, _LANES // (n_z + 1))):
            errors, jacobian, final[part], slopes[part] = self._linearized(batch, known, names, part, threads)
            rows = self._rows(batch)[part]
            w = np.where(measurements.valid[rows][:, :, None], W[rows], 0.0)
            weighted = (w * errors)[..., None]
            with np.errstate(invalid="ignore", over="ignore"):
                cost[part] = (weighted[..., 0] * errors).sum(axis=(1, 2))
                flat = jacobian.reshape(len(errors), -1, n_z)
                gradient[part] = (flat.swapaxes(1, 2) @ weighted.reshape(len(errors), -1, 1))[..., 0]
                beside = np.concatenate([errors[..., None], jacobian], axis=3)
                along[part] = np.einsum("nrs,nrds,nrsz->ndz", w, d[rows], beside)
                if normal_matrix:
                    matrix[part] = flat.swapaxes(1, 2) @ (w.reshape(len(errors), -1, 1) * flat)
        diverged = ~(np.isfinite(cost) & np.isfinite(slopes).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1))
        if normal_matrix:
            diverged |= ~np.isfinite(matrix).all(axis=(1, 2))
        cost[diverged], gradient[diverged], slopes[diverged], final[diverged] = np.inf, 0.0, np.nan, np.nan
        along[diverged] = 0.0
        if normal_matrix:
            matrix[diverged] = 0.0
        return GaussNewtonBatch(names, cost, gradient, matrix, final, slopes, diverged, along)

    def linearized_errors(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        *,
        unknowns: Sequence[str] | None = None,
        threads: int = 1,
    ) -> LinearizedErrors:
        """Errors and Jacobian row by row, from differences; see `Simulator.linearized_errors`."""
        names, n, n_x = self._unknowns(unknowns), batch.n_lanes, len(self._model.state)
        errors = np.empty((n, batch.rows_per_lane, len(self.signals)))
        jacobian, final = np.empty((*errors.shape, len(names))), np.empty((n, n_x))
        slopes = np.empty((n, n_x, len(names)))
        for part in _parts(n, max(1, _LANES // (len(names) + 1))):
            errors[part], jacobian[part], final[part], slopes[part] = self._linearized(
                batch, measurements, names, part, threads
            )
        return LinearizedErrors(names, errors, jacobian, final, slopes)

    def fly(
        self,
        batch: RolloutBatch,
        feedback: LinearFeedback,
        *,
        feedback_of_lane: ArrayLike | None = None,
        threads: int = 1,
    ) -> ClosedLoopBatch:
        """Not for this back end.  Raises SettingsError."""
        raise SettingsError(f"{self._model.name}: closed loops need the equations of a model; MuJoCo's has none")

    # ------------------------------------------------------------------ simulation

    def _unknowns(self, unknowns: Sequence[str] | None) -> tuple[str, ...]:
        known = (*self._model.parameters, *self._model.state)
        names = known if unknowns is None else tuple(unknowns)
        if not names or len(set(names)) < len(names) or not set(names) <= set(known):
            raise SettingsError(
                f"unknowns are {', '.join(names) or 'none'}; choose from {', '.join(known)}, each once."
            )
        return names

    def _rows(self, batch: RolloutBatch) -> IntArray:
        """Row of the log of each row of each lane."""
        starts = np.zeros(batch.n_lanes, np.int64) if batch.start_rows is None else batch.start_rows
        return np.asarray(starts[:, None] + np.arange(batch.rows_per_lane))

    def _compared(self, series: FloatArray, batch: RolloutBatch, measurements: Measurements, part: slice) -> FloatArray:
        """Simulated less measured signals of some lanes; quaternions have the nearer sign."""
        measured = measurements.values[self._rows(batch)[part]]
        simulated = series[..., self._columns].copy()
        for four in self._model.quaternions:
            own = [int(np.flatnonzero(self._columns == k)[0]) for k in four if k in self._columns]
            if len(own) == 4:
                sign = np.sign((simulated[..., own] * measured[..., own]).sum(axis=-1, keepdims=True))
                simulated[..., own] *= np.where(sign < 0.0, -1.0, 1.0)
        return np.asarray(simulated - measured)

    def _simulated(self, batch: RolloutBatch, lanes: IntArray, threads: int) -> tuple[FloatArray, FloatArray]:
        """All signals (n, n_rows, n_signals) of some lanes, and the states after their last rows."""
        states = np.broadcast_to(batch.initial_states, (batch.n_lanes, len(self._model.state)))[lanes]
        return self._run(batch, self._rows(batch)[lanes], batch.parameters[lanes], states, threads)

    def _linearized(
        self,
        batch: RolloutBatch,
        measurements: Measurements,
        names: tuple[str, ...],
        part: slice,
        threads: int,
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Errors and their derivatives of some lanes, final states and their derivatives."""
        lanes, n_z = np.arange(batch.n_lanes)[part], len(names)
        n, n_all = len(lanes), n_z + 1
        p = np.repeat(batch.parameters[lanes][:, None], n_all, axis=1)
        states = np.broadcast_to(batch.initial_states, (batch.n_lanes, len(self._model.state)))[lanes]
        x, steps = np.repeat(states[:, None], n_all, axis=1), np.empty((n, n_z))
        own, state = list(self._model.parameters), list(self._model.state)
        for k, name in enumerate(names):
            values, column = (p, own.index(name)) if name in own else (x, state.index(name))
            steps[:, k] = (_STEP_OF_PARAMETERS if name in own else _STEP) * np.maximum(
                self._sizes[name], np.abs(values[:, 0, column])
            )
            values[:, k + 1, column] += steps[:, k]
        rows = np.repeat(self._rows(batch)[lanes], n_all, axis=0)
        series, ends = self._run(batch, rows, p.reshape(n * n_all, -1), x.reshape(n * n_all, -1), threads)
        series, ends = series.reshape(n, n_all, *series.shape[1:]), ends.reshape(n, n_all, -1)
        errors = self._compared(series[:, 0], batch, measurements, part)
        signed = errors + measurements.values[self._rows(batch)[part]]
        moved = self._alike(series[:, 1:, :, self._columns], signed)
        jacobian = np.moveaxis((moved - signed[:, None]) / steps[:, :, None, None], 1, -1)
        slopes = np.moveaxis((ends[:, 1:] - ends[:, :1]) / steps[:, :, None], 1, -1)
        return errors, np.ascontiguousarray(jacobian), ends[:, 0], slopes

    def _alike(self, moved: FloatArray, signals: FloatArray) -> FloatArray:
        """Signals of moved rollouts (n, k, n_rows, n_s) whose quaternions have the signs of others."""
        of_quaternions = np.isin(self._columns, [k for four in self._model.quaternions for k in four])
        if not of_quaternions.any():
            return moved
        flipped = np.square(moved - signals[:, None]) > np.square(moved + signals[:, None])
        return np.where(of_quaternions & flipped, -moved, moved)

    def _run(
        self, batch: RolloutBatch, rows: IntArray, parameters: FloatArray, states: FloatArray, threads: int
    ) -> tuple[FloatArray, FloatArray]:
        """Signals (n, n_rows, n_signals) of lanes, and states (n, n_x) after their last rows."""
        model, module = self._model, mujoco_module()
        n, length = rows.shape
        n_x = len(model.state)
        substeps = max(1, round(batch.dt / model.compiled.opt.timestep))
        models = self._models(parameters, batch.dt / substeps)
        begin = np.zeros((n, 1 + n_x))
        begin[:, 1:] = self._normalized(states)
        control = self._inputs(batch, substeps)[rows].reshape(n, length * substeps, -1)
        spec = int(module.mjtState.mjSTATE_CTRL)
        state, sensordata = _pool(threads).run(models, begin, np.ascontiguousarray(control), spec)
        return self._signals(begin[:, 1:], state[:, :, 1:], sensordata, substeps, batch.dt / substeps, parameters)

    def _signals(
        self,
        begin: FloatArray,
        state: FloatArray,
        sensordata: FloatArray,
        substeps: int,
        step: float,
        parameters: FloatArray,
    ) -> tuple[FloatArray, FloatArray]:
        """Signals of rows, from the states after each of MuJoCo's steps and the readings before it."""
        model, (n, n_steps, n_x) = self._model, state.shape
        series = np.empty((n, n_steps // substeps, len(model.signals)))
        series[:, 0, :n_x] = begin
        series[:, 1:, :n_x] = state[:, substeps - 1 : -1 : substeps]
        speeds = state[:, ::substeps, model.n_q :]
        series[:, :, n_x : n_x + model.n_v] = (speeds - series[:, :, model.n_q : n_x]) / step
        places = list(model.reading_places.values())
        series[:, :, n_x + model.n_v :] = sensordata[:, ::substeps][:, :, places]
        for k, sensor in model.biases:
            value = parameters[:, k, None] if k >= 0 else model.constants[-1 - k][1]
            series[:, :, n_x + model.n_v + sensor] += value
        # MuJoCo repeats the last state after a warning.
        still = (state[:, 1:, : model.n_q] == state[:, :-1, : model.n_q]).all(axis=2)
        moving = (np.abs(state[:, 1:, model.n_q : model.n_q + model.compiled.nv]) > 1e-6).any(axis=2)
        lost = (still & moving).any(axis=1) | ~(np.abs(state) < _DIVERGED).all(axis=(1, 2))
        series[lost] = np.nan
        ends = state[:, -1].copy()
        ends[lost] = np.nan
        return series, ends

    def _normalized(self, states: FloatArray) -> FloatArray:
        """States with unit quaternions."""
        found = states.copy()
        for four in self._model.quaternions:
            found[:, list(four)] /= size_or_one(np.linalg.norm(found[:, list(four)], axis=1, keepdims=True))
        return found

    def _inputs(self, batch: RolloutBatch, substeps: int) -> FloatArray:
        """Inputs (n_log, substeps, n_u) at the middle of MuJoCo's steps; of a hold, at their beginning."""
        n_u = self._model.n_u
        columns = input_columns(self._hold, batch.inputs, substeps, batch.logs)
        u = np.repeat(columns[:, None, :n_u], substeps, axis=1)
        if columns.shape[1] == n_u:
            return u
        first, second = columns[:, None, n_u : 2 * n_u], columns[:, None, 2 * n_u :]
        middle = np.arange(substeps)[None, :, None] + 0.5
        return np.asarray(interpolated(u, first, second, middle))

    @cached_property
    def _sizes(self) -> dict[str, float]:
        """Size of each unknown, of which a difference is a part."""
        model = self._model
        sizes = {x.name: abs(x.parameter.value or 0.0) or 0.01 for x in model.unknowns}
        return dict.fromkeys((*model.state, *model.parameters), 1.0) | sizes

    # ------------------------------------------------------------------ MuJoCo's models

    def _models(self, parameters: FloatArray, step: float) -> list[Any]:
        """MuJoCo's model of each lane; lanes with the same parameters have one."""
        model = self._model
        acting = [k for k, x in enumerate(model.unknowns) if x.places]
        different, lane = np.unique(parameters[:, acting], axis=0, return_inverse=True)
        while len(self._copies) < len(different):
            self._copies.append(copy.copy(model.compiled))
        for one, values in zip(self._copies, different, strict=False):
            one.opt.timestep = step
            for k, value in zip(acting, values.tolist(), strict=True):
                write(one, model.unknowns[k].places, value)
            if acting:
                model.complete(one, _scratch(model))
        return [self._copies[k] for k in np.ravel(lane)]


class _Pool:
    """MuJoCo's threads, with data for each."""

    def __init__(self, threads: int) -> None:
        from mujoco.rollout import Rollout

        self._threads, self._rollout = threads, Rollout(nthread=threads if threads > 1 else 0)
        self._data: tuple[tuple[int, ...], list[Any]] | None = None

    def run(
        self, models: list[Any], begin: FloatArray, control: FloatArray, spec: int
    ) -> tuple[FloatArray, FloatArray]:
        """States after every step, and readings before it."""
        one, module = models[0], mujoco_module()
        sizes = (one.nq, one.nv, one.na, one.nu, one.nsensordata, one.nbody, one.ngeom, one.narena)
        if self._data is None or self._data[0] != sizes:
            self._data = sizes, [module.MjData(one) for _ in range(max(1, self._threads))]
        n, n_steps = control.shape[:2]
        state, sensordata = np.empty((n, n_steps, begin.shape[1])), np.empty((n, n_steps, one.nsensordata))
        outputs = {"state": state, "sensordata": sensordata}
        with without_warnings():  # of states that diverge, which MuJoCo writes into a file
            self._rollout.rollout(models, self._data[1], begin, control, control_spec=spec, nstep=n_steps, **outputs)
        return state, sensordata


@lru_cache(maxsize=4)
def _pool(threads: int) -> _Pool:
    """Threads that stay: to start them takes as long as a hundred steps."""
    return _Pool(threads if threads > 1 else default_threads())


@lru_cache(maxsize=8)
def _scratch(model: MujocoModel) -> Any:
    return mujoco_module().MjData(model.compiled)


def _parts(n: int, size: int) -> Iterator[slice]:
    """Slices of at most so many of n."""
    return (slice(k, min(k + size, n)) for k in range(0, n, size))
