"""Pictures of flights: what they draw, that flights which diverge leave them readable, and files that repeat."""

import re
import subprocess
import sys
from importlib.resources import files
from itertools import combinations, pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.colors import to_hex

import diransac.plots.figure
from diransac.data.log import Log
from diransac.errors import LogError, SettingsError
from diransac.flight.trajectory import Trajectory
from diransac.plots import plot_flight
from diransac.plots.figure import COLOURS, REFERENCE

N, DT = 60, 0.1
T = np.arange(N) * DT
STATES, INPUTS = ("x", "z", "theta", "x_dot", "z_dot", "theta_dot"), ("thrust", "moment")
UNITS = {"x": "m", "z": "m", "theta": "rad", "x_dot": "m/s", "thrust": "N"}
LIMITS = {"thrust": (0.0, 3.0), "moment": (-50.0, 50.0)}


def columns(radius=2.0):
    return {
        "x": radius * np.sin(T),
        "z": radius * np.cos(T),
        "theta": 0.3 * np.sin(2.0 * T),
        "x_dot": radius * np.cos(T),
        "z_dot": -radius * np.sin(T),
        "theta_dot": 0.6 * np.cos(2.0 * T),
        "thrust": 2.5 + 0.6 * np.sin(T),
        "moment": 0.1 * np.cos(T),
    }


def trajectory(radius=2.0, states=STATES, inputs=INPUTS, **changed):
    made = columns(radius) | changed
    matrices = (np.column_stack([made[name] for name in names]) for names in (states, inputs))
    return Trajectory(T, *matrices, states, inputs, LIMITS)


def flown(units=UNITS, **changed):
    return Log.from_arrays(T, columns() | {"x": 2.1 * np.sin(T), "z": 1.9 * np.cos(T)} | changed, units)


def panels(figure):
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


def lines(axes, colour):
    """The lines (not the marks) of a colour."""
    return [line for line in axes.lines if to_hex(line.get_color()) == colour and len(line.get_xdata()) > 1]


