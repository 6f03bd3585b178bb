"""A leg that moves by MuJoCo's dynamics under position control, identified from positions and targets alone."""

import pytest

import diransac as dr

mujoco = pytest.importorskip("mujoco", reason="IDENTIFICATION OF ROBOTS NOT CHECKED: mujoco is missing")

from robot_intervals import BIAS, DELAY, JOINTS, LEG, TRUTH, model_of, recorded  # noqa: E402  # needs mujoco


@pytest.mark.slow
def test_joints_and_encoders_are_found_from_positions_and_late_targets(tmp_path):
    path = tmp_path / "leg.xml"
    path.write_text(LEG)
    result = dr.identify(model_of(path, "encoder_bias"), recorded(path, duration=3.0), differentiate=True)
    for k, joint in enumerate(JOINTS):
        for kind, values in TRUTH.items():
            name, error = f"{kind}_{joint}", abs(result.parameters[f"{kind}_{joint}"] - values[k])
            assert error < 0.05 * values[k], name
            assert error < 4.0 * result.standard_errors[name], name
        assert result.parameters[f"encoder_bias_{joint}"] == pytest.approx(BIAS[k], abs=0.005)
    assert result.diagnosis.input_delay == pytest.approx(DELAY, abs=5e-4)
