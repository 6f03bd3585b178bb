"""Columns of joints in degrees that do not say so: beyond the joint's range in rad, and within it in degrees."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, bulk_range, interpolated
from diransac.data.units import conversion, one_turn, same_unit
from diransac.text_table import listed, number

if TYPE_CHECKING:
    from diransac.data.log import Log
    from diransac.model import Model

_DEGREE = math.pi / 180.0
_HALFWAY = math.sqrt(_DEGREE)
"""Ratio that is as far from 1 as from a degree in rad."""


def in_degrees(log: Log, model: Model) -> Log:
    """Log in which columns of joints that are in degrees have that unit, with a note; the same log if none is.

    Positions are recorded alike, and so are targets: what a range proves of one holds for the others of its kind,
    unless the joint's column of the other kind, or its derivative, contradicts.

    Parameters
    ----------
    log : Log
        Units that it states, and factors that it was given, hold.
    model : Model
        With ranges of its coordinates.
    """
    if not model.ranges:
        return log
    joints = {n: n for n, unit in model.coordinates.items() if one_turn(unit) is not None}
    kinds = [
        {n: q for n, q in kind.items() if n in log and q in joints and same_unit(model.units[n], "rad")}
        for kind in (joints, model.targets)
    ]
    known, rates = _known(log, model), _rates(model)
    proven = [_proven(log, {n: q for n, q in kind.items() if n not in known}, model) for kind in kinds]
    # In rad: of positions, those whose targets are known to be; of targets, by what is then decided of positions.
    partners = {q: log[n] * x for n, q in kinds[1].items() if (x := _factor(n, known, proven[1])) is not None}
    found = _alike(log, kinds[0], proven[0], known, rates, partners)
    partners = {n: log[n] * known.get(n, _DEGREE if n in found else 1.0) for n in kinds[0]}
    found += _alike(log, kinds[1], proven[1], known, rates, partners)
    if not found:
        return log
    units = dict.fromkeys(found, "deg")
    for name in (n for n in found if _travel(log, n, rates) < 1.0 / _HALFWAY):
        ends = zip(rates.get(name, ()), ("deg/s", "deg/s^2"), strict=False)
        units |= {n: unit for n, unit in ends if n in log and n not in known}
    return replace(
        log, units={**log.units, **units}, notes=(*log.notes, _note(log, model, found, (proven[0] or proven[1])[0]))
    )


def _alike(
    log: Log,
    kind: Mapping[str, str],
    proven: Collection[str],
    known: Collection[str],
    rates: Mapping[str, Sequence[str]],
    partners: Mapping[str, FloatArray],
) -> list[str]:
    """Columns of a kind in degrees: the proven ones, and the others unless their rates, or partners, are in rad."""
    rates_in_rad = any(_travel(log, n, rates) > 1.0 / _HALFWAY for n in proven)
    found = list[str]()
    for name in (n for n in kind if proven and n not in known):
        is_rad = rates_in_rad and 0.0 < _travel(log, name, rates) < 1.0 / _HALFWAY
        is_rad |= _is_rad(log[name], partners.get(kind[name]))
        found += [name] if name in proven or not is_rad else []
    return found


def _rates(model: Model) -> dict[str, tuple[str, ...]]:
    """Derivatives of coordinates and of targets in rad, by name."""
    speeds = {q: n for n, q in model.targets.items() if same_unit(model.units[n], "rad/s")}
    of_targets = {n: (speeds[q],) for n, q in model.targets.items() if q in speeds}
    return {x[0]: x[1:] for x in model.chains} | of_targets


def _known(log: Log, model: Model) -> dict[str, float]:
    """Factors to rad, or to its derivatives, of columns whose unit is stated, or that the user scaled."""
    scaled = {n: x for step in log.history if step.get("step") == "scale" for n, x in step["factors"].items()}
    stated = {n: conversion(unit, model.units[n]) for n, unit in log.units.items() if n in model.units}
    return {n: 1.0 for n, x in scaled.items() if x != -1.0} | {n: x for n, x in stated.items() if x is not None}


def _factor(name: str, known: Mapping[str, float], proven: Collection[str]) -> float | None:
    """Factor to rad of a column, of whose kind some are proven to be in degrees; None where it is not known."""
    if name in known:
        return known[name]
    return _DEGREE if name in proven else None if proven else 1.0


def _proven(log: Log, columns: Mapping[str, str], model: Model) -> list[str]:
    """Columns, of these by their coordinate, that a range proves to be in degrees; none if most contradict that."""
    proven, contradict = list[str](), 0
    for name, coordinate in columns.items():
        low, high = model.ranges.get(coordinate, (-np.inf, np.inf))
        width, (first, last) = high - low, bulk_range(log[name])
        # Two ranges, or two turns beyond one, are no error of a zero or of a description.
        beyond = last - first > 2.0 * width or max(low - first, last - high) > max(width, 4.0 * np.pi)
        slack = 0.1 * width
        within = first * _DEGREE > low - slack and last * _DEGREE < high + slack
        proven += [name] if beyond and within else []
        contradict += not within
    return proven if len(proven) > contradict else []


def _is_rad(values: FloatArray, partner: FloatArray | None) -> bool:
    """True if a column varies as its partner in rad does, rather than 57 times as much."""
    if partner is None:
        return False
    own, other = (float(np.subtract(*bulk_range(x)[::-1])) for x in (values, partner))
    return own > 0.0 and other > 0.0 and own / other < 1.0 / _HALFWAY


def _travel(log: Log, name: str, rates: Mapping[str, Sequence[str]]) -> float:
    """Change of a column over the integral of its rate: 1 in one unit, 57 in degrees and rad/s; 0: not known."""
    rate = next(iter(rates.get(name, ())), None)
    if rate is None or rate not in log:
        return 0.0
    x, v = interpolated(np.column_stack([log[name], log[rate]])).T
    span = max(1, len(x) // 50)
    change, integral = (float(np.median(np.abs(y[span:] - y[:-span]))) for y in (x, np.cumsum(v) * log.dt))
    return change / integral if integral > 0.0 else 0.0


def _note(log: Log, model: Model, names: Collection[str], proven: str) -> str:
    """The columns in degrees, the proof of one of them, and the option that contradicts it."""
    coordinate = model.targets.get(proven, proven)
    low, high, least, largest = map(number, (*model.ranges[coordinate], *bulk_range(log[proven])))
    return (
        f"{listed(list(names))} {'is' if len(names) == 1 else 'are'} read as degrees: {proven} goes from {least} to "
        f"{largest}, beyond the range of {coordinate}, {low} to {high} rad, and within it in degrees; "
        f"if it is in rad, pass --scale {','.join(f'{n}=1' for n in names)}"
    )
