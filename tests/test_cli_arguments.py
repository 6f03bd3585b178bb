"""The command line: settings and models as they are typed."""

import json
import sys
from pathlib import Path

import pytest

import diransac as dr
from command_line import FEW, MODEL, NONLINEAR, run, working_folder
from diransac.cli import arguments


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return working_folder(tmp_path, monkeypatch)


# ---------------------------------------------------------------- settings


def test_settings_file_gives_way_to_what_is_set_on_the_command_line(folder: Path):
    Path("s.toml").write_text(
        'max-iterations = 30\nsample_size = 25\ninlier_thresholds = {x_dot = 0.5}\nrefit = "none"\n'
    )
    settings = arguments.load_settings(
        Path("s.toml"),
        ["sample-size=40", "inlier_thresholds.x_ddot=.25", "stop_inlier_fraction=none", "acceptance_weights=1,0.1"],
    )
    assert dr.Settings.from_dict(settings) == dr.Settings(
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
    assert arguments.load_settings(None, [text]) == expected


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
    done = run("identify", "swim.csv", *MODEL, "--method", "i-diransac", "--set", text)
    assert (done.exit_code, done.stdout) == (code, "")
    assert message in done.stderr


@pytest.mark.parametrize(
    ("content", "code"),
    [
        (None, 1),
        (b"sample_size = ", 1),
        (b"\xff\xfe", 1),
        (b"[[sample_size]]\na = 1", 1),
        (b"sample_sizes = 3", 2),
    ],
)
def test_settings_file_that_cannot_be_used_is_refused_by_name(folder: Path, content: bytes | None, code: int):
    if content is not None:
        Path("s.toml").write_bytes(content)
    done = run("identify", "swim.csv", *MODEL, "--method", "i-diransac", "--settings", "s.toml")
    assert (done.exit_code, done.stdout) == (code, "")
    assert "s.toml" in done.stderr or "sample_size" in done.stderr


@pytest.mark.parametrize(
    "words",
    [
        ["identify", "swim.csv", "--method", "ols", "--set", "sample_size=50"],
        ["identify", "swim.csv", "--method", "lo-diransac", "--set", "sample_size=50"],
        ["compare", "swim.csv", "--methods", "ols,tls", "--set", "sample_size=50"],
        ["cross-validate", "swim.csv", "swim.csv", "--method", "ols", "--set", "sample_size=50"],
    ],
)
def test_a_setting_that_no_method_uses_is_refused(folder: Path, words: list[str]):
    done = run(*words, *MODEL)
    assert (done.exit_code, done.stdout) == (2, "")
    assert 'no setting "sample_size"' in done.stderr.splitlines()[0]


@pytest.mark.parametrize(("typed", "meant"), [("substep", "substeps"), ("n_sample", "n_samples")])
def test_a_misspelt_setting_is_answered_with_the_nearest_alone(folder: Path, typed: str, meant: str):
    done = run("identify", "swim.csv", "--set", f"{typed}=3", *MODEL)
    assert (done.exit_code, done.stdout) == (2, "")
    assert f'no setting "{typed}"; did you mean {meant}?' in " ".join(done.stderr.split())
    assert "smoothing_half_width" not in done.stderr


def test_a_method_s_own_setting_is_used_and_reported(folder: Path):
    words = ["identify", "swim.csv", *MODEL, "--json"]
    said, usual = (json.loads(run(*words, *more).stdout) for more in (["--set", "substeps=10"], []))
    assert said["options"]["substeps"] == 10
    assert {name for name in usual["options"] if usual["options"][name] != said["options"][name]} == {"substeps"}


def test_compare_gives_each_method_the_settings_that_it_uses(folder: Path):
    done = run("compare", "swim.csv", *MODEL, "--methods", "ols,i-diransac", *FEW, "--json")
    methods = json.loads(done.stdout)["methods"]
    assert done.exit_code == 0
    assert methods["i-diransac"]["settings"]["sample_size"] == 20
    assert methods["ols"]["settings"]["sample_size"] == dr.Settings().sample_size


# ---------------------------------------------------------------- models


def test_model_file_serves_like_a_built_in_model(folder: Path):
    source = Path(dr.models.underwater_vehicle.__code__.co_filename).read_text()
    Path("mine.py").write_text(source + "\nboat = underwater_vehicle()\n")
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


def test_completion_is_installed_by_the_command_itself_and_by_no_part_of_it():
    assert "--install-completion" in run("--help").stdout
    assert "completion" not in run("study", "--help").stdout
