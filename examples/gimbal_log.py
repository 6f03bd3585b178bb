"""Two recordings of a simulated pan-tilt gimbal, as ROS 2 writes them: ``python examples/gimbal_log.py``.

``gimbal_monday.mcap`` and ``gimbal_friday.mcap`` are the logs of ``docs/tutorial.md``.  The camera's centre of mass is
off its axis, and its inertia about the pan axis depends on the tilt.  Encoders and drives have messages of their own,
in degrees and milliamperes, with clocks of their own; of the encoders' samples 2 % are glitches, and 0.6 s are lost.
At times the drives are off, and somebody turns the camera by hand.  The cable to the camera pulls the pan axis back,
and gusts turn it.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin, tanh
from pathlib import Path

import numpy as np
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

TORQUE_CONSTANT = 0.085  # N m/A, both axes
TRUTH = {
    "base_inertia": 0.0031,
    "camera_inertia": 0.0024,
    "tilt_inertia": 0.0019,
    "unbalance": 0.045,
    "pan_viscous": 0.006,
    "pan_dry": 0.014,
    "tilt_viscous": 0.004,
    "tilt_dry": 0.008,
}
CABLE = 0.02  # N m/rad
STEP = 0.0005
LIMIT = 2.0  # A
DRIVES_HZ, ENCODERS_HZ, IMU_HZ = 100, 50, 100
START = 1_790_000_000_000_000_000  # ns
OFF, TRACKING = 0, 3

MESSAGES = {
    "ptu_msgs/msg/Encoders": "std_msgs/Header header\nfloat64 pan_deg\nfloat64 down_deg\n",
    "ptu_msgs/msg/Drives": "std_msgs/Header header\nint16[2] current_ma\nuint8 mode\nfloat32 bus_volts\n",
}
DEFINITIONS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
}
IMU = (
    "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
)


@dataclass(frozen=True)
class Motion:
    """Motion of the gimbal every `STEP`: time, s, angles, rad, rates, rad/s, currents, A, of pan and tilt, (n, 2)."""

    time: np.ndarray
    angles: np.ndarray
    rates: np.ndarray
    currents: np.ndarray


def target(t: float, shift: float) -> tuple[float, float]:
    """Pan and tilt, rad, at which the camera is pointed: sweeps, and jumps from one object to the next."""
    pan = 0.6 * sin(1.1 * t + shift) + 0.25 * sin(4.3 * t) + (0.35 if sin(0.9 * t + 2.0 * shift) > 0.0 else -0.35)
    tilt = 0.35 * sin(1.7 * t - shift) + 0.15 * sin(5.9 * t) + (0.3 if sin(1.3 * t + shift) > 0.3 else -0.2)
    return pan, tilt


def is_off(t: float, off: list[tuple[float, float]]) -> bool:
    """True within one of the stretches, s, in which the drives are off."""
    return any(start <= t < stop for start, stop in off)


def simulated(seconds: float, off: list[tuple[float, float]], seed: int) -> Motion:
    """Gimbal under the control of its drives; while they are off somebody turns the camera by hand."""
    p, n = TRUTH, round(seconds / STEP)
    rng, knots = np.random.default_rng(seed), np.arange(0.0, seconds + 0.7, 0.7)
    gusts = np.interp(np.arange(n) * STEP, knots, rng.normal(0.0, 0.003, len(knots)))
    angles, rates, currents = np.zeros((3, n, 2))
    pan, tilt, pan_rate, tilt_rate = 0.2, -0.3, 0.0, 0.0
    for k in range(n):
        t = k * STEP
        tracking = not is_off(t, off)
        wanted = target(t, 0.9 * seed) if tracking else (0.2 + 0.4 * sin(1.5 * t), -0.3 + 0.3 * sin(2.0 * t))
        if k % round(1.0 / (DRIVES_HZ * STEP)) == 0:
            pull = (7.0 * (wanted[0] - pan) - 0.6 * pan_rate, 5.0 * (wanted[1] - tilt) - 0.4 * tilt_rate)
            currents[k:] = currents[k] + 0.35 * (np.clip(pull, -LIMIT, LIMIT) - currents[k]) if tracking else 0.0
        hand = (
            (0.0, 0.0)
            if tracking
            else (0.5 * (wanted[0] - pan) - 0.02 * pan_rate, 0.5 * (wanted[1] - tilt) - 0.02 * tilt_rate + 0.04)
        )
        angles[k], rates[k] = (pan, tilt), (pan_rate, tilt_rate)
        inertia = p["base_inertia"] + p["camera_inertia"] * cos(tilt) ** 2
        turn = p["camera_inertia"] * sin(2.0 * tilt) * pan_rate
        on_pan = TORQUE_CONSTANT * currents[k, 0] + hand[0] + turn * tilt_rate + gusts[k] - CABLE * pan
        on_tilt = TORQUE_CONSTANT * currents[k, 1] + hand[1] - 0.5 * turn * pan_rate - p["unbalance"] * cos(tilt)
        on_pan -= p["pan_viscous"] * pan_rate + p["pan_dry"] * tanh(pan_rate / 0.01)
        on_tilt -= p["tilt_viscous"] * tilt_rate + p["tilt_dry"] * tanh(tilt_rate / 0.01)
        pan_rate, tilt_rate = pan_rate + STEP * on_pan / inertia, tilt_rate + STEP * on_tilt / p["tilt_inertia"]
        pan, tilt = pan + STEP * pan_rate, tilt + STEP * tilt_rate
    return Motion(np.arange(n) * STEP, angles, rates, currents)


def record(motion: Motion, off: list[tuple[float, float]], seed: int, path: Path) -> None:
    """Write what the gimbal's computer would record of a motion."""
    rng = np.random.default_rng([seed, 1])
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register({k: v for name, text in MESSAGES.items() for k, v in get_types_from_msg(text, name).items()})
    kinds = store.types
    time, header = kinds["builtin_interfaces/msg/Time"], kinds["std_msgs/msg/Header"]
    vector, quaternion = kinds["geometry_msgs/msg/Vector3"], kinds["geometry_msgs/msg/Quaternion"]
    found = []

    def rows(rate: float, phase: float) -> np.ndarray:
        """Rows of the motion at which a sensor with a clock of its own takes its samples."""
        return np.arange(round(phase / STEP), len(motion.time), round(1.0 / (rate * STEP)))

    def add(topic: str, kind: str, t: float, delay: float, *content: object) -> None:
        """Add a message, stamped when it was sampled, and recorded later."""
        stamp = START + round(1e9 * t)
        head = header(stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id="ptu")
        data = store.serialize_cdr(kinds[kind](head, *content), kind)
        found.append((stamp + round(1e9 * delay), topic, kind, bytes(data)))

    lost = 0.55 * motion.time[-1]
    for k in rows(ENCODERS_HZ, 0.0025):
        t = motion.time[k]
        if not lost < t < lost + 0.6:
            degrees = np.round((np.degrees(motion.angles[k]) + rng.normal(0.0, 0.02, 2)) / 0.022) * 0.022
            degrees += (rng.random(2) < 0.02) * rng.uniform(-60.0, 60.0, 2)
            add("/ptu/encoders", "ptu_msgs/msg/Encoders", t, rng.uniform(0.001, 0.009), degrees[0], -degrees[1])
    for k in rows(DRIVES_HZ, 0.0):
        t = motion.time[k]
        milliamperes = np.round(1000.0 * motion.currents[k] + rng.normal(0.0, 4.0, 2)).astype(np.int16)
        mode = OFF if is_off(t, off) else TRACKING
        volts = 24.6 - 0.01 * t - 0.2 * np.abs(motion.currents[k]).sum()
        add("/ptu/drives", "ptu_msgs/msg/Drives", t, rng.uniform(0.0005, 0.002), milliamperes, mode, volts)
    for k in rows(IMU_HZ, 0.0035):
        (_, tilt), (pan_rate, tilt_rate) = motion.angles[k], motion.rates[k]
        rates = np.array([pan_rate * sin(tilt), -tilt_rate, pan_rate * cos(tilt)]) + rng.normal(0.0, 0.01, 3)
        rates += radians(0.6)
        force = 9.81 * np.array([sin(tilt), 0.0, cos(tilt)]) + rng.normal(0.0, 0.2, 3)
        none, unknown = quaternion(x=0.0, y=0.0, z=0.0, w=1.0), np.full(9, -1.0)
        content = none, unknown, vector(*rates), unknown, vector(*force), unknown
        add("/camera/imu", "sensor_msgs/msg/Imu", motion.time[k], rng.uniform(0.002, 0.004), *content)

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels: dict[str, int] = {}
        for stamp, topic, kind, data in sorted(found, key=lambda x: x[0]):
            if topic not in channels:
                schema = writer.register_schema(kind, "ros2msg", definition(kind).encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def definition(kind: str) -> str:
    """Definition of a message with those of its parts, as ROS 2 records it."""
    parts = [f"{'=' * 80}\nMSG: {name}\n{text}" for name, text in DEFINITIONS.items()]
    return "".join([MESSAGES.get(kind, IMU), *parts])


def main() -> None:
    """Write both recordings into the working directory."""
    for day, seconds, off, seed in (("monday", 16.0, [(0.0, 1.5), (4.0, 4.8)], 1), ("friday", 12.0, [(0.0, 1.5)], 2)):
        path = Path(f"gimbal_{day}.mcap")
        record(simulated(seconds, off, seed), off, seed, path)
        print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
