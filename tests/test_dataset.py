"""One model over one log: which rows count, what is held, what is refused, where a simulation starts."""

from dataclasses import replace

import numpy as np
import pytest

import diransac as dr
from diransac.data.dataset import Dataset, bind_log
from diransac.errors import LogError, SettingsError
from diransac.identification.regression.rows import regression
from diransac.model.library import builtin
from simulated import MACHINES, as_log, flight
from user_models import tumbling

PLANE, VEHICLE = MACHINES["planar-rotorcraft"], MACHINES["underwater-vehicle"]
MODEL = builtin("planar-rotorcraft")
N, DT = 80, 0.02
EVERY_ROW = tuple(range(N))


def plane_log(changes=None, without=(), units=None, more=None):
    """A clean flight with some samples changed, {(row or rows, name): value}, or signals left out."""
    signals, inputs = flight(PLANE, N, DT)
    log = as_log(PLANE, signals, inputs, DT)
    columns = {name: np.array(log[name]) for name in log.names if name not in without} | (more or {})
    for (rows, name), value in dict(changes or {}).items():
        columns[name][np.array(rows)] = value
    return dr.Log.from_arrays(log.time, columns, units, source='log "flight.csv"')


# ---------------------------------------------------------------------- rows that count


def test_every_row_of_a_whole_log_counts():
    segment = bind_log(MODEL, plane_log())
    assert (len(segment), segment.n_rows, segment.offset) == (N, N, 0)
    assert segment.notes == ()


def test_row_with_nan_in_a_signal_in_use_is_skipped_counted_and_said():
    changes = {(7, "x_ddot"): np.nan, (7, "theta"): np.nan, (20, "z_dot"): np.nan}
    segment = bind_log(MODEL, plane_log(changes))
    assert np.flatnonzero(~segment.valid).tolist() == [7, 20]
    assert segment.n_rows == N - 2
    assert any("2 of 80 rows were skipped" in note for note in segment.notes)


def test_nan_in_a_signal_that_nothing_uses_is_harmless():
    """Position is in no equation; a column of another name in none at all, not even where it is infinite."""
    log = plane_log({(7, "x"): np.nan}, more={"battery": np.full(N, np.inf)})
    assert bind_log(MODEL, log).valid.all()


def test_signal_that_judges_is_in_use():
    assert not bind_log(MODEL, plane_log({(7, "x"): np.nan}), also=("x",)).valid[7]


def test_nan_of_an_input_is_held_from_the_last_good_sample_and_counted():
    changes = {(10, "thrust"): np.nan, (11, "thrust"): np.nan, (11, "moment"): np.nan}
    log = plane_log(changes)
    segment = bind_log(MODEL, log)
    assert segment.valid.all()
    assert segment.inputs[11].tolist() == [log["thrust"][9], log["moment"][10]]
    assert any("held" in note and "2 rows" in note for note in segment.notes)


def test_gap_in_the_inputs_ends_a_stretch_and_its_rows_do_not_count():
    """A few samples are bridged; where more are missing, what is simulated is no longer what flew."""
    two, ten = tuple(range(5, 7)), tuple(range(30, 40))
    segment = bind_log(MODEL, plane_log({(two, "thrust"): np.nan, (ten, "moment"): np.nan, (40, "x_ddot"): np.nan}))
    assert segment.notes[-2] == "inputs were held from the last good sample in 2 rows, where they are NaN"
    assert segment.notes[-1] == (
        "inputs or all sensors are unknown in 1 gap, the longest 0.22 s after t = 0.58 s: simulations end there and "
        "begin again after it"
    )
    assert segment.stretches == (slice(0, 30), slice(41, len(segment)))
    assert not segment.valid[30:41].any()
    assert segment.valid[[*range(30), *range(41, len(segment))]].all()
    assert not any("gap" in note for note in bind_log(MODEL, plane_log({(two, "thrust"): np.nan})).notes)


