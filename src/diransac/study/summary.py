"""What a store says, level by level and method by method.

How flights were tracked and how many are missing; where a study judges parameters, how far off these are.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import StudyError
from diransac.study.facts import PlantFacts
from diransac.study.judging import differ, hold, relative_errors
from diransac.study.plants import PlantChoice
from diransac.study.reading import read, status
from diransac.study.store import Store
from diransac.study.tables import changed

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Estimates", "Flights", "Summary", "summarise"]

_Statistic = Callable[[FloatArray], np.floating]


@dataclass(frozen=True)
class Flights:
    """How one trajectory was tracked.

    A trial without a flight (no parameters, no plan, no controller, or numbers that overflowed) has no error that a
    mean could hold: it is counted as failed.  A flight that ends far from where it should has a large error, and is in
    the mean like any other.

    Parameters
    ----------
    errors : state -> RMS tracking error (n_levels, n_methods, n_trials), state's unit; NaN without a flight
    ran : (n_levels, n_methods, n_trials), which trials there are
    failed : the same, which of these have no flight
    """

    errors: Mapping[str, FloatArray]
    ran: BoolArray
    failed: BoolArray

    def mean(self, state: str) -> FloatArray:
        """Mean over the flights there are, (n_levels, n_methods); NaN where there is none."""
        return _over_trials(self.errors[state], ~np.isnan(self.errors[state]), np.mean)

    def deviation(self, state: str) -> FloatArray:
        """Standard deviation of the flights there are, with n - 1; NaN where there are fewer than two."""
        there = ~np.isnan(self.errors[state])
        enough = there & (there.sum(axis=2, keepdims=True) > 1)
        return _over_trials(self.errors[state], enough, _sample_deviation)

    def median(self, state: str) -> FloatArray:
        """Median over all trials, of which one that failed counts as an infinite error; NaN where there is none."""
        return _over_trials(np.where(self.failed, np.inf, self.errors[state]), self.ran, _upper_median)

    def largest(self, state: str) -> FloatArray:
        """Largest error of all trials, infinite where one failed; NaN where there is none."""
        return _over_trials(np.where(self.failed, np.inf, self.errors[state]), self.ran, np.max)

    @property
    def failure_share(self) -> FloatArray:
        """Fraction of the trials that failed, (n_levels, n_methods); NaN where there are none."""
        return _over_trials(self.failed.astype(float), self.ran, np.mean)


@dataclass(frozen=True)
class Estimates:
    """How far parameters are off, by parameter and (n_levels, n_methods, n_trials).

    An error is ``|found / reference - 1|``: infinite where nothing was found, which includes trials without data, for
    which no best parameters are known; NaN where there is no trial, and of a parameter that is 0 in the plant.

    Parameters
    ----------
    errors : against the best parameters that the model can reach in the very flight
    errors_of_own : against the plant's own
    covered : 1 where the 95 % interval holds the best parameter, to a millionth; 0 where not, NaN without an interval
    differs : (n_levels,) whether the best parameters are not the plant's own: some differ by more than 0.2 %
    disturbed : (n_levels,) whether the plant has more to it than the model
    """

    errors: Mapping[str, FloatArray]
    errors_of_own: Mapping[str, FloatArray]
    covered: Mapping[str, FloatArray]
    differs: BoolArray
    disturbed: BoolArray

    @cached_property
    def worst(self) -> FloatArray:
        """Error of the worst parameter against the best ones, (n_levels, n_methods, n_trials)."""
        return _largest(self.errors)

    @cached_property
    def worst_of_own(self) -> FloatArray:
        """The same against the plant's own parameters."""
        return _largest(self.errors_of_own)

    @staticmethod
    def median(errors: FloatArray) -> FloatArray:
        """Median over the trials that were judged, (n_levels, n_methods); NaN where there is none."""
        return _over_trials(errors, ~np.isnan(errors), np.median)

    @staticmethod
    def largest(errors: FloatArray) -> FloatArray:
        """Largest error of the trials that were judged, (n_levels, n_methods); NaN where there is none."""
        return _over_trials(errors, ~np.isnan(errors), np.max)

    def coverage(self, *, disturbed: bool) -> list[tuple[int, int]]:
        """Of each method's intervals, how many hold the best parameter, and how many there are.

        Parameters
        ----------
        disturbed : at the levels whose plant has more to it than the model, or at the others
        """
        some = np.array([one[self.disturbed == disturbed] for one in self.covered.values()])
        held, there = np.nansum(some, axis=(0, 1, 3)), (~np.isnan(some)).sum(axis=(0, 1, 3))
        return [(int(a), int(n)) for a, n in zip(held, there, strict=True)]


