"""Inverse dynamics of trees of rigid bodies by the recursive Newton-Euler algorithm, over CasADi SX.

References
----------
Luh, Walker, Paul 1980, "On-line computational scheme for mechanical manipulators", Journal of Dynamic Systems,
Measurement, and Control 102(2).
Featherstone 2008, "Rigid Body Dynamics Algorithms", section 5.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.model.robots.description import Body, Description, Joint

INERTIAL_NAMES = ("mass", "hx", "hy", "hz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
"""Inertial parameters of a body about the origin of its frame: mass, kg, first moments, kg m, inertia, kg m^2."""


class _Motion(NamedTuple):
    """Angular velocity and acceleration of a frame, acceleration of its origin less gravity, and gravity, in it."""

    w: ca.SX
    dw: ca.SX
    a: ca.SX
    g: ca.SX

    def at(self, r: Any) -> ca.SX:
        """Acceleration of a point that is fixed in the frame."""
        return self.a + ca.cross(self.dw, r) + ca.cross(self.w, ca.cross(self.w, r))

    def turned(self, R: Any, origin: Any) -> _Motion:
        """Motion in a frame that is fixed in this one, with the axes R and an origin."""
        return _Motion(*(R.T @ x for x in (self.w, self.dw, self.at(origin), self.g)))


class _Force(NamedTuple):
    """Force, and moment about the origin of the frame in whose components they are."""

    f: ca.SX
    n: ca.SX

    def plus(self, other: _Force) -> _Force:
        """Sum of two forces in one frame."""
        return _Force(self.f + other.f, self.n + other.n)

    def turned_back(self, R: Any, origin: Any) -> _Force:
        """The same in the frame in which this one has the axes R and an origin."""
        f = R @ self.f
        return _Force(f, R @ self.n + ca.cross(origin, f))


def pseudo_inertia(inertial: Sequence[Any]) -> Any:
    """Pseudo-inertia ``(4, 4)`` of the ten `INERTIAL_NAMES` about the same origin.

    References: Wensing, Kim, Slotine 2018, eq. (17).
    """
    m, hx, hy, hz, xx, yy, zz, xy, xz, yz = inertial
    half = 0.5 * (xx + yy + zz)
    rows = [[half - xx, -xy, -xz, hx], [-xy, half - yy, -yz, hy], [-xz, -yz, half - zz, hz], [hx, hy, hz, m]]
    return ca.vertcat(*(ca.horzcat(*row) for row in rows))


def inertial_parameters(J: FloatArray) -> FloatArray:
    """The ten `INERTIAL_NAMES` of a pseudo-inertia ``(4, 4)``."""
    S = J[:3, :3]
    inertia = np.trace(S) * np.eye(3) - S
    return np.array([J[3, 3], *J[:3, 3], *np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]])


def inverse_dynamics(
    description: Description,
    q: Sequence[Any],
    v: Sequence[Any],
    a: Sequence[Any],
    inertials: Sequence[Any],
    base: Sequence[ca.SX] = (),
) -> list[ca.SX]:
    """Force of each joint for a motion, without those of armatures, springs, damping and friction.

    Parameters
    ----------
    description : Description
        Tree of bodies.
    q, v, a : sequences of SX or float, one per joint
        Positions, velocities and accelerations, rad or m.
    inertials : sequence of (4, 4) SX or array, one per body
        Pseudo-inertias about the origins of the body frames.
    base : sequence of three (3,) SX, optional
        Angular velocity and acceleration of the base whose motion is measured, and acceleration of its origin less
        gravity (what an accelerometer shows), in its frame.

    Returns
    -------
    list of SX, one per joint
        N m of hinges, N of slides.
    """
    still, gravity = ca.SX.zeros(3), ca.SX(description.gravity)
    world = _Motion(still, still, -gravity, gravity)
    motions = list[_Motion]()
    for i, body in enumerate(description.bodies):
        motion = world if body.parent < 0 else motions[body.parent]
        motion = motion.turned(ca.DM(body.rotation), ca.DM(body.position))
        if i == description.base:
            motion = _Motion(base[0], base[1], base[2], still)
        for k in body.joints:
            motion = _moved(motion, description.joints[k], q[k], v[k], a[k])
        motions.append(motion)
    parts = list(zip(_lumped(description.bodies, inertials), motions, strict=True))
    shares = [body.gravity_compensation for body in description.bodies]
    found = _joint_forces(description, q, [_inertial_force(*x, share) for x, share in zip(parts, shares, strict=True)])
    if any(shares) and any(joint.compensated_by_drive for joint in description.joints):
        whole = _joint_forces(description, q, [_inertial_force(*part, 0.0) for part in parts])
        pairs = zip(description.joints, found, whole, strict=True)
        found = [all_of_it if joint.compensated_by_drive else rest for joint, rest, all_of_it in pairs]
    return found


def position_of(description: Description, body: int, point: Sequence[float], q: Sequence[Any]) -> ca.SX:
    """Position of a point of a body.

    Parameters
    ----------
    description : Description
    body : int
        Index of the body.
    point : three floats
        In the body's frame, m.
    q : sequence of SX or float, one per joint
        Positions, rad or m.

    Returns
    -------
    (3,) SX
        In the frame of the world, or of the base whose motion is measured, m.
    """
    r = ca.SX(ca.DM(list(point)))
    while body >= 0:
        own = description.bodies[body]
        for k in reversed(own.joints):
            R, origin = _displacement(description.joints[k], q[k])
            r = R @ r + origin
        if body == description.base:
            break
        r = ca.DM(own.rotation) @ r + ca.DM(own.position)
        body = own.parent
    return r


def _joint_forces(description: Description, q: Sequence[Any], forces: list[_Force]) -> list[ca.SX]:
    """Forces of the joints, summed from the tips of the tree to its root."""
    of_joints = [ca.SX(0)] * len(description.joints)
    for i in range(len(forces) - 1, -1, -1):
        body, force = description.bodies[i], forces[i]
        for k in reversed(body.joints):
            joint = description.joints[k]
            moment = force.n - ca.cross(ca.DM(joint.anchor), force.f)
            of_joints[k] = ca.dot(ca.DM(joint.axis), moment if joint.turns else force.f)
            force = force.turned_back(*_displacement(joint, q[k]))
        if body.parent >= 0:
            force = force.turned_back(ca.DM(body.rotation), ca.DM(body.position))
            forces[body.parent] = forces[body.parent].plus(force)
    return of_joints


def _displacement(joint: Joint, q: Any) -> tuple[Any, Any]:
    """Axes and origin of the moved frame in the frame in which it is at the joint's reference."""
    axis, moved = ca.DM(joint.axis), ca.SX(q - joint.reference)
    if not joint.turns:
        return ca.DM.eye(3), moved * axis
    along = axis @ axis.T
    R = along + ca.cos(moved) * (ca.DM.eye(3) - along) + ca.sin(moved) * ca.skew(axis)
    return R, (ca.DM.eye(3) - R) @ ca.DM(joint.anchor)