@pytest.mark.parametrize(("n_rows", "is_gap"), [(11, False), (12, True)])
def test_silence_of_all_sensors_for_a_quarter_of_a_second_is_a_gap(n_rows, is_gap):
    rows = tuple(range(30, 30 + n_rows))
    segment = bind_log(MODEL, plane_log({(rows, name): np.nan for name in MODEL.signals}))
    assert len(segment.stretches) == 1 + is_gap


def test_rare_samples_are_no_gaps():
    silent = tuple(k for k in range(1, N) if k % 20)
    segment = bind_log(MODEL, plane_log({(silent, name): np.nan for name in MODEL.signals}), pointwise=False)
    assert not segment.gaps.any()


def test_input_unknown_from_the_start_is_not_held():
    assert not any("held" in note for note in bind_log(MODEL, plane_log({(range(5), "thrust"): np.nan})).notes)


def test_log_starts_where_everything_in_use_is_known():
    """An input that has no good sample yet cannot be held; a simulation cannot start without a state."""
    segment = bind_log(MODEL, plane_log({(0, "thrust"): np.nan, (1, "z_dot"): np.nan}))
    assert segment.offset == 2
    assert len(segment) == N - 2
    assert segment.valid.all()


def test_log_without_one_whole_row_is_refused():
    even, odd = tuple(range(0, N, 2)), tuple(range(1, N, 2))
    log = plane_log({(even, "x_ddot"): np.nan, (odd, "z_ddot"): np.nan})
    with pytest.raises(LogError, match=r'log "flight.csv": no row has a value in every signal'):
        bind_log(MODEL, log)


@pytest.mark.parametrize(
    ("value", "says"), [(np.nan, "NaN in every row"), (np.inf, "infinite at row 0"), (1e200, "square overflows")]
)
def test_signal_that_cannot_serve_is_refused_by_name(value, says):
    with pytest.raises(LogError, match=f'"x_ddot".*{says}'):
        bind_log(MODEL, plane_log({(EVERY_ROW, "x_ddot"): value}))


@pytest.mark.parametrize(("name", "hint"), [("theta_ddot", "--differentiate"), ("thrust", "--map"), ("theta", "--map")])
def test_missing_signal_is_refused_with_what_was_found_and_what_to_try(name, hint):
    with pytest.raises(LogError, match=f'"{name}" is missing; found t, x, .*{hint}') as caught:
        bind_log(MODEL, plane_log(without=[name]))
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(("name", "hint"), [("theta_ddot", "--differentiate"), ("moment", "--map")])
def test_column_that_is_no_signal_is_refused_with_the_reason(name, hint):
    log = replace(plane_log(without=[name]), unusable={name: 'is not numeric: line 9 holds "--"'})
    with pytest.raises(LogError, match=f'signal "{name}" is not numeric: line 9 holds "--"; .*{hint}'):
        bind_log(MODEL, log)


def test_signals_that_no_equation_names_may_be_missing():
    segment = bind_log(MODEL, plane_log(without=["x", "z"]))
    assert segment.signals == MODEL.signals[2:]


def test_log_and_its_arrays_are_left_alone():
    log = plane_log({(3, "thrust"): np.nan})
    before = log.fingerprint
    regression(Dataset.of(MODEL, log))
    assert log.fingerprint == before


# ---------------------------------------------------------------------- units and angles


@pytest.mark.parametrize(
    ("name", "unit", "factor"), [("theta", "deg", np.pi / 180.0), ("thrust", "kN", 1e3), ("x_ddot", "g", 9.80665)]
)
def test_unit_that_is_not_the_models_is_converted_with_a_note(name, unit, factor):
    log = plane_log(units={name: unit})
    segment = bind_log(MODEL, log)
    np.testing.assert_allclose(segment.log[name], factor * log[name], rtol=1e-15)
    assert segment.log.units[name] == MODEL.units[name]
    assert f"converted: {name} from {unit} to {MODEL.units[name]}" in segment.notes
    assert segment.log.history[-1] == {"step": "units", "from": {name: unit}, "to": {name: MODEL.units[name]}}


