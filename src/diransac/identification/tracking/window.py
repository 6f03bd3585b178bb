"""The sliding window: the joint fit of the last intervals, given what those before them have told."""

from __future__ import annotations

from collections import deque
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.equations import linearized
from diransac.identification.core.fit import weights_of, with_residuals
from diransac.identification.core.minimise import gauss_newton_step
from diransac.identification.core.noise import NoiseSums
from diransac.identification.core.scales import SHRINK, ProcessSums, negligible_jumps, process_sums, unbroken_jumps
from diransac.identification.methods.lo_diransac.unmeasured import measured_velocities
from diransac.identification.tracking.fits import free_motion, gain_of_freedom, is_surprised, left_by, part

if TYPE_CHECKING:
    from diransac.identification.core.arrowhead import Factored
    from diransac.identification.core.equations import JointEquations
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.minimise import Step
    from diransac.identification.core.windows import Windows
    from diransac.identification.tracking.starting import Setup
    from diransac.identification.tracking.stream import Stream

AS_LIKELY = 5.0
"""Evidence, nats, by which a richer fit must be likelier; as in `local_search`."""
MEMORY = 60.0
"""Time over which noise, forces, drifts and the scatter of tests are remembered, s."""


@dataclass(frozen=True)
class _Memory:
    """Sums over intervals that have left the window, which fade.

    Parameters
    ----------
    noise : NoiseSums
    process : ProcessSums
    sizes : (n_v,) array
        Squared sizes of the unmodelled accelerations.
    count : float
        Number of intervals.
    freedom : float
        Evidence, nats, that unmodelled accelerations gain.
    """

    noise: NoiseSums
    process: ProcessSums
    sizes: FloatArray
    count: float
    freedom: float

    @classmethod
    def empty(cls, fit: Fit) -> _Memory:
        """Sums over no interval."""
        none = np.zeros_like(fit.noise.sigma)
        return cls(NoiseSums(none, none, none), ProcessSums.none(len(fit.tau)), np.zeros_like(fit.tau), 0.0, 0.0)

    def extended(self, faded: float, new: _Memory) -> _Memory:
        """Sums with those over further intervals."""
        return _Memory(
            new.noise.plus(self.noise, faded),
            new.process.plus(self.process, faded),
            new.sizes + faded * self.sizes,
            new.count + faded * self.count,
            new.freedom + faded * self.freedom,
        )


