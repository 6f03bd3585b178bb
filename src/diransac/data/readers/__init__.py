"""Readers of logs: one module per format, and `read_log` for all formats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.checks import check_clock, check_names, check_time_order
from diransac.data.log import Log
from diransac.data.preprocessing.steps import check_factor, origins_of, rename_columns, resample_columns
from diransac.data.readers.comma_separated import read_csv, read_csv_gz
from diransac.data.readers.mat import read_mat
from diransac.data.readers.npz import read_npz
from diransac.data.readers.parquet import read_parquet
from diransac.data.readers.table import Table
from diransac.data.units import conversion, split_unit
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any

__all__ = ["read_log"]

_READERS: dict[str, Callable[[bytes, str], Table]] = {
    ".csv": read_csv,
    ".csv.gz": read_csv_gz,
    ".parquet": read_parquet,
    ".npz": read_npz,
    ".mat": read_mat,
}


def read_log(
    path: str | Path,
    *,
    rename: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    resample: float | str | None = None,
) -> Log:
    """Log of a CSV (plain or gzip), Parquet, NPZ or MAT file.

    Parameters
    ----------
    path : str or Path
        Its ending names the format.
    rename : mapping of str to str, optional
        New name -> name of the column in the file; ``{"t": "t_s"}`` names the time.
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

    Notes
    -----
    The time column is ``t``, in seconds.  Every other column is a signal; a column that does not hold numbers is left
    out, with a note.  A header ``theta [deg]`` is the signal ``theta`` in degrees.  Rows count from 0, lines of text
    from 1.
    """
    path = Path(path)
    source = f'log "{path}"'
    table = _reader(path, source)(_content(path, source), source)
    history: list[dict[str, Any]] = list(table.history)
    if rename:
        names = {new: split_unit(old)[0] if old not in table.columns else old for new, old in rename.items()}
        table = _renamed(table, names, source)
        history.append({"step": "rename", "names": names})
    factors = {name: float(factor) for name, factor in (scale or {}).items()}
    time = _time(table, factors, source)
    signals, unusable = _signals(table, len(time), source)
    for name in factors:
        if name != "t" and name not in signals:
            raise LogError(f'{source}: there is no signal "{name}" to scale; found {", ".join(table.columns)}')
    if factors:
        time, signals = time * factors.get("t", 1.0), {n: x * factors.get(n, 1.0) for n, x in signals.items()}
        history.append({"step": "scale", "factors": factors})
    check_time_order(time, source)
    notes = [*table.notes, *check_clock(time, source)]
    if resample is not None:
        time, signals, step, said = resample_columns(time, signals, resample, source)
        history.append(step)
        notes += said
    units = {n: unit for n, unit in table.units.items() if abs(factors.get(n, 1.0)) == 1.0}
    log = Log(time, signals, units, source, tuple(history), unusable=unusable, filter=table.filter)
    return replace(log, notes=tuple(dict.fromkeys((*notes, *log.findings()))))


def _reader(path: Path, source: str) -> Callable[[bytes, str], Table]:
    if path.is_dir():
        raise LogError(f"{source}: it is a folder; name a file in it")
    endings = [ending for ending in _READERS if path.name.lower().endswith(ending)]
    if not endings:
        raise LogError(f'{source}: the ending "{path.suffix}" is not known; use one of {", ".join(_READERS)}')
    return _READERS[endings[-1]]


def _content(path: Path, source: str) -> bytes:
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise LogError(f"{source}: there is no such file") from error
    except OSError as error:
        raise LogError(f"{source}: it cannot be read: {error.strerror}") from error
    if not data:
        raise LogError(f"{source}: it is empty")
    return data


def _renamed(table: Table, names: Mapping[str, str], source: str) -> Table:
    columns = rename_columns(table.columns, names, source)
    units = {new: table.units[old] for new, old in names.items() if old in table.units}
    kept = {name: unit for name, unit in table.units.items() if name in columns and name not in names}
    specification = None if table.filter is None else table.filter.renamed(origins_of(table.columns, names))
    return replace(table, columns=columns, units=kept | units, filter=specification)


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
