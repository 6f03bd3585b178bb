"""`robot`: a model of a robot from its description file."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.model import Model
from diransac.model.robots.actuation import FORCE, UNKNOWN_GAIN, Actuation, JointTorques
from diransac.model.robots.description import Description, read_description
from diransac.model.robots.inertias import moving_bodies, notes_on_inertias, with_unknown
from diransac.model.robots.mechanism import UNKNOWN, Mechanism, followed, identifier, ordered_couplings
from diransac.model.robots.reference import check_forces
from diransac.model.robots.rigid_body import position_of
from diransac.text_table import some

_OF_BODIES = re.compile(r"(mass|inertia|com|ipos|cent(re|er)|payload|h[xyz]|i[xyz]{2})(_|$)", re.IGNORECASE)
_OF_DRIVES = re.compile(r"(kp|kd|kv|kt|constant|gear|gain)(_|$)", re.IGNORECASE)
"""Names that people give to parameters that are not those of joints."""


def robot(
    path: str | Path,
    *,
    unknown: Collection[str] = ("armature", "damping", "friction"),
    actuation: Actuation | None = None,
    bodies: Collection[str] | str = (),
    joints: Collection[str] | Mapping[str, str] | str | None = None,
    passive: Collection[str] = (),
    friction_speed: float = 0.05,
    stribeck_speed: float = 0.2,
    gravity: Sequence[float] | None = None,
    base: str | None = None,
    inertia: str = "nearest",
) -> Model:
    """Model of a robot from its description: chains and trees of hinges and slides on a base that is fixed or measured.

    ``tau_i(q, q', q'') + armature q'' + damping q' + friction tanh(q' / s) + spring (q - q_0) = drive``

    with the inverse dynamics tau of the rigid bodies, gravity included. Everything that is not unknown has its value in
    the file. Contacts, limits of joints, and the file's actuators are no part of the model.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF; read by MuJoCo (``pip install 'diransac[robots]'``).
    unknown : collection of str, optional
        Unknown parameters of every joint: "armature", "damping", "friction" (Coulomb), "stribeck" (what friction at
        rest is more, ``stribeck tanh(q' / s) exp(-(q' / stribeck_speed)^2)``), "spring" (its stiffness), "offset" (a
        constant force), "torque_gain" (a factor of the drive's force), "encoder_bias" (reading less position,
        within half a turn). Parameters are named after both: ``armature_elbow``.
    actuation : Actuation, optional
        Forces of the drives: `JointTorques` (default: columns ``elbow_torque``), `PositionControl`, `MotorCurrents`.
    bodies : collection of str or "all", optional
        Bodies whose ten inertial parameters are unknown, about the origin of the body's frame: ``mass_hand``,
        ``hx_hand``, ... (first moments), ``Ixx_hand``, ... The model has their base parameters: those that
        no motion shows are left out, and those of which motions show a combination alone are grouped into one,
        ``Izz_hand_grouped``. ``Parameter.combination`` names its parts, as ``"Izz hand"``, with their weights.
    joints : collection of str, mapping of str to str, or str, optional
        Joints to be modelled, by name; or by coordinate, the name that log columns have: ``{"elbow": "joint_4"}``; or
        the pattern of their names, ``"{}_joint"``, in which ``{}`` stands for the coordinate.
        By default all, and each coordinate has the joint's name. Other joints are locked in the pose of the file;
        those that an equality constraint couples to a joint move with it.
    passive : collection of str, optional
        Coordinates without a drive.
    friction_speed : float, optional
        Speed s over which friction changes its sign, rad/s or m/s.
    stribeck_speed : float, optional
        Speed at which the Stribeck effect has fallen to 1/e, rad/s or m/s.
    gravity : sequence of float, optional
        In the frame of the world, m/s^2; by default the file's.
    base : str, optional
        A base with a free joint: "held" in the pose of the file, of a robot that hangs or is clamped; or "measured",
        with further inputs ``base_wx``, ... (angular velocity), ``base_wx_dot``, ... (angular acceleration) and
        ``base_fx``, ... (acceleration of its origin less gravity, which an accelerometer shows), all in its frame.
    inertia : {"nearest", "strict"}, optional
        Of a body that moves, is not in ``bodies``, and has an inertia that no body can have (zero, not positive
        definite, A + B < C), or no mass: the nearest possible one, or an error.

    Returns
    -------
    Model
        One coordinate per joint, the reading of its encoder. Nominal values of its parameters are the file's, those of
        unknown bodies with an impossible inertia a ball's; `Model.notes` name bodies with impossible inertias.
        `independent_parts` splits it into its limbs.

    Raises
    ------
    ModelError
        MuJoCo is not installed; the file cannot be read, or describes a closed loop or a ball joint; a name is unknown;
        nothing is unknown, or a body with unknown parameters does not move; nothing that a joint moves has a mass.

    References
    ----------
    Luh, Walker, Paul 1980 (recursive Newton-Euler algorithm); Gautier 1991 (base parameters).
    """
    if base not in (None, "held", "measured"):
        raise ModelError(f'base is {base!r}; give "held" or "measured", or None')
    if inertia not in ("nearest", "strict"):
        raise ModelError(f'inertia is {inertia!r}; give "nearest" or "strict"')
    description = read_description(path, base)
    if gravity is not None:
        description = replace(description, gravity=_vector(gravity, "gravity"))
    label = f'robot "{path}"'
    coordinates = _coordinates(label, description, joints)
    moved = set(coordinates.values())
    for coupling in ordered_couplings(label, description):
        moved |= {coupling.follower} if coupling.leader in moved else set()
    chosen = _bodies(description, bodies, moved)
    notes = notes_on_inertias(label, description, moved, chosen, strict=inertia == "strict")
    check_forces(label, description)
    mechanism = Mechanism(
        label=label,
        description=with_unknown(description, chosen),
        coordinates=coordinates,
        unknown=_unknown_of_joints(unknown, description),
        bodies=chosen,
        speeds=(_positive("friction_speed", friction_speed), _positive("stribeck_speed", stribeck_speed)),
    )
    model = mechanism.model(actuation or JointTorques(), _known_names("passive", passive, mechanism.coordinates))
    model.notes = notes
    return model


def robot_limits(
    path: str | Path,
    *,
    actuation: Actuation | None = None,
    joints: Collection[str] | Mapping[str, str] | str | None = None,
    base: str | None = None,
) -> dict[str, tuple[float, float]]:
    """Ranges of joints, their speeds and the forces of their drives, for `diransac.design_experiment`.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF.
    actuation : Actuation, optional
        Drives of the robot, whose own limits hold, too.
    joints, base
        As of `robot`.

    Returns
    -------
    dict of str to (float, float)
        By coordinate, ``elbow``, in rad or m, by speed, ``elbow_dot``, in rad/s or m/s (URDF; one of zero is none), and
        by force of the drive, ``elbow_torque``, in N m or N (as `drive_forces`). What the file does not limit on both
        sides is left out.

    Raises
    ------
    ModelError
        The file cannot be read, or a name is unknown.
    """
    _, description, chosen = _read(path, base, joints)
    found: dict[str, tuple[float, float]] = {}
    for name, joint in ((n, description.joints[k]) for n, k in chosen.items()):
        own = np.inf if actuation is None else actuation.largest_force(name)
        low, high = joint.force_limits
        speed = description.velocity_limits.get(joint.name, np.inf)
        found |= {name: joint.position_limits, f"{name}_dot": (-speed, speed)}
        found[FORCE.format(name)] = max(low, -own), min(high, own)
    return {name: pair for name, pair in found.items() if np.isfinite(pair).all()}


def body_position(
    path: str | Path,
    body: str,
    point: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    joints: Collection[str] | Mapping[str, str] | str | None = None,
    base: str | None = None,
) -> Callable[..., dict[str, Any]]:
    """Position of a point of a body, ``hand_x``, ``hand_y`` and ``hand_z``, as ``outputs`` of `design_experiment`.

    Limits of these are a workspace: ``limits={"hand_z": (0.05, 0.8)}``.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF.
    body : str
        Name of the body, or link.
    point : sequence of three floats, optional
        In the body's frame, m; its origin by default.
    joints, base
        As of `robot`.

    Returns
    -------
    callable
        ``(q, v, a, u, p)`` to the coordinates by name, m, in the frame of the world, or of a measured base.  The
        coordinates of the model must include those that `coordinates_of_bodies` has for this body.

    Raises
    ------
    ModelError
        The file cannot be read, a name is unknown, or the point is no point.
    """
    label, description, chosen = _read(path, base, joints)
    names = [x.name for x in description.bodies]
    i = names.index(_known_names("body", body, names)[0])
    couplings, needed = ordered_couplings(label, description), _moving(label, description, chosen)[i]
    at = _vector(point, "point")

    def outputs(q: Any, _v: Any, _a: Any, _u: Any, _p: Any) -> dict[str, Any]:
        found: list[Any] = [joint.reference for joint in description.joints]
        for name in needed:
            found[chosen[name]] = q[name]
        for coupling in couplings:
            found[coupling.follower] = followed(description, coupling, found)
        r = position_of(description, i, at.tolist(), found)
        return {f"{identifier(body)}_{axis}": r[k] for k, axis in enumerate("xyz")}

    return outputs


def coordinates_of_bodies(
    path: str | Path,
    *,
    joints: Collection[str] | Mapping[str, str] | str | None = None,
    base: str | None = None,
) -> dict[str, tuple[str, ...]]:
    """Coordinates that move each body of a robot.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF.
    joints, base
        As of `robot`.

    Returns
    -------
    dict of str to tuple of str
        By name of the body; none for a body that does not move.

    Raises
    ------
    ModelError
        The file cannot be read, or a name is unknown.
    """
    label, description, chosen = _read(path, base, joints)
    moving = _moving(label, description, chosen)
    return {body.name: names for body, names in zip(description.bodies, moving, strict=True)}


def _read(
    path: str | Path, base: str | None, joints: Collection[str] | Mapping[str, str] | str | None
) -> tuple[str, Description, dict[str, int]]:
    """Label of a robot in messages, its description, and the index of the joint of each coordinate."""
    label, description = f'robot "{path}"', read_description(path, base)
    return label, description, _coordinates(label, description, joints)


def _moving(label: str, description: Description, chosen: Mapping[str, int]) -> list[tuple[str, ...]]:
    """Coordinates that move each body."""
    owner = {k: name for name, k in chosen.items()}
    for coupling in ordered_couplings(label, description):
        if coupling.leader in owner:
            owner[coupling.follower] = owner[coupling.leader]
    found = list[tuple[str, ...]]()
    for i, body in enumerate(description.bodies):
        above = () if body.parent < 0 or i == description.base else found[body.parent]
        found.append(tuple(dict.fromkeys((*above, *(owner[k] for k in body.joints if k in owner)))))
    return found


# ---------------------------------------------------------------------- arguments


def _known_names(what: str, given: Collection[str], known: Collection[str]) -> tuple[str, ...]:
    """The names themselves, each once.  Raises ModelError: one is unknown."""
    names = (given,) if isinstance(given, str) else tuple(dict.fromkeys(given))
    for name in names:
        if name not in known:
            raise ModelError(f"{what}: there is no {name!r}; choose from {', '.join(known)}")
    return names


def _unknown_of_joints(given: Collection[str], description: Description) -> tuple[str, ...]:
    """Names of unknown parameters of joints.  Raises ModelError: one is unknown, or has its place elsewhere."""
    for name in (given,) if isinstance(given, str) else given:
        elsewhere = ""
        if "/" in name:
            elsewhere = "is a mask: dr.models.mujoco takes it (--simulator mujoco)"
        elif _OF_BODIES.match(name):
            bodies = some(body.name for body in description.bodies)
            elsewhere = f'belongs to bodies: name these with bodies= (--bodies), "all" or some of {bodies}'
        elif _OF_DRIVES.match(name):
            elsewhere = f"is a gain of a drive: {UNKNOWN_GAIN.format('gain')}"
        if elsewhere:
            raise ModelError(f"unknown: {name!r} {elsewhere}; parameters of joints are {', '.join(UNKNOWN)}")
    return _known_names("unknown", given, UNKNOWN)


def _coordinates(
    label: str, description: Description, joints: Collection[str] | Mapping[str, str] | str | None
) -> dict[str, int]:
    """Index of the joint of each coordinate.

    Raises ModelError: a name is unknown, a joint is named twice or follows another, or there is none.
    """
    names = [joint.name for joint in description.joints]
    followers = {names[x.follower] for x in description.couplings}
    leaders = [name for name in names if name not in followers]
    if joints is None:
        joints = leaders
    elif isinstance(joints, str) and "{}" in joints:
        pattern = re.compile(re.escape(joints).replace(r"\{\}", "(.+)"))
        joints = {identifier(found[1]): name for name in leaders if (found := pattern.fullmatch(name))}
    chosen = (
        joints if isinstance(joints, Mapping) else {identifier(n): n for n in _known_names("joints", joints, names)}
    )
    for name in _known_names("joints", tuple(chosen.values()), names):
        if name in followers:
            raise ModelError(
                f'{label}: joint "{name}" follows another by an equality constraint; leave it out of joints'
            )
        if list(chosen.values()).count(name) > 1:
            raise ModelError(f'{label}: joint "{name}" has several coordinates; give it one')
    if len(chosen) < len(joints):
        raise ModelError(f"{label}: names of joints differ only in special characters; give joints as a mapping")
    if not chosen:
        raise ModelError(f"{label}: no joint is modelled; there are {', '.join(names)}")
    return {coordinate: names.index(name) for coordinate, name in chosen.items()}


def _bodies(description: Description, bodies: Collection[str] | str, moved: Collection[int]) -> tuple[int, ...]:
    """Indices of bodies by name; of "all", those with one of the moved joints between them and the world."""
    if bodies == "all":
        return moving_bodies(description, moved)
    names = [body.name for body in description.bodies]
    return tuple(names.index(name) for name in _known_names("bodies", bodies, names))


def _positive(what: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0.0):
        raise ModelError(f"{what} is {value!r}; give a positive number")
    return float(value)


def _vector(given: Sequence[float], what: str) -> FloatArray:
    try:
        found = np.array(given, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{what} is {given!r:.60}; give three numbers") from error
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ModelError(f"{what} is {given!r:.60}; give three finite numbers")
    return found
