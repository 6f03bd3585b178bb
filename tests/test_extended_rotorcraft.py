"""The paper's extended plant against eq. (20), written out once more, and against what physics demands."""

from itertools import product
from math import cos, pi, sin, sqrt

import numpy as np
import pytest

import diransac as dr
from diransac.errors import ModelError
from diransac.model.library import BLADE_FLAPPING, TABLE_I, extended_rotorcraft, planar_rotorcraft
from diransac.simulation import RolloutBatch, rollouts

M, I, C = TABLE_I.values()
G, CT, CP, D, L, LZ, RHO = 9.81, 0.06, 0.06, 0.127, 0.177, 0.01, 1.225
EVERY_WORLD = list(product(("physical", "printed"), ("integrated", "instantaneous")))
EVERYTHING = {"aerodynamic_imbalance": (1.4e-6, 1.1e-6), "mass_imbalance": (1.2e-4, 0.9e-4)}


def rotor_speeds(u, convention):
    """Turns a second of both rotors, eqs. (9) to (11)."""
    couple = u[1] / L if convention == "printed" else u[1]
    return [sqrt(max((u[0] + sign * couple) / 2, 0.0) / (CT * RHO * D**4)) for sign in (-1, 1)]


def accelerations_of_eq_20(x, u, angles, convention, gamma, dm):
    """Eq. (20), literally, with eqs. (13) to (19)."""
    theta, vx, vz = x[2], x[3], x[4]
    ax = -u[0] * sin(theta) / M - C / M * abs(u[0]) * vx * cos(theta)
    az = u[0] * cos(theta) / M - G - C / M * abs(u[0]) * vz * sin(theta)
    at = L / I * u[1]
    for i, n in enumerate(rotor_speeds(u, convention)):
        r_proj = D / 2 * cos(angles[i])
        T_a = gamma[i] * RHO * n**2
        Q_a = 4 * pi * CP / CT * gamma[i] * RHO * n**2 * r_proj
        tau_c = dm[i] * (2 * pi * n) ** 2 * r_proj * LZ
        F_g, tau_g = dm[i] * G, dm[i] * G * r_proj
        by_mass, by_inertia = (M, I) if convention == "physical" else (1.0, 1.0)
        az += (T_a + F_g) / by_mass
        at += (Q_a + tau_c + tau_g) / by_inertia
    return np.array([ax, az, at])


def lively_inputs(n_rows, dt):
    """Thrust about the weight, and moments of both signs."""
    t = np.arange(n_rows)[:, None] * dt
    return np.hstack([M * G * (1 + 0.3 * np.sin(2 * t)), 0.05 * np.cos(5 * t) + 0.01 * np.sin(17 * t)])


@pytest.mark.parametrize(("convention", "phase"), EVERY_WORLD)
def test_dynamics_are_eq_20(convention, phase):
    plant = extended_rotorcraft(*EVERYTHING.values(), convention, phase)
    rng = np.random.default_rng(2)
    for _ in range(20):
        x, u = rng.uniform(-2, 2, 6), np.array([rng.uniform(0, 5), rng.uniform(-1, 1)])
        t, own = rng.uniform(0, 30), rng.uniform(0, 2000, 2)
        n = rotor_speeds(u, convention)
        angles = own if phase == "integrated" else [2 * pi * k * t for k in n]
        wanted = accelerations_of_eq_20(x, u, angles, convention, (1.4e-6, 1.1e-6), (1.2e-4, 0.9e-4))
        hidden = own if phase == "integrated" else [t]
        rates, found = plant.simulated.dynamics(np.concatenate([x, hidden]), u, plant.constants)
        np.testing.assert_allclose(np.array(found).ravel(), wanted, rtol=1e-11, atol=1e-11)
        if phase == "integrated":
            np.testing.assert_allclose(np.array(rates).ravel()[6:], 2 * pi * np.array(n), rtol=1e-14)


