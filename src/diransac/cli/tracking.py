"""The tracker over a file that grows or is complete, and what it writes on the way."""

from __future__ import annotations

import csv
import io
import math
import mmap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.preprocessing import unit_factors
from diransac.errors import ResultError
from diransac.identification.tracking.estimates import History, change_text
from diransac.plain_text import one_line
from diransac.text_table import aligned, number, percent, plural

if TYPE_CHECKING:
    from diransac.data.readers.growing import Growing
    from diransac.identification.tracking import TrackedEstimate, Tracker
    from diransac.model import Model

Columns = dict[str, FloatArray]


# ---------------------------------------------------------------------- a file that grows


def followed(
    reader: Growing,
    model: Model,
    *,
    idle: float | None,
    pause: float,
    clock: Callable[[], float],
    sleep: Callable[[float], None],
) -> Iterator[Columns]:
    """Columns of new rows, in the units of a model, as they come.

    Parameters
    ----------
    reader : Growing
    model : Model
    idle : float, optional
        Seconds without a row after which it ends; None: it waits on.
    pause : float
        Seconds between looks at a file without new rows.
    clock, sleep : callable
        Seconds of a steady clock, and a wait for some seconds.

    Raises
    ------
    LogError
        The rows cannot be read, or a unit has another dimension than the model's.
    """
    since = clock()
    while not reader.ended:
        part = reader.new()
        if part is not None:
            since = clock()
            columns, units = part
            factors = unit_factors(units, model, reader.source)
            yield {name: x * factors.get(name, 1.0) for name, x in columns.items()}
        elif idle is not None and clock() - since >= idle:
            return
        else:
            sleep(pause)


def tracked(tracker: Tracker, parts: Iterator[Columns], step: float) -> Iterator[TrackedEstimate]:
    """Estimates of a tracker, one a step, over columns of any number of rows.

    Parameters
    ----------
    tracker : Tracker
    parts : iterator of columns
        With the time ``t``.
    step : float
        Of the tracker, s.
    """
    for part in parts:
        for piece in _pieces(part, 0.5 * step):
            now = tracker.update(piece)
            if now is not None:
                yield now


def _pieces(columns: Columns, longest: float) -> Iterator[Columns]:
    """Rows in pieces that are so short, s, that an update completes no two steps."""
    cells = np.floor(columns["t"] / longest)
    ends = [0, *(np.flatnonzero(np.diff(cells)) + 1).tolist(), len(cells)]
    for first, end in pairwise(ends):
        yield {name: x[first:end] for name, x in columns.items()}


# ---------------------------------------------------------------------- the table


class TrackTable:
    """CSV file of estimates: time ``t``, parameters, and a column ``NAME_standard_error`` of each.

    A file that is there already is gone on with: a run that was killed is repeated by the same command, and its rows
    must be those that are there, by their times; from the first that is missing on, they are appended.  A last line
    that is not complete is removed.  Each row is written at once.

    Parameters
    ----------
    path : Path
    model : Model

    Raises
    ------
    ResultError
        The file cannot be written, or holds something else.
    """

    def __init__(self, path: Path, model: Model) -> None:
        names = tuple(model.parameters)
        self._path, self._names = path, names
        header = _fields(["t", *names, *(f"{name}_standard_error" for name in names)])
        try:
            self._there = self._opened(header)
            self._file: IO[str] = path.open("a", encoding="utf-8", newline="\n")
        except OSError as error:
            raise ResultError(f'output "{path}" cannot be written: {error.strerror}') from error
        if self._file.tell() == 0:
            self._write(header)

    def _opened(self, header: str) -> IO[str] | None:
        """The rows that are there, below their header; None without any.  Raises ResultError: it is another table."""
        if not self._path.exists() or not self._path.stat().st_size:
            return None
        _remove_partial_line(self._path)
        there = self._path.open(encoding="utf-8", errors="replace")
        first = there.readline()
        if first in ("", f"{header}\n"):
            return there
        there.close()
        raise ResultError(
            f'output "{self._path}" is there and begins with "{first.strip():.60}", not with the columns of this '
            "model; give another name"
        )

    def add(self, now: TrackedEstimate) -> bool:
        """Write a row; False where it is there already.  Raises ResultError: another row is there, or it cannot be."""
        cells = [now.time, *(now.parameters[n] for n in self._names), *(now.standard_errors[n] for n in self._names)]
        row = _fields([repr(float(x)) for x in cells])
        if self._there is not None:
            found = self._there.readline()
            if found:
                self._check(found, row)
                return False
            self._there.close()
            self._there = None
        self._write(row)
        return True

    def _check(self, found: str, row: str) -> None:
        there, time = (text.partition(",")[0] for text in (found, row))
        if there != time:
            raise ResultError(
                f'output "{self._path}" has a row at t = {there:.30} s where this run has t = {time} s: it is that of '
                "another log, or of other options; give another name"
            )

    def _write(self, line: str) -> None:
        try:
            self._file.write(f"{line}\n")
            self._file.flush()
        except OSError as error:
            raise ResultError(f'output "{self._path}" cannot be written: {error.strerror}') from error

    def __enter__(self) -> TrackTable:
        return self

    def __exit__(self, _kind: type[BaseException] | None, _error: object, _where: TracebackType | None) -> None:
        self._file.close()
        if self._there is not None:
            self._there.close()


