"""Mutations of every kind of file: no internal error, no code that runs, nothing left behind.

The suite runs the same few examples every time; `make fuzz FUZZ_EXAMPLES=n` runs n others of each kind, and prints
their outcomes.
"""

import gzip
import io
import json
import os
import struct
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import scipy.io
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

import diransac as dr
from command_line import TRUE, swim
from diransac.study import identify_each, run_study, status, template
from diransac.study.store import Store
from fuzzing import (
    Kind,
    changed_bytes,
    changed_graph,
    changed_lines,
    changed_names,
    changed_result,
    changed_store,
    changed_table,
    command,
)
from fuzzing_sizes import (
    MOST_MEMORY,
    Place,
    another_place,
    model_text,
    odd_model,
    sized_graph,
    sized_gzip,
    sized_hdf5,
    sized_npz,
    sized_robot,
)
from hostile import SETTINGS as BESIDE
from hostile import URDF
from lerobot_datasets import write_dataset
from recordings import flight, write_bag, write_mcap
from studies import TINY, TINY_TOML

ASKED = os.environ.get("FUZZ_EXAMPLES")
TIME = 0.05 * np.arange(80)
MODEL = "--model underwater-vehicle --method ols"

ARM = """<mujoco model="arm">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="link" pos="0 0 1">
      <joint name="elbow" type="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 -0.2" mass="1.5" diaginertia="0.02 0.02 0.01"/>
    </body>
  </worldbody>
</mujoco>
"""
SETTINGS = """max_iterations = 20
sample_size = 20
stop_inlier_fraction = 0.9
acceptance_weights = [1.0, 0.06]
inlier_thresholds = { x = 0.1, x_dot = 0.2 }
"""
MAPPING = """repair = "safe"
despike = "all"
[[signals]]
name = ["x_dot", "x_ddot"]
field = ["x_dot", "x_ddot"]
sign = [1, 1]
[[signals]]
name = "x"
field = "x"
scale = 1.0
[[signals]]
name = "thrust"
field = "thrust"
where = { field = "x", above = -5 }
"""


# Undamaged files ------------------------------------------------------------------------------------------------------
def swum() -> dr.Log:
    return dr.Log.from_arrays(TIME, swim(TIME))


def columns(ending: str, folder: Path) -> bytes:
    """A table with metadata."""
    file = folder / f"log{ending}"
    raw = {name: swim(TIME)[name] for name in ("x", "thrust")}
    dr.differentiate(dr.Log(TIME, raw, {"x": "m", "thrust": "N"}), dr.models.underwater_vehicle()).write(file)
    return file.read_bytes()


def mat() -> bytes:
    file = io.BytesIO()
    scipy.io.savemat(file, {"t": TIME, **swim(TIME), "names": {"a": ["b", 1.0]}}, do_compression=True)
    return file.getvalue()


def hdf5(folder: Path) -> bytes:
    h5py = pytest.importorskip("h5py", reason="NOT CHECKED: h5py is missing")
    with h5py.File(folder / "log.h5", "w") as file:
        for name, values in {"t": TIME, **swim(TIME)}.items():
            file.create_dataset(name, data=values, compression="gzip")
    return (folder / "log.h5").read_bytes()


def crazyflie() -> bytes:
    """A micro SD log, version 2, with one event of two variables."""
    header = b"\xbc" + struct.pack("<HHH", 2, 1, 0) + b"fixed\0" + struct.pack("<H", 2) + b"x(f)\0u(h)\0"
    return header + b"".join(struct.pack("<HQfh", 0, 10_000 * k, np.sin(0.1 * k), k) for k in range(80))


def bag(folder: Path) -> dict[str, bytes]:
    """The two files of a ROS 2 bag."""
    write_bag(folder / "bag", "SQLITE3")
    return {f"bag/{path.name}": path.read_bytes() for path in (folder / "bag").iterdir()}


def recording(name: str, folder: Path) -> bytes:
    write_mcap(folder / name) if name.endswith(".mcap") else write_bag(folder / name, 1)
    return (folder / name).read_bytes()


@cache
def results() -> tuple[bytes, ...]:
    """Results of two methods; that of lo-diransac has a diagnosis, a fixed parameter and a prior."""
    model, known = dr.models.underwater_vehicle(), {"fixed": {"mass": TRUE["mass"]}, "priors": {"bias": (2.0, 1.0)}}
    found = (dr.identify(model, swum(), "ols"), dr.identify(model, swum(), **known))
    return tuple(json.dumps(one.to_dict()).encode() for one in found)


