"""`read_log`: every format it reads, and every hostile file it turns into one clear sentence."""

import gzip
import io
import json
import random
import zipfile
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st

from diransac.data.log import Log
from diransac.data.readers import comma_separated, read_log
from diransac.errors import DiransacError, LogError, SettingsError

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def real(name):
    path = DATA / name
    if not path.exists():
        pytest.skip(f"the real logs are not here: {path} is missing")
    return path


def packed(data):
    """Gzip data that do not depend on the time of day, which would otherwise be part of their header."""
    return gzip.compress(data, mtime=0)


def npz(**arrays):
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def mat(**arrays):
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, arrays, do_compression=True)
    return buffer.getvalue()


def parquet(**columns):
    buffer = io.BytesIO()
    pl.DataFrame(columns).write_parquet(buffer)
    return buffer.getvalue()


def zipped(*entries):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in entries:
            archive.writestr(name, data)
    return buffer.getvalue()


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def read(tmp_path, data, name="a.csv", **options):
    path = tmp_path / name
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return read_log(path, **options)


T = np.arange(5) * 0.1
GARBAGE = random.Random(1).randbytes(4000)
PICKLED = np.array([{"a": 1}] * 5, dtype=object)

HOSTILE = {
    "empty.csv": (b"", "it is empty"),
    "blank.csv": (b"\n \n\n", "it is empty"),
    "header_only.csv": (b"t,x\n", r"there is a header \(t, x\) but no row"),
    "one_row.csv": (b"t,x\n0,1\n", "at least 2 rows; found 1"),
    "too_many.csv": (b"t,x\n0,1\n1,2,3\n2,3\n", "line 3 has 3 fields, the header has 2"),
    "too_few.csv": (b"t,x,y\n0,1,2\n1,2\n2,3,4\n", "line 3 has 2 fields, the header has 3"),
    "too_few_quoted.csv": (b't,"x",y\n0,1,2\n1,"2"\n2,3,4\n', "line 3 has 2 fields, the header has 3"),
    "hole.csv": (b"t,x\n0,1\n\n2,3\n", "line 3 is blank; remove blank lines$"),
    "holes.csv": (b't,"x"\n0,1\n\n2,3\n \n3,4', "line 3 is blank, the first of 2; remove blank lines$"),
    "open_quote.csv": (b't,x\n0,"1\n1,2\n2,3\n', "line .* cannot be read"),
    "broken_field.csv": (b't,x\n0,"1\n"\n1,2\n2,3\n', "line 2 has a line break in quotation marks"),
    "broken_header.csv": (b't,"x\n"\n0,1\n1,2\n', "line 1 has a line break in quotation marks"),
    "cut.csv": (b"t,x,y\n0,1,2\n1,2,3\n2,", "line 4 has 2 fields"),
    "garbage.csv": (GARBAGE, "not UTF-8 text"),
    "nul.csv": (b"t,x\n0,\x001\n1,2\n", "binary data"),
    "twice.csv": (b"t,x,x\n0,1,2\n1,2,3\n", '2 columns are called "x"'),
    "twice_with_unit.csv": (b"t,x,x [m]\n0,1,2\n1,2,3\n", '2 columns are called "x"'),
    "two_times.csv": (b"time_s,stamp,x\n0,0,1\n1,1,2\n", 'no time column "t"; found time_s, stamp, x. .*--map t=NAME$'),
    "no_clue.csv": (b"a,x\n0,1\n1,2\n", "found a, x. .*--map t=NAME"),
    "no_header.csv": (b"0.0,1\n0.1,2\n", "the first line holds numbers .*header line"),
    "text_time.csv": (b"t,x\n0,1\nnoon,2\n", 'the time column "t" is not numeric: line 3 holds "noon"'),
    "hole_in_time.csv": (b"t,x\n0,1\n,2\n2,3\n", "time is nan at row 1"),
    "repeated_time.csv": (b"t,x\n0,1\n1,2\n1,3\n1,4\n", "time 1 s repeats at row 2"),
    "backwards.csv": (b"t,x\n0,1\n1,2\n2,3\n3,4\n4,5\n0,6\n", "time runs backwards at row 5"),
    "events.csv": (b"t,x\n0,1\n1,2\n2,3\n9,4\n9.5,5\n", "1 gap, .*--resample 1"),
    "huge_field.csv": (b't,"' + b"x" * 200_000 + b'"\n0,1\n1,2\n', "header line cannot be read"),
    "a.csv.gz": (packed(b"t,x\n0,1\n1,2\n" * 50)[:-20], "gzip data are damaged or cut off"),
    "plain.csv.gz": (b"t,x\n0,1\n1,2\n", "gzip data are damaged or cut off"),
    "empty.csv.gz": (packed(b""), "it is empty"),
    "garbage.parquet": (GARBAGE, "not a Parquet file"),
    "cut.parquet": (parquet(t=T, x=T)[:-30], "cut off"),
    "hollow.parquet": (b"PAR1" + GARBAGE + b"PAR1", "damaged"),
    "text_time.parquet": (parquet(t=["a", "b"], x=[1, 2]), 'time column "t" is not numeric: row 0 holds a'),
    "rows.parquet": (parquet(t=[0.0], x=[1.0]), "at least 2 rows; found 1"),
    "none.parquet": (parquet(t=pl.Series([], dtype=pl.Float64)), "at least 2 rows; found 0"),
    "garbage.npz": (GARBAGE, "not an NPZ file"),
    "cut.npz": (npz(t=T, x=T)[:-40], "not an NPZ file, or is cut off"),
    "pickled.npz": (npz(t=T, x=PICKLED), 'array "x" cannot be read .*allow_pickle=False'),
    "pickled_time.npz": (npz(t=PICKLED), 'array "t" cannot be read .*allow_pickle=False'),
    "text.npz": (zipped(("t.npy", b"not an array")), 'array "t" cannot be read'),
    "short.npz": (zipped(("t.npy", npy(T)[:-8])), 'array "t" cannot be read'),
    "scalar.npz": (npz(t=np.array(1.0), x=T), "at least 2 rows; found 1"),
    "cube.npz": (npz(t=np.zeros((2, 2, 2))), '"t" has 3 dimensions'),
    "garbage.mat": (GARBAGE, "not a MAT file, or is damaged"),
    "cut.mat": (mat(t=T, x=np.random.default_rng(0).normal(size=5))[:-20], "not a MAT file, or is damaged"),
    "v73.mat": (b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n", "HDF5"),
    "cells.mat": (mat(t=PICKLED), 'time column "t" is not numeric'),
    "flight.dat": (b"ULog", 'ending ".dat" is not known; use one of .csv'),
    "flight": (b"t,x", 'ending "" is not known'),
    "flight.gz": (b"t,x", 'ending ".gz" is not known'),
}


METADATA = {
    "text": ("units are metres", "JSONDecodeError: Expecting value"),
    "cut": ('{"version": 1, "units": {"x"', "JSONDecodeError"),
    "a list": ("[1]", "AttributeError"),
    "a number": ("3", "AttributeError"),
    "later": ('{"version": 2, "filters": []}', "of version 2, this diransac reads version 1; update diransac, or"),
    "no version": ("{}", "of version None"),
    "units": ('{"version": 1, "units": {"x": 3}}', "a number stands where a text belongs"),
    "units as a list": ('{"version": 1, "units": ["x"]}', "ValueError"),
    "notes": ('{"version": 1, "notes": [1]}', "a number stands"),
    "history": ('{"version": 1, "history": [3]}', "TypeError"),
    "a step without a name": ('{"version": 1, "history": [{}]}', "a step of the history has no name"),
    "half a filter": ('{"version": 1, "filter": {"bandwidth": 1.0}}', "KeyError"),
    "no filter": ('{"version": 1, "filter": 3}', "TypeError"),
    "no number": (
        '{"version": 1, "filter": {"bandwidth": "wide", "derivation_bandwidth": 1, "derived": {}}}',
        "could not convert",
    ),
    "negative": (
        '{"version": 1, "filter": {"bandwidth": -1, "derivation_bandwidth": 1, "derived": {}}}',
        "bandwidth is -1.0; give a positive number",
    ),
    "endless": (
        '{"version": 1, "filter": {"bandwidth": 1e-300, "derivation_bandwidth": 1, "derived": {}}}',
        "too long for its rate",
    ),
    "deep": ("[" * 100_000, "nested too deeply"),
    "unnamed": ('{"version": 1, "unusable": {"": "is text"}}', "cannot name a signal"),
}


def with_metadata(text):
    """A small log in every format that has metadata."""
    buffer = io.BytesIO()
    pl.DataFrame({"t": T, "x": T}).write_parquet(buffer, metadata={"diransac": text})
    rows = "".join(f"{t},{t}\n" for t in T)
    csv = f"# diransac: {text}\nt,x\n{rows}".encode()
    archive = zipped(("t.npy", npy(T)), ("x.npy", npy(T)), ("diransac.json", text))
    return {"a.csv": csv, "a.csv.gz": packed(csv), "a.npz": archive, "a.parquet": buffer.getvalue()}


@pytest.mark.parametrize("case", METADATA)
def test_hostile_metadata_end_in_one_sentence_that_names_the_file(tmp_path, case):
    text, message = METADATA[case]
    for name, data in with_metadata(text).items():
        with pytest.raises(LogError, match=message) as caught:
            read(tmp_path, data, name)
        said = str(caught.value)
        assert said.startswith(f'log "{tmp_path / name}": ')
        assert "\n" not in said
        assert len(said) < len(str(tmp_path)) + 400


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.sampled_from(["x", "t"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["x", "t", "", "step"]), inner),
    max_leaves=6,
)
ANY_FILTER = st.fixed_dictionaries({"bandwidth": ANY_JSON, "derivation_bandwidth": ANY_JSON, "derived": ANY_JSON})


