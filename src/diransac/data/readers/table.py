"""`Table`: the contents of a file before they are checked as a log."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.data.checks import as_numbers
from diransac.data.files import decode_metadata
from diransac.data.filters import FilterSpecification
from diransac.data.units import split_unit
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["LARGEST", "Table", "check_unique", "table_of_arrays", "with_metadata"]

LARGEST = 1 << 31
"""Bytes that a compressed file may unpack to, 2 GiB."""


@dataclass(frozen=True)
class Table:
    """Columns of a file.

    Parameters
    ----------
    columns : mapping of str to (n,) array or str
        Numbers, or the reason why a column has none, such as ``is not numeric: line 3 holds "takeoff"``.
    units : mapping of str to str
        Units in headers and metadata.
    notes : tuple of str
        Findings of the reader, a sentence each.
    history, filter
        Those of the log that was written to the file, as in `Log`.
    is_described : bool
        True with the metadata of a log.
    """

    columns: Mapping[str, FloatArray | str]
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    history: tuple[dict[str, Any], ...] = ()
    filter: FilterSpecification | None = None
    is_described: bool = False

    def with_step(self, step: Mapping[str, Any]) -> Table:
        """The table with one more step in its history."""
        return replace(self, history=(*self.history, dict(step)))


def with_metadata(table: Table, text: str | bytes, source: str, remedy: str = "write the log again") -> Table:
    """Table completed by the metadata of its file; units in headers, which an editor may have changed, prevail.

    Raises LogError: the metadata are damaged.
    """
    facts = decode_metadata(text, source, remedy)
    return replace(
        table,
        columns={**table.columns, **{name: why for name, why in facts.unusable.items() if name not in table.columns}},
        units={**facts.units, **table.units},
        notes=(*facts.notes, *table.notes),
        history=facts.history,
        filter=facts.filter,
        is_described=True,
    )


def check_unique(names: Sequence[str], source: str) -> None:
    """Raise LogError if two columns have one name."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise LogError(
            f'{source}: {names.count(repeated[0])} columns are called "{repeated[0]}"; give each its own name'
        )


def table_of_arrays(arrays: Mapping[str, npt.NDArray[Any]], source: str) -> Table:
    """Table of named arrays: a vector is one column, a matrix ``q (n, k)`` the columns ``q_1`` to ``q_k``.

    Raises LogError: two columns would have one name.
    """
    headers = [split_unit(name) for name in arrays]
    pieces = [piece for (name, _), x in zip(headers, arrays.values(), strict=True) for piece in _pieces(name, x)]
    check_unique([name for name, _ in pieces], source)
    return Table(dict(pieces), {name: unit for name, unit in headers if unit is not None})


def _pieces(name: str, array: npt.NDArray[Any]) -> list[tuple[str, FloatArray | str]]:
    if array.ndim == 2 and 1 not in array.shape:
        return [(f"{name}_{k + 1}", as_numbers(array[:, k])) for k in range(array.shape[1])]
    if array.ndim > 2:
        return [(name, f"has {array.ndim} dimensions: {array.shape}")]
    return [(name, as_numbers(array.ravel()))]
