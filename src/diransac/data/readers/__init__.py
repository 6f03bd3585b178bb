"""Readers of logs: one module per format, imported at its first use, and `read_log` for all formats."""

from __future__ import annotations

import importlib
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data import preprocessing
from diransac.data.checks import check_clock, check_names
from diransac.data.clock import Gridded, in_order, is_even, on_own_grid, runs_freely
from diransac.data.files import place_of_metadata
from diransac.data.log import Log
from diransac.data.preprocessing.steps import check_factor, origins_of, rename_columns, resample_columns
from diransac.data.readers.recording import Samples
from diransac.data.readers.repair import Repairs
from diransac.data.readers.repeated import Reading
from diransac.data.readers.table import Table, with_metadata
from diransac.data.readers.time_column import seconds, time_column, unit_of_name
from diransac.data.units import split_unit
from diransac.errors import LogError, SettingsError
from diransac.limits import LARGEST_LOG, LARGEST_RESULT, LARGEST_TEXT, check_ordinary, read_bytes
from diransac.plain_text import one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from diransac.data.mapping import LogMapping
    from diransac.data.readers.recording import Recording
    from diransac.data.readers.topics import TopicTable

__all__ = ["read_fields", "read_log", "read_topics"]

_TABLES = {
    ".parquet": "parquet:read_parquet",
    ".npz": "npz:read_npz",
    ".mat": "mat:read_mat",
    ".h5": "hdf5:read_hdf5",
    ".hdf5": "hdf5:read_hdf5",
}
_TEXTS = {
    ".csv": "comma_separated:read_csv",
    ".csv.gz": "comma_separated:read_csv_gz",
    ".txt": "comma_separated:read_csv",
}
_RECORDINGS = {
    ".ulg": "ulog:UlogRecording",
    ".ulog": "ulog:UlogRecording",
    ".mcap": "bags:open_mcap",
    ".bag": "bags:open_bag",
}
"""Ending -> module of this package, and what opens or reads a file there."""
_ENDINGS = (*_TEXTS, *_TABLES, *_RECORDINGS)


def read_log(
    path: str | Path,
    *,
    mapping: str | Path | None = None,
    columns: Sequence[str] | None = None,
    rate: float | None = None,
    repair: bool | str | Iterable[str] | None = None,
    rename: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    resample: float | str | None = None,
    like: Iterable[Mapping[str, Any]] = (),
) -> Log:
    """Log of a CSV (plain or gzip), Parquet, NPZ, MAT, HDF5, ULog, MCAP or bag file, or of a Crazyflie's micro SD log.

    Parameters
    ----------
    path : str or Path
        Its ending names the format.  A folder is a ROS 2 bag, or has one CSV file for each group of signals.
    mapping : str or Path, optional
        Name of a built-in mapping, or a TOML file, that says which field of which topic is which signal.
    columns : sequence of str, optional
        Names of the columns of CSV text without a header line.
    rate : float, optional
        Hz, of a table without a time column.
    repair : bool, str or iterable of str, optional
        Repairs by name, True or "safe" for all; `diransac.data.readers.repair.REPAIRS` lists them.
    rename : mapping of str to str, optional
        New name -> name of the column in the file; ``{"t": "t_s"}`` names the time.  Of a file with topics,
        ``topic.field``.
    scale : mapping of str to float, optional
        (New) name -> factor; ``{"t": 0.001}`` for a time in milliseconds.
    resample : float or "median", optional
        Rate in Hz for linear interpolation, or ``"median"`` for one row per median interval.  None: the time must be
        even.
    like : iterable of dict, optional
        History of a log of the same recorder, such as ``result.logs[0].preparation``.  Its mapping, names, factors,
        rates, repairs, delays and despiking apply where the arguments above give none.  What the history in the file
        itself has is not done again.

    Returns
    -------
    Log
        With the units, filter, history and notes of a log that `Log.write` has written.

    Raises
    ------
    LogError
        The file cannot be read, or does not hold a log; one sentence says where, and what to do.
    SettingsError
        There is no repair of that name; a factor or a rate has no meaning.

    Notes
    -----
    The time column is ``t``, else the only one with a name such as ``time``, ``timestamp`` or ``t_ms``; it is converted
    to seconds from the unit of its header or name.  Every other column is a signal; a column that does not hold numbers
    is left out, with a note.  A header ``theta [deg]`` or ``theta (deg)`` is the signal ``theta`` in degrees, which a
    model in radians converts.  Rows count from 0, lines of text from 1.

    Topics have clocks of their own.  The rows of the log are those of the fastest topic, or at ``resample`` Hz; a
    sample of a slower topic stands in the row nearest to it, and the rows between are NaN.
    """
    path = Path(path)
    source = one_line(f'log "{path}"')
    like = list(like)
    earlier = Reading.of(like)
    chosen = earlier.mapping if mapping is None else _mapping(mapping)
    repairs = Repairs.of(_given(earlier.repairs if repair is None else repair, chosen, "repair"))
    columns = earlier.columns if columns is None else columns
    opened = _opened(path, source, columns, repairs)
    if isinstance(opened, Table):
        done = {step["step"] for step in opened.history}
        earlier = Reading.of(step for step in like if step["step"] not in done)
        chosen = earlier.mapping if mapping is None else chosen
    resample = _given(earlier.resample if resample is None else resample, chosen, "resample")
    if isinstance(opened, Table):
        opened = opened if columns is None else opened.with_step({"step": "columns", "names": list(columns)})
        table = repairs.in_si(_with_clock(opened, earlier.rate if rate is None else rate, source))
        rename = earlier.names(table, _stripped(rename, table))
        if chosen is None or chosen.time_column is None:
            rename = _with_time(rename, table)
    else:
        from diransac.data.readers.topics import is_one_table, table_of_topics, whole_topic

        rename = {**earlier.rename, **(rename or {})}
        if chosen is None and is_one_table(opened, rename):
            table = whole_topic(opened, repairs)
        else:
            table, resample = table_of_topics(opened, chosen, rename, resample, repairs)
            rename = None
    if rename:
        table = _renamed(table, rename, source)
    if chosen is not None and isinstance(opened, Table):
        from diransac.data.readers.topics import mapped_table

        table = mapped_table(table, chosen, source)
    log = _log(table, earlier.factors(table, scale or {}), resample, repairs, source)
    return earlier.prepared(log if chosen is None else _prepared(log, chosen))