@given(
    st.dictionaries(st.sampled_from(["units", "history", "notes", "unusable", "filter"]), ANY_JSON),
    st.none() | ANY_FILTER,
)
def test_any_metadata_are_read_or_refused_by_our_own_error(tmp_path_factory, facts, filtered):
    text = json.dumps({**facts, **({"filter": filtered} if filtered else {}), "version": 1})
    folder = tmp_path_factory.mktemp("metadata")
    assert is_log_or_sentence(folder, with_metadata(text)["a.csv"])


def test_metadata_of_columns_that_are_gone_are_harmless(tmp_path):
    text = '{"version": 1, "units": {"x": "m", "y": "s"}, "unusable": {"x": "was text", "y": "is text"}}'
    for name, data in with_metadata(text).items():
        log = read(tmp_path, data, name)
        assert log.units == {"x": "m"}
        assert log.unusable == {"y": "is text"}
        assert np.array_equal(log["x"], T)


def test_units_in_headers_prevail_over_metadata(tmp_path):
    assert read(tmp_path, '# diransac: {"version": 1, "units": {"x": "m"}}\nt,x [mm]\n0,1\n1,2\n').units == {"x": "mm"}


def test_metadata_that_a_spreadsheet_has_split_are_refused(tmp_path):
    with pytest.raises(LogError, match=r"metadata are damaged .*; remove its first line$"):
        read(tmp_path, '"# diransac: {""version"": 1"," ""units"": {}}"\nt,x\n0,1\n1,2\n')


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0,1\n1,2,3\n", "line 4 has 3 fields"),
        ('0,"1"\n1,2,3\n', "line 4 has 3 fields"),
        ("0,1\n\n1,2\n", "line 4 is blank"),
        ('0,1\n1,"2\n', "line 4 cannot be read"),
        ("0,1\nnoon,2\n", 'line 4 holds "noon"'),
        ("", "no row"),
    ],
)
def test_lines_are_counted_with_the_metadata(tmp_path, rows, message):
    with pytest.raises(LogError, match=message):
        read(tmp_path, '# diransac: {"version": 1}\nt,x\n' + rows)