@pytest.mark.parametrize(("convention", "phase"), EVERY_WORLD)
def test_compiled_flight_agrees_with_a_plain_loop_over_eq_20(convention, phase):
    gamma, dm = (1.4e-6, 1.1e-6), (1.2e-4, 0.9e-4)
    plant, dt, substeps = extended_rotorcraft(gamma, dm, convention, phase), 0.01, 24
    inputs = lively_inputs(40, dt)
    engine = rollouts(plant.simulated, substeps=substeps)
    flown = engine.trajectories(RolloutBatch([plant.constants], plant.initial_state(np.zeros(6)), inputs, dt))[0]
    accelerations = flown[:, -3:]

    def rates(x, t, own, u):
        n = np.array(rotor_speeds(u, convention))
        angles = own if phase == "integrated" else 2 * pi * n * t
        return np.concatenate([x[3:], accelerations_of_eq_20(x, u, angles, convention, gamma, dm)]), 2 * pi * n

    x, own, t, h = np.zeros(6), np.zeros(2), 0.0, dt / substeps
    for row, u in enumerate(inputs):
        np.testing.assert_allclose(flown[row, :6], x, atol=1e-9)
        np.testing.assert_allclose(accelerations[row], rates(x, t, own, u)[0][3:], rtol=1e-8, atol=1e-8)
        for _ in range(substeps):
            k1, w = rates(x, t, own, u)
            k2, _ = rates(x + h / 2 * k1, t + h / 2, own + h / 2 * w, u)
            k3, _ = rates(x + h / 2 * k2, t + h / 2, own + h / 2 * w, u)
            k4, _ = rates(x + h * k3, t + h, own + h * w, u)
            x, own, t = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), own + h * w, t + h


@pytest.mark.parametrize(("convention", "phase"), EVERY_WORLD)
def test_without_imbalance_it_is_the_baseline_to_rounding(convention, phase):
    plant = extended_rotorcraft(convention=convention, phase=phase)
    inputs = lively_inputs(1000, 0.01)
    with_rotors = rollouts(plant.simulated, substeps=4).trajectories(
        RolloutBatch([plant.constants], plant.initial_state(np.zeros(6)), inputs, 0.01)
    )[0]
    baseline = rollouts(planar_rotorcraft(), substeps=4).trajectories(
        RolloutBatch([[M, I, C]], np.zeros(6), inputs, 0.01)
    )[0]
    own = len(plant.simulated.own_states)
    flown = np.delete(with_rotors, np.s_[6 : 6 + own], axis=1)
    np.testing.assert_allclose(flown, baseline, rtol=1e-13, atol=1e-13 * np.abs(baseline).max())


def test_energy_changes_by_the_work_of_the_rotors_alone():
    """Without drag: d/dt (m v^2/2 + I w^2/2 + m g z) is the power of thrust and torque."""
    plant = extended_rotorcraft(parameters={**TABLE_I, "drag": 0.0})
    dt = 1e-3
    inputs = lively_inputs(4001, dt)
    flown = rollouts(plant.simulated).trajectories(
        RolloutBatch([plant.constants], plant.initial_state([0, 0, 0.3, 1.0, 0.5, 0]), inputs, dt)
    )[0]
    _, z, theta, vx, vz, w = flown[:, :6].T
    energy = M / 2 * (vx**2 + vz**2) + I / 2 * w**2 + M * G * z
    # The force is constant over a step: in the world's axes its work is F dx, with F's direction at the midpoint.
    middle = (theta[1:] + theta[:-1]) / 2
    along = -np.sin(middle) * np.diff(flown[:, 0]) + np.cos(middle) * np.diff(z)
    work = np.cumsum(inputs[:-1, 0] * along + L * inputs[:-1, 1] * np.diff(theta))
    assert np.ptp(energy) > 0.5
    np.testing.assert_allclose(energy[1:] - energy[0], work, atol=2e-6 * np.ptp(energy))


def test_drag_takes_the_energy_that_eq_4_says():
    plant = extended_rotorcraft()
    dt = 1e-3
    inputs = np.tile([M * G, 0.0], (3001, 1))
    flown = rollouts(plant.simulated).trajectories(
        RolloutBatch([plant.constants], plant.initial_state([0, 0, 0, 3.0, 0, 0]), inputs, dt)
    )[0]
    speed = flown[:, 3]
    # Upright, only x moves: m x'' = -C u x'.
    np.testing.assert_allclose(speed, 3.0 * np.exp(-C * G * np.arange(3001) * dt), rtol=1e-12)


