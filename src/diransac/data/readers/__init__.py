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
from diransac.data.checks import check_clock, check_even, check_names, check_time_order
from diransac.data.log import Log
from diransac.data.preprocessing.steps import check_factor, origins_of, rename_columns, resample_columns
from diransac.data.readers.recording import Samples
from diransac.data.readers.repair import Repairs
from diransac.data.readers.table import Table
from diransac.data.units import conversion, split_unit
from diransac.errors import LogError, SettingsError
from diransac.limits import LARGEST_LOG, LARGEST_TEXT, check_ordinary, read_bytes
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
    The time column is ``t``, in seconds.  Every other column is a signal; a column that does not hold numbers is left
    out, with a note.  A header ``theta [deg]`` is the signal ``theta`` in degrees.  Rows count from 0, lines of text
    from 1.

    Topics have clocks of their own.  The rows of the log are those of the fastest topic, or at ``resample`` Hz; a
    sample of a slower topic stands in the row nearest to it, and the rows between are NaN.
    """
    path = Path(path)
    source = one_line(f'log "{path}"')
    chosen = None if mapping is None else _mapping(mapping)
    repairs = Repairs.of(_given(repair, chosen, "repair"))
    resample = _given(resample, chosen, "resample")
    opened = _opened(path, source, columns, repairs)
    if isinstance(opened, Table):
        table = repairs.in_si(_with_clock(opened, rate, source))
        rename = _stripped(rename, table)
    else:
        from diransac.data.readers.topics import is_one_table, table_of_topics, whole_topic

        if chosen is None and is_one_table(opened, rename or {}):
            table = whole_topic(opened, repairs)
        else:
            table, resample = table_of_topics(opened, chosen, rename or {}, resample, repairs)
            rename = None
    if rename:
        table = _renamed(table, rename, source)
    if chosen is not None and isinstance(opened, Table):
        from diransac.data.readers.topics import mapped_table

        table = mapped_table(table, chosen, source)
    log = _log(table, scale or {}, resample, repairs, source)
    return log if chosen is None else _prepared(log, chosen)


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
    time = _time(table, factors, source)
    signals, unusable = _signals(table, len(time), source)
    for name in factors:
        if name != "t" and name not in signals:
            raise LogError(f'{source}: there is no signal "{name}" to scale; found {", ".join(table.columns)}')
    if factors:
        time, signals = time * factors.get("t", 1.0), {n: x * factors.get(n, 1.0) for n, x in signals.items()}
        history.append({"step": "scale", "factors": factors})
    ordered = repairs.ordered(Samples(time, signals), "")
    time, signals = ordered.time, dict(ordered.columns)
    check_time_order(time, source)
    notes = [*table.notes, *check_clock(time, source)]
    if resample is None and "clock" in repairs and _is_uneven(time, source):
        resample = "median"
        repairs.record("clock", "the clock is uneven")
    if repairs.step is not None:
        history.append(repairs.step)
        notes += repairs.notes
    if resample is not None:
        time, signals, step, said = resample_columns(time, signals, resample, source)
        history.append(step)
        notes += said
    units = {n: unit for n, unit in table.units.items() if abs(factors.get(n, 1.0)) == 1.0}
    log = Log(time, signals, units, source, tuple(history), unusable=unusable, filter=table.filter)
    return replace(log, notes=tuple(dict.fromkeys((*notes, *log.findings()))))


def _is_uneven(time: FloatArray, source: str) -> bool:
    try:
        check_even(time, source)
    except LogError:
        return True
    return False


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
        return _imported(_TEXTS[ending])(_content(path, source), source, columns, repairs)
    if ending is not None:
        return _imported(_TABLES[ending])(_content(path, source), source)
    from diransac.data.readers.crazyflie import MAGIC, CrazyflieRecording

    _check_content(path, source)
    with path.open("rb") as file:
        is_crazyflie = file.read(1) == MAGIC
    if is_crazyflie:
        return CrazyflieRecording(_content(path, source), source)
    raise LogError(f'{source}: the ending "{path.suffix}" is not known; use one of {", ".join(_ENDINGS)}')


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


def _content(path: Path, source: str) -> bytes:
    is_text = _ending(path) in _TEXTS and not path.name.lower().endswith(".gz")
    try:
        data = read_bytes(path, LARGEST_TEXT if is_text else LARGEST_LOG)
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
    step = {"step": "clock", "rate": float(rate)}
    return replace(table, columns={"t": np.arange(n) / rate, **table.columns}, history=(*table.history, step))


def _stripped(rename: Mapping[str, str] | None, table: Table) -> dict[str, str]:
    """New name -> name of a column, without the unit that its header may have."""
    return {new: split_unit(old)[0] if old not in table.columns else old for new, old in (rename or {}).items()}


def _renamed(table: Table, names: Mapping[str, str], source: str) -> Table:
    columns = rename_columns(table.columns, names, source)
    units = {new: table.units[old] for new, old in names.items() if old in table.units}
    kept = {name: unit for name, unit in table.units.items() if name in columns and name not in names}
    specification = None if table.filter is None else table.filter.renamed(origins_of(table.columns, names))
    history = (*table.history, {"step": "rename", "names": dict(names)})
    return replace(table, columns=columns, units=kept | units, filter=specification, history=history)


def _time(table: Table, factors: Mapping[str, float], source: str) -> FloatArray:
    """Column ``t`` (N,) of the file, not scaled.  Raises LogError: there is none, or it is not in seconds."""
    for name, factor in factors.items():
        check_factor(name, factor)
    if "t" not in table.columns:
        raise LogError(f'{source}: there is no time column "t"; found {", ".join(table.columns)}. {_time_hint(table)}')
    time = table.columns["t"]
    if isinstance(time, str):
        raise LogError(f'{source}: the time column "t" {time}')
    to_seconds = conversion(table.units.get("t", "s"), "s")
    if to_seconds not in (None, 1.0) and "t" not in factors:
        raise LogError(f"{source}: the time is in {table.units['t']}; pass --scale t={to_seconds:.6g}")
    return time


def _time_hint(table: Table) -> str:
    likely = [name for name in table.columns if name.lower().startswith(("t_", "time", "stamp"))]
    if len(likely) != 1:
        return "Say which one it is: --map t=NAME"
    factor = " --scale t=0.001" if likely[0].lower().endswith(("_ms", "millis")) else ""
    return f"Say which one it is: --map t={likely[0]}{factor}"


def _signals(table: Table, n: int, source: str) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Columns that are as long as the time, and for the others the reason why they are no signals."""
    columns = {name: column for name, column in table.columns.items() if name != "t"}
    check_names(columns, source)
    unusable = {name: column for name, column in columns.items() if isinstance(column, str)}
    numbers = {name: column for name, column in columns.items() if isinstance(column, np.ndarray)}
    unusable |= {m: f"has {len(x)} value{'s' * (len(x) != 1)}, the time {n}" for m, x in numbers.items() if len(x) != n}
    return {name: x for name, x in numbers.items() if len(x) == n}, unusable
