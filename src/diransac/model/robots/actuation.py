"""Forces of a robot's drives: measured torques, position control, motor currents.

Names of columns are patterns in which ``{}`` stands for the joint's coordinate, such as ``des_{}`` for ``des_elbow``.
A setting is one number for all joints, or a mapping from the joint's coordinate.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import casadi as ca
import numpy as np

from diransac.errors import ModelError

FORCE = "{}_torque"
"""Name of the force of a joint's drive."""

UNKNOWN_GAIN = 'where the {} is not known, give 1, and the unknown "torque_gain", which it then is'
"""Advice on gains and constants of drives."""

PerJoint: TypeAlias = float | Mapping[str, float]


class Actuation(Protocol):
    """Drives of a robot."""

    def inputs(self, joint: str, units: tuple[str, str]) -> dict[str, str]:
        """Columns of the log on which the force of a joint depends, with units, from those of position and force."""

    def force(self, joint: str, q: Any, v: Any, u: Any) -> Any:
        """Force of a joint, N m or N, by its position and velocity, and by the inputs."""

    def largest_force(self, joint: str) -> float:
        """Magnitude at which the force of a joint saturates, N m or N; infinite if it does not."""


class _Saturating:
    """Drives with a limit."""

    limit: PerJoint | None

    def largest_force(self, joint: str) -> float:
        """Magnitude at which the force of a joint saturates, N m or N; infinite if it does not."""
        return np.inf if self.limit is None else _of_joint("limit", self.limit, joint)


@dataclass(frozen=True)
class JointTorques(_Saturating):
    """Measured forces of the joints.

    Parameters
    ----------
    torque : str, optional
        Pattern of the columns, N m of hinges, N of slides.
    limit : float or mapping of str to float, optional
        Largest magnitude, at which the force saturates.

    Raises
    ------
    ModelError
        A limit is not positive, or the pattern lacks ``{}``.
    """

    torque: str = FORCE
    limit: PerJoint | None = None

    def __post_init__(self) -> None:
        _check(self, patterns=("torque",), positive=("limit",))

    def inputs(self, joint: str, units: tuple[str, str]) -> dict[str, str]:
        """Column of the force."""
        return {self.torque.format(joint): units[1]}

    def force(self, joint: str, q: Any, v: Any, u: Any) -> Any:
        """``clip(torque)``."""
        return _saturated(u[self.torque.format(joint)], self.limit, joint)


@dataclass(frozen=True)
class PositionControl(_Saturating):
    """Position control of every joint: ``kp (target - q) + kd (target' - q') + feedforward``.

    Parameters
    ----------
    kp : float or mapping of str to float
        Stiffness, N m/rad or N/m. Where it is not known, 1 with ``kd=0`` and the unknown "torque_gain", which it is.
    kd : float or mapping of str to float, optional
        Damping, N m s/rad or N s/m.
    target : str, optional
        Pattern of the columns with the targets, rad or m.
    velocity : str, optional
        Pattern of the columns with the targets' velocities; None: zero.
    feedforward : str, optional
        Pattern of the columns with further forces; None: zero.
    limit : float or mapping of str to float, optional
        Largest magnitude, at which the force saturates.

    Raises
    ------
    ModelError
        A gain is missing, negative or not finite, a limit is not positive, or a pattern lacks ``{}``.
    """

    kp: PerJoint
    kd: PerJoint = 0.0
    target: str = "{}_target"
    velocity: str | None = None
    feedforward: str | None = None
    limit: PerJoint | None = None

    def __post_init__(self) -> None:
        _check(self, patterns=("target", "velocity", "feedforward"), positive=("limit",), non_negative=("kp", "kd"))
        _check_given(self, "kp")

    def inputs(self, joint: str, units: tuple[str, str]) -> dict[str, str]:
        """Columns of target, its velocity and the feedforward."""
        position, force = units
        patterns = {self.target: position, self.velocity: f"{position}/s", self.feedforward: force}
        return {pattern.format(joint): unit for pattern, unit in patterns.items() if pattern is not None}

    def gains(self, joint: str) -> tuple[float, float]:
        """Stiffness and damping of a joint."""
        return _of_joint("kp", self.kp, joint), _of_joint("kd", self.kd, joint)

    def force(self, joint: str, q: Any, v: Any, u: Any) -> Any:
        """``clip(kp (target - q) + kd (target' - q') + feedforward)``."""
        v_target = 0.0 if self.velocity is None else u[self.velocity.format(joint)]
        further = 0.0 if self.feedforward is None else u[self.feedforward.format(joint)]
        kp, kd = self.gains(joint)
        return _saturated(kp * (u[self.target.format(joint)] - q) + kd * (v_target - v) + further, self.limit, joint)


