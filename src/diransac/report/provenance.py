"""Equations and provenance: settings, data and versions."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from typing import Any

from diransac.data.log import Log
from diransac.identification.diagnosis import Resolution
from diransac.identification.methods import default_options
from diransac.identification.settings import Settings
from diransac.model import Model
from diransac.report.rendering import numbered
from diransac.report.runs import Entry
from diransac.text_table import number, percent, plural


def unique_models(entries: Sequence[Entry]) -> list[Model]:
    """The models of the page."""
    return list({entry.result.model.fingerprint: entry.result.model for entry in entries}.values())


def model_text(model: Model) -> tuple[str, str, str]:
    """Name, variables and equations of a model."""
    groups = (
        ("coordinates", model.coordinates),
        ("velocities", model.velocities_of_motion),
        ("states of first order", model.first_order),
        ("inputs", model.inputs),
    )
    named = (f"{kind} " + ", ".join(f"{n} ({u})" for n, u in units.items()) for kind, units in groups if units)
    return model.name, "; ".join(named), "\n".join(model.equations_text())


def settings(entries: Sequence[Entry]) -> list[tuple[str, list[tuple[str, bool]]]]:
    """Facts and settings, each with its text by every result and whether that differs from the default."""
    columns = [_facts(entry) for entry in entries]
    keys = dict.fromkeys(key for column in columns for key in column)
    return [(key, [column.get(key, ("", False)) for column in columns]) for key in keys]


def _facts(entry: Entry) -> dict[str, tuple[str, bool]]:
    result, default, defaults = entry.result, Settings().to_dict(), default_options(entry.result.method)
    hold = result.estimate.resolution.hold
    squares = " (sum of squares)" if result.method == "diransac" else ""
    facts = {
        "method": result.method,
        "estimator": result.estimator,
        "seed": str(result.seed),
        "fit error": number(result.fit_error, 6) + squares,
        "inliers": f"{percent(result.inlier_fraction)} of the valid rows",
        "samples": f"{result.iterations:,}",
        "hypotheses": f"{result.n_hypotheses:,}",
        "rejected hypotheses": ", ".join(f"{n:,} {reason}" for reason, n in result.rejected.items()) or "none",
        "stop reason": result.stop_reason,
    }
    if result.fixed:
        facts["fixed"] = ", ".join(f"{n} = {number(result.parameters[n], 6)}" for n in result.fixed)
    if result.priors:
        facts["priors"] = ", ".join(f"{n} = {number(m, 6)} ± {number(s, 2)}" for n, (m, s) in result.priors.items())
    chosen = {key: (_value(x), x != default[key]) for key, x in result.settings.to_dict().items()}
    own = {key: (_value(x), x != defaults.get(key)) for key, x in result.options.items()}
    return (
        {key: (text, False) for key, text in facts.items()}
        | chosen
        | {"input hold": (hold, hold != Resolution().hold)}
        | own
    )


def _value(x: Any) -> str:
    """Text of a setting or of a preprocessing step's detail."""
    if isinstance(x, Mapping):
        return ", ".join(f"{key}: {_value(value)}" for key, value in x.items()) or "none"
    if isinstance(x, list | tuple):
        return ", ".join(_value(value) for value in x) or "none"
    if x is None:
        return "automatic"
    return number(x, 6) if isinstance(x, float) else str(x)


def log_facts(entries: Sequence[Entry], logs: Sequence[Log]) -> list[tuple[str, str]]:
    """Description and fingerprint of every log that was used for identification, or is shown."""
    used = {s.fingerprint: s for entry in entries for s in entry.result.logs}
    facts = [(f"{s.source}: {_rows(s.n_rows, s.start, s.dt)}", s.fingerprint) for s in used.values()]
    names = numbered(log.source for log in logs)
    return facts + [
        (f"Held out: {name}: {_rows(len(log), float(log.time[0]), log.dt)}", log.fingerprint)
        for i, (name, log) in enumerate(zip(names, logs, strict=True))
        if any(entry.runs[i].held_out for entry in entries)
    ]


def _rows(n_rows: int, start: float, dt: float) -> str:
    return f"{plural(n_rows, 'row')} from t = {number(start, 6)} s, sampling time {number(dt, 6)} s; SHA-256 "


def preparation(entries: Sequence[Entry]) -> list[str]:
    """Preprocessing steps, in order."""
    steps = (step for entry in entries for run in entry.runs for step in run.view.preparation)
    return list(dict.fromkeys(_step(step) for step in steps))


def _step(step: Mapping[str, Any]) -> str:
    details = ", ".join(f"{key} {_value(value)}" for key, value in step.items() if key not in ("step", "text"))
    return f"{step.get('step', 'step')}: {details}" if details else str(step.get("step"))


def notes(entries: Sequence[Entry]) -> list[str]:
    """Notes on the identification and on the logs."""
    found = (note for e in entries for run in e.runs for note in (*e.result.notes, *run.observations.notes))
    return list(dict.fromkeys(found))


def versions() -> str:
    """Versions of the packages and the platform."""
    from importlib.metadata import version

    packages = ", ".join(f"{name} {version(name)}" for name in ("diransac", "numpy", "scipy", "casadi", "llvmlite"))
    return f"{packages}, Python {platform.python_version()} on {platform.system()} {platform.machine()}"