def test_metadata_alone_are_no_log(tmp_path):
    with pytest.raises(LogError, match="no header line after the metadata"):
        read(tmp_path, '# diransac: {"version": 1}\n')


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_ends_in_one_sentence_that_names_it(tmp_path, name):
    data, message = HOSTILE[name]
    with pytest.raises(LogError, match=message) as caught:
        read(tmp_path, data, name)
    text = str(caught.value)
    assert text.startswith(f'log "{tmp_path / name}": ')
    assert "\n" not in text
    assert len(text) < len(str(tmp_path)) + 400


def test_no_file_no_path_and_a_folder_are_told_apart(tmp_path):
    with pytest.raises(LogError, match="there is no such file"):
        read_log(tmp_path / "a.csv")
    with pytest.raises(LogError, match="it cannot be read: embedded null byte"):
        read_log(f"{tmp_path}/a\0.csv")
    with pytest.raises(LogError, match="it is a folder"):
        read_log(tmp_path)


def is_log_or_sentence(folder, data, name="a.csv"):
    """Whether a file is read, or refused by an error of ours in one line; any other exception passes."""
    try:
        return isinstance(read(folder, data, name), Log)
    except LogError as error:
        return "\n" not in str(error)


def test_a_file_that_the_system_withholds_is_refused(tmp_path, monkeypatch):
    def withhold(self, mode):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "a.csv").write_text("t,x\n0,1\n1,2\n")
    monkeypatch.setattr("pathlib.Path.open", withhold)
    with pytest.raises(LogError, match="it cannot be read: Permission denied"):
        read_log(tmp_path / "a.csv")


