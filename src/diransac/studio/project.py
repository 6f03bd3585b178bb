"""`Project`: logs, model and options of an identification as a readable file, ``project.diransac.toml``.

A project is options of the command line under their names, so that one table says what a file may hold, what the
command line makes of it, and which Python does the same.
"""

from __future__ import annotations

import keyword
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from diransac.atomic import write_text
from diransac.errors import ResultError, SettingsError
from diransac.plain_data import toml_file, toml_text
from diransac.plain_text import literal, one_line, printable
from diransac.user_files import file_and_name, is_description

NAME = "project.diransac.toml"

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Text = Annotated[str, Field(min_length=1, max_length=4096, pattern=r"^[^\x00\n\r]*$")]
_Stretch = Annotated[list[_Number], Field(min_length=2, max_length=2)]
_READING = ["mapping", "columns", "rate", "repair", "map", "scale", "resample", "unmeasured", "episodes"]
_ROBOT = ["unknown", "control", "motor", "bodies", "joints", "passive", "base", "inertia"]
_STEPS = ["from", "until", "while", "leave-out", "unwrap", "despike", "shift"]
_SEARCH = [
    *("method", "estimator", "seed", "input-hold", "fix", "prior", "start", "horizon", "settings"),
    *("with-suggestions", "add-terms", "time-limit", "differentiate", "bandwidth"),
]


def _hyphened(name: str) -> str:
    """Name of a field as the command line spells it."""
    return name.strip("_").replace("_", "-")


