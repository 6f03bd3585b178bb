"""CSV text, plain or compressed by gzip: one header line, then one line per row."""

from __future__ import annotations

import csv
import gzip
import io
import zlib
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.files import COMMENT
from diransac.data.readers.table import Table, check_unique, with_metadata
from diransac.data.units import split_unit
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Iterable

    import polars as pl

__all__ = ["read_csv", "read_csv_gz"]

_SEPARATORS = {",": "comma", ";": "semicolon", "\t": "tab"}
_FEW_LINES = 20_000
_MISSING = ("", "na", "n/a", "nan", "null", "none")


def read_csv_gz(data: bytes, source: str) -> Table:
    """Table of gzip data.  Raises LogError: as `read_csv`; the data are not gzip, or are cut off."""
    try:
        return read_csv(gzip.decompress(data), source)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise LogError(f"{source}: the gzip data are damaged or cut off ({error})") from error


def read_csv(data: bytes, source: str) -> Table:
    """Table of CSV text.

    Raises LogError: the data are not UTF-8 text with a header line and as many fields in every line.
    """
    lines = _text(data, source).split("\n")
    metadata = lines.pop(0).strip('"').removeprefix(COMMENT) if _is_metadata(lines[0]) else None
    if not lines:
        raise LogError(f"{source}: there is no header line after the metadata; give one, and one line per row")
    line = 1 if metadata is None else 2
    separator = _separator(lines[0])
    headers = _header(lines[0], separator, source)
    _check_ragged(lines, line, separator, source)
    if len(lines) == 1:
        raise LogError(f"{source}: there is a header ({', '.join(headers)[:200]}) but no row")
    named = [split_unit(header) for header in headers]
    check_unique([name for name, _ in named if name], source)
    fields = zip(named, _columns(lines[1:], len(headers), line + 1, separator, source), strict=True)
    columns = {name: column for (name, _), column in fields if name}
    units = {name: unit for name, unit in named if unit is not None}
    table = Table(columns, units, tuple(_notes(named, separator)))
    return table if metadata is None else with_metadata(table, metadata, source, "remove its first line")


def _is_metadata(line: str) -> bool:
    """True for a first line with metadata, also between the quotation marks that spreadsheets put around it."""
    return line.lstrip('"').startswith(COMMENT)


def _text(data: bytes, source: str) -> str:
    """Decoded text whose lines are separated by single line feeds."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LogError(
            f"{source}: it is not UTF-8 text (byte 0x{data[error.start]:02x} at offset {error.start}); save it as UTF-8"
        ) from error
    if "\0" in text:
        raise LogError(f"{source}: it holds binary data, not text")
    text = text.replace("\r\n", "\n").replace("\r", "\n").strip("\n")
    if not text.strip():
        raise LogError(f"{source}: it is empty; give a header line and one line per row")
    return text


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
        raise LogError(f"{source}: the first line holds numbers ({line:.60}); give it a header line with names")
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
        counts = [(number, line.count(separator) + 1) for number, line in enumerate(lines, first)]
    expected = counts[0][1]
    for number, count in counts:
        if count != expected and not lines[number - first].strip():
            n = sum(not line.strip() for line in lines)
            which = f"line {number} is blank, the first of {n}" if n > 1 else f"line {number} is blank"
            raise LogError(f"{source}: {which}; remove blank lines")
        if count != expected:
            raise LogError(f"{source}: line {number} has {count} fields, the header has {expected}")


def _quoted_counts(lines: list[str], first: int, separator: str, source: str) -> list[tuple[int, int]]:
    """Line number and number of fields of every record; separators in quotation marks do not count."""
    reader = csv.reader((line + "\n" for line in lines), delimiter=separator, strict=True)
    counts = []
    try:
        for number, record in enumerate(reader, first):
            if reader.line_num + first - 1 != number:
                raise LogError(f"{source}: line {number} has a line break in quotation marks; remove it")
            counts.append((number, len(record)))
    except csv.Error as error:
        raise LogError(f"{source}: line {reader.line_num + first - 1} cannot be read ({error})") from error
    return counts


def _columns(lines: list[str], n_columns: int, first: int, separator: str, source: str) -> Iterable[FloatArray | str]:
    """Numbers of every column from line ``first``, or its first field that is no number.

    A short file of plain numbers is read without Polars, whose import takes longer.
    """
    if separator == "," and len(lines) <= _FEW_LINES:
        with suppress(ValueError):  # some field is no plain number
            numbers = np.loadtxt(lines, delimiter=",", ndmin=2, comments=None)
            return np.ascontiguousarray(numbers.T)
    frame = _frame(lines, n_columns, separator, source)
    return [_numbers(column, first, separator) for column in frame.get_columns()]


def _frame(lines: list[str], n_columns: int, separator: str, source: str) -> pl.DataFrame:
    """Data frame with every field as text; columns are numbered, because Polars takes some names as patterns."""
    import polars as pl

    header = separator.join(map(str, range(n_columns)))
    data = io.BytesIO("\n".join([header, *lines]).encode())
    try:
        return pl.read_csv(data, separator=separator, infer_schema=False)
    except (pl.exceptions.PolarsError, pl.exceptions.PanicException) as error:
        raise LogError(f"{source}: it cannot be read as CSV ({str(error).splitlines()[0]})") from error


def _numbers(fields: pl.Series, first: int, separator: str) -> FloatArray | str:
    """Numbers of a column of text from line ``first``, empty fields as NaN, or the first field that is no number.

    Semicolons allow decimal commas.
    """
    import polars as pl

    text = fields.str.strip_chars()
    readable = text.str.replace(",", ".", literal=True) if separator == ";" else text
    numbers = readable.cast(pl.Float64, strict=False)
    bad = (numbers.is_null() & text.is_not_null() & ~text.str.to_lowercase().is_in(_MISSING)).to_numpy()
    if bad.any():
        row = int(bad.argmax())
        return f'is not numeric: line {row + first} holds "{text[row]:.60}"'
    return numbers.fill_null(np.nan).to_numpy().astype(np.float64)


def _notes(named: list[tuple[str, str | None]], separator: str) -> list[str]:
    notes = []
    if separator != ",":
        notes.append(f"fields are separated by a {_SEPARATORS[separator]}")
    unnamed = sum(not name for name, _ in named)
    if unnamed:
        notes.append(f"{unnamed} column{'s' * (unnamed > 1)} without a name left out")
    return notes
