"""Estimates in a robot's description file: the same text but for the values that were identified."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.parameter import Parameter
from diransac.model.robots.compiled import compiled_file, mujoco_module
from diransac.model.robots.consistency import consistent_parameters, inconsistency
from diransac.model.robots.description import Description, Joint, read_description
from diransac.model.robots.document import Document
from diransac.model.robots.fields import FIELDS, places_of
from diransac.model.robots.inertias import with_unknown
from diransac.model.robots.rigid_body import INERTIAL_NAMES, inertial_parameters
from diransac.model.robots.written import refresh, written

_OF_MJCF = {"armature": "armature", "damping": "damping", "friction": "frictionloss", "spring": "stiffness"}
"""Attributes of a joint by parameter."""
_OF_URDF = ("damping", "friction")
"""Parameters that a joint of a URDF has."""


def calibrated(
    path: str | Path, parameters: Mapping[str, Parameter], values: FloatArray, covariance: FloatArray
) -> tuple[str, tuple[str, ...]]:
    """Text of a description with estimates in it, and the parameters that are not in it.

    Parameters of joints replace those of the file. Inertials are the physically consistent ones nearest to those of the
    file, of all that explain the estimated base parameters (`consistent_parameters`).

    Parameters
    ----------
    path : str or Path
        MJCF or URDF file, for which `robot` made the model.
    parameters : mapping of str to Parameter
        Those of the model.
    values, covariance : (n_p,), (n_p, n_p) arrays
        Estimates of them; NaN where there is none.

    Returns
    -------
    text : str
        The file's, comments and layout included.
    left_out : tuple of str
        Parameters that are not in the text: there is no estimate, or the format cannot express them, such as the bias
        of an encoder.

    Raises
    ------
    ModelError
        The file cannot be read; a joint or body is not in it, but in one that it includes; the parameters are not those
        of a robot; or MuJoCo compiles the text to other values, whatever is written.
    """
    description = read_description(path, "held")
    document = Document(Path(path).read_bytes(), f'robot description "{path}"')
    of_joints, of_bodies = _estimates(description, parameters, values, covariance)
    placed = {place for place in of_joints if place.partition(" ")[0] in (_OF_URDF if document.is_urdf else _OF_MJCF)}
    try:
        meant, bare = compiled_file(path), False
    except ModelError:  # files of meshes need not be there
        meant, bare = compiled_file(path, bare=True), True
    indices = [k for k in range(meant.njnt) if meant.jnt_type[k] != mujoco_module().mjtJoint.mjJNT_FREE]
    joints = {joint.name: (k, joint) for k, joint in zip(indices, description.joints, strict=True)}
    for place in placed:
        kind, _, name = place.partition(" ")
        if name not in joints:
            raise ModelError(f'there is no joint "{name}" in the description')
        _set_joint(document.label, meant, *joints[name], _OF_MJCF[kind], of_joints[place])
    for k, body in enumerate(description.bodies, 1):
        if body.name in of_bodies:
            _set_body(meant, k, of_bodies[body.name])
    refresh(meant)
    left_out = [
        n
        for (n, x), value in zip(parameters.items(), values, strict=True)
        if np.isnan(value) or not (_has_inertials(dict(x.combination)) or x.combination[0][0] in placed)
    ]
    repaired = [i + 1 for i, flaw in description.flaws.items() if flaw.kind == "impossible"]
    return written(path, document, meant, bare=bare, repaired=repaired), tuple(left_out)


def impossible_changes(
    parameters: Mapping[str, Parameter], values: FloatArray, covariance: FloatArray
) -> dict[str, float]:
    """Least changes of estimated base parameters by which they are those of possible bodies, over standard errors.

    Parameters
    ----------
    parameters : mapping of str to Parameter
    values, covariance : (n_p,), (n_p, n_p) arrays
        Estimates of them; parameters of infinite variance are left out.

    Returns
    -------
    dict of str to float
        Empty where no parameter is one of a body.
    """
    places = {n: dict(x.combination) for n, x in parameters.items()}
    spread = np.diag(covariance)
    known = [
        k for k, n in enumerate(places) if _has_inertials(places[n]) and np.isfinite(spread[k]) and spread[k] > 0.0
    ]
    if not known:
        return {}
    names = [list(places)[k] for k in known]
    bodies, _, combinations = _combinations([places[n] for n in names])
    changes = inconsistency(combinations, len(bodies), values[known], covariance[np.ix_(known, known)])
    return dict(zip(names, changes.tolist(), strict=True))


# ---------------------------------------------------------------------- values


def _estimates(
    description: Description, parameters: Mapping[str, Parameter], values: FloatArray, covariance: FloatArray
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Parameters of joints by place, such as ``armature elbow``, and the ten inertial parameters of bodies by name."""
    places = {n: dict(x.combination) for n, x in parameters.items()}
    if not all(places.values()):
        raise ModelError(f"{next(n for n, x in places.items() if not x)} is no parameter of a robot's description")
    of_joints, known = dict[str, float](), list[int]()
    for k, own in enumerate(places.values()):
        if not np.isnan(values[k]):
            if not _has_inertials(own):
                of_joints[next(iter(own))] = float(values[k])
            elif np.isfinite(covariance[k, k]):
                known.append(k)
    if not known:
        return of_joints, {}
    every = list(places.values())
    names, constants, combinations = _combinations([every[k] for k in known])
    description = with_unknown(description, [i for i, x in enumerate(description.bodies) if x.name in names])
    bodies, joints = {x.name: x for x in description.bodies}, {x.name: x for x in description.joints}
    missing = [name for name in names if name not in bodies]
    if missing:
        raise ModelError(f'there is no body "{missing[0]}" in the description')
    inertials, others = consistent_parameters(
        np.array([inertial_parameters(bodies[name].inertial) for name in names]),
        np.array([joints[place.partition(" ")[2]].armature for place in constants]),
        combinations,
        values[known],
        covariance[np.ix_(known, known)],
    )
    return of_joints | dict(zip(constants, others.tolist(), strict=True)), dict(zip(names, inertials, strict=True))


