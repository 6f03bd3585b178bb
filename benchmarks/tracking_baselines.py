"""What an engineer would track parameters with instead, for `tracking`: Kalman filters and recursive least squares.

``ekf``, ``ukf``
    The parameters are states that walk at random: masses, inertias and coefficients as logarithms, which keeps them
    positive, biases as they are.  An attitude has three errors.  A sample beyond five standard deviations of its
    innovation is not used.  Where a sensor has been so for .3 s, and after a gap, the state begins anew, from robust
    lines through .3 s of samples; the parameters stay.

``rls``
    Recursive least squares with forgetting.  Causal Hampel filter, then the same second-order low-pass filter on both
    sides of the equations, which are linear in 1/mass, drag/mass and 1/inertia.  Updates pause after a gap until the
    filters have settled.

Densities of random accelerations and walks, forgetting and bandwidth were chosen on flights of seeds from 1000 on, for
the least error over all scenarios: ``python benchmarks/tracking.py --tune``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import quadrotor_flights as quad
from tracking_bodies import Array, Body, Columns, Planar, Quadrotor, advanced, rotated
from tracking_flights import KNOWN, Flight

from simulated import ARM_LENGTH, GRAVITY

GATE, IMPATIENCE = 5.0, 0.3
"""Standard deviations of an innovation; s."""
RESTART = 0.25
"""Gap, s, over which no state is predicted."""
FIRST_STD = 0.15
"""Of the logarithms of parameters at the beginning, which are a tenth off."""
BIAS_STD, BIAS_WALK = 0.2, 1e-3
"""Of biases at the beginning, and per root second; units of the sensor."""


@dataclass(frozen=True)
class Moment:
    """Estimates at one time.

    Parameters
    ----------
    time : float
        s
    values, errors : mapping of str to float
        Parameters and their standard errors.
    seconds : float
        Of the processor, since the moment before.
    changes : tuple of (str, float)
        Parameters that are reported as changed, and since when.
    """

    time: float
    values: Mapping[str, float]
    errors: Mapping[str, float]
    seconds: float
    changes: tuple[tuple[str, float], ...] = ()


Method = Callable[[Flight, float], Iterator[Moment]]
"""Moments of a flight, one per so many seconds."""


# ---------------------------------------------------------------------- Kalman filters


class Transform(Protocol):
    """Mean and covariance of a function of a Gaussian."""

    def spread(self, P: Array) -> Array:
        """Errors (m, n) at which the function is evaluated, the first of them zero."""

    def moments(self, errors: Array, found: Array, P: Array) -> tuple[Array, Array, Array]:
        """Mean (k,), covariance (k, k) and cross covariance (n, k) of values (m, k), less the first of them."""


@dataclass(frozen=True)
class Linearised:
    """First order, of the extended Kalman filter; slopes by differences."""

    step: float = 1e-6

    def spread(self, P: Array) -> Array:
        """Small steps along the axes."""
        return np.vstack([np.zeros(len(P)), self.step * np.eye(len(P))])

    def moments(self, errors: Array, found: Array, P: Array) -> tuple[Array, Array, Array]:
        """``J P J'`` and ``P J'``."""
        J = found[1:].T / self.step
        cross = P @ J.T
        return np.zeros(len(J)), J @ cross, cross


@dataclass(frozen=True)
class Unscented:
    """Sigma points at ``sqrt(n)`` standard deviations (Julier and Uhlmann 1997), the middle without weight."""

    def spread(self, P: Array) -> Array:
        """Columns of the root, both ways."""
        root = np.sqrt(len(P)) * np.linalg.cholesky(P).T
        return np.vstack([np.zeros(len(P)), root, -root])

    def moments(self, errors: Array, found: Array, P: Array) -> tuple[Array, Array, Array]:
        """Sums over points."""
        mean = found[1:].mean(axis=0)
        apart, n = found[1:] - mean, len(found) - 1
        return mean, apart.T @ apart / n, errors[1:].T @ apart / n


@dataclass(frozen=True)
class Tuning:
    """Density of random accelerations, m/s^2 per root Hz, and of the parameters' logarithms, per root second."""

    acceleration: float
    walk: float


