"""Control characters of files, names and errors: none of them reaches stdout, stderr or a bar of progress."""

import json
import re
import sqlite3
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, run, swim
from diransac.cli import rows as workers
from diransac.cli import screen
from diransac.identification.method import Progress
from diransac.plain_text import printable
from diransac.study import identify_each, load
from diransac.study.store import Store
from hostile import TEXTS, named
from studies import TINY_TOML, row, tiny

SOURCE = Path(dr.__file__).parent
HARMFUL = "".join(TEXTS[name] for name in ("escape", "c1", "delete", "bidirectional", "carriage return", "surrogate"))
OURS = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")
"""What Rich itself writes for a bar."""


def is_plain(text: str) -> bool:
    return all(line.isprintable() for line in text.split("\n"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Working directory with a log, and a result whose model, units and log have crafted names."""
    monkeypatch.chdir(tmp_path)
    t = 0.05 * np.arange(80)
    dr.Log.from_arrays(t, swim(t)).write("swim.csv")
    model = named(HARMFUL.encode("utf-8", "replace").decode().replace("\n", ""), ("x", "thrust", "mass", "drag"))
    result = dr.identify(model, dr.Log.from_arrays(t, swim(t)), "ols")
    result.save("model.json")
    return tmp_path


def test_only_two_functions_print_and_what_they_print_is_printable():
    printing = re.compile(r"\bprint\(|\b(?:typer|click)\.s?echo\(|\.print\(|std(?:out|err)\.write\(")
    found = {
        str(path.relative_to(SOURCE)): lines
        for path in SOURCE.rglob("*.py")
        if (lines := [line.strip() for line in path.read_text(encoding="utf-8").splitlines() if printing.search(line)])
    }
    assert found.keys() == {"cli/__init__.py", "cli/screen.py"}
    assert all("printable(" in line for lines in found.values() for line in lines)


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_json_on_stdout_is_printable_and_has_the_same_values(text, capsys):
    class Shown:
        def to_dict(self):
            return {text: [text]}

    screen.show(Shown(), as_json=True)
    out = capsys.readouterr().out
    assert is_plain(out)
    assert json.loads(out) == {text: [text]}


def test_a_result_with_control_characters_prints_none(folder):
    for words in (["validate", "model.json", "swim.csv", "--horizon", "1"], ["inspect", "swim.csv", *MODEL]):
        for done in (run(*words), run(*words, "--json"), run(*words, "-v")):
            assert done.exit_code == 0, done.stderr
            assert is_plain(done.stdout)
            assert is_plain(done.stderr)


@pytest.mark.parametrize(
    "words",
    [
        ["inspect", f"{HARMFUL}.csv"],
        ["identify", "swim.csv", "--model", HARMFUL],
        ["identify", "swim.csv", *MODEL, "--method", HARMFUL],
        ["export", "model.json", "-o", f"a.{HARMFUL}"],
        ["export", f"{HARMFUL}.json", "-o", "a.c"],
        [HARMFUL],
        ["inspect", f"--{HARMFUL}"],
    ],
    ids=lambda words: " ".join(words).replace(HARMFUL, "TEXT").replace("\0", ""),
)
def test_errors_print_no_control_characters_and_at_most_three_lines(folder, words):
    done = run(*words)
    assert done.exit_code in (1, 2)
    assert done.stdout == ""
    assert done.stderr.startswith("error: ")
    assert is_plain(done.stderr)


@pytest.mark.parametrize("words", [[], ["--debug"]], ids=["internal error", "traceback"])
def test_unexpected_errors_and_warnings_print_no_control_characters(tmp_path, words):
    script = tmp_path / "broken.py"
    script.write_text(
        "import sys, warnings\nfrom diransac import cli\nimport diransac.cli.commands as commands\n"
        "text = 'a\\x1b[2J\\x9bm\\ud800'\n"
        "def app():\n    warnings.warn(text)\n    raise RuntimeError(text)\n"
        "commands.app = app\ncli.main()\n"
    )
    done = subprocess.run([sys.executable, script, *words], capture_output=True, check=False)
    assert done.returncode == 1
    text = done.stderr.decode()
    assert is_plain(text)
    assert text.count(r"a\u001b[2J\u009bm\ud800") == 2


@pytest.mark.parametrize("terminal", [True, False], ids=["terminal", "pipe"])
def test_an_output_on_stdout_is_printable_on_a_terminal_and_whole_in_a_pipe(capfdbinary, monkeypatch, terminal):
    monkeypatch.setattr(screen, "is_terminal", lambda _: terminal)
    content = "a,\x9b2J\x1b\n1,2\n\ud800".encode("utf-8", "surrogatepass")
    screen.copy(content)
    out = capfdbinary.readouterr().out
    assert (out == content) is not terminal
    assert is_plain(out.decode()) if terminal else True


@pytest.mark.parametrize("how", ["bar", "lines", "stages", "rows", "rows in lines"])
def test_progress_prints_no_control_characters_and_no_markup(capsys, monkeypatch, how):
    monkeypatch.setattr(screen, "_FIRST_LINE", -1.0)
    monkeypatch.setenv("FORCE_COLOR", "1" if how in ("bar", "rows") else "")
    monkeypatch.setenv("COLUMNS", "400")
    text = HARMFUL + TEXTS["markup"]
    screen.begin(verbosity=1 if how == "stages" else 0)
    try:
        if how.startswith("rows"):
            with workers.running(text, Path(text), None, None) as arguments:
                arguments["progress"](1, 3)
                arguments["progress"](2, 3)
        else:
            with screen.bar(text) as show:
                show(Progress(text, 0.5, text))
    finally:
        screen.begin()
    shown = OURS.sub("", capsys.readouterr().err)
    assert is_plain(shown)
    assert printable(text.split("\n")[0])[:20] in shown
    assert TEXTS["markup"] in shown


# Lines ----------------------------------------------------------------------------------------------------------------
LINE = "m\nforged: usable"


def check_lines(*words: object) -> None:
    """No line of what a command prints begins within a text."""
    for more in ((), ("-v",), ("--debug",)):
        try:
            done = run(*words, *more)
        except dr.errors.DiransacError:
            assert more == ("--debug",)
            continue
        printed = (done.stdout + done.stderr).split("\n")
        assert not [line for line in printed if line.lstrip(" \"'").startswith("forged")], printed


def test_a_column_a_unit_and_a_file_name_stay_in_their_lines(folder):
    t = 0.05 * np.arange(80)
    file = f"{LINE}.npz"
    dr.Log(t, swim(t) | {LINE: t, "other": t}, {"x": LINE, LINE: LINE, "other": LINE}).write(file)
    Path("text.csv").write_text('t,x,"' + LINE + '"\n' + "".join(f'{x},{x},"{LINE}"\n' for x in t))
    for name in (file, "text.csv", f"no {LINE}.csv"):
        check_lines("inspect", name)
        check_lines("inspect", name, *MODEL)
        check_lines("map", name, *MODEL, "-o", f"{LINE}.toml")
        check_lines("identify", name, *MODEL, "--method", "ols", "-o", f"{LINE}.json")
        check_lines("validate", "model.json", name, "--horizon", "1")
        check_lines("export", "model.json", "-o", f"{LINE}.yaml")
        check_lines("identify", name, "swim.csv", *MODEL, "--method", "ols", "--each", "--store", f"{LINE}.db")
        check_lines("fleet", "status", f"{LINE}.db")
    assert list(dr.read_log(file).signals) == [*swim(t), LINE.replace("\n", r"\u000a"), "other"]


def test_texts_of_a_store_stay_in_their_lines(folder):
    with Store("a.db", load(tiny(trials=2))) as kept:
        kept.add([row(trial=0, status="failed", error=LINE), row(trial=1, method="true")])
    with closing(sqlite3.connect("a.db")) as connection, connection:
        connection.execute("UPDATE asked SET level = ?, method = ? WHERE rowid = 1", (LINE, LINE))
        connection.execute("UPDATE trials SET level = ?, method = ? WHERE rowid = 1", (LINE, LINE))
        connection.execute("UPDATE about SET value = ? WHERE key = 'name'", (json.dumps(LINE),))
    check_lines("study", "status", "a.db")
    check_lines("study", "report", "a.db", "-o", "a.html")


def test_texts_of_a_fleet_stay_in_their_lines(folder):
    model, logs = dr.models.underwater_vehicle(), ["swim.csv", "missing.csv"]
    identify_each(model, logs, "ols", store="a.db", executor=ThreadPoolExecutor(1))
    with closing(sqlite3.connect("a.db")) as connection, connection:
        connection.execute("UPDATE trials SET error = ? WHERE status = 'failed'", (LINE,))
        connection.execute("UPDATE asked SET vehicle = ?, time = ?", (LINE, LINE))
        for table in ("asked", "trials"):
            connection.execute(f"UPDATE {table} SET log = ? WHERE log = 'swim.csv'", (LINE,))
    for words in ("status a.db", "show a.db"):
        check_lines("fleet", *words.split())


def test_texts_of_a_result_and_of_options_stay_in_their_lines(folder):
    data = json.loads(Path("model.json").read_text())
    for log in data["logs"]:
        log["source"] = LINE
    Path("model.json").write_text(json.dumps(data))
    check_lines("validate", "model.json", "swim.csv", "--horizon", "1")
    check_lines("identify", "swim.csv", "--model", LINE)
    check_lines("identify", "swim.csv", *MODEL, "--method", LINE)
    check_lines(LINE)
    label = json.dumps(LINE)
    Path("a.toml").write_text(TINY_TOML.replace('"tiny"', label).replace("methods.ols", f"methods.{label}"))
    check_lines("study", "run", "a.toml", "--store", "b.db", "--levels", "no")
