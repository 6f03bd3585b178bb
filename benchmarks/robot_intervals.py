"""Intervals of a leg's joints, from positions and late targets: coverage, error and time over simulated logs.

``python benchmarks/robot_intervals.py [N]``: accelerations are MuJoCo's, the integration is classical Runge-Kutta.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

import diransac as dr

KP, KD, DELAY, DT, STEP = 20.0, 0.8, 0.005, 0.005, 1e-3
JOINTS = ("hip", "thigh", "calf")
TRUTH = {"armature": (0.03, 0.02, 0.015), "damping": (0.3, 0.2, 0.15), "friction": (0.4, 0.3, 0.2)}
BIAS = (0.03, -0.02, 0.04)
LEG = """
<mujoco model="leg">
  <compiler angle="radian"/>
  <default><joint armature="0.01" damping="0.1" frictionloss="0.1"/></default>
  <worldbody>
    <body name="hip"><joint name="hip_joint" axis="1 0 0"/>
      <inertial pos="-0.01 0.02 0" mass="0.6" diaginertia="0.0009 0.0006 0.0005"/>
      <body name="thigh" pos="0 0.09 0"><joint name="thigh_joint" axis="0 1 0"/>
        <inertial pos="0 -0.02 -0.04" mass="1.1" diaginertia="0.006 0.006 0.0009"/>
        <body name="calf" pos="0 0 -0.21"><joint name="calf_joint" axis="0 1 0"/>
          <inertial pos="0.01 0 -0.12" mass="0.25" diaginertia="0.0015 0.0015 0.0001"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def model_of(path: Path, *further: str) -> dr.Model:
    """Model of the leg, with further unknown parameters."""
    control = dr.PositionControl(kp=KP, kd=KD, target="des_{}")
    return dr.models.robot(path, joints="{}_joint", unknown=(*TRUTH, *further), actuation=control)


def recorded(path: Path, seed: int = 0, bias: Sequence[float] = BIAS, duration: float = 12.0) -> dr.Log:
    """Log of a leg with other joints than its file has, whose targets act late and whose encoders have a bias."""
    machine, rng = mujoco.MjModel.from_xml_path(str(path)), np.random.default_rng(seed)
    machine.dof_armature[:], machine.dof_damping[:], machine.dof_frictionloss[:] = *list(TRUTH.values())[:2], 0.0
    data, t = mujoco.MjData(machine), np.arange(0.0, duration, DT)
    slow, fast = (2.1, 3.3, 2.7), (11.0, 14.0, 9.0)
    targets = 0.5 * np.sin(np.outer(t + 0.05 * t**2, slow)) + 0.2 * np.sin(np.outer(t + 0.02 * t**2, fast))
    late = np.vstack([targets[:1].repeat(round(DELAY / DT), axis=0), targets])

    zero = np.array(bias)

    def rates(x: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Derivative of position and velocity by MuJoCo, with friction and control as applied forces."""
        data.qpos[:], data.qvel[:] = x
        friction = TRUTH["friction"] * np.tanh(x[1] / 0.05)
        data.qfrc_applied[:] = KP * (target - x[0] - zero) - KD * x[1] - friction
        mujoco.mj_forward(machine, data)
        return np.array([data.qvel, data.qacc])

    x, positions = np.zeros((2, 3)), np.zeros_like(targets)
    for k in range(len(t)):
        positions[k] = x[0] + zero
        for _ in range(round(DT / STEP)):
            one = rates(x, late[k])
            two = rates(x + 0.5 * STEP * one, late[k])
            three = rates(x + 0.5 * STEP * two, late[k])
            x = x + STEP / 6.0 * (one + 2.0 * two + 2.0 * three + rates(x + STEP * three, late[k]))
    positions += 2e-4 * rng.standard_normal(positions.shape)
    positions[rng.random(positions.shape) < 0.02] += 0.3
    columns = dict(zip(JOINTS, positions.T, strict=True))
    return dr.Log.from_arrays(t, columns | {f"des_{n}": x for n, x in zip(JOINTS, targets.T, strict=True)})


def main() -> None:
    """Print a line per log, and the coverage of 95 % intervals over all."""
    n = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    inside = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "leg.xml"
        path.write_text(LEG)
        model = model_of(path)
        truth = {f"{kind}_{joint}": x for kind, own in TRUTH.items() for joint, x in zip(JOINTS, own, strict=True)}
        for seed in range(n):
            log, begin = recorded(path, seed, (0.0, 0.0, 0.0)), time.perf_counter()
            result = dr.identify(model, log, differentiate=True)
            seconds, intervals = time.perf_counter() - begin, result.intervals()
            inside += [intervals[name][0] <= x <= intervals[name][1] for name, x in truth.items()]
            worst = max(abs(result.parameters[name] / x - 1.0) for name, x in truth.items())
            print(f"{seed}: {seconds:.1f} s, largest error {100.0 * worst:.2f} %, {result.verdict}", flush=True)
    print(f"{len(inside)} intervals of 95 % hold {100.0 * np.mean(inside):.1f} % of the true values")


if __name__ == "__main__":
    main()
