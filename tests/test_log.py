"""`Log`: what it holds, what it refuses, what it writes."""

import copy
import dataclasses
import json
import pickle
import re

import numpy as np
import pandas as pd
import polars as pl
import pytest
from hypothesis import example as tried
from hypothesis import given
from hypothesis import strategies as st

from diransac.data.files import place_of_metadata
from diransac.data.filters import FilterSpecification
from diransac.data.log import Log
from diransac.data.preprocessing import differentiate, rename, scale
from diransac.data.readers import read_log
from diransac.errors import LogError, SettingsError
from diransac.identification.identify import identify
from diransac.model.library.drives import servo_axis
from diransac.plain_text import one_line


def example(n=100, dt=0.01, **signals):
    t = np.arange(n) * dt
    return Log.from_arrays(t, signals or {"x": np.sin(t), "u": np.cos(t)}, {"x": "m"}, 'log "a.csv"')


def test_signals_are_found_by_name():
    log = example()
    assert np.array_equal(log["x"], np.sin(log.time))
    assert log.names == ("x", "u")
    assert "x" in log
    assert "t" not in log
    assert np.array_equal(log["t"], log.time)
    assert "y" not in log
    assert len(log) == 100
    assert log.dt == pytest.approx(0.01, rel=1e-12)
    assert log.units == {"x": "m"}
    assert "100 rows at 100 Hz" in repr(log)


def test_a_missing_signal_is_named_with_what_was_found():
    with pytest.raises(LogError, match=r'log "a.csv": signal "theta_ddot" is missing; found t, x, u$'):
        example()["theta_ddot"]


def test_arrays_are_copied_and_read_only():
    t, x = np.arange(5.0), np.ones(5)
    log = Log.from_arrays(t, {"x": x})
    x[0] = t[0] = -7.0
    assert log["x"][0] == 1.0
    assert log.time[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        log["x"][0] = 2.0
    with pytest.raises(TypeError):
        log.signals["y"] = x


def test_integers_and_booleans_become_floats():
    log = Log.from_arrays([0, 1, 2], {"n": [1, 2, 3], "on": [True, False, True], "gap": [1, None, 3]})
    assert log["n"].dtype == log["on"].dtype == log["gap"].dtype == np.float64
    assert np.isnan(log["gap"][1])


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ([0.0], "at least 2 rows; found 1"),
        ([0.0, 1.0, np.nan, 3.0], "time is nan at row 2"),
        ([0.0, 1.0, np.inf, 3.0], "time is inf at row 2"),
        ([0.0, 1.0, 1.0, 1.0], r"repeats at row 2 \(and 1 more like it\)"),
        ([0.0, 1.0, 2.0, 3.0, 4.0, 0.0], "time runs backwards at row 5: 0 s follows 4 s; sort"),
        (
            [0.0, 1.0, 2.0, 20.0, 20.5],
            r"1 gap, the longest after t = 2 s \(row 2\) is 18 s long, the usual interval 1 s",
        ),
    ],
)
def test_a_time_that_cannot_be_used_is_refused_with_the_place(time, message):
    with pytest.raises(LogError, match=message):
        Log.from_arrays(time, {"x": np.zeros(len(time))})


@pytest.mark.parametrize(
    ("signals", "message"),
    [
        ({"x": [1.0, 2.0]}, '"x" has 2 rows, the time has 3'),
        ({"x": [[1.0, 2.0, 3.0]]}, r'"x" has shape \(1, 3\)'),
        ({"x": ["1", "two", "3"]}, '"x" is not numeric'),
        ({"x": [1.0, "two", 3.0]}, '"x" is not numeric'),
        ({"x": [1j, 2.0, 3.0]}, '"x" is not numeric'),
        ({"t": [1.0, 2.0, 3.0]}, '"t" is the time'),
        ({"": [1.0, 2.0, 3.0]}, "cannot name a signal"),
        ({3: [1.0, 2.0, 3.0]}, "3 cannot name a signal"),
    ],
)
def test_signals_that_cannot_be_used_are_refused(signals, message):
    with pytest.raises(LogError, match=message):
        Log.from_arrays([0.0, 1.0, 2.0], signals)