def test_momentum_is_the_integral_of_forces_and_torques():
    plant = extended_rotorcraft(parameters={**TABLE_I, "drag": 0.0})
    inputs = np.column_stack([np.zeros(500), 0.02 * np.sin(np.arange(500) * 0.05)])
    flown = rollouts(plant.simulated).trajectories(
        RolloutBatch([plant.constants], plant.initial_state([0, 0, 0.4, 1.5, 2.0, 0]), inputs, 0.01)
    )[0]
    t = np.arange(500) * 0.01
    np.testing.assert_allclose(flown[:, 3], 1.5, rtol=1e-14)
    np.testing.assert_allclose(M * flown[:, 4], M * 2.0 - M * G * t, rtol=1e-12, atol=1e-12)
    spin = np.concatenate([[0.0], np.cumsum(L * inputs[:-1, 1] * 0.01)])
    np.testing.assert_allclose(I * flown[:, 5], spin, atol=1e-15)


@pytest.mark.parametrize("convention", ["physical", "printed"])
def test_eight_steps_a_turn_resolve_the_rotors_and_the_error_falls_with_the_fourth_power(convention):
    plant = extended_rotorcraft(*EVERYTHING.values(), convention)
    inputs = np.tile([M * G, 0.0], (300, 1))

    def state(substeps):
        engine = rollouts(plant.simulated, substeps=substeps)
        return engine.trajectories(RolloutBatch([plant.constants], plant.initial_state(np.zeros(6)), inputs, 0.01))[0][
            -1, :6
        ]

    turns = 0.01 * rotor_speeds([M * G, 0.0], convention)[0]
    exact = state(400)
    eight, sixteen, chosen = (
        np.abs(state(n) - exact).max() for n in (round(8 * turns), round(16 * turns), plant.substeps(0.01))
    )
    assert 2.4 < turns < 2.6
    assert plant.substeps(0.01) / (turns * sqrt(2)) >= 8
    assert chosen < eight < 2e-5
    assert 10 < eight / sixteen < 24


def test_the_mean_thrust_of_aerodynamic_imbalance_hides_eight_percent_of_the_mass():
    """`paper/notes.md`: the force is proportional to the thrust, so a mass of m / (1 + gamma / (C_T D^4)) is seen."""
    plant = extended_rotorcraft(1.4e-6)
    seen = M / (1 + 1.4e-6 / (CT * D**4))
    _, a = plant.simulated.dynamics(np.concatenate([np.zeros(6), [pi / 2, pi / 2]]), [seen * G, 0.0], plant.constants)
    np.testing.assert_allclose(np.array(a).ravel(), 0.0, atol=1e-12)
    assert seen / M == pytest.approx(0.918, abs=1e-3)


def test_blades_that_differ_by_2_percent_have_the_imbalance_of_table_2():
    """1.5 to 2.5 % in both C_T and D give 1.2e-6 to 2.0e-6 m^4 by eq. (12); the table says 1.0e-6 to 1.8e-6."""
    low, high = (
        CT * (1 + d / 2) * (D * (1 + d / 2)) ** 4 - CT * (1 - d / 2) * (D * (1 - d / 2)) ** 4 for d in (0.015, 0.025)
    )
    assert low == pytest.approx(1.17e-6, rel=0.01)
    assert high == pytest.approx(1.95e-6, rel=0.01)


def test_mass_effects_can_be_switched_off_one_by_one():
    x, u = np.concatenate([np.zeros(6), [0.3, 1.1]]), [M * G, 0.0]

    def accelerations(**options):
        plant = extended_rotorcraft(mass_imbalance=1e-4, **options)
        return np.array(plant.simulated.dynamics(x, u, plant.constants)[1]).ravel()

    both, rotational, gravitational, none = (
        accelerations(mass_effects=effects)
        for effects in (("rotational", "gravitational"), ("rotational",), ("gravitational",), ())
    )
    np.testing.assert_allclose(rotational + gravitational - none, both, atol=1e-12)
    np.testing.assert_allclose(gravitational[1], 2 * 1e-4 * G / M, rtol=1e-9)
    assert rotational[1] == pytest.approx(0.0, abs=1e-12)
    assert abs(rotational[2]) > 20 * abs(gravitational[2])


