"""The command ``design``: its options, and experiments of the limbs of a robot, or of another machine."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from diransac.cli import screen
from diransac.cli.arguments import is_result, model_file, numbers, pairs
from diransac.cli.commands import grouped
from diransac.cli.flight_options import FlightPicture, LogOutput
from diransac.cli.options import JsonFlag
from diransac.cli.outputs import staged
from diransac.cli.robot_options import RobotOptions, UnsaturatedRobot
from diransac.data.log import Log
from diransac.errors import ModelError
from diransac.identification.method import Progress
from diransac.identification.result import Result
from diransac.model import Model
from diransac.model.plant import Plant

if TYPE_CHECKING:
    from diransac.flight.planning import Experiment
    from diransac.flight.trajectory import Trajectory

app = typer.Typer(add_completion=False)


@dataclass(frozen=True)
class DesignOptions:
    """Options of `diransac.design_experiment`."""

    limits: Annotated[
        list[str] | None,
        typer.Option(
            "--limit",
            metavar="NAME=LOW:HIGH|NAME=SIZE,...",
            help="Range of a quantity, or its largest magnitude; {}_dot=5 for every joint; hand_z=0.1:0.8 for the "
            "place of a body. A robot's file has others.",
        ),
    ] = None
    assignments: Annotated[
        list[str] | None,
        typer.Option("--parameter", metavar="NAME=VALUE,...", help="Assumed parameters; by default nominal values."),
    ] = None
    noise: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=SD,...", help="Noise of signals; by default 1 % of inputs; {} as above."),
    ] = None
    duration: Annotated[float, typer.Option(metavar="S", help="Duration.")] = 20.0
    frequency: Annotated[float, typer.Option(metavar="HZ", help="Highest frequency.")] = 1.0
    rate: Annotated[float, typer.Option(metavar="HZ", help="Rows per second.")] = 100.0
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same motion.")] = 0
    time_limit: Annotated[float, typer.Option(metavar="S", help="End the search of a limb after so many seconds.")] = (
        60.0
    )

    def numbers_of(self) -> dict[str, Any]:
        """Arguments of `diransac.design_experiment` that are numbers."""
        names = ("duration", "frequency", "rate", "seed", "time_limit")
        return {name: getattr(self, name) for name in names}

    def plant(self, model: Model, known: Mapping[str, float]) -> Plant:
        """The model with its parameters.  Raises ModelError: one has no value."""
        values = {n: float(x.value) for n, x in model.parameters.items() if x.value is not None}
        values |= {n: x for n, x in known.items() if n in model.parameters}
        missing = [n for n in model.parameters if n not in values]
        if missing:
            raise ModelError(
                f'model "{model.name}": {", ".join(missing)} have no nominal value; give an assumed one by '
                f"--parameter {missing[0]}=..."
            )
        return Plant(model, values)


def _range(name: str, text: str) -> float | tuple[float, float]:
    """A largest magnitude, or a range."""
    try:
        low, colon, high = text.partition(":")
        return (float(low), float(high)) if colon else float(low)
    except ValueError as error:
        raise typer.BadParameter(f"--limit: {name}={text!r} is neither a number nor LOW:HIGH") from error


def _of_joints(given: Mapping[str, Any], limbs: Mapping[str, Model]) -> dict[str, Any]:
    """Values by name, those of patterns such as ``{}_dot`` for every coordinate; values of names themselves win."""
    patterns = {name: value for name, value in given.items() if "{}" in name}
    joints = [n for model in limbs.values() for n in model.coordinates]
    found = {name.replace("{}", n): value for name, value in patterns.items() for n in joints}
    return found | {name: value for name, value in given.items() if name not in patterns}


def _own(values: Mapping[str, Any], limbs: Mapping[str, Model], limb: str, places: Mapping[str, str]) -> dict[str, Any]:
    """Values of a limb's quantities: those whose names do not belong to another limb."""
    from diransac.model.robots.actuation import FORCE

    models = [model for other, model in limbs.items() if other != limb]
    others = {n for model in models for n in (*model.units, *map(FORCE.format, model.coordinates))}
    return {n: x for n, x in values.items() if n not in others and places.get(n, limb) == limb}


def _places(machine: UnsaturatedRobot, limits: Iterable[str]) -> dict[str, str]:
    """Limits on the positions of bodies, with the limb that moves the body.

    Raises typer.BadParameter: several limbs move it.
    """
    found = {}
    for limit in limits:
        name, moved = machine.bodies.get(limit[:-2], ("", frozenset[str]()))
        # Endings of the names of positions of bodies.
        if not name or limit[-2:] not in ("_x", "_y", "_z"):
            continue
        limbs = [limb for limb, own in machine.limbs.items() if moved <= set(own.coordinates)]
        if not limbs:
            movers = ", ".join(sorted(moved))
            raise typer.BadParameter(
                f"--limit: {movers} move {name}, which are designed apart; limit these instead of {limit}"
            )
        found[limit] = limbs[0]
    return found


