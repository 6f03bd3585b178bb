"""Sensors: measurement equations in models, in simulations, and in every method."""

import copy
import json
import pickle

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import diransac as dr
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.identification.assessment.inspection import inspect
from diransac.identification.regression.observers import driven_states
from diransac.identification.structure.lacking_terms import Suggestion, with_terms
from diransac.model import expressions
from diransac.simulation import Measurements, RolloutBatch, rollouts
from instruments import INSTRUMENTS, TRUTH, flight, recorded

DERIVED = tuple(f"{n}{end}" for end in ("_dot", "_ddot") for n in ("x", "z", "theta"))
TRUE = {**TRUTH, **INSTRUMENTS}
ROTORCRAFT = dr.models.planar_rotorcraft()


def rotorcraft(sensors, parameters=None):
    """The planar rotorcraft with sensors."""
    base = ROTORCRAFT

    def equations(q, v, a, u, p):
        vectors = [ca.vertcat(*x) for x in (q, v, a, u)]
        return list(ca.vertsplit(base.residual(*vectors, ca.vertcat(p.mass, p.inertia, p.drag))))

    known = {**base.parameters, **(parameters or {})}
    return dr.Model("rotorcraft", base.coordinates, base.inputs, known, equations, sensors=sensors)


def imu(**options):
    """An accelerometer whose lever arm is estimated, and a gyroscope with a scale factor."""
    arm = dr.sensors.accelerometer(("x", "z"), "theta", lever_arm="estimated", **options)
    return {**arm, **dr.sensors.gyroscope("theta", scale=True)}


def as_log(columns, **others):
    columns = {**columns, **others}
    return dr.Log.from_arrays(columns["t"], {n: x for n, x in columns.items() if n != "t"}, source="flight")


@pytest.fixture(scope="module")
def columns():
    return flight(0)


@pytest.fixture(scope="module")
def model():
    return rotorcraft(imu())


# ---------------------------------------------------------------------- ready-made sensors


def value(sensor, p=None, **groups):
    """The number that a sensor shows, from named components of its arguments."""
    model_of = {n: type("Components", (dict,), {"__getattr__": dict.__getitem__})(x) for n, x in groups.items()}
    empty = type("Components", (dict,), {"__getattr__": dict.__getitem__})
    arguments = [model_of.get(n, empty()) for n in "qvau"]
    return float(ca.DM(ca.evalf(ca.SX(sensor.equation(*arguments, empty(p or {}))))))


def pose(seed=3):
    """A random attitude, world acceleration, body rates and their derivatives, by name."""
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=4)
    x, y, z, w = R.as_quat()
    vectors = rng.normal(size=(3, 3))
    named = [
        dict(zip(names, x, strict=True))
        for names, x in zip(("xyz", ("wx", "wy", "wz"), ("wx", "wy", "wz")), vectors, strict=True)
    ]
    return R.as_matrix(), {"qw": w, "qx": x, "qy": y, "qz": z}, *named, *vectors


def test_accelerometer_with_lever_arm_measures_the_specific_force_at_its_place():
    R, q, a, v, alpha, acceleration, w, dw = pose()
    arm, names = np.array([0.1, -0.2, 0.05]), ("qw", "qx", "qy", "qz")
    made = dr.sensors.accelerometer(tuple("xyz"), names, rates=("wx", "wy", "wz"), lever_arm=arm, bias=False)
    found = [value(x, q=q, v=v, a={**a, **alpha}) for x in made.values()]
    at_place = acceleration + R @ (np.cross(dw, arm) + np.cross(w, np.cross(w, arm)))
    assert list(made) == ["acc_x", "acc_y", "acc_z"]
    assert_allclose(found, R.T @ (at_place + np.array([0.0, 0.0, 9.81])), rtol=1e-12)


