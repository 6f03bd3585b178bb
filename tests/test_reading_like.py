"""What a log says of itself needs no option, and a second log of a recorder is read as the first."""

import json
from csv import DictReader
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, TRUE, run, swim
from diransac.data.readers import read_log

T = 0.01 * np.arange(200.0)
X = np.sin(T)


def csv(path: Path, header: str, *columns) -> Path:
    rows = (",".join(repr(float(x)) for x in row) for row in zip(*columns, strict=True))
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("time", 1.0),
        ("Timestamp", 1.0),
        ("t_s", 1.0),
        ("t_ms", 1e3),
        ("Time [ms]", 1e3),
        ("time (ms)", 1e3),
        ("time_us", 1e6),
        ("timestamp_ns", 1e9),
        ("stamp", 1.0),
    ],
)
def test_the_only_column_that_can_be_the_time_is_it_in_seconds(tmp_path, header, factor):
    log = read_log(csv(tmp_path / "a.csv", f"{header},x", factor * T, X))
    np.testing.assert_allclose(log.time, T, atol=1e-12)
    assert log.names == ("x",)


@pytest.mark.parametrize("header", ["time,stamp", "T", "temperature", "times_called", "tm"])
def test_other_columns_are_not_taken_for_the_time(tmp_path, header):
    columns = [T] * (1 + header.count(","))
    with pytest.raises(dr.LogError, match=r"no time column .*--map t=NAME"):
        read_log(csv(tmp_path / "a.csv", f"{header},x", *columns, X))


def test_a_column_that_is_named_otherwise_is_not_the_time(tmp_path):
    log = read_log(csv(tmp_path / "a.csv", "time,stamp,x", T, T + 5.0, X), rename={"sent": "stamp"})
    assert log.names == ("sent", "x")


def test_a_factor_of_the_time_prevails_over_its_unit(tmp_path):
    log = read_log(csv(tmp_path / "a.csv", "time [ms],x", T, X), scale={"t": 1.0})
    np.testing.assert_array_equal(log.time, T)


def test_a_second_log_is_read_as_the_first(tmp_path):
    options = {"rename": {"position": "q"}, "scale": {"position": -2.0}, "resample": 50.0}
    first = read_log(csv(tmp_path / "a.csv", "t_ms,q [mm]", 1e3 * T, X), **options)
    first = dr.shift(first, {"position": 0.1})
    second = csv(tmp_path / "b.csv", "t_ms,q [mm]", 1e3 * T, X)
    like = read_log(second, like=first.history)
    np.testing.assert_array_equal(like["position"], first["position"])
    assert like.units == first.units
    other = read_log(second, like=first.history, rename={"x": "q"}, resample=100.0)
    assert set(other.names) == {"x"}
    assert other.dt == pytest.approx(0.01)


def test_a_factor_is_that_of_columns_in_the_same_unit(tmp_path):
    first = read_log(csv(tmp_path / "a.csv", "t,x [mm]", T, X), scale={"x": 0.001})
    second = read_log(csv(tmp_path / "b.csv", "t,x [m]", T, X), like=first.history)
    np.testing.assert_array_equal(second["x"], X)


def test_a_file_of_a_prepared_log_is_read_as_it_is(tmp_path):
    first = read_log(csv(tmp_path / "a.csv", "t,q", T, X), rename={"x": "q"}, scale={"x": 3.0})
    first.write(tmp_path / "prepared.csv")
    again = read_log(tmp_path / "prepared.csv", like=first.history)
    np.testing.assert_array_equal(again["x"], first["x"])
    assert again.history == first.history


def test_a_mapping_travels_with_the_history(tmp_path):
    mapping = tmp_path / "m.toml"
    mapping.write_text('[[signals]]\nname = "x"\nfield = "q"\nscale = 2.0\n')
    first = read_log(csv(tmp_path / "a.csv", "time,q", T, X), mapping=mapping)
    mapping.unlink()
    second = read_log(csv(tmp_path / "b.csv", "time,q", T, X), like=first.history)
    np.testing.assert_array_equal(second["x"], 2.0 * X)


@pytest.mark.parametrize(
    "step", [{"step": "scale"}, {"step": "map", "text": "[", "mapping": "m"}, {"step": "rename", "names": None}]
)
def test_a_damaged_history_is_refused(tmp_path, step):
    path = csv(tmp_path / "a.csv", "time,q", T, X)
    with pytest.raises(dr.LogError, match=r"damaged|TOML"):
        read_log(path, like=[step])


