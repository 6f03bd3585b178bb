"""The sliding window: the joint fit of the last intervals, given what those before them have told."""

from __future__ import annotations

from collections import deque
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, size_or_one
from diransac.identification.methods.lo_diransac.boundary import BoundaryPrior
from diransac.identification.methods.lo_diransac.gauss_newton import gauss_newton_step
from diransac.identification.methods.lo_diransac.joint_equations import linearized
from diransac.identification.methods.lo_diransac.mixture import NoiseSums
from diransac.identification.methods.lo_diransac.normal_equations import innovation_std, innovations, with_residuals
from diransac.identification.methods.lo_diransac.scales import (
    SHRINK,
    ProcessSums,
    negligible_jumps,
    process_sums,
    unbroken_jumps,
)
from diransac.identification.methods.lo_diransac.unmeasured import measured_velocities
from diransac.identification.tracking.forces import gain_of_freedom
from diransac.identification.tracking.surprise import is_surprised, weights_of_free_motion

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.normal_equations import Fit, NormalEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals
    from diransac.identification.tracking.starting import Setup
    from diransac.identification.tracking.stream import Stream

# Steps at most with another interval.
_MOST_STEPS = 3
AS_LIKELY = 5.0
"""Evidence, nats, by which a richer fit must be likelier; as in `local_search`."""


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


@dataclass(frozen=True)
class Linearization:
    """Normal equations of a window, the fit that they are of, and their solution.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
    at : NormalEquations
    solved : Factored
    """

    intervals: ShootingIntervals
    fit: Fit
    at: NormalEquations
    solved: Factored


