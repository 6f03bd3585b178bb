"""The options of commands that fly: what is flown, what machine flies, what spoils its log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from diransac.cli.arguments import numbers
from diransac.cli.options import output_file
from diransac.data.writing import ENDINGS
from diransac.errors import ModelError
from diransac.flight.noise import Noise
from diransac.model import Model
from diransac.model.library import TABLE_I, extended_rotorcraft, planar_rotorcraft
from diransac.model.plant import Plant

__all__ = [
    "SHAPES",
    "FlightPicture",
    "FlightSeed",
    "LogOutput",
    "OptionalLogOutput",
    "Recorder",
    "TrajectoryArgument",
    "TrajectoryOption",
    "TruePlant",
]

SHAPES = ("star", "square", "sine")
EXTENDED = "extended-rotorcraft"


def _one_of(*choices: str) -> Callable[[str | None], str | None]:
    """What lets a word pass if it is one of these; None stays None."""

    def check(word: str | None) -> str | None:
        if word is not None and word not in choices:
            raise typer.BadParameter(f"{word!r} is not one of {', '.join(choices)}")
        return word

    return check


def _finite(number: float | None) -> float | None:
    if number is not None and not isfinite(number):
        raise typer.BadParameter(f"{number} is not finite; give a number")
    return number


def _angle(text: str) -> float | str:
    """Radians, or the word ``any``."""
    try:
        return text if text == "any" else float(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is neither a number of radians nor any") from error


def _steps(text: str) -> float | dict[str, float]:
    """One number, or numbers by name."""
    try:
        return float(text)
    except ValueError:
        return numbers("--quantisation", [text])


def _log_file(text: str) -> Path:
    path = output_file(text)
    if not path.name.lower().endswith(ENDINGS):
        raise typer.BadParameter(f"{text!r} has an ending that is not known; use one of {', '.join(ENDINGS)}")
    return path


def _picture_file(text: str) -> Path:
    path = output_file(text)
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise typer.BadParameter(f"{text!r} has an ending that is not known; use one of .png, .svg, .pdf")
    return path


_SHAPE = "|".join(SHAPES)
_LOG_NAMES: dict[str, Any] = {"parser": _log_file, "metavar": "FILE.csv"}

TrajectoryArgument = Annotated[
    str, typer.Argument(metavar=_SHAPE, callback=_one_of(*SHAPES), help="What is flown: section V of the paper.")
]
TrajectoryOption = Annotated[
    str, typer.Option("--trajectory", metavar=_SHAPE, callback=_one_of(*SHAPES), help="What is flown.")
]
LogOutput = Annotated[
    Path, typer.Option("--output", "-o", help=f"Where to write the log: {', '.join(ENDINGS)}.", **_LOG_NAMES)
]
OptionalLogOutput = Annotated[
    Path | None, typer.Option("--output", "-o", help="Where to write the log of the flight.", **_LOG_NAMES)
]
FlightPicture = Annotated[
    Path | None,
    typer.Option("--plot", parser=_picture_file, metavar="FILE.png", help="Where to draw the flight, as it was."),
]
FlightSeed = Annotated[int, typer.Option("--seed", min=0, help="The same seed gives the same flight and log.")]


def _plant_option(*names: str, **about: Any) -> Any:
    return typer.Option(*names, rich_help_panel="The machine that flies", **about)


@dataclass(frozen=True)
class TruePlant:
    """The machine that flies: the model's own equations, or those and more."""

    plant: Annotated[
        str | None,
        _plant_option(
            metavar=EXTENDED,
            callback=_one_of(EXTENDED),
            help="A disturbed machine; without it, the model itself flies.",
        ),
    ] = None
    assignments: Annotated[
        list[str] | None,
        _plant_option(
            "--parameter",
            metavar="NAME=VALUE",
            help="A true parameter, repeatable. The planar rotorcraft has those of Table I already.",
        ),
    ] = None
    aerodynamic_imbalance: Annotated[
        float | None, _plant_option(metavar="M4", callback=_finite, help="Of each rotor; Table II: 1.0e-6 to 1.8e-6.")
    ] = None
    mass_imbalance: Annotated[
        float | None, _plant_option(metavar="KG", callback=_finite, help="Of each rotor; Table II: 6e-5 to 1.4e-4.")
    ] = None
    convention: Annotated[
        str | None,
        _plant_option(
            metavar="physical|printed",
            callback=_one_of("physical", "printed"),
            show_default="physical",
            help="Imbalance is forces, or added to accelerations as eq. (20) is printed.",
        ),
    ] = None
    phase: Annotated[
        str | None,
        _plant_option(
            metavar="integrated|instantaneous",
            callback=_one_of("integrated", "instantaneous"),
            show_default="integrated",
            help="Of the rotors; instantaneous as eq. (14) is printed.",
        ),
    ] = None
    blade_flapping: Annotated[
        float | None, _plant_option(metavar="RAD", callback=_finite, help="Tilt for each unit of advance ratio.")
    ] = None
    rotor_phase: Annotated[
        Any,
        _plant_option(
            parser=_angle, metavar="RAD|any", show_default="0", help="At the start; any: drawn with the seed."
        ),
    ] = None

    def of(self, model: Model) -> Plant:
        """The machine: a disturbed one if it is asked for, else the model with its true parameters.

        Raises ModelError: a parameter is unknown, outside its bounds, or missing where Table I has none.
        Raises typer.BadParameter: disturbances without a plant that has them.
        """
        given = numbers("--parameter", self.assignments or ())
        disturbances = self._disturbances()
        if self.plant is None and disturbances:
            option = next(iter(disturbances)).replace("_", "-")
            raise typer.BadParameter(f"--{option} is that of --plant {EXTENDED}, which is not given; give both")
        if self.plant is None:
            return Plant(model, _true_parameters(model, given))
        parameters = _true_parameters(planar_rotorcraft(), given)
        if disturbances.get("rotor_phase") == "any":
            disturbances["rotor_phase"] = None
        return extended_rotorcraft(parameters=parameters, **disturbances)

    def _disturbances(self) -> dict[str, Any]:
        """What is given of the arguments that `extended_rotorcraft` takes."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("plant", "assignments")}
        return {name: value for name, value in own.items() if value is not None}


def same_equations(a: Model, b: Model) -> bool:
    """Whether two models have the same signals, inputs, parameters and equations, whatever they are called."""
    one, other = a.to_dict(), b.to_dict()
    return all(one[key] == other[key] for key in one if key not in ("name", "description", "checksum"))


def _true_parameters(model: Model, given: Mapping[str, float]) -> dict[str, float]:
    """The values that are given, over those of Table I where the model is the paper's.

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
    for name, bounds in model.parameters.items():
        if not bounds.admits(values[name]):
            raise ModelError(f'"{model.name}" cannot have {name} = {values[name]:g}, which is outside its bounds')
    return values


