"""Example of a quadrotor of one's own: rotors that follow their commands with a lag, drag, a gyroscope with biases."""

from typing import Any

import diransac as dr

G, L = 9.81, 0.12 / 2**0.5
ROTORS = [(L, -L, 1), (-L, L, 1), (L, L, -1), (-L, -L, -1)]  # forward, left, direction seen from above


def kinematics(q: Any, v: Any) -> list[Any]:
    """Rates of the position and of the quaternion."""
    return [
        *(v.vx, v.vy, v.vz),
        0.5 * (-q.qx * v.wx - q.qy * v.wy - q.qz * v.wz),
        0.5 * (q.qw * v.wx + q.qy * v.wz - q.qz * v.wy),
        0.5 * (q.qw * v.wy - q.qx * v.wz + q.qz * v.wx),
        0.5 * (q.qw * v.wz + q.qx * v.wy - q.qy * v.wx),
    ]


def equations(q: Any, v: Any, a: Any, u: Any, p: Any) -> list[Any]:
    """Residuals of Newton's and Euler's equations, and of the rotors' lag."""
    up = [2 * (q.qx * q.qz + q.qw * q.qy), 2 * (q.qy * q.qz - q.qw * q.qx), 1 - 2 * (q.qx**2 + q.qy**2)]
    squares = [v[f"n{i}"] ** 2 for i in range(1, 5)]
    x, y, spin = (sum(rotor[k] * n2 for rotor, n2 in zip(ROTORS, squares, strict=True)) for k in range(3))
    along = up[0] * v.vx + up[1] * v.vy + up[2] * v.vz
    motion = zip((v.vx, v.vy, v.vz), (a.vx, a.vy, a.vz + G), up, strict=True)
    return [
        *(p.mass * f - p.kT * sum(squares) * e + p.drag * (speed - along * e) for speed, f, e in motion),
        p.Jx * a.wx + (p.Jz - p.Jy) * v.wy * v.wz - p.kT * y,
        p.Jy * a.wy + (p.Jx - p.Jz) * v.wz * v.wx + p.kT * x,
        p.Jz * a.wz + (p.Jy - p.Jx) * v.wx * v.wy + p.kQ * spin,
        *(p.lag * a[f"n{i}"] + v[f"n{i}"] - u[f"motor{i}"] for i in range(1, 5)),
    ]


model = dr.Model(
    name="my-quad",
    coordinates={**dict.fromkeys("xyz", "m"), **dict.fromkeys(("qw", "qx", "qy", "qz"), "1")},
    velocities={**dict.fromkeys(("vx", "vy", "vz"), "m/s"), **dict.fromkeys(("wx", "wy", "wz"), "rad/s")},
    first_order={f"n{i}": "rad/s" for i in range(1, 5)},
    inputs={f"motor{i}": "rad/s" for i in range(1, 5)},
    parameters={name: dr.Parameter(positive=True) for name in ("mass", "Jx", "Jy", "Jz", "kT", "kQ", "drag", "lag")},
    kinematics=kinematics,
    equations=equations,
    sensors=dr.sensors.gyroscope(("wx", "wy", "wz")),
)