WHOLE = [
    ("a.csv.gz", packed(b"t,x\n0,1\n1,2\n2,3\n")),
    ("a.parquet", parquet(t=T, x=T)),
    ("a.npz", npz(t=T, x=T)),
    ("a.mat", mat(t=T, x=T)),
    *with_metadata('{"version": 1, "units": {"x": "m"}, "history": [{"step": "cut"}], "notes": ["x"]}').items(),
]


@pytest.mark.parametrize(("name", "data"), WHOLE, ids=[name for name, _ in WHOLE])
def test_a_file_cut_or_changed_anywhere_is_read_or_refused_by_our_own_error(tmp_path, name, data):
    rng = random.Random(0)
    for _ in range(150):
        damaged = bytearray(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data)
        for _ in range(rng.randrange(4)):
            if damaged:
                damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        assert is_log_or_sentence(tmp_path, bytes(damaged), name)


@given(st.text(st.sampled_from('t,x\n;"\t .-019eE[]m\r\ufeff'), max_size=60))
def test_any_text_is_read_or_refused_by_our_own_error(tmp_path_factory, text):
    folder = tmp_path_factory.mktemp("text")
    assert is_log_or_sentence(folder, "t,x\n" + text)
    assert is_log_or_sentence(folder, text)


# ---------------------------------------------------------------------- what is read