def test_gyroscope_and_magnetometer_turn_vectors_into_the_body_frame():
    R, q, _, v, _, _, w, _ = pose()
    names, field = ("qw", "qx", "qy", "qz"), np.array([20.0, 3.0, -41.0])
    gyro = dr.sensors.gyroscope(("wx", "wy", "wz"), attitude=names, scale=True)
    p = {f"gyro_{kind}_{n}": x for kind, x in (("bias", 0.1), ("scale", 1.2)) for n in ("wx", "wy", "wz")}
    assert_allclose([value(x, p, q=q, v=v) for x in gyro.values()], 1.2 * R.T @ w + 0.1, rtol=1e-12)
    mag = dr.sensors.magnetometer(lambda q, p: R, field, bias=False)
    assert_allclose([value(x, q=q) for x in mag.values()], R.T @ field, rtol=1e-12)
    plane = dr.sensors.magnetometer("yaw", axes=("x", "y"))
    assert list(plane["mag_x"].parameters) == ["mag_field_x", "mag_field_y", "mag_bias_x"]


def test_encoder_counts_revolutions_and_range_is_a_distance():
    encoder = dr.sensors.encoder("joint", counts=4096, ratio=6.0)
    assert value(encoder["joint_encoder"], {"joint_encoder_bias": 10.0}, q={"joint": np.pi}) == pytest.approx(12298.0)
    distance = dr.sensors.range_to((1.0, 2.0, 2.0), tuple("xyz"), bias=False)
    assert value(distance["range"], q={"x": 0.0, "y": 0.0, "z": 0.0}) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: dr.sensors.accelerometer("x", "theta"), "two or three axes"),
        (lambda: dr.sensors.accelerometer(tuple("xyz"), ("qw", "qx", "qy", "qz"), lever_arm=(0.1, 0.0, 0.0)), "rates="),
        (lambda: dr.sensors.accelerometer(("x", "z"), "theta", lever_arm="unknown"), '"estimated"'),
        (lambda: dr.sensors.accelerometer(("x", "z"), "theta", gravity=(0.0, 0.0, -9.81)), "2 finite numbers"),
        (lambda: dr.sensors.gyroscope(("wx", "wy")), "three angular velocities"),
        (lambda: dr.sensors.gyroscope(("wx", "wy", "wz"), axes="xy"), "3 names"),
        (lambda: dr.sensors.encoder("joint", counts=0), "other than 0"),
        (lambda: dr.sensors.range_to(None, ("x", "z")), '"estimated"'),
        (lambda: rotorcraft(dr.sensors.accelerometer(tuple("xyz"), "theta")), "planar angle, but there are 3 axes"),
        (lambda: rotorcraft(dr.sensors.gyroscope("psi")), "velocities have no 'psi'"),
    ],
)
def test_instruments_refuse_what_has_no_meaning_in_one_sentence(make, said):
    with pytest.raises(dr.ModelError, match=said) as caught:
        make()
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------- models


