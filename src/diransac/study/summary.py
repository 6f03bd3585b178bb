"""Summary of a store by level and method: tracking errors, parameter errors, failures and run times."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import StudyError
from diransac.study.assessment import PlantFacts, covers, differ, relative_errors
from diransac.study.reading import Status, about, read, status
from diransac.study.store import Store, damage

if TYPE_CHECKING:
    import polars as pl

_Statistic = Callable[[FloatArray], np.floating]


@dataclass(frozen=True)
class TrackingErrors:
    """RMS tracking errors of one trajectory.

    A trial without a flight (no parameters, no plan, no controller, or overflow) has no error and is counted as failed.
    A flight that ends far from its reference has a large error and is part of the mean.

    Parameters
    ----------
    errors : state -> RMS tracking error (n_levels, n_methods, n_trials), in the state's unit; NaN without a flight
    ran : (n_levels, n_methods, n_trials), trials that are in the store
    failed : (n_levels, n_methods, n_trials), those of them without a flight
    """

    errors: Mapping[str, FloatArray]
    ran: BoolArray
    failed: BoolArray

    def mean(self, state: str) -> FloatArray:
        """Mean over flights, (n_levels, n_methods); NaN without a flight."""
        return _over_trials(self.errors[state], ~np.isnan(self.errors[state]), np.mean)

    def deviation(self, state: str) -> FloatArray:
        """Standard deviation over flights with n - 1, (n_levels, n_methods); NaN with fewer than two."""
        there = ~np.isnan(self.errors[state])
        enough = there & (there.sum(axis=2, keepdims=True) > 1)
        return _over_trials(self.errors[state], enough, _sample_deviation)

    def median(self, state: str) -> FloatArray:
        """Median over trials, (n_levels, n_methods), infinite errors for failed ones; NaN without a trial."""
        upper_median = partial(np.quantile, q=0.5, method="higher")  # infinities are not averaged with numbers
        return _over_trials(np.where(self.failed, np.inf, self.errors[state]), self.ran, upper_median)

    def largest(self, state: str) -> FloatArray:
        """Largest error over trials, (n_levels, n_methods), infinite if one failed; NaN without a trial."""
        return _over_trials(np.where(self.failed, np.inf, self.errors[state]), self.ran, np.max)

    @property
    def failure_share(self) -> FloatArray:
        """Fraction of trials that failed, (n_levels, n_methods); NaN without a trial."""
        return _over_trials(self.failed.astype(float), self.ran, np.mean)


@dataclass(frozen=True)
class ParameterErrors:
    """Relative errors of estimated parameters, by parameter and (n_levels, n_methods, n_trials).

    An error is ``|found / reference - 1|``: infinite without an estimate, also in trials without data; NaN without a
    trial, and for parameters that are 0 in the plant.

    Parameters
    ----------
    errors : to the pseudo-true parameters of each trial's flight
    errors_to_true : to the plant's parameters
    covered : 1 where the 95 % interval contains the pseudo-true parameter, to one millionth; 0 where not, NaN without
        an interval
    differs : (n_levels,), True where a pseudo-true parameter differs from the true one by more than 0.2 %
    disturbed : (n_levels,), True where the plant has a disturbance that the model leaves out
    """

    errors: Mapping[str, FloatArray]
    errors_to_true: Mapping[str, FloatArray]
    covered: Mapping[str, FloatArray]
    differs: BoolArray
    disturbed: BoolArray

    @cached_property
    def worst(self) -> FloatArray:
        """Largest error of a parameter to the pseudo-true ones, (n_levels, n_methods, n_trials)."""
        return _largest(self.errors)

    @cached_property
    def worst_to_true(self) -> FloatArray:
        """Largest error of a parameter to the true ones, (n_levels, n_methods, n_trials)."""
        return _largest(self.errors_to_true)

    @staticmethod
    def median(errors: FloatArray) -> FloatArray:
        """Median over trials, (n_levels, n_methods); NaN without a trial."""
        return _over_trials(errors, ~np.isnan(errors), np.median)

    @staticmethod
    def largest(errors: FloatArray) -> FloatArray:
        """Largest error over trials, (n_levels, n_methods); NaN without a trial."""
        return _over_trials(errors, ~np.isnan(errors), np.max)

    def coverage(self, *, disturbed: bool) -> list[tuple[int, int]]:
        """Number of intervals that contain the pseudo-true parameter, and number of intervals, by method."""
        some = np.array([one[self.disturbed == disturbed] for one in self.covered.values()])
        held, there = np.nansum(some, axis=(0, 1, 3)), (~np.isnan(some)).sum(axis=(0, 1, 3))
        return [(int(a), int(n)) for a, n in zip(held, there, strict=True)]


@dataclass(frozen=True)
class Summary:
    """Contents of a store as arrays.

    Parameters
    ----------
    name, description, axis, unit : of the study and its axis
    levels, methods : numbers in ascending order, words in the order in which they were asked for
    units : state -> unit
    ran : (n_levels, n_methods, n_trials), trials that are in the store
    flights : tracking errors by trajectory
    estimates : parameter errors; None in a study that does not evaluate parameters
    failures : (method, error) -> number of trials, the most frequent first
    seconds : (n_methods, n_stages), s of one process, summed over trials
    stages : names of the columns of ``seconds``
    versions : of Python and the packages that computed the rows
    asked, missing : number of rows that were asked for, and of those yet to run
    """

    name: str
    description: str
    axis: str
    unit: str
    levels: tuple[str, ...]
    methods: tuple[str, ...]
    units: Mapping[str, str]
    ran: BoolArray
    flights: Mapping[str, TrackingErrors]
    estimates: ParameterErrors | None
    failures: Mapping[tuple[str, str], int]
    seconds: FloatArray
    stages: tuple[str, ...]
    versions: tuple[str, ...]
    asked: int
    missing: int

    @property
    def remark(self) -> str:
        """Sentence on missing rows, ``18 of 24 rows are missing.``; "" for a complete store."""
        verb = "is" if self.missing == 1 else "are"
        return f"{self.missing} of {self.asked} rows {verb} missing." if self.missing else ""

    @property
    def positions(self) -> FloatArray:
        """Coordinates of the levels on an axis, (n_levels,): their values, or 0, 1, 2, ... for words."""
        values = [_value(level) for level in self.levels]
        return np.arange(len(values), dtype=float) if None in values else np.array(values, dtype=float)

    @property
    def is_numeric(self) -> bool:
        """True if all levels are numbers."""
        return None not in map(_value, self.levels)


def summarise(store: str | Path) -> Summary:
    """Summary of the rows of a store.

    Raises
    ------
    StudyError
        There is no such store, or it has no rows yet.
    """
    rows, progress, words = read(store), status(store), about(store)
    with Store.existing(store) as kept:
        noted, parts = kept.about, kept.configuration
    if not len(rows):
        raise StudyError(f'store "{store}" has no rows yet; run its study first')
    with damage(Path(store)):
        plants = {level: PlantFacts.from_dict(one) for level, one in noted["plants"].items()}
        return _summary(rows, progress, words, parts, plants)


def _summary(
    rows: pl.DataFrame,
    progress: Status,
    words: Mapping[str, str],
    parts: Mapping[str, Mapping[str, Any]],
    noted: Mapping[str, PlantFacts],
) -> Summary:
    """Summary of what a store holds.  Raises LookupError, TypeError, ValueError: its parts do not fit together."""
    named = dict.fromkeys(level for level, _ in progress.cells)
    values = [value for value in map(_value, named) if value is not None]
    levels = tuple(named if len(values) < len(named) else sorted(named, key=float))
    if len(set(values)) < len(values):
        raise ValueError(f"levels {', '.join(levels)} have equal values")
    methods = tuple(dict.fromkeys(method for _, method in progress.cells))
    plants = [noted[level] for level in levels]
    if any((list(x.units), list(x.parameters)) != (list(plants[0].units), list(plants[0].parameters)) for x in plants):
        raise ValueError("plants of several models")
    units = plants[0].units
    table = _Table(rows, levels, methods)
    seconds = rows.select("method", "seconds").unnest("seconds")
    stages = tuple(seconds.columns[1:])
    failed = rows.filter(status="failed").select("method", "error").iter_rows()
    by_method = {method: seconds.filter(method=method).select(stages).sum().row(0) for method in methods}
    return Summary(
        **words,
        levels=levels,
        methods=methods,
        units=units,
        ran=table.ran,
        flights={shape: _flights(table, shape, list(units)) for shape in parts["study"]["evaluation.trajectories"]},
        estimates=_estimates(table, plants) if parts["study"].get("evaluation.parameters") else None,
        failures=dict(Counter((str(method), str(error)) for method, error in failed).most_common()),
        seconds=np.array(list(by_method.values()), dtype=float),
        stages=stages,
        versions=tuple(dict.fromkeys(rows["versions"])),
        asked=progress.asked,
        missing=progress.missing,
    )


class _Table:
    """A store's rows as arrays (n_levels, n_methods, n_trials)."""

    def __init__(self, rows: pl.DataFrame, levels: Sequence[str], methods: Sequence[str]) -> None:
        cells = [
            (levels.index(level), methods.index(method), trial)
            for level, method, trial in rows.select("level", "method", "trial").iter_rows()
        ]
        self._rows, self._where = rows, tuple(np.array(cells).T)
        if len(levels) * len(methods) * int(self._where[2].max()) > 100_000_000:
            raise ValueError(f"trial {int(self._where[2].max())}")
        self.ran = np.zeros((len(levels), len(methods), int(self._where[2].max()) + 1), dtype=bool)
        self.ran[self._where] = True

    def column(self, name: str) -> FloatArray:
        """A column of numbers; NaN for null.  Raises KeyError: there is none of that name."""
        if name not in self._rows.columns:
            raise KeyError(name)
        found = np.full(self.ran.shape, np.nan)
        found[self._where] = self._rows[name].to_numpy()
        return found


