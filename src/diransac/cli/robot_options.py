"""Options for models from descriptions of robots."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from diransac.cli.arguments import load_model, names, pairs
from diransac.model import Model
from diransac.model.parts import independent_parts
from diransac.user_files import is_description

if TYPE_CHECKING:
    from diransac.model.robots import Actuation, MotorCurrents, PositionControl

Drives = TypeVar("Drives", "PositionControl", "MotorCurrents")

_NUMBERS = {"kp", "kd", "limit", "constant", "gear"}


_option = partial(typer.Option, rich_help_panel="Robot, for --model FILE.xml or FILE.urdf")


@dataclass(frozen=True)
class UnsaturatedRobot:
    """Models of a robot's limbs whose drives do not saturate.

    Parameters
    ----------
    limbs : mapping of str to Model
        By name; a machine in one part has an empty one.
    limits : mapping of str to (float, float)
        Of joints and forces of drives, by the description and the drives.
    drives : Actuation, optional
        None: the machine has no description.
    bodies : mapping of str to (str, set of str)
        By name without special characters: name in the file, and coordinates that move the body; only if some do.
    position : callable, optional
        Position of a body by its name in the file, as `body_position` has it.
    """

    limbs: Mapping[str, Model]
    limits: Mapping[str, tuple[float, float]]
    drives: Actuation | None = None
    bodies: Mapping[str, tuple[str, frozenset[str]]] = field(default_factory=dict)
    position: Callable[[str], Callable[..., dict[str, Any]]] | None = None


@dataclass(frozen=True)
class RobotOptions:
    """Options of `diransac.models.robot`."""

    unknown: Annotated[
        str | None, _option(metavar="NAME,...", help="Unknown parameters of joints: armature,damping,friction, ...")
    ] = None
    control: Annotated[
        str | None, _option(metavar="kp=20,kd=1.5,...", help="Position control; target=des_{} names columns.")
    ] = None
    motor: Annotated[
        str | None, _option(metavar="constant=0.1,gear=9,...", help="Motors with measured currents, current=i_{}.")
    ] = None
    bodies: Annotated[
        str | None,
        _option(metavar="all|NAME,...", help="Bodies with unknown inertial parameters."),
    ] = None
    joints: Annotated[
        str | None, _option(metavar="NAME,...|{}_joint", help="Joints, as column=joint if names differ; or a pattern.")
    ] = None
    passive: Annotated[str | None, _option(metavar="NAME,...", help="Joints without a drive.")] = None
    base: Annotated[
        str | None, _option(metavar="held|measured", help="A floating base: held, or with a measured motion.")
    ] = None
    inertia: Annotated[
        str | None,
        _option(metavar="nearest|strict", help="Impossible inertias: nearest possible ones, or an error."),
    ] = None
    simulator: Annotated[
        str | None, _option(metavar="mujoco", help="Contacts, loops, tendons; --unknown KIND/NAME.FIELD,...")
    ] = None

    def load(self, model: str) -> Model:
        """The model that ``--model`` names.

        Raises typer.BadParameter: options for a robot belong to no other model; ModelError: as `load_model`.
        """
        if is_description(model):
            from diransac.model.library import mujoco, robot

            if self.simulator is None:
                return robot(model, **self._arguments())
            return mujoco(model, unknown=self._masks(), actuation=self._actuation())
        for given in (x.name for x in fields(self) if getattr(self, x.name) is not None):
            raise typer.BadParameter(f"--{given} is for the description of a robot (.xml, .urdf)")
        return load_model(model)

    def load_limbs(self, model: str) -> dict[str, Model]:
        """Models of a robot's limbs by name; of another model, itself under an empty name."""
        whole = self.load(model)
        limbs = independent_parts(whole) if is_description(model) and whole.has_equations else {}
        return limbs if len(limbs) > 1 else {"": whole}

    def load_unsaturated(self, model: str) -> UnsaturatedRobot:
        """A robot for whose inputs its equations can be solved; of another model, itself alone.

        Raises as `load`.
        """
        if not is_description(model):
            return UnsaturatedRobot({"": self.load(model)}, {})
        from diransac.model.library import body_position, coordinates_of_bodies, robot, robot_limits
        from diransac.model.robots import JointTorques
        from diransac.model.robots.mechanism import identifier

        arguments = self._arguments()
        given = self._actuation() or JointTorques()
        drives = replace(given, limit=None)
        whole = robot(model, **arguments | {"actuation": drives})
        chosen: dict[str, Any] = {"joints": arguments.get("joints"), "base": self.base}
        moving = coordinates_of_bodies(model, **chosen).items()
        bodies = {identifier(name): (name, frozenset(moved)) for name, moved in moving if moved}
        position = partial(body_position, model, **chosen)
        limits, limbs = robot_limits(model, actuation=given, **chosen), independent_parts(whole)
        return UnsaturatedRobot(limbs if len(limbs) > 1 else {"": whole}, limits, drives, bodies, position)

    def _masks(self) -> Sequence[str]:
        """Masks of what is unknown in a file that MuJoCo simulates.

        Raises typer.BadParameter: there are none, options belong to equations, or the simulator is unknown.
        """
        if self.simulator != "mujoco":
            raise typer.BadParameter(f"--simulator {self.simulator} is unknown; there is mujoco")
        for name in ("bodies", "joints", "passive", "base", "inertia"):
            if getattr(self, name) is not None:
                raise typer.BadParameter(f"--{name} belongs to equations; with --simulator, name it in --unknown")
        if self.unknown is None:
            raise typer.BadParameter('--simulator mujoco needs --unknown "body/trunk.mass,joint/*.damping"')
        return names(self.unknown)

    def _arguments(self) -> dict[str, Any]:
        found: dict[str, Any] = {"actuation": self._actuation(), "base": self.base}
        if self.unknown is not None:
            found["unknown"] = names(self.unknown)
        if self.passive is not None:
            found["passive"] = names(self.passive)
        if self.bodies is not None:
            found["bodies"] = "all" if self.bodies == "all" else names(self.bodies)
        if self.inertia is not None:
            found["inertia"] = self.inertia
        if self.joints is not None:
            listed = names(self.joints)
            found["joints"] = self.joints if "{}" in self.joints else listed
            if any("=" in x for x in listed):
                found["joints"] = pairs("--joints", [self.joints])
        return found

    def _actuation(self) -> PositionControl | MotorCurrents | None:
        if self.control is not None and self.motor is not None:
            raise typer.BadParameter("--control and --motor are two kinds of drives; give one")
        from diransac.model.robots import MotorCurrents, PositionControl

        if self.control is not None:
            return _made(PositionControl, "--control", self.control)
        return None if self.motor is None else _made(MotorCurrents, "--motor", self.motor)


def _made(kind: type[Drives], option: str, text: str) -> Drives:
    """A drive from ``key=value`` pairs.  Raises typer.BadParameter: a key is unknown, or a value is no number."""
    given, known = pairs(option, [text]), [x.name for x in fields(kind)]
    for key in given:
        if key not in known:
            raise typer.BadParameter(f"{option}: there is no {key!r}; there are {', '.join(known)}")
    needed = known[0]
    if needed not in given:
        alone = f"{option} {needed}=1 --unknown armature,damping,friction,torque_gain"
        raise typer.BadParameter(f"{option}: {needed} is missing; give {needed}=number, or, if unknown, {alone}")
    try:
        arguments: dict[str, Any] = {key: float(x) if key in _NUMBERS else x for key, x in given.items()}
        return kind(**arguments)
    except ValueError as error:
        raise typer.BadParameter(
            f"{option}: {error}; give {', '.join(sorted(_NUMBERS & set(known)))} as numbers"
        ) from error