def test_a_unit_for_no_signal_is_refused():
    with pytest.raises(LogError, match='a unit is given for "y"; found x'):
        Log.from_arrays([0, 1], {"x": [0, 1]}, {"y": "m"})


def test_a_clock_that_ticks_in_whole_nanoseconds_is_silent():
    n = np.arange(1000)
    log = Log.from_arrays(n * 1e-3 + 2.4e-8 * (n % 2), {"x": n})
    assert log.notes == ()


def test_small_jitter_is_said_with_size_and_place():
    t = np.arange(100) * 0.01
    t[40] += 0.001
    (note,) = Log.from_arrays(t, {"x": t}).notes
    assert "10.0% of a sample (at t = 0.39 s)" in note


@pytest.mark.parametrize("hertz", [20.0, 100.0, 500.0])
@pytest.mark.parametrize(("unit", "tick"), [("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9)])
def test_a_clock_that_does_not_count_seconds_is_said_with_its_scale(hertz, unit, tick):
    time = np.arange(50) / hertz / tick
    finding = f"rows are {1 / hertz / tick:.4g} s apart: if t is in {unit}, pass --scale t={tick:g}"
    if unit == "milliseconds":
        assert Log.from_arrays(time, {"x": time}).notes == (finding,)
    else:
        with pytest.raises(LogError, match=re.escape(finding)):
            Log.from_arrays(time, {"x": time})


@pytest.mark.parametrize("dt", [1e-6, 1e-3, 0.5, 1.0])
def test_a_clock_that_may_count_seconds_is_silent(dt):
    time = np.arange(50) * dt
    assert Log.from_arrays(time, {"x": time}).notes == ()


def test_a_clock_too_fast_for_seconds_is_said():
    time = np.arange(50) * 1e-9
    (note,) = Log.from_arrays(time, {"x": time}).notes
    assert note.startswith("rows are 1e-09 s apart: check the unit of t")


def test_missing_and_infinite_samples_are_said_once_for_all_signals_that_share_them():
    x = np.arange(10.0)
    x[[3, 5]] = np.nan
    y = np.where(np.arange(10) == 7, np.inf, 0.0)
    notes = Log.from_arrays(np.arange(10), {"x": x, "z": x, "y": y}).notes
    assert notes == (
        '"x", "z" are NaN in 2 of 10 rows, first at t = 3 s',
        '"y" is infinite in 1 of 10 rows, first at t = 7 s',
    )


def test_check_passes_what_can_be_squared_and_summed():
    x = np.array([1.0, np.nan, -1e149])
    Log.from_arrays([0, 1, 2], {"x": x, "y": [np.inf, 1, 2]}).check(["x"])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([np.nan] * 3, 'log "a.csv": signal "x" is NaN in every row'),
        ([1.0, -np.inf, 2.0], r'log "a.csv": signal "x" is infinite at row 1 \(t = 0.01 s\)'),
        ([1.0, 2.0, -1e160], r'log "a.csv": signal "x" is -1e\+160 at row 2 .* square overflows'),
    ],
)
def test_check_names_signal_and_row(values, message):
    with pytest.raises(LogError, match=message):
        example(3, x=values).check(["x"])


# ---------------------------------------------------------------------- parts


def test_slices_by_row_and_by_time_agree():
    log = example()
    by_row, by_time = log[20:41], log.between(0.2, 0.4)
    assert len(by_row) == 21
    assert by_row.fingerprint == by_time.fingerprint
    assert by_time.time[0] == log.time[20]
    assert by_time.history == ({"step": "cut", "start": log.time[20], "end": log.time[40], "rows": 21},)


def test_split_parts_make_the_whole():
    log = example()
    first, second = log.split(0.7)
    assert len(first) == 70
    assert np.array_equal(np.concatenate([first["u"], second["u"]]), log["u"])


@pytest.mark.parametrize("part", [lambda x: x[3:4], lambda x: x.between(5.0, 6.0), lambda x: x.split(0.001)])
def test_a_part_without_two_rows_is_refused(part):
    with pytest.raises(LogError, match="2 rows"):
        part(example())


@pytest.mark.parametrize("fraction", [np.nan, -0.5, 0.0, 1.0, np.inf])
def test_split_refuses_what_is_no_fraction(fraction):
    with pytest.raises(LogError, match=r"fraction is .*; give a number between 0 and 1"):
        example().split(fraction)


# ---------------------------------------------------------------------- identity


def test_fingerprint_tells_names_times_and_samples_apart_but_not_column_order():
    t, x, y = np.arange(4.0), np.ones(4), np.array([0.0, np.nan, 2.0, 3.0])
    one = Log.from_arrays(t, {"x": x, "y": y}).fingerprint
    assert Log.from_arrays(t, {"y": y.copy(), "x": x}).fingerprint == one
    others = [
        Log.from_arrays(t, {"x": y, "y": x}),
        Log.from_arrays(t + 1, {"x": x, "y": y}),
        Log.from_arrays(t, {"x": np.nextafter(x, 2), "y": y}),
        Log.from_arrays(t, {"x": x}),
    ]
    assert len({one, *(other.fingerprint for other in others)}) == 5


@pytest.mark.parametrize("clone", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy])
def test_a_log_survives_pickling(clone):
    log = example()[5:50]
    other = clone(log)
    assert other.fingerprint == log.fingerprint
    assert (other.history, other.notes, other.source) == (log.history, log.notes, log.source)
    assert (other.units, other.unusable) == (log.units, log.unusable)
    assert not other["x"].flags.writeable


