"""`Study`: a grid of Monte-Carlo trials, as a TOML file describes it, checked."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from diransac.errors import DiransacError, SettingsError
from diransac.flight.noise import Noise
from diransac.identification.identify import METHODS
from diransac.identification.settings import Settings
from diransac.study.axis import Axis
from diransac.study.flights import MISSIONS, Flight, check_flown
from diransac.study.plants import PlantChoice
from diransac.study.tables import Reader, changed, flat

__all__ = ["TRUE", "Method", "Study"]

TRUE = "true"
"""The method that identifies nothing: it knows the true parameters."""

PRESETS = {"default": Settings, "table-iv": Settings.table_iv}

VARIABLE = ("plant", "data", "noise", "methods")
"""Tables of a study that an axis may lead to; the others are the same at every level."""

_LABEL = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _+()/-]*")
_NO_ANSWER_CHANGES = ("threads", "batch_size")


@dataclass(frozen=True)
class Method:
    """A way to find parameters.

    Parameters
    ----------
    label : how the study calls it
    method : one of `diransac.METHODS`, or ``true``
    settings : of the identification
    """

    label: str
    method: str
    settings: Settings

    @classmethod
    def from_dict(cls, label: str, table: object) -> Method:
        """A method of a study's table; ``preset`` gives the settings that ``settings`` are laid over.

        Raises SettingsError: a key is unknown or holds something else.
        """
        reader = Reader(table, f"methods.{label}")
        if not _LABEL.fullmatch(label):
            raise SettingsError(
                f'methods: the label "{label}" has other characters than letters, digits and _ + - ( ) /'
            )
        method = reader.text("method", label, choices=(TRUE, *METHODS))
        preset = PRESETS[reader.text("preset", "default", choices=tuple(PRESETS))]()
        given = {name: _none_where_meant(name, x) for name, x in reader.table("settings", needed=False).items()}
        try:
            settings = Settings.from_dict({**preset.to_dict(), **given})
        except SettingsError as error:
            raise SettingsError(f"methods.{label}.settings: {error}") from error
        reader.end()
        return cls(label, method, settings)

    def to_dict(self) -> dict[str, Any]:
        """The table that `from_dict` takes."""
        return {"method": self.method, "settings": self.settings.to_dict()}


@dataclass(frozen=True)
class Study:
    """A grid of trials: at each level of an axis, so many times, data are flown, spoilt, identified from, and judged.

    Parameters
    ----------
    name, description : for people
    plant : what flies, disturbances included
    data : what is flown for data, and recorded
    noise : what spoils the record
    methods : what identifies from it, by label
    evaluation : trajectories that are planned, steered and flown with what was identified; none where
        parameters alone are judged
    keep_paths : whether the paths of these flights are kept
    judges_parameters : whether each trial finds the best parameters that the model can reach, to judge others by
    axis : what varies
    trials : at each level
    seed : trial k of a level depends on (seed, level, k) alone

    Raises SettingsError: no trials, no methods.
    """

    name: str
    description: str
    plant: PlantChoice
    data: Flight
    noise: Noise
    methods: Mapping[str, Method]
    evaluation: tuple[str, ...]
    keep_paths: bool
    judges_parameters: bool
    axis: Axis
    trials: int
    seed: int

    @classmethod
    def from_dict(cls, table: object) -> Study:
        """The study that a TOML file's tables describe, every level of it checked.

        Raises SettingsError: a key is missing, unknown or holds something else; it says which and what there is.
        """
        study = cls._from_dict(table)
        for level in study.axis.levels:
            try:
                study.at(level.text)
            except DiransacError as error:
                raise SettingsError(f"axis: at level {level.text}, {error}") from error
        return study

    @classmethod
    def _from_dict(cls, table: object) -> Study:
        """As `from_dict`, but for the levels."""
        reader = Reader(table)
        data, evaluation = reader.table("data"), Reader(reader.table("evaluation"), "evaluation")
        judges_parameters = evaluation.flag("parameters", default=False)
        methods = reader.table("methods")
        found = cls(
            name=reader.text("name"),
            description=reader.text("description", ""),
            plant=PlantChoice.from_dict(reader.table("plant")),
            data=Flight.from_dict(data),
            noise=_noise(reader.table("noise", needed=False)),
            methods={label: Method.from_dict(label, one) for label, one in methods.items()},
            evaluation=_trajectories(evaluation.listed("trajectories", least=0 if judges_parameters else 1)),
            keep_paths=evaluation.flag("keep_paths", default=False),
            judges_parameters=judges_parameters,
            axis=Axis.from_dict(reader.table("axis")),
            trials=reader.whole("trials", 1),
            seed=reader.whole("seed", 0, default=0),
        )
        for one in (reader, evaluation):
            one.end()
        if not found.methods:
            raise SettingsError(f"methods is empty; there are {TRUE}, {', '.join(METHODS)}")
        found._check_flights()
        return found

    def _check_flights(self) -> None:
        """Raises SettingsError: the plant cannot fly what it is to fly."""
        flown = {self.data.trajectory: "data.trajectory", **dict.fromkeys(self.evaluation, "evaluation.trajectories")}
        for trajectory, key in flown.items():
            try:
                check_flown(trajectory, self.plant.plant.model)
            except SettingsError as error:
                raise SettingsError(f"{key} has {trajectory!r}: {error}") from error

    def to_dict(self) -> dict[str, Any]:
        """The tables that `from_dict` takes, with everything that has a default."""
        return {
            "name": self.name,
            "description": self.description,
            "trials": self.trials,
            "seed": self.seed,
            "plant": self.plant.to_dict(),
            "data": self.data.to_dict(),
            "noise": dataclasses.asdict(self.noise),
            "methods": {label: method.to_dict() for label, method in self.methods.items()},
            "evaluation": {
                "trajectories": list(self.evaluation),
                "keep_paths": self.keep_paths,
                **({"parameters": True} if self.judges_parameters else {}),  # stores of before have no such key
            },
            "axis": self.axis.to_dict(),
        }

    def at(self, level: str) -> Study:
        """The study as it is at one level.

        A level that flies another trajectory for data, or another kind of plant, takes over what was given to this
        study's, but not its defaults.

        Raises SettingsError: there is no such level, or what it changes has no meaning.
        """
        changes = self.axis.narrowed([level]).levels[0].changes
        known = {path: value for path, value in changes.items() if self._concerns(path)}
        return self._from_dict(changed(self._shared(known), known))

    def _shared(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """The study's tables, without the defaults of what changes put another in place of."""
        table = self.to_dict()
        for part, key, made_from in (
            ("data", "trajectory", Flight.from_dict),
            ("plant", "kind", PlantChoice.from_dict),
        ):
            choice = {key: table[part][key]}
            if changes.get(f"{part}.{key}", choice[key]) != choice[key]:
                defaults = made_from(choice).to_dict()
                given = {name: value for name, value in table[part].items() if defaults.get(name) != value}
                table[part] = {**choice, **given}
        return table

    def _concerns(self, path: str) -> bool:
        """Whether a path of the axis leads into this study, rather than to a method that it was narrowed from.

        Raises SettingsError: it leads to what all levels share.
        """
        root, *way = path.split(".")
        if root not in VARIABLE or not way:
            raise SettingsError(f'"{path}" cannot vary; there are {", ".join(f"{name}.*" for name in VARIABLE)}')
        if root == "methods" and way[1:] == ["preset"]:
            raise SettingsError(
                f'"{path}" cannot vary: all settings are known by then; give two methods, a preset each'
            )
        return root != "methods" or way[0] in self.methods

    def narrowed(
        self,
        trials: int | None = None,
        levels: Sequence[str | float] | None = None,
        methods: Sequence[str] | None = None,
    ) -> Study:
        """The same study with so many trials, at these levels, of these methods; None keeps all.

        Raises SettingsError: there is no such level or method, or fewer than one trial.
        """
        table: dict[str, Any] = {} if trials is None else {"trials": trials}
        count = Reader(table).whole("trials", 1, default=self.trials)
        axis = self.axis if levels is None else self.axis.narrowed([str(level) for level in levels])
        chosen = list(self.methods) if methods is None else list(methods)
        unknown = [label for label in chosen if label not in self.methods]
        if unknown or not chosen:
            which = f'no method "{unknown[0]}"' if unknown else "no method named"
            raise SettingsError(f"there is {which}; there are {', '.join(self.methods)}")
        return replace(self, trials=count, axis=axis, methods={label: self.methods[label] for label in chosen})

    @property
    def configuration(self) -> dict[str, dict[str, Any]]:
        """What decides a trial's outcome, by part and dotted path: ``study``, ``methods.<label>``, ``levels.<text>``.

        How many trials there are, and what people call things, decides nothing.
        """
        table = self.to_dict()
        decisive = {name: table[name] for name in ("seed", "plant", "data", "noise", "evaluation")}
        parts = {"study": dict(flat(decisive))}
        for label, method in table["methods"].items():
            silent = [f"settings.{name}" for name in _NO_ANSWER_CHANGES]
            parts[f"methods.{label}"] = {path: value for path, value in flat(method) if path not in silent}
        changes = {level.text: dict(level.changes) or {"changes": "none"} for level in self.axis.levels}
        return parts | {f"levels.{text}": some for text, some in changes.items()}


def _none_where_meant(name: str, value: object) -> object:
    """None for the word ``none``, which TOML has no value for, unless it is the setting's own."""
    return None if value == "none" and name != "refit" else value


def _noise(table: Mapping[str, Any]) -> Noise:
    reader = Reader(table, "noise")
    given = {field.name: table[field.name] for field in dataclasses.fields(Noise) if reader.has(field.name)}
    reader.end()
    try:
        return Noise(**given)
    except SettingsError as error:
        raise SettingsError(f"noise.{error}") from error


def _trajectories(found: Sequence[object]) -> tuple[str, ...]:
    for name in found:
        if name not in MISSIONS:
            raise SettingsError(f"evaluation.trajectories has {name!r}; there are {', '.join(MISSIONS)}")
    return tuple(dict.fromkeys(map(str, found)))
