"""Mapping files, repairs, and tables in other shapes: what is done, what is said, and what is refused."""

import dataclasses
import gzip
import struct

import numpy as np
import pytest
import scipy.io

import diransac as dr
from command_line import run
from diransac.data.mapping import LogMapping, MappedSignals
from diransac.data.mapping_file import BUILT_IN, load_mapping
from diransac.data.readers import read_fields
from diransac.data.readers.recording import Samples
from diransac.data.readers.repair import REPAIRS, Repairs
from diransac.data.readers.topics import table_of_topics
from diransac.data.suggested_mapping import suggest_mapping
from diransac.errors import LogError, SettingsError
from diransac.identification.assessment.inspection import inspect

T = np.arange(300) / 100.0
RNG = np.random.default_rng(8)
Q, TAU = RNG.normal(size=(2, len(T)))


def written(folder, text, name="map.toml"):
    path = folder / name
    path.write_text(text)
    return path


def csv(folder, name="a.csv", **columns):
    path = folder / name
    rows = [",".join(columns), *(",".join(repr(float(x)) for x in row) for row in zip(*columns.values(), strict=True))]
    path.write_text("\n".join(rows))
    return path


# ---------------------------------------------------------------------- mapping files


TABLE = """
time = { column = "t_ms", scale = 0.001 }
until = 1.0
shift = { force = 0.02 }

[[signals]]
name = "position"
field = "enc"
scale = 0.5
sign = -1
offset = 2.0
unit = "m"

[[signals]]
name = ["vx", "vy", "vz"]
field = ["v_n", "v_e", "v_d"]
frame = "ned-to-enu"

[[signals]]
name = "force"
field = "f"
where = { field = "ok", above = 0.5 }
"""


def test_a_table_is_mapped_scaled_turned_and_masked(tmp_path):
    ok = np.arange(len(T)) % 10 != 0
    path = csv(tmp_path, t_ms=1000.0 * T, enc=Q, v_n=Q + 1, v_e=Q + 2, v_d=Q + 3, f=TAU, ok=1.0 * ok, other=Q)
    log = dr.read_log(path, mapping=written(tmp_path, TABLE))
    n = len(log)
    assert log.names == ("position", "vx", "vy", "vz", "force")
    assert log.units == {"position": "m"}
    assert (log.time[0], log.time[-1]) == pytest.approx((0.02, 1.0))
    np.testing.assert_array_equal(log["position"], -0.5 * Q[2 : n + 2] + 2.0)
    np.testing.assert_array_equal(log["vx"], Q[2 : n + 2] + 2)
    np.testing.assert_array_equal(log["vz"], -(Q[2 : n + 2] + 3))
    np.testing.assert_array_equal(np.isnan(log["force"]), ~ok[:n])
    assert [step["step"] for step in log.history] == ["map", "cut", "shift"]


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_built_in_mapping_is_valid(name):
    assert load_mapping(name).signals


