"""CSV text, plain or compressed by gzip: one header line, unless names are given, then one line per row."""

from __future__ import annotations

import codecs
import csv
import gzip
import io
import re
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.checks import are_many
from diransac.data.files import COMMENT
from diransac.data.readers.repair import Repairs
from diransac.data.readers.table import Table, check_size, check_unique, undamaged, with_metadata
from diransac.data.units import split_unit
from diransac.errors import LogError
from diransac.limits import LARGEST_TEXT, beyond

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import polars as pl

_SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab"}
_FEW_LINES = 20_000
_COMMENTS = ("#", "%", "//")
_ISO = re.compile(
    r"(?P<date>(?:19|20|21)\d\d-\d\d-\d\d)[T ](?P<clock>\d\d:\d\d:\d\d(?:[.,]\d{1,9})?)(?P<zone>Z|[+-]\d\d:?\d\d)?"
)


def read_csv_gz(data: bytes, source: str, names: Sequence[str] | None = None, repairs: Repairs | None = None) -> Table:
    """Table of gzip data.  Raises LogError: as `read_csv`; the data are not gzip, or are cut off."""
    with undamaged(f"{source}: the gzip data are damaged or cut off"):
        text = _unpacked(data, source)
    return read_csv(text, source, names, repairs)


def _unpacked(data: bytes, source: str) -> bytes:
    """Text of gzip data.  Raises LogError: it is too large."""
    parts, size = list[bytes](), 0
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        while part := file.read(1 << 22):
            parts.append(part)
            size += len(part)
            if size > LARGEST_TEXT:
                raise LogError(f"{source}: its text has {beyond(LARGEST_TEXT, 'bytes')}; split it")
    return b"".join(parts)


def read_csv(data: bytes, source: str, names: Sequence[str] | None = None, repairs: Repairs | None = None) -> Table:
    """Table of CSV text.

    Parameters
    ----------
    data : bytes
    source : str
    names : sequence of str, optional
        Names of the columns of a file without a header line.
    repairs : Repairs, optional
        Of comments, rows, timestamps and cells, where they are allowed.

    Raises LogError: the data are not UTF-8 text with a header line and as many fields in every line, or too large.
    """
    repairs = Repairs() if repairs is None else repairs
    text, notes = _text(data, source)
    check_size(source, text.count("\n"), 1)
    lines = text.split("\n")
    has_metadata = lines[0].lstrip('"').startswith(COMMENT)  # spreadsheets put quotation marks around it
    metadata = lines.pop(0).strip('"').removeprefix(COMMENT) if has_metadata else None
    lines = _without_comments(_with_bare_header(lines) if names is None else lines, repairs)
    lines, skipped = _without_preamble(lines, repairs)
    if not lines:
        raise LogError(f"{source}: there is no header line after the metadata; give one, and one line per row")
    line = (1 if metadata is None else 2) + skipped
    if _is_spaced(lines):
        lines, notes = [",".join(x.split()) for x in lines], [*notes, "fields are separated by spaces"]
    separator = _separator(lines[0])
    check_size(source, len(lines), lines[0].count(separator) + 1)
    if names is None:
        headers = _header(lines[0], separator, source)
    else:
        headers = _checked_names(lines[0], names, separator, source)
        lines, line = [separator.join(headers), *lines], line - 1
    lines = _without_ragged(lines, separator, repairs, source)
    _check_ragged(lines, line, separator, source)
    if len(lines) == 1:
        raise LogError(f"{source}: there is a header ({', '.join(headers)[:200]}) but no row")
    headers, first = _with_units(headers, lines[1].split(separator)) if len(lines) > 2 else (headers, 1)
    named = [split_unit(header) for header in headers]
    check_unique([name for name, _ in named if name], source)
    read = _columns(lines[first:], headers, line + first, separator, source, repairs)
    columns = {name: column for (name, _), column in zip(named, read, strict=True) if name}
    units = {name: unit for name, unit in named if unit is not None}
    times = {name: x.seconds for name, x in columns.items() if isinstance(x, _Times)}
    plain = {name: x.reason if isinstance(x, _Times) else x for name, x in columns.items()}
    table = Table(plain, units, (*notes, *_notes(named, separator)), times=times)
    return table if metadata is None else with_metadata(table, metadata, source, "remove its first line")


@dataclass(frozen=True)
class _Times:
    """A column of times of the calendar: seconds (n,) since the first, and the reason why it is no signal."""

    seconds: FloatArray
    reason: str


