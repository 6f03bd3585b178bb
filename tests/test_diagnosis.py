"""`Diagnosis`: what lo-diransac says of a log and of what its model lacks is true, is kept, and cannot be changed."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import diransac as dr

DT, N = 0.01, 1500
MASS, DRAG, EXTRA = 1.5, 2.0, 0.3
NOISE = np.array([1e-3, 5e-3, 0.02])


def sledge():
    """A mass with viscous drag; nothing of it knows the force that goes with the input's size."""
    return dr.Model(
        "sledge",
        {"s": "m"},
        {"force": "N"},
        {"mass": dr.Parameter("kg", positive=True), "drag": dr.Parameter("N s/m", lower=0.0)},
        lambda q, v, a, u, p: [p.mass * a.s + p.drag * v.s - u.force],
    )


def slide(extra=EXTRA, lag=0):
    """State (N, 2), acceleration and recorded input (N,) of the sledge, exact where the input is held."""
    t = DT * np.arange(N + lag)
    held = 3.0 * np.sin(1.1 * t) + 2.0 * np.sin(3.7 * t + 0.5) + np.sin(7.9 * t)
    acting = np.r_[np.zeros(lag), held][: N + lag]
    total = acting + extra * np.abs(acting)
    state, decay = np.zeros((N + lag + 1, 2)), np.exp(-DRAG / MASS * DT)
    for k, force in enumerate(total):
        final = force / DRAG
        gap = state[k, 1] - final
        state[k + 1] = state[k, 0] + final * DT + gap * (1.0 - decay) * MASS / DRAG, final + gap * decay
    state = state[:-1]
    return state[lag:], ((total - DRAG * state[:, 1]) / MASS)[lag:], held[lag:]


def log_of(state, acceleration, force, hit=0.0, names=("s", "s_dot", "s_ddot")):
    """The log, with noise and outliers of up to 30 in a share of all samples, and which samples those are."""
    rng = np.random.default_rng(5)
    signals, planted = np.column_stack([state, acceleration]), rng.random((N, 3)) < hit
    signals = signals + NOISE * rng.standard_normal(signals.shape)
    spoilt = signals + planted * rng.uniform(-30.0, 30.0, signals.shape)
    columns = {n: x for n, x in zip(("s", "s_dot", "s_ddot"), spoilt.T, strict=True) if n in names}
    return dr.Log.from_arrays(2.0 + DT * np.arange(N), {**columns, "force": force}, source="sledge"), planted


@pytest.fixture(scope="module")
def spoilt():
    """An identification from a log with outliers, of a machine on which more acts than its model knows."""
    log, planted = log_of(*slide(), hit=0.1)
    return dr.identify(sledge(), log, seed=1), planted


# ---------------------------------------------------------------------- what it says


def test_outliers_are_the_planted_ones_by_signal(spoilt):
    result, planted = spoilt
    for k, name in enumerate(("s", "s_dot", "s_ddot")):
        assert (result.diagnosis.outliers[name] == planted[:, k]).mean() > 0.98
        assert result.diagnosis.outlier_fraction[name] == pytest.approx(planted[:, k].mean(), abs=0.02)


def test_unexplained_is_the_acceleration_less_what_the_model_makes_of_it(spoilt):
    result, _ = spoilt
    state, acceleration, force = slide()
    p, found = result.parameters, result.diagnosis
    left = acceleration - (force - p["drag"] * state[:, 1]) / p["mass"]
    rows = np.rint((found.smoothed_time - 2.0) / DT).astype(int)
    means = np.array([x.mean() for x in np.split(left, rows[1:])])
    assert np.sqrt(np.mean(means**2)) > 0.05
    np.testing.assert_allclose(found.unmodelled_accelerations["s_ddot"], means, atol=0.1 * np.abs(means).max())
    np.testing.assert_allclose(found.unmodelled_forces["s_ddot"], p["mass"] * found.unmodelled_accelerations["s_ddot"])


def test_motion_is_where_the_machine_was_though_rows_are_outliers_or_rates_are_not_measured(spoilt):
    state, acceleration, force = slide(extra=0.0)
    alone, _ = log_of(state, acceleration, force, hit=0.1, names=("s",))
    positions = dr.identify(sledge(), alone, seed=1, differentiate=True).diagnosis
    for found, truth in ((spoilt[0].diagnosis, slide()[0]), (positions, state)):
        rows = np.rint((found.smoothed_time - 2.0) / DT).astype(int)
        assert rows[0] == 0
        for k, name in enumerate(("s", "s_dot")):
            np.testing.assert_allclose(found.smoothed_states[name], truth[rows, k], atol=0.05)