@dataclass(frozen=True)
class Summary:
    """What a store says.

    Parameters
    ----------
    name, description, axis, unit : the study's words, and the unit of its axis
    levels, methods : numbers in ascending order, words in the order in which they were asked for
    units : state -> its unit
    ran : (n_levels, n_methods, n_trials), which trials there are
    flights : by trajectory
    estimates : None where the study judges no parameters
    failures : (method, why) -> how many trials, the most frequent first
    seconds : (n_methods, n_stages), s of one process, summed over trials
    stages : what these are of
    versions : of what computed the rows
    asked, missing : rows that were asked for, and how many of these are yet to come
    """

    name: str
    description: str
    axis: str
    unit: str
    levels: tuple[str, ...]
    methods: tuple[str, ...]
    units: Mapping[str, str]
    ran: BoolArray
    flights: Mapping[str, Flights]
    estimates: Estimates | None
    failures: Mapping[tuple[str, str], int]
    seconds: FloatArray
    stages: tuple[str, ...]
    versions: tuple[str, ...]
    asked: int
    missing: int

    @property
    def remark(self) -> str:
        """How much of the study is not here yet, ``18 of 24 rows are missing.``; nothing once all is."""
        verb = "is" if self.missing == 1 else "are"
        return f"{self.missing} of {self.asked} rows {verb} missing." if self.missing else ""

    @property
    def positions(self) -> FloatArray:
        """Where the levels stand on an axis, (n_levels,): their values, or 0, 1, 2, ... if they are words."""
        values = [_value(level) for level in self.levels]
        return np.arange(len(values), dtype=float) if None in values else np.array(values, dtype=float)

    @property
    def is_numeric(self) -> bool:
        """Whether all levels are numbers."""
        return None not in map(_value, self.levels)


def summarise(store: str | Path) -> Summary:
    """What the rows of a store say.

    Raises StudyError: there is no such store, or it has no rows yet.
    """
    rows, progress = read(store), status(store)
    with Store.existing(store) as kept:
        words, parts, noted = kept.about, kept.configuration, kept.plants
        cells = kept.select("SELECT level, method FROM cells ORDER BY rowid")
    if not len(rows):
        raise StudyError(f'store "{store}" has no rows yet; run its study first')
    levels = _in_order(list(dict.fromkeys(level for level, _ in cells)))
    methods = tuple(dict.fromkeys(method for _, method in cells))
    plants = [noted.get(level) or _facts(level, parts) for level in levels]
    units = plants[0].units
    table = _Table(rows, levels, methods)
    seconds = rows.select("method", "seconds").unnest("seconds")
    stages = tuple(seconds.columns[1:])
    by_method = {method: seconds.filter(method=method).select(stages).sum().row(0) for method in methods}
    return Summary(
        **words,
        levels=levels,
        methods=methods,
        units=units,
        ran=table.ran,
        flights={shape: _flights(table, shape, list(units)) for shape in parts["study"]["evaluation.trajectories"]},
        estimates=_estimates(table, plants) if parts["study"].get("evaluation.parameters") else None,
        failures=_failures(rows),
        seconds=np.array(list(by_method.values()), dtype=float),
        stages=stages,
        versions=tuple(dict.fromkeys(rows["versions"])),
        asked=progress.asked,
        missing=progress.missing,
    )


