"""Errors of recordings as unknowns of a fit: their slopes, score tests, and steps of all unknowns together.

An error of a sensor that no parameter and no discrepancy explains is in the residuals: a delay in
proportion to the signal's rate, a bias a constant.  One of an input is in them as simulations with it differ: an
actuator that is late, a battery that sags.

References
----------
Rao 1948 (score test); Furgale, Rehder, Siegwart 2013 (delays of sensors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.methods.lo_diransac.corrections import ErrorKind
from diransac.identification.methods.lo_diransac.normal_equations import (
    linearize,
    weights_of,
    with_residuals,
)
from diransac.identification.methods.lo_diransac.score_tests import ScoreTests, Slopes, scores_tested

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.arrowhead import Factored
    from diransac.identification.methods.lo_diransac.normal_equations import Fit, NormalEquations
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

# Part of the information of an error that other unknowns must leave; of an error of inputs, which moves the ends of
# intervals that continuity holds, more than rounding.
_DETERMINED, _ROUNDED = 1e-6, 1e-12
# Errors of inputs by which simulations are compared: samples, relative change of a gain.
_STEPS = {"delay": 0.5, "lag": 0.5, "drift": 0.01}
# Largest delay, over the log; relative change of a gain that leaves none.
_LATEST, _NO_GAIN = 0.1, 1.0
# Change of a signal over its size that is a rounding error.
_ROUNDING, _TINY = 1e-9, 1e-300


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


def is_possible(intervals: ShootingIntervals, kind: ErrorKind, more: float) -> bool:
    """False for a delay or a lag of a tenth of the log, a negative time constant, a gain that vanishes, infinity."""
    what, size = kind.what, intervals.all_errors.sizes.get(kind, 0.0) + more
    if what == "bias":
        return bool(np.isfinite(size))
    if what == "drift":
        return abs(size) < _NO_GAIN
    lags = intervals.all_errors.input_lag[list(kind.columns)] if what == "lag" else np.zeros(0)
    longest = max(x.stop - x.start for x in intervals.rows_of_logs)
    return abs(size) < _LATEST * longest and bool((lags + more > 0.0).all())


def effect_on(intervals: ShootingIntervals, fit: Fit, z: FloatArray, s: FloatArray) -> FloatArray:
    """Covariance of functions of a fit by the uncertainty of the errors of its sensors.

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
    slopes = np.einsum("wkn,wke->ne", z, joint.of_z) + s.T @ joint.of_s
    return np.asarray(slopes @ joint.step(joint.right).covariance @ slopes.T)


@dataclass(frozen=True, eq=False, repr=False)
class _Slope:
    """Derivatives of the cost, and of its gradient, with respect to one error.

    Parameters
    ----------
    kind : ErrorKind
    sensitivity : (N, n_s) array
        Of the residuals.
    jumps : (W - 1, n_x) array
        Of the jumps from interval to interval.
    of_z, of_s : (W, k) and (n_s,) array
        Of the gradient of the fit.
    rows : (W,) array
        Of the cost of each interval's measurements.
    of_jumps : float
        Of the cost of the jumps.
    """

    kind: ErrorKind
    sensitivity: FloatArray
    jumps: FloatArray
    of_z: FloatArray
    of_s: FloatArray
    rows: FloatArray
    of_jumps: float

    @classmethod
    def sum(cls, kind: ErrorKind, parts: Sequence[_Slope]) -> _Slope:
        """Derivatives with respect to errors of the same size, as one."""
        names = ("sensitivity", "jumps", "of_z", "of_s", "rows")
        total: dict[str, FloatArray] = {n: np.sum([getattr(x, n) for x in parts], axis=0) for n in names}
        return cls(kind=kind, **total, of_jumps=sum(x.of_jumps for x in parts))

    @property
    def score(self) -> float:
        """Derivative of the cost."""
        return float(self.rows.sum()) + self.of_jumps