@dataclass(frozen=True)
class MotorCurrents(_Saturating):
    """Measured currents of the motors: ``gear constant current``.

    Parameters
    ----------
    constant : float or mapping of str to float
        Torque constant of the motor, N m/A. Where it, or the gear, is not known, 1 and the unknown "torque_gain", which
        is gear times constant.
    gear : float or mapping of str to float, optional
        Revolutions of the motor per revolution of the joint; rad/m of a slide.
    current : str, optional
        Pattern of the columns, A.
    limit : float or mapping of str to float, optional
        Largest magnitude, at which the force of the joint saturates.

    Raises
    ------
    ModelError
        The constant is missing, a number is not finite, a constant or limit is not positive, or the pattern lacks
        ``{}``.
    """

    constant: PerJoint
    gear: PerJoint = 1.0
    current: str = "{}_current"
    limit: PerJoint | None = None

    def __post_init__(self) -> None:
        _check(self, patterns=("current",), positive=("constant", "limit"), finite=("gear",))
        _check_given(self, "constant")

    def inputs(self, joint: str, units: tuple[str, str]) -> dict[str, str]:
        """Column of the current."""
        return {self.current.format(joint): "A"}

    def force_per_current(self, joint: str) -> float:
        """Force of a joint per ampere, N m/A or N/A."""
        return _of_joint("gear", self.gear, joint) * _of_joint("constant", self.constant, joint)

    def force(self, joint: str, q: Any, v: Any, u: Any) -> Any:
        """``clip(gear constant current)``."""
        return _saturated(self.force_per_current(joint) * u[self.current.format(joint)], self.limit, joint)


def drive_forces(actuation: Actuation, joints: Collection[str]) -> Callable[..., dict[str, Any]]:
    """Forces of the drives, ``elbow_torque``, as ``outputs`` of `diransac.design_experiment`.

    Parameters
    ----------
    actuation : Actuation
        Drives of the robot.
    joints : collection of str
        Coordinates with a drive.

    Returns
    -------
    callable
        ``(q, v, a, u, p)`` to the forces by name, N m or N; without those that are inputs themselves.
    """
    units = ("rad", "N m")

    def outputs(q: Any, v: Any, _a: Any, u: Any, _p: Any) -> dict[str, Any]:
        inputs = {name for joint in joints for name in actuation.inputs(joint, units)}
        forces = {FORCE.format(joint): joint for joint in joints}
        return {name: actuation.force(n, q[n], v[n], u) for name, n in forces.items() if name not in inputs}

    return outputs


def targets_among(drives: Mapping[str, Mapping[str, str]], units: Mapping[str, tuple[str, str]]) -> dict[str, str]:
    """Coordinate by the name of each input that is its target, or that of its velocity.

    Parameters
    ----------
    drives : mapping of str to mapping of str to str
        Inputs of each joint's drive, with units.
    units : mapping of str to (str, str)
        Units of each joint's position and force.
    """
    return {
        name: joint
        for joint, own in drives.items()
        for name, unit in own.items()
        if unit in (units[joint][0], f"{units[joint][0]}/s")
    }


def _of_joint(what: str, value: PerJoint, joint: str) -> float:
    """Value of a setting for a joint.  Raises ModelError: there is none."""
    if not isinstance(value, Mapping):
        return float(value)
    if joint not in value:
        raise ModelError(f"{what} is given for {', '.join(value) or 'no joint'}, but not for {joint}; give it, too")
    return float(value[joint])


def _saturated(force: Any, limit: PerJoint | None, joint: str) -> Any:
    if limit is None:
        return force
    largest = _of_joint("limit", limit, joint)
    return ca.fmin(ca.fmax(force, -largest), largest)


def _check(
    actuation: object,
    patterns: tuple[str, ...],
    positive: tuple[str, ...] = (),
    non_negative: tuple[str, ...] = (),
    finite: tuple[str, ...] = (),
) -> None:
    """Raises ModelError: a pattern or a number is none, or a number is out of range."""
    label = type(actuation).__name__
    for name in patterns:
        pattern = getattr(actuation, name)
        if pattern is not None and not (isinstance(pattern, str) and pattern.count("{}") == 1):
            raise ModelError(f'{label}: {name} is {pattern!r}; give a pattern of columns, such as "{{}}_{name}"')
    for name in (*positive, *non_negative, *finite):
        value = getattr(actuation, name)
        for number in value.values() if isinstance(value, Mapping) else [value] * (value is not None):
            if not _is_number(number):
                raise ModelError(f"{label}: {name} is {number!r}; give a number, or one for each joint by name")
            if (name in positive and number <= 0.0) or (name in non_negative and number < 0.0):
                raise ModelError(
                    f"{label}: {name} is {number:g}; give a {'positive' if name in positive else 'non-negative'} number"
                )


def _check_given(actuation: object, name: str) -> None:
    """Raises ModelError: a gain or a constant is None."""
    if getattr(actuation, name) is None:
        raise ModelError(f"{type(actuation).__name__}: {name} is None; {UNKNOWN_GAIN.format(name)}")


def _is_number(value: object) -> bool:
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return bool(is_number and np.isfinite(value))  # type: ignore[call-overload]  # a number