ENTRY = '[[signals]]\nname = "x"\nfield = "a"\n'
WRONG = {
    "not TOML": ("x = ", "it is not TOML"),
    "empty": ("", "it maps no signal"),
    "unknown key": (f"frme = 1\n{ENTRY}", 'has "frme", which is not known; it may have bandwidth, description, '),
    "unknown key of a signal": (f"{ENTRY}scal = 2", r'signal 1 has "scal", which is not known'),
    "signals are no tables": ("signals = 3", r"write \[\[signals\]\] before each"),
    "no name": ('[[signals]]\nfield = "a"', "signal 1: name is missing"),
    "no field": ('[[signals]]\nname = "x"', r'signal 1 \("x"\): field is missing'),
    "too few fields": ('[[signals]]\nname = ["x", "y"]\nfield = "a"', "has 2 names and 1 fields"),
    "a text as scale": (f'{ENTRY}scale = "2"', "scale is '2'; write a finite number"),
    "no scale at all": (f"{ENTRY}scale = 0", "scale is 0; give a factor other than 0"),
    "infinite": (f"{ENTRY}offset = inf", "offset is inf; write a finite number"),
    "sign": (f"{ENTRY}sign = -2", "sign is -2; it is 1 or -1"),
    "frame": (f'{ENTRY}frame = "ned"', "frame is 'ned'; use one of ned-to-enu"),
    "frame of one": (f'{ENTRY}frame = "ned-to-enu"', "changes the 3 components of a vector; there are 1"),
    "order": (f'{ENTRY}order = "xyzw"', "a quaternion has 4"),
    "attitude without order": (
        '[[signals]]\nname = ["a", "b", "c", "d"]\nfield = ["a", "b", "c", "d"]\nframe = "ned-frd-to-enu-flu"',
        "give its order",
    ),
    "where": (f"{ENTRY}where = 3", "where is 3; write a table"),
    "where without limit": (
        f'{ENTRY}where = {{ field = "b" }}',
        "where needs a field, and above, below or both, or equals",
    ),
    "time": (f'time = "noon"\n{ENTRY}', 'time is \'noon\'; write "header", "message"'),
    "time without column": (f"time = {{ scale = 2 }}\n{ENTRY}", "time: column is missing"),
    "shift": (f"shift = 3\n{ENTRY}", "shift is 3; write a table"),
    "resample": (f'resample = "often"\n{ENTRY}', "resample is 'often'"),
    "absent field": ('[[signals]]\nname = "x"\nfield = "b"', r'has "x" from field "b" .*say optional = true'),
    "nothing fits": ('[[signals]]\nname = "x"\nfield = "b"\noptional = true', "fits none of its columns"),
    "unknown repair": (f'repair = ["glue"]\n{ENTRY}', 'there is no repair "glue"; there are comments'),
}


