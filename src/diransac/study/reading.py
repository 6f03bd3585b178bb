"""Rows, flown paths and progress of a store."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from diransac.atomic import write_bytes
from diransac.errors import SettingsError, StudyError
from diransac.limits import MOST_COUNTED
from diransac.plain_data import json_data
from diransac.plain_text import cell
from diransac.study.specification import planned_path
from diransac.study.store import LARGEST, Store, damage, quoted, word
from diransac.text_table import aligned

if TYPE_CHECKING:
    import polars as pl


# Rows -------------------------------------------------------------------------------------------
def read(store: str | Path) -> pl.DataFrame:
    """The rows of a store, one per level, trial and method, in the order in which they were asked for.

    Returns
    -------
    polars.DataFrame
        ``level``, ``trial``, ``method``; ``status``, done or failed, and ``error``; ``seed``; ``parameter_<name>`` in
        the parameter's unit; in a study that evaluates parameters the pseudo-true value ``pseudo_true_<name>`` and the
        95 % interval, ``low_<name>`` and ``high_<name>``; ``fit_error``, ``inlier_fraction``, ``iterations`` and
        ``stop_reason`` of the identification; ``<trajectory>_<state>``, RMS tracking error in the state's unit;
        ``versions``; ``seconds``, a struct by stage (the time of what is done for several trials at once is divided
        equally); ``host``. Unknown values are null.

    Raises
    ------
    StudyError
        There is no such store.
    """
    import polars as pl

    with Store.existing(store) as kept:
        columns = {name: column for name, column in kept.columns.items() if name != "paths"}
        names = ", ".join(f"t.{quoted(column)}" for column, _ in columns.values())
        rows = kept.select(
            f"SELECT {names} FROM trials t JOIN asked a USING (level, trial, method) ORDER BY "
            "min(place) OVER (PARTITION BY t.level), t.trial, min(place) OVER (PARTITION BY t.level, t.method)"
        )
    with damage(Path(store)):
        kinds: dict[str, type] = {"TEXT": str, "INTEGER": int, "REAL": float}
        schema = {name: kinds[kind] for name, (_, kind) in columns.items()}
        by_name = {name: [row[k] for row in rows] for k, name in enumerate(schema)}
        seconds = _checked(by_name, schema)
        frame = pl.DataFrame({**by_name, "seconds": seconds}, schema={**schema, "seconds": str})
    stages = list(json.loads(seconds[0])) if seconds else []
    return frame.with_columns(pl.col("seconds").str.json_decode(pl.Struct(dict.fromkeys(stages, pl.Float64))))


def _checked(columns: Mapping[str, Sequence[Any]], schema: Mapping[str, type]) -> list[str]:
    """Computing times of the rows as JSON, with the same stages; the other columns are checked.

    Raises LookupError, TypeError, ValueError: a value is not of its column's kind.
    """
    for name in ("level", "trial", "method", "status", "seed", "versions", "seconds", "host"):
        if any(value is None for value in columns[name]):
            raise ValueError(f"a row has no {name}")
    for name, kind in schema.items():
        allowed = (int, float) if kind is float else (kind,)
        wrong = [value for value in columns[name] if value is not None and type(value) not in allowed]
        if wrong:
            raise TypeError(f"{name} is {wrong[0]!r:.40}")
        if kind is float:
            _check_squares(name, columns[name])
    for trial in columns["trial"]:
        if not 0 <= trial <= MOST_COUNTED:
            raise ValueError(f"trial is {trial}")
    times = [json_data(text) for text in columns["seconds"]]
    stages = list(times[0]) if times else []
    for time in times:
        if not stages or list(time) != stages or not all(type(value) in (int, float) for value in time.values()):
            raise ValueError(f"seconds are {time!r:.40}")
    return [json.dumps(dict(zip(stages, map(float, time.values()), strict=True))) for time in times]


def _check_squares(name: str, values: Sequence[float | None]) -> None:
    """Raises ValueError: the square of a number overflows."""
    for value in values:
        if value is not None and LARGEST < abs(value) < math.inf:
            raise ValueError(f"{name} is {value!r:.40}")


def about(store: str | Path) -> dict[str, str]:
    """The study's ``name`` and ``description``, the name of its ``axis`` and the ``unit``.

    Raises
    ------
    StudyError
        There is no such store.
    """
    with Store.existing(store) as kept:
        noted = kept.about
    with damage(Path(store)):
        return {key: word(noted[key]) for key in ("name", "description", "axis", "unit")}


def paths(
    store: str | Path, trajectory: str, *, planned: bool = False
) -> dict[tuple[str, int, str], npt.NDArray[np.float32]]:
    """Flown paths (K, n_q), coordinates in their units, by level, trial and method.

    Parameters
    ----------
    store : str or Path
    trajectory : str
        Name of the mission.
    planned : bool
        The references of these flights instead, which were planned with what the method had identified.

    Raises
    ------
    StudyError
        There is no such store.
    """
    with Store.existing(store) as kept:
        rows = kept.select("SELECT level, trial, method, paths FROM trials WHERE paths NOT NULL ORDER BY rowid")
    found, key = {}, planned_path(trajectory) if planned else trajectory
    with damage(Path(store)):
        for level, trial, method, packed in rows:
            path = _unpacked(packed, key)
            if path is not None:
                found[level, trial, method] = path
    return found


def _unpacked(packed: bytes, trajectory: str) -> npt.NDArray[np.float32] | None:
    """Flown path (K, n_q) of a trajectory; None if there is none.  Raises ValueError: it is damaged, or too large."""
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        if any(entry.file_size > 64 * 2**20 for entry in archive.infolist()):
            raise ValueError("a flown path is too large")
    with np.load(io.BytesIO(packed), allow_pickle=False) as flown:
        if trajectory not in flown:
            return None
        path: npt.NDArray[np.float32] = flown[trajectory]
    if path.dtype != np.float32 or path.ndim != 2 or min(path.shape) < 1:
        raise ValueError(f"a flown path is of {path.dtype}, {path.shape}")
    return path


def export(store: str | Path, path: str | Path, kind: str) -> None:
    """Write the rows of a store as ``parquet``, or as ``csv`` with the seconds by stage as JSON.

    Raises
    ------
    StudyError
        There is no such store, or the file cannot be written.
    SettingsError
        Another kind.
    """
    import polars as pl

    frame = read(store)
    memory = io.BytesIO()  # Polars' own errors of a full disk are no OSError
    if kind == "parquet":
        # Without rows there are no stages, which Parquet cannot hold.
        (frame if len(frame) else frame.drop("seconds")).write_parquet(memory)
    elif kind == "csv":
        header = pl.DataFrame([list(map(cell, frame.columns))], orient="row")
        header.write_csv(memory, include_header=False)
        texts = pl.col(pl.String).map_elements(cell, pl.String)
        frame.with_columns(texts, pl.col("seconds").struct.json_encode()).write_csv(memory, include_header=False)
    else:
        raise SettingsError(f'there is no kind "{kind}"; there are parquet, csv')
    try:
        write_bytes(path, memory.getbuffer())
    except OSError as error:
        raise StudyError(f'"{path}" cannot be written: {error.strerror}') from error


# Progress --------------------------------------------------------------------------------------------------
class TrialCounts(NamedTuple):
    """Numbers of trials of one level and method that were asked for, are done and have failed; one of the errors."""

    asked: int
    done: int
    failed: int
    error: str | None

    @property
    def missing(self) -> int:
        """Number of trials yet to run."""
        return self.asked - self.done - self.failed


@dataclass(frozen=True)
class Status:
    """Progress of a study.

    Parameters
    ----------
    store : path of the file
    name : of the study
    cells : (level, method) -> numbers of trials, in the order in which they were asked for
    """

    store: str
    name: str
    cells: Mapping[tuple[str, str], TrialCounts]

    @property
    def asked(self) -> int:
        """Number of rows that were asked for."""
        return sum(cell.asked for cell in self.cells.values())

    @property
    def done(self) -> int:
        """Number of complete rows."""
        return sum(cell.done for cell in self.cells.values())

    @property
    def failed(self) -> int:
        """Number of rows with an error."""
        return sum(cell.failed for cell in self.cells.values())

    @property
    def missing(self) -> int:
        """Number of rows yet to run."""
        return self.asked - self.done - self.failed

    def to_dict(self) -> dict[str, Any]:
        """All of it, ready for JSON."""
        totals = {"rows": self.asked, "done": self.done, "failed": self.failed, "missing": self.missing}
        cells = [
            {"level": level, "method": method, **cell._asdict(), "missing": cell.missing}
            for (level, method), cell in self.cells.items()
        ]
        return {"store": self.store, "study": self.name, **totals, "cells": cells}

    def __str__(self) -> str:
        methods = list(dict.fromkeys(method for _, method in self.cells))
        levels = dict.fromkeys(level for level, _ in self.cells)
        rows = [["level", *methods]]
        rows += [[level, *(_text(self.cells.get((level, method))) for method in methods)] for level in levels]
        title = f"{self.name} in {self.store}: {self.done} done, {self.failed} failed, {self.missing} missing"
        lines = [f"{title} of {self.asked} rows, one per level, trial and method", *aligned(rows)]
        failures = {method: (level, cell.error) for (level, method), cell in self.cells.items() if cell.error}
        lines += [f"! {method} failed, as at level {level}: {error}" for method, (level, error) in failures.items()]
        return "\n".join(lines)


def status(store: str | Path) -> Status:
    """Numbers of trials done, failed and missing, by level and method.

    Raises
    ------
    StudyError
        There is no such store.
    """
    with Store.existing(store) as kept:
        noted = kept.about
        rows = kept.select(
            "SELECT a.level, a.method, count(*), coalesce(sum(t.status = 'done'), 0), "
            "coalesce(sum(t.status = 'failed'), 0), min(t.error) "
            "FROM asked a LEFT JOIN trials t USING (level, trial, method) GROUP BY 1, 2 ORDER BY min(place)"
        )
    with damage(Path(store)):
        cells = {
            (word(level), word(method)): TrialCounts(asked, done, failed, None if error is None else word(error))
            for level, method, asked, done, failed, error in rows
        }
        return Status(str(store), word(noted["name"]), cells)


def _text(cell: TrialCounts | None) -> str:
    if cell is None:
        return "-"
    counts = [f"{cell.done} done"]
    counts += [f"{n} {word}" for n, word in ((cell.failed, "failed"), (cell.missing, "missing")) if n]
    return ", ".join(counts)
