"""`Study`: the specification of a grid of Monte-Carlo trials, as a TOML file describes it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    BeforeValidator,
    Field,
    InstanceOf,
    PlainSerializer,
    PlainValidator,
    ValidationInfo,
    field_validator,
    model_validator,
)

from diransac.errors import DiransacError, SettingsError, check_known
from diransac.flight.noise import Noise
from diransac.flight.planning import multisine, random_waypoints, sine, square, star
from diransac.flight.planning.trajectories import MAX_DURATION, check_fully_actuated, check_plane
from diransac.flight.trajectory import Trajectory
from diransac.flight.tvlqr import Controller, check_weights
from diransac.identification.settings import EXECUTION, MOST_SUBSTEPS
from diransac.model import Model
from diransac.model.plant import ModelWithParameters
from diransac.study.assessment import PlantFacts
from diransac.study.axis import Axis
from diransac.study.method_choice import MethodChoice, methods_of
from diransac.study.plants import PlantChoice
from diransac.study.store import STUDY, Key, Kind
from diransac.study.tables import (
    RANDOM,
    Count,
    Flag,
    FunctionTable,
    OneOf,
    Table,
    Text,
    Whole,
    changed,
    check_whole,
    flat,
    function_arguments,
    is_number,
    located,
    takes_options,
    unknown_key,
)

MISSIONS: dict[str, Callable[..., Trajectory]] = {"square": square, "star": star, "sine": sine}
"""Trajectories that identified models are evaluated on."""

TRAJECTORIES: dict[str, Callable[..., Trajectory]] = {
    **MISSIONS,
    "random-waypoints": random_waypoints,
    "multisine": multisine,
}
"""Trajectories that may be flown for data."""


def planned_path(mission: str) -> str:
    """Key of a mission's planned paths, beside that of the flown ones, which is its name."""
    return f"{mission} planned"


