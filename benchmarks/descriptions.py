"""Robots' description files of installable packages: read, refused and why, and equal to MuJoCo's inverse dynamics.

    python benchmarks/descriptions.py FOLDER|FILE ... [--refusals]

Each folder is one package, such as an unpacked wheel; without arguments, those of `PACKAGES` that are installed. Files
without any joint, which are scenes and objects, are left out, and so are parts that other files include.

The residual of `diransac.models.robot`, with nominal parameters and without friction, is compared with `mj_inverse` of
MuJoCo's own compilation of the same file, without constraints, in five random states; a free base is held, and joints
that follow others move with them by virtual work. Files that MuJoCo does not compile are compared with MuJoCo's
compilation of what is read in their place.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import diransac as dr
from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.robots.compiled import parsed

PACKAGES = ("brax", "dm_control", "gymnasium", "gymnasium_robotics", "metaworld", "pybullet_data", "robosuite")
"""Packages whose files are read where no folder is given."""
EQUAL = 1e-9
"""Difference of forces, over the largest of them, up to which they are equal."""

REASONS = {
    "nothing moves": "there are no joints",
    "closed loop": "closes a kinematic loop",
    "ball joint": "is a ball joint",
    "force without equations": "no equations here|not modelled|surrounding fluid",
    "no mass where something moves": "moves has a mass",
    "impossible inertia": "inertia must|mass and inertia of moving",
    "included file is missing": "Element 'include'",
    "file of a mesh is missing": r"[Ee]rror opening file|mesh file",
    "Xacro": "Xacro",
    "SDF": "SDF",
    "part of a file": "is a part that",
    "too many joints": "split the robot",
    "ambiguous names": "names of joints differ only",
    "MuJoCo does not read the text": "cannot be read",
}
"""Refusals by a part of their message; the first that fits."""


@dataclass(frozen=True)
class Outcome:
    """What came of a file: the reason of its refusal, or the largest relative difference of forces."""

    file: Path
    reason: str = ""
    message: str = ""
    difference: float = np.nan
    by_mujoco: bool = True


def main(arguments: list[str] | None = None) -> None:
    """Print the table, and the refusals by reason."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, metavar="FOLDER|FILE")
    parser.add_argument("--refusals", action="store_true", help="print the message of each refusal")
    chosen = parser.parse_args(arguments)
    folders = chosen.folders or installed()
    if not folders:
        print(f"none of these packages is installed: {', '.join(PACKAGES)}; give folders")
        return
    outcomes = {folder.name: list(outcomes_of(folder)) for folder in folders}
    print_table(outcomes)
    print_unequal([x for own in outcomes.values() for x in own])
    print_refusals([x for own in outcomes.values() for x in own], every=chosen.refusals)


def installed() -> list[Path]:
    """Folders of the packages that are installed."""
    specs = [importlib.util.find_spec(name) for name in PACKAGES]
    return [Path(place) for spec in specs if spec for place in spec.submodule_search_locations or ()]


def outcomes_of(folder: Path) -> Iterator[Outcome]:
    """Outcomes of the descriptions of a folder, or of a file."""
    files = [folder] if folder.is_file() else sorted(folder.rglob("*"))
    seen = set[bytes]()
    for file in files:
        if file.suffix in (".urdf", ".xml", ".mjcf", ".xacro", ".sdf") and file.is_file():
            content = file.read_bytes()
            if content not in seen and describes_motion(content.decode(errors="replace")):
                seen.add(content)
                with kept_off_the_terminal():
                    yield outcome_of(file)


def describes_motion(text: str) -> bool:
    """Whether a text is a whole description with a joint that moves."""
    root = re.search(r"<(robot|mujoco|sdf)\b", text)
    moves = {"mujoco": r"<(joint|freejoint|include)\b"}.get(root[1] if root else "", r"<joint\b(?![^>]*\"fixed\")")
    return root is not None and re.search(moves, text[root.end() :]) is not None


def outcome_of(file: Path) -> Outcome:
    """Outcome of a description."""
    try:
        model = dr.models.robot(file, base="held")
    except ModelError as error:
        return Outcome(file, reason_of(str(error)), str(error))
    compiled, by_mujoco = reference(file)
    return Outcome(file, difference=difference(model, compiled), by_mujoco=by_mujoco)


def reason_of(message: str) -> str:
    """Reason of a refusal."""
    return next((reason for reason, pattern in REASONS.items() if re.search(pattern, message)), "other")


# ---------------------------------------------------------------------- comparison


def reference(file: Path) -> tuple[Any, bool]:
    """MuJoCo's model of a file, and whether MuJoCo compiles the file as it is."""
    for as_it_is in (True, False):
        with contextlib.suppress(ValueError):
            spec = mujoco.MjSpec.from_file(str(file)) if as_it_is else parsed(file).spec
            if not as_it_is:
                drop_meshes(spec)
            spec.compiler.fusestatic = False  # MuJoCo drops the inertia of a massless body that it fuses
            compiled = spec.compile()
            bits = mujoco.mjtDisableBit
            if compiled.opt.disableflags & (bits.mjDSBL_CONSTRAINT | bits.mjDSBL_EQUALITY):
                compiled.eq_active0[:] = 0
            compiled.opt.disableflags |= bits.mjDSBL_CONSTRAINT
            return compiled, as_it_is
    raise RuntimeError(f"{file}: diransac reads what MuJoCo cannot compile")


