"""`Reading`: arguments with which a log was read, for a further log of the same recorder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from diransac.data import preprocessing
from diransac.errors import LogError

if TYPE_CHECKING:
    from diransac.data.log import Log
    from diransac.data.mapping import LogMapping
    from diransac.data.readers.table import Table

__all__ = ["Reading"]


@dataclass(frozen=True)
class Reading:
    """Arguments of `read_log`, and delays and spikes, by the history of a log; empty without one.

    Parameters
    ----------
    mapping : LogMapping, optional
    columns : tuple of str, optional
    rate : float, optional
    repairs : tuple of str, optional
    rename : mapping of str to str
    scale, units : mapping of str to float, mapping of str to str
        Factors, and the units of the columns that had them.
    resample : float, optional
    shift : mapping of str to float
    despike : tuple of str
    unmeasured : tuple of str
    """

    mapping: LogMapping | None = None
    columns: tuple[str, ...] | None = None
    rate: float | None = None
    repairs: tuple[str, ...] | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    resample: float | None = None
    shift: Mapping[str, float] = field(default_factory=dict)
    despike: tuple[str, ...] = ()
    unmeasured: tuple[str, ...] = ()

    @classmethod
    def of(cls, history: Iterable[Mapping[str, Any]]) -> Reading:
        """The reading of a log with a history; what a mapping file does is done by the mapping.

        Raises LogError: the history is damaged, or a mapping in it.
        """
        found: dict[str, Any] = {}
        for step in history:
            try:
                found |= _ARGUMENTS.get(step["step"], lambda _: {})(step)
            except (KeyError, TypeError) as error:
                raise LogError(f"a step of the history is damaged: {step!r:.80}; give the options again") from error
        mapping = found.get("mapping")
        return cls(
            **{name: x for name, x in found.items() if name == "mapping" or not mapping or not mapping.option(name)}
        )

    def names(self, table: Table, given: Mapping[str, str]) -> dict[str, str]:
        """New names of a table's columns: the given ones, and those of this reading that it has."""
        free = [name for name in table.columns if name not in given.values()]
        own = {new: old for new, old in self.rename.items() if old in free and new not in table.columns}
        return {**own, **given}

    def factors(self, table: Table, given: Mapping[str, float]) -> dict[str, float]:
        """Factors of a renamed table's columns: the given ones, and those of this reading for columns of its units."""
        columns, units = table.columns, table.units
        own = {n: x for n, x in self.scale.items() if n in columns and units.get(n) == self.units.get(n)}
        return {**own, **given}

    def prepared(self, log: Log) -> Log:
        """The log without spikes and with delays, as far as it has such signals."""
        spiky = [name for name in self.despike if name in log]
        delays = {name: x for name, x in self.shift.items() if name in log}
        log = preprocessing.despike(log, spiky) if spiky else log
        return preprocessing.shift(log, delays) if delays else log


def _mapped(step: Mapping[str, Any]) -> dict[str, Any]:
    """Mapping and new names of a step of a mapping."""
    from diransac.data.mapping import parse_mapping

    text = step.get("text")
    found = {} if text is None else {"mapping": parse_mapping(text, step["mapping"])}
    return {**found, "rename": dict(step.get("renamed", {}))}


def _factors(step: Mapping[str, Any]) -> dict[str, Any]:
    return {"scale": dict(step["factors"]), "units": dict(step.get("units", {}))}


def _names(step: Mapping[str, Any]) -> Sequence[str]:
    return tuple(step["names"])


_ARGUMENTS: dict[str, Any] = {
    "columns": lambda step: {"columns": _names(step)},
    "clock": lambda step: {"rate": step["rate"]},
    "rename": lambda step: {"rename": dict(step["names"])},
    "map": _mapped,
    "scale": _factors,
    "repair": lambda step: {"repairs": tuple(step["repairs"])},
    "resample": lambda step: {"resample": step["rate"]},
    "despike": lambda step: {"despike": tuple(step["replaced"])},
    "unmeasured": lambda step: {"unmeasured": tuple(step["signals"])},
    "shift": lambda step: {"shift": dict(step["delays"])},
}
"""Arguments by the name of a step."""
