"""`PlantChoice`: the plant of a study, by its kind and its arguments.

Kinds are the paper's rotorcraft, further machines with effects that their models leave out, and functions in files of
users.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator

from diransac.errors import DiransacError, ModelError, SettingsError
from diransac.model.library import TABLE_I, builtin, extended_rotorcraft
from diransac.model.plant import Plant, check_possible
from diransac.study.machines import double_pendulum, pendulum, rotorcraft_in_gusts, servo_axis, underwater_vehicle
from diransac.study.tables import RANDOM, FunctionTable, Text, check_signature, function_arguments
from diransac.user_files import blaming, definitions, file_and_name, running


def _undisturbed(parameters: Mapping[str, float] = TABLE_I) -> Plant:
    """The planar rotorcraft without any disturbance."""
    return Plant(builtin("planar-rotorcraft"), parameters)


_KINDS: dict[str, Callable[..., Plant]] = {
    "extended-rotorcraft": extended_rotorcraft,
    "planar-rotorcraft": _undisturbed,
    "rotorcraft-in-gusts": rotorcraft_in_gusts,
    "servo-axis": servo_axis,
    "double-pendulum": double_pendulum,
    "pendulum": pendulum,
    "underwater-vehicle": underwater_vehicle,
}


class PlantChoice(FunctionTable):
    """The plant of a study, the table ``[plant]``, with all of its arguments, defaults included.

    Parameters
    ----------
    kind : ``extended-rotorcraft`` (`models.extended_rotorcraft`); ``planar-rotorcraft``, with parameters only;
        ``rotorcraft-in-gusts``, ``servo-axis``, ``double-pendulum``, ``pendulum``, ``underwater-vehicle``; or
        ``FILE.py:NAME``, a function of that name (default ``plant``) in a file, which is run wherever trials run
    file_digest : of the file, so that every worker and every resumed run uses the same one; "" for other kinds
    arguments : by name, as TOML has them: a list for a pair, ``random`` for a rotor phase that each flight draws;
        model parameters that are not given have the plant's defaults, such as Table I

    Raises
    ------
    SettingsError
        An unknown kind or key, a value that makes no plant, a parameter outside its bounds, a file that is missing or
        has changed.
    """

    PLACE: ClassVar[str] = "plant"

    kind: Text
    file_digest: Text = Field("", validate_default=True)
    arguments: dict[str, Any] = Field({})

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        if kind not in _KINDS and file_and_name(kind, "plant") is None:
            raise SettingsError(f"plant.kind is {kind!r:.60}; there are {', '.join(_KINDS)}, or give FILE.py:NAME")
        return kind

    @field_validator("file_digest")
    @classmethod
    def _of_the_file(cls, digest: str, info: ValidationInfo) -> str:
        kind = info.data.get("kind")
        if kind is None or kind in _KINDS:
            return digest
        found = _digest(kind)  # also where one is given: the file must be there
        return digest or found

    @field_validator("arguments")
    @classmethod
    def _complete(cls, given: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if "kind" not in info.data:
            return given
        kind, digest = info.data["kind"], info.data["file_digest"]
        if kind in _KINDS and digest:
            given = {**given, "file_digest": digest}  # which is then refused
        with _settings_errors():
            function = _function(kind, digest)
            return function_arguments(function, given, "plant", ["kind"], random="rotor_phase", pairs=True)

    @model_validator(mode="after")
    def _makes_a_plant(self) -> Self:
        with _settings_errors():  # also of arguments that make no plant
            check_possible(self.plant.model, self.plant.parameters)
        return self

    @property
    def plant(self) -> Plant:
        """The plant itself."""
        return _made(self.kind, self.file_digest, json.dumps(self.arguments))

    @property
    def is_drawn(self) -> bool:
        """True if the seed of a flight draws a start value of a disturbance."""
        return any(isinstance(start, tuple) for one in self.plant.disturbances for start in one.start.values())


@contextlib.contextmanager
def _settings_errors() -> Iterator[None]:
    """Raises SettingsError in place of the other errors of a plant."""
    try:
        yield
    except SettingsError:
        raise
    except DiransacError as error:
        raise SettingsError(f"plant: {error}") from error


@functools.lru_cache(maxsize=64)
def _made(kind: str, digest: str, arguments: str) -> Plant:
    """A plant from its arguments as JSON; levels with the same arguments share it."""
    function = _function(kind, digest)
    return function(**{name: _as_argument(name, value) for name, value in json.loads(arguments).items()})


def _as_argument(name: str, value: Any) -> Any:
    """A value of a table as the plant's function takes it."""
    if name == "rotor_phase" and value == RANDOM:
        return None
    return tuple(value) if isinstance(value, list) else value


# Files of users -------------------------------------------------------------------------------------------------------
@functools.lru_cache(maxsize=8)
def _function(kind: str, digest: str) -> Callable[..., Plant]:
    """The function that makes plants of a kind.

    Raises ModelError: a user's file cannot be run, or has no such function.
    Raises SettingsError: the file is missing, or has another digest.
    """
    if kind in _KINDS:
        return _KINDS[kind]
    if _digest(kind) != digest:
        raise SettingsError(
            f"plant.kind: {kind} is not the file that the study was begun with: its digest is {_digest(kind)}, not "
            f"{digest}; give that one, or begin a new store"
        )
    file, name = _file_and_name(kind)
    defined = definitions(file, "plant")
    made_by = defined.get(name)
    if not callable(made_by):
        found = ", ".join(key for key, value in defined.items() if inspect.isfunction(value)) or "none"
        raise ModelError(
            f'plant file "{file}" has no function "{name}" that returns a diransac.Plant; functions found: {found}'
        )
    with blaming(file, "plant"):
        check_signature(made_by, name)
    return _checked(made_by, file, name)


def _digest(kind: str) -> str:
    """Digest of the bytes of a user's file.  Raises SettingsError: the file cannot be read."""
    file, _ = _file_and_name(kind)
    try:
        return hashlib.blake2b(file.read_bytes(), digest_size=8).hexdigest()
    except OSError as error:
        raise SettingsError(
            f'plant.kind: "{file}" cannot be read: {error.strerror}; it must be there wherever trials run, by this name'
        ) from error


def _checked(function: Callable[..., Any], file: Path, name: str) -> Callable[..., Plant]:
    """The function, with its errors and its result checked."""

    @functools.wraps(function)  # keeps the signature, whose arguments are keys
    def made(**arguments: Any) -> Plant:
        with running(file, "plant"):
            found = function(**arguments)
        if not isinstance(found, Plant):
            raise ModelError(f'plant file "{file}": "{name}" returns a {type(found).__name__}, not a diransac.Plant')
        return found

    return made


def _file_and_name(kind: str) -> tuple[Path, str]:
    """File and function of a user's plant."""
    found = file_and_name(kind, "plant")
    assert found is not None
    return found
