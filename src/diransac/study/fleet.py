"""A fleet of logs: one identification per log, on the workers of studies, kept as rows of one SQLite file."""

from __future__ import annotations

import csv
import pickle
import platform
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from hashlib import sha256
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.atomic import write_with
from diransac.data.log import Log
from diransac.data.readers import read_log
from diransac.errors import DiransacError, SettingsError, StudyError
from diransac.identification.identify import identify, method_object
from diransac.identification.method import Method
from diransac.identification.methods import DEFAULT
from diransac.identification.result import Result
from diransac.identification.settings import EXECUTION, Settings
from diransac.limits import check_ordinary
from diransac.model import Model
from diransac.plain_text import cell
from diransac.process import single_threaded
from diransac.study.engine import Progress, run_work
from diransac.study.store import AGAIN, FLEET, LARGEST, Key, Kind, Store, damage, quoted, word
from diransac.study.trials import versions


def identify_each(
    model: Model,
    logs: Sequence[str | Path],
    method: str | Method = DEFAULT,
    *,
    store: str | Path,
    vehicle: str | None = None,
    read: Callable[[Path], Log] = read_log,
    configuration: Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    jobs: int | None = None,
    batch_size: int | None = None,
    tasks: int | None = None,
    time_limit: float | None = None,
    progress: Progress | None = None,
    **arguments: Any,
) -> FleetStatus:
    """Identify a model from each of many logs by itself; those that a store has are not identified again.

    Parameters
    ----------
    model : Model
    logs : sequence of str or Path
        Files, in the order of the vehicles' lives; a worker reads them under these names.
    method : str or Method, optional
        As in `identify`.
    store : str or Path
        SQLite file; made if it does not exist.
    vehicle : str, optional
        Regular expression that is searched in the name of each file, with a group ``(?P<vehicle>...)`` and, where the
        order of the files is not that of time, ``(?P<time>...)``: a number, or a text that sorts by time.  None: the
        identity that a log's own metadata has (``sys_uuid`` of a ULog), else ``"unknown"``.
    read : callable, optional
        Log of a file; it can be pickled.
    configuration : mapping of str to object, optional
        Further values on which rows depend, ready for JSON, such as those of `read`; a store is resumed only with the
        same.
    executor, jobs, tasks, time_limit, progress
        As in `run_study`.
    batch_size : int, optional
        Logs that a worker identifies before it hands over rows; None: four, or as many as take about a second.
    **arguments
        Of `identify`, such as ``seed`` and ``differentiate``.

    Raises
    ------
    SettingsError
        The pattern or a number has no meaning; a file is named twice.
    StudyError
        The store has another configuration, or workers are lost repeatedly.
    KeyboardInterrupt
        Rows that were done are kept.

    Notes
    -----
    The row of a log depends on its file and the configuration alone.  A log that cannot be read or identified is a row
    with the reason.  The same call after an interruption runs the others, and those whose files have changed since.
    Logs that a store lacks follow those it has, whose order only a call that names all of them changes.
    """
    chosen = method_object(method, arguments.pop("settings", None), arguments.pop("estimator", None))
    signature(identify).bind(model, None, chosen, **arguments)  # a name that it lacks fails here, not once per log
    wanted = {
        "model": model.fingerprint,
        "method": [chosen.name, _without_execution(chosen)],
        "arguments": repr(sorted(arguments.items())),
        **(configuration or {}),
    }
    run_work(
        Fleet(model, {"fleet": wanted}, _asked(logs, vehicle)),
        partial(identify_logs, pickle.dumps((model, chosen, read, arguments))),
        store=store,
        executor=executor,
        jobs=jobs,
        batch_size=batch_size,
        tasks=tasks,
        time_limit=time_limit,
        progress=progress,
        stale=_changed,
    )
    return fleet_status(store)


