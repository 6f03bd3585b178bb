"""The commands behind the numbers and pictures of the documentation: a list of them, or their output.

Run it as ``python benchmarks/documented.py [--run] [TEXT ...]``: those that hold a text, all by default.  With
``--run``, as ``make docs-figures`` has it, each that has no output yet runs in ``out/docs-figures`` and leaves what it
prints there, which is compared with what pages show of it; all of them take many hours.  Blocks that the tests run are
not among them.
"""

import argparse
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from printed import disagreement

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDER = REPOSITORY / "out" / "docs-figures"
PLACEHOLDERS = re.compile(r"\[|\.\.\.|//host|\b[A-Z]{3,}\b|\b[NMAB]\b(?!=)")
TIMES = 20 * 3600.0


def pages() -> list[Path]:
    """Pages of the documentation."""
    return [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]


def commands(page: str) -> Iterator[str]:
    """Commands of a page: benchmarks in code, and lines of blocks that are shown as text, in their order."""
    for block in re.finditer(r"^ *```(\w*)\n(.*?)^ *```|`(python benchmarks/[^`]+)`", page, re.DOTALL | re.MULTILINE):
        language, body, inline = block.groups()
        lines = [inline] if inline else re.sub(r"\\\n", " ", body).splitlines() if language == "text" else []
        for line in lines:
            command = " ".join(line.split()).removeprefix("$ ").partition(" #")[0]
            if command.startswith(("python benchmarks/", "diransac study")) and not PLACEHOLDERS.search(command):
                yield command


def outputs(page: str) -> dict[str, str]:
    """What a page shows below a command that the tests do not run, in a block that begins with a ``$``."""
    found = dict[str, str]()
    for body in re.findall(r"^ *```text\n(\$ .*?)^ *```", page, re.DOTALL | re.MULTILINE):
        for line in re.sub(r"\\\n", " ", body).splitlines(keepends=True):
            if line.startswith("$ "):
                command = line[2:].strip()
            else:
                found[command] = found.get(command, "") + line
    return found


def documented(texts: list[str]) -> list[str]:
    """All commands that hold one of the texts, each once."""
    found = dict.fromkeys(x for page in pages() for x in commands(page.read_text("utf-8")))
    return [x for x in found if not texts or any(text in x for text in texts)]


def target_of(command: str) -> Path:
    """File of a command's output."""
    return FOLDER / f"{re.sub(r'[^A-Za-z0-9.]+', '-', command).strip('-')[:120]}.txt"


def run(command: str) -> int:
    """Exit code of a command, whose output is kept where it succeeds."""
    words = shlex.split(command)
    if words[0] == "python":
        words = [sys.executable, str(REPOSITORY / words[1]), *words[2:]]
    else:
        words = [sys.executable, "-m", *words]
    target = target_of(command)
    if target.exists():
        return 0
    draft = target.with_suffix(".part")
    FOLDER.mkdir(parents=True, exist_ok=True)
    with draft.open("w", encoding="utf-8") as file:
        code = subprocess.run(words, cwd=FOLDER, stdout=file, check=False, timeout=TIMES).returncode
    if code == 0:
        draft.replace(target)
    return code


def main() -> None:
    """List the commands, or run them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("texts", nargs="*", metavar="TEXT")
    parser.add_argument("--run", action="store_true", help="run those that have no output yet")
    chosen = parser.parse_args()
    shown = {command: text for page in pages() for command, text in outputs(page.read_text("utf-8")).items()}
    failed = []
    for command in documented(chosen.texts):
        print(command, flush=True)
        if chosen.run and run(command):
            failed.append(command)
        elif chosen.run and command in shown:
            difference = disagreement(shown[command], target_of(command).read_text("utf-8"))
            failed += [f"{command}: the page shows something else\n{difference}"] if difference else []
    if failed:
        sys.exit("\n".join(["failed:", *failed]))


if __name__ == "__main__":
    main()
