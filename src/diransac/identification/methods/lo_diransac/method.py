"""lo-diransac: random minimal samples, consensus by simulation, local optimisation.

1. `gate`: what is not to be used at all.
2. `smoothing`: the motion without a model.
3. `hypotheses`: parameters from random samples of the equations in weak form, judged by simulation.
4. `refinement`: the most probable motion and parameters, noise and deviations from the model, from the best of them.
5. `readout`: parameters that hold for the whole motion, and their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import IdentificationError, LogError, ModelError
from diransac.identification.methods.lo_diransac.gate import mended_inputs, stuck_rows
from diransac.identification.methods.lo_diransac.hypotheses import find_hypotheses, n_samples, robust_scores
from diransac.identification.methods.lo_diransac.mixture import BREAKDOWN
from diransac.identification.methods.lo_diransac.readout import deviation_units, parameter_units, read_out, unexplained
from diransac.identification.methods.lo_diransac.refinement import believe, refine, start
from diransac.identification.methods.lo_diransac.smoothing import choose_half_width, running_median, smooth
from diransac.identification.methods.lo_diransac.windows import Windows

if TYPE_CHECKING:
    from diransac.data.dataset import Observations
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.readout import Readout
    from diransac.identification.methods.lo_diransac.refinement import Belief, Refinement
    from diransac.identification.methods.lo_diransac.smoothing import Motion

__all__ = ["Findings", "find"]


_FEWEST_WINDOWS = 4
# Half a row of delay or more is taken up by shifting the inputs, as often as needed.
_WHOLE_ROW, _MAX_SHIFTS = 0.5, 3
# Local optimisations at most, and the difference in their losses, nats, that shows nothing.
_MAX_STARTS, _MAX_FITS, _AS_LIKELY = 5, 8, 5.0
_OUTLIER = 0.5
# Rows that inputs may be late by, to begin with.
_SHIFTS = range(-3, 9)
# A share of a signal's spread that is no noise any more.
_ALL_OF_IT = 0.8
# A delay that is worth a word: so many standard errors, and so many rows.
_SURE, _SMALL_DELAY = 3.0, 0.25


@dataclass(frozen=True)
class Findings:
    """What lo-diransac found in a log.

    Parameters
    ----------
    parameters, covariance : (n_p,), (n_p, n_p)
    states : (W, n_x)   of the most probable motion, at the first row of each window
    unidentifiable : (n_p,)   parameters whose 95 % interval spans more than all of an equation's inertial force
    noise_std, outlier_fraction : (n_s,)   of each signal of the model; NaN where it is not measured
    outliers : (N, n_s)   samples that are more likely outliers than not
    latent_middles, unmodelled_accelerations : (W,), (W, n_v)   middle row of each window, and its unmodelled part
    unmodelled_forces : (W, n_v)   the same as generalised forces; None where the equations are no balance of forces
    input_delay, input_delay_error : s; input_delay_significant : whether that is more than errors of estimation
    samples, hypotheses, steps : samples drawn, hypotheses judged on the whole log, Gauss-Newton steps
    settled : whether local optimisation ended before its limit
    notes : what was found and done, a sentence each
    """

    parameters: FloatArray
    covariance: FloatArray
    states: FloatArray
    unidentifiable: BoolArray
    noise_std: FloatArray
    outlier_fraction: FloatArray
    outliers: BoolArray
    latent_middles: FloatArray
    unmodelled_accelerations: FloatArray
    unmodelled_forces: FloatArray | None
    input_delay: float
    input_delay_error: float
    input_delay_significant: bool
    samples: int
    hypotheses: int
    steps: int
    settled: bool
    notes: tuple[str, ...]


def find(observations: Observations, seed: int) -> Findings:
    """Parameters of the model from the log, without starting values or thresholds.

    Raises LogError: the log is too short; IdentificationError: no sample of it gives parameters within their bounds.
    """
    windows, motion, notes = _prepare(observations)
    hypotheses, _ = find_hypotheses(windows, motion, seed, observations)
    if not len(hypotheses):
        raise IdentificationError(
            f"{observations.log.source}: no sample of the log gives parameters within their bounds; check the model, "
            "the signs and units of inputs, and the bounds"
        )
    belief = believe(windows, motion, deviation_units(windows, motion, hypotheses[0]))
    late, refined = _best_when_late(windows, motion, hypotheses, belief)
    windows, refined, later = _shifted(windows.delayed(late), refined, belief)
    result = read_out(windows, refined.fit)
    if not _admits(windows, result.parameters):
        # The fit keeps to the bounds, least squares on its motion need not.
        kept = refined.fit.shared[: windows.model.n_p]
        result = replace(result, parameters=kept, unexplained=unexplained(windows, refined.fit, kept))
        notes = (*notes, "a bound of the parameters is reached; they are those of the most probable motion")
    if _explains_nothing(windows, motion, refined):
        notes = (*notes, "the model explains hardly anything of this log: do not rely on these parameters")
    if not refined.settled:
        notes = (*notes, "local optimisation had not settled when it reached its limit of steps")
    return _findings(observations, windows, motion, refined, result, late + later, len(hypotheses), notes)


def _admits(windows: Windows, parameters: FloatArray) -> bool:
    return all(bounds.admits(x) for bounds, x in zip(windows.model.parameters.values(), parameters, strict=True))


def _explains_nothing(windows: Windows, motion: Motion, refined: Refinement) -> bool:
    """Whether the noise of every signal is as large as the signal."""
    seen = windows.known.any(axis=0)
    return bool((refined.fit.noise.sigma > _ALL_OF_IT * motion.spread)[seen].all())


def _prepare(observations: Observations) -> tuple[Windows, Motion, tuple[str, ...]]:
    """The log in windows of the motion's own time scale, and the motion."""
    model, dt = observations.model, observations.log.dt
    measured = np.full((len(observations), len(model.signals)), np.nan)
    measured[:, [model.signals.index(n) for n in observations.signals]] = observations.measured
    stuck = stuck_rows(observations.measured)
    known = np.isfinite(measured) & ~stuck[:, None]
    measured = np.where(known, measured, 0.0)
    inputs, n_leaps = mended_inputs(observations.inputs)
    notes = []
    if stuck.any():
        notes.append(f"{stuck.sum()} rows repeat the row before in every signal, and were taken as missing")
    if n_leaps:
        notes.append(f"inputs leap for a moment in {n_leaps} rows; the running median stands in for them")
    centre = running_median(measured, known)
    half = choose_half_width(model, measured, known, centre, dt)
    if len(observations) < _FEWEST_WINDOWS * half:
        raise LogError(
            f"{observations.log.source}: {len(observations)} rows are too few; lo-diransac needs at least "
            f"{_FEWEST_WINDOWS * half}. Give a longer log"
        )
    motion = smooth(model, measured, known, centre, dt, half)
    return Windows(model, measured, known, inputs, dt, half), motion, tuple(notes)