class Scores:
    """Score tests at a fit: of errors one by one, or estimates of several together, whose `slopes` it has."""

    def __init__(
        self,
        intervals: ShootingIntervals,
        fit: Fit,
        weights: FloatArray | None = None,
        kinds: Sequence[ErrorKind] = (),
    ) -> None:
        self.intervals, self.fit = intervals, fit
        if intervals.all_errors.delay.any():
            # Fractions of a sample are corrected by the rates of this fit, so that a step is compared with no step.
            self.intervals = intervals.corrected({}, self.rates)
            self.fit = replace(fit, residuals=fit.residuals + intervals.measured - self.intervals.measured)
        self.weights = weights_of(self.intervals, self.fit) if weights is None else weights
        changes = [self._changes(x) for x in kinds]
        self.at = linearize(self.intervals, self.fit, self.weights, [own for own, _ in changes])
        self.slopes = self._slopes(kinds, changes, self.at.along)

    @cached_property
    def rates(self) -> FloatArray:
        """Change of each signal per sample."""
        return signal_rates(self.intervals, self.fit)

    def product(self, x: _Slope, y: _Slope) -> float:
        """Information that two errors have in common, before other unknowns take theirs."""
        of_signals = (self.weights * x.sensitivity * y.sensitivity).sum()
        return float(of_signals + (self.at.precision * x.jumps * y.jumps).sum())

    def _changes(self, kind: ErrorKind) -> tuple[FloatArray, FloatArray]:
        """Derivatives of the residuals and of the jumps; of an error of inputs by the difference of simulations."""
        if not kind.of_inputs:
            columns, own = list(kind.columns), np.zeros_like(self.intervals.measured)
            own[:, columns] = -self.rates[:, columns] if kind.what == "delay" else 1.0
            return own, np.zeros((len(self.intervals) - 1, self.fit.x.shape[1]))
        step, fit = _STEPS[kind.what], self.fit
        moved = self.intervals.with_input_error(kind, step)
        late = with_residuals(moved, fit)
        own, jumps = late.residuals - fit.residuals, late.jumps(moved) - fit.jumps(self.intervals)
        return np.where(self.intervals.known, own / step, 0.0), jumps / step

    def _slopes(
        self, kinds: Sequence[ErrorKind], changes: Sequence[tuple[FloatArray, FloatArray]], along: FloatArray
    ) -> list[_Slope]:
        """Derivatives with respect to errors, from those of the residuals and of the jumps."""
        at, found = self.at, list[_Slope]()
        for i, (kind, (own, jumps)) in enumerate(zip(kinds, changes, strict=True)):
            of_z, of_s = at.by_jumps(self.intervals, jumps)
            z, s = at.by_residuals(self.intervals, along[:, i])
            of_jumps = float((at.precision * jumps * at.jumps).sum())
            found.append(_Slope(kind, own, jumps, of_z + z, of_s + s, along[:, i, 0], of_jumps))
        return found

    def _of_groups(self, kinds: Sequence[ErrorKind]) -> list[_Slope]:
        """Derivatives with respect to errors; those of a group of signals that others make up are sums of theirs."""
        parts, fit = dict[ErrorKind, list[ErrorKind]](), self.fit
        for kind in sorted(kinds, key=lambda x: len(x.columns)):
            left, some = set(kind.columns), list[ErrorKind]()
            for other in reversed(parts):
                if other.what == kind.what and not other.of_inputs and left.issuperset(other.columns):
                    left.difference_update(other.columns)
                    some.append(other)
            parts[kind] = [] if left or kind.of_inputs else some
        alone = [x for x, some in parts.items() if not some]
        changes, at = [self._changes(x) for x in alone], (fit.shared, fit.x, fit.d, self.weights)
        sums = self.intervals.gauss_newton(*at, directions=[own for own, _ in changes], normal_matrix=False)
        found = dict(zip(alone, self._slopes(alone, changes, sums.along), strict=True))
        for kind, some in parts.items():
            if some:
                found[kind] = _Slope.sum(kind, [found[x] for x in some])
        return [found[x] for x in kinds]

    def tested(self, kinds: Sequence[ErrorKind]) -> list[RecordingError]:
        """Estimates of errors one by one, given all else that is estimated; without those not determined by the log."""
        slopes, n = self._of_groups(kinds), len(self.intervals)
        shares = [(self.weights * np.square(x.sensitivity)).sum(axis=1).reshape(n, -1).sum(axis=1) for x in slopes]
        together = Slopes(
            share=np.stack(shares, axis=1),
            rows=np.stack([x.rows for x in slopes], axis=1),
            of_z=np.stack([x.of_z for x in slopes], axis=-1),
            of_s=np.stack([x.of_s for x in slopes], axis=-1),
            by_jumps=np.array([(self.at.precision * np.square(x.jumps)).sum() for x in slopes]),
            score_of_jumps=np.array([x.of_jumps for x in slopes]),
        )
        del slopes  # their sensitivities have a number for every sample
        tests = scores_tested(self.at, together)
        return [x for k, kind in enumerate(kinds) if (x := self._estimate(kind, tests, k)) is not None]

    def _estimate(self, kind: ErrorKind, tests: ScoreTests, k: int) -> RecordingError | None:
        """Estimate of the k-th error, or None if the log does not determine it."""
        information, score = float(tests.information[k]), float(tests.score[k])
        if information <= _least_information(kind) * tests.direct[k]:
            return None
        n = len(self.intervals)
        batches = np.add.reduceat(tests.scores[:, k], np.arange(0, n, max(1, round(np.sqrt(n)))))
        variance = max(information, float(np.square(batches).sum()))
        size = -score / information
        gain = -0.5 * score * size  # which overflows where the rollouts of a fit nearly do
        return RecordingError(kind, size, float(np.sqrt(variance)) / information, gain) if gain < np.inf else None