def read_topics(path: str | Path) -> TopicTable | None:
    """Topics of a recording, with their rates, gaps and fields; None for a file with one table.

    Raises LogError: as `read_log`.
    """
    path = Path(path)
    is_folder_of_tables = path.is_dir() and not (path / "metadata.yaml").exists()
    if is_folder_of_tables or _ending(path) in (*_TEXTS, *_TABLES):
        return None
    from diransac.data.readers.topics import list_topics

    opened = _opened(path, one_line(f'log "{path}"'), None, Repairs())
    return None if isinstance(opened, Table) else list_topics(opened)


def read_fields(path: str | Path) -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    """Fields of each topic of a file, and the names of the elements of its arrays; a table has the topic ``""``.

    Raises LogError: as `read_log`.
    """
    opened = _opened(Path(path), one_line(f'log "{path}"'), None, Repairs())
    if isinstance(opened, Table):
        return {"": tuple(name for name in opened.columns if name != "t")}, {}
    return dict(opened.fields), opened.elements


def _mapping(mapping: str | Path) -> LogMapping:
    from diransac.data.mapping import load_mapping

    return load_mapping(mapping)


def _given(value: Any, mapping: LogMapping | None, name: str) -> Any:
    """An argument, or what the mapping says where there is none."""
    return mapping.option(name) if value is None and mapping is not None else value


def _prepared(log: Log, mapping: LogMapping) -> Log:
    """The log after the steps of a mapping that need no model."""
    start, stop = mapping.option("from"), mapping.option("until")
    if start is not None or stop is not None:
        log = log.between(-math.inf if start is None else start, math.inf if stop is None else stop)
    events = mapping.option("while")
    if events is not None:
        log = preprocessing.keep_while(log, [events] if isinstance(events, str) else events)
    despiked = mapping.option("despike")
    if despiked is not None:
        names = [despiked] if isinstance(despiked, str) else despiked
        log = preprocessing.despike(log, None if despiked == "all" else names)
    delays = mapping.option("shift")
    return preprocessing.shift(log, delays) if delays else log


