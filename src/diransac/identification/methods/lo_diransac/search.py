"""Search of the likeliest explanation of the logs, from random samples or from an estimate with its motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.input_timing import InputTiming
from diransac.errors import IdentificationError, TimeLimitError
from diransac.identification.core.minimise import diverges, make_prior, start
from diransac.identification.method import report, within
from diransac.identification.methods.lo_diransac.hypotheses import find_hypotheses
from diransac.identification.methods.lo_diransac.local_search import LATE, LocalSearch
from diransac.identification.methods.lo_diransac.motion_equations import discrepancy_units, residuals_of_motion
from diransac.identification.methods.lo_diransac.projection import (
    ProjectedEstimate,
    estimate_parameters,
    fitted_parameters,
)
from diransac.identification.methods.lo_diransac.recording_errors import LEAST_DELAY, errors_of
from diransac.identification.methods.lo_diransac.unmeasured import (
    unmeasured_by_name,
    unmeasured_states,
    with_observed_states,
    with_unmeasured_states,
)
from diransac.identification.regression.rows import MotionRows
from diransac.identification.structure.prospects import Prospects
from diransac.identification.structure.refusal import cause_of_refusal
from diransac.time_limit import check_time

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.windows import Windows
    from diransac.identification.estimate import Competition
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.recording_errors import RecordingError
    from diransac.identification.methods.lo_diransac.segments import ActingInputs
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.sources import Candidate

_ALL_OF_IT = 0.8
"""Fraction of a signal's spread from which on its noise leaves nothing to explain, and of its samples for outliers."""
_MUCH = 0.1
"""Unexplained part of an acceleration from which on states that nothing measures are doubtful."""
_TINY = 1e-9


@dataclass(frozen=True)
class Decided:
    """Outcome of a competition.

    Its summary, the inputs of the winner unless it is an estimate of the fit, the winner with the parameters of the
    answer, and the rows of the horizon over which it predicts best.
    """

    summary: Competition
    acting: ActingInputs | None
    answer: Candidate
    n_rows: int


