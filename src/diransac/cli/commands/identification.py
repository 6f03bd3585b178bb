"""The commands ``identify``, ``compare`` and ``cross-validate``."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from diransac.cli import screen
from diransac.cli.arguments import model_file, names, preparation_of, start_values
from diransac.cli.commands import grouped
from diransac.cli.options import (
    Derivation,
    JsonFlag,
    LogFiles,
    MethodName,
    ModelName,
    Output,
    Preparation,
    Report,
    Search,
    StrictFlag,
    known_methods,
)
from diransac.cli.outputs import PAGE, STDOUT, check_ending, checked, staged
from diransac.cli.robot_options import RobotOptions
from diransac.cli.rows import FleetOptions
from diransac.data.log import Log
from diransac.errors import DiransacError
from diransac.identification.finding import shown_lines
from diransac.identification.identify import identify
from diransac.identification.method import Method
from diransac.identification.methods import DEFAULT, METHODS
from diransac.identification.result import Result
from diransac.model import Model
from diransac.text_table import aligned, telling_digits
from diransac.time_limit import time_limited

app = typer.Typer(add_completion=False)


@app.command("identify")
@grouped
def _identify(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    robot: RobotOptions,
    each: FleetOptions,
    method: MethodName = DEFAULT,
    with_suggestions: Annotated[
        bool, typer.Option("--with-suggestions", help="Identify again with the terms that the model seems to lack.")
    ] = False,
    add_terms: Annotated[
        str | None,
        typer.Option(metavar="NAME,...", help="The same with these alone of the terms, by their parameters."),
    ] = None,
    rough: Annotated[
        str | None,
        typer.Option(
            "--start", metavar="NAME=VALUE,...", help="Rough values from which lo-diransac starts, too: mass=0.3."
        ),
    ] = None,
    horizon: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time over which the model is to predict; estimates are compared over it."),
    ] = None,
    _config: Annotated[
        Path | None,
        typer.Option(
            "--config", metavar="FILE.toml", help="A project: logs, model and options; those given besides it win."
        ),
    ] = None,
    output: Output = None,
    report: Report = None,
    as_json: JsonFlag = False,
    strict: StrictFlag = False,
) -> None:
    """Identify the parameters of a model from one log, from several logs of one machine, or from each by itself."""
    (chosen,) = search.methods([method])
    terms = names(add_terms or "") or with_suggestions
    arguments = search.arguments() | preparation.completed(derivation).arguments()
    arguments |= {"start": start_values(rough), "horizon": horizon, "with_suggestions": terms}
    read = [*files, model_file(model), search.settings]
    if each.asked():
        if output or strict:
            raise typer.BadParameter("--each keeps its results in --store; -o and --strict are of one result")
        each.run(
            files,
            robot.load(model),
            chosen,
            preparation,
            preparation_of(model),
            report,
            arguments,
            search.time_limit,
            as_json,
        )
        return
    checked([output, report], read)
    check_ending(output, (".json",))
    check_ending(report, PAGE)
    limbs, results = robot.load_limbs(model), dict[str, Result]()
    if len(limbs) > 1 and output == STDOUT:
        raise typer.BadParameter("-o - holds one result; this robot has several limbs, give a file")
    outputs = [_of_limb(path, limb) for limb in limbs for path in (output, report)]
    with staged(outputs, read) as drafts:
        logs = preparation.read_all(files, preparation_of(model))
        for (limb, plant), saved, page in zip(limbs.items(), drafts[::2], drafts[1::2], strict=True):
            with screen.bar(f"{method} {limb}".rstrip()) as progress:
                found = identify(plant, logs, chosen, progress=progress, time_limit=search.time_limit, **arguments)
            results[limb] = found
            if output:
                found.save(saved)
            if report:
                from diransac.report import write_report

                write_report(found, logs, page, command=screen.command())
        screen.show(_LimbResults(results) if len(results) > 1 else results[""], as_json)
    for found in results.values():
        screen.end(found.verdict, strict)


@app.command("compare")
@grouped
def _compare(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    robot: RobotOptions,
    methods: Annotated[str, typer.Option(metavar="NAME,...", help="Which, in this order.")] = ",".join(METHODS),
    report: Report = None,
    as_json: JsonFlag = False,
) -> None:
    """Identify by every method from the same logs, side by side."""
    wanted = search.methods(known_methods(methods))
    arguments = search.arguments() | preparation.completed(derivation).arguments()
    read = [*files, model_file(model), search.settings]
    check_ending(report, PAGE)
    with staged([report], read) as (page,):
        plant, logs = robot.load(model), preparation.read_all(files, preparation_of(model))
        with time_limited(search.time_limit):
            comparison = _compare_methods(plant, logs, wanted, arguments)
        if report:
            from diransac.report import write_report

            write_report(comparison.results, logs, page, command=screen.command())
        screen.show(comparison, as_json)


@app.command("cross-validate")
@grouped
def _cross_validate(
    files: LogFiles,
    model: ModelName,
    search: Search,
    derivation: Derivation,
    preparation: Preparation,
    robot: RobotOptions,
    method: MethodName = DEFAULT,
    horizon: Annotated[float | None, typer.Option(metavar="S", help="Restart the simulation after so long.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Identify from all logs but one, and predict that one, for each in turn."""
    from diransac.identification.assessment.cross_validation import cross_validate

    (chosen,) = search.methods([method])
    arguments = search.arguments() | preparation.completed(derivation).arguments()
    arguments |= {"horizon": horizon, "time_limit": search.time_limit}
    plant, logs = robot.load(model), preparation.read_all(files, preparation_of(model))
    with screen.bar(f"{method}, leaving one log out") as progress:
        found = cross_validate(plant, logs, chosen, progress=progress, **arguments)
    screen.show(found, as_json)


