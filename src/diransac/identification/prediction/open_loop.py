"""Open-loop prediction of one log: windows with an estimated initial state each, and their errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, interpolated, runs, size_or_one
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.data.segment import Segment
from diransac.errors import LogError
from diransac.identification.core.noise import lower_scale
from diransac.identification.diagnosis import Resolution
from diransac.identification.evaluation.simulation import Simulation
from diransac.identification.methods.lo_diransac.segments import OUTLYING
from diransac.identification.prediction.starts import SmoothedLog, StartEstimator, followed_log, smoothed_log
from diransac.identification.regression.multistart import least_squares
from diransac.model import Model

StartRule = Literal["smoothed", "measured"]

_MOST_ROWS = 200_000
"""Rows of a stretch that windows of a horizon predict, about; of longer ones every other window is enough."""


@dataclass(frozen=True, eq=False, repr=False)
class PredictedWindows:
    """Windows of n samples, and predictions of them that need no model.

    Parameters
    ----------
    rows : (K,) int array
        First row of each window, which is not scored.
    states : (K, n_x) array
        Initial states.
    deviations : (K, n_x, n_x) array
        Independent errors of each initial state, of one standard deviation, a row each.
    measured : (K, n, n_s) array
        Samples; NaN where there is none.
    regular : (K, n, n_s) bool array
        Samples that are no outliers.
    trivial : (2, K, n, n_s) array
        Errors of the predictions that signals stay as they are, and that coordinates go on at their velocity.
    """

    rows: IntArray
    states: FloatArray
    deviations: FloatArray
    measured: FloatArray
    regular: BoolArray
    trivial: FloatArray


class Sums(NamedTuple):
    """Windows, diverged ones, and sums over their samples by signal, ``(n_s,)``; see `OpenLoop.sums`.

    The first three arrays are of all samples: number, squared errors, squares about the mean in each log.  The others
    are of those without outliers: number, squares of the errors of the prediction and of the trivial ones, of the
    effects of uncertain starts and of changed parameters, and of the noise.
    """

    windows: int
    diverged: int
    known: FloatArray
    squared: FloatArray
    spread: FloatArray
    regular: FloatArray
    robust: FloatArray
    held: FloatArray
    uniform: FloatArray
    of_starts: FloatArray
    of_parameters: FloatArray
    of_noise: FloatArray


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
        self.smoothed: SmoothedLog | None = None
        if start == "smoothed" and alone.model.has_equations:
            self.smoothed = smoothed_log(alone)
        elif start == "smoothed":
            self.smoothed = followed_log(alone, self.parameters, resolution)
        if self.smoothed is not None and noise:
            most = np.array([noise.get(name, np.inf) for name in self.segment.signals])
            self.smoothed = replace(self.smoothed, noise=np.fmin(self.smoothed.noise, most))
        self.states = _states(self.segment, layout, self.parameters, self.smoothed)
        n_s, found = self.segment.measured.shape[1], self.smoothed
        self.outliers: BoolArray = np.zeros(self.segment.measured.shape, bool) if found is None else found.outliers
        self.noise = np.zeros(n_s) if found is None else found.noise
        self._estimator = None
        if found is not None and found.intervals is not None:
            filled = interpolated(self.states)
            self._estimator = StartEstimator.of(found, self.segment, self.parameters, resolution, filled)
        n_before = 0 if self._estimator is None else self._estimator.n_before
        self._complete: BoolArray = np.asarray(np.isfinite(self.states).all(axis=1))
        begins = [slice(x.start + n_before, x.stop) for x in runs(~self.segment.gaps)]
        parts = [x for x in begins if self._complete[x.start : x.stop - 1].any()]
        self.stretches = [slice(x.start + int(np.argmax(self._complete[x])), x.stop) for x in parts]
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
        n = estimator.n_before
        ends = np.concatenate([np.append(np.arange(x.start, x.stop, n), x.stop) for x in self.stretches])
        smooth = self._of_whole_quaternions(self.outliers)
        # Scales depend on starts, and these on scales: after three rounds they hardly change.  The first are those of
        # simulations from the smoothed motion, so that a signal of which the model is wrong does not pull the starts.
        for k in range(3):
            errors, scale, noise = self._short_errors(estimator, ends, fitted=k > 0)
            near = np.zeros(smooth.shape, bool)
            np.logical_or.at(near, ends[:, None] + np.arange(-n, 0), np.abs(errors) <= OUTLYING * scale)
            self.outliers = smooth & ~near
            self.noise = np.fmin(self.smoothed.noise, noise)
            estimator = estimator.refined(self.noise, scale, self.outliers)
        rows, tried = ends[ends + n < len(self.segment)], estimator.shorter()
        for x in tried[1:]:  # of which the model lacks less
            self.noise = np.fmin(self.noise, self._short_errors(x, ends, fitted=True)[2])
        tried = [x.refined(self.noise, scale, self.outliers) for x in tried]
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
        n, errors = estimator.n_before, estimator.errors(ends, fitted=fitted)
        outliers = self.outliers[ends[:, None] + np.arange(-n, 0)]
        known, scale = _known_scale(np.where(outliers, np.nan, errors))
        # A short simulation fits two numbers to the samples of a signal.
        samples = known.mean(axis=(0, 1)) * n
        freedom = np.where(samples > 4.0, 1.0 - 2.0 / np.maximum(samples, 4.0), np.nan)
        return errors, scale, scale / np.sqrt(freedom)

    def _misses(self, estimator: StartEstimator, rows: IntArray, steps: int) -> float:
        """Sum over the signals of the logarithms of robust errors of short predictions from some rows."""
        found = self._simulated_errors(self.parameters, estimator.at(rows)[0], rows, steps)
        measured = self.segment.measured[rows[:, None] + np.arange(1, steps + 1)]
        _, scale = _known_scale(np.where(np.isfinite(measured), found, np.nan))
        return float(np.log(scale[np.isfinite(scale) & (scale > 0.0)]).sum())

    # ------------------------------------------------------------------ windows

    @property
    def duration(self) -> float:
        """From the first complete state to the end, or to a gap, the longest, s."""
        return self.steps(np.inf) * self.segment.log.dt

    def steps(self, horizon: float) -> int:
        """Samples of a horizon; 0 where no stretch of the log is longer than that."""
        return max(self._steps(x, horizon) for x in self.stretches)

    def _steps(self, rows: slice, horizon: float) -> int:
        longest = int(rows.stop - rows.start) - 1
        if np.isinf(horizon):
            return longest
        return round(horizon / self.segment.log.dt) if horizon < longest * self.segment.log.dt else 0

    def starts(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Initial states ``(K, n_x)`` of windows from some rows, and their standard deviations ``(K, n_x, n_x)``."""
        if self._estimator is not None:
            return self._estimator.at(rows)
        found = self.states[rows]
        return found, np.zeros((*found.shape, found.shape[1]))

    def windows(self, horizon: float) -> Iterator[PredictedWindows]:
        """Windows of one horizon, one after another, from complete states; those of each stretch that has some."""
        for stretch in self.stretches:
            steps = self._steps(stretch, horizon)
            rows = np.arange(stretch.start, stretch.stop - steps, steps) if steps else np.arange(0)
            rows = rows[self._complete[rows]]
            rows = rows[:: max(1, -(-len(rows) * steps // _MOST_ROWS))]
            if len(rows):
                after = rows[:, None] + np.arange(1, steps + 1)
                measured, (states, deviations) = self.segment.measured[after], self.starts(rows)
                regular = np.isfinite(measured) & ~self.outliers[after]
                trivial = self._trivial(states, rows, steps) - measured
                yield PredictedWindows(rows, states, deviations, measured, regular, trivial)

    def errors(self, windows: PredictedWindows, parameters: FloatArray | None = None) -> FloatArray:
        """Predicted less measured signals ``(K, n, n_s)``, of the loop's parameters or of others ``(n_p,)``."""
        p = self.parameters if parameters is None else parameters
        return self._simulated_errors(p, windows.states, windows.rows, windows.measured.shape[1])

    def _simulated_errors(self, parameters: FloatArray, states: FloatArray, rows: IntArray, steps: int) -> FloatArray:
        return self.simulation.errors(0, parameters, states, rows, steps + 1)[:, 1:]

    def _trivial(self, states: FloatArray, rows: IntArray, steps: int) -> FloatArray:
        """Signals ``(2, K, steps, n_s)`` that stay as they are, and those of uniform motion."""
        model, names = self.segment.model, self.segment.signals
        columns = [model.signals.index(n) for n in names]
        start = self.segment.measured[rows] if self.smoothed is None else self.smoothed.signals[rows][:, columns]
        rates, velocity = np.zeros(start.shape), _coordinate_rates(model, states)
        for i, name in enumerate(names):
            if name in model.state:
                start[:, i] = states[:, model.state.index(name)]
            if name in model.coordinates:
                rates[:, i] = velocity[:, list(model.coordinates).index(name)]
        later = self.segment.log.dt * np.arange(1, steps + 1)[:, None]
        held: FloatArray = np.broadcast_to(start[:, None], (len(rows), steps, len(names)))
        return np.array([held, held + later * rates[:, None]])

    # ------------------------------------------------------------------ scores

    def sums(self, horizon: float) -> Sums:
        """Sums over the windows of one horizon in all stretches between gaps."""
        n_s = self.segment.measured.shape[1]
        numbers, total, measured = np.zeros(2, int), np.zeros((9, n_s)), [np.empty((0, n_s))]
        for x in self.windows(horizon):
            errors, known = self.errors(x), np.isfinite(x.measured)
            numbers += len(x.rows), int((~np.isfinite(errors) & known).any(axis=(1, 2)).sum())
            regular = x.regular.sum(axis=(0, 1))
            robust = (errors, *x.trivial, *self._effects(x, errors))
            total += np.array(
                [
                    known.sum(axis=(0, 1)),
                    _squares(errors, known),
                    regular,
                    *(_squares(y, x.regular) for y in robust),
                    regular * np.square(self.noise),
                ]
            )
            measured.append(x.measured.reshape(-1, n_s))
        n_known, squared, *others = total
        spread = _squares_about_mean(np.concatenate(measured))
        return Sums(int(numbers[0]), int(numbers[1]), n_known, squared, spread, *others)

    def _effects(self, windows: PredictedWindows, errors: FloatArray) -> FloatArray:
        """Root mean square effects ``(2, K, n, n_s)`` of uncertain starts, and of parameters changed by 1 %."""
        n_x = windows.states.shape[1]
        signs = np.random.default_rng(0).choice([-1.0, 1.0], (4, n_x + len(self.parameters)))
        effects = np.zeros((2, *errors.shape))
        for sign in signs:
            with np.errstate(over="ignore", invalid="ignore"):
                if windows.deviations.any():
                    shifted = windows.states + np.einsum("j,kji->ki", sign[:n_x], windows.deviations)
                    effects[0] += np.square(self.errors(replace(windows, states=shifted)) - errors)
                effects[1] += np.square(self.errors(windows, self.parameters * (1.0 + 0.01 * sign[n_x:])) - errors)
        return np.sqrt(effects / len(signs))

    def change(self, horizon: float, parameters: FloatArray, delay: float = 0.0) -> float:
        """Largest RMS change of a moving state's prediction by other parameters ``(n_p,)`` and a further delay, s.

        It is relative to the excess of the better trivial prediction, as `HorizonScores.relative_error`; 0 below the
        noise.
        """
        total, other = np.zeros((4, self.segment.measured.shape[1])), copy(self)
        timing = self.resolution.timing
        later = replace(self.resolution, timing=replace(timing, delay=timing.delay + delay))
        other.simulation = Simulation(self._alone, resolution=later) if delay else self.simulation
        for x in self.windows(horizon):
            squares = (other.errors(x, parameters) - self.errors(x), *x.trivial)
            total += np.array([*(_squares(y, x.regular) for y in squares), x.regular.sum(axis=(0, 1))])
        is_state = np.array([x in self.segment.model.state for x in self.segment.signals])
        with np.errstate(divide="ignore", invalid="ignore"):
            moved, held, uniform = total[:3] / total[3]
        noise = np.square(self.noise)
        seen = is_state & (moved > noise)
        return float(np.nan_to_num(np.sqrt(moved / excess(held, uniform, noise)))[seen].max(initial=0.0))

    # ------------------------------------------------------------------ simulations

    def simulated(self, horizon: float) -> tuple[IntArray, FloatArray]:
        """All signals of the model ``(N, n_signals)``, NaN in gaps, and the first rows ``(K,)`` of the simulations.

        They begin at the start of every stretch between gaps, and again after every horizon, s; infinite: never.
        """
        segment = self.segment
        n_rows = len(segment) if np.isinf(horizon) else max(1, round(horizon / segment.log.dt))
        parts = [(x, np.arange(x.start, x.stop, n_rows)) for x in runs(~segment.gaps)]
        rows = np.concatenate([begins for _, begins in parts])
        sizes = np.concatenate([np.diff(np.append(begins, x.stop)) for x, begins in parts])
        states = interpolated(self.states)[rows]
        if self._estimator is not None:
            firsts = np.repeat([x.start for x, _ in parts], [len(begins) for _, begins in parts])
            lengths = np.repeat([x.stop - x.start for x, _ in parts], [len(begins) for _, begins in parts])
            long = lengths >= self._estimator.n_before
            states[long] = self._estimator.drawn(rows[long], firsts[long])
        series = np.full((len(segment), len(segment.model.signals)), np.nan)
        for size in np.unique(sizes).tolist():
            begins = rows[sizes == size]
            found = self.simulation.trajectories(0, self.parameters, states[sizes == size], begins, size)
            series[begins[:, None] + np.arange(size)] = found
        return rows, series


def excess(held: FloatArray, uniform: FloatArray, noise: FloatArray) -> FloatArray:
    """Mean square errors ``(n_s,)`` of the better trivial prediction beyond the noise; NaN of signals that do not move.

    A signal moves if these are five standard deviations of the noise; arguments are mean squares.
    """
    trivial = np.fmin(held, uniform)
    return np.where((trivial > 5.0**2 * noise) & (trivial > 0.0), trivial - noise, np.nan)


def _known_scale(errors: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Errors ``(K, n, n_s)`` that are finite, and their robust scale ``(n_s,)``, infinite where too few are."""
    known: BoolArray = np.isfinite(errors)
    flat = np.where(known, errors, 0.0).reshape(-1, errors.shape[2])
    return known, np.nan_to_num(lower_scale(flat, known.reshape(flat.shape)), nan=np.inf)


def _squares(errors: FloatArray, counted: BoolArray) -> FloatArray:
    """Sum of squares ``(n_s,)``; infinite with an error that is not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        squares = np.where(np.isfinite(errors), np.square(errors), np.inf)
    return np.asarray(np.where(counted, squares, 0.0).sum(axis=(0, 1)))


def _squares_about_mean(measured: FloatArray) -> FloatArray:
    """Sum of squares ``(n_s,)`` about the mean of the samples that are there."""
    present = np.isfinite(measured)
    mean = np.where(present, measured, 0.0).sum(axis=0) / np.maximum(present.sum(axis=0), 1)
    return np.asarray(np.where(present, np.square(measured - mean), 0.0).sum(axis=0))


def _coordinate_rates(model: Model, states: FloatArray) -> FloatArray:
    """Derivatives ``(K, n_q)`` of the coordinates."""
    q, v = states[:, : model.n_q], states[:, model.n_q :]
    return v[:, : model.n_q] if model.kinematics is None else np.array(model.kinematics(q.T, v.T)).T


# ---------------------------------------------------------------------- states of a log


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
    seen = [n for n in matter if n in (*segment.present, *derived)]
    hidden = tuple(n for n in matter if n not in seen and (smoothed is not None or n in model.first_order))
    given = dict.fromkeys((*hidden, *derived), 0.0)
    states = np.tile(segment.initial_state(given or "first"), (len(segment), 1))
    if smoothed is None:
        signals = segment.with_signals(model.signals).measured
    else:
        signals = np.where(segment.gaps[:, None], np.nan, smoothed.signals)
    states[:, [model.state.index(n) for n in seen]] = signals[:, [model.signals.index(n) for n in seen]]
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
    compared = np.column_stack([states[:, observed], segment.with_signals(tuple(model.sensors)).measured])
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