@dataclass(frozen=True)
class Fleet:
    """Logs to be identified.

    Parameters
    ----------
    configuration : as `Work.configuration`
    asked : name of each log -> its vehicle and time
    """

    model: Model
    configuration: Mapping[str, Mapping[str, Any]]
    asked: Mapping[Key, tuple[str | None, str | None]]
    kind: Kind = FLEET

    @property
    def columns(self) -> dict[str, str]:
        """SQL type of each column of a row."""
        figures = [f"{kind}_{name}" for name in self.model.parameters for kind in ("parameter", "standard_error")]
        return {
            **dict.fromkeys(("own_vehicle", "verdict", "findings"), "TEXT"),
            **dict.fromkeys(("duration", *figures, "fit_error", "inlier_fraction"), "REAL"),
            **dict.fromkeys(("stop_reason", "file_stamp", "file_hash"), "TEXT"),
            "seconds": "REAL NOT NULL",
        }

    @property
    def about(self) -> dict[str, Any]:
        """Name of the model, and units of its parameters."""
        units = {name: parameter.unit for name, parameter in self.model.parameters.items()}
        return {"model_name": self.model.name, "units": units}


def _without_execution(method: Method) -> str:
    """The method in words, without the settings on which no answer depends."""
    defaults = {name: getattr(Settings(), name) for name in EXECUTION}
    return repr(replace(method, criteria=replace(method.criteria, **defaults)))  # type: ignore[type-var]


def _asked(logs: Sequence[str | Path], pattern: str | None) -> dict[Key, tuple[str | None, str | None]]:
    """Vehicle and time of each file, as far as the pattern finds them.

    Raises SettingsError: the pattern is wrong, or a file is named twice.
    """
    names = [str(Path(path)) for path in logs]
    twice = [name for name, other in zip(sorted(names), sorted(names)[1:], strict=False) if name == other]
    if twice or not names:
        raise SettingsError(f'log "{twice[0]}" is named twice' if twice else "no log is named; give files")
    if pattern is None:
        return {(name,): (None, None) for name in names}
    try:
        search = re.compile(pattern)
    except re.error as error:
        raise SettingsError(f"vehicle pattern {pattern!r}: {error}; see Python's re") from error
    if "vehicle" not in search.groupindex:
        raise SettingsError(f"vehicle pattern {pattern!r} has no group (?P<vehicle>...); add one")
    found: dict[Key, tuple[str | None, str | None]] = {}
    for name in names:
        match = search.search(name)
        groups = match.groupdict() if match else {"vehicle": ""}
        if groups["vehicle"] == "":
            raise SettingsError(f'vehicle pattern {pattern!r} finds no vehicle in log "{name}"')
        found[name,] = groups["vehicle"], groups.get("time")
    return found


# Worker --------------------------------------------------------------------------------------------------------------
def identify_logs(work: bytes, keys: Sequence[Key]) -> list[dict[str, Any]]:
    """One row per log, by column of the store; a log that fails is a row with the error.

    Parameters
    ----------
    work : pickle of model, method, reader and arguments of `identify`
    keys : name of each log

    Raises
    ------
    StudyError
        This machine cannot do the work at all.
    """
    model, method, read, arguments = _unpickled(work)
    with single_threaded():  # all cores run logs
        return [_row(name, model, method, read, arguments) for (name,) in keys]


@lru_cache(maxsize=4)
def _unpickled(work: bytes) -> tuple[Model, Method, Callable[[Path], Log], Mapping[str, Any]]:
    try:
        return pickle.loads(work)  # type: ignore[no-any-return]  # of `identify_each`
    except Exception as error:
        raise StudyError(f"a worker on {platform.node()} cannot load the work: {error}") from error


def _row(
    name: str, model: Model, method: Method, read: Callable[[Path], Log], arguments: Mapping[str, Any]
) -> dict[str, Any]:
    """The row of one log."""
    begin, row = time.perf_counter(), dict[str, Any](log=name, status="done", error=None, **_marks(Path(name)))
    try:
        log = read(Path(name))
        row |= {"own_vehicle": _identity(log), "duration": float(log.time[-1] - log.time[0])}
        row |= _figures(identify(model, log, method, **arguments))
    except Exception as error:  # noqa: BLE001  one log must not end a fleet; its row says what it was
        known = isinstance(error, DiransacError | OSError)
        row |= {"status": "failed", "error": str(error) if known else f"{type(error).__name__}: {error}"}
    return {**row, "versions": versions(), "seconds": time.perf_counter() - begin, "host": platform.node()}


