"""History, figure and page of a tracked run, from estimates that are made up."""

import re
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from diransac.errors import SettingsError
from diransac.identification.tracking import Change, TrackedEstimate
from diransac.identification.tracking import estimates as histories
from diransac.identification.tracking.estimates import History, change_text
from diransac.plots.tracking import plot_tracking
from diransac.report.tracking import write_tracking_report

MODEL = dr.models.planar_rotorcraft()
STEP = Change(30.0, "mass", 0.25, 0.175, detected=30.5, before_error=1e-3, after_error=2e-3)


def estimate(t, mass=0.25, changes=(), notes=(), outliers=0.1):
    values = {"mass": mass, "inertia": 0.004, "drag": 0.025}
    errors = {"mass": 1e-3, "inertia": 1e-5, "drag": 1e-3}
    shares, noise = {"x": outliers, "z": 0.0}, {"x": 2e-3, "z": 2e-3}
    return TrackedEstimate(t, values, errors, np.diag([1e-6, 1e-10, 1e-6]), changes, shares, noise, {}, notes)


def run_of(times, **at):
    history = History(MODEL)
    for t in times:
        history.add(estimate(float(t), 0.25 if t < 30.5 else 0.175, (STEP,) if t == 30.5 else (), **at))
    return history


def test_a_long_history_keeps_its_ends_its_changes_and_a_bounded_number(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(histories, "_MOST", 100)
    history = run_of(np.arange(1.0, 1001.0, 0.5), notes=("a gap",))
    assert (history.n_steps, history.changes) == (2000, [STEP])
    assert len(history.time) <= 100
    assert history.time[0] == 1.0
    assert history.last.time == 1000.5
    assert np.ptp(np.diff(history.time)) == 0.0
    assert len(history.notes) == 500


def test_a_change_is_a_sentence():
    assert change_text(STEP, "kg") == "t = 30.00 s: step of mass from 0.25 to 0.175 kg, found 0.5 s later"
    assert change_text(Change(1.0, "e", 0.0, 1.0, kind="drift"), "") == "t = 1.00 s: drift of e from 0 to 1"


def test_the_figure_has_a_panel_per_parameter_its_interval_and_its_changes(tmp_path: Path):
    figure = plot_tracking(run_of(np.arange(0.0, 60.0, 0.5)), tmp_path / "a.svg")
    panels = {axes.get_title(loc="left"): axes for axes in figure.axes}
    assert list(panels) == ["mass", "inertia", "drag", "outliers"]
    marks = [line for line in panels["mass"].lines if len(set(line.get_xdata())) == 1]
    assert [line.get_xdata()[0] for line in marks] == [30.0]
    band = panels["mass"].collections[0].get_paths()[0].vertices
    at_start = band[band[:, 0] == 0.0][:, 1]
    assert np.ptp(at_start) == pytest.approx(2 * 1.96e-3)
    assert not [line for line in panels["drag"].lines if len(set(line.get_xdata())) == 1]
    again = tmp_path / "b.svg"
    plot_tracking(run_of(np.arange(0.0, 60.0, 0.5)), again)
    assert again.read_bytes() == (tmp_path / "a.svg").read_bytes()
    with pytest.raises(SettingsError, match="ending"):
        plot_tracking(run_of([1.0]), tmp_path / "a.gif")


def test_the_page_shows_changes_findings_and_figures(tmp_path: Path):
    path = tmp_path / "a.html"
    times = np.concatenate([np.arange(0.0, 20.0, 0.5), np.arange(25.0, 60.0, 0.5)])
    write_tracking_report(run_of(times, notes=("a gap <of> 5 s",)), path, command="diransac track a.csv")
    text = path.read_text()
    assert text.count("<figure>") == 3 + 2
    assert "1 change reported" in text
    assert "a gap &lt;of&gt; 5 s" in text
    assert "diransac track a.csv" in text
    mass = text[text.index("<h3>mass") :]
    assert "band departed" in mass[: mass.index("</figure>")]
    line = re.search(r'class="trace line m0" data-name="mass" d="([^"]*)"', mass)[1]
    assert line.count("m") == 1  # broken at the gap alone
    drag = text[text.index("<h3>drag") :]
    assert "band departed" not in drag[: drag.index("</figure>")]


def test_a_page_of_a_clock_that_was_set_back_counts_estimates(tmp_path: Path):
    path = tmp_path / "a.html"
    write_tracking_report(run_of([5.0, 5.5, 6.0, 0.0, 0.5]), path)
    assert "counts estimates, because the clock was set back" in path.read_text()


def test_one_estimate_is_enough_for_figure_and_page(tmp_path: Path):
    plot_tracking(run_of([1.0]), tmp_path / "a.png")
    write_tracking_report(run_of([1.0]), tmp_path / "a.html")