# ---------------------------------------------------------------------- frames


@pytest.mark.parametrize("frame", [pl.DataFrame, pd.DataFrame])
def test_frames_give_signals_units_and_notes(frame):
    log = Log.from_frame(
        frame({"time": [0.0, 0.1, 0.2], "theta [deg]": [1, 2, 3], "mode": ["a", "b", "c"]}), time="time"
    )
    assert log.names == ("theta",)
    assert log.units == {"theta": "deg"}
    assert log.notes == ("column \"mode\" is left out: it is not numeric: row 0 holds 'a'",)
    with pytest.raises(LogError, match='signal "mode" is not numeric: row 0 holds'):
        log["mode"]


def test_missing_values_of_frames_are_nan():
    for frame in (
        pl.DataFrame({"t": [0, 1, 2], "x": [1, None, 3], "on": [True, None, False]}),
        pd.DataFrame({"t": [0, 1, 2], "x": pd.array([1, None, 3], dtype="Int64"), "on": [True, None, False]}),
    ):
        log = Log.from_frame(frame)
        assert np.array_equal(log["x"], [1.0, np.nan, 3.0], equal_nan=True)
        assert np.array_equal(log["on"], [1.0, np.nan, 0.0], equal_nan=True)


def test_a_frame_without_its_time_column_is_refused():
    with pytest.raises(LogError, match='no time column "t"; found a, b'):
        Log.from_frame(pl.DataFrame({"a": [0, 1], "b": [0, 1]}))


@pytest.mark.parametrize("frame", [3, "a.csv", {"t": [0, 1]}])
def test_what_is_no_frame_is_refused(frame):
    with pytest.raises(LogError, match=r"frame is a .*; give a polars or pandas data frame"):
        Log.from_frame(frame)


def test_a_frame_with_two_columns_of_one_name_is_refused():
    with pytest.raises(LogError, match="two columns have one name"):
        Log.from_frame(pd.DataFrame(np.zeros((3, 3)), columns=["t", "x", "x"]))