class KalmanFilter:
    """State and parameters of one flight.

    Parameters
    ----------
    body : Body
    transform : Transform
    tuning : Tuning
    start : mapping of str to float
    """

    def __init__(self, body: Body, transform: Transform, tuning: Tuning, start: Mapping[str, float]) -> None:
        self._body, self._transform = body, transform
        self._logarithmic = np.array(["bias" not in name for name in body.parameters])
        values = np.array([start[name] for name in body.parameters])
        self._h = np.where(self._logarithmic, np.log(np.where(self._logarithmic, values, 1.0)), values)
        self._n = len(body.first_std)
        stds = np.where(self._logarithmic, FIRST_STD, BIAS_STD)
        self._P = np.diag(np.concatenate([body.first_std, stds]) ** 2)
        walks = np.where(self._logarithmic, tuning.walk, BIAS_WALK)
        self._q = np.concatenate([tuning.acceleration * body.pushed, walks]) ** 2
        self._x = np.empty(0)
        self._refused = np.zeros(len(body.signals))

    def begin(self, rows: Columns) -> None:
        """Begin with a state from samples, the parameters as they are."""
        self._x, n = self._body.first(rows), self._n
        self._refused[:] = 0.0
        self._P[:n, :] = self._P[:, :n] = 0.0
        self._P[:n, :n] = np.diag(self._body.first_std**2)

    def _values(self, h: Array) -> dict[str, Array]:
        values = np.where(self._logarithmic, np.exp(np.where(self._logarithmic, h, 0.0)), h)
        return dict(zip(self._body.parameters, np.atleast_2d(values).T, strict=True))

    def _spread(self) -> tuple[Array, Array, Array]:
        errors = self._transform.spread(self._P)
        return errors, self._body.moved(self._x[None], errors[:, : self._n]), self._h + errors[:, self._n :]

    def predict(self, u: Array, dt: float) -> None:
        """Predict over an interval with held inputs."""
        errors, x, h = self._spread()
        moved = advanced(self._body, x, self._values(h), u, dt)
        found = np.hstack([self._body.apart(moved, moved[0]), h - self._h])
        mean, covariance, _ = self._transform.moments(errors, found, self._P)
        self._x, self._h = self._body.moved(moved[:1], mean[None, : self._n])[0], self._h + mean[self._n :]
        self._P = covariance + np.diag(self._q * dt)

    def correct(self, y: Array, u: Array, dt: float) -> None:
        """Correct by the samples (n_y,), NaN where there is none, that pass the gate."""
        errors, x, h = self._spread()
        predicted = self._body.readings(x, self._values(h), u)
        mean, S, cross = self._transform.moments(errors, predicted - predicted[0], self._P)
        S = S + np.diag(self._body.noise**2)
        innovation = self._body.aligned(y, predicted[0]) - predicted[0] - mean
        beyond = np.abs(innovation) > GATE * np.sqrt(np.diag(S))
        self._refused = np.where(np.isnan(y), self._refused, (self._refused + dt) * beyond)
        used = np.flatnonzero(np.isfinite(innovation) & ~beyond)
        if not len(used):
            return
        gain = np.linalg.solve(S[np.ix_(used, used)], cross[:, used].T).T
        step = gain @ innovation[used]
        self._x, self._h = self._body.moved(self._x[None], step[None, : self._n])[0], self._h + step[self._n :]
        P = self._P - gain @ cross[:, used].T
        self._P = 0.5 * (P + P.T)

    @property
    def is_lost(self) -> bool:
        """True where the samples of a sensor have been far from their predictions for long."""
        return bool(self._refused.max() > IMPATIENCE)

    def estimates(self) -> tuple[dict[str, float], dict[str, float]]:
        """Values and standard errors of the parameters."""
        values = {name: float(x[0]) for name, x in self._values(self._h).items()}
        stds = np.sqrt(np.diag(self._P)[self._n :])
        pairs = zip(values.items(), stds, self._logarithmic, strict=True)
        return values, {name: float(s * (value if log else 1.0)) for (name, value), s, log in pairs}


def body_of(flight: Flight) -> Body:
    """Equations of the machine of a flight."""
    return Quadrotor(flight.known[KNOWN]) if KNOWN in flight.known else Planar()


