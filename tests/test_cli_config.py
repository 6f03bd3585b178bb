"""The command line: configuration files, standard input and output, and how much is printed."""

import json
from pathlib import Path

import pytest

import diransac as dr
from command_line import FEW, MODEL, run, working_folder
from diransac.cli import screen
from diransac.cli.workers import running

QUICKEST = ["--method", "ols"]


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return working_folder(tmp_path, monkeypatch)


def test_options_and_logs_of_a_configuration_are_those_of_the_command_line():
    words = ["--method", "i-diransac", *FEW, "--seed", "3", "--map", "x=x,thrust=thrust"]
    told = run("identify", "swim.csv", *MODEL, *words, "--json")
    Path("c.toml").write_text(
        """
        model = "underwater-vehicle"
        map = { x = "x", thrust = "thrust" }
        set = { max_iterations = 20, sample_size = 20 }
        [identify]
        log = ["swim.csv"]
        method = "i-diransac"
        seed = 3
        json = true
        """
    )
    assert run("identify", "--config", "c.toml").stdout == told.stdout
    ols = json.loads(run("identify", "--config=c.toml", "--method", "ols", "--set", "min_inlier_signals=1").stdout)
    assert ols["method"] == "ols"  # the command line wins


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('modle = "a"', 'no command has an option "modle"; did you mean model?'),
        ('[identify]\nmethd = "ols"', 'identify has no option "methd"; did you mean method?'),
        ("differentiate = 1", "differentiate is 1; it is true or false"),
        ("identify = 1", "identify is 1; give a table"),
        ("model = ", "is not TOML"),
    ],
)
def test_a_wrong_configuration_is_one_sentence(text: str, says: str):
    Path("c.toml").write_text(text)
    done = run("identify", "swim.csv", *MODEL, "--config", "c.toml")
    assert (done.exit_code, done.stdout, len(done.stderr.splitlines())) == (1, "", 1)
    assert says in done.stderr


def test_a_configuration_may_have_options_of_groups_that_the_command_is_none_of():
    Path("c.toml").write_text('trials = 2\n[study.run]\nstore = "s.db"\n[fleet.export]\noutput = "rows.csv"\n')
    assert run("identify", "swim.csv", *MODEL, *QUICKEST, "--config", "c.toml").exit_code == 0
    Path("c.toml").write_text("[study.run]\ntirals = 2\n")
    wrong = run("identify", "swim.csv", *MODEL, *QUICKEST, "--config", "c.toml")
    assert 'study run has no option "tirals"; did you mean trials?' in wrong.stderr


def test_a_log_from_stdin_and_a_result_on_stdout_are_those_of_files():
    run("identify", "swim.csv", *MODEL, *QUICKEST, "-o", "model.json")
    piped = run("identify", "-", *MODEL, *QUICKEST, "-o", "-", stdin=Path("swim.csv").read_bytes())
    Path("piped.json").write_text(piped.stdout)  # nothing else is there
    assert dr.Result.load("piped.json").parameters == dr.Result.load("model.json").parameters
    assert "from standard input" in piped.stderr
    predicted = run("predict", "model.json", "swim.csv", "-o", "-")
    Path("piped.csv").write_text(predicted.stdout)
    run("predict", "model.json", "swim.csv", "-o", "file.csv")
    assert Path("piped.csv").read_bytes() == Path("file.csv").read_bytes()
    assert "wrote -" in predicted.stderr


def test_two_results_on_stdout_and_other_outputs_there_are_refused():
    both = run("identify", "swim.csv", *MODEL, *QUICKEST, "-o", "-", "--json")
    page = run("identify", "swim.csv", *MODEL, *QUICKEST, "--report", "-")
    nothing = run("identify", "-", *MODEL, *QUICKEST, stdin=b"")
    assert (both.exit_code, page.exit_code, nothing.exit_code) == (2, 2, 1)
    assert both.stdout + page.stdout + nothing.stdout == ""
    assert not Path("-").exists()


def test_quiet_prints_nothing_and_verbose_every_stage():
    words = ["identify", "swim.csv", *MODEL, *QUICKEST]
    quiet, plain, verbose = run("-q", *words), run(*words), run(*words, "-v")
    assert (quiet.exit_code, quiet.stdout, quiet.stderr) == (0, "", "")
    assert verbose.stdout == plain.stdout
    assert len(verbose.stderr.splitlines()) > len(plain.stderr.splitlines())


def test_quiet_shows_no_progress_of_rows(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # a bar, from the first row on
    try:
        for level, shown in ((-1, False), (0, True)):
            screen.set_verbosity(level)
            with running("3 logs", Path("fleet.db"), 1, None) as how:
                how["progress"](1, 3)
                how["progress"](3, 3)
            assert bool(capsys.readouterr().err) is shown
    finally:
        screen.set_verbosity(0)