def _identity(log: Log) -> str | None:
    """Identity of the vehicle in a log's metadata."""
    found = [step["log"]["sys_uuid"] for step in log.history if "sys_uuid" in step.get("log", {})]
    return str(found[-1]) if found else None


def _figures(result: Result) -> dict[str, Any]:
    """Columns of a result; values that are not finite are null."""
    values = {f"parameter_{name}": x for name, x in result.parameters.items()}
    values |= {f"standard_error_{name}": x for name, x in result.standard_errors.items()}
    values |= {"fit_error": result.fit_error, "inlier_fraction": result.inlier_fraction}
    finite = {name: float(x) if np.isfinite(x) else None for name, x in values.items()}
    against = "; ".join(finding for finding in result.findings if finding.level == "bad")
    return {**finite, "verdict": result.verdict, "stop_reason": result.stop_reason, "findings": against or None}


# Files -------------------------------------------------------------------------------------------------------------
def _marks(path: Path) -> dict[str, str | None]:
    """Marks of a file, or of a folder with all of its files: of sizes and times, and of contents; None without it."""
    try:
        return {"file_stamp": _stamp(path), "file_hash": _hash(path)}
    except OSError:
        return {"file_stamp": None, "file_hash": None}


def _stamp(path: Path) -> str:
    """Sizes and times of the files of a log.  Raises OSError: it cannot be read."""
    about = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in _files(path)]
    return sha256(repr(about).encode()).hexdigest()


def _hash(path: Path) -> str:
    """Contents of the files of a log.  Raises OSError: it cannot be read."""
    found = sha256()
    for file in _files(path):
        found.update(repr((file.name, file.stat().st_size)).encode())
        check_ordinary(file)
        with file.open("rb") as data:
            while block := data.read(2**20):
                found.update(block)
    return found.hexdigest()


def _files(path: Path) -> list[Path]:
    return sorted(x for x in path.rglob("*") if x.is_file()) if path.is_dir() else [path]


def _changed(store: Store, logs: Iterable[Key]) -> list[Key]:
    """Logs whose files differ from those that were read; files that are not here stay."""
    kept = {name: marks for name, *marks in store.select("SELECT log, file_stamp, file_hash FROM trials")}
    return [(name,) for (name,) in logs if name in kept and _differs(Path(name), *kept[name])]


def _differs(path: Path, stamp: str | None, content: str | None) -> bool:
    """True if a file is here and is not the one with these marks."""
    try:
        return path.exists() and _stamp(path) != stamp and _hash(path) != content
    except OSError:
        return False


# Reading -------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class FleetStatus:
    """Number of logs of a store.

    Parameters
    ----------
    done, failed, missing : int
    reasons : mapping of str to int
        Number of failed logs by reason, the names of the files left out.
    """

    done: int
    failed: int
    missing: int
    reasons: Mapping[str, int]

    def to_dict(self) -> dict[str, Any]:
        """The fields."""
        return asdict(self)

    def __str__(self) -> str:
        head = f"{self.done} logs identified, {self.failed} failed, {self.missing} missing"
        return "\n".join([head, *(f"  {count} failed: {reason}" for reason, count in self.reasons.items())])


@dataclass(frozen=True, eq=False)
class FleetRows:
    """Estimates of a fleet as arrays, each vehicle's logs together in the order of its life.

    Parameters
    ----------
    model : str
        Name of the model.
    units : mapping of str to str
        Unit of each parameter.
    logs : tuple of str
        Name of each log that was identified, (n,).
    vehicles : (n,) array of str
    values, standard_errors : mapping of str to (n,) array
        By parameter, in its unit; NaN where the log does not determine it.
    verdicts : tuple of str
        As `Result.verdict`.
    status : FleetStatus
    """

    model: str
    units: Mapping[str, str]
    logs: tuple[str, ...]
    vehicles: np.ndarray[Any, np.dtype[np.str_]]
    values: Mapping[str, FloatArray]
    standard_errors: Mapping[str, FloatArray]
    verdicts: tuple[str, ...]
    status: FleetStatus