def kalman(transform: Transform, tuning: Tuning) -> Method:
    """Method of a Kalman filter."""

    def run(flight: Flight, step: float) -> Iterator[Moment]:
        body, t = body_of(flight), flight.columns["t"]
        found = KalmanFilter(body, transform, tuning, flight.start)
        dt = float(np.median(np.diff(t)))
        y = np.column_stack([flight.columns[name] for name in body.signals])
        u = np.column_stack([flight.columns[name] for name in body.inputs])
        since, n_first, due, begin = 0, round(IMPATIENCE / dt), t[0] + step, time.process_time()
        for k in range(1, len(t)):
            apart = t[k] - t[k - 1]
            since = k if apart > RESTART else max(since, k - n_first) if found.is_lost else since
            if k - since == n_first:
                found.begin(flight.rows(slice(since, k + 1)))
                since = -len(t)
            elif since < 0:
                for _ in range(round(apart / dt)):
                    found.predict(u[k - 1], dt)
                found.correct(y[k], u[k], dt)
            if t[k] >= due - 0.5 * dt:
                now = time.process_time()
                yield Moment(float(t[k]), *found.estimates(), now - begin)
                due, begin = t[k] + step, time.process_time()

    return run


# ---------------------------------------------------------------------- recursive least squares
HAMPEL_ROWS, HAMPEL_LIMIT = 11, 4.0
"""Samples before, the newest included; standard deviations from their median."""
MOST_FILLED = 5
"""Rows over which samples are interpolated; filters pause after a longer gap."""


class Hampel:
    """Causal Hampel filter of several signals: a sample far from the median of the last ones becomes it.

    Missing samples, and the first ones, are those before.
    """

    def __init__(self) -> None:
        self._past: list[Array] = []

    def __call__(self, y: Array) -> Array:
        """The sample (n,) that is used."""
        if self._past:
            y = np.where(np.isnan(y), self._past[-1], y)
        self._past = [*self._past[1 - HAMPEL_ROWS :], y]
        median = np.median(self._past, axis=0)
        deviation = 1.4826 * np.median(np.abs(self._past - median), axis=0)
        return np.where(np.abs(y - median) > HAMPEL_LIMIT * np.maximum(deviation, 1e-12), median, y)


class LowPass:
    """Second-order Butterworth filter of several signals, and the derivatives of what it yields.

    Parameters
    ----------
    bandwidth : float
        Hz
    dt : float
        s
    """

    def __init__(self, bandwidth: float, dt: float) -> None:
        self._w, self._dt = 2.0 * np.pi * bandwidth, dt
        self.value = self.slope = self.curvature = np.empty(0)

    def __call__(self, y: Array) -> Array:
        """The filtered sample (n,); ``slope`` and ``curvature`` are its derivatives."""
        if not len(self.value):
            self.value, self.slope, self.curvature = y.copy(), np.zeros(len(y)), np.zeros(len(y))
        self.curvature = self._w**2 * (y - self.value) - np.sqrt(2.0) * self._w * self.slope
        self.slope = self.slope + self._dt * self.curvature
        self.value = self.value + self._dt * self.slope
        return self.value


class LeastSquares:
    """Recursive least squares of one equation ``y = phi' theta`` with exponential forgetting, in information form.

    Parameters
    ----------
    first : (n,) array
        Values at the beginning, which have the weight of one row.
    keep : float
        Weight of the past from row to row.
    """

    def __init__(self, first: Array, keep: float) -> None:
        n = len(first)
        self._keep, self._square, self._weight = keep, 0.0, 0.0
        self._A = np.diag(1.0 / (np.square(first) + 1e-6))
        self._b = self._A @ first + np.zeros(n)

    def add(self, phi: Array, y: float) -> None:
        """Take one equation."""
        self._A = self._keep * self._A + np.outer(phi, phi)
        self._b = self._keep * self._b + phi * y
        self._square = self._keep * self._square + y**2
        self._weight = self._keep * self._weight + 1.0

    def solved(self) -> tuple[Array, Array]:
        """Values (n,), and their standard errors if the errors of the equation were white."""
        theta = np.linalg.solve(self._A, self._b)
        variance = max(self._square - self._b @ theta, 0.0) / max(self._weight, 1.0)
        return theta, np.sqrt(variance * np.diag(np.linalg.inv(self._A)))


