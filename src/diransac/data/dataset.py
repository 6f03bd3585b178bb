"""`Dataset`: one or more logs bound to a model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, bulk_range, robust_std
from diransac.data.log import Log
from diransac.data.segment import Segment, bind_log
from diransac.errors import LogError, SettingsError, check_known
from diransac.model.parameter import parameter_of

if TYPE_CHECKING:
    from diransac.model import Model, Parameter

T = TypeVar("T")


class ParameterLayout:
    """Positions of every log's parameters in one vector: shared ones once, per-log ones once per log.

    Parameters
    ----------
    parameters : mapping of str to Parameter
        Parameters of the model by name.
    n_logs : int, optional
        Number of logs that are identified together.
    priors : mapping of str to (float, float), optional
        Mean and standard deviation of the Gaussian prior of a parameter, in its unit; for a per-log one, of each value.

    Attributes
    ----------
    names : tuple of str
        The n names: the model's; ``bias[0]``, ``bias[1]``, ... for a per-log parameter of several logs.
    owners : tuple of str
        The parameter of the model that each of the n is a value of.
    bounds : tuple of Parameter
        Unit and bounds of each of the n.
    index : (n_logs, n_p) int array
        Positions of each log's parameters in the vector.
    prior_mean, prior_std : (n,) array
        Mean and standard deviation of the prior of each of the n; 0 and infinite without one.
    """

    def __init__(
        self,
        parameters: Mapping[str, Parameter],
        n_logs: int = 1,
        priors: Mapping[str, tuple[float, float]] | None = None,
    ) -> None:
        self.parameters, self.n_logs, self.priors = dict(parameters), n_logs, dict(priors or {})
        names: list[str] = []
        columns: list[list[int]] = []
        for name, parameter in parameters.items():
            own = [f"{name}[{i}]" for i in range(n_logs)] if parameter.per_log and n_logs > 1 else [name]
            columns.append([len(names) + (i if len(own) > 1 else 0) for i in range(n_logs)])
            names += own
        self.names = tuple(names)
        self.owners = tuple(parameter_of(name, self.parameters) for name in names)
        self.bounds = tuple(self.parameters[name] for name in self.owners)
        self.index: IntArray = np.array(columns, np.int64).reshape(len(columns), n_logs).T
        beforehand = np.array([self.priors.get(name, (0.0, np.inf)) for name in self.owners])
        self.prior_mean, self.prior_std = beforehand.T

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def with_prior(self) -> IntArray:
        """Positions of the parameters that have a prior."""
        return np.flatnonzero(np.isfinite(self.prior_std))

    @property
    def is_shared(self) -> bool:
        """True if every log has the same parameters."""
        return len(self.names) == len(self.parameters)

    def of_log(self, values: FloatArray, i: int) -> FloatArray:
        """The model's parameters ``(..., n_p)`` of log ``i`` from vectors ``(..., n)``."""
        return values if self.is_shared else values[..., self.index[i]]

    def scattered(self, columns: FloatArray, i: int) -> FloatArray:
        """Columns ``(..., n_p)`` of log ``i`` in their places ``(..., n)``; zero elsewhere."""
        if self.is_shared:
            return columns
        full = np.zeros((*columns.shape[:-1], len(self)))
        full[..., self.index[i]] = columns
        return full

    @cached_property
    def mean_map(self) -> FloatArray:
        """Matrix ``(n_p, n)`` from the vector to one value per parameter: the mean over logs of a per-log one."""
        mean = np.zeros((len(self.parameters), len(self)))
        for own in self.index:
            mean[np.arange(len(own)), own] += 1.0 / self.n_logs
        return mean

    def admits(self, values: FloatArray) -> BoolArray:
        """Mask ``(n_vectors,)`` of the vectors ``(n_vectors, n)`` whose parameters are all within their bounds."""
        return np.asarray(np.all([x.admits(values[:, i]) for i, x in enumerate(self.bounds)], axis=0))

    def violations(self, values: FloatArray) -> tuple[str, ...]:
        """Names of the parameters of a vector ``(n,)`` that are outside their bounds."""
        return tuple(n for n, x, value in zip(self.names, self.bounds, values, strict=True) if not x.admits(value))

    def on_bounds(self, values: FloatArray) -> BoolArray:
        """Mask ``(n,)`` of the parameters of a vector ``(n,)`` that lie on a bound, where an estimator stops."""
        pairs = zip(self.bounds, values.tolist(), strict=True)
        return np.array([x.lower < x.upper and value in (x.lower, x.upper) for x, value in pairs], bool)


