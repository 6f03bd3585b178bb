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
from diransac.identification.assessment.window_starts import SmoothedLog, WindowStarts
from diransac.identification.diagnosis import Resolution
from diransac.identification.evaluation.simulation import Simulation
from diransac.identification.regression.multistart import least_squares
from diransac.identification.regression.observers import driven_states
from diransac.model import Model

StartRule = Literal["smoothed", "measured"]


@dataclass(frozen=True)
class HorizonScores:
    """Open-loop prediction at one horizon, by signal.

    Robust scores leave out outliers: samples further than six standard deviations of the noise from the motion as it
    is smoothed without the model, so that no error of the model is one.

    Parameters
    ----------
    horizon : float
        Time after which the simulation restarts, s; infinite: never.
    windows : int
        Number of simulations that were scored.
    diverged : int
        Number of simulations that became infinite, which makes the scores infinite.
    rmse : mapping of str to float
        Root mean squared error of each signal, its unit.
    fit_percent : mapping of str to float
        ``100 (1 - |y - y_sim| / |y - mean(y)|)``.
    r_squared : mapping of str to float
        ``1 - sum (y - y_sim)^2 / sum (y - mean(y))^2``.
    robust_rmse, robust_fit_percent, robust_r_squared : mapping of str to float
        The same without outliers.
    hold_last : mapping of str to float
        RMSE, without outliers, of the prediction that nothing changes after the start of a window.
    constant_velocity : mapping of str to float
        RMSE, without outliers, of the prediction that every coordinate goes on at the velocity of the start.
    relative_error : mapping of str to float
        Of each state and sensor that moves: RMSE in excess of the noise and of the effect of uncertain starts, over the
        excess of the better of these two predictions.  0: perfect; 1: no better than a trivial prediction.
    sensitivity : mapping of str to float
        Of each state and sensor that moves: RMS effect on the prediction of 1 % changes of the parameters, of random
        signs, and of uncertain starts, over the same excess.
    of_starts : mapping of str to float
        The part of uncertain starts in it, an error up to which cannot be seen.
    """

    horizon: float
    windows: int
    diverged: int
    rmse: Mapping[str, float]
    fit_percent: Mapping[str, float]
    r_squared: Mapping[str, float]
    robust_rmse: Mapping[str, float]
    robust_fit_percent: Mapping[str, float]
    robust_r_squared: Mapping[str, float]
    hold_last: Mapping[str, float]
    constant_velocity: Mapping[str, float]
    relative_error: Mapping[str, float]
    sensitivity: Mapping[str, float]
    of_starts: Mapping[str, float]

    @property
    def name(self) -> str:
        """The horizon in words."""
        return "whole log" if np.isinf(self.horizon) else f"{self.horizon:g} s"


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
    ) -> None:
        layout = ParameterLayout(dataset.model.parameters)
        alone = replace(dataset, segments=(dataset.segments[log],), given=(dataset.given[log],), layout=layout)
        self.segment: Segment = alone.segments[0]
        self.simulation = Simulation(alone, resolution=resolution)
        self.parameters = dataset.model.parameter_vector(parameters)
        self.smoothed = _smoothed(alone, self.parameters, resolution) if start == "smoothed" else None
        self.states = _states(self.segment, layout, self.parameters, self.smoothed)
        n_s = self.segment.measured.shape[1]
        found = self.smoothed
        self.outliers: BoolArray = np.zeros(self.segment.measured.shape, bool) if found is None else found.outliers
        complete: BoolArray = np.asarray(np.isfinite(self.states).all(axis=1))
        parts = [x for x in runs(~self.segment.gaps) if complete[x.start : x.stop - 1].any()]
        self.stretches = [slice(x.start + int(np.argmax(complete[x])), x.stop) for x in parts]
        self._complete = complete
        if not parts:
            needed = ", ".join(dataset.model.states_behind(self.segment.present))
            raise LogError(f"{self.segment.log.source}: no row has a complete state ({needed}) to start from")
        self.noise = self._noise() if found is not None else np.zeros(n_s)

    def _noise(self) -> FloatArray:
        """Noise ``(n_s,)``: the lesser of the samples' deviations from the smoothed motion, and from short simulations.

        The one holds errors of the smoothed motion besides noise, the other those of the model, less what the fit of
        their starts takes of few samples.
        """
        assert self.smoothed is not None
        if not self.segment.model.has_equations:
            return self.smoothed.noise
        stretch = max(self.stretches, key=lambda x: x.stop - x.start)
        # Forty short simulations are enough.
        every = max(1, (stretch.stop - stretch.start) // 40)
        rows = np.arange(stretch.start, stretch.stop, every)
        samples = self.smoothed.samples
        # A short simulation fits two numbers to the samples of a signal.
        freedom = np.where(samples > 4.0, 1.0 - 2.0 / np.maximum(samples, 4.0), np.nan)
        return np.fmin(self.smoothed.noise, self._estimated(stretch, rows).residual / np.sqrt(freedom))

    def _estimated(self, stretch: slice, rows: IntArray) -> WindowStarts:
        """Estimated initial states of windows from some rows of a stretch."""
        from diransac.identification.assessment.window_starts import window_starts  # which needs all of lo-diransac

        assert self.smoothed is not None
        filled, measured = self.filled_states(), self.segment.measured
        return window_starts(self.simulation, self.parameters, filled, self.smoothed, measured, stretch, rows)

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

    def starts(self, stretch: slice, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Initial states ``(K, n_x)`` of windows from some rows, and their standard deviations ``(K, n_x, n_x)``."""
        if self.smoothed is None or not self.segment.model.has_equations:
            found = self.states[rows]
            return found, np.zeros((*found.shape, found.shape[1]))
        one = self._estimated(stretch, rows)
        return one.states, one.deviations

    def filled_states(self) -> FloatArray:
        """States ``(N, n_x)`` at all rows, interpolated where there is none."""
        return interpolated(self.states)

    def window_rows(self, steps: int) -> list[tuple[slice, IntArray]]:
        """First rows of windows of so many samples, one after another, and of the rest, in each stretch."""
        found = []
        for part in self.stretches:
            rows = np.arange(part.start, part.stop, steps)
            found.append((part, rows[self._complete[rows]]))
        return found

    def sums(self, horizon: float) -> _Sums:
        """Sums over the windows of one horizon in all stretches between gaps."""
        found = [self._sums(rows, self._steps(rows, horizon)) for rows in self.stretches]
        return _Sums.over([x for x in found if x is not None], self.segment.measured.shape[1])

    def _sums(self, rows: slice, steps: int) -> _Sums | None:
        """Sums over windows, one after another, from complete states; None without any."""
        begins = np.arange(rows.start, rows.stop - steps, steps) if steps else np.arange(0)
        begins = begins[self._complete[begins]]
        if not len(begins):
            return None
        states, deviations = self.starts(rows, begins)
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
        # A signal moves if trivial predictions err by ten standard deviations of its noise.
        moves = judged & (trivial > 10.0**2 * noise) & (trivial > 0.0)
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
    # These need all of lo-diransac.
    from diransac.identification.assessment.window_starts import followed_log, smoothed_log

    return smoothed_log(alone) if alone.model.has_equations else followed_log(alone, parameters, resolution)


def _states(
    segment: Segment, layout: ParameterLayout, parameters: FloatArray, smoothed: SmoothedLog | None
) -> FloatArray:
    """The state ``(N, n_x)`` at every row, NaN where it is incomplete; 0 where nothing measured depends on it.

    Smoothed states take the place of measured ones, and of velocities that the log lacks.  States of first order that
    it lacks are simulated, driven by the others.

    Raises LogError: the log lacks another state on which a measured signal depends.
    """
    model, matter = segment.model, segment.model.states_behind(segment.present)
    if smoothed is not None and not model.has_equations:
        return smoothed.signals[:, : len(model.state)]
    hidden = tuple(n for n in model.first_order if n in matter and n not in segment.present)
    derived = () if smoothed is None else derived_velocities(segment, matter)
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
    problem = driven_states(
        model, alone, hidden, known, segment.inputs, readings, weights, whole, segment.log.dt, bandwidth, parameters
    )
    found = problem.trajectories(least_squares(problem, problem.starts(), 20)[0][0])
    return np.column_stack([found[n] for n in hidden])
