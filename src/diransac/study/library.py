"""Sources of studies: TOML files, the built-in studies and the template."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from diransac.errors import SettingsError
from diransac.limits import LARGEST_TABLE
from diransac.plain_data import read_text, toml_table
from diransac.study.specification import Study
from diransac.study.tables import changed

_FOLDER = files("diransac.study")


def builtin_names() -> list[str]:
    """Names of the built-in studies."""
    return sorted(file.name.removesuffix(".toml") for file in (_FOLDER / "builtin").iterdir())


def template() -> str:
    """Text of a study file with a comment at every key."""
    return (_FOLDER / "template.toml").read_text(encoding="utf-8")


def load(source: Study | Mapping[str, Any] | str | Path, changes: Mapping[str, Any] | None = None) -> Study:
    """A study from a built-in name, a TOML file or tables.

    Parameters
    ----------
    source : a string with a folder, or that ends in ``.toml``, is a file
    changes : dotted path -> value, laid over it

    Raises
    ------
    SettingsError
        There is no such study or file, or a key is wrong.
    """
    if isinstance(source, Study):
        return Study.from_dict(changed(source.to_dict(), changes)) if changes else source
    if isinstance(source, Mapping):
        return Study.from_dict(changed(source, changes or {}))
    try:
        return Study.from_dict(changed(toml_table(_text(source)), changes or {}))
    except SettingsError as error:
        raise SettingsError(f'study "{source}": {error}') from error
    except ValueError as error:
        why = str(error).replace("Cannot overwrite a value", "a key, or a level, stands there twice")
        raise SettingsError(f'study "{source}" is not TOML: {why}') from error


def _text(source: str | Path) -> str:
    path = Path(source)
    if isinstance(source, str) and path.suffix != ".toml" and path.name == source:
        if source not in builtin_names():
            raise SettingsError(
                f"there is none of that name; there are {', '.join(builtin_names())}, or give FILE.toml"
            )
        return (_FOLDER / "builtin" / f"{source}.toml").read_text(encoding="utf-8")
    try:
        return read_text(path, LARGEST_TABLE)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SettingsError(f"the file cannot be read: {reason}") from error
