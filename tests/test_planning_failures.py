"""What cannot be planned is refused in a sentence, what is interrupted stops, and nothing prints."""

import signal
import threading
import time

import numpy as np
import pytest

import diransac as dr
from diransac.errors import ModelError, PlanningError, SettingsError
from diransac.flight.planning.transcription import Program
from planned import LIMITS, MASS, ROTORCRAFT, across, mass, rotorcraft
from rolling import BODY

HOME = {"q0": 1.0, "q1": 0.0, "q2": 0.0, "q3": 0.0}


# ---------------------------------------------------------------------- plans that cannot be


def test_an_impossible_plan_names_the_waypoint_the_miss_and_the_limit():
    way = [{}, {"x": 0.3}, {"x": 2.0, "z": -2.0}, {"x": 4.0}]
    with pytest.raises(PlanningError) as error:
        dr.plan(ROTORCRAFT, waypoints=way, times=[0.0, 0.3, 0.6, 3.2], input_limits=LIMITS)
    words = str(error.value)
    assert "waypoint 2 (x = 2, z = -2) at t = 0.60 s is missed by" in words
    assert "give it more time" in words
    assert "thrust" in words


def test_the_named_miss_is_about_the_least_possible():
    # At full force from rest to rest a mass comes F T^2 / (4 m) = 0.75 m far in 2 s; 1 m is asked for. The nearest end
    # in the sense of least squares trades some of the missing 0.25 m for speed.
    with pytest.raises(PlanningError, match=r"waypoint 1 \(y = 1\) at t = 2.00 s is missed by 0\.[12]\d* m.*force"):
        dr.plan(mass(2.0), waypoints=[{}, {"y": 1.0}], times=[0.0, 2.0], input_limits={"force": (-1.5, 1.5)})


def test_a_state_limit_that_binds_is_named():
    with pytest.raises(PlanningError, match="raise the limits of y_dot"):
        dr.plan(mass(), waypoints=[{}, {"y": 1.0}], times=[0.0, 2.0], state_limits={"y_dot": (-0.4, 0.4)})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mass": 0.75}, "cannot rest at .* thrust would have to be 7.357, but may be 0 to 5"),
        ({"mass": -0.249}, "thrust would have to be -2.443"),
        ({"inertia": 0.4}, "waypoint 1 .* is missed by"),
        ({"mass": 1e-12}, "there is no plan: .* check the parameters"),
    ],
)
def test_parameters_that_are_wildly_off_fail_in_a_sentence(changes, words):
    before = time.monotonic()
    with pytest.raises(PlanningError, match=words):
        dr.square(rotorcraft(**changes))
    assert time.monotonic() - before < 30


@pytest.mark.parametrize("changes", [{"inertia": 1e-9}, {"drag": 50.0}, {"drag": -5.0}, {"mass": 0.45}])
def test_parameters_that_are_odd_end_in_a_plan_or_a_sentence(changes):
    outcome = None
    try:
        outcome = dr.square(rotorcraft(**changes), max_iterations=200, time_limit=3.0).states
    except PlanningError as error:
        outcome = str(error)
    assert "give" in outcome if isinstance(outcome, str) else np.isfinite(outcome).all()


def test_no_input_holds_a_falling_body():
    falling = dr.Model("stone", {"y": "m"}, {"spin": "N"}, {"g": dr.Parameter()}, lambda q, v, a, u, p: [a.y + p.g])
    with pytest.raises(
        PlanningError, match="no inputs make y_ddot zero; start elsewhere, or give the inputs of zero cost with trim="
    ):
        dr.plan(dr.Plant(falling, {"g": 9.81}), waypoints=[{}, {"y": 1.0}], times=[0.0, 1.0])


def test_trim_may_be_given_where_there_is_none():
    thrown = dr.Model("thrown", {"x": "m", "y": "m"}, {"push": "N"}, {"g": dr.Parameter()},
                      lambda q, v, a, u, p: [a.x - u.push, a.y + p.g])  # fmt: skip
    start, end = {"x": 0.0, "x_dot": 0.0, "y": 0.0, "y_dot": 9.81}, {"x": 1.0}
    found = dr.plan(
        dr.Plant(thrown, {"g": 9.81}),
        waypoints=[start, end],
        times=[0.0, 2.0],
        trim={"push": 0.0},
        start_end_at_rest=False,
    )
    assert found["y"].max() == pytest.approx(9.81 / 2, rel=1e-6)


def test_time_and_iterations_that_run_out_are_said():
    with pytest.raises(PlanningError, match="within 0 s; raise time_limit="):
        across(ROTORCRAFT, time_limit=0.0)
    with pytest.raises(PlanningError, match="after 1 iterations"):
        across(ROTORCRAFT, max_iterations=1)


# ---------------------------------------------------------------------- arguments that make no sense

