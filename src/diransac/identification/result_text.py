"""A result as text: on a terminal, and in a notebook."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

import numpy as np

from diransac.identification.finding import next_line, shown_lines
from diransac.text_table import aligned, telling_digits

if TYPE_CHECKING:
    from diransac.identification.result import Result


def text_of(result: Result) -> str:
    """Tables, verdict, findings and notes."""
    parts = (_headline(result), *aligned(_cells(result)), *_prior_lines(result), _summary(result))
    return "\n".join([*parts, *_diagnosed(result), *_assessed(result)])


def html_of(result: Result) -> str:
    """Parameters, verdict and the findings against the result, as a notebook shows them."""
    header, *rows = ([escape(cell) for cell in row] for row in _cells(result))
    table = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
    findings = "".join(f"<li>{escape(x)}</li>" for x in shown_lines(result.findings))
    return (
        f"<p>{escape(_headline(result))}: <strong>{result.verdict}</strong></p>"
        f"<table><tr>{''.join(f'<th>{cell}</th>' for cell in header)}</tr>{table}</table>"
        + (f"<ul>{findings}</ul>" if findings else "")
        + f"<p>{escape(next_line(result.findings))}</p>"
    )


def _headline(result: Result) -> str:
    many = len(result.logs) > 1
    seconds = sum(log.dt * (log.n_rows - 1) for log in result.logs)
    source = f"{len(result.logs)} logs" if many else result.logs[0].source
    rates = sorted({f"{1.0 / log.dt:.4g}" for log in result.logs}, key=float)
    rate = rates[0] if len(rates) == 1 else f"{rates[0]} to {rates[-1]}"
    return f"{result.model.name} by {result.method} from {source} ({seconds:.4g} s at {rate} Hz)"


def _cells(result: Result) -> list[tuple[str, ...]]:
    """Header and rows of the table of parameters."""
    columns = {"95 % interval": result.intervals()}
    if result.has_structure:
        columns = {
            "95 % interval if the model is complete": result.intervals(),
            "if it may lack a term": result.structural_intervals(),
        }
    rows = [("parameter", "estimate", *columns, "unit")]
    for name in result.parameters:
        intervals = [_interval(result, name, *x[name]) for x in columns.values()]
        estimate = "?" if name in result.unidentifiable else f"{result.parameters[name]:.6g}"
        varies = not result.layout.is_shared and result.model.parameters[name].per_log
        averaged = varies and name not in result.fixed
        rows.append((f"{name} (mean of logs)" if averaged else name, estimate, *intervals, result.units[name]))
    return rows


def _interval(result: Result, name: str, low: float, high: float) -> str:
    """An interval of a parameter as text."""
    digits = telling_digits(low, high)
    interval = f"{low:.{digits}g} .. {high:.{digits}g}" if np.isfinite(high - low) else "unknown"
    return "fixed" if name in result.fixed else interval


def _prior_lines(result: Result) -> list[str]:
    """The priors, in a line; none without them."""
    texts = [f"{n} = {mean:.6g} ± {std:.2g} {result.units[n]}" for n, (mean, std) in result.priors.items()]
    return [f"prior of {'; '.join(texts)}"] if texts else []


def _summary(result: Result) -> str:
    whole = "in one simulation of the whole log: " if result.separates_forces else ""
    parts = [f"{whole}fit error {result.fit_error:.4g}", f"inliers {100.0 * result.inlier_fraction:.1f} %"]
    if result.estimate.resolution.interpolation:
        parts.append(result.estimate.resolution.interpolation)
    parts.append(f"fitted to {result.n_fitted} rows")
    if result.iterations:
        rejected = ", ".join(f"{n} {reason}" for reason, n in result.rejected.items())
        parts.append(f"{result.iterations} sample{'s' if result.iterations > 1 else ''}, {result.stop_reason}")
        parts.append(f"{result.n_hypotheses} hypotheses" + (f" ({rejected})" if rejected else ""))
    return "; ".join(parts)


def _diagnosed(result: Result) -> list[str]:
    """Tables of the logs, and of noise, outliers and unexplained accelerations."""
    lines = [] if len(result.logs) == 1 else ["", *aligned(_log_lines(result))]
    return lines if result.diagnosis is None else [*lines, "", *aligned(result.diagnosis.lines(result.model.units)), ""]


def _log_lines(result: Result) -> list[list[str]]:
    """Rows of a table: log, duration, fit error, inliers, per-log parameters."""
    own, errors = result.per_log, result.per_log_standard_errors
    rows = [["log", "s", "fit error", "inliers", *(f"{name} ± standard error [{result.units[name]}]" for name in own)]]
    for i, log in enumerate(result.logs):
        inliers = f"{100.0 * log.inlier_fraction:.1f} %"
        values = [f"{x[i]:.5g} ± {errors[name][i]:.2g}" for name, x in own.items()]
        rows.append([log.source, f"{log.dt * (log.n_rows - 1):.4g}", f"{log.fit_error:.4g}", inliers, *values])
    return rows


def _assessed(result: Result) -> list[str]:
    """The verdict, the findings against the result, sensitivities and notes."""
    lines = [f"verdict: {result.verdict}", *shown_lines(result.findings)]
    for name, (half, double) in (result.bandwidth_sensitivity or {}).items():
        lines.append(f"  {name}: {100 * half:+.2g} % at half the filter's bandwidth, {100 * double:+.2g} % at twice")
    if result.competition is not None:
        lines.append(f"  {result.competition.sentence()}")
    lines += [f"  {note}" for note in result.notes]
    return [*lines, *(f"? {suggestion.change}" for suggestion in result.suggestions), next_line(result.findings)]
