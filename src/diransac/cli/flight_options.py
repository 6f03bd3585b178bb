"""Options of the flying commands: trajectory, plant, and noise of the log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from diransac.cli.arguments import numbers
from diransac.cli.options import output_file, output_or_stdout
from diransac.data.files import ENDINGS
from diransac.errors import ModelError
from diransac.flight.noise import Noise
from diransac.model import Model
from diransac.model.library import TABLE_I, extended_rotorcraft, planar_rotorcraft
from diransac.model.plant import Plant, check_possible

__all__ = [
    "SHAPES",
    "FlightPicture",
    "FlightSeed",
    "LogOutput",
    "NoiseOptions",
    "OptionalLogOutput",
    "PlantOptions",
    "TrajectoryArgument",
    "TrajectoryOption",
]

SHAPES = ("star", "square", "sine")
EXTENDED = "extended-rotorcraft"


def _one_of(*choices: str) -> Callable[[str | None], str | None]:
    """Callback that accepts None and these words."""

    def check(word: str | None) -> str | None:
        if word is not None and word not in choices:
            raise typer.BadParameter(f"{word!r} is not one of {', '.join(choices)}")
        return word

    return check


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


_SHAPE = "|".join(SHAPES)
_LOG_NAMES: dict[str, Any] = {"parser": _log_file, "metavar": "FILE.csv|-"}

TrajectoryArgument = Annotated[
    str, typer.Argument(metavar=_SHAPE, callback=_one_of(*SHAPES), help="Trajectory, section V of the paper.")
]
TrajectoryOption = Annotated[
    str, typer.Option("--trajectory", metavar=_SHAPE, callback=_one_of(*SHAPES), help="Trajectory.")
]
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


def _plant_option(*names: str, **about: Any) -> Any:
    """Option in the panel of the plant."""
    return typer.Option(*names, rich_help_panel="Plant", **about)


@dataclass(frozen=True)
class PlantOptions:
    """Plant: the model's equations, or these with disturbances."""

    plant: Annotated[
        str | None,
        _plant_option(
            metavar=EXTENDED,
            callback=_one_of(EXTENDED),
            help="Plant with disturbances; the model itself by default.",
        ),
    ] = None
    assignments: Annotated[
        list[str] | None,
        _plant_option(
            "--parameter",
            metavar="NAME=VALUE",
            help="True parameter, repeatable; by default Table I for the planar rotorcraft.",
        ),
    ] = None
    aerodynamic_imbalance: Annotated[
        float | None,
        _plant_option(
            metavar="M4", callback=_finite, help="Aerodynamic imbalance of each rotor; Table II: 1.0e-6 to 1.8e-6."
        ),
    ] = None
    mass_imbalance: Annotated[
        float | None,
        _plant_option(metavar="KG", callback=_finite, help="Mass imbalance of each rotor; Table II: 6e-5 to 1.4e-4."),
    ] = None
    convention: Annotated[
        str | None,
        _plant_option(
            metavar="physical|printed",
            callback=_one_of("physical", "printed"),
            show_default="physical",
            help="Imbalance as forces and torques, or added to accelerations as in eq. (20).",
        ),
    ] = None
    phase: Annotated[
        str | None,
        _plant_option(
            metavar="integrated|instantaneous",
            callback=_one_of("integrated", "instantaneous"),
            show_default="integrated",
            help="Rotor phase: integrated speed, or as in eq. (14).",
        ),
    ] = None
    blade_flapping: Annotated[
        float | None,
        _plant_option(metavar="RAD", callback=_finite, help="Tilt of the rotor disc per unit of advance ratio."),
    ] = None
    rotor_phase: Annotated[
        Any,
        _plant_option(
            parser=_angle, metavar="RAD|any", show_default="0", help="Initial rotor phase; any: drawn with the seed."
        ),
    ] = None

    def of(self, model: Model) -> Plant:
        """Plant with disturbances, if requested, else the model with its true parameters.

        Raises ModelError: a parameter is unknown, outside its bounds, or missing where Table I has none.
        Raises typer.BadParameter: disturbances without a plant that has them.
        """
        given = numbers("--parameter", self.assignments or ())
        disturbances = self._disturbances()
        if self.plant is None and disturbances:
            option = next(iter(disturbances)).replace("_", "-")
            raise typer.BadParameter(f"--{option} needs --plant {EXTENDED}; give both")
        if self.plant is None:
            return Plant(model, _true_parameters(model, given))
        parameters = _true_parameters(planar_rotorcraft(), given)
        if disturbances.get("rotor_phase") == "any":
            disturbances["rotor_phase"] = None
        return extended_rotorcraft(parameters=parameters, **disturbances)

    def _disturbances(self) -> dict[str, Any]:
        """Given arguments of `extended_rotorcraft`, by name."""
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("plant", "assignments")}
        return {name: value for name, value in own.items() if value is not None}


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


