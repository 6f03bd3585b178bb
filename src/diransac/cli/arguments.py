"""Models, methods and settings from the text of command-line arguments."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from diransac.errors import ModelError
from diransac.identification.method import Method
from diransac.identification.methods import WITH_ESTIMATOR, configured, estimator_named, setting_names
from diransac.identification.settings import Settings, nearest_names
from diransac.model import Model
from diransac.plain_data import toml_file, toml_table
from diransac.user_files import definitions, file_and_name, is_description

# ---------------------------------------------------------------------- lists of pairs


def pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """``["a=b,c=d", "e=f"]`` as a mapping.

    Parameters
    ----------
    option : str
        Name of the option in messages.
    texts : sequence of str
        Pairs, separated by commas.

    Raises
    ------
    typer.BadParameter
        An item is not a pair, or a name is given twice.
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

    Parameters
    ----------
    option : str
        Name of the option in messages.
    texts : sequence of str
        Pairs, separated by commas.

    Raises
    ------
    typer.BadParameter
        As `pairs`; a value is not a number.
    """
    found = pairs(option, texts)
    try:
        return {name: float(value) for name, value in found.items()}
    except ValueError as error:
        raise typer.BadParameter(f"{option}: {error}; give name=number pairs") from error


def fixed_parameters(texts: Sequence[str] | None) -> dict[str, float | None]:
    """``["mass=0.25,gravity"]`` of ``--fix`` as values by name; None for a name alone.

    Raises
    ------
    typer.BadParameter
        As `numbers`.
    """
    items = [item for text in texts or () for item in names(text)]
    alone = [item for item in items if "=" not in item]
    found: dict[str, float | None] = {**numbers("--fix", [item for item in items if "=" in item])}
    for name in alone:
        if name in found:
            raise typer.BadParameter(f"--fix: {name} is given twice")
        found[name] = None
    return found


def start_values(text: str | None) -> dict[str, float] | None:
    """``"mass=0.3,drag=0.02"`` of ``--start`` as values by name; None without a text.

    Raises
    ------
    typer.BadParameter
        As `numbers`.
    """
    return None if text is None else numbers("--start", names(text))


def prior_pairs(texts: Sequence[str] | None) -> dict[str, tuple[float, float]]:
    """``["inertia=0.004,0.001"]`` of ``--prior`` as a mean and a standard deviation by name.

    Raises
    ------
    typer.BadParameter
        A text is not ``name=mean,deviation``, or a name is given twice.
    """
    found: dict[str, tuple[float, float]] = {}
    for text in texts or ():
        name, _, values = (part.strip() for part in text.partition("="))
        try:
            mean, std = (float(x) for x in values.split(","))
        except ValueError as error:
            raise typer.BadParameter(f"--prior: {text!r} is not name=mean,standard deviation") from error
        if name in found:
            raise typer.BadParameter(f"--prior: {name} is given twice")
        found[name] = (mean, std)
    return found


# ---------------------------------------------------------------------- settings


def load_settings(file: Path | None, assignments: Sequence[str]) -> dict[str, Any]:
    """Settings by name from a TOML file, replaced by ``key=value`` assignments in order.

    Parameters
    ----------
    file : Path, optional
    assignments : sequence of str
        As ``sample_size=50`` or ``inlier_thresholds.x_dot=0.5``.

    Raises
    ------
    SettingsError
        The file cannot be read.
    typer.BadParameter
        An assignment is not ``key=value``.
    """
    table = (
        {}
        if file is None
        else {key.replace("-", "_"): value for key, value in toml_file(file, "settings file").items()}
    )
    for (first, *inner), value in assigned(assignments, "sample_size=50"):
        _assign(table, [first.replace("-", "_"), *inner], value)
    return {key: _none_where_meant(key, value) for key, value in table.items()}


def assigned(assignments: Sequence[str], example: str) -> Iterator[tuple[list[str], object]]:
    """Keys ``a, b`` and value of each ``a.b=value`` of ``--set``.

    Parameters
    ----------
    assignments : sequence of str
    example : str
        An assignment, for the message.

    Raises
    ------
    typer.BadParameter
        An assignment has another form.
    """
    for text in assignments:
        path, equals, value = text.partition("=")
        keys = [part.strip() for part in path.split(".")]
        if not equals or not all(keys):
            raise typer.BadParameter(f"--set: {text!r} is not key=value, such as {example}")
        yield keys, _toml_value(value.strip())


def load_methods(names: Sequence[str], settings: Mapping[str, Any], estimator: str | None = None) -> list[Method]:
    """Methods by name, each with those of the given settings that it has.

    Parameters
    ----------
    names : sequence of str
    settings : mapping of str to object
    estimator : str, optional
        Name of the estimator inside the RANSAC methods.

    Raises
    ------
    typer.BadParameter
        A setting belongs to none of the methods, or none has an estimator inside.
    SettingsError
        A value is out of range, or of another type.
    """
    if estimator is not None and not set(names) & set(WITH_ESTIMATOR):
        raise typer.BadParameter(f"--estimator serves {', '.join(WITH_ESTIMATOR)}; found {', '.join(names)}")
    known = {name: setting_names(name) for name in names}
    for key in settings:
        if not any(key in own for own in known.values()):
            of_one = f'method "{names[0]}" has' if len(names) == 1 else "none of the methods has"
            own = list(dict.fromkeys(x for own in known.values() for x in own))
            raise typer.BadParameter(f'{of_one} no setting "{key}"; {nearest_names(key, own)}')
    inside = {} if estimator is None else {"estimator": estimator_named(estimator)}
    return [
        configured(
            name,
            {key: value for key, value in settings.items() if key in known[name]},
            **(inside if name in WITH_ESTIMATOR else {}),
        )
        for name in names
    ]


def _assign(table: dict[str, Any], keys: Sequence[str], value: object) -> None:
    """``table[a][b] = value`` for keys a, b; what is no mapping on the way becomes one."""
    *path, last = keys
    for key in path:
        inner = table.get(key)
        table[key] = table = inner if isinstance(inner, dict) else {}
    table[last] = value


def _toml_value(text: str) -> object:
    """A TOML value; a bare word is itself."""
    for candidate in (text, text.lower(), f"[{text}]" if "," in text else text):
        try:
            return toml_table(f"value = {candidate}")["value"]
        except ValueError:
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


def is_result(text: str) -> bool:
    """True for the name of a result, ``.json``."""
    return Path(text).suffix.lower() == ".json"


def preparation_of(model: str | None) -> Sequence[Mapping[str, Any]]:
    """History of the log from which a result was identified, where a model is named by its result; else empty.

    Parameters
    ----------
    model : str or None

    Returns
    -------
    sequence of dict

    Raises
    ------
    ResultError
        The result cannot be loaded.
    """
    if model is None or not is_result(model):
        return ()
    from diransac.identification.result import Result

    return Result.load(model).logs[0].preparation


def model_file(text: str) -> Path | None:
    """The file of ``file.py[:name]``, of a robot's description or of a result; None for a built-in model's name."""
    if is_description(text) or is_result(text):
        return Path(text)
    found = file_and_name(text, "model")
    return None if found is None else found[0]


def load_model(text: str) -> Model:
    """The built-in model of that name, the one that ``file.py[:name]`` defines, or that of a result.

    Raises
    ------
    ModelError
        There is no such model, the file cannot be run, or the name is not that of a model.
    ResultError
        The result cannot be loaded.
    """
    if is_result(text):
        from diransac.identification.result import Result

        return Result.load(text).model
    found = file_and_name(text, "model")
    if found is None:
        from diransac.model.library import builtin

        return builtin(text)
    file, name = found
    defined = definitions(file, "model")
    if name not in defined:
        models = ", ".join(key for key, value in defined.items() if isinstance(value, Model)) or "none"
        raise ModelError(
            f'model file "{file}" does not define "{name}"; models found: {models}. Choose with {file}:NAME'
        )
    value = defined[name]
    if not isinstance(value, Model):
        hint = f"call it there: model = {name}()" if callable(value) else "assign a diransac.Model to it"
        raise ModelError(f'model file "{file}": "{name}" is of type {type(value).__name__}, not a Model; {hint}')
    return value
