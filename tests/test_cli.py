"""The command line: what it prints, what it writes, how it ends."""

import errno
import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import diransac as dr
from diransac.cli import arguments, outputs
from diransac.cli.commands import app

TRUE = {"mass": 50.0, "linear_drag": 12.0, "quadratic_drag": 30.0, "bias": 2.0}
MODEL = ["--model", "underwater-vehicle"]
# A search that takes a few milliseconds.
QUICK = ["--set", "max_iterations=20", "--set", "sample_size=20"]
NONLINEAR = """
from casadi import exp
from diransac import Model, Parameter
model = Model(
    name="bent", coordinates={"x": "m"}, inputs={"thrust": "N"},
    parameters={"mass": Parameter("kg", positive=True), "rate": Parameter("1")},
    equations=lambda q, v, a, u, p: [p.mass * a.x + exp(p.rate * v.x) - u.thrust],
)
other = 3
def make():
    return model
"""
HOVER = """
from diransac import Model, Parameter
model = Model(
    name="hover", coordinates={"x": "m"}, inputs={"thrust": "N"}, parameters={"mass": Parameter("kg", positive=True)},
    equations=lambda q, v, a, u, p: [p.mass * (a.x + 9.81) - u.thrust],
)
"""


def run(*words: object) -> Result:
    """Run a command line; an error that nobody foresaw fails the test."""
    done = CliRunner().invoke(app, [str(word) for word in words], prog_name="diransac", catch_exceptions=False)
    assert done.exit_code == 0 or len(done.stderr.splitlines()) <= 3, done.stderr
    return done