FORMATS = {
    "a.csv": b"t,x,u\n0,1.5,2\n0.1,2.5,\n0.2,-3.5e-1,4\n",
    "bom_and_crlf.csv": b"\xef\xbb\xbft,x,u\r\n0,1.5,2\r\n0.1,2.5,NaN\r\n0.2,-3.5e-1,4\r\n\r\n",
    "quoted_and_padded.csv": b'"t", x ,u\n0, 1.5,2\n"0.1",2.5 , N/A\n0.2,-.35,+4\n',
    "semicolon.csv": b"t;x;u\n0;1.5;2\n0.1;2.5;\n0.2;-0.35;4\n",
    "decimal_comma.csv": b"t;x;u\n0;1,5;2\n0,1;2,5;\n0,2;-3,5e-1;4\n",
    "tab.csv": b"t\tx\tu\n0\t1.5\t2\n0.1\t2.5\tnan\n0.2\t-0.35\t4\n",
    "a.csv.gz": packed(b"t,x,u\n0,1.5,2\n0.1,2.5,\n0.2,-0.35,4\n"),
    "a.parquet": parquet(t=[0.0, 0.1, 0.2], x=[1.5, 2.5, -0.35], u=[2, None, 4]),
    "a.npz": npz(t=np.array([0.0, 0.1, 0.2]), x=np.array([[1.5], [2.5], [-0.35]]), u=np.array([2.0, np.nan, 4.0])),
    "a.mat": mat(t=[0.0, 0.1, 0.2], x=np.array([[1.5], [2.5], [-0.35]]), u=[2.0, np.nan, 4.0]),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_log(tmp_path, name):
    log = read(tmp_path, FORMATS[name], name)
    assert log.names == ("x", "u")
    assert np.array_equal(log.time, [0.0, 0.1, 0.2])
    assert np.array_equal(log["x"], [1.5, 2.5, -0.35])
    assert np.array_equal(log["u"], [2.0, np.nan, 4.0], equal_nan=True)
    assert '"u" is NaN in 1 of 3 rows, first at t = 0.1 s' in log.notes
    assert log.source == f'log "{tmp_path / name}"'


def test_another_separator_is_said(tmp_path):
    assert read(tmp_path, FORMATS["semicolon.csv"]).notes[0] == "fields are separated by a semicolon"


def test_headers_carry_units_and_indices(tmp_path):
    log = read(tmp_path, "t [s],theta [deg],q[0],q[1]\n0,1,2,3\n1,2,3,4\n")
    assert log.names == ("theta", "q[0]", "q[1]")
    assert log.units == {"theta": "deg"}


def test_a_name_is_never_taken_as_a_pattern(tmp_path):
    log = read(tmp_path, "t,^$,.*\n0,1.5,2\n0.1,2.5,3\n")
    assert log.names == ("^$", ".*")
    assert np.array_equal(log[".*"], [2.0, 3.0])


@pytest.mark.parametrize("name", ["a.npz", "a.mat"])
def test_a_matrix_gives_one_signal_a_column(tmp_path, name):
    arrays = {"t": T, "q": np.arange(10.0).reshape(5, 2), "gain": np.array(3.0)}
    log = read(tmp_path, (npz if name == "a.npz" else mat)(**arrays), name)
    assert log.names == ("q_1", "q_2")
    assert np.array_equal(log["q_2"], [1, 3, 5, 7, 9])
    assert log.notes == ('column "gain" is left out: it has 1 value, the time 5',)


def test_two_matrices_must_not_meet_in_one_name(tmp_path):
    with pytest.raises(LogError, match='2 columns are called "q_1"'):
        read(tmp_path, npz(t=T, q=np.zeros((5, 2)), q_1=T), "a.npz")


@pytest.mark.parametrize(
    ("name", "data", "place"),
    [
        ("a.csv", b"t,x,mode\n0,1,1\n1,2,auto\n", 'line 3 holds "auto"'),
        ("a.parquet", parquet(t=[0, 1], x=[1, 2], mode=["auto", "manual"]), "row 0 holds auto"),
        ("a.npz", npz(t=T, x=T, mode=np.array(list("abcde"))), "row 0 holds a"),
        ("a.mat", mat(t=T, x=T, mode=np.array([1 + 2j] * 5)), "row 0 holds"),
    ],
)
def test_a_column_without_numbers_is_harmless_until_it_is_asked_for(tmp_path, name, data, place):
    log = read(tmp_path, data, name)
    assert log.names == ("x",)
    assert log.notes[0].startswith('column "mode" is left out: it is not numeric: ')
    with pytest.raises(LogError, match=f'signal "mode" is not numeric: {place}'):
        log["mode"]


def test_a_column_without_a_name_is_left_out(tmp_path):
    log = read(tmp_path, ",t,x\n0,0,1\n1,1,2\n")
    assert log.names == ("x",)
    assert log.notes == ("1 column without a name left out",)


# ---------------------------------------------------------------------- names, factors, rate

RENAMED = "t_ms,q [mm],mode\n0,10,a\n10,20,b\n20,30,c\n"


def test_rename_and_scale_are_applied_and_recorded(tmp_path):
    options = {"rename": {"t": "t_ms", "x": "q"}, "scale": {"t": 0.001, "x": 0.001}}
    log = read(tmp_path, RENAMED, **options)
    assert np.array_equal(log.time, [0.0, 0.01, 0.02])
    assert np.allclose(log["x"], [0.01, 0.02, 0.03], rtol=1e-15)
    assert log.units == {}
    assert log.history == (
        {"step": "rename", "names": {"t": "t_ms", "x": "q"}},
        {"step": "scale", "factors": {"t": 0.001, "x": 0.001}, "units": {"t": "ms", "x": "mm"}},
    )


def test_rename_takes_the_header_as_it_stands_and_keeps_the_unit(tmp_path):
    log = read(tmp_path, RENAMED, rename={"t": "t_ms", "x": "q [mm]"})
    assert log.units == {"x": "mm"}


def test_rename_can_swap_and_copy(tmp_path):
    log = read(tmp_path, "t,x,y\n0,1,2\n1,3,4\n", rename={"x": "y", "y": "x", "z": "x"})
    assert (log["x"][0], log["y"][0], log["z"][0]) == (2.0, 1.0, 1.0)


def test_a_renamed_column_keeps_the_reason_why_it_is_unusable(tmp_path):
    log = read(tmp_path, RENAMED, rename={"t": "t_ms", "state": "mode"})
    with pytest.raises(LogError, match='signal "state" is not numeric: line 2 holds "a"'):
        log["state"]


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"rename": {"x": "position"}}, LogError, 'no column "position" to call "x"; found t_ms, q, mode'),
        (
            {"rename": {"t": "t_ms", "mode": "q"}},
            LogError,
            "there is a column of that name; .*--map mode=q,mode_other=mode",
        ),
        ({"rename": {"t": "t_ms"}, "scale": {"y": 2.0}}, LogError, 'no signal "y" to scale; found t, q, mode'),
        ({"rename": {"t": "t_ms"}, "scale": {"q": 0.0}}, SettingsError, 'scale of "q" is 0.0'),
        ({"rename": {"t": "t_ms"}, "scale": {"q": np.inf}}, SettingsError, 'scale of "q" is inf'),
        ({"rename": {"t": "t_ms"}, "resample": -1.0}, SettingsError, "give a rate in Hz"),
        ({"rename": {"t": "t_ms"}, "resample": "mean"}, SettingsError, "give a rate in Hz"),
        ({"rename": {"t": "t_ms"}, "resample": 1e-9}, LogError, "leaves 1 row"),
        ({"scale": {"t": 1.0}, "resample": 1e7}, LogError, r"would make 2e\+08 rows; at most 10,000,000"),
    ],
)
def test_options_without_meaning_are_refused(tmp_path, options, error, message):
    with pytest.raises(error, match=message):
        read(tmp_path, RENAMED, **options)


