"""What others offer for the same work, for `speed.py`: simulate a rotorcraft's log with many hypotheses and score it.

Every function takes a `Problem` and returns a call that gives the sums of squared errors ``(n, 9)``, or raises
ImportError where its package is absent.  The equations are written anew for each, as a user of it would.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
Problem = tuple[Array, Array, Array, Array, Array, float, Array, int]
Sums = Callable[[], Array]

ARM_LENGTH, GRAVITY = 0.177, 9.81


def jax_scan(problem: Problem) -> Sums:
    """RK4 in ``lax.scan``, hypotheses by ``vmap``, compiled."""

    def step(x: Any, u: Any, p: Any, dt: float) -> Any:
        k1, acceleration = _jax_slope(x, u, p)
        k2, _ = _jax_slope(x + dt / 2 * k1, u, p)
        k3, _ = _jax_slope(x + dt / 2 * k2, u, p)
        k4, _ = _jax_slope(x + dt * k3, u, p)
        return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), acceleration

    return _scanned(problem, step)


def diffrax_steps(problem: Problem) -> Sums:
    """One step of Tsitouras' method a row (diffrax has no RK4), in ``lax.scan`` and ``vmap``."""
    import diffrax

    solver = diffrax.Tsit5()

    def step(x: Any, u: Any, p: Any, dt: float) -> Any:
        term = diffrax.ODETerm(lambda _t, y, _args: _jax_slope(y, u, p)[0])
        state = solver.init(term, 0.0, dt, x, None)
        after, *_ = solver.step(term, 0.0, dt, x, None, state, made_jump=False)
        return after, _jax_slope(x, u, p)[1]

    return _scanned(problem, step)


def _jax_slope(x: Any, u: Any, p: Any) -> Any:
    """Derivative of the state, and the accelerations."""
    import jax.numpy as jnp

    s, c, drag = jnp.sin(x[2]), jnp.cos(x[2]), p[2] * jnp.abs(u[0])
    a = jnp.stack([
        -(u[0] * s + drag * x[3] * c) / p[0],
        (u[0] * c - drag * x[4] * s) / p[0] - GRAVITY,
        ARM_LENGTH * u[1] / p[1],
    ])  # fmt: skip
    return jnp.concatenate([x[3:], a]), a


def _scanned(problem: Problem, step: Callable[..., Any]) -> Sums:
    """A step in a scan over rows, for all hypotheses at once."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    hypotheses, state, inputs, measured, _, dt, thresholds, least = problem
    rows = jnp.asarray(inputs), jnp.asarray(measured)

    def sums(p: Any) -> Any:
        def row(carry: Any, logged: Any) -> Any:
            x, total, count = carry
            u, y = logged
            after, acceleration = step(x, u, p, dt)
            error = jnp.concatenate([x, acceleration]) - y
            inlier = (jnp.abs(error) < thresholds).sum() >= least
            return (after, total + error**2, count + inlier), None

        start = jnp.asarray(state), jnp.zeros(9), jnp.zeros((), int)
        return jax.lax.scan(row, start, rows)[0][1:]

    compiled = jax.jit(jax.vmap(sums))
    return lambda: np.asarray(jax.block_until_ready(compiled(hypotheses))[0])


def numba_scalar(problem: Problem) -> Sums:
    """Plain loops over hypotheses and rows, compiled by Numba, on one thread."""
    import numba

    @numba.njit
    def acceleration(theta, vx, vz, thrust, mass, drag):  # noqa: ANN001, ANN202  Numba finds the types
        s, c = np.sin(theta), np.cos(theta)
        return -(thrust * s + drag * vx * c) / mass, (thrust * c - drag * vz * s) / mass - GRAVITY

    @numba.njit
    def sums(hypotheses, state, inputs, measured, h, thresholds, least):  # noqa: ANN001, ANN202
        total, counts = np.zeros((len(hypotheses), 9)), np.zeros(len(hypotheses))
        for i in range(len(hypotheses)):
            mass, inertia, drag = hypotheses[i]
            x, z, t, vx, vz, w = state
            for j in range(len(inputs)):
                thrust = inputs[j, 0]
                d, a = drag * abs(thrust), ARM_LENGTH * inputs[j, 1] / inertia
                ax1, az1 = acceleration(t, vx, vz, thrust, mass, d)
                near = 0
                for k, signal in enumerate((x, z, t, vx, vz, w, ax1, az1, a)):
                    error = signal - measured[j, k]
                    total[i, k] += error * error
                    near += abs(error) < thresholds[k]
                counts[i] += near >= least
                w2, w4 = w + h / 2 * a, w + h * a
                vx2, vz2 = vx + h / 2 * ax1, vz + h / 2 * az1
                ax2, az2 = acceleration(t + h / 2 * w, vx2, vz2, thrust, mass, d)
                vx3, vz3 = vx + h / 2 * ax2, vz + h / 2 * az2
                ax3, az3 = acceleration(t + h / 2 * w2, vx3, vz3, thrust, mass, d)
                vx4, vz4 = vx + h * ax3, vz + h * az3
                ax4, az4 = acceleration(t + h * w2, vx4, vz4, thrust, mass, d)
                x += h / 6 * (vx + 2 * vx2 + 2 * vx3 + vx4)
                z += h / 6 * (vz + 2 * vz2 + 2 * vz3 + vz4)
                t += h / 6 * (w + 4 * w2 + w4)
                vx += h / 6 * (ax1 + 2 * ax2 + 2 * ax3 + ax4)
                vz += h / 6 * (az1 + 2 * az2 + 2 * az3 + az4)
                w = w4
        return total, counts

    hypotheses, state, inputs, measured, _, dt, thresholds, least = problem
    return lambda: sums(hypotheses, state, inputs, measured, dt, thresholds, least)[0]


def scipy_segments(problem: Problem) -> Sums:
    """``solve_ivp`` from each row to the next, at tolerances of RK4's accuracy."""
    from scipy.integrate import solve_ivp

    hypotheses, state, inputs, measured, _, dt, _, _ = problem

    def slope(_t: float, x: Array, u: Array, p: Array) -> Array:
        s, c, drag = np.sin(x[2]), np.cos(x[2]), p[2] * abs(u[0])
        along = -(u[0] * s + drag * x[3] * c) / p[0], (u[0] * c - drag * x[4] * s) / p[0] - GRAVITY
        return np.array([*x[3:], *along, ARM_LENGTH * u[1] / p[1]])

    def sums(p: Array) -> Array:
        x, total = state, np.zeros(9)
        for u, y in zip(inputs, measured, strict=True):
            total += (np.concatenate([x, slope(0.0, x, u, p)[3:]]) - y) ** 2
            x = solve_ivp(slope, (0.0, dt), x, args=(u, p), rtol=1e-6, atol=1e-9).y[:, -1]
        return total

    return lambda: np.array([sums(p) for p in hypotheses])


def scikit_learn_ransac(W: Array, b: Array, trials: int) -> Callable[[], Any]:
    """So many trials of ``RANSACRegressor`` on the regressor's rows: it fits and counts, and simulates nothing."""
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    stacked, right = W.reshape(-1, W.shape[-1]), b.reshape(-1)
    regressor = RANSACRegressor(
        LinearRegression(fit_intercept=False), min_samples=75, max_trials=trials, stop_probability=1.0, random_state=0
    )
    return lambda: regressor.fit(stacked, right)
