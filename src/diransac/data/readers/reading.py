"""`Reading`: from the contents of a file to a log, by arguments or by the history of a log of the same recorder."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data import preprocessing
from diransac.data.checks import check_clock, check_names
from diransac.data.clock import Aligned, in_order, is_even, on_own_grid, runs_freely
from diransac.data.log import Log
from diransac.data.preprocessing.steps import check_factor, origins_of, rename_columns, resampled
from diransac.data.readers.recording import Recording, Samples
from diransac.data.readers.repair import Repairs
from diransac.data.readers.table import Table, seconds, time_column, unit_of_name
from diransac.data.units import split_unit
from diransac.errors import LogError, SettingsError

if TYPE_CHECKING:
    from diransac.data.mapping import LogMapping


@dataclass(frozen=True)
class Reading:
    """Arguments of `read_log`, and delays and spikes; None is not given.

    Parameters
    ----------
    mapping : LogMapping, optional
    columns : sequence of str, optional
    rate : float, optional
    repair : bool, str or iterable of str, optional
    rename : mapping of str to str
    scale, units : mapping of str to float, mapping of str to str
        Factors, and the units of the columns that had them.
    resample : float or str, optional
    unwrap, shift : mapping of str to float
    despike : tuple of str
    unmeasured : iterable of str, optional
    """

    mapping: LogMapping | None = None
    columns: Sequence[str] | None = None
    rate: float | None = None
    repair: bool | str | Iterable[str] | None = None
    rename: Mapping[str, str] = field(default_factory=dict)
    scale: Mapping[str, float] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    resample: float | str | None = None
    unwrap: Mapping[str, float] = field(default_factory=dict)
    shift: Mapping[str, float] = field(default_factory=dict)
    despike: tuple[str, ...] = ()
    unmeasured: Iterable[str] | None = None

    @classmethod
    def given(cls, mapping: str | Path | None = None, **arguments: Any) -> Reading:
        """The reading by arguments of `read_log`.  Raises LogError: the mapping cannot be read."""
        loaded = None
        if mapping is not None:
            from diransac.data.mapping_file import load_mapping

            loaded = load_mapping(mapping)
        return cls(loaded, **{name: x for name, x in arguments.items() if x is not None})

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

    def log(
        self,
        opened_with: Callable[[Sequence[str] | None, Repairs], Table | Recording],
        source: str,
        like: Sequence[Mapping[str, Any]],
    ) -> Log:
        """Log of what is opened with the names of columns and the repairs, like one with a history.

        Raises LogError, SettingsError: as `read_log`.
        """
        earlier = Reading.of(like)
        columns = self._chosen("columns", earlier)
        repairs = Repairs.of(self._chosen("repair", earlier))
        opened = opened_with(columns, repairs)
        if isinstance(opened, Table):
            done = {step["step"] for step in opened.history}
            earlier = Reading.of(step for step in like if step["step"] not in done)
        table, resample = self._table(opened, earlier, columns, repairs, source)
        mapping, unmeasured = self._chosen("mapping", earlier), self._chosen("unmeasured", earlier)
        if unmeasured:
            table = table.with_step({"step": "unmeasured", "signals": list(unmeasured)})
        log = _log(table, {**earlier._factors(table), **self.scale}, resample, repairs, source)
        log = log if mapping is None else preprocessing.prepared(log, mapping.preparation)
        spiky = [name for name in earlier.despike if name in log]
        periods, delays = ({n: x for n, x in found.items() if n in log} for found in (earlier.unwrap, earlier.shift))
        return preprocessing.prepared(log, {"unwrap": periods, "despike": spiky or None, "shift": delays})

    def part(
        self, opened: Table, source: str, like: Sequence[Mapping[str, Any]]
    ) -> tuple[dict[str, FloatArray], dict[str, str]]:
        """Columns of a part of a table that grows, with its time ``t`` in seconds, and their units.

        Nothing is repaired or resampled, and no step of a preparation is done.

        Raises LogError, SettingsError: as `read_log`; the time is that of a calendar.
        """
        earlier = Reading.of(like)
        table, _ = self._table(opened, earlier, self._chosen("columns", earlier), Repairs(), source)
        if opened.times and not table.times:
            raise LogError(f"{source}: its time is that of a calendar, which cannot be followed; give seconds")
        table = table.scaled({**earlier._factors(table), **self.scale})
        time, _ = seconds(table, source)
        signals, _ = _signals(table, len(time), source)
        return {"t": time, **signals}, {name: unit for name, unit in table.units.items() if name in signals}

    def topics(self, like: Sequence[Mapping[str, Any]]) -> tuple[LogMapping | None, dict[str, str]]:
        """Mapping, and new names by ``topic.field``, of a recording."""
        earlier = Reading.of(like)
        return self._chosen("mapping", earlier), {**earlier.rename, **self.rename}

    def _table(
        self,
        opened: Table | Recording,
        earlier: Reading,
        columns: Sequence[str] | None,
        repairs: Repairs,
        source: str,
    ) -> tuple[Table, float | str | None]:
        """Table of the signals, with the time ``t``, and the resampling that is left to do."""
        mapping, resample = self._chosen("mapping", earlier), self._chosen("resample", earlier)
        if isinstance(opened, Table):
            opened = opened if columns is None else opened.with_step({"step": "columns", "names": list(columns)})
            table = repairs.in_si(_with_clock(opened, self._chosen("rate", earlier), source))
            # Without the unit that the header of a column may have.
            new_names = {n: old if old in table.columns else split_unit(old)[0] for n, old in self.rename.items()}
            rename = {**earlier._names(table, new_names.values()), **new_names}
            if mapping is None or mapping.time_column is None:
                rename = _with_time(rename, table)
                table = table.with_time_of(rename.get("t", "t"))
            else:
                table = table.with_time_of(mapping.time_column)
        else:
            from diransac.data.readers.topics import is_one_table, table_of_topics, whole_topic

            rename = {**earlier.rename, **self.rename}
            if mapping is None and is_one_table(opened, rename):
                table = whole_topic(opened, repairs)
            else:
                table, resample = table_of_topics(opened, mapping, rename, resample, repairs)
                rename = {}
        table = _renamed(table, rename, source) if rename else table
        if mapping is not None and isinstance(opened, Table):
            from diransac.data.readers.topics import mapped_table

            table = mapped_table(table, mapping, source)
        return table, resample

    def _chosen(self, name: str, earlier: Reading) -> Any:
        """An argument, else that of an earlier reading, else what the mapping says."""
        found = getattr(self, name) if getattr(self, name) is not None else getattr(earlier, name)
        if found is not None or name == "mapping":
            return found
        mapping: LogMapping | None = self._chosen("mapping", earlier)
        return None if mapping is None else mapping.option(name)

    def _names(self, table: Table, taken: Container[str]) -> dict[str, str]:
        """New names of this reading for those of a table's columns that are not taken."""
        free = [name for name in table.columns if name not in taken]
        return {new: old for new, old in self.rename.items() if old in free and new not in table.columns}

    def _factors(self, table: Table) -> dict[str, float]:
        """Factors of this reading for columns of its units."""
        columns, units = table.columns, table.units
        return {n: x for n, x in self.scale.items() if n in columns and units.get(n) == self.units.get(n)}


