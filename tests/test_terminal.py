"""Control characters of files, names and errors: none of them reaches stdout, stderr or a bar of progress."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, run, swim
from diransac.cli import screen, workers
from diransac.identification.method import Progress
from diransac.plain_text import printable
from hostile import TEXTS, named

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
    model = named(HARMFUL.encode("utf-8", "replace").decode(), ("x", "thrust", "mass", "drag"))
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
        ["inspect", "swim.csv", "--config", HARMFUL],
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
    screen.set_verbosity(1 if how == "stages" else 0)
    try:
        if how.startswith("rows"):
            with workers.running(text, Path(text), None, None) as arguments:
                arguments["progress"](1, 3)
                arguments["progress"](2, 3)
        else:
            with screen.bar(text) as show:
                show(Progress(text, 0.5, text))
    finally:
        screen.set_verbosity(0)
    shown = OURS.sub("", capsys.readouterr().err)
    assert is_plain(shown)
    assert printable(text.split("\n")[0])[:20] in shown
    assert TEXTS["markup"] in shown
