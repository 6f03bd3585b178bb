"""Files of a working directory that libraries would read, load, run or write: none of them is touched.

A folder holds a crafted file for every library; one process, started as the console script is, works in it.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import swim
from hostile import LIBRARIES, MODULES, SETTINGS, URDF

RAN = "ran-"
"""Beginning of the names of files that planted code makes."""

WORK = """
import json, sys
from concurrent.futures import ThreadPoolExecutor

def main():
    import numpy as np
    import diransac as dr
    from diransac.study import identify_each
    found = {}
    model = dr.Model("m", {"s": "m"}, {"f": "N"}, {"m": dr.Parameter("kg")}, lambda q, v, a, u, p: [p.m * a.s - u.f])
    plant, way, limits = dr.Plant(model, {"m": 1.0}), [{"s": 0.0}, {"s": 1.0}], {"f": (-9.0, 9.0)}
    flight = dr.plan(plant, waypoints=way, times=[0.0, 2.0], input_limits=limits)
    found["ipopt"] = round(float(flight.states[-1, 0]), 6)
    try:
        found["mujoco"] = list(dr.models.robot("arm.urdf", unknown=("damping",)).parameters)
    except dr.ModelError as error:
        found["mujoco"] = str(error)[-17:]
    found["logs"] = [len(dr.read_log(name)) for name in sys.argv[1:]]
    vehicle = dr.models.underwater_vehicle()
    found["workers"] = identify_each(vehicle, ["swim.csv"], "ols", store="fleet.db", jobs=1).done
    result = dr.identify(vehicle, dr.read_log("swim.csv"), "ols")
    from diransac.plots.flight import plot_prediction
    log = dr.read_log("swim.csv")
    plot_prediction(dr.simulate(result, log), log, result.model.state, tuple(result.model.inputs), "out.png")
    import matplotlib
    found["matplotlib"] = matplotlib.rcParams["figure.dpi"] != 7
    try:
        import dask.config
        found["dask"] = dask.config.get("planted", False)
    except ModuleNotFoundError:
        pass
    print(json.dumps(found))

if __name__ == "__main__":
    main()
"""


def planted(folder: Path) -> None:
    """Put the files into a folder, code among them that makes a file when it is run."""
    for name in MODULES:
        (folder / f"{name}.py").write_text(f"open({str(folder / (RAN + name))!r}, 'w').close()\n")
    for name, text in SETTINGS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    compiler = shutil.which("cc")
    for name in LIBRARIES:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"not a library")
    if compiler:
        source = folder / "planted.c"
        mark = json.dumps(str(folder / f"{RAN}library"))
        source.write_text(
            "#include <stdio.h>\n__attribute__((constructor)) static void run(void)"
            f' {{ FILE *file = fopen({mark}, "w"); if (file) fclose(file); }}\n'
        )
        subprocess.run([compiler, "-shared", "-fPIC", "-o", folder / LIBRARIES[0], source], check=True)
        for name in LIBRARIES[1:]:
            shutil.copy(folder / LIBRARIES[0], folder / name)


def environment() -> dict[str, str]:
    """Variables of a process, without those that change what libraries and Python search."""
    dropped = ("PYTHONSAFEPATH", "MATPLOTLIBRC", "MPLBACKEND", "DASK_CONFIG", "CASADIPATH", "HDF5_PLUGIN_PATH")
    kept = {name: value for name, value in os.environ.items() if name not in dropped}
    return {**kept, "PYTHONPATH": str(Path(dr.__file__).parents[1]), "PYTHONDONTWRITEBYTECODE": "1"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Working directory with logs, a robot and the planted files."""
    folder = tmp_path_factory.mktemp("beside")
    t = 0.05 * np.arange(80)
    for ending in (".csv", ".parquet", ".npz"):
        dr.Log.from_arrays(t, swim(t)).write(folder / f"swim{ending}")
    (folder / "arm.urdf").write_text(URDF)
    planted(folder)
    return folder