def _fields(texts: Sequence[str]) -> str:
    """A line of CSV; line breaks within texts are none."""
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow([one_line(x) for x in texts])
    return line.getvalue()


def _remove_partial_line(path: Path) -> None:
    """Cut a file, which is not empty, off after its last line break."""
    with path.open("r+b") as file:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            end = content.rfind(b"\n") + 1
        file.truncate(end)


# ---------------------------------------------------------------------- texts


def to_dict(now: TrackedEstimate) -> dict[str, Any]:
    """An estimate without its covariance, ready for JSON apart from numbers that are not finite."""
    return {
        "t": now.time,
        "parameters": dict(now.parameters),
        "standard_errors": dict(now.standard_errors),
        "outliers": dict(now.outliers),
        "noise": dict(now.noise),
        "state": dict(now.state),
        "changes": [asdict(change) for change in now.changes],
        "notes": list(now.notes),
    }


def as_line(now: TrackedEstimate, model: Model) -> str:
    """An estimate on one line: each parameter with its standard error, and the largest fraction of outliers."""
    cells = [f"t {now.time:.1f} s"]
    for name, value in now.parameters.items():
        unit = model.parameters[name].unit
        cells.append(f"{name} {_with_error(value, now.standard_errors[name])} {unit}".rstrip())
    if now.outliers:
        worst = max(now.outliers, key=lambda name: now.outliers[name])
        cells.append(f"outliers {percent(now.outliers[worst])} of {worst}")
    return "  ".join(cells)


def _with_error(value: float, error: float) -> str:
    """``0.2491 ± 0.0003``: an error in one digit, and a value to its place, within six digits."""
    if not (math.isfinite(error) and error > 0.0 and math.isfinite(value)):
        return f"{number(value)} ± {number(error, 1)}"
    size = max(abs(value), error)
    digits = min(6, max(1, 1 + math.floor(math.log10(size)) - math.floor(math.log10(error))))
    return f"{number(value, digits)} ± {number(error, 1)}"


@dataclass(frozen=True)
class Summary:
    """The end of a run: the last estimate, all changes, and findings.

    Parameters
    ----------
    history : History
        With an estimate at least.
    findings : sequence of str
        Of the reader, a sentence each.
    """

    history: History
    findings: Sequence[str] = ()

    def to_dict(self) -> dict[str, Any]:
        """The last estimate, with all changes and notes."""
        assert self.history.last is not None
        notes = [*self.findings, *(note for _, note in self.history.notes)]
        changes = [asdict(change) for change in self.history.changes]
        return to_dict(self.history.last) | {"steps": self.history.n_steps, "changes": changes, "notes": notes}

    def __str__(self) -> str:
        history, last = self.history, self.history.last
        assert last is not None
        first = float(history.time[0])
        rows = [["parameter", f"at t = {last.time:.6g} s", "standard error", "unit"]]
        for name, parameter in history.model.parameters.items():
            rows.append([name, number(last.parameters[name], 5), number(last.standard_errors[name], 2), parameter.unit])
        shares = [f"{percent(x)} of {name}" for name, x in last.outliers.items()]
        changes = [change_text(x, history.model.parameters[x.parameter].unit) for x in history.changes]
        lines = [
            f"{history.model.name}: {plural(history.n_steps, 'estimate')} from t = {first:.6g} to {last.time:.6g} s",
            *aligned(rows),
            *([f"outliers in the last window: {', '.join(shares)}"] if shares else []),
            *(["changes:", *(f"  {x}" for x in changes)] if changes else ["changes: none"]),
            *(f"note: {x}" for x in (*self.findings, *(f"t = {t:.6g} s: {note}" for t, note in history.notes))),
        ]
        return "\n".join(lines)