def _has_inertials(places: Mapping[str, float]) -> bool:
    return any(place.partition(" ")[0] in INERTIAL_NAMES for place in places)


def _combinations(places: list[dict[str, float]]) -> tuple[list[str], list[str], FloatArray]:
    """Bodies, constants of joints, and the matrix by which the parameters of both give base parameters."""
    every = list(dict.fromkeys(place for own in places for place in own))
    of_bodies = [place for place in every if place.partition(" ")[0] in INERTIAL_NAMES]
    bodies = list(dict.fromkeys(place.partition(" ")[2] for place in of_bodies))
    constants = [place for place in every if place not in of_bodies]
    columns = [f"{kind} {body}" for body in bodies for kind in INERTIAL_NAMES] + constants
    return bodies, constants, np.array([[own.get(column, 0.0) for column in columns] for own in places])


# ---------------------------------------------------------------------- values in the compiled model


def _set_joint(label: str, meant: Any, k: int, joint: Joint, field: str, value: float) -> None:
    """Give a joint a value, of which actuators have a part of their own.  Raises ModelError: they have more."""
    of_drives = {"armature": joint.drive_armature, "damping": joint.drive_damping}.get(field, 0.0)
    if of_drives > value:
        raise ModelError(
            f'{label}: {field} of joint "{joint.name}" is {value:.6g}, but its actuators alone have '
            f"{of_drives:.6g} behind their gears; lower {field} of the actuators in the file"
        )
    for place in places_of(meant, "joint", k, FIELDS["joint"][field].numbers[0]):
        getattr(meant, place.array)[place.index] = value - of_drives


def _set_body(meant: Any, k: int, inertial: FloatArray) -> None:
    """Give a body these inertial parameters about the origin of its frame."""
    mass, h = inertial[0], inertial[1:4]
    centre = h / mass
    xx, yy, zz, xy, xz, yz = inertial[4:]
    shift = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    principal, axes = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - shift)
    axes[:, 2] *= np.linalg.det(axes)  # a rotation
    meant.body_mass[k], meant.body_ipos[k], meant.body_inertia[k] = mass, centre, principal
    mujoco_module().mju_mat2Quat(meant.body_iquat[k], axes.ravel())
