"""What a store says, level by level and method by method: errors of the flights there are, and how many are missing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from diransac.errors import StudyError
from diransac.study.plants import PlantChoice
from diransac.study.reading import read
from diransac.study.store import Store
from diransac.study.tables import changed

if TYPE_CHECKING:
    import polars as pl

__all__ = ["Flights", "Summary", "summarise"]

Floats = npt.NDArray[np.float64]
_Statistic = Callable[[Floats], np.floating]


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

    errors: Mapping[str, Floats]
    ran: npt.NDArray[np.bool_]
    failed: npt.NDArray[np.bool_]

    def mean(self, state: str) -> Floats:
        """Mean over the flights there are, (n_levels, n_methods); NaN where there is none."""
        return self._over_trials(self.errors[state], ~np.isnan(self.errors[state]), np.mean)

    def deviation(self, state: str) -> Floats:
        """Standard deviation of the flights there are, with n - 1; NaN where there are fewer than two."""
        there = ~np.isnan(self.errors[state])
        enough = there & (there.sum(axis=2, keepdims=True) > 1)
        return self._over_trials(self.errors[state], enough, _sample_deviation)

    def median(self, state: str) -> Floats:
        """Median over all trials, of which one that failed counts as an infinite error; NaN where there is none."""
        return self._over_trials(np.where(self.failed, np.inf, self.errors[state]), self.ran, _upper_median)

    @property
    def failure_share(self) -> Floats:
        """Fraction of the trials that failed, (n_levels, n_methods); NaN where there are none."""
        return self._over_trials(self.failed.astype(float), self.ran, np.mean)

    @staticmethod
    def _over_trials(values: Floats, counted: npt.NDArray[np.bool_], statistic: _Statistic) -> Floats:
        found = np.full(values.shape[:2], np.nan)
        for cell in np.argwhere(counted.any(axis=2)):
            found[tuple(cell)] = statistic(values[tuple(cell)][counted[tuple(cell)]])
        return found


@dataclass(frozen=True)
class Summary:
    """What a store says.

    Parameters
    ----------
    name, description, axis, unit : the study's words, and the unit of its axis
    levels, methods : numbers in ascending order, words in the order in which they were asked for
    units : state -> its unit
    flights : by trajectory
    failures : (method, why) -> how many trials, the most frequent first
    seconds : (n_methods, n_stages), s of one process, summed over trials
    stages : what these are of
    versions : of what computed the rows
    """

    name: str
    description: str
    axis: str
    unit: str
    levels: tuple[str, ...]
    methods: tuple[str, ...]
    units: Mapping[str, str]
    flights: Mapping[str, Flights]
    failures: Mapping[tuple[str, str], int]
    seconds: Floats
    stages: tuple[str, ...]
    versions: tuple[str, ...]

    @property
    def positions(self) -> Floats:
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
    rows = read(store)
    with Store.existing(store) as kept:
        words, configuration = kept.about, kept.configuration["study"]
        cells = kept.select("SELECT level, method FROM cells ORDER BY rowid")
    if not len(rows):
        raise StudyError(f'store "{store}" has no rows yet; run its study first')
    levels = _in_order(list(dict.fromkeys(level for level, _ in cells)))
    methods = tuple(dict.fromkeys(method for _, method in cells))
    model = PlantChoice.from_dict(changed({}, configuration)["plant"]).plant.model
    seconds = rows.select("method", "seconds").unnest("seconds")
    stages = tuple(seconds.columns[1:])
    by_method = {method: seconds.filter(method=method).select(stages).sum().row(0) for method in methods}
    return Summary(
        **words,
        levels=levels,
        methods=methods,
        units={name: model.units[name] for name in model.state},
        flights={
            shape: _flights(rows, shape, model.state, levels, methods)
            for shape in configuration["evaluation.trajectories"]
        },
        failures=_failures(rows),
        seconds=np.array(list(by_method.values()), dtype=float),
        stages=stages,
        versions=tuple(dict.fromkeys(rows["versions"])),
    )


def _flights(
    rows: pl.DataFrame, shape: str, states: Sequence[str], levels: Sequence[str], methods: Sequence[str]
) -> Flights:
    cells = [
        (levels.index(level), methods.index(method), trial)
        for level, method, trial in rows.select("level", "method", "trial").iter_rows()
    ]
    where = tuple(np.array(cells).T)
    size = (len(levels), len(methods), int(where[2].max()) + 1)
    errors = {}
    for state in states:
        errors[state] = np.full(size, np.nan)
        errors[state][where] = rows[f"{shape}_{state}"].to_numpy()
    ran = np.zeros(size, dtype=bool)
    ran[where] = True
    return Flights(errors, ran, ran & np.isnan(errors[states[0]]))


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


def _upper_median(values: Floats) -> np.floating:
    """The median; of an even number the upper one, so that infinities are not averaged with numbers."""
    return np.float64(np.sort(values)[len(values) // 2])


def _sample_deviation(values: Floats) -> np.floating:
    """The standard deviation with n - 1; exactly 0 of equal values, whose mean rounds."""
    return np.float64(np.std(values - values[0], ddof=1))