def _moved(motion: _Motion, joint: Joint, q: Any, v: Any, a: Any) -> _Motion:
    """Motion of the frame behind a joint."""
    R, origin = _displacement(joint, q)
    axis, anchor = ca.DM(joint.axis), ca.DM(joint.anchor)
    if not joint.turns:
        before = motion.turned(R, origin)
        return before._replace(a=before.a + a * axis + 2.0 * ca.cross(before.w, v * axis))
    before = motion.turned(R, anchor)
    w = before.w + v * axis
    dw = before.dw + a * axis + ca.cross(before.w, v * axis)
    at_anchor = _Motion(w, dw, before.a, before.g)
    return at_anchor._replace(a=at_anchor.at(-anchor))


def _inertial_force(J: Any, motion: _Motion, compensation: float) -> _Force:
    """Force and moment about its origin that a body's motion takes, with what is not compensated of its weight."""
    w, dw, a, g = motion
    S, h, m = J[:3, :3], ca.SX(J[:3, 3]), J[3, 3]
    inertia = ca.SX(ca.trace(ca.SX(S)) * ca.SX.eye(3) - S)
    f = m * a + ca.cross(dw, h) + ca.cross(w, ca.cross(w, h))
    n = inertia @ dw + ca.cross(w, inertia @ w) + ca.cross(h, a)
    lift = compensation * g
    return _Force(f + m * lift, n + ca.cross(h, lift))


def _lumped(bodies: Sequence[Body], inertials: Sequence[Any]) -> list[Any]:
    """Pseudo-inertias with those of bodies that are fixed to their parent, and are numbers, added to the parent's."""
    lumped = list(inertials)
    for i in range(len(bodies) - 1, -1, -1):
        body = bodies[i]
        is_fixed = body.parent >= 0 and not body.joints and isinstance(lumped[i], np.ndarray)
        if is_fixed and body.gravity_compensation == bodies[body.parent].gravity_compensation:
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = body.rotation, body.position
            lumped[body.parent] = lumped[body.parent] + T @ lumped[i] @ T.T
            lumped[i] = np.zeros((4, 4))
    return lumped
