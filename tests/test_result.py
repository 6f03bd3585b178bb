"""Results: what is saved is what is loaded, files are whole or untouched, damage is told from meaning."""

import copy
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import t as student_t

import diransac as dr
import results as replacing
from diransac.errors import ResultError, SettingsError
from simulated import MACHINES, as_log, flight, with_outliers

SETTINGS = dr.Settings(sample_size=20, max_iterations=30)


def identified(method="i-diransac", signals=None, **changes):
    machine = MACHINES["planar-rotorcraft"]
    recorded, inputs = flight(machine, 150, 0.02)
    log = as_log(machine, with_outliers(recorded, 0.05, 30.0, 2), inputs, 0.02)
    if signals is not None:
        columns = {n: log[n] for n in (*signals, *machine.inputs)}
        log = dr.Log.from_arrays(log.time, columns, source="partial log")
    settings = SETTINGS if method == "i-diransac" else None
    return dr.identify(dr.models.planar_rotorcraft(), log, method, settings=settings, **changes)


@pytest.fixture(scope="module")
def result():
    return identified()


@pytest.fixture(scope="module")
def results(result):
    """Results of every kind: a search, least squares that violates a bound, no simulation, infinite variances."""
    without_start = identified("ols", ("theta", "x_dot", "z_dot", "x_ddot", "z_ddot", "theta_ddot"))
    negative = dataclasses.replace(
        result.estimate, parameters=result.parameters | {"mass": -0.1}, covariance=np.full((3, 3), np.inf)
    )
    shifted = ({"step": "shift", "seconds": 0.01, "names": ["thrust"]},)
    odd = dataclasses.replace(
        result,
        estimate=negative,
        evaluation=dataclasses.replace(result.evaluation, fit_error=np.inf),
        bandwidth_sensitivity=dict.fromkeys(result.parameters, (0.01, np.nan)),
        logs=(dataclasses.replace(result.logs[0], preparation=shifted),),
        notes=("two rows were skipped",),
    )
    return {"search": result, "tls": identified("tls"), "no simulation": without_start, "odd": odd}


KINDS = pytest.mark.parametrize("kind", ["search", "tls", "no simulation", "odd"])


# ---------------------------------------------------------------------- what is saved


@KINDS
def test_saved_result_loads_as_it_was(results, kind, tmp_path):
    path = tmp_path / "model.json"
    results[kind].save(path)
    loaded = dr.Result.load(path)
    assert loaded == results[kind]
    assert np.array_equal(loaded.inliers, results[kind].inliers)
    assert np.array_equal(loaded.covariance, results[kind].covariance, equal_nan=True)
    assert list(loaded.parameters.items()) == list(results[kind].parameters.items())
    assert str(loaded) == str(results[kind])


def test_without_a_start_nothing_is_simulated(results):
    """The log lacks the initial angular rate: fitted all the same, without an error or inliers."""
    it = results["no simulation"]
    assert np.isnan(it.fit_error)
    assert np.isnan(it.inlier_fraction)
    assert not it.inliers.any()


def test_saved_file_is_json_that_any_program_reads(results, tmp_path):
    """No NaN, no Infinity: they are no JSON."""
    path = tmp_path / "model.json"
    results["odd"].save(path)

    def refuse(constant):
        raise AssertionError(constant)

    data = json.loads(path.read_text(), parse_constant=refuse)
    assert data["parameters"] == results["odd"].parameters
    assert data["units"] == {"mass": "kg", "inertia": "kg m^2", "drag": "s/m"}


def test_equality_is_of_everything_but_identity(result):
    assert result == dr.Result.from_dict(result.to_dict())
    assert result != dataclasses.replace(result, seed=5)
    others = dataclasses.replace(result.evaluation, inliers=~result.inliers)
    assert result != dataclasses.replace(result, evaluation=others)
    wider = dataclasses.replace(result.estimate, covariance=2.0 * result.covariance)
    assert result != dataclasses.replace(result, estimate=wider)
    assert result != dataclasses.replace(result, options={"substeps": 5})
    assert result != "a result"


def test_result_pickles(result):
    assert copy.deepcopy(result) == result


def test_result_is_a_plant(result):
    assert dr.Plant(result.model, result.parameters).parameters == result.parameters


# ---------------------------------------------------------------------- files, whole or not at all


def test_saving_replaces_a_file_and_leaves_nothing_beside_it(result, tmp_path):
    path = tmp_path / "model.json"
    path.write_text("old")
    result.save(str(path))
    assert dr.Result.load(path) == result
    assert [x.name for x in tmp_path.iterdir()] == ["model.json"]