def _best(windows: Windows, motion: Motion, hypotheses: FloatArray, belief: Belief) -> Refinement:
    """Local optimisation from the best hypothesis; where it leaves a doubt, from others; the likeliest of these.

    Doubtful is what takes most of a window for outliers: sensors may have failed there, or the fit.  What was found
    then becomes a hypothesis itself if it is the likeliest so far, or else the next one has its turn; doubt ends with a
    second fit that is as likely.
    """
    waiting = list(hypotheses[:_MAX_STARTS])
    found: list[Refinement] = []
    while waiting and len(found) < _MAX_FITS:
        found.append(refine(windows, start(windows, motion, waiting.pop(0), belief), belief))
        again = any(abs(found[-1].loss - x.loss) < _AS_LIKELY for x in found[:-1])
        if again or not _is_doubtful(windows, found[-1]):
            break
        if all(found[-1].loss < x.loss for x in found[:-1]):
            waiting.insert(0, found[-1].fit.shared[: windows.model.n_p])
    return replace(min(found, key=lambda x: x.loss), steps=sum(x.steps for x in found))


def _is_doubtful(windows: Windows, refined: Refinement) -> bool:
    """Whether some window has too few inlying samples for a robust scale to stand on."""
    fit = refined.fit
    inlying = (fit.noise.inlying(fit.residuals, windows.known) > _OUTLIER).reshape(len(windows), -1).sum(axis=1)
    return bool((inlying < BREAKDOWN * windows.known.reshape(len(windows), -1).sum(axis=1)).any())


