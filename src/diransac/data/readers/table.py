"""What a file holds before it is a log: columns of numbers by name, and why other columns are none."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.data.checks import as_numbers
from diransac.data.units import split_unit
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["Table", "check_unique", "table_of_arrays"]


@dataclass(frozen=True)
class Table:
    """Columns of a file.

    Parameters
    ----------
    columns : name -> (n,) numbers, or why the column has none, such as ``is not numeric: line 3 holds "takeoff"``
    units : name -> unit that the header states
    notes : what was found while reading
    """

    columns: Mapping[str, FloatArray | str]
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def check_unique(names: Sequence[str], source: str) -> None:
    """Raise LogError where two columns have one name."""
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise LogError(
            f'{source}: {names.count(repeated[0])} columns are called "{repeated[0]}"; give each its own name'
        )


def table_of_arrays(arrays: Mapping[str, npt.NDArray[Any]], source: str) -> Table:
    """Named arrays as a table: a row or column vector is a column, a matrix ``q (n, k)`` columns ``q_1`` to ``q_k``.

    Raises LogError: two columns come to have one name.
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