@pytest.mark.parametrize("failing", ["write_bytes", "replace"])
def test_failing_to_save_leaves_the_old_file_and_nothing_beside_it(result, tmp_path, monkeypatch, failing):
    path = tmp_path / "model.json"
    path.write_text("old")

    def fail(self, *arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, failing, fail)
    with pytest.raises(ResultError, match=r"model\.json: cannot be written: No space left"):
        result.save(path)
    monkeypatch.undo()
    assert path.read_text() == "old"
    assert [x.name for x in tmp_path.iterdir()] == ["model.json"]


def test_saved_file_has_the_rights_of_any_new_file(result, tmp_path):
    (tmp_path / "plain").write_text("")
    result.save(tmp_path / "model.json")
    assert (tmp_path / "model.json").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_saving_keeps_the_rights_of_the_file_it_replaces(result, tmp_path):
    path = tmp_path / "model.json"
    path.write_text("old")
    path.chmod(0o600)
    result.save(path)
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("where", ["missing/model.json", "."])
def test_saving_where_no_file_can_be_is_refused(result, tmp_path, where):
    with pytest.raises(ResultError, match="cannot be written"):
        result.save(tmp_path / where)


# ---------------------------------------------------------------------- what cannot be loaded


def changed(result, path, value):
    data = json.loads(json.dumps(result.to_dict()))
    holder = data
    for key in path[:-1]:
        holder = holder[key]
    holder[path[-1]] = value
    return json.dumps(data)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "3", "null", '{"format": 99}', '"model"', "[" * 100_000],
    ids=["empty", "cut", "list", "number", "null", "another format", "text", "endless"],
)
def test_file_that_holds_no_result_is_refused_by_name(tmp_path, text):
    path = tmp_path / "model.json"
    path.write_text(text)
    with pytest.raises(ResultError, match=r"model\.json"):
        dr.Result.load(path)


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"\x00" * 100], ids=["not UTF-8", "zeros"])
def test_binary_file_is_refused_by_name(tmp_path, content):
    path = tmp_path / "model.json"
    path.write_bytes(content)
    with pytest.raises(ResultError, match=r"model\.json"):
        dr.Result.load(path)


@pytest.mark.parametrize(
    ("number", "says"),
    [
        (1, "format 1, of an earlier version of diransac; this one reads 9 to 11. Identify again$"),
        (8, "format 8, of an earlier"),
        (99, "format 99, of a later"),
        ("8", "no result of diransac"),
        (None, "no result of diransac"),
    ],
)
def test_result_of_another_format_is_refused_in_one_sentence(result, tmp_path, number, says):
    path = tmp_path / "model.json"
    path.write_text(changed(result, ["format"], number))
    with pytest.raises(ResultError, match=rf"model\.json: .*{says}") as caught:
        dr.Result.load(path)
    assert len(str(caught.value).splitlines()) == 1


def test_missing_file_is_refused_by_name(tmp_path):
    with pytest.raises(ResultError, match=r"nothing\.json: cannot be read: No such file"):
        dr.Result.load(tmp_path / "nothing.json")


def test_every_key_is_needed(result, tmp_path):
    data = json.loads(json.dumps(result.to_dict()))
    derived = {"units", "standard_errors", "intervals_95", "structural_intervals_95", "structure", "violations"}
    derived |= {"verdict", "findings"}
    added = {"checks"}
    for key in data.keys() - derived - added:
        path = tmp_path / "model.json"
        path.write_text(json.dumps({k: x for k, x in data.items() if k != key}))
        with pytest.raises(ResultError):
            dr.Result.load(path)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (["parameters", "mass"], "NaN"),
        (["parameters", "mass"], "heavy"),
        (["parameters"], {"mass": 1.0}),
        (["parameters"], 3),
        (["covariance"], [[1.0, 2.0], [3.0, 4.0]]),
        (["covariance"], "none"),
        (["inliers"], "####"),
        (["inliers"], "AAAA"),
        (["inliers"], 7),
        (["logs", 0, "n_rows"], 10**6),
        (["logs", 0, "dt"], "fast"),
        (["logs", 0], 3),
        (["logs"], []),
        (["logs"], None),
        (["settings", "sample_size"], 0),
        (["settings", "unknown"], 0),
        (["settings"], [1]),
        (["model", "residual"], "AAAA"),
        (["model", "coordinates"], {"y": "m", "z": "m", "theta": "rad"}),
        (["model"], 5),
        (["bandwidth_sensitivity"], {"mass": [1.0]}),
        (["degrees_of_freedom"], "many"),
        (["rejected"], 4),
        (["iterations"], "all"),
        (["method"], None),
        (["notes"], 5),
        (["checks"], 5),
        (["possible_terms"], 5),
        (["possible_terms"], [{"kind": "drag"}]),
        (["checks"], [{"level": "fatal", "text": "it burns"}]),
        (["logs", 0, "prediction"], 3),
    ],
    ids=str,
)
def test_damaged_result_is_refused(result, tmp_path, path, value):
    file = tmp_path / "model.json"
    file.write_text(changed(result, path, value))
    with pytest.raises(ResultError, match=r"model\.json"):
        dr.Result.load(file)


