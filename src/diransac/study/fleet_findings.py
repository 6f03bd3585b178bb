"""Vehicles of a fleet that differ from the others, change or drift, by robust statistics of their estimates.

The model of a parameter is that of random effects: the estimate from log k of vehicle v is

    y_vk = mu + b_v + e_vk + n_vk,    n_vk ~ N(0, s_vk^2),    e_vk ~ N(0, sigma_w^2),    b_v ~ N(0, sigma_b^2)

with the standard errors s_vk of the results. Both variances solve Paule and Mandel's equation with the median of the
squared standardised differences in place of their mean, so that less than half of the vehicles, or of the logs, may be
anything; sigma_b is then reweighted once. Means are Huber's.

References: Paule and Mandel 1982 (J. Res. Natl. Bur. Stand. 87); DerSimonian and Kacker 2007 (Contemp. Clin. Trials
28); Huber 1964 (Ann. Math. Stat. 35); Rousseeuw and Leroy 1987 (reweighting); Scott and Knott 1974 (Biometrics 30) for
the binary segmentation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import SettingsError
from diransac.identification.regression.uncertainty import student_quantile
from diransac.study.fleet import FleetRows, FleetStatus, read_fleet
from diransac.text_table import aligned, number, plural

_HUBER = 1.345
"""Standardised residual from which on Huber's mean bounds the influence of a value: 95 % efficiency."""
_EFFICIENCY = 0.95
_SHORTEST = 3
"""Logs on either side of a change."""
_FEWEST_VEHICLES = 8
"""Vehicles that are compared with each other; fewer are not."""


@dataclass(frozen=True)
class VehicleOutlier:
    """A vehicle whose parameter differs from those of the others; `distance` is in standard deviations."""

    vehicle: str
    parameter: str
    value: float
    fleet_value: float
    distance: float
    unit: str

    def __str__(self) -> str:
        return (
            f"{self.vehicle}: {self.parameter} is {_with_unit(self.value, self.unit)}, that of the fleet "
            f"{_with_unit(self.fleet_value, self.unit)}; {number(self.distance, 2)} standard deviations"
        )


@dataclass(frozen=True)
class Change:
    """A step in the life of a vehicle, first seen in a log; `place` counts the vehicle's logs from 1."""

    vehicle: str
    parameter: str
    before: float
    after: float
    log: str
    place: int
    distance: float
    unit: str

    def __str__(self) -> str:
        return (
            f"{self.vehicle}: {self.parameter} changes from {number(self.before)} to "
            f"{_with_unit(self.after, self.unit)} at its log {self.place}, {self.log}; "
            f"{number(self.distance, 2)} standard errors"
        )


@dataclass(frozen=True)
class Drift:
    """A gradual change over the life of a vehicle, from its first to its last log."""

    vehicle: str
    parameter: str
    first: float
    last: float
    distance: float
    unit: str

    def __str__(self) -> str:
        return (
            f"{self.vehicle}: {self.parameter} drifts from {number(self.first)} to {_with_unit(self.last, self.unit)} "
            f"over its logs; {number(self.distance, 2)} standard errors"
        )


def _with_unit(x: float, unit: str) -> str:
    return f"{number(x)} {unit}" if unit not in ("", "1") else number(x)


@dataclass(frozen=True, eq=False)
class ParameterInFleet:
    """A parameter in a fleet.

    Parameters
    ----------
    name, unit : str
    mean, standard_error : float
        Of the fleet, Huber's.
    between, within : float
        Standard deviation among vehicles, and from log to log of one vehicle beyond the standard errors of results.
    vehicles : tuple of str
        Those with at least one estimate.
    values, standard_errors : (n_vehicles,) array
        Of each vehicle, before its first change, or at the beginning of its drift.
    """

    name: str
    unit: str
    mean: float
    standard_error: float
    between: float
    within: float
    vehicles: tuple[str, ...]
    values: FloatArray
    standard_errors: FloatArray


