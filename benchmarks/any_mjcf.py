"""Any MJCF: a few parameters of files that others wrote, from logs of random drives.

``python benchmarks/any_mjcf.py FILE.xml ... [--seeds 1:2] [--seconds 5] [--out rows.jsonl]``, for instance the files of
`dm_control/suite` and `gymnasium/envs/mujoco/assets` in the wheels of these packages.

The machine has masses, dampings, armatures, Coulomb frictions, a stiffness and a gain of a drive that are 0.6 to 1.7
times those of the file; its drives follow smoothed noise over their ranges.  The log has positions and velocities of
its joints, with noise of 0.2 and 1 % of their spread and outliers of up to a hundred times that in 3 % of the samples.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco_simulation import Array, columns, simulated

import diransac as dr

FACTORS, OUTLIERS, SMOOTHING = (0.6, 1.7), 0.03, 0.15
"""True over nominal values; part of the samples that are outliers; time constant of the drives, s."""


def chosen(rng: np.random.Generator, machine: mujoco.MjModel) -> Iterator[tuple[str, str, tuple[int, ...]]]:
    """Masks of what is unknown, each with the array and the place in MuJoCo's model."""

    def some(names: list[str], n: int) -> list[str]:
        return [str(x) for x in rng.permutation(names)[:n]]

    joints = [x for x in map(machine.joint, range(machine.njnt)) if x.type[0] in (2, 3) and x.name]
    bodies = [machine.body(k) for k in range(1, machine.nbody) if machine.body_dofnum[k] and machine.body_mass[k] > 0.0]
    for name in some([x.name for x in bodies if x.name], 2):
        yield f"body/{name}.mass", "body_mass", (machine.body(name).id,)
    for field in ("damping", "armature", "frictionloss"):
        for name in some([x.name for x in joints if getattr(x, field)[0] > 0.0], 2):
            yield f"joint/{name}.{field}", f"dof_{field}", (int(machine.joint(name).dofadr[0]),)
    for name in some([x.name for x in joints if x.stiffness[0] > 0.0], 1):
        yield f"joint/{name}.stiffness", "jnt_stiffness", (machine.joint(name).id,)
    drives = [x for x in map(machine.actuator, range(machine.nu)) if x.name and not x.gaintype[0] and not x.biastype[0]]
    for name in some([x.name for x in drives], 1):
        yield f"actuator/{name}.gainprm[0]", "actuator_gainprm", (machine.actuator(name).id, 0)


def smoothed_noise(rng: np.random.Generator, machine: mujoco.MjModel, rows: int) -> Array:
    """Controls ``(rows, nu)`` over the ranges of the drives."""
    share, drives = machine.opt.timestep / SMOOTHING, np.zeros((rows + 1, machine.nu))
    for j in range(rows):
        noise = np.sqrt(2.0 * share) * rng.standard_normal(machine.nu)
        drives[j + 1] = drives[j] + (noise - share * drives[j])
    limited = machine.actuator_ctrllimited.astype(bool)
    low, high = (np.where(limited, machine.actuator_ctrlrange[:, k], 2.0 * k - 1.0) for k in (0, 1))
    return np.clip(0.5 * (low + high) + 0.45 * (high - low) * drives[1:], low, high)


def recorded(rng: np.random.Generator, exact: Mapping[str, Array]) -> dict[str, Array]:
    """Columns with noise and outliers."""
    found = {}
    for name, values in exact.items():
        is_speed = name.endswith("_dot")
        deviation = (0.01 if is_speed else 0.002) * max(float(np.std(values)), 0.01 if is_speed else 0.001)
        wrong = np.where(rng.random(len(values)) < OUTLIERS, 100.0 * rng.uniform(-1.0, 1.0, len(values)), 0.0)
        found[name] = values + deviation * (rng.standard_normal(len(values)) + wrong)
    return found


def measured(path: Path, seed: int, seconds: float) -> dict[str, Any]:
    """Row of a file and a seed: of each parameter the truth, the nominal value, the estimate and its interval."""
    row: dict[str, Any] = {"file": "/".join(path.parts[-2:]), "seed": seed}
    try:
        rng, machine = np.random.default_rng(seed), mujoco.MjModel.from_xml_path(str(path))
        places = {mask: (getattr(machine, array), index) for mask, array, index in chosen(rng, machine)}
        nominal = {mask: float(array[index]) for mask, (array, index) in places.items()}
        for array, index in places.values():
            array[index] *= np.exp(rng.uniform(*np.log(FACTORS)))
        truth = {mask: float(array[index]) for mask, (array, index) in places.items()}
        mujoco.mj_setConst(machine, mujoco.MjData(machine))
        model, dt = dr.models.mujoco(path, unknown=list(places)), machine.opt.timestep
        drives = smoothed_noise(rng, machine, round(seconds / dt))
        states, inputs, readings = simulated(machine, lambda j, _: drives[j], len(drives))
        exact = {n: x for n, x in columns(machine, states, readings).items() if n in model.state}
        log = recorded(rng, exact) | dict(zip(model.inputs, inputs.T, strict=True))
        begin = time.process_time()
        result = dr.identify(model, dr.Log.from_arrays(dt * np.arange(len(states)), log))
    except (dr.DiransacError, ValueError) as error:
        return row | {"refused": str(error)}
    intervals = result.intervals(0.95)
    values = {mask: (truth[mask], nominal[mask], result.parameters[mask], *intervals[mask]) for mask in places}
    return row | {"seconds": time.process_time() - begin, "verdict": result.verdict, "values": values}


def line(row: Mapping[str, Any]) -> str:
    """Row of the table."""
    start = f"| {row['file']} | {row['seed']} |"
    if "refused" in row:
        return f"{start} refused: {row['refused']:.120} |"
    values = np.array(list(row["values"].values()))
    truth, _, found, low, high = values.T
    told = np.isfinite(high - low) & (high - low < truth)
    inside = int(((low <= truth) & (truth <= high)).sum())
    errors = 100.0 * np.abs(found / truth - 1.0)[told]
    summary = f"{np.median(errors):.2g}, {errors.max():.2g}" if told.any() else "-"
    return f"{start} {inside} of {len(truth)} | {told.sum()} | {summary} | {row['verdict']} | {row['seconds']:.0f} |"


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--seeds", default="1:2")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    print("| file | seed | intervals that hold | known to half | their error, median, largest, % | verdict | s |")
    print("|---|--:|--:|--:|--:|---|--:|")
    for path in options.files:
        for seed in range(*map(int, options.seeds.split(":"))):
            row = measured(path, seed, options.seconds)
            print(line(row), flush=True)
            if options.out:
                with options.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