def head_of(lines: Sequence[str]) -> int | None:
    """Number of lines above the first row of numbers, of text with a header; None where that row is missing."""
    return next((k for k, line in enumerate(lines) if k and any(map(_is_number, fields_of(line)))), None)


def fields_of(line: str) -> list[str]:
    """Fields of a line, between separators or else between spaces."""
    separated = any(x in line for x in _SEPARATORS)
    return [x.strip() for x in (line.split(_separator(line)) if separated else line.split())]


def _is_row(line: str) -> bool:
    """True for a line of numbers."""
    return all(_is_number(x) for x in fields_of(line))


def _with_bare_header(lines: list[str]) -> list[str]:
    """Lines in which a header is no comment: the last of the comments above numbers, with as many fields as these."""
    n = next((k for k, line in enumerate(lines) if not line.startswith(_COMMENTS)), 0)
    if not 0 < n < len(lines) or not _is_row(lines[n]):
        return lines
    header = lines[n - 1].lstrip("#%/ ")
    if len(fields_of(header)) != len(fields_of(lines[n])) or _is_row(header):
        return lines
    return [*lines[: n - 1], header, *lines[n:]]


def _is_spaced(lines: Sequence[str]) -> bool:
    """True where spaces separate the numbers of the last line, and as many fields of the first."""
    last = lines[-1].split()
    return (
        len(last) > 1
        and not any(x in line for x in _SEPARATORS for line in (lines[0], lines[-1]))
        and all(_is_number(x) for x in last)
        and len(lines[0].split()) == len(last)
    )


def _without_preamble(lines: list[str], repairs: Repairs) -> tuple[list[str], int]:
    """Lines from the header on, and the number of those above it, where they may be left out."""
    if "preamble" not in repairs or not lines:
        return lines, 0
    n = _lines_above(lines)
    if n:
        repairs.record("preamble", f"{n} line{'s' * (n > 1)} above the header left out")
    return lines[n:], n


def _lines_above(lines: Sequence[str]) -> int:
    """Number of lines above the first that has as many fields as most of the last ones, if it is a header."""
    separator = _separator(lines[-1]) if any(x in lines[-1] for x in _SEPARATORS) else None
    # The last lines have the usual number of fields.
    width = Counter(len(line.split(separator)) for line in lines[-20:]).most_common(1)[0][0]
    found = next((k for k, line in enumerate(lines) if len(line.split(separator)) == width), 0)
    return 0 if _is_row(lines[found]) else found


def _with_units(headers: list[str], below: Sequence[str]) -> tuple[list[str], int]:
    """Headers with the units of a second line of these, and the number of lines above the first row."""
    units = [x.strip().strip("[]()") for x in below]
    known = [split_unit(f"x ({x})")[1] is not None for x in units]
    if len(units) != len(headers) or any(map(_is_number, units)) or not any(known):
        return headers, 1
    pairs = zip(headers, units, strict=True)
    return [f"{name} [{unit}]" if unit not in ("", "-") else name for name, unit in pairs], 2


def joined(files: Sequence[tuple[str, bytes]], source: str, repairs: Repairs) -> Table:
    """Table of several CSV files with as many rows each, such as ``time``, ``q`` and ``tau``.

    A file without a header is one column with the file's name, or the columns ``q_1`` to ``q_k``; ``time`` is ``t``.

    Raises LogError: as `read_csv`; two columns have one name; the files have different numbers of rows.
    """
    columns: dict[str, FloatArray | str] = {}
    units: dict[str, str] = {}
    rows: dict[str, int] = {}
    for name, data in files:
        own = f"{source}, file {name}"
        table = read_csv(data, own, _names_of(name, data, own), repairs)
        if columns and table.columns.keys() <= columns.keys():
            raise LogError(
                f"{source}: its files have the columns {', '.join(table.columns)} each: each is a log of its own. "
                "Name the files, as in folder/*.csv"
            )
        check_unique([*columns, *table.columns], source)
        columns |= table.columns
        units |= table.units
        rows[name] = table.n_rows
    if len(set(rows.values())) > 1:
        raise LogError(
            f"{source}: its files have different numbers of rows: {', '.join(f'{n} {k}' for n, k in rows.items())}"
        )
    return Table(columns, units, (f"joined from the files {', '.join(rows)}",))