class Window:
    """Fit of the intervals of a window; changes as it moves on.

    Parameters
    ----------
    setup : Setup
    stream : Stream
        Holds the rows of the window.
    first : int
        First row of the window.
    fit : Fit
        Of its intervals.
    spread : (n_signals,) array
        Of the signals, as in `Motion`.
    most : int
        Number of intervals of the window once it is full.
    """

    def __init__(self, setup: Setup, stream: Stream, first: int, fit: Fit, spread: FloatArray, most: int) -> None:
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
        self.kept = float(np.exp(-self.length * stream.dt / 60.0))
        self.last: Linearization | None = None

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

    def intervals(self) -> ShootingIntervals:
        """The intervals with their rows as they are now."""
        return self.setup.intervals(self.stream, self.first, len(self))

    # ------------------------------------------------------------------ moving on

    def extend(self, n: int) -> None:
        """Add intervals that continue the last one."""
        for _ in range(n):
            fit = self.fit
            x, d = np.vstack([fit.x, fit.ends[-1:]]), np.vstack([fit.d, fit.rho * fit.d[-1:]])
            self._append(replace(fit, x=x, d=d), 1)

    def join(self, x: FloatArray) -> None:
        """Add intervals of a new stretch that begin with given states ``(n, n_x)``."""
        fit = self.fit
        d = np.zeros((len(x), fit.d.shape[1]))
        self._append(replace(fit, x=np.vstack([fit.x, x]), d=np.vstack([fit.d, d])), len(x))

    def _append(self, fit: Fit, n: int) -> None:
        """The fit with n more intervals, whose residuals are simulated."""
        self.times = np.append(self.times, self.stream.time(self.end) + self.length * self.stream.dt * np.arange(n))
        self.fit = fit
        residuals, ends = self.intervals().simulated(fit.shared, fit.x, fit.d, np.arange(len(fit.x) - n, len(fit.x)))
        self.fit = replace(fit, residuals=np.vstack([fit.residuals, residuals]), ends=np.vstack([fit.ends, ends]))

    def leave(self, n: int) -> None:
        """Marginalise the first n intervals; their sums of noise and unmodelled accelerations are remembered."""
        assert self.last is not None
        intervals, now, at = self.last.intervals, self.last.fit, self.last.at
        boundary = _marginal(at, intervals, now, n)
        rows = n * self.length
        self._remember(intervals, now, n)
        fit = self.fit
        kept = {name: getattr(fit, name)[n:] for name in ("x", "d", "ends")}
        self.fit = replace(fit, residuals=fit.residuals[rows:], boundary=boundary, **kept)
        if not self.is_exact:  # errors of a model do not average out as noise does
            self.fit = replace(self.fit, boundary=boundary.faded(self.kept**n))
        self.first, self.times = self.first + rows, self.times[n:]

    def diffuse(self, std: FloatArray) -> None:
        """Random changes of the parameters, of given standard deviations ``(n_p,)``, before the window."""
        changing = np.flatnonzero(std)
        if self.fit.boundary is not None and len(changing):
            root = np.zeros((len(std), len(changing)))
            root[changing, np.arange(len(changing))] = std[changing]
            self.fit = replace(self.fit, boundary=self.fit.boundary.diffused(root))

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

    def optimise(self) -> Linearization:
        """Steps of the fit and of its scales from the state of the window; the first linearisation."""
        intervals = self.intervals()
        self._measured |= measured_velocities(intervals)
        weights = weights_of_free_motion(self) if is_surprised(self) else None
        first: Linearization | None = None
        damping = 0.0
        for _ in range(_MOST_STEPS):
            at = linearized(intervals, self.fit, weights)
            before = self.fit
            taken = gauss_newton_step(at, damping)
            solved, damping = taken.solved, taken.damping
            self.last = Linearization(intervals, before, at.of_fit, solved)
            self.fit = self._with_scales(intervals, taken.fit, solved)
            first = first or self.last
            moved = np.abs(taken.fit.shared - before.shared)
            if (moved <= 0.1 * np.sqrt(np.diag(solved.var_p))).all():
                break
        assert first is not None
        assert self.last is not None
        self._gained = gain_of_freedom(self.last, self.least, self.expected, self.largest)
        self._follow_spread(intervals)
        self._n_hopeless = self._n_hopeless + 1 if self._explains_nothing(intervals) else 0
        return first

    @property
    def is_hopeless(self) -> bool:
        """True if the fit has explained nothing in as many steps as the window has intervals."""
        return self._n_hopeless >= self.most

    def _follow_spread(self, intervals: ShootingIntervals) -> None:
        """Raise the spread of the signals to that of the fitted motion, with a delay of a window."""
        now = (self.fit.residuals + intervals.measured).std(axis=0)
        share = 1.0 / self.most
        self._spread = self._spread * np.clip(now / self._spread, 1.0, 1.0 / SHRINK) ** share

    def _explains_nothing(self, intervals: ShootingIntervals) -> bool:
        """True if noise or unmodelled accelerations are as large as the signals themselves."""
        seen = intervals.known.any(axis=0)
        noise = self.fit.noise
        # As in `search`.
        nothing = ((noise.sigma > 0.8 * self._spread) | (noise.pi > 0.8))[seen].all()
        return bool(nothing or (self.fit.tau > self.spread)[self._measured].all())

    def _with_scales(self, intervals: ShootingIntervals, fit: Fit, solved: Factored) -> Fit:
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

    def _remember(self, intervals: ShootingIntervals, fit: Fit, n: int) -> None:
        """Add the sums of the first n intervals to those that are remembered, which fade."""
        assert self.last is not None
        rows = slice(n * self.length)
        residuals, known = fit.residuals[rows], intervals.known[rows]
        noise = NoiseSums.of(residuals, known, fit.noise.inlying(residuals, known))
        process = process_sums(intervals, fit, self.last.solved).part(slice(1, n + 1)).total()
        # Forces that a start has taken for its errors are no evidence: it counts once all intervals are others.
        gained = n / len(intervals) * self._gained if len(self._memories) == self.most else 0.0
        self.memory = self.memory.extended(self.kept**n, _Memory(noise, process, n * self._found, n, gained))
        self._memories.append(self.memory)

    # ------------------------------------------------------------------ what it tells

    def outliers(self, signals: list[tuple[str, int]]) -> dict[str, float]:
        """Fraction of the samples of some signals, by name and column, that are outliers."""
        assert self.last is not None
        known = self.last.intervals.known
        inlying = self.fit.noise.inlying(self.fit.residuals, known).sum(axis=0)
        return {name: float(1.0 - inlying[k] / known[:, k].sum()) for name, k in signals}

    def last_state(self) -> dict[str, float]:
        """Most probable state in the last row."""
        assert self.last is not None
        intervals, fit, last = self.last.intervals, self.fit, np.array([len(self) - 1])
        series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d, last))
        state = self.setup.model.state
        return dict(zip(state, series[0, -1, : len(state)].tolist(), strict=True))


