"""Commands and Python lines of the stages of the page, from a `Project`; the page runs these commands and no others."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from diransac.errors import SettingsError
from diransac.plain_text import printable
from diransac.studio.project import Project, hyphenless, printed, quoted

RESULTS = "diransac-results"
"""Folder of what the commands write, below the first folder."""
CALLS_CODE = {"model", "map", "check", "design", "solve"}
"""Commands that run a model's own code."""

_MODEL = f"{RESULTS}/model.json"
_INSPECT = "from diransac.identification.assessment.inspection import inspect"


def command(kind: str, project: Project, given: Mapping[str, Any], results: Sequence[str]) -> list[str]:
    """Words of a command after the program's name.

    Parameters
    ----------
    kind : str
        One of ``model``, ``map``, ``check``, ``design``, ``solve``, ``validate``, ``predict``, ``export``.
    project : Project
    given : mapping
        What the page has asked for besides: ``log``, ``limits``, ``parameters``, ``horizon``, ``name``.
    results : sequence of str
        Files of the latest solution, one for each limb of a robot.

    Raises
    ------
    SettingsError
        There is no such command, or it lacks something.
    """
    if kind not in _COMMANDS:
        raise SettingsError(f"there is no command {kind!r:.40}; there are {', '.join(_COMMANDS)}")
    return _COMMANDS[kind](project, given, results)


def _model(project: Project) -> list[str]:
    if project.model is None:
        raise SettingsError("there is no model yet; choose one")
    return project.words_of_model()


def _log(project: Project, given: Mapping[str, Any]) -> str:
    name = given.get("log") or next(iter(project.logs), None)
    if not isinstance(name, str):
        raise SettingsError("there is no log yet; choose one")
    return hyphenless(name)


def _logs(project: Project) -> list[str]:
    return [hyphenless(name) for name in project.logs] or [_log(project, {})]


def _solved(results: Sequence[str]) -> list[str]:
    if not results:
        raise SettingsError("there is no result yet; solve first")
    return list(results)


def _horizon(given: Mapping[str, Any]) -> list[str]:
    horizon = given.get("horizon")
    return ["--horizon", f"{float(horizon):g}"] if isinstance(horizon, int | float) and horizon > 0 else []


def _named(given: Mapping[str, Any], key: str, form: Callable[[Any], str]) -> list[str]:
    """Numbers by name as an option's value."""
    values = given.get(key) or {}
    if not isinstance(values, dict) or any("," in x or "=" in x or not x.isprintable() for x in values):
        raise SettingsError(f"{key} are numbers by name, without commas and control characters")
    return [f"{name}={form(value)}" for name, value in values.items()]


def _design(project: Project, given: Mapping[str, Any], results: Sequence[str]) -> list[str]:
    # A result has the parameters with it; a model from a description has limits and nominal values.
    source = _model(project) if project.names_robot or not results else [results[0]]
    words = ["design", *source]
    for text in _named(given, "limits", lambda x: f"{float(x[0]):.6g}:{float(x[1]):.6g}"):
        words += ["--limit", text]
    if source[0] == project.model and not project.names_robot:
        for text in _named(given, "parameters", lambda x: f"{float(x):.6g}"):
            words += ["--parameter", text]
    return [*words, "--time-limit", "30", "-o", f"{RESULTS}/experiment.csv"]


def _solve(project: Project, _given: Mapping[str, Any], _results: Sequence[str]) -> list[str]:
    # Both are needed, and then taken by the project's own words.
    _logs(project)
    _model(project)
    # Not by the file of the project, which may have changed since its model was confirmed.
    return ["identify", *project.words(), "-o", _MODEL, "--report", f"{RESULTS}/report.html"]


def _validate(project: Project, given: Mapping[str, Any], results: Sequence[str]) -> list[str]:
    if not project.held_out:
        raise SettingsError("no log is held out; set one aside in Data")
    held_out = map(hyphenless, project.held_out)
    page = f"{RESULTS}/held-out.html"
    return ["validate", _chosen(given, results), *held_out, *_horizon(given), "--report", page]


def _predict(project: Project, given: Mapping[str, Any], results: Sequence[str]) -> list[str]:
    log = _log(project, given)
    return ["predict", _chosen(given, results), log, *_horizon(given), "-o", f"{RESULTS}/predicted.csv"]


