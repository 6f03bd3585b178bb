"""Robots that move by MuJoCo's dynamics under position control, identified from positions and targets alone."""

import numpy as np
import pytest

import diransac as dr
import robots

mujoco = pytest.importorskip("mujoco", reason="IDENTIFICATION OF ROBOTS NOT CHECKED: mujoco is missing")

KP, KD, DELAY, DT = 20.0, 0.8, 0.005, 0.005
TRUTH = {"armature": (0.03, 0.02, 0.015), "damping": (0.3, 0.2, 0.15), "friction": (0.4, 0.3, 0.2)}
BIAS = (0.03, -0.02, 0.04)


def recorded(path, seed=0, duration=12.0, step=1e-3):
    """Log of a leg with other joints than its file has, whose targets act late and whose encoders have a bias."""
    machine, rng = mujoco.MjModel.from_xml_path(str(path)), np.random.default_rng(seed)
    machine.dof_armature[:], machine.dof_damping[:], machine.dof_frictionloss[:] = *list(TRUTH.values())[:2], 0.0
    data, t = mujoco.MjData(machine), np.arange(0.0, duration, DT)
    slow, fast = (2.1, 3.3, 2.7), (11.0, 14.0, 9.0)
    targets = 0.5 * np.sin(np.outer(t + 0.05 * t**2, slow)) + 0.2 * np.sin(np.outer(t + 0.02 * t**2, fast))
    late = np.vstack([targets[:1].repeat(round(DELAY / DT), axis=0), targets])

    def rates(x, target):
        """Derivative of position and velocity by MuJoCo, with friction and control as applied forces."""
        data.qpos[:], data.qvel[:] = x
        friction = TRUTH["friction"] * np.tanh(x[1] / 0.05)
        data.qfrc_applied[:] = KP * (target - x[0] - BIAS) - KD * x[1] - friction
        mujoco.mj_forward(machine, data)
        return np.array([data.qvel, data.qacc])

    x, positions = np.zeros((2, 3)), np.zeros_like(targets)
    for k in range(len(t)):
        positions[k] = x[0] + BIAS
        for _ in range(round(DT / step)):
            one = rates(x, late[k])
            two = rates(x + 0.5 * step * one, late[k])
            three = rates(x + 0.5 * step * two, late[k])
            x = x + step / 6.0 * (one + 2.0 * two + 2.0 * three + rates(x + step * three, late[k]))
    positions += 2e-4 * rng.standard_normal(positions.shape)
    positions[rng.random(positions.shape) < 0.02] += 0.3
    names = ("hip", "thigh", "calf")
    columns = dict(zip(names, positions.T, strict=True))
    return dr.Log.from_arrays(t, columns | {f"des_{n}": x for n, x in zip(names, targets.T, strict=True)})


@pytest.mark.slow
def test_joints_and_encoders_are_found_from_positions_and_late_targets(tmp_path):
    path = tmp_path / "leg.xml"
    path.write_text(robots.leg())
    model = dr.models.robot(
        path,
        joints="{}_joint",
        unknown=("armature", "damping", "friction", "encoder_bias"),
        actuation=dr.PositionControl(kp=KP, kd=KD, target="des_{}"),
    )
    result = dr.identify(model, recorded(path), differentiate=True)
    for k, joint in enumerate(("hip", "thigh", "calf")):
        for kind, values in TRUTH.items():
            name, error = f"{kind}_{joint}", abs(result.parameters[f"{kind}_{joint}"] - values[k])
            assert error < 0.05 * values[k], name
            assert error < 4.0 * result.standard_errors[name], name
        assert result.parameters[f"encoder_bias_{joint}"] == pytest.approx(BIAS[k], abs=0.005)
    assert result.diagnosis.input_delay == pytest.approx(DELAY, abs=5e-4)
