"""Plants that tests of plans share."""

import numpy as np

import diransac as dr
from diransac.model import Model, Parameter

ROTORCRAFT = dr.Plant(dr.models.planar_rotorcraft(), dr.models.TABLE_I)
LIMITS = {"thrust": (0.0, 5.0), "moment": (-1.0, 1.0)}

MASS = Model(
    "mass", {"y": "m"}, {"force": "N"}, {"mass": Parameter("kg")}, lambda q, v, a, u, p: [p.mass * a.y - u.force]
)


def mass(kilograms=2.0):
    """A mass on a line."""
    return dr.Plant(MASS, {"mass": kilograms})


def rotorcraft(**changes):
    """The paper's rotorcraft, parameters changed."""
    return dr.Plant(ROTORCRAFT.model, {**ROTORCRAFT.parameters, **changes})


def across(plant, **options):
    """From rest to rest, 2 m to the right and 1 m up, past a point on the way; segments of uneven length."""
    way = [{}, {"x": 0.7, "z": 1.0}, {"x": 2.0, "z": 1.0}]
    chosen = {"times": [0.0, 0.83, 2.16], "input_limits": LIMITS} | options
    return dr.plan(plant, waypoints=way, **chosen)


def defects(step, trajectory):
    """How far each row is from one step after the row before it."""
    moved = np.array([step(x, u) for x, u in zip(trajectory.states[:-1], trajectory.inputs[:-1], strict=True)])
    return np.abs(moved - trajectory.states[1:])
