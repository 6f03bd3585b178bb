"""The package as a whole: what it exports, what it costs to import, who may import whom."""

import ast
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import diransac

REPOSITORY = Path(__file__).resolve().parents[1]
HEAVY = ["llvmlite", "matplotlib", "pandas", "plotly", "polars", "rich", "scipy", "sklearn", "typer"]


def in_a_fresh_process(code: str) -> str:
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_is_light():
    loaded = in_a_fresh_process(f"import sys, diransac; print(*[name for name in {HEAVY} if name in sys.modules])")
    assert loaded == ""


def test_import_configures_nothing():
    code = """
import logging, random
import numpy
state, loggers = random.getstate(), len(logging.root.handlers)
numpy_state = numpy.random.get_state()[1].copy()
import diransac
assert random.getstate() == state
assert len(logging.root.handlers) == loggers
assert (numpy.random.get_state()[1] == numpy_state).all()
"""
    in_a_fresh_process(code)


def test_every_exported_name_exists_and_nothing_else_is_public():
    public = {name for name in dir(diransac) if not name.startswith("_")}
    modules = {name for name in public if type(getattr(diransac, name)).__name__ == "module"}
    assert set(diransac.__all__) - {"__version__"} <= public
    assert public - modules <= set(diransac.__all__)
    assert list(diransac.__all__) == sorted(set(diransac.__all__), key=diransac.__all__.index), (
        "a name is exported twice"
    )


def test_names_that_are_imported_when_asked_for_are_exported():
    assert set(diransac._LATER) <= set(diransac.__all__)


PACKAGES = sorted((REPOSITORY / "src/diransac").rglob("__init__.py"))


@pytest.mark.parametrize("file", PACKAGES, ids=lambda file: file.parent.name)
def test_the_docstring_of_a_package_lists_its_files(file: Path):
    """But for those in a registry below it, such as ``"npz:read_npz"``."""
    text = file.read_text()
    listed = {*re.findall(r"`(\w+)(?:\.py|/)?`", ast.get_docstring(ast.parse(text))), *re.findall(r'"(\w+):', text)}
    packages = {path.parent.name for path in file.parent.glob("*/__init__.py")}
    files = {path.stem for path in file.parent.glob("[!_]*.py")} if file.parent.name != "diransac" else set()
    assert not (packages | files) - listed


@pytest.mark.parametrize("name", diransac.__all__)
def test_exported_name_is_documented(name: str):
    exported = getattr(diransac, name)
    assert name == "__version__" or exported.__doc__


def test_types_are_shipped():
    assert Path(diransac.__file__).with_name("py.typed").is_file()


def test_imports_run_downward_only():
    linter = shutil.which("lint-imports", path=sysconfig.get_path("scripts"))
    assert linter, "import-linter is not installed: pip install -e '.[dev]'"
    command = [linter, "--no-logo", "--no-cache"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
