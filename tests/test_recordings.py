"""Recordings of several topics, written here as their own tools write them: the same arrays as from CSV, to the bit."""

import json
import random
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import diransac as dr
from diransac.data.readers import read_topics
from diransac.data.readers.crazyflie import CrazyflieRecording
from diransac.data.readers.recording import shortened
from diransac.errors import LogError
from recordings import EFFORT, T, Ulog, V, X, flight, nanoseconds, write_bag, write_mcap

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


def shared(name):
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"NOT CHECKED with real recordings: {path} is missing")
    return path


def assert_same(log, **signals):
    """The log has these signals and the times of a CSV file, to the bit."""
    np.testing.assert_array_equal(log.time, T)
    for name, values in signals.items():
        np.testing.assert_array_equal(log[name], values)


# ---------------------------------------------------------------------- ULog


def rotation(q):
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


@pytest.fixture(scope="module")
def ulog(tmp_path_factory):
    data, enu, q = flight()
    path = tmp_path_factory.mktemp("ulog") / "flight.ulg"
    path.write_bytes(data)
    return path, enu, q


def test_a_ulog_is_read_in_the_axes_of_the_model(ulog):
    path, enu, q = ulog
    log = dr.read_log(path, mapping="px4-multirotor", resample=None)
    np.testing.assert_allclose(log.time, T, atol=1e-12)
    for name in ("wx", "wy", "wz", "motor1"):
        np.testing.assert_array_equal(log[name], enu[name])
    ned_to_enu, flu_to_frd = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), np.diag([1.0, -1.0, -1.0])
    found = rotation(np.column_stack([log[n] for n in ("qw", "qx", "qy", "qz")]))
    np.testing.assert_allclose(found, ned_to_enu @ rotation(q) @ flu_to_frd, atol=1e-12)


def test_rows_on_the_ground_are_left_out_by_the_logs_own_topic(tmp_path):
    data, enu, _ = flight()
    file = Ulog()
    file.data = data
    file.format("vehicle_land_detected", "uint64_t timestamp;bool landed;uint8_t[7] _padding0;")
    file.subscribe(9, "vehicle_land_detected")
    for k, landed in ((0, True), (10, False), (20, True), (30, False), (len(T) - 5, True)):
        file.record(9, "?", T[k] - 1e-4, landed)
    path = tmp_path / "flight.ulg"
    path.write_bytes(file.data)
    log = dr.read_log(path, mapping="px4-multirotor", resample=None)
    inside = np.isin(np.arange(len(T)), [*range(10, 20), *range(30, len(T) - 5)])
    np.testing.assert_array_equal(log["airborne"][1:], inside[1:])
    kept = dr.keep_while(log, ["airborne"])
    np.testing.assert_allclose(kept.time[[0, -1]], T[[10, len(T) - 6]])
    np.testing.assert_array_equal(np.isfinite(kept["wx"]), inside[10 : len(T) - 5])
    np.testing.assert_array_equal(kept["wx"][:10], enu["wx"][10:20])
    assert kept.history[-1]["left_out"][1] == pytest.approx([T[20], T[29]])
    with pytest.raises(LogError, match="armed"):
        dr.keep_while(log, ["armed"])


EVENTS = """
while = ["auto"]

[[signals]]
name = "{signal}"
topic = "{topic}"
field = "{field}"

[[events]]
name = "auto"
topic = "{state}"
where = [{{ field = "mode", equals = {mode} }}, {{ field = "volts", above = 11.5 }}]
"""


def test_a_mode_and_a_charged_battery_of_a_ulog_are_an_event_and_the_mapping_leaves_out_the_rest(tmp_path):
    data, enu, _ = flight()
    file = Ulog()
    file.data = data
    file.format("state", "uint64_t timestamp;float volts;uint8_t mode;uint8_t[3] _padding0;")
    file.subscribe(9, "state")
    for k, volts, mode in ((0, 12.0, 2), (10, 12.0, 3), (90, 12.0, 4), (100, 12.0, 3), (150, 11.0, 3)):
        file.record(9, "fB", T[k] - 1e-4, volts, mode)
    (tmp_path / "flight.ulg").write_bytes(file.data)
    place = {"signal": "wx", "topic": "vehicle_angular_velocity", "field": "xyz[0]", "state": "state", "mode": 3}
    (tmp_path / "map.toml").write_text(EVENTS.format(**place))
    log = dr.read_log(tmp_path / "flight.ulg", mapping=tmp_path / "map.toml")
    kept = np.isin(np.arange(10, 150), [*range(10, 90), *range(100, 150)])
    np.testing.assert_array_equal(log["wx"], np.where(kept, enu["wx"][10:150], np.nan))
    assert any("not auto" in note and "0.9 to 0.99 s" in note for note in log.notes)