def _best_when_late(windows: Windows, motion: Motion, hypotheses: FloatArray, belief: Belief) -> tuple[int, Refinement]:
    """How many rows inputs are late by, and the best fit then.

    Where the hypotheses say that they are late at all, the neighbouring rows are tried, too, and theirs, as long as the
    fit becomes likelier: hypotheses come from inputs that were taken to be in time.
    """
    late = _likeliest_shift(windows, motion, hypotheses[0])
    fits = {late: _best(windows.delayed(late), motion, hypotheses, belief)}
    for step in (-1, 1) if late else ():
        while abs(late + step) < windows.length:
            other = _best(windows.delayed(late + step), motion, hypotheses, belief)
            fits[late + step] = other
            if other.loss >= fits[late].loss:
                break
            late += step
    return late, replace(fits[late], steps=sum(fit.steps for fit in fits.values()))


def _likeliest_shift(windows: Windows, motion: Motion, p: FloatArray) -> int:
    """Rows that inputs are late by if simulations with the best hypothesis are to agree best with the log.

    Inputs that are held for many rows and then leap make few outliers when they are taken to be early or late, and
    local optimisation would rest there; so whole rows are settled before it begins.
    """
    every = np.arange(len(windows))
    scores = {rows: float(robust_scores(windows.delayed(rows), motion, p[None], every)[0]) for rows in _SHIFTS}
    return min(scores, key=lambda rows: (scores[rows], abs(rows)))


def _shifted(windows: Windows, refined: Refinement, belief: Belief) -> tuple[Windows, Refinement, int]:
    """Local optimisation again with the inputs shifted by whole rows, while it finds them late."""
    shift, steps = 0, refined.steps
    for _ in range(_MAX_SHIFTS):
        delay = refined.fit.shared[-1]
        if not _WHOLE_ROW <= abs(delay) < windows.length:
            break
        shift += round(delay)
        windows = windows.delayed(round(delay))
        shared = np.append(refined.fit.shared[:-1], delay - round(delay))
        prior = np.append(refined.fit.prior[:-1], belief.delay)
        refined = refine(windows, windows.judged(replace(refined.fit, shared=shared, prior=prior)), belief)
        steps += refined.steps
    return windows, replace(refined, steps=steps), shift


def _findings(
    observations: Observations,
    windows: Windows,
    motion: Motion,
    refined: Refinement,
    result: Readout,
    shift: int,
    n_hypotheses: int,
    notes: tuple[str, ...],
) -> Findings:
    fit, N, dt = refined.fit, len(observations), windows.dt
    delay = float(shift + fit.shared[-1])
    seen = windows.known.any(axis=0)
    inlying = fit.noise.inlying(fit.residuals, windows.known)[:N]
    spans = np.sqrt(np.diag(result.covariance)) * 1.96
    units = parameter_units(windows, motion, result.parameters)
    return Findings(
        parameters=result.parameters,
        covariance=result.covariance,
        states=fit.x.copy(),
        unidentifiable=~(spans < units),
        noise_std=np.where(seen, fit.noise.sigma, np.nan),
        outlier_fraction=np.where(seen, fit.noise.pi, np.nan),
        outliers=windows.known[:N] & (inlying < _OUTLIER),
        latent_middles=np.asarray(windows.starts + 0.5 * (windows.length - 1), np.float64),
        unmodelled_accelerations=result.unexplained,
        unmodelled_forces=_latent_forces(windows, fit, result),
        input_delay=float(delay * dt),
        input_delay_error=result.delay_error * dt,
        input_delay_significant=abs(delay) > max(_SURE * result.delay_error, _SMALL_DELAY),
        samples=n_samples(windows.model),
        hypotheses=n_hypotheses,
        steps=refined.steps,
        settled=refined.settled,
        notes=notes,
    )


def _latent_forces(windows: Windows, fit: Fit, result: Readout) -> FloatArray | None:
    """Generalised forces (W, n_v) that make the latent accelerations, at the windows' starts."""
    model = windows.model
    try:
        response = model.force_response
    except ModelError:
        return None
    motion = (fit.x[:, : model.n_q].T, fit.x[:, model.n_q :].T, windows.inputs[windows.starts].T, result.parameters)
    columns = [np.array(response(*motion, np.repeat(f[:, None], len(fit.x), axis=1))).T for f in np.eye(model.n_v)]
    return np.asarray(np.linalg.solve(np.stack(columns, axis=-1), result.unexplained[:, :, None])[:, :, 0])
