"""Results of several methods from the same logs, side by side."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from diransac.cli.screen import bar
from diransac.data.log import Log
from diransac.errors import DiransacError
from diransac.identification.finding import shown_lines
from diransac.identification.identify import identify
from diransac.identification.method import Method
from diransac.identification.result import Result
from diransac.model import Model
from diransac.text_table import aligned


@dataclass(frozen=True)
class Comparison:
    """Results of several methods from the same logs, printed side by side.

    Parameters
    ----------
    model : Model
    logs : sequence of Log
    results : mapping of str to Result
        Result of each method that succeeded.
    seconds : mapping of str to float
        Run time of each method, s.
    refusals : mapping of str to str
        Message of each method that failed.
    """

    model: Model
    logs: Sequence[Log]
    results: Mapping[str, Result]
    seconds: Mapping[str, float]
    refusals: Mapping[str, str]

    @property
    def _source(self) -> str:
        return ", ".join(dict.fromkeys(log.source for log in self.logs))

    def to_dict(self) -> dict[str, Any]:
        """Results and refusals by method."""
        found = {name: result.to_dict() | {"seconds": self.seconds[name]} for name, result in self.results.items()}
        refused = {name: {"refused": reason} for name, reason in self.refusals.items()}
        return {"model": self.model.name, "log": self._source, "methods": found | refused}

    def __str__(self) -> str:
        units = [f"{name} [{parameter.unit}]" for name, parameter in self.model.parameters.items()]
        rows = [["method", *units, "fit error", "inliers", "samples", "seconds", "verdict"]]
        rows += [self._row(name, result) for name, result in self.results.items()]
        lines = [f"{self.model.name} from {self._source}", *aligned(rows)]
        lines += [f"{name}: {reason}" for name, reason in self.refusals.items()]
        return "\n".join([*lines, *self._remarks()])

    def _remarks(self) -> Iterator[str]:
        """Sentences on figures that do not compare, and the findings against each result."""
        yield "±: one standard error"
        if "diransac" in self.results:
            yield "diransac's fit error is a mean square, the others' a root mean square, eq. (2)"
        diagnosed = {name: result for name, result in self.results.items() if result.diagnosis is not None}
        preparations = {json.dumps([log.preparation for log in x.logs]) for x in self.results.values()}
        if diagnosed and len(preparations) > 1:
            yield f"{', '.join(diagnosed)} is evaluated on measured signals, the others on derived ones, too"
        elif diagnosed and len(self.results) > 1:
            yield "fit error and inliers are those of one simulation of the whole log, outliers and drift included"
        said = {name: x.estimate.resolution.interpolation for name, x in self.results.items()}
        for text in dict.fromkeys(filter(None, said.values())):
            yield f"{', '.join(name for name, x in said.items() if x == text)}: {text}"
        for name, result in self.results.items():
            yield from (f"{line[:2]}{name}: {line[2:]}" for line in shown_lines(result.findings))

    def _row(self, name: str, result: Result) -> list[str]:
        errors = result.standard_errors
        outside = {n: "!" if n in result.violations else "" for n in result.parameters}
        unknown = result.unidentifiable
        spreads = {n: "fixed" if n in result.fixed else f"± {error:.2g}" for n, error in errors.items()}
        estimates = ["?" if n in unknown else f"{x:.5g} {spreads[n]}{outside[n]}" for n, x in result.parameters.items()]
        inliers = f"{100.0 * result.inlier_fraction:.1f} %"
        return [
            name,
            *estimates,
            f"{result.fit_error:.4g}",
            inliers,
            str(result.iterations),
            f"{self.seconds[name]:.2f}",
            result.verdict,
        ]


def compare_methods(
    model: Model, logs: Sequence[Log], methods: Sequence[Method], arguments: Mapping[str, Any]
) -> Comparison:
    """Results of each method from the same logs, with the same arguments of `identify`.

    Parameters
    ----------
    model : Model
    logs : sequence of Log
    methods : sequence of Method
    arguments : mapping of str to object
        Other arguments of `identify`.

    Returns
    -------
    Comparison

    Raises
    ------
    DiransacError
        Every method failed; the error is that of the first.
    """
    results, seconds, refusals = {}, {}, {}
    first: DiransacError | None = None
    for method in methods:
        begin = time.perf_counter()
        try:
            with bar(method.name) as progress:
                results[method.name] = identify(model, logs, method, progress=progress, **arguments)
        except DiransacError as error:
            refusals[method.name] = str(error)
            first = first or error
        seconds[method.name] = time.perf_counter() - begin
    if first is not None and not results:
        raise first
    return Comparison(model, logs, results, seconds, refusals)
