"""``diransac study``: what it prints, writes and refuses."""

import json
import re
import tomllib
from functools import partial
from pathlib import Path

import polars as pl
import pytest
from rich.console import Console

from command_line import contents, run, run_both
from diransac.cli.rows import _bar
from diransac.study import builtin_names, load, template
from studies import TINY_TOML, rows

QUICK = ["--store", "a.db", "--jobs", 1, "--trials", 1]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trials_in_this_process: None) -> Path:
    """Working directory with a study in it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY_TOML)
    return tmp_path


@pytest.fixture(scope="module")
def listed() -> tuple[str, dict]:
    """What ``diransac study list`` prints, as text and as JSON."""
    with pytest.MonkeyPatch.context() as patched:
        return run_both(patched, "study", "list")


def test_list_shows_every_study_and_every_method(listed: tuple[str, dict]):
    text, as_json = listed
    assert all(name in text for name in (*builtin_names(), "true, ols", "i-diransac"))
    assert load(as_json["studies"]["fig4"]) == load("fig4")


def test_list_names_the_methods_of_every_study(listed: tuple[str, dict]):
    lines = listed[0].splitlines()
    named = [line.removeprefix("methods of ").split(": ") for line in lines if line.startswith("methods of ")]
    methods_of = {name: methods for names, methods in named for name in names.split(", ")}
    assert methods_of == {name: ", ".join(load(name).methods) for name in builtin_names()}


def test_new_writes_a_study_and_never_over_another(folder: Path):
    assert run("study", "new", "mine.toml").exit_code == 0
    assert load("mine.toml") == load(tomllib.loads(template()))
    (folder / "mine.toml").write_text("changed")
    done = run("study", "new", "mine.toml")
    assert (done.exit_code, done.stderr) == (1, 'error: "mine.toml" is there already; give another name\n')
    assert (folder / "mine.toml").read_text() == "changed"
    assert run("study", "new", "mine.txt").exit_code == 2


def test_run_prints_the_status_that_status_prints(folder: Path):
    done = run("study", "run", "tiny.toml", *QUICK, "--levels", "0,40")
    assert done.exit_code == 0
    assert done.stderr == ""
    assert "tiny in a.db: 4 done, 0 failed, 0 missing of 4 rows" in done.stdout
    assert run("study", "status", "a.db").stdout == done.stdout
    shown = json.loads(run("study", "status", "a.db", "--json").stdout)
    assert (shown["done"], [cell["level"] for cell in shown["cells"]]) == (4, ["0", "0", "40", "40"])


def test_run_goes_on_with_what_is_missing(folder: Path):
    assert run("study", "run", "tiny.toml", *QUICK, "--levels", "40", "--methods", "ols").exit_code == 0
    before = rows(folder / "a.db")
    done = run("study", "run", "tiny.toml", "--store", "a.db", "--jobs", 1)
    assert "8 done" in done.stdout
    after = rows(folder / "a.db")
    assert {key: after[key] for key in before} == before


def test_set_changes_what_is_run_and_a_store_keeps_to_one_configuration(folder: Path):
    run("study", "run", "tiny.toml", *QUICK, "--methods", "true", "--set", "plant.parameters.mass=0.3")
    assert {row["parameter_mass"] for row in rows(folder / "a.db").values()} == {0.3}
    before = contents(folder)
    done = run("study", "run", "tiny.toml", *QUICK)
    assert done.exit_code == 1
    assert "plant.parameters.mass is 0.3 in the store, 0.249 was asked for" in done.stderr
    assert contents(folder) == before


def test_a_bare_word_is_a_value(folder: Path):
    done = run("study", "run", "fig3", "--store", "a.db", "--set", "plant.convention=imperial")
    assert done.exit_code == 1
    assert "convention is 'imperial'; choose physical or printed" in done.stderr
    assert not (folder / "a.db").exists()


def test_export_writes_rows(folder: Path):
    run("study", "run", "tiny.toml", *QUICK, "--levels", "40")
    for kind, read in (("csv", pl.read_csv), ("parquet", pl.read_parquet)):
        assert run("study", "export", "a.db", "--to", kind, "-o", f"a.{kind}").exit_code == 0
        assert read(f"a.{kind}")["method"].to_list() == ["true", "ols"]
    before = contents(folder)
    for output, code in (("a.db", 1), ("none/a.csv", 1)):
        assert run("study", "export", "a.db", "--to", "csv", "-o", output).exit_code == code
    assert run("study", "export", "a.db", "--to", "xls", "-o", "a.xls").exit_code == 2
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["run", "fig9", *QUICK], 1, 'study "fig9": there is none of that name; there are fig2'),
        (["run", "tiny.toml", *QUICK, "--levels", "some"], 1, 'no level "some"'),
        (["run", "tiny.toml", *QUICK, "--methods", "tls"], 1, 'no method "tls"; there are true, ols'),
        (["run", "tiny.toml", *QUICK, "--methods", ","], 2, "--methods: nothing is named"),
        (["run", "tiny.toml", *QUICK, "--set", "seed"], 2, "'seed' is not key=value"),
        (["run", "tiny.toml", *QUICK, "--set", "a..b=3"], 2, "'a..b=3' is not key=value"),
        (["run", "tiny.toml", *QUICK, "--cluster", "tcp://a:1"], 2, "--jobs sets the processes of this machine"),
        (["run", "tiny.toml", "--store", "a.db", "--trials", 0], 2, "--trials"),
        (["run", "tiny.toml"], 2, "--store"),
        (["plot", "a.db", "-o", "a.jpg"], 1, 'cannot write "a.jpg": its ending is not known; use one of .png'),
        (["run", "tiny.toml", "--store", "none/a.db"], 1, "cannot be opened"),
        (["status", "none.db"], 1, 'store "none.db" does not exist'),
        (["status", "tiny.toml"], 1, "file is not a database"),
        (["export", "none.db", "--to", "csv", "-o", "a.csv"], 1, 'store "none.db" does not exist'),
    ],
)
def test_what_cannot_be_done_is_said_in_a_line_and_leaves_nothing(
    words: list[object], code: int, message: str, folder: Path
):
    before = contents(folder)
    done = run("study", *words)
    assert (done.exit_code, done.stdout) == (code, "")
    assert message in " ".join(done.stderr.split())
    assert contents(folder) == before


def test_from_the_first_rows_on_a_terminal_sees_rate_and_time_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    seconds = [0.0]
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr("rich.console.Console", partial(Console, get_time=lambda: seconds[0]))
    with _bar("tiny") as show:
        show(2, 8)
        seconds[0] = 300.0
        show(4, 8)
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
    assert "4/8 rows, 0.4/min 0:10:00" in shown


def test_a_terminal_sees_how_far_a_run_is(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    done = run("study", "run", "tiny.toml", *QUICK, "--json")
    assert json.loads(done.stdout)["done"] == 4
    assert "4/4" in done.stderr or "2/4" in done.stderr
    assert "rows" in done.stderr
