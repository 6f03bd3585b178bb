"""The command ``track``: over a log, and over a file that grows under a clock that is no real one."""

import json
import re
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, contents, run, working_folder

START = ["--start", "mass=60,linear_drag=10,quadratic_drag=25,bias=1"]
TRACK = ["track", "swim.csv", *MODEL, *START]
FOLLOW = [*TRACK, "--follow", "--idle", "1"]


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = working_folder(tmp_path, monkeypatch)
    log = dr.read_log("swim.csv")
    rows = zip(*(x[:400].tolist() for x in (log.time, log["x"], log["thrust"])), strict=True)
    Path("swim.csv").write_text("t,x,thrust\n" + "".join(f"{t!r},{x!r},{u!r}\n" for t, x, u in rows))
    return folder


@dataclass
class FakeTime:
    """A clock that only moves by sleeping; at each sleep, something happens to the file."""

    happens: list = field(default_factory=list)
    now: float = 0.0

    def monotonic(self) -> float:
        """Seconds."""
        return self.now

    def sleep(self, seconds: float) -> None:
        """Move on."""
        self.now += seconds
        if self.happens:
            self.happens.pop(0)()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> FakeTime:
    fake = FakeTime()
    monkeypatch.setattr("diransac.cli.commands.tracking.time", fake)
    return fake


def in_parts(text: str, n: int) -> list:
    """Appending a text to the file in parts, wherever they end."""
    ends = np.linspace(0, len(text), n + 1).astype(int)

    def append(part: str) -> None:
        with Path("swim.csv").open("a") as file:
            file.write(part)

    return [lambda a=a, b=b: append(text[a:b]) for a, b in pairwise(ends)]


def table(name="track.csv"):
    header, *rows = Path(name).read_text().splitlines()
    return header.split(","), np.array([[float(x) for x in row.split(",")] for row in rows])


def test_a_log_has_the_estimates_of_dr_track_in_table_and_lines():
    done = run(*TRACK, "-o", "track.csv", "--jsonl")
    assert (done.exit_code, done.stderr) == (0, "")
    header, rows = table()
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    start = {"mass": 60.0, "linear_drag": 10.0, "quadratic_drag": 25.0, "bias": 1.0}
    wanted = list(dr.track(dr.models.underwater_vehicle(), dr.read_log("swim.csv"), start=start))
    names = tuple(start)
    assert header == ["t", *names, *(f"{name}_standard_error" for name in names)]
    for row, line, now in zip(rows, lines, wanted, strict=True):
        assert row.tolist() == [now.time, *now.parameters.values(), *now.standard_errors.values()]
        assert (line["t"], line["parameters"]) == (now.time, dict(now.parameters))
        assert set(line) == {"t", "parameters", "standard_errors", "outliers", "noise", "state", "changes", "notes"}


def test_the_result_names_every_parameter_and_figure_and_page_are_written():
    done = run(*TRACK, "--plot", "a.png", "--report", "a.html")
    assert done.exit_code == 0
    assert all(name in done.stdout for name in ("mass", "linear_drag", "changes: "))
    assert Path("a.png").stat().st_size > 10_000
    page = Path("a.html").read_text()
    assert "diransac track swim.csv" in page
    assert page.count("<figure>") == 5  # four parameters and the signal


def test_a_file_that_grows_gives_the_table_of_the_whole_file(clock: FakeTime):
    run(*FOLLOW, "-o", "whole.csv")
    text = Path("swim.csv").read_text()
    Path("swim.csv").write_text(text[:5000])
    clock.happens = in_parts(text[5000:], 40)
    done = run(*FOLLOW, "-o", "track.csv")
    assert (done.exit_code, done.stderr) == (0, "")
    assert Path("track.csv").read_bytes() == Path("whole.csv").read_bytes()


