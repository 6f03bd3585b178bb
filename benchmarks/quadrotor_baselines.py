"""What an engineer does without the package: least squares on filtered readings, and output error.

Both know the mass and the places of the rotors.  Output error has the delay of the motion capture as a parameter, and
the state at the beginning of every fifth of a second.  Nothing happens when this file is run.

References
----------
Jategaonkar 2015, "Flight Vehicle System Identification", chapter 4 (output error).
"""

from dataclasses import dataclass

import numpy as np
from quadrotor_flights import ACC, ATTITUDE, COMMANDS, DIRECTIONS, GYRO, NOISE, PLACES, POSITION, Array, Flight, G
from scipy.interpolate import make_smoothing_spline
from scipy.ndimage import median_filter
from scipy.signal import butter, lfilter, sosfiltfilt
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

BANDWIDTH = 12.0
"""Hz, of the filter of the regression: the attitude is controlled with about 2 Hz."""
LAGS = np.linspace(0.0, 0.08, 41)
N_STATES, SEGMENT = 17, 100
ITERATIONS, STEP, SETTLED, CAUCHY = 40, 1e-6, 1e-6, 2.385
NAMES = (
    "inertia_x",
    "inertia_y",
    "inertia_z",
    "thrust_coefficient",
    "torque_coefficient",
    "drag",
    "motor_time_constant",
    *(f"gyro_bias_{axis}" for axis in "xyz"),
    *(f"acc_bias_{axis}" for axis in "xyz"),
)


@dataclass(frozen=True)
class Readings:
    """Readings without spikes, the pose interpolated.

    Parameters
    ----------
    dt : s
    gyro, acc, velocity : (N, 3) the velocity in the world frame
    attitude : (N, 4)
    position : (N, 3)
    commands : (N, 4)
    """

    dt: float
    gyro: Array
    acc: Array
    position: Array
    velocity: Array
    attitude: Array
    commands: Array

    @classmethod
    def of(cls, flight: Flight) -> "Readings":
        """Readings of a flight; a sample far from the running median is replaced by it."""
        log = flight.log
        t = np.asarray(log.time)
        pose = np.column_stack([log[name] for name in (*POSITION, *ATTITUDE)])
        seen = np.isfinite(pose[:, 0])
        pose = _continuous(pose[seen])
        splines = [make_smoothing_spline(t[seen], _despiked(column), lam=1e-7) for column in pose.T]
        smooth = np.column_stack([spline(t) for spline in splines])
        velocity = np.column_stack([spline.derivative()(t) for spline in splines[:3]])
        attitude = smooth[:, 3:] / np.linalg.norm(smooth[:, 3:], axis=1)[:, None]
        gyro, acc = (np.column_stack([_despiked(log[name]) for name in names]) for names in (GYRO, ACC))
        commands = np.column_stack([log[name] for name in COMMANDS])
        return cls(float(t[1] - t[0]), gyro, acc, smooth[:, :3], velocity, attitude, commands)

    def speeds(self, lag: float) -> Array:
        """Commands after a lag of first order."""
        if not lag:
            return self.commands
        a = np.exp(-self.dt / lag)
        return np.asarray(lfilter([1.0 - a], [1.0, -a], self.commands - self.commands[0], axis=0) + self.commands[0])


def _continuous(pose: Array) -> Array:
    """Quaternions with the sign that is nearer to the running median's."""
    signs, attitude = np.ones(len(pose)), pose[:, 3:].copy()
    for k in range(1, len(pose)):
        near = np.median(attitude[max(0, k - 9) : k] * signs[max(0, k - 9) : k, None], axis=0)
        signs[k] = 1.0 if near @ attitude[k] >= 0.0 else -1.0
    return np.hstack([pose[:, :3], attitude * signs[:, None]])


def _despiked(values: Array) -> Array:
    middle = median_filter(values, 9, mode="nearest")
    off = np.abs(values - middle)
    return np.where(off > 5.0 * 1.4826 * np.median(off), middle, values)


