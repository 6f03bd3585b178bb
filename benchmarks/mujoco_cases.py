"""Machines of the benchmark of `diransac.models.mujoco`: contacts, loops and tendons, by seed.

Nothing happens when this file is run; `mujoco_cases_run.py` identifies these cases, and `mujoco_simulation` says what a
case is.  Every seed has true values, a motion and faults of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from mujoco_files import ARM, BOX, FINGER, FOOT, FOUR_BAR, GRIPPER, HANGING, LEG, QUADRUPED
from mujoco_simulation import (
    ACCELEROMETER,
    AXES,
    DT,
    ENCODER,
    GYRO,
    POSE,
    POSITION,
    QUATERNION,
    SPEED,
    Array,
    Case,
    Control,
    Recording,
    case_of,
)

import diransac as dr

# ---------------------------------------------------------------------- quadruped

LEGS = {"FL": (1, 1), "FR": (1, -1), "RL": (-1, 1), "RR": (-1, -1)}
LINK, HEIGHT, BACK = 0.213, 0.29, -0.04
"""Length of thigh and calf, height of the hips over the feet, feet in front of the hips, m."""
GAITS = {"FL": 0.0, "FR": 0.5, "RL": 0.5, "RR": 0.0}
"""Phase of a trot, cycles."""


def leg_angles(x: Array, z: Array) -> tuple[Array, Array]:
    """Thigh and calf, rad, that place a foot at (x, z) from the hip, m."""
    bend = np.arccos(np.clip(np.hypot(x, z) / (2.0 * LINK), 0.0, 1.0))
    return np.arctan2(-x, -z) + bend, -2.0 * bend


def quadruped_xml() -> str:
    """Nominal file: dimensions and masses of a Unitree Go2, spheres as feet."""
    legs = [
        LEG.format(n=n, x=0.193 * s, y=0.047 * w, c=0.002 * w, w=0.096 * w, foot=FOOT.format(n=n))
        for n, (s, w) in LEGS.items()
    ]
    motors = [f'<motor name="{n}_{part}" joint="{n}_{part}"/>' for n in LEGS for part in ("hip", "thigh", "calf")]
    thigh, calf = leg_angles(np.array(BACK), np.array(-HEIGHT))
    return QUADRUPED.format(legs="".join(legs), motors="".join(motors), pose=f"0 {thigh} {calf} " * 4)


def hop_height(phase: float) -> float:
    """Height of the feet over their stance, m, by the phase of a hop, 0 to 1: crouch, push off, return."""
    return float(np.interp(phase, [0.0, 0.1, 0.3, 0.4, 0.5, 0.75, 1.0], [0.0, 0.01, 0.05, 0.05, -0.045, 0.0, 0.0]))


def gait_targets(rng: np.random.Generator, gait: str, seconds: float) -> Control:
    """Targets of twelve joints: swaying with feet that drag, a trot on the spot with sweeping feet, and hops.

    Each is blended in and out over 0.3 s; "all" gives each a third of the time.
    """
    names = ("stand", "trot", "hop") if gait == "all" else (gait,)
    sway, phases = rng.uniform(0.5, 2.5, (4, 4, 2)), rng.uniform(0.0, 2.0 * np.pi, (4, 4, 2))
    pace, rate, sweep = rng.uniform(1.8, 2.4), rng.uniform(1.3, 1.6), rng.uniform(0.3, 0.8)
    share = seconds / len(names)

    def targets(j: int, _: object) -> Array:
        t = max(j * DT, 0.0)
        k = min(int(t / share), len(names) - 1)
        blend = float(np.clip(min(t - k * share, (k + 1) * share - t) / 0.3, 0.0, 1.0))
        found = []
        for i, (leg, (_front, side)) in enumerate(LEGS.items()):
            waves = np.sin(2.0 * np.pi * sway[i] * t + phases[i]).sum(axis=-1)
            x, z, hip = 0.014 * waves[0], 0.012 * waves[1], 0.04 * waves[2]
            if names[k] == "trot":
                swing = np.sin(2.0 * np.pi * (pace * t + GAITS[leg]))
                x = 0.5 * x + 0.05 * np.sin(2.0 * np.pi * sweep * t) * np.cos(2.0 * np.pi * (pace * t + GAITS[leg]))
                z, hip = 0.2 * z + 0.07 * max(swing, 0.0), 0.5 * hip
            elif names[k] == "hop":
                x, z, hip = 0.3 * x, 0.1 * z + hop_height(rate * t % 1.0), 0.3 * hip + 0.06 * side
            thigh, calf = leg_angles(blend * x + BACK, blend * z - HEIGHT)
            found += [blend * hip + 0.02 * side, thigh, calf]
        return np.array(found, dtype=float)

    return targets


def quadruped(
    seed: int,
    *,
    outliers: float = 0.05,
    gaps: bool = True,
    payload: float | None = None,
    gait: str = "all",
    seconds: float = 10.0,
    pose: bool = False,
) -> Case:
    """Quadruped under position control with a payload, without a measured pose of its trunk unless ``pose``.

    Parameters
    ----------
    payload : float, optional   true mass, kg; None: drawn between 1 and 3 kg
    gait : str                  "stand", "trot", "hop" or "all"
    """
    parts = ("hip", "thigh", "calf")
    ranges = {
        "body/payload.mass": (1.0, 3.0) if payload is None else (payload, payload),
        "body/payload.ipos[0]": (-0.05, 0.05),
        "body/payload.ipos[1]": (-0.05, 0.05),
        "body/payload.ipos[2]": (0.0, 0.05),
        "geom/*_foot.friction[0]": (0.4, 0.7),
        **{f"joint/*_{part}.armature": (0.008, 0.015) for part in parts},
        **{f"joint/*_{part}.damping": (0.2, 0.6) for part in parts},
        **{f"joint/*_{part}.frictionloss": (0.15, 0.4) for part in parts},
        "sensor/imu_gyro.bias": (-0.03, 0.03),
        "sensor/imu_acc.bias": (-0.2, 0.2),
    }
    joints = [f"{leg}_{part}" for leg in LEGS for part in parts]
    noise = dict.fromkeys(joints, ENCODER) | {f"{x}_dot": SPEED for x in joints}
    noise |= {f"imu_gyro{x}": GYRO for x in AXES[3]} | {f"imu_acc{x}": ACCELEROMETER for x in AXES[3]}
    if pose:
        noise |= {f"base_{x}": POSITION if x in "xyz" else QUATERNION for x in POSE}
    part = 0.0 if seed % 2 == 0 else float(np.random.default_rng(seed).uniform(0.2, 0.8))
    return case_of(
        "quadruped", quadruped_xml(), ranges, noise, lambda rng: gait_targets(rng, gait, seconds),
        Recording(outliers, gaps), seed=seed, rows=round(seconds / DT), settling=500,
        actuation=dr.PositionControl(kp=60.0, kd=1.5), delay=DT * (2 + seed % 3 + part),
    )  # fmt: skip


# ---------------------------------------------------------------------- contacts with a pusher and with fingers


def pushed_box(seed: int, *, outliers: float = 0.05, gaps: bool = True, seconds: float = 10.0) -> Case:
    """Box on a floor, pushed in strokes by a plate on a slide with a known force; motion capture of the box."""
    ranges = {"geom/box.friction[0]": (0.25, 0.6), "body/box.mass": (0.6, 1.5), "joint/pusher.damping": (2.0, 5.0)}
    noise = _captured("box") | {"pusher": 1e-4, "pusher_dot": 5e-3}

    def control(rng: np.random.Generator) -> Control:
        period, stroke, stiffness = rng.uniform(0.8, 1.2), rng.uniform(0.05, 0.09), rng.uniform(600.0, 900.0)

        def force(j: int, data: Any) -> Array:
            phase, gap = j * DT / period % 1.0, data.qpos[0] - 0.09
            target = gap + (stroke * np.interp(phase, [0.0, 0.3, 0.5, 0.6, 1.0], [-0.5, 0.3, 0.4, -0.5, -0.5]))
            return np.clip([stiffness * (target - data.qpos[7]) - 60.0 * data.qvel[6]], -30.0, 30.0)

        return force

    return case_of(
        "pushed box", BOX, ranges, noise, control, Recording(outliers, gaps), seed=seed, rows=round(seconds / DT)
    )


def gripper(seed: int, *, outliers: float = 0.05, gaps: bool = True, seconds: float = 10.0) -> Case:
    """Two fingers that shake a part and let it slip for moments, by known forces; motion capture of the part."""
    ranges = {"geom/pad_*.friction[0]": (0.4, 0.7), "body/part.mass": (0.25, 0.4), "joint/lift.damping": (2.0, 6.0)}
    noise = _captured("part") | dict.fromkeys(("lift", "left", "right"), 1e-4)
    noise |= dict.fromkeys(("lift_dot", "left_dot", "right_dot"), 5e-3)

    def control(rng: np.random.Generator) -> Control:
        rates, phases, period = rng.uniform(1.0, 3.0, 3), rng.uniform(0.0, 6.0, 3), rng.uniform(0.4, 0.6)

        def force(j: int, data: Any) -> Array:
            t = j * DT
            target = 0.008 * np.sin(2.0 * np.pi * rates * t + phases).sum() * min(1.0, max(t, 0.0))
            held = data.qpos[5] - data.qpos[0] < 0.16  # the part is low between the pads
            squeeze = 9.0 if held or t < 0.0 or t % period > 0.03 else 1.2
            lift = 10.3 + 800.0 * (target - data.qpos[0]) - 30.0 * data.qvel[0]
            centring = 200.0 * (data.qpos[1] - data.qpos[2]) + 2.0 * (data.qvel[1] - data.qvel[2])
            return np.array([lift, squeeze - centring, squeeze + centring])

        return force

    return case_of(
        "gripper", GRIPPER, ranges, noise, control, Recording(outliers, gaps), seed=seed, rows=round(seconds / DT),
        settling=100,
    )  # fmt: skip


def _captured(joint: str) -> dict[str, float]:
    """Columns of motion capture of a free joint, with standard deviations."""
    return {f"{joint}_{x}": POSITION if x in "xyz" else QUATERNION for x in POSE}


# ---------------------------------------------------------------------- loop, tendon, arm, leg


def waves(rng: np.random.Generator, sizes: Sequence[float], offsets: Sequence[float], top: float = 2.0) -> Control:
    """Sums of four sinusoids about offsets, one for each input; rates to ``top`` Hz."""
    rates, phases = rng.uniform(0.2, top, (len(sizes), 4)), rng.uniform(0.0, 2.0 * np.pi, (len(sizes), 4))
    scale, middle = 0.5 * np.asarray(sizes), np.asarray(offsets)
    return lambda j, _: middle + scale * np.sin(2.0 * np.pi * rates * j * DT + phases).sum(axis=-1)


def four_bar(seed: int, *, outliers: float = 0.05, gaps: bool = True, seconds: float = 10.0) -> Case:
    """Crank-rocker, closed by a connect equality, in gravity; torque on the crank, encoders on three joints."""
    ranges = {
        "joint/crank.armature": (0.003, 0.006),
        "each:joint/*.damping": (0.01, 0.03),
        "body/coupler.mass": (0.4, 0.6),
    }
    joints = ("crank", "coupler", "rocker")
    noise = dict.fromkeys(joints, ENCODER) | {f"{x}_dot": SPEED for x in joints}
    return case_of(
        "four-bar", FOUR_BAR, ranges, noise,
        lambda rng: waves(rng, [0.4], [0.2]), Recording(outliers, gaps), seed=seed, rows=round(seconds / DT),
    )  # fmt: skip


def tendon_finger(seed: int, *, outliers: float = 0.05, gaps: bool = True, seconds: float = 10.0) -> Case:
    """Finger with two springy joints, bent by the tension of one tendon; encoders and the tendon's length."""
    ranges = {
        "each:joint/*.stiffness": (0.08, 0.15),
        "joint/*.damping": (0.003, 0.006),
        "tendon/flexor.frictionloss": (0.2, 0.6),
    }
    noise = {"mcp": ENCODER, "pip": ENCODER, "mcp_dot": SPEED, "pip_dot": SPEED, "cable": 1e-4}
    return case_of(
        "tendon finger", FINGER, ranges, noise, lambda rng: waves(rng, [4.0], [6.0]), Recording(outliers, gaps),
        seed=seed, rows=round(seconds / DT),
    )  # fmt: skip


