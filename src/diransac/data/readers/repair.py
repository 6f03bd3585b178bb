"""Repairs of faults for which a log is refused otherwise; each is asked for by name, counted and recorded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.data.readers.recording import Samples
from diransac.data.units import conversion
from diransac.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from diransac.data.readers.table import Table

REPAIRS = {
    "comments": "comments and blank lines of CSV text are left out",
    "preamble": "lines of CSV text above its header are left out",
    "rows": "lines of CSV text with too few or too many fields are left out, up to 1 in 100",
    "timestamps": "columns of ISO 8601 times become seconds since the first",
    "cells": "fields that hold no number are missing samples, up to 1 in 100 of a column",
    "units": "degrees, milliseconds and the like become SI units",
    "sort": "rows are sorted by time",
    "duplicates": "of rows with one time, the first is kept",
    "clock": "an uneven clock is resampled at its median rate",
}
"""Names of the repairs, and what each does; all of them are done by ``repair=True``."""


@dataclass
class Repairs:
    """Repairs that may be done, and those that were.

    Parameters
    ----------
    allowed : frozenset of str
        Keys of `REPAIRS`.
    done : dict of str to str
        Repair -> what it changed, a sentence.
    """

    allowed: frozenset[str] = frozenset()
    done: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, repair: bool | str | Iterable[str] | None) -> Repairs:
        """Repairs of an argument: True or "safe" for all.  Raises SettingsError: there is no repair of that name."""
        if repair is None or repair is False:
            return cls()
        if repair is True or repair == "safe":
            return cls(frozenset(REPAIRS))
        names = [x.strip() for x in repair.split(",")] if isinstance(repair, str) else list(repair)
        unknown = [name for name in names if name not in REPAIRS]
        if unknown:
            raise SettingsError(f'there is no repair "{unknown[0]}"; there are {", ".join(REPAIRS)}, and safe for all')
        return cls(frozenset(names))

    def __contains__(self, name: str) -> bool:
        return name in self.allowed

    def record(self, name: str, sentence: str) -> None:
        """Remember a repair that was done; a second sentence is added to the first."""
        self.done[name] = f"{self.done[name]}; {sentence}" if name in self.done else sentence

    @property
    def step(self) -> dict[str, Any] | None:
        """Step of a log's history; None where nothing was done."""
        return {"step": "repair", "repairs": dict(self.done)} if self.done else None

    @property
    def notes(self) -> list[str]:
        """A sentence for each repair that was done."""
        return [f"repaired ({name}): {sentence}" for name, sentence in self.done.items()]

    def ordered(self, samples: Samples, topic: str) -> Samples:
        """Samples whose time increases, as far as these repairs may see to it."""
        where = f' of "{topic}"' if topic else ""
        time = samples.time
        if "sort" in self and len(time) > 1 and (np.diff(time) < 0.0).any():
            n = int((np.diff(time) < 0.0).sum())
            samples = samples.select(np.argsort(time, kind="stable"))
            self.record("sort", f"time{where} ran backwards {n} time{'s' * (n > 1)}")
        time = samples.time
        if "duplicates" in self and len(time) > 1 and (np.diff(time) == 0.0).any():
            kept = np.r_[True, np.diff(time) != 0.0]
            samples = samples.select(np.flatnonzero(kept))
            self.record("duplicates", f"{(~kept).sum()} of {len(kept)} rows{where} repeated a time")
        return samples

    def in_si(self, table: Table) -> Table:
        """Table with its columns in SI units, where their units are known."""
        if "units" not in self:
            return table
        known = ("s", "m", "m/s", "m/s^2", "rad", "rad/s", "rad/s^2", "N", "N m", "V", "A", "kg")
        columns, units, changed = dict(table.columns), dict(table.units), []
        for name, unit in table.units.items():
            target = next((x for x in known if conversion(unit, x) is not None), None)
            column = columns.get(name)
            if unit == "g" or target is None or column is None or isinstance(column, str):
                continue
            factor = conversion(unit, target)
            if factor is not None and factor != 1.0:
                columns[name], units[name] = column * factor, target
                changed.append(f"{name} from {unit} to {target}")
        if changed:
            self.record("units", ", ".join(changed))
        return replace(table, columns=columns, units=units)
