"""The column that holds the time of a table, by its name, and the unit of its stamps."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.units import conversion
from diransac.errors import LogError

if TYPE_CHECKING:
    from collections.abc import Container, Mapping

    from diransac.data.readers.table import Table

__all__ = ["seconds", "time_column", "unit_of_name"]

_UNITS = {
    "s": ("s", "sec", "secs", "seconds"),
    "ms": ("ms", "msec", "millis", "milliseconds"),
    "us": ("us", "usec", "micros", "microseconds"),
    "ns": ("ns", "nsec", "nanos", "nanoseconds"),
}
_UNIT_OF_ENDING = {ending: unit for unit, endings in _UNITS.items() for ending in endings}
_ENDING = "|".join(_UNIT_OF_ENDING)
_NAME = re.compile(
    rf"(?:t[ _.-]|(?i:time|time[ _.-]?stamps?|stamp)[ _.-]?)(?P<unit>(?i:{_ENDING}))|(?i:time|time[ _]?stamps?|stamp)"
)


def time_column(table: Table, taken: Container[str]) -> str | None:
    """Name of the one column that a table can have as its time; None without one, and where it has ``t``.

    Parameters
    ----------
    table : Table
    taken : container of str
        Columns that are something else.
    """
    if "t" in table.columns:
        return None
    numeric = [name for name, x in table.columns.items() if isinstance(x, np.ndarray)]
    for kind in (numeric, table.times):
        found = [name for name in kind if _NAME.fullmatch(name) and name not in taken]
        if found:
            return found[0] if len(found) == 1 else None
    return None


def unit_of_name(name: str) -> str | None:
    """Unit at the end of the name of a time column, such as that of ``t_ms``; None without one."""
    match = _NAME.fullmatch(name)
    return _UNIT_OF_ENDING[match["unit"].lower()] if match and match["unit"] else None


def seconds(table: Table, factors: Mapping[str, float], source: str) -> tuple[FloatArray, str]:
    """Column ``t`` (N,) of a table in seconds, and a sentence on a conversion from its unit, empty without one.

    Raises LogError: there is no such column, or it holds no numbers.
    """
    if "t" not in table.columns:
        found = ", ".join(table.columns)
        rate = "" if any(map(_NAME.fullmatch, table.columns)) else ", or give the rate of a log without one: --rate HZ"
        raise LogError(f'{source}: there is no time column "t"; found {found}. Say which one it is: --map t=NAME{rate}')
    time = table.columns["t"]
    if isinstance(time, str):
        raise LogError(f'{source}: the time column "t" {time}')
    if "t" in factors:
        return time * factors["t"], ""
    unit = table.units.get("t", "s")
    factor = conversion(unit, "s")
    if factor in (None, 1.0):
        return time, ""
    return time * factor, f"the time is converted from {unit} to s"
