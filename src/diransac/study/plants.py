"""Which plant a study flies: its kind, and every argument that makes one."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from diransac.errors import DiransacError, SettingsError
from diransac.models import TABLE_I, builtin, extended_rotorcraft
from diransac.plant import Plant
from diransac.study.arguments import ANY, given_arguments
from diransac.study.tables import Reader

__all__ = ["PlantChoice"]


def _undisturbed(parameters: Mapping[str, float] = TABLE_I) -> Plant:
    """The planar rotorcraft with nothing that its model leaves out."""
    return Plant(builtin("planar-rotorcraft"), parameters)


_KINDS: dict[str, Callable[..., Plant]] = {
    "extended-rotorcraft": extended_rotorcraft,
    "planar-rotorcraft": _undisturbed,
}


@dataclass(frozen=True)
class PlantChoice:
    """A plant by its kind and all of its arguments, those that nobody gave included.

    Parameters
    ----------
    kind : ``extended-rotorcraft`` (`models.extended_rotorcraft`), or ``planar-rotorcraft``, which has parameters alone
    arguments : by name, as TOML has them: a list for a pair, the word ``any`` for a rotor phase that is drawn;
        parameters of the model that nobody named are those of Table I
    """

    kind: str
    arguments: Mapping[str, Any]

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> PlantChoice:
        """The plant of a study's table.

        Raises SettingsError: an unknown kind or key, or a value that makes no plant.
        """
        reader = Reader(table, "plant")
        kind = reader.text("kind", choices=tuple(_KINDS))
        arguments = given_arguments(_KINDS[kind], table, reader, drawn="rotor_phase", pairs=True)
        reader.end()
        found = cls(kind, arguments)
        try:
            found.plant  # noqa: B018  refuses what makes no plant
        except DiransacError as error:
            raise SettingsError(f"plant: {error}") from error
        return found

    def to_dict(self) -> dict[str, Any]:
        """The table that `from_dict` takes."""
        return {"kind": self.kind, **self.arguments}

    @property
    def plant(self) -> Plant:
        """The plant itself."""
        return _made(self.kind, json.dumps(self.arguments))

    @property
    def is_drawn(self) -> bool:
        """Whether one flight differs from another by more than its controller."""
        return any(isinstance(start, tuple) for one in self.plant.disturbances for start in one.start.values())


@lru_cache(maxsize=64)
def _made(kind: str, arguments: str) -> Plant:
    """A plant from its arguments as JSON: levels that leave it as it is share it."""
    return _KINDS[kind](**{name: _as_meant(name, value) for name, value in json.loads(arguments).items()})


def _as_meant(name: str, value: Any) -> Any:
    """An argument as the plant's function takes it."""
    if name == "rotor_phase" and value == ANY:
        return None
    return tuple(value) if isinstance(value, list) else value
