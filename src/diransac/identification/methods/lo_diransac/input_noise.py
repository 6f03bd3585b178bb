"""Noise of inputs: currents, winds and speeds of rotors are measured, as signals are.

An input is measured as ``u_m = u - e``, with white errors e.  They are unknowns of each interval, instead of
unmodelled accelerations, and the size of each input's is a scale of the fit.  The model is exact then, driven by
``u_m + e``: noise of inputs is noise of force through their gains, which may vary, and parameters that multiply an
input are not attenuated, since its errors are estimated together with them.

References
----------
Fuller 1987 (errors in variables).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, size_or_one
from diransac.data.input_timing import acting_inputs
from diransac.identification.core.equations import linearize
from diransac.identification.core.fit import split, weights_of, with_residuals
from diransac.identification.core.minimise import Refinement, minimise
from diransac.identification.core.noise import NoiseSums
from diransac.identification.core.scales import CONTINUITY, SHRINK, negligible_jumps, process_sums
from diransac.identification.core.theta import EffectKind
from diransac.identification.methods.lo_diransac.missing_terms import candidates_of_fit, missing_terms
from diransac.identification.methods.lo_diransac.motion_equations import unexplained
from diransac.identification.methods.lo_diransac.projection import fitted_parameters

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.minimise import Prior, Step
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.projection import ProjectedEstimate
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.structure.candidate_terms import TermLibrary

# Noise of an input over its RMS with which a fit starts.
_START = 0.03
# Noise of an input over its RMS that counts as none.
_NONE = 1e-4
# Numbers in the normal matrices of all intervals, at most: 160 MB.
_MOST = 2e7
# Samples over which the response of an acting input to a recorded one is summed.
_RESPONSE = 401
# Share of a signal's samples that a fit takes, at most.
_MOST_TAKEN = 0.995
# Power at low frequencies, and fourth moments, over those of white noise, from which on an error is no noise.
_WHITE = 2.0
# Stretches of a log whose sums show power at low frequencies.
_STRETCHES = 30
# Share of errors that the measurements determine, from which on they show whether they are white.
_SEEN = 0.1
# Standard errors of their size from which on accelerations that an exact model leaves may be noise of inputs.
_CLEAR = 3.0
# Correlation from interval to interval below which those that a flexible model leaves may be.
_SLOW = 0.5


def refine_noisy(settings: LoDiransacSettings, intervals: Windows, fit: Fit, prior: Prior) -> Refinement:
    """Fit of the exact model with noise of its inputs.

    Parameters
    ----------
    settings : LoDiransacSettings
    intervals : Windows
    fit : Fit
        Initial fit, with unmodelled accelerations or with noise of inputs.
    prior : Prior

    Returns
    -------
    Refinement
        In intervals that are as short as memory allows: noise is white within them, too.

    Raises
    ------
    TimeLimitError
        The time limit was reached.
    """
    least, unbroken = _NONE * _sizes(intervals), negligible_jumps(intervals, prior.exact)
    if not intervals.noisy:
        intervals, fit = _with_errors(intervals, fit)
    return minimise(intervals, fit, Noisy(settings, least, unbroken), settings.max_steps)


def _sizes(intervals: Windows) -> FloatArray:
    """RMS ``(n_u,)`` of each input; 1 of one that never acts."""
    return size_or_one(np.sqrt(np.square(intervals.recorded).mean(axis=0)))


def _with_errors(intervals: Windows, fit: Fit) -> tuple[Windows, Fit]:
    """The intervals, split, and the fit with errors of inputs instead of unmodelled accelerations; all vanish yet."""
    n = fit.x.shape[1] + intervals.model.n_u + intervals.n_p
    divisors = [k for k in range(1, intervals.length + 1) if intervals.length % k == 0]
    parts = max((k for k in divisors if k * len(intervals) * n**2 < _MOST), default=1)
    finer, fit = split(intervals, fit, parts)
    finer, own = replace(finer, noisy=True, discrepancies=False), slice(intervals.n_p)
    tau = _START * _sizes(intervals) / np.sqrt(finer.length)
    fit = replace(
        fit, d=np.zeros((len(finer), len(tau))), tau=tau, rho=np.zeros_like(tau),
        shared=fit.shared[own], prior=fit.prior[own], prior_mean=fit.prior_mean[own],
    )  # fmt: skip
    return finer, with_residuals(finer, fit)


@dataclass(frozen=True, eq=False, repr=False)
class Noisy:
    """Schedule of the exact model with noise of inputs; least noise of inputs, and least jumps."""

    settings: LoDiransacSettings
    least: FloatArray
    unbroken: FloatArray
    settled = 0.01

    def after(self, step: Step) -> Fit:
        """The fit with every scale updated from residuals and errors of inputs."""
        intervals, fit = step.intervals, step.fit
        noise = fit.noise.of_sums(_noise_sums(step), outliers=self.settings.outliers)
        sums, n_x = process_sums(intervals, fit, step.solved).total(), fit.x.shape[1]
        tau = sums.most_probable_size(np.zeros_like(fit.tau), fit.tau)
        tau = np.maximum(tau, self.least / np.sqrt(intervals.length))
        by_errors = step.at.of_fit.slopes[:, :, n_x : n_x + len(tau)] * tau
        jumps = np.maximum(self.unbroken, CONTINUITY * np.sqrt(np.square(by_errors).sum(axis=2).mean(axis=0)))
        return replace(fit, noise=noise, tau=tau, continuity_std=np.maximum(jumps, SHRINK * fit.continuity_std))


def _noise_sums(taken: Step) -> NoiseSums:
    """Sums of the noise of signals beyond what states and errors of inputs, of which each row has its own, take of it.

    MacKay 1992: of N samples, of which the fit takes gamma, the squares have N - gamma degrees of freedom.
    """
    intervals, fit, solved = taken.intervals, taken.fit, taken.solved
    known, n_x = intervals.known, fit.x.shape[1]
    inlying = fit.noise.inlying(fit.residuals, known)
    sums, variances = NoiseSums.of(fit.residuals, known, inlying), np.zeros(known.shape[1])
    variances[:n_x] = np.einsum(
        "ni,ni->i", inlying[:, :n_x], np.repeat(solved.var_z[:, :n_x], intervals.length, axis=0)
    )
    for i in n_x + np.flatnonzero(known[:, n_x:].any(axis=0)):
        own = np.where(np.arange(len(variances)) == i, inlying, 0.0)
        k = solved.alone.shape[1]
        slopes = intervals.gauss_newton(fit.shared, fit.x, fit.d, own).normal_matrix[:, :k, :k]
        moved = np.einsum("wim,mn,wjn->wij", solved.gain, solved.var_p, solved.gain, optimize=True)
        variances[i] = (slopes * (solved.alone + moved)).sum()
    share = np.minimum(variances / np.square(fit.noise.sigma) / size_or_one(sums.weight), _MOST_TAKEN)
    return replace(sums, squares=sums.squares / (1.0 - share))


def noise_of_inputs(intervals: Windows, fit: Fit) -> FloatArray:
    """Standard deviation ``(n_u,)`` of the noise of each input, its unit; 0 where the logs show none.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    """
    if not intervals.noisy:
        return np.zeros(intervals.model.n_u)
    noise = fit.tau * np.sqrt(intervals.length)
    return np.where(noise > 2.0 * _NONE * _sizes(intervals), noise, 0.0)


def averaged_noise(intervals: Windows, fit: Fit) -> float:
    """Negative log evidence by which noise is less likely as it was recorded than as it acts; 0 without noise, nats.

    A lag, a fraction of a sample by which a held input is late, and interpolation average the noise of samples.  The
    fit is at its optimum.
    """
    if not intervals.noisy:
        return 0.0
    at, errors, n_u = linearize(intervals, fit, weights_of(intervals, fit)), intervals.all_errors, len(fit.tau)
    left = at.system.solve(at.right_z, at.right_s).var_z[:, fit.x.shape[1] :] / np.square(fit.tau)
    impulse = np.zeros((_RESPONSE, n_u))
    impulse[_RESPONSE // 2] = 1.0
    acting = acting_inputs(impulse, errors.input_delay, errors.input_lag, np.zeros(n_u), intervals.hold, _RESPONSE)
    if intervals.hold != "zero-order":
        acting = 0.5 * (acting[1:] + acting[:-1])
    power = np.square(acting).sum(axis=0) / np.square(acting.sum(axis=0))
    return float(-0.5 * ((1.0 - left).sum(axis=0) * np.log(power)).sum())


def simpler_timings(intervals: Windows, *, free_hold: bool) -> list[Windows]:
    """The intervals with delays and lags of all inputs alone; and with delays of whole samples instead of any.

    Parameters
    ----------
    intervals : Windows
    free_hold : bool
        Whether inputs may be held, too, where they are interpolated.

    Returns
    -------
    list of Windows
        Those that differ.
    """
    sizes, late = intervals.all_errors.sizes, defaultdict[EffectKind, float](float)
    timings = [kind for kind in sizes if kind.of_inputs and kind.what != "drift"]
    for kind in timings:
        late[replace(kind, what="delay")] += sizes[kind]
    of_sensors = {kind: size for kind, size in sizes.items() if not kind.of_inputs}
    common = of_sensors | {kind: sizes[kind] for kind in timings if kind == intervals.all_inputs(kind.what)}
    whole = of_sensors | {kind: float(np.round(size)) for kind, size in late.items() if np.round(size)}
    hold = "zero-order" if free_hold else intervals.hold
    simpler = [(common, intervals.hold), (whole, hold)]
    differs = [x for k, x in enumerate(simpler) if x not in ((sizes, intervals.hold), *simpler[:k])]
    return [replace(intervals, errors=replace(intervals.all_errors, sizes=x), hold=hold) for x, hold in differs]


def may_explain(intervals: Windows, fit: Fit, prior: Prior, projected: FloatArray | None) -> bool:
    """True if an exact model leaves white accelerations, or if some of those that a flexible one leaves vary fast.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    prior : Prior
        Its size of unmodelled accelerations is that with which an exact model is tested for them.
    projected : (n,) array or None
        Parameters by least squares on the fitted motion; None: the model is exact.
    """
    if not intervals.model.n_u:
        return False
    if projected is not None:
        rest = unexplained(intervals, fit, projected)
        alike = (rest[1:] * rest[:-1]).sum(axis=0) < _SLOW * np.square(rest).sum(axis=0)
        return bool(alike.any() or (fit.rho < _SLOW)[fit.tau > prior.tau].any())
    fit = replace(fit, tau=prior.tau, rho=np.zeros_like(fit.rho))
    at = linearize(intervals, fit, weights_of(intervals, fit))
    solved = at.system.solve(at.right_z, at.right_s)
    moved = replace(fit, d=fit.d + solved.step_z[:, fit.x.shape[1] :])
    sums = process_sums(intervals, moved, solved).total()
    return bool((sums.surplus > _CLEAR * np.sqrt(2.0 * sums.weight)).any())


def explains_all(intervals: Windows, fit: Fit, library: TermLibrary | None, *, instead_of_exact: bool) -> bool:
    """True if inputs have noise, which is white, and no term of the motion explains it.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        At its optimum, with noise of inputs.
    library : callable or None
        The user's candidates for terms.
    instead_of_exact : bool
        Whether an exact model is the alternative, whose intervals noise widens: it need not be seen to be white then.
    """
    if not (noise_of_inputs(intervals, fit).any() and is_white(intervals, fit, 0.0 if instead_of_exact else _SEEN)):
        return False
    moved = with_accelerations(intervals, fit, fitted_parameters(intervals, fit))
    return not missing_terms(candidates_of_fit(*moved, library)).suggestions


def is_white(intervals: Windows, fit: Fit, seen: float) -> bool:
    """True if noise of inputs and of signals is white: without power at low frequencies, and without bursts.

    Errors of inputs may take up the forces that a model lacks, which have both.  Estimates of errors, and their sums
    over stretches of the log, have the variances that their priors lose to the measurements, and sums of residuals at
    most that of their noise; fourth moments are three times the squared variances.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        At its optimum, with noise of inputs.
    seen : float
        Part of the errors of an input that the measurements determine, at least.
    """
    n_x, n_u, W = fit.x.shape[1], fit.d.shape[1], len(intervals)
    weights, starts = weights_of(intervals, fit), np.arange(0, W, -(-W // _STRETCHES))
    at = linearize(intervals, fit, weights)
    # Posterior variances of the errors, and covariances with their sums over stretches.
    part = np.searchsorted(starts, np.arange(W), side="right") - 1
    columns = np.zeros((W, n_x + n_u, n_u, len(starts)))
    for j in range(n_u):
        columns[np.arange(W), n_x + j, j, part] = 1.0
    found, _ = at.system.functional(columns.reshape(W, n_x + n_u, -1), np.zeros((len(fit.shared), n_u * len(starts))))
    common = found.reshape(columns.shape)[:, n_x:].diagonal(axis1=1, axis2=2)[np.arange(W), part]
    prior = np.square(fit.tau)
    slow = np.square(np.add.reduceat(fit.d, starts)).sum(axis=0) / (W * prior - common.sum(axis=0))
    variances = prior - at.system.solve(at.right_z, at.right_s).var_z[:, n_x:]
    bursts = (fit.d**4).sum(axis=0) / (3.0 * np.square(variances).sum(axis=0))
    white = (weights * fit.residuals * fit.noise.sigma).reshape(W, -1, weights.shape[1]).sum(axis=1)
    residuals = np.square(np.add.reduceat(white, starts)).sum(axis=0)
    shown = noise_of_inputs(intervals, fit) > 0.0
    is_noise = (slow < _WHITE) & (bursts < _WHITE) & (bursts > 1.0 / _WHITE)
    if (variances.mean(axis=0) < seen * prior)[shown].all():
        return False
    return bool(is_noise[shown].all() and (residuals <= _WHITE * intervals.known.sum(axis=0)).all())


def with_accelerations(
    intervals: Windows, fit: Fit, result: ProjectedEstimate
) -> tuple[Windows, Fit, ProjectedEstimate]:
    """The same motion with unmodelled accelerations instead of the noise of inputs, whose size they have.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
    result : ProjectedEstimate
    """
    if not intervals.noisy:
        return intervals, fit, result
    d, plain = unexplained(intervals, fit, fit.shared, recorded=True), replace(intervals, noisy=False)
    tau = np.sqrt(np.square(d).mean(axis=0))
    tau = np.maximum(tau, _NONE * tau.max())
    moved = with_residuals(plain, replace(fit, d=d, tau=tau, rho=np.zeros_like(tau)))
    of_z = np.zeros((*d.shape[:1], fit.x.shape[1] + d.shape[1], len(result.parameters)))
    return plain, moved, replace(result, of_z=of_z)