@dataclass(frozen=True, eq=False)
class FleetSummary:
    """A fleet's parameters, and the vehicles that differ, change or drift.

    Parameters
    ----------
    rows : FleetRows
    parameters : tuple of ParameterInFleet
    outliers, changes, drifts : tuple
        Sorted by distance, the largest first.
    level : float
        Probability that a fleet without any has an outlier; the same for changes and drifts.
    """

    rows: FleetRows
    parameters: tuple[ParameterInFleet, ...]
    outliers: tuple[VehicleOutlier, ...]
    changes: tuple[Change, ...]
    drifts: tuple[Drift, ...]
    level: float

    @property
    def status(self) -> FleetStatus:
        """Number of logs done, failed and missing."""
        return self.rows.status

    @cached_property
    def unreliable(self) -> dict[str, tuple[int, int]]:
        """Vehicle -> logs with the verdict "do not rely on this", and all; vehicles without such logs left out."""
        bad = np.array([verdict == "do not rely on this" for verdict in self.rows.verdicts], bool)
        names, index = np.unique(self.rows.vehicles, return_inverse=True)
        counts, all_logs = np.bincount(index[bad], minlength=len(names)), np.bincount(index, minlength=len(names))
        return {str(names[k]): (int(counts[k]), int(all_logs[k])) for k in np.flatnonzero(counts)}

    @property
    def n_vehicles(self) -> int:
        """Number of vehicles with at least one identified log."""
        return len(np.unique(self.rows.vehicles))

    @property
    def findings(self) -> tuple[VehicleOutlier | Change | Drift, ...]:
        """Outliers, changes and drifts."""
        return (*self.outliers, *self.changes, *self.drifts)

    def to_dict(self) -> dict[str, Any]:
        """The summary without the single logs."""
        return {
            "status": self.status.to_dict(),
            "vehicles": self.n_vehicles,
            "parameters": {
                x.name: {k: getattr(x, k) for k in ("unit", "mean", "standard_error", "between", "within")}
                for x in self.parameters
            },
            **{kind: [asdict(x) for x in getattr(self, kind)] for kind in ("outliers", "changes", "drifts")},
            "unreliable": {vehicle: list(counts) for vehicle, counts in self.unreliable.items()},
        }

    def __str__(self) -> str:
        rows = [["parameter", "fleet", "±", "between vehicles", "within a vehicle", "unit"]]
        rows += [
            [x.name, number(x.mean), *(number(y, 3) for y in (x.standard_error, x.between, x.within)), x.unit]
            for x in self.parameters
        ]
        lines = [f"{self.rows.model}, {plural(self.n_vehicles, 'vehicle')}: {self.status}", "", *aligned(rows), ""]
        lines += [f"! {finding}" for finding in self.findings] or ["no vehicle differs, changes or drifts"]
        return "\n".join([*lines, *self.remarks])

    @property
    def remarks(self) -> list[str]:
        """Sentences on what the statistics do not cover."""
        found = []
        if self.n_vehicles < _FEWEST_VEHICLES:
            found.append(f"vehicles are not compared: {self.n_vehicles} are too few, {_FEWEST_VEHICLES} are needed")
        if self.unreliable:
            logs = plural(sum(count for count, _ in self.unreliable.values()), "log")
            vehicles = plural(len(self.unreliable), "vehicle")
            found.append(f'{logs} of {vehicles} with the verdict "do not rely on this"')
        return found


def summarise_fleet(store: str | Path | FleetRows, *, level: float = 0.01) -> FleetSummary:
    """Parameters of a fleet, and vehicles that differ, change or drift.

    Parameters
    ----------
    store : str, Path or FleetRows
        Store of `identify_each`, or its rows.
    level : float, optional
        Probability that a fleet without any gives an outlier, and that it gives a change or drift, by Bonferroni's
        inequality over parameters, vehicles and places.

    Raises
    ------
    StudyError
        There is no such store.
    SettingsError
        The level is not between 0 and 0.5.
    """
    if not 0.0 < level < 0.5:
        raise SettingsError(f"level is {level}; give a number between 0 and 0.5, such as 0.01")
    rows = store if isinstance(store, FleetRows) else read_fleet(store)
    parameters, outliers, steps = [], list[VehicleOutlier](), list[Change | Drift]()
    for name in rows.units:
        lives = _lives(rows, name)
        if not lives:
            continue
        one, differing, changing = _assessed(name, rows, lives, level / len(rows.units))
        parameters.append(one)
        outliers += differing
        steps += changing
    outliers.sort(key=lambda x: -x.distance)
    steps.sort(key=lambda x: -x.distance)
    changes = tuple(x for x in steps if isinstance(x, Change))
    drifts = tuple(x for x in steps if isinstance(x, Drift))
    return FleetSummary(rows, tuple(parameters), tuple(outliers), changes, drifts, level)


# One parameter -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Life:
    """Estimates (n,) of a parameter from the logs of one vehicle, their variances, and the logs' names."""

    vehicle: str
    values: FloatArray
    variances: FloatArray
    logs: Sequence[str]


