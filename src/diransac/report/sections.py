"""The page's sections that are read: what was found, how sure it is, and how it was made."""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diransac.data.log import Log
from diransac.identification.settings import Settings
from diransac.identification.validation import Scores, Validation
from diransac.model import Model
from diransac.report.judgement import findings, verdict, worst
from diransac.report.markup import Html, join, number, percent, plural, table, tag
from diransac.report.runs import Run

__all__ = ["equations", "heading", "making", "scores", "short"]

_PACKAGES = ("diransac", "numpy", "scipy", "casadi", "llvmlite")
_DEFAULT_ESTIMATORS = ("OrdinaryLeastSquares", "NonlinearLeastSquares")
_SYMBOLS = {"good": "✓", "care": "!", "bad": "✗", "note": "i"}


# ---------------------------------------------------------------------- what was found


def heading(runs: Sequence[Run], log: Log) -> Html:
    """Which model, from which log."""
    models = " and ".join(dict.fromkeys(run.result.model.name for run in runs))
    sources = dict.fromkeys(run.result.log.source for run in runs)
    methods = f"by {runs[0].label}" if len(runs) == 1 else f"in {len(runs)} ways ({', '.join(r.label for r in runs)})"
    seconds, rate = number(log.dt * (len(log) - 1)), number(1.0 / log.dt)
    size = f"{seconds} s at {rate} Hz, {plural(len(log), 'row')}"
    lead = f"Identified {methods} from {' and '.join(sources)}"
    if any(run.held_out for run in runs):
        lead = f"Held-out validation. {lead}; shown here on a log that it was not made from, {log.source}"
    descriptions = dict.fromkeys(run.result.model.description for run in runs if run.result.model.description)
    about = [tag("p", text, class_="about") for text in descriptions]
    diagnosed = any(run.result.diagnosis is not None for run in runs)
    found = (("short", "In short"), ("parameters", "Parameters"), *((("diagnosis", "Diagnosis"),) if diagnosed else ()))
    links = (*found, ("signals", "Simulation"), ("inliers", "Inliers"))
    more = (("scores", "Scores"), ("equations", "Equations"), ("making", "How it was made"))
    menu = tag("nav", *(tag("a", text, href=f"#{key}") for key, text in links + more), aria_label="Sections")
    return tag("header", tag("h1", models), *about, tag("p", f"{lead} ({size})."), menu)


def short(runs: Sequence[Run]) -> Html:
    """The verdict on every result, and what it rests on."""
    cards = [_card(run) for run in runs]
    comparison = [_differences(runs)] if len(runs) > 1 else []
    return tag(
        "section", tag("h2", "In short"), *comparison, tag("div", *cards, class_="cards"), id="short", class_="short"
    )


def _card(run: Run) -> Html:
    found = findings(run)
    level = worst(found)
    items = [
        tag("li", tag("span", _SYMBOLS[f.level], class_="sign", title=f.level), " ", f.text, class_=f.level)
        for f in found
    ]
    title = tag("h3", tag("span", run.label, class_="method"), " ", verdict(level))
    return tag("article", title, tag("ul", *items), class_=f"card {level}")


def _differences(runs: Sequence[Run]) -> Html:
    """In which parameter the results differ most."""
    spread = {}
    for name in runs[0].result.parameters:
        values = {run.label: run.result.parameters[name] for run in runs if run.tells(name)}
        if not values:
            continue
        low, high = min(values, key=lambda k: values[k]), max(values, key=lambda k: values[k])
        middle = abs(float(np.median(list(values.values()))))
        if middle > 0.0:
            spread[name] = ((values[high] - values[low]) / middle, low, high)
    if not spread:
        return join([])
    name = max(spread, key=lambda n: spread[n][0])
    difference, low, high = spread[name]
    if difference < 1e-3:
        return tag("p", "The results agree to 0.1 % in every parameter.")
    by_label = {run.label: number(run.result.parameters[name]) for run in runs if run.tells(name)}
    unit = runs[0].result.units[name]
    return tag("p", f"They differ most in {name}: {by_label[low]} {unit} ({low}) to {by_label[high]} {unit} ({high}).")


# ---------------------------------------------------------------------- scores


def scores(runs: Sequence[Run]) -> Html:
    """Open-loop scores at several horizons."""
    about = (
        "The simulation restarts from the measured state after each horizon. Outliers count in full here, as samples "
        "and as states to start from: on a log that has them, these scores judge the log as much as the model."
    )
    return tag(
        "section",
        tag("h2", "Open-loop scores"),
        *_short_term(runs),
        tag("p", about, class_="how"),
        *(_scores(run) for run in runs),
        id="scores",
    )


