"""Settings: what has no meaning is refused by name, and everything survives JSON."""

import dataclasses
import json

import numpy as np
import pytest

from diransac.errors import SettingsError
from diransac.identification.settings import Settings


def test_table_iv_holds_the_papers_values():
    s = Settings.table_iv()
    assert (s.sample_size, s.max_iterations, s.stop_inlier_fraction) == (75, 1000, 0.85)
    assert (s.min_inlier_signals, s.acceptance_weights) == (3, (1.0, 0.06))
    assert s.inlier_thresholds == dict.fromkeys(("x_dot", "z_dot", "theta_dot", "x_ddot", "z_ddot", "theta_ddot"), 0.5)
    assert [s.error_weights.get(n, 0.0) for n in ("x", "z", "theta")] == [0.0, 0.0, 0.0]
    assert [s.error_weights[n] for n in ("x_dot", "z_dot", "theta_dot")] == [1.0, 1.0, 1.0]
    assert [s.error_weights[n] for n in ("x_ddot", "z_ddot", "theta_ddot")] == [0.1, 0.1, 0.1]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sample_size", 0),
        ("sample_size", 7.5),
        ("sample_size", True),
        ("max_iterations", -1),
        ("substeps", 0),
        ("batch_size", None),
        ("threads", 0),
        ("min_inlier_signals", 0),
        ("stop_inlier_fraction", 1.5),
        ("stop_inlier_fraction", float("nan")),
        ("stop_inlier_fraction", 0.0),
        ("stop_inlier_fraction", "half"),
        ("inlier_thresholds", {"x": -1.0}),
        ("inlier_thresholds", {"x": float("inf")}),
        ("inlier_thresholds", {"x": "wide"}),
        ("inlier_thresholds", 0.5),
        ("error_weights", {"x": float("nan")}),
        ("error_weights", ["x"]),
        ("acceptance_weights", (0.0, 0.0)),
        ("acceptance_weights", (-1.0, 1.0)),
        ("acceptance_weights", (1.0,)),
        ("acceptance_weights", (1.0, float("inf"))),
        ("acceptance_weights", 3.0),
        ("refit", "always"),
        ("integrator", "rk45"),
        ("initial_state", "last"),
        ("initial_state", {"x": float("nan")}),
        ("initial_state", 3.0),
    ],
)
def test_value_without_meaning_is_refused_by_the_settings_name(name, value):
    with pytest.raises(SettingsError, match=name):
        Settings(**{name: value})


def test_unknown_setting_is_refused_with_those_there_are():
    with pytest.raises(SettingsError, match=r'"sampel_size".*sample_size'):
        Settings.from_dict({"sampel_size": 3})


@pytest.mark.parametrize(
    "settings",
    [
        Settings(),
        Settings.table_iv(),
        Settings(stop_inlier_fraction=None, threads=3, initial_state={"x": 1.0}, acceptance_weights=(1.0, 0.0)),
        Settings(
            sample_size=np.int64(9),
            min_inlier_signals=np.int32(2),
            stop_inlier_fraction=np.float32(0.5),
            error_weights={"x": np.float64(2.0)},
            acceptance_weights=np.array([1.0, 2.0]),
        ),
    ],
    ids=["default", "table iv", "other", "numpy's numbers"],
)
def test_settings_survive_json(settings):
    assert Settings.from_dict(json.loads(json.dumps(settings.to_dict()))) == settings


def test_settings_do_not_follow_the_mapping_that_they_were_made_of():
    weights = {"x": 1.0}
    settings = Settings(error_weights=weights)
    weights["x"] = 5.0
    assert settings.error_weights == {"x": 1.0}


def test_replace_checks_anew():
    with pytest.raises(SettingsError, match="sample_size"):
        dataclasses.replace(Settings(), sample_size=0)
