"""Beginning of a window: smoothed states of its intervals, and a first fit with the parameters of a start."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.data.log import Log
from diransac.identification.methods.lo_diransac.boundary import BoundaryPrior
from diransac.identification.methods.lo_diransac.integration_steps import with_fewest_steps
from diransac.identification.methods.lo_diransac.motion_equations import parameter_units
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.refinement import make_prior, refine, start
from diransac.identification.methods.lo_diransac.smoothing import Motion
from diransac.identification.tracking.window import Window

if TYPE_CHECKING:
    from diransac.identification.methods.lo_diransac.normal_equations import Fit
    from diransac.identification.tracking.setup import Setup
    from diransac.identification.tracking.stream import Stream

__all__ = ["Start", "begun", "smoothed_motion"]

# Prior standard deviation of a parameter of which only a rough value is known, over the value.
_ROUGH = 1.0
# Evidence, nats, by which inputs that are interpolated must be likelier than held ones; as in `local_search`.
_AS_LIKELY = 5.0


@dataclass(frozen=True)
class Start:
    """Parameters with which a tracker begins.

    Parameters
    ----------
    parameters : (n_p,) array
    covariance : (n_p, n_p) array, optional
        None of rough values.
    holds : tuple of str, optional
        What inputs may do between samples, of `HOLDS`; the first one unless another is clearly likelier.
    """

    parameters: FloatArray
    covariance: FloatArray | None = None
    holds: tuple[str, ...] = ("zero-order", "smooth")


def smoothed_motion(setup: Setup, stream: Stream, first: int, n_rows: int) -> Motion:
    """Smoothed motion of rows of a stream, whose angles and quaternions become continuous.

    Parameters
    ----------
    setup : Setup
    stream : Stream
    first, n_rows : int
        Rows.

    Returns
    -------
    Motion
        Of these rows.

    Raises
    ------
    LogError
        The rows are too few, or have too few samples.
    """
    rows = slice(first - stream.first, first - stream.first + n_rows)
    names = (*setup.model.signals, *setup.model.inputs)
    columns = dict(zip(names, stream.values[rows].T, strict=True))
    seen = {name: x for name, x in columns.items() if np.isfinite(x).any() or name in setup.model.inputs}
    log = Log.from_arrays(stream.time(first) + stream.dt * np.arange(n_rows), seen, source="the stream")
    dataset = Dataset.of(setup.model, log, pointwise=False)
    _, motion, _ = prepared(setup.settings, dataset)
    segment = dataset.segments[0]
    for name in segment.signals:
        stream.values[rows, names.index(name)][segment.offset :] = segment.column(name)
    at = np.clip(np.arange(n_rows) - segment.offset, 0, len(motion.signals) - 1)
    return Motion(motion.signals[at], motion.spread)


def begun(setup: Setup, stream: Stream, first: int, n: int, given: Start, most: int) -> Window:
    """Window of the first n intervals, fitted from the parameters of a start.

    Parameters
    ----------
    setup : Setup
    stream : Stream
    first : int
        First row.
    n : int
        Number of intervals.
    given : Start
    most : int
        Number of intervals of the window once it is full.

    Returns
    -------
    Window

    Raises
    ------
    LogError
        The rows are too few, or have too few samples.
    """
    length = stream.length // stream.parts
    motion = smoothed_motion(setup, stream, first, n * length)
    first_hold, *others = given.holds
    best = _fitted(replace(setup, hold=first_hold), stream, first, n, given, motion)
    for hold in others:
        other = _fitted(replace(setup, hold=hold), stream, first, n, given, motion)
        best = other if other.cost < best.cost - _AS_LIKELY else best
    few = with_fewest_steps(best.setup.intervals(stream, first, n), best.fit, setup.settings.substeps).substeps
    begun_setup = replace(best.setup, settings=replace(setup.settings, substeps=few))
    return Window(begun_setup, stream, first, best.fit, motion.spread, most)


class _Begun(NamedTuple):
    """Fit of the first intervals, and its negative log evidence."""

    setup: Setup
    fit: Fit
    cost: float


def _fitted(setup: Setup, stream: Stream, first: int, n: int, given: Start, motion: Motion) -> _Begun:
    """Fit of the first n intervals of a stream from the parameters of a start."""
    intervals, p = setup.intervals(stream, first, n), given.parameters
    if given.covariance is None:
        unit = parameter_units(intervals, motion, p)
        covariance = np.diag(np.square(_ROUGH * np.maximum(np.abs(p), np.where(unit > 0.0, unit, 1.0))))
    else:
        covariance = given.covariance
    std = np.sqrt(np.diag(covariance))
    names = setup.layout.names
    priors = {name: (float(x), float(s)) for name, x, s in zip(names, p, std, strict=True)}
    with_prior = replace(intervals, layout=ParameterLayout(setup.layout.parameters, 1, priors))
    prior = make_prior(setup.settings, with_prior, motion, np.full(len(p), np.inf))
    found = refine(setup.settings, with_prior, start(setup.settings, with_prior, motion, p, prior), prior)
    return _Begun(setup, _with_boundary(found.fit, p, covariance), found.cost)


def _with_boundary(fit: Fit, p: FloatArray, covariance: FloatArray) -> Fit:
    """The fit with the prior of its parameters as that of its boundary."""
    n_x, n = fit.x.shape[1], fit.x.shape[1] + fit.d.shape[1]
    known = np.isfinite(np.diag(covariance))
    information = np.zeros((n + len(p), n + len(p)))
    information[n_x:n, n_x:n] = np.diag(1.0 / np.square(fit.tau))
    places = n + np.flatnonzero(known)
    information[np.ix_(places, places)] = np.linalg.inv(covariance[np.ix_(known, known)])
    point = np.concatenate([fit.x[0], np.zeros_like(fit.d[0]), p])
    boundary = BoundaryPrior.of_information(point, information, np.zeros(len(point)))
    none = np.zeros_like(fit.prior)
    return replace(fit, boundary=boundary, prior=none + np.inf, prior_mean=none)