def _matrices(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


# ---------------------------------------------------------------------- least squares


def least_squares_of(flight: Flight) -> dict[str, float]:
    """Newton's and Euler's equations on filtered readings; the lag is the one with which they hold best."""
    seen, mass = Readings.of(flight), flight.truth["mass"]
    sections = butter(3, BANDWIDTH, fs=1.0 / seen.dt, output="sos")

    def filtered(values: Array) -> Array:
        return np.asarray(sosfiltfilt(sections, values, axis=0))[50:-50]

    w, acc = filtered(seen.gyro), filtered(seen.acc)
    turning = filtered(np.gradient(seen.gyro, seen.dt, axis=0))
    in_body = filtered(np.einsum("nji,nj->ni", _matrices(seen.attitude), seen.velocity))
    one = np.ones(len(w))

    def lift(lag: float) -> tuple[float, Array]:
        squares = filtered(seen.speeds(lag) ** 2)
        rows = np.column_stack([squares.sum(axis=1) / mass, one])
        found, left, *_ = np.linalg.lstsq(rows, acc[:, 2], rcond=None)
        return float(left[0]), found

    lag = float(min(LAGS, key=lambda x: lift(x)[0]))
    thrust, bias_z = lift(lag)[1]
    squares = filtered(seen.speeds(lag) ** 2)
    drags, biases = zip(*(_line(-in_body[:, i] / mass, acc[:, i]) for i in range(2)), strict=True)
    moments = thrust * np.column_stack([squares @ PLACES[:, 1], -squares @ PLACES[:, 0]])
    wx, wy, wz = w.T
    zero = np.zeros_like(wx)
    # J w' + w x J w = M, with the torque coefficient on the side of the inertias; a constant for each axis.
    axes = (
        (turning[:, 0], -wy * wz, wy * wz, zero, moments[:, 0]),
        (wx * wz, turning[:, 1], -wx * wz, zero, moments[:, 1]),
        (-wx * wy, wx * wy, turning[:, 2], squares @ DIRECTIONS, zero),
    )
    rows = np.vstack([np.column_stack([*axis[:4], *(one * (k == i) for k in range(3))]) for i, axis in enumerate(axes)])
    right = np.concatenate([axis[4] for axis in axes])
    size = np.abs(rows).max(axis=0)
    Jx, Jy, Jz, torque, *_ = np.linalg.lstsq(rows / size, right, rcond=None)[0] / size
    rates = _rates(seen)
    gyro = np.median(seen.gyro - rates, axis=0)
    values = (Jx, Jy, Jz, thrust, torque, float(np.mean(drags)), lag, *gyro, *biases, bias_z)
    return dict(zip(NAMES, map(float, values), strict=True))


def _line(x: Array, y: Array) -> tuple[float, float]:
    slope, constant = np.linalg.lstsq(np.column_stack([x, np.ones(len(x))]), y, rcond=None)[0]
    return float(slope), float(constant)


def _rates(seen: Readings) -> Array:
    """Angular velocity in the body frame from the attitude."""
    q, change = seen.attitude, np.gradient(seen.attitude, seen.dt, axis=0)
    w, v, dw, dv = q[:, :1], q[:, 1:], change[:, :1], change[:, 1:]
    return np.asarray(2.0 * (w * dv - v * dw - np.cross(v, dv)))


# ---------------------------------------------------------------------- output error


def output_error_of(flight: Flight) -> dict[str, float]:
    """Parameters by Levenberg and Marquardt with a Cauchy loss, from those of least squares."""
    problem = _OutputError.of(flight)
    unknowns, damping = problem.first, 1e-3
    residuals = problem.residuals(unknowns)
    for _ in range(ITERATIONS):
        J, weights = problem.jacobian(unknowns), 1.0 / (1.0 + (residuals / CAUCHY) ** 2)
        normal, gradient = (J.T @ (J * weights[:, None])).tocsc(), J.T @ (weights * residuals)
        before = unknowns
        while damping < 1e6:
            step = spsolve(normal + damping * diags_array(normal.diagonal()), -gradient)
            after = problem.residuals(unknowns + step)
            if _cost(after) < _cost(residuals):
                unknowns, residuals, damping = unknowns + step, after, damping / 10.0
                break
            damping *= 10.0
        if np.abs(unknowns - before)[: len(NAMES)].max() < SETTLED:
            break
    return dict(zip(NAMES, map(float, unknowns[: len(NAMES)] * problem.size), strict=True))


def _cost(residuals: Array) -> float:
    return float(np.log1p((residuals / CAUCHY) ** 2).sum())


@dataclass(frozen=True)
class _OutputError:
    """Residuals of all segments; unknowns are parameters over their size, the delay in samples, and initial states.

    Parameters
    ----------
    flight : Flight
    seen : Readings
    measured : (S, SEGMENT, 13) position, attitude, gyroscope and accelerometer; NaN where there is none
    commands : (S, SEGMENT, 4)
    size : (13,) of the parameters
    first : (n,) unknowns to begin with
    """

    flight: Flight
    seen: Readings
    measured: Array
    commands: Array
    size: Array
    first: Array

    @classmethod
    def of(cls, flight: Flight) -> "_OutputError":
        """Segments of a flight."""
        seen, begin = Readings.of(flight), least_squares_of(flight)
        n = len(seen.gyro) // SEGMENT
        rows = slice(0, n * SEGMENT)
        log = flight.log
        columns = [np.array(log[name]) for name in (*POSITION, *ATTITUDE, *GYRO, *ACC)]
        measured = np.column_stack(columns)[rows].reshape(n, SEGMENT, -1)
        values = np.array([begin[name] for name in NAMES])
        size = np.abs(values) + np.array([0.02 if "gyro" in name else 0.2 if "acc" in name else 0.0 for name in NAMES])
        gyro = seen.gyro - values[7:10]
        states = np.hstack([seen.position, seen.attitude, seen.velocity, gyro, seen.speeds(values[6]) / 1000.0])
        first = states[rows].reshape(n, SEGMENT, -1)[:, 0].ravel()
        commands = seen.commands[rows].reshape(n, SEGMENT, 4)
        return cls(flight, seen, measured, commands, size, np.concatenate([values / size, [0.0], first]))

    def residuals(self, unknowns: Array) -> Array:
        """Errors over the noise; 0 where nothing is measured."""
        return self._residuals(unknowns).ravel()

    def _residuals(self, unknowns: Array) -> Array:
        p = dict(zip(NAMES, unknowns[: len(NAMES)] * self.size, strict=True)) | {"mass": self.flight.truth["mass"]}
        late, x = unknowns[len(NAMES)], unknowns[len(NAMES) + 1 :].reshape(-1, N_STATES)
        simulated = self._simulated(x, p, late)
        with np.errstate(invalid="ignore"):
            turned = np.where((simulated[..., 3:7] * self.measured[..., 3:7]).sum(axis=-1) < 0.0, -1.0, 1.0)
        measured = self.measured.copy()
        measured[..., 3:7] *= turned[..., None]
        noise = np.repeat([NOISE[kind] for kind in ("position", "attitude", "gyro", "acc")], [3, 4, 3, 3])
        return np.nan_to_num((simulated - measured) / noise, nan=0.0, posinf=1e3, neginf=-1e3)

    def jacobian(self, unknowns: Array) -> csr_array:
        """By forward differences: a simulation per parameter, and one per state of all segments at once."""
        base, n_shared, n = self._residuals(unknowns), len(NAMES) + 1, len(self.measured)
        rows, columns, values = [], [], []
        for k in range(n_shared + N_STATES):
            moved = unknowns.copy()
            at = np.array([k]) if k < n_shared else n_shared + (k - n_shared) + N_STATES * np.arange(n)
            moved[at] += STEP
            slope = ((self._residuals(moved) - base) / STEP).reshape(n, -1)
            segment, place = np.nonzero(slope)
            rows.append(segment * slope.shape[1] + place)
            columns.append(np.full(len(segment), k) if k < n_shared else at[segment])
            values.append(slope[segment, place])
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return csr_array(entries, shape=(base.size, len(unknowns)))

    def _simulated(self, x: Array, p: dict[str, float], late: float) -> Array:
        """What the instruments would read, (S, SEGMENT, 13), by Runge and Kutta from sample to sample."""
        out, dt = np.empty(self.measured.shape), self.seen.dt
        for row in range(SEGMENT):
            u = self.commands[:, row] / 1000.0
            first, acc = _slope(x, u, p)
            pose = x[:, :7] - late * dt * first[:, :7]
            out[:, row] = np.hstack([pose, x[:, 10:13] + _biases(p, "gyro"), acc + _biases(p, "acc")])
            second = _slope(x + 0.5 * dt * first, u, p)[0]
            third = _slope(x + 0.5 * dt * second, u, p)[0]
            fourth = _slope(x + dt * third, u, p)[0]
            x = x + dt / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
            x[:, 3:7] /= np.linalg.norm(x[:, 3:7], axis=1)[:, None]
        return out


def _biases(p: dict[str, float], sensor: str) -> Array:
    return np.array([p[f"{sensor}_bias_{axis}"] for axis in "xyz"])


def _slope(x: Array, u: Array, p: dict[str, float]) -> tuple[Array, Array]:
    """Derivatives (S, 17) of pose, velocities and speeds in thousands, and the specific force (S, 3) in the body."""
    q, v, w, speeds = x[:, 3:7], x[:, 7:10], x[:, 10:13], x[:, 13:]
    R = _matrices(q / np.linalg.norm(q, axis=1)[:, None])
    squares = 1e6 * speeds**2
    thrusts = p["thrust_coefficient"] * squares
    in_body = np.einsum("sji,sj->si", R, v)
    force = np.column_stack([-p["drag"] * in_body[:, 0], -p["drag"] * in_body[:, 1], thrusts.sum(axis=1)]) / p["mass"]
    yaw = -p["torque_coefficient"] * squares @ DIRECTIONS
    moments = np.column_stack([thrusts @ PLACES[:, 1], -thrusts @ PLACES[:, 0], yaw])
    J = np.array([p["inertia_x"], p["inertia_y"], p["inertia_z"]])
    turning = (moments - np.cross(w, J * w)) / J
    w0, vector = q[:, :1], q[:, 1:]
    attitude = 0.5 * np.hstack([-(vector * w).sum(axis=1, keepdims=True), w0 * w + np.cross(vector, w)])
    a = np.einsum("sij,sj->si", R, force) - [0.0, 0.0, G]
    return np.hstack([v, attitude, a, turning, (u - speeds) / p["motor_time_constant"]]), force
