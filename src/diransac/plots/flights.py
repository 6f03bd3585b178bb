"""What a picture shows: flights with their references, and how much of them an axis has room for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.log import Log
from diransac.errors import SettingsError
from diransac.flight.trajectory import Trajectory
from diransac.plots.palette import COLOURS, DASHES

__all__ = ["Flight", "Range", "around", "extent", "flights_of", "last_number", "leaves", "near", "path_box", "shown"]

Range = tuple[float, float]

# Of what an axis shows: the margin, and how far off a line is still drawn.  Of a path: its least breadth.
_MARGIN, _FARTHEST, _LEAST_BREADTH = 0.06, 20.0, 0.15
# How far a flight usually is from its reference, as `_reach` counts; how much that may widen an axis; from where on it
# is all that counts.
_USUAL_SHARE, _USUAL_FACTOR, _WIDENING, _NEGLIGIBLE = 0.2, 5.0, 5.0, 1e-4


@dataclass(frozen=True)
class Flight:
    """One flight, its reference, and how it looks."""

    label: str
    reference: Trajectory
    log: Log
    colour: str
    dashes: tuple[float, ...]


def flights_of(trajectory: Trajectory | Mapping[str, Trajectory], log: Log | Mapping[str, Log]) -> list[Flight]:
    """The flights by their labels.

    Raises SettingsError: there is none, labels don't match, a trajectory has no names, or others than the first has.
    LogError: a log lacks a state or input.
    """
    logs = dict(log) if isinstance(log, Mapping) else {"flown": log}
    if not logs:
        raise SettingsError("there is no flight to draw; give a log, or a mapping from label to log")
    references = dict(trajectory) if isinstance(trajectory, Mapping) else dict.fromkeys(logs, trajectory)
    if set(references) != set(logs):
        raise SettingsError(
            f"the trajectories are called {', '.join(map(str, references))}, the logs {', '.join(map(str, logs))}; "
            "give both the same labels, or one trajectory for all"
        )
    for label, flown in logs.items():
        _check(label, references[label], flown)
    first = references[next(iter(logs))]
    for label, other in references.items():
        if (other.state_names, other.input_names) != (first.state_names, first.input_names):
            raise SettingsError(f'the trajectory of "{label}" has other states or inputs; draw it on another picture')
    looks = [(COLOURS[i % len(COLOURS)], DASHES[i % len(DASHES)]) for i in range(len(logs))]
    return [
        Flight(str(label), references[label], flown, *look)
        for (label, flown), look in zip(logs.items(), looks, strict=True)
    ]


def _check(label: str, reference: object, log: object) -> None:
    if not isinstance(reference, Trajectory) or not isinstance(log, Log):
        raise SettingsError(
            f'"{label}" is a {type(reference).__name__} and a {type(log).__name__}; give a Trajectory and a Log'
        )
    if not reference.state_names or not reference.input_names:
        raise SettingsError(
            f'the trajectory of "{label}" does not name its states and inputs; give state_names and input_names'
        )
    for name in (*reference.state_names, *reference.input_names):
        log[name]


# What an axis has room for -------------------------------------------------------------------------------------------
def shown(name: str, flights: Sequence[Flight]) -> Range:
    """The references, and of the flights what comes within reach of them, with a margin."""
    planned = np.concatenate([flight.reference[name] for flight in flights])
    flown = [values for flight in flights if len(values := _finite(flight.log[name]))]
    low, high = float(planned.min()), float(planned.max())
    reach = _reach(planned, flown)
    visible = np.clip(np.concatenate([planned, *flown]), low - reach, high + reach)
    low, high = float(visible.min()), float(visible.max())
    width = high - low
    if not width > 1e-9 * max(abs(low), abs(high)):
        width = max(abs(low), abs(high), 1.0)
    return low - _MARGIN * width, high + _MARGIN * width


def _reach(planned: FloatArray, flown: Sequence[FloatArray]) -> float:
    """How far beyond the references a panel follows the flights: as far as the references themselves extend.

    Where these hardly move, the flight that stays nearest tells how far it usually is, before it may diverge.  That
    widens the axis by a few times, or without limit if the references rest but for rounding.
    """
    size = float(np.ptp(planned))
    off = [float(np.quantile(np.abs(values - np.median(planned)), _USUAL_SHARE)) for values in flown]
    usual = _USUAL_FACTOR * min(off, default=0.0)
    return usual if size < _NEGLIGIBLE * usual else max(size, min(usual, _WIDENING * size))


def path_box(flights: Sequence[Flight]) -> tuple[Range, Range] | None:
    """What a picture of the path shows in x and z at least; None where the states have no x and z."""
    if not {"x", "z"} <= set(flights[0].reference.state_names):
        return None
    x, z = shown("x", flights), shown("z", flights)
    least = _LEAST_BREADTH * max(extent(x), extent(z))
    return around(x, max(extent(x), least)), around(z, max(extent(z), least))


def near(values: FloatArray, visible: Range) -> FloatArray:
    """The values, those far outside brought nearer: a canvas has no room for them."""
    reach = _FARTHEST * extent(visible)
    return np.asarray(np.clip(values, visible[0] - reach, visible[1] + reach))


def extent(visible: Range) -> float:
    """How much an axis shows."""
    return visible[1] - visible[0]


def around(visible: Range, width: float) -> Range:
    """As much around the same middle."""
    middle = (visible[0] + visible[1]) / 2.0
    return middle - width / 2.0, middle + width / 2.0


def _finite(values: Iterable[float]) -> FloatArray:
    array = np.asarray(values)
    return np.asarray(array[np.isfinite(array)])


# Where a flight can no longer be seen --------------------------------------------------------------------------------
def leaves(values: FloatArray, visible: Range) -> int | None:
    """The first row that lies outside; None where none does."""
    outside = np.flatnonzero((values < visible[0]) | (values > visible[1]))
    return int(outside[0]) if len(outside) else None


def last_number(values: FloatArray) -> int | None:
    """The last row that is finite, if all that follow are not; None where the last row is, or none is."""
    finite = np.flatnonzero(np.isfinite(values))
    return int(finite[-1]) if len(finite) and finite[-1] < len(values) - 1 else None