def as_logs(logs: Log | Iterable[Log]) -> tuple[Log, ...]:
    """One log, or a sequence of logs, as a tuple.

    Parameters
    ----------
    logs : Log or iterable of Log

    Returns
    -------
    tuple of Log

    Raises
    ------
    SettingsError
        The argument is something else, or empty.
    """
    several = (logs,) if isinstance(logs, Log) or not isinstance(logs, Iterable) else tuple(logs)
    for one in several:
        if not isinstance(one, Log):
            raise SettingsError(f"log is a {type(one).__name__}; give a dr.Log, such as dr.read_log(path), or several")
    if not several:
        raise SettingsError("there is no log; give one dr.Log or several")
    return several


def distinct_logs(logs: Log | Iterable[Log]) -> tuple[Log, ...]:
    """As `as_logs`, of logs that are to be independent evidence.

    Parameters
    ----------
    logs : Log or iterable of Log

    Returns
    -------
    tuple of Log

    Raises
    ------
    SettingsError
        As `as_logs`.
    LogError
        Two logs have the same time and samples.
    """
    several = as_logs(logs)
    for one, other in combinations(several, 2):
        if one.fingerprint == other.fingerprint:
            same = f"{one.source} and {other.source} have the same time and samples"
            found = f"{one.source} is given twice" if one.source == other.source else same
            raise LogError(f"{found}; give each log once: repeated samples are no further evidence")
    return several


