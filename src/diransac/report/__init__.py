"""Self-contained HTML page of identification results: parameters, verdict, figures, provenance.

In come results with their logs, a history of a tracker, or a store; out comes one file without references to others.
Begin with `write_report`.

| file | contents |
|---|---|
| `runs.py` | results simulated over the logs: the numbers behind every section |
| `sections.py`, `provenance.py` | tables and texts; equations, settings and versions |
| `figures.py` | geometry of SVG figures |
| `over_time.py` | signals, residuals and forces over time |
| `tracking.py`, `stores.py` | pages of tracked runs, and of studies and fleets |
| `rendering.py`, `templates/` | Jinja templates |
| `viewer.py` | recordings for the Rerun viewer |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from diransac.data.log import Log
from diransac.errors import ResultError
from diransac.identification.result import Result
from diransac.report import provenance, sections
from diransac.report.over_time import figures_of
from diransac.report.rendering import numbered, write_page
from diransac.report.runs import Entry, simulate_all

__all__ = ["write_report"]


def write_report(
    results: Result | Sequence[Result] | Mapping[str, Result],
    logs: Log | Sequence[Log],
    path: str | Path,
    *,
    horizon: float | None = None,
    command: str = "",
) -> None:
    """Write one HTML page about one or several results, evaluated on one or several logs.

    Parameters
    ----------
    results : one result, several, or several by label
    logs : the logs that were given to `identify`, or others: the page is then a held-out validation
    path : file of the page, written whole or not at all
    horizon : of the open-loop scores and of the verdict on held-out logs, s, as in `validate`
    command : shell command that writes the page, to be shown on it

    Raises
    ------
    ResultError
        There is no result or no log, a log cannot be simulated by a model, or the page cannot be written.

    Notes
    -----
    The page loads nothing: figures are SVG, and its content security policy admits its own script only.  The same
    results and logs give the same page.
    """
    named, several = labelled(results), _as_list(logs)
    entries = simulate_all(named, several, horizon)
    write_page(path, "report.html", script="page.js", command=command, **_content(entries, several))


def labelled(results: Result | Sequence[Result] | Mapping[str, Result]) -> dict[str, Result]:
    """Results by unique label: the mapping's keys, or the methods, numbered where they repeat.

    Raises ResultError: there is no result, or an object of another type.
    """
    if isinstance(results, Mapping):
        pairs: list[tuple[str, object]] = [(str(label), result) for label, result in results.items()]
    else:
        several = results if isinstance(results, list | tuple) else [results]
        pairs = [(getattr(result, "method", ""), result) for result in several]
    named: dict[str, Result] = {}
    for label, (_, result) in zip(numbered(label for label, _ in pairs), pairs, strict=True):
        if not isinstance(result, Result):
            raise ResultError(f"a report shows results of diransac.identify; found a {type(result).__name__}")
        named[label] = result
    if not named:
        raise ResultError("a report shows results of diransac.identify; found none")
    return named


def _as_list(logs: object) -> list[Log]:
    """The logs as a list.  Raises ResultError: there is none, or an object of another type."""
    several: list[Log] = []
    for log in logs if isinstance(logs, list | tuple) else [logs]:
        if not isinstance(log, Log):
            raise ResultError(f"a report shows logs; found a {type(log).__name__}; give a diransac.Log or several")
        several.append(log)
    if not several:
        raise ResultError("a report shows logs; found none; give the log that was given to identify")
    return several


def _content(entries: Sequence[Entry], logs: Sequence[Log]) -> dict[str, Any]:
    """Values of the template."""
    models = provenance.unique_models(entries)
    by_log = list(zip(*(entry.runs for entry in entries), strict=True))
    return {
        "title": f"{models[0].name}: {', '.join(entry.label for entry in entries)}",
        "models": models,
        "lead": sections.lead(entries, logs),
        "differences": sections.differences(entries),
        "cards": [sections.card(entry) for entry in entries],
        "log_tables": sections.log_tables(entries, logs),
        "parameters": sections.parameters(entries),
        "diagnosis": sections.diagnosis(entries),
        "suggestions": sections.suggestions(entries),
        "competitions": sections.competitions(entries),
        "logs": [figures_of(log, runs, len(logs)) for log, runs in zip(logs, by_log, strict=True)],
        "scores": [(runs[0].log_name, [sections.scores(run) for run in runs]) for runs in by_log],
        "equations": [provenance.model_text(model) for model in models],
        "settings": provenance.settings(entries),
        "log_facts": provenance.log_facts(entries, logs),
        "preparation": provenance.preparation(entries),
        "notes": provenance.notes(entries),
        "versions": provenance.versions(),
    }