# ---------------------------------------------------------------------- what is said


def test_intervals_are_students(result):
    width = student_t.ppf(0.95, result.degrees_of_freedom)
    for name, (low, high) in result.intervals(0.9).items():
        error = result.standard_errors[name]
        assert (low + high) / 2 == pytest.approx(result.parameters[name])
        assert high - low == pytest.approx(2 * width * error)


@pytest.mark.parametrize("level", [0.0, 1.0, 95, float("nan")])
def test_level_that_is_no_probability_is_refused(result, level):
    with pytest.raises(SettingsError, match="level"):
        result.intervals(level)


def test_standard_errors_are_roots_of_the_covariances_diagonal(result):
    assert list(result.standard_errors.values()) == pytest.approx(np.sqrt(np.diag(result.covariance)))


def test_inlier_times_are_log_times(result):
    assert result.inlier_times == pytest.approx(0.02 * np.flatnonzero(result.inliers))


def test_printed_result_shows_every_parameter_with_its_unit_and_how_it_came_about(result):
    text = str(result)
    for name, unit in result.units.items():
        (line,) = [x for x in text.splitlines() if x.startswith(name)]
        assert line.endswith(unit)
        assert f"{result.parameters[name]:.6g}" in line
    for part in ("planar-rotorcraft by i-diransac", "fit error", "inliers", result.stop_reason):
        assert part in text


def test_a_notebook_shows_the_verdict_and_every_parameter_and_nothing_that_is_markup_of_a_log(result):
    named = dataclasses.replace(result, logs=(dataclasses.replace(result.logs[0], source="<script>a</script>"),))
    page = named._repr_html_()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert f"<strong>{result.verdict}</strong>" in page
    assert all(f"<td>{name}</td>" in page for name in result.parameters)
    assert len(repr(result)) < 200


def test_printed_result_says_what_is_not_as_it_should_be(results):
    text = str(results["odd"])
    assert "mass" in text.split("!", 1)[1].splitlines()[0]
    assert "two rows were skipped" in text
    assert "unknown" in text


def test_printed_result_warns_of_a_fit_that_explains_little_of_the_log(result):
    vague = dataclasses.replace(result.estimate, covariance=np.full((3, 3), np.inf), n_fitted=2)
    poor = dataclasses.replace(
        result, estimate=vague, evaluation=dataclasses.replace(result.evaluation, inlier_fraction=0.2)
    )
    lines = str(poor).splitlines()
    assert "verdict: usable with care" in lines  # predictions decide what is not to be relied on
    assert any(line.startswith("· 20 % of") and "less than half of the log" in line for line in lines)
    assert any(line.startswith("· ") and "2 fitted rows are too few" in line for line in lines)
    assert any("short of the 85 % inliers" in finding for finding in poor.findings)


def test_arrays_of_a_result_cannot_be_changed(result):
    assert not result.inliers.flags.writeable
    assert not result.covariance.flags.writeable


def test_samples_are_within_intervals_as_often_as_these_say(result):
    spread = 1e-3 * np.array(list(result.parameters.values()))  # far from all bounds
    n, narrow = 20_000, replacing.changed(result, covariance=np.outer(spread, spread) * (0.5 + 0.5 * np.eye(3)))
    draws = narrow.sample(n, seed=1)
    assert list(draws) == list(result.parameters)
    for name, (low, high) in narrow.intervals(0.9).items():
        inside = (draws[name] > low) & (draws[name] < high)
        assert inside.mean() == pytest.approx(0.9, abs=4.0 * np.sqrt(0.09 / n)), name
    again = narrow.sample(10, seed=1)
    assert all((again[name] == draws[name][:10]).all() for name in draws)


def test_samples_are_within_bounds_and_fixed_parameters_are_constant(result):
    name, *others = result.parameters
    places = [list(result.parameters).index(n) for n in others]
    covariance = np.zeros_like(result.covariance)
    covariance[np.ix_(places, places)] = np.diag([4.0 * result.parameters[n] ** 2 for n in others])
    wide = replacing.changed(result, fixed=(name,), covariance=covariance)
    draws = wide.sample(500)
    assert (draws[name] == result.parameters[name]).all()
    for n, values in draws.items():
        assert result.model.parameters[n].admits(values).all()


def test_nothing_is_drawn_where_no_interval_is_known(result):
    unknown = replacing.changed(result, covariance=np.full_like(result.covariance, np.inf))
    with pytest.raises(dr.ResultError, match="no interval is known"):
        unknown.sample(3)
    with pytest.raises(dr.SettingsError, match="n is 0"):
        result.sample(0)