@dataclass(frozen=True, eq=False, repr=False)
class Searched:
    """The likeliest explanation of the logs, and the motion that its search began with.

    ``decided`` is the outcome of a competition; None where there was none.  ``impossible`` names parameters that would
    violate a strict bound by least squares of the whole motion; the result is that of the fit then.
    """

    motion: Motion
    notes: tuple[str, ...]
    n_hypotheses: int
    likeliest: Explanation
    result: ProjectedEstimate
    impossible: tuple[str, ...]
    decided: Decided | None = None

    @cached_property
    def common_timing(self) -> RecordingError | None:
        """Delay and lag of all inputs together, samples, with a standard error; None where no input moves.

        Where the explanation has neither, it is the delay that its residuals suggest.
        """
        intervals, fit = self.likeliest.intervals, self.likeliest.refinement.fit
        sizes = intervals.all_errors.sizes
        kinds = [x for x in map(intervals.all_inputs, LATE) if x in sizes]
        found = errors_of(intervals, fit, kinds or [intervals.all_inputs("delay")])
        whole = sum(sizes[x] for x in kinds)
        left = 0.0 if intervals.noisy else found[0].size if found else 0.0  # the noise of a sample would move it
        return replace(found[0], size=whole + left) if found else None

    @property
    def is_late(self) -> bool:
        """True for a delay or a lag that all inputs have in common, and none of which has another of its own."""
        intervals = self.likeliest.intervals
        late = [x for x in intervals.all_errors.kinds if x.of_inputs and x.what in LATE]
        common = self.common_timing
        is_shared = bool(late) and all(x == intervals.all_inputs(x.what) for x in late)
        return is_shared and common is not None and abs(common.size) > LEAST_DELAY

    def timing(self, *, forced: bool) -> InputTiming:
        """Delays, lags and drifts of the inputs; a negligible delay of all counts if it is forced."""
        intervals = self.likeliest.intervals
        errors, dt = intervals.all_errors, intervals.dt
        common = errors.sizes.get(intervals.all_inputs("delay"), 0.0)
        delays = errors.input_delay - common * (abs(common) < LEAST_DELAY and not forced)
        return InputTiming.of(delays * dt, errors.input_lag * dt, errors.gain_drift)

    def corrected(self, intervals: Windows) -> Windows:
        """Intervals of the same logs, corrected of the errors of sensors of the explanation."""
        own = self.likeliest.intervals
        sizes = {kind: x for kind, x in own.all_errors.sizes.items() if not kind.of_inputs}
        errors = replace(own.all_errors, sizes=sizes)
        return replace(intervals, measured=own.measured, sampled=own.sampled, errors=errors)

    @property
    def explains_nothing(self) -> bool:
        """True if the noise of every signal is as large as the signal, or nearly all of its samples are outliers."""
        seen, noise = self.likeliest.intervals.known.any(axis=0), self.likeliest.refinement.fit.noise
        nothing = (noise.sigma > _ALL_OF_IT * self.motion.spread) | (noise.pi > _ALL_OF_IT)
        return bool(nothing[seen].all())

    @property
    def unexplained(self) -> float:
        """Largest RMS acceleration that the model does not explain, over the spread of its motion.

        That of states which nothing measures is the spread of the fit; their motion before it was that of a hypothesis.
        """
        intervals, motion, hidden = self.likeliest.intervals, self.motion, unmeasured_states(self.likeliest.intervals)
        model, first = intervals.model, intervals.model.n_q + intervals.model.n_v
        fitted = residuals_of_motion(intervals, self.likeliest.refinement.fit, self.result.parameters)[0][2]
        measured = np.array([name not in hidden for name in model.velocities])
        spread = np.where(
            measured, motion.spread[first : first + model.n_v], fitted[intervals.counted].std(axis=0) + _TINY
        )
        left = np.sqrt(np.square(self.result.unexplained[intervals.occupied]).mean(axis=0))
        return float((left / spread).max())

    @property
    def is_doubtful(self) -> bool:
        """True if much is unexplained of a motion of which nothing measures a part: either may be anything.

        The unmeasured states may have begun on wrong trajectories, for which a resonance that smoothing takes for noise
        is enough.
        """
        return bool(unmeasured_states(self.likeliest.intervals)) and self.unexplained > _MUCH


def likeliest(
    settings: LoDiransacSettings,
    dataset: Dataset,
    seed: int,
    callback: Callback | None,
    whole: tuple[Windows, Motion, tuple[str, ...]],
) -> Searched:
    """The likeliest explanation of the logs.

    Where states that nothing measures are not those of an exact model at once, they may have begun on wrong
    trajectories, for which a resonance that smoothing takes for noise is enough.  A second search begins with the
    motion of observers, and the likelier explanation counts; a third where that has found errors of sensors.
    """
    intervals, motion, notes = whole
    if not unmeasured_states(intervals):
        return searched(settings, intervals, motion, notes, seed, dataset, callback)
    report(callback, "unmeasured states", 0.05)
    try:
        completed = _completed(intervals, motion, dataset)
        first = searched(settings, intervals, completed, notes, seed, dataset, callback)
    except (IdentificationError, np.linalg.LinAlgError):
        observed = with_observed_states(intervals, motion)
        if observed is None:
            raise
        return searched(settings, intervals, observed, notes, seed, dataset, within(callback, 0.87, 0.9))
    best, tried = first, None
    try:
        # Observers follow the samples: late ones mislead them, and are followed again once they are corrected.
        while not best.likeliest.exact and (sensors := best.corrected(intervals)).all_errors.kinds != tried:
            observed, tried = with_observed_states(sensors, motion), sensors.all_errors.kinds
            if observed is not None:
                further, rival = within(callback, 0.87, 0.9), best.likeliest
                other = searched(settings, sensors, observed, notes, seed, dataset, further, rival=rival)
                best = min(best, other, key=lambda x: x.likeliest.cost)
    except TimeLimitError:
        return replace(best, likeliest=replace(best.likeliest, complete=False))
    except (IdentificationError, np.linalg.LinAlgError):
        pass  # the search before stands
    return best