def swim(t: np.ndarray, frequency: float = 1.3) -> dict[str, np.ndarray]:
    """A vehicle that is made to follow x' = sin(w t): the thrust follows from the equation of motion."""
    x_dot, x_ddot = np.sin(frequency * t), frequency * np.cos(frequency * t)
    drag = TRUE["linear_drag"] * x_dot + TRUE["quadratic_drag"] * np.abs(x_dot) * x_dot
    thrust = TRUE["mass"] * x_ddot + drag + TRUE["bias"]
    return {"x": (1.0 - np.cos(frequency * t)) / frequency, "x_dot": x_dot, "x_ddot": x_ddot, "thrust": thrust}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with ``swim.csv`` and the model file ``bent.py``."""
    monkeypatch.chdir(tmp_path)
    t = np.arange(600) * 0.01
    dr.Log.from_arrays(t, swim(t)).write("swim.csv")
    (tmp_path / "bent.py").write_text(NONLINEAR)
    return tmp_path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# ---------------------------------------------------------------- identify


@pytest.mark.parametrize("method", dr.METHODS)
def test_identify_finds_the_true_parameters_by_every_method(folder: Path, method: str):
    done = run("identify", "swim.csv", *MODEL, "--method", method, *QUICK, "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == 0
    assert found["parameters"] == pytest.approx(TRUE, rel=1e-6)
    assert found["method"] == method


def test_identify_prints_and_saves_the_same_result(folder: Path):
    printed = run("identify", "swim.csv", *MODEL, "--seed", 7, *QUICK, "-o", "model.json")
    as_json = run("identify", "swim.csv", *MODEL, "--seed", 7, *QUICK, "--json")
    saved = dr.Result.load("model.json")
    assert printed.stdout.strip() == str(saved)
    assert json.loads(as_json.stdout)["parameters"] == dict(saved.parameters)
    assert saved.seed == 7
    assert printed.stderr == as_json.stderr == ""


def test_identify_prepares_the_log_as_it_is_told(folder: Path):
    t = np.arange(600) * 0.01
    clean = swim(t)
    spoilt = clean["thrust"].copy()
    spoilt[300] = 1e4
    columns = {"pos": clean["x"], "speed": clean["x_dot"], "x_ddot": clean["x_ddot"], "force_kN": spoilt / 1e3}
    dr.Log.from_arrays(t * 1e3, columns).write("raw.csv")
    done = run(
        *("identify", "raw.csv", *MODEL, "--method", "ols", "--json", "--from", "0.5", "--until", "5.5"),
        *("--map", "x=pos,x_dot=speed", "--map", "thrust=force_kN", "--scale", "t=0.001,thrust=1000"),
        *("--despike", "thrust"),
    )
    found = json.loads(done.stdout)
    assert found["parameters"] == pytest.approx(TRUE, rel=1e-3)
    assert [step["step"] for step in found["preparation"]][:3] == ["rename", "scale", "cut"]


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


def test_progress_is_shown_on_a_terminal_and_never_on_stdout(folder: Path, monkeypatch: pytest.MonkeyPatch):
    silent = run("identify", "swim.csv", *MODEL, *QUICK, "--json")
    monkeypatch.setenv("FORCE_COLOR", "1")
    shown = CliRunner().invoke(app, ["identify", "swim.csv", *MODEL, *QUICK, "--json"], catch_exceptions=False)
    assert shown.stdout == silent.stdout
    assert "i-diransac" in shown.stderr
    assert silent.stderr == ""


def test_same_seed_gives_the_same_bytes(folder: Path):
    for name in ("a.json", "b.json"):
        assert run("identify", "swim.csv", *MODEL, *QUICK, "--seed", 3, "-o", name).exit_code == 0
    assert Path("a.json").read_bytes() == Path("b.json").read_bytes()


# ---------------------------------------------------------------- settings


def test_settings_file_gives_way_to_what_is_set_on_the_command_line(folder: Path):
    Path("s.toml").write_text(
        'max-iterations = 30\nsample_size = 25\ninlier_thresholds = {x_dot = 0.5}\nrefit = "none"\n'
    )
    settings = arguments.load_settings(
        Path("s.toml"),
        ["sample-size=40", "inlier_thresholds.x_ddot=.25", "stop_inlier_fraction=none", "acceptance_weights=1,0.1"],
    )
    assert settings == dr.Settings(
        max_iterations=30,
        sample_size=40,
        inlier_thresholds={"x_dot": 0.5, "x_ddot": 0.25},
        stop_inlier_fraction=None,
        acceptance_weights=(1.0, 0.1),
        refit="none",
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("refit=none", {"refit": "none"}),
        ("threads=None", {"threads": None}),
        ("integrator=semi-implicit-euler", {"integrator": "semi-implicit-euler"}),
        ("error_weights={x_dot=1.0}", {"error_weights": {"x_dot": 1.0}}),
        ("initial_state=robust", {"initial_state": "robust"}),
        ("min-inlier-signals = 2", {"min_inlier_signals": 2}),
    ],
)
def test_set_reads_toml_values_bare_words_and_none(text: str, expected: dict[str, object]):
    assert arguments.load_settings(None, [text]) == dr.Settings(**expected)


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        ("max_iteration=3", 2, "max_iterations"),
        ("sample_size=0", 1, "sample_size"),
        ("sample_size", 2, "key=value"),
        ("=3", 2, "key=value"),
    ],
)
def test_set_refuses_what_it_cannot_mean(folder: Path, text: str, code: int, message: str):
    done = run("identify", "swim.csv", *MODEL, "--set", text)
    assert (done.exit_code, done.stdout) == (code, "")
    assert message in done.stderr


@pytest.mark.parametrize(
    "content", [None, b"sample_size = ", b"\xff\xfe", b"[[sample_size]]\na = 1", b"sample_sizes = 3"]
)
def test_settings_file_that_cannot_be_used_is_named(folder: Path, content: bytes | None):
    if content is not None:
        Path("s.toml").write_bytes(content)
    done = run("identify", "swim.csv", *MODEL, "--settings", "s.toml")
    assert done.exit_code == 1
    assert "s.toml" in done.stderr or "sample_size" in done.stderr


# ---------------------------------------------------------------- models


def test_model_file_serves_like_a_built_in_model(folder: Path):
    here = Path(__file__).resolve().parents[1] / "src/diransac/models/underwater_vehicle.py"
    Path("mine.py").write_text(here.read_text() + "\nboat = underwater_vehicle()\n")
    options = ["--method", "ols", "--json"]
    mine = run("identify", "swim.csv", "--model", "mine.py:boat", *options)
    built_in = run("identify", "swim.csv", "--model", "underwater_vehicle", *options)
    assert json.loads(mine.stdout)["parameters"] == json.loads(built_in.stdout)["parameters"]


def test_model_file_may_import_its_neighbours(folder: Path):
    Path("neighbour.py").write_text("NAME = 'model'\n")
    Path("near.py").write_text("from neighbour import NAME\n" + NONLINEAR)
    before = list(sys.path)
    done = run("models", "near.py", "--json")
    sys.modules.pop("neighbour")
    assert json.loads(done.stdout)["name"] == "bent"
    assert sys.path == before
    assert not list(folder.rglob("__pycache__"))


@pytest.mark.parametrize(
    ("spec", "content", "message"),
    [
        ("no-such-model", None, "planar-rotorcraft"),
        ("absent.py", None, 'model file "absent.py" does not exist'),
        ("bent.py:boat", None, "models found: model"),
        ("bent.py:other", None, "is of type int, not a Model"),
        ("bent.py:make", None, "call it there: model = make()"),
        ("broken.py", "x = 1\0", 'broken.py": SyntaxError'),
        ("broken.py", "x = 1\nx +\n", "line 2: SyntaxError"),
        ("broken.py", "x = 1\n\n1 / 0\n", "line 3: ZeroDivisionError"),
        ("broken.py", "import sys\nsys.exit(0)\n", "line 2: SystemExit"),
        ("broken.py", "class Odd(Exception): pass\nraise Odd('very')\n", "line 2: Odd: very"),
        ("broken.py", NONLINEAR.replace("exp(p.rate * v.x)", "p.speed"), "speed"),
    ],
)
def test_model_that_cannot_be_used_is_refused_by_name(folder: Path, spec: str, content: str | None, message: str):
    if content:
        Path("broken.py").write_text(content)
    done = run("identify", "swim.csv", "--model", spec)
    assert (done.exit_code, done.stdout) == (1, "")
    assert message in done.stderr


def test_models_lists_every_built_in_model_with_its_parameters(folder: Path):
    listed = run("models")
    as_json = json.loads(run("models", "--json").stdout)
    for name in dr.models.BUILTIN:
        assert name in listed.stdout
        assert as_json[name]["equations"]
    assert as_json["underwater-vehicle"]["parameters"]["mass"]["unit"] == "kg"


def test_models_shows_equations_bounds_and_units_of_one(folder: Path):
    shown = run("models", "underwater_vehicle").stdout
    assert "0 = " in shown
    assert "N s^2/m^2" in shown
    assert "0 < value" in shown


# ---------------------------------------------------------------- compare and validate


def test_compare_shows_every_method_and_why_one_refuses(folder: Path):
    t = np.arange(400) * 0.01
    v, a = np.sin(t), np.cos(t)
    thrust = 2.0 * a + np.exp(0.5 * v)
    dr.Log.from_arrays(t, {"x": 1.0 - np.cos(t), "x_dot": v, "x_ddot": a, "thrust": thrust}).write("bent.csv")
    options = ["bent.csv", "--model", "bent.py", *QUICK]
    methods = json.loads(run("compare", *options, "--json").stdout)["methods"]
    text = run("compare", *options).stdout
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
    assert "RMSE" in run("validate", "model.json", "held_out.csv", "--horizon", 0.5).stdout


@pytest.mark.parametrize("content", [None, b"", b"{}", b"\x00\xff", b'{"format": 1}'])
def test_validate_names_a_model_that_cannot_be_read(folder: Path, content: bytes | None):
    if content is not None:
        Path("model.json").write_bytes(content)
    done = run("validate", "model.json", "swim.csv")
    assert done.exit_code == 1
    assert "model.json" in done.stderr


# ---------------------------------------------------------------- inspect


def test_inspect_finds_what_was_planted(folder: Path):
    t = np.arange(600) * 0.01
    log = swim(t)
    log["x"][100:105] = np.nan
    log["x_dot"][200:250] = log["x_dot"][200]
    log["thrust"][[300, 400]] = 1e4
    dr.Log.from_arrays(t, log, units={"thrust": "N"}).write("odd.csv")
    found = json.loads(run("inspect", "odd.csv", "--json").stdout)
    signals = found["signals"]
    assert found["rate"] == pytest.approx(100.0)
    assert found["duration"] == pytest.approx(5.99)
    assert signals["x"]["n_missing"] == 5
    assert signals["x_dot"]["frozen"] == pytest.approx(0.5)
    assert signals["thrust"]["n_spikes"] == 2
    assert signals["x_ddot"]["n_spikes"] == signals["x_ddot"]["n_missing"] == 0
    assert signals["x_ddot"]["maximum"] == pytest.approx(1.3, abs=1e-3)
    text = run("inspect", "odd.csv").stdout.splitlines()
    assert text[1].split() == ["signal", "unit", "minimum", "maximum", "std", "NaN", "spikes", "frozen", "s"]
    assert next(line for line in text if line.startswith("x_dot ")).split()[-1] == "0.5"


def test_inspect_says_what_is_missing_and_what_can_be_derived(folder: Path):
    t = np.arange(600) * 0.01
    log = swim(t)
    dr.Log.from_arrays(t, {"x": log["x"], "force": log["thrust"]}).write("bare.csv")
    bare = json.loads(run("inspect", "bare.csv", *MODEL, "--json").stdout)["fitness"]
    named = json.loads(run("inspect", "bare.csv", *MODEL, "--map", "thrust=force", "--json").stdout)["fitness"]
    assert set(bare["missing"]) == {"x_dot", "x_ddot", "thrust"}
    assert "thrust" not in bare["derivable"]
    assert set(named["missing"]) == set(named["derivable"]) == {"x_dot", "x_ddot"}
    assert "--differentiate" in run("inspect", "bare.csv", *MODEL, "--map", "thrust=force").stdout


def test_inspect_says_which_parameters_the_motion_shows(folder: Path):
    lively = json.loads(run("inspect", "swim.csv", *MODEL, "--json").stdout)["fitness"]
    t = np.arange(600) * 0.01
    steady = {"x": 0.5 * t, "x_dot": np.full_like(t, 0.5), "x_ddot": 0 * t, "thrust": np.full_like(t, 15.5)}
    dr.Log.from_arrays(t, steady).write("steady.csv")
    dull = json.loads(run("inspect", "steady.csv", *MODEL, "--json").stdout)["fitness"]
    assert lively["verdicts"] == dict.fromkeys(TRUE, "well")
    assert lively["excitation"]["mass"]["estimate"] == pytest.approx(TRUE["mass"], rel=1e-6)
    assert set(dull["verdicts"].values()) == {"not"}
    assert "mass" in dull["verdicts"]
    assert "is missing" in dull["reason"]


def test_inspect_doubts_an_estimate_from_a_log_with_spikes(folder: Path):
    t = np.arange(600) * 0.01
    log = swim(t)
    log["thrust"][np.random.default_rng(0).choice(600, 60, replace=False)] += 500.0
    dr.Log.from_arrays(t, log).write("spiky.csv")
    spiky = json.loads(run("inspect", "spiky.csv", *MODEL, "--json").stdout)["fitness"]
    clean = json.loads(run("inspect", "swim.csv", *MODEL, "--json").stdout)["fitness"]
    assert "spikes in thrust" in spiky["caveat"]
    assert spiky["caveat"] in run("inspect", "spiky.csv", *MODEL).stdout
    assert clean["caveat"] == ""


def test_inspect_agrees_with_identify_that_nothing_moves(folder: Path):
    Path("hover.py").write_text(HOVER)
    rest = {"x": np.zeros(600), "x_dot": np.zeros(600), "x_ddot": np.zeros(600), "thrust": np.full(600, 9.81)}
    dr.Log.from_arrays(np.arange(600) * 0.01, rest).write("rest.csv")
    fitness = json.loads(run("inspect", "rest.csv", "--model", "hover.py", "--json").stdout)["fitness"]
    refused = run("identify", "rest.csv", "--model", "hover.py", "--method", "ols")
    assert (fitness["excitation"], refused.exit_code) == ({}, 1)
    assert "nothing moves" in fitness["reason"]
    assert "nothing moves" in refused.stderr


def test_inspect_shows_a_log_whose_clock_is_uneven(folder: Path):
    t = np.arange(600) * 0.01
    t[300:] += 1.0
    dr.Log.from_arrays(np.arange(600) * 0.01, swim(t)).write("even.csv")
    rows = Path("even.csv").read_text().splitlines()
    clock = [f"{now!r},{row.split(',', 1)[1]}" for now, row in zip(t.tolist(), rows[1:], strict=True)]
    Path("gap.csv").write_text("\n".join([rows[0], *clock]) + "\n")
    found = json.loads(run("inspect", "gap.csv", "--json").stdout)
    assert run("identify", "gap.csv", *MODEL).exit_code == 1
    assert any("gap" in note for note in found["notes"])
    assert found["signals"]["x"]["n_missing"] > 90


def test_inspect_shows_numbers_whose_squares_overflow(folder: Path):
    t = np.arange(600) * 0.01
    dr.Log.from_arrays(t, {"x": 1e200 * np.sin(t), "y": 0 * t, "z": np.sin(t)}).write("huge.csv")
    signals = json.loads(run("inspect", "huge.csv", "--json").stdout)["signals"]
    assert signals["x"]["standard_deviation"] == pytest.approx(1e200 * np.sin(t).std())
    assert signals["y"]["standard_deviation"] == 0.0
    assert signals["z"]["standard_deviation"] == pytest.approx(np.sin(t).std())


# ---------------------------------------------------------------- outputs


@pytest.mark.parametrize("existing", [None, b"mine"])
def test_a_failing_command_leaves_outputs_as_they_were(folder: Path, existing: bytes | None):
    if existing:
        Path("model.json").write_bytes(existing)
    before = contents(folder)
    done = run("identify", "swim.csv", *MODEL, "--set", "sample_size=5000", "-o", "model.json", "--report", "page.html")
    assert done.exit_code == 1
    assert contents(folder) == before


def test_outputs_stay_as_they_were_where_the_result_cannot_be_printed(folder: Path, monkeypatch: pytest.MonkeyPatch):
    def show(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("diransac.cli.screen.show", show)
    before = contents(folder)
    found = run("identify", "swim.csv", *MODEL, *QUICK, "-o", "model.json", "--report", "page.html")
    compared = run("compare", "swim.csv", *MODEL, "--methods", "ols", "--report", "page.html")
    assert found.exit_code == compared.exit_code == 1
    assert "No space left" in found.stderr
    assert contents(folder) == before


def test_outputs_take_their_places_together_or_not_at_all(folder: Path):
    Path("a.json").write_text("old")

    def write(failure: type[Exception] | None) -> None:
        with outputs.staged([Path("a.json"), Path("b.html"), None]) as (a, b, _):
            a.write_text("new")
            b.write_text("new")
            if failure:
                raise failure

    with pytest.raises(OverflowError):
        write(OverflowError)
    assert Path("a.json").read_text() == "old"
    assert not Path("b.html").exists()
    write(None)
    assert Path("a.json").read_text() == Path("b.html").read_text() == "new"
    assert set(contents(folder)) == {"swim.csv", "bent.py", "a.json", "b.html"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["-o", "nowhere/model.json"], "does not exist"),
        (["-o", "swim.csv"], "reads"),
        (["-o", "s.toml", "--settings", "s.toml"], "reads"),
        (["--report", "bent.py", "--model", "bent.py"], "reads"),
        (["-o", "./bent.py", "--model", "bent.py:other"], "reads"),
        (["-o", "."], "not an ordinary file"),
        (["-o", "same", "--report", "./same"], "two outputs"),
        (["-o", 250 * "x" + ".json"], f'{250 * "x"}.json" cannot be written: File name too long'),
    ],
)
def test_outputs_are_checked_before_the_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
):
    monkeypatch.setattr("diransac.cli.commands.identify", lambda *_, **__: pytest.fail("the work has begun"))
    Path("s.toml").write_text("sample_size = 20\n")
    before = contents(folder)
    done = run("identify", "swim.csv", *MODEL, *words)
    assert done.exit_code == 1
    assert message in done.stderr
    assert contents(folder) == before


def test_report_is_one_page(folder: Path):
    done = run("identify", "swim.csv", *MODEL, *QUICK, "--report", "page.html")
    both = run("compare", "swim.csv", *MODEL, *QUICK, "--methods", "ols,i-diransac", "--report", "both.html")
    assert done.exit_code == both.exit_code == 0
    for page in ("page.html", "both.html"):
        assert "quadratic_drag" in Path(page).read_text()


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

    monkeypatch.setattr("diransac.cli.commands.identify", interrupt)
    before = contents(folder)
    done = run("identify", "swim.csv", *MODEL, "-o", "model.json")
    assert (done.exit_code, done.stderr) == (130, "interrupted\n")
    assert contents(folder) == before


def test_an_error_that_nobody_foresaw_is_one_line(capsys: pytest.CaptureFixture[str]):
    cli = importlib.import_module("diransac.cli")
    cli._say_that_it_is_our_fault(KeyError, KeyError("x"), None)
    assert capsys.readouterr().err.count("\n") == 1


def test_the_module_is_the_command():
    done = subprocess.run([sys.executable, "-m", "diransac", "--version"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("diransac ")