@dataclass(frozen=True)
class Forgetting:
    """Time constant of forgetting, s, and bandwidth of the filters, Hz."""

    memory: float
    bandwidth: float


class Regression(Protocol):
    """Equations of a machine for recursive least squares."""

    def add(self, y: Mapping[str, float], *, settled: bool) -> None:
        """Take the filtered samples of a row, and the equations where the filters have settled."""

    @property
    def is_lost(self) -> bool:
        """True where the samples of a sensor have been far from their predictions for long."""
        return bool(self._refused.max() > IMPATIENCE)

    def estimates(self) -> tuple[dict[str, float], dict[str, float]]:
        """Values and standard errors of the parameters."""


def _inverse(name: str, theta: float, error: float) -> tuple[dict[str, float], dict[str, float]]:
    """A parameter of which an unknown is the inverse."""
    return {name: 1.0 / theta}, {name: error / theta**2}


class _Held:
    """Filtered rows of which force and motion belong together: a force acts from its row to the next."""

    def __init__(self, bandwidth: float, dt: float) -> None:
        self.filter, self._before = LowPass(bandwidth, dt), np.empty(0)

    def __call__(self, y: Array) -> tuple[Array, Array]:
        """Filtered values (n,) over the last interval, and the mean of this and the one before it."""
        found = self.filter(y)
        mean = 0.5 * (found + self._before) if len(self._before) else found
        self._before = found.copy()
        return found, mean


class PlanarRegression:
    """``a = -T s / m - (d/m) |T| v c``, and the same along z; ``theta'' = L M / I``."""

    def __init__(self, flight: Flight, dt: float, tuning: Forgetting) -> None:
        keep, start = np.exp(-dt / tuning.memory), flight.start
        self._poses, self._forces = LowPass(tuning.bandwidth, dt), _Held(tuning.bandwidth, dt)
        self._force = LeastSquares(np.array([1.0, start["drag"]]) / start["mass"], np.sqrt(keep))
        self._moment = LeastSquares(np.array([1.0 / start["inertia"]]), keep)
        self._before: Mapping[str, float] = {}

    def add(self, y: Mapping[str, float], *, settled: bool) -> None:
        """As `Regression.add`."""
        before, self._before = self._before or y, y
        thrust, theta = before["thrust"], 0.5 * (before["theta"] + y["theta"])
        s, c = np.sin(theta), np.cos(theta)
        self._poses(np.array([y["x"], y["z"], y["theta_dot"]]))
        along = abs(thrust) * self._poses.slope[:2] * [c, s]
        now, mean = self._forces(np.array([-thrust * s, thrust * c, *along, ARM_LENGTH * before["moment"]]))
        if settled:
            for k, gravity in enumerate((0.0, GRAVITY)):
                self._force.add(np.array([mean[k], -mean[2 + k]]), self._poses.curvature[k] + gravity)
            self._moment.add(now[4:], self._poses.slope[2])

    def estimates(self) -> tuple[dict[str, float], dict[str, float]]:
        """As `Regression.estimates`."""
        (inverse, ratio), (error, of_ratio) = self._force.solved()
        moment, of_moment = self._moment.solved()
        values, errors = _inverse("mass", inverse, error)
        more, more_errors = _inverse("inertia", moment[0], of_moment[0])
        return values | more | {"drag": ratio / inverse}, errors | more_errors | {"drag": of_ratio / inverse}