def drop_meshes(spec: Any) -> None:
    """Remove shapes of bodies with an inertial, or that do not move: files of their meshes need not be there."""
    for element in (*spec.pairs, *spec.sensors, *spec.skins, *spec.lights, *spec.materials, *spec.textures):
        spec.delete(element)
    for shape in [x for x in spec.geoms if x.parent.explicitinertial or not moves(x.parent)]:
        spec.delete(shape)
    for shape in (*spec.geoms, *spec.sites, *spec.tendons):
        shape.material = ""
    used = {name for x in spec.geoms for name in (x.meshname, x.hfieldname)}
    for mesh in [x for x in (*spec.meshes, *spec.hfields) if x.name not in used]:
        spec.delete(mesh)


def moves(body: Any) -> bool:
    """Whether a body, or one that bears it, has a joint."""
    while body.parent is not None and not list(body.joints):
        body = body.parent
    return body.parent is not None


def difference(model: dr.Model, compiled: Any) -> float:
    """Largest difference of forces over the largest force, of five random motions."""
    p = [0.0 if name.startswith("friction") else x.value for name, x in model.parameters.items()]
    data, rng, errors = mujoco.MjData(compiled), np.random.default_rng(0), []
    followers = {int(compiled.eq_obj1id[k]): k for k in np.flatnonzero(compiled.eq_active0)}
    joints = np.flatnonzero(compiled.jnt_type != mujoco.mjtJoint.mjJNT_FREE)  # free bodies rest in the pose of the file
    leaders = [k for k in joints.tolist() if k not in followers]
    at, dofs = compiled.jnt_qposadr[joints], compiled.jnt_dofadr[joints]
    for _ in range(5):
        motion = np.zeros((3, compiled.njnt))
        motion[:, leaders] = rng.normal(size=(3, len(leaders)))
        slopes = np.eye(compiled.njnt)[:, leaders]
        for k, constraint in followers.items():
            motion[:, k], slopes[k] = followed(compiled, k, constraint, motion, slopes)
        data.qpos[at], data.qvel[dofs], data.qacc[dofs] = motion[:, joints]
        mujoco.mj_inverse(compiled, data)
        friction = np.where(np.isin(joints, list(followers)), compiled.dof_frictionloss[dofs], 0.0)  # no parameter
        expected = slopes[joints].T @ (data.qfrc_inverse[dofs] + friction * np.tanh(motion[1, joints] / 0.05))
        found = np.array(model.residual(*motion[:, leaders], np.zeros(model.n_u), p)).ravel()
        errors.append(np.abs(found - expected).max() / max(np.abs(expected).max(), 1e-12))
    return float(np.max(errors))


def followed(
    compiled: Any, k: int, constraint: int, motion: FloatArray, slopes: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position, velocity and acceleration of a joint that follows another, and its slopes; leaders come first."""
    leader, rest = int(compiled.eq_obj2id[constraint]), compiled.qpos0[compiled.jnt_qposadr]
    y0 = rest[k]
    polynomial = np.polynomial.Polynomial(compiled.eq_data[constraint, :5])
    if leader < 0:
        return np.array([y0 + polynomial(0.0), 0.0, 0.0]), 0.0 * slopes[k]
    x, v, a = motion[:, leader] - np.array([rest[leader], 0.0, 0.0])
    slope, curvature = polynomial.deriv(1)(x), polynomial.deriv(2)(x)
    return np.array([y0 + polynomial(x), slope * v, slope * a + curvature * v**2]), slope * slopes[leader]


# ---------------------------------------------------------------------- output


@contextlib.contextmanager
def kept_off_the_terminal() -> Iterator[None]:
    """Context without the text that readers of meshes print."""
    before, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
        os.close(nowhere)


def print_table(outcomes: dict[str, list[Outcome]]) -> None:
    """Print a row per package, and their sum."""
    reasons = [x for x in (*REASONS, "other") if any(x == y.reason for own in outcomes.values() for y in own)]
    head = ["package", "files", "read", "equal", "unequal", *reasons]
    print("| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    every = [x for own in outcomes.values() for x in own]
    for name, own in [*outcomes.items(), ("all", every)]:
        refused = Counter(x.reason for x in own)
        equal = sum(x.difference < EQUAL for x in own)
        read = refused.pop("", 0)
        cells = [len(own), read, equal, read - equal, *(refused[x] for x in reasons)]
        print(f"| {name} | " + " | ".join(str(x or "") for x in cells) + " |")
    print(f"\nNot compiled by MuJoCo as they are: {sum(not x.by_mujoco for x in every)} of the files that are read.")


def print_unequal(outcomes: list[Outcome]) -> None:
    """Print the files whose forces are not MuJoCo's."""
    for x in (x for x in outcomes if not x.reason and not x.difference < EQUAL):
        print(f"unequal by {x.difference:.2g}: {x.file}")


def print_refusals(outcomes: list[Outcome], *, every: bool) -> None:
    """Print the refusals by reason: three of each, or all."""
    groups = defaultdict[str, list[Outcome]](list)
    for x in (x for x in outcomes if x.reason):
        groups[x.reason].append(x)
    for reason, own in groups.items():
        print(f"\n{reason}: {len(own)}")
        for x in own if every else own[:3]:
            print(f"  {x.file.name}: {x.message}")


if __name__ == "__main__":
    main()