def two_joint_arm(seed: int, *, outliers: float = 0.05, gaps: bool = True, seconds: float = 10.0) -> Case:
    """Planar arm in gravity with measured torques, which `diransac.models.robot` identifies as well."""
    ranges = {"each:joint/*.armature": (0.01, 0.03), "each:joint/*.damping": (0.1, 0.4)}
    joints = ("shoulder", "elbow")
    noise = dict.fromkeys(joints, ENCODER) | {f"{x}_dot": SPEED for x in joints}
    return case_of(
        "two-joint arm", ARM, ranges, noise, lambda rng: waves(rng, [3.0, 1.0], [0.0, 0.0]),
        Recording(outliers, gaps), seed=seed, rows=round(seconds / DT), actuation=dr.JointTorques(),
    )  # fmt: skip


def leg(seed: int, *, outliers: float = 0.05, gaps: bool = True, seconds: float = 10.0) -> Case:
    """Leg that hangs from a stand under position control, which `diransac.models.robot` identifies as well."""
    ranges = {"each:joint/*.armature": (0.008, 0.015), "each:joint/*.damping": (0.2, 0.6)}
    joints = ("FL_hip", "FL_thigh", "FL_calf")
    noise = dict.fromkeys(joints, ENCODER) | {f"{x}_dot": SPEED for x in joints}
    xml = HANGING.format(leg=LEG.format(n="FL", x=0, y=0, c=0.002, w=0.096, foot=""))
    return case_of(
        "leg", xml, ranges, noise, lambda rng: waves(rng, [0.4, 0.6, 0.6], [0.0, 0.9, -1.8]), Recording(outliers, gaps),
        seed=seed, rows=round(seconds / DT), actuation=dr.PositionControl(kp=20.0, kd=0.5), settling=500,
    )  # fmt: skip


CASES: Mapping[str, Callable[..., Case]] = {
    "quadruped": quadruped, "pushed box": pushed_box, "gripper": gripper, "four-bar": four_bar,
    "tendon finger": tendon_finger, "two-joint arm": two_joint_arm, "leg": leg,
}  # fmt: skip