def test_derived_columns_are_not_judged_as_measured():
    model = dr.models.servo_axis()
    t = 0.005 * np.arange(2000.0)
    force = 60.0 * np.sin(1.5 * t) + 45.0 * np.sin(4.1 * t)
    plant = dr.Plant(model, {"mass": 20.0, "viscous_friction": 80.0, "dry_friction": 8.0, "offset": 1.0})
    start = {"position": 0.0, "position_dot": 0.0}
    moved = dr.simulate(plant, dr.Log.from_arrays(t, {"force": force}), initial_state=start)
    raw = dr.Log.from_arrays(t, {"position": moved["position"], "force": force})
    derived = dr.differentiate(raw, model)
    assert set(derived.measured.names) == {"position", "force"}
    assert set(dr.validate(plant, derived).rmse) == {"position"}
    result = dr.identify(model, derived)
    assert set(result.diagnosis.outlier_fraction) == {"position"}


def test_a_table_of_a_spreadsheet_with_decimal_commas_needs_no_option(tmp_path):
    rows = (f"{1e3 * t:.4f};{x:.6f}".replace(".", ",") for t, x in zip(T, X, strict=True))
    (tmp_path / "a.csv").write_text("\r\n".join(["\ufeffTime [ms];x (mm)", *rows]) + "\r\n", encoding="utf-8")
    log = read_log(tmp_path / "a.csv")
    np.testing.assert_allclose(log.time, T, atol=1e-12)
    np.testing.assert_allclose(log["x"], X, atol=1e-6)
    assert log.units == {"x": "mm"}


# Commands that are given a result ------------------------------------------------------------------------------------


@pytest.fixture
def raw(tmp_path, monkeypatch):
    """Two logs of a recorder with names and units of its own, and a result of the first."""
    monkeypatch.chdir(tmp_path)
    for name, frequency in (("a.csv", 1.3), ("b.csv", 0.9)):
        own = swim(T, frequency)
        columns = (1e3 * T, own["x"], own["x_dot"], own["x_ddot"], own["thrust"] / 12.5)
        csv(tmp_path / name, "t_ms,pos,vel,acc,current", *columns)
    done = run("identify", "a.csv", *MODEL, *SIGNALS, "--method", "ols", "-o", "a.json")
    assert done.exit_code == 0, done.stderr
    return tmp_path


SIGNALS = ["--map", "x=pos,x_dot=vel,x_ddot=acc,thrust=current", "--scale", "thrust=12.5"]


@pytest.mark.parametrize(
    "words",
    [
        ["compare", "b.csv", "--methods", "ols,tls", "--report", "page.html"],
        ["identify", "b.csv", "--method", "ols", "--report", "page.html"],
        ["cross-validate", "a.csv", "b.csv", "--method", "ols"],
        ["inspect", "b.csv"],
    ],
)
def test_commands_that_are_given_a_result_read_logs_as_it_was(raw, words):
    of_result = run(*words, "--model", "a.json", "--json")
    assert of_result.exit_code == 0, of_result.stderr
    given = run(*words, *MODEL, *SIGNALS, "--json")
    found, expected = json.loads(of_result.stdout), json.loads(given.stdout)
    for one in (found, expected):
        for method in one.get("methods", {}).values():
            del method["seconds"]
    assert found == expected
    if "--report" in words:
        assert "12.5" in Path("page.html").read_text()


def test_a_fleet_is_read_as_the_log_of_the_result(raw):
    words = ["--method", "ols", "--each", "--store", "fleet.db", "--json", "--jobs", "1"]
    done = run("identify", "a.csv", "b.csv", "--model", "a.json", *words)
    assert done.exit_code == 0, done.stderr
    assert run("fleet", "export", "fleet.db", "-o", "fleet.csv").exit_code == 0
    rows = list(DictReader(Path("fleet.csv").read_text().splitlines()))
    assert [float(row["parameter_mass"]) for row in rows] == pytest.approx([TRUE["mass"]] * 2, rel=1e-6)


def test_an_option_prevails_over_the_result(raw):
    done = run("identify", "b.csv", "--model", "a.json", "--scale", "thrust=25", "--method", "ols", "--json")
    assert json.loads(done.stdout)["parameters"]["mass"] == pytest.approx(100.0, rel=1e-6)


def test_a_model_is_no_other_json(raw):
    Path("other.json").write_text("{}")
    done = run("compare", "b.csv", "--model", "other.json")
    assert (done.exit_code, done.stderr.startswith("error: other.json: ")) == (1, True)