def _log(table: Table, scale: Mapping[str, float], resample: float | str | None, repairs: Repairs, source: str) -> Log:
    """Log of a table: scaled, repaired, resampled and checked."""
    history: list[dict[str, Any]] = list(table.history)
    factors = {name: float(factor) for name, factor in scale.items()}
    for name, factor in factors.items():
        check_factor(name, factor)
    time, converted = seconds(table, factors, source)
    signals, unusable = _signals(table, len(time), source)
    for name in factors:
        if name != "t" and name not in signals:
            raise LogError(f'{source}: there is no signal "{name}" to scale; found {", ".join(table.columns)}')
    if factors:
        signals = {n: x * factors.get(n, 1.0) for n, x in signals.items()}
        units = {name: table.units[name] for name in factors if name in table.units}
        history.append({"step": "scale", "factors": factors, **({"units": units} if units else {})})
    ordered = repairs.ordered(Samples(time, signals), "")
    time, signals = ordered.time, dict(ordered.columns)
    rows = in_order(time, source)
    notes = [*table.notes, *([converted] if converted else []), *check_clock(time[rows], source)]
    gridded, resample = _gridded(time, signals, resample, repairs, source)
    if repairs.step is not None:
        history.append(repairs.step)
        notes += repairs.notes
    if gridded is not None:
        time, signals, recorded = gridded.time, dict(gridded.signals), gridded.recorded
        history += [] if gridded.step is None else [gridded.step]
        notes += gridded.notes
    elif resample is not None:
        columns = {name: x[rows] for name, x in signals.items()}
        time, signals, step, said = resample_columns(time[rows], columns, resample, source)
        history.append(step)
        recorded, notes = np.ones(len(time), bool), [*notes, *said]
    units = {n: unit for n, unit in table.units.items() if abs(factors.get(n, 1.0)) == 1.0}
    log = Log(time, signals, units, source, tuple(history), unusable=unusable, filter=table.filter)
    return replace(log, notes=tuple(dict.fromkeys((*notes, *log.findings(recorded)))))


def _gridded(
    time: FloatArray, signals: Mapping[str, FloatArray], resample: float | str | None, repairs: Repairs, source: str
) -> tuple[Gridded | None, float | str | None]:
    """Columns on the log's own grid, or the rate at which they are resampled.  Raises LogError: neither is known."""
    if resample is not None:
        return None, resample
    if "clock" in repairs and not is_even(time):
        repairs.record("clock", "the clock is uneven")
        return None, "median"
    try:
        return on_own_grid(time, signals, source), None
    except LogError:
        if not runs_freely(time[in_order(time, source)]):
            raise
    return None, "median"


# ---------------------------------------------------------------------- files


def _opened(path: Path, source: str, columns: Sequence[str] | None, repairs: Repairs) -> Table | Recording:
    """Contents of a file, or of a folder.  Raises LogError: it cannot be read."""
    if path.is_dir():
        return _opened_folder(path, source, repairs)
    ending = _ending(path)
    if ending in _RECORDINGS:
        _check_content(path, source)
        return _imported(_RECORDINGS[ending])(path, source)
    if columns is not None and ending not in _TEXTS:
        raise LogError(f"{source}: names of columns are those of CSV text without a header; leave them out")
    if ending in _TEXTS:
        return _described(path, _imported(_TEXTS[ending])(_content(path, source), source, columns, repairs), source)
    if ending is not None:
        return _imported(_TABLES[ending])(_content(path, source), source)
    from diransac.data.readers.crazyflie import MAGIC, CrazyflieRecording

    _check_content(path, source)
    with path.open("rb") as file:
        is_crazyflie = file.read(1) == MAGIC
    if is_crazyflie:
        return CrazyflieRecording(_content(path, source), source)
    raise LogError(f'{source}: the ending "{path.suffix}" is not known; use one of {", ".join(_ENDINGS)}')


def _described(path: Path, read: Table | Recording, source: str) -> Table | Recording:
    """A table with the metadata of the file beside it, where there is one."""
    beside = place_of_metadata(path)
    if not beside.is_file() or not isinstance(read, Table) or read.is_described:
        return read
    return with_metadata(read, _content(beside, f'metadata "{beside}"', LARGEST_RESULT), source, f'remove "{beside}"')


def _imported(place: str) -> Callable[..., Table | Recording]:
    """The function of a module of this package, by ``module:function``."""
    module, _, attribute = place.partition(":")
    found: Callable[..., Table | Recording] = getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
    return found


def _ending(path: Path) -> str | None:
    """The longest known ending of a file's name; None where it has none."""
    return max((x for x in _ENDINGS if path.name.lower().endswith(x)), key=len, default=None)


