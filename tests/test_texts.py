"""Tables as instruments, spreadsheets and other programs write them are read, or refused with what to do."""

import numpy as np
import pandas as pd
import polars as pl
import pytest

import diransac as dr
from command_line import run

T = np.arange(50) / 10.0
X = np.sin(T)
ROWS = [f"{t},{x}" for t, x in zip(T, X, strict=True)]


def text(*lines: str) -> str:
    return "\n".join([*lines, ""])


def spaced(*lines: str) -> str:
    return text(*lines, *(row.replace(",", "   ") for row in ROWS))


READ = {
    "header of NumPy": (text("# t,x", *ROWS), {}, ()),
    "header of NumPy below a title": (text("# bench 3", "# t,x", *ROWS), {"repair": "comments"}, ("repaired",)),
    "header of MATLAB": (text("% t,x", *ROWS), {}, ()),
    "spaces": (spaced("t x"), {}, ("fields are separated by spaces",)),
    "spaces below a header of NumPy": (spaced("# t x"), {}, ("fields are separated by spaces",)),
    "spaces without a header": (spaced(), {"columns": ["t", "x"]}, ("fields are separated by spaces",)),
    "above a header": (text("Recorder: 7.1", "", "Rate: 10", "t,x", *ROWS), {"repair": "preamble"}, ("repaired",)),
    "safe repairs": (text("Recorder, x, y, z", "t,x", *ROWS), {"repair": "safe"}, ("repaired",)),
    "times": (text("timestamp,x", *(f"2026-01-03T12:00:{t:09.6f}Z,{x}" for t, x in zip(T, X, strict=True))), {}, ()),
    "times of another name": (
        text("utc,x", *(f"2026-01-03 12:00:{t:04.1f},{x}" for t, x in zip(T, X, strict=True))),
        {"rename": {"t": "utc"}},
        ('"utc" holds times, of which the first is zero',),
    ),
}


@pytest.mark.parametrize("case", READ)
def test_texts_of_other_programs_are_read(tmp_path, case):
    content, options, notes = READ[case]
    (tmp_path / "a.txt").write_text(content)
    log = dr.read_log(tmp_path / "a.txt", **options)
    np.testing.assert_allclose(log.time, T, atol=1e-9)
    np.testing.assert_array_equal(log["x"], X)
    assert log.names == ("x",)
    for note in notes:
        assert any(x.startswith(note) for x in log.notes), log.notes


def test_a_line_of_units_below_the_header_has_the_units(tmp_path):
    (tmp_path / "a.csv").write_text(text("time,x,mode,angle", "[ms],mm,-,deg", *(f"{1e3 * t},1,2,3" for t in T)))
    log = dr.read_log(tmp_path / "a.csv")
    assert log.units == {"x": "mm", "angle": "deg"}
    np.testing.assert_allclose(log.time, T, atol=1e-9)
    assert len(log) == len(T)


def test_a_row_of_texts_is_no_line_of_units(tmp_path):
    (tmp_path / "a.csv").write_text(text("t,mode", "IDLE,m", "IDLE,A"))
    with pytest.raises(dr.LogError, match='line 3 holds "IDLE"'):
        dr.read_log(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("code", "note"), [("utf-16", "UTF-16"), ("cp1252", r"not UTF-8, and is read as that of Windows")]
)
def test_other_codes_of_text_are_read_with_a_note(tmp_path, code, note):
    (tmp_path / "a.csv").write_bytes(text("t,größe [µm]", *ROWS).encode(code))
    log = dr.read_log(tmp_path / "a.csv")
    assert log.units == {"größe": "µm"}
    assert any(note in x for x in log.notes)


def test_what_stands_above_a_header_is_refused_with_the_repair(tmp_path):
    (tmp_path / "a.csv").write_text(text("Recorder: ControlDesk 7.1", "Sample time: 0.1", "t,x", *ROWS))
    with pytest.raises(
        dr.LogError, match="line 3 has 2 fields, the header has 1; if the header is line 3, pass --repair"
    ):
        dr.read_log(tmp_path / "a.csv")


def test_the_preamble_ends_at_the_header_whatever_is_wrong_below_it(tmp_path):
    (tmp_path / "a.csv").write_text(text("t,x", *ROWS[:20], "0.1", *ROWS[20:]))
    assert len(dr.read_log(tmp_path / "a.csv", repair="safe")) == len(T)


def test_times_beside_a_numeric_time_are_no_time(tmp_path):
    (tmp_path / "a.csv").write_text(text("time,timestamp,x", *(f"{t},2026-01-03T12:00:00,1" for t in T)))
    log = dr.read_log(tmp_path / "a.csv")
    assert log.names == ("x",)
    assert "is not numeric" in log.unusable["timestamp"]


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
def test_times_in_parquet_are_seconds(tmp_path, unit):
    stamps = (
        pl.Series(1_700_000_000_000 + (1e3 * T).round().astype(int)).cast(pl.Datetime("ms")).cast(pl.Datetime(unit))
    )
    pl.DataFrame({"timestamp": stamps, "x": X}).write_parquet(tmp_path / "a.parquet")
    pl.DataFrame({"t": stamps - stamps[0], "x": X}).write_parquet(tmp_path / "b.parquet")
    index = pd.DatetimeIndex(stamps.to_numpy())
    pd.DataFrame({"x": X}, index=index).to_parquet(tmp_path / "c.parquet")
    for name in ("a", "b", "c"):
        log = dr.read_log(tmp_path / f"{name}.parquet")
        np.testing.assert_allclose(log.time, T, atol=1e-9)
        assert log.names == ("x",)


@pytest.mark.parametrize(
    ("name", "remedy"),
    [("a.xlsx", "export the sheet as CSV"), ("a.npy", "np.savez"), ("a.bbl", "blackbox_decode"), ("a.db3", "folder")],
)
def test_formats_that_are_not_read_have_a_remedy(tmp_path, name, remedy):
    (tmp_path / name).write_bytes(b"content")
    with pytest.raises(dr.LogError, match=f"use one of .*; .*{remedy}"):
        dr.read_log(tmp_path / name)


def test_a_folder_of_logs_is_no_log(tmp_path):
    for k in range(3):
        (tmp_path / f"run{k}.csv").write_text(text("t,x", *ROWS))
    with pytest.raises(dr.LogError, match=r"have the columns t, x each: .* Name the files, as in folder/\*\.csv"):
        dr.read_log(tmp_path)


def test_a_log_without_time_is_refused_with_both_remedies(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.csv").write_text(text("x,u", *ROWS))
    done = run("inspect", "a.csv")
    assert "Say which one it is: --map t=NAME, or give the rate of a log without one: --rate HZ" in done.stderr
    assert run("inspect", "a.csv", "--rate", "10").exit_code == 0