def fleet_status(store: str | Path) -> FleetStatus:
    """Number of logs that a store has, lacks, or that failed.  Raises StudyError: there is no such store."""
    with Store.existing(store, FLEET) as kept:
        return _status(kept)


def _status(kept: Store) -> FleetStatus:
    counts = dict(kept.select("SELECT status, count(*) FROM trials JOIN asked USING (log) GROUP BY status"))
    ((asked,),) = kept.select("SELECT count(*) FROM asked")
    failures = kept.select(
        "SELECT replace(error, log, 'LOG') AS reason, count(*) AS n FROM trials WHERE status = 'failed' "
        "GROUP BY reason ORDER BY n DESC, reason LIMIT 20"
    )
    with damage(kept.path):
        done, failed = int(counts.get("done", 0)), int(counts.get("failed", 0))
        return FleetStatus(done, failed, asked - done - failed, {word(text): int(n) for text, n in failures})


def read_fleet(store: str | Path) -> FleetRows:
    """Estimates of all logs of a store.

    Raises
    ------
    StudyError
        There is no such store, or it is damaged.
    """
    with Store.existing(store, FLEET) as kept:
        about, columns, status = kept.about, kept.columns, _status(kept)
        with damage(kept.path):
            units = {word(name): word(unit) for name, unit in about["units"].items()}
            model = word(about["model_name"])
            names = [f"{kind}_{name}" for kind in ("parameter", "standard_error") for name in units]
            figures = ", ".join(quoted(columns[name][0]) for name in names)
        # Vehicle of a log that names none.
        rows = kept.select(
            "SELECT log, coalesce(vehicle, own_vehicle, ?), time, place, verdict, "
            f"{figures} FROM trials JOIN asked USING (log) WHERE status = 'done'",
            ("unknown",),
        )
    with damage(Path(store)):
        rows.sort(key=lambda row: (word(row[1]), _moment(row[2]), int(row[3])))
        numbers = np.array([row[5:] for row in rows], np.float64).reshape(len(rows), 2 * len(units))
        if np.any(np.isfinite(numbers) & (np.abs(numbers) > LARGEST)):
            raise ValueError("the square of an estimate overflows")
        vehicles = np.array([word(row[1]) for row in rows], np.str_)
        values, errors = (dict(zip(units, some, strict=True)) for some in np.split(numbers.T, 2))
        logs, verdicts = (tuple(word(row[k]) for row in rows) for k in (0, 4))
        return FleetRows(model, units, logs, vehicles, values, errors, verdicts, status)


def _moment(text: str | None) -> tuple[float, str]:
    """Key that sorts times: numbers by value, other texts as texts after them."""
    if text is None:
        return 0.0, ""
    try:
        return float(text), ""
    except ValueError:
        return np.inf, word(text)


def export_fleet(store: str | Path, path: str | Path) -> None:
    """Write the rows of a store as CSV, one per log, in the order in which logs were asked for.

    Raises
    ------
    StudyError
        There is no such store, or it has values that are neither numbers nor texts.
    """
    with Store.existing(store, FLEET) as kept:
        internal = ("own_vehicle", "file_stamp", "file_hash")
        names = [name for _, name, *_ in kept.select("PRAGMA table_info(trials)") if name not in internal]
        columns = ", ".join(map(quoted, names[1:]))
        rows = kept.select(
            f"SELECT log, coalesce(vehicle, own_vehicle), time, {columns} FROM asked LEFT JOIN trials USING (log) "
            "ORDER BY place"
        )
    with damage(Path(store)):
        lines = [[x if isinstance(x, int | float | None) else cell(word(x)) for x in row] for row in rows]

    def write(temporary: Path) -> None:
        with temporary.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(["log", "vehicle", "time", *(cell(name.rstrip(AGAIN)) for name in names[1:])])
            table.writerows(lines)

    write_with(path, write)
