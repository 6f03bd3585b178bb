"""Sizes and places of files from others: refused in one sentence, before memory and time are spent."""

import gzip
import io
import json
import os
import zipfile
from itertools import pairwise

import casadi as ca
import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner

import diransac as dr
from diransac import limits
from diransac.cli import options
from diransac.cli.commands import app
from diransac.data import readers
from diransac.data.readers import comma_separated, hdf5, npz, table
from diransac.limits import beyond, read_bytes
from diransac.model import expressions
from diransac.plain_data import json_data, toml_table
from diransac.simulation.compiler import operations
from fuzzing import outcome
from rebuilt import built, log

T = 0.05 * np.arange(40)
X = np.sin(T)


# Sizes of logs --------------------------------------------------------------------------------------------------------
def test_a_size_is_refused_in_one_form():
    assert beyond(10_000, "columns", 12_000) == "12,000 columns; up to 10,000 are possible"
    assert beyond(2**20, "bytes", 2**20 + 1) == "2 MiB; up to 1 are possible"
    assert beyond(10_000, "links") == "more than 10,000 links"


def hdf5_file(path, **others):
    h5py = pytest.importorskip("h5py", reason="NOT CHECKED: h5py is missing")
    with h5py.File(path, "w") as file:
        file["t"], file["x"] = T, X
        for name, make in others.items():
            make(h5py, file, name)
    return path


def virtual(source):
    def make(h5py, file, name):
        layout = h5py.VirtualLayout(shape=(40,), dtype="f8")
        layout[:] = h5py.VirtualSource(source, name, shape=(40,))
        file.create_virtual_dataset(name, layout)

    return make


def shaped(shape, kind, chunks, **more):
    return lambda _h5py, file, name: file.create_dataset(name, shape, kind, chunks=chunks, **more)


def external(_h5py, file, name):
    file.create_dataset(name, (40,), "i1", external=[("/etc/passwd", 0, 40)])


STORED = {
    "virtual, of itself": (virtual("."), "takes its values from other datasets or files"),
    "virtual, of another file": (virtual("b.h5"), "takes its values from other datasets or files"),
    "external": (external, "takes its values from other datasets or files"),
    "declared": (shaped((1_900_000_000,), "i1", (1 << 20,)), "1,900,000,000 rows; up to 10,000,000"),
    "columns": (shaped((2, 1_000_000), "i1", (1, 1 << 19)), "1,000,002 columns; up to 10,000"),
    "numbers": (shaped((40_000, 9_000), "i1", (1, 100)), "360,000,080 numbers; up to 134,217,728"),
    "chunks": (shaped((9_999_999,), "i1", (1,)), "10,000,001 chunks; up to 200,000 are possible; write it in larger"),
    "a chunk": (shaped((40,), "f8", (1 << 28,), maxshape=(None,)), "in chunks of 2,048 MiB; up to 1,024"),
}


@pytest.mark.parametrize("case", STORED)
def test_an_hdf5_file_is_refused_by_what_it_declares(tmp_path, case):
    make, says = STORED[case]
    with pytest.raises(dr.LogError, match=says):
        dr.read_log(hdf5_file(tmp_path / "a.h5", y=make))


def test_groups_within_themselves_end_and_many_paths_are_refused(tmp_path, monkeypatch):
    def loop(_h5py, file, name):
        group = file.create_group(name)
        group["x"] = X
        for k in range(12):
            group[f"again{k}"] = group

    def paths(_h5py, file, _name):
        chain = [file.create_group(f"g{k}") for k in range(14)]
        for above, below in pairwise(chain):
            for k in range(8):
                above[f"to{k}"] = below

    assert set(dr.read_log(hdf5_file(tmp_path / "a.h5", loop=loop)).signals) == {"x", "loop.x"}
    monkeypatch.setattr(hdf5, "_MOST_LINKS", 500)
    with pytest.raises(dr.LogError, match="it has more than 500 links"):
        dr.read_log(hdf5_file(tmp_path / "b.h5", paths=paths))


