"""Machines of the built-in models, simulated independently: NumPy, Runge-Kutta, physical parameters.

Masses, lengths and inertias of the parts are those of a drawing, from which the parameters of the models follow; mass
matrices are inverted as linear systems, forces summed wheel by wheel and rotor by rotor.  Nothing is shared with the
package but `Log`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from diransac.data.log import Log

G = 9.81


@dataclass(frozen=True)
class Machine:
    """A machine with its excitation.

    Parameters
    ----------
    truth : parameters of the model that follow from those of the machine
    states, rates : names of the state's components, and of those rates that are signals themselves, by component
    inputs : names
    derivative : ``(x, u) -> dx/dt``
    start : x at row 0
    law : ``(t, x) -> u``, held over a sample
    dt, n_rows : s, and number of samples
    sensors : by name, a reading from all signals and inputs by name
    """

    truth: Mapping[str, float]
    states: tuple[str, ...]
    rates: Mapping[str, str]
    inputs: tuple[str, ...]
    derivative: Callable[..., np.ndarray]
    start: tuple[float, ...]
    law: Callable[..., tuple[float, ...]]
    dt: float
    n_rows: int
    sensors: Mapping[str, Callable[..., np.ndarray]] = field(default_factory=dict)


@cache
def simulate(name, substeps=5):
    """Time, all signals and all inputs by name, without noise."""
    machine = MACHINES[name]
    x, h, states, rates, inputs = np.array(machine.start, float), machine.dt / substeps, [], [], []
    for row in range(machine.n_rows):
        u = machine.law(row * machine.dt, x)
        states.append(x)
        rates.append(machine.derivative(x, u))
        inputs.append(u)
        for _ in range(substeps):
            k1 = machine.derivative(x, u)
            k2 = machine.derivative(x + h / 2 * k1, u)
            k3 = machine.derivative(x + h / 2 * k2, u)
            k4 = machine.derivative(x + h * k3, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    signals = dict(zip(machine.states, np.array(states).T, strict=True))
    slopes = dict(zip(machine.states, np.array(rates).T, strict=True))
    signals |= {rate: slopes[state] for state, rate in machine.rates.items()}
    acting = dict(zip(machine.inputs, np.array(inputs).T, strict=True))
    signals |= {sensor: read(**signals, **acting) for sensor, read in machine.sensors.items()}
    return np.arange(machine.n_rows) * machine.dt, signals, acting


def recorded(name, noise=None, outliers=0.0, seed=0):
    """Log of a machine: every signal, or those with a noise (standard deviation, the signal's unit).

    Outliers are uniform within five standard deviations of the signal itself.
    """
    time, signals, inputs = simulate(name)
    if noise is None:
        return Log.from_arrays(time, {**signals, **inputs})
    rng, columns = np.random.default_rng(seed), {}
    for signal, scale in noise.items():
        x, hit = signals[signal], rng.random(len(time)) < outliers
        wild = 5.0 * max(x.std(), scale) * rng.uniform(-1.0, 1.0, len(time))
        columns[signal] = x + scale * rng.standard_normal(len(time)) + hit * wild
    return Log.from_arrays(time, {**columns, **inputs})


def sines(t, *terms):
    """Sum of sines, each an amplitude, a frequency in rad/s and a phase."""
    return sum(amplitude * np.sin(rate * t + phase) for amplitude, rate, phase in terms)


# ---------------------------------------------------------------------- cart-pole, hanging

CART, POLE, LENGTH, CART_FRICTION, POLE_FRICTION = 1.1, 0.25, 0.6, 1.4, 0.006  # a uniform rod of this length


def cart_pole_rates(x, u):
    """Lagrange's equations of cart and rod, with the centre of the rod at half of its length."""
    _, angle, speed, rate = x
    arm = LENGTH / 2
    mass, coupling, inertia = CART + POLE, POLE * arm * np.cos(angle), POLE * LENGTH**2 / 3
    along = u[0] - CART_FRICTION * speed + POLE * arm * rate**2 * np.sin(angle)
    across = -POLE * G * arm * np.sin(angle) - POLE_FRICTION * rate
    determinant = mass * inertia - coupling**2
    turning = (mass * across - coupling * along) / determinant
    return np.array([speed, rate, (inertia * along - coupling * across) / determinant, turning])


def cart_pole_law(t, x):
    """Force with a weak spring to the middle of the track."""
    return (sines(t, (3.0, 1.3, 0.2), (2.0, 4.1, 1.0), (3.0, 7.7, 2.0)) - 4.0 * x[0],)


# ---------------------------------------------------------------------- flexible joint

JOINT = {
    "motor_inertia": 0.02,
    "load_inertia": 0.06,
    "stiffness": 30.0,
    "damping": 0.03,
    "motor_friction": 0.05,
    "load_friction": 0.08,
}


def joint_rates(x, u):
    """Torques on both sides of the spring."""
    motor, load, motor_speed, load_speed = x
    inertia_m, inertia_l, k, d, friction_m, friction_l = JOINT.values()
    through = k * (motor - load) + d * (motor_speed - load_speed)
    of_motor = (u[0] - friction_m * motor_speed - through) / inertia_m
    return np.array([motor_speed, load_speed, of_motor, (through - friction_l * load_speed) / inertia_l])


def joint_law(t, x):
    """Torque on both sides of the resonance, 7 Hz."""
    steps = 0.5 * np.sign(np.sin(3.3 * t))
    return (sines(t, (0.6, 2.1, 0.0), (0.6, 9.0, 1.0), (0.5, 23.0, 0.4), (0.5, 47.0, 2.0)) + steps,)


# ---------------------------------------------------------------------- motors

MOTOR = {
    "inertia": 3e-4,
    "viscous_friction": 2e-4,
    "torque_constant": 0.05,
    "resistance": 1.2,
    "inductance": 0.012,
}


def motor_rates(x, u):
    """Kirchhoff's and Newton's laws."""
    _, speed, current = x
    inertia, friction, constant, resistance, inductance = MOTOR.values()
    voltage = u[0] - resistance * current - constant * speed
    return np.array([speed, (constant * current - friction * speed) / inertia, voltage / inductance])


def resistive_motor_rates(x, u):
    """The same motor whose current follows at once."""
    _, speed = x
    inertia, friction, constant, resistance, _ = MOTOR.values()
    current = (u[0] - constant * speed) / resistance
    return np.array([speed, (constant * current - friction * speed) / inertia])


def motor_law(t, x):
    """Voltage with steps."""
    return (sines(t, (4.0, 2.3, 0.3), (3.0, 13.0, 1.0), (3.0, 41.0, 0.0)) + 3.0 * np.sign(np.sin(5.1 * t)),)


MOTOR_GAIN = MOTOR["torque_constant"] / (
    MOTOR["torque_constant"] ** 2 + MOTOR["viscous_friction"] * MOTOR["resistance"]
)
RESISTIVE_MOTOR = {
    "gain": MOTOR_GAIN,
    "time_constant": MOTOR_GAIN * MOTOR["inertia"] * MOTOR["resistance"] / MOTOR["torque_constant"],
}

# ---------------------------------------------------------------------- differential drive

RADIUS, TRACK = 0.06, 0.36
CHASSIS, CHASSIS_INERTIA, AHEAD, WHEEL_INERTIA = 8.0, 0.24, 0.05, 0.003
WHEEL_FRICTION, WHEEL_DRY_FRICTION, WHEEL_GAIN = 0.03, 0.08, 0.35
DRIVE = {
    "mass": CHASSIS + 2 * WHEEL_INERTIA / RADIUS**2,
    "inertia": CHASSIS_INERTIA + CHASSIS * AHEAD**2 + TRACK**2 / 2 * WHEEL_INERTIA / RADIUS**2,
    "moment": CHASSIS * AHEAD,
    "viscous_friction": WHEEL_FRICTION,
    "dry_friction": WHEEL_DRY_FRICTION,
}


ROLLING = WHEEL_INERTIA / RADIUS
CHASSIS_AND_WHEELS = np.linalg.inv(
    [
        [CHASSIS, 0.0, -1.0, -1.0],
        [0.0, CHASSIS_INERTIA + CHASSIS * AHEAD**2, TRACK / 2, -TRACK / 2],
        [ROLLING, -ROLLING * TRACK / 2, RADIUS, 0.0],
        [ROLLING, ROLLING * TRACK / 2, 0.0, RADIUS],
    ]
)


def drive_rates(x, torques):
    """Chassis and wheels with the forces between them as unknowns, and rolling as further equations.

    Unknowns: acceleration of the axle's midpoint along the robot, yaw acceleration, forces of both wheels.
    """
    _, _, yaw, speed, rate = x
    spins = np.array([speed - TRACK / 2 * rate, speed + TRACK / 2 * rate]) / RADIUS
    driven = torques - WHEEL_FRICTION * spins - WHEEL_DRY_FRICTION * np.sign(spins)
    lateral = CHASSIS * (speed * rate)  # of the axle, plus CHASSIS * AHEAD times the yaw acceleration
    along, turning, *_ = CHASSIS_AND_WHEELS @ (CHASSIS * AHEAD * rate**2, -lateral * AHEAD, *driven)
    return np.array([speed * np.cos(yaw), speed * np.sin(yaw), rate, along, turning])


def drive_law(t, x):
    """Torques about a forward drive, so that both wheels also turn backwards at times."""
    common = sines(t, (0.5, 0.7, 0.0), (0.4, 2.1, 1.0)) + 0.2
    steering = sines(t, (0.3, 1.1, 0.5), (0.25, 3.7, 0.0)) + 0.15 * np.sign(np.sin(0.9 * t))
    return common - steering, common + steering


# ---------------------------------------------------------------------- single-track vehicle

CAR = {"mass": 1450.0, "inertia": 2300.0, "front_stiffness": 78e3, "rear_stiffness": 96e3}
FRONT, REAR = 1.15, 1.5


def car_rates(x, u):
    """Newton and Euler for the velocities of the axles; slip is the angle between an axle's velocity and its wheels."""
    _, rate, lateral = x
    steering, speed = u
    forces = []
    for position, stiffness, wheel in ((FRONT, CAR["front_stiffness"], steering), (-REAR, CAR["rear_stiffness"], 0.0)):
        slip = (lateral + position * rate) / speed - wheel
        forces.append((position, -stiffness * slip))
    turning = sum(position * force for position, force in forces) / CAR["inertia"]
    return np.array([rate, turning, sum(force for _, force in forces) / CAR["mass"] - rate * speed])


def car_law(t, x):
    """Steering at a speed that varies."""
    steering = sines(t, (0.012, 0.9, 0.0), (0.012, 3.1, 1.0), (0.01, 6.3, 0.5)) + 0.006 * np.sign(np.sin(0.7 * t))
    return steering, 20.0 + 4.0 * np.sin(0.35 * t)


# ---------------------------------------------------------------------- the machines

MACHINES = {
    "cart-pole": Machine(
        {
            "mass": CART + POLE,
            "moment": POLE * LENGTH / 2,
            "inertia": POLE * LENGTH**2 / 3,
            "cart_friction": CART_FRICTION,
            "pole_friction": POLE_FRICTION,
        },
        ("x", "theta", "x_dot", "theta_dot"),
        {"x_dot": "x_ddot", "theta_dot": "theta_ddot"},
        ("force",),
        cart_pole_rates,
        (0.0, 0.4, 0.0, 0.0),
        cart_pole_law,
        0.01,
        2000,
    ),
    "flexible-joint": Machine(
        JOINT,
        ("motor", "load", "motor_dot", "load_dot"),
        {"motor_dot": "motor_ddot", "load_dot": "load_ddot"},
        ("torque",),
        joint_rates,
        (0.0, 0.0, 0.0, 0.0),
        joint_law,
        0.005,
        2000,
    ),
    "dc-motor": Machine(
        MOTOR,
        ("angle", "angle_dot", "current"),
        {"angle_dot": "angle_ddot", "current": "current_dot"},
        ("voltage",),
        motor_rates,
        (0.0, 0.0, 0.0),
        motor_law,
        0.002,
        2000,
    ),
    "resistive-motor": Machine(
        RESISTIVE_MOTOR,
        ("angle", "angle_dot"),
        {"angle_dot": "angle_ddot"},
        ("voltage",),
        resistive_motor_rates,
        (0.0, 0.0),
        motor_law,
        0.005,
        1500,
    ),
    "differential-drive": Machine(
        DRIVE,
        ("x", "y", "yaw", "speed", "yaw_rate"),
        {"speed": "speed_dot", "yaw_rate": "yaw_rate_dot"},
        ("left_torque", "right_torque"),
        drive_rates,
        (0.0, 0.0, 0.0, 0.2, 0.1),
        drive_law,
        0.02,
        1500,
    ),
    "voltage-drive": Machine(
        {**DRIVE, "motor_gain": WHEEL_GAIN},
        ("x", "y", "yaw", "speed", "yaw_rate"),
        {"speed": "speed_dot", "yaw_rate": "yaw_rate_dot"},
        ("left_voltage", "right_voltage"),
        lambda x, u: drive_rates(x, WHEEL_GAIN * np.array(u)),
        (0.0, 0.0, 0.0, 0.2, 0.1),
        lambda t, x: tuple(torque / WHEEL_GAIN for torque in drive_law(t, x)),
        0.02,
        1500,
        {
            "left_wheel": lambda speed, yaw_rate, **_: (speed - TRACK / 2 * yaw_rate) / RADIUS,
            "right_wheel": lambda speed, yaw_rate, **_: (speed + TRACK / 2 * yaw_rate) / RADIUS,
        },
    ),
    "single-track-vehicle": Machine(
        CAR,
        ("yaw", "yaw_dot", "lateral_velocity"),
        {"yaw_dot": "yaw_ddot", "lateral_velocity": "lateral_velocity_dot"},
        ("steering", "speed"),
        car_rates,
        (0.0, 0.0, 0.0),
        car_law,
        0.02,
        1500,
        {
            "lateral_acceleration": lambda lateral_velocity_dot, speed, yaw_dot, **_: (
                lateral_velocity_dot + speed * yaw_dot
            )
        },
    ),
}
