"""First contacts: files as people have them, and the commands that a reader of the messages tries until one works.

Run: ``python benchmarks/first_contacts.py [TEXT ...]``: those whose names hold a text, all by default.  Files are those
of a simulated axis of 20 kg; real ones are read from ``../shared/data`` where that is.  A command works if its exit
code is 0 and, of the axis, the mass is right within 5 %.  Printed are the number of commands that were refused, the
time of all, and their messages.  ``PYTHONPATH`` of another version gives its table.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.io

import diransac as dr

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from lerobot_datasets import write_dataset

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED = REPOSITORY.parent / "shared" / "data"
MASS = 20.0
AXIS = "identify {} --model servo-axis --json"


def moved(seed: int) -> pd.DataFrame:
    """Time, position and force of the axis."""
    t, phases = np.arange(0.0, 10.0, 0.01), np.random.default_rng(seed).uniform(0.0, 6.0, 3)
    force = np.sin(np.outer(t, (1.5, 4.1, 9.0)) + phases) @ (60.0, 45.0, 20.0)
    truth = {"mass": MASS, "viscous_friction": 80.0, "dry_friction": 8.0, "offset": 1.0}
    start = {"position": 0.0, "position_dot": 0.0}
    inputs = dr.Log.from_arrays(t, {"force": force})
    run = dr.simulate(dr.Plant(dr.models.servo_axis(), truth), inputs, initial_state=start, substeps=5)
    noise = np.random.default_rng(seed).normal(0.0, 1e-4, len(t))
    return pd.DataFrame({"t": t, "position": run["position"] + noise, "force": force})


TABLE, OTHER = moved(1), moved(2)
INSTRUMENT = TABLE.assign(t=1e3 * TABLE.t, position=1e3 * TABLE.position)
UNITS = INSTRUMENT.set_axis(["time [ms]", "position [mm]", "force [N]"], axis=1)
STAMPED = TABLE.assign(t=pd.to_datetime(1.7e9 + TABLE.t, unit="s")).rename(columns={"t": "timestamp"})


@dataclass(frozen=True)
class Contact:
    """A file, and command lines in the order in which its messages suggest them.

    Parameters
    ----------
    name : str
    write : callable
        Writes the file into the current folder.
    commands : tuple of str
        Without the name of the program.
    """

    name: str
    write: Callable[[], object]
    commands: tuple[str, ...]


def axis(name: str, write: Callable[[], object], file: str, *options: str) -> Contact:
    """A contact in which the axis is identified, with no option first."""
    return Contact(name, write, tuple(f"{AXIS.format(file)} {x}".strip() for x in ("", *options)))


def lines(frame: pd.DataFrame, *above: str) -> str:
    """CSV text below other lines."""
    return "\n".join([*above, frame.to_csv(index=False)])


def write_folder(frames: dict[str, pd.DataFrame], **options: object) -> None:
    """CSV files in a folder ``runs``."""
    Path("runs").mkdir()
    for name, frame in frames.items():
        frame.to_csv(f"runs/{name}.csv", index=False, **options)


def write_hdf5() -> None:
    """Time, and a group with the signals."""
    import h5py

    with h5py.File("a.h5", "w") as file:
        file["time"], file["axis/position"], file["axis/force"] = (TABLE[name] for name in TABLE)


def write_simulink() -> None:
    """Structures with time, as Simulink logs them."""
    t, x, f = (TABLE[[name]].to_numpy() for name in TABLE)
    scipy.io.savemat("a.mat", {"out": {"tout": t, "position": {"signals": {"values": x}}, "force": f}})


def write_lerobot() -> None:
    """Two episodes in degrees."""
    episodes = [
        {
            "observation.state": np.rad2deg(x[["position"]].to_numpy()) * [1, 1],
            "action": x[["force"]].to_numpy() * [1, 1],
        }
        for x in (TABLE, OTHER)
    ]
    write_dataset(Path("lerobot"), episodes, fps=100)


def write_colleague() -> None:
    """A log with its history, and a result of a log with other names and units."""
    UNITS.to_csv("raw.csv", index=False)
    dr.read_log("raw.csv", rename={"position": "position"}).write("log.csv")
    INSTRUMENT.set_axis(["t_ms", "q", "u"], axis=1).to_csv("theirs.csv", index=False)
    options = {"rename": {"position": "q", "force": "u"}, "scale": {"position": 1e-3}}
    dr.identify(dr.models.servo_axis(), dr.read_log("theirs.csv", **options)).save("result.json")


def write_bag() -> None:
    """A bag of ROS 2 with joint states."""
    from recordings import write_bag

    write_bag(Path("bag"), "SQLITE3")


def write_gimbal() -> None:
    """The recordings of the tutorial, and its files."""
    subprocess.run([sys.executable, REPOSITORY / "examples" / "gimbal_log.py"], check=True, stdout=subprocess.DEVNULL)
    page = (REPOSITORY / "docs" / "tutorial.md").read_text()
    for block in page.split("```")[1::2]:
        language, _, body = block.partition("\n")
        first = body.partition("\n")[0].removeprefix("# ")
        if language in ("python", "toml") and first in ("gimbal.py", "gimbal.toml"):
            Path(first).write_text(body)


NAMED = "--map position=Pos,force=Force"
CONTACTS = (
    axis("CSV in SI units", lambda: TABLE.to_csv("a.csv", index=False), "a.csv"),
    axis("CSV in ms and mm, by its header", lambda: UNITS.to_csv("a.csv", index=False), "a.csv"),
    axis("CSV of pandas with its index", lambda: TABLE.to_csv("a.csv"), "a.csv"),
    axis(
        "Excel's CSV: semicolons, decimal commas, Windows' µ",
        lambda: (
            UNITS.assign(**{"position [mm]": 1e6 * TABLE.position})
            .rename(columns={"position [mm]": "position [µm]"})
            .to_csv("a.csv", index=False, sep=";", decimal=",", encoding="cp1252")
        ),
        "a.csv",
    ),
    axis("Excel's Unicode text", lambda: UNITS.to_csv("a.txt", index=False, sep="\t", encoding="utf-16"), "a.txt"),
    axis(
        "NumPy's savetxt with a header",
        lambda: np.savetxt("a.csv", TABLE, delimiter=",", header="t,position,force"),
        "a.csv",
        "--repair comments",
        "--repair comments --columns t,position,force",
    ),
    axis("NumPy's savetxt, spaces", lambda: np.savetxt("a.txt", TABLE), "a.txt", "--columns t,position,force"),
    axis(
        "a line of units below the header",
        lambda: Path("a.csv").write_text(
            "time,position,force\nms,mm,N\n" + INSTRUMENT.to_csv(index=False, header=False)
        ),
        "a.csv",
        "--map t=time",
        "--map t=time --repair safe",
    ),
    axis(
        "dSPACE and the like: lines above the header",
        lambda: Path("a.csv").write_text(lines(TABLE, "Recorder: ControlDesk 7.1", "Date: 2026-01-03")),
        "a.csv",
        "--repair preamble",
        "--repair safe",
    ),
    axis(
        "CSV with ISO times",
        lambda: STAMPED.to_csv("a.csv", index=False),
        "a.csv",
        "--map t=timestamp",
        "--map t=timestamp --repair timestamps",
    ),
    axis(
        "Parquet of pandas, times as its index",
        lambda: STAMPED.set_index("timestamp").to_parquet("a.parquet"),
        "a.parquet",
        "--map t=timestamp",
        "--map t=timestamp --repair timestamps",
    ),
    axis(
        "CSV in ms, which says no unit",
        lambda: TABLE.assign(t=1e3 * TABLE.t).to_csv("a.csv", index=False),
        "a.csv",
        "--scale t=0.001",
    ),
    axis("no time column", lambda: TABLE.drop(columns="t").to_csv("a.csv", index=False), "a.csv", "--rate 100"),
    axis(
        "other names of columns",
        lambda: TABLE.set_axis(["Time", "Pos", "Force"], axis=1).to_csv("a.csv", index=False),
        "a.csv",
        NAMED,
    ),
    axis(
        "a typing error in the header",
        lambda: TABLE.rename(columns={"position": "postion"}).to_csv("a.csv", index=False),
        "a.csv",
        "--map position=postion",
    ),
    axis("NPZ", lambda: np.savez("a.npz", **TABLE), "a.npz"),
    axis(
        "MAT of Simulink",
        write_simulink,
        "a.mat",
        "--map t=out.tout",
        "--map t=out.tout,force=out.force",
        "--map t=out.tout,force=out.force,position=out.position.signals.values",
    ),
    axis("HDF5 with groups", write_hdf5, "a.h5", "--map force=axis.force,position=axis.position"),
    axis("a folder, a file per signal", lambda: write_folder({x: TABLE[[x]] for x in TABLE}, header=False), "runs"),
    Contact(
        "a folder of runs",
        lambda: write_folder({"a": TABLE, "b": OTHER}),
        (AXIS.format("runs"), AXIS.format("runs/a.csv runs/b.csv")),
    ),
    axis("stdin", lambda: TABLE.to_csv("a.csv", index=False), "- < a.csv"),
    axis(
        "a LeRobot dataset in degrees",
        write_lerobot,
        "lerobot",
        "--map force=action.shoulder_pan.pos,position=observation.state.shoulder_pan.pos --scale position=0.0174533",
    ),
    axis("a colleague's log, with its history", write_colleague, "log.csv"),
    Contact("a colleague's result, and a log of the recorder", write_colleague, ("validate result.json theirs.csv",)),
    Contact(
        "the same, compared",
        write_colleague,
        tuple(
            f"compare theirs.csv --methods lo-diransac --model {x}"
            for x in ("result.json", "servo-axis", "servo-axis --map position=q,force=u --scale position=0.001")
        ),
    ),
    Contact(
        "MCAP of the tutorial",
        write_gimbal,
        (
            "identify gimbal_monday.mcap --model gimbal.py",
            "identify gimbal_monday.mcap --model gimbal.py --mapping gimbal.toml",
        ),
    ),
    Contact(
        "a ROS 2 bag",
        write_bag,
        (
            "inspect bag --model servo-axis --map force=effort[0]",
            "inspect bag --model servo-axis --mapping ros-joint-states",
        ),
    ),
    Contact("its file", write_bag, ("inspect bag/bag.db3", "inspect bag")),
    Contact("a workbook", lambda: Path("a.xlsx").write_bytes(b"PK"), ("inspect a.xlsx",)),
    Contact(
        "PX4's ULog",
        lambda: None,
        (
            f"inspect {SHARED}/px4_ulog/sample_log_small.ulg --model quadrotor",
            f"inspect {SHARED}/px4_ulog/sample_log_small.ulg --mapping px4-multirotor",
        ),
    ),
    Contact("Crazyflie's micro SD log", lambda: None, (f"inspect {SHARED}/crazyflie_arpl/log15 --mapping crazyflie",)),
    Contact(
        "Go2's MJCF",
        lambda: None,
        (
            f"inspect {SHARED}/unitree_go2/traj_0.parquet --model {SHARED}/unitree_go2/go2.xml",
            f"inspect {SHARED}/unitree_go2/traj_0.parquet --model {SHARED}/unitree_go2/go2.xml --joints {{}}_joint "
            "--control kp=20,kd=1.5,target=des_{}",
        ),
    ),
)


def tried(command: str) -> tuple[bool, float, str]:
    """Whether a command works, its time, s, and its last message."""
    words, _, source = command.partition(" < ")
    file, _, rest = source.partition(" ")
    began = time.perf_counter()
    with open(file or "/dev/null", "rb") as text:  # noqa: PTH123  a descriptor for the process
        done = subprocess.run(
            [sys.executable, "-m", "diransac", *shlex.split(f"{words} {rest}")],
            stdin=text,
            capture_output=True,
            text=True,
            check=False,
        )
    seconds = time.perf_counter() - began
    works = done.returncode == 0
    message = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ""
    if works and "--json" in command:
        mass = json.loads(done.stdout)["parameters"]["mass"]
        works = bool(abs(mass / MASS - 1.0) < 0.05)
        message = "" if works else f"a mass of {mass:.3g} kg"
    return works, seconds, message


def main() -> None:
    """Print the table."""
    import os

    for contact in CONTACTS:
        if sys.argv[1:] and not any(text in contact.name for text in sys.argv[1:]):
            continue
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            contact.write()
            refused, total, messages = 0, 0.0, []
            for command in contact.commands:
                works, seconds, message = tried(command)
                total += seconds
                if works:
                    break
                refused += 1
                messages.append(message)
            outcome = "works" if works else "does not work"
            print(f"{contact.name} | {refused} | {outcome} | {total:.0f} s | {' / '.join(messages)[:300]}", flush=True)
            os.chdir("/")


if __name__ == "__main__":
    main()