def marks(axes, marker):
    return [(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.lines if line.get_marker() == marker]


def legend(figure):
    (only,) = figure.legends
    return dict(zip((text.get_text() for text in only.get_texts()), only.legend_handles, strict=True))


BLUE, GREY = COLOURS[0], REFERENCE

# ---------------------------------------------------------------------- what is drawn


def test_every_state_and_input_is_drawn_over_its_reference():
    reference, log = trajectory(), flown()
    drawn = panels(plot_flight(reference, log))
    assert set(drawn) == {*STATES, *INPUTS, "path"}
    for name in (*STATES, *INPUTS):
        ((planned,), (flight,)) = lines(drawn[name], GREY), lines(drawn[name], BLUE)
        assert np.array_equal(planned.get_xydata(), np.column_stack([T, reference[name]]))
        assert np.array_equal(flight.get_xydata(), np.column_stack([T, log[name]]))
        held = "steps-post" if name in INPUTS else "default"
        assert (planned.get_drawstyle(), flight.get_drawstyle()) == (held, held)
        assert drawn[name].get_title(loc="right").startswith(UNITS.get(name, ""))
        low, high = drawn[name].get_ylim()
        assert low < min(log[name].min(), reference[name].min())
        assert high > max(log[name].max(), reference[name].max())


def test_the_path_is_drawn_with_x_and_z_to_one_scale():
    reference, log = trajectory(), flown()
    figure = plot_flight(reference, log)
    axes = panels(figure)["path"]
    ((planned,), (flight,)) = lines(axes, GREY), lines(axes, BLUE)
    assert np.array_equal(planned.get_xydata(), np.column_stack([reference["x"], reference["z"]]))
    assert np.array_equal(flight.get_xydata(), np.column_stack([log["x"], log["z"]]))
    figure.draw_without_rendering()
    origin, right, up = axes.transData.transform([(0, 0), (1, 0), (0, 1)])
    assert right[0] - origin[0] == pytest.approx(up[1] - origin[1], rel=1e-6)


def test_start_and_end_of_the_reference_are_named():
    def texts(reference):
        return [text.get_text() for text in panels(plot_flight(reference, flown()))["path"].texts if text.get_text()]

    assert texts(trajectory()) == ["start", "end"]
    around = 2.0 * np.pi * T / T[-1]
    assert texts(trajectory(x=np.sin(around), z=np.cos(around))) == ["start, end"]


def test_limits_are_told_always_and_drawn_where_they_come_into_view():
    figure = plot_flight(trajectory(), flown())
    drawn = panels(figure)
    assert drawn["thrust"].get_title(loc="right") == "N, limits 0 to 3"
    assert drawn["moment"].get_title(loc="right") == "limits −50 to 50"
    level = [line.get_ydata()[0] for line in drawn["thrust"].lines if len(set(line.get_ydata())) == 1]
    assert level == [3.0]
    assert not any(len(set(line.get_ydata())) == 1 for line in drawn["moment"].lines)
    assert list(legend(figure)) == ["reference", "flown", "limits"]


def test_a_longer_log_is_shown_to_its_end():
    reference = trajectory()
    made = {name: np.append(values, values[-1]) for name, values in columns().items()}
    log = Log.from_arrays(np.append(T, T[-1] + DT), made)
    drawn = panels(plot_flight(reference, log))
    assert all(drawn[name].get_xlim() == (0.0, log.time[-1]) for name in (*STATES, *INPUTS))


# ---------------------------------------------------------------------- several flights


def test_each_method_has_one_look_in_every_panel():
    logs = {label: flown(x=(2.0 + i / 10) * np.sin(T)) for i, label in enumerate(["OLS", "DIRANSAC", "LO-DIRANSAC"])}
    figure = plot_flight(trajectory(), logs)
    handles = legend(figure)
    assert set(handles) == {"reference", "limits", *logs}
    looks = {label: (to_hex(handles[label].get_color()), handles[label].get_linestyle()) for label in logs}
    assert len({colour for colour, _ in looks.values()}) == 3
    drawn = panels(figure)
    for name, axes in drawn.items():
        assert len(lines(axes, GREY)) == 1, name
        for label, (colour, style) in looks.items():
            (line,) = lines(axes, colour)
            assert line.get_linestyle() == style, (name, label)
    for label, (colour, _) in looks.items():
        (line,) = lines(drawn["x"], colour)
        assert np.array_equal(line.get_ydata(), logs[label]["x"])


def test_methods_have_the_colours_of_the_reports_page():
    css = (files("diransac.report") / "templates" / "page.css").read_text().split("@media")[0]
    page = dict(re.findall(r"--(\w+): (#\w+);", css))
    assert tuple(page[f"c{i}"] for i in range(6)) == COLOURS
    for name in ("PAPER", "INK", "MUTED", "RULE", "SOFT"):
        assert page[name.lower()] == getattr(diransac.plots.figure, name)


def test_each_flight_may_have_its_own_reference():
    references = {"a": trajectory(2.0), "b": trajectory(2.5)}
    figure = plot_flight(references, {"a": flown(), "b": flown()})
    assert "references" in legend(figure)
    for colour, reference in zip(COLOURS[:2], references.values(), strict=True):
        planned, _ = sorted(lines(panels(figure)["z"], colour), key=lambda line: -line.get_linewidth())
        assert np.array_equal(planned.get_ydata(), reference["z"])


# ---------------------------------------------------------------------- flights that diverge


def share_of_the_axis(axes, values):
    low, high = axes.get_ylim()
    return np.ptp(values) / (high - low)


@pytest.mark.parametrize("far", [1e2, 1e4, 1e300])
def test_a_flight_that_diverges_leaves_the_reference_readable(far):
    away = np.where(T > 2.0, far ** ((T - 2.0) / (T[-1] - 2.0)) - 1.0, 0.0)
    reference = trajectory()
    log = flown(**{name: columns()[name] + away for name in (*STATES, "thrust")})
    figure = plot_flight(reference, log)
    assert "leaves the panel" in legend(figure)
    for name in (*STATES, "thrust"):
        axes = panels(figure)[name]
        assert share_of_the_axis(axes, reference[name]) > 1.0 / 8.0, name
        row = np.flatnonzero(log[name] > axes.get_ylim()[1])[0]
        assert marks(axes, "^") == [(T[row], axes.get_ylim()[1])]
    path = panels(figure)["path"]
    assert share_of_the_axis(path, reference["z"]) > 1.0 / 8.0
    ((x, z),) = marks(path, "^") + marks(path, ">")
    assert z == path.get_ylim()[1] or x == path.get_xlim()[1]
    figure.draw_without_rendering()  # no warning, however far the line goes


def test_a_method_that_diverges_does_not_spoil_the_others():
    reference = trajectory()
    alone = plot_flight(reference, flown())
    both = plot_flight(reference, {"good": flown(), "bad": flown(x=1e6 * T**3, z=-1e6 * T**3)})
    for name in ("x", "z"):
        low, high = panels(alone)[name].get_ylim()
        assert np.ptp(panels(both)[name].get_ylim()) < 2.5 * (high - low)


def test_a_cross_marks_where_the_numbers_end():
    ended = {name: np.where(T < 3.0, values, np.nan) for name, values in columns().items()}
    figure = plot_flight(trajectory(), Log.from_arrays(T, ended))
    assert "last finite value" in legend(figure)
    last = np.flatnonzero(T < 3.0)[-1]
    for name in STATES:
        assert marks(panels(figure)[name], "X") == [(T[last], columns()[name][last])]
    assert marks(panels(figure)["path"], "X") == [(columns()["x"][last], columns()["z"][last])]


def test_a_gap_is_no_end():
    gap = np.where((T > 2.0) & (T < 3.0), np.nan, columns()["x"])
    figure = plot_flight(trajectory(), flown(x=gap))
    assert not marks(panels(figure)["x"], "X")
    assert "last finite value" not in legend(figure)


def test_a_flight_without_any_number_leaves_the_reference():
    nothing = flown(x=np.append(0.0, np.full(N - 1, np.nan)), z=np.full(N, np.nan))
    figure = plot_flight(trajectory(), nothing)
    figure.draw_without_rendering()
    assert share_of_the_axis(panels(figure)["z"], columns()["z"]) > 0.8


@pytest.mark.parametrize("rounding", [0.0, 1e-9])
def test_a_reference_at_rest_shows_how_the_flight_moves_about_it(rounding):
    reference = trajectory(theta=1.0 + rounding * np.sin(T))
    log = flown(theta=1.0 + 0.2 * np.sin(3.0 * T))
    axes = panels(plot_flight(reference, log))["theta"]
    assert share_of_the_axis(axes, log["theta"]) > 0.5
    assert not marks(axes, "^")
    assert not marks(axes, "v")


def test_states_that_never_move_are_drawn():
    still = dict.fromkeys(STATES, np.zeros(N))
    figure = plot_flight(trajectory(**still), flown(**still))
    figure.draw_without_rendering()
    assert all(np.ptp(axes.get_ylim()) > 0.0 for axes in figure.axes)


# ---------------------------------------------------------------------- any model


def machine(states, inputs):
    rng = np.random.default_rng(0)
    reference = Trajectory(T, rng.normal(size=(N, len(states))), rng.normal(size=(N, len(inputs))), states, inputs)
    return reference, Log.from_arrays(T, {name: reference[name] + 0.1 for name in (*states, *inputs)})


MACHINES = {
    "axis": (("position", "position_dot"), ("force",)),
    "pendulum": (("q1", "q2", "q1_dot", "q2_dot"), ("torque1", "torque2")),
    "rotorcraft": (STATES, INPUTS),
    "quadrotor": (
        ("x", "y", "z", "qw", "qx", "qy", "qz", "x_dot", "y_dot", "z_dot", "wx", "wy", "wz"),
        ("thrust", "torque_x", "torque_y"),
    ),
    "no derivative's name": (("qw", "qx", "wx"), ("torque",)),
    "odd": (("x", "z"), ("a", "b", "c", "d", "e")),
}


@pytest.mark.parametrize("names", MACHINES.values(), ids=MACHINES)
def test_any_machine_gets_its_panels_which_do_not_overlap(names):
    states, inputs = names
    figure = plot_flight(*machine(states, inputs), title="A title")
    expected = {*states, *inputs} | ({"path"} if {"x", "z"} <= set(states) else set())
    assert set(panels(figure)) == expected
    assert len(figure.axes) == len(expected)
    boxes = [axes.get_position() for axes in figure.axes]
    for box in boxes:
        assert 0.0 < box.x0 < box.x1 < 1.0
        assert 0.0 < box.y0 < box.y1 < 1.0
    for a, b in combinations(boxes, 2):
        assert a.x1 <= b.x0 or b.x1 <= a.x0 or a.y1 <= b.y0 or b.y1 <= a.y0


@pytest.mark.parametrize("size", [1e-3, 1.0, 37.0, 1e4])
def test_names_of_ticks_do_not_run_into_each_other(size):
    scaled = {name: size * values for name, values in columns().items()}
    figure = plot_flight(trajectory(**scaled), Log.from_arrays(T, scaled, UNITS))
    figure.draw_without_rendering()
    for axes in figure.axes:
        shown = axes.get_window_extent().padded(1.0)
        for axis, low, high in ((axes.xaxis, "x0", "x1"), (axes.yaxis, "y0", "y1")):
            extents = [tick.label1.get_window_extent() for tick in axis.get_major_ticks() if tick.label1.get_visible()]
            middles = [(e.x0 + e.x1) / 2 if low == "x0" else (e.y0 + e.y1) / 2 for e in extents]
            ends = (getattr(shown, low), getattr(shown, high))
            inside = [e for e, m in zip(extents, middles, strict=True) if ends[0] <= m <= ends[1]]
            assert len(inside) > 1 or not extents, axes.get_title(loc="left")
            for a, b in pairwise(sorted(inside, key=lambda e: getattr(e, low))):
                assert getattr(a, high) < getattr(b, low), axes.get_title(loc="left")
            assert all(e.x0 >= 0.0 for e in inside)


# ---------------------------------------------------------------------- files


def test_files_are_of_the_kind_that_their_ending_says_and_the_same_for_the_same_flight(tmp_path):
    pairs = [("a.png", "a.PNG"), ("a.svg", "b.svg"), ("a.pdf", "b.pdf")]
    for name in (name for pair in pairs for name in pair):
        plot_flight(trajectory(), {"one": flown(), "two": flown()}, tmp_path / name, title="A title")
    png = (tmp_path / "a.png").read_bytes()
    assert png.startswith(b"\x89PNG\r\n\x1a\n")
    assert int.from_bytes(png[16:20], "big") == 1800
    assert ElementTree.parse(tmp_path / "a.svg").getroot().tag.endswith("svg")
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    for one, other in pairs:
        assert (tmp_path / one).read_bytes() == (tmp_path / other).read_bytes(), other
    assert len(list(tmp_path.iterdir())) == 6


def test_drawing_changes_nothing_for_others(tmp_path):
    code = f"""
import sys
import numpy as np
import diransac as dr
from diransac import plots
assert not any(name.startswith("matplotlib") for name in sys.modules)
import matplotlib
settings = lambda: {{name: matplotlib.rcParams[name] for name in matplotlib.rcParams if name != "backend"}}
before = settings()
t = np.arange(9) / 10
signals = dict(x=t, x_dot=t, f=t)
reference = dr.Trajectory(t, np.column_stack([t, t]), t[:, None], ("x", "x_dot"), ("f",))
plots.plot_flight(reference, dr.Log.from_arrays(t, signals), {str(tmp_path / "a.svg")!r})
assert "matplotlib.pyplot" not in sys.modules
assert settings() == before
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_file_that_cannot_be_written_leaves_what_was_there(tmp_path, monkeypatch):
    target = tmp_path / "a.png"
    target.write_text("before")

    def full(*arguments, **options):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(SettingsError, match=r'cannot write ".*a\.png": No space left on device'):
        plot_flight(trajectory(), flown(), target)
    assert target.read_text() == "before"
    assert list(tmp_path.iterdir()) == [target]
    with pytest.raises(SettingsError, match="No such file or directory"):
        plot_flight(trajectory(), flown(), tmp_path / "nowhere" / "a.png")


# ---------------------------------------------------------------------- senseless arguments


def test_arguments_without_meaning_are_refused(tmp_path):
    reference, log = trajectory(), flown()
    for arguments, message in (
        ((reference, log, tmp_path / "a.gif"), r"its ending is not known; use one of \.png, \.svg, \.pdf"),
        ((reference, {}), "no flight to draw"),
        (({"a": reference}, {"b": log}), "the trajectories have the labels a, the logs b"),
        (({"a": reference}, log), "the trajectories have the labels a, the logs flown"),
        ((log, reference), '"flown" is a Log and a Trajectory; give a Trajectory and a Log'),
        ((Trajectory(T, np.zeros((N, 2)), np.zeros((N, 1))), log), 'of "flown" does not name its states'),
        (({"a": reference, "b": trajectory(states=STATES[:2])}, {"a": log, "b": log}), '"b" has other states'),
    ):
        with pytest.raises(SettingsError, match=message):
            plot_flight(*arguments)
    with pytest.raises(LogError, match='signal "theta_dot" is missing'):
        plot_flight(reference, Log.from_arrays(T, {k: v for k, v in columns().items() if k != "theta_dot"}))
    assert not list(tmp_path.iterdir())
