"""Designed experiments: they keep their limits, rest at their ends, and predict what least squares then shows."""

import pickle

import numpy as np
import pytest
from casadi import cos, sign, sin

import diransac as dr
from planned import ROTORCRAFT, mass

G, LENGTH = 9.81, 0.4


def two_links(q, v, a, u, p):
    """Planar arm in the vertical plane, with two angles from the horizontal, friction in the first joint alone."""
    coupling = p.moment * LENGTH * cos(q.upper - q.lower)
    twist = p.moment * LENGTH * sin(q.upper - q.lower)
    return [
        p.inertia1 * a.upper + coupling * a.lower + twist * v.lower**2 + p.weight * G * cos(q.upper)
        + p.friction * sign(v.upper) - u.upper_torque,
        p.inertia2 * a.lower + coupling * a.upper - twist * v.upper**2 + p.moment * G * cos(q.lower) - u.lower_torque,
    ]  # fmt: skip


UNITS = {"inertia1": "kg m^2", "inertia2": "kg m^2", "moment": "kg m", "weight": "kg m", "friction": "N m"}
TRUTH = {"inertia1": 0.4, "inertia2": 0.1, "moment": 0.3, "weight": 0.9, "friction": 0.4}
ARM = dr.Plant(
    dr.Model(
        "arm",
        {"upper": "rad", "lower": "rad"},
        {"upper_torque": "N m", "lower_torque": "N m"},
        {name: dr.Parameter(unit) for name, unit in UNITS.items()},
        two_links,
    ),
    TRUTH,
)
LIMITS = {"upper": (-2.2, 0.3), "lower": 2.0, "upper_dot": 4.0, "lower_dot": 5.0, "upper_torque": 14.0, "hand": (-0.9, 9.0)}
NOISE = {"upper_torque": 0.2, "lower_torque": 0.1}


def hand(q, v, a, u, p):
    """Height of the hand, m."""
    return {"hand": LENGTH * sin(q.upper) + 0.3 * sin(q.lower)}


def designed(**changes):
    return dr.design_experiment(ARM, **{"limits": LIMITS, "noise": NOISE, "outputs": hand, "duration": 8.0} | changes)


@pytest.fixture(scope="module")
def experiment():
    return designed()


def regressor(motion):
    """Equations (2 K, 5) by hand at rows of q, v and a."""
    (q1, q2), (v1, v2), (a1, a2) = motion
    c, s, zero = LENGTH * np.cos(q1 - q2), LENGTH * np.sin(q1 - q2), np.zeros_like(q1)
    first = [a1, zero, c * a2 + s * v2**2, G * np.cos(q1), np.sign(v1)]
    second = [zero, a2, c * a1 - s * v1**2 + G * np.cos(q2), zero, zero]
    return np.vstack([np.array(first).T, np.array(second).T])


def motion_of(trajectory):
    """q, v and a (2, K) by the velocities' periodic spline-free spectrum."""
    v = trajectory.states[:-1, 2:].T
    w = 2j * np.pi * np.fft.fftfreq(v.shape[1], trajectory.dt)
    a = np.fft.ifft(w * np.fft.fft(v, axis=1), axis=1).real
    return trajectory.states[:, :2].T, trajectory.states[:, 2:].T, np.hstack([a, a[:, :1]])
