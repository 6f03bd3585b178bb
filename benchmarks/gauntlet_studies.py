"""Vehicles of the gauntlet: the studies that the package brings, and flights beside those that they draw.

A new vehicle is one more study in `VEHICLES`; its scenarios are the study's levels.  Nothing happens when this file is
run.
"""

from functools import cache

from diransac.study import FlightChoice, Study, load

VEHICLES = {
    "rotorcraft": "gauntlet",
    "servo-axis": "gauntlet-servo-axis",
    "double-pendulum": "gauntlet-double-pendulum",
    "pendulum": "gauntlet-pendulum",
    "underwater-vehicle": "gauntlet-underwater-vehicle",
    "rotorcraft-in-gusts": "gauntlet-gusts",
}
"""A study each: the name of one that the package brings, or a TOML file."""

DRAWN = "drawn"
"""The study's own flights: another one in every scenario and seed."""

SHOWN_APART = {"rotorcraft": {"star": FlightChoice(trajectory="star", substeps=20)}}
"""Flights that methods have been developed on, which only run when they are asked for."""


def flights_of(vehicle: str) -> list[str]:
    """What a vehicle can fly while it is recorded."""
    return [DRAWN, *SHOWN_APART.get(vehicle, {})]


def scenarios_of(vehicle: str) -> list[str]:
    """What goes wrong with a vehicle, in order."""
    return list(study_of(vehicle).axis.levels)


@cache
def study_of(vehicle: str, flight: str = DRAWN) -> Study:
    """The study of a vehicle, recorded on one of its flights."""
    study = load(VEHICLES[vehicle])
    return study if flight == DRAWN else study.model_copy(update={"data": SHOWN_APART[vehicle][flight]})
