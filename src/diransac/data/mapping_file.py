"""Mapping files: which field of which topic is which signal of a model, in which unit and frame.

A mapping is TOML.  Built-in ones, in ``mappings/``, are named without an ending: ``px4-multirotor``.

::

    time = "header"                   # or "message"; for a table: { column = "t_ms", scale = 0.001 }
    resample = 100.0                  # Hz, or "median"; without it the rows are those of the fastest topic

    [[signals]]
    name = "x"                        # or several: ["x", "y", "z"]
    topic = "vehicle_local_position"  # not for a table
    field = "x"                       # as many as names
    scale = 1.0                       # value = sign * scale * field + offset
    unit = "m"

A list of ``names`` may have one ``scale``, ``sign`` or ``offset`` for each.  ``frame`` then changes the axes of three
components, or of the four of a quaternion whose ``order`` in the file is given.  ``where`` leaves samples out.

::

    while = ["airborne"]              # above the signals: rows where it does not hold are left out

    [[events]]
    name = "airborne"                 # a signal that is 1 where the conditions held last, else 0
    topic = "vehicle_land_detected"
    where = { field = "landed", below = 0.5 } # above, below, or equals: a number or a text
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from diransac.data.mapping import ATTITUDES, AXES, Condition, Event, LogMapping, MappedSignals
from diransac.errors import LogError
from diransac.limits import LARGEST_TABLE
from diransac.plain_data import read_text, toml_table

BUILT_IN = ("px4-multirotor", "crazyflie", "ros-joint-states", "ros-odometry-imu", "lerobot")
"""Names of the mappings that come with the package."""


# Forms ----------------------------------------------------------------------------------------------------------------
def _or_list(kind: Any) -> Callable[[Any], Any]:
    """Validator that makes a list of a single value."""
    return lambda value: [value] if isinstance(value, kind) else value


_Text = Annotated[str, Field(pattern=r"\S")]
_Texts = Annotated[list[_Text], BeforeValidator(_or_list(str)), Field(min_length=1)]
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Numbers = Annotated[list[_Number], BeforeValidator(_or_list(int | float | str)), Field(min_length=1)]
_WORDS = {
    **dict.fromkeys(("float_type", "finite_number"), "write a finite number"),
    **dict.fromkeys(("string_type", "string_pattern_mismatch"), "write a text"),
    "bool_type": "it is true or false",
    "missing": "write a text, or a list of texts",
    "list_type": "write a text, or a list of texts",
}
"""Type of an error -> what to do, where the field has no words of its own."""


class _Form(BaseModel):
    """Base of the tables of a mapping: no conversion of kinds, unknown keys refused."""

    model_config = ConfigDict(extra="forbid", strict=True)

    @classmethod
    def read(cls, table: Any, source: str, name: str = "") -> Self:
        """The table.  Raises LogError: a key is missing, unknown or holds something else; ``name`` is that of it."""
        try:
            return cls.model_validate(table)
        except ValidationError as error:
            first = error.errors()[0]
            by_key = {field.alias or key: field for key, field in cls.model_fields.items()}
            if not first["loc"]:
                raise LogError(f"{source} is {table!r:.60}; write a table") from error
            key = str(first["loc"][0])
            if first["type"] == "extra_forbidden":
                known = ", ".join(sorted(by_key))
                raise LogError(f'{source} has "{key}", which is not known; it may have {known}') from error
            found = f"is {table[key]!r:.60}" if key in table else "is missing"
            words = by_key[key].description or _WORDS.get(first["type"], "write one or more")
            raise LogError(f"{source}{name}: {key} {found}; {words}") from error


class _Where(_Form):
    """A condition."""

    field: _Text
    above: _Number | None = None
    below: _Number | None = None
    equals: bool | _Number | _Text | None = Field(None, description="write a finite number or a text")


_Conditions = Annotated[
    list[dict[str, Any]],
    BeforeValidator(_or_list(dict)),
    Field(description='write a table: where = { field = "xy_valid", above = 0.5 }'),
]


class _Signals(_Form):
    """An entry of ``[[signals]]``."""

    name: _Texts
    topic: _Text = ""
    field: _Texts
    unit: _Texts | None = None
    scale: _Numbers = [1.0]
    sign: _Numbers = [1.0]
    offset: _Numbers = [0.0]
    frame: str | None = None
    order: Literal["wxyz", "xyzw"] | None = Field(None, description='it is that of a quaternion, "wxyz" or "xyzw"')
    optional: bool = False
    where: _Conditions = []


class _Event(_Form):
    """An entry of ``[[events]]``."""

    name: _Text
    topic: _Text = ""
    where: _Conditions


class _Time(_Form):
    """Column of the time of a table."""

    column: _Text
    scale: _Number = 1.0


class _Mapping(_Form):
    """A mapping file; the first keys are steps of the preparation."""

    resample: _Number | Literal["median"] | None = Field(None, description='write a rate in Hz, or "median"')
    repair: bool | _Texts | None = Field(None, description="write true, or a list of texts")
    start: _Number | None = Field(None, alias="from")
    until: _Number | None = None
    events_held: _Texts | None = Field(None, alias="while")
    unwrap: dict[str, _Number] | None = Field(None, description="write a table of periods: unwrap = { ticks = 65536 }")
    despike: _Texts | None = None
    shift: dict[str, _Number] | None = Field(None, description="write a table of seconds: shift = { thrust = 0.02 }")
    differentiate: bool | None = None
    bandwidth: _Number | None = None
    description: str = ""
    time: Literal["header", "message"] | dict[str, Any] = Field(
        "header", description='write "header", "message", or { column = "t_ms", scale = 0.001 }'
    )
    signals: list[dict[str, Any]] = Field([], description="write [[signals]] before each")
    events: list[dict[str, Any]] = Field([], description="write [[events]] before each")


# Reading --------------------------------------------------------------------------------------------------------------
def load_mapping(mapping: str | Path) -> LogMapping:
    """Mapping of a built-in name or of a file.

    Raises
    ------
    LogError
        There is no such file, or it is no valid mapping; the sentence names the entry and what it may be.
    """
    if isinstance(mapping, str) and mapping in BUILT_IN:
        source = f'mapping "{mapping}"'
        text = (Path(__file__).parent / "mappings" / f"{mapping}.toml").read_text(encoding="utf-8")
        return parse_mapping(text, source)
    path = Path(mapping)
    source = f'mapping "{path}"'
    try:
        text = read_text(path, LARGEST_TABLE)
    except FileNotFoundError as error:
        built_in = ", ".join(BUILT_IN)
        raise LogError(f"{source}: there is no such file; built in are {built_in}") from error
    except OSError as error:
        raise LogError(f"{source}: it cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise LogError(f"{source}: {error}") from error
    return parse_mapping(text, source)


def parse_mapping(text: str, source: str) -> LogMapping:
    """Mapping of TOML text, by its name in messages.  Raises LogError: as `load_mapping`."""
    try:
        content = toml_table(text)
    except ValueError as error:
        raise LogError(f"{source}: it is not TOML ({' '.join(str(error).split()):.120})") from error
    form = _Mapping.read(content, source)
    if not form.signals:
        raise LogError(f"{source}: it maps no signal; write [[signals]] with name, topic and field")
    steps = {"resample", "repair", "from", "until", "while", "unwrap", "despike", "shift", "differentiate", "bandwidth"}
    loaded = LogMapping(
        source,
        tuple(_signals(x, f"{source}: signal {k + 1}") for k, x in enumerate(form.signals)),
        tuple(_event(x, f"{source}: events") for x in form.events),
        preparation={name: content[name] for name in sorted(steps & content.keys())},
        text=text,
    )
    if isinstance(form.time, str):
        return replace(loaded, time=form.time)
    column = _Time.read(form.time, f"{source}: time")
    if column.scale == 0.0:
        raise LogError(f"{source}: time: scale is 0; give a factor other than 0")
    return replace(loaded, time_column=column.column, time_scale=column.scale)


def _signals(table: Mapping[str, Any], source: str) -> MappedSignals:
    """An entry.  Raises LogError: it has another form, or its parts do not fit together."""
    first = next(iter(_or_list(str)(table.get("name")) or ()), "")
    name = f' ("{first}")' if isinstance(first, str) and first else ""
    form = _Signals.read(table, source, name)
    source, n = source + name, len(form.name)
    if len(form.field) != n:
        raise LogError(f"{source} has {n} names and {len(form.field)} fields; give as many")
    if "t" in form.name:
        raise LogError(f'{source}: "t" is the time of every log; it needs no entry')
    if len(set(form.name)) < n:
        raise LogError(f"{source} names a signal twice")
    counts = {key: len(getattr(form, key) or [""]) for key in ("scale", "sign", "offset", "unit")}
    for key, count in counts.items():
        if count not in (1, n):
            raise LogError(f"{source} has {n} names and {count} of {key}; give one, or as many")
    if any(abs(x) != 1.0 for x in form.sign):
        raise LogError(f"{source}: sign is {table['sign']}; it is 1 or -1")
    if 0.0 in form.scale:
        raise LogError(f"{source}: scale is {table['scale']}; give a factor other than 0")
    _check_frame(form, source)
    scale, sign, offset = (x * n if len(x) == 1 else x for x in (form.scale, form.sign, form.offset))
    return MappedSignals(
        names=tuple(form.name),
        fields=(form.field[3], *form.field[:3]) if form.order == "xyzw" else tuple(form.field),
        topic=form.topic,
        units=() if form.unit is None else tuple(form.unit * n if len(form.unit) == 1 else form.unit),
        factors=tuple(f * s for f, s in zip(scale, sign, strict=True)),
        offsets=tuple(offset),
        frame=form.frame,
        optional=form.optional,
        where=_conditions(form.where, source),
    )


def _check_frame(form: _Signals, source: str) -> None:
    """Raise LogError: a change of frame, or an order, is that of another number of fields."""
    n, known = len(form.field), (*AXES, *ATTITUDES)
    if form.frame not in (None, *known):
        raise LogError(f"{source}: frame is {form.frame!r:.60}; use one of {', '.join(known)}")
    if form.order is not None and n != 4:
        raise LogError(f'{source}: order is "{form.order}", of {n} fields; a quaternion has 4, in "wxyz" or "xyzw"')
    if form.frame in AXES and n != 3:
        raise LogError(f'{source}: frame "{form.frame}" changes the 3 components of a vector; there are {n} fields')
    if form.frame in ATTITUDES and form.order is None:
        raise LogError(f'{source}: frame "{form.frame}" is that of a quaternion; give its order, "wxyz" or "xyzw"')


def _event(table: Mapping[str, Any], source: str) -> Event:
    form = _Event.read(table, source)
    if form.name == "t" or not form.where:
        raise LogError(f'{source}: an event needs a name, and where = {{ field = "landed", below = 0.5 }}')
    return Event(form.name, form.topic, _conditions(form.where, f'{source}: event "{form.name}"'))


def _conditions(tables: list[dict[str, Any]], source: str) -> tuple[Condition, ...]:
    conditions = []
    for table in tables:
        form = _Where.read(table, f"{source}: where")
        limits = {key: x for key in ("above", "below") if (x := getattr(form, key)) is not None}
        equals = float(form.equals) if isinstance(form.equals, bool) else form.equals
        if (equals is None) == (not limits):
            raise LogError(f"{source}: where needs a field, and above, below or both, or equals")
        conditions.append(Condition(form.field, **limits, equals=equals))
    return tuple(conditions)
