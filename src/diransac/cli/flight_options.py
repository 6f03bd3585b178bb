"""Options of the flying commands: trajectory, plant, and noise of the log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_type_hints

import typer

from diransac.cli.arguments import numbers
from diransac.cli.options import output_file, output_or_stdout
from diransac.data.files import ENDINGS
from diransac.errors import ModelError
from diransac.flight.noise import Noise
from diransac.model import Model
from diransac.model.library import TABLE_I, extended_rotorcraft, planar_rotorcraft
from diransac.model.plant import Plant, check_possible

T = TypeVar("T")

Shape: TypeAlias = Literal["star", "square", "sine"]


def _finite(number: float | None) -> float | None:
    """Callback that accepts None and finite numbers."""
    if number is not None and not isfinite(number):
        raise typer.BadParameter(f"{number} is not finite; give a number")
    return number


def _angle(text: str) -> float | str:
    """Angle in rad, or the word ``any``."""
    try:
        return text if text == "any" else float(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is neither a number of radians nor any") from error


def _steps(text: str) -> float | dict[str, float]:
    """One step, or steps by name."""
    try:
        return float(text)
    except ValueError:
        return numbers("--quantisation", [text])


def _log_file(text: str) -> Path:
    """Path of a log."""
    path = output_or_stdout(text)
    if text != "-" and not path.name.lower().endswith(ENDINGS):
        raise typer.BadParameter(f"{text!r} has an ending that is not known; use one of {', '.join(ENDINGS)}")
    return path


def _picture_file(text: str) -> Path:
    """Path of a figure."""
    path = output_file(text)
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise typer.BadParameter(f"{text!r} has an ending that is not known; use one of .png, .svg, .pdf")
    return path


_LOG_NAMES: dict[str, Any] = {"parser": _log_file, "metavar": "FILE.csv|-"}

TrajectoryArgument = Annotated[Shape, typer.Argument(help="Trajectory, section V of the paper.")]
TrajectoryOption = Annotated[Shape, typer.Option("--trajectory", help="Trajectory.")]
LogOutput = Annotated[Path, typer.Option("--output", "-o", help=f"Log to write: {', '.join(ENDINGS)}.", **_LOG_NAMES)]
OptionalLogOutput = Annotated[
    Path | None, typer.Option("--output", "-o", help="Log of the flight to write.", **_LOG_NAMES)
]
FlightPicture = Annotated[
    Path | None,
    typer.Option(
        "--plot",
        parser=_picture_file,
        metavar="FILE.png",
        help="Figure to write: .png, .svg or .pdf; of flights, without noise.",
    ),
]
FlightSeed = Annotated[int, typer.Option("--seed", min=0, help="Seed of flight and noise.")]


# Plant and noise ------------------------------------------------------------------------------------------------------
Options: TypeAlias = Mapping[str, tuple[Any, str, str, Mapping[str, Any]]]
"""Field -> kind of its value, name of its option where it is not the field's, help, and what else Typer takes."""


def _options(panel: str, options: Options) -> Callable[[type[T]], type[T]]:
    """Make a class a dataclass whose fields are options of a panel of the help; None where not given."""

    def made(group: type[T]) -> type[T]:
        group.__annotations__ = {}
        for name, (kind, option, text, about) in options.items():
            declared = typer.Option(*([option] if option else []), rich_help_panel=panel, help=text, **about)
            group.__annotations__[name] = Annotated[kind | None if kind is not Any else Any, declared]
            setattr(group, name, None)
        return dataclass(frozen=True)(group)

    return made


def _given(group: Any) -> dict[str, Any]:
    """Options that are given, by field."""
    return {f.name: value for f in fields(group) if (value := getattr(group, f.name)) is not None}


_PROBABILITY = {"min": 0.0, "max": 1.0, "metavar": "P"}
_LENGTH = {"min": 1.0, "metavar": "ROWS", "show_default": "10"}


def _size(unit: str, **about: Any) -> dict[str, Any]:
    """A number from 0, in a unit."""
    return {"min": 0.0, "metavar": unit, **about}


