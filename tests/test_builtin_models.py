"""Built-in models against machines that are simulated independently, from the parameters of a drawing."""

from dataclasses import dataclass

import pytest

import diransac as dr
import machines
from diransac.identification.structure.structural import structural
from machines import MACHINES, recorded


@dataclass(frozen=True)
class Case:
    """A model, the parameters that must be known, noise of what is measured, and the largest errors admitted.

    `within` is the largest relative error with 8 % of outliers: ten times the standard error, or less.
    """

    model: dr.Model
    noise: dict[str, float]
    within: float
    fixed: tuple[str, ...] = ()


DRIVE = machines.RADIUS, machines.TRACK
CASES = {
    "cart-pole": Case(dr.models.cart_pole(), {"x": 1e-3, "theta": 3e-3}, 0.01),
    "flexible-joint": Case(dr.models.flexible_joint(), {"motor": 5e-4, "load": 5e-4}, 0.02),
    "dc-motor": Case(dr.models.dc_motor(), {"angle": 0.01, "current": 0.05}, 0.02),
    "resistive-motor": Case(dr.models.dc_motor(neglect_inductance=True), {"angle": 0.01}, 0.001),
    "differential-drive": Case(dr.models.differential_drive(*DRIVE), {"x": 2e-3, "y": 2e-3, "yaw": 5e-3}, 0.005),
    "voltage-drive": Case(
        dr.models.differential_drive(*DRIVE, drive="voltage"), {"x": 2e-3, "y": 2e-3, "yaw": 5e-3}, 0.005, ("mass",)
    ),
    "single-track-vehicle": Case(
        dr.models.single_track_vehicle(machines.FRONT, machines.REAR),
        {"yaw_dot": 5e-3, "lateral_velocity": 0.03},
        0.02,
        ("mass",),
    ),
}
EVERY_CASE = pytest.mark.parametrize("name", CASES)


def known(name):
    """Values of the parameters that must be known."""
    return {parameter: MACHINES[name].truth[parameter] for parameter in CASES[name].fixed}


@EVERY_CASE
def test_equations_are_those_of_the_machine(name):
    result = dr.identify(CASES[name].model, recorded(name), "ols", fixed=known(name))
    assert dict(result.parameters) == pytest.approx(MACHINES[name].truth, rel=1e-9)
    assert result.inlier_fraction == 1.0


def assert_within_intervals(name, result, within):
    """The errors are below a limit, and below four standard errors.

    But for what dry friction, which switches within a step, leaves to an integrator: derivatives of a simulation do not
    contain that it switches earlier or later.
    """
    truth = MACHINES[name].truth
    switches = 1e-3 if "dry" in " ".join(truth) else 0.0
    for parameter, value in result.parameters.items():
        error = abs(value - truth[parameter])
        assert error <= within * truth[parameter], parameter
        assert error <= max(4.0 * result.standard_errors[parameter], switches * truth[parameter]), parameter


@pytest.mark.slow
@EVERY_CASE
def test_parameters_are_within_their_intervals_with_noise_and_outliers(name):
    case = CASES[name]
    log = recorded(name, case.noise, outliers=0.08, seed=1)
    result = dr.identify(case.model, log, fixed=known(name), differentiate=True)
    assert_within_intervals(name, result, case.within)
    for signal in case.noise:
        assert result.diagnosis.noise_std[signal] == pytest.approx(case.noise[signal], rel=0.15)
        assert result.diagnosis.outlier_fraction[signal] == pytest.approx(0.08, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "noise", "fixed", "within"),
    [
        ("dc-motor", {"angle": 0.01}, ("torque_constant", "resistance"), 0.1),
        ("voltage-drive", {"yaw_rate": 0.02, "left_wheel": 0.1, "right_wheel": 0.1}, ("mass",), 0.02),
    ],
)
def test_what_vehicles_and_drives_usually_measure_is_enough(name, noise, fixed, within):
    """The current of a motor and a robot's pose are unmeasured."""
    log = recorded(name, noise, outliers=0.08, seed=1)
    values = {parameter: MACHINES[name].truth[parameter] for parameter in fixed}
    result = dr.identify(CASES[name].model, log, fixed=values, differentiate=True)
    assert_within_intervals(name, result, within)


@EVERY_CASE
def test_a_scale_that_no_log_determines_is_that_of_the_documented_parameter(name):
    model = CASES[name].model
    named = [ambiguity.names[0] for ambiguity in structural(model)]
    assert named == list(CASES[name].fixed)
    if named:
        assert structural(model.with_fixed(known(name))) == ()


def test_an_upright_pole_has_the_equations_of_a_hanging_one_half_a_turn_away():
    time, signals, inputs = machines.simulate("cart-pole")
    log = dr.Log.from_arrays(time, {**signals, "theta": signals["theta"] - machines.np.pi, **inputs})
    result = dr.identify(dr.models.cart_pole(upright=True), log, "ols")
    assert dict(result.parameters) == pytest.approx(MACHINES["cart-pole"].truth, rel=1e-9)


def test_a_drive_without_a_name_is_refused():
    with pytest.raises(dr.ModelError, match="drive is 'current'; choose torque or voltage"):
        dr.models.differential_drive(drive="current")