def packed(path, shape, kind="|b1", body=b""):
    """An NPZ with an array of which the header is all that is true."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in {"t": T, "x": X}.items():
            file = io.BytesIO()
            np.save(file, values)
            archive.writestr(f"{name}.npy", file.getvalue())
        file = io.BytesIO()
        np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
        archive.writestr("y.npy", file.getvalue() + body)
    return path


@pytest.mark.parametrize(
    ("shape", "kind", "says"),
    [
        ((900_000_000,), "|b1", "900,000,000 rows; up to 10,000,000"),
        ((3_000_000_000,), "|b1", "2,862 MiB; up to 1,024"),
        ((2, 1_000_000), "|b1", "1,000,002 columns; up to 10,000"),
        ((40_000, 9_000), "|b1", "360,000,080 numbers; up to 134,217,728"),
        ((40,), "<U100000000", "MiB; up to 1,024"),
    ],
)
def test_an_npz_is_refused_by_the_headers_of_its_arrays(tmp_path, shape, kind, says):
    with pytest.raises(dr.LogError, match=says):
        dr.read_log(packed(tmp_path / "a.npz", shape, kind))


def test_an_npz_is_refused_by_its_directory(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "LARGEST_LOG", 3 * 2**20)
    with pytest.raises(dr.LogError, match="its arrays have 4 MiB; up to 3 are possible; split it"):
        dr.read_log(packed(tmp_path / "a.npz", (3 * 2**20,), body=bytes(3 * 2**20)))


def test_a_parquet_file_is_refused_by_its_metadata_and_long_texts_are_not_read(tmp_path):
    pl.select(t=pl.repeat(0.0, 10_000_001)).write_parquet(tmp_path / "rows.parquet")
    with pytest.raises(dr.LogError, match="it has 10,000,001 rows; up to 10,000,000 are possible; split it"):
        dr.read_log(tmp_path / "rows.parquet")
    pl.DataFrame({"t": T, "x": X, "list": [[1, 2]] * 40}).write_parquet(tmp_path / "list.parquet")
    assert "\n" not in dr.read_log(tmp_path / "list.parquet").unusable["list"]


@pytest.mark.parametrize("line", [b"1,0\n", b"\n", b"0"])
def test_text_that_unpacks_beyond_the_limit_is_refused(tmp_path, monkeypatch, line):
    monkeypatch.setattr(comma_separated, "LARGEST_TEXT", 2**20)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"t,x\n" + line * 5_000_000, 1))
    with pytest.raises(dr.LogError, match="its text has more than 1 MiB; split it"):
        dr.read_log(tmp_path / "a.csv.gz")


def test_text_with_too_many_lines_or_columns_is_refused(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text(",".join(["t", *(f"x{k}" for k in range(10_000))]) + "\n" + "0," * 10_000 + "0\n")
    with pytest.raises(dr.LogError, match="it has 10,001 columns; up to 10,000 are possible"):
        dr.read_log(tmp_path / "a.csv")
    monkeypatch.setattr(table, "MOST_ROWS", 30)
    (tmp_path / "b.csv").write_text("t,x\n" + "".join(f"{t},0\n" for t in T))
    with pytest.raises(dr.LogError, match="it has 40 rows; up to 30 are possible"):
        dr.read_log(tmp_path / "b.csv")


def test_a_file_with_a_hole_is_refused_by_its_size(tmp_path):
    with (tmp_path / "a.csv").open("wb") as file:
        file.truncate(1 << 35)
    with pytest.raises(dr.LogError, match="it has 32,768 MiB; up to 512 are possible; split it"):
        dr.read_log(tmp_path / "a.csv")


def test_standard_input_is_read_up_to_the_limit(monkeypatch):
    for module in (options, readers):
        monkeypatch.setattr(module, "LARGEST_TEXT", 2**20)
    done = CliRunner().invoke(app, ["identify", "-", "--model", "servo-axis"], input="t,x\n" + "0,1\n" * 10**6)
    assert "standard input: it has 2 MiB; up to 1 are possible" in done.stderr


# Data -----------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("read", [json_data, lambda text: toml_table(f"x = {text}")])
def test_lists_within_lists_have_a_limit(read):
    read("[" * 90 + "]" * 90)
    with pytest.raises(ValueError, match="nested too deeply: it has more than 100 levels"):
        read("[" * 120 + "]" * 120)


def test_a_result_that_is_nested_deeply_is_refused_on_loading(tmp_path):
    data = dr.identify(built(), log(), "ols").to_dict()
    data["logs"][0]["preparation"] = json.loads("[" * 900 + "]" * 900)
    (tmp_path / "a.json").write_text(json.dumps(data))
    with pytest.raises(dr.ResultError, match="nested too deeply"):
        dr.Result.load(tmp_path / "a.json")


# Models ---------------------------------------------------------------------------------------------------------------
def coupled(n, symmetric=True):
    def equations(q, v, a, u, p):
        angles, accelerations = list(q), list(a)
        shift = 1.0 if symmetric else 2.0
        return [
            sum((p.m * ca.cos(angles[i] - shift * angles[j]) + 3.0 * n * (i == j)) * accelerations[j] for j in range(n))
            - u.f
            for i in range(n)
        ]

    units = {f"q{k}": "rad" for k in range(n)}
    return dr.Model("coupled", units, {"f": "N"}, {"m": dr.Parameter("kg", positive=True)}, equations)


@pytest.mark.parametrize("symmetric", [True, False])
def test_the_operations_of_a_dense_mass_matrix_are_counted_before_it_is_solved(monkeypatch, symmetric):
    model = coupled(12, symmetric)
    assert model.dynamics.n_instructions() > 1000
    monkeypatch.setattr("diransac.model.derivation.MOST_SOLVED", 300)
    with pytest.raises(dr.ModelError, match=r"accelerations of 12 equations take [\d,]+ operations; up to 300"):
        coupled(12, symmetric).dynamics  # noqa: B018  derived when first needed


def test_the_limit_of_the_solution_is_above_what_it_takes():
    model = coupled(40)
    assert model.dynamics.n_instructions() < limits.MOST_SOLVED / 50


def test_equations_that_compile_for_minutes_are_refused(monkeypatch):
    def equations(q, v, a, u, p):
        x = v.x
        for _ in range(300):
            x = ca.sin(x)
        return [p.m * a.x + x - u.f]

    model = dr.Model("chain", {"x": "m"}, {"f": "N"}, {"m": dr.Parameter("kg", positive=True)}, equations)
    inputs = dr.Log.from_arrays(T, {"f": X})
    monkeypatch.setattr(operations, "MOST_COMPILED", 4000)
    with pytest.raises(dr.ModelError, match=r"takes 18,0\d\d operations; up to 4,000 are possible, a sine .* as 15"):
        dr.simulate(dr.Plant(model, {"m": 1.0}), inputs, initial_state={"x": 0.0, "x_dot": 0.0})
    assert expressions.MOST_OPERATIONS > limits.MOST_COMPILED


# Places ---------------------------------------------------------------------------------------------------------------
READING = {
    "a result": "validate PIPE.json swim.csv",
    "a study": "study run PIPE.toml --store a.db",
    "a store": "study status PIPE.db",
    "a log": "inspect PIPE.csv",
    "a recording": "inspect PIPE.mcap",
    "a log without ending": "inspect PIPE",
    "a mapping": "inspect swim.csv --mapping PIPE.toml",
    "settings": "identify swim.csv --model underwater-vehicle --settings PIPE.toml",
    "a model": "identify swim.csv --model PIPE.py",
    "a robot": "models PIPE.xml",
}


@pytest.mark.parametrize("command", READING)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_pipes_and_devices_are_refused_as_files(tmp_path, command, kind):
    name = next(word for word in READING[command].split() if "PIPE" in word)
    (tmp_path / "swim.csv").write_text("t,x\n0,1\n1,2\n2,3\n")
    if command == "a robot":
        pytest.importorskip("mujoco", reason="NOT CHECKED: mujoco is missing")  # it starts a process when imported
    os.mkfifo(tmp_path / name) if kind == "pipe" else (tmp_path / name).symlink_to("/dev/zero")
    assert outcome(tmp_path, READING[command].split()) in (1, 2)


def test_the_content_of_a_folder_or_device_is_not_read(tmp_path):
    with pytest.raises(IsADirectoryError):
        read_bytes(tmp_path, 10)
    with pytest.raises(OSError, match="not an ordinary file"):
        read_bytes("/dev/zero", 10)


@pytest.mark.parametrize("output", ["loop.json", "no/../a.json", "no/a.json", "x" * 300 + ".json", "file/a.json"])
def test_an_output_without_a_place_leaves_nothing(tmp_path, output):
    (tmp_path / "loop.json").symlink_to("other.json")
    (tmp_path / "other.json").symlink_to("loop.json")
    (tmp_path / "file").write_text("")
    log().write(tmp_path / "log.csv")
    words = ["identify", "log.csv", "--model", "servo-axis", "--method", "ols", "-o", output]
    assert outcome(tmp_path, words) == 1


def test_a_loop_of_links_is_no_input(tmp_path):
    (tmp_path / "a.json").symlink_to("b.json")
    (tmp_path / "b.json").symlink_to("a.json")
    assert outcome(tmp_path, ["export", "a.json", "-o", "out.py"]) == 1


def test_a_store_in_a_missing_folder_is_not_made_beside_it(tmp_path):
    with pytest.raises(dr.StudyError, match=r"the folder .* does not exist; make it first"):
        dr.run_study("gauntlet-gusts", store=tmp_path / "no" / ".." / "a.db")
    assert not list(tmp_path.iterdir())