def test_a_slow_topic_has_its_samples_where_they_are_valid_and_nothing_between(ulog):
    path, enu, _ = ulog
    log = dr.read_log(path, mapping="px4-multirotor")
    rows = np.arange(len(T))
    for name, every in (("vx", 4), ("x", 8)):
        np.testing.assert_array_equal(log[name], np.where(rows % every == 0, enu[name], np.nan))


def test_a_ulog_lists_its_topics_parameters_and_dropouts(ulog):
    found = read_topics(ulog[0])
    assert found.topics["vehicle_attitude"].rate == pytest.approx(100.0)
    assert found.topics["vehicle_attitude"].fields == ("timestamp", "q[0]", "q[1]", "q[2]", "q[3]")
    assert found.topics["actuator_motors"].fields[-1] == "control[3]"
    assert found.metadata["parameters"] == {"MC_ROLL_P": 6.5}
    assert found.metadata["messages"] == [[5.0, "takeoff"]]
    assert found.notes == ("1 dropout of the logger, 0.03 s in all",)


def test_fields_of_a_recording_are_named_on_the_spot(ulog):
    log = dr.read_log(ulog[0], rename={"rate": "vehicle_angular_velocity.xyz[0]", "u": "actuator_motors.control[0]"})
    np.testing.assert_array_equal(log["rate"], ulog[1]["wx"])
    assert log.names == ("rate", "u")


@pytest.mark.parametrize(
    ("rename", "said"),
    [
        (None, "it has 4 topics, .*--mapping NAME|FILE.toml"),
        ({"x": "vehicle_attitude.p"}, 'topic "vehicle_attitude" has no field "p"; it has timestamp, q'),
        ({"x": "attitude"}, '"attitude" names no topic; found actuator_motors'),
    ],
)
def test_a_recording_whose_signals_are_not_named_is_refused(ulog, rename, said):
    with pytest.raises(LogError, match=said):
        dr.read_log(ulog[0], rename=rename)


@pytest.mark.parametrize("file", ["px4_ulog/sample_log_small.ulg", "px4_ulog/sample_appended_multiple.ulg"])
def test_real_ulogs_are_read_as_pyulog_reads_them(file):
    pyulog = pytest.importorskip("pyulog", reason="NOT CHECKED against the other reader: pyulog is missing")
    from diransac.data.readers.ulog import UlogRecording

    path = shared(file)
    recording, other = UlogRecording(path, "log"), pyulog.ULog(str(path))
    assert len(recording.fields) == len(other.data_list)
    own = recording.read(recording.fields, "message")
    for data in other.data_list:
        name = data.name if data.name in own else f"{data.name}_{data.multi_id}"
        for label, values in data.data.items():
            np.testing.assert_array_equal(own[name].columns[label], values.astype(float))


@pytest.mark.parametrize("file", ["px4_ulog/sample_log_small.ulg", "px4_ulog/sample_appended_multiple.ulg"])
def test_a_bench_log_is_inspected_and_refused_with_a_reason(file):
    path = shared(file)
    assert read_topics(path).topics["vehicle_attitude"].n_messages > 100
    log = dr.read_log(path, mapping="px4-multirotor")
    assert "xy_valid is never above 0.5" in log.unusable["x"]
    with pytest.raises(dr.DiransacError, match="sample"):
        dr.identify(dr.models.quadrotor(speed_unit="1"), log, differentiate=True)


def outcome(path, **options):
    """A log, or one sentence."""
    try:
        return dr.read_log(path, **options)
    except LogError as error:
        return str(error)


