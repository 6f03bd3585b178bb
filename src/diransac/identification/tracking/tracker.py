"""`Tracker`: parameters of a machine while it runs, and `track`, the same over a recorded log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.data import preprocessing
from diransac.data.dataset import ParameterLayout
from diransac.data.log import Log
from diransac.errors import DiransacError, LogError, SettingsError, check_known
from diransac.identification.structure.known_parameters import KnownParameters
from diransac.identification.tracking.changes import Changes
from diransac.identification.tracking.estimates import TrackedEstimate
from diransac.identification.tracking.starting import ColdStart, Setup, Start, begun, begun_anew, smoothed_motion
from diransac.identification.tracking.steps import fine_ages_of
from diransac.identification.tracking.stream import SensorWatch, Stream
from diransac.identification.tracking.window import AS_LIKELY
from diransac.model import Model
from diransac.process import single_threaded

if TYPE_CHECKING:
    from diransac.identification.result import Result
    from diransac.identification.tracking.window import Window

Samples = Log | Mapping[str, npt.ArrayLike]

_FIRST = 1.0
"""Time from the beginning of a stretch to its first interval at least, s: four half-widths of the smoother."""


class Tracker:
    """Parameters of a machine, their intervals and their changes while it runs, in fixed memory.

    The joint fit of `LoDiransac` over the last ``window`` seconds, given a Gaussian of all that was before.  Each step
    adds an interval, takes one or a few Gauss-Newton and EM steps from the fit before, and returns an estimate.

    Parameters
    ----------
    model : Model
        Equations with the parameters that are tracked.
    window : float, optional
        Time over which the motion is fitted again at each step, s.
    step : float, optional
        Time between estimates, s.
    start : mapping of str to float, or Result, optional
        Rough values of the parameters, each in its unit, or an identification, whose covariance is a prior.  None: the
        default method identifies them from the first seconds, in a thread of its own.
    seed : int, optional
        Seed of that identification.
    false_alarms_per_hour : float, optional
        Changes that are reported per hour of a machine that does not change.
    fixed : mapping of str to float, or iterable of str, optional
        Parameters that are not tracked, with their values, as in `identify`; those of a `Result` remain fixed.
    drift : mapping of str to float, optional
        Standard deviation by which a parameter changes at random in a second, in its unit; 0 for one that never drifts.
        None, or a name that is not given: estimated.
    background : bool, optional
        Whether `update` returns while an identification runs; otherwise it waits for it.

    Raises
    ------
    SettingsError
        An argument is out of range, or names no parameter.
    """

    def __init__(
        self,
        model: Model,
        *,
        window: float = 5.0,
        step: float = 0.1,
        start: Mapping[str, float] | Result | None = None,
        seed: int = 0,
        false_alarms_per_hour: float = 0.1,
        fixed: Mapping[str, float | None] | Iterable[str] | None = None,
        drift: Mapping[str, float] | None = None,
        background: bool = True,
    ) -> None:
        _check_positive(window=window, step=step, false_alarms_per_hour=false_alarms_per_hour)
        if window < 2.0 * step:
            raise SettingsError(f"window is {window:g} s and step {step:g} s; give a window of at least two steps")
        model = model.with_fixed(_fixed(model, fixed, start))
        _check_names("drift", drift or {}, model)
        self._setup = Setup(model, ParameterLayout(model.parameters))
        self._start: Start | None = None
        if start is not None:
            self._setup, self._start = _started(self._setup, start)
        self._names = (*model.signals, *model.inputs)
        self._steps = max(2, round(window / step))
        self._step = step
        # Unmodelled accelerations vary as fast off-line as on-line.
        parts = int(np.ceil(step / self._setup.settings.smoothing_half_width))
        # Four windows of rows are held until there is a start.
        self._stream = Stream(len(self._names), model.n_u, step, 4.0 * window + step, parts)
        self._cold = ColdStart(self._setup, seed, window, background=background)
        self._new_changes = partial(Changes, self._setup, step, false_alarms_per_hour, drift or {})
        self._changes = self._new_changes()
        self._sensors = SensorWatch(model)
        self._window: Window | None = None
        self._notes: list[str] = []
        self._retry, self._refused, self._n_updates = 0, "", 0

    def update(self, samples: Samples) -> TrackedEstimate | None:
        """Take samples.

        Parameters
        ----------
        samples : Log, or mapping of str to float or (n,) array
            Columns by name, each in the unit of the model: ``t``, the time in seconds, with any of the signals and
            inputs of the model; NaN where one has no sample.  Others are ignored.

        Returns
        -------
        TrackedEstimate or None
            The last one, where several steps are complete, with the changes and notes of all; None where none is.

        Raises
        ------
        LogError
            The time is missing or not finite, columns differ in length, or hold no numbers.
        """
        new = list(self._estimates(*self._columns(samples)))
        if not new:
            return None
        return replace(new[-1], changes=sum((x.changes for x in new), ()), notes=sum((x.notes for x in new), ()))

    @property
    def missing(self) -> str:
        """Reason for which there is no estimate; empty while there is one."""
        if self._window is not None:
            return ""
        return self._cold.refused if self._start is None else self._refused or "there are too few rows"

    # ------------------------------------------------------------------ samples

    def _columns(self, samples: Samples) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(n,)`` and rows ``(n, n_columns)`` of samples, NaN where nothing is measured."""
        if isinstance(samples, Log):
            log = preprocessing.in_stated_units(samples.measured, self._setup.model)
            columns: dict[str, npt.ArrayLike] = {"t": log.time, **log.signals}
        elif isinstance(samples, Mapping):
            columns = dict(samples)
        else:
            raise LogError(f"samples are a {type(samples).__name__}; give a dr.Log, or columns by name")
        if "t" not in columns:
            raise LogError('samples have no time; give their column "t" in seconds')
        time = _column("t", columns["t"])
        if not np.isfinite(time).all():
            raise LogError('a time "t" of the samples is not finite; give seconds')
        rows = np.full((len(time), len(self._names)), np.nan)
        for k, name in enumerate(self._names):
            if name in columns:
                values = _column(name, columns[name])
                if len(values) != len(time):
                    raise LogError(f'"{name}" has {len(values)} samples, the time has {len(time)}; give one for each')
                # A square that overflows is no sample of anything.
                rows[:, k] = np.where(np.abs(values) < 1e150, values, np.nan)
        return time, rows

    def _estimates(self, time: FloatArray, rows: FloatArray) -> Iterator[TrackedEstimate]:
        """An estimate whenever a step is complete."""
        with single_threaded():
            for end in self._stream.feed(time, rows):
                self._notes += self._stream.taken_notes()
                if self._window is None:
                    self._begin(end)
                while self._window is not None and self._advanced(self._window, end):
                    yield self._estimate(self._window)
                    if self._window.is_hopeless:
                        self._begin_anew()

    # ------------------------------------------------------------------ the window

    def _begin(self, end: int) -> None:
        """Begin a window where a start is known, and rows enough are there."""
        stream = self._stream
        if self._start is None:
            cold = self._cold.sought(stream, end)
            if cold is None:
                return
            self._setup, self._start, note = cold
            self._notes.append(note)
        first = max(stream.first, stream.fresh)
        n = min((end - first) // stream.length, self._steps)
        if n * stream.length * stream.dt < _FIRST - 1e-9 or end < self._retry:
            return
        parts = stream.parts
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                window = begun(self._setup, stream, first, n * parts, self._start, self._steps * parts)
                window.optimise()
        except DiransacError as error:  # too few samples as yet
            self._retry, self._refused = end + stream.length, str(error)
        except np.linalg.LinAlgError:
            self._begin_anew()
        else:
            self._window = window

    def _begin_anew(self) -> None:
        """Forget a fit that explains nothing, and identify the parameters from the rows that are held."""
        self._window, self._start, self._changes = None, None, self._new_changes()
        self._cold.restart()
        self._notes.append("the parameters explain none of the motion, and are identified anew")

    def _advanced(self, window: Window, end: int) -> bool:
        """Move the window on by a step where its rows are complete; False where they are not, or its fit fails."""
        stream, states = self._stream, None
        is_new = stream.fresh >= window.end
        n_steps = (end - stream.fresh) // stream.length if is_new else 1
        n = n_steps * stream.parts
        if end < window.end + n * window.length or (is_new and n_steps * self._step < _FIRST - 1e-9):
            return False
        if is_new:
            try:
                motion = smoothed_motion(self._setup, stream, window.end, n * window.length)
            except DiransacError:  # too few samples as yet
                return False
            states = motion.signals[:: window.length, : window.fit.x.shape[1]]
        excess = len(window) + n - window.most
        if excess > 0:
            window.leave(min(excess, len(window) - 1))
            stream.drop(window.first // stream.length * stream.length - stream.first)
        self._changes.before_step(window)
        try:
            window.extend(n, states)
            equations = window.optimise()
            self._n_updates += 1
            # While the window fills, and whenever all intervals are others, unless forces are remembered.
            is_due = not self._n_updates % self._steps and window.memory.freedom < AS_LIKELY
            is_due = is_due if window.memory.count else len(window) in fine_ages_of(window.most)
            if is_due and self._start is not None and not self._changes.is_suspected:
                window.setup, window.fit = begun_anew(self._setup, window, self._start)
                equations = window.optimise()
            self._changes.after_step(window, equations)
        except np.linalg.LinAlgError:
            self._begin_anew()
        else:
            if self._setup.layout.violations(window.fit.shared):
                self._begin_anew()
        return self._window is not None

    def _estimate(self, window: Window) -> TrackedEstimate:
        """Estimate at the end of the window."""
        model, fit = self._setup.model, window.fit
        covariance = self._changes.covariance(window)
        seen = np.flatnonzero(window.last.at.intervals.known.any(axis=0)) if window.last else ()
        signals = [(model.signals[k], int(k)) for k in seen]
        notes, self._notes = [*self._notes, *self._sensors.notes(self._stream, window)], []
        names = tuple(model.parameters)
        return TrackedEstimate(
            time=self._stream.time(window.end - 1),
            parameters=dict(zip(names, fit.shared.tolist(), strict=True)),
            standard_errors=dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
            covariance=covariance,
            changes=self._changes.taken(),
            outliers=window.outliers(signals),
            noise={name: float(fit.noise.sigma[k]) for name, k in signals},
            state=window.last_state(),
            notes=tuple(notes),
        )


def track(model: Model, log: Log, **options: Any) -> Iterator[TrackedEstimate]:
    """Estimates of a `Tracker` over a recorded log, one a step.

    Parameters
    ----------
    model : Model
    log : Log
    **options : optional
        ``window``, ``step``, ``start``, ``seed``, ``false_alarms_per_hour``, ``fixed`` and ``drift``, as of `Tracker`.

    Returns
    -------
    iterator of TrackedEstimate

    Raises
    ------
    SettingsError
        As `Tracker`.
    LogError
        As `Tracker.update`; or the log ends without any estimate.
    """
    if not isinstance(log, Log):
        raise SettingsError(f"log is a {type(log).__name__}; give a dr.Log, such as dr.read_log(path)")
    tracker = Tracker(model, background=False, **options)
    return refused_if_none(tracker, tracker._estimates(*tracker._columns(preprocessing.in_units(log, model))))


def refused_if_none(tracker: Tracker, estimates: Iterator[TrackedEstimate]) -> Iterator[TrackedEstimate]:
    """Estimates of a tracker as they come.

    Parameters
    ----------
    tracker : Tracker
    estimates : iterator of TrackedEstimate

    Raises
    ------
    LogError
        They end without any.
    """
    first = next(estimates, None)
    if first is None:
        raise LogError(f"there is no estimate: {tracker.missing}; give rough values as start")
    yield first
    yield from estimates


# ---------------------------------------------------------------------- arguments


def _column(name: str, values: npt.ArrayLike) -> FloatArray:
    """A column ``(n,)`` of numbers."""
    try:
        column = np.atleast_1d(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise LogError(f'"{name}" of the samples is {values!r:.60}; give numbers') from error
    if column.ndim != 1:
        raise LogError(f'"{name}" of the samples has the shape {column.shape}; give one number for each time')
    return column


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.number) and not isinstance(value, bool)


def _check_positive(**values: float) -> None:
    for name, value in values.items():
        if not (_is_number(value) and 0.0 < value < np.inf):
            raise SettingsError(f"{name} is {value!r}; give a number above 0")


def _check_names(argument: str, values: Mapping[str, float], model: Model) -> None:
    for name, value in values.items():
        check_known([name], model.parameters, f"{argument} names", "the parameters are")
        if not (_is_number(value) and np.isfinite(value)):
            raise SettingsError(f'{argument} of "{name}" is {value!r}; give a number in its unit')


def _fixed(
    model: Model, fixed: Mapping[str, float | None] | Iterable[str] | None, start: Mapping[str, float] | Result | None
) -> Mapping[str, float]:
    """Values of the parameters that are not tracked."""
    of_start = {} if start is None or isinstance(start, Mapping) else {n: start.parameters[n] for n in start.fixed}
    known = KnownParameters.of(model, fixed, None).fixed
    return {**{n: x for n, x in of_start.items() if n in model.parameters}, **known}


def _started(setup: Setup, start: Mapping[str, float] | Result) -> tuple[Setup, Start]:
    """The problem and its start, from rough values or an identification."""
    parameters = setup.model.parameters
    if isinstance(start, Mapping):
        _check_names("start", start, setup.model)
        values = {name: start.get(name, x.value) for name, x in parameters.items()}
        lacking = [name for name, x in values.items() if x is None]
        if lacking:
            raise SettingsError(f'start lacks "{lacking[0]}"; give a rough value of it')
        return setup, Start(np.array([float(x) for x in values.values() if x is not None]))
    free = [k for k, name in enumerate(start.parameters) if name in parameters]
    if [tuple(start.parameters)[k] for k in free] != list(parameters):
        raise SettingsError(
            f"start has the parameters {', '.join(start.parameters)}, the model has {', '.join(parameters)}"
        )
    resolution = start.estimate.resolution
    known, covariance = np.array(list(start.parameters.values()))[free], start.covariance[np.ix_(free, free)]
    exact = start.estimate.competition is None
    return replace(setup, timing=resolution.timing, exact=exact), Start(known, covariance, (resolution.hold,))
