"""The command line: what it prints, and how it ends."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

import diransac as dr
from command_line import FEW, MODEL, QUICK, TRUE, contents, run, run_both, swim, working_folder
from diransac.cli import screen
from diransac.cli.commands import app
from diransac.identification.method import Progress
from diransac.simulation import RolloutBatch, rollouts


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return working_folder(tmp_path, monkeypatch)


# ---------------------------------------------------------------- identify


@pytest.mark.parametrize("method", dr.METHODS)
def test_identify_finds_the_true_parameters_by_every_method(folder: Path, method: str):
    model, thrust = dr.models.underwater_vehicle(), swim(np.arange(600) * 0.01)["thrust"]
    plant = dr.Plant(model, TRUE)
    # The thrust is held from row to row, as in simulations: lo-diransac distinguishes it from a continuous one.
    signals = rollouts(model).trajectories(RolloutBatch([plant.constants], np.zeros(2), thrust[:, None], 0.01))[0]
    columns = dict(zip(model.signals, signals.T, strict=True)) | {"thrust": thrust}
    dr.Log.from_arrays(np.arange(600) * 0.01, columns).write("held.csv")
    settings = FEW if method in ("diransac", "i-diransac") else []
    done = run("identify", "held.csv", *MODEL, "--method", method, *settings, "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == 0
    assert found["parameters"] == pytest.approx(TRUE, rel=1e-6)
    assert found["method"] == method


def test_identify_prints_and_saves_the_same_result(folder: Path):
    printed = run("identify", "swim.csv", *MODEL, "--seed", 7, "-o", "model.json")
    as_json = run("identify", "swim.csv", *MODEL, "--seed", 7, "--json")
    saved = dr.Result.load("model.json")
    assert printed.stdout.strip() == str(saved)
    assert json.loads(as_json.stdout)["parameters"] == dict(saved.parameters)
    assert saved.seed == 7
    assert printed.stderr == as_json.stderr == ""


def test_identify_prepares_the_log_as_it_is_told(folder: Path):
    t = np.arange(600) * 0.01
    clean = swim(t)
    corrupted = clean["thrust"].copy()
    corrupted[300] = 1e4
    columns = {"pos": clean["x"], "speed": clean["x_dot"], "x_ddot": clean["x_ddot"], "force_kN": corrupted / 1e3}
    dr.Log.from_arrays(t * 1e3, columns).write("raw.csv")
    done = run(
        *("identify", "raw.csv", *MODEL, "--method", "ols", "--json", "--from", "0.5", "--until", "5.5"),
        *("--map", "x=pos,x_dot=speed", "--map", "thrust=force_kN", "--scale", "t=0.001,thrust=1000"),
        *("--despike", "thrust"),
    )
    found = json.loads(done.stdout)
    assert found["parameters"] == pytest.approx(TRUE, rel=1e-3)
    assert [step["step"] for step in found["logs"][0]["preparation"]][:3] == ["rename", "scale", "cut"]


def test_identify_moves_a_command_that_acts_late(folder: Path):
    t = np.arange(600) * 0.01
    early = swim(t) | {"thrust": swim(t + 0.05)["thrust"]}
    dr.Log.from_arrays(t, early).write("early.csv")
    done = run("identify", "early.csv", *MODEL, "--method", "ols", "--shift", "thrust=0.05", "--json")
    assert json.loads(done.stdout)["parameters"] == pytest.approx(TRUE, rel=1e-6)


def test_identify_derives_only_when_asked(folder: Path):
    t = np.arange(1000) * 0.01
    log = swim(t)
    dr.Log.from_arrays(t, {"x": log["x"], "thrust": log["thrust"]}).write("positions.csv")
    refused = run("identify", "positions.csv", *MODEL, "--method", "ols")
    done = run("identify", "positions.csv", *MODEL, "--method", "ols", "--differentiate", "--bandwidth", 5, "--json")
    assert refused.exit_code == 1
    assert "x_dot" in refused.stderr
    assert "--differentiate" in refused.stderr
    assert json.loads(done.stdout)["parameters"]["mass"] == pytest.approx(TRUE["mass"], rel=0.02)


def test_a_bandwidth_without_differentiation_is_refused_in_the_command_line_s_words(folder: Path):
    run("identify", "swim.csv", *MODEL, "--method", "ols", "-o", "model.json")
    for words in (["identify", "swim.csv", *MODEL], ["validate", "model.json", "swim.csv"]):
        done = run(*words, "--bandwidth", 3)
        assert done.exit_code == 1
        assert "--bandwidth" in done.stderr
        assert "--differentiate" in done.stderr


@pytest.mark.parametrize("options", [[], QUICK], ids=["default", "i-diransac"])
def test_same_seed_gives_the_same_bytes(folder: Path, options: list[str]):
    for name in ("a.json", "b.json"):
        assert run("identify", "swim.csv", *MODEL, *options, "--seed", 3, "-o", name).exit_code == 0
    assert Path("a.json").read_bytes() == Path("b.json").read_bytes()


# ---------------------------------------------------------------- compare and validate


def test_compare_shows_every_method_and_why_one_refuses(folder: Path, monkeypatch: pytest.MonkeyPatch):
    t = np.arange(400) * 0.01
    v, a = np.sin(t), np.cos(t)
    thrust = 2.0 * a + np.exp(0.5 * v)
    dr.Log.from_arrays(t, {"x": 1.0 - np.cos(t), "x_dot": v, "x_ddot": a, "thrust": thrust}).write("bent.csv")
    text, said = run_both(monkeypatch, "compare", "bent.csv", "--model", "bent.py", *FEW)
    methods = said["methods"]
    assert set(methods) == set(dr.METHODS)
    assert "rate" in methods["ols"]["refused"]
    assert methods["i-diransac"]["parameters"] == pytest.approx({"mass": 2.0, "rate": 0.5}, rel=1e-6)
    assert all(method in text for method in dr.METHODS)


def test_compare_runs_the_methods_that_are_named(folder: Path):
    done = run("compare", "swim.csv", *MODEL, "--methods", "ols, tls", "--json")
    assert list(json.loads(done.stdout)["methods"]) == ["ols", "tls"]
    assert run("compare", "swim.csv", *MODEL, "--methods", "ols,magic").exit_code == 2


def test_compare_fails_where_every_method_refuses(folder: Path):
    done = run("compare", "swim.csv", "--model", "bent.py", "--methods", "ols,tls")
    assert (done.exit_code, done.stdout) == (1, "")
    assert "rate" in done.stderr


def test_validate_needs_no_model_file_and_scores_every_signal(folder: Path):
    run("identify", "swim.csv", *MODEL, "--method", "ols", "-o", "model.json")
    t = np.arange(600) * 0.01
    dr.Log.from_arrays(t, swim(t, frequency=0.7)).write("held_out.csv")
    done = run("validate", "model.json", "held_out.csv", "--json")
    scores = json.loads(done.stdout)
    assert set(scores["rmse"]) == {"x", "x_dot", "x_ddot"}
    assert max(scores["rmse"].values()) < 0.02
    at = run("validate", "model.json", "held_out.csv", "--horizon", 0.5, "--report", "page.html")
    assert "RMSE" in at.stdout
    assert "0.5 s, the judged horizon" in Path("page.html").read_text()


@pytest.mark.parametrize("content", [None, b"", b"{}", b"\x00\xff", b'{"format": 1}'])
def test_validate_names_a_model_that_cannot_be_read(folder: Path, content: bytes | None):
    if content is not None:
        Path("model.json").write_bytes(content)
    done = run("validate", "model.json", "swim.csv")
    assert done.exit_code == 1
    assert "model.json" in done.stderr


# ---------------------------------------------------------------- several logs


@pytest.fixture
def two(folder: Path) -> list[str]:
    """Names of two logs of one vehicle, at two frequencies."""
    for name, frequency in (("a.csv", 1.3), ("b.csv", 0.9)):
        t = np.arange(600) * 0.01
        dr.Log.from_arrays(t, swim(t, frequency)).write(name)
    return ["a.csv", "b.csv"]


@pytest.mark.parametrize(("method", "error"), [("ols", 1e-6), ("lo-diransac", 0.1)])
def test_identify_estimates_one_set_of_parameters_from_several_logs(
    two: list[str], monkeypatch: pytest.MonkeyPatch, method: str, error: float
):
    text, said = run_both(monkeypatch, "identify", *two, *MODEL, "--method", method)
    assert said["parameters"] == pytest.approx(TRUE, rel=error)
    assert [log["source"] for log in said["logs"]] == [f'log "{name}"' for name in two]
    assert "from 2 logs" in text
    assert all(any(line.startswith(f'log "{name}"') for line in text.splitlines()) for name in two)


def test_a_result_of_several_logs_is_saved_reported_and_validated_on_several(two: list[str]):
    done = run("identify", *two, *MODEL, "--method", "ols", "-o", "model.json", "--report", "page.html")
    said = json.loads(run("validate", "model.json", *two, "--json").stdout)
    result = dr.Result.load("model.json")
    assert done.exit_code == 0
    assert [log.source for log in result.logs] == [f'log "{name}"' for name in two]
    assert all(name in Path("page.html").read_text() for name in two)
    assert said["rmse"] == dr.validate(result, [dr.read_log(name) for name in two]).rmse
    assert all(name in said["log"] for name in two)


def test_compare_gives_every_method_all_logs(two: list[str], monkeypatch: pytest.MonkeyPatch):
    text, said = run_both(monkeypatch, "compare", *two, *MODEL, "--methods", "ols,i-diransac", *FEW)
    assert text.startswith('underwater-vehicle from log "a.csv", log "b.csv"\n')
    for found in said["methods"].values():
        assert [log["source"] for log in found["logs"]] == [f'log "{name}"' for name in two]
        assert found["parameters"] == pytest.approx(TRUE, rel=1e-6)


def test_cross_validate_leaves_out_each_log_in_turn(two: list[str], monkeypatch: pytest.MonkeyPatch):
    text, said = run_both(monkeypatch, "cross-validate", *two, *MODEL, "--method", "ols")
    assert [fold["log"] for fold in said["folds"]] == [f'log "{name}"' for name in two]
    assert [fold["validation"]["log"] for fold in said["folds"]] == [fold["log"] for fold in said["folds"]]
    for fold in said["folds"]:
        assert fold["parameters"] == pytest.approx(TRUE, rel=1e-6)
    errors = [fold["validation"]["rmse"]["x"] for fold in said["folds"]]
    assert said["rmse"]["x"] == pytest.approx(np.median(errors))
    assert "log left out" in text


def test_cross_validate_needs_two_logs(folder: Path):
    done = run("cross-validate", "swim.csv", *MODEL, "--method", "ols")
    assert (done.exit_code, done.stdout) == (1, "")
    assert "at least two logs" in done.stderr


# ---------------------------------------------------------------- progress


def test_progress_is_shown_on_a_terminal_and_never_on_stdout(folder: Path, monkeypatch: pytest.MonkeyPatch):
    silent = run("identify", "swim.csv", *MODEL, *QUICK, "--json")
    monkeypatch.setenv("FORCE_COLOR", "1")
    shown = CliRunner().invoke(app, ["identify", "swim.csv", *MODEL, *QUICK, "--json"], catch_exceptions=False)
    assert shown.stdout == silent.stdout
    assert "i-diransac" in shown.stderr
    assert silent.stderr == ""


def lines_of_progress(monkeypatch: pytest.MonkeyPatch, *updates: tuple[float, float]) -> None:
    """Show progress of "ols" without a terminal: pairs of seconds since the begin and fraction done."""
    now = [100.0]
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setattr(screen, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with screen.bar("ols") as progress:
        for seconds, fraction in updates:
            now[0] = 100.0 + seconds
            progress(Progress("fitting", fraction, "a note"))


def test_without_a_terminal_short_work_prints_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    lines_of_progress(monkeypatch, (0.0, 0.0), (2.0, 0.5), (4.9, 1.0))
    assert capsys.readouterr() == ("", "")


def test_without_a_terminal_long_work_prints_a_line_every_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    lines_of_progress(monkeypatch, (4.0, 0.0), (6.0, 0.0), (10.0, 0.25), (15.9, 0.3), (20.0, 0.5), (29.0, 0.9))
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines() == ["ols: fitting, 0% after 6 s", "ols: fitting, 50% after 20 s, about 20 s left"]


def test_a_process_without_stderr_works_in_silence(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    with monkeypatch.context() as patched:
        patched.setattr("sys.stderr", None)
        lines_of_progress(patched, (0.0, 0.0), (60.0, 0.5))
    assert capsys.readouterr() == ("", "")


def test_on_a_terminal_a_bar_shows_stage_share_and_note(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setenv("FORCE_COLOR", "1")
    with screen.bar("ols") as progress:
        progress(Progress("fitting", 0.25, "12 inliers"))
    out, err = capsys.readouterr()
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", err)
    assert out == ""
    assert "ols: fitting (12 inliers)" in shown
    assert "25%" in shown


# ---------------------------------------------------------------- how it ends


@pytest.mark.parametrize(
    "words",
    [
        ["identify"],
        ["identify", "swim.csv"],
        ["identify", "swim.csv", *MODEL, "--nonsense"],
        ["identify", "swim.csv", *MODEL, "--method", "magic"],
        ["identify", "swim.csv", *MODEL, "--seed", "x"],
        ["identify", "swim.csv", *MODEL, "--map", "position"],
        ["identify", "swim.csv", *MODEL, "--map", "a=x,a=x_dot"],
        ["identify", "swim.csv", *MODEL, "--scale", "x=large"],
        ["identify", "swim.csv", *MODEL, "--resample", "often"],
        ["identify", "swim.csv", *MODEL, "--from", "nan"],
        ["identify", "swim.csv", *MODEL, "--until", "nan"],
        ["identify", "swim.csv", *MODEL, "-o", ""],
        ["identify", "swim.csv", *MODEL, "--report", ""],
        ["compare", "swim.csv", *MODEL, "--methods", ""],
        ["compare", "swim.csv", *MODEL, "--report", ""],
        ["flyaway"],
        [],
    ],
)
def test_wrong_usage_ends_with_2(folder: Path, words: list[str]):
    done = CliRunner().invoke(app, words, prog_name="diransac", catch_exceptions=False)
    assert (done.exit_code, done.stdout) == (2, "")
    assert "diransac" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["identify", "absent.csv", *MODEL],
        ["identify", ".", *MODEL],
        ["identify", "swim.csv", *MODEL, "--map", "x=absent"],
        ["identify", "swim.csv", *MODEL, "--from", "100"],
        ["identify", "swim.csv", *MODEL, "--despike", "absent"],
        ["identify", "swim.csv", *MODEL, "--shift", "absent=1"],
        ["identify", "swim.csv", *MODEL, "--bandwidth", "3"],
        ["identify", "swim.csv", *MODEL, "--resample", "0"],
        ["validate", "absent.json", "swim.csv"],
        ["inspect", "absent.csv"],
        ["models", "absent"],
    ],
)
def test_what_cannot_be_done_ends_with_1_and_a_short_message(folder: Path, words: list[str]):
    done = run(*words)
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ")
    assert "Traceback" not in done.stderr


def test_debug_shows_the_traceback_wherever_it_stands(folder: Path):
    for words in (["--debug", "inspect", "absent.csv"], ["inspect", "absent.csv", "--debug"]):
        with pytest.raises(dr.LogError):
            run(*words)


def test_interrupt_ends_with_130_and_one_line(folder: Path, monkeypatch: pytest.MonkeyPatch):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("diransac.cli.commands.identification.identify", interrupt)
    before = contents(folder)
    done = run("identify", "swim.csv", *MODEL, "-o", "model.json")
    assert (done.exit_code, done.stderr) == (130, "interrupted\n")
    assert contents(folder) == before


def test_an_error_that_nobody_foresaw_is_one_line(capsys: pytest.CaptureFixture[str]):
    cli = importlib.import_module("diransac.cli")
    cli._report_internal_error(KeyError, KeyError("x"), None)
    assert capsys.readouterr().err.count("\n") == 1


def test_the_module_is_the_command():
    done = subprocess.run([sys.executable, "-m", "diransac", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("diransac ")