def test_an_input_that_acts_late_is_said_with_its_delay():
    found = dr.identify(sledge(), log_of(*slide(extra=0.0, lag=6))[0], seed=0)
    assert found.diagnosis.input_delay_significant
    assert found.diagnosis.input_delay == pytest.approx(0.06, abs=1e-3)
    assert re.search(r"· Inputs act 60(\.1)? ms later than recorded", str(found))
    punctual = dr.identify(sledge(), log_of(*slide(extra=0.0))[0], seed=0)
    assert not punctual.diagnosis.input_delay_significant


# ---------------------------------------------------------------------- how it is printed


def test_a_result_prints_a_row_a_signal_and_all_rows_are_as_long(spoilt):
    result, _ = spoilt
    rows = result.diagnosis.lines(result.model.units)
    assert [row[0] for row in rows] == ["signal", "s", "s_dot", "s_ddot"]
    assert [row[-1] for row in rows] == ["unit", "m", "m/s", "m/s^2"]
    assert len({len(row) for row in rows}) == 1
    assert re.search(r"^s_ddot +\S+ +\S+ % +0\.\d+ +m/s\^2$", str(result), re.MULTILINE)


def test_an_acceleration_that_is_not_measured_shows_what_is_unexplained_alone(spoilt):
    found = spoilt[0].diagnosis
    bare = replace(
        found,
        noise_std={"s": 0.1},
        outlier_fraction={"s": 0.0},
        unmodelled_accelerations={"s_ddot": np.array([3.0, -3.0])},
    )
    assert bare.lines(sledge().units)[2] == ["s_ddot", "", "", "3", "m/s^2"]


def test_a_parameter_that_the_log_cannot_tell_is_printed_as_a_question(spoilt):
    result, _ = spoilt
    covariance = result.covariance.copy()
    covariance[1] = covariance[:, 1] = np.inf
    diagnosis = replace(result.diagnosis, unidentifiable=("drag",))
    vague = replace(result, estimate=replace(result.estimate, covariance=covariance, diagnosis=diagnosis))
    assert re.search(r"^drag +\? +unknown +unknown +N s/m$", str(vague), re.MULTILINE)
    assert "· drag is not identifiable from this log; excite it" in str(vague)


# ---------------------------------------------------------------------- how it is kept


def test_what_is_saved_is_what_is_loaded(spoilt, tmp_path):
    result, _ = spoilt
    result.save(tmp_path / "model.json")
    loaded = dr.Result.load(tmp_path / "model.json")
    assert loaded == result
    for name, mask in result.diagnosis.outliers.items():
        np.testing.assert_array_equal(loaded.diagnosis.outliers[name], mask)
    for name in ("unmodelled_time", "smoothed_time"):
        np.testing.assert_array_equal(getattr(loaded.diagnosis, name), getattr(result.diagnosis, name))
    for name in ("unmodelled_accelerations", "unmodelled_forces", "smoothed_states"):
        before, after = getattr(result.diagnosis, name), getattr(loaded.diagnosis, name)
        assert list(before) == list(after)
        assert all((before[n] == after[n]).all() for n in before)


def test_nothing_of_it_can_be_changed(spoilt):
    result, _ = spoilt
    for found in (result.diagnosis, dr.Result.from_dict(json.loads(json.dumps(result.to_dict()))).diagnosis):
        arrays = [found.window_log, found.unmodelled_time, found.smoothed_time]
        for mapping in (found.outliers, found.unmodelled_accelerations, found.unmodelled_forces, found.smoothed_states):
            arrays += mapping.values()
            with pytest.raises(TypeError, match="item assignment"):
                mapping["s"] = None
        for array in arrays:
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1.0
        with pytest.raises(AttributeError):
            found.input_delay_significant = True


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("noise_std", None),
        ("noise_std", {"s": "loud"}),
        ("outliers", {"s": "AAAA"}),
        ("outliers", {"s": "no base 64!"}),
        ("window_log", [0.5]),
        ("unmodelled_time", ["soon"]),
        ("smoothed_states", {"s": [[0.0], [0.0, 1.0]]}),
        ("input_delay", None),
        ("unidentifiable", None),
    ],
)
def test_damage_is_told_by_name_of_the_file(spoilt, tmp_path, key, value):
    data = spoilt[0].to_dict()
    for damaged in ({**data["diagnosis"], key: value}, {k: x for k, x in data["diagnosis"].items() if k != key}):
        path = tmp_path / "model.json"
        path.write_text(json.dumps({**data, "diagnosis": damaged}))
        with pytest.raises(dr.ResultError, match=r"model\.json: the result is damaged"):
            dr.Result.load(path)