def _number(unit: str) -> dict[str, Any]:
    """A finite number, in a unit."""
    return {"metavar": unit, "callback": _finite}


_PLANT: Options = {
    "plant": (Literal["extended-rotorcraft"], "", "Plant with disturbances; the model itself by default.", {}),
    "assignments": (list[str], "--parameter",
                    "True parameter, repeatable; by default Table I for the planar rotorcraft.",
                    {"metavar": "NAME=VALUE"}),
    "aerodynamic_imbalance": (float, "", "Aerodynamic imbalance of each rotor; Table II: 1.0e-6 to 1.8e-6.",
                              _number("M4")),
    "mass_imbalance": (float, "", "Mass imbalance of each rotor; Table II: 6e-5 to 1.4e-4.", _number("KG")),
    "convention": (Literal["physical", "printed"], "",
                   "Imbalance as forces and torques, or added to accelerations as in eq. (20).",
                   {"show_default": "physical"}),
    "phase": (Literal["integrated", "instantaneous"], "", "Rotor phase: integrated speed, or as in eq. (14).",
              {"show_default": "integrated"}),
    "blade_flapping": (float, "", "Tilt of the rotor disc per unit of advance ratio.", _number("RAD")),
    "rotor_phase": (Any, "", "Initial rotor phase; any: drawn with the seed.",
                    {"parser": _angle, "metavar": "RAD|any", "show_default": "0"}),
}  # fmt: skip


@_options("Plant", _PLANT)
class PlantOptions:
    """Plant: the model's equations, or these with disturbances."""

    def of(self, model: Model) -> Plant:
        """Plant with disturbances, if requested, else the model with its true parameters.

        Raises ModelError: a parameter is unknown, outside its bounds, or missing where Table I has none.
        Raises typer.BadParameter: disturbances without a plant that has them.
        """
        disturbances = _given(self)
        given = numbers("--parameter", disturbances.pop("assignments", ()))
        if disturbances.pop("plant", None) is None:
            for option in disturbances:
                raise typer.BadParameter(f"--{option.replace('_', '-')} needs --plant extended-rotorcraft; give both")
            return Plant(model, _true_parameters(model, given))
        parameters = _true_parameters(planar_rotorcraft(), given)
        if disturbances.get("rotor_phase") == "any":
            disturbances["rotor_phase"] = None
        return extended_rotorcraft(parameters=parameters, **disturbances)


def same_equations(a: Model, b: Model) -> bool:
    """True if two models have the same signals, inputs, parameters and equations; their names may differ."""
    one, other = a.to_dict(), b.to_dict()
    return all(one[key] == other[key] for key in one if key not in ("name", "description", "checksum"))


def _true_parameters(model: Model, given: Mapping[str, float]) -> dict[str, float]:
    """Given parameters, with those of Table I as defaults for the paper's model.

    Raises ModelError: a name is unknown, a value is missing or outside its bounds.
    """
    known = TABLE_I if same_equations(model, planar_rotorcraft()) else {}
    unknown = [name for name in given if name not in model.parameters]
    if unknown:
        raise ModelError(f'"{model.name}" has no parameter {unknown[0]}; there are {", ".join(model.parameters)}')
    values = {**known, **given}
    missing = [name for name in model.parameters if name not in values]
    if missing:
        wanted = " ".join(f"--parameter {name}=VALUE" for name in missing)
        raise ModelError(f'the true parameters of "{model.name}" are not known; give {wanted}')
    check_possible(model, values)
    return values


