"""Small machines, their logs, and a plain loop, for the tests of rollouts."""

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from llvmlite import binding

from diransac.model import Model, Parameter
from diransac.simulation import Measurements, RolloutBatch
from diransac.simulation.compiler import Target


def _forced(cpu, *features):
    """Target as a parameter of a test, skipped where this processor lacks its instructions."""
    has = binding.get_host_cpu_features()
    missing = [name for name in features if not has.get(name)]
    reason = f"this processor lacks {', '.join(missing)}: it cannot run code for {cpu}"
    return pytest.param(Target(cpu), id=features[0], marks=pytest.mark.skipif(bool(missing), reason=reason))


NARROW = _forced("haswell", "avx2", "fma", "bmi2")
WIDE = _forced("skylake-avx512", "avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")
HOST = pytest.param(None, id="host")
ON_EVERY_TARGET = pytest.mark.parametrize("target", [HOST, NARROW, WIDE])
"""The same test on code for this processor, with registers of half a vector, and with registers of a whole one."""

INTEGRATORS = {"rk4": 4, "euler": 1, "semi-implicit-euler": 1}
"""Each integrator's order."""


def machine(name, n_q, n_v, n_u, n_p):
    """Make a model of `dynamics(q, v, u, p)`, which gives dq/dt and the accelerations; signals q0 .. v0 .. v0_dot .."""

    def make(dynamics):
        def kinematics(q, v):
            return dynamics(ca.vertcat(*q), ca.vertcat(*v), ca.SX.zeros(n_u), ca.SX.ones(n_p))[0]

        def equations(q, v, a, u, p):
            _, accelerations = dynamics(*(ca.vertcat(*part) for part in (q, v, u, p)))
            return [x - y for x, y in zip(a, accelerations, strict=True)]

        def numbered(letter, n):
            return {f"{letter}{k}": "1" for k in range(n)}

        parameters = {name: Parameter() for name in numbered("p", n_p)}
        return Model(
            name, numbered("q", n_q), numbered("u", n_u), parameters, equations,
            velocities=numbered("v", n_v), kinematics=kinematics,
        )  # fmt: skip

    return make


@machine("rotorcraft", 3, 3, 2, 3)
def ROTORCRAFT(q, v, u, p):
    s, c, drag = ca.sin(q[2]), ca.cos(q[2]), p[2] * ca.fabs(u[0])
    return ca.vertsplit(v), [
        -(u[0] * s + drag * v[0] * c) / p[0],
        (u[0] * c - drag * v[1] * s) / p[0] - 9.81,
        0.177 * u[1] / p[1],
    ]


@machine("pendulum", 1, 1, 1, 2)
def PENDULUM(q, v, u, p):
    return [v[0]], [u[0] - p[0] * ca.sin(q[0]) - p[1] * ca.tanh(v[0])]


@machine("body", 4, 3, 3, 3)
def BODY(q, v, u, p):
    w, x, y, z = ca.vertsplit(q)
    a, b, c = ca.vertsplit(v)
    rates = [
        0.5 * (-x * a - y * b - z * c), 0.5 * (w * a + y * c - z * b),
        0.5 * (w * b - x * c + z * a), 0.5 * (w * c + x * b - y * a),
    ]  # fmt: skip
    return rates, [
        (u[0] + (p[1] - p[2]) * b * c) / p[0],
        (u[1] + (p[2] - p[0]) * c * a) / p[1],
        (u[2] + (p[0] - p[1]) * a * b) / p[2],
    ]


@machine("explosive", 2, 2, 1, 2)
def EXPLOSIVE(q, v, u, p):
    return ca.vertsplit(v), [p[0] * q[0] ** 3 + u[0], p[1] * q[1]]


def log_of(model, n_rows, seed=0):
    """A problem for a model: parameters of some lanes, an initial state, inputs and measurements."""
    rng = np.random.default_rng(seed)
    time = 0.01 * np.arange(n_rows)[:, None]
    inputs = np.sin(time * rng.uniform(1, 7, model.n_u)) + 0.3 * rng.standard_normal((n_rows, model.n_u))
    states = rng.uniform(-1, 1, model.n_q + model.n_v)
    for four in model.quaternions:
        states[list(four)] /= np.linalg.norm(states[list(four)])
    parameters = rng.uniform(0.5, 2.0, (21, model.n_p))
    measured = rng.standard_normal((n_rows, len(model.signals)))
    return SimpleNamespace(
        parameters=parameters,
        states=states,
        inputs=inputs,
        measured=measured,
        valid=rng.uniform(size=n_rows) < 0.9,
        dt=0.01,
    )


def normalised(model, x):
    """The state with quaternions of length one."""
    for four in model.quaternions:
        x[list(four)] /= np.linalg.norm(x[list(four)])
    return x


def plain_step(model, p, x, u, dt, integrator="rk4", substeps=1):
    """The state a row later, each sub-step written out in NumPy around CasADi's own evaluation of the dynamics."""

    def slope(x):
        return np.array(model.dynamics(x, u, p)[0]).ravel()

    n_q, h = model.n_q, dt / substeps
    for _ in range(substeps):
        k = slope(x)
        if integrator == "euler":
            x = x + h * k
        elif integrator == "semi-implicit-euler":
            v = x[n_q:] + h * k[n_q:]
            x = np.concatenate([x[:n_q] + h * slope(np.concatenate([x[:n_q], v]))[:n_q], v])
        else:
            k2 = slope(x + h / 2 * k)
            k3 = slope(x + h / 2 * k2)
            k4 = slope(x + h * k3)
            x = x + h / 6 * (k + 2 * k2 + 2 * k3 + k4)
        x = normalised(model, x)
    return x


def signals_at(model, p, x, u):
    """State and accelerations."""
    return np.concatenate([x, np.array(model.dynamics(x, u, p)[1]).ravel()])


def plain_trajectory(model, p, x, inputs, dt, integrator="rk4", substeps=1):
    """Signals row by row."""
    rows = []
    for u in inputs:
        rows.append(signals_at(model, p, x, u))
        x = plain_step(model, p, x, u, dt, integrator, substeps)
    return np.array(rows)


def batch_of(task, parameters=None, *, start_rows=None, n_rows=None):
    """The lanes of a problem, or others."""
    p = task.parameters if parameters is None else parameters
    return RolloutBatch(p, task.states, task.inputs, task.dt, start_rows, n_rows)


def measurements_of(engine, task):
    """The measurements of as many signals as are scored."""
    return Measurements(task.measured[:, : len(engine.signals)], task.valid)


def score_of(engine, task, parameters=None, *, thresholds=0.7, least=2, threads=1, **rows):
    """Score a problem with the same threshold for every signal."""
    limits = np.full(len(engine.signals), thresholds)
    return engine.score(
        batch_of(task, parameters, **rows), measurements_of(engine, task), limits, least, threads=threads
    )


def assert_same(found, expected):
    """All arrays of two results agree bit for bit, NaN included."""
    for name, value in vars(expected).items():
        if name != "batch":
            np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