TWO = [{}, {"y": 1.0}]
SENSELESS = {
    "nothing asked for": ({}, "needs waypoints=, or reference="),
    "one waypoint": ({"waypoints": [{}], "times": [0.0]}, "at least 2 waypoints"),
    "unknown state": ({"waypoints": [{}, {"z": 1.0}]}, 'waypoint 1: there is no state "z"; there are y, y_dot'),
    "NaN waypoint": ({"waypoints": [{}, {"y": np.nan}]}, "give a finite number"),
    "word for a number": ({"waypoints": [{}, {"y": "far"}]}, "give a finite number"),
    "times that fall": ({"waypoints": [{}, {}, {"y": 1.0}], "times": [0.0, 2.0, 1.0]}, "must increase"),
    "times too few": ({"waypoints": TWO, "times": [0.0]}, "each of the 2 waypoints"),
    "NaN time": ({"waypoints": TWO, "times": [0.0, np.nan]}, "finite number of seconds"),
    "times too near": ({"waypoints": TWO, "times": [0.0, 0.001]}, "at least 0.01 s"),
    "reference without duration": ({"reference": {"y": np.sin}}, "needs duration="),
    "waypoints and duration": ({"waypoints": TWO, "duration": 2.0}, "waypoints have times="),
    "reference at free times": ({"waypoints": TWO, "reference": {"y": np.sin}}, "need times="),
    "unknown reference": ({"reference": {"x": np.sin}, "duration": 1.0}, 'reference: there is no state "x"'),
    "NaN reference": ({"reference": {"y": lambda t: t * np.nan}, "duration": 1.0}, "NaN"),
    "one sample": ({"reference": {"y": [1.0]}, "duration": 1.0}, "at least 2 samples"),
    "weight without reference": ({"waypoints": TWO, "times": [0, 1], "state_weights": {"y": 1.0}}, "has no reference"),
    "negative weight": ({"waypoints": TWO, "times": [0, 1], "input_weights": {"force": -1.0}}, "at least 0"),
    "unknown input": ({"waypoints": TWO, "input_limits": {"push": (0, 1)}}, 'there is no input "push"'),
    "limits upside down": ({"waypoints": TWO, "input_limits": {"force": (1, 0)}}, "must be .lowest, highest."),
    "waypoint out of limits": ({"waypoints": TWO, "state_limits": {"y": (0, 0.5)}}, "move the waypoint or the limits"),
    "no share": ({"waypoints": TWO, "input_limit_fraction": 0.0}, "above 0 and at most 1"),
    "negative time weight": ({"waypoints": TWO, "time_weight": -1.0}, "time_weight"),
    "unknown trim": ({"waypoints": TWO, "trim": {"push": 1.0}}, 'there is no input "push"'),
    "no iterations": ({"waypoints": TWO, "max_iterations": 0}, "max_iterations"),
}


@pytest.mark.parametrize(("options", "words"), SENSELESS.values(), ids=SENSELESS)
def test_senseless_arguments_are_refused_by_name(options, words):
    with pytest.raises(SettingsError, match=words):
        dr.plan(mass(), **options)


@pytest.mark.parametrize(
    ("first", "words"), [({}, "leaves the attitude open"), ({**HOME, "q0": 0.5}, "its norm is 0.5, not 1")]
)
def test_quaternions_must_be_said_and_be_ones(first, words):
    plant = dr.Plant(BODY, {"p0": 1.0, "p1": 1.5, "p2": 2.0})
    with pytest.raises(SettingsError, match=words):
        dr.plan(plant, waypoints=[first, HOME], times=[0.0, 1.0])


def test_a_guess_of_another_model_is_refused():
    other = dr.plan(mass(), waypoints=TWO, times=[0.0, 1.0])
    with pytest.raises(SettingsError, match="guess= is a trajectory of y, y_dot, force"):
        across(ROTORCRAFT, guess=other)


def test_parameters_that_are_not_numbers_are_refused():
    with pytest.raises(ModelError, match="finite"):
        dr.Plant(MASS, {"mass": np.nan})


@pytest.mark.parametrize("flight", [dr.square, dr.star, dr.sine])
def test_flights_need_x_and_z(flight):
    with pytest.raises(SettingsError, match='model "mass" has no coordinate x: it has y'):
        flight(mass())


# ---------------------------------------------------------------------- silence, and being stopped


def test_nothing_is_printed(capfd):
    across(ROTORCRAFT, times=None)
    with pytest.raises(PlanningError):
        across(ROTORCRAFT, times=[0.0, 0.3, 0.6])
    with pytest.raises(PlanningError):
        across(ROTORCRAFT, time_limit=0.0)
    assert capfd.readouterr() == ("", "")


@pytest.fixture
def interruptible():
    """Ctrl-C as a terminal has it; a shell's background jobs ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_stops_the_search(monkeypatch, capfd):
    plain, calls = Program.constraints, []

    def interrupted(self, *arguments):
        calls.append(arguments)
        if len(calls) == 3:
            signal.raise_signal(signal.SIGINT)
        return plain(self, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(Program, "constraints", interrupted)
        with pytest.raises(KeyboardInterrupt):
            across(ROTORCRAFT)
    assert len(calls) == 3
    assert capfd.readouterr() == ("", "")
    assert across(ROTORCRAFT).cost > 0  # and the next plan is made as if nothing had been


def test_an_error_in_the_midst_of_a_search_is_not_swallowed(monkeypatch):
    def broken(*_):
        raise ZeroDivisionError("planted")

    monkeypatch.setattr(Program, "gradient", broken)
    with pytest.raises(ZeroDivisionError, match="planted"):
        across(ROTORCRAFT)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_at_any_moment_stops_the_search():
    """CasADi swallows half of the interrupts that it is left to find by itself."""
    far_off = rotorcraft(inertia=1e-5)
    for moment in (0.1, 0.17, 0.23, 0.31):
        threading.Timer(moment, signal.raise_signal, [signal.SIGINT]).start()
        with pytest.raises(KeyboardInterrupt):
            dr.sine(far_off, max_iterations=3000)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
