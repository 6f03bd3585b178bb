"""The regimes' plants, logs, baselines and judgement."""

import numpy as np
import pytest
import regime_baselines as baselines
import regime_flights as flights
import regime_machines as machines
import regimes
from regime_judging import METHODS, UNRELIABLE, Record
from regime_output_error import output_error

from regime_logs import of_table

SHORT = 0.8
"""Seconds that are simulated where the length does not matter."""
EXACT = {name: regime for name, regime in flights.REGIMES.items() if regime.exact}
BY_PLANT = {(one.machine.name, one.machine.dt, one.machine.control, one.held): one for one in EXACT.values()}


def shortened(regime, **changes):
    duration = max(SHORT, 80 * regime.machine.dt)
    machine = flights.replace(regime.machine, duration=duration, **changes)
    return flights.replace(regime, machine=machine, fault=flights.Fault())


def stacked(recording, names):
    return np.stack([recording.exact[name] for name in names])


def residual(model, recording, factors):
    """Residuals of the model's equations (n_v, N) with each true parameter multiplied by a factor."""
    n_rows = len(recording.time)
    names = (model.coordinates, model.velocities, model.accelerations, model.inputs)
    p = np.array(list(recording.truth.values())) * factors
    return np.array(
        model.residual.map(n_rows)(*(stacked(recording, n) for n in names), np.repeat(p[:, None], n_rows, axis=1))
    )


@pytest.mark.parametrize("regime", BY_PLANT.values(), ids=lambda regime: regime.name)
def test_exact_signals_satisfy_the_models_equations_at_the_true_parameters(regime):
    model = regime.machine.model
    for recording in flights.recordings(shortened(regime), [1000, 1001]):
        size = np.abs(residual(model, recording, np.linspace(1.2, 1.8, model.n_p))).max(axis=1)
        assert (np.abs(residual(model, recording, 1.0)).max(axis=1) < 1e-10 * size).all()


@pytest.mark.parametrize("machine", [machines.QUAD, machines.DRIVE], ids=lambda machine: machine.name)
def test_a_plants_kinematics_are_the_models(machine):
    rng = np.random.default_rng(3)
    q, v = rng.normal(0.0, 0.5, (machine.n_q, 5)), rng.normal(0.0, 1.0, (machine.n_v, 5))
    np.testing.assert_allclose(machine.kinematics(q, v), np.array(machine.model.kinematics(q, v)), rtol=1e-12)


