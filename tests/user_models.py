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


def oven():
    """A temperature under heating and losses to the surroundings; no coordinates."""
    return Model(
        name="oven",
        coordinates={},
        first_order={"temperature": "K"},
        inputs={"power": "W", "ambient": "K"},
        parameters={"capacity": Parameter("J/K", positive=True), "loss": Parameter("W/K", positive=True)},
        equations=lambda q, v, a, u, p: [
            p.capacity * a.temperature + p.loss * (v.temperature - u.ambient) - u.power,
        ],
    )


def tank():
    """The level of a tank with an outlet (Torricelli); no coordinates."""
    return Model(
        name="tank",
        coordinates={},
        first_order={"level": "m"},
        inputs={"inflow": "m^3/s"},
        parameters={"area": Parameter("m^2", positive=True), "outlet": Parameter("m^2", positive=True)},
        equations=lambda q, v, a, u, p: [
            p.area * a.level + p.outlet * ca.sqrt(2 * 9.81 * ca.fmax(v.level, 1e-6)) - u.inflow,
        ],
    )


def dc_motor(**known):
    """A motor with electrical time constant; parameters that are given are known."""
    units = {
        "inertia": "kg m^2",
        "friction": "N m s/rad",
        "constant": "N m/A",
        "resistance": "ohm",
        "inductance": "H",
    }

    def equations(q, v, a, u, p):
        def value(name):
            return known.get(name) or p[name]

        return [
            value("inertia") * a.angle + value("friction") * v.angle - value("constant") * v.current,
            value("inductance") * a.current + value("resistance") * v.current + value("constant") * v.angle - u.voltage,
        ]

    return Model(
        name="dc-motor",
        coordinates={"angle": "rad"},
        first_order={"current": "A"},
        inputs={"voltage": "V"},
        parameters={n: Parameter(unit, positive=True) for n, unit in units.items() if n not in known},
        equations=equations,
    )


def lagged_thrust(mass=0.5):
    """A vertical rotorcraft whose thrust follows a command with a lag; without a mass it is a parameter."""
    own = {} if mass else {"mass": Parameter("kg", positive=True)}
    return Model(
        name="lagged-thrust",
        coordinates={"z": "m"},
        first_order={"thrust": "N"},
        inputs={"command": "1"},
        parameters={
            **own,
            "gain": Parameter("N", positive=True),
            "tau": Parameter("s", positive=True),
            "drag": Parameter("N s/m", lower=0.0),
        },
        equations=lambda q, v, a, u, p: [
            (mass or p.mass) * (a.z + 9.81) + p.drag * v.z - v.thrust,
            p.tau * a.thrust + v.thrust - p.gain * u.command,
        ],
    )


def flexible_joint():
    """Two inertias and a spring with damping; the torque acts on the first."""

    def equations(q, v, a, u, p):
        spring = p.stiffness * (q.motor - q.load) + p.damping * (v.motor - v.load)
        return [p.rotor * a.motor + p.friction * v.motor + spring - u.torque, p.inertia * a.load - spring]

    return Model(
        name="flexible-joint",
        coordinates={"motor": "rad", "load": "rad"},
        inputs={"torque": "N m"},
        parameters={
            "rotor": Parameter("kg m^2", positive=True),
            "inertia": Parameter("kg m^2", positive=True),
            "stiffness": Parameter("N m/rad", positive=True),
            "damping": Parameter("N m s/rad", lower=0.0),
            "friction": Parameter("N m s/rad", lower=0.0),
        },
        equations=equations,
    )