# ---------------------------------------------------------------------- limbs of a robot


def _of_limb(path: Path | None, limb: str) -> Path | None:
    """File of a limb, ``model-FL.json`` beside ``model.json``; the file itself for a model that is in one part."""
    return path if path is None or not limb else path.with_stem(f"{path.stem}-{limb}")


@dataclass(frozen=True)
class _LimbResults:
    """Results of the limbs of a robot, side by side.

    Parameters
    ----------
    results : mapping of str to Result
        By the name of the limb.
    """

    results: Mapping[str, Result]

    def to_dict(self) -> dict[str, Any]:
        """Results by limb."""
        return {"limbs": {limb: result.to_dict() for limb, result in self.results.items()}}

    def __str__(self) -> str:
        rows: list[Sequence[str]] = [("parameter ± 95 %", *self.results, "unit")]
        of_limbs = [_without_limb(limb, result) for limb, result in self.results.items()]
        for name in dict.fromkeys(name for own in of_limbs for name in own):
            units = [own[name][1] for own in of_limbs if name in own]
            rows.append((name, *(own[name][0] if name in own else "" for own in of_limbs), units[0]))
        texts = (f"{limb}: {result}" for limb, result in self.results.items())
        return "\n".join([*aligned(rows), "", *texts])


def _without_limb(limb: str, result: Result) -> dict[str, tuple[str, str]]:
    """Estimate with half of its interval, and unit, of each parameter, by its name without that of the limb."""
    found = {}
    for name, (low, high) in result.intervals().items():
        value, digits = result.parameters[name], telling_digits(low, high)
        text = "?" if name in result.unidentifiable else f"{value:.{digits}g} ± {0.5 * (high - low):.2g}"
        found[name.replace(f"_{limb}_", "_")] = text, result.units[name]
    return found


# ---------------------------------------------------------------------- methods side by side


@dataclass(frozen=True)
class _Comparison:
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


def _compare_methods(
    model: Model, logs: Sequence[Log], methods: Sequence[Method], arguments: Mapping[str, Any]
) -> _Comparison:
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
    _Comparison

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
            with screen.bar(method.name) as progress:
                results[method.name] = identify(model, logs, method, progress=progress, **arguments)
        except DiransacError as error:
            refusals[method.name] = str(error)
            first = first or error
        seconds[method.name] = time.perf_counter() - begin
    if first is not None and not results:
        raise first
    return _Comparison(model, logs, results, seconds, refusals)