def _flights(table: _Table, shape: str, states: Sequence[str]) -> TrackingErrors:
    errors = {state: table.column(f"{shape}_{state}") for state in states}
    for state, found in errors.items():
        if (found < 0.0).any():
            raise ValueError(f"{shape}_{state} is {np.nanmin(found):.6g}")
    return TrackingErrors(errors, table.ran, table.ran & np.isnan(errors[states[0]]))


def _estimates(table: _Table, plants: Sequence[PlantFacts]) -> ParameterErrors:
    errors, errors_to_true, covered, differs = {}, {}, {}, np.zeros(len(plants), dtype=bool)
    for name in plants[0].parameters:
        kinds = ("parameter", "pseudo_true", "low", "high")
        found, pseudo_true, low, high = (table.column(f"{kind}_{name}") for kind in kinds)
        true = np.array([plant.parameters[name] for plant in plants])[:, None, None]
        true = np.broadcast_to(true, pseudo_true.shape)
        defined = table.ran & (true != 0.0)
        reached = np.where(np.isnan(pseudo_true), true, pseudo_true)  # without data the error is infinite either way
        errors[name] = relative_errors(found, np.where(defined, reached, np.nan))
        errors_to_true[name] = relative_errors(found, np.where(defined, true, np.nan))
        covered[name] = covers(low, high, pseudo_true)
        differs |= (defined & differ(reached, true)).any(axis=(1, 2))
    return ParameterErrors(errors, errors_to_true, covered, differs, np.array([plant.disturbed for plant in plants]))


def _largest(errors: Mapping[str, FloatArray]) -> FloatArray:
    """The largest of errors by name; NaN where all are."""
    return np.asarray(np.fmax.reduce(list(errors.values())))


def _over_trials(values: FloatArray, counted: BoolArray, statistic: _Statistic) -> FloatArray:
    """Statistic of the counted trials, (n_levels, n_methods); NaN without one."""
    found = np.full(values.shape[:2], np.nan)
    for cell in np.argwhere(counted.any(axis=2)):
        found[tuple(cell)] = statistic(values[tuple(cell)][counted[tuple(cell)]])
    return found


def _value(level: str) -> float | None:
    """Value of a level; None for a word."""
    try:
        value = float(level)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _sample_deviation(values: FloatArray) -> np.floating:
    """Standard deviation with n - 1; exactly 0 for equal values, in spite of rounding of the mean."""
    if not np.isfinite(values).all():
        return np.float64(np.inf)
    return np.float64(np.std(values - values[0], ddof=1))