_NOISE: Options = {
    "outlier_probability": (float, "--outliers", "Probability of an outlier per sample; with --magnitude.",
                            _PROBABILITY),
    "outlier_magnitude": (float, "--magnitude", "Outliers add uniform(-A, A).", _size("A")),
    "outliers": (Literal["signals", "rows"], "--outliers-hit", "Each signal by itself, or all signals of a row.",
                 {"show_default": "signals"}),
    "acceleration_std": (float, "--acceleration-noise", "Standard deviation.", _size("M/S2")),
    "rate_std": (float, "--rate-noise", "Standard deviation.", _size("RAD/S")),
    "angular_acceleration_std": (float, "--angular-acceleration-noise", "Standard deviation.",
                                 _size("RAD/S2", show_default="--rate-noise over the sampling time")),
    "integrated": (Literal["white", "random-walk"], "--integrated-noise", "Noise of velocities and positions.",
                   {"show_default": "white"}),
    "first_row": (Literal["clean", "corrupted"], "", "First row: without noise and faults, or like the others.",
                  {"show_default": "clean"}),
    "burst_probability": (float, "--bursts",
                          "Probability per sample that a burst of outliers starts; with --magnitude.",
                          _PROBABILITY),
    "burst_length": (float, "--burst-length", "Mean length of bursts.", _LENGTH),
    "stuck_probability": (float, "--stuck", "Probability per sample that a run of repeated values starts.",
                          _PROBABILITY),
    "stuck_length": (float, "--stuck-length", "Mean length of these runs.", _LENGTH),
    "dropout_probability": (float, "--dropouts", "Probability per sample that a run of missing values starts.",
                            _PROBABILITY),
    "dropout_length": (float, "--dropout-length", "Mean length of these runs.", _LENGTH),
    "correlated": (bool, "--correlated", "Bursts, stuck values and dropouts occur in the same rows of all signals.",
                   {"show_default": False}),
    "leverage_probability": (float, "--leverage",
                             "Probability of a one-sided offset per sample where --leverage-signal is large.",
                             _PROBABILITY),
    "leverage_offset": (float, "", "One-sided offsets are uniform(0, A).", _number("A")),
    "leverage_signal": (str, "", "Signal that selects the rows of one-sided offsets, such as thrust.",
                        {"metavar": "NAME"}),
    "leverage_quantile": (float, "--leverage-quantile", "Quantile above which it is large.",
                          {**_PROBABILITY, "show_default": "0.7"}),
    "delay": (float, "", "Delay of the signals after the inputs.", _size("S")),
    "quantisation": (Any, "", "Quantisation step: fraction of the range, or steps by signal.",
                     {"parser": _steps, "metavar": "STEP|NAME=STEP,..."}),
}  # fmt: skip


@_options("Noise and faults of the log", _NOISE)
class NoiseOptions:
    """Noise and faults of the log: the fields of `Noise` as options."""

    def noise(self) -> Noise:
        """Noise of these options.

        Raises SettingsError: a value has no meaning.
        Raises typer.BadParameter: an option lacks another one that it needs.
        """
        given = _given(self)
        for name, others in _NEEDED.items():
            if name in given and not any(other in given for other in others):
                wanted = " or ".join(map(_option_of, others))
                raise typer.BadParameter(f"{_option_of(name)} needs {wanted}; give both")
        return Noise(**given)


_NEEDED = {
    "outlier_probability": ("outlier_magnitude",),
    "outlier_magnitude": ("outlier_probability", "burst_probability"),
    "outliers": ("outlier_probability",),
    "burst_probability": ("outlier_magnitude",),
    "burst_length": ("burst_probability",),
    "stuck_length": ("stuck_probability",),
    "dropout_length": ("dropout_probability",),
    "correlated": ("burst_probability", "stuck_probability", "dropout_probability"),
    "leverage_probability": ("leverage_offset",),
    "leverage_offset": ("leverage_signal",),
    "leverage_signal": ("leverage_probability",),
    "leverage_quantile": ("leverage_probability",),
    "integrated": ("acceleration_std", "rate_std"),
}
"""Field -> fields of which it needs one."""


def _option_of(name: str) -> str:
    """Name of the option of a field of `NoiseOptions`."""
    about = get_type_hints(NoiseOptions, include_extras=True)[name].__metadata__[0]
    return about.default if isinstance(about.default, str) else f"--{name.replace('_', '-')}"
