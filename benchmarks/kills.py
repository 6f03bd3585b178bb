"""SIGKILL at random moments of commands that write: what was there stays, and the same command then completes.

    python benchmarks/kills.py [KILLS]

KILLS, 25 by default, of each command. A row of the table has the kills that came before the end, those after which an
older output or row was lost or changed, those after which an output was neither the old one nor that of an undisturbed
run, failures of the same command afterwards, other numbers than those of an undisturbed run, and drafts that are left;
and of every fifth kill, runs of two processes at once with an empty cache of machine code that ended otherwise.
"""

import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np

import diransac as dr
from diransac.text_table import aligned

N_KILLS = 25
PROGRAM = (sys.executable, "-P", "-m", "diransac", "-q")
MODEL = "--model underwater-vehicle"
STUDY = """
name = "tiny"
trials = 8
[plant]
kind = "planar-rotorcraft"
[data]
trajectory = "square"
[noise]
outlier_probability = 0.1
[methods.ols]
[evaluation]
trajectories = ["square"]
[axis]
path = "noise.outlier_magnitude"
levels = [0, 40]
"""
COMMANDS = {
    "identify": (f"identify 0.csv {MODEL} -o out.json --report out.html", ("out.json", "out.html")),
    "report": ("validate model.json 1.csv --report out.html", ("out.html",)),
    "study run": ("study run tiny.toml --store trials.db --jobs 2", ("trials.db",)),
    "identify --each": (
        f"identify {' '.join(f'{k}.csv' for k in range(8))} {MODEL} --each --store logs.db --jobs 2",
        ("logs.db",),
    ),
}
"""Command lines, and what each writes; a store has a table of its name."""
COUNTED = ("kills", "lost", "half-written", "failed", "other numbers", "drafts", "at once")


def main() -> None:
    """Print the table."""
    n_kills = int(sys.argv[1]) if len(sys.argv) > 1 else N_KILLS
    rng, lines = random.Random(0), [["command", *COUNTED]]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_inputs(folder)
        for title, (words, outputs) in COMMANDS.items():
            found = killed(folder, words.split(), outputs, n_kills, rng)
            lines.append([title, *(str(found[name]) for name in COUNTED)])
    print("\n".join(aligned(lines)))


def write_inputs(folder: Path) -> None:
    """Write logs, a result and a study."""
    model, t = dr.models.underwater_vehicle(), 0.02 * np.arange(500)
    plant = dr.Plant(model, {"mass": 50.0, "linear_drag": 12.0, "quadratic_drag": 30.0, "bias": 2.0})
    for k in range(8):
        inputs = dr.Log.from_arrays(t, {"thrust": 40.0 * np.sin((1.0 + 0.1 * k) * t)})
        log = dr.simulate(plant, inputs, initial_state={"x": 0.0, "x_dot": 0.0})
        dr.differentiate(log, model).write(folder / f"{k}.csv")
    dr.identify(model, dr.read_log(folder / "0.csv"), "ols").save(folder / "model.json")
    (folder / "tiny.toml").write_text(STUDY)


def killed(folder: Path, words: list[str], outputs: tuple[str, ...], n_kills: int, rng: random.Random) -> Counter[str]:
    """Counts of what happened in kills of a command at moments of the time that it takes undisturbed."""
    paths, counts = [folder / name for name in outputs], Counter[str]()
    run(folder, words)
    forget(paths)
    begin = time.monotonic()
    run(folder, words)
    duration, whole = time.monotonic() - begin, [content(path) for path in paths]
    while counts["kills"] < n_kills:
        for path in paths:
            path.unlink() if path.suffix == ".db" else path.write_text("old")
        before = [content(path) for path in paths]
        while run_until(folder, words, rng.uniform(0.0, duration)):
            counts["kills"] += 1
            after = [content(path) for path in paths]
            for old, new, all_of_it in zip(before, after, whole, strict=True):
                counts["lost"] += not (new >= old if isinstance(old, frozenset) else new in (old, all_of_it))
                counts["half-written"] += not (
                    new <= all_of_it if isinstance(old, frozenset) else new in (old, all_of_it)
                )
            before = after
            if counts["kills"] == n_kills or not isinstance(before[0], frozenset):
                break
        counts["failed"] += run(folder, words) != 0
        counts["other numbers"] += [content(path) for path in paths] != whole
        counts["drafts"] += sum(path.name.endswith((".part", "-journal")) for path in folder.iterdir())
    counts["at once"] = sum(differs_at_once(folder, words, paths, whole) for _ in range(-(-n_kills // 5)))
    return counts


def differs_at_once(folder: Path, words: list[str], paths: list[Path], whole: list[object]) -> bool:
    """True if two processes at once, which begin anew, do not end as one."""
    forget(paths)
    with tempfile.TemporaryDirectory() as cache:
        given = {"cwd": folder, "env": os.environ | {"DIRANSAC_CACHE": cache}}
        both = [subprocess.Popen([*PROGRAM, *words], **given, stdout=subprocess.DEVNULL) for _ in range(2)]
        codes = [process.wait() for process in both]
        has_drafts = any(path.suffix != ".code" for path in Path(cache).iterdir())
    return any(codes) or has_drafts or [content(path) for path in paths] != whole


def forget(paths: list[Path]) -> None:
    """Remove outputs."""
    for path in paths:
        path.unlink()


def run(folder: Path, words: list[str]) -> int:
    """Exit code of a command."""
    return subprocess.run([*PROGRAM, *words], cwd=folder, capture_output=True, check=False).returncode


def run_until(folder: Path, words: list[str], moment: float) -> bool:
    """True if a command was killed at a moment before its end."""
    process = subprocess.Popen([*PROGRAM, *words], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        process.communicate(timeout=moment)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()  # ends when its workers have ended, too
    return process.returncode == -signal.SIGKILL


def content(path: Path) -> object:
    """Rows of a store without times and places, as texts; the bytes of another file."""
    if path.suffix != ".db":
        return path.read_bytes()
    if not path.exists():
        return frozenset[str]()
    with closing(sqlite3.connect(path)) as connection:
        connection.row_factory = sqlite3.Row
        if not connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            return frozenset[str]()
        rows = [dict(row) for row in connection.execute(f"SELECT * FROM {path.stem}")]
    return frozenset(json.dumps({k: str(x) for k, x in row.items() if k not in ("seconds", "host")}) for row in rows)


if __name__ == "__main__":
    main()
