"""Search for systematic errors of recordings: delays and biases of sensors, delays, lags and drifts of inputs.

A sensor is here whatever measures a signal, with a measurement equation or without.  A score test finds the most
significant error, given all else that is estimated; it costs a call of the simulator, and no fit.  From then on the
error is an unknown of the fit as others (`core/equations.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from diransac.arrays import BoolArray
from diransac.identification.core.columns import Columns, changes_by, recorrected, scores_tested, signal_rates
from diransac.identification.core.equations import JointEquations, linearize
from diransac.identification.core.fit import weights_of
from diransac.identification.core.theta import EffectKind, is_possible, largest_size

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows

LEAST_DELAY = 0.1
"""Delay, samples, from which on one is tried, and named."""

# Standard errors from which on an error of a sensor is tried.
_CLEAR = 3.0
# Groups of which a fit is made at a time.
_GROUPS = 4
# Numbers of the sensitivities that are held at a time.
_NUMBERS_AT_A_TIME = 1_000_000
# Signals that are known in fewer rows than this are not tested.
_FEWEST = 50
_OF_INPUTS: tuple[Literal["delay", "lag", "drift"], ...] = ("delay", "lag", "drift")


@dataclass(frozen=True)
class RecordingError:
    """An error of one signal or input, or of a group.

    Parameters
    ----------
    kind : EffectKind
    size : float
        Its estimate: samples, the signal's unit, or relative to the gain.
    std : float
        Its standard error.
    gain : float
        Evidence that it would gain, nats, if the residuals were white.
    """

    kind: EffectKind
    size: float
    std: float
    gain: float

    @property
    def ratio(self) -> float:
        """Its size over its standard error."""
        return abs(self.size) / self.std


def clear_errors(intervals: Windows, fit: Fit, tested: Sequence[EffectKind], *, worth: float) -> list[RecordingError]:
    """Errors that the residuals show most clearly: of a single signal, some of groups of signals, and of inputs.

    Groups that are late alike show nearly as clearly as others that are early, and a delay of inputs nearly as a lag;
    fits of each tell them apart.  They are judged by the evidence that they promise: a delay of many samples leaves
    residuals whose scores scatter by itself.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        At its optimum.
    tested : sequence of EffectKind
    worth : float
        Evidence that an error of a group, or of inputs, must promise, nats.

    Returns
    -------
    list of RecordingError
        Empty if no error is clear.
    """
    at_a_time = max(1, _NUMBERS_AT_A_TIME // intervals.measured.size)
    found = [
        x
        for x in errors_tested(intervals, fit, tested, at_a_time)
        if is_possible(intervals, x.kind, x.size) and (x.kind.what != "delay" or abs(x.size) > LEAST_DELAY)
    ]
    inputs = [x for x in found if x.kind.of_inputs and x.gain > worth]
    single = [x for x in found if len(x.kind.columns) == 1 and not x.kind.of_inputs and x.ratio > _CLEAR]
    groups = [x for x in found if len(x.kind.columns) > 1 and not x.kind.of_inputs and x.gain > worth]
    single.sort(key=lambda x: x.ratio, reverse=True)
    groups.sort(key=lambda x: x.gain, reverse=True)
    common = [intervals.all_inputs(what) for what in _OF_INPUTS]
    inputs.sort(key=lambda x: x.gain + worth * (x.kind in common))  # an input without effect has no timing of its own
    likeliest = {x.kind.what: x for x in inputs}
    return [*single[:1], *groups[:_GROUPS], *likeliest.values()]


def errors_tested(intervals: Windows, fit: Fit, kinds: Sequence[EffectKind], at_a_time: int) -> list[RecordingError]:
    """Estimates of errors one by one, given all else that is estimated.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        At its optimum.
    kinds : sequence of EffectKind
    at_a_time : int
        Number of errors whose sensitivities, of a number for every sample, are held at a time.
    """
    intervals, fit, rates = recorrected(intervals, fit)
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


def errors_of(intervals: Windows, fit: Fit, kinds: Sequence[EffectKind]) -> list[RecordingError]:
    """Remainders of some errors, estimated together, clear or not.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        At its optimum.
    kinds : sequence of EffectKind

    Returns
    -------
    list of RecordingError
        Without impossible ones.
    """
    joint = JointEquations.of(intervals, fit, kinds)
    sizes, std, _ = joint.errors_of(joint.solve())
    each = zip(kinds, sizes.tolist(), std.tolist(), strict=True)
    found = [RecordingError(kind, size, std, 0.5 * (size / std) ** 2) for kind, size, std in each]
    return [x for x in found if is_possible(intervals, x.kind, x.size)]


def with_errors(intervals: Windows, fit: Fit, errors: Sequence[RecordingError]) -> Windows:
    """The intervals with measurements that are corrected of errors, too.

    Parameters
    ----------
    intervals : Windows
    fit : Fit
        Of which the rates of signals are taken.
    errors : sequence of RecordingError

    Returns
    -------
    Windows
    """
    return intervals.corrected({x.kind: x.size for x in errors}, signal_rates(intervals, fit))


def errors_of_signals(intervals: Windows, among: BoolArray) -> list[EffectKind]:
    """Errors that signals may have: delays and biases of single ones, and delays of groups.

    A group are the coordinates, the velocities, ..., or those of one unit, as one instrument measures them.  The bias
    of a sensor that has one as a parameter is none.

    Parameters
    ----------
    intervals : Windows
    among : (n_s,) bool array
        Single signals.

    Returns
    -------
    list of EffectKind
    """
    model = intervals.model
    seen = intervals.known.sum(axis=0) >= _FEWEST
    n = len(model.velocities_of_motion)
    kind = np.repeat([0, 1, 3, 2, 3, 4], [model.n_q, n, model.n_v - n, n, model.n_v - n, len(model.sensors)])
    single = [np.arange(len(seen)) == i for i in np.flatnonzero(seen & among)]
    unit = np.array([model.units[n] for n in model.signals])
    masks = [kind == g for g in (0, 1, 2, 4)]
    masks += [mask & (unit == u) for mask in masks for u in dict.fromkeys(unit[mask])]
    groups = [mask & seen for mask in masks]
    late = [x for x in (*groups, *single) if x.any() and not (x == seen).all()]
    biased = np.array([n in model.biased_sensors for n in model.signals])
    kinds = [EffectKind(_places(x), "delay") for x in late]
    return list(dict.fromkeys([*kinds, *(EffectKind(_places(x), "bias") for x in single if not biased[x].any())]))


def errors_of_inputs(intervals: Windows) -> list[EffectKind]:
    """Errors that inputs may have: delays, lags and drifts of the gain, of all, of those of one unit, and of each.

    Parameters
    ----------
    intervals : Windows

    Returns
    -------
    list of EffectKind
    """
    model = intervals.model
    unit = np.array(list(model.inputs.values()))
    moving = np.ptp(intervals.inputs, axis=0) > 0.0
    masks = [moving, *(moving & (unit == u) for u in dict.fromkeys(unit.tolist())), *np.eye(len(unit), dtype=bool)]
    some = [x for x in masks if (x & moving).any()]
    return list(dict.fromkeys(EffectKind(_places(x), what, of_inputs=True) for what in _OF_INPUTS for x in some))


def _places(mask: BoolArray) -> tuple[int, ...]:
    return tuple(np.flatnonzero(mask).tolist())