class Project(BaseModel):
    """Logs, model and options of an identification; every key but the lists of logs is an option of ``identify``.

    ``held-out`` are logs to predict, ``settings`` are those of ``--set``.
    """

    model_config = ConfigDict(extra="forbid", strict=True, alias_generator=_hyphened, populate_by_name=True)

    model: _Text | None = None
    logs: list[_Text] = []
    held_out: list[_Text] = []
    mapping: _Text | None = None
    columns: list[_Text] | None = None
    rate: _Number | None = None
    repair: list[_Text] | None = None
    map: dict[_Text, _Text] = {}
    scale: dict[_Text, _Number] = {}
    resample: _Number | Literal["median"] | None = None
    unmeasured: list[_Text] | None = None
    episodes: _Text | None = None
    from_: _Number | None = None
    until: _Number | None = None
    while_: list[_Text] | None = None
    leave_out: list[_Stretch] = []
    unwrap: dict[_Text, _Number] = {}
    despike: list[_Text] | None = None
    shift: dict[_Text, _Number] = {}
    unknown: list[_Text] | None = None
    control: dict[_Text, _Number | _Text] = {}
    motor: dict[_Text, _Number | _Text] = {}
    bodies: list[_Text] | None = None
    joints: _Text | None = None
    passive: list[_Text] | None = None
    base: Literal["held", "measured"] | None = None
    inertia: Literal["nearest", "strict"] | None = None
    method: _Text | None = None
    estimator: _Text | None = None
    seed: int | None = None
    input_hold: _Text | None = None
    fix: dict[_Text, _Number | Literal["nominal"]] = {}
    prior: dict[_Text, _Stretch] = {}
    start: dict[_Text, _Number] = {}
    horizon: _Number | None = None
    settings: dict[_Text, bool | int | _Number | _Text] = {}
    with_suggestions: bool = False
    add_terms: list[_Text] = []
    time_limit: _Number | None = None
    differentiate: bool = False
    bandwidth: _Number | None = None

    @classmethod
    def of(cls, table: Mapping[str, Any], source: str) -> Self:
        """The project of a table.  Raises SettingsError: a key is unknown or holds something else."""
        try:
            return cls.model_validate(table)
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(str(x) for x in first["loc"][:2])
            raise SettingsError(f'{source}: "{key}": {first["msg"]}') from error

    @classmethod
    def load(cls, path: Path) -> Self:
        """The project of a file.  Raises SettingsError: as `of`, or it cannot be read."""
        return cls.of(toml_file(path, "project"), f'project "{path}"')

    def save(self, path: Path) -> None:
        """Write the project, atomically.  Raises ResultError: the file cannot be written."""
        try:
            write_text(path, f"# diransac identify --config {printable(one_line(path.name))}\n{_toml(self.options)}")
        except OSError as error:
            raise ResultError(f'project "{path}" cannot be written: {error.strerror}') from error

    @property
    def options(self) -> dict[str, Any]:
        """Options that are given, by the names of the command line."""
        return self.model_dump(by_alias=True, exclude_defaults=True)

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """The project with other options; None takes one away.  Raises SettingsError: as `of`."""
        kept = self.options | dict(changes)
        return self.of({key: value for key, value in kept.items() if value is not None}, "project")

    # ------------------------------------------------------------------ command line

    @property
    def names_robot(self) -> bool:
        """True for a model from a description, which alone takes options of a robot."""
        return is_description(self.model or "")

    @property
    def code(self) -> str:
        """The file of the user's own code that the model is, or an empty text."""
        found = file_and_name(self.model or "", "")
        return "" if found is None else str(found[0])

    @property
    def mapping_file(self) -> str:
        """The file that the mapping is, or an empty text for a built-in one."""
        from diransac.data.mapping_file import BUILT_IN

        return "" if self.mapping is None or self.mapping in BUILT_IN else self.mapping

    def words_of_reading(self, folder: Path = Path()) -> list[str]:
        """Options of the preparation of a log."""
        return list(self._words([*_READING, *_STEPS], folder))

    def words_of_model(self, folder: Path = Path()) -> list[str]:
        """The model, and options of a robot after it."""
        robot = self._words(_ROBOT, folder) if self.names_robot else ()
        return [*([] if self.model is None else [_placed(self.model, folder)]), *robot]

    def words_of_fixing(self) -> list[str]:
        """Options of the parameters that are known."""
        return list(self._words(["fix"], Path()))

    def words(self, folder: Path = Path()) -> list[str]:
        """Arguments of ``identify``, of files beside the project."""
        model = self.words_of_model(folder)
        chosen = ["--model", *model] if model else []
        logs = [hyphenless(str(folder / log)) for log in self.logs]
        return [*logs, *chosen, *self.words_of_reading(folder), *self._words(_SEARCH, folder)]

    def _words(self, keys: Sequence[str], folder: Path) -> Iterator[str]:
        options = self.options
        for key in keys:
            if key in options:
                named = f"--{'set' if key == 'settings' else key}"
                if options[key] is True:
                    yield named
                    continue
                for text in _texts(key, options[key]):
                    is_file = key == "mapping" and self.mapping_file
                    placed = hyphenless(str(folder / text)) if is_file else text
                    yield from [f"{named}={placed}"] if text[:1] == "-" else [named, placed]

    # ------------------------------------------------------------------ Python

    def python(self) -> str:
        """Lines of Python that identify the same."""
        options = self.options
        lines = ["import diransac as dr", *self._python_of_model()]
        read = {"rename" if key == "map" else key: options[key] for key in _READING if key in options}
        episodes = "" if read.pop("episodes", None) is None else ", episodes=[...]"
        listed = ", ".join(map(repr, self.logs))
        lines += [f"logs = [log for file in [{listed}] for log in dr.read_logs(file{_given(read)}{episodes})]"]
        steps = {key.replace("-", "_"): options[key] for key in _STEPS if key in options}
        if steps:
            lines.insert(1, "from diransac.data.preprocessing import prepared")
            lines += [f"logs = [prepared(log, {steps!r}) for log in logs]"]
        lines += self._python_of_search(options)
        return "\n".join(map(printable, lines))

    def _python_of_model(self) -> list[str]:
        if self.model is None:
            return []
        options = self.options
        if self.names_robot:
            given: dict[str, Any] = {
                k: options[k] for k in ("unknown", "bodies", "joints", "passive", "base", "inertia") if k in options
            }
            given |= {"bodies": "all"} if given.get("bodies") == ["all"] else {}
            kinds = (("control", "PositionControl"), ("motor", "MotorCurrents"))
            drive = "".join(f", actuation=dr.{kind}({_given(options[k])[2:]})" for k, kind in kinds if k in options)
            return [f"model = dr.models.robot({self.model!r}{_given(given)}{drive})"]
        code = file_and_name(self.model, "")
        if code is not None:
            stem, name = code[0].stem, code[1] or "model"
            if not (_is_name(stem) and _is_name(name)):  # no import can name it
                return []
            return [f"from {stem} import {name}" + ("" if name == "model" else " as model")]
        if self.model.endswith(".json"):
            return [f"model = dr.Result.load({self.model!r}).model"]
        return [f"model = dr.models.builtin({self.model!r})"]

    def _python_of_search(self, options: Mapping[str, Any]) -> list[str]:
        named = {"fix": "fixed", "prior": "priors", "add-terms": "with_suggestions"}
        given = {named.get(k, k.replace("-", "_")): options[k] for k in _SEARCH if k in options and k != "method"}
        settings, method, lines = given.pop("settings", None), options.get("method"), list[str]()
        given["fixed"] = {n: None if x == "nominal" else x for n, x in given.get("fixed", {}).items()} or None
        given["priors"] = {n: tuple(x) for n, x in given.get("priors", {}).items()} or None
        chosen = "" if method is None else f", {method!r}"
        if settings is not None:
            lines = ["from diransac.identification.methods import configured"]
            chosen = f", configured({method or 'lo-diransac'!r}, {settings!r})"
        return [*lines, f"result = dr.identify(model, logs{chosen}{_given(given)})", printed("result")]