@pytest.mark.parametrize(
    ("sensors", "said"),
    [
        ({"x_dot": dr.Sensor("m/s", lambda q, v, a, u, p: v.x)}, "'x_dot' is used twice"),
        ({"thrust": dr.Sensor("N", lambda q, v, a, u, p: u.thrust)}, "'thrust' is used twice"),
        ({"mass": dr.Sensor("kg", lambda q, v, a, u, p: p.mass)}, "'mass' is used twice"),
        ({"two words": dr.Sensor("m", lambda q, v, a, u, p: q.x)}, "cannot name"),
        ({"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: a.x + p.bias)}, "parameters have no 'bias'"),
        ({"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: [a.x, a.z])}, "2 x 1 values; return one"),
        ({"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: np.sqrt(-1.0) * a.x)}, "NaN"),
        ({"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: ca.sqrt(-1 - q.x**2))}, "not finite"),
        ({"acc": "m/s^2"}, "give dr.Sensor"),
        (["acc"], "give a mapping"),
        (
            {
                "one": dr.Sensor("m", lambda q, v, a, u, p: q.x + p.bias, {"bias": dr.Parameter("m")}),
                "two": dr.Sensor("m", lambda q, v, a, u, p: q.z + p.bias, {"bias": dr.Parameter("m", lower=0.0)}),
            },
            "different parameters 'bias'",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_bad_sensors_are_refused_in_one_sentence(sensors, said):
    with pytest.raises(dr.ModelError, match=said) as caught:
        rotorcraft(sensors)
    assert "\n" not in str(caught.value)


def test_a_sensor_brings_its_parameters_and_the_model_may_declare_them_itself(model):
    assert model.signals[-3:] == ("acc_x", "acc_z", "gyro")
    assert list(model.parameters)[3:] == [
        "acc_arm_x", "acc_arm_z", "acc_bias_x", "acc_bias_z", "gyro_bias", "gyro_scale",
    ]  # fmt: skip
    own = dr.Parameter("rad/s", lower=-0.1, upper=0.1)
    assert rotorcraft(imu(), {"gyro_bias": own}).parameters["gyro_bias"] == own
    assert model.units["gyro"] == "rad/s"
    assert model.equations_text()[-1].startswith("gyro = ")


def test_a_model_with_sensors_is_stored_whole_and_one_without_as_before(model):
    stored = json.loads(json.dumps(model.to_dict()))
    assert dr.Model.from_dict(stored) == model == pickle.loads(pickle.dumps(model))
    assert rotorcraft(imu(scale=True)) != model
    assert not {"sensors", "measurement"} & set(ROTORCRAFT.to_dict())
    damaged = copy.deepcopy(stored) | {"sensors": {"gyro": "rad/s"}}
    with pytest.raises(dr.ResultError, match="damaged"):
        dr.Model.from_dict(damaged)


def test_a_model_without_some_sensors_keeps_the_parameters_that_are_still_needed(model):
    left = model.with_sensors(["acc_z"])
    assert list(left.parameters) == ["mass", "inertia", "drag", "acc_arm_x", "acc_arm_z", "acc_bias_z"]
    assert model.with_sensors(["gyro", "acc_x", "acc_z"]) is model
    assert model.with_sensors([]).signals == ROTORCRAFT.signals


def test_affinity_of_each_sensor_is_known():
    known = rotorcraft({**imu(), **dr.sensors.range_to("estimated", ("x", "z"))})
    assert known.affine_sensors == ("acc_x", "acc_z", "gyro")
    assert rotorcraft(imu(scale=True)).affine_sensors == ("gyro",)
    assert known.biased_sensors == ("acc_x", "acc_z", "gyro", "range")


def test_suggested_terms_keep_the_sensors(model):
    symbols = [ca.SX.sym(name, n) for name, n in zip("qvaup", (3, 3, 3, 2, model.n_p), strict=True)]
    h = ca.Function("term", symbols, [ca.vertcat(symbols[1][0], 0, 0)], list("qvaup"), ["h"])
    term = expressions.stored("term", h)
    suggestion = Suggestion(
        **dict.fromkeys(Suggestion.__dataclass_fields__) | {"parameter": "friction_x", "unit": "N s/m", "term": term}
    )
    extended = with_terms(model, [suggestion])
    assert extended.sensors == model.sensors
    x = [np.full(n, 0.3) for n in (3, 3, 3, 2)]
    p = np.linspace(1.0, 2.0, model.n_p)
    assert_allclose(np.array(extended.measurement(*x, np.append(p, 1.0))), np.array(model.measurement(*x, p)))


# ---------------------------------------------------------------------- simulation


def test_simulated_sensors_are_those_of_an_independent_simulation(model, columns):
    p = np.array([TRUE[n] for n in model.parameters])
    u = np.column_stack([columns["thrust"], columns["moment"]])
    start = np.array([columns[n][0] for n in model.state])
    found = rollouts(model).trajectories(RolloutBatch(p[None], start, u, 0.01))[0]
    for k, name in enumerate(model.signals):
        assert_allclose(found[:, k], columns[name], atol=1e-5 * np.abs(columns[name]).max())


def test_derivatives_of_sensors_are_those_of_finite_differences(model, columns):
    p = np.array([TRUE[n] for n in model.parameters])
    u = np.column_stack([columns["thrust"], columns["moment"]])[:40]
    z, n = np.concatenate([p, [columns[n][0] for n in model.state]]), model.n_p
    simulator = rollouts(model)

    def sensors(points):
        return simulator.trajectories(RolloutBatch(points[:, :n], points[:, n:], u, 0.01))[:, :, -3:]

    steps = 1e-6 * np.eye(len(z))
    slopes = np.moveaxis(sensors(z + steps) - sensors(z - steps), 0, -1) / 2e-6
    batch = RolloutBatch(z[None, :n], z[n:], u, 0.01)
    found = simulator.linearized_errors(batch, Measurements(np.zeros((40, 12)), np.ones(40, bool)))
    assert_allclose(found.jacobian[0][:, -3:], slopes, rtol=1e-5, atol=1e-6)


def test_sensors_of_a_disturbed_plant_see_its_accelerations():
    model = rotorcraft(dr.sensors.accelerometer(("x", "z"), "theta", bias=False))
    wind = dr.Disturbance(model, "wind", accelerations=lambda q, v, u, p, d: {"x": d.push}, constants={"push": 0.7})
    parameters = {"mass": 0.25, "inertia": 0.004, "drag": 0.0}
    start, u = np.array([0.0, 0.0, 0.2, 0.0, 0.0, 0.0]), np.array([[3.0, 0.0]] * 3)
    calm, windy = (dr.Plant(model, parameters, some) for some in ((), (wind,)))
    readings = [
        rollouts(one.simulated).trajectories(RolloutBatch(one.constants[None], start, u, 0.01))[0, 0, -2:]
        for one in (calm, windy)
    ]
    assert_allclose(readings[1] - readings[0], [0.7 * np.cos(0.2), -0.7 * np.sin(0.2)], rtol=1e-12)


def test_flights_have_a_column_for_each_sensor(model):
    plant = dr.Plant(model, TRUE)
    trajectory = dr.sine(plant)
    log = dr.fly(plant, trajectory, dr.tvlqr(plant, trajectory))
    assert_allclose(log["gyro"], 1.06 * log["theta_dot"] + 0.08, atol=1e-12)
    assert log.units["acc_x"] == "m/s^2"


# ---------------------------------------------------------------------- linear methods


def rows_by_hand(c, used):
    """``W`` and ``b`` of acc_x, acc_z and gyro over the parameters that only they show, in some rows."""
    s, k, w, alpha = np.sin(c["theta"]), np.cos(c["theta"]), c["theta_dot"], c["theta_ddot"]
    one, none = np.ones_like(s), np.zeros_like(s)
    fx, fz = k * c["x_ddot"] + s * (c["z_ddot"] + 9.81), -s * c["x_ddot"] + k * (c["z_ddot"] + 9.81)
    of_x = np.column_stack([-(w**2), -alpha, one, none, none, none])
    of_z = np.column_stack([alpha, -(w**2), none, one, none, none])
    of_gyro = np.column_stack([none, none, none, none, one, w])
    W = np.vstack([of_x[used], of_z[used], of_gyro])
    return W, np.concatenate([(c["acc_x"] - fx)[used], (c["acc_z"] - fz)[used], c["gyro"]])


@pytest.mark.parametrize("every", [1, 10])
def test_least_squares_has_a_row_for_each_measured_sample_of_a_sensor(model, columns, every):
    log = recorded(columns, 1, 0.0, DERIVED)
    log |= {n: columns[n] for n in ("x", "z", "theta")}
    used = np.arange(len(log["t"])) % every == 0
    sparse = {n: np.where(used, log[n], np.nan) for n in ("acc_x", "acc_z")}
    result = dr.identify(model, as_log(log, **sparse), "ols")
    assert len(result.inliers) == result.estimate.n_fitted == len(used)
    assert "acc_x" in result.evaluation.thresholds
    expected = np.linalg.lstsq(*rows_by_hand(log, used), rcond=None)[0]
    assert_allclose([result.parameters[n] for n in INSTRUMENTS], expected, rtol=1e-8)
    assert_allclose([result.parameters[n] for n in ("mass", "inertia")], [0.25, 0.0041], rtol=1e-3)


@pytest.mark.parametrize("method", ["tls", "diransac", "i-diransac", "nls"])
def test_every_method_estimates_the_parameters_of_sensors(model, columns, method):
    result = dr.identify(model, as_log({n: columns[n] for n in columns}), method)
    for name, true in TRUE.items():
        assert result.parameters[name] == pytest.approx(true, rel=1e-6)


def test_a_sensor_that_a_regression_cannot_use_is_left_out_and_named(columns):
    point = dr.sensors.range_to("estimated", ("x", "z"))
    model = rotorcraft({**point, **dr.sensors.gyroscope("theta")})
    distance = np.hypot(columns["x"] - 2.0, columns["z"] + 1.0) + 0.3
    log = as_log(columns, range=distance)
    result = dr.identify(model, log, "ols")
    assert "range_bias" not in result.parameters
    assert any("range" in note and "affine in the parameters" in note for note in result.notes)
    exact = dr.identify(model, log, "nls").parameters
    assert [exact[n] for n in ("range_point_x", "range_point_z", "range_bias")] == pytest.approx([2.0, -1.0, 0.3], 1e-4)


def test_a_sensor_is_affine_once_the_others_of_its_parameters_are_fixed(columns):
    model = rotorcraft(imu(scale=True))
    fixed = {"acc_scale_x": 1.0, "acc_scale_z": 1.0, "gyro_scale": 1.06}
    result = dr.identify(model, as_log(columns), "ols", fixed=fixed)
    assert set(result.fixed) == set(fixed)
    assert result.parameters["acc_arm_x"] == pytest.approx(0.06, rel=1e-6)
    assert result.parameters["acc_scale_x"] == 1.0
    without = as_log({n: x for n, x in columns.items() if not n.startswith("acc")})
    assert set(dr.identify(model, without, "ols", fixed=fixed).fixed) == {"gyro_scale"}


def test_a_sensor_whose_argument_is_missing_is_left_out_and_named(columns):
    tank = dr.Model(
        "slide",
        {"x": "m", "y": "m"},
        {"force": "N"},
        {"mass": dr.Parameter("kg", positive=True)},
        lambda q, v, a, u, p: [p.mass * a.x - u.force, a.y + 0.5 * q.x],
        sensors={"track": dr.Sensor("m", lambda q, v, a, u, p: q.y + p.zero, {"zero": dr.Parameter("m")})},
    )
    t = 0.01 * np.arange(300)
    log = {
        "t": t,
        "force": 2 * np.sin(5 * t),
        "x_ddot": np.sin(5 * t),
        "y_ddot": -0.5 * t,
        "x": t,
        "x_dot": np.cos(5 * t),
    }
    result = dr.identify(tank, as_log(log, track=0.1 * t), "ols")
    assert list(result.parameters) == ["mass"]
    assert any("track" in note and "y in the measurement equation is not measured" in note for note in result.notes)


def test_sensors_that_no_log_has_are_left_out_with_their_parameters(model, columns):
    log = as_log({n: x for n, x in columns.items() if n not in ("acc_x", "acc_z")})
    result = dr.identify(model, log, "ols")
    assert list(result.parameters) == ["mass", "inertia", "drag", "gyro_bias", "gyro_scale"]
    assert any("no log has such a signal" in note for note in result.notes)


# ---------------------------------------------------------------------- evaluation, storage


def test_sensors_are_scored_stored_and_validated(model, columns, tmp_path):
    result = dr.identify(model, as_log(recorded(columns, 2, 0.0, DERIVED)), "ols")
    assert {"acc_x", "acc_z", "gyro"} <= set(result.evaluation.thresholds)
    result.save(tmp_path / "result.json")
    loaded = dr.Result.load(tmp_path / "result.json")
    assert loaded.model == result.model
    other = as_log(recorded(flight(1), 3, 0.0, DERIVED))
    assert dr.validate(loaded, other).rmse["gyro"] == pytest.approx(0.01, rel=0.2)


def test_inspection_rates_the_parameters_of_sensors(model, columns):
    found = inspect(as_log(recorded(columns, 2, 0.0, DERIVED)), model)
    assert found.fitness.excitation["acc_arm_x"].verdict == "well"


def test_a_sensor_in_another_unit_is_converted_and_of_another_dimension_refused(model, columns):
    signals = {n: x for n, x in columns.items() if n != "t"}
    (segment,) = Dataset.of(model, dr.Log.from_arrays(columns["t"], signals, {"gyro": "deg/s"})).segments
    np.testing.assert_allclose(segment.column("gyro"), np.deg2rad(columns["gyro"])[segment.offset :], rtol=1e-14)
    with pytest.raises(dr.LogError, match="gyro"):
        Dataset.of(model, dr.Log.from_arrays(columns["t"], signals, {"gyro": "deg"}, source="flight"))


# ---------------------------------------------------------------------- lo-diransac


def within_intervals(result, true, level=0.999):
    """Names of the parameters whose true value is outside their intervals."""
    return [n for n, (low, high) in result.intervals(level).items() if not low <= true[n] <= high]


def test_imu_beside_motion_capture_is_calibrated_and_its_outliers_found(model, columns):
    result = dr.identify(model, as_log(recorded(columns, 0, 0.05)), differentiate=True)
    assert within_intervals(result, TRUE) == []
    assert result.parameters["acc_bias_x"] == pytest.approx(TRUE["acc_bias_x"], abs=0.03)
    assert result.parameters["gyro_scale"] == pytest.approx(1.06, rel=0.003)
    assert result.diagnosis.noise_std["acc_x"] == pytest.approx(0.15, rel=0.1)
    assert result.diagnosis.outlier_fraction["gyro"] == pytest.approx(0.05, abs=0.02)
    assert result.verdict == "usable"


def test_a_gyroscope_makes_the_inertia_of_a_noisy_pose_better():
    columns = flight(0, gyro_scale=1.0)
    log, rng = recorded(columns, 0, 0.05), np.random.default_rng(7)
    log |= {n: columns[n] + rng.normal(0.0, 0.03, len(columns["t"])) for n in ("x", "z", "theta")}
    model, without = rotorcraft(dr.sensors.gyroscope("theta")), {n: x for n, x in log.items() if n != "gyro"}
    alone, both = (dr.identify(model, as_log(x), differentiate=True) for x in (without, log))
    assert list(alone.parameters) == ["mass", "inertia", "drag"]
    assert both.standard_errors["inertia"] < 0.3 * alone.standard_errors["inertia"]
    assert abs(both.parameters["inertia"] / 0.0041 - 1.0) < 0.003
    assert within_intervals(both, TRUE) == []


def test_the_delay_of_an_imu_is_estimated(model, columns):
    log = recorded(columns, 0)
    late = {n: np.concatenate([np.full(3, np.nan), log[n][:-3]]) for n in ("acc_x", "acc_z", "gyro")}
    result = dr.identify(model, as_log(log, **late), differentiate=True)
    said = [str(x) for x in result.findings if "acc_x, acc_z and gyro are recorded" in str(x)]
    assert float(said[0].split("recorded ")[1].split(" ms late")[0]) == pytest.approx(30.0, abs=3.0)
    assert within_intervals(result, TRUE) == []


def test_a_log_without_a_sensor_is_identified_with_one_that_has_it(model, columns):
    other = {n: x for n, x in recorded(flight(5), 5).items() if n not in ("acc_x", "acc_z", "gyro")}
    result = dr.identify(model, [as_log(recorded(columns, 0)), as_log(other)], differentiate=True)
    assert within_intervals(result, TRUE) == []
    assert [x.remark for x in result.logs] == ["", ""]


def test_a_parameter_that_only_a_sensor_shows_is_identified_from_it():
    """The motion of a cart with its payload shows only their sum; a load cell between them shows the payload."""
    cart = dr.Model(
        "cart",
        {"x": "m"},
        {"force": "N"},
        {
            "cart": dr.Parameter("kg", positive=True),
            "payload": dr.Parameter("kg", positive=True),
            "friction": dr.Parameter("N s/m", lower=0),
        },
        lambda q, v, a, u, p: [(p.cart + p.payload) * a.x + p.friction * v.x - u.force],
        sensors={
            "cell": dr.Sensor(
                "N", lambda q, v, a, u, p: p.payload * a.x + p.cell_bias, {"cell_bias": dr.Parameter("N")}
            )
        },
    )
    true = {"cart": 2.3, "payload": 1.2, "friction": 0.8, "cell_bias": 0.7}
    t, rng = 0.01 * np.arange(1500), np.random.default_rng(0)
    force = 4.0 * np.sin(2.0 * t) + 2.0 * np.sin(5.1 * t + 1.0) + 1.5 * np.sin(0.7 * t)
    decay, x, v = np.exp(-0.8 / 3.5 * 0.01), np.zeros(len(t)), np.zeros(len(t))
    for k in range(len(t) - 1):  # the exact solution under a held force
        terminal = force[k] / 0.8
        v[k + 1] = terminal + (v[k] - terminal) * decay
        x[k + 1] = x[k] + 0.01 * terminal + (v[k] - terminal) * (1.0 - decay) * 3.5 / 0.8
    cell = 1.2 * (force - 0.8 * v) / 3.5 + 0.7 + rng.normal(0.0, 0.1, len(t))
    cell[rng.random(len(t)) < 0.1] += 5.0
    log = {"t": t, "x": x + rng.normal(0.0, 1e-3, len(t)), "force": force}
    result = dr.identify(cart, as_log(log, cell=cell), differentiate=True)
    assert within_intervals(result, true) == []
    assert result.parameters["payload"] == pytest.approx(1.2, rel=0.01)
    bare = dr.identify(cart, as_log(log), differentiate=True)
    assert set(bare.diagnosis.unidentifiable) == {"cart", "payload"}


def test_sensors_that_are_not_affine_are_fitted_too():
    """A slide that is seen by the distance to a point beside it."""
    slide = dr.Model(
        "slide",
        {"x": "m"},
        {"force": "N"},
        {"mass": dr.Parameter("kg", positive=True), "friction": dr.Parameter("N s/m", lower=0)},
        lambda q, v, a, u, p: [p.mass * a.x + p.friction * v.x - u.force],
        sensors={
            "distance": dr.Sensor(
                "m",
                lambda q, v, a, u, p: ca.sqrt((q.x - p.along) ** 2 + p.beside**2),
                {"along": dr.Parameter("m"), "beside": dr.Parameter("m", positive=True)},
            )
        },
    )
    t, rng = 0.01 * np.arange(1000), np.random.default_rng(1)
    x = 0.5 * np.sin(2.0 * t) + 0.3 * np.sin(3.1 * t)
    v, a = np.gradient(x, t), -2.0 * np.sin(2.0 * t) - 0.3 * 3.1**2 * np.sin(3.1 * t)
    v = np.cos(2.0 * t) + 0.93 * np.cos(3.1 * t)
    log = {"t": t, "x": x + rng.normal(0.0, 1e-3, len(t)), "force": 2.0 * a + 0.5 * v}
    distance = np.hypot(x - 0.4, 0.7) + rng.normal(0.0, 0.005, len(t))
    distance[rng.random(len(t)) < 0.1] += 2.0
    result = dr.identify(slide, as_log(log, distance=distance), differentiate=True, input_hold="linear")
    assert result.parameters["along"] == pytest.approx(0.4, abs=0.01)
    assert result.parameters["beside"] == pytest.approx(0.7, abs=0.01)
    assert within_intervals(result, {"mass": 2.0, "friction": 0.5, "along": 0.4, "beside": 0.7}) == []


def test_an_attitude_that_only_sensors_show_is_estimated(model, columns):
    log = {n: x for n, x in recorded(columns, 0).items() if n != "theta"}
    result = dr.identify(model, as_log(log), differentiate=True)
    assert within_intervals(result, TRUE) == []
    angles = np.interp(result.diagnosis.smoothed_time, columns["t"], columns["theta"])
    assert np.abs(result.diagnosis.smoothed_states["theta"] - angles).max() < 0.02
    with pytest.raises(dr.LogError, match="theta"):
        dr.identify(model, as_log(log), "ols", differentiate=True)


@pytest.mark.parametrize(("stiffness", "turns"), [(0.0, 1), (0.3, 0)])
def test_an_attitude_that_nothing_measures_is_the_one_within_half_a_turn_of_zero_if_turns_have_no_effect(
    stiffness, turns
):
    """A spring tells one turn from the next."""
    model = dr.Model(
        "tilting",
        {"x": "m", "tilt": "rad"},
        {"moment": "N m"},
        {"drag": dr.Parameter("1/s")},
        lambda q, v, a, u, p: [a.x + p.drag * v.x - ca.sin(q.tilt), a.tilt + stiffness * q.tilt - u.moment],
    )
    n, begin = 50, np.array([2.0 * np.pi + 0.2, 0.1, -4.0 * np.pi - 0.2, 0.0])
    rows = [slice(0, n), slice(n, 2 * n)]
    layout = ParameterLayout(dict(model.parameters), 2)
    zeros = [np.zeros((2 * n, k)) for k in (len(model.state), 1, 0, 1)]
    problem = driven_states(model, layout, ("tilt", "tilt_dot"), *zeros, rows, 0.01, 10.0, np.array([0.5]))
    found = problem.trajectories(begin)["tilt"]
    assert_allclose(found[[0, n]], [0.2 + 2.0 * np.pi * (1 - turns), -0.2 - 4.0 * np.pi * (1 - turns)])
    if turns:
        assert_allclose(found[n - 1], 0.2 + 0.1 * 0.01 * (n - 1))


def test_the_lag_of_a_thrust_is_identified_from_an_accelerometer_alone():
    """Neither the thrust nor any position is measured."""
    model = dr.Model(
        "hover",
        {},
        {"command": "1"},
        {"tau": dr.Parameter("s", positive=True), "gain": dr.Parameter("m/s^2", positive=True)},
        lambda q, v, a, u, p: [p.tau * a.thrust + v.thrust - p.gain * u.command],
        first_order={"thrust": "m/s^2"},
        sensors={"acc": dr.Sensor("m/s^2", lambda q, v, a, u, p: v.thrust)},
    )
    t, rng, decay = 0.01 * np.arange(1500), np.random.default_rng(0), np.exp(-0.01 / 0.05)
    command = 0.5 + 0.2 * np.sin(4.4 * t) + 0.15 * np.sign(np.sin(1.9 * t)) + 0.05 * np.sin(19.5 * t)
    thrust = np.full(len(t), 20.0 * command[0])
    for k in range(len(t) - 1):  # the exact solution under a held command
        thrust[k + 1] = 20.0 * command[k] + (thrust[k] - 20.0 * command[k]) * decay
    acc = thrust + rng.normal(0.0, 0.2, len(t)) + 10.0 * (rng.random(len(t)) < 0.05)
    result = dr.identify(model, as_log({"t": t, "command": command, "acc": acc}), differentiate=True)
    assert result.parameters["tau"] == pytest.approx(0.05, rel=0.03)
    assert within_intervals(result, {"tau": 0.05, "gain": 20.0}) == []