class QuadrotorRegression:
    """``acc_z = k sum(n^2) / m + b``, ``acc_xy = -(d/m) v_xy + b``, ``w' = M/J + c w w``; the motors' lag is known."""

    def __init__(self, flight: Flight, dt: float, tuning: Forgetting) -> None:
        keep, start = np.exp(-dt / tuning.memory), flight.start
        self._thrust_coefficient = flight.known[KNOWN]
        self._lag = 1.0 - np.exp(-dt / start["motor_time_constant"])
        self._speeds = np.empty(0)
        self._poses, self._others = LowPass(tuning.bandwidth, dt), LowPass(tuning.bandwidth, dt)
        self._turns, self._moments_of = LowPass(tuning.bandwidth, dt), _Held(tuning.bandwidth, dt)
        self._lift = LeastSquares(np.array([1.0 / start["mass"], 0.0]), keep)
        self._drag = LeastSquares(np.array([start["drag"] / start["mass"], 0.0, 0.0]), np.sqrt(keep))
        self._moments = [LeastSquares(np.array([1.0 / start[f"inertia_{axis}"], 0.0]), keep) for axis in "xy"]

    def add(self, y: Mapping[str, float], *, settled: bool) -> None:
        """As `Regression.add`."""
        commands, gyro, acc, position, attitude = (
            np.array([y[name] for name in names])
            for names in (quad.COMMANDS, quad.GYRO, quad.ACC, quad.POSITION, quad.ATTITUDE)
        )
        before = self._speeds if len(self._speeds) else commands
        self._speeds = before + self._lag * (commands - before)
        thrusts = self._thrust_coefficient * before**2
        self._poses(position)
        inverse = attitude[None] * [1.0, -1.0, -1.0, -1.0] / np.linalg.norm(attitude)
        velocity = rotated(inverse, self._poses.slope[None])[0]
        z = self._others(np.array([*acc, *velocity[:2], thrusts.sum()]))
        self._turns(gyro[:2])
        moments = (thrusts @ quad.PLACES[:, 1], -(thrusts @ quad.PLACES[:, 0]))
        m, _ = self._moments_of(np.array([*moments, gyro[1] * gyro[2], gyro[2] * gyro[0]]))
        if settled:
            self._lift.add(np.array([z[5], 1.0]), z[2])
            self._drag.add(np.array([-z[3], 1.0, 0.0]), z[0])
            self._drag.add(np.array([-z[4], 0.0, 1.0]), z[1])
            for k, equation in enumerate(self._moments):
                equation.add(m[[k, 2 + k]], self._turns.slope[k])

    def estimates(self) -> tuple[dict[str, float], dict[str, float]]:
        """As `Regression.estimates`."""
        lift, of_lift = self._lift.solved()
        drag, of_drag = self._drag.solved()
        values, errors = _inverse("mass", lift[0], of_lift[0])
        values, errors = values | {"drag": drag[0] * values["mass"]}, errors | {"drag": of_drag[0] * values["mass"]}
        for axis, equation in zip("xy", self._moments, strict=True):
            theta, error = equation.solved()
            more, more_errors = _inverse(f"inertia_{axis}", theta[0], error[0])
            values, errors = values | more, errors | more_errors
        return values, errors


def least_squares(tuning: Forgetting) -> Method:
    """Method of recursive least squares."""

    def run(flight: Flight, step: float) -> Iterator[Moment]:
        t = flight.columns["t"]
        dt = float(np.median(np.diff(t)))
        kind = QuadrotorRegression if KNOWN in flight.known else PlanarRegression
        found, clean = kind(flight, dt, tuning), Hampel()
        body = body_of(flight)
        names = (*body.signals, *body.inputs)
        y = np.column_stack([flight.columns[name] for name in names])
        settled_at, due, begin = t[0] + 1.0 / tuning.bandwidth, t[0] + step, time.process_time()
        n, last = len(body.signals), np.concatenate([clean(y[0, : len(body.signals)]), y[0, len(body.signals) :]])
        for k in range(1, len(t)):
            row, missing = np.concatenate([clean(y[k, :n]), y[k, n:]]), round((t[k] - t[k - 1]) / dt)
            if missing > MOST_FILLED:
                settled_at = t[k] + 1.0 / tuning.bandwidth
            for part in np.linspace(0.0, 1.0, missing + 1)[1:] if missing <= MOST_FILLED else (1.0,):
                between = last + part * (row - last)
                if part < 1.0:
                    between[n:] = last[n:]
                found.add(dict(zip(names, between, strict=True)), settled=t[k] > settled_at)
            last = row
            if t[k] >= due - 0.5 * dt:
                now = time.process_time()
                yield Moment(float(t[k]), *found.estimates(), now - begin)
                due, begin = t[k] + step, time.process_time()

    return run