def _outputs(machine: UnsaturatedRobot, limb: Model, places: Iterable[str]) -> Callable[..., dict[str, Any]] | None:
    """Forces of a limb's drives, and positions of its bodies that are limited; None without a description."""
    if machine.drives is None or machine.position is None:
        return None
    from diransac.model.robots import drive_forces

    bodies = dict.fromkeys(machine.bodies[name[:-2]][0] for name in places)
    parts = [drive_forces(machine.drives, list(limb.coordinates)), *map(machine.position, bodies)]
    return lambda *at: {name: x for part in parts for name, x in part(*at).items()}


@dataclass(frozen=True)
class Designs:
    """Experiments by limb, which are run together; of another machine one, under an empty name."""

    experiments: Mapping[str, Experiment]

    @property
    def motion(self) -> Trajectory:
        """Designed motion of all limbs."""
        return _joined(list(self.experiments.values()))

    def log(self, motion: Trajectory) -> Log:
        """States and inputs of a motion of all limbs."""
        names = (*motion.state_names, *motion.input_names)
        units = {n: unit for x in self.experiments.values() for n, unit in x.units.items() if n in names}
        return Log.from_arrays(motion.time, {n: motion[n] for n in names}, units=units)

    def draw(self, path: Path) -> None:
        """Write a figure of the designed motion and the plain one."""
        from diransac.plots import plot_flight

        plain = [x.multisine for x in self.experiments.values() if x.multisine is not None]
        motions = {"designed": self.motion, "plain multisine": _joined(plain)}
        plot_flight(motions, {name: self.log(motion) for name, motion in motions.items()}, path)

    def to_dict(self) -> dict[str, Any]:
        """Experiment, or experiments by limb."""
        found = {limb: experiment.to_dict() for limb, experiment in self.experiments.items()}
        return found[""] if list(found) == [""] else {"limbs": found}

    def __str__(self) -> str:
        return "\n\n".join(f"{limb}: {x}".removeprefix(": ") for limb, x in self.experiments.items())


def _joined(parts: Sequence[Trajectory]) -> Trajectory:
    """Trajectory with the states and inputs of all parts."""
    from diransac.flight.trajectory import Trajectory

    return Trajectory(
        parts[0].time,
        np.hstack([x.states for x in parts]),
        np.hstack([x.inputs for x in parts]),
        tuple(n for x in parts for n in x.state_names),
        tuple(n for x in parts for n in x.input_names),
        {n: pair for x in parts for n, pair in x.input_limits.items()},
    )


def designed(model: str, robot: RobotOptions, options: DesignOptions) -> Designs:
    """Experiments of a machine: of what ``identify`` saved, of a model, or of the limbs of a robot.

    Raises as `diransac.design_experiment`; typer.BadParameter: an option cannot be read.
    """
    from diransac.flight.planning import design_experiment

    assumed, known = numbers("--parameter", options.assignments or ()), dict[str, float]()
    if is_result(model):
        result = Result.load(model)
        machine, known = UnsaturatedRobot({"": result.model}, {}), dict(result.parameters)
    else:
        machine = robot.load_unsaturated(model)
    limbs = machine.limbs
    every = [n for own in limbs.values() for n in own.parameters]
    for name in assumed:
        if name not in every:
            raise typer.BadParameter(f"--parameter: there is no {name!r}; there are {', '.join(every)}")
    given = {name: _range(name, text) for name, text in pairs("--limit", options.limits or ()).items()}
    limits = {**machine.limits, **_of_joints(given, limbs)}
    noise = _of_joints(numbers("--noise", options.noise or ()), limbs)
    places, found = _places(machine, limits), {}
    for limb, own in limbs.items():
        with screen.bar(f"design {limb}".rstrip()) as show:
            found[limb] = design_experiment(
                options.plant(own, known | assumed),
                limits=_own(limits, limbs, limb, places),
                noise=_own(noise, limbs, limb, {}) or None,
                outputs=_outputs(machine, own, [name for name, of in places.items() if of == limb]),
                progress=lambda stage, fraction, show=show: show(Progress(stage, fraction)),  # type: ignore[misc]
                **options.numbers_of(),
            )
    return Designs(found)


@app.command("design")
@grouped
def _design(
    model: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE.py[:NAME]|FILE.xml|MODEL.json",
            help="A built-in model, one of yours, a robot's MJCF or URDF, or what identify saved.",
        ),
    ],
    robot: RobotOptions,
    options: DesignOptions,
    output: LogOutput,
    plot: FlightPicture = None,
    as_json: JsonFlag = False,
) -> None:
    """Design a motion within limits from which parameters are identified best, and predict their standard errors."""
    with staged([output, plot], [model_file(model)]) as (written, picture):
        designs = designed(model, robot, options)
        designs.log(designs.motion).write(written)
        if plot:
            designs.draw(picture)
        screen.show(designs, as_json)
