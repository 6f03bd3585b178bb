"""The problem that a tracker solves, and its start: given or found by the default method, and the first window."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, interpolated, long_runs, size_or_one
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.data.input_timing import InputTiming
from diransac.data.log import Log
from diransac.errors import DiransacError
from diransac.identification.core.boundary import BoundaryPrior
from diransac.identification.core.fit import with_residuals
from diransac.identification.core.minimise import make_prior, refine, start
from diransac.identification.core.windows import Windows
from diransac.identification.identify import identify
from diransac.identification.methods.lo_diransac import LoDiransac
from diransac.identification.methods.lo_diransac.integration_steps import with_fewest_steps
from diransac.identification.methods.lo_diransac.motion_equations import parameter_units
from diransac.identification.methods.lo_diransac.preparation import prepared
from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings
from diransac.identification.methods.lo_diransac.smoothing import Motion
from diransac.identification.tracking.fits import followed
from diransac.identification.tracking.window import AS_LIKELY, Window

if TYPE_CHECKING:
    from diransac.identification.core.fit import Fit
    from diransac.identification.result import Result
    from diransac.identification.tracking.stream import Stream
    from diransac.model import Model


@dataclass(frozen=True)
class Setup:
    """Model, settings and timing of a tracker.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
        Of one log.
    hold : str, optional
        Inputs between samples, one of `HOLDS`.
    timing : InputTiming, optional
        Delay and lag after which recorded inputs act.
    settings : LoDiransacSettings, optional
        Of the joint fit.
    exact : bool, optional
        Whether an identification has predicted its logs within their noise.
    """

    model: Model
    layout: ParameterLayout
    hold: str = "zero-order"
    timing: InputTiming = field(default_factory=InputTiming)
    settings: LoDiransacSettings = field(default_factory=LoDiransacSettings)
    exact: bool = False

    def intervals(self, stream: Stream, first: int, n: int) -> Windows:
        """Intervals of a stream.

        Parameters
        ----------
        stream : Stream
        first : int
            Row of the stream with which they begin.
        n : int
            Number of intervals.

        Returns
        -------
        Windows
        """
        length = stream.length // stream.parts
        held, n_s = stream.values[: first - stream.first + n * length], len(self.model.signals)
        rows = slice(first - stream.first, len(held))
        measured, recorded = held[rows, :n_s], held[:, n_s:]
        known, missing = np.isfinite(measured), np.asarray(np.isnan(recorded).any(axis=1))
        acting = self.timing.acting(interpolated(recorded), stream.dt, self.hold)[rows]
        return Windows(
            model=self.model,
            layout=self.layout,
            measured=np.where(known, measured, 0.0),
            sampled=known,
            recorded=acting,
            is_logged=np.ones(n * length, bool),
            # Three rows without an input are a gap, as in `data.segment.bind_log`.
            gaps=(stream.ended[: len(held)] | long_runs(missing, 3))[rows],
            log_of=np.zeros(n, np.int64),
            dt=stream.dt,
            length=length,
            substeps=self.settings.substeps,
            hold=self.hold,
            discrepancies=False,
        )


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
    motion = smoothed_motion(setup, stream, first, n * (stream.length // stream.parts))
    fits = [_fitted(replace(setup, hold=hold), stream, first, n, given, motion) for hold in given.holds]
    best, fit, _ = min(fits, key=lambda x: x[2] + AS_LIKELY * (x[0].hold != given.holds[0]))
    return Window(*_with_fewest_steps(setup, best, stream, first, fit), stream, first, motion.spread, most)


def begun_anew(setup: Setup, window: Window, given: Start) -> tuple[Setup, Fit]:
    """A window as an exact model with the likeliest hold of the inputs, if that is clearly likelier, or as it is.

    A fit of the first second may have ended at an optimum with unmodelled accelerations, or with another hold; one of
    an exact model begins with the motion that was found, and what another hold has told before the window is forgotten.

    Parameters
    ----------
    setup : Setup
        With the most integration steps.
    window : Window
    given : Start

    Returns
    -------
    Setup, Fit
        With the fewest integration steps that are enough.
    """
    shared = window.fit.shared if window.is_exact else given.parameters
    alone = replace(window.fit, boundary=window.beginning)
    fits = [(_settled(window.setup, window, alone)[1] + AS_LIKELY, window.setup, window.fit)]
    for other in (replace(window.setup, hold=hold) for hold in given.holds):
        fit = replace(alone, shared=shared, tau=window.least, rho=np.zeros_like(window.least))
        fit, evidence = _settled(other, window, fit)
        fits.append((evidence, other, fit))
    _, best, fit = max(fits, key=lambda x: x[0])
    return _with_fewest_steps(setup, best, window.stream, window.first, fit)


def _settled(setup: Setup, window: Window, fit: Fit) -> tuple[Fit, float]:
    """A fit of a window after some steps, and its evidence, nats; -inf where simulations overflow from there."""
    intervals = setup.intervals(window.stream, window.first, len(window))
    with np.errstate(over="ignore", invalid="ignore"), suppress(np.linalg.LinAlgError):
        return followed(intervals, with_residuals(intervals, fit))
    return fit, -np.inf


def _with_fewest_steps(setup: Setup, other: Setup, stream: Stream, first: int, fit: Fit) -> tuple[Setup, Fit]:
    """A problem with the fewest integration steps of one with the most that change no parameter of a fit noticeably."""
    few, fit = with_fewest_steps(other.intervals(stream, first, len(fit.x)), fit, setup.settings.substeps)
    return replace(other, settings=replace(setup.settings, substeps=few.substeps)), fit


def _fitted(setup: Setup, stream: Stream, first: int, n: int, given: Start, motion: Motion) -> tuple[Setup, Fit, float]:
    """Fit of the first n intervals of a stream from the parameters of a start, and its negative log evidence, nats."""
    intervals, p, covariance = setup.intervals(stream, first, n), given.parameters, given.covariance
    if covariance is None:
        units = size_or_one(parameter_units(intervals, motion, p))
        covariance = np.diag(np.square(np.maximum(np.abs(p), units)))
    rough = zip(p.tolist(), np.sqrt(np.diag(covariance)).tolist(), strict=True)
    priors = dict(zip(setup.layout.names, rough, strict=True))
    intervals = replace(intervals, layout=ParameterLayout(setup.layout.parameters, 1, priors))
    prior = make_prior(setup.settings, intervals, motion, np.full(len(p), np.inf))
    refinement = refine(setup.settings, intervals, start(setup.settings, intervals, motion, p, prior), prior)
    return setup, _with_boundary(refinement.fit, p, covariance), refinement.cost


def _with_boundary(fit: Fit, p: FloatArray, covariance: FloatArray) -> Fit:
    """The fit with the prior of its parameters as that of its boundary."""
    n_x, n = fit.x.shape[1], fit.x.shape[1] + fit.d.shape[1]
    known = np.isfinite(np.diag(covariance))
    information = np.zeros((n + len(p), n + len(p)))
    information[n_x:n, n_x:n] = np.diag(1.0 / np.square(fit.tau))
    places = n + np.flatnonzero(known)
    information[np.ix_(places, places)] = np.linalg.inv(covariance[np.ix_(known, known)])
    point = np.concatenate([fit.x[0], np.zeros_like(fit.d[0]), p])
    boundary, none = BoundaryPrior.of_information(point, information, np.zeros(len(point))), np.zeros_like(fit.prior)
    return replace(fit, boundary=boundary, prior=none + np.inf, prior_mean=none)


# ---------------------------------------------------------------------- a start by the default method


class ColdStart:
    """Identification of the rows that a stream holds: of one window, then of twice as many, a window apart at least.

    Parameters
    ----------
    setup : Setup
    seed : int
    window : float
        Time from which on the first rows are identified, s.
    background : bool
        Whether `sought` returns while an identification runs.

    Attributes
    ----------
    refused : str
        Why there is no start yet.
    """

    def __init__(self, setup: Setup, seed: int, window: float, *, background: bool) -> None:
        self.setup, self.seed, self.window, self.background = setup, seed, window, background
        self._running: Future[Result] | None = None
        self._needed, self._not_before = window, 0
        self.refused = f"there are fewer than {window:g} s of rows"

    def restart(self) -> None:
        """Begin again with the rows of one window."""
        self._running, self._needed = None, self.window

    def sought(self, stream: Stream, end: int) -> tuple[Setup, Start, str] | None:
        """The problem with the timing of its inputs, its start and a note, once there is one that is usable.

        Parameters
        ----------
        stream : Stream
        end : int
            Row after the newest one.
        """
        first = max(stream.first, stream.fresh)
        enough = (end - first) * stream.dt >= self._needed and end >= self._not_before
        if self._running is None and enough:
            self._not_before = end + round(self.window / stream.dt)
            self._running = self._identified(stream, first, end)
        if self._running is None or (self.background and not self._running.done()):
            return None
        running, self._running = self._running, None
        seconds = f"an identification of {self._needed:.3g} s"
        try:
            result = running.result()
            self.refused = f'{seconds} says "{result.verdict}"'
        except DiransacError as error:
            self.refused = f"{seconds} fails: {error}"
            result = None
        if result is None or result.verdict == "do not rely on this":
            self._needed = min(2.0 * self._needed, len(stream.values) * stream.dt - self.window)
            return None
        resolution = result.estimate.resolution
        setup = replace(self.setup, timing=resolution.timing, exact=result.estimate.competition is None)
        said = f"identified from the first {self._needed:.3g} s ({result.verdict})"
        start = Start(np.array(list(result.parameters.values())), holds=(resolution.hold,))
        return setup, start, said

    def _identified(self, stream: Stream, first: int, end: int) -> Future[Result]:
        """The identification of some rows, which runs."""
        rows = stream.values[first - stream.first : end - stream.first]
        names = (*self.setup.model.signals, *self.setup.model.inputs)
        columns = {n: x.copy() for n, x in zip(names, rows.T, strict=True) if np.isfinite(x).any()}
        log = Log.from_arrays(stream.time(first) + stream.dt * np.arange(len(rows)), columns, source="the stream")
        pool = ThreadPoolExecutor(1, thread_name_prefix="identification")
        running = pool.submit(identify, self.setup.model, log, LoDiransac(suggestions=False), seed=self.seed)
        pool.shutdown(wait=False)
        return running