@pytest.fixture(scope="module")
def worked(folder, tmp_path_factory):
    """What a process found in the folder, what it printed beside, and the files that are new."""
    h5py = pytest.importorskip("h5py", reason="NOT CHECKED: h5py is missing")
    with h5py.File(folder / "swim.h5", "w") as file:
        for name, values in {"t": 0.05 * np.arange(80), **swim(0.05 * np.arange(80))}.items():
            file.create_dataset(name, data=values, compression="gzip")
    script = tmp_path_factory.mktemp("bin") / "work.py"
    script.write_text(WORK)
    before = {path.name for path in folder.iterdir()}
    words = [sys.executable, script, *(f"swim{x}" for x in (".csv", ".parquet", ".npz", ".h5"))]
    done = subprocess.run(words, cwd=folder, env=environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    *printed, found = done.stdout.splitlines()
    new = {path.name for path in folder.iterdir()} - before
    return json.loads(found), printed + done.stderr.splitlines(), new


def test_no_planted_code_runs_in_a_command_or_in_its_workers(worked):
    found, _, new = worked
    assert found["workers"] == 1
    assert not [name for name in new if name.startswith(RAN)]


def test_ipopt_reads_no_options_and_loads_no_library(worked):
    found, printed, new = worked
    assert found["ipopt"] == 1.0
    assert new == {"out.png", "fleet.db"}
    assert printed == []


def test_matplotlib_reads_no_settings(worked):
    assert worked[0]["matplotlib"]


def test_mujoco_writes_no_log_and_prints_no_warning(worked):
    pytest.importorskip("mujoco", reason="NOT CHECKED: mujoco is missing")
    found, printed, new = worked
    assert found["mujoco"] == ["damping_e"]
    assert "MUJOCO_LOG.TXT" not in new
    assert printed == []


def test_the_page_names_every_library_that_is_checked_here():
    page = (Path(__file__).parents[1] / "docs" / "shared-files.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \|.*\|$", page.partition("## Files beside a log")[2], re.MULTILINE)
    named = {name.split()[0].strip("`") for row in rows[1:] for name in row.split(", ")}
    assert named == {
        "IPOPT", "Matplotlib", "MuJoCo", "Python", "CasADi", "HDF5", "Dask", "NumPy", "SciPy", "Polars",
        "llvmlite", "SQLite", "diransac",
    }  # fmt: skip


def test_dask_reads_no_settings(worked):
    pytest.importorskip("dask", reason="NOT CHECKED: dask is missing")
    assert worked[0]["dask"] is False


def test_readers_of_logs_load_nothing(worked):
    assert worked[0]["logs"] == [80] * 4


def test_hdf5_and_casadi_search_no_folder_by_a_relative_name(folder):
    pytest.importorskip("h5py", reason="NOT CHECKED: h5py is missing")
    code = (
        "import casadi, h5py; print(casadi.GlobalOptions.getCasadiPath());"
        "print(*(h5py.h5pl.get(k).decode() for k in range(h5py.h5pl.size())), sep='\\n')"
    )
    words = [sys.executable, "-P", "-c", code]
    done = subprocess.run(words, cwd=folder, env=environment(), capture_output=True, text=True, check=True)
    places = [Path(place) for line in done.stdout.splitlines() for place in line.split(os.pathsep)]
    assert places
    assert all(place.is_absolute() for place in places)


@pytest.mark.parametrize(
    ("words", "runs"),
    [(["-m", "diransac"], True), (["-P", "-m", "diransac"], False), (["SCRIPT"], False)],
    ids=["python -m diransac", "python -P -m diransac", "diransac"],
)
def test_modules_beside_run_with_python_m_alone(tmp_path, words, runs):
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "casadi.py").write_text("import sys; sys.exit(77)\n")
    script = tmp_path / "diransac"
    script.write_text("import sys\nfrom diransac.cli import main\nsys.exit(main())\n")
    given = [sys.executable, *(str(script) if word == "SCRIPT" else word for word in words), "--version"]
    done = subprocess.run(given, cwd=tmp_path / "here", env=environment(), capture_output=True, check=False)
    assert done.returncode == (77 if runs else 0)
