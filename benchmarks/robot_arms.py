"""Intervals of arms with six and seven joints: coverage, error, time and memory over simulated logs.

``python benchmarks/robot_arms.py six|seven [N] [--from SEED]``

- ``six``: an arm in URDF; all base parameters, damping and friction, from positions and measured torques, which have
  white noise of 1 % of their spread and 5 % outliers of up to three times their spread.
- ``seven``: an arm in MJCF; armature, damping and friction, from positions and targets that act 5 ms late.

Accelerations are MuJoCo's, the integration is classical Runge-Kutta, and the machine differs from its description by up
to a quarter in every joint parameter, and in every inertial parameter that is unknown.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

import diransac as dr

DT, STEP, DURATION, DELAY = 0.005, 1e-3, 10.0, 0.005
NOISE, TORQUE_NOISE, OUTLIERS, OUTLIER_SIZE = 1e-4, 0.01, 0.05, 3.0
REACH, FREQUENCIES = 1.5, 2.0 * np.pi * np.array([0.1, 0.2, 0.3, 0.4, 0.5])
KP, KD = (600.0, 600.0, 400.0, 400.0, 150.0, 100.0, 50.0), (40.0, 40.0, 25.0, 25.0, 8.0, 5.0, 2.5)


@dataclass(frozen=True)
class Link:
    """A link behind a hinge about its z axis, or behind a slide along it.

    Parameters
    ----------
    offset, turn : three floats
        Origin, m, and roll, pitch and yaw in the frame of the link before it, rad.
    mass : float
        kg.
    centre, moments : three floats
        Centre of mass, m; principal moments of inertia about it, kg m^2.
    armature, damping, friction : float
        Of the joint, SI.
    kind : str, optional
        "hinge" or "slide".
    """

    offset: tuple[float, float, float]
    turn: tuple[float, float, float]
    mass: float
    centre: tuple[float, float, float]
    moments: tuple[float, float, float]
    armature: float
    damping: float
    friction: float
    kind: str = "hinge"


R = np.pi / 2.0
SIX = (
    Link((0.0, 0.0, 0.36), (0.0, 0.0, 0.0), 7.0, (0.02, -0.03, -0.04), (0.045, 0.040, 0.030), 0.0, 3.0, 4.0),
    Link((0.07, 0.0, 0.0), (-R, 0.0, 0.0), 9.5, (0.19, 0.01, 0.05), (0.030, 0.160, 0.150), 0.0, 3.5, 5.0),
    Link((0.43, 0.0, 0.0), (0.0, 0.0, 0.0), 4.5, (0.03, 0.04, -0.02), (0.020, 0.018, 0.014), 0.0, 2.0, 3.0),
    Link((0.05, 0.38, 0.0), (R, 0.0, 0.0), 2.5, (0.01, -0.01, -0.10), (0.030, 0.028, 0.012), 0.0, 0.5, 0.6),
    Link((0.0, 0.0, 0.0), (-R, 0.0, 0.0), 1.8, (0.0, 0.02, 0.01), (0.014, 0.012, 0.010), 0.0, 0.4, 0.4),
    Link((0.0, 0.08, 0.0), (R, 0.0, 0.0), 1.5, (0.02, 0.01, 0.06), (0.011, 0.010, 0.009), 0.0, 0.3, 0.3),
)
SEVEN = (
    Link((0.0, 0.0, 0.333), (0.0, 0.0, 0.0), 4.9, (0.0, -0.03, -0.07), (0.040, 0.036, 0.018), 0.20, 1.2, 1.5),
    Link((0.0, 0.0, 0.0), (-R, 0.0, 0.0), 3.1, (0.0, -0.07, 0.03), (0.022, 0.012, 0.020), 0.20, 1.5, 1.8),
    Link((0.0, -0.316, 0.0), (R, 0.0, 0.0), 3.2, (0.03, 0.03, -0.05), (0.018, 0.017, 0.010), 0.15, 0.9, 1.2),
    Link((0.0825, 0.0, 0.0), (R, 0.0, 0.0), 3.5, (-0.04, 0.06, 0.03), (0.022, 0.013, 0.020), 0.15, 1.0, 1.3),
    Link((-0.0825, 0.384, 0.0), (-R, 0.0, 0.0), 2.1, (0.0, 0.03, -0.12), (0.026, 0.025, 0.005), 0.08, 0.5, 0.7),
    Link((0.0, 0.0, 0.0), (R, 0.0, 0.0), 1.6, (0.05, 0.0, -0.01), (0.003, 0.006, 0.005), 0.08, 0.4, 0.6),
    Link((0.088, 0.0, 0.0), (R, 0.0, 0.0), 1.2, (0.01, 0.01, 0.08), (0.004, 0.004, 0.002), 0.06, 0.3, 0.4),
)


def machine_like(links: tuple[Link, ...], seed: int) -> tuple[Link, ...]:
    """Links whose inertial and joint parameters differ by up to a quarter, and whose bodies are possible."""
    rng = np.random.default_rng((seed, 1))

    def changed(x: tuple[float, float, float]) -> tuple[float, float, float]:
        a, b, c = (np.array(x) * rng.uniform(0.85, 1.15, 3)).tolist()
        return a, b, c

    found = []
    for x in links:
        mass, armature, damping, friction = np.array([x.mass, x.armature, x.damping, x.friction]) * rng.uniform(
            0.75, 1.25, 4
        )
        moments = changed(x.moments)
        thick = max(0.0, 1.02 * (2.0 * max(moments) - sum(moments)))  # the triangle inequality
        a, b, c = (m + thick for m in moments)
        found.append(
            Link(
                x.offset,
                x.turn,
                float(mass),
                changed(x.centre),
                (a, b, c),
                float(armature),
                float(damping),
                float(friction),
                x.kind,
            )
        )
    return tuple(found)


def _joint_of(link: Link) -> dict[str, float]:
    """Parameters of a link's hinge."""
    return {"armature": link.armature, "damping": link.damping, "friction": link.friction}


