"""The command ``track``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diransac.cli import screen
from diransac.cli.arguments import fixed_parameters, is_result, model_file, preparation_of, start_values
from diransac.cli.commands import grouped
from diransac.cli.flight_options import FlightPicture
from diransac.cli.options import (
    FixedParameters,
    JsonFlag,
    LogFile,
    ModelName,
    Preparation,
    Report,
    Seed,
    output_or_stdout,
)
from diransac.cli.outputs import PAGE, STDOUT, check_ending, checked, staged
from diransac.cli.robot_options import RobotOptions
from diransac.cli.tracking import Summary, TrackTable, as_line, followed, to_dict, tracked
from diransac.errors import LogError
from diransac.identification.result import Result
from diransac.identification.structure.known_parameters import KnownParameters
from diransac.identification.tracking import TrackedEstimate, Tracker, refused_if_none, track
from diransac.identification.tracking.estimates import History
from diransac.model import Model

if TYPE_CHECKING:
    from diransac.data.readers.growing import Growing

app = typer.Typer(add_completion=False)


@dataclass(frozen=True)
class TrackerOptions:
    """Options of the tracker."""

    window: Annotated[float, typer.Option(metavar="S", help="Time over which the motion is fitted again.")] = 5.0
    step: Annotated[float, typer.Option(metavar="S", help="Time between estimates.")] = 0.1
    rough: Annotated[
        str | None,
        typer.Option(
            "--start",
            metavar="RESULT.json|NAME=VALUE,...",
            help="Where it starts; else from --model MODEL.json, or from an identification of the first seconds.",
        ),
    ] = None
    fixed: FixedParameters = None
    false_alarms: Annotated[
        float, typer.Option(metavar="N", help="Changes per hour of a machine that does not change.")
    ] = 0.1
    seed: Seed = 0

    def model_of(self, whole: Model, start: Result | dict[str, float] | None) -> Model:
        """The model without the parameters that are known, by option or in the result with which it starts."""
        known = KnownParameters.of(whole, fixed_parameters(self.fixed), None).fixed
        of_start = {n: start.parameters[n] for n in start.fixed} if isinstance(start, Result) else {}
        return whole.with_fixed({**of_start, **known})

    def arguments(self, start: Result | dict[str, float] | None) -> dict[str, Any]:
        """Arguments of `diransac.track`."""
        return {
            "window": self.window,
            "step": self.step,
            "start": start,
            "seed": self.seed,
            "false_alarms_per_hour": self.false_alarms,
        }

    def start_file(self) -> Path | None:
        """The result that is the start, where one is named."""
        return Path(self.rough) if self.rough is not None and is_result(self.rough) else None

    def start(self, model: str) -> Result | dict[str, float] | None:
        """Start of the tracker."""
        file = self.start_file()
        if file is None and self.rough is None and is_result(model):
            file = Path(model)
        return start_values(self.rough) if file is None else Result.load(file)


@app.command("track")
@grouped
def _track(
    file: LogFile,
    model: ModelName,
    options: TrackerOptions,
    preparation: Preparation,
    robot: RobotOptions,
    follow: Annotated[
        bool, typer.Option("--follow", help="Read on as the file grows, CSV or MCAP, until Ctrl-C.")
    ] = False,
    idle: Annotated[
        float | None, typer.Option(metavar="S", help="With --follow: end after so long without a new row.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", parser=output_or_stdout, metavar="FILE.csv|-", help="A row for each estimate."),
    ] = None,
    json_lines: Annotated[bool, typer.Option("--jsonl", help="Print a JSON object for each estimate.")] = False,
    plot: FlightPicture = None,
    report: Report = None,
    as_json: JsonFlag = False,
) -> None:
    """Track the parameters of a machine while it runs, with their intervals and changes."""
    if as_json and json_lines:
        raise typer.BadParameter("--json and --jsonl both write to stdout; give one")
    _check(file, output, report, follow=follow, idle=idle, json_lines=json_lines)
    read = [None if file == STDOUT else file, model_file(model), options.start_file()]
    checked([output, plot, report], read)
    start, like = options.start(model), preparation_of(model)
    machine, arguments = options.model_of(robot.load(model), start), options.arguments(start)
    history = History(machine)
    with staged([plot, report, None if follow else output], read) as (picture, page, written), ExitStack() as opened:
        findings = list[str]()
        if follow:
            reader = opened.enter_context(closing(preparation.grow(file, like)))
            estimates = _following(reader, machine, arguments, idle, findings)
            written = output or Path()
        else:
            estimates = track(machine, preparation.read(file, like), **arguments)
        table = opened.enter_context(TrackTable(written, machine)) if output else None
        with suppress(KeyboardInterrupt) if follow else ExitStack():
            _show(estimates, history, table, json_lines=json_lines)
        _finish(history, picture if plot else None, page if report else None)
        if not json_lines:
            screen.show(Summary(history, findings), as_json)


def _check(
    file: Path, output: Path | None, report: Path | None, *, follow: bool, idle: float | None, json_lines: bool
) -> None:
    """Raise typer.BadParameter or ResultError: options that exclude each other, or an ending that is not written."""
    check_ending(output, (".csv",))
    check_ending(report, PAGE)
    if idle is not None and not (follow and idle > 0.0):
        raise typer.BadParameter("--idle is a number of seconds above 0, with --follow")
    if output == STDOUT and (follow or json_lines):
        raise typer.BadParameter("-o - is the table of a complete log; for a stream, give --jsonl or a file")
    if file == STDOUT and follow and output is not None and output.exists():
        raise typer.BadParameter(f'"{output}" is there, and standard input cannot be read again; give another name')


def _following(
    reader: Growing, model: Model, arguments: Mapping[str, Any], idle: float | None, findings: list[str]
) -> Iterator[TrackedEstimate]:
    """Estimates of a file that grows; a cold start is waited for, so that no answer depends on the time it takes."""
    tracker, step = Tracker(model, background=False, **arguments), arguments["step"]
    parts = followed(reader, model, idle=idle, pause=0.5 * step, clock=time.monotonic, sleep=time.sleep)
    for now in refused_if_none(tracker, tracked(tracker, parts, step)):
        for note in reader.taken_notes():
            findings.append(note)
            screen.note(note)
        yield now


def _show(
    estimates: Iterator[TrackedEstimate], history: History, table: TrackTable | None, *, json_lines: bool
) -> None:
    """Keep, write and print estimates as they come, on a terminal as a line of the newest one."""
    with screen.live() as line:
        for now in estimates:
            history.add(now)
            if table is not None:
                table.add(now)
            if json_lines:
                screen.emit(to_dict(now))
            line(as_line(now, history.model))


def _finish(history: History, picture: Path | None, page: Path | None) -> None:
    """Write the figure and the page.  Raises LogError: there is no estimate."""
    if history.last is None:
        raise LogError("there is no estimate as yet: a tracker needs a second of samples at least")
    if picture is not None:
        from diransac.plots.tracking import plot_tracking

        plot_tracking(history, picture)
    if page is not None:
        from diransac.report.tracking import write_tracking_report

        write_tracking_report(history, page, command=screen.command())
