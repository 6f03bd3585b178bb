"""The command line: standard input and output, and how much is printed."""

from pathlib import Path

import pytest

import diransac as dr
from command_line import MODEL, run, working_folder
from diransac.cli import screen
from diransac.cli.rows import running

QUICKEST = ["--method", "ols"]


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return working_folder(tmp_path, monkeypatch)


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
            screen.begin(verbosity=level)
            with running("3 logs", Path("fleet.db"), 1, None) as how:
                how["progress"](1, 3)
                how["progress"](3, 3)
            assert bool(capsys.readouterr().err) is shown
    finally:
        screen.begin()