@pytest.mark.parametrize("name", ["px4_ulog/sample_log_small.ulg", "px4_ulog/sample_appended_multiple.ulg"])
def test_damaged_ulogs_end_in_a_log_or_in_one_sentence(tmp_path, name):
    data = shared(name).read_bytes()
    rng, file = random.Random(5), tmp_path / "cut.ulg"
    for k in range(20):
        file.write_bytes(data[: 10 + (len(data) - 10) * k // 20])
        found = outcome(file, mapping="px4-multirotor")
        assert isinstance(found, str) or any("cut off" in note for note in found.notes) or k == 0
    for _ in range(10):
        flipped = bytearray(data)
        for _ in range(20):
            flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        file.write_bytes(flipped)
        outcome(file, mapping="px4-multirotor")


def test_a_ulog_is_read_on_behind_a_damage(ulog, tmp_path):
    path, enu, _ = ulog
    data = path.read_bytes()
    file = tmp_path / "hole.ulg"
    file.write_bytes(data[:8000] + bytes(64) + data[8100:])
    log = dr.read_log(file, rename={"wx": "vehicle_angular_velocity.xyz[0]"}, resample="median")
    assert any("damaged" in note for note in log.notes)
    np.testing.assert_array_equal(log["wx"][-100:], enu["wx"][-100:])


# ---------------------------------------------------------------------- MCAP and bags


def write_state_mcap(path):
    """A position at 100 Hz, and at times a mode in words with the voltage of the battery."""
    writer_of = pytest.importorskip("mcap.writer", reason="NOT CHECKED: mcap is missing")
    with path.open("wb") as file:
        writer = writer_of.Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        encoder, state = (writer.register_channel(x, "json", schema) for x in ("/encoder", "/state"))
        told = {0: ("MANUAL", 12.0), 10: ("AUTO", 12.0), 90: ("MANUAL", 12.0), 100: ("AUTO", 12.0), 150: ("AUTO", 11.0)}
        for k in range(len(T)):
            writer.add_message(encoder, nanoseconds(k), json.dumps({"x": X[k]}).encode(), nanoseconds(k))
            if k in told:
                text = json.dumps({"mode": told[k][0], "volts": told[k][1]}).encode()
                writer.add_message(state, nanoseconds(k) - 1000, text, nanoseconds(k) - 1000)
        writer.finish()
    return path


def test_a_mode_in_words_and_a_charged_battery_of_an_mcap_are_an_event(tmp_path):
    path = write_state_mcap(tmp_path / "a.mcap")
    place = {"signal": "x", "topic": "/encoder", "field": "x", "state": "/state", "mode": '"AUTO"'}
    (tmp_path / "map.toml").write_text(EVENTS.format(**place))
    log = dr.read_log(path, mapping=tmp_path / "map.toml")
    kept = np.isin(np.arange(10, 150), [*range(10, 90), *range(100, 150)])
    np.testing.assert_array_equal(log["x"], np.where(kept, X[10:150], np.nan))
    assert "mode (text)" in str(read_topics(path))
    (tmp_path / "map.toml").write_text(EVENTS.format(**place | {"mode": 3}))  # a number is no text
    with pytest.raises(LogError, match="no stretch of it is auto"):
        dr.read_log(path, mapping=tmp_path / "map.toml")


def test_a_text_is_no_signal(tmp_path):
    path = write_state_mcap(tmp_path / "a.mcap")
    (tmp_path / "map.toml").write_text('[[signals]]\nname = "m"\ntopic = "/state"\nfield = "mode"\n')
    with pytest.raises(LogError, match='field "mode" of topic "/state" is not numeric'):
        dr.read_log(path, mapping=tmp_path / "map.toml")


def test_a_listing_puts_arrays_and_vectors_together_and_leaves_out_headers():
    fields = ["header.stamp.sec", "q.x", "q.y", "c[0]", "c[1]", "c[2]", "c[0].a", "mode"]
    assert shortened(fields) == ["q.{x, y}", "c[0..2]", "c[0].a", "mode"]


@pytest.mark.parametrize("version", [1, "SQLITE3", "MCAP"])
def test_bags_have_the_arrays_of_the_csv_file(tmp_path, version):
    path = tmp_path / ("log.bag" if version == 1 else "bag")
    write_bag(path, version)
    log = dr.read_log(path, mapping="ros-joint-states")
    assert_same(log, elbow=X, elbow_dot=V, elbow_torque=EFFORT, wrist=np.ones(len(T)))
    by_hand = {"x": "/joint_states.position[elbow]", "u": "/joint_states.effort[elbow]"}
    assert_same(dr.read_log(path, rename=by_hand), x=X, u=EFFORT)
    assert read_topics(path).topics["/joint_states"].rate == pytest.approx(100.0)


MCAP = """
time = "message"
[[signals]]
name = "x"
topic = "/joint_states"
field = "position[elbow]"
[[signals]]
name = "force"
topic = "/command"
field = "u.force"
where = { field = "on", above = 0.5 }
"""


def test_an_mcap_file_has_the_arrays_of_the_csv_file_by_either_clock(tmp_path):
    path, csv = tmp_path / "run.mcap", tmp_path / "run.csv"
    write_mcap(path)
    dr.Log.from_arrays(T, {"x": X, "force": EFFORT}).write(csv)
    (tmp_path / "run.toml").write_text(MCAP)
    (tmp_path / "header.toml").write_text(MCAP.replace('"message"', '"header"'))
    by_header = dr.read_log(path, mapping=tmp_path / "header.toml")
    by_message = dr.read_log(path, mapping=tmp_path / "run.toml")
    assert by_header.fingerprint == dr.read_log(csv).fingerprint
    assert_same(by_header, x=X, force=EFFORT)
    np.testing.assert_allclose(by_message.time, T + 0.0003, atol=1e-12)
    np.testing.assert_array_equal(by_message["force"], EFFORT)
    assert any("0.3 ms" in note for note in by_message.notes)


def test_damaged_mcap_files_end_in_a_log_or_in_one_sentence(tmp_path):
    path = tmp_path / "run.mcap"
    write_mcap(path)
    data, rng = path.read_bytes(), random.Random(2)
    options = {"rename": {"x": "/joint_states.position[elbow]"}, "resample": "median"}
    for k in range(20):
        path.write_bytes(data[: 20 + (len(data) - 20) * k // 20])
        found = outcome(path, **options)
        assert isinstance(found, str) or len(found) == len(T) or any("cut off" in note for note in found.notes)
    for _ in range(10):
        flipped = bytearray(data)
        for _ in range(10):
            flipped[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(flipped)
        outcome(path, **options)


def test_a_missing_package_is_named_with_its_install_line(tmp_path, monkeypatch):
    for name in ("mcap.reader", "rosbags.highlevel", "h5py"):
        monkeypatch.setitem(__import__("sys").modules, name, None)
    for name in ("a.mcap", "a.bag", "a.h5"):
        (tmp_path / name).write_bytes(b"x")
        with pytest.raises(LogError, match=r'pip install "diransac\[logs\]"$'):
            dr.read_log(tmp_path / name)


# ---------------------------------------------------------------------- Crazyflie


def test_a_crazyflie_log_has_the_numbers_of_its_decoded_copy():
    recording = CrazyflieRecording(shared("crazyflie_arpl/log16").read_bytes(), "log")
    copy = pl.read_parquet(shared("crazyflie_arpl/log16.parquet"))
    found = recording.read(recording.fields, "message")["fixedFrequency"]
    for name, values in found.columns.items():
        np.testing.assert_allclose(values, copy[name].to_numpy(), rtol=1e-6)
    np.testing.assert_allclose(np.diff(found.time), np.diff(copy["t_ms"].to_numpy()) / 1000.0, atol=1e-6)


def test_damaged_crazyflie_logs_end_in_a_log_or_in_one_sentence(tmp_path):
    data = shared("crazyflie_arpl/log16").read_bytes()[:200_000]
    file = tmp_path / "log"
    for size in (1, 4, 20, 120, 150, 5000):
        file.write_bytes(data[:size])
        found = outcome(file, mapping="crazyflie", resample="median")
        assert isinstance(found, str) or any("cut off" in note for note in found.notes)
