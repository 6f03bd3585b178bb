"""The command line: files that it writes, complete or not at all."""

import errno
import html
import shlex
from pathlib import Path

import pytest

from command_line import FEW, MODEL, QUICK, contents, run, working_folder
from diransac.cli import outputs


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return working_folder(tmp_path, monkeypatch)


@pytest.mark.parametrize("existing", [None, b"mine"])
def test_a_failing_command_leaves_outputs_as_they_were(folder: Path, existing: bytes | None):
    if existing:
        Path("model.json").write_bytes(existing)
    before = contents(folder)
    words = ("--method", "i-diransac", "--set", "sample_size=5000", "-o", "model.json", "--report", "page.html")
    done = run("identify", "swim.csv", *MODEL, *words)
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
        (["-o", "s.toml", "--settings", "s.toml", "--method", "i-diransac"], "reads"),
        (["--report", "bent.py", "--model", "bent.py"], "reads"),
        (["-o", "./bent.py", "--model", "bent.py:other"], "reads"),
        (["-o", "."], "not an ordinary file"),
        (["-o", "same", "--report", "./same"], "two outputs"),
        (["-o", "model.yaml"], '"model.yaml" does not end in .json, the format that is written'),
        (["--report", "page.pdf"], '"page.pdf" does not end in .html or .htm, the format that is written'),
        (["-o", 251 * "x" + ".json"], f"{251 * 'x'}.json: File name too long"),
    ],
)
def test_outputs_are_checked_before_the_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
):
    monkeypatch.setattr(
        "diransac.cli.commands.identification.identify", lambda *_, **__: pytest.fail("the work has begun")
    )
    Path("s.toml").write_text("sample_size = 20\n")
    before = contents(folder)
    done = run("identify", "swim.csv", *MODEL, *words)
    assert done.exit_code == 1
    assert message in done.stderr
    assert contents(folder) == before


def test_report_is_one_page(folder: Path):
    done = run("identify", "swim.csv", *MODEL, *QUICK, "--report", "page.html")
    both = run("compare", "swim.csv", *MODEL, *FEW, "--methods", "ols,i-diransac", "--report", "both.html")
    assert done.exit_code == both.exit_code == 0
    for page in ("page.html", "both.html"):
        assert "quadratic_drag" in Path(page).read_text()
    words = shlex.join(["diransac", "identify", "swim.csv", *MODEL, *QUICK, "--report", "page.html"])
    assert f"<code>{html.escape(words)}</code>" in Path("page.html").read_text()
