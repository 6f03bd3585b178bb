"""From what a user typed to a model, settings and a prepared log."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import runpy
import sys
import tomllib
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from diransac.cli.silence import silenced
from diransac.errors import DiransacError, ModelError, SettingsError
from diransac.model import Model
from diransac.settings import Settings

__all__ = ["load_model", "load_settings", "model_file", "names", "numbers", "pairs", "toml_value"]

_MODEL_FILE = re.compile(r"(.+\.py)(?::(\w+))?")


# ---------------------------------------------------------------------- lists of pairs


def pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """``["a=b,c=d", "e=f"]`` as a mapping.

    Raises typer.BadParameter: an item is no pair, or a name is given twice.
    """
    found: dict[str, str] = {}
    for item in (item.strip() for text in texts for item in text.split(",")):
        name, equals, value = (part.strip() for part in item.partition("="))
        if not (name and equals and value):
            raise typer.BadParameter(f"{option}: {item!r} is not name=value; give pairs, separated by commas")
        if name in found:
            raise typer.BadParameter(f"{option}: {name} is given twice")
        found[name] = value
    return found


def names(text: str) -> list[str]:
    """``"a, b"`` as a list."""
    return [name for name in (part.strip() for part in text.split(",")) if name]


def numbers(option: str, texts: Sequence[str]) -> dict[str, float]:
    """``["a=1,b=2.5"]`` as numbers by name.

    Raises typer.BadParameter: a value is no number.
    """
    found = pairs(option, texts)
    try:
        return {name: float(value) for name, value in found.items()}
    except ValueError as error:
        raise typer.BadParameter(f"{option}: {error}; give name=number pairs") from error


# ---------------------------------------------------------------------- settings


def load_settings(file: Path | None, assignments: Sequence[str]) -> Settings:
    """Settings of a TOML file, with ``key=value`` assignments laid over them in order.

    Raises
    ------
    SettingsError
        the file cannot be read or has an unknown setting, or a value has no meaning.
    typer.BadParameter
        an assignment is not ``key=value``, or its key is no setting.
    """
    table = {} if file is None else {key.replace("-", "_"): value for key, value in _read_toml(file).items()}
    for text in assignments:
        key, equals, value = text.partition("=")
        keys = [part.strip() for part in key.split(".")]
        if not equals or not all(keys):
            raise typer.BadParameter(f"--set: {text!r} is not key=value")
        _assign(table, [_known_setting(keys[0]), *keys[1:]], toml_value(value.strip()))
    return Settings.from_dict({key: _none_where_meant(key, value) for key, value in table.items()})


def _known_setting(key: str) -> str:
    name = key.replace("-", "_")
    known = [field.name for field in dataclasses.fields(Settings)]
    if name not in known:
        raise typer.BadParameter(f'--set: there is no setting "{key}"; there are {", ".join(known)}')
    return name


def _read_toml(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(f'settings file "{file}" cannot be read: {error.strerror}') from error
    except ValueError as error:
        raise SettingsError(f'settings file "{file}" is not TOML: {error}') from error


def _assign(table: dict[str, Any], keys: Sequence[str], value: object) -> None:
    """``table[a][b] = value`` for keys a, b; what is no mapping on the way becomes one."""
    *path, last = keys
    for key in path:
        inner = table.get(key)
        table[key] = table = inner if isinstance(inner, dict) else {}
    table[last] = value


def toml_value(text: str) -> object:
    """A TOML value; a bare word is itself."""
    for candidate in (text, text.lower(), f"[{text}]" if "," in text else text):
        try:
            return tomllib.loads(f"value = {candidate}")["value"]
        except tomllib.TOMLDecodeError:
            continue
    try:
        return float(text)
    except ValueError:
        return text


def _none_where_meant(key: str, value: object) -> object:
    """None for the word ``none``, unless it is one of the setting's own choices."""
    nullable = {field.name for field in dataclasses.fields(Settings) if "None" in str(field.type)}
    return None if key in nullable and str(value).lower() == "none" else value


# ---------------------------------------------------------------------- models


def model_file(text: str) -> Path | None:
    """The file of ``file.py[:name]``; None for a built-in model's name."""
    match = _MODEL_FILE.fullmatch(text)
    return None if match is None else Path(match[1])


def load_model(text: str) -> Model:
    """The built-in model of that name, or the one that ``file.py[:name]`` defines.

    Raises ModelError: there is none of that name, the file cannot be run, or what it defines is no model.
    """
    match = _MODEL_FILE.fullmatch(text)
    if match is None:
        from diransac.models import builtin

        return builtin(text)
    file, name = Path(match[1]), match[2] or "model"
    defined = _run(file)
    if name not in defined:
        found = ", ".join(key for key, value in defined.items() if isinstance(value, Model)) or "none"
        raise ModelError(
            f'model file "{file}" does not define "{name}"; models found: {found}. Choose with {file}:NAME'
        )
    value = defined[name]
    if not isinstance(value, Model):
        hint = f"call it there: model = {name}()" if callable(value) else "assign a diransac.Model to it"
        raise ModelError(f'model file "{file}": "{name}" is of type {type(value).__name__}, not a Model; {hint}')
    return value


def _run(file: Path) -> Mapping[str, object]:
    """Names that a user's file defines; it may import its neighbours, and what it prints is not shown."""
    if not file.is_file():
        raise ModelError(f'model file "{file}" does not exist; give a built-in name or file.py[:name]')
    try:
        with _importable(file.resolve().parent), silenced():
            return runpy.run_path(str(file), run_name="diransac_model_file")
    except DiransacError as error:
        raise ModelError(f'model file "{file}"{_line(error, file)}: {error}') from error
    except (Exception, SystemExit) as error:
        what = error.msg if isinstance(error, SyntaxError) else error
        raise ModelError(f'model file "{file}"{_line(error, file)}: {type(error).__name__}: {what}') from error


@contextlib.contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """A folder on the module path; no bytecode is left in it."""
    path, keep = list(sys.path), sys.dont_write_bytecode
    sys.path.insert(0, str(folder))
    sys.dont_write_bytecode = True
    try:
        yield
    finally:
        sys.path[:], sys.dont_write_bytecode = path, keep


def _line(error: BaseException, file: Path) -> str:
    """``, line 12``: where in the user's file an error arose; nothing where it did not."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}" if error.lineno else ""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    return f", line {lines[-1]}" if lines else ""