def _names_of(name: str, data: bytes, source: str) -> list[str] | None:
    """Names of the columns of a file without a header; None for a file that has one."""
    lines = _with_bare_header(_text(data, source)[0].split("\n"))
    first = next((x for x in lines if x.strip() and not x.startswith(_COMMENTS)), "")
    fields = fields_of(first)
    if not _is_row(first):
        return None
    if len(fields) == 1:
        return ["t" if name.lower() in ("t", "time") else name]
    return [f"{name}_{k + 1}" for k in range(len(fields))]


def _without_comments(lines: list[str], repairs: Repairs) -> list[str]:
    if "comments" not in repairs:
        return lines
    kept = [line for line in lines if line.strip() and not line.lstrip().startswith(_COMMENTS)]
    if len(kept) < len(lines):
        repairs.record("comments", f"{len(lines) - len(kept)} lines of comments, or blank, left out")
    return kept


def _checked_names(line: str, names: Sequence[str], separator: str, source: str) -> list[str]:
    found = line.count(separator) + 1
    if len(names) != found:
        raise LogError(f"{source}: {len(names)} columns are named, the first line has {found} fields")
    return list(names)


def _without_ragged(lines: list[str], separator: str, repairs: Repairs, source: str) -> list[str]:
    """Lines with as many fields as the header, which are kept."""
    if "rows" not in repairs or any('"' in line for line in lines):
        return lines
    expected = lines[0].count(separator)
    kept = [line for line in lines if line.count(separator) == expected]
    n = len(lines) - len(kept)
    if are_many(n, len(lines)):
        raise LogError(
            f"{source}: {n} of {len(lines)} lines have not {expected + 1} fields: too many to repair (1 in 100)"
        )
    if n:
        repairs.record("rows", f"{n} line{'s' * (n > 1)} without {expected + 1} fields left out")
    return kept


