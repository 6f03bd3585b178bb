"""Errors of recordings as unknowns of a fit: their columns in its equations, and score tests of those that it lacks.

An error of a sensor that no parameter and no discrepancy explains is in the residuals: a delay in
proportion to the signal's rate, a bias a constant.  One of an input is in them as simulations with it differ: an
actuator that is late, a battery that sags.  Each has a Gaussian prior of mean zero, whose standard deviation is the
largest size that is possible, so that what a log does not determine vanishes.

References
----------
Rao 1948 (score test); Furgale, Rehder, Siegwart 2013 (delays of sensors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.arrowhead import Arrowhead
from diransac.identification.methods.lo_diransac.corrections import ErrorKind
from diransac.identification.methods.lo_diransac.normal_equations import (
    linearize,
    weights_of,
    with_residuals,
)
from diransac.identification.methods.lo_diransac.score_tests import Slopes, scores_tested

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.normal_equations import Fit, NormalEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

_STEPS = {"delay": 0.5, "lag": 0.5, "drift": 0.01}
"""Errors of inputs by which simulations are compared: samples, samples, relative change of a gain."""
_LATEST = 0.1
"""Largest delay or lag, over the duration of the longest log."""
_ROUNDING = 1e-9
"""Change of a signal over its size that is a rounding error."""

Right = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class RecordingError:
    """An error of one signal or input, or of a group.

    Parameters
    ----------
    kind : ErrorKind
    size : float
        Its estimate: samples, the signal's unit, or relative to the gain.
    std : float
        Its standard error.
    gain : float
        Evidence that it would gain, nats, if the residuals were white.
    """

    kind: ErrorKind
    size: float
    std: float
    gain: float

    @property
    def ratio(self) -> float:
        """Its size over its standard error."""
        return abs(self.size) / self.std


def largest_size(intervals: ShootingIntervals, kind: ErrorKind) -> float:
    """Largest size of an error, and its prior standard deviation: a tenth of the log, a signal's range, all of a gain.

    Parameters
    ----------
    intervals : ShootingIntervals
    kind : ErrorKind
    """
    if kind.what == "bias":
        columns = list(kind.columns)
        seen = np.where(intervals.sampled[:, columns], intervals.measured[:, columns], np.nan)
        return float(np.nanmax(seen) - np.nanmin(seen)) or 1.0
    return 1.0 if kind.what == "drift" else _LATEST * max(x.stop - x.start for x in intervals.rows_of_logs)


def is_possible(intervals: ShootingIntervals, kind: ErrorKind, more: float) -> bool:
    """True if an error that is larger by some amount stays below the largest one, and time constants positive."""
    size = intervals.all_errors.sizes.get(kind, 0.0) + more
    lags = intervals.all_errors.input_lag[list(kind.columns)] if kind.what == "lag" else np.ones(1)
    return bool(abs(size) < largest_size(intervals, kind) and (kind.what != "lag" or (lags + more > 0.0).all()))


@dataclass(frozen=True, eq=False, repr=False)
class Columns:
    """Derivatives with respect to errors of recordings.

    Parameters
    ----------
    residuals : list of (N, n_s) array
    jumps : (W - 1, n_x, E) array
        Of the jumps from interval to interval.
    of_z, of_s : (W, k, E) and (n_s, E) array
        Of the gradient of the fit.
    rows : (W, E) array
        Of the cost of each interval's measurements.
    of_jumps : (E,) array
        Of the cost of the jumps.
    """

    residuals: list[FloatArray]
    jumps: FloatArray
    of_z: FloatArray
    of_s: FloatArray
    rows: FloatArray
    of_jumps: FloatArray

    @classmethod
    def of(
        cls, intervals: ShootingIntervals, at: NormalEquations, changes: Sequence[Change], along: FloatArray
    ) -> Columns:
        """Derivatives from those of residuals and jumps, and the products ``along (W, E, 1 + n)`` of the residuals."""
        jumps = np.stack([x for _, x in changes], axis=-1) if changes else np.zeros((*at.jumps.shape, 0))
        of_z, of_s = at.by_jumps(intervals, jumps)
        by_residuals = [at.by_residuals(intervals, along[:, i]) for i in range(len(changes))]
        for i, (z, s) in enumerate(by_residuals):
            of_z[:, :, i] += z
            of_s[:, i] += s
        of_jumps = np.einsum("wi,wie,wi->e", at.precision, jumps, at.jumps)
        return cls([x for x, _ in changes], jumps, of_z, of_s, along[:, :, 0], of_jumps)

    def slopes(self, at: NormalEquations) -> Slopes:
        """The derivatives, as a score test takes them."""
        n = len(at.right_z)
        shares = [(at.weights * np.square(x)).sum(axis=1).reshape(n, -1).sum(axis=1) for x in self.residuals]
        by_jumps = np.einsum("wi,wie,wie->e", at.precision, self.jumps, self.jumps)
        return Slopes(np.stack(shares, axis=1), self.rows, self.of_z, self.of_s, by_jumps, self.of_jumps)

    def information(self, at: NormalEquations) -> FloatArray:
        """Information ``(E, E)`` of the errors, if all else were known."""
        own = [[(at.weights * x * y).sum() for y in self.residuals] for x in self.residuals]
        by_jumps = np.einsum("wi,wie,wif->ef", at.precision, self.jumps, self.jumps)
        return np.asarray(np.array(own).reshape(by_jumps.shape) + by_jumps)


Change = tuple[FloatArray, FloatArray]
"""Derivatives of residuals (N, n_s) and of jumps (W - 1, n_x) with respect to an error."""


def changes_by(intervals: ShootingIntervals, fit: Fit, kinds: Sequence[ErrorKind], rates: FloatArray) -> list[Change]:
    """Derivatives with respect to errors; those of inputs by the difference of simulations."""
    changes = []
    for kind in kinds:
        if kind.of_inputs:
            step = _STEPS[kind.what]
            moved = intervals.with_input_error(kind, step)
            late = with_residuals(moved, fit)
            own = np.where(intervals.known, (late.residuals - fit.residuals) / step, 0.0)
            jumps = (late.jumps(moved) - fit.jumps(intervals)) / step
        else:
            columns, own = list(kind.columns), np.zeros_like(intervals.measured)
            own[:, columns] = -rates[:, columns] if kind.what == "delay" else 1.0
            jumps = np.zeros((len(intervals) - 1, fit.x.shape[1]))
        changes.append((own, jumps))
    return changes


def _recorrected(intervals: ShootingIntervals, fit: Fit) -> tuple[ShootingIntervals, Fit, FloatArray]:
    """Recordings whose fractions of a sample are corrected by the rates of this fit, which these are; the last result.

    A step is compared with no step then.
    """
    rates = signal_rates(intervals, fit)
    if not intervals.all_errors.delay.any():
        return intervals, fit, rates
    corrected = intervals.corrected({}, rates)
    return corrected, replace(fit, residuals=fit.residuals + intervals.measured - corrected.measured), rates


def errors_tested(
    intervals: ShootingIntervals, fit: Fit, kinds: Sequence[ErrorKind], at_a_time: int
) -> list[RecordingError]:
    """Estimates of errors one by one, given all else that is estimated.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.
    kinds : sequence of ErrorKind
    at_a_time : int
        Number of errors whose sensitivities, of a number for every sample, are held at a time.
    """
    intervals, fit, rates = _recorrected(intervals, fit)
    at, n, errors = linearize(intervals, fit, weights_of(intervals, fit)), len(intervals), list[RecordingError]()
    for part in (kinds[k : k + at_a_time] for k in range(0, len(kinds), at_a_time)):
        changes = changes_by(intervals, fit, part, rates)
        directions = [own for own, _ in changes]
        along = intervals.gauss_newton(
            fit.shared, fit.x, fit.d, at.weights, directions=directions, normal_matrix=False
        ).along
        tests = scores_tested(at, Columns.of(intervals, at, changes, along).slopes(at))
        batches = np.add.reduceat(tests.scores, np.arange(0, n, max(1, round(np.sqrt(n)))), axis=0)
        precision = np.array([largest_size(intervals, x) for x in part]) ** -2.0
        information = np.maximum(tests.information, 0.0) + precision
        std = np.sqrt(np.maximum(information, np.square(batches).sum(axis=0))) / information
        size = -tests.score / information
        gain = -0.5 * tests.score * size  # which overflows where the rollouts of a fit nearly do
        each = zip(part, size.tolist(), std.tolist(), gain.tolist(), strict=True)
        errors += [RecordingError(*x) for x in each if x[3] < np.inf]
    return errors


@dataclass(frozen=True, eq=False, repr=False)
class JointEquations:
    """Gauss-Newton system at a fit, with errors of its recordings among the unknowns that intervals share.

    Parameters
    ----------
    intervals : ShootingIntervals
        Recordings are corrected by the rates of this fit.
    fit : Fit
        Where they are linearised, with its residuals.
    of_fit : NormalEquations
        Of the fit alone.
    kinds : tuple of ErrorKind
    rates : (N, n_s) or (1, n_s) array
        Change of each signal per sample; 0 where no error is one of signals.
    columns : Columns
    system : Arrowhead
    right : (W, k) array, (n_s + E,) array
        Minus the gradient: of intervals, and of shared unknowns and errors.
    """

    intervals: ShootingIntervals
    fit: Fit
    of_fit: NormalEquations
    kinds: tuple[ErrorKind, ...]
    rates: FloatArray
    columns: Columns
    system: Arrowhead
    right: Right

    @classmethod
    def of(
        cls, intervals: ShootingIntervals, fit: Fit, kinds: Sequence[ErrorKind], weights: FloatArray | None = None
    ) -> JointEquations:
        """Equations at a fit.

        Parameters
        ----------
        intervals : ShootingIntervals
        fit : Fit
        kinds : sequence of ErrorKind
        weights : (N, n_s) array, optional
            Of the measurements; None: those of the fit, as `weights_of`.
        """
        rates = np.zeros((1, intervals.measured.shape[1]))
        if any(not x.of_inputs for x in (*kinds, *intervals.all_errors.kinds)):
            intervals, fit, rates = _recorrected(intervals, fit)
        changes = changes_by(intervals, fit, kinds, rates)
        weights = weights_of(intervals, fit) if weights is None else weights
        at = linearize(intervals, fit, weights, [own for own, _ in changes])
        columns = Columns.of(intervals, at, changes, at.along)
        sizes = np.array([intervals.all_errors.sizes.get(x, 0.0) for x in kinds])
        precision = np.array([largest_size(intervals, x) for x in kinds]) ** -2.0
        system = at.system
        own = columns.information(at) + np.diag(precision)
        bordered = replace(
            system,
            border=np.concatenate([system.border, columns.of_z], axis=2),
            corner=np.block([[system.corner, columns.of_s], [columns.of_s.T, own]]),
        )
        of_errors = columns.rows.sum(axis=0) + columns.of_jumps + precision * sizes
        right = at.right_z, np.concatenate([at.right_s, -of_errors])
        return cls(intervals, fit, at, tuple(kinds), rates, columns, bordered if kinds else system, right)

    def solve(self, right: Right | None = None, damping: float = 0.0) -> Factored:
        """Step for a right-hand side, which is minus the gradient unless another one is given.

        Parameters
        ----------
        right : (W, k) array, (n_s + E,) array, optional
        damping : float, optional
            The diagonal is multiplied by ``1 + damping``.
        """
        return self.system.solve(*(right or self.right), damping)

    def errors_of(self, step: Factored) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Changes ``(E,)`` of the errors, their standard errors ``(E,)``, and their covariance ``(E, E)``."""
        n = len(self.fit.shared)
        covariance = step.var_p[n:, n:]
        return step.step_p[n:], np.sqrt(np.diag(covariance)), covariance

    @property
    def log_det(self) -> float:
        """Logarithm of the determinant of the system without the errors of the recordings."""
        step = self.solve()
        return step.log_det + float(np.linalg.slogdet(self.errors_of(step)[2])[1]) if self.kinds else step.log_det

    def moved(self, step: Factored) -> tuple[ShootingIntervals, Fit]:
        """Recordings and fit after a step within the bounds of all shared unknowns.

        Parameters
        ----------
        step : Factored
        """
        fit, n = self.fit, len(self.fit.shared)
        shared = bounded(self.intervals, fit.shared, fit.shared + step.step_p[:n])
        sizes = np.array([self._bounded(x, size) for x, size in zip(self.kinds, step.step_p[n:], strict=True)])
        z = step.step_z - step.gain @ (np.concatenate([shared - fit.shared, sizes]) - step.step_p)
        more = dict(zip(self.kinds, sizes.tolist(), strict=True))
        intervals = self.intervals.corrected(more, self.rates) if sizes.any() else self.intervals
        n_x = fit.x.shape[1]
        moved = replace(fit, shared=shared, x=fit.x + z[:, :n_x], d=fit.d + z[:, n_x:])
        return intervals, with_residuals(intervals, moved)

    def _bounded(self, kind: ErrorKind, more: float) -> float:
        """Change of an error that leaves it possible; a time constant at most halves."""
        now, largest = self.intervals.all_errors.sizes[kind], largest_size(self.intervals, kind)
        if kind.what == "lag":
            more = max(more, -0.5 * float(self.intervals.all_errors.input_lag[list(kind.columns)].min()))
        return float(np.clip(now + more, -largest, largest)) - now

    def corrected(self, intervals: ShootingIntervals, moved: Fit) -> Right:
        """Right-hand sides of a step that makes up for the curvature of the rollouts along another step.

        Where continuity is tight, ends that are curved fill the cost of a step that is right otherwise, and no step but
        a tiny one would lower it (Maratos' effect; Nocedal and Wright 2006, section 18.3, second-order correction).

        Parameters
        ----------
        intervals : ShootingIntervals
        moved : Fit
            After the other step, with its recordings.

        Returns
        -------
        (W, k) array, (n_s + E,) array
            Not finite where a rollout diverges.
        """
        at, sizes = self.of_fit, (x.all_errors.sizes for x in (self.intervals, intervals))
        before, after = (np.array([x[kind] for kind in self.kinds]) for x in sizes)
        more = at.excess(intervals, self.fit, moved) - self.columns.jumps @ (after - before)
        of_z, of_s = at.by_jumps(intervals, more)
        linked = np.where(intervals.linked[:, None], more, 0.0)
        of_e = np.einsum("wi,wi,wie->e", at.precision, linked, self.columns.jumps)
        return self.right[0] - of_z, self.right[1] - np.concatenate([of_s, of_e])