# Steps of a history ---------------------------------------------------------------------------------------------------
def _mapped(step: Mapping[str, Any]) -> dict[str, Any]:
    """Mapping and new names of a step of a mapping."""
    from diransac.data.mapping_file import parse_mapping

    text = step.get("text")
    found = {} if text is None else {"mapping": parse_mapping(text, step["mapping"])}
    return {**found, "rename": dict(step.get("renamed", {}))}


_ARGUMENTS: dict[str, Any] = {
    "columns": lambda step: {"columns": tuple(step["names"])},
    "clock": lambda step: {"rate": step["rate"]},
    "rename": lambda step: {"rename": dict(step["names"])},
    "map": _mapped,
    "scale": lambda step: {"scale": dict(step["factors"]), "units": dict(step.get("units", {}))},
    "repair": lambda step: {"repair": tuple(step["repairs"])},
    "resample": lambda step: {"resample": step["rate"]},
    "unwrap": lambda step: {"unwrap": dict(step["periods"])} if "periods" in step else {},
    "despike": lambda step: {"despike": tuple(step["replaced"])},
    "unmeasured": lambda step: {"unmeasured": tuple(step["signals"])},
    "shift": lambda step: {"shift": dict(step["delays"])},
}
"""Arguments by the name of a step."""


# From a table to a log ------------------------------------------------------------------------------------------------
def _log(table: Table, scale: Mapping[str, float], resample: float | str | None, repairs: Repairs, source: str) -> Log:
    """Log of a table: scaled, repaired, resampled and checked."""
    for name, factor in scale.items():
        check_factor(name, float(factor))
    table = table.scaled({name: float(factor) for name, factor in scale.items()})
    time, converted = seconds(table, source)
    signals, unusable = _signals(table, len(time), source)
    for name in scale:
        if name != "t" and name not in signals:
            raise LogError(f'{source}: there is no signal "{name}" to scale; found {", ".join(table.columns)}')
    ordered = repairs.ordered(Samples(time, signals), "")
    stamps = ordered.time[in_order(ordered.time, source)]
    unstated = "t" not in table.units and not table.is_described
    notes = [*table.notes, *([converted] if converted else []), *check_clock(stamps, source, in_file=unstated)]
    made = _on_even_clock(ordered, resample, repairs, source)
    history = (*table.history, *([] if repairs.step is None else [repairs.step]), *made.steps)
    log = Log(made.time, made.signals, table.units, source, history, unusable=unusable, filter=table.filter)
    notes += (*repairs.notes, *made.notes, *log.findings(made.recorded))
    return replace(log, notes=tuple(dict.fromkeys(notes)))