def test_unit_of_another_dimension_is_refused():
    with pytest.raises(LogError, match='"thrust" is in V, the model needs N; check the column'):
        bind_log(MODEL, plane_log(units={"thrust": "V"}))


def test_unit_in_another_spelling_is_the_same():
    bind_log(MODEL, plane_log(units={"x_ddot": "m s^-2", "theta_dot": "rad s^-1", "x": "m"}))


def test_angle_that_jumps_by_a_turn_is_unwrapped():
    signals, inputs = flight(PLANE, N, DT)
    signals[:, 2] += np.linspace(0.0, 20.0, N)
    wrapped = signals.copy()
    wrapped[:, 2] = (wrapped[:, 2] + np.pi) % (2 * np.pi) - np.pi
    segment = bind_log(MODEL, as_log(PLANE, wrapped, inputs, DT))
    assert segment.column("theta") == pytest.approx(signals[:, 2], abs=1e-12)


# ---------------------------------------------------------------------- regression and scales


@pytest.mark.parametrize("name", MACHINES)
def test_regression_is_that_of_the_rows_written_by_hand(name):
    machine = MACHINES[name]
    signals, inputs = flight(machine, 60, DT)
    W, b = regression(Dataset.of(builtin(name), as_log(machine, signals, inputs, DT)))
    by_hand = machine.rows(signals, inputs)
    assert pytest.approx(by_hand[0], rel=1e-12, abs=1e-12) == W
    assert b == pytest.approx(by_hand[1], rel=1e-12, abs=1e-12)


def test_regression_leaves_skipped_rows_out():
    changes = {(7, "x_ddot"): np.nan, (0, "z_dot"): np.nan}
    W, b = regression(Dataset.of(MODEL, plane_log(changes)))
    whole_W, whole_b = regression(Dataset.of(MODEL, plane_log()))
    kept = np.delete(np.arange(N), [0, 7])
    assert np.array_equal(W, whole_W[kept])
    assert np.array_equal(b, whole_b[kept])


def test_scale_of_a_signal_is_the_spread_of_its_bulk():
    """A tenth of the samples hit by outliers of magnitude 80 changes the scale by less than a quarter."""
    rng = np.random.default_rng(0)
    clean = rng.normal(0.0, 2.0, 4000)
    hit = clean + (rng.random(4000) < 0.1) * rng.uniform(-80, 80, 4000)
    time = np.arange(4000) * 0.01
    scales = [
        Dataset.of(
            builtin("underwater-vehicle"),
            dr.Log.from_arrays(time, {"x_dot": clean, "x_ddot": values, "thrust": clean}),
        ).scales["x_ddot"]
        for values in (clean, hit)
    ]
    assert scales[0] == pytest.approx(2.0, rel=0.05)
    assert scales[1] == pytest.approx(2.0, rel=0.25)


@pytest.mark.parametrize(("values", "scale"), [("constant", 0.0), ("mostly at rest", 1.0)])
def test_scale_of_a_signal_that_rests(values, scale):
    """Constant: none.  At rest for more than half of the time: that of what moves, not 0."""
    rng = np.random.default_rng(1)
    column = (
        np.full(1000, 0.1) if values == "constant" else np.where(rng.random(1000) < 0.6, 0.0, rng.normal(size=1000))
    )
    log = dr.Log.from_arrays(
        np.arange(1000) * 0.01, {"x_dot": rng.normal(size=1000), "x_ddot": column, "thrust": np.ones(1000)}
    )
    assert Dataset.of(builtin("underwater-vehicle"), log).scales["x_ddot"] == pytest.approx(scale, rel=0.6)


def test_setting_that_names_no_signal_is_refused():
    dataset = Dataset.of(MODEL, plane_log(without=["x"]))
    with pytest.raises(SettingsError, match='no signal "y_dot"; it has x, z, theta'):
        dataset.by_signal({"y_dot": 1.0})
    with pytest.raises(SettingsError, match='"x", which the log lacks'):
        dataset.by_signal({"x": 1.0})
    assert dataset.by_signal({"x": 0.0, "z": 2.0})[0] == 2.0