def _short_term(runs: Sequence[Run]) -> list[Html]:
    """How well each predicts from where the machine was, where that is known."""
    having = [run for run in runs if np.isfinite(run.period)]
    if not having:
        return []
    names = dict.fromkeys(name for run in having for name in run.observations.signals)
    noise = having[0].diagnosis.noise_std if having[0].diagnosis is not None else {}
    units = having[0].result.model.units
    rows = [
        (name, units[name], number(noise.get(name, np.nan), 3), *(_sound_rms(run, name) for run in having))
        for name in names
    ]
    period = number(having[0].period)
    caption = (
        f"RMS error but for outliers, simulated for {period} s at a time from where the machine most probably was."
    )
    return [table(("Signal", "Unit", "Noise", *(run.label for run in having)), rows, caption)]


def _sound_rms(run: Run, name: str) -> str:
    errors = run.sound_errors.get(name, np.empty(0))
    with np.errstate(over="ignore"):
        return number(float(np.sqrt(np.mean(np.square(errors)))) if len(errors) else np.nan, 3)


def _scores(run: Run) -> Html:
    validation = run.validation
    if isinstance(validation, str):
        return tag("p", f"{run.label}: no scores: {validation}")
    figures = ("RMSE", "fit %", "R²")
    top = [tag("th", _horizon(s), scope="colgroup", colspan=len(figures)) for s in validation.horizons]
    second = [tag("th", text, scope="col") for _ in validation.horizons for text in figures]
    names = [tag("th", text, scope="col", rowspan=2) for text in ("Signal", "Unit")]
    body = [_score_row(name, validation) for name in validation.rmse]
    head = tag("thead", tag("tr", *names, *top), tag("tr", *second))
    inner = tag("table", tag("caption", run.label), head, tag("tbody", *body), class_="scores")
    return tag("div", inner, class_="scroll")


def _horizon(at: Scores) -> str:
    name = "whole log" if np.isinf(at.horizon) else f"{number(at.horizon)} s ({plural(at.windows, 'window')})"
    return f"{name}, {at.diverged} diverged" if at.diverged else name


def _score_row(name: str, validation: Validation) -> Html:
    cells = [
        text
        for at in validation.horizons
        for text in (number(at.rmse[name]), number(at.fit_percent[name], 3), _r_squared(at.r_squared[name]))
    ]
    numbers = [tag("td", text, class_="number") for text in cells]
    return tag("tr", tag("th", name, scope="row"), tag("td", validation.units[name]), *numbers)


def _r_squared(x: float) -> str:
    return f"{x:.4f}".replace("-", "−") if abs(x) < 10.0 else number(x, 3)


# ---------------------------------------------------------------------- equations


def equations(runs: Sequence[Run]) -> Html:
    """The residuals of every model."""
    models = {run.result.model.fingerprint: run.result.model for run in runs}
    return tag("section", tag("h2", "Equations"), *(_model(model) for model in models.values()), id="equations")


def _model(model: Model) -> Html:
    text = "\n".join(model.equations_text())
    groups = (("coordinates", model.coordinates), ("velocities", model.velocities), ("inputs", model.inputs))
    named = "; ".join(f"{kind} " + ", ".join(f"{n} ({u})" for n, u in units.items()) for kind, units in groups if units)
    return join([tag("h3", model.name), tag("p", f"With {named}."), tag("pre", tag("code", text))])


# ---------------------------------------------------------------------- how it was made


def making(runs: Sequence[Run], log: Log) -> Html:
    """Everything that is needed to repeat it."""
    return tag(
        "section",
        tag("h2", "How it was made"),
        _provenance(runs),
        tag("h3", "The log"),
        _log(runs, log),
        tag("h3", "To repeat it"),
        tag("pre", tag("code", _snippet(runs))),
        tag("p", "Page written with ", _versions(), "."),
        id="making",
    )


def _provenance(runs: Sequence[Run]) -> Html:
    """Each result's search and settings, a column a result."""
    columns = [_facts(run) for run in runs]
    rows = [(key, *(column[key] for column in columns)) for key in columns[0]]
    return table(
        ("", *(run.label for run in runs)), rows, "Search and settings; what differs from the default is bold."
    )