def _facts(level: str, parts: Mapping[str, Mapping[str, Any]]) -> PlantFacts:
    """Facts about the plant of a level, made anew from the configuration: a store of before has not noted them."""
    table = changed(changed({}, parts["study"]), parts[f"levels.{level}"])
    return PlantFacts.of(PlantChoice.from_dict(table["plant"]).plant)


class _Table:
    """A store's rows as arrays (n_levels, n_methods, n_trials)."""

    def __init__(self, rows: pl.DataFrame, levels: Sequence[str], methods: Sequence[str]) -> None:
        cells = [
            (levels.index(level), methods.index(method), trial)
            for level, method, trial in rows.select("level", "method", "trial").iter_rows()
        ]
        self._rows, self._where = rows, tuple(np.array(cells).T)
        self.ran = np.zeros((len(levels), len(methods), int(self._where[2].max()) + 1), dtype=bool)
        self.ran[self._where] = True

    def column(self, name: str) -> FloatArray:
        """A column of numbers, NaN where there is none."""
        found = np.full(self.ran.shape, np.nan)
        found[self._where] = self._rows[name].to_numpy()
        return found


def _flights(table: _Table, shape: str, states: Sequence[str]) -> Flights:
    errors = {state: table.column(f"{shape}_{state}") for state in states}
    return Flights(errors, table.ran, table.ran & np.isnan(errors[states[0]]))


def _estimates(table: _Table, plants: Sequence[PlantFacts]) -> Estimates:
    errors, errors_of_own, covered, differs = {}, {}, {}, np.zeros(len(plants), dtype=bool)
    for name in plants[0].parameters:
        found, best, low, high = (table.column(f"{what}_{name}") for what in ("parameter", "best", "low", "high"))
        own = np.broadcast_to(np.array([plant.parameters[name] for plant in plants])[:, None, None], best.shape)
        judged = table.ran & (own != 0.0)
        reached = np.where(np.isnan(best), own, best)  # without data nothing is found, whatever it is compared to
        errors[name] = relative_errors(found, np.where(judged, reached, np.nan))
        errors_of_own[name] = relative_errors(found, np.where(judged, own, np.nan))
        covered[name] = hold(low, high, best)
        differs |= (judged & differ(reached, own)).any(axis=(1, 2))
    return Estimates(errors, errors_of_own, covered, differs, np.array([plant.disturbed for plant in plants]))


def _largest(errors: Mapping[str, FloatArray]) -> FloatArray:
    """The largest of errors by name; NaN where all are."""
    return np.asarray(np.fmax.reduce(list(errors.values())))


def _over_trials(values: FloatArray, counted: BoolArray, statistic: _Statistic) -> FloatArray:
    """A statistic of those trials that count, (n_levels, n_methods); NaN where none does."""
    found = np.full(values.shape[:2], np.nan)
    for cell in np.argwhere(counted.any(axis=2)):
        found[tuple(cell)] = statistic(values[tuple(cell)][counted[tuple(cell)]])
    return found


def _failures(rows: pl.DataFrame) -> dict[tuple[str, str], int]:
    failed = rows.filter(status="failed").select("method", "error").iter_rows()
    return dict(Counter((str(method), str(error)) for method, error in failed).most_common())


def _in_order(levels: Sequence[str]) -> tuple[str, ...]:
    values = {level: _value(level) for level in levels}
    return tuple(levels) if None in values.values() else tuple(sorted(levels, key=float))


def _value(level: str) -> float | None:
    """The number that a level is; None for a word."""
    try:
        value = float(level)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _upper_median(values: FloatArray) -> np.floating:
    """The median; of an even number the upper one, so that infinities are not averaged with numbers."""
    return np.float64(np.sort(values)[len(values) // 2])


def _sample_deviation(values: FloatArray) -> np.floating:
    """The standard deviation with n - 1; exactly 0 of equal values, whose mean rounds."""
    return np.float64(np.std(values - values[0], ddof=1))
