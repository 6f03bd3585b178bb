"""Which flight a study records: a trajectory by its name, and every argument that makes it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from diransac.errors import SettingsError
from diransac.flight.planning import multisine, random_waypoints, sine, square, star
from diransac.flight.planning.trajectories import MAX_DURATION, check_fully_actuated, check_plane
from diransac.flight.trajectory import Trajectory
from diransac.model import Model
from diransac.model.plant import ModelWithParameters
from diransac.study.arguments import ANY, given_arguments, takes_options
from diransac.study.tables import Reader, is_number

__all__ = ["MISSIONS", "TRAJECTORIES", "Flight", "check_flown"]

MISSIONS: dict[str, Callable[..., Trajectory]] = {"square": square, "star": star, "sine": sine}
"""What identified models are judged by."""

TRAJECTORIES: dict[str, Callable[..., Trajectory]] = {**MISSIONS, "places": random_waypoints, "sines": multisine}
"""What may be flown for data."""


def check_flown(trajectory: str, model: Model) -> None:
    """Raises SettingsError: a model of this kind cannot fly the trajectory, whatever its parameters."""
    (check_fully_actuated if trajectory == "sines" else check_plane)(model)


@dataclass(frozen=True)
class Flight:
    """What is flown for data: the table ``[data]`` of a study.

    Parameters
    ----------
    trajectory : a key of `TRAJECTORIES`
    arguments : keyword arguments of that function by name, as TOML has them; the seed may be the word ``any``
    substeps : integration steps from row to row, at least; None: as many as the plant itself asks for

    Raises SettingsError: an argument that isn't above 0, or a flight of more than an hour.
    """

    trajectory: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    substeps: int | None = None

    def __post_init__(self) -> None:
        for name, value in self.arguments.items():
            if name != "seed" and is_number(value) and value <= 0:
                raise SettingsError(f"data.{name} is {value:g}; give a number above 0")
            if name == "duration" and value > MAX_DURATION:
                raise SettingsError(f"data.duration is {value:g}; give {MAX_DURATION:g} s or less")

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Flight:
        """The flight of a study's table.

        Raises SettingsError: an unknown trajectory or key, or a value of another kind.
        """
        reader = Reader(table, "data")
        trajectory = reader.text("trajectory", choices=tuple(TRAJECTORIES))
        substeps = reader.whole("substeps", 1) if reader.has("substeps") else None
        arguments = given_arguments(TRAJECTORIES[trajectory], table, reader, drawn="seed")
        reader.end()
        return cls(trajectory, arguments, substeps)

    def to_dict(self) -> dict[str, Any]:
        """The table that `from_dict` takes."""
        steps = {} if self.substeps is None else {"substeps": self.substeps}
        return {"trajectory": self.trajectory, **self.arguments, **steps}

    @property
    def is_drawn(self) -> bool:
        """Whether each trial flies another one."""
        return bool(self.arguments.get("seed") == ANY)

    def planned(self, plant: ModelWithParameters, seed: int, **options: Any) -> Trajectory:
        """The trajectory.

        Parameters
        ----------
        plant : what is to fly it
        seed : of a flight that is drawn; others have their own
        options : of `plan`, such as time_limit; a trajectory that needs no plan has no use for them

        Raises SettingsError: a model that cannot fly it.
        Raises PlanningError: there is no such trajectory.
        """
        function = TRAJECTORIES[self.trajectory]
        arguments = {**self.arguments, "seed": seed} if self.is_drawn else self.arguments
        return function(plant, **arguments, **(options if takes_options(function) else {}))
