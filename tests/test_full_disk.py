"""A full disk at every write: one sentence, exit code 1, what was there intact, nothing left behind."""

import shutil
import sqlite3
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import chdir, closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, QUICK, contents, run, swim
from hostile import URDF
from studies import TINY_TOML

resource = pytest.importorskip("resource", reason="FULL DISKS NOT CHECKED: this system has no limit of file sizes")
pytest.importorskip("mujoco", reason="FULL DISKS NOT CHECKED: mujoco is missing")
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("trials_in_this_process")]

T = 0.02 * np.arange(150)
ARM = """<mujoco><worldbody><body name="b"><joint name="e" type="hinge" axis="0 1 0" damping="0.1"/>
<inertial pos="0 0 -0.2" mass="1.5" diaginertia="0.02 0.02 0.01"/></body></worldbody></mujoco>
"""
FIT = " ".join([*MODEL, *QUICK])
ENDINGS = {
    "simulate star": ("csv", "csv.gz", "parquet", "npz"),
    "export model.json": ("c", "py", "yaml", "casadi"),
    "export arm.json --into arm.xml": ("xml",),
    "export arm.json --into arm.urdf": ("urdf",),
    "study export a.db --to csv": ("csv",),
    "study export a.db --to parquet": ("parquet",),
    "study plot a.db": ("png",),
    "study report a.db": ("html",),
    "fleet export fleet.db": ("csv",),
    "fleet plot fleet.db": ("pdf",),
    "fleet report fleet.db": ("html",),
    "predict model.json b.csv": ("csv",),
    "map a.csv --model underwater-vehicle": ("toml",),
    "design arm.xml --unknown damping --duration 2 --limit e=1,e_torque=20": ("csv",),
}
COMMANDS = {
    **{f"{words} -o out.{ending}": [f"out.{ending}"] for words, endings in ENDINGS.items() for ending in endings},
    f"identify a.csv {FIT} -o out.json": ["out.json"],
    f"identify a.csv {FIT} -o out.json --report out.html": ["out.json", "out.html"],
    f"compare a.csv {' '.join(MODEL)} --methods ols --report out.html": ["out.html"],
    "validate model.json b.csv --horizon 1 --report out.html": ["out.html"],
    "predict model.json b.csv -o out.csv --plot out.svg": ["out.csv", "out.svg"],
    "simulate star -o out.csv --plot out.svg": ["out.csv", "out.svg"],
    "fly rotorcraft.json --trajectory square -o out.csv --plot out.svg": ["out.csv", "out.svg"],
    "study new out.toml": ["out.toml"],
}
"""Command lines, and the files that each writes."""

WITH_PATHS = TINY_TOML.replace("[axis]", "keep_paths = true\n[axis]")
STORES = {
    "study": ("", "study run tiny.toml --store out.db --methods true"),
    "fleet": ("", f"identify a.csv b.csv {FIT} --each --store out.db"),
    "begun study": (
        "study run paths.toml --store out.db --methods true --trials 1",
        "study run paths.toml --store out.db --methods true",
    ),
}
"""Command lines that write a part of the rows of a store, if any, and all of them."""


def moving(model: dr.Model) -> dr.Log:
    """A log of any motion of a model, under inputs that have nothing to do with it."""
    signals = {}
    for w, name in enumerate(model.coordinates, 2):
        signals |= {name: np.sin(w * T), f"{name}_dot": w * np.cos(w * T), f"{name}_ddot": -(w**2) * np.sin(w * T)}
    return dr.Log.from_arrays(T, signals | {name: np.cos(5 * T + k) for k, name in enumerate(model.inputs)})


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of logs, results, descriptions, a study and stores."""
    folder = tmp_path_factory.mktemp("made")
    for name, text in {"arm.xml": ARM, "arm.urdf": URDF, "tiny.toml": TINY_TOML, "paths.toml": WITH_PATHS}.items():
        (folder / name).write_text(text)
    logs = [folder / "a.csv", folder / "b.csv"]
    for path, frequency in zip(logs, (1.3, 1.7), strict=True):
        dr.Log.from_arrays(T, swim(T, frequency)).write(path)
    dr.identify(dr.models.underwater_vehicle(), dr.read_log(logs[0]), "ols").save(folder / "model.json")
    arm, rotorcraft = dr.models.robot(folder / "arm.xml", unknown=("damping",)), dr.models.planar_rotorcraft()
    for name, model in {"arm": arm, "rotorcraft": rotorcraft}.items():
        dr.identify(model, moving(model), "ols").save(folder / f"{name}.json")
    with ThreadPoolExecutor(1) as here:
        dr.run_study(folder / "tiny.toml", store=folder / "a.db", executor=here)
        with chdir(folder):
            dr.study.identify_each(
                dr.models.underwater_vehicle(), ["a.csv", "b.csv"], "ols", store="fleet.db", executor=here
            )
    return folder


@contextmanager
def full_after(size: int) -> Iterator[None]:
    """Context in which no file grows beyond a size."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def folder(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory with what is made."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("words", COMMANDS)
def test_an_output_on_a_full_disk_is_an_error_and_all_files_stay_as_they_were(folder: Path, words: str):
    assert run(*words.split()).exit_code == 0
    sizes = [Path(name).stat().st_size for name in COMMANDS[words]]
    for is_new in (False, True):
        for name in COMMANDS[words] if is_new or words.startswith("study new") else ():
            Path(name).unlink(missing_ok=True)
        before = contents(folder)
        # Of what is replaced half is written, of what is new nothing or nearly all; CasADi leaves its last byte unread.
        for size in (0, *(n - 2 for n in sizes)) if is_new else {n // 2 for n in sizes}:
            with full_after(size):
                done = run(*words.split())
            assert done.exit_code == 1
            assert len(done.stderr.splitlines()) == 1
            assert "File too large" in done.stderr or "is the disk full?" in done.stderr
            assert contents(folder) == before


def rows(store: Path) -> list[dict[str, object]]:
    """Rows of a store without times and places; none of a file that holds nothing yet."""
    with closing(sqlite3.connect(store)) as connection:
        connection.row_factory = sqlite3.Row
        if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            return []
        found = [dict(row) for row in connection.execute("SELECT * FROM trials ORDER BY 1, 2, 3")]
    return [{name: value for name, value in row.items() if name not in ("seconds", "host")} for row in found]


@pytest.mark.parametrize("kind", STORES)
def test_a_store_on_a_full_disk_keeps_its_rows_and_is_completed_later(folder: Path, kind: str):
    part, all_of_it = (words.split() for words in STORES[kind])
    store = folder / "out.db"
    assert run(*all_of_it).exit_code == 0
    whole, largest = rows(store), store.stat().st_size
    store.unlink()
    if part:
        assert run(*part).exit_code == 0
    first, kept = (store.read_bytes(), rows(store)) if part else (b"", [])
    sizes = range(len(first), largest, 4096) if part else (0, 512, *range(4096, largest, 4096))
    assert sizes
    for size in sizes:
        if size:
            store.write_bytes(first)
        before = contents(folder)
        with full_after(size):
            done = run(*all_of_it)
        assert (done.exit_code, len(done.stderr.splitlines())) == (1, 1), (size, done.stderr)
        assert "is the disk full? Rows that it has are kept" in done.stderr
        assert {*contents(folder)} - {*before} <= {"out.db"}
        assert all(row in whole for row in rows(store))
        assert all(row in rows(store) for row in kept)
        assert run(*all_of_it).exit_code == 0
        assert rows(store) == whole