# ---------------------------------------------------------------------- initial states


def test_first_row_is_where_a_simulation_starts():
    log = plane_log()
    expected = [log[name][0] for name in MODEL.state]
    assert bind_log(MODEL, log).initial_state("first").tolist() == expected


def test_given_values_replace_those_of_the_first_row():
    start = bind_log(MODEL, plane_log()).initial_state({"z_dot": 3.0, "theta": -1.0})
    expected = bind_log(MODEL, plane_log()).initial_state("first")
    expected[[2, 4]] = [-1.0, 3.0]
    assert start.tolist() == expected.tolist()


def test_given_name_that_is_no_state_is_refused():
    with pytest.raises(SettingsError, match='"x_ddot"; the state is x, z, theta'):
        bind_log(MODEL, plane_log()).initial_state({"x_ddot": 1.0})


def test_robust_start_is_not_moved_by_outliers_in_the_first_rows():
    clean = plane_log()
    changes = {(row, name): 60.0 for row in (0, 4, 9) for name in MODEL.state}
    spoilt = bind_log(MODEL, plane_log(changes))
    truth = np.array([clean[name][0] for name in MODEL.state])
    usual_change = np.array([np.abs(np.diff(clean[name][:25])).max() for name in MODEL.state])
    assert (np.abs(spoilt.initial_state("robust") - truth) < 10 * usual_change).all()
    assert (np.abs(spoilt.initial_state("first") - truth) > 50).all()


def test_robust_start_takes_a_missing_velocity_from_its_coordinate():
    signals, inputs = flight(VEHICLE, 100, 0.002)
    log = as_log(VEHICLE, signals, inputs, 0.002)
    positions = dr.Log.from_arrays(log.time, {"x": log["x"], "thrust": log["thrust"]})
    segment = bind_log(builtin("underwater-vehicle"), positions, pointwise=False)
    assert segment.initial_state("robust") == pytest.approx(signals[0, :2], abs=0.03)
    with pytest.raises(LogError, match='needs the initial value of "x_dot", which the log lacks'):
        segment.initial_state("first")


def test_missing_state_on_which_nothing_measured_depends_starts_at_zero():
    segment = bind_log(MODEL, plane_log(without=["x", "z"]))
    assert segment.initial_state("first")[:2].tolist() == [0.0, 0.0]


def test_missing_state_on_which_something_measured_depends_is_refused_by_name():
    segment = bind_log(MODEL, plane_log(without=["theta_dot"]))
    with pytest.raises(LogError, match='"theta_dot", which the log lacks'):
        segment.initial_state("first")
    assert segment.initial_state({"theta_dot": 0.5})[5] == 0.5


def test_start_of_a_model_with_velocities_of_its_own_is_named_as_the_model_names_it():
    """The coordinates' rates are no velocities there: a body rate is never taken from a quaternion's slope."""
    model = tumbling()
    rng = np.random.default_rng(0)
    columns = {name: rng.normal(size=30) for name in (*model.coordinates, *model.inputs)}
    segment = bind_log(model, dr.Log.from_arrays(np.arange(30) * 0.01, columns), pointwise=False)
    with pytest.raises(LogError, match='"wx"'):
        segment.initial_state("robust")


def test_inputs_are_interpolated_in_lost_rows_and_held_in_others():
    log = plane_log({((20, 21), name): np.nan for name in (*MODEL.signals, *MODEL.inputs)} | {(30, "thrust"): np.nan})
    segment = bind_log(MODEL, log)
    thrust = segment.inputs[:, 0]
    np.testing.assert_allclose(thrust[20:22], np.interp([20, 21], [19, 22], log["thrust"][[19, 22]]), rtol=1e-12)
    assert thrust[30] == log["thrust"][29]
    assert "inputs were interpolated in 2 lost rows" in segment.notes
    assert "inputs were held from the last good sample in 1 rows, where they are NaN" in segment.notes