@pytest.mark.parametrize("regime", BY_PLANT.values(), ids=lambda regime: regime.name)
def test_other_steps_change_a_plants_motion_by_less_than_the_noise_of_clean_logs(regime):
    n = regime.machine.substeps
    coarse, usual, fine = (
        flights.recordings(shortened(regime, substeps=k), [1000])[0].exact for k in (max(1, n // 4), n, 2 * n)
    )
    for name, noise in regime.machine.noise.items():
        assert np.abs(usual[name] - fine[name]).max() < 1e-2 * noise, name
        assert np.abs(coarse[name] - fine[name]).max() < 0.1 * noise, name


def test_a_seeds_log_does_not_depend_on_the_seeds_beside_it_and_differs_from_theirs():
    regime = shortened(flights.REGIMES["rotor slight gusts"])
    alone, beside = flights.recordings(regime, [1001])[0], flights.recordings(regime, [1000, 1001])
    for name, values in alone.columns.items():
        np.testing.assert_array_equal(values, beside[1].columns[name])
        assert not np.array_equal(values, beside[0].columns[name])
    assert alone.truth == beside[1].truth != beside[0].truth


@pytest.mark.parametrize("regime", flights.REGIMES.values(), ids=lambda regime: regime.name)
def test_parameters_stay_within_30_percent_and_names_have_no_comma(regime):
    drawn = regime.machine.drawn([np.random.default_rng(k) for k in range(50)])
    for name, base in regime.machine.base.items():
        ratio = getattr(drawn, name) / base
        assert ratio.min() >= 1.0 / 1.3
        assert ratio.max() <= 1.3
        assert ratio.max() > 1.2
    assert "," not in regime.name
    assert set(regime.signals or ()) <= set(regime.machine.noise)


def test_a_late_signal_repeats_the_exact_one_and_a_gap_has_its_length():
    late = flights.REGIMES["rotor x and z 10 ms late"]
    recording = flights.recordings(
        flights.replace(late, noise=0.0, machine=flights.replace(late.machine, duration=2.0)), [1000]
    )[0]
    np.testing.assert_allclose(recording.columns["x"][1:], recording.exact["x"][:-1], atol=1e-12)
    np.testing.assert_array_equal(recording.columns["theta"], recording.exact["theta"])
    for name, inputs_missing in (("servo 1 s missing", 100), ("servo 1 s of sensors missing", 0)):
        regime = flights.REGIMES[name]
        regime = flights.replace(regime, machine=flights.replace(regime.machine, duration=6.0))
        columns = flights.recordings(regime, [1000])[0].columns
        assert np.isnan(columns["s"]).sum() == 100
        assert np.isnan(columns["force"]).sum() == inputs_missing


@pytest.mark.parametrize(("regime", "bound"), [("pendulum clean", 1.0), ("car continuous input", 3.0)])
@pytest.mark.parametrize("method", [baselines.ordinary, baselines.total, output_error])
def test_baselines_find_the_truth_of_an_exact_model(method, regime, bound):
    recording = of_table(regime, 1002)
    found = method(flights.REGIMES[regime], recording)
    assert max(abs(100.0 * (found[name] / x - 1.0)) for name, x in recording.truth.items()) < bound


def test_a_baseline_refuses_what_it_cannot_do():
    regime = flights.REGIMES["flexible joint motor angle"]
    recording = flights.recordings(shortened(regime), [1000])[0]
    record = METHODS["ols"](regime, 1000, recording)
    assert not record.errors
    assert "load_dot" in record.refusal


@pytest.mark.parametrize(
    ("verdict", "findings", "inside", "error", "wrong"),
    [
        ("usable", (), False, 6.0, True),
        ("usable with care", ("residuals are not white",), False, -6.0, True),
        ("usable", (), False, 4.0, False),
        ("usable", (), True, 60.0, False),
        (UNRELIABLE, (), False, 60.0, False),
        ("usable", ("x is logged 10 ms later than it is measured",), False, 60.0, False),
        ("usable", ("m is not identifiable from this log",), False, 60.0, False),
    ],
)
def test_confidently_wrong_is_off_without_a_warning_or_a_cause(verdict, findings, inside, error, wrong):
    record = Record("rotor noise 1x", 0, "lo", {"mass": error}, {"mass": inside}, verdict, findings)
    assert record.confidently_wrong is wrong


def test_the_table_has_a_row_per_regime_and_says_who_crashed(capsys, monkeypatch):
    records = [
        Record(
            "rotor noise 1x",
            0,
            "lo",
            {"mass": 1.0, "drag": -7.0},
            {"mass": True, "drag": False},
            "usable",
            inside_structural={"mass": True, "drag": True},
            widening={"mass": 1.5, "drag": 2.5},
        ),
        Record("rotor noise 1x", 1, "lo", refusal="LinAlgError: no", crashed=True),
        Record("rotor noise 1x", 0, "ols", {"mass": 1.0, "drag": -2.0}),
    ]
    monkeypatch.setattr(regimes, "_run_all", lambda *_: records)
    regimes.main(["--regimes", "rotor noise 1x", "--methods", "lo,ols"])
    lines = capsys.readouterr().out.splitlines()
    row = [cell.strip() for cell in lines[2].strip("|").split("|")]
    assert row == [
        "rotor noise 1x",
        "yes",
        "7 / 7",
        "0.50",
        "1.00",
        "2.00",
        "1/0/0",
        *"1010",
        "0, 1 crashed",
        "0.0",
        "2 / 2",
    ]
    assert "2 runs: 1 off, 1 confidently wrong (50.0 %)" in lines[-1]


def test_regimes_are_chosen_by_name_or_part_of_a_name():
    assert regimes._parsed(["--regimes", "arm clean,cart-pole 40"]).regimes == ["cart-pole 40 Hz", "arm clean"]
    assert regimes._parsed(["--seeds", "1000:1003"]).seeds == range(1000, 1003)
    with pytest.raises(SystemExit):
        regimes._parsed(["--regimes", "zeppelin"])