# Tables of a study ----------------------------------------------------------------------------------------------------
class FlightChoice(FunctionTable):
    """The flight that is recorded, the table ``[data]``, with all of its arguments, defaults included.

    Parameters
    ----------
    trajectory : a key of `TRAJECTORIES`
    substeps : integration steps per sample, at least; None: as many as the plant requires
    arguments : of the trajectory's function, by name; the seed may be the word ``random``

    Raises
    ------
    SettingsError
        An unknown trajectory or key, a value of another kind, a number that is not above 0, more than an hour.
    """

    PLACE: ClassVar[str] = "data"

    trajectory: Annotated[Text, OneOf(TRAJECTORIES)]
    substeps: Count | None = Field(
        None, le=MOST_SUBSTEPS, description=f"a whole number of at least 1 and at most {MOST_SUBSTEPS}"
    )
    arguments: dict[str, Any] = Field({})

    @field_validator("arguments")
    @classmethod
    def _complete(cls, given: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if "trajectory" not in info.data:
            return given
        function, keys = TRAJECTORIES[info.data["trajectory"]], ["trajectory", "substeps"]
        return _trajectory_arguments(function, given, "data", keys)

    @property
    def is_drawn(self) -> bool:
        """True if each trial flies another trajectory."""
        return bool(self.arguments.get("seed") == RANDOM)

    def planned(self, plant: ModelWithParameters, seed: int, **options: Any) -> Trajectory:
        """The trajectory.

        Parameters
        ----------
        plant : that is to fly it
        seed : of a trajectory that is drawn; others have their own
        options : of `plan`, such as ``time_limit``; unused by trajectories that need no plan

        Raises
        ------
        SettingsError
            The model cannot fly it.
        PlanningError
            There is no such trajectory.
        """
        function = TRAJECTORIES[self.trajectory]
        arguments = {**self.arguments, "seed": seed} if self.is_drawn else self.arguments
        return function(plant, **arguments, **(options if takes_options(function) else {}))


def _trajectory_arguments(
    function: Callable[..., Trajectory], given: Mapping[str, Any], place: str, keys: Sequence[str] = ()
) -> dict[str, Any]:
    """Arguments of a trajectory's function from a table, completed and checked; ``keys`` are others of that table."""
    arguments = function_arguments(function, given, place, keys, random="seed")
    for name, value in arguments.items():
        if name != "seed" and is_number(value) and value <= 0:
            raise SettingsError(f"{place}.{name} is {value:g}; give a number above 0")
        if name == "duration" and value > MAX_DURATION:
            raise SettingsError(f"{place}.duration is {value:g}; give {MAX_DURATION:g} s or less")
    return arguments


class Missions(Table):
    """The trajectories that estimates are evaluated on, the table ``[missions]``: a table of arguments for each.

    Raises
    ------
    SettingsError
        An unknown mission or key, a value of another kind, a number that is not above 0.
    """

    PLACE: ClassVar[str] = "missions"

    square: dict[str, Any] = Field({}, validate_default=True, description="a table")
    star: dict[str, Any] = Field({}, validate_default=True, description="a table")
    sine: dict[str, Any] = Field({}, validate_default=True, description="a table")

    @field_validator("square", "star", "sine")
    @classmethod
    def _complete(cls, given: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        assert info.field_name is not None
        return _trajectory_arguments(MISSIONS[info.field_name], given, f"missions.{info.field_name}")

    def planned(self, mission: str, plant: ModelWithParameters, **options: Any) -> Trajectory:
        """The trajectory of a mission, a key of `MISSIONS`; options of `plan`.  Raises PlanningError: there is none."""
        return MISSIONS[mission](plant, **getattr(self, mission), **options)


_Cost = Annotated[float, Field(strict=True, ge=0.0, allow_inf_nan=False)]
_Weights = Annotated[
    _Cost | dict[str, _Cost] | None, Field(description="a number, or a table of numbers by name, from 0")
]


class ControlChoice(Table):
    """Control of every flight, the table ``[control]``.

    Parameters
    ----------
    Q, R, Qf : weights of `tvlqr`, a number for all or by name; None: its defaults
    clip : keep inputs within the limits of the trajectory

    Raises
    ------
    SettingsError
        An unknown key, or a value of another kind.
    """

    PLACE: ClassVar[str] = "control"

    Q: _Weights = None
    R: _Weights = None
    Qf: _Weights = None
    clip: Flag = True

    @property
    def weights(self) -> dict[str, Any]:
        """Weights by the name of their argument of `tvlqr`."""
        return {"Q": self.Q, "R": self.R, "Qf": self.Qf}

    def limited(self, controller: Controller) -> Controller:
        """The controller itself, or without limits."""
        return controller if self.clip else controller.unclipped()


def _noise(table: object) -> Noise:
    """The noise of a table.  Raises SettingsError: an unknown key, or a value without meaning."""
    if isinstance(table, Noise):
        return table
    if not isinstance(table, Mapping):
        raise SettingsError(f"noise is {table!r:.60}; give a table")
    known = [field.name for field in dataclasses.fields(Noise)]
    for key in table:
        if key not in known:
            raise SettingsError(unknown_key("noise", key, known))
    with located("noise."):
        return Noise(**table)


class Criteria(Table):
    """The quantities that estimates are evaluated by, the table ``[evaluation]``.

    Parameters
    ----------
    trajectories : planned, steered and flown with what was identified
    keep_paths : keep the paths of these flights, and those that were planned
    parameters : compare parameters with the pseudo-true ones of the flight that was recorded
    """

    PLACE: ClassVar[str] = "evaluation"

    trajectories: tuple[Annotated[Text, OneOf(MISSIONS)], ...] = Field(description="a list of one or more")
    keep_paths: Flag = False
    parameters: Flag = False

    @field_validator("trajectories")
    @classmethod
    def _each_once(cls, trajectories: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(trajectories))

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if not self.trajectories and not self.parameters:
            raise SettingsError("evaluation.trajectories is []; give a list of one or more")
        return self


# The study ------------------------------------------------------------------------------------------------------------
class Study(Table):
    """A grid of trials: at each level of an axis, data are flown, corrupted, identified from, and evaluated.

    Parameters
    ----------
    name, description : for tables and figures
    trials : at each level
    seed : trial k of a level depends on (seed, level, k) alone
    data : the flight that is recorded
    plant : the plant that flies, disturbances included
    noise : of the record
    methods : of identification, by label
    evaluation : of the estimates
    missions : the trajectories of the evaluation
    control : of the flight that is recorded, and of those of the evaluation
    axis : the quantity that varies

    Raises
    ------
    SettingsError
        A key is missing, unknown or holds something else, or the plant cannot fly a trajectory.
    """

    kind: ClassVar[Kind] = STUDY
    """Kind of the store."""

    name: Text
    description: Text = ""
    trials: Count
    seed: Whole = 0
    data: FlightChoice
    plant: PlantChoice
    noise: Annotated[Noise, PlainValidator(_noise), PlainSerializer(dataclasses.asdict)] = Noise()
    methods: Annotated[
        dict[str, Annotated[InstanceOf[MethodChoice], PlainSerializer(MethodChoice.to_dict)]],
        BeforeValidator(methods_of),
    ]
    evaluation: Criteria
    missions: Missions = Missions.from_dict({})
    control: ControlChoice = ControlChoice.from_dict({})
    axis: Axis

    @model_validator(mode="after")
    def _can_be_flown(self) -> Self:
        missions = [("evaluation.trajectories", x, getattr(self.missions, x)) for x in self.evaluation.trajectories]
        for key, trajectory, arguments in [("data.trajectory", self.data.trajectory, self.data.arguments), *missions]:
            with located(f"{key} has {trajectory!r}: "):
                _check_flown(trajectory, self.plant.plant.model, arguments)
        with located("control."):
            check_weights(self.plant.plant.model, **self.control.weights)
        return self

    @classmethod
    def from_dict(cls, table: object) -> Self:
        """The study that the tables of a TOML file describe, every level checked.

        Raises
        ------
        SettingsError
            A key is missing, unknown or holds something else; the message names it and what is valid.
        """
        study = super().from_dict(table)
        for level in study.axis.levels:
            with located(f"axis: at level {level}, ", DiransacError):
                study.at(level)
        return study

    @property
    def evaluate_parameters(self) -> bool:
        """True if estimates are compared with the pseudo-true parameters of each trial's flight."""
        return self.evaluation.parameters

    def at(self, level: str) -> Study:
        """The study at one level.

        A level with another trajectory for data, or another kind of plant, keeps the arguments that were given, and not
        the defaults.

        Raises
        ------
        SettingsError
            There is no such level, or its changes have no meaning.
        """
        (changes,) = self.axis.subset([level]).levels.values()
        own = {path: value for path, value in changes.items() if self._concerns(path)}
        return Study.model_validate(changed(self._without_defaults(own), own))

    def _without_defaults(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """The study's tables, without default arguments of a function that the changes replace by another."""
        table = self.to_dict()
        for part, key, choice_type in (("data", "trajectory", FlightChoice), ("plant", "kind", PlantChoice)):
            choice = {key: table[part][key]}
            if changes.get(f"{part}.{key}", choice[key]) != choice[key]:
                defaults = choice_type.from_dict(choice).to_dict()
                given = {name: value for name, value in table[part].items() if defaults.get(name) != value}
                table[part] = {**choice, **given}
        return table

    def _concerns(self, path: str) -> bool:
        """False for a path of the axis that leads to a method which is not in this subset of the study.

        Raises SettingsError: the path leads to a table that is the same at every level.
        """
        variable = ("plant", "data", "noise", "methods", "missions", "control")
        root, *way = path.split(".")
        if root not in variable or not way:
            raise SettingsError(f'"{path}" cannot vary; there are {", ".join(f"{name}.*" for name in variable)}')
        if root == "methods" and way[1:] == ["preset"]:
            raise SettingsError(f'"{path}" cannot vary: levels change settings; give two methods, a preset each')
        return root != "methods" or way[0] in self.methods

    def subset(
        self,
        trials: int | None = None,
        levels: Sequence[str | float] | None = None,
        methods: Sequence[str] | None = None,
    ) -> Study:
        """The same study with another number of trials, at some levels, of some methods; None keeps all.

        Raises
        ------
        SettingsError
            There is no such level or method, or fewer than one trial.
        """
        chosen = list(self.methods) if methods is None else list(methods)
        unknown = [label for label in chosen if label not in self.methods]
        if unknown or not chosen:
            which = f'no method "{unknown[0]}"' if unknown else "no method named"
            raise SettingsError(f"there is {which}; there are {', '.join(self.methods)}")
        if trials is not None:
            check_whole("trials", trials, least=1)
        return self.model_copy(
            update={
                "trials": self.trials if trials is None else trials,
                "axis": self.axis if levels is None else self.axis.subset([str(level) for level in levels]),
                "methods": {label: self.methods[label] for label in chosen},
            }
        )

    # Members of `Work` -----------------------------------------------------------------------------------------------
    @property
    def asked(self) -> dict[Key, tuple[str | None, ...]]:
        """Level, trial and method of each row.  Raises SettingsError: there are too many."""
        n_rows, most = len(self.axis.levels) * self.trials * len(self.methods), 1_000_000
        if n_rows > most:
            raise SettingsError(f"the study has {n_rows:,} rows, {most:,} at most are run; give fewer trials")
        trials = range(self.trials)
        return {(x, k, label): () for x in self.axis.levels for k in trials for label in self.methods}

    @property
    def columns(self) -> dict[str, str]:
        """SQL type of each column of a row."""
        model = self.plant.plant.model
        kinds = ("parameter", "pseudo_true", "low", "high") if self.evaluate_parameters else ("parameter",)
        return {
            "seed": "INTEGER NOT NULL",
            **{f"{kind}_{name}": "REAL" for kind in kinds for name in model.parameters},
            **dict.fromkeys(("fit_error", "inlier_fraction"), "REAL"),
            "iterations": "INTEGER",
            "stop_reason": "TEXT",
            **{f"{shape}_{state}": "REAL" for shape in self.evaluation.trajectories for state in model.state},
            "paths": "BLOB",
            "seconds": "TEXT NOT NULL",
        }

    @property
    def about(self) -> dict[str, Any]:
        """Names and descriptions, and properties of each level's plant."""
        plants = {x: dataclasses.asdict(PlantFacts.of(self.at(x).plant.plant)) for x in self.axis.levels}
        about = {"name": self.name, "description": self.description, "axis": self.axis.name, "unit": self.axis.unit}
        return {**about, "plants": plants}

    @property
    def configuration(self) -> dict[str, dict[str, Any]]:
        """The values that determine rows, by part and dotted path: ``study``, ``methods.<label>``, ``levels.<text>``.

        The number of trials, names and descriptions do not.
        """
        table = self.to_dict()
        decisive = {name: table[name] for name in ("seed", "plant", "data", "noise", "evaluation", "control")}
        missions = {name: table["missions"][name] for name in self.evaluation.trajectories}
        parts = {"study": dict(flat({**decisive, "missions": missions}))}
        for label, method in table["methods"].items():
            silent = [f"settings.{name}" for name in EXECUTION]
            parts[f"methods.{label}"] = {path: value for path, value in flat(method) if path not in silent}
        changes = {level: dict(some) or {"changes": "none"} for level, some in self.axis.levels.items()}
        return parts | {f"levels.{text}": some for text, some in changes.items()}


def _check_flown(trajectory: str, model: Model, arguments: Mapping[str, Any]) -> None:
    """Raises SettingsError: no model of this structure can fly the trajectory, or it has no such input."""
    (check_fully_actuated if trajectory == "multisine" else check_plane)(model)
    check_known(arguments.get("input_weights", {}), model.inputs, "input_weights names", "inputs are")