def _lives(rows: FleetRows, name: str) -> list[_Life]:
    """Lives of all vehicles; estimates without a positive standard error are left out."""
    y, s = rows.values[name], rows.standard_errors[name]
    there = np.flatnonzero(np.isfinite(y) & np.isfinite(s) & (s > 0.0))
    if not len(there):
        return []
    vehicles = rows.vehicles[there]
    ends = np.flatnonzero(vehicles[1:] != vehicles[:-1]) + 1
    return [_Life(str(rows.vehicles[k[0]]), y[k], s[k] ** 2, [rows.logs[i] for i in k]) for k in np.split(there, ends)]


def _assessed(
    name: str, rows: FleetRows, lives: Sequence[_Life], level: float
) -> tuple[ParameterInFleet, list[VehicleOutlier], list[Change | Drift]]:
    """A parameter in the fleet, and its findings at a level."""
    unit, n = rows.units[name], len(lives)
    differences = np.concatenate([np.diff(life.values) for life in lives])
    within = scale_beyond(differences, np.concatenate([x.variances[1:] + x.variances[:-1] for x in lives])) / 2**0.5
    tests = max(1, sum(len(life.values) for life in lives))
    # Successive differences are correlated: two thirds of them count.
    # Efficiency of a scale by the median of absolute deviations.
    limit = _limit(level / tests, 0.37 * len(differences) * 2.0 / 3.0)
    found = list[Change | Drift]()
    begins = np.empty((n, 2))
    for k, life in enumerate(lives):
        steps, begins[k] = _steps_of(life, within, limit, name, unit)
        found += steps
    values, variances = begins.T
    mean, between = _centre(values, variances)
    distances = np.abs(values - mean[0]) / np.sqrt(variances + between**2 + mean[1])
    # Share of the vehicles that count as degrees of freedom of that scale. By simulation of normal vehicles: with
    # it, a fleet of 12 to 200 has an outlier with at most the nominal 1 % or 0.33 %, one of 8 with 1.2 and 0.6 %.
    # The scale's own efficiency is 0.7 to 0.8.
    far = _limit(level / n, 0.5 * (n - 1)) if n >= _FEWEST_VEHICLES else np.inf
    outliers = [
        VehicleOutlier(lives[k].vehicle, name, float(values[k]), mean[0], float(distances[k]), unit)
        for k in np.flatnonzero(distances > far).tolist()
    ]
    vehicles = tuple(life.vehicle for life in lives)
    errors = np.sqrt(variances)
    one = ParameterInFleet(name, unit, mean[0], mean[1] ** 0.5, between, within, vehicles, values, errors)
    return one, outliers, found


def _centre(values: FloatArray, variances: FloatArray) -> tuple[tuple[float, float], float]:
    """Huber's mean (and its variance) of vehicles, and the standard deviation among them, reweighted once.

    The scale by the median is robust and inefficient; that of the vehicles within three of it is Paule and Mandel's.
    """
    mean, between = huber_mean(values, variances), 0.0
    for _ in range(10):  # a fixed point: the mean moves by less than its standard error after the first
        between = scale_beyond(values - mean[0], variances)
        mean = huber_mean(values, variances + between**2)
    # Standardised distance of vehicles that the scale among them leaves out; mean of chi^2_1 below its square.
    near = np.abs(values - mean[0]) <= 3.0 * np.sqrt(variances + between**2)
    n = int(near.sum())
    if n > 1:
        target = 0.97334 * (n - 1) / n
        between = scale_beyond(values[near] - values[near].mean(), variances[near], np.mean, target)
    return huber_mean(values, variances + between**2), between


def _limit(level: float, degrees_of_freedom: float) -> float:
    """Standardised distance that is exceeded with a probability, on either side."""
    return student_quantile(max(1.0, degrees_of_freedom), 1.0 - level / 2.0)


def huber_mean(values: FloatArray, variances: FloatArray) -> tuple[float, float]:
    """Huber's mean of values (n,) with known variances, and its variance."""
    means, of_means = _huber_means(values, variances, np.ones((1, len(values)), bool))
    return float(means[0]), float(of_means[0])