class Window:
    """Fit of the intervals of a window; changes as it moves on.

    Parameters
    ----------
    setup : Setup
    fit : Fit
        Of its intervals.
    stream : Stream
        Holds the rows of the window.
    first : int
        First row of the window.
    spread : (n_signals,) array
        Of the signals, as in `Motion`.
    most : int
        Number of intervals of the window once it is full.
    """

    def __init__(self, setup: Setup, fit: Fit, stream: Stream, first: int, spread: FloatArray, most: int) -> None:
        self.most = most
        self.setup, self.stream, self.first, self.fit, self._spread = setup, stream, first, fit, spread
        self.beginning = fit.boundary
        self._n_hopeless = 0
        self._measured = np.zeros(fit.d.shape[1], bool)
        n = len(fit.x)
        self.length = stream.length // stream.parts
        self.times = stream.time(first) + self.length * stream.dt * np.arange(n)
        self.memory = _Memory.empty(fit)
        self._memories = deque([self.memory], maxlen=most)
        self._found, self._gained = np.square(fit.tau), np.inf
        # Noise, forces, and parameters of a model that is not exact are remembered over a minute after the window: of a
        # sensor at 1 Hz it still gives the noise to 10 %.
        self.kept = float(np.exp(-self.length * stream.dt / MEMORY))
        self.last: Step | None = None

    def __len__(self) -> int:
        return len(self.fit.x)

    @property
    def end(self) -> int:
        """Row after the last one of the window."""
        return self.first + len(self) * self.length

    @property
    def spread(self) -> FloatArray:
        """Spread ``(n_v,)`` of the accelerations, the largest so far."""
        n_x, n_v = self.fit.x.shape[1], self.fit.d.shape[1]
        return self._spread[n_x : n_x + n_v]

    @property
    def least(self) -> FloatArray:
        """Unmodelled accelerations ``(n_v,)`` of an exact model: as those of `refine_exact`."""
        return 1e-6 * self.spread

    @property
    def expected(self) -> FloatArray:
        """Unmodelled accelerations ``(n_v,)`` of any model of a real machine."""
        return self.setup.settings.prior_model_error * self.spread

    @property
    def largest(self) -> FloatArray:
        """Unmodelled accelerations ``(n_v,)`` at most: those of a motion that follows its samples.

        Of velocities that nothing measures, such as the speeds of rotors, they are no larger than expected.  The
        smaller an inertia, the smaller are those of the rotors that explain a gust: the joint density of motion and
        parameters, which the fit maximises, would grow as inertias sink.
        """
        return np.where(self._measured, self.spread, self.expected)

    def intervals(self, first: int = 0, end: int | None = None) -> Windows:
        """The intervals, or some of them, with their rows as they are now."""
        n = (len(self) if end is None else end) - first
        return self.setup.intervals(self.stream, self.first + first * self.length, n)

    # ------------------------------------------------------------------ moving on

    def extend(self, n: int, states: FloatArray | None = None) -> None:
        """Add intervals that continue the last one, or those of a new stretch, which begin with states ``(n, n_x)``."""
        if states is not None:
            self._append(states, np.zeros((n, self.fit.d.shape[1])))
            return
        for _ in range(n):
            self._append(self.fit.ends[-1:], self.fit.rho * self.fit.d[-1:])

    def _append(self, x: FloatArray, d: FloatArray) -> None:
        """The fit with more intervals, whose residuals are simulated."""
        n, now = len(x), self.fit
        self.times = np.append(self.times, self.stream.time(self.end) + self.length * self.stream.dt * np.arange(n))
        self.fit = fit = replace(now, x=np.vstack([now.x, x]), d=np.vstack([now.d, d]))
        residuals, ends = self.intervals().simulated(fit.shared, fit.x, fit.d, np.arange(len(fit.x) - n, len(fit.x)))
        self.fit = replace(fit, residuals=np.vstack([fit.residuals, residuals]), ends=np.vstack([fit.ends, ends]))

    def leave(self, n: int) -> None:
        """Marginalise the first n intervals; their sums of noise and unmodelled accelerations are remembered."""
        assert self.last is not None
        rows, now = n * self.length, self.last.at
        boundary = left_by(self.intervals(0, n + 1), part(now.fit, 0, n + 1), now.of_fit.weights[: rows + self.length])
        self._remember(self.last, n)
        # Errors of a model do not average out as noise does.
        boundary = boundary if self.is_exact else boundary.faded(self.kept**n)
        self.fit = replace(part(self.fit, n), boundary=boundary)
        self.first, self.times = self.first + rows, self.times[n:]

    def diffuse(self, std: FloatArray) -> None:
        """Random changes of the parameters, of given standard deviations ``(n_p,)``, before the window."""
        if self.fit.boundary is not None and std.any():
            self.fit = replace(self.fit, boundary=self.fit.boundary.diffused(np.diag(std)[:, std > 0.0]))

    def frozen(self) -> Window:
        """The window as it is now, while this one moves on."""
        stream = replace(self.stream, values=self.stream.values.copy(), ended=self.stream.ended.copy())
        then = copy(self)
        then.stream = stream
        return then

    def first_of(self, then: Window) -> int:
        """Interval of the window as it was then with which this one begins."""
        return (self.first - then.first) // self.length

    def begin_with(self, then: Window, first: int, fit: Fit) -> None:
        """Begin the window with an interval of what it was then, from a fit of those that followed it.

        Parameters
        ----------
        then : Window
        first : int
            Not before the first interval of this window.
        fit : Fit
            Of these intervals; scales are those of this window.
        """
        whole, since = self.fit, first - self.first_of(then)
        later = slice(since + len(fit.x), None)
        scales = {name: getattr(whole, name) for name in ("tau", "rho", "continuity_std")}
        x, d = (np.vstack([getattr(fit, name), getattr(whole, name)[later]]) for name in ("x", "d"))
        self.first, self.times = self.first + since * self.length, self.times[since:]
        # Outliers and forces for which the change was taken until it was found are forgotten.
        self.memory = self._memories[-min(len(self.times) + 1, len(self._memories))]
        self.fit = replace(fit, x=x, d=d, **scales)
        self.fit = with_residuals(self.intervals(), self.fit)
        self.optimise()

    # ------------------------------------------------------------------ the fit

    def optimise(self) -> JointEquations:
        """Up to three steps of the fit and of its scales from the state of the window; the first equations."""
        intervals = self.intervals()
        self._measured |= measured_velocities(intervals)
        weights, damping = self._weights(intervals), 0.0
        steps: list[Step] = []
        while len(steps) < 3:
            step = gauss_newton_step(linearized(intervals, self.fit, weights), damping)
            damping, self.fit = step.damping, self._with_scales(intervals, step.fit, step.solved)
            steps.append(step)
            moved = np.abs(step.fit.shared - step.at.fit.shared)
            if (moved <= 0.1 * np.sqrt(np.diag(step.solved.var_p))).all():
                break
        self.last = steps[-1]
        self._gained = gain_of_freedom(self.last.at, self.least, self.expected, self.largest)
        self._follow_spread(intervals)
        self._n_hopeless = self._n_hopeless + 1 if self._explains_nothing(intervals) else 0
        return steps[0].at

    def _weights(self, intervals: Windows) -> FloatArray | None:
        """Weights of the samples where those of the fit are a surprise: in the last second, of a free motion."""
        recent = max(len(self) - 2, 0)
        if not is_surprised(self.intervals(recent), part(self.fit, recent)):
            return None
        first = max(len(self) - round(1.0 / (self.length * self.stream.dt)), 0)
        last, weights = self.intervals(first), weights_of(intervals, self.fit)
        weights[first * self.length :] = weights_of(last, free_motion(last, part(self.fit, first), self.largest))
        return weights

    @property
    def is_hopeless(self) -> bool:
        """True if the fit has explained nothing in as many steps as the window has intervals."""
        return self._n_hopeless >= self.most

    def _follow_spread(self, intervals: Windows) -> None:
        """Raise the spread of the signals to that of the fitted motion, with a delay of a window."""
        now = (self.fit.residuals + intervals.measured).std(axis=0)
        share = 1.0 / self.most
        self._spread = self._spread * np.clip(now / self._spread, 1.0, 1.0 / SHRINK) ** share

    def _explains_nothing(self, intervals: Windows) -> bool:
        """True if noise or unmodelled accelerations are as large as the signals themselves."""
        seen = intervals.known.any(axis=0)
        noise = self.fit.noise
        # As in `search`.
        nothing = ((noise.sigma > 0.8 * self._spread) | (noise.pi > 0.8))[seen].all()
        return bool(nothing or (self.fit.tau > self.spread)[self._measured].all())

    def _with_scales(self, intervals: Windows, fit: Fit, solved: Factored) -> Fit:
        """The fit with its scales, from the window and what is remembered."""
        inlying = fit.noise.inlying(fit.residuals, intervals.known)
        noise = fit.noise.of_sums(NoiseSums.of(fit.residuals, intervals.known, inlying).plus(self.memory.noise))
        process = process_sums(intervals, fit, solved).total()
        size = np.where(self._measured, process.likeliest_size(fit.tau), 0.0)
        self._found = np.square(size)
        tau = self.least if self.is_exact else np.maximum(size, self._usual_size())
        rho = np.zeros_like(tau) if self.is_exact else process.plus(self.memory.process).correlation(self.expected)
        continuity = np.maximum(negligible_jumps(intervals, tau), unbroken_jumps(fit, solved))
        return replace(fit, noise=noise, tau=tau, rho=rho, continuity_std=continuity)

    @property
    def is_exact(self) -> bool:
        """True unless unmodelled accelerations are likelier, in the window and in the last minute before it."""
        return self.memory.freedom + self._gained < AS_LIKELY

    def _usual_size(self) -> FloatArray:
        """Size ``(n_v,)`` of the unmodelled accelerations in the last minute before the window, or of any model."""
        return np.asarray(np.maximum(np.sqrt(self.memory.sizes / max(self.memory.count, 1.0)), self.expected))

    def _remember(self, step: Step, n: int) -> None:
        """Add the sums of the first n intervals to those that are remembered, which fade."""
        intervals, fit = step.at.intervals, step.at.fit
        rows = slice(n * self.length)
        residuals, known = fit.residuals[rows], intervals.known[rows]
        noise = NoiseSums.of(residuals, known, fit.noise.inlying(residuals, known))
        process = process_sums(intervals, fit, step.solved).part(slice(1, n + 1)).total()
        # Forces that a start has taken for its errors are no evidence: it counts once all intervals are others.
        gained = n / len(intervals) * self._gained if len(self._memories) == self.most else 0.0
        self.memory = self.memory.extended(self.kept**n, _Memory(noise, process, n * self._found, n, gained))
        self._memories.append(self.memory)

    # ------------------------------------------------------------------ what it tells

    def outliers(self, signals: list[tuple[str, int]]) -> dict[str, float]:
        """Fraction of the samples of some signals, by name and column, that are outliers."""
        assert self.last is not None
        known = self.last.at.intervals.known
        inlying = self.fit.noise.inlying(self.fit.residuals, known).sum(axis=0)
        return {name: float(1.0 - inlying[k] / known[:, k].sum()) for name, k in signals}

    def last_state(self) -> dict[str, float]:
        """Most probable state in the last row."""
        assert self.last is not None
        intervals, fit, last = self.last.at.intervals, self.fit, np.array([len(self) - 1])
        series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d, last))
        state = self.setup.model.state
        return dict(zip(state, series[0, -1, : len(state)].tolist(), strict=True))