def mjcf(links: tuple[Link, ...]) -> str:
    """Description of an arm in MJCF."""
    parts = ['<mujoco model="arm"><compiler angle="radian" eulerseq="XYZ"/><worldbody>']
    for k, x in enumerate(links, 1):
        parts.append(f'<body name="link{k}" pos="{text(x.offset)}" euler="{text(x.turn)}">')
        parts.append(f'<inertial pos="{text(x.centre)}" mass="{x.mass!r}" diaginertia="{text(x.moments)}"/>')
        of_joint = f'armature="{x.armature!r}" damping="{x.damping!r}" frictionloss="{x.friction!r}"'
        parts.append(f'<joint name="joint{k}" type="{x.kind}" axis="0 0 1" {of_joint}/>')
    return "".join([*parts, "</body>" * len(links), "</worldbody></mujoco>"])


def urdf(links: tuple[Link, ...]) -> str:
    """Description of an arm in URDF."""
    parts = ['<robot name="arm"><link name="link0"/>']
    for k, x in enumerate(links, 1):
        a, b, c = x.moments
        parts.append(
            f'<link name="link{k}"><inertial><origin xyz="{text(x.centre)}"/><mass value="{x.mass!r}"/>'
            f'<inertia ixx="{a!r}" iyy="{b!r}" izz="{c!r}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="joint{k}" type="continuous"><parent link="link{k - 1}"/><child link="link{k}"/>'
            f'<origin xyz="{text(x.offset)}" rpy="{text(x.turn)}"/><axis xyz="0 0 1"/>'
            f'<dynamics damping="{x.damping!r}" friction="{x.friction!r}"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def text(values: tuple[float, float, float]) -> str:
    """Numbers with all their digits."""
    return " ".join(repr(float(x)) for x in values)


@dataclass(frozen=True)
class Motion:
    """Simulated motion: positions and torques of the drives, (N, n), and the targets."""

    time: np.ndarray
    positions: np.ndarray
    torques: np.ndarray
    targets: np.ndarray


def simulated(path: Path, seed: int, *, controlled: bool) -> Motion:
    """Motion of a described machine along random harmonics, by computed torques, or by late position control."""
    machine, rng = mujoco.MjModel.from_xml_path(str(path)), np.random.default_rng(seed)
    friction, n = machine.dof_frictionloss.copy(), machine.nv
    machine.dof_frictionloss[:] = 0.0
    machine.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, t = mujoco.MjData(machine), np.arange(0.0, DURATION, DT)
    a, b = rng.uniform(-1.0, 1.0, (2, n, len(FREQUENCIES)))
    size = REACH / (np.abs(a) + np.abs(b)).sum(axis=1)
    a, b, w = a * size[:, None], b * size[:, None], FREQUENCIES

    def reference(time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and acceleration."""
        s, c = np.sin(w * time), np.cos(w * time)
        return a @ s + b @ (c - 1.0), a @ (w * c) - b @ (w * s), -a @ (w**2 * s) - b @ (w**2 * c)

    def torque(x: np.ndarray, time: float) -> np.ndarray:
        """Of the drives: of position control with the late target, or computed with feedback."""
        if controlled:
            return np.array(KP[:n]) * (reference(max(0.0, held(time) - DELAY))[0] - x[0]) - np.array(KD[:n]) * x[1]
        q, v, acceleration = reference(time)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = x[0], x[1], 0.0
        data.qacc[:] = acceleration + 100.0 * (q - x[0]) + 20.0 * (v - x[1])
        mujoco.mj_inverse(machine, data)
        return data.qfrc_inverse + friction * np.tanh(v / 0.05)

    def held(time: float) -> float:
        """Time of the last sample."""
        return DT * np.floor(time / DT + 1e-6)

    def rates(x: np.ndarray, time: float, drive: np.ndarray | None) -> np.ndarray:
        """Derivative of position and velocity by MuJoCo."""
        force = torque(x, time) if drive is None else drive
        data.qpos[:], data.qvel[:] = x
        data.qfrc_applied[:] = force - friction * np.tanh(x[1] / 0.05)
        mujoco.mj_forward(machine, data)
        return np.array([data.qvel, data.qacc])

    x, shape = np.array(reference(0.0)[:2]), (len(t), n)
    positions, torques = np.zeros(shape), np.zeros(shape)
    for k, time_k in enumerate(t):
        positions[k], torques[k] = x[0], torque(x, time_k)
        drive = None if controlled else torques[k]
        for i in range(round(DT / STEP)):
            now = time_k + i * STEP
            one = rates(x, now, drive)
            two = rates(x + 0.5 * STEP * one, now, drive)
            three = rates(x + 0.5 * STEP * two, now, drive)
            x = x + STEP / 6.0 * (one + 2.0 * two + 2.0 * three + rates(x + STEP * three, now, drive))
    return Motion(t, positions, torques, np.array([reference(time_k)[0] for time_k in t]))


def log_of(motion: Motion, seed: int, *, controlled: bool) -> dr.Log:
    """Log of the encoders, and of targets or torques."""
    rng, names = np.random.default_rng((seed, 2)), [f"joint{k + 1}" for k in range(motion.positions.shape[1])]
    positions = motion.positions + NOISE * rng.standard_normal(motion.positions.shape)
    inputs, kind = motion.targets, "target"
    if not controlled:
        spread, shape, kind = motion.torques.std(axis=0), motion.torques.shape, "torque"
        inputs = motion.torques + TORQUE_NOISE * spread * rng.standard_normal(shape)
        hit = rng.random(shape) < OUTLIERS
        inputs[hit] += (OUTLIER_SIZE * spread * rng.uniform(-1.0, 1.0, shape))[hit]
    columns = dict(zip(names, positions.T, strict=True))
    return dr.Log.from_arrays(motion.time, columns | {f"{n}_{kind}": u for n, u in zip(names, inputs.T, strict=True)})


def model_of(path: Path, *, controlled: bool) -> dr.Model:
    """Model of the described arm."""
    if not controlled:
        return dr.models.robot(path, unknown=("damping", "friction"), bodies="all")
    names = [f"joint{k + 1}" for k in range(len(KP))]
    kp, kd = dict(zip(names, KP, strict=True)), dict(zip(names, KD, strict=True))
    return dr.models.robot(path, actuation=dr.PositionControl(kp=kp, kd=kd))


def main() -> None:
    """Print a line per log, and the coverage of 95 % intervals over all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arm", choices=("six", "seven"))
    parser.add_argument("n", type=int, nargs="?", default=20)
    parser.add_argument("--from", type=int, default=0, dest="first")
    given = parser.parse_args()
    controlled = given.arm == "seven"
    links, describe, suffix = (SEVEN, mjcf, "xml") if controlled else (SIX, urdf, "urdf")
    inside = list[bool]()
    with tempfile.TemporaryDirectory() as folder:
        path, true_path = (Path(folder) / f"{name}.{suffix}" for name in ("arm", "machine"))
        for seed in range(given.first, given.first + given.n):
            machine = machine_like(links, seed)
            if controlled:  # joints alone are unknown: inertials are those of the description
                machine = tuple(replace(x, **_joint_of(y)) for x, y in zip(links, machine, strict=True))
            path.write_text(describe(links))
            true_path.write_text(describe(machine))
            model = model_of(path, controlled=controlled)
            truth = {n: float(p.value or 0.0) for n, p in model_of(true_path, controlled=controlled).parameters.items()}
            log = log_of(simulated(true_path, seed, controlled=controlled), seed, controlled=controlled)
            begin, processor = time.perf_counter(), time.process_time()
            result = dr.identify(model, log, differentiate=True)
            seconds, processor = time.perf_counter() - begin, time.process_time() - processor
            intervals = result.intervals()
            own = [intervals[n][0] <= x <= intervals[n][1] for n, x in truth.items()]
            wide = np.array([(intervals[n][1] - intervals[n][0]) / 2.0 for n in truth])
            errors = [abs(result.parameters[n] / x - 1.0) for n, x in truth.items() if x]
            inside += own
            middle = 100.0 * float(np.median(errors))
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
            missed = ", ".join(n for n, x in zip(truth, own, strict=True) if not x) or "none"
            print(
                f"{seed}: {seconds:.0f} s, processor {processor:.0f} s, {memory:.2f} GiB; {sum(own)} of {len(own)} in "
                f"their intervals, {np.isinf(wide).sum()} of these infinite; median error {middle:.2f} %; "
                f"{result.verdict}; outside: {missed}",
                flush=True,
            )
    print(f"{len(inside)} intervals of 95 % hold {100.0 * np.mean(inside):.1f} % of the true values")


if __name__ == "__main__":
    main()