def _noise_option(*names: str, **about: Any) -> Any:
    return typer.Option(*names, rich_help_panel="What spoils the log", **about)


def _share(*names: str, **about: Any) -> Any:
    return _noise_option(*names, min=0.0, max=1.0, metavar="P", **about)


def _length(*names: str, **about: Any) -> Any:
    return _noise_option(*names, min=1.0, metavar="ROWS", **about)


@dataclass(frozen=True)
class Recorder:
    """What spoils the log: the fields of `Noise`, under the names that users type."""

    outlier_probability: Annotated[
        float | None, _share("--outliers", help="Probability that a value is an outlier; with --magnitude.")
    ] = None
    outlier_magnitude: Annotated[
        float | None, _noise_option("--magnitude", min=0.0, metavar="A", help="An outlier adds uniform(-A, A).")
    ] = None
    acceleration_std: Annotated[
        float | None, _noise_option("--acceleration-noise", min=0.0, metavar="M/S2", help="Standard deviation.")
    ] = None
    rate_std: Annotated[
        float | None, _noise_option("--rate-noise", min=0.0, metavar="RAD/S", help="Standard deviation.")
    ] = None
    angular_acceleration_std: Annotated[
        float | None,
        _noise_option(
            "--angular-acceleration-noise",
            min=0.0,
            metavar="RAD/S2",
            show_default="--rate-noise over the sampling time",
            help="Standard deviation.",
        ),
    ] = None
    integrated: Annotated[
        str | None,
        _noise_option(
            "--integrated-noise",
            metavar="white|random-walk",
            callback=_one_of("white", "random-walk"),
            show_default="white",
            help="What the noise of velocities and positions is.",
        ),
    ] = None
    first_row: Annotated[
        str | None,
        _noise_option(
            metavar="clean|corrupted",
            callback=_one_of("clean", "corrupted"),
            show_default="clean",
            help="Spare the first row, or none.",
        ),
    ] = None
    burst_probability: Annotated[
        float | None, _share("--bursts", help="That a run of outliers starts; with --magnitude.")
    ] = None
    burst_length: Annotated[float | None, _length("--burst-length", show_default="10", help="Mean.")] = None
    stuck_probability: Annotated[
        float | None, _share("--stuck", help="Probability that a run of repeated values starts.")
    ] = None
    stuck_length: Annotated[float | None, _length("--stuck-length", show_default="10", help="Mean.")] = None
    dropout_probability: Annotated[float | None, _share("--dropouts", help="That values go missing.")] = None
    dropout_length: Annotated[float | None, _length("--dropout-length", show_default="10", help="Mean.")] = None
    correlated: Annotated[
        bool | None,
        _noise_option(
            "--correlated",
            help="Bursts, stuck values and dropouts occur in the same rows of all signals.",
            show_default=False,
        ),
    ] = None
    leverage_probability: Annotated[
        float | None, _share("--leverage", help="Of one-sided offsets where --leverage-signal is largest.")
    ] = None
    leverage_offset: Annotated[
        float | None, _noise_option(metavar="A", callback=_finite, help="Such an offset is uniform(0, A).")
    ] = None
    leverage_signal: Annotated[str | None, _noise_option(metavar="NAME", help="Such as thrust.")] = None
    leverage_quantile: Annotated[
        float | None, _share("--leverage-quantile", show_default="0.7", help="Above which it counts as large.")
    ] = None
    delay: Annotated[
        float | None, _noise_option(min=0.0, metavar="S", help="Signals lag behind inputs by so much.")
    ] = None
    quantisation: Annotated[
        Any,
        _noise_option(
            parser=_steps, metavar="STEP|NAME=STEP,...", help="Rounding: a share of the range, or steps by signal."
        ),
    ] = None

    def noise(self) -> Noise:
        """The noise that is asked for.

        Raises SettingsError: a value has no meaning.
        Raises typer.BadParameter: an option is given without one that it needs.
        """
        given = {f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None}
        for name, others in _COMPANY.items():
            if name in given and not any(other in given for other in others):
                wanted = " or ".join(map(_option_of, others))
                raise typer.BadParameter(f"{_option_of(name)} means nothing without {wanted}; give both")
        return Noise(**given)


_COMPANY = {
    "outlier_probability": ("outlier_magnitude",),
    "outlier_magnitude": ("outlier_probability", "burst_probability"),
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
"""What needs one of others to mean anything."""


def _option_of(name: str) -> str:
    """What users type for a field of `Recorder`."""
    about = get_type_hints(Recorder, include_extras=True)[name].__metadata__[0]
    return about.default if isinstance(about.default, str) else f"--{name.replace('_', '-')}"
