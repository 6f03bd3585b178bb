"""What a store notes about the plant of each level, so that it can be read where a user's file isn't."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from diransac.model.plant import Plant
from diransac.study.judging import is_disturbed

__all__ = ["PlantFacts"]


@dataclass(frozen=True)
class PlantFacts:
    """What a summary says of a plant.

    Parameters
    ----------
    units : state of its model -> unit, in order
    parameters : by name, its own, in order
    disturbed : whether something acts on it that its model leaves out
    """

    units: Mapping[str, str]
    parameters: Mapping[str, float]
    disturbed: bool

    @classmethod
    def of(cls, plant: Plant) -> PlantFacts:
        """Those of a plant."""
        units = {name: plant.model.units[name] for name in plant.model.state}
        return cls(units, dict(plant.parameters), is_disturbed(plant))
