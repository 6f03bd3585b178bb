"""Where studies come from: TOML files, those that the package brings, and the one to start from."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from diransac.errors import SettingsError
from diransac.study.specification import Study
from diransac.study.tables import changed

__all__ = ["builtin_names", "load", "template"]

_FOLDER = files("diransac.study")


def builtin_names() -> list[str]:
    """Names of the studies that the package brings."""
    return sorted(file.name.removesuffix(".toml") for file in (_FOLDER / "builtin").iterdir())


def template() -> str:
    """A study with a comment at every key, to start one's own from."""
    return (_FOLDER / "template.toml").read_text(encoding="utf-8")


def load(source: Study | Mapping[str, Any] | str | Path, changes: Mapping[str, Any] | None = None) -> Study:
    """A study by the name of one that the package brings, or of a TOML file, or from its tables.

    Parameters
    ----------
    source : a path that has a folder or ends in ``.toml`` is a file
    changes : dotted path -> value, laid over it

    Raises SettingsError: there is none, or it describes no study; it says at which key.
    """
    if isinstance(source, Study):
        return Study.from_dict(changed(source.to_dict(), changes)) if changes else source
    if isinstance(source, Mapping):
        return Study.from_dict(changed(source, changes or {}))
    try:
        return Study.from_dict(changed(tomllib.loads(_text(source)), changes or {}))
    except tomllib.TOMLDecodeError as error:
        why = str(error).replace("Cannot overwrite a value", "a key, or a level, stands there twice")
        raise SettingsError(f'study "{source}" is not TOML: {why}') from error
    except SettingsError as error:
        raise SettingsError(f'study "{source}": {error}') from error


def _text(source: str | Path) -> str:
    path = Path(source)
    if isinstance(source, str) and path.suffix != ".toml" and path.name == source:
        if source not in builtin_names():
            raise SettingsError(
                f"there is none of that name; there are {', '.join(builtin_names())}, or give FILE.toml"
            )
        return (_FOLDER / "builtin" / f"{source}.toml").read_text(encoding="utf-8")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise SettingsError(f"the file cannot be read: {reason}") from error
