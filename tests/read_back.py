"""Checks of what a command has printed and written: text without control characters, files that read back."""

import ast
import csv
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from xml.etree import ElementTree

import pytest

from hostile import SECOND_LINES


def check_printed(words: Sequence[str], *texts: str) -> None:
    """Raises AssertionError: a command has printed a control character, or a line that begins within a text."""
    for line in (line for text in texts for line in text.split("\n")):
        assert line.isprintable(), f"{words}: {line!r}"
        assert not line.startswith(SECOND_LINES), f"{words}: {line!r}"


def check_reads_back(path: Path) -> None:
    """Raises AssertionError, SyntaxError and the like: an output cannot be read, or holds code of others."""
    if path.suffix not in _READERS:
        return
    text = path.read_text(encoding="utf-8")
    check_printed((path.name,), text)
    _READERS[path.suffix](text)


def _check_python(text: str) -> None:
    kinds = [type(one).__name__ for one in ast.parse(text).body]
    assert kinds == ["Expr", "Import", "Assign", "Assign", "Assign", "FunctionDef", "FunctionDef"], kinds


def _check_c(text: str) -> None:
    """What is left of C without comments, after lines are joined, has the words of a model alone."""
    joined = re.sub(r"(\\|\?\?/)\n", "", text)
    code = re.sub(r"/\*.*?\*/", " ", joined, flags=re.DOTALL)
    assert '"' not in code
    assert "__" not in code
    assert re.findall(r"#.*", code) == ["#include <math.h>"]
    assert re.findall(r"^\w[\w ]*?(\w+)\(", code, re.MULTILINE) == re.findall(r"^void (\w+)\(", code, re.MULTILINE)
    assert len(re.findall(r"^void \w+\(", code, re.MULTILINE)) == 3


def _check_yaml(text: str) -> None:
    yaml = pytest.importorskip("yaml", reason="EXPORTED YAML NOT READ: PyYAML is missing")
    assert {"model", "states", "parameters"} <= yaml.safe_load(text).keys()


def _check_csv(text: str) -> None:
    header, *rows = csv.reader((line for line in text.splitlines() if not line.startswith("#")), strict=True)
    assert {len(row) for row in rows} <= {len(header)}


_READERS: dict[str, Callable[[str], object]] = {
    ".py": _check_python,
    ".c": _check_c,
    ".yaml": _check_yaml,
    ".csv": _check_csv,
    ".toml": tomllib.loads,
    ".svg": ElementTree.fromstring,
}
"""Check of the text of an output by its ending."""
