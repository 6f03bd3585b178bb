"""Files of logs: columns that read back exactly, and beside them one JSON object, the metadata.

The metadata hold what the columns cannot: units, filter specification, history, notes, and the reasons why columns were
left out.  Their place in a file cannot be taken by a signal, whatever its name:

========  =========================================================================================
format    place
========  =========================================================================================
CSV       a first line ``# diransac: {...}``, which ``pandas.read_csv(..., comment="#")`` skips
Parquet   the key ``diransac`` of the file's key-value metadata
NPZ       the archive's member ``diransac.json``; members of arrays end in ``.npy``
========  =========================================================================================

A log without any of it is written without metadata.
"""

from __future__ import annotations

import gzip
import io
import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.atomic import write_with
from diransac.data.filters import FilterSpecification
from diransac.errors import LogError, SettingsError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

__all__ = ["COMMENT", "ENDINGS", "KEY", "MEMBER", "Metadata", "decode_metadata", "write_columns"]


KEY, MEMBER, COMMENT = "diransac", "diransac.json", "# diransac:"
"""Place of the metadata in a Parquet file, in an NPZ archive and in CSV text."""

_VERSION = 1


@dataclass(frozen=True)
class Metadata:
    """Facts about a log that its columns cannot hold; the fields are those of `Log`."""

    units: Mapping[str, str] = field(default_factory=dict)
    filter: FilterSpecification | None = None
    history: tuple[dict[str, Any], ...] = ()
    notes: tuple[str, ...] = ()
    unusable: Mapping[str, str] = field(default_factory=dict)

    def encode(self) -> str:
        """ASCII JSON in one line, with numbers that read back exactly; empty text where there is nothing to say.

        Raises LogError: a step of the history holds what JSON cannot.
        """
        facts = {
            "units": dict(self.units),
            "filter": None if self.filter is None else self.filter.as_dict(),
            "history": list(self.history),
            "notes": list(self.notes),
            "unusable": dict(self.unusable),
        }
        present = {name: fact for name, fact in facts.items() if fact}
        try:
            return json.dumps({"version": _VERSION, **present}) if present else ""
        except (TypeError, ValueError, RecursionError) as error:
            raise LogError(f"the log's history cannot be written as JSON: {error}") from error


def decode_metadata(text: str | bytes, source: str, remedy: str) -> Metadata:
    """The metadata that `Metadata.encode` wrote.

    Raises LogError: they are damaged, or of a later version; the message ends with the remedy.
    """
    from diransac.plain_data import json_data

    try:
        facts = json_data(text)
        version = facts.get("version")
        if version == _VERSION:
            return _metadata(facts)
    except (ValueError, TypeError, AttributeError, KeyError, OverflowError, RecursionError, SettingsError) as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise LogError(f"{source}: its diransac metadata are damaged ({why:.120}); {remedy}") from error
    raise LogError(
        f"{source}: its diransac metadata are of version {version!s:.20}, this diransac reads version {_VERSION}; "
        f"update diransac, or {remedy}"
    )


def _metadata(facts: Mapping[str, Any]) -> Metadata:
    """Checked facts.  Raises ValueError and the like: one of them has not the type that it should have."""
    filtered = facts.get("filter")
    history = tuple(dict(step) for step in facts.get("history", ()))
    if not all(isinstance(step.get("step"), str) for step in history):
        raise ValueError("a step of the history has no name")
    return Metadata(
        units=_texts(facts.get("units", {})),
        filter=None if filtered is None else FilterSpecification.from_dict(filtered),
        history=history,
        notes=tuple(_texts(dict(enumerate(facts.get("notes", ())))).values()),
        unusable=_texts(facts.get("unusable", {})),
    )


def _texts(found: Mapping[Any, str]) -> dict[Any, str]:
    if not all(isinstance(text, str) for text in dict(found).values()):
        raise ValueError("a number stands where a text belongs")
    return dict(found)


# ---------------------------------------------------------------------- writing


def write_columns(path: Path, columns: Mapping[str, FloatArray], metadata: Metadata | None = None) -> None:
    """Write columns and metadata to ``.csv``, ``.csv.gz``, ``.parquet`` or ``.npz``.

    Raises LogError: another ending, or the file cannot be written; an existing file is then untouched.
    """
    endings = [ending for ending in _WRITERS if path.name.lower().endswith(ending)]
    if not endings:
        raise LogError(f'cannot write "{path}": its ending is not known; use one of {", ".join(_WRITERS)}')
    text = "" if metadata is None else metadata.encode()
    try:
        write_with(path, lambda file: _WRITERS[endings[0]](columns, text, file))
    except OSError as error:
        raise LogError(f'cannot write "{path}": {error.strerror or error}') from error


def _csv(columns: Mapping[str, FloatArray], metadata: str) -> bytes:
    import polars as pl

    first = f"{COMMENT} {metadata}\n" if metadata else ""
    return (first + pl.DataFrame(dict(columns)).write_csv()).encode()


def _write_csv(columns: Mapping[str, FloatArray], metadata: str, file: Path) -> None:
    file.write_bytes(_csv(columns, metadata))


def _write_csv_gz(columns: Mapping[str, FloatArray], metadata: str, file: Path) -> None:
    with (
        file.open("wb") as packed,
        gzip.GzipFile(fileobj=packed, mode="wb", filename="", mtime=0, compresslevel=6) as unpacked,
    ):
        unpacked.write(_csv(columns, metadata))


def _write_parquet(columns: Mapping[str, FloatArray], metadata: str, file: Path) -> None:
    import polars as pl

    memory = io.BytesIO()  # Polars' own errors of a full disk are no OSError
    pl.DataFrame(dict(columns)).write_parquet(memory, metadata={KEY: metadata} if metadata else None)
    file.write_bytes(memory.getbuffer())


def _write_npz(columns: Mapping[str, FloatArray], metadata: str, file: Path) -> None:
    import zipfile

    with zipfile.ZipFile(file, "w") as archive:
        for name, values in columns.items():
            with archive.open(zipfile.ZipInfo(f"{name}.npy"), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, values, allow_pickle=False)
        if metadata:
            archive.writestr(zipfile.ZipInfo(MEMBER), metadata)


_WRITERS = {".csv": _write_csv, ".csv.gz": _write_csv_gz, ".parquet": _write_parquet, ".npz": _write_npz}
ENDINGS = tuple(_WRITERS)
"""Endings of the files that `write_columns` writes."""