@dataclass(frozen=True, eq=False, repr=False)
class JointStep:
    """Step of a fit and of errors of its recordings.

    Parameters
    ----------
    of_fit : Factored
    sizes : (E,) array
        Of the errors; 0 of those that the logs do not determine.
    std : (E,) array
        Standard errors; infinite of those.
    covariance : (E, E) array
        0 of those.
    """

    of_fit: Factored
    sizes: FloatArray
    std: FloatArray
    covariance: FloatArray


Right = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False, repr=False)
class JointEquations:
    """Gauss-Newton system at a fit, with errors of its recordings as further unknowns.

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
    of_z, of_s, jumps : (W, k, E), (n_s, E) and (W - 1, n_x, E) array
        Derivatives with respect to the errors of the gradient of the fit, and of the jumps.
    information : (E, E) array
        Of the errors, if all else were known.
    score : (E,) array
        Derivative of the cost.
    """

    intervals: ShootingIntervals
    fit: Fit
    of_fit: NormalEquations
    kinds: tuple[ErrorKind, ...]
    rates: FloatArray
    of_z: FloatArray
    of_s: FloatArray
    jumps: FloatArray
    information: FloatArray
    score: FloatArray

    @classmethod
    def of(
        cls,
        intervals: ShootingIntervals,
        fit: Fit,
        kinds: Sequence[ErrorKind],
        weights: FloatArray | None = None,
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
        scores = Scores(intervals, fit, weights, kinds)
        slopes = scores.slopes

        def stacked(values: list[FloatArray], like: FloatArray) -> FloatArray:
            return np.stack(values, axis=-1) if values else np.zeros((*like.shape, 0))

        at = scores.at
        return cls(
            intervals=scores.intervals,
            fit=scores.fit,
            of_fit=at,
            kinds=tuple(kinds),
            rates=scores.rates if any(not x.of_inputs for x in kinds) else np.zeros((1, intervals.measured.shape[1])),
            of_z=stacked([x.of_z for x in slopes], at.right_z),
            of_s=stacked([x.of_s for x in slopes], at.right_s),
            jumps=stacked([x.jumps for x in slopes], at.jumps),
            information=np.array([[scores.product(x, y) for y in slopes] for x in slopes]).reshape(
                len(kinds), len(kinds)
            ),
            score=np.array([x.score for x in slopes]),
        )

    @property
    def right(self) -> Right:
        """Right-hand sides, minus the gradient: of intervals, of shared unknowns, and of errors."""
        return self.of_fit.right_z, self.of_fit.right_s, -self.score

    def step(self, right: Right, damping: float = 0.0) -> JointStep:
        """Solution for a right-hand side.

        Parameters
        ----------
        right : (W, k) array, (n_s,) array, (E,) array
        damping : float, optional
            The diagonal is multiplied by ``1 + damping``.
        """
        z, s, e = right
        columns = np.concatenate([z[:, :, None], self.of_z], axis=2), np.hstack([s[:, None], self.of_s])
        solved = self.of_fit.system.solve(*columns, damping)
        alone = replace(solved, step_z=solved.step_z[:, :, 0], step_p=solved.step_p[:, 0])
        of_z, of_s = solved.step_z[:, :, 1:], solved.step_p[:, 1:]
        direct = np.diag(self.information)
        left = self.information + damping * np.diag(direct)
        left = left - np.einsum("wke,wkf->ef", self.of_z, of_z) - self.of_s.T @ of_s
        least = np.array([_least_information(x) for x in self.kinds])
        found = np.flatnonzero(np.diag(left) > least * direct)
        covariance, std = np.zeros_like(left), np.full(len(direct), np.inf)
        covariance[np.ix_(found, found)] = np.linalg.pinv(left[np.ix_(found, found)], hermitian=True)
        std[found] = np.sqrt(np.diag(covariance)[found]) + _TINY
        expected = np.einsum("wke,wk->e", self.of_z, alone.step_z) + self.of_s.T @ alone.step_p
        sizes = covariance @ (e - expected)
        moved = replace(alone, step_z=alone.step_z - of_z @ sizes, step_p=alone.step_p - of_s @ sizes)
        return JointStep(moved, sizes, std, covariance)

    def moved(self, step: JointStep) -> ShootingIntervals | None:
        """The intervals with errors after a step; None if one is impossible.

        Parameters
        ----------
        step : JointStep
        """
        if not step.sizes.any():
            return self.intervals
        sizes = dict(zip(self.kinds, step.sizes.tolist(), strict=True))
        possible = all(is_possible(self.intervals, kind, x) for kind, x in sizes.items())
        return self.intervals.corrected(sizes, self.rates) if possible else None

    def corrected(self, intervals: ShootingIntervals, moved: Fit, step: JointStep) -> Right:
        """Right-hand sides of a step that makes up for the curvature of the rollouts along another step.

        Where continuity is tight, ends that are curved fill the cost of a step that is right otherwise, and no step but
        a tiny one would lower it (Maratos' effect; Nocedal and Wright 2006, section 18.3, second-order correction).

        Parameters
        ----------
        intervals : ShootingIntervals
        moved : Fit
            After the other step.
        step : JointStep
            That step.

        Returns
        -------
        (W, k) array, (n_s,) array, (E,) array
            Not finite where a rollout diverges.
        """
        at = self.of_fit
        more = at.excess(intervals, self.fit, moved) - self.jumps @ step.sizes
        of_z, of_s = at.by_jumps(intervals, more)
        of_e = np.einsum("wi,wi,wie->e", at.precision, np.where(intervals.linked[:, None], more, 0.0), self.jumps)
        right_z, right_s, right_e = self.right
        return right_z - of_z, right_s - of_s, right_e - of_e


def _least_information(kind: ErrorKind) -> float:
    """Part of the information of an error that other unknowns must leave."""
    return _ROUNDED if kind.of_inputs else _DETERMINED


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