def _chosen(given: Mapping[str, Any], results: Sequence[str]) -> str:
    """The result of one limb; the first where none is named."""
    found = _solved(results)
    return str(given["result"]) if given.get("result") in found else found[0]


def _export(project: Project, given: Mapping[str, Any], results: Sequence[str]) -> list[str]:
    name, found = given.get("name"), _solved(results)
    if not isinstance(name, str) or not re.fullmatch(r"[\w][\w .-]{0,99}", name):
        raise SettingsError("the name of the file has letters, digits, spaces, dots and hyphens")
    into = given.get("into")
    if Path(name).suffix in (".xml", ".urdf") and project.names_robot:
        return ["export", *found, "-o", f"{RESULTS}/{name}", "--into", str(project.model)]
    if into or Path(name).suffix in (".xml", ".urdf"):
        raise SettingsError("a description is calibrated where the model is that of a description")
    return ["export", _chosen(given, results), "-o", f"{RESULTS}/{name}"]


def _show_model(project: Project, _given: Mapping[str, Any], _results: Sequence[str]) -> list[str]:
    return ["models", *_model(project)]


def _map(project: Project, given: Mapping[str, Any], _results: Sequence[str]) -> list[str]:
    return ["map", _log(project, given), "--model", *_model(project)]


def _check(project: Project, _given: Mapping[str, Any], _results: Sequence[str]) -> list[str]:
    reading, known = project.words_of_reading(), project.words_of_fixing()
    return ["inspect", *_logs(project), *reading, "--model", *_model(project), *known]


_COMMANDS: dict[str, Callable[[Project, Mapping[str, Any], Sequence[str]], list[str]]] = {
    "model": _show_model,
    "map": _map,
    "check": _check,
    "design": _design,
    "solve": _solve,
    "validate": _validate,
    "predict": _predict,
    "export": _export,
}


# ---------------------------------------------------------------------- what the page shows beside a stage


def lines(project: Project, results: Sequence[str]) -> dict[str, dict[str, str]]:
    """Command and Python lines by stage; a stage that lacks something has the reason in place of the command.

    Parameters
    ----------
    project : Project
    results : sequence of str
        As for `command`.
    """
    found = results or [_MODEL]
    shell: dict[str, Callable[[], list[str]]] = {
        "data": lambda: ["inspect", *_logs(project), *project.words_of_reading()],
        "model": lambda: command("model", project, {}, found),
        "check": lambda: command("check", project, {}, found),
        "solve": lambda: ["identify", *project.words()],
        "results": lambda: command("validate", project, {}, found),
        "use": lambda: ["export", *found[:1], "-o", "dynamics.c"],
    }
    python = _python(project, found[0])
    return {stage: {"shell": _shell(words), "python": python[stage]} for stage, words in shell.items()}


def _python(project: Project, result: str) -> dict[str, str]:
    """Python lines by stage."""
    whole = project.python().split("\n")
    first = [x for x in whole if x.startswith(("import", "from"))]
    model, logs = ([x for x in whole if x.startswith(f"{name} =")] for name in ("model", "logs"))
    load = ["import diransac as dr", f"result = dr.Result.load({result!r})"]
    held_out = f"held_out = [dr.read_log(file, like=result.logs[0].preparation) for file in {project.held_out!r}]"
    known = {name: None if value == "nominal" else float(value) for name, value in project.fix.items()}
    fixed = f", fixed={known!r}" if known else ""
    parts = {
        "data": [*first, _INSPECT, *logs, printed("inspect(logs)")],
        "model": [*first, *model, printed("model")],
        "check": [*first, _INSPECT, *model, *logs, printed(f"inspect(logs, model{fixed})")],
        "solve": whole,
        "results": [*load, held_out, printed("dr.validate(result, held_out)")],
        "use": [*load, "result.export('dynamics.c')", "draws = result.sample(1000)"],
    }
    return {stage: printable("\n".join(texts)) for stage, texts in parts.items()}


def _shell(words: Callable[[], list[str]]) -> str:
    try:
        return quoted(words())
    except SettingsError as error:
        return f"# {error}"