# ---------------------------------------------------------------------- marginalisation


def _marginal(at: NormalEquations, intervals: ShootingIntervals, fit: Fit, n: int) -> BoundaryPrior:
    """Information of the first intervals of a fit, and its boundary, on the unknowns at the start of the next one.

    Parameters
    ----------
    at : NormalEquations
    intervals : ShootingIntervals
        All with the same parameters.
    fit : Fit
        Of these equations.
    n : int
        Number of intervals that are marginalised, fewer than there are.

    Returns
    -------
    BoundaryPrior
        At the start of interval ``n``, linearised at the fit.
    """
    own = 1.0 / innovation_std(intervals, fit)
    pull = -own * innovations(intervals, fit)
    information, right = _beforehand(fit, own[0], pull[0])
    k, n_x = at.right_z.shape[1], fit.x.shape[1]
    known, known_right = information, right  # of interval w in its block of the equations
    for w in range(n):
        P, F = at.precision[w], at.slopes[w]
        H, g = np.zeros((2 * k + len(right) - k,) * 2), np.zeros(2 * k + len(right) - k)
        z, then, s = slice(0, k), slice(k, 2 * k), slice(2 * k, None)
        H[z, z] = at.system.diagonal[w] + information[:k, :k] - known[:k, :k]
        H[z, s] = at.system.border[w] + information[:k, k:] - known[:k, k:]
        H[s, s] = at.corners[w] + information[k:, k:]
        H[then, z] = at.system.below[w]
        g[z], g[s] = at.right_z[w] + right[:k] - known_right[:k], at.rights[w] + right[k:]
        known, known_right = np.zeros_like(information), np.zeros_like(right)
        known[:n_x, :n_x], known[n_x:k, n_x:k] = np.diag(P), np.diag(np.square(own[w + 1]))
        known[:n_x, k:] = -P[:, None] * F[:, k:]
        known_right[:k] = np.concatenate([-P * at.jumps[w], pull[w + 1]])
        H[then, then], H[then, s], g[then] = known[:k, :k], known[:k, k:], known_right[:k]
        information, right = _eliminated(H, g, k)
    point = np.concatenate([fit.x[n], fit.d[n], fit.shared])
    return BoundaryPrior.of_information(point, information, right)


def _beforehand(fit: Fit, own: FloatArray, pull: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Information and right-hand side of the first interval's unknowns before its measurements."""
    if fit.boundary is not None:
        return fit.boundary.information, fit.boundary.right(fit.at_boundary)
    n_x = fit.x.shape[1]
    k = n_x + len(own)
    information, right = np.zeros((k + len(fit.shared),) * 2), np.zeros(k + len(fit.shared))
    information[n_x:k, n_x:k], right[n_x:k] = np.diag(np.square(own)), pull
    return information, right


def _eliminated(H: FloatArray, g: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
    """Schur complement of the first k unknowns, and its right side.

    Couplings of these to the next k are below the diagonal, all others above.
    """
    n = len(g) - k
    coupling = np.concatenate([H[k : 2 * k, :k], H[:k, 2 * k :].T])
    rest = np.triu(H[k:, k:]) + np.triu(H[k:, k:], 1).T
    scale = 1.0 / np.sqrt(size_or_one(np.diag(H)[:k]))
    # A ridge keeps an unknown which nothing determines.
    scaled = H[:k, :k] * np.outer(scale, scale) + 1e-13 * np.eye(k)
    solved = np.linalg.solve(scaled, scale[:, None] * np.column_stack([coupling.T, g[:k]]))
    taken = (coupling * scale) @ solved
    return rest - taken[:, :n], g[k:] - taken[:, n]