def test_events_of_a_table_are_listed_apart_by_inspect_until_they_leave_out_rows(tmp_path):
    on = (T > 1.0) & (T < 2.5)
    path = csv(tmp_path, t=T, a=Q, landed=~on)
    event = '[[events]]\nname = "airborne"\nwhere = { field = "landed", equals = false }\n'
    log = dr.read_log(path, mapping=written(tmp_path, f'[[signals]]\nname = "x"\nfield = "a"\n{event}'))
    found = inspect(log)
    assert list(found.signals) == ["x"]
    assert found.events == {"airborne": pytest.approx(on.mean())}
    assert "event airborne: holds in 50 % of the rows" in str(found)
    kept = dr.read_log(
        path, mapping=written(tmp_path, f'while = "airborne"\n[[signals]]\nname = "x"\nfield = "a"\n{event}')
    )
    np.testing.assert_array_equal(kept["x"], Q[on])
    assert kept.history[-1]["events"] == ["airborne"]


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_mapping_is_refused_with_one_sentence(tmp_path, case):
    text, said = WRONG[case]
    path = csv(tmp_path, t=T, a=Q)
    with pytest.raises((LogError, SettingsError), match=said) as caught:
        dr.read_log(path, mapping=written(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_a_placeholder_stands_for_the_joints_of_a_topic_and_is_refused_without_one():
    entry = MappedSignals(("{joint}",), ("position[{joint}]",))
    mapping, fields = LogMapping("mapping", (entry,)), {"/joints": ["position[0]", "position[1]"]}
    found, _ = mapping.chosen(fields, {"/joints": ["hip", "knee"]}, "log")  # the only topic needs no name
    assert [x.fields for x in found] == [("position[hip]",), ("position[knee]",)]
    named = LogMapping("mapping", (dataclasses.replace(entry, topic="/arm"), MappedSignals(("t1",), ("position[0]",))))
    with pytest.raises(LogError, match=r'has "\{joint\}" from topic "/arm", which the log has not'):
        named.chosen(fields, {}, "log")


class TwoTopics:
    """A recording whose fields are constant."""

    source, fields, elements, texts, metadata, notes = "log", {"a": ("y", "f"), "b": ("x", "z")}, {}, {}, {}, ()

    def read(self, wanted, stamps):
        """Samples, the same by either clock."""
        values = {"y": 1.0, "f": 2.0, "x": 3.0, "z": 4.0}
        return {topic: Samples(T, {n: np.full(len(T), values[n]) for n in names}) for topic, names in wanted.items()}


def test_a_renamed_field_replaces_that_of_the_mapping():
    y, x = MappedSignals(("y",), ("y",), "a"), MappedSignals(("x",), ("x",), "b", ("deg",))
    table, _ = table_of_topics(TwoTopics(), LogMapping("mapping", (y, x)), {"x": "a.f"}, None, Repairs())
    assert (table.columns["x"] == 2.0).all()
    assert "x" not in table.units
    pair = LogMapping("mapping", (MappedSignals(("x", "z"), ("x", "z"), "b"),))
    with pytest.raises(LogError, match='has "x" with x, z; rename all of these'):
        table_of_topics(TwoTopics(), pair, {"x": "a.f"}, None, Repairs())


def test_a_mapping_that_is_not_there_names_the_built_in_ones(tmp_path):
    with pytest.raises(LogError, match="there is no such file; built in are px4-multirotor, crazyflie"):
        dr.read_log(csv(tmp_path, t=T, a=Q), mapping="px5")


def test_a_suggested_mapping_reads_the_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = csv(tmp_path, time_ms=1000.0 * T, pos_mm=1000.0 * Q, force_N=TAU, temperature=Q)
    done = run("map", path, "--model", "servo-axis", "-o", "axis.toml")
    assert done.exit_code == 0
    assert "position_ddot: from position_dot with --differentiate" in done.stdout
    log = dr.read_log(path, mapping="axis.toml")
    np.testing.assert_allclose(log["position"], Q)
    np.testing.assert_array_equal(log["force"], TAU)
    assert log.units == {"position": "m", "force": "N"}
    np.testing.assert_allclose(log.time, T, atol=1e-12)


def test_a_suggestion_lists_what_is_missing_with_the_nearest_names(tmp_path):
    path = csv(tmp_path, t=T, pos=Q, force_gauge_raw_counts=TAU)
    found = suggest_mapping(*read_fields(path), dr.models.servo_axis(), "log")
    assert found.missing == {"force": ("force_gauge_raw_counts",)}
    assert found.derivable == {"position_dot": "position", "position_ddot": "position_dot"}
    assert '# name = "force"' in found.toml()


def test_a_suggestion_is_completed_by_filling_in_and_uncommenting(tmp_path):
    path = csv(tmp_path, t=T, enc=Q, drive_counts=TAU, mode=T > 1.0)
    found = suggest_mapping(*read_fields(path), dr.models.servo_axis(), "log")
    assert set(found.missing) == {"position", "force"}
    assert set(found.derivable) == {"position_dot", "position_ddot"}
    text = found.toml()
    for name, field in (("position", "enc"), ("force", "drive_counts")):
        block = f'# [[signals]]\n# name = "{name}"\n# topic = ""\n# field = ""\n'
        assert block in text
        text = text.replace(block, f'[[signals]]\nname = "{name}"\nfield = "{field}"\n')
    event = text[text.index("# [[events]]") : text.index("# Other fields")]
    text = text.replace(event, event.replace("# ", "")).replace("# while", "while").replace(" # above [[signals]]", "")
    moved = next(line for line in text.splitlines() if line.startswith("while"))
    log = dr.read_log(path, mapping=written(tmp_path, f"{moved}\n" + text.replace(moved, "")))
    np.testing.assert_array_equal(log["position"], Q[T > 1.0])


# ---------------------------------------------------------------------- repairs


def lines(**columns):
    return [",".join(columns), *(",".join(f"{x:.17g}" for x in row) for row in zip(*columns.values(), strict=True))]


def broken(kind):
    """CSV text with one fault."""
    text = lines(t=T, x=Q, y=TAU)
    if kind == "comments":
        text[5:5] = ["# battery changed", ""]
    elif kind == "preamble":
        text[:0] = ["Recorder: bench 3", "Date: 2026-01-03"]
    elif kind == "rows":
        text[-1] = "2.99"
    elif kind == "timestamps":
        stamps = np.datetime64("2024-02-28T23:59:59", "ns") + np.round(1e9 * T).astype(int)
        text[1:] = [f"{stamp}Z,{line.split(',', 1)[1]}" for stamp, line in zip(stamps, text[1:], strict=True)]
    elif kind == "cells":
        text[7] = text[7].rsplit(",", 1)[0] + ",#ERR"
    elif kind == "sort":
        text[20], text[21] = text[21], text[20]
    elif kind == "duplicates":
        text.insert(9, text[9])
    elif kind == "clock":
        text[1:] = [
            f"{t + 0.004 * (k % 3 == 1):.17g},{line.split(',', 1)[1]}"
            for k, (t, line) in enumerate(zip(T, text[1:], strict=True))
        ]
    return "\n".join(text)


REFUSED = {
    "comments": "line",
    "preamble": "line 3 has 3 fields, the header has 1; if the header is line 3, pass --repair preamble",
    "rows": "line 301 has 1 fields",
}


@pytest.mark.parametrize("kind", [kind for kind in REPAIRS if kind != "units"])
def test_a_fault_is_refused_and_repaired_by_name(tmp_path, kind):
    path = written(tmp_path, broken(kind), "a.csv")
    if kind in REFUSED:
        with pytest.raises(LogError, match=REFUSED[kind]):
            dr.read_log(path)
        with pytest.raises(LogError, match=REFUSED[kind]):
            dr.read_log(path, repair=[name for name in REPAIRS if name not in (kind, "rows")])
    for repair in (kind, True, "safe"):
        log = dr.read_log(path, repair=repair)
        (step,) = [step for step in log.history if step["step"] == "repair"]
        assert list(step["repairs"]) == [kind]
        assert any(note.startswith(f"repaired ({kind}): ") for note in log.notes)
        if kind != "clock":
            n = len(log)
            np.testing.assert_allclose(log.time, T[:n], atol=1e-9)
            np.testing.assert_array_equal(log["x"], Q[:n])
            assert np.isnan(log["y"]).sum() == (kind == "cells")


def test_times_of_the_calendar_need_no_repair_where_they_are_the_time(tmp_path):
    log = dr.read_log(written(tmp_path, broken("timestamps"), "a.csv"))
    np.testing.assert_allclose(log.time, T, atol=1e-9)
    assert (log.history, log.notes[0]) == ((), '"t" holds times, of which the first is zero')


def test_units_are_repaired_to_si(tmp_path):
    path = tmp_path / "a.csv"
    columns = {"t [ms]": 1000.0 * T, "theta [deg]": Q, "x [m]": TAU}
    path.write_text("\n".join(lines(**columns)))
    log = dr.read_log(path, repair="units")
    np.testing.assert_allclose(log.time, T, atol=1e-12)
    np.testing.assert_allclose(log["theta"], np.deg2rad(Q))
    assert log.units == {"theta": "rad", "x": "m"}
    assert log.history[-1]["repairs"] == {"units": "t from ms to s, theta from deg to rad"}


def test_a_log_without_faults_is_not_repaired(tmp_path):
    path = written(tmp_path, "\n".join(lines(t=T, x=Q)), "a.csv")
    plain, repaired = dr.read_log(path), dr.read_log(path, repair=True)
    assert (plain.fingerprint, plain.history) == (repaired.fingerprint, repaired.history)


def test_many_bad_cells_are_not_repaired(tmp_path):
    text = lines(t=T, x=Q)
    text[10:30] = [line.split(",")[0] + ",?" for line in text[10:30]]
    log = dr.read_log(written(tmp_path, "\n".join(text), "a.csv"), repair="cells")
    assert "x" in log.unusable


def test_the_command_line_repairs_and_lists_it(tmp_path):
    path = written(tmp_path, broken("timestamps"), "a.csv")
    assert "repaired (timestamps)" in run("inspect", path, "--repair", "safe").stdout
    assert 'there is no repair "glue"' in run("inspect", path, "--repair", "glue").stderr


# ---------------------------------------------------------------------- tables in other shapes


def test_columns_and_time_are_given_to_a_file_without_them(tmp_path):
    path = written(tmp_path, "\n".join(lines(x=Q, y=TAU)[1:]), "a.csv")
    with pytest.raises(LogError, match="--columns"):
        dr.read_log(path)
    log = dr.read_log(path, columns=["x", "y"], rate=100.0)
    np.testing.assert_array_equal(log.time, T)
    np.testing.assert_array_equal(log["y"], TAU)
    packed = tmp_path / "a.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert dr.read_log(packed, columns=["x", "y"], rate=100.0).fingerprint == log.fingerprint
    with pytest.raises(LogError, match="3 columns are named, the first line has 2 fields"):
        dr.read_log(path, columns=["t", "x", "y"])
    assert "x " in run("inspect", path, "--columns", "x,y", "--rate", 100).stdout


def test_a_log_is_joined_from_the_files_of_a_folder(tmp_path):
    for name, columns in {"time": [T], "q": [Q, TAU], "tau": [TAU]}.items():
        (tmp_path / f"{name}.csv").write_text(
            "\n".join(",".join(f"{x:.17g}" for x in row) for row in np.transpose(columns))
        )
    log = dr.read_log(tmp_path)
    np.testing.assert_array_equal(log.time, T)
    for name, values in {"q_1": Q, "q_2": TAU, "tau": TAU}.items():
        np.testing.assert_array_equal(log[name], values)
    (tmp_path / "tau.csv").write_text("1\n2\n")
    with pytest.raises(LogError, match="different numbers of rows: q 300, tau 2, time 300"):
        dr.read_log(tmp_path)


def test_structures_and_groups_have_dotted_names(tmp_path):
    h5py = pytest.importorskip("h5py", reason="NOT CHECKED with HDF5: h5py is missing")
    scipy.io.savemat(tmp_path / "a.mat", {"log": {"t": T, "arm": {"q": Q}}})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["log/t"], file["log/arm/q"] = T, Q
        file["log/link"] = h5py.ExternalLink("/etc/passwd", "/")
    with h5py.File(tmp_path / "b.mat", "w", userblock_size=512) as file:
        file["log/t"], file["log/arm/q"] = T[None, :], np.stack([Q, TAU])
    for name in ("a.mat", "a.h5", "b.mat"):
        log = dr.read_log(tmp_path / name, rename={"t": "log.t"})
        np.testing.assert_array_equal(log.time, T)
        first = "log.arm.q_1" if name == "b.mat" else "log.arm.q"
        np.testing.assert_array_equal(log[first], Q)


def test_an_array_that_declares_more_than_it_holds_is_refused(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"t": T})
    data = bytearray((tmp_path / "a.mat").read_bytes())
    data[128 + 32 : 128 + 40] = struct.pack("<ii", 1, 900_000_000)  # its dimensions
    (tmp_path / "a.mat").write_bytes(data)
    with pytest.raises(LogError, match=r'"t" has 300 numbers for the size \(1, 900000000\)'):
        dr.read_log(tmp_path / "a.mat")


@pytest.mark.parametrize("do_compression", [True, False])
def test_mat_files_have_the_arrays_that_scipy_reads(tmp_path, do_compression):
    kinds = {kind: np.arange(-3, 9).astype(kind) for kind in ("f4", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8")}
    arrays = {"t": np.arange(12.0), "flag": np.arange(12) > 5, **{f"x_{kind}": x for kind, x in kinds.items()}}
    others = {"q": np.arange(24.0).reshape(12, 2), "note": "text", "cells": np.array([1, "a"], dtype=object), "z": 1j}
    scipy.io.savemat(tmp_path / "a.mat", arrays | others, do_compression=do_compression)
    log = dr.read_log(tmp_path / "a.mat")
    found = scipy.io.loadmat(tmp_path / "a.mat")
    for name in arrays:
        np.testing.assert_array_equal(log[name], found[name].ravel())
    np.testing.assert_array_equal(np.column_stack([log["q_1"], log["q_2"]]), found["q"])
    assert set(log.unusable) == {"note", "cells", "z"}


def test_an_hdf5_file_that_declares_more_than_it_holds_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py", reason="NOT CHECKED with HDF5: h5py is missing")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = T
        file.create_dataset("x", shape=(1 << 40,), dtype="f8", chunks=(1 << 16,))
    with pytest.raises(LogError, match="it has 1,099,511,627,776 rows; up to 10,000,000 are possible"):
        dr.read_log(tmp_path / "a.h5")
    (tmp_path / "b.h5").write_bytes((tmp_path / "a.h5").read_bytes()[:700])
    with pytest.raises(LogError, match="is not an HDF5 file, or is damaged"):
        dr.read_log(tmp_path / "b.h5")
