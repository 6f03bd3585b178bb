"""Files of logs: columns that read back exactly, and beside them one JSON object, the metadata.

The metadata hold what the columns cannot: units, filter specification, history, notes, and the reasons why columns were
left out.  Their place in a file cannot be taken by a signal, whatever its name:

========  =========================================================================================
format    place
========  =========================================================================================
CSV       the file ``NAME.csv-metadata.json`` beside it, as CSV on the Web of the W3C has it
Parquet   the key ``diransac`` of the file's key-value metadata
NPZ       the archive's member ``diransac.json``; members of arrays end in ``.npy``
========  =========================================================================================

A log without any of it is written without metadata.  Earlier versions wrote those of CSV text into a first line
``# diransac: {...}``, which is still read.
"""

from __future__ import annotations

import gzip
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.atomic import draft
from diransac.data.filters import FilterSpecification
from diransac.errors import LogError, SettingsError

KEY, MEMBER, COMMENT = "diransac", "diransac.json", "# diransac:"
"""Place of the metadata in a Parquet file, in an NPZ archive and, of earlier versions, in CSV text."""
_VERSION, _UNIT = 1, "schema:unitText"


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


def place_of_metadata(table: Path) -> Path:
    """The file beside a CSV file that describes it."""
    return table.with_name(table.name + "-metadata.json")


def put_in_place(written: Path, target: Path) -> None:
    """Replace a table and the metadata beside it by those that were written elsewhere in the same file system.

    A table is never found beside the metadata of another one.
    """
    if not target.name.lower().endswith(_TEXTS):
        written.replace(target)
        return
    old, new, aside = (place_of_metadata(x) for x in (target, written, written.with_name("previous")))
    if old.exists():
        old.replace(aside)
    try:
        written.replace(target)
    except OSError:
        if aside.exists():
            aside.replace(old)
        raise
    if new.exists():
        new.replace(old)


def _csv_on_the_web(table: Path, columns: Sequence[str], metadata: str) -> str:
    """JSON that describes a CSV file: its columns with their units, and all other metadata as a note."""
    facts = json.loads(metadata)
    units = {"t": "s", **facts.pop("units", {})}
    described = [
        {"titles": name, "datatype": "number", **({_UNIT: units[name]} if name in units else {})} for name in columns
    ]
    content = {
        "@context": "http://www.w3.org/ns/csvw",
        "url": table.name,
        "tableSchema": {"columns": described},
        "notes": [{KEY: facts}],
    }
    return json.dumps(content, indent=1)


def _of_csv_on_the_web(content: Mapping[str, Any]) -> dict[str, Any]:
    """Facts in the description of a CSV file, which may be that of another tool."""
    columns = content.get("tableSchema", {}).get("columns", [])
    titled = {x["titles"]: x[_UNIT] for x in columns if _UNIT in x and isinstance(x.get("titles"), str)}
    own = [x[KEY] for x in content.get("notes", []) if isinstance(x, dict) and KEY in x]
    units = {name: unit for name, unit in titled.items() if name != "t"}
    return {"version": _VERSION, **(own[0] if own else {}), "units": units}


def decode_metadata(text: str | bytes, source: str, remedy: str) -> Metadata:
    """The metadata that `Metadata.encode` wrote, or that stand beside a CSV file.

    Raises LogError: they are damaged, or of a later version; the message ends with the remedy.
    """
    from diransac.plain_data import json_data

    try:
        found = json_data(text)
        facts = _of_csv_on_the_web(found) if isinstance(found, dict) and "@context" in found else found
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
        with draft(path) as written:
            _WRITERS[endings[0]](columns, text, written)
            if text and endings[0] in _TEXTS:
                described = _csv_on_the_web(path, list(columns), text)
                place_of_metadata(written).write_text(described, encoding="utf-8")
            if path.exists():
                written.chmod(path.stat().st_mode)
            put_in_place(written, path)
    except OSError as error:
        raise LogError(f'cannot write "{path}": {error.strerror or error}') from error


def _csv(columns: Mapping[str, FloatArray]) -> bytes:
    import polars as pl

    return pl.DataFrame(dict(columns)).write_csv().encode()


def _write_csv(columns: Mapping[str, FloatArray], _: str, file: Path) -> None:
    file.write_bytes(_csv(columns))


def _write_csv_gz(columns: Mapping[str, FloatArray], _: str, file: Path) -> None:
    with (
        file.open("wb") as packed,
        gzip.GzipFile(fileobj=packed, mode="wb", filename="", mtime=0, compresslevel=6) as unpacked,
    ):
        unpacked.write(_csv(columns))


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
_TEXTS = (".csv", ".csv.gz")
ENDINGS = tuple(_WRITERS)
"""Endings of the files that `write_columns` writes."""
