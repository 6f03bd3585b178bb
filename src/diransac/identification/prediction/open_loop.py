"""Scores of open-loop prediction over windows of one length, beside those of trivial predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, interpolated, runs, size_or_one
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.data.segment import Segment
from diransac.errors import LogError
from diransac.identification.core.noise import lower_scale
from diransac.identification.diagnosis import Resolution
from diransac.identification.estimate import HorizonScores
from diransac.identification.evaluation.simulation import Simulation
from diransac.identification.methods.lo_diransac.segments import OUTLYING
from diransac.identification.prediction.starts import SmoothedLog, StartEstimator, followed_log, smoothed_log
from diransac.identification.regression.multistart import least_squares
from diransac.model import Model

StartRule = Literal["smoothed", "measured"]

_ROUNDS = 3
_MOST_ROWS = 200_000
"""Rows of a stretch that windows of a horizon predict, about; of longer ones every other window is enough."""


@dataclass(frozen=True)
class _Sums:
    """Windows, diverged ones; sums of squares and counts ``(n_s,)``; samples ``(n, n_s)``, and those of outliers.

    ``squared`` and ``count`` are of all samples, the other sums of those without outliers: errors of the prediction,
    of the two trivial ones, effects of uncertain starts and of changed parameters, and the noise.
    """

    windows: int
    diverged: int
    squared: FloatArray
    count: FloatArray
    robust_squared: FloatArray
    robust_count: FloatArray
    held: FloatArray
    uniform: FloatArray
    of_starts: FloatArray
    of_parameters: FloatArray
    of_noise: FloatArray
    measured: FloatArray
    outliers: BoolArray

    @classmethod
    def over(cls, parts: Sequence[_Sums], n_s: int) -> _Sums:
        """The sums over the windows of all parts; of none, zeros."""
        samples = {"measured": np.empty((0, n_s)), "outliers": np.empty((0, n_s), bool)}
        totals: dict[str, Any] = {}
        for name in (x.name for x in fields(cls)):
            values = [getattr(x, name) for x in parts]
            if name in samples:
                totals[name] = np.concatenate([samples[name], *values])
            else:
                totals[name] = sum(values, 0 if name in ("windows", "diverged") else np.zeros(n_s))
        return cls(**totals)


class OpenLoop:
    """Predictions of one log: states at its rows, and simulations that restart from them.

    Parameters
    ----------
    dataset : Dataset
    log : int
        Index of the log.
    parameters : mapping of str to float
        Those of this log.
    resolution : Resolution
    start : {"smoothed", "measured"}
        Rule of the initial states.
    noise : mapping of str to float, optional
        Noise of signals by an identification, which separates it from what the model lacks: upper bounds.

    Raises
    ------
    LogError
        No row has a complete state to start from.
    """

    def __init__(
        self,
        dataset: Dataset,
        log: int,
        parameters: Mapping[str, float],
        resolution: Resolution,
        start: StartRule = "smoothed",
        noise: Mapping[str, float] | None = None,
    ) -> None:
        layout = ParameterLayout(dataset.model.parameters)
        alone = replace(dataset, segments=(dataset.segments[log],), given=(dataset.given[log],), layout=layout)
        self._alone, self.resolution = alone, resolution
        self.segment: Segment = alone.segments[0]
        self.simulation = Simulation(alone, resolution=resolution)
        self.parameters = dataset.model.parameter_vector(parameters)
        self.smoothed = _smoothed(alone, self.parameters, resolution) if start == "smoothed" else None
        if self.smoothed is not None and noise:
            most = np.array([noise.get(name, np.inf) for name in self.segment.signals])
            self.smoothed = replace(self.smoothed, noise=np.fmin(self.smoothed.noise, most))
        self.states = _states(self.segment, layout, self.parameters, self.smoothed)
        n_s, found = self.segment.measured.shape[1], self.smoothed
        self.outliers: BoolArray = np.zeros(self.segment.measured.shape, bool) if found is None else found.outliers
        self.noise = np.zeros(n_s) if found is None else found.noise
        self._estimator = None
        if found is not None and found.intervals is not None:
            filled = self.filled_states()
            self._estimator = StartEstimator.of(found, self.segment, self.parameters, resolution, filled)
        n_before = 0 if self._estimator is None else self._estimator.n_before
        complete: BoolArray = np.asarray(np.isfinite(self.states).all(axis=1))
        begins = [slice(x.start + n_before, x.stop) for x in runs(~self.segment.gaps)]
        parts = [x for x in begins if complete[x.start : x.stop - 1].any()]
        self.stretches = [slice(x.start + int(np.argmax(complete[x])), x.stop) for x in parts]
        self._complete = complete
        if not parts:
            needed = ", ".join(dataset.model.states_behind(self.segment.present))
            raise LogError(f"{self.segment.log.source}: no row has a complete state ({needed}) to start from")
        if self._estimator is not None:
            self._estimator = self._refined(self._estimator)

    def _refined(self, estimator: StartEstimator) -> StartEstimator:
        """Noise and outliers by short simulations that follow the samples, too; starts that predict best.

        The smoothed motion has errors besides noise, simulations those of the model, less what the fit of their starts
        takes of few samples: noise is the lesser, and an outlier far from both.  Starts from few samples have their
        noise, those from many what the model lacks: those are used from which the rows after them are predicted best.
        """
        assert self.smoothed is not None
        n, columns = estimator.n_before, [self.segment.model.signals.index(x) for x in self.segment.signals]
        ends = np.concatenate([np.append(np.arange(x.start, x.stop, n), x.stop) for x in self.stretches])
        smooth = self._of_whole_quaternions(self.outliers)
        # Scales depend on starts, and these on scales: after three rounds they hardly change.
        for k in range(_ROUNDS):
            errors, scale, noise = self._short_errors(estimator, ends, fitted=k > 0)
            near = np.zeros(smooth.shape, bool)
            np.logical_or.at(near, ends[:, None] + np.arange(-n, 0), np.abs(errors) <= OUTLYING * scale)
            self.outliers = smooth & ~near
            self.noise = np.fmin(self.smoothed.noise, noise)
            estimator = estimator.refined(columns, self.noise, scale, self.outliers)
        rows, tried = ends[ends + n < len(self.segment)], estimator.shorter()
        for x in tried[1:]:  # of which the model lacks less
            self.noise = np.fmin(self.noise, self._short_errors(x, ends, fitted=True)[2])
        tried = [x.refined(columns, self.noise, scale, self.outliers) for x in tried]
        return min(tried, key=lambda x: self._misses(x, rows, n)) if len(rows) and len(tried) > 1 else tried[0]

    def _of_whole_quaternions(self, outliers: BoolArray) -> BoolArray:
        """The mask with all components of a quaternion of which one is an outlier, which may turn the sign of all."""
        found, signals = outliers.copy(), self.segment.signals
        for four in self.segment.model.quaternions:
            own = [signals.index(n) for n in (self.segment.model.signals[k] for k in four) if n in signals]
            found[:, own] = outliers[:, own].any(axis=1, keepdims=True)
        return found

    def _short_errors(
        self, estimator: StartEstimator, ends: IntArray, *, fitted: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Errors ``(K, n, n_s)`` of simulations before some rows, their scale without outliers, and the noise in it."""
        columns, n = [self.segment.model.signals.index(x) for x in self.segment.signals], estimator.n_before
        errors = estimator.errors(ends, fitted=fitted)[:, :, columns]
        outliers = self.outliers[ends[:, None] + np.arange(-n, 0)]
        known, scale = _known_scale(np.where(outliers, np.nan, errors))
        # A short simulation fits two numbers to the samples of a signal.
        samples = known.mean(axis=(0, 1)) * n
        freedom = np.where(samples > 4.0, 1.0 - 2.0 / np.maximum(samples, 4.0), np.nan)
        return errors, scale, scale / np.sqrt(freedom)

    def _misses(self, estimator: StartEstimator, rows: IntArray, steps: int) -> float:
        """Sum over the signals of the logarithms of robust errors of short predictions from some rows."""
        found = self._errors(self.parameters, estimator.at(rows)[0], rows, steps)
        measured = self.segment.measured[rows[:, None] + np.arange(1, steps + 1)]
        _, scale = _known_scale(np.where(np.isfinite(measured), found, np.nan))
        return float(np.log(scale[np.isfinite(scale) & (scale > 0.0)]).sum())

    @property
    def duration(self) -> float:
        """From the first complete state to the end, or to a gap, the longest, s."""
        return max(self._steps(x, np.inf) for x in self.stretches) * self.segment.log.dt

    def _steps(self, rows: slice, horizon: float) -> int:
        """Samples of a horizon; 0 where the stretch is not longer than that."""
        longest = int(rows.stop - rows.start) - 1
        if np.isinf(horizon):
            return longest
        return round(horizon / self.segment.log.dt) if horizon < longest * self.segment.log.dt else 0

    def steps(self, horizon: float) -> int:
        """Samples of a horizon; 0 where no stretch of the log is longer than that."""
        return max(self._steps(x, horizon) for x in self.stretches)

    def starts(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Initial states ``(K, n_x)`` of windows from some rows, and their standard deviations ``(K, n_x, n_x)``."""
        if self._estimator is not None:
            return self._estimator.at(rows)
        found = self.states[rows]
        return found, np.zeros((*found.shape, found.shape[1]))

    def filled_states(self) -> FloatArray:
        """States ``(N, n_x)`` at all rows, interpolated where there is none."""
        return interpolated(self.states)

    def window_rows(self, steps: int) -> IntArray:
        """First rows of windows of so many samples, one after another, and of the rest, in each stretch."""
        rows: IntArray = np.concatenate([np.arange(x.start, x.stop, steps) for x in self.stretches])
        return rows[self._complete[rows]]

    def sums(self, horizon: float) -> _Sums:
        """Sums over the windows of one horizon in all stretches between gaps."""
        found = [self._sums(rows, self._steps(rows, horizon)) for rows in self.stretches]
        return _Sums.over([x for x in found if x is not None], self.segment.measured.shape[1])

    def _sums(self, rows: slice, steps: int) -> _Sums | None:
        """Sums over windows, one after another, from complete states; None without any."""
        begins = self._begins(rows, steps)
        if not len(begins):
            return None
        states, deviations = self.starts(begins)
        at = begins[:, None] + np.arange(1, steps + 1)
        measured, outliers = self.segment.measured[at], self.outliers[at]
        errors = self._errors(self.parameters, states, begins, steps)
        known = np.isfinite(measured)
        regular = known & ~outliers
        held, uniform = self._trivial(states, begins, steps)
        of_starts, of_parameters = self._effects(errors, states, deviations, begins)
        return _Sums(
            windows=len(begins),
            diverged=int((~np.isfinite(errors) & known).any(axis=(1, 2)).sum()),
            squared=_squares(errors, known),
            count=known.sum(axis=(0, 1)).astype(float),
            robust_squared=_squares(errors, regular),
            robust_count=regular.sum(axis=(0, 1)).astype(float),
            held=_squares(held - measured, regular),
            uniform=_squares(uniform - measured, regular),
            of_starts=_squares(of_starts, regular),
            of_parameters=_squares(of_parameters, regular),
            of_noise=regular.sum(axis=(0, 1)) * np.square(self.noise),
            measured=measured.reshape(-1, measured.shape[2]),
            outliers=outliers.reshape(-1, measured.shape[2]),
        )

    def _begins(self, rows: slice, steps: int) -> IntArray:
        """First rows of the windows of so many samples that are scored in a stretch."""
        begins = np.arange(rows.start, rows.stop - steps, steps) if steps else np.arange(0)
        begins = begins[self._complete[begins]]
        return begins[:: max(1, -(-len(begins) * steps // _MOST_ROWS))]

    def change(self, horizon: float, parameters: FloatArray, delay: float = 0.0) -> float:
        """Largest RMS change of a moving state's prediction by other parameters ``(n_p,)`` and a further delay, s.

        It is relative to the excess of the better trivial prediction, as `HorizonScores.relative_error`; 0 below the
        noise.
        """
        timing = self.resolution.timing
        later = replace(self.resolution, timing=replace(timing, delay=timing.delay + delay))
        simulation = Simulation(self._alone, resolution=later) if delay else self.simulation
        total, n = np.zeros((3, self.segment.measured.shape[1])), np.zeros(self.segment.measured.shape[1])
        for rows in self.stretches:
            steps = self._steps(rows, horizon)
            begins = self._begins(rows, steps)
            if not len(begins):
                continue
            states, at = self.starts(begins)[0], begins[:, None] + np.arange(1, steps + 1)
            measured, regular = self.segment.measured[at], np.isfinite(self.segment.measured[at]) & ~self.outliers[at]
            other = simulation.errors(0, parameters, states, begins, steps + 1)[:, 1:]
            moved = other - self._errors(self.parameters, states, begins, steps)
            trivial = [x - measured for x in self._trivial(states, begins, steps)]
            total += np.array([_squares(x, regular) for x in (moved, *trivial)])
            n += regular.sum(axis=(0, 1))
        with np.errstate(divide="ignore", invalid="ignore"):
            moved, held, uniform = total / n
        trivial, noise = np.fmin(held, uniform), np.square(self.noise)
        is_state = np.array([x in self.segment.model.state for x in self.segment.signals])
        seen = is_state & _moves(trivial, noise) & (moved > noise)
        return float(np.sqrt(moved[seen] / (trivial - noise)[seen]).max(initial=0.0))

    def _errors(self, parameters: FloatArray, states: FloatArray, rows: IntArray, steps: int) -> FloatArray:
        """Simulated less measured signals ``(K, steps, n_s)``, without the first row of each window."""
        return self.simulation.errors(0, parameters, states, rows, steps + 1)[:, 1:]

    def _trivial(self, states: FloatArray, rows: IntArray, steps: int) -> tuple[FloatArray, FloatArray]:
        """Signals ``(K, 1, n_s)`` that stay as they are, and ``(K, steps, n_s)`` of uniform motion."""
        model, names = self.segment.model, self.segment.signals
        columns = [model.signals.index(n) for n in names]
        start = self.segment.measured[rows] if self.smoothed is None else self.smoothed.signals[rows][:, columns]
        rates = np.zeros(start.shape)
        velocity = _coordinate_rates(model, states)
        for i, name in enumerate(names):
            if name in model.state:
                start[:, i] = states[:, model.state.index(name)]
            if name in model.coordinates:
                rates[:, i] = velocity[:, list(model.coordinates).index(name)]
        later = self.segment.log.dt * np.arange(1, steps + 1)[:, None]
        return start[:, None], start[:, None] + later * rates[:, None]

    def _effects(
        self, errors: FloatArray, states: FloatArray, deviations: FloatArray, rows: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Root mean square effects ``(K, steps, n_s)`` of uncertain starts, and of changed parameters."""
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (4, states.shape[1] + len(self.parameters)))
        of_starts, of_parameters = np.zeros(errors.shape), np.zeros(errors.shape)
        for sign in signs:
            shifted = states + np.einsum("j,kji->ki", sign[: states.shape[1]], deviations)
            changed = self.parameters * (1.0 + 0.01 * sign[states.shape[1] :])
            with np.errstate(over="ignore", invalid="ignore"):
                if deviations.any():
                    of_starts += np.square(self._errors(self.parameters, shifted, rows, errors.shape[1]) - errors)
                of_parameters += np.square(self._errors(changed, states, rows, errors.shape[1]) - errors)
        return np.sqrt(of_starts / len(signs)), np.sqrt(of_parameters / len(signs))


