"""A recording's topics as one table of signals, and as a listing."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.clock import is_even
from diransac.data.mapping import LogMapping, MappedSignals, held
from diransac.data.readers.recording import Recording, Samples, align, find_field, shortened
from diransac.data.readers.table import Table
from diransac.errors import LogError
from diransac.plain_text import one_line
from diransac.text_table import aligned, some

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from diransac.data.readers.repair import Repairs

# ---------------------------------------------------------------------- tables


def mapped_table(table: Table, mapping: LogMapping, source: str) -> Table:
    """Table of the signals of a mapping, with the time ``t``, from the columns of another.

    Raises LogError: as `LogMapping.chosen`; a column that is wanted holds no numbers.
    """
    columns = dict(table.columns)
    if mapping.time_column is not None:
        if mapping.time_column not in columns:
            found = ", ".join(columns)
            raise LogError(f'{source}: {mapping.source} has its time in "{mapping.time_column}"; found {found}')
        time = columns[mapping.time_column]
        columns["t"] = time if isinstance(time, str) else time * mapping.time_scale
    entries, notes = mapping.chosen({"": list(columns)}, {"": table.elements}, source)
    mapped: dict[str, FloatArray | str] = {"t": columns["t"]} if "t" in columns else {}
    units = {"t": "s"} if mapping.time_column is not None else {n: x for n, x in table.units.items() if n == "t"}
    numbers = {name: x for name, x in columns.items() if not isinstance(x, str)}
    for entry in entries:
        for name in entry.needs:
            if name not in numbers:
                raise LogError(f'{source}: column "{name}" {columns[name]}')
        mapped |= entry.apply(numbers)
        units |= entry.known_units()
    events = [x for x in mapping.events_in({"": list(numbers)}) if not x.topic]
    mapped |= {x.name: x.flags(numbers) for x in events}
    step = {"step": "map", "mapping": mapping.source, "text": mapping.text, "signals": _origins(entries)}
    step |= {"events": [x.name for x in events]} if events else {}
    made = replace(table, columns=mapped, units=units, notes=(*table.notes, *notes), filter=None)
    return made.with_step(step)


def is_one_table(recording: Recording, rename: Mapping[str, str]) -> bool:
    """True for a recording of one topic whose fields are called by their names alone."""
    return len(recording.fields) == 1 and set(rename.values()) <= set(next(iter(recording.fields.values())))


def whole_topic(recording: Recording, repairs: Repairs) -> Table:
    """Table of all fields of a recording with one topic."""
    ((topic, fields),) = recording.fields.items()
    samples = repairs.ordered(recording.read({topic: fields}, "header")[topic], topic)
    return Table({"t": samples.time, **samples.columns, **samples.unusable}, {"t": "s"}, recording.notes)


def table_of_topics(
    recording: Recording,
    mapping: LogMapping | None,
    rename: Mapping[str, str],
    resample: float | str | None,
    repairs: Repairs,
) -> tuple[Table, float | str | None]:
    """Table of the signals that a mapping, and ``rename`` by ``topic.field``, take from a recording's topics.

    A signal of both is that of ``rename``.  Returned beside the table is the resampling that is left to do: that of the
    samples of a single topic.

    Raises LogError: neither is given; a topic or field is missing; ``rename`` has a part of a vector; as `align`.
    """
    source = recording.source
    entries, notes = entries_of(recording, mapping, rename)
    read = recording.read(wanted_by(entries), "header" if mapping is None else mapping.time)
    parts = {topic: signals_of(topic, samples, entries, repairs, source) for topic, samples in read.items()}
    fastest = min(parts.values(), key=lambda x: x.interval)
    if "clock" in repairs and resample is None and len(parts) > 1 and not is_even(fastest.time):
        resample = "median"
        repairs.record("clock", "the topics' clocks are uneven; resampled at the median rate of the fastest")
    made = align(parts, resample if len(parts) > 1 else None, source)
    units = {name: unit for entry in entries for name, unit in entry.known_units().items()}
    step: dict[str, Any] = {"step": "map", "mapping": None if mapping is None else mapping.source}
    step |= {} if mapping is None else {"text": mapping.text}
    step |= {"renamed": dict(rename)} if rename else {}
    step["signals"] = _origins(entries)
    information = recording.metadata.get("information", {})
    kept = ("sys_name", "ver_hw", "ver_sw", "ver_sw_branch", "sys_uuid")
    step |= {"log": {name: information[name] for name in kept if name in information}} if information else {}
    flags = {} if mapping is None else _flags(recording, mapping, made.time)
    step |= {"events": list(flags)} if flags else {}
    said = (*recording.notes, *notes, *(made.notes if len(parts) > 1 else ()))
    unusable = {name: why for samples in parts.values() for name, why in samples.unusable.items()}
    columns: dict[str, FloatArray | str] = {"t": made.time, **made.signals, **unusable, **flags}
    table = Table(columns, units | {"t": "s"}, said, (step, *made.steps))
    return table, None if len(parts) > 1 else resample


def entries_of(
    recording: Recording, mapping: LogMapping | None, rename: Mapping[str, str]
) -> tuple[list[MappedSignals], list[str]]:
    """Signals that a mapping, and ``rename`` by ``topic.field``, take from a recording, and notes on what it lacks.

    Raises LogError: neither is given; a topic or field is missing; ``rename`` has a part of a vector.
    """
    source, fields = recording.source, recording.fields
    entries, notes = ([], []) if mapping is None else mapping.chosen(_with_texts(recording), recording.elements, source)
    entries = [x for x in entries if not set(x.names) <= set(rename)]
    for name, path in rename.items():
        if name == "t":
            raise LogError(f'{source}: each topic has its own time; leave out "t", and give the signals')
        together = next((x.names for x in entries if name in x.names), None)
        if together is not None:
            whole = ", ".join(together)
            raise LogError(f'{source}: the mapping has "{name}" with {whole}; rename all of these, or none')
        topic, label = find_field(path, fields, source)
        entries.append(MappedSignals((name,), (label,), topic))
    if not entries:
        raise LogError(
            f"{source}: it has {len(fields)} topics, {some(fields, 12)}; say what they are: "
            "--mapping NAME|FILE.toml, or --map thrust=topic.field"
        )
    return entries, notes


def wanted_by(entries: Sequence[MappedSignals]) -> dict[str, tuple[str, ...]]:
    """Fields of each topic that some signals need."""
    wanted: dict[str, tuple[str, ...]] = {}
    for entry in entries:
        wanted[entry.topic] = tuple(dict.fromkeys((*wanted.get(entry.topic, ()), *entry.needs)))
    return wanted


def _flags(recording: Recording, mapping: LogMapping, rows: FloatArray) -> dict[str, FloatArray]:
    """Flags (N,) of the events of a mapping at the rows of a log, without those whose topic has no message."""
    found = {}
    for event in mapping.events_in(_with_texts(recording)):
        with suppress(LogError):
            samples = recording.read({event.topic: event.needs}, mapping.time)[event.topic]
            found[event.name] = held(samples.time, event.flags({**samples.columns, **samples.texts}), rows)
    return found


def _with_texts(recording: Recording) -> dict[str, tuple[str, ...]]:
    """Fields of each topic, those that hold texts included."""
    return {topic: (*fields, *recording.texts.get(topic, ())) for topic, fields in recording.fields.items()}


def signals_of(
    topic: str, samples: Samples, entries: Sequence[MappedSignals], repairs: Repairs, source: str
) -> Samples:
    """The mapped signals of one topic."""
    signals: dict[str, FloatArray] = {}
    unusable: dict[str, str] = {}
    for entry in entries:
        if entry.topic == topic:
            for label in entry.fields:
                if label in samples.unusable:
                    raise LogError(f'{source}: field "{label}" of topic "{topic}" {samples.unusable[label]}')
            columns = {**samples.columns, **samples.texts}
            why = entry.invalid(columns)
            unusable |= dict.fromkeys(entry.names, why) if why else {}
            signals |= {} if why else entry.apply(columns)
    return repairs.ordered(Samples(samples.time, signals, unusable), topic)


def _origins(entries: Sequence[MappedSignals]) -> dict[str, str]:
    return {
        name: f"{entry.topic}.{label}" if entry.topic else label
        for entry in entries
        for name, label in zip(entry.names, entry.fields, strict=True)
    }


# ---------------------------------------------------------------------- listing


@dataclass(frozen=True)
class TopicFacts:
    """One topic.

    Parameters
    ----------
    n_messages : int
    rate : float
        One over the median interval, Hz; NaN for fewer than two messages.
    start, end : float
        First and last time, s since the start of the recording.
    n_gaps, longest_gap : int, float
        Intervals of more than three and a half median ones, and the longest interval, s.
    fields : tuple of str
    texts : tuple of str
        Fields that hold texts.
    """

    n_messages: int
    rate: float
    start: float
    end: float
    n_gaps: int
    longest_gap: float
    fields: tuple[str, ...]
    texts: tuple[str, ...] = ()


@dataclass(frozen=True)
class TopicTable:
    """Topics of a recording, returned by `read_topics`; printed as a table.

    Parameters
    ----------
    source : str
    topics : mapping of str to TopicFacts
    notes : tuple of str
        Findings about the file.
    metadata : mapping
        Facts beside the samples: of a ULog ``information``, ``parameters``, ``messages`` and ``dropouts``.
    elements : mapping of str to tuple of str
        Names of the elements of arrays, such as joints.
    """

    source: str
    topics: Mapping[str, TopicFacts]
    notes: tuple[str, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)
    elements: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def fields(self) -> dict[str, tuple[str, ...]]:
        """Fields of each topic."""
        return {name: facts.fields for name, facts in self.topics.items()}

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON apart from numbers that are not finite."""
        return asdict(self)

    def __str__(self) -> str:
        rows = [["topic", "messages", "Hz", "from s", "to s", "gaps", "longest s", "fields"]]
        for name, x in self.topics.items():
            gaps = [str(x.n_gaps or "-"), f"{x.longest_gap:.3g}" if x.n_gaps else "-"]
            listed = [*shortened(x.fields), *(f"{name} (text)" for name in shortened(x.texts))]
            shown = ", ".join(listed[:6]) + (", ..." if len(listed) > 6 else "")
            rate = f"{x.rate:.4g}" if np.isfinite(x.rate) else "-"
            rows.append([name, str(x.n_messages), rate, f"{x.start:.6g}", f"{x.end:.6g}", *gaps, shown])
        machine = self.metadata.get("information", {})
        about = [f"  {k}: {machine[k]}" for k in ("sys_name", "ver_hw", "ver_sw") if k in machine]
        parameters = self.metadata.get("parameters", {})
        about += [f"  {len(parameters)} parameters"] if parameters else []
        messages = [f"  {at:.3f} s: {text}" for at, text in self.metadata.get("messages", [])[:10]]
        notes = [f"  {note}" for note in self.notes]
        head = f"{self.source}: {len(self.topics)} topic{'s' * (len(self.topics) != 1)}"
        return "\n".join(map(one_line, [head, *aligned(rows), *about, *notes, *messages]))


def list_topics(recording: Recording) -> TopicTable:
    """Topics of a recording, with their rates and gaps."""
    fields = recording.fields
    read = recording.read(dict.fromkeys(fields, ()), "message")
    topics = {name: _facts(read[name].time, own, recording.texts.get(name, ())) for name, own in fields.items()}
    return TopicTable(recording.source, topics, recording.notes, recording.metadata, recording.elements)


def _facts(time: FloatArray, fields: tuple[str, ...], texts: tuple[str, ...]) -> TopicFacts:
    steps = np.diff(time)
    usual = float(np.median(steps)) if len(steps) else np.nan
    n_gaps = int((steps > 3.5 * usual).sum()) if usual > 0.0 else 0
    longest = float(steps.max()) if len(steps) else np.nan
    rate = 1.0 / usual if usual > 0.0 else np.nan
    return TopicFacts(len(time), rate, float(time[0]), float(time[-1]), n_gaps, longest, fields, texts)