def _texts(key: str, value: Any) -> list[str]:
    """Values of an option on the command line."""
    if key == "leave-out":
        return [",".join(f"{a:.12g}:{b:.12g}" for a, b in value)] if value else []
    if isinstance(value, list):
        return [",".join(value)]
    if isinstance(value, dict):
        pairs = [_pair(key, name, x) for name, x in value.items()]
        return [",".join(pairs)] if key in ("control", "motor", "start") else pairs
    return [f"{value:.17g}" if isinstance(value, float) else str(value)]


def _pair(key: str, name: str, value: Any) -> str:
    """A name and its value as the command line takes them.  Raises SettingsError: it would take them for others."""
    if "," in name or "=" in name or (key == "map" and "," in value):
        raise SettingsError(f"{key}: {name!r:.100} has a comma or an equals sign, or its column a comma; rename it")
    if key == "prior":
        return f"{name}={value[0]!r},{value[1]!r}"
    if key == "settings" and isinstance(value, bool):
        return f"{name}={str(value).lower()}"
    return name if (key, value) == ("fix", "nominal") else f"{name}={value}"


def _placed(model: str, folder: Path) -> str:
    """A model beside the project as the command finds it, never a word that begins like an option."""
    file, name = file_and_name(model, "") or (Path(model), "")
    is_file = file.suffix or "/" in model
    return hyphenless(f"{folder / file}{name and ':'}{name}" if is_file else model)


def _is_name(text: str) -> bool:
    """True for a text that Python takes as a name."""
    return text.isidentifier() and not keyword.iskeyword(text)


def hyphenless(text: str) -> str:
    """Name of a file that no command takes for an option."""
    return f"./{text}" if text.startswith("-") else text


def _given(arguments: Mapping[str, Any]) -> str:
    """Keyword arguments after others."""
    given = ((name, value) for name, value in arguments.items() if value is not None)
    return "".join(f", {n}={x!r}" if _is_name(n) else f", **{ {n: x}!r}" for n, x in given)


def printed(expression: str) -> str:
    """Line of Python that shows a value; nothing is printed here."""
    return f"{print.__name__}({expression})"


def quoted(words: Sequence[str]) -> str:
    """A command as a shell takes it, harmless to be shown."""
    return printable(one_line(shlex.join(["diransac", *words])))


# ---------------------------------------------------------------------- TOML


def _toml(options: Mapping[str, Any]) -> str:
    """Options as TOML, values before tables."""
    plain = {key: value for key, value in options.items() if not isinstance(value, dict)}
    lines = [f"{key} = {toml_text(value)}" for key, value in plain.items()]
    for key in (key for key in options if key not in plain):
        lines += ["", f"[{key}]", *(f"{literal(name)} = {toml_text(x)}" for name, x in options[key].items())]
    return "\n".join(lines) + "\n"
