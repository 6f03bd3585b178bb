"""Models as users write them, beyond the built-in ones."""

import casadi as ca

from diransac.model import Model, Parameter


def tumbling(**changes):
    """A rigid body that turns: unit quaternion, body rates, principal inertias."""

    def equations(q, v, a, u, p):
        return [
            p.Jx * a.wx + (p.Jz - p.Jy) * v.wy * v.wz - u.tx,
            p.Jy * a.wy + (p.Jx - p.Jz) * v.wz * v.wx - u.ty,
            p.Jz * a.wz + (p.Jy - p.Jx) * v.wx * v.wy - u.tz,
        ]

    def kinematics(q, v):
        return [
            0.5 * (-q.qx * v.wx - q.qy * v.wy - q.qz * v.wz),
            0.5 * (q.qw * v.wx + q.qy * v.wz - q.qz * v.wy),
            0.5 * (q.qw * v.wy + q.qz * v.wx - q.qx * v.wz),
            0.5 * (q.qw * v.wz + q.qx * v.wy - q.qy * v.wx),
        ]

    parts = {
        "coordinates": dict.fromkeys(("qw", "qx", "qy", "qz"), "1"),
        "velocities": dict.fromkeys(("wx", "wy", "wz"), "rad/s"),
        "inputs": dict.fromkeys(("tx", "ty", "tz"), "N m"),
        "parameters": dict.fromkeys(("Jx", "Jy", "Jz"), Parameter("kg m^2", positive=True)),
        "equations": equations,
        "kinematics": kinematics,
    }
    return Model(name="tumbling", **(parts | changes))


def hanging_mass(**changes):
    """A pendulum of unknown length l, mass m and drag c, driven by its pivot's acceleration: 1/l and 1/l^2."""

    def equations(q, v, a, u, p):
        pull = 9.81 * ca.sin(q.angle) + u.pivot * ca.cos(q.angle)
        return [a.angle + pull / p.l + p.c / (p.m * p.l**2) * v.angle - u.torque / (p.m * p.l**2)]

    parts = {
        "coordinates": {"angle": "rad"},
        "inputs": {"pivot": "m/s^2", "torque": "N m"},
        "parameters": {
            "l": Parameter("m", positive=True),
            "m": Parameter("kg", positive=True),
            "c": Parameter("N m s/rad", lower=0.0),
        },
        "equations": equations,
    }
    return Model(name="hanging-mass", **(parts | changes))