def _known_scale(errors: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Errors ``(K, n, n_s)`` that are finite, and their robust scale ``(n_s,)``, infinite where too few are."""
    known: BoolArray = np.isfinite(errors)
    flat = np.where(known, errors, 0.0).reshape(-1, errors.shape[2])
    return known, np.nan_to_num(lower_scale(flat, known.reshape(flat.shape)), nan=np.inf)


def _moves(trivial: FloatArray, noise: FloatArray) -> BoolArray:
    """Signals whose trivial predictions err by five standard deviations of the noise; arguments are mean squares."""
    return np.asarray((trivial > 5.0**2 * noise) & (trivial > 0.0))


def _squares(errors: FloatArray, counted: BoolArray) -> FloatArray:
    """Sum of squares ``(n_s,)``; infinite with an error that is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.where(np.isfinite(errors), np.square(errors), np.inf)
    return np.asarray(np.where(counted, squares, 0.0).sum(axis=(0, 1)))


def _coordinate_rates(model: Model, states: FloatArray) -> FloatArray:
    """Derivatives ``(K, n_q)`` of the coordinates."""
    q, v = states[:, : model.n_q], states[:, model.n_q :]
    return v[:, : model.n_q] if model.kinematics is None else np.array(model.kinematics(q.T, v.T)).T


# ---------------------------------------------------------------------- pooling


def pooled_scores(signals: Sequence[str], horizon: float, logs: Sequence[OpenLoop]) -> HorizonScores:
    """Scores of one horizon over all logs; the spread of a signal is about its mean in each log.

    Parameters
    ----------
    signals : sequence of str
        The n_s signals of the dataset.
    horizon : float
        s; infinite: the whole of each log.
    logs : sequence of OpenLoop
    """
    parts = [one.sums(horizon) for one in logs]
    total = _Sums.over(parts, len(signals))
    spread = sum((_squares_about_mean(x.measured) for x in parts), np.zeros(len(signals)))
    regular = sum(
        (_squares_about_mean(np.where(x.outliers, np.nan, x.measured)) for x in parts), np.zeros(len(signals))
    )
    model = logs[0].segment.model
    judged = np.array([n in model.state or n in model.sensors for n in signals])
    with np.errstate(divide="ignore", invalid="ignore"):
        count = total.robust_count
        ratio, robust_ratio = total.squared / spread, total.robust_squared / regular
        held, uniform, noise = total.held / count, total.uniform / count, total.of_noise / count
        trivial = np.fmin(held, uniform)
        moves = judged & _moves(trivial, noise)
        excess = trivial - noise
        known = (total.of_noise + total.of_starts) / count
        error = np.sqrt(np.maximum(total.robust_squared / count - known, 0.0) / excess)
        effect = np.sqrt((total.of_starts + total.of_parameters) / count / excess)
        of_starts = np.sqrt(total.of_starts / count / excess)
    columns = (
        np.sqrt(total.squared / np.maximum(total.count, 1)),
        100.0 * (1.0 - np.sqrt(ratio)),
        1.0 - ratio,
        np.sqrt(total.robust_squared / np.maximum(count, 1)),
        100.0 * (1.0 - np.sqrt(robust_ratio)),
        1.0 - robust_ratio,
        np.sqrt(held),
        np.sqrt(uniform),
    )
    by_name = [dict(zip(signals, x.tolist(), strict=True)) for x in columns]
    of_moving = [
        {
            n: float(np.nan_to_num(x, nan=np.inf, posinf=np.inf))
            for n, x, yes in zip(signals, values, moves, strict=True)
            if yes
        }
        for values in (error, effect, of_starts)
    ]
    return HorizonScores(horizon, total.windows, total.diverged, *by_name, *of_moving)


def _squares_about_mean(measured: FloatArray) -> FloatArray:
    """Sum of squares ``(n_s,)`` about the mean of the samples that are there."""
    present = np.isfinite(measured)
    mean = np.where(present, measured, 0.0).sum(axis=0) / np.maximum(present.sum(axis=0), 1)
    return np.asarray(np.where(present, np.square(measured - mean), 0.0).sum(axis=0))


# ---------------------------------------------------------------------- states of a log


def _smoothed(alone: Dataset, parameters: FloatArray, resolution: Resolution) -> SmoothedLog | None:
    """One log, smoothed without the model, or followed by one without equations; None where it is too short."""
    return smoothed_log(alone) if alone.model.has_equations else followed_log(alone, parameters, resolution)


def _states(
    segment: Segment, layout: ParameterLayout, parameters: FloatArray, smoothed: SmoothedLog | None
) -> FloatArray:
    """The state ``(N, n_x)`` at every row, NaN where it is incomplete; 0 where nothing measured depends on it.

    Smoothed states take the place of measured ones, and of velocities that the log lacks.  States that nothing measures
    are simulated, driven by the others.

    Raises LogError: the log lacks another state on which a measured signal depends.
    """
    model, matter = segment.model, segment.model.states_behind(segment.present)
    if smoothed is not None and not model.has_equations:
        return smoothed.signals[:, : len(model.state)]
    derived = () if smoothed is None else derived_velocities(segment, matter)
    lacking = [n for n in model.state if n in matter and n not in (*segment.present, *derived)]
    hidden = tuple(n for n in lacking if smoothed is not None or n in model.first_order)
    given = dict.fromkeys((*hidden, *derived), 0.0)
    states = np.tile(segment.initial_state(given or "first"), (len(segment), 1))
    for i, name in enumerate(model.state):
        if smoothed is not None and name in matter and (name in segment.present or name in derived):
            states[:, i] = smoothed.signals[:, model.signals.index(name)]
            states[segment.gaps, i] = np.nan
        elif name in segment.present and name in matter:
            states[:, i] = segment.column(name)
    if hidden:
        states[:, [model.state.index(n) for n in hidden]] = _unmeasured(segment, layout, parameters, states, hidden)
    return states


def derived_velocities(segment: Segment, matter: Sequence[str]) -> tuple[str, ...]:
    """Velocities among some states that the log lacks, and that follow from coordinates that it has."""
    model, present = segment.model, segment.present
    lacking = [n for n in model.velocities_of_motion if n in matter and n not in present]
    if model.kinematics is not None:
        return tuple(lacking) if set(model.coordinates) <= set(present) else ()
    return tuple(v for q, v, *_ in model.chains if v in lacking and q in model.coordinates and q in present)


def _unmeasured(
    segment: Segment, layout: ParameterLayout, parameters: FloatArray, states: FloatArray, hidden: tuple[str, ...]
) -> FloatArray:
    """States ``(N, n)`` that the log lacks, whose initial values agree best with the other velocities and sensors."""
    model, known = segment.model, interpolated(states)
    observed = [i for i, n in enumerate(model.state) if n in model.velocities and n not in hidden]
    absent = np.full(len(segment), np.nan)
    sensors = [segment.column(n) if n in segment.present else absent for n in model.sensors]
    compared = np.column_stack([states[:, observed], *sensors])
    seen = np.isfinite(compared)
    spread = np.array([x[ok].std() if ok.any() else 0.0 for x, ok in zip(compared.T, seen.T, strict=True)])
    weights = np.where(seen, 1.0 / np.square(size_or_one(spread)), 0.0)
    readings = np.nan_to_num(compared[:, len(observed) :])
    # The observers forget within a twentieth of the log.
    bandwidth = 1.0 / (0.05 * len(segment) * segment.log.dt)
    whole, alone = [slice(0, len(segment))], ParameterLayout(layout.parameters)
    from diransac.identification.regression.observers import driven_states  # for states that nothing measures alone

    problem = driven_states(
        model, alone, hidden, known, segment.inputs, readings, weights, whole, segment.log.dt, bandwidth, parameters
    )
    found = problem.trajectories(least_squares(problem, problem.starts(), 20)[0][0])
    return np.column_stack([found[n] for n in hidden])