def _opened_folder(path: Path, source: str, repairs: Repairs) -> Table | Recording:
    """A ROS 2 bag, or a table of the CSV files in a folder."""
    if (path / "metadata.yaml").exists():
        return _imported(_RECORDINGS[".bag"])(path, source)
    files = sorted(x for x in path.iterdir() if x.name.lower().endswith(tuple(_TEXTS)))
    if len(files) < 2:  # one file is a log of its own
        raise LogError(f"{source}: it is a folder without a bag or several CSV files; name a file in it")
    from diransac.data.readers.comma_separated import joined

    return joined([(x.name.split(".")[0], _content(x, f'log "{x}"')) for x in files], source, repairs)


def _check_content(path: Path, source: str) -> None:
    """Raise LogError for a file that cannot be read, or is empty."""
    try:
        if not check_ordinary(path).st_size:
            raise LogError(f"{source}: it is empty")
    except FileNotFoundError as error:
        raise LogError(f"{source}: there is no such file") from error
    except OSError as error:
        raise LogError(f"{source}: it cannot be read: {error.strerror}") from error


def _content(path: Path, source: str, largest: int | None = None) -> bytes:
    """The bytes of a file; with the largest size of a log, unless there is another one."""
    is_text = _ending(path) in _TEXTS and not path.name.lower().endswith(".gz")
    try:
        data = read_bytes(path, largest or (LARGEST_TEXT if is_text else LARGEST_LOG))
    except ValueError as error:
        raise LogError(f"{source}: {error}; split it") from error
    except FileNotFoundError as error:
        raise LogError(f"{source}: there is no such file") from error
    except OSError as error:
        raise LogError(f"{source}: it cannot be read: {error.strerror}") from error
    if not data:
        raise LogError(f"{source}: it is empty")
    return data


# ---------------------------------------------------------------------- columns


def _with_clock(table: Table, rate: float | None, source: str) -> Table:
    """The table with a time ``t`` at a rate, where one is given."""
    if rate is None:
        return table
    if not 0.0 < rate < math.inf:
        raise SettingsError(f"the rate of a log without time is {rate}; give Hz")
    if "t" in table.columns:
        raise LogError(f"{source}: it has a time column; leave out the rate of {rate:.6g} Hz")
    n = max((len(x) for x in table.columns.values() if not isinstance(x, str)), default=0)
    clocked = replace(table, columns={"t": np.arange(n) / rate, **table.columns})
    return clocked.with_step({"step": "clock", "rate": float(rate)})


def _stripped(rename: Mapping[str, str] | None, table: Table) -> dict[str, str]:
    """New name -> name of a column, without the unit that its header may have."""
    return {new: split_unit(old)[0] if old not in table.columns else old for new, old in (rename or {}).items()}


def _with_time(rename: Mapping[str, str], table: Table) -> dict[str, str]:
    """New names of columns, with that of the time ``t``, where one column alone can be the time."""
    name = None if "t" in rename else time_column(table, rename.values())
    return dict(rename) if name is None else {"t": name, **rename}


def _renamed(table: Table, names: Mapping[str, str], source: str) -> Table:
    columns = rename_columns(table.columns, names, source)
    units = {new: table.units[old] for new, old in names.items() if old in table.units}
    named = unit_of_name(names["t"]) if "t" in names else None
    units |= {"t": named} if named is not None and "t" not in units else {}
    kept = {name: unit for name, unit in table.units.items() if name in columns and name not in names}
    specification = None if table.filter is None else table.filter.renamed(origins_of(table.columns, names))
    renamed = replace(table, columns=columns, units=kept | units, filter=specification)
    return renamed.with_step({"step": "rename", "names": dict(names)})


def _signals(table: Table, n: int, source: str) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Columns that are as long as the time, and for the others the reason why they are no signals."""
    columns = {name: column for name, column in table.columns.items() if name != "t"}
    check_names(columns, source)
    unusable = {name: column for name, column in columns.items() if isinstance(column, str)}
    numbers = {name: column for name, column in columns.items() if isinstance(column, np.ndarray)}
    unusable |= {m: f"has {len(x)} value{'s' * (len(x) != 1)}, the time {n}" for m, x in numbers.items() if len(x) != n}
    return {name: x for name, x in numbers.items() if len(x) == n}, unusable