def store(folder: Path) -> bytes:
    """A store of every row of a study, with paths."""
    run_study(
        TINY | {"evaluation": {"trajectories": ["square"], "keep_paths": True}},
        store=folder / "a.db",
        executor=ThreadPoolExecutor(1),
    )
    return (folder / "a.db").read_bytes()


def fleet(folder: Path) -> bytes:
    """A store of ten logs of five vehicles, one of which fails."""
    logs = []
    for k in range(10):
        noise = 1e-2 * np.random.default_rng(k).standard_normal(len(TIME))
        signals = swim(TIME, 1.0 + 0.1 * k)
        logs.append(folder / f"v{k // 2}-{k}.csv")
        dr.Log.from_arrays(TIME, signals | {"thrust": signals["thrust"] * (1 + noise)}).write(logs[-1])
    logs[3].write_text("t,x\n0,1\n")
    arguments = {"vehicle": r"(?P<vehicle>v\d)", "executor": ThreadPoolExecutor(1)}
    identify_each(dr.models.underwater_vehicle(), logs, "ols", store=folder / "fleet.db", **arguments)
    return (folder / "fleet.db").read_bytes()


# Kinds ----------------------------------------------------------------------------------------------------------------
def table() -> bytes:
    rows = np.column_stack([TIME, *swim(TIME).values()]).tolist()
    return "\n".join([",".join(("t", *swim(TIME))), *(",".join(map(repr, row)) for row in rows), ""]).encode()


def log(name: str, data: bytes, changed=changed_bytes, options: str = "", beside=None) -> Kind:
    """A kind of log; of a file in a folder, the folder is read."""
    source = name.split("/")[0]
    commands = (
        command(f"inspect {source}"),
        command(f"inspect {source} --model underwater-vehicle --repair safe --json {options}"),
        command(f"identify {source} {MODEL} {options}", share=2),
        command(f"map {source} --model underwater-vehicle -o out.toml", "out.toml"),
    )
    return Kind(name, (data,), changed, commands, beside or {})


def result(changed, _: Path) -> Kind:
    commands = (
        command("export model.json -o out.py", "out.py", share=4),
        command("export model.json -o out.yaml", "out.yaml", share=4),
        command("export model.json -o out.c", "out.c", share=4),
        command("validate model.json swim.csv --horizon 1", share=2),
        command("validate model.json swim.csv --report out.html", "out.html"),
        command("predict model.json swim.csv -o out.csv", "out.csv", share=2),
    )
    return Kind("model.json", results(), changed, commands, {"swim.csv": table()})


def names(_: Path) -> Kind:
    """Results with crafted names, in everything that is written of them."""
    commands = (
        *(
            command(f"export model.json -o out.{ending}", f"out.{ending}", 3)
            for ending in ("c", "py", "yaml", "casadi")
        ),
        command("validate model.json swim.csv --horizon 1 --json"),
        command("validate model.json swim.csv --report out.html", "out.html"),
        command("predict model.json swim.csv -o out.csv", "out.csv"),
        command("predict model.json swim.csv -o out.csv --plot out.svg", "out.csv out.svg"),
        command("map swim.csv --model underwater-vehicle -o out.toml", "out.toml"),
    )
    return Kind("model.json", results(), changed_names, commands, {"swim.csv": table()})


def files_beside(_: Path) -> Kind:
    """Options of IPOPT in the working directory, beside files of other libraries."""
    pytest.importorskip("mujoco", reason="NOT CHECKED: mujoco is missing")
    others = {name: text.encode() for name, text in BESIDE.items() if name != "ipopt.opt"}
    commands = (
        command("simulate star --plant extended-rotorcraft -o out.csv", "out.csv"),
        command("models arm.urdf --unknown damping", share=2),
        command("predict model.json swim.csv -o out.csv --plot out.svg", "out.csv out.svg", share=2),
        command(f"identify swim.csv {MODEL}", share=2),
    )
    beside = {**others, "arm.urdf": URDF.encode(), "model.json": results()[0], "swim.csv": table()}
    return Kind("ipopt.opt", (BESIDE["ipopt.opt"].encode(),), changed_lines, commands, beside)