def _huber_means(values: FloatArray, variances: FloatArray, chosen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Huber's mean (m,) of each choice (m, n) of the values, and its variance."""
    exact = chosen / variances
    of_means = 1.0 / (_EFFICIENCY * exact.sum(axis=1))
    means = np.nanmedian(np.where(chosen, values, np.nan), axis=1)
    deviation = np.sqrt(variances)
    for _ in range(50):
        distance = np.abs(values - means[:, None]) / deviation
        weights = exact * np.minimum(1.0, _HUBER / np.maximum(distance, 1e-300))
        before, means = means, weights @ values / weights.sum(axis=1)
        if (np.abs(means - before) <= 1e-6 * np.sqrt(of_means)).all():
            break
    return means, of_means


def scale_beyond(
    deviations: FloatArray,
    variances: FloatArray,
    average: Callable[[FloatArray], Any] = np.median,
    target: float = 0.454936,  # median of a squared standard normal variable
) -> float:
    """Scale sigma with ``average(deviations^2 / (variances + sigma^2)) = target``; 0 where variances suffice.

    Paule and Mandel's equation, by default with the median in place of the mean.
    """
    if len(deviations) < 2:
        return 0.0

    def excess(square: float) -> float:
        return float(average(deviations**2 / (variances + square))) - target

    if excess(0.0) <= 0.0:
        return 0.0
    low, high = 0.0, float((deviations**2).max()) / target
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0.0 else (low, middle)
    return float(np.sqrt(high))


# One vehicle ---------------------------------------------------------------------------------------------------------
def _steps_of(
    life: _Life, within: float, limit: float, name: str, unit: str
) -> tuple[list[Change | Drift], tuple[float, float]]:
    """Changes and drift of a vehicle, and the value at its beginning with the variance."""
    variances = life.variances + within**2
    line, splits = _line(life.values, variances), sorted(_splits(life.values, variances, limit))
    bounds = [0, *(k for k, _ in splits), len(life.values)]
    means = [huber_mean(life.values[a:b], variances[a:b]) for a, b in pairwise(bounds)]
    if line is not None and line.distance > limit:
        steps = np.repeat([mean for mean, _ in means], np.diff(bounds))
        # Huber's loss and Schwarz' criterion: a line has two coefficients; so has each further step, place and size.
        extra = (2 * len(splits) - 1) * float(np.log(len(steps)))
        of_line, of_steps = (_loss(life.values - fitted, variances) for fitted in (line.fitted, steps))
        if not splits or of_line < of_steps + extra:
            first, last = float(line.fitted[0]), float(line.fitted[-1])
            return [Drift(life.vehicle, name, first, last, line.distance, unit)], (first, line.variance_of_first)
    changes: list[Change | Drift] = [
        Change(life.vehicle, name, means[i][0], means[i + 1][0], life.logs[k], k + 1, distance, unit)
        for i, (k, distance) in enumerate(splits)
    ]
    return changes, means[0]


def _splits(values: FloatArray, variances: FloatArray, limit: float, start: int = 0) -> Iterator[tuple[int, float]]:
    """Places of changes, and their distances: the largest is split off, then each side by itself."""
    n = len(values)
    if n < 2 * _SHORTEST:
        return
    # Places at which a change is looked for in one stretch of logs.
    places = np.unique(np.linspace(_SHORTEST, n - _SHORTEST, min(400, n)).astype(int))
    before = np.arange(n) < places[:, None]
    (a, of_a), (b, of_b) = (_huber_means(values, variances, side) for side in (before, ~before))
    distances = np.abs(a - b) / np.sqrt(of_a + of_b)
    best = int(np.argmax(distances))
    if distances[best] > limit:
        k = int(places[best])
        yield start + k, float(distances[best])
        yield from _splits(values[:k], variances[:k], limit, start)
        yield from _splits(values[k:], variances[k:], limit, start + k)


@dataclass(frozen=True, eq=False)
class _Line:
    """A line over the order of the logs (n,), and the slope's distance from 0 in standard errors."""

    fitted: FloatArray
    distance: float
    variance_of_first: float


def _line(values: FloatArray, variances: FloatArray) -> _Line | None:
    """Huber's regression line; None for too few logs."""
    n = len(values)
    if n < 2 * _SHORTEST:
        return None
    design = np.column_stack([np.ones(n), np.linspace(0.0, 1.0, n)])
    weights, coefficients = 1.0 / variances, np.full(2, np.nan)
    for _ in range(30):
        gram = (design * weights[:, None]).T @ design
        before, coefficients = coefficients, np.linalg.solve(gram, design.T @ (weights * values))
        if np.allclose(before, coefficients, rtol=1e-9, atol=0.0):
            break
        distance = np.abs(values - design @ coefficients) / np.sqrt(variances)
        weights = np.minimum(1.0, _HUBER / np.maximum(distance, 1e-300)) / variances
    covariance = np.linalg.inv((design / variances[:, None]).T @ design) / _EFFICIENCY
    distance = float(abs(coefficients[1]) / np.sqrt(covariance[1, 1]))
    return _Line(design @ coefficients, distance, float(covariance[0, 0]))


def _loss(residuals: FloatArray, variances: FloatArray) -> float:
    """Twice Huber's loss of standardised residuals."""
    x = np.abs(residuals) / np.sqrt(variances)
    return float(np.where(x < _HUBER, x**2, 2.0 * _HUBER * x - _HUBER**2).sum())