def linearized(intervals: ShootingIntervals, fit: Fit, weights: FloatArray | None = None) -> JointEquations:
    """Equations at a fit and the errors of its recordings; arguments as of `JointEquations.of`.

    Errors of noisy inputs stay as they are: a delay by a fraction of a sample, or a lag, would average their noise.
    """
    kinds = [x for x in intervals.all_errors.kinds if not (intervals.noisy and x.of_inputs)]
    return JointEquations.of(intervals, fit, kinds, weights)


def bounded(intervals: ShootingIntervals, now: FloatArray, then: FloatArray) -> FloatArray:
    """Shared unknowns ``(n_s,)``, parameters within their bounds; a positive one at most halves or doubles."""
    then = then.copy()
    for j, bounds in enumerate(intervals.layout.bounds):
        then[j] = np.clip(then[j], bounds.lower, bounds.upper)
        if bounds.positive:
            then[j] = np.clip(then[j], 0.5 * now[j], 2.0 * now[j])
    return then


def effect_on(intervals: ShootingIntervals, fit: Fit, z: FloatArray, s: FloatArray) -> FloatArray:
    """Covariance of functions of a fit by the uncertainty of the errors of its recordings.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.
    z, s : (W, k, n) and (n_s, n) array
        Result of `Arrowhead.functional` for the functions' gradients.

    Returns
    -------
    (n, n) array
        0 without such errors.
    """
    kinds = intervals.all_errors.kinds
    if not kinds:
        return np.zeros((s.shape[1], s.shape[1]))
    joint = JointEquations.of(intervals, fit, kinds)
    slopes = np.einsum("wkn,wke->ne", z, joint.columns.of_z) + s.T @ joint.columns.of_s
    return np.asarray(slopes @ joint.errors_of(joint.solve())[2] @ slopes.T)


def signal_rates(intervals: ShootingIntervals, fit: Fit) -> FloatArray:
    """Change of each simulated signal per sample; none where it is a rounding error.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit

    Returns
    -------
    (N, n_s) array
    """
    series = intervals.rollouts.trajectories(intervals.batch(fit.shared, fit.x, fit.d))
    signals = series.reshape(intervals.measured.shape)
    rates = np.zeros_like(signals)
    for rows in intervals.rows_of_logs:
        if rows.stop - rows.start > 1:
            rates[rows] = np.gradient(signals[rows], axis=0)
    rates, signals = (np.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0) for x in (rates, signals))
    return np.where(np.abs(rates).max(axis=0) > _ROUNDING * np.abs(signals).max(axis=0), rates, 0.0)
