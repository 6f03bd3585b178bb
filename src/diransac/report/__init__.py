"""One HTML page that shows what was identified and how far it can be trusted: self-contained, without any network."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path

from diransac.atomic import write_text
from diransac.data.log import Log
from diransac.errors import ResultError
from diransac.identification.result import Result
from diransac.report import sections
from diransac.report.diagnosed import diagnoses
from diransac.report.figures import Timeline
from diransac.report.markup import Html, tag
from diransac.report.over_time import inliers_over_time, signals_over_time
from diransac.report.parameters import parameters
from diransac.report.runs import Run, diagnosis_of, labelled, simulate_on

__all__ = ["write_report"]

# Detail of the figures: a page of many results has less of each, so that it stays light.
_CELLS, _FEWEST_CELLS = 500, 110


def write_report(results: Result | Sequence[Result] | Mapping[str, Result], log: Log, path: str | Path) -> None:
    """Write a page about one result, or several side by side, and the log that they are looked at with.

    Parameters
    ----------
    results : a result, several, or several by the names that the page shall call them
    log : the log that was given to `identify`; with another one the page is a held-out validation, and says so
    path : of the page; it appears whole or not at all

    The page needs nothing else and loads nothing: figures are SVG, its script is its own and the only one that a
    browser will run.  The same results and log give the same page.
    Raises ResultError: there is no result, the log cannot be simulated by its model, or the page cannot be written.
    """
    named = labelled(results)
    diagnosis = diagnosis_of(named, log)
    runs = [simulate_on(label, result, log, diagnosis) for label, result in named.items()]
    try:
        write_text(path, _page(runs, log))
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror}") from error


def _page(runs: Sequence[Run], log: Log) -> str:
    timeline = Timeline(len(log), float(log.time[0]), log.dt, max(_FEWEST_CELLS, _CELLS // len(runs)))
    title = f"{runs[0].result.model.name}: {', '.join(run.label for run in runs)}"
    body = [
        sections.heading(runs, log),
        tag(
            "main",
            sections.short(runs),
            parameters(runs),
            *diagnoses(runs, timeline),
            signals_over_time(runs, timeline),
            inliers_over_time(runs, timeline),
            sections.scores(runs),
            sections.equations(runs),
            sections.making(runs, log),
        ),
    ]
    script = _asset("page.js")
    head = [
        tag("meta", charset="utf-8"),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=_policy(script)),
        tag("title", title),
        tag("style", Html(_asset("page.css"))),
    ]
    page = tag("html", tag("head", *head), tag("body", *body, tag("script", Html(script))), lang="en")
    return f"<!DOCTYPE html>\n{page}\n"


def _policy(script: str) -> str:
    """What a browser may do with the page: apply its styles, run its one script, load nothing."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"


def _asset(name: str) -> str:
    return (files("diransac.report") / name).read_text(encoding="utf-8")