def searched(
    settings: LoDiransacSettings,
    intervals: Windows,
    motion: Motion,
    notes: tuple[str, ...],
    seed: int,
    dataset: Dataset,
    callback: Callback | None,
    hypotheses: FloatArray | None = None,
    rival: Explanation | None = None,
) -> Searched:
    """A search that begins with a motion, and with hypotheses or samples; a rival may end it early."""
    report(callback, "drawing hypotheses", 0.1)
    check_time()
    if hypotheses is None:
        hypotheses = _hypotheses(settings, intervals, motion, seed, dataset)
    prior = make_prior(settings, intervals, motion, discrepancy_units(intervals, motion, hypotheses[0]))
    able = next((p for p in hypotheses if not diverges(start(settings, intervals, motion, p, prior))), None)
    if able is None:
        raise IdentificationError(
            f"{dataset.source}: simulations of {intervals.length} rows from smoothed states diverge, with each of "
            f"{len(hypotheses)} samples of the parameters; compare the model with the machine, or bound them"
        )
    search = LocalSearch(settings, motion, able, prior, callback)
    likeliest = search.likeliest(intervals, free_hold=dataset.input_hold is None, rival=rival)
    return Searched(motion, notes, len(hypotheses), likeliest, *parameters_of(likeliest))


def parameters_of(likeliest: Explanation) -> tuple[ProjectedEstimate, tuple[str, ...]]:
    """Parameters of an explanation: the fit's where others would violate strict bounds, with the names of these.

    Parameters
    ----------
    likeliest : Explanation
    """
    intervals, fit = likeliest.intervals, likeliest.refinement.fit
    if likeliest.exact:
        return fitted_parameters(intervals, fit), ()
    result, layout = estimate_parameters(intervals, fit), intervals.layout
    impossible = layout.violations(result.parameters)
    return (fitted_parameters(intervals, fit) if impossible else result), impossible


def _completed(intervals: Windows, motion: Motion, dataset: Dataset) -> Motion:
    """The motion with its unmeasured states.  Raises IdentificationError: no simulation gives them."""
    found = with_unmeasured_states(intervals, motion)
    if found is None:
        names = unmeasured_by_name(intervals)
        raise IdentificationError(
            f"{dataset.source}: nothing measures {names}, nor a derivative, and every simulation of {names} from the "
            "other signals diverges; measure it, or bound the parameters of its equation"
        )
    return found


def _hypotheses(
    settings: LoDiransacSettings, intervals: Windows, motion: Motion, seed: int, dataset: Dataset
) -> FloatArray:
    """Hypotheses, best first.  Raises IdentificationError: there are none, and the message names the cause."""
    found = find_hypotheses(settings, intervals, motion, seed, dataset)
    if len(found):
        return found
    cause = cause_of_refusal(dataset.model, dataset.layout, rows_of_logs(intervals, motion))
    raise IdentificationError(f"{dataset.source}: no sample gives parameters within their bounds: {cause}")


def prospects_of(dataset: Dataset, intervals: Windows, motion: Motion) -> Prospects:
    """Prospects of a search by the smoothed motion; of no row where it lacks states that nothing measures."""
    rows = [] if unmeasured_states(intervals) else rows_of_logs(intervals, motion)
    return Prospects(dataset.model, dataset.layout, rows)


def rows_of_logs(intervals: Windows, motion: Motion) -> list[MotionRows]:
    """Rows of the smoothed motion of each log."""
    logged = [np.arange(x.start, x.stop)[intervals.is_logged[x]] for x in intervals.rows_of_logs]
    parts = [motion.parts(intervals.model, rows) for rows in logged]
    return [MotionRows(q, v, a, intervals.inputs[rows], y) for (q, v, a, y), rows in zip(parts, logged, strict=True)]