def test_gaps_are_missing_rows_and_interpolated_over_only_when_asked(tmp_path):
    t = np.delete(np.arange(200) * 0.01, np.r_[50:60, 120]) + 0.002 * np.sin(np.arange(189))
    data = "t,x\n" + "".join(f"{a!r},{3.0 * a!r}\n" for a in t.tolist())
    recorded = read(tmp_path, data)
    assert (len(recorded), np.isnan(recorded["x"]).sum()) == (200, 11)
    np.testing.assert_array_equal(recorded["x"][np.isfinite(recorded["x"])], 3.0 * t)
    log = read(tmp_path, data, resample=100.0)
    blank = np.isnan(log["x"])
    assert log.dt == pytest.approx(0.01, rel=1e-9)
    assert np.allclose(log["x"][~blank], 3.0 * log.time[~blank], atol=1e-12)
    assert blank.sum() == pytest.approx(10, abs=1)
    assert log.history[-1]["gaps"] == 1
    assert "1 gap in time, the longest 0.1" in " ".join(log.notes)


@pytest.mark.parametrize("resample", [None, "median", 2.0])
def test_a_clock_in_milliseconds_is_refused_whatever_the_rate_asked_for(tmp_path, resample):
    text = "t,x\n0,1\n10,2\n20,3\n"
    with pytest.raises(LogError, match=r"10 s apart: if t is in milliseconds, pass --scale t=0\.001, .* --scale t=1$"):
        read(tmp_path, text, resample=resample)
    assert read(tmp_path, text, scale={"t": 1.0}).dt == 10.0
    assert read(tmp_path, text, scale={"t": 0.001}).dt == pytest.approx(0.01)