def test_a_run_that_is_interrupted_ends_well_and_goes_on_without_doubling_rows(clock: FakeTime):
    def interrupt() -> None:
        raise KeyboardInterrupt

    run(*FOLLOW, "-o", "whole.csv")
    text = Path("swim.csv").read_text()
    Path("swim.csv").write_text(text[:15000])
    clock.happens = [interrupt]
    stopped = run(*TRACK, "--follow", "-o", "track.csv")
    assert stopped.exit_code == 0
    assert "estimates from t" in stopped.stdout
    n = len(table()[1])
    assert 0 < n < len(table("whole.csv")[1])
    with Path("track.csv").open("a") as file:
        file.write("1.25,5")  # as a kill leaves it
    clock.happens = in_parts(text[15000:], 3)
    assert run(*FOLLOW, "-o", "track.csv").exit_code == 0
    assert Path("track.csv").read_bytes() == Path("whole.csv").read_bytes()
    before = contents(Path())
    assert run(*FOLLOW, "-o", "track.csv").exit_code == 0  # nothing is new
    assert contents(Path()) == before


def test_the_table_of_another_run_is_not_gone_on_with(clock: FakeTime):
    run(*FOLLOW, "-o", "track.csv")
    there = Path("track.csv").read_bytes()
    done = run(*FOLLOW, "--step", "0.15", "-o", "track.csv")
    assert done.exit_code == 1
    assert "give another name" in done.stderr
    Path("other.csv").write_text("t,x\n1,2\n")
    assert "give another name" in run(*FOLLOW, "-o", "other.csv").stderr
    assert Path("track.csv").read_bytes() == there


def test_standard_input_has_the_lines_of_the_file(clock: FakeTime):
    words = ["--follow", "--jsonl"]
    piped = run("track", "-", *MODEL, *START, *words, stdin=Path("swim.csv").read_bytes())
    assert (piped.exit_code, piped.stderr) == (0, "")
    assert piped.stdout == run(*FOLLOW, "--jsonl").stdout


def test_a_file_that_is_cut_off_is_said(clock: FakeTime):
    text = Path("swim.csv").read_text()
    clock.happens = [lambda: Path("swim.csv").write_text(text[:12000])]
    done = run(*FOLLOW, "--json")
    assert "the file was cut off, and is read from its beginning" in json.loads(done.stdout)["notes"]
    assert "cut off" in done.stderr


def test_a_known_parameter_is_not_tracked_and_a_result_is_a_start():
    run("identify", "swim.csv", *MODEL, "--fix", "bias=2", "-o", "model.json")
    line = json.loads(run("track", "swim.csv", "--model", "model.json", "--json").stdout)
    assert list(line["parameters"]) == ["mass", "linear_drag", "quadratic_drag"]
    assert line["parameters"]["mass"] == pytest.approx(50.0, rel=0.01)
    rest = ["--start", "linear_drag=10,quadratic_drag=25,bias=1"]
    fixed = run("track", "swim.csv", *MODEL, "--fix", "mass=50", *rest, "--json")
    assert list(json.loads(fixed.stdout)["parameters"]) == ["linear_drag", "quadratic_drag", "bias"]


def test_a_terminal_shows_the_newest_estimate_in_a_line_and_nothing_else_does(monkeypatch: pytest.MonkeyPatch):
    plain = run(*TRACK)
    monkeypatch.setenv("FORCE_COLOR", "1")
    shown = run(*TRACK)
    assert plain.stderr == ""
    lines = [x for x in shown.stderr.split("\r\x1b[2K") if x.startswith("t ")]
    assert re.match(r"t 4\.0 s  mass \d+(\.\d+)? ± \d+(\.\d+)?(×10⁻\S+)? kg  linear_drag ", lines[-1])
    assert all(len(x.splitlines()[0]) <= 80 for x in lines)
    assert shown.stdout == plain.stdout
    assert run("-q", *TRACK).stderr == ""


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([*TRACK, "--idle", "1"], "--idle"),
        ([*FOLLOW, "-o", "-"], "--jsonl"),
        ([*TRACK, "--json", "--jsonl"], "give one"),
        ([*FOLLOW, "--from", "1"], "--follow takes"),
    ],
)
def test_wrong_usage_is_said_in_a_line(words: list[str], says: str):
    done = run(*words)
    assert done.exit_code == 2
    assert says in done.stderr


def test_a_log_that_is_too_short_leaves_nothing(clock: FakeTime):
    text = Path("swim.csv").read_text().splitlines(keepends=True)
    Path("swim.csv").write_text("".join(text[:30]))
    before = contents(Path())
    done = run(*TRACK, "-o", "track.csv", "--plot", "a.png")
    assert done.exit_code == 1
    assert "there is no estimate" in done.stderr
    assert contents(Path()) == before
