"""Simulation, scores and output error of `real.py`, apart from the package.  Nothing happens when this file is run.

A machine is ``rates(x, u, p)`` over lanes: states ``(n_x, L)``, inputs ``(n_u, L)``, parameters ``(n_p, L)``.
The first ``n_y`` states are measured positions, the next their velocities.

References
----------
Jategaonkar 2015, "Flight Vehicle System Identification", chapter 4, output error; Bock 1987, multiple shooting.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import OptimizeResult, least_squares
from scipy.signal import lfilter, savgol_filter

Array = np.ndarray[Any, Any]
Rates = Callable[[Array, Array, Array], Array]

CAP, KEPT = 10.0, 0.95
"""Greatest error of a window in spreads; part of the windows that a robust error keeps."""
STEP, ROWS, BEND = 1e-5, 50, 0.1
"""Relative step of derivatives; residuals per segment and signal; where the loss bends at first, spreads."""
STARTS, PARTS, FEW, TOLERANCE = 8, 5, 24, 1e-5
"""Starts; the segments on which they compete: parts of a long one, and their number; relative, of cost and steps."""
FAR = 1e6


@dataclass(frozen=True)
class Inputs:
    """Inputs between samples: "zero-order", "linear" or "smooth"; delay and lag after which they act, s."""

    hold: str = "zero-order"
    delay: float = 0.0
    lag: float = 0.0

    def between(self, u: Array, dt: float, substeps: int) -> Array:
        """Inputs ``(K - 1, 2 substeps + 1, n_u)`` at the stages of RK4 from each row of ``(K, n_u)`` to the next."""
        rows, stages = np.arange(len(u)), np.linspace(1e-9, 1.0 - 1e-9, 2 * substeps + 1)
        at = np.clip(rows[:-1, None] + stages - self.delay / dt, 0.0, rows[-1])
        if self.hold == "zero-order":
            found = u[at.astype(int)]
        elif self.hold == "linear":
            found = np.stack([np.interp(at, rows, one) for one in u.T], axis=-1)
        else:
            found = CubicSpline(rows, u)(at)
        return self._lagged(found, dt) if self.lag > 0.0 else found

    def _lagged(self, u: Array, dt: float) -> Array:
        """Inputs behind a first-order lag that starts at rest."""
        steps = u.shape[1] - 1
        left = np.exp(-dt / steps / self.lag)
        flat = u[:, :-1].reshape(-1, u.shape[-1])
        found, _ = lfilter([0.0, 1.0 - left], [1.0, -left], flat, axis=0, zi=flat[:1])
        ends = np.append(found[steps::steps], found[-1:], axis=0)
        return np.concatenate([found.reshape(len(u), steps, -1), ends[:, None]], axis=1)


@dataclass(frozen=True)
class Motion:
    """Positions ``(K, n_y)`` and inputs ``(K, n_u)`` of a log, every dt seconds."""

    y: Array
    u: Array
    dt: float

    def states(self, width: int) -> Array:
        """Smoothed positions and velocities ``(2 n_y, K)`` by cubic polynomials over an odd number of rows."""
        q = savgol_filter(self.y, width, 3, axis=0)
        v = savgol_filter(self.y, width, 3, deriv=1, delta=self.dt, axis=0)
        return np.concatenate([q, v], axis=1).T


@dataclass(frozen=True)
class Simulator:
    """RK4 of a machine from given rows of a log, as lanes."""

    rates: Rates
    substeps: int = 2

    def __call__(self, p: Array, x: Array, stages: Array, begins: Array, steps: int, dt: float) -> Array:
        """States ``(steps + 1, n_x, L)`` from ``x`` (n_x, L); ``stages`` are those of `Inputs.between`."""
        h, found = dt / self.substeps, np.empty((steps + 1, *x.shape))
        found[0] = x
        with np.errstate(all="ignore"):
            for k in range(steps):
                u = stages[begins + k].transpose(1, 2, 0)
                for i in range(self.substeps):
                    x = self._step(p, x, u[2 * i : 2 * i + 3], h)
                found[k + 1] = x
        return np.clip(np.nan_to_num(found, copy=False, nan=FAR), -FAR, FAR, out=found)

    def _step(self, p: Array, x: Array, u: Array, h: float) -> Array:
        k1 = self.rates(x, u[0], p)
        k2 = self.rates(x + 0.5 * h * k1, u[1], p)
        k3 = self.rates(x + 0.5 * h * k2, u[1], p)
        k4 = self.rates(x + h * k3, u[2], p)
        return x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


# ---------------------------------------------------------------------- scores


def robust_errors(errors: Array, spread: Array) -> Array:
    """Robust RMSE ``(n_y,)`` in spreads of ``(rows, n_y, windows)``: the worst windows of each signal are left out."""
    squares = np.mean(np.square(np.clip(np.abs(errors) / spread[:, None], 0.0, CAP)), axis=0)
    kept = max(1, int(np.ceil(KEPT * squares.shape[1])))
    return np.sqrt(np.mean(np.sort(squares, axis=1)[:, :kept], axis=1))


def overall(by_horizon: Mapping[float, Array]) -> float:
    """Root mean square over horizons and signals."""
    return float(np.sqrt(np.mean([np.square(x) for x in by_horizon.values()])))


@dataclass(frozen=True)
class Windows:
    """Open-loop prediction of held-out logs from windows that start at smoothed states.

    Parameters
    ----------
    simulator : of the machine
    held : logs to predict
    spread : (n_y,) standard deviation of each position over all logs
    horizons : s, ascending
    width : rows of the smoothing polynomials, odd
    """

    simulator: Simulator
    held: Sequence[Motion]
    spread: Array
    horizons: Sequence[float]
    width: int

    def __call__(self, p: Array, inputs: Inputs) -> dict[float, Array]:
        """Robust errors ``(n_y,)`` in spreads at each horizon."""
        return self._scored(
            lambda log, x, begins, steps: self.simulator(
                np.repeat(p[:, None], len(begins), axis=1),
                x, inputs.between(log.u, log.dt, self.simulator.substeps), begins, steps, log.dt,
            )
        )  # fmt: skip

    def at_rest(self) -> dict[float, Array]:
        """The same of positions that stay where a window starts: no model at all."""
        return self._scored(lambda log, x, begins, steps: np.repeat(x[None], steps + 1, axis=0))

    def _scored(self, predicted: Callable[[Motion, Array, Array, int], Array]) -> dict[float, Array]:
        errors: dict[float, list[Array]] = {h: [] for h in self.horizons}
        for log in self.held:
            steps, n_y = round(self.horizons[-1] / log.dt), log.y.shape[1]
            begins = np.arange(self.width, len(log.y) - steps - self.width, round(self.horizons[0] / log.dt))
            states = predicted(log, log.states(self.width)[:, begins], begins, steps)
            off = states[:, :n_y] - log.y[begins + np.arange(steps + 1)[:, None]].transpose(0, 2, 1)
            for h in self.horizons:
                errors[h].append(_rows(off[1 : round(h / log.dt) + 1]))
        return {h: robust_errors(np.concatenate(x, axis=2), self.spread) for h, x in errors.items()}


def _rows(errors: Array) -> Array:
    """As many rows of every log, whatever its rate."""
    return errors[np.linspace(0, len(errors) - 1, min(len(errors), 50)).astype(int)]


# ---------------------------------------------------------------------- output error


@dataclass(frozen=True)
class OutputError:
    """Output error over segments whose first states are free, with SciPy's soft-L1 loss.

    Parameters
    ----------
    simulator : of the machine
    train : logs
    low : (n_p,) least value of each parameter
    spread : (n_y,) of the positions
    length : s, of a segment
    width : rows of the polynomials that give first states
    holds : between which the training error chooses
    """

    simulator: Simulator
    train: Sequence[Motion]
    low: Array
    spread: Array
    length: float
    width: int
    holds: Sequence[str] = ("zero-order", "linear")

    def __call__(self, guess: Array, linear: Array | None) -> tuple[Array, Inputs]:
        """Parameters, and the hold that fits best: the best of `STARTS` starts on short segments, continued on long.

        Half of the starts are within a decade of round numbers, half within 50 % of least squares, where it is
        admissible.  Errors of short segments have fewer minima.  The loss bends at a part of the spread first, then at
        the robust scale of the errors.
        """
        rng = np.random.default_rng(0)
        starts = guess * 10.0 ** rng.uniform(-1.0, 1.0, (STARTS, len(guess)))
        if linear is not None and (linear > self.low).all():
            starts[: STARTS // 2] = linear * rng.uniform(0.5, 1.5, (STARTS // 2, len(guess)))
            starts[0] = linear
        short = [_Segments.of(self, Inputs(hold), self.length / PARTS, FEW) for hold in self.holds]
        first = min((short[-1].fitted(p, BEND, 20) for p in starts), key=lambda fit: fit.cost)
        fits = [one.fitted(self.parameters(first), BEND, 20, first) for one in short]
        best = int(np.argmin([fit.cost for fit in fits]))
        whole = _Segments.of(self, Inputs(self.holds[best]), self.length, None)
        rough = whole.fitted(self.parameters(fits[best]), BEND, 20)
        fit = whole.fitted(self.parameters(rough), None, 40, rough)
        return self.parameters(fit), whole.inputs

    def parameters(self, fit: OptimizeResult) -> Array:
        """Parameters of a fit."""
        return np.asarray(fit.x[: len(self.low)])


@dataclass(frozen=True)
class _Segments:
    """Segments of logs as lanes: measured positions (K, n_y, S), first states (n_x, S), stages of the inputs."""

    problem: OutputError
    inputs: Inputs
    dt: float
    measured: Array
    first: Array
    stages: Array
    begins: Array
    rows: Array
    size: Array

    @classmethod
    def of(cls, problem: OutputError, inputs: Inputs, length: float, most: int | None) -> _Segments:
        """Segments of all logs, or evenly spaced ones."""
        measured, first, stages, begins, offset = [], [], [], [], 0
        for log in problem.train:
            steps = round(length / log.dt)
            own = np.arange(problem.width // 2, len(log.y) - steps - 1, steps)
            measured.append(log.y[own + np.arange(steps + 1)[:, None]].transpose(0, 2, 1))
            first.append(log.states(problem.width)[:, own])
            stages.append(inputs.between(log.u, log.dt, problem.simulator.substeps))
            begins.append(own + offset)
            offset += len(stages[-1])
        number = sum(map(len, begins))
        kept = np.unique(np.linspace(0, number - 1, number if most is None else min(most, number)).astype(int))
        states = np.concatenate([log.states(problem.width) for log in problem.train], axis=1)
        return cls(
            problem, inputs, log.dt, np.concatenate(measured, axis=2)[..., kept],
            np.concatenate(first, axis=1)[:, kept], np.concatenate(stages), np.concatenate(begins)[kept],
            np.unique(np.linspace(0, steps, min(ROWS, steps + 1)).astype(int)), np.std(states, axis=1) + 1e-9,
        )  # fmt: skip

    def fitted(
        self, p: Array, bend: float | None, evaluations: int, after: OptimizeResult | None = None
    ) -> OptimizeResult:
        """SciPy's fit in parameters over their start and first states in spreads; bend None: the robust scale."""
        size = np.maximum(np.abs(p), 1e-12)
        z = np.concatenate([p / size, np.zeros(self.first.size) if after is None else after.x[len(p) :]])
        low = np.concatenate([self.problem.low / size, np.full(self.first.size, -np.inf)])
        z[: len(p)] = np.maximum(z[: len(p)], low[: len(p)] + 1e-9)
        packed = z * np.concatenate([size, np.ones(self.first.size)])
        scale = bend if bend is not None else max(self.scale(packed), 1e-9)
        fit = least_squares(
            lambda z: self._residual(z, size) / scale, z, lambda z: self._jacobian(z, size) / scale,
            bounds=(low, np.inf), loss="soft_l1", x_scale="jac", max_nfev=evaluations,
            ftol=TOLERANCE, xtol=TOLERANCE,
        )  # fmt: skip
        fit.x = fit.x * np.concatenate([size, np.ones(self.first.size)])
        return fit

    def scale(self, x: Array) -> float:
        """Robust scale of the errors, spreads."""
        return 1.4826 * float(np.median(np.abs(self._residual(x, np.ones(len(self.problem.low))))))

    def _residual(self, z: Array, size: Array) -> Array:
        first = self.first + self.size[:, None] * z[len(size) :].reshape(self.first.shape)
        return self._errors(np.repeat((z[: len(size)] * size)[:, None], first.shape[1], axis=1), first, 1).ravel()

    def _jacobian(self, z: Array, size: Array) -> Array:
        """Differences by all parameters and all first states at once; a first state moves its own segment alone."""
        n_p, (n_x, n_s) = len(size), self.first.shape
        n = 1 + n_p + n_x
        first = self.first + self.size[:, None] * z[n_p:].reshape(self.first.shape)
        moved = np.repeat((z[:n_p] * size)[:, None], n, axis=1)
        moved[:, 1 : n_p + 1] += STEP * np.diag(size)
        states = np.repeat(first[:, None, :], n, axis=1)
        states[:, n_p + 1 :] += STEP * np.diag(self.size)[:, :, None]
        errors = self._errors(np.repeat(moved, n_s, axis=1), states.reshape(n_x, -1), n)
        errors = errors.reshape(*errors.shape[:2], n, n_s)
        slopes = (errors[:, :, 1:] - errors[:, :, :1]) / STEP
        own = np.einsum("kyis,sr->kysir", slopes[:, :, n_p:], np.eye(n_s))
        whole = [slopes[:, :, :n_p].transpose(0, 1, 3, 2).reshape(-1, n_p), own.reshape(-1, n_x * n_s)]
        return np.concatenate(whole, axis=1)

    def _errors(self, p: Array, first: Array, copies: int) -> Array:
        steps, n_y = len(self.measured) - 1, self.measured.shape[1]
        x = self.problem.simulator(p, first, self.stages, np.tile(self.begins, copies), steps, self.dt)
        error = x[self.rows, :n_y] - np.tile(self.measured[self.rows], copies)
        return np.clip(error / self.problem.spread[:, None], -FAR, FAR)
