"""The quadratic model of all intervals together: measurements, continuity, and priors.

Unknowns are those that all intervals share (parameters, discrepancies), and at the start of each interval w the
state x_w and an unmodelled acceleration d_w that acts over the interval.  With ``F`` the rollout of an interval,
``kappa`` the standard deviation of continuity and m the prior means of the shared unknowns (zero for
discrepancies), twice the cost is

    sum W |y - y(x_w, s, d_w)|^2 + sum |x_{w+1} - F(x_w, s, d_w)|^2 / kappa^2 + sum |e_w|^2 / tau^2
        + |s - m|^2 / prior^2 + sum |x_w - m_w|^2 / s_w^2

and where a fit begins with a window of a log, that of its `BoundaryPrior`, which includes ``e_0``.  The second sum
is over neighbours within one log.  Unmodelled accelerations are a first-order Gauss-Markov process:
``e_w`` is ``(d_w - rho d_{w-1}) / sqrt(1 - rho^2)``, and ``d_w`` where a log begins.

References
----------
Bock 1987 (multiple shooting); Tremolet 2006 (weak-constraint 4D-Var).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.core.arrowhead import Arrowhead, Factored
from diransac.identification.core.columns import Columns, changes_by, recorrected
from diransac.identification.core.fit import (
    Fit,
    innovation_terms,
    innovations,
    weights_of,
    with_residuals,
)
from diransac.identification.core.theta import (
    EffectKind,
    bounded,
    in_places,
    largest_size,
    of_logs,
    places,
    shared_blocks,
    sum_in_places,
    sum_of_products,
)
from diransac.identification.core.windows import Windows

if TYPE_CHECKING:
    from collections.abc import Sequence

# A prior may alone determine a parameter, with less than the ridge's part of the precision of continuity.
_FINE_RIDGE = 1e-15


@dataclass(frozen=True, eq=False, repr=False)
class NormalEquations:
    """Gauss-Newton system at a fit.

    Parameters
    ----------
    weights : (N, n_signals) array
        Weights of the measurements, one over each signal's unit squared.
    system : Arrowhead
    right_z : (W, n_x + n_v) array
    right_s : (n_s,) array
        Right-hand side, minus the gradient: of states and unmodelled accelerations, and of the shared unknowns.
    data_z : (W, n_x + n_v) array
    data_s : (W, n_s) array
        The part of each interval's measurements in it.
    jumps : (W - 1, n_x) array
        States at the intervals' starts less the ends of the intervals before; 0 where a log or a gap ends.
    slopes : (W - 1, n_x, n) array
        Derivatives of the ends, with respect to the states and unmodelled accelerations of the interval, and to the
        shared unknowns of its log.
    precision : (W - 1, n_x) array
        Of the jumps.
    corners, rights : (W, n, n) and (W, n) array
        Information and right-hand side of the shared unknowns of each interval's log, from its measurements and its
        end.
    along : (W, n_directions, 1 + n) array
        Weighted products of changes of the residuals with these, and with their derivatives.
    """

    weights: FloatArray
    system: Arrowhead
    right_z: FloatArray
    right_s: FloatArray
    data_z: FloatArray
    data_s: FloatArray
    jumps: FloatArray
    slopes: FloatArray
    precision: FloatArray
    corners: FloatArray
    rights: FloatArray
    along: FloatArray

    def excess(self, intervals: Windows, fit: Fit, moved: Fit) -> FloatArray:
        """Jumps ``(W - 1, n_x)`` after a step, less those that these equations expect, from the step of a fit alone.

        Parameters
        ----------
        intervals : Windows
        fit : Fit
            Of these equations.
        moved : Fit
            After the step; not finite where a rollout diverges.
        """
        n_x = fit.x.shape[1]
        z = np.hstack([moved.x - fit.x, moved.d - fit.d])
        s = of_logs(intervals, moved.shared - fit.shared)
        linear = self.jumps + z[1:, :n_x] - np.einsum("wij,wj->wi", self.slopes, np.hstack([z, s])[:-1])
        return np.asarray(moved.jumps(intervals) - linear)

    def by_residuals(self, intervals: Windows, along: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of the gradient by larger residuals.

        Parameters
        ----------
        intervals : Windows
        along : (W, 1 + n) array
            Of a change of the residuals.

        Returns
        -------
        (W, k) array, (n_s,) array
        """
        k = self.right_z.shape[1]
        return along[:, 1 : 1 + k], sum_in_places(intervals, along[:, 1 + k :])

    def by_jumps(self, intervals: Windows, more: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Change of the gradient by larger jumps.

        Parameters
        ----------
        intervals : Windows
        more : (W - 1, n_x, ...) array
            0 is taken where a log or a gap ends.

        Returns
        -------
        (W, k, ...) array, (n_s, ...) array
        """
        n_x, k = more.shape[1], self.right_z.shape[1]
        along = (slice(None), slice(None), *(None,) * (more.ndim - 2))
        force = self.precision[along] * np.where(intervals.linked[:, None][along], more, 0.0)
        of_z = np.zeros((*self.right_z.shape, *more.shape[2:]))
        of_z[:-1] -= np.einsum("wij,wi...->wj...", self.slopes[:, :, :k], force, optimize=True)
        of_z[1:, :n_x] += force
        return of_z, -sum_of_products(intervals, self.slopes[:, :, k:].swapaxes(1, 2), force)


def linearize(
    intervals: Windows, fit: Fit, weights: FloatArray, directions: Sequence[FloatArray] = ()
) -> NormalEquations:
    """Gauss-Newton normal equations of the cost at a fit.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    weights : (N, n_signals) array
        Weights of the measurements, one over each signal's unit squared.
    directions : sequence of (N, n_signals) array, optional
        Changes of the residuals, along which the gradient is wanted, too.

    Returns
    -------
    NormalEquations
    """
    n_x, k = fit.x.shape[1], fit.x.shape[1] + fit.d.shape[1]
    sums = intervals.gauss_newton(fit.shared, fit.x, fit.d, weights, directions=directions)
    H, g = sums.normal_matrix, -sums.gradient
    data_z, data_s = g[:, :k].copy(), in_places(intervals, g[:, k:])
    F = sums.final_slopes[:-1]
    linked = intervals.linked
    jumps = fit.jumps(intervals)
    F = F if linked.all() else np.where(linked[:, None, None], F, 0.0)
    precision = linked[:, None] / np.square(fit.continuity_std)
    FP = F.swapaxes(1, 2) * precision[:, None, :]
    H[:-1] += FP @ F
    g[:-1] += np.einsum("wij,wj->wi", FP, jumps)
    own_diagonal, of_states = np.einsum("wii->wi", H), fit.x_std**-2.0
    own_diagonal[:, :n_x] += of_states
    g[:, :n_x] -= (fit.x - fit.x_mean) * of_states
    own_diagonal[1:, :n_x] += precision
    H[1:, :n_x, k:] -= precision[:, :, None] * F[:, :, k:]
    g[1:, :n_x] -= precision * jumps
    E = np.zeros((len(H) - 1, k, k))
    np.multiply(-precision[:, :, None], F[:, :, :k], out=E[:, :n_x])
    diagonal, below, pull = innovation_terms(intervals, fit)
    own_diagonal[:, n_x:k] += diagonal
    np.einsum("wii->wi", E)[:, n_x:] += below
    g[:, n_x:k] += pull
    beforehand = 1.0 / np.square(fit.prior)
    corners, rights = H[:, k:, k:], g[:, k:]
    border, corner, right = shared_blocks(intervals, H[:, :k, k:], corners, rights)
    corner = corner + np.diag(beforehand)
    right = right - beforehand * (fit.shared - fit.prior_mean)
    if fit.boundary is not None:
        known, pull = fit.boundary.information, fit.boundary.right(fit.at_boundary)
        H[0, :k, :k] += known[:k, :k]
        border[0] += known[:k, k:]
        corner += known[k:, k:]
        g[0, :k] += pull[:k]
        right += pull[k:]
    blocks = (H[:, :k, :k], E, border, corner)
    has_prior = fit.boundary is not None or len(intervals.layout.with_prior)
    system = Arrowhead(*blocks, _FINE_RIDGE) if has_prior else Arrowhead(*blocks)
    of_jumps = jumps, F, precision
    return NormalEquations(weights, system, g[:, :k], right, data_z, data_s, *of_jumps, corners, rights, sums.along)


def without_windows(intervals: Windows, fit: Fit, at: NormalEquations) -> tuple[FloatArray, FloatArray]:
    """Normal equations of the shared unknowns, the right-hand side last, when windows that nothing ties are eliminated.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    at : NormalEquations

    Returns
    -------
    (W, n_s, n_s + 1) array
        Of each window.
    (n_s, n_s + 1) array
        Of the priors.
    """
    right = np.concatenate([at.system.border, at.right_z[:, :, None]], axis=2)
    solved = np.linalg.solve(at.system.ridged, right)
    parts = -at.system.border.swapaxes(1, 2) @ solved
    n, rows = np.arange(len(parts)), places(intervals)[intervals.log_of]
    own = np.concatenate([at.corners, at.rights[:, :, None]], axis=2)
    columns = np.concatenate([rows, np.full((len(n), 1), intervals.n_shared)], axis=1)
    parts[n[:, None, None], rows[:, :, None], columns[:, None, :]] += own
    precision = np.square(fit.prior) ** -1.0
    return parts, np.column_stack([np.diag(precision), -precision * (fit.shared - fit.prior_mean)])


def variances_of_intervals(
    intervals: Windows, fit: Fit, weights: FloatArray, z: FloatArray, s: FloatArray
) -> FloatArray:
    """Variances of functions of a fit by the noise of each interval's measurements alone, of inputs if they are noisy.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    weights : (N, n_signals) array
        Weights of the measurements, one over the variance of each.
    z, s : (W, k, n) and (n_s, n) array
        Result of `Arrowhead.functional` for the functions' gradients.

    Returns
    -------
    (W, n, n) array
    """
    sums = intervals.gauss_newton(fit.shared, fit.x, fit.d, weights)
    own = np.concatenate([z, of_logs(intervals, s)], axis=1)
    found = own.swapaxes(1, 2) @ sums.normal_matrix @ own
    if intervals.noisy:
        by_errors = z[:, fit.x.shape[1] :] / fit.tau[:, None]
        found += by_errors.swapaxes(1, 2) @ by_errors
    return np.asarray(found)


def cost(intervals: Windows, fit: Fit, weights: FloatArray) -> float:
    """Twice the cost of a fit with fixed weights.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    weights : (N, n_signals) array
        Weights of the measurements, one over each signal's unit squared.

    Returns
    -------
    float
        Infinite where a rollout diverges.
    """
    terms = (
        np.einsum("ns,ns,ns->", weights, fit.residuals, fit.residuals),
        np.square(fit.jumps(intervals) / fit.continuity_std).sum(),
        np.square(innovations(intervals, fit)).sum(),
        np.square((fit.shared - fit.prior_mean) / fit.prior).sum(),
        np.square((fit.x - fit.x_mean) / fit.x_std).sum(),
        0.0 if fit.boundary is None else fit.boundary.cost(fit.at_boundary),
    )
    total = float(sum(terms))
    return total if np.isfinite(total) else np.inf


Right = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False, repr=False)
class JointEquations:
    """Gauss-Newton system at a fit, with errors of its recordings among the unknowns that intervals share.

    Parameters
    ----------
    intervals : Windows
        Recordings are corrected by the rates of this fit.
    fit : Fit
        Where they are linearised, with its residuals.
    of_fit : NormalEquations
        Of the fit alone.
    kinds : tuple of EffectKind
    rates : (N, n_s) or (1, n_s) array
        Change of each signal per sample; 0 where no error is one of signals.
    columns : Columns
    system : Arrowhead
    right : (W, k) array, (n_s + E,) array
        Minus the gradient: of intervals, and of shared unknowns and errors.
    """

    intervals: Windows
    fit: Fit
    of_fit: NormalEquations
    kinds: tuple[EffectKind, ...]
    rates: FloatArray
    columns: Columns
    system: Arrowhead
    right: Right

    @classmethod
    def of(
        cls, intervals: Windows, fit: Fit, kinds: Sequence[EffectKind], weights: FloatArray | None = None
    ) -> JointEquations:
        """Equations at a fit.

        Parameters
        ----------
        intervals : Windows
        fit : Fit
        kinds : sequence of EffectKind
        weights : (N, n_s) array, optional
            Of the measurements; None: those of the fit, as `weights_of`.
        """
        rates = np.zeros((1, intervals.measured.shape[1]))
        if any(not x.of_inputs for x in (*kinds, *intervals.all_errors.kinds)):
            intervals, fit, rates = recorrected(intervals, fit)
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

    def moved(self, step: Factored) -> tuple[Windows, Fit]:
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

    def _bounded(self, kind: EffectKind, more: float) -> float:
        """Change of an error that leaves it possible; a time constant at most halves."""
        now, largest = self.intervals.all_errors.sizes[kind], largest_size(self.intervals, kind)
        if kind.what == "lag":
            more = max(more, -0.5 * float(self.intervals.all_errors.input_lag[list(kind.columns)].min()))
        return float(np.clip(now + more, -largest, largest)) - now

    def corrected(self, intervals: Windows, moved: Fit) -> Right:
        """Right-hand sides of a step that makes up for the curvature of the rollouts along another step.

        Where continuity is tight, ends that are curved fill the cost of a step that is right otherwise, and no step but
        a tiny one would lower it (Maratos' effect; Nocedal and Wright 2006, section 18.3, second-order correction).

        Parameters
        ----------
        intervals : Windows
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


def linearized(intervals: Windows, fit: Fit, weights: FloatArray | None = None) -> JointEquations:
    """Equations at a fit and the errors of its recordings; arguments as of `JointEquations.of`.

    Errors of noisy inputs stay as they are: a delay by a fraction of a sample, or a lag, would average their noise.
    """
    kinds = [x for x in intervals.all_errors.kinds if not (intervals.noisy and x.of_inputs)]
    return JointEquations.of(intervals, fit, kinds, weights)


def effect_on(intervals: Windows, fit: Fit, z: FloatArray, s: FloatArray) -> FloatArray:
    """Covariance of functions of a fit by the uncertainty of the errors of its recordings.

    Parameters
    ----------
    intervals : Windows
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
