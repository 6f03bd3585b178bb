"""Search for systematic errors of recordings: delays and biases of sensors, delays, lags and drifts of inputs.

A sensor is here whatever measures a signal, with a measurement equation or without.  A score test finds the most
significant error, given all else that is estimated; it costs a call of the simulator, and no fit.  From then on the
error is an unknown of the fit as others (`joint_equations`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import numpy as np

from diransac.arrays import BoolArray
from diransac.identification.methods.lo_diransac.corrections import ErrorKind
from diransac.identification.methods.lo_diransac.joint_equations import (
    JointEquations,
    RecordingError,
    errors_tested,
    is_possible,
    signal_rates,
)

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.methods.lo_diransac.shooting import ShootingIntervals

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


def clear_errors(
    intervals: ShootingIntervals, fit: Fit, tested: Sequence[ErrorKind], *, worth: float
) -> list[RecordingError]:
    """Errors that the residuals show most clearly: of a single signal, some of groups of signals, and of inputs.

    Groups that are late alike show nearly as clearly as others that are early, and a delay of inputs nearly as a lag;
    fits of each tell them apart.  They are judged by the evidence that they promise: a delay of many samples leaves
    residuals whose scores scatter by itself.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.
    tested : sequence of ErrorKind
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


def errors_of(intervals: ShootingIntervals, fit: Fit, kinds: Sequence[ErrorKind]) -> list[RecordingError]:
    """Remainders of some errors, estimated together, clear or not.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        At its optimum.
    kinds : sequence of ErrorKind

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


def with_errors(intervals: ShootingIntervals, fit: Fit, errors: Sequence[RecordingError]) -> ShootingIntervals:
    """The intervals with measurements that are corrected of errors, too.

    Parameters
    ----------
    intervals : ShootingIntervals
    fit : Fit
        Of which the rates of signals are taken.
    errors : sequence of RecordingError

    Returns
    -------
    ShootingIntervals
    """
    return intervals.corrected({x.kind: x.size for x in errors}, signal_rates(intervals, fit))


def errors_of_signals(intervals: ShootingIntervals, among: BoolArray) -> list[ErrorKind]:
    """Errors that signals may have: delays and biases of single ones, and delays of groups.

    A group are the coordinates, the velocities, ..., or those of one unit, as one instrument measures them.  The bias
    of a sensor that has one as a parameter is none.

    Parameters
    ----------
    intervals : ShootingIntervals
    among : (n_s,) bool array
        Single signals.

    Returns
    -------
    list of ErrorKind
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
    kinds = [ErrorKind(_places(x), "delay") for x in late]
    return list(dict.fromkeys([*kinds, *(ErrorKind(_places(x), "bias") for x in single if not biased[x].any())]))


def errors_of_inputs(intervals: ShootingIntervals) -> list[ErrorKind]:
    """Errors that inputs may have: delays, lags and drifts of the gain, of all, of those of one unit, and of each.

    Parameters
    ----------
    intervals : ShootingIntervals

    Returns
    -------
    list of ErrorKind
    """
    model = intervals.model
    unit = np.array(list(model.inputs.values()))
    moving = np.ptp(intervals.inputs, axis=0) > 0.0
    masks = [moving, *(moving & (unit == u) for u in dict.fromkeys(unit.tolist())), *np.eye(len(unit), dtype=bool)]
    some = [x for x in masks if (x & moving).any()]
    return list(dict.fromkeys(ErrorKind(_places(x), what, of_inputs=True) for what in _OF_INPUTS for x in some))


def _places(mask: BoolArray) -> tuple[int, ...]:
    return tuple(np.flatnonzero(mask).tolist())
