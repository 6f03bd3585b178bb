"""Options that several commands share."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diransac.cli.arguments import (
    fixed_parameters,
    load_methods,
    load_settings,
    names,
    numbers,
    pairs,
    prior_pairs,
)
from diransac.data import preprocessing
from diransac.data.log import Log
from diransac.data.readers import episodes_of, read_log, read_logs
from diransac.data.readers.repair import REPAIRS
from diransac.errors import LogError, SettingsError
from diransac.identification.method import Method
from diransac.identification.methods import ESTIMATORS, METHODS
from diransac.limits import LARGEST_TEXT, MOST_COUNTED
from diransac.simulation import HOLDS

if TYPE_CHECKING:
    from diransac.data.readers.growing import Growing


def _known(what: str, choices: Collection[str]) -> Callable[[Any], Any]:
    """Callback that accepts None and one of some names."""

    def check(name: str | None) -> str | None:
        if name is not None and name not in choices:
            raise typer.BadParameter(f"there is no {what} {name!r}; there are {', '.join(choices)}")
        return name

    return check


known_method: Callable[[str], str] = _known("method", METHODS)


def _rate(text: str | None) -> str | float | None:
    """Hz, or the word ``median``.  Raises typer.BadParameter: it is neither."""
    if text is None or text == "median":
        return text
    try:
        return float(text)
    except ValueError as error:
        raise typer.BadParameter(f"--resample: {text!r} is no rate; give a number in Hz, or median") from error


def _episodes(text: str) -> list[int]:
    """Numbers of ``0:10,12``, of which ``0:10`` are the first ten.  Raises typer.BadParameter: it is anything else."""
    found = list[int]()
    for part in text.split(","):
        first, colon, end = part.partition(":")
        try:
            start, stop = int(first), int(end) if colon else int(first) + 1
        except ValueError as error:
            raise typer.BadParameter(f"--episodes: {part!r} is no episode; give numbers, or START:END") from error
        if not start < stop <= start + MOST_COUNTED - len(found):
            raise typer.BadParameter(f"--episodes: {part!r} has no episode, or too many; 0:10 are the first ten")
        found += range(start, stop)
    return found


def _stretches(text: str) -> list[tuple[float, float]]:
    """Pairs of seconds of ``4.8:5.9,7:8``.  Raises typer.BadParameter: it is anything else."""
    found = []
    for part in text.split(","):
        try:
            start, stop = (float(x) for x in part.split(":"))
        except ValueError as error:
            raise typer.BadParameter(f"--leave-out: {part!r} is no stretch; give START:END in seconds") from error
        found.append((start, stop))
    return found


def known_methods(text: str) -> list[str]:
    """Names of methods from ``"a, b"``.  Raises typer.BadParameter: a name is unknown, or there is none."""
    wanted = [known_method(name) for name in names(text)]
    if not wanted:
        raise typer.BadParameter(f"--methods: none is named; there are {', '.join(METHODS)}")
    return wanted


def output_or_stdout(text: str) -> Path:
    """Path of a file to write, or ``-``.  Raises typer.BadParameter: empty, for `Path` the current folder."""
    if not text:
        raise typer.BadParameter("the name is empty; give the name of a file")
    return Path(text)


def output_file(text: str) -> Path:
    """Path of a file to write.  Raises typer.BadParameter: empty, or ``-``."""
    if text == "-":
        raise typer.BadParameter("only --output can be -, which is stdout; give the name of a file")
    return output_or_stdout(text)


def _moment(seconds: float | None) -> float | None:
    """The number itself.  Raises typer.BadParameter: it is NaN."""
    if seconds is not None and isnan(seconds):
        raise typer.BadParameter("nan is no moment; give a number of seconds")
    return seconds


_LOG_HELP = (
    "CSV(.gz), Parquet, NPZ, MAT or HDF5: time t and one column a signal; ULog, MCAP, bag, Crazyflie: --mapping; "
    "the folder of a LeRobot dataset."
)
_MODEL = typer.Option(
    "--model",
    metavar="NAME|FILE.py[:NAME]|FILE.xml|MODEL.json",
    help="Built in, yours, a robot's MJCF or URDF, or a result's; logs are then read as that of the result was.",
)

LogFile = Annotated[Path, typer.Argument(metavar="LOG|-", help=_LOG_HELP)]
LogFiles = Annotated[list[Path], typer.Argument(metavar="LOG...", help=f"{_LOG_HELP} Several are used together.")]
ResultFile = Annotated[Path, typer.Argument(metavar="MODEL.json", help="What identify saved.")]
ModelName = Annotated[str, _MODEL]
OptionalModelName = Annotated[str | None, _MODEL]
MethodName = Annotated[str, typer.Option("--method", callback=known_method, help=f"One of {', '.join(METHODS)}.")]
Output = Annotated[
    Path | None,
    typer.Option("--output", "-o", parser=output_or_stdout, metavar="FILE.json|-", help="Where to save the result."),
]
Report = Annotated[
    Path | None,
    typer.Option("--report", parser=output_file, metavar="FILE.html", help="Where to write a page to look at."),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")]
StrictFlag = Annotated[
    bool, typer.Option("--strict", help='End with exit code 3 where the verdict is "do not rely on this".')
]

Seed = Annotated[int, typer.Option(help="The same seed gives the same answer.")]
FixedParameters = Annotated[
    list[str] | None,
    typer.Option("--fix", metavar="NAME[=VALUE],...", help="Parameters that are known: mass=0.25, or by name."),
]
TimeLimit = Annotated[
    float | None,
    typer.Option("--time-limit", metavar="S", help="End the search after so many seconds, with what it has found."),
]


_option = partial(typer.Option, rich_help_panel="Preparation of the log, in this order")


@dataclass(frozen=True)
class Search:
    """Options of the identification: seed, settings, hold of the inputs, and parameters that are known."""

    seed: Seed = 0
    settings: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Settings by name.")] = None
    assignments: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One setting, such as sample_size=50; repeatable."),
    ] = None

    estimator: Annotated[
        str | None,
        typer.Option(
            callback=_known("estimator", ESTIMATORS),
            metavar="|".join(ESTIMATORS),
            help="Least squares of the samples of diransac and i-diransac.",
        ),
    ] = None

    input_hold: Annotated[
        str | None,
        typer.Option(
            callback=_known("hold", HOLDS),
            metavar="|".join(HOLDS),
            help="Inputs between samples: held, or interpolated linearly or smoothly.",
        ),
    ] = None

    fixed: FixedParameters = None
    priors: Annotated[
        list[str] | None,
        typer.Option("--prior", metavar="NAME=MEAN,SD", help="A Gaussian prior of a parameter; repeatable."),
    ] = None

    time_limit: TimeLimit = None

    def arguments(self) -> dict[str, Any]:
        """Arguments of `diransac.identify`, without method and time limit.

        Raises typer.BadParameter: they cannot be read.
        """
        return {
            "seed": self.seed,
            "input_hold": self.input_hold,
            "fixed": fixed_parameters(self.fixed),
            "priors": prior_pairs(self.priors),
        }

    def methods(self, names: Sequence[str]) -> list[Method]:
        """The methods with these settings.  Raises SettingsError: a setting has no meaning."""
        return load_methods(names, load_settings(self.settings, self.assignments or ()), self.estimator)


@dataclass(frozen=True)
class Derivation:
    """Options of the differentiation of signals that the log lacks, which regressions need.

    A simulation is compared with what was measured: commands that simulate accept them without effect.
    """

    differentiate: Annotated[
        bool,
        typer.Option(
            "--differentiate", help="For regressions: derive velocities and accelerations that the log lacks."
        ),
    ] = False
    bandwidth: Annotated[
        float | None, typer.Option(metavar="HZ", help="Bandwidth of that filter; chosen from the log if not given.")
    ] = None

    def arguments(self) -> dict[str, Any]:
        """Arguments of `diransac.identify`.  Raises SettingsError: a bandwidth without differentiation."""
        self.check()
        return {"differentiate": self.differentiate, "bandwidth": self.bandwidth}

    def check(self) -> None:
        """Raise SettingsError: a bandwidth without differentiation."""
        if self.bandwidth is not None and not self.differentiate:
            raise SettingsError("--bandwidth is that of --differentiate, which is not given; give both or neither")


@dataclass(frozen=True)
class Preparation:
    """Options of the preparation of a log, applied in this order."""

    episodes: Annotated[
        str | None, _option(metavar="N,START:END,...", help="Of a LeRobot dataset: 0:10 are the first ten.")
    ] = None
    mapping: Annotated[
        str | None, _option(metavar="NAME|FILE.toml", help="Topics to signals: a file, or px4-multirotor, ...")
    ] = None
    columns: Annotated[
        str | None, _option(metavar="NAME,...", help="Names of the columns of a CSV file without header.")
    ] = None
    rate: Annotated[float | None, _option(metavar="HZ", help="Rate of a file without time.")] = None
    repair: Annotated[
        str | None, _option(metavar="safe|NAME,...", help=f"Repair instead of refusing: {', '.join(REPAIRS)}.")
    ] = None
    rename: Annotated[
        list[str] | None, _option("--map", metavar="NEW=OLD,...", help="Columns to rename: position=q_m,t=t_s.")
    ] = None
    scale: Annotated[
        list[str] | None, _option(metavar="NAME=FACTOR,...", help="Signals to multiply, by their new names.")
    ] = None
    resample: Annotated[
        str | None, _option(metavar="HZ|median", help="Resample at a uniform rate; median: the clock's usual one.")
    ] = None
    unmeasured: Annotated[
        str | None, _option(metavar="NAME,...", help="Coordinates that the log lacks although a column is named alike.")
    ] = None
    start: Annotated[
        float | None, _option("--from", callback=_moment, metavar="S", help="Leave out what comes before.")
    ] = None
    stop: Annotated[
        float | None, _option("--until", callback=_moment, metavar="S", help="Leave out what comes after.")
    ] = None
    events: Annotated[
        str | None,
        _option("--while", metavar="EVENT,...", help="Leave out rows where an event does not hold: airborne."),
    ] = None
    left_out: Annotated[
        str | None,
        _option("--leave-out", metavar="S:S,...", help="Leave out stretches of time, from start to end: 4.8:5.9."),
    ] = None
    unwrap: Annotated[
        list[str] | None, _option(metavar="NAME=PERIOD,...", help="Counters that wrap: ticks=65536, in their unit.")
    ] = None
    despike: Annotated[str | None, _option(metavar="all|NAME,...", help="Signals to take spikes out of.")] = None
    shift: Annotated[
        list[str] | None, _option(metavar="NAME=S,...", help="Signals to move later in time: thrust=0.02.")
    ] = None

    def grow(self, file: Path, like: Sequence[Mapping[str, Any]] = ()) -> Growing:
        """Reader of a file that grows, or of CSV text on stdin, like another log of the same recorder.

        Raises LogError: it cannot be read; typer.BadParameter: an option changes samples that a complete log has.
        """
        from diransac.data.readers.growing import GrowingCsv, Pipe, growing
        from diransac.data.readers.reading import Reading

        kept = {"mapping", "columns", "rename", "scale"}
        if any(x.name not in kept and getattr(self, x.name) for x in fields(self)):
            raise typer.BadParameter(
                "--follow takes --mapping, --columns, --map and --scale; other steps need a whole log"
            )
        reading = Reading.given(**{name: x for name, x in self._arguments(()).items() if name in kept and x})
        if file == Path("-"):
            return GrowingCsv(Pipe(typer.get_binary_stream("stdin")), "standard input", reading, like)
        return growing(file, reading, like)

    def read_all(self, files: Sequence[Path], like: Sequence[Mapping[str, Any]] = ()) -> list[Log]:
        """The logs of several files, all prepared alike, and like a log of the same recorder, by its history."""
        return [log for file in files for log in self._read_each(file, like)]

    def read(self, file: Path, like: Sequence[Mapping[str, Any]] = ()) -> Log:
        """The prepared log of a file, like another one of the same recorder, as far as no option says otherwise.

        Raises LogError: it cannot be read or prepared; typer.BadParameter: several episodes are named.
        """
        if file == Path("-"):
            return self._of_stdin(like)
        episodes = [None] if self.episodes is None else _episodes(self.episodes)
        if len(episodes) > 1:
            raise typer.BadParameter("--episodes: this command takes one log; name one episode")
        return self._prepared(read_log(file, episode=episodes[0], **self._arguments(like)))

    def _read_each(self, file: Path, like: Sequence[Mapping[str, Any]]) -> list[Log]:
        """The prepared logs of a file: one, or one per episode."""
        if file == Path("-"):
            return [self._of_stdin(like)]
        episodes = None if self.episodes is None else _episodes(self.episodes)
        return [self._prepared(log) for log in read_logs(file, episodes=episodes, **self._arguments(like))]

    def _arguments(self, like: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Arguments of `read_log`."""
        replaced = {"unwrap": self.unwrap, "despike": self.despike, "shift": self.shift}
        return {
            "mapping": self.mapping,
            "columns": None if self.columns is None else names(self.columns),
            "rate": self.rate,
            "repair": self.repair,
            "rename": pairs("--map", self.rename or ()),
            "scale": numbers("--scale", self.scale or ()),
            "resample": _rate(self.resample),
            "unmeasured": None if self.unmeasured is None else names(self.unmeasured),
            "like": [step for step in like if replaced.get(step["step"]) is None],
        }

    def _prepared(self, log: Log) -> Log:
        """The log after the steps that follow its reading."""
        return preprocessing.prepared(
            log,
            {
                "from": self.start,
                "until": self.stop,
                "while": None if self.events is None else names(self.events),
                "leave_out": None if self.left_out is None else _stretches(self.left_out),
                "unwrap": numbers("--unwrap", self.unwrap or ()),
                "despike": None if self.despike is None else names(self.despike),
                "shift": numbers("--shift", self.shift or ()),
            },
        )

    def _of_stdin(self, like: Sequence[Mapping[str, Any]]) -> Log:
        """The prepared log of CSV text on stdin.  Raises LogError: as `read`, or there is none."""
        data = typer.get_binary_stream("stdin").read(LARGEST_TEXT + 1)
        if not data:
            raise LogError('"-" is standard input, which is empty; pipe CSV text into this command')
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "stdin.csv"
            file.write_bytes(data)
            try:
                return replace(self.read(file, like), source="standard input")
            except LogError as error:
                raise LogError(str(error).replace(f'log "{file}"', "standard input")) from error

    def completed(self, derivation: Derivation) -> Derivation:
        """The derivation with what the mapping file says of it and the command line does not.

        Raises LogError: the mapping is not valid.
        """
        if self.mapping is None:
            return derivation
        from diransac.data.mapping_file import load_mapping

        mapping = load_mapping(self.mapping)
        bandwidth = derivation.bandwidth if derivation.bandwidth is not None else mapping.option("bandwidth")
        return Derivation(derivation.differentiate or bool(mapping.option("differentiate")), bandwidth)

    @property
    def names_signals(self) -> bool:
        """True where topics are mapped to signals."""
        return self.mapping is not None or bool(self.rename)

    def read_uneven(self, file: Path, like: Sequence[Mapping[str, Any]] = ()) -> Log:
        """As `read`, but an unevenly sampled log is resampled at its median rate, and of several episodes the first is
        read where none is named, each with a note.
        """
        found = episodes_of(file) if self.episodes is None else ()
        if len(found) > 1:
            log = replace(self, episodes=str(found[0])).read_uneven(file, like)
            said = f"the first of {len(found)} episodes, {found[0]} to {found[-1]}; --episodes names another one"
            return replace(log, notes=(said, *log.notes))
        try:
            return self.read(file, like)
        except LogError as error:
            if self.resample is not None:
                raise
            log = replace(self, resample="median").read(file, like)
            return replace(log, notes=(f"resampled, because: {error}", *log.notes))