def _noise_option(*names: str, **about: Any) -> Any:
    """Option in the panel of noise and faults."""
    return typer.Option(*names, rich_help_panel="Noise and faults of the log", **about)


def _probability(*names: str, **about: Any) -> Any:
    """Option with a value from 0 to 1."""
    return _noise_option(*names, min=0.0, max=1.0, metavar="P", **about)


def _length(*names: str, **about: Any) -> Any:
    """Option with a mean length in rows."""
    return _noise_option(*names, min=1.0, metavar="ROWS", **about)


@dataclass(frozen=True)
class NoiseOptions:
    """Noise and faults of the log: the fields of `Noise` as options."""

    outlier_probability: Annotated[
        float | None, _probability("--outliers", help="Probability of an outlier per sample; with --magnitude.")
    ] = None
    outlier_magnitude: Annotated[
        float | None, _noise_option("--magnitude", min=0.0, metavar="A", help="Outliers add uniform(-A, A).")
    ] = None
    outliers: Annotated[
        str | None,
        _noise_option(
            "--outliers-hit",
            metavar="signals|rows",
            callback=_one_of("signals", "rows"),
            show_default="signals",
            help="Each signal by itself, or all signals of a row.",
        ),
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
            help="Noise of velocities and positions.",
        ),
    ] = None
    first_row: Annotated[
        str | None,
        _noise_option(
            metavar="clean|corrupted",
            callback=_one_of("clean", "corrupted"),
            show_default="clean",
            help="First row: without noise and faults, or like the others.",
        ),
    ] = None
    burst_probability: Annotated[
        float | None,
        _probability("--bursts", help="Probability per sample that a burst of outliers starts; with --magnitude."),
    ] = None
    burst_length: Annotated[
        float | None, _length("--burst-length", show_default="10", help="Mean length of bursts.")
    ] = None
    stuck_probability: Annotated[
        float | None, _probability("--stuck", help="Probability per sample that a run of repeated values starts.")
    ] = None
    stuck_length: Annotated[
        float | None, _length("--stuck-length", show_default="10", help="Mean length of these runs.")
    ] = None
    dropout_probability: Annotated[
        float | None, _probability("--dropouts", help="Probability per sample that a run of missing values starts.")
    ] = None
    dropout_length: Annotated[
        float | None, _length("--dropout-length", show_default="10", help="Mean length of these runs.")
    ] = None
    correlated: Annotated[
        bool | None,
        _noise_option(
            "--correlated",
            help="Bursts, stuck values and dropouts occur in the same rows of all signals.",
            show_default=False,
        ),
    ] = None
    leverage_probability: Annotated[
        float | None,
        _probability(
            "--leverage", help="Probability of a one-sided offset per sample where --leverage-signal is large."
        ),
    ] = None
    leverage_offset: Annotated[
        float | None, _noise_option(metavar="A", callback=_finite, help="One-sided offsets are uniform(0, A).")
    ] = None
    leverage_signal: Annotated[
        str | None,
        _noise_option(metavar="NAME", help="Signal that selects the rows of one-sided offsets, such as thrust."),
    ] = None
    leverage_quantile: Annotated[
        float | None, _probability("--leverage-quantile", show_default="0.7", help="Quantile above which it is large.")
    ] = None
    delay: Annotated[
        float | None, _noise_option(min=0.0, metavar="S", help="Delay of the signals after the inputs.")
    ] = None
    quantisation: Annotated[
        Any,
        _noise_option(
            parser=_steps,
            metavar="STEP|NAME=STEP,...",
            help="Quantisation step: fraction of the range, or steps by signal.",
        ),
    ] = None

    def noise(self) -> Noise:
        """Noise of these options.

        Raises SettingsError: a value has no meaning.
        Raises typer.BadParameter: an option lacks another one that it needs.
        """
        given = {f.name: value for f in fields(self) if (value := getattr(self, f.name)) is not None}
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