def study_store(folder: Path) -> Kind:
    commands = (
        command("study status a.db", share=20),
        command("study export a.db --to csv -o out.csv", "out.csv", share=10),
        command("study export a.db --to parquet -o out.parquet", "out.parquet", share=10),
        command("study plot a.db -o out.svg", "out.svg"),
        command("study plot a.db --paths --level 40 -o out.svg", "out.svg"),
        command("study report a.db -o out.html", "out.html"),
    )
    return Kind("a.db", (store(folder),), changed_store, commands)


def fleet_store(folder: Path) -> Kind:
    commands = (
        command("fleet status a.db", share=10),
        command("fleet show a.db", share=10),
        command("fleet export a.db -o out.csv", "out.csv", share=10),
        command("fleet plot a.db -o out.svg", "out.svg"),
        command("fleet report a.db -o out.html", "out.html"),
    )
    return Kind("a.db", (fleet(folder),), changed_store, commands)


def study_file(_: Path) -> Kind:
    """Study files, up to the store that their trials would go to."""
    extended = TINY_TOML.replace('"planar-rotorcraft"', '"extended-rotorcraft"\nmass_imbalance = 1e-4\ndiameter = 0.1')
    texts = (TINY_TOML, extended, template())
    commands = (command("study run a.toml --store out.db", "out.db"),)
    return Kind("a.toml", [text.encode() for text in texts], changed_lines, commands)


def robot(_: Path) -> Kind:
    pytest.importorskip("mujoco", reason="NOT CHECKED: mujoco is missing")
    return Kind("arm.xml", (ARM.encode(),), changed_lines, (command("models arm.xml --unknown damping"),))


def options(name: str, text: str, words: str) -> Kind:
    return Kind(name, (text.encode(),), changed_lines, (command(words),), {"swim.csv": table()})


def ros2(part: str, folder: Path) -> Kind:
    """One file of a ROS 2 bag, beside the other."""
    files = bag(folder)
    (name,) = (name for name in files if name.endswith(part))
    changed = changed_bytes if part == "db3" else changed_lines
    return log(name, files.pop(name), changed, "--mapping ros-joint-states", files)


def lerobot(part: str, folder: Path) -> Kind:
    """One file of a LeRobot dataset with two episodes, beside the others."""
    swum = {name: values[:, None] for name, values in swim(TIME).items()}
    episodes = [swum, {name: values[:50] for name, values in swum.items()}]
    made = write_dataset(folder / "data", episodes, version="v3.0", fps=20, names=None)
    files = {str(path.relative_to(folder)): path.read_bytes() for path in made.rglob("*") if path.is_file()}
    changed = changed_bytes if part.endswith("parquet") else changed_lines
    return log(f"data/{part}", files.pop(f"data/{part}"), changed, beside=files)


def sizes(name: str, data: bytes, changed) -> Kind:
    """A kind of log that declares any size."""
    return replace(log(name, data, changed), memory=MOST_MEMORY)


def places(name: str, content: bytes, words: str, outputs: str = "") -> Kind:
    """A name that stands for no file."""
    return Place(name, (b"file",), another_place, (command(words, outputs),), {"swim.csv": table()}, content=content)


def model_file(_: Path) -> Kind:
    commands = (command(f"identify swim.csv --model m.py --time-limit 5 --method {method}") for method in dr.METHODS)
    return Kind("m.py", (model_text(),), odd_model, tuple(commands), {"swim.csv": table()})


