r"""README.md, CONTRIBUTING.md and docs/, run as they are shown.

A page runs from top to bottom in a folder of its own, with ``examples/`` inside and the real logs in
``../shared/data``, of which the longest are cut short:

- every ``python`` block, in one namespace per page;
- a ``python`` or ``toml`` block whose first line is a comment that names a file (``# rover.py``) is written to that
  file;
- in every ``console`` block, each ``$ diransac ...`` line in this process, trials of its studies included, and each
  ``$ python ...`` line in its own; both may be continued over ``\`` at a line's end. Lines of `NOT_RUN` are shown only;
- every ``text`` block is what the block before it printed (`printed` has the rules of the comparison), or it shows
  commands that are not run here, each behind a ``$``. What those print is shown only of the commands of `LONG`.
  Formulas, diagrams and code of other languages have a fence without a language.

``make docs-printed`` writes today's output into the pages.
"""

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import documented
import pytest
from printed import disagreement, renewed
from typer.testing import CliRunner

from diransac.cli.commands import app

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED = REPOSITORY.parent / "shared" / "data"
AXIS, PENDULUM = "emps/DATA_EMPS.csv", "dfki_double_pendulum"
"""Logs that are cut short."""
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
NOT_RUN = {"cd", "git", "make", "pip"}
NEEDS = {"robots.md": "mujoco", "logs.md": "mcap", "tutorial.md": "mcap"}
"""Package without which a page is not run."""
LANGUAGES = {"", "python", "console", "text", "toml", "json", "yaml", "csv", "mermaid"}
LONG = {"python benchmarks/fleet.py": "200 identifications", "python benchmarks/kills.py": "200 processes"}
"""Commands whose output is shown but takes too long for a test, and why; ``make docs-figures`` compares it."""
RENEWED = "RENEW_PAGES" in os.environ
"""Whether output is written into the pages, not compared with them."""


@dataclass(frozen=True)
class Block:
    """One fenced block: the language and what follows it on the fence, the body, and the body's first line number."""

    info: str
    body: str
    line: int


def blocks(text: str) -> Iterator[Block]:
    """Every fenced block of a page, in order."""
    for match in re.finditer(r"^( *)```([^\n`]*)\n(.*?)^\1```[ ]*$", text, re.DOTALL | re.MULTILINE):
        indent, info, body = match.groups()
        line = text.count("\n", 0, match.start(3)) + 1
        yield Block(info.strip(), re.sub(f"^{indent}", "", body, flags=re.MULTILINE), line)


def commands(body: str) -> list[list[str]]:
    """Every ``$`` line of a console block, split as a shell does; what the commands print is skipped."""
    joined = re.sub(r"\\\n", " ", body)
    return [shlex.split(line[2:], comments=True) for line in joined.splitlines() if line.startswith("$ ")]


def run_command(command: list[str], folder: Path) -> str:
    """Run one command line of a page in its folder, the working directory, and return what it prints."""
    program, *arguments = command
    if program in NOT_RUN:
        return ""
    assert program in {"diransac", "python"}, f"{shlex.join(command)}: this cannot be run; show it in a text block"
    if program == "diransac":
        assert folder == Path.cwd()
        done = CliRunner().invoke(app, arguments, prog_name=program, catch_exceptions=False)
        code = done.exit_code
    else:
        words = [sys.executable, *arguments]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=600, check=False)
        code = done.returncode
    assert code == 0, f"{shlex.join(command)}: exit code {code}\n{done.stdout}{done.stderr}"
    return done.stdout


def write_named(block: Block, folder: Path) -> None:
    """Write a block to the file that its first line names, if it names one."""
    named = re.match(rf"# ([\w-]+\.{'py' if block.info == 'python' else 'toml'})\n", block.body)
    if named:
        (folder / named[1]).write_text(block.body)


def run_python(block: Block, page: Path, namespace: dict[str, object]) -> str:
    """Run one Python block, with the page's own line numbers in a traceback, and return what it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        exec(compile("\n" * (block.line - 1) + block.body, str(page), "exec"), namespace)
    return out.getvalue()


def run_blocks(found: list[Block], page: Path, folder: Path) -> dict[Block, str]:
    """Run the blocks of a page from top to bottom, and return what each printed."""
    namespace: dict[str, object] = {"__name__": "__page__"}
    printed = dict[Block, str]()
    for block in found:
        if "../shared/" in block.body and block.info in {"python", "console"} and not SHARED.is_dir():
            pytest.skip(f"{page.name} NOT CHECKED from line {block.line} on: {SHARED} is missing")
        if block.info in {"python", "toml"}:
            write_named(block, folder)
        if block.info == "python":
            printed[block] = run_python(block, page, namespace)
        if block.info == "console":
            printed[block] = "".join(run_command(command, folder) for command in commands(block.body))
    return printed


def outputs(found: list[Block]) -> Iterator[tuple[Block, Block]]:
    """Each block that shows output, and the block that printed it."""
    for before, block in pairwise(found):
        if block.info == "text" and not block.body.startswith("$ "):
            yield before, block


def write_output(page: Path, block: Block, body: str) -> None:
    """Write another body into a block of a page; blocks before it keep their lines."""
    lines, first = page.read_text().splitlines(keepends=True), block.line - 1
    indent = re.match(" *", lines[first - 1])[0]
    lines[first : first + block.body.count("\n")] = [textwrap.indent(body, indent)]
    page.write_text("".join(lines))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trials_in_this_process: None) -> Path:
    """Build a page's working directory: it looks like a checkout that has the real logs beside it."""
    checkout = tmp_path / "main"
    checkout.mkdir()
    (checkout / "examples").symlink_to(REPOSITORY / "examples")
    if SHARED.is_dir():
        cut_short(tmp_path / "shared" / "data")
    monkeypatch.chdir(checkout)
    monkeypatch.syspath_prepend(checkout)  # as where a session of Python begins
    return checkout


