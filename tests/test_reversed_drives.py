"""Reversed columns of torques, of robots with a description, named before anything is searched."""

import re
import time

import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.identification.assessment.inspection import inspect
from diransac.identification.structure.columns import reversed_signs
from robots import urdf


def scaled(text, rng, error):
    """A description whose masses and inertias differ."""

    def other(found):
        mass, inertia = np.exp(error * rng.normal(size=2))
        link = re.sub(r'mass value="([^"]+)"', lambda m: f'mass value="{float(m[1]) * mass}"', found[0])
        return re.sub(r'(i[xyz]{2})="([^"]+)"', lambda m: f'{m[1]}="{float(m[2]) * inertia}"', link)

    return re.sub(r"<inertial>.*?</inertial>", other, text)


def recorded(folder, seed, n, error=0.1, duration=10.0):
    """An arm's description, and the time, positions and torques of one with other inertials, friction and rotors."""
    rng = np.random.default_rng(seed)
    text = urdf(seed, parents=tuple(range(n)))
    arm, true = folder / "arm.urdf", folder / "true.urdf"
    arm.write_text(text)
    true.write_text(scaled(text, rng, error))
    machine = dr.models.robot(true)
    t = np.arange(0.0, duration, 0.01)
    q, v, a = (np.zeros((n, len(t))) for _ in range(3))
    for j in range(n):
        q[j] = rng.uniform(-1.0, 1.0)
        for k in range(1, 5):
            w, size, phase = 2.0 * np.pi * rng.uniform(0.8, 1.2) * k / 5.0, rng.uniform(0.1, 0.5) / k, rng.uniform(0, 6)
            q[j] += size * np.sin(w * t + phase)
            v[j] += size * w * np.cos(w * t + phase)
            a[j] -= size * w**2 * np.sin(w * t + phase)
    largest = {"armature": 0.3, "damping": 2.0, "friction": 2.0}
    p = np.array([rng.uniform(0.1, 1.0) * largest[name.split("_")[0]] for name in machine.parameters])
    torque = np.array(machine.residual(q, v, a, np.zeros((n, len(t))), np.repeat(p[:, None], len(t), 1)))
    torque += 0.02 * torque.std(axis=1, keepdims=True) * rng.normal(size=torque.shape)
    columns = dict(zip(machine.coordinates, q + 2e-4 * rng.normal(size=q.shape), strict=True))
    return arm, t, columns | dict(zip(machine.inputs, torque, strict=True))


def with_reversed(t, columns, joints):
    signs = {f"joint_{k}_torque": -1.0 for k in joints}
    return dr.Log.from_arrays(t, {n: x * signs.get(n, 1.0) for n, x in columns.items()})


@pytest.mark.parametrize(
    ("seed", "n", "joints", "arguments"),
    [
        (70, 2, (), {}),
        (71, 2, (1,), {}),
        (72, 2, (1, 2), {"bodies": "all"}),
        (73, 4, (), {"bodies": "all"}),
        (74, 4, (3,), {}),
        (75, 4, (1, 4), {"unknown": ("armature", "damping", "friction", "torque_gain")}),
        pytest.param(76, 6, (), {}, marks=pytest.mark.slow),
        pytest.param(77, 6, (2, 5), {}, marks=pytest.mark.slow),
    ],
)
def test_the_reversed_torques_are_named_and_no_others(tmp_path, seed, n, joints, arguments):
    arm, t, columns = recorded(tmp_path, seed, n)
    found = reversed_signs(dr.models.robot(arm, **arguments), [with_reversed(t, columns, joints)])
    named = [x.action.rpartition("--scale ")[2] for x in found]
    assert named == ([",".join(f"joint_{k}_torque=-1" for k in joints)] if joints else [])


def test_an_encoder_that_is_reversed_is_no_reversed_torque_alone(tmp_path):
    arm, t, columns = recorded(tmp_path, 78, 2)
    log = dr.Log.from_arrays(t, columns | {"joint_2": -columns["joint_2"]})
    assert all(" or joint_2 " in x.what for x in reversed_signs(dr.models.robot(arm), [log]))


def test_the_default_method_names_them_at_once(tmp_path):
    arm, t, columns = recorded(tmp_path, 79, 2)
    model, log = dr.models.robot(arm), with_reversed(t, columns, (2,))
    begin = time.monotonic()
    with pytest.raises(dr.IdentificationError, match=r"sign of joint_2_torque.*reversed.*--scale joint_2_torque=-1$"):
        dr.identify(model, log)
    assert time.monotonic() - begin < 20.0
    assert dr.identify(model, dr.scale(log, {"joint_2_torque": -1.0}), method="ols", differentiate=True)


def test_inspect_names_them_beside_impossible_values(tmp_path):
    arm, t, columns = recorded(tmp_path, 80, 2)
    log = with_reversed(t, columns, (1,))
    log.write(tmp_path / "log.csv")
    shown = run("inspect", tmp_path / "log.csv", "--model", arm).stdout
    assert "identify again with --scale joint_1_torque=-1" in shown
    assert "outside the bounds as recorded" in shown
    again = run("inspect", tmp_path / "log.csv", "--model", arm, "--scale", "joint_1_torque=-1").stdout
    assert "reversed" not in again
    assert inspect(log, dr.models.robot(arm)).fitness.caveat in shown


def test_a_target_is_no_force(tmp_path):
    arm, t, columns = recorded(tmp_path, 81, 2)
    targets = {n.replace("torque", "target"): -x for n, x in columns.items()}
    log = dr.Log.from_arrays(t, columns | targets)
    assert reversed_signs(dr.models.robot(arm, actuation=dr.PositionControl(kp=20.0)), [log]) == []