def usable_sensors(model: Model, logs: Sequence[Log], *, regression: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Sensors of a model that can be used.

    Parameters
    ----------
    model : Model
    logs : sequence of Log
    regression : bool
        Whether sensors are used as rows of ``W p = b``: affine in the parameters, of measured signals.  Other sensors
        remain where they have no parameters of their own, because simulations are compared with them.

    Returns
    -------
    sensors : tuple of str
    notes : tuple of str
        Reasons for those that are left out, a sentence each.
    """
    absent = [n for n in model.sensors if not any(n in log for log in logs)]
    reasons = dict.fromkeys(absent, "no log has such a signal")
    if regression:
        reasons |= {n: reason for n in model.sensors if n not in absent and (reason := _unusable(model, n, logs))}
    left = {x for n in model.sensors if n not in reasons for x in model.sensor_arguments[n]}
    own = {n: [x for x in model.sensor_arguments[n] if x in model.sensor_parameters and x not in left] for n in reasons}
    notes = []
    for reason in dict.fromkeys(reasons.values()):
        alike = [n for n, x in reasons.items() if x == reason]
        lost = dict.fromkeys(x for n in alike for x in own[n])
        if lost or alike[0] not in absent:
            with_parameters = f" with {', '.join(lost)}, which only sensors depend on" if lost else ""
            notes.append(f"the fit leaves {', '.join(alike)} out{with_parameters}: {reason}")
    used = tuple(n for n in model.sensors if n not in absent and not own.get(n))
    return used, tuple(notes)


def _unusable(model: Model, sensor: str, logs: Sequence[Log]) -> str:
    """Reason why a sensor gives no rows of a regression; empty if it does."""
    if sensor not in model.affine_sensors:
        return "a regression needs sensors that are affine in the parameters"
    needed = [n for n in model.sensor_arguments[sensor] if n in model.signals]
    having = [log for log in logs if sensor in log]
    missing = [[n for n in needed if n not in log] for log in having]
    return f"{', '.join(missing[0])} in the measurement equation is not measured" if all(missing) else ""


@dataclass(frozen=True)
class Dataset:
    """Logs bound to a model: independent segments, one per log; made by `Dataset.of`.

    Parameters
    ----------
    model : Model
        Equations with the parameters to be estimated.
    given : tuple of Log
        Logs as the user gave them.
    segments : tuple of Segment
        One per log, in the same order; all have the same ``signals``.
    layout : ParameterLayout
        Positions of each log's parameters in the vector of all parameters.
    input_hold : str, optional
        Requested hold of the inputs between samples, such as "zero-order"; None: the method's choice.
    """

    model: Model
    given: tuple[Log, ...]
    segments: tuple[Segment, ...]
    layout: ParameterLayout
    input_hold: str | None = None
    _kept: list[tuple[object, Any]] = field(default_factory=list, init=False, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        model: Model,
        logs: Log | Iterable[Log],
        also: Sequence[str] = (),
        *,
        pointwise: bool = True,
        given: Sequence[Log] | None = None,
        input_hold: str | None = None,
        priors: Mapping[str, tuple[float, float]] | None = None,
    ) -> Dataset:
        """The dataset of one log or several.

        Parameters
        ----------
        model : Model
        logs : Log or iterable of Log
        also : sequence of str, optional
            Signals in use besides those that the equations name: those with a weight or a threshold.
        pointwise : bool, optional
            Whether the equations are evaluated at each row, which needs every signal that they name.  Otherwise
            simulations are compared with measurements, so that derived signals are left out.
        given : sequence of Log, optional
            Logs as the user gave them, where ``logs`` were derived from them.
        input_hold : str, optional
            Requested hold of the inputs.
        priors : mapping of str to (float, float), optional
            Mean and standard deviation of the Gaussian prior of a parameter.

        Returns
        -------
        Dataset

        Raises
        ------
        LogError
            As `bind_log`; the message names the log.
        """
        several = as_logs(logs)
        compared = several if pointwise else tuple(log.measured for log in several)
        segments = [bind_log(model, log, also, pointwise=pointwise) for log in compared]
        found = {name for one in segments for name in one.signals}
        signals = tuple(name for name in model.signals if name in found)
        layout = ParameterLayout(model.parameters, len(several), priors)
        own = several if given is None else tuple(given)
        return cls(model, own, tuple(x.with_signals(signals) for x in segments), layout, input_hold)

    def __len__(self) -> int:
        """Rows of all segments."""
        return sum(map(len, self.segments))

    @property
    def n_rows(self) -> int:
        """Rows that count."""
        return sum(one.n_rows for one in self.segments)

    @property
    def signals(self) -> tuple[str, ...]:
        """Signals of the model that at least one log has, in the model's order."""
        return self.segments[0].signals

    @property
    def hold(self) -> str:
        """Hold of the inputs in the simulations of a method that makes no choice: as requested, else "zero-order"."""
        return self.input_hold or "zero-order"

    @property
    def source(self) -> str:
        """Names of the logs in messages."""
        return ", ".join(dict.fromkeys(one.source for one in self.given))

    @cached_property
    def common_signals(self) -> tuple[str, ...]:
        """Signals of the model that every log has."""
        return tuple(n for n in self.signals if all(n in one.present for one in self.segments))

    @property
    def dt(self) -> float:
        """Sampling time of all logs, s.

        Raises
        ------
        LogError
            The logs are sampled at different rates.
        """
        steps = [one.log.dt for one in self.segments]
        for one in self.segments:
            # Relative difference of two sampling times below which they are one rate with another jitter.
            if abs(one.log.dt - steps[0]) > 1e-3 * steps[0]:
                raise LogError(
                    f"{self.segments[0].log.source} is sampled at {1.0 / steps[0]:.6g} Hz, {one.log.source} at "
                    f"{1.0 / one.log.dt:.6g} Hz; resample them to one rate (--resample)"
                )
        return float(np.mean(steps)) if len(steps) > 1 else steps[0]

    @property
    def notes(self) -> tuple[str, ...]:
        """Findings and changes, a sentence each; with the log's name where there are several."""
        if len(self.segments) == 1:
            return self.segments[0].notes
        return tuple(f"{one.log.source}: {note}" for one in self.segments for note in one.notes)

    @cached_property
    def scales(self) -> dict[str, float]:
        """Spread of each measured signal over the rows that count, in its unit; 0 where it is constant.

        Coordinates of several logs are taken about the median of their log: where a log begins is no motion.
        """
        parts = [one.measured[one.valid] for one in self.segments]
        if len(parts) > 1:
            centred = np.array([n in self.model.coordinates for n in self.signals])
            parts = [x - np.where(centred, _medians(x), 0.0) for x in parts]
        values = np.concatenate(parts)
        return {n: _spread(values[:, i]) for i, n in enumerate(self.signals)}

    @cached_property
    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """Smallest and largest value of the bulk of each signal and input over all logs, with its name."""
        found: dict[str, list[float]] = {}
        for one in self.segments:
            of_inputs = (bulk_range(u) for u in one.inputs.T)
            pairs = (*zip(one.signals, one.ranges, strict=True), *zip(self.model.inputs, of_inputs, strict=True))
            for name, (low, high) in pairs:
                if np.isfinite([low, high]).all():
                    found.setdefault(name, []).extend((low, high))
        return tuple((name, min(x), max(x)) for name, x in found.items())

    def kept(self, key: object, make: Callable[[], T]) -> T:
        """The value that was made under an equal key before, or a new one, which lives as long as the dataset.

        Methods that are given the same dataset share what they derive from it.

        Parameters
        ----------
        key : object
            All that the value depends on besides the dataset.
        make : callable
            Returns the value.
        """
        for known, value in self._kept:
            if known == key:
                return cast("T", value)
        value = make()
        self.keep(key, value)
        return value

    def keep(self, key: object, value: object) -> None:
        """Keep a value, instead of one under an equal key, as long as the dataset lives.

        Parameters
        ----------
        key : object
            All that the value depends on besides the dataset.
        value : object
        """
        self._kept[:] = [*((known, x) for known, x in self._kept if known != key), (key, value)]

    def by_signal(self, values: Mapping[str, float]) -> FloatArray:
        """Values in the signals' order.

        Parameters
        ----------
        values : mapping of str to float
            Values of some of the signals by name.

        Returns
        -------
        (n_s,) array
            0 for signals that are not named.

        Raises
        ------
        SettingsError
            The model, or a log, has no signal of that name.
        """
        for name, value in values.items():
            check_known([name], self.model.signals, f'model "{self.model.name}" has no signal', "it has")
            if value > 0.0 and name not in self.common_signals:
                lacking = next(one.log.source for one in self.segments if name not in one.present)
                raise SettingsError(f'{lacking}: a setting names "{name}", which the log lacks; leave it out')
        return np.array([values.get(name, 0.0) for name in self.signals])

    def subset(self, logs: Sequence[int]) -> Dataset:
        """The dataset of some of the logs."""
        segments = tuple(self.segments[i] for i in logs)
        found = {n for one in segments for n in one.present}
        signals = tuple(n for n in self.signals if n in found)
        narrowed = tuple(one.with_signals(signals) for one in segments)
        given = tuple(self.given[i] for i in logs)
        layout = ParameterLayout(self.model.parameters, len(logs), self.layout.priors)
        return replace(self, given=given, segments=narrowed, layout=layout)

    def on_given_logs(self, masks: Sequence[BoolArray]) -> BoolArray:
        """Mask over the rows of all given logs, log after log, from one mask per segment."""
        whole = []
        for one, log, mask in zip(self.segments, self.given, masks, strict=True):
            rows, first = np.zeros(len(log), dtype=bool), one.first_row_in(log)
            rows[first : first + len(mask)] = mask
            whole.append(rows)
        return np.concatenate(whole)


def _spread(values: FloatArray) -> float:
    """Standard deviation by the MAD; where half the samples rest at one value, by the central 80 %."""
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return 0.0
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9])
    mad = float(robust_std(values - median))
    wide = float(high - low) / 2.563
    if mad > 1e-2 * wide > 0.0:
        return mad
    spread = wide if wide > 0.0 else float(values.std())
    return spread if spread > 1e-12 * float(np.abs(values).max(initial=0.0)) else 0.0


def _medians(values: FloatArray) -> FloatArray:
    """Median of each column's finite values, 0 where there is none."""
    found = [x[np.isfinite(x)] for x in values.T]
    return np.array([np.median(x) if len(x) else 0.0 for x in found])