SEARCH = "--model underwater-vehicle --method i-diransac --time-limit 1"
KINDS = {
    "results": (20, lambda folder: result(changed_result, folder)),
    "names": (10, names),
    "files beside": (8, files_beside),
    "equations": (10, lambda folder: result(changed_graph, folder)),
    "stores": (15, study_store),
    "fleets": (8, fleet_store),
    "studies": (15, study_file),
    "csv": (8, lambda _: log("log.csv", table(), changed_table)),
    "csv with metadata": (8, lambda folder: log("log.csv", columns(".csv", folder), changed_table)),
    "csv.gz": (8, lambda folder: log("log.csv.gz", columns(".csv.gz", folder))),
    "parquet": (8, lambda folder: log("log.parquet", columns(".parquet", folder))),
    "npz": (8, lambda folder: log("log.npz", columns(".npz", folder))),
    "mat": (8, lambda _: log("log.mat", mat())),
    "hdf5": (8, lambda folder: log("log.h5", hdf5(folder))),
    "ulog": (8, lambda _: log("log.ulg", flight()[0][:20_000], options="--mapping px4-multirotor")),
    "mcap": (8, lambda folder: log("log.mcap", recording("log.mcap", folder), options="--mapping ros-joint-states")),
    "ros 1 bag": (8, lambda folder: log("log.bag", recording("log.bag", folder), options="--mapping ros-joint-states")),
    "ros 2 bag": (8, lambda folder: ros2("db3", folder)),
    "ros 2 metadata": (8, lambda folder: ros2("yaml", folder)),
    "lerobot": (8, lambda folder: lerobot("data/chunk-000/file-000.parquet", folder)),
    "lerobot facts": (8, lambda folder: lerobot("meta/info.json", folder)),
    "crazyflie": (8, lambda _: log("log", crazyflie(), options="--map x=fixed.x,thrust=fixed.u")),
    "mapping": (8, lambda _: options("m.toml", MAPPING, f"identify swim.csv {MODEL} --mapping m.toml")),
    "settings": (8, lambda _: options("s.toml", SETTINGS, f"identify swim.csv {SEARCH} --settings s.toml")),
    "robot": (8, robot),
    "sizes of npz": (6, lambda folder: sizes("log.npz", columns(".npz", folder), sized_npz)),
    "sizes of hdf5": (6, lambda folder: sizes("log.h5", hdf5(folder), sized_hdf5)),
    "sizes of text": (4, lambda _: sizes("log.csv.gz", gzip.compress(table()), sized_gzip)),
    "sizes of equations": (2, lambda folder: replace(result(sized_graph, folder), memory=MOST_MEMORY)),
    "sizes of robots": (6, lambda folder: replace(robot(folder), changed=sized_robot, memory=MOST_MEMORY)),
    "models": (8, model_file),
    "places of results": (6, lambda _: places("a.json", results()[0], "export a.json -o out.py", "out.py")),
    "places of logs": (6, lambda _: places("a.csv", table(), f"identify a.csv {MODEL}")),
    "places of studies": (
        6,
        lambda _: places("a.toml", TINY_TOML.encode(), "study run a.toml --store out.db", "out.db"),
    ),
    "places of outputs": (6, lambda _: places("a.json", b"", f"identify swim.csv {MODEL} -o a.json", "a.json")),
}
"""Examples of each kind in the suite, and what makes the kind."""


# The rule -------------------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module", autouse=True)
def counts() -> Iterator[dict[str, Counter[int]]]:
    """Exit codes by kind; printed where a number of examples was asked for."""
    found: dict[str, Counter[int]] = {name: Counter() for name in KINDS}
    yield found
    if ASKED:
        print(f"\n{'kind':20}{'files':>8}{'exit 0':>8}{'exit 1':>8}{'exit 2':>8}")  # noqa: T201
        for name, codes in found.items():
            print(f"{name:20}{codes.total():8}" + "".join(f"{codes[code]:8}" for code in (0, 1, 2)))  # noqa: T201


@pytest.fixture(autouse=True)
def no_code(monkeypatch):
    """CasADi reads no code but what this process has written, and trials of studies are not run."""
    own, serialize, deserialize = set(), ca.Function.serialize, ca.Function.deserialize

    def written(function, *options):
        own.add(serialize(function, *options))
        return serialize(function, *options)

    def read(text):
        assert text in own, "code of a file would be run"
        return deserialize(text)

    def refused(*_):
        raise AssertionError("code of a file would be run")

    def kept(study, *, store, **_):
        with Store(store, study):
            pass
        return status(store)

    monkeypatch.setattr(ca.Function, "serialize", written)
    monkeypatch.setattr(ca.Function, "deserialize", read)
    for name in ("external", "Importer", "StringDeserializer", "FileDeserializer"):
        monkeypatch.setattr(ca, name, refused)
    monkeypatch.setattr("diransac.cli.commands.stores.run_study", kept)


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_every_command_keeps_the_rule_over_a_damaged_file(name, tmp_path_factory, counts):
    few, make = KINDS[name]
    kind = make(tmp_path_factory.mktemp("made"))
    folder = tmp_path_factory.mktemp("read")
    refused = [one.words for one, code in kind.undamaged(folder) if code]
    assert len(refused) < len(kind.data) * len(kind.commands), refused

    @settings(max_examples=int(ASKED or few), derandomize=not ASKED, database=None, phases=[Phase.generate])
    @given(st.randoms(use_true_random=True))
    def check(rng):
        counts[name][kind.check(folder, rng)] += 1

    check()
