"""Which plant a study flies: its kind, and every argument that makes one."""

from __future__ import annotations

import functools
import hashlib
import inspect
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diransac.errors import DiransacError, ModelError, SettingsError
from diransac.model.library import TABLE_I, builtin, extended_rotorcraft
from diransac.model.plant import Plant
from diransac.study.arguments import ANY, check_signature, given_arguments
from diransac.study.tables import Reader
from diransac.study.vehicles import double_pendulum, pendulum, servo_axis
from diransac.user_files import blaming, definitions, file_and_name, running

__all__ = ["PlantChoice"]


def _undisturbed(parameters: Mapping[str, float] = TABLE_I) -> Plant:
    """The planar rotorcraft with nothing that its model leaves out."""
    return Plant(builtin("planar-rotorcraft"), parameters)


_KINDS: dict[str, Callable[..., Plant]] = {
    "extended-rotorcraft": extended_rotorcraft,
    "planar-rotorcraft": _undisturbed,
    "servo-axis": servo_axis,
    "double-pendulum": double_pendulum,
    "pendulum": pendulum,
}
_DEFAULT_NAME = "plant"
_DIGEST_KEY = "file_digest"


@dataclass(frozen=True)
class PlantChoice:
    """A plant by its kind and all of its arguments, those that nobody gave included.

    Parameters
    ----------
    kind : ``extended-rotorcraft`` (`models.extended_rotorcraft`); ``planar-rotorcraft``, which has parameters alone;
        ``servo-axis``, ``double-pendulum`` or ``pendulum`` (`study.vehicles`); or ``FILE.py:NAME``, a function of that
        name (``plant`` if none is given) in a file that is run wherever trials are
    arguments : by name, as TOML has them: a list for a pair, the word ``any`` for a rotor phase that is drawn;
        parameters of the model that nobody named are the plant's own, such as those of Table I
    file_digest : of the file, so that every worker, and every run that goes on with a store, has the same one; "" of a
        kind that needs none
    """

    kind: str
    arguments: Mapping[str, Any]
    file_digest: str = ""

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> PlantChoice:
        """The plant of a study's table.

        Raises SettingsError: an unknown kind or key, a value that makes no plant, a file that is not there or not what
        it was.
        """
        reader = Reader(table, "plant")
        kind = _kind(reader.text("kind"))
        digest = "" if kind in _KINDS else reader.text(_DIGEST_KEY, _digest(kind))
        try:
            arguments = given_arguments(_function(kind, digest), table, reader, "rotor_phase", pairs=True)
            reader.end(unnamed=[_DIGEST_KEY])
            found = cls(kind, arguments, digest)
            found.plant  # noqa: B018  refuses what makes no plant
        except SettingsError:
            raise
        except DiransacError as error:
            raise SettingsError(f"plant: {error}") from error
        return found

    def to_dict(self) -> dict[str, Any]:
        """The table that `from_dict` takes."""
        file = {_DIGEST_KEY: self.file_digest} if self.file_digest else {}
        return {"kind": self.kind, **self.arguments, **file}

    @property
    def plant(self) -> Plant:
        """The plant itself."""
        return _made(self.kind, self.file_digest, json.dumps(self.arguments))

    @property
    def is_drawn(self) -> bool:
        """Whether one flight differs from another by more than its controller."""
        return any(isinstance(start, tuple) for one in self.plant.disturbances for start in one.start.values())


@functools.lru_cache(maxsize=64)
def _made(kind: str, digest: str, arguments: str) -> Plant:
    """A plant from its arguments as JSON: levels that leave it as it is share it."""
    function = _function(kind, digest)
    return function(**{name: _as_meant(name, value) for name, value in json.loads(arguments).items()})


def _as_meant(name: str, value: Any) -> Any:
    """An argument as the plant's function takes it."""
    if name == "rotor_phase" and value == ANY:
        return None
    return tuple(value) if isinstance(value, list) else value


# A user's own --------------------------------------------------------------------------------------------------------
def _kind(text: str) -> str:
    """The kind itself.  Raises SettingsError: there is none of that name, and it is no file's."""
    if text not in _KINDS and file_and_name(text, _DEFAULT_NAME) is None:
        raise SettingsError(f"plant.kind is {text!r:.60}; there are {', '.join(_KINDS)}, or give FILE.py:NAME")
    return text


@functools.lru_cache(maxsize=8)
def _function(kind: str, digest: str) -> Callable[..., Plant]:
    """What makes a plant of this kind.

    Raises ModelError: a user's file cannot be run, or has no such function.
    Raises SettingsError: the file is not there, or has another digest.
    """
    if kind in _KINDS:
        return _KINDS[kind]
    if _digest(kind) != digest:
        raise SettingsError(
            f"plant.kind: {kind} is not the file that the study was begun with: its digest is {_digest(kind)}, not "
            f"{digest}; give that one, or begin a new store"
        )
    file, name = _own(kind)
    defined = definitions(file, "plant")
    made_by = defined.get(name)
    if not callable(made_by):
        found = ", ".join(key for key, value in defined.items() if inspect.isfunction(value)) or "none"
        raise ModelError(
            f'plant file "{file}" has no function "{name}" that returns a diransac.Plant; functions found: {found}'
        )
    with blaming(file, "plant"):
        check_signature(made_by, name)
    return _blamed(made_by, file, name)


def _digest(kind: str) -> str:
    """Of the bytes of a user's file.  Raises SettingsError: the file cannot be read."""
    file, _ = _own(kind)
    try:
        return hashlib.blake2b(file.read_bytes(), digest_size=8).hexdigest()
    except OSError as error:
        raise SettingsError(
            f'plant.kind: "{file}" cannot be read: {error.strerror}; it must be there wherever trials run, by this name'
        ) from error


def _blamed(function: Callable[..., Any], file: Path, name: str) -> Callable[..., Plant]:
    """The function, with a sentence for whatever goes wrong in it."""

    @functools.wraps(function)  # the arguments of what is wrapped are those that a study may give
    def made(**arguments: Any) -> Plant:
        with running(file, "plant"):
            found = function(**arguments)
        if not isinstance(found, Plant):
            raise ModelError(f'plant file "{file}": "{name}" returns a {type(found).__name__}, not a diransac.Plant')
        return found

    return made


def _own(kind: str) -> tuple[Path, str]:
    """File and name of a user's plant."""
    found = file_and_name(kind, _DEFAULT_NAME)
    assert found is not None
    return found