def test_flapping_tilts_the_thrust_back_by_the_angle_of_blade_element_theory():
    plant = extended_rotorcraft(blade_flapping=BLADE_FLAPPING)
    still, moving = np.zeros(8), np.array([0, 0, 0, 2.0, 0, 0, 0, 0])
    u = [M * G, 0.0]
    at_rest, found = (np.array(plant.simulated.dynamics(x, u, plant.constants)[1]).ravel() for x in (still, moving))
    mu = 2.0 / (pi * D * rotor_speeds(u, "physical")[0])
    tilt = BLADE_FLAPPING * mu / (1 - mu**2 / 2)
    np.testing.assert_allclose(at_rest, 0.0, atol=1e-12)
    np.testing.assert_allclose(found[0], -G * sin(tilt) - C * G * 2.0, rtol=1e-12)
    np.testing.assert_allclose(found[1], G * (cos(tilt) - 1.0), rtol=1e-9)
    np.testing.assert_allclose(found[2], LZ * M * G * sin(tilt) / I, rtol=1e-12)
    inflow = sqrt(2 * CT / pi) / pi
    pitch = inflow + 16 * CT / (pi**3 * 0.12 * 5.7)
    assert pytest.approx(4 * pitch - 2 * inflow, abs=0.01) == BLADE_FLAPPING


def test_flapping_turns_with_the_vehicle():
    """In the body's axes it is the same at every attitude."""
    plant = extended_rotorcraft(blade_flapping=BLADE_FLAPPING, parameters={**TABLE_I, "drag": 0.0})
    forces = []
    for theta in (0.0, 0.7, -2.0):
        turn = np.array([[cos(theta), -sin(theta)], [sin(theta), cos(theta)]])
        x = np.concatenate([[0, 0, theta], turn @ [2.0, 0.5], np.zeros(3)])
        a = np.array(plant.simulated.dynamics(x, [M * G, 0.1], plant.constants)[1]).ravel()
        forces.append([*(turn.T @ [a[0], a[1] + G]), a[2]])
    np.testing.assert_allclose(forces, np.tile(forces[0], (3, 1)), rtol=1e-12)


def test_a_stopped_rotor_disturbs_by_its_weight_alone():
    plant = extended_rotorcraft(*EVERYTHING.values(), blade_flapping=BLADE_FLAPPING)
    x = np.array([0, 0, 0, 5.0, 0, 0, pi / 2, pi / 2])
    _, a = plant.simulated.dynamics(x, [0.0, 0.0], plant.constants)
    np.testing.assert_allclose(np.array(a).ravel(), [0.0, -G + (1.2e-4 + 0.9e-4) * G / M, 0.0], atol=1e-12)


def test_rotors_may_start_anywhere():
    plant = extended_rotorcraft(rotor_phase=None)
    starts = np.array([plant.initial_state(np.zeros(6), seed)[6:] for seed in range(50)])
    assert len(np.unique(starts)) == 100
    np.testing.assert_array_equal(
        extended_rotorcraft(rotor_phase=(0.1, 0.2)).initial_state(np.zeros(6))[6:], [0.1, 0.2]
    )


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"convention": "real"}, "convention is 'real'; choose physical or printed"),
        ({"phase": "random"}, "phase is 'random'; choose integrated or instantaneous"),
        ({"mass_effects": ("centrifugal",)}, "mass_effects is 'centrifugal'; choose rotational or gravitational"),
        ({"parameters": {"mass": 1.0}}, "parameters are mass, inertia, drag; found mass"),
        ({"aerodynamic_imbalance": float("nan")}, "aerodynamic_1 is nan; give a finite number"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments, says):
    with pytest.raises(ModelError, match=says):
        dr.models.extended_rotorcraft(**arguments)


def test_flapping_of_a_rotor_that_hardly_turns_stays_small():
    """The formula has a pole at an advance ratio of sqrt(2); a rotor so slow has no thrust to tilt either."""
    plant = extended_rotorcraft(blade_flapping=BLADE_FLAPPING, convention="printed")
    x = np.array([0, 0, 0, 5.0, 0, 0, 0, 0])
    without = extended_rotorcraft(convention="printed")
    for moment in np.linspace(0.2, 0.6, 101):  # eq. (9) stops the first rotor at 0.43 N
        u = [M * G, moment]
        a, plain = (np.array(one.simulated.dynamics(x, u, one.constants)[1]).ravel() for one in (plant, without))
        assert np.abs(a - plain)[:2].max() < 0.5