def _on_even_clock(samples: Samples, resample: float | str | None, repairs: Repairs, source: str) -> Aligned:
    """Columns on the log's own grid, or resampled.  Raises LogError: they have no grid, and no rate is known."""
    time = samples.time
    if resample is None and "clock" in repairs and not is_even(time):
        repairs.record("clock", "the clock is uneven")
        resample = "median"
    if resample is None:
        try:
            return on_own_grid(time, samples.columns, source)
        except LogError:
            if not runs_freely(time[in_order(time, source)]):
                raise
        resample = "median"
    rows = in_order(time, source)
    return resampled(time[rows], {name: x[rows] for name, x in samples.columns.items()}, resample, source)


def _with_clock(table: Table, rate: float | None, source: str) -> Table:
    """The table with a time ``t`` at a rate, where one is given."""
    if rate is None:
        return table
    if not 0.0 < rate < math.inf:
        raise SettingsError(f"the rate of a log without time is {rate}; give Hz")
    if "t" in table.columns:
        raise LogError(f"{source}: it has a time column; leave out the rate of {rate:.6g} Hz")
    columns: dict[str, FloatArray | str] = {"t": np.arange(table.n_rows) / rate, **table.columns}
    clocked = replace(table, columns=columns, units={**table.units, "t": "s"})
    return clocked.with_step({"step": "clock", "rate": float(rate)})


def _with_time(rename: Mapping[str, str], table: Table) -> dict[str, str]:
    """New names of columns, with that of the time ``t``, where one column alone can be the time."""
    name = None if "t" in rename else time_column(table, rename.values())
    return dict(rename) if name is None else {"t": name, **rename}


def _renamed(table: Table, names: Mapping[str, str], source: str) -> Table:
    columns = rename_columns(table.columns, names, source)
    units = {new: table.units[old] for new, old in names.items() if old in table.units}
    named = unit_of_name(names["t"]) if "t" in names else None
    units |= {"t": named} if named is not None and "t" not in units else {}
    kept = {name: unit for name, unit in table.units.items() if name in columns and name not in names}
    specification = None if table.filter is None else table.filter.renamed(origins_of(table.columns, names))
    renamed = replace(table, columns=columns, units=kept | units, filter=specification)
    return renamed.with_step({"step": "rename", "names": dict(names)})


def _signals(table: Table, n: int, source: str) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Columns that are as long as the time, and for the others the reason why they are no signals."""
    check_names([name for name in table.columns if name != "t"], source)
    unusable = {name: column for name, column in table.columns.items() if isinstance(column, str)}
    numbers = {name: x for name, x in table.numbers.items() if name != "t"}
    unusable |= {m: f"has {len(x)} value{'s' * (len(x) != 1)}, the time {n}" for m, x in numbers.items() if len(x) != n}
    return {name: x for name, x in numbers.items() if len(x) == n}, unusable
