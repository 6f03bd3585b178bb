"""Every parameter by result: its estimate, its interval as numbers and as a picture, and what it depends on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diransac.report.figures import Scale, padded, ticks
from diransac.report.judgement import bounds_text
from diransac.report.markup import Html, join, number, percent, table, tag
from diransac.report.runs import Run
from diransac.text_table import telling_digits

__all__ = ["parameters"]

_WIDEST = 2.0
_LONG = 6


def parameters(runs: Sequence[Run]) -> Html:
    """Every parameter by result, with its interval as numbers and as a picture."""
    header = ("Parameter", "By", "Estimate", "95 % interval", "±", "")
    names = dict.fromkeys(name for run in runs for name in run.result.parameters)
    head = tag("tr", *(tag("th", cell, scope="col") for cell in header))
    caption = tag("caption", "A dot is an estimate, its line the 95 % interval, what is hatched outside the bounds.")
    groups = [_parameter(name, [r for r in enumerate(runs) if name in r[1].result.parameters]) for name in names]
    inner = tag("table", caption, tag("thead", head), *groups, class_="parameters")
    return tag(
        "section", tag("h2", "Parameters"), tag("div", inner, class_="scroll"), _sensitivity(runs), id="parameters"
    )


def _parameter(name: str, having: Sequence[tuple[int, Run]]) -> Html:
    model = having[0][1].result.model
    bounds = bounds_text(model.parameters[name])
    about = ", ".join(text for text in (model.parameters[name].unit, bounds) if text)
    first = tag("th", name, " ", tag("span", about, class_="unit"), scope="rowgroup", rowspan=len(having) + 1)
    scale = _parameter_scale(name, [run for _, run in having])
    rows = [_estimate(name, run, i, scale) for i, run in having]
    shown = _parameter_ticks(scale) if any(run.tells(name) for _, run in having) else []
    marks = [tag("span", text, class_="tick x", style=f"left:{_at(x, scale)}") for x, text in shown]
    axis = tag(
        "tr", tag("td", colspan=4), tag("td", tag("div", *marks, class_="times"), aria_hidden="true"), class_="scale"
    )
    return tag("tbody", tag("tr", first, *rows[0]), *(tag("tr", *row) for row in rows[1:]), axis)


def _parameter_ticks(scale: Scale) -> list[tuple[float, str]]:
    """Fewer where they are long, and none at the edges then."""
    found = ticks(scale.low, scale.high, 4)
    if max(len(text) for _, text in found) <= _LONG:
        return found
    margin = 0.15 * (scale.high - scale.low)
    return [(x, text) for x, text in found[1::2] if scale.low + margin < x < scale.high - margin]


def _parameter_scale(name: str, runs: Sequence[Run]) -> Scale:
    """All estimates, and the intervals as far as they do not dwarf the narrowest."""
    runs = [run for run in runs if run.tells(name)]
    if not runs:
        return Scale(-1.0, 1.0)
    intervals = np.array([run.result.intervals()[name] for run in runs])
    estimates = np.array([run.result.parameters[name] for run in runs])
    widths = intervals[:, 1] - intervals[:, 0]
    sharpest = int(np.argmin(np.where(np.isfinite(widths), widths, np.inf)))
    core = np.append(estimates, intervals[sharpest][np.isfinite(intervals[sharpest])])
    low, high = float(core.min()), float(core.max())
    reach = _WIDEST * (high - low)
    edges = np.clip(intervals[np.isfinite(intervals)], low - reach, high + reach)
    if high - low <= 1e-9 * abs(high):
        low, high = low - 1e-3 * abs(low), high + 1e-3 * abs(high)
    return padded(float(edges.min(initial=low)), float(edges.max(initial=high)))


def _estimate(name: str, run: Run, i: int, scale: Scale) -> list[Html]:
    result = run.result
    if not run.tells(name):
        told = tag("td", "the log cannot tell", colspan=4)
        return [tag("td", tag("span", class_=f"swatch m{i}"), run.label), told]
    value, (low, high) = result.parameters[name], result.intervals()[name]
    known = np.isfinite(high - low)
    digits = telling_digits(low, high)
    interval = f"{number(low, digits)} … {number(high, digits)}" if known else "unknown"
    width = "includes 0" if low <= 0.0 <= high else percent(0.5 * (high - low) / abs(value))
    outside = tag("strong", " outside its bounds") if name in result.violations else ""
    return [
        tag("td", tag("span", class_=f"swatch m{i}"), run.label),
        tag("td", number(value, 6), outside, class_="number"),
        tag("td", interval, class_="number"),
        tag("td", width if known else "–", class_="number"),
        tag("td", _whisker(name, run, i, scale), class_="picture", aria_hidden="true"),
    ]


def _whisker(name: str, run: Run, i: int, scale: Scale) -> Html:
    result = run.result
    bounds, (low, high) = result.model.parameters[name], result.intervals()[name]
    low, high = (low, high) if np.isfinite(high - low) else (-np.inf, np.inf)
    lower = max(bounds.lower, 0.0) if bounds.positive else bounds.lower
    parts = []
    if lower > scale.low:
        parts.append(tag("span", class_="forbidden", style=f"left:0;right:calc(100% - {_at(lower, scale)})"))
    if bounds.upper < scale.high:
        parts.append(tag("span", class_="forbidden", style=f"left:{_at(bounds.upper, scale)};right:0"))
    cut = " cut-low" * bool(low < scale.low) + " cut-high" * bool(high > scale.high)
    left, right = _at(low, scale), _at(high, scale)
    parts.append(tag("span", class_=f"interval m{i}{cut}", style=f"left:{left};right:calc(100% - {right})"))
    parts.append(tag("span", class_=f"estimate m{i}", style=f"left:{_at(result.parameters[name], scale)}"))
    return tag("div", *parts, class_="whisker")


def _at(value: float, scale: Scale) -> str:
    """Where a value lies on a scale, at its nearer end if outside, for CSS."""
    return f"{np.clip(100.0 * (value - scale.low) / (scale.high - scale.low), 0.0, 100.0):.2f}%"


def _sensitivity(runs: Sequence[Run]) -> Html:
    rows = [
        (name, run.label, percent(half), percent(twice))
        for run in runs
        for name, (half, twice) in (run.result.bandwidth_sensitivity or {}).items()
    ]
    if not rows:
        return join([])
    caption = "Change of each parameter when the bandwidth of the filter that derived the rates is another."
    return table(("Parameter", "By", "at half", "at twice"), rows, caption)