def _decoded(data: bytes, source: str) -> tuple[str, list[str]]:
    """Text in UTF-8, else in UTF-16 by its mark or in the code of Windows, with a note."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        with suppress(UnicodeDecodeError):
            return data.decode("utf-16"), ["its text is UTF-16"]
    try:
        return data.decode("utf-8-sig"), []
    except UnicodeDecodeError as error:
        with suppress(UnicodeDecodeError):
            text = data.decode("cp1252")
            if not re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", text):
                return text, ["its text is not UTF-8, and is read as that of Windows (1252)"]
        raise LogError(
            f"{source}: it is not UTF-8 text (byte 0x{data[error.start]:02x} at offset {error.start}); save it as UTF-8"
        ) from error


def _text(data: bytes, source: str) -> tuple[str, list[str]]:
    """Decoded text whose lines are separated by single line feeds, and notes on it."""
    text, notes = _decoded(data, source)
    if "\0" in text:
        raise LogError(f"{source}: it holds binary data, not text")
    text = text.replace("\r\n", "\n").replace("\r", "\n").strip("\n")
    if not text.strip():
        raise LogError(f"{source}: it is empty; give a header line and one line per row")
    return text, notes


def _separator(header: str) -> str:
    """The semicolon or tab of a header that has no other separator; the comma otherwise."""
    found = [s for s in _SEPARATORS if s in header]
    return found[0] if len(found) == 1 else ","


def _header(line: str, separator: str, source: str) -> list[str]:
    try:
        headers = [header.strip() for header in next(csv.reader([line], delimiter=separator))]
    except csv.Error as error:
        raise LogError(f"{source}: the header line cannot be read ({error})") from error
    if all(_is_number(header) for header in headers):
        raise LogError(
            f"{source}: the first line holds numbers ({line:.60}); give it a header line with names, or "
            "name the columns: --columns t,x,..."
        )
    return headers


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _check_ragged(lines: list[str], first: int, separator: str, source: str) -> None:
    """Raise LogError for the first line that has not as many fields as the header, which is line ``first``."""
    if any('"' in line for line in lines):
        counts = _quoted_counts(lines, first, separator, source)
    else:
        counts = [line.count(separator) + 1 for line in lines]
    expected = counts[0]
    for number, count in enumerate(counts, first):
        if count != expected and not lines[number - first].strip():
            n = sum(not line.strip() for line in lines)
            which = f"line {number} is blank, the first of {n}" if n > 1 else f"line {number} is blank"
            raise LogError(f"{source}: {which}; remove blank lines")
        if count != expected:
            above = _lines_above(lines)
            hint = f"; if the header is line {first + above}, pass --repair preamble" if above else ""
            raise LogError(f"{source}: line {number} has {count} fields, the header has {expected}{hint}")


def _quoted_counts(lines: list[str], first: int, separator: str, source: str) -> list[int]:
    """Number of fields of every record; separators in quotation marks do not count."""
    reader = csv.reader((line + "\n" for line in lines), delimiter=separator, strict=True)
    counts = []
    try:
        for number, record in enumerate(reader, first):
            if reader.line_num + first - 1 != number:
                raise LogError(f"{source}: line {number} has a line break in quotation marks; remove it")
            counts.append(len(record))
    except csv.Error as error:
        raise LogError(f"{source}: line {reader.line_num + first - 1} cannot be read ({error})") from error
    return counts


def _columns(
    lines: list[str], headers: Sequence[str], first: int, separator: str, source: str, repairs: Repairs
) -> Iterable[FloatArray | str | _Times]:
    """Numbers of every column from line ``first``, or its first field that is no number.

    A short file of plain numbers is read without Polars, whose import takes longer.
    """
    if separator == "," and len(lines) <= _FEW_LINES:
        with suppress(ValueError):  # some field is no plain number
            numbers = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
            return np.ascontiguousarray(numbers.T)
    frame = _frame(lines, len(headers), separator, source)
    return [
        _numbers(column, first, separator, f'"{header}"', repairs)
        for column, header in zip(frame.get_columns(), headers, strict=True)
    ]


def _frame(lines: list[str], n_columns: int, separator: str, source: str) -> pl.DataFrame:
    """Data frame with every field as text; columns are numbered, because Polars takes some names as patterns."""
    import polars as pl

    header = separator.join(map(str, range(n_columns)))
    data = io.BytesIO("\n".join([header, *lines]).encode())
    try:
        return pl.read_csv(data, separator=separator, infer_schema=False)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise LogError(f"{source}: it cannot be read as CSV ({str(error).splitlines()[0]})") from error


def _numbers(fields: pl.Series, first: int, separator: str, name: str, repairs: Repairs) -> FloatArray | str | _Times:
    """Numbers of a column of text from line ``first``, empty fields as NaN, or the first field that is no number.

    Semicolons allow decimal commas.
    """
    import polars as pl

    text = fields.str.strip_chars()
    readable = text.str.replace(",", ".", literal=True) if separator == ";" else text
    numbers = readable.cast(pl.Float64, strict=False)
    missing = text.str.to_lowercase().is_in(("", "na", "n/a", "nan", "null", "none"))
    bad = (numbers.is_null() & text.is_not_null() & ~missing).to_numpy()
    if bad.any():
        row, n = int(bad.argmax()), int(bad.sum())
        reason = f'is not numeric: line {row + first} holds "{text[row]:.60}"'
        seconds = _seconds(text)
        if "timestamps" in repairs and seconds is not None:
            repairs.record("timestamps", f"{name} holds times from {text[0]:.40} on")
            return seconds
        if seconds is not None:
            return _Times(seconds, reason)
        if "cells" not in repairs or are_many(n, len(bad)):
            return reason
        repairs.record("cells", f'{name} has {n} field{"s" * (n > 1)} without a number, the first "{text[row]:.30}"')
    return numbers.fill_null(np.nan).to_numpy().astype(np.float64)


def _seconds(text: pl.Series) -> FloatArray | None:
    """Seconds (n,) since the first of ISO 8601 times; None where one of them is none."""
    if not _ISO.fullmatch(text[0] or ""):
        return None
    matches = [_ISO.fullmatch(x) for x in text.fill_null("")]
    found = [m for m in matches if m is not None]
    if len(found) < len(matches) or not found:
        return None
    try:
        stamps = np.array([f"{m['date']}T{m['clock'].replace(',', '.')}" for m in found], dtype="datetime64[ns]")
    except ValueError:  # a thirteenth month
        return None
    zones = np.array([_zone(m["zone"] or "Z") for m in found], dtype=np.int64)
    since = stamps.astype(np.int64) - 60_000_000_000 * zones
    return np.asarray((since - since[0]) / 1e9)


def _zone(text: str) -> int:
    """Minutes that a time zone is ahead of UTC."""
    if text == "Z":
        return 0
    minutes = 60 * int(text[1:3]) + int(text[-2:])
    return -minutes if text[0] == "-" else minutes


def _notes(named: list[tuple[str, str | None]], separator: str) -> list[str]:
    notes = []
    if separator != ",":
        notes.append(f"fields are separated by a {_SEPARATORS[separator]}")
    unnamed = sum(not name for name, _ in named)
    if unnamed:
        notes.append(f"{unnamed} column{'s' * (unnamed > 1)} without a name left out")
    return notes
