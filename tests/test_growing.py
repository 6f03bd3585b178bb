"""Readers of files that grow: what is complete, and nothing twice."""

import os
from contextlib import ExitStack, closing

import numpy as np
import pytest

from diransac.data.readers.growing import GrowingCsv, Pipe, growing
from diransac.data.readers.reading import Reading
from diransac.errors import LogError
from recordings import write_mcap

PLAIN = Reading.given()


@pytest.fixture
def reader_of():
    with ExitStack() as opened:
        yield lambda path, **arguments: opened.enter_context(closing(growing(path, Reading.given(**arguments))))


def all_new(reader):
    """Columns of everything that is new, and all notes."""
    parts = []
    while (part := reader.new()) is not None:
        parts.append(part[0])
    columns = {name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())}
    return columns, reader.taken_notes()


def append(path, text):
    with path.open("a", encoding="utf-8") as file:
        file.write(text)


def test_lines_are_read_once_and_a_partial_last_line_when_it_is_complete(tmp_path, reader_of):
    path = tmp_path / "a.csv"
    path.write_text("t,x\n0.0,1.0\n0.1,2")
    reader = reader_of(path)
    assert all_new(reader)[0] == {"t": [0.0], "x": [1.0]}
    append(path, ".5\n0.2,")
    assert all_new(reader)[0] == {"t": [0.1], "x": [2.5]}
    append(path, "3.0\n")
    assert all_new(reader) == ({"t": [0.2], "x": [3.0]}, [])
    assert reader.new() is None


def test_a_header_without_a_row_is_awaited(tmp_path, reader_of):
    path = tmp_path / "a.csv"
    path.write_text("t,")
    reader = reader_of(path)
    assert reader.new() is None
    append(path, "x [deg]\n")
    assert reader.new() is None
    append(path, "0.0,90\n")
    columns, units = reader.new()
    assert columns == {"t": [0.0], "x": [90.0]}
    assert units["x"] == "deg"


def test_names_factors_and_the_unit_of_the_time_are_those_of_a_log(tmp_path, reader_of):
    path = tmp_path / "a.csv"
    path.write_text("t_ms;q_m\n0;1,5\n10;2,5\n")
    columns, _ = all_new(reader_of(path, rename={"x": "q_m"}, scale={"x": 2.0}))
    assert columns["x"].tolist() == [3.0, 5.0]
    assert columns["t"].tolist() == [0.0, 0.01]


def test_a_truncated_file_is_read_again_and_said(tmp_path, reader_of):
    path = tmp_path / "a.csv"
    path.write_text("t,x\n5.0,1.0\n5.1,2.0\n")
    reader = reader_of(path)
    all_new(reader)
    path.write_text("t,x\n0.0,7.0\n")
    columns, notes = all_new(reader)
    assert columns == {"t": [0.0], "x": [7.0]}
    assert notes == ["the file was cut off, and is read from its beginning"]


def test_a_replaced_file_is_read_to_its_end_and_then_the_new_one(tmp_path, reader_of):
    path = tmp_path / "a.csv"
    path.write_text("t,x\n5.0,1.0\n")
    reader = reader_of(path)
    all_new(reader)
    append(path, "5.1,2.0\n")
    path.rename(tmp_path / "a.csv.1")
    assert all_new(reader)[0] == {"t": [5.1], "x": [2.0]}
    path.write_text("t,x\n0.0,7.0\n")
    columns, notes = all_new(reader)
    assert columns == {"t": [0.0], "x": [7.0]}
    assert notes == ["the file was replaced, and the new one is read"]


def test_a_damaged_line_is_left_out_and_a_field_that_is_no_number_is_missing(tmp_path, reader_of):
    path = tmp_path / "a.csv"
    path.write_text("t,x\n0.0,1.0\n0.1\n0.2,error\n")
    reader = reader_of(path)
    columns, notes = all_new(reader)
    assert columns["t"].tolist() == [0.0, 0.2]
    assert columns["x"][0] == 1.0
    assert np.isnan(columns["x"][1])
    assert notes == ["1 line without 2 fields left out"]


def test_a_pipe_ends_with_its_writer():
    reading_end, writing_end = os.pipe()
    with os.fdopen(reading_end, "rb") as stream:
        reader = GrowingCsv(Pipe(stream), "standard input", PLAIN)
        os.write(writing_end, b"t,x\n0.0,1.0\n")
        assert reader.new()[0] == {"t": [0.0], "x": [1.0]}
        assert not reader.ended
        os.close(writing_end)
        assert reader.new() is None
        assert reader.ended


def test_missing_files_and_formats_that_are_written_at_their_end_are_refused(tmp_path, reader_of):
    with pytest.raises(LogError, match="there is no such file"):
        reader_of(tmp_path / "none.csv")
    with pytest.raises(LogError, match="not read while it grows"):
        reader_of(tmp_path / "a.parquet")


def test_a_calendar_is_refused_because_its_first_time_differs_from_part_to_part(tmp_path, reader_of):
    path = tmp_path / "a.csv"
    path.write_text("time,x\n2026-01-01 10:00:00,1.0\n2026-01-01 10:00:01,2.0\n")
    with pytest.raises(LogError, match="cannot be followed; give seconds"):
        reader_of(path).new()


def test_a_growing_mcap_file_has_each_sample_once(tmp_path, reader_of):
    whole, path = tmp_path / "whole.mcap", tmp_path / "run.mcap"
    write_mcap(whole)
    data, names = whole.read_bytes(), {"x": "/joint_states.position[elbow]", "force": "/command.u.force"}
    path.write_bytes(b"")
    reader = reader_of(path, rename=names)
    parts = []
    for end in range(0, len(data) + 5000, 5000):
        path.write_bytes(data[:end])
        while (part := reader.new()) is not None:
            parts.append(part[0])
    assert reader.ended
    at_once, _ = all_new(reader_of(whole, rename=names))
    for name in names:
        found, wanted = (np.concatenate([p[name] for p in group]) for group in (parts, [at_once]))
        assert np.array_equal(found[np.isfinite(found)], wanted[np.isfinite(wanted)])
    assert len(at_once["t"]) == 2 * len(np.unique(at_once["t"]))


def test_an_mcap_file_whose_topics_never_come_says_so_at_its_end(tmp_path, reader_of):
    path = tmp_path / "run.mcap"
    write_mcap(path)
    reader = reader_of(path, rename={"x": "/nothing.x"})
    assert reader.new() is None
    with pytest.raises(LogError, match="nothing"):
        _ = reader.ended