# ---------------------------------------------------------------------- writing

ENDINGS = [".csv", ".csv.gz", ".parquet", ".npz"]
any_float = st.floats(width=64)
names = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1, max_size=8).filter(
    lambda name: name != "t" and "[" not in name
)


@tried(ending=".parquet", signals={"*": [0.0, 1.0, 2.0], "^.*$": [3.0, 4.0, 5.0]}, start=0.0)
@given(
    ending=st.sampled_from(ENDINGS),
    signals=st.dictionaries(names, st.lists(any_float, min_size=3, max_size=3), min_size=1, max_size=4),
    start=st.floats(-1e6, 1e6),
)
def test_every_number_reads_back_exactly(tmp_path_factory, ending, signals, start):
    path = tmp_path_factory.mktemp("round_trip") / f"a{ending}"
    log = Log.from_arrays(start + np.arange(3), signals)
    log.write(path)
    back = read_log(path)
    assert back.fingerprint == log.fingerprint
    assert back.names == log.names


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_same_log_gives_the_same_bytes_and_nothing_else(tmp_path, ending):
    paths = [tmp_path / "one" / f"a{ending}", tmp_path / "two" / f"a{ending}"]
    for path in paths:
        path.parent.mkdir()
        example().write(path)
        beside = [place_of_metadata(path)] if ".csv" in ending else []
        assert sorted(path.parent.iterdir()) == [path, *beside]
    for name in {x.name for x in paths[0].parent.iterdir()}:
        assert (paths[0].parent / name).read_bytes() == (paths[1].parent / name).read_bytes()


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_failed_write_leaves_the_existing_file(tmp_path, ending, monkeypatch):
    path = tmp_path / f"a{ending}"
    path.write_bytes(b"precious")
    place_of_metadata(path).write_bytes(b"of the precious")

    def refuse(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", refuse)
    with pytest.raises(LogError, match=r"cannot write .* No space left"):
        example().write(path)
    assert sorted(tmp_path.iterdir()) == [path, place_of_metadata(path)]
    assert path.read_bytes() == b"precious"
    assert place_of_metadata(path).read_bytes() == b"of the precious"


def test_an_unknown_ending_or_folder_is_refused(tmp_path):
    with pytest.raises(LogError, match=r"use one of .csv, .csv.gz, .parquet, .npz"):
        example().write(tmp_path / "a.xlsx")
    with pytest.raises(LogError, match="No such file or directory"):
        example().write(tmp_path / "nowhere" / "a.csv")
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------- metadata of files


def differentiated():
    t = np.arange(1500) * 0.01
    position, force = 0.1 * np.sin(3 * t) + 0.02 * np.sin(7 * t), 50.0 * np.cos(3 * t) + np.sin(11 * t)
    log = Log.from_arrays(t, {"position": position, "force": force}, {"position": "m", "force": "N"})
    return differentiate(log, servo_axis(), 5.0)


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_written_log_reads_back_whole(tmp_path, ending):
    frame = pl.DataFrame(
        {"t": np.arange(9) * 0.1, "x [m]": [1.0, float("nan"), *range(7)], "µ": [0.1] * 9, "mode": "a"}
    )
    log = dataclasses.replace(
        Log.from_frame(frame)[1:],
        filter=FilterSpecification(1 / 3, 0.1, {"x": "µ"}),
        notes=("an é\n\u2028 'of' \"it\"",),
    )
    log = scale(log, {"µ": 1 / 3})
    log.write(tmp_path / f"a{ending}")
    back = read_log(tmp_path / f"a{ending}")
    assert (back.fingerprint, back.names, back.units) == (log.fingerprint, log.names, {"x": "m"})
    assert (back.filter, back.history) == (log.filter, log.history)
    assert back.notes[: len(log.notes)] == tuple(map(one_line, log.notes))  # a break within a note is shown
    with pytest.raises(LogError, match="\"mode\" is not numeric: row 0 holds 'a'"):
        back["mode"]
    back.write(tmp_path / f"b{ending}")
    again = read_log(tmp_path / f"b{ending}")
    assert (again.notes, again.unusable, again.filter, again.history) == (
        back.notes,
        back.unusable,
        back.filter,
        back.history,
    )


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("part", [slice(None), slice(200, 900)], ids=["whole", "part"])
def test_a_differentiated_log_that_is_read_back_gives_the_same_identification(tmp_path, ending, part):
    log = differentiated()[part]
    log.write(tmp_path / f"a{ending}")
    back = read_log(tmp_path / f"a{ending}")
    one, two = (identify(servo_axis(), each, "ols") for each in (log, back))
    assert one.parameters == two.parameters
    assert one.standard_errors == two.standard_errors
    assert one.parameters != identify(servo_axis(), dataclasses.replace(log, filter=None), "ols").parameters


@pytest.mark.parametrize(
    "change",
    [
        lambda x: x[100:300],
        lambda x: x.between(2.0, 4.0),
        lambda x: x.split(0.5)[1],
        lambda x: x.with_step({"step": "nothing"}),
        lambda x: scale(x, {"force": 2.0}),
        lambda x: pickle.loads(pickle.dumps(x)),
        copy.deepcopy,
    ],
    ids=["slice", "between", "split", "with_step", "scale", "pickle", "deepcopy"],
)
def test_a_log_keeps_its_filter(change):
    log = differentiated()
    assert log.filter == FilterSpecification(5.0, 20.0, {"position_dot": "position", "position_ddot": "position"})
    assert change(log).filter == log.filter


@pytest.mark.parametrize("by_reading", [False, True])
def test_names_in_the_filter_follow_their_signals(tmp_path, by_reading):
    log, names = differentiated(), {"x": "position", "x_ddot": "position_ddot"}
    log.write(tmp_path / "a.csv")
    new = read_log(tmp_path / "a.csv", rename=names) if by_reading else rename(log, names)
    assert new.filter == FilterSpecification(5.0, 20.0, {"position_dot": "x", "x_ddot": "x"})


@pytest.mark.parametrize("bandwidths", [(0.0, 1.0), (1.0, -1.0), (np.nan, 1.0), (1.0, np.inf)])
def test_a_filter_has_positive_bandwidths(bandwidths):
    with pytest.raises(SettingsError, match=r"bandwidth is .*; give a positive number of Hz"):
        FilterSpecification(*bandwidths)


def test_a_filter_too_long_for_any_memory_is_refused():
    with pytest.raises(LogError, match="a filter of 1e-12 Hz is too long for its rate"):
        dataclasses.replace(example(), filter=FilterSpecification(1e-12, 1.0))


@pytest.mark.parametrize("ending", ENDINGS)
def test_no_signal_can_be_taken_for_metadata(tmp_path, ending):
    columns = {name: np.arange(3.0) for name in ("diransac", "diransac.json", "# diransac:", "#", '"')}
    log = Log.from_arrays(np.arange(3), columns, {"#": "m"})
    log.write(tmp_path / f"a{ending}")
    back = read_log(tmp_path / f"a{ending}")
    assert back.names == log.names
    assert back.fingerprint == log.fingerprint
    assert back.units == {"#": "m"}


def test_other_tools_read_the_columns(tmp_path):
    log = differentiated()
    for ending in ENDINGS:
        log.write(tmp_path / f"a{ending}")
    with np.load(tmp_path / "a.npz") as arrays:
        assert np.array_equal(arrays["position"], log["position"])
    for frame in (
        pl.read_csv(tmp_path / "a.csv"),
        pd.read_csv(tmp_path / "a.csv"),
        pd.read_csv(tmp_path / "a.csv.gz"),
        pl.read_parquet(tmp_path / "a.parquet"),
    ):
        assert list(frame.columns) == ["t", *log.names]
        assert np.allclose(frame["position"].to_numpy(), log["position"], rtol=1e-15, atol=0.0)


def test_a_log_without_facts_is_written_without_metadata(tmp_path):
    log = Log.from_arrays([0, 1], {"x": [0, 1]})
    example().write(tmp_path / "a.csv")  # whose metadata are removed
    log.write(tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == "t,x\n0.0,0.0\n1.0,1.0\n"
    assert list(tmp_path.iterdir()) == [tmp_path / "a.csv"]


def test_metadata_beside_a_table_are_csv_on_the_web(tmp_path):
    log = Log.from_arrays([0, 1], {"x": [0, 1], "u": [2, 3]}, {"x": "mm"}).with_step({"step": "mine"})
    log.write(tmp_path / "a.csv")
    found = json.loads((tmp_path / "a.csv-metadata.json").read_text())
    assert found == {
        "@context": "http://www.w3.org/ns/csvw",
        "url": "a.csv",
        "tableSchema": {
            "columns": [
                {"titles": "t", "datatype": "number", "schema:unitText": "s"},
                {"titles": "x", "datatype": "number", "schema:unitText": "mm"},
                {"titles": "u", "datatype": "number"},
            ]
        },
        "notes": [{"diransac": {"version": 1, "history": [{"step": "mine"}]}}],
    }


def test_metadata_of_another_tool_give_units(tmp_path):
    (tmp_path / "a.csv").write_text("t,x\n0,1\n1,2\n")
    columns = [{"titles": "t"}, {"titles": "x", "schema:unitText": "mm"}]
    content = {"@context": "http://www.w3.org/ns/csvw", "url": "a.csv", "tableSchema": {"columns": columns}}
    (tmp_path / "a.csv-metadata.json").write_text(json.dumps(content))
    assert read_log(tmp_path / "a.csv").units == {"x": "mm"}


@pytest.mark.parametrize("text", ["{", "[]", '{"@context": 1, "tableSchema": []}', '{"@context": 1, "notes": 3}'])
def test_damaged_metadata_beside_a_table_are_refused_with_the_remedy(tmp_path, text):
    (tmp_path / "a.csv").write_text("t,x\n0,1\n1,2\n")
    (tmp_path / "a.csv-metadata.json").write_text(text)
    with pytest.raises(LogError, match=r'metadata are damaged .*; remove ".*a\.csv-metadata\.json"'):
        read_log(tmp_path / "a.csv")


def test_the_first_line_of_earlier_versions_is_still_read(tmp_path):
    (tmp_path / "a.csv").write_text('# diransac: {"version": 1, "units": {"x": "m"}}\nt,x\n0,1\n1,2\n')
    assert read_log(tmp_path / "a.csv").units == {"x": "m"}


def test_the_footer_of_parquet_has_the_metadata(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="NOT CHECKED with pyarrow, which is missing")
    example().write(tmp_path / "a.parquet")
    facts = json.loads(parquet.read_metadata(tmp_path / "a.parquet").metadata[b"diransac"])
    assert facts["units"] == {"x": "m"}


def test_parquet_of_other_tools_and_of_earlier_versions_is_read(tmp_path):
    """Their metadata have other keys, or none."""
    columns = pd.DataFrame({"t": [0.0, 0.1, 0.2], "x": [1.0, 2.0, 4.0]})
    columns.to_parquet(tmp_path / "pandas.parquet")
    pl.from_pandas(columns).write_parquet(tmp_path / "polars.parquet")
    for name in ("pandas", "polars"):
        log = read_log(tmp_path / f"{name}.parquet")
        assert (log.names, log["x"].tolist(), log.history) == (("x",), [1.0, 2.0, 4.0], ())


def test_a_step_that_json_cannot_hold_is_refused(tmp_path):
    with pytest.raises(LogError, match="history cannot be written as JSON"):
        example().with_step({"step": "mine", "model": object()}).write(tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []
