"""Logs cut into windows of equal length, each a rollout of its own: the lanes of multiple shooting.

The model is augmented by what it may lack, all of them parameters of an ordinary model, so that compiled rollouts and
their derivatives need no change:

- Unmodelled accelerations, one for each of the model's: ``a = f(q, v, u, p) + d``.  Or, where the noise of inputs
  explains a log, errors of these: ``a = f(q, v, u + e, p)``.
- Input gain and bias discrepancies: in every equation a constant force, and one in proportion to each input.  An
  actuator with another gain or direction than in the model deviates by the same amount throughout the motion;
  unmodelled accelerations, free in every window, would attribute that to the parameters.

Sensors measure the motion as it is, unmodelled accelerations included.

References
----------
Kennedy, O'Hagan 2001 (models with a discrepancy); Tremolet 2006 (weak-constraint 4D-Var).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Literal

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data.input_timing import acting_inputs
from diransac.identification.core.theta import EffectKind, Effects
from diransac.model import Model, Parameter
from diransac.simulation import Measurements, RolloutBatch, rollouts

if TYPE_CHECKING:
    from collections.abc import Iterable

    from diransac.data.dataset import ParameterLayout
    from diransac.model import Model
    from diransac.model.derivation import Symbols
    from diransac.simulation import GaussNewtonBatch, Simulator

SHORTEST_LAG = 0.5
"""Time constant, samples, from which on an actuator's lag shows."""
DIVERGED = 1e50
"""Error after a divergence, and state from which on squares of its derivatives overflow, whatever their units."""
_DIVERGED = 1e6
_WELL_CONDITIONED = 1e8
# Rows times squared unknowns from which on derivatives take longer than threads take to be told (a few milliseconds).
_WORTH_THREADS = 4e6


@dataclass(frozen=True, eq=False, repr=False)
class Windows:
    """Rows of all logs as intervals of ``length`` rows; made by `of`, which pads the last interval of each log.

    Parameters
    ----------
    model : Model
        Equations with the parameters to be estimated.
    layout : ParameterLayout
        Positions of each log's parameters.
    measured : (N, n_s) array
        Every signal of the model, in its order and its unit.
    sampled : (N, n_s) bool array
        Samples that are measured; False in padded rows.
    recorded : (N, n_u) array
        Recorded inputs, each in its unit; `inputs` are those that act.
    is_logged : (N,) bool array
        Rows of the logs, as opposed to padded ones.
    gaps : (N,) bool array
        Rows of gaps: no simulation passes through them.
    log_of : (W,) int array
        Log of each interval.
    dt : float
        Sampling time, s.
    length : int
        Number of rows of an interval.
    substeps : int
        Integration steps from row to row.
    hold : str, optional
        Inputs from row to row, one of `HOLDS`.  Only the state after the last row of a log, which nothing
        uses, depends on the inputs of the next log.
    errors : Effects, optional
        Errors of which ``measured`` is corrected, and with which the inputs act.
    threads : int, optional
        Threads of the simulations with derivatives.
    discrepancies : bool, optional
        Whether the model is augmented by input gain and bias discrepancies.
    noisy : bool, optional
        Whether the unknowns of an interval are errors of the inputs instead of unmodelled accelerations.
    apart : bool, optional
        Whether intervals are tied by nothing but the parameters: neither by continuity nor by unmodelled accelerations,
        of which there are none (simulation error).
    """

    model: Model
    layout: ParameterLayout
    measured: FloatArray
    sampled: BoolArray
    recorded: FloatArray
    is_logged: BoolArray
    gaps: BoolArray
    log_of: IntArray
    dt: float
    length: int
    substeps: int
    hold: str = "zero-order"
    errors: Effects | None = None
    threads: int = 1
    discrepancies: bool = True
    noisy: bool = False
    apart: bool = False

    @classmethod
    def of(
        cls,
        model: Model,
        layout: ParameterLayout,
        logs: Sequence[tuple[FloatArray, BoolArray, FloatArray, BoolArray]],
        dt: float,
        length: int,
        substeps: int,
        hold: str = "zero-order",
    ) -> Windows:
        """Intervals of logs of any length.

        Parameters
        ----------
        model : Model
        layout : ParameterLayout
        logs : sequence of ((N, n_s) array, (N, n_s) bool array, (N, n_u) array, (N,) bool array)
            Measured signals, known samples, inputs, and rows of gaps of each log.
        dt : float
            Sampling time, s.
        length : int
            Number of rows of an interval.
        substeps : int
            Integration steps from row to row.
        hold : str, optional
            Inputs from row to row, one of `HOLDS`.

        Returns
        -------
        Windows
        """
        sizes = [len(log[2]) for log in logs]
        missing = [-n % length for n in sizes]
        measured = _joined([_filled_up(log[0], more) for log, more in zip(logs, missing, strict=True)])
        recorded = _joined([_filled_up(log[2], more) for log, more in zip(logs, missing, strict=True)])
        sampled = np.concatenate([np.pad(log[1], ((0, n), (0, 0))) for log, n in zip(logs, missing, strict=True)])
        gaps = np.concatenate([np.pad(log[3], (0, n)) for log, n in zip(logs, missing, strict=True)])
        is_logged = np.concatenate([np.arange(n + more) < n for n, more in zip(sizes, missing, strict=True)])
        log_of = np.repeat(np.arange(len(logs)), [-(-n // length) for n in sizes])
        return cls(model, layout, measured, sampled, recorded, is_logged, gaps, log_of, dt, length, substeps, hold)

    def __len__(self) -> int:
        return len(self.log_of)

    @cached_property
    def starts(self) -> IntArray:
        """First row of each interval."""
        return np.arange(len(self), dtype=np.int64) * self.length

    @cached_property
    def linked(self) -> BoolArray:
        """Mask ``(W - 1,)`` of the intervals that continue in the next one, of the same log and without a gap."""
        reached = self._reached.reshape(len(self), self.length)[:-1, -1] & ~self.gaps[self.starts[1:]]
        return np.asarray((self.log_of[1:] == self.log_of[:-1]) & reached & (not self.apart))

    @cached_property
    def following(self) -> BoolArray:
        """Mask ``(W,)`` of the intervals that continue the one before."""
        return np.concatenate([[False], self.linked])

    @cached_property
    def _reached(self) -> BoolArray:
        """Rows ``(N,)`` that a simulation reaches from its interval's start without passing through a gap."""
        clear = ~self.gaps.reshape(len(self), self.length)
        return np.logical_and.accumulate(clear, axis=1).ravel()

    @cached_property
    def known(self) -> BoolArray:
        """Samples ``(N, n_s)`` that are measured, and reached by a simulation."""
        return self.sampled if self._reached.all() else self.sampled & self._reached[:, None]

    @cached_property
    def counted(self) -> BoolArray:
        """Rows ``(N,)`` of the logs that a simulation reaches."""
        return self.is_logged & self._reached

    @cached_property
    def first_of_log(self) -> IntArray:
        """First row of each log."""
        return self.starts[np.searchsorted(self.log_of, np.arange(self.layout.n_logs))]

    @cached_property
    def log_of_row(self) -> IntArray:
        """Log of each row ``(N,)``."""
        if self.layout.n_logs == 1:
            return np.broadcast_to(self.log_of[:1], len(self.is_logged))
        return np.repeat(self.log_of, self.length)

    @cached_property
    def occupied(self) -> BoolArray:
        """Mask ``(W,)`` of the intervals with a row that counts; others begin in a gap, or after the end of a log."""
        return np.asarray(self.counted[self.starts])

    def rows_of(self, chosen: IntArray) -> IntArray:
        """Rows ``(n * length,)`` of chosen intervals, one interval after the other."""
        return (self.starts[chosen][:, None] + np.arange(self.length)).ravel()

    @property
    def duration(self) -> float:
        """Duration of an interval, s."""
        return self.length * self.dt

    @cached_property
    def augmented(self) -> AugmentedModel:
        """The model with its discrepancies."""
        if self.apart:
            return AugmentedModel(self.model, self.model.n_p, 0, 0)
        return augmented_model(self.model, discrepancies=self.discrepancies, noisy=self.noisy)

    @property
    def n_p(self) -> int:
        """Number of parameters, per-log ones of every log included."""
        return len(self.layout)

    @property
    def n_shared(self) -> int:
        """Number of unknowns that intervals share: parameters and discrepancies."""
        return self.n_p + self.augmented.n_discrepancies

    @cached_property
    def rollouts(self) -> Simulator:
        """Simulator of the augmented model."""
        return rollouts(self.augmented.model, substeps=self.substeps, hold=self.hold)

    @cached_property
    def inputs(self) -> FloatArray:
        """Inputs ``(N, n_u)`` as they act, after their delays and lags."""
        if self.apart:
            return self.recorded
        errors = self.all_errors
        timing = errors.input_delay, errors.input_lag, errors.gain_drift
        n_rows = [int(self.is_logged[rows].sum()) for rows in self.rows_of_logs]
        logs = zip(self.rows_of_logs, n_rows, strict=True)
        return _joined([acting_inputs(self.recorded[rows], *timing, self.hold, n) for rows, n in logs])

    @cached_property
    def later_inputs(self) -> FloatArray:
        """Change ``(N, n_u)`` of the acting inputs per sample of delay."""
        return np.concatenate([_differences(-self.inputs[rows]) for rows in self.rows_of_logs])

    def all_inputs(self, what: Literal["delay", "bias", "lag", "drift"]) -> EffectKind:
        """An error that all inputs that move have in common."""
        return EffectKind(tuple(np.flatnonzero(np.ptp(self.recorded, axis=0) > 0.0).tolist()), what, of_inputs=True)

    @cached_property
    def rows_of_logs(self) -> list[slice]:
        """Rows of each log, padded ones included."""
        edges = [*self.first_of_log.tolist(), len(self.recorded)]
        return [slice(a, b) for a, b in pairwise(edges)]

    @property
    def all_errors(self) -> Effects:
        """Errors of the recordings, none of which may be known."""
        if self.errors is not None:
            return self.errors
        return Effects(self.measured, self.sampled, self.recorded.shape[1])

    def corrected(self, more: Mapping[EffectKind, float], rates: FloatArray) -> Windows:
        """The intervals with recordings that are corrected of further errors.

        Parameters
        ----------
        more : mapping from EffectKind to float
            By how much larger they are.
        rates : (N, n_s) array
            Change of each signal per sample, for the fractions of a sample.

        Returns
        -------
        Windows
        """
        errors = self.all_errors.plus(more)
        whole, measured, sampled = np.round(errors.delay), errors.measured, errors.sampled
        if whole.any():
            rows = self._rows_later(whole)
            measured = np.take_along_axis(measured, rows, axis=0)
            sampled = np.take_along_axis(sampled, rows, axis=0) & (rows >= 0)
        measured = measured + (errors.delay - whole) * rates - errors.bias
        return replace(self, measured=np.where(sampled, measured, 0.0), sampled=sampled, errors=errors)

    def weights_in(self, other: Windows, weights: FloatArray) -> FloatArray:
        """Weights ``(N, n_s)`` of the samples in the rows that they have in other intervals, with other delays."""
        later = np.round(other.all_errors.delay) - np.round(self.all_errors.delay)
        if not later.any():
            return weights
        rows = self._rows_later(later)
        return np.where((rows >= 0) & other.known, np.take_along_axis(weights, rows, axis=0), 0.0)

    def _rows_later(self, whole: FloatArray) -> IntArray:
        """Row ``(N, n_s)`` of the same log by a number of samples later, for each signal; -1 where there is none."""
        own, last = self.log_of_row[:, None], len(self.recorded) - 1
        later = np.arange(last + 1)[:, None] + whole.astype(int)
        at = np.clip(later, 0, last)
        return np.where((at == later) & (self.log_of_row[at] == own), at, -1)

    def with_input_error(self, kind: EffectKind, size: float) -> Windows:
        """The intervals with another error of an input, and measurements as they are.

        Parameters
        ----------
        kind : EffectKind
        size : float

        Returns
        -------
        Windows
        """
        return replace(self, errors=self.all_errors.plus({kind: size}))

    def with_errors(self, kinds: Iterable[EffectKind]) -> Windows:
        """The intervals with further errors of the recordings, none of a size yet; lags, which have a sign, of one."""
        begin = {kind: SHORTEST_LAG if kind.what == "lag" else 0.0 for kind in kinds}
        return replace(self, errors=self.all_errors.plus(begin))

    def without_error(self, kind: EffectKind) -> Windows:
        """The intervals without an error of an input."""
        errors = self.all_errors
        return replace(self, errors=replace(errors, sizes={x: size for x, size in errors.sizes.items() if x != kind}))

    def parts_apart(self, acting: FloatArray, hold: str, starts: IntArray, length: int) -> Windows:
        """Parts of the logs as intervals that nothing ties.

        Parameters
        ----------
        acting : (N, n_u) array
            Inputs as they act.
        hold : str
            Of these, one of `HOLDS`.
        starts : (K,) int array
            First row of each part.
        length : int
            Its rows.
        """
        rows = (starts[:, None] + np.arange(length)).ravel()
        return replace(
            self, measured=self.measured[rows], sampled=self.sampled[rows], recorded=acting[rows], errors=None,
            is_logged=np.ones(len(rows), bool), gaps=np.zeros(len(rows), bool), log_of=self.log_of_row[starts],
            length=length, hold=hold, apart=True, discrepancies=False, noisy=False,
        )  # fmt: skip

    def split(self, parts: int) -> Windows:
        """The same rows in intervals of a fraction of the length."""
        return replace(self, length=self.length // parts, log_of=np.repeat(self.log_of, parts))

    def of_log(self, log: int, layout: ParameterLayout) -> Windows:
        """The intervals of one of the logs, whose parameters are those of a layout of one log."""
        chosen, errors = self.log_of == log, self.all_errors
        rows = self.rows_of_logs[log]
        names = ("measured", "sampled", "recorded", "is_logged", "gaps")
        errors = replace(errors, measured=errors.measured[rows], sampled=errors.sampled[rows])
        parts = {n: getattr(self, n)[rows] for n in names}
        return replace(self, layout=layout, log_of=np.zeros(chosen.sum(), int), errors=errors, **parts)

    def parameters_of(self, values: FloatArray, logs: IntArray) -> FloatArray:
        """Model parameters ``(n, n_p)`` of the logs ``(n,)`` from a vector; the vector itself if all are shared."""
        return values if self.layout.is_shared else values[self.layout.index[logs]]

    def batch(self, shared: FloatArray, x: FloatArray, d: FloatArray, chosen: IntArray | None = None) -> RolloutBatch:
        """Lanes of all or chosen intervals.

        Parameters
        ----------
        shared : (n_shared,) array
            Parameters and discrepancies.
        x : (W, n_x) array
            States at the intervals' starts.
        d : (W, n_v) array
            Unmodelled accelerations.
        chosen : (n,) int array, optional
            Indices of intervals; None: all.

        Returns
        -------
        RolloutBatch
        """
        logs, starts, rows = self.log_of, self.starts, self._rows_about(chosen)
        if chosen is not None:
            logs, starts, x, d = logs[chosen], starts[chosen], x[chosen], d[chosen]
        n_p, last = self.model.n_p, self.model.n_p + len(shared) - self.n_p
        parameters = np.empty((len(x), last + d.shape[1]))
        parameters[:, :n_p] = self.parameters_of(shared[: self.n_p], logs)
        parameters[:, n_p:last], parameters[:, last:] = shared[self.n_p :], d
        first = (starts if self.apart else self.first_of_log) - rows.start
        return RolloutBatch(parameters, x, self.inputs[rows], self.dt, starts - rows.start, self.length, first)

    def _rows_about(self, chosen: IntArray | None) -> slice:
        """Rows from the first to the last of chosen intervals, and the two about them on which inputs depend."""
        if chosen is None:
            return slice(0, len(self.measured))
        first, last = int(chosen.min()) * self.length, (int(chosen.max()) + 1) * self.length
        return slice(max(first - 2, 0), last + 2)

    def measurements(self, rows: slice = slice(None), columns: IntArray | slice = slice(None)) -> Measurements:
        """Measured signals; all rows count, and unknown samples have no weight."""
        values = self.measured[rows, columns]
        return Measurements(values, np.ones(len(values), bool))

    def simulated(
        self, shared: FloatArray, x: FloatArray, d: FloatArray, chosen: IntArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Residuals and ends of all or chosen intervals; arguments as `batch`.

        Parameters
        ----------
        shared, x, d : array
        chosen : (n,) int array, optional

        Returns
        -------
        (n * length, n_s) array
            Simulated less measured signals, huge from a divergence on.
        (n, n_x) array
            States one row after the last of each interval, NaN where it diverges.
        """
        rows = self._rows_about(chosen)
        errors, ends = self.rollouts.errors_and_ends(self.batch(shared, x, d, chosen), self.measurements(rows))
        if not np.isfinite(errors).all():
            np.nan_to_num(errors, copy=False, nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED)
        return errors.reshape(-1, errors.shape[2]), ends

    def gauss_newton(
        self,
        shared: FloatArray,
        x: FloatArray,
        d: FloatArray,
        weights: FloatArray,
        *,
        directions: Sequence[FloatArray] = (),
        chosen: IntArray | None = None,
        normal_matrix: bool = True,
    ) -> GaussNewtonBatch:
        """Least-squares sums of all or chosen intervals; other arguments as `batch`.

        Unknowns are in the order of x, d and the shared ones.  Derivatives of signals that nothing measures are left
        out, which are most of them in many logs.

        Parameters
        ----------
        shared, x, d : array
        weights : (N, n_s) array
            Of the measurements, one over each signal's unit squared.
        directions : sequence of (N, n_s) array, optional
            Changes of the residuals, of which sums are wanted, too.
        chosen : (n,) int array, optional
        normal_matrix : bool, optional
            Whether it is needed.

        Returns
        -------
        GaussNewtonBatch
        """
        (derived, columns), rows = self._derived, self._rows_about(chosen)
        batch, unknowns = self.batch(shared, x, d, chosen), self.augmented.unknowns
        threads = self.threads if batch.n_log * len(unknowns) ** 2 > _WORTH_THREADS else 1
        return derived.gauss_newton(
            batch,
            self.measurements(rows, columns),
            weights[rows, columns],
            unknowns=unknowns,
            normal_matrix=normal_matrix,
            directions=np.stack([x[rows, columns] for x in directions], axis=1) if directions else None,
            threads=threads,
        )

    @cached_property
    def _derived(self) -> tuple[Simulator, IntArray | slice]:
        """Simulator of the signals that the logs have, quaternions as a whole, and their columns."""
        signals, seen = self.augmented.model.signals, np.array(self.sampled.any(axis=0))
        for four in self.model.quaternions:
            seen[list(four)] = seen[list(four)].any()
        names = [name for name, has in zip(signals, seen, strict=True) if has]
        simulator = rollouts(self.augmented.model, names, substeps=self.substeps, hold=self.hold)
        return simulator, slice(None) if seen.all() else np.flatnonzero(seen)

    def origins(self, shared: FloatArray, x: FloatArray, d: FloatArray, chosen: IntArray) -> FloatArray:
        """Initial states (n, n_x) for which chosen intervals end in their successors' initial states.

        One Newton step; states are unchanged where it has no solution.
        """
        nothing = np.broadcast_to(0.0, self.measured.shape)
        sums = self.gauss_newton(shared, x, d, nothing, chosen=chosen, normal_matrix=False)
        jumps, slopes = x[chosen + 1] - sums.final_states, sums.final_slopes[:, :, : x.shape[1]]
        finite = np.isfinite(jumps).all(axis=1) & np.isfinite(slopes).all(axis=(1, 2))
        usable = np.flatnonzero(finite)
        usable = usable[np.linalg.cond(slopes[usable]) < _WELL_CONDITIONED]
        found = x[chosen]
        found[usable] += np.linalg.solve(slopes[usable], jumps[usable][:, :, None])[:, :, 0]
        return found


def _joined(logs: Sequence[FloatArray]) -> FloatArray:
    """Rows of all logs; a single one is not copied."""
    return np.concatenate(logs) if len(logs) > 1 else logs[0]


def _differences(values: FloatArray) -> FloatArray:
    """Central differences from row to row; 0 of a single row."""
    return np.gradient(values, axis=0) if len(values) > 1 else np.zeros_like(values)


def _filled_up(values: FloatArray, more: int) -> FloatArray:
    """The rows, padded by repetitions of the last one."""
    return np.pad(values, ((0, more), (0, 0)), mode="edge") if more else values


@dataclass(frozen=True)
class AugmentedModel:
    """The augmented form of a model.

    Parameters
    ----------
    model : Model
        Model whose parameters are the original ones; the discrepancies, equation by equation the bias and one gain per
        input; the unmodelled accelerations.
    n_p, n_latent : int
        Number of parameters of the original model, and of unmodelled accelerations or errors of inputs.
    n_discrepancies : int
        Number of input gain and bias discrepancies.
    """

    model: Model
    n_p: int
    n_latent: int
    n_discrepancies: int

    @property
    def unknowns(self) -> tuple[str, ...]:
        """The unknowns of an interval: its state, accelerations or errors, and those that intervals share."""
        names = tuple(self.model.parameters)
        last = len(names) - self.n_latent
        return (*self.model.state, *names[last:], *names[:last])


_MOST_GAINS = 24


@lru_cache(maxsize=16)
def augmented_model(model: Model, *, discrepancies: bool = True, noisy: bool = False) -> AugmentedModel:
    """The model with unmodelled accelerations, and input gain and bias discrepancies.

    Parameters
    ----------
    model : Model
    discrepancies : bool, optional
        Whether it has input gain and bias discrepancies.
    noisy : bool, optional
        Whether it has errors of the inputs instead of unmodelled accelerations.

    Returns
    -------
    AugmentedModel
    """
    derived, own = model.kinematics is None, model.rate_names
    latent = [f"error_{n}" for n in model.inputs] if noisy else [f"unmodelled_{n}" for n in own]
    pairs = discrepant_pairs(model) if discrepancies else ()
    gains = [f"discrepancy_{i}_{k}" for i, k in pairs]

    def arguments(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[ca.SX]:
        motion = [_stacked(q, model.coordinates), _stacked(v, own), _stacked(a, own)]
        applied = _stacked(u, model.inputs) + (_stacked(p, latent) if noisy else 0.0)
        return [*motion, applied, _stacked(p, model.parameters)]

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        coordinates, velocities, accelerations, applied, parameters = arguments(q, v, a, u, p)
        modelled = accelerations - (0.0 if noisy else _stacked(p, latent))
        residuals = model.residual(coordinates, velocities, modelled, applied, parameters)
        if discrepancies:
            sizes = ca.SX(model.n_v, model.n_u + 1)
            for n, x in zip(gains, pairs, strict=True):
                sizes[x] = getattr(p, n)
            residuals -= sizes @ ca.vertcat(1, applied)
        return list(ca.vertsplit(residuals))

    def kinematics(q: Symbols, v: Symbols) -> list[object]:
        assert model.kinematics is not None
        return list(ca.vertsplit(model.kinematics(_stacked(q, model.coordinates), _stacked(v, own))))

    augmented = Model(
        f"{model.name}, augmented",
        model.coordinates,
        model.inputs,
        {**model.parameters, **{n: Parameter("") for n in (*gains, *latent)}},
        equations,
        velocities=None if derived else model.velocities_of_motion,
        kinematics=None if derived else kinematics,
        first_order=model.first_order,
        sensors=model.sensors_of(arguments),
    )
    return AugmentedModel(augmented, model.n_p, len(latent), len(gains))


@lru_cache(maxsize=16)
def discrepant_pairs(model: Model) -> tuple[tuple[int, int], ...]:
    """Equation and column of each discrepancy: its bias (column 0), and a gain of each input k (column k + 1).

    Of more than 30 gains, those of inputs that act in the equation alone: their number grows with the square of the
    number of joints, and so do the memory and the time of a fit.

    Parameters
    ----------
    model : Model
    """
    acts = np.array(ca.DM(model.residual.sparsity_jac(3, 0), 1)) != 0.0
    every = model.n_v * model.n_u <= _MOST_GAINS
    return tuple((i, k) for i in range(model.n_v) for k in range(model.n_u + 1) if k == 0 or every or acts[i, k - 1])


def _stacked(symbols: Symbols, names: Iterable[str]) -> ca.SX:
    return ca.SX(ca.vertcat(*(getattr(symbols, n) for n in names)))