@pytest.mark.parametrize("header", ["t [s],x", "t_s,x", "Time (s),x", "t [min],x"])
def test_a_slow_clock_that_says_its_unit_is_read(tmp_path, header):
    assert read(tmp_path, f"{header}\n0,1\n10,2\n20,3\n").dt in (10.0, 600.0)


def test_a_slow_log_that_was_written_is_read(tmp_path):
    log = Log.from_arrays(60.0 * np.arange(5), {"x": np.arange(5.0)}, {"x": "K"})
    for name in ("a.csv", "a.parquet", "a.npz"):
        log.write(tmp_path / name)
        assert read_log(tmp_path / name).dt == 60.0


def test_the_unit_of_the_time_holds_with_a_mapping(tmp_path):
    (tmp_path / "m.toml").write_text('[[signals]]\nname = "y"\nfield = "x"\n')
    log = read(tmp_path, "time [ms],x\n0,1\n10,2\n20,3\n", mapping=tmp_path / "m.toml")
    assert log.dt == pytest.approx(0.01)


def test_many_duplicates_are_refused_even_when_resampling_is_asked(tmp_path):
    with pytest.raises(LogError, match="repeats at row 2"):
        read(tmp_path, "t,x\n0,1\n1,2\n1,3\n1,4\n", resample="median")


# ---------------------------------------------------------------------- real logs


def test_real_emps_csv_and_mat_agree():
    table = read_log(real("emps/DATA_EMPS.csv"), rename={"t": "t_s", "x": "q_m"})
    original = read_log(real("emps/DATA_EMPS.mat"), rename={"x": "qm"})
    assert len(table) == len(original) == 24841
    assert np.allclose(table["x"], original["x"], atol=1e-9)
    assert table.notes == ()
    assert 'column "gtau" is left out: it has 1 value, the time 24841' in original.notes


def test_real_uneven_clocks_are_read_onto_their_grid_and_resampled_when_asked():
    path = real("crazyflie_arpl/log15.parquet")
    own = read_log(path)
    assert own.dt == pytest.approx(0.00099028, rel=1e-4)
    (note,) = [note for note in own.notes if "its own grid" in note]
    assert "of 1009.82 Hz: 95% of the stamps are within 18% of a sample, 26 rows are missing in 6 gaps" in note
    log = read_log(path, resample="median")
    assert log.dt == pytest.approx(0.000989, rel=1e-6)
    assert np.isnan(log["acc.x"]).sum() > 0


def test_real_autopilot_logs_are_refused_by_their_ending():
    with pytest.raises(DiransacError, match=r"\.ulg"):
        read_log(real("px4_ulog/sample_log_small.ulg"))


@pytest.mark.parametrize("seed", range(3))
def test_a_short_file_of_plain_numbers_has_the_same_bits_as_any_other(seed: int, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(40, 3)) * 10.0 ** rng.integers(-12, 12, (40, 3))
    forms = ("{!r}", "{:.3e}", " {:.17g} ", "{:+.6f}")
    lines = [",".join(rng.choice(forms).format(float(x)) for x in row) for row in values]
    data = "\n".join(["t,a,b", *lines, "41,nan,NaN"]).encode()
    plain = comma_separated.read_csv(data, "plain")
    monkeypatch.setattr(comma_separated, "_FEW_LINES", 0)
    other = comma_separated.read_csv(data, "other")
    for name in ("t", "a", "b"):
        np.testing.assert_array_equal(plain.columns[name], other.columns[name])