def _facts(run: Run) -> dict[str, str]:
    result, default = run.result, Settings().to_dict()
    skipped = ", ".join(f"{n:,} {reason}" for reason, n in result.rejected.items()) or "none"
    squares = " (sum of squares)" if result.method == "diransac" else ""
    facts = {
        "method": result.method,
        "estimator": result.estimator,
        "seed": str(result.seed),
        "fit error": number(result.fit_error, 6) + squares,
        "inliers": f"{percent(result.inlier_fraction)} of the rows that count",
        "samples drawn": f"{result.iterations:,}",
        "hypotheses evaluated": f"{result.n_hypotheses:,}",
        "went no further": skipped,
        "ended because": result.stop_reason,
    }
    chosen = result.settings.to_dict()
    return facts | {k: _value(x) if x == default[k] else tag("strong", _value(x)) for k, x in chosen.items()}


def _value(x: Any) -> str:
    """A setting or a step's detail as text."""
    if isinstance(x, Mapping):
        return ", ".join(f"{key}: {_value(value)}" for key, value in x.items()) or "none"
    if isinstance(x, list | tuple):
        return ", ".join(_value(value) for value in x) or "none"
    if x is None:
        return "automatic"
    return number(x, 6) if isinstance(x, float) else str(x)


def _log(runs: Sequence[Run], log: Log) -> Html:
    """Where the samples came from, and what was done to them."""
    summaries = dict.fromkeys(run.result.log for run in runs)
    items = [tag("li", f"{s.source}: {_rows(s.n_rows, s.start, s.dt)}", tag("code", s.fingerprint)) for s in summaries]
    if any(run.held_out for run in runs):
        shown = f"Shown here: {log.source}: {_rows(len(log), float(log.time[0]), log.dt)}"
        items.append(tag("li", shown, tag("code", log.fingerprint)))
    steps = dict.fromkeys(_step(step) for run in runs for step in run.result.preparation)
    notes = dict.fromkeys(note for run in runs for note in (*run.result.notes, *run.observations.notes))
    parts = [tag("ul", *items)]
    if steps:
        parts += [tag("p", "Prepared in this order:"), tag("ol", *(tag("li", text) for text in steps))]
    if notes:
        parts += [tag("p", "Found on the way:"), tag("ul", *(tag("li", text) for text in notes))]
    return join(parts)


def _rows(n_rows: int, start: float, dt: float) -> str:
    return f"{plural(n_rows, 'row')} from t = {number(start, 6)} s, {number(dt, 6)} s apart; SHA-256 "


def _step(step: Mapping[str, Any]) -> str:
    details = ", ".join(f"{key} {_value(value)}" for key, value in step.items() if key != "step")
    return f"{step.get('step', 'step')}: {details}" if details else str(step.get("step"))


def _snippet(runs: Sequence[Run]) -> str:
    """Python that asks the same questions again."""
    lines = ["import diransac as dr", ""]
    for source in dict.fromkeys(run.result.log.source for run in runs):
        lines.append(f"log = dr.read_log(...)  # {' '.join(source.split())}, prepared as above")
    for model in {run.result.model.fingerprint: run.result.model for run in runs}.values():
        lines.append(f"model = ...  # {' '.join(model.name.split())}")
    return "\n".join([*lines, *(_call(run) for run in runs)])


def _call(run: Run) -> str:
    result = run.result
    arguments = [f"method={result.method!r}", f"seed={result.seed}"]
    default = Settings()
    names = [field.name for field in dataclasses.fields(Settings)]
    chosen = [(n, getattr(result.settings, n)) for n in names if getattr(result.settings, n) != getattr(default, n)]
    if chosen:
        arguments.append(f"settings=dr.Settings({', '.join(f'{name}={value!r}' for name, value in chosen)})")
    if result.iterations and result.diagnosis is None and result.estimator not in _DEFAULT_ESTIMATORS:
        arguments.append(f"estimator={result.estimator}(...)")
    if result.diagnosis is not None and not set(result.model.required_signals) <= set(result.diagnosis.noise_std):
        arguments.append("differentiate=True")
    elif result.preparation and result.preparation[-1].get("step") == "differentiate":
        arguments.append(f"differentiate=True, bandwidth={result.preparation[-1]['bandwidth']!r}")
    return f"result = dr.identify(model, log, {', '.join(arguments)})"


def _versions() -> str:
    from importlib.metadata import version

    packages = ", ".join(f"{name} {version(name)}" for name in _PACKAGES)
    return f"{packages}, Python {platform.python_version()} on {platform.system()} {platform.machine()}"