def cut_short(data: Path) -> None:
    """Link the real logs, but for five sixths of the axis' rows and most of the pendulum's runs."""
    for path in SHARED.glob("*/*"):
        (data / path.parent.name).mkdir(parents=True, exist_ok=True)
        (data / path.relative_to(SHARED)).symlink_to(path)
    rows = (SHARED / AXIS).read_text().splitlines(keepends=True)
    for path in (data / AXIS, *sorted((data / PENDULUM).iterdir())[2:]):
        path.unlink()
    (data / AXIS).write_text("".join(rows[: len(rows) // 6]))


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_page_runs_as_it_is_shown(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch):
    if "diransac cache --clear" in page.read_text():  # the machine code of the other tests is to stay
        monkeypatch.setenv("DIRANSAC_CACHE", str(folder / "code"))
    if page.name in NEEDS:
        pytest.importorskip(NEEDS[page.name], reason=f"{page.name} NOT CHECKED: {NEEDS[page.name]} is missing")
    found = list(blocks(page.read_text()))
    printed = run_blocks(found, page, folder)
    if RENEWED:
        for before, block in reversed([*outputs(found)]):
            write_output(page, block, renewed(block.body, printed[before]))
        return
    differ = {block.line: disagreement(block.body, printed[before]) for before, block in outputs(found)}
    wrong = [f"{page.name}, line {line}:\n{x}" for line, x in differ.items() if x]
    if wrong:
        pytest.fail("\n".join([*wrong, "make docs-printed writes today's output into the pages"]), pytrace=False)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_every_text_block_is_compared_or_shows_commands_that_take_too_long(page: Path):
    found = list(blocks(page.read_text()))
    assert not [block.line for block in found[:1] if block.info == "text" and not block.body.startswith("$ ")]
    lost = [block.line for before, block in outputs(found) if before.info not in {"python", "console"}]
    assert not lost, f"{page.name}: output of no block that runs; $ marks commands, no language formulas and diagrams"
    assert set(documented.outputs(page.read_text())) <= set(LONG), f"{page.name}: run the command, or say why not"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_page_marks_every_block_with_a_plain_language(page: Path):
    found = blocks(page.read_text())
    odd = {f"line {block.line - 1}: {block.info!r}" for block in found if block.info not in LANGUAGES}
    assert not odd, f"{page.name}: mark blocks with one of {sorted(LANGUAGES)}; text is for what cannot run"


def test_pages_are_short_enough_to_be_read():
    words = {page.name: len(page.read_text().split()) for page in PAGES if page.parent.name != "tables"}
    assert words["README.md"] < 1_300
    assert words["method.md"] < 4_000
    assert sum(words.values()) < 30_000


def test_the_version_is_the_same_everywhere():
    version = re.search(r'^version = "(.+)"$', (REPOSITORY / "pyproject.toml").read_text(), re.MULTILINE)[1]
    assert f"\nversion: {version}\n" in (REPOSITORY / "CITATION.cff").read_text()
    assert f"\n## [{version}] - " in (REPOSITORY / "CHANGELOG.md").read_text()


def test_blocks_are_found_with_their_lines_and_without_their_indent():
    page = "text\n\n```python\na = 1\n```\n- item\n\n"
    page += "  ```console\n  $ diransac models \\\n      --json  # all\n  servo-axis\n  ```\n"
    first, second = blocks(page)
    assert first == Block("python", "a = 1\n", 4)
    assert (second.info, second.line) == ("console", 9)
    assert commands(second.body) == [["diransac", "models", "--json"]]


def test_a_command_that_cannot_run_is_refused(tmp_path: Path):
    with pytest.raises(AssertionError, match="text block"):
        run_command(["curl", "example.org"], tmp_path)


def test_documented_benchmarks_exist_and_have_their_options():
    found = [shlex.split(command) for command in documented.documented(["benchmarks/"])]
    assert len(found) > 15
    for _, file, *options in found:
        words = set(re.findall(r'"-{0,2}([\w-]+)"', (REPOSITORY / file).read_text()))
        unknown = [x for x in options if x.startswith("-") and x.lstrip("-") not in words]
        assert not unknown, f"{file}: {unknown}"


def test_commands_behind_figures_are_those_in_code_and_in_text_blocks():
    page = "Run `python benchmarks/a.py --seeds\n0:5`, not `python benchmarks/a.py N`.\n"
    page += (
        "```text\n$ diransac study run fig2 \\\n    --store b.db\nrows\n```\n```console\n$ diransac study run c\n```\n"
    )
    assert list(documented.commands(page)) == [
        "python benchmarks/a.py --seeds 0:5",
        "diransac study run fig2 --store b.db",
    ]
