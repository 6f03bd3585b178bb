"""Random descriptions of robots with every attribute of MuJoCo's schema: forces equal to MuJoCo's, or refused by name.

``python benchmarks/described_trees.py [--first 0] [--last 1999]``: trees of hinges and slides on a base that is fixed,
held or free, with equality constraints, tendons and actuators; an attribute is drawn from MuJoCo's own schema, so that
one that a later version adds has no value here, and is named.  Residuals stand against `mj_inverse`, accelerations
against `mj_forward`, of MuJoCo's own compilation of the same text.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import diransac as dr

Rng = np.random.Generator
Draw = Callable[[Rng], str]
EQUAL, SPEED, WELL_CONDITIONED = 1e-9, 0.05, 1e5
"""Difference over the largest value that is one of rounding; speed over which friction changes its sign; of the mass
matrices whose accelerations are compared (two parallel slides without armature have none)."""


def text(values: Any) -> str:
    """Numbers with all of their digits."""
    return " ".join(repr(float(x)) for x in np.ravel(values))


def within(low: float, high: float, size: int = 1) -> Draw:
    """Uniform numbers."""
    return lambda rng: text(rng.uniform(low, high, size))


def one_of(*words: str) -> Draw:
    """One of some words."""
    return lambda rng: str(rng.choice(words))


def polynomial(first: float) -> Draw:
    """One to three coefficients of a force, the first of which is positive."""
    return lambda rng: text([rng.uniform(0, first), *rng.uniform(-0.2 * first, 0.5 * first, rng.integers(3))])


def ordered(low: float, high: float) -> Draw:
    """A range."""
    return lambda rng: text(np.sort(rng.uniform(low, high, 2)))


FLAG, YES = one_of("enable", "disable"), one_of("true", "false")
SOLVER: dict[str, Draw] = {
    "solref": lambda rng: text([rng.uniform(0.005, 0.1), 1.0]),
    "solimp": lambda rng: text([0.9, rng.uniform(0.9, 0.99), 0.001, 0.5, 2]),
}
LIMITED: dict[str, Draw] = {
    "limited": YES, "range": ordered(-60, 60), "margin": within(0, 0.01), "group": one_of("0", "3"),
    "actuatorfrclimited": YES, "actuatorfrcrange": lambda rng: text([-rng.uniform(1, 9), rng.uniform(1, 9)]),
    **{f"sol{kind}limit": SOLVER[f"sol{kind}"] for kind in ("ref", "imp")},
    **{f"sol{kind}friction": SOLVER[f"sol{kind}"] for kind in ("ref", "imp")},
}  # fmt: skip
DRIVE: dict[str, Draw] = {
    "gear": lambda rng: text(rng.choice([-1, 1]) * rng.uniform(0.5, 20)), "armature": within(0, 1e-3),
    "damping": polynomial(1e-3), "ctrllimited": YES, "forcelimited": YES, "group": one_of("0", "2"),
    "ctrlrange": ordered(-2, 2), "forcerange": lambda rng: text([-rng.uniform(1, 9), rng.uniform(1, 9)]),
    "lengthrange": ordered(-2, 2),
}  # fmt: skip
VALUES: dict[str, dict[str, Draw]] = {
    "compiler": {
        "angle": one_of("radian", "degree"), "balanceinertia": YES, "boundmass": within(0, 0.5),
        "boundinertia": within(0, 1e-3), "eulerseq": one_of("xyz", "ZYX", "XZX"), "fusestatic": YES, "usethread": YES,
        "discardvisual": YES, "inertiafromgeom": one_of("auto", "auto", "false"), "settotalmass": within(1, 9),
        "alignfree": YES, "saveinertial": YES,
    },
    "option": {
        "gravity": within(-10, 10, 3), "timestep": within(0.001, 0.01), "impratio": within(1, 5),
        "wind": within(-1, 1, 3), "density": within(1, 900), "viscosity": within(0.01, 0.5),
        "integrator": one_of("Euler", "RK4", "implicit"),
        "solver": one_of("PGS", "CG", "Newton"), "cone": one_of("pyramidal", "elliptic"), "magnetic": within(-1, 1, 3),
        "jacobian": one_of("dense", "sparse"), "tolerance": within(0, 1e-6), "iterations": one_of("10", "200"),
        "o_margin": within(0, 0.1), "o_solref": SOLVER["solref"], "o_solimp": SOLVER["solimp"],
        "o_friction": within(0.1, 1, 5), "actuatorgroupdisable": one_of("2", "0 2"),
    },
    "flag": dict.fromkeys(
        ("actuation", "autoreset", "clampctrl", "constraint", "contact", "damper", "energy", "equality", "eulerdamp",
         "filterparent", "frictionloss", "fwdinv", "gravity", "invdiscrete", "island", "limit", "midphase", "multiccd",
         "nativeccd", "override", "refsafe", "sensor", "spring", "warmstart", "diagexact"), FLAG
    ),
    "joint": {
        "axis": within(-1, 1, 3), "pos": within(-0.3, 0.3, 3), "ref": within(-0.5, 0.5), "armature": within(0, 0.1),
        "springref": within(-0.5, 0.5), "stiffness": polynomial(3), "damping": polynomial(1),
        "frictionloss": within(0, 1), "actuatorgravcomp": YES, "springyield": within(0.1, 1),
        "springdamper": lambda rng: text(rng.uniform(0.5, 2, 2)),
        **LIMITED,
    },
    "body": {
        "pos": within(-0.3, 0.3, 3), "quat": within(0.1, 1, 4), "euler": within(-2, 2, 3), "gravcomp": within(0, 1.2),
        "axisangle": within(0.1, 1, 4), "zaxis": within(0.1, 1, 3), "mocap": one_of("false"), "sleep": one_of("auto"),
        "fuse": one_of("auto"), "simple": one_of("auto"),
        "xyaxes": lambda rng: text([*(r := np.linalg.qr(rng.normal(size=(3, 3)))[0])[0], *r[1]]),
    },
    "frame": {"pos": within(-0.3, 0.3, 3), "euler": within(-2, 2, 3), "scale": within(0.7, 1.4)},
    "geom": {
        "size": lambda rng: text(rng.uniform(0.02, 0.1, 3)), "type": one_of("sphere", "capsule", "box", "ellipsoid"),
        "pos": within(-0.2, 0.2, 3), "density": within(100, 2000), "mass": within(0.1, 2), "shellinertia": YES,
        "fluidshape": one_of("none", "ellipsoid"), "fluidcoef": within(0.1, 1, 5), "friction": within(0.1, 1),
        "condim": one_of("3", "6"), "contype": one_of("0", "1"), "surfacevel": within(-1, 1, 3),
        "adhesion": within(0.0, 1.0),
    },
    "fixed": {
        "stiffness": polynomial(3), "damping": polynomial(1), "frictionloss": within(0.1, 1),
        "armature": within(0.01, 0.1), "springlength": within(-0.1, 0.5), "springyield": within(0.1, 1), **LIMITED,
    },
    "equality": {"active": one_of("true", "true", "false"), **SOLVER},
    "motor": DRIVE,
    "position": DRIVE | {"kp": within(1, 20), "kv": within(0, 2), "timeconst": within(0.01, 0.1)},
    "velocity": DRIVE | {"kv": within(0, 2)},
    "damper": {x: y for x, y in DRIVE.items() if x != "ctrllimited"} | {
        "kv": within(0, 2), "ctrlrange": lambda rng: text([0.0, rng.uniform(1, 3)]),
    },
    "general": DRIVE | {
        "dyntype": one_of("none", "filter"), "dynprm": within(0.05, 0.5), "gainprm": within(1, 5),
        "biastype": one_of("none", "affine"), "biasprm": within(-2, 0, 3),
    },
    "pid": DRIVE | {"kp": within(1, 20), "ki": within(0, 5), "kv": within(0, 2), "imax": within(0.1, 1)},
    "dcmotor": {x: y for x, y in DRIVE.items() if not x.startswith(("force", "length"))} | {
        "motorconst": lambda rng: text(rng.uniform(0.02, 0.2, 2)), "resistance": within(0.1, 2),
        "lugre": lambda rng: text([*rng.uniform(1, 100, 2), *rng.uniform(0, 0.2, 2), 0.1]),
        "cogging": lambda rng: text([rng.uniform(0, 0.1), 6, rng.uniform(0, 1)]),
    },
}  # fmt: skip
"""Values of attributes, by element."""

NAMES = {
    "name", "class", "type", "user", "joint", "joint1", "joint2", "polycoef", "site", "site1", "site2", "refsite",
    "coef", "tendon", "tendon1", "tendon2", "slidersite", "cranksite", "body", "body1", "body2", "childclass",
    "jointinparent", "material", "mesh", "hfield", "anchor", "relpose", "geom", "sidesite", "flex", "cell",
    "torquescale",
}  # fmt: skip
"""Attributes that name elements or users' data, or that are drawn with their elements."""
ELSEWHERE: dict[str, str] = {
    "compiler": "assetdir conflict coordinate fitaabb inertiagrouprange meshdir passthrough savecanonical savecompiled "
    "strippath texturedir autolimits",
    "option": "ccd_iterations ccd_tolerance ls_iterations ls_tolerance noslip_iterations noslip_tolerance "
    "sdf_initpoints sdf_iterations sleep_tolerance",
    "flag": "ipc sleep speculative",
    "geom": "axisangle castshadow conaffinity euler fitscale fromto gap group margin priority quat rgba solimp solmix "
    "solref xyaxes zaxis",
    "general": "actdim actearly actlimited actrange cranklength delay ffrange gaintype inheritrange input interp "
    "nsample velrange",
    "motor": "cranklength delay interp nsample",
    "position": "cranklength dampratio delay inheritrange interp nsample",
    "velocity": "cranklength delay interp nsample",
    "damper": "cranklength delay interp nsample",
    "pid": "cranklength dampratio delay ffrange inheritrange input interp nsample posrange slewmax velrange",
    "dcmotor": "controller cranklength delay inductance input interp nominal nsample saturation thermal lengthrange",
}
"""Attributes of files, of solvers of contacts, of looks, and of the force of a drive, which is no part of the model."""


def schema() -> dict[str, set[str]]:
    """Attributes that MuJoCo's schema has, by element."""
    found, own, names = dict[str, set[str]](), set[str](), []
    for line in mujoco.mj_printSchema(False, False).splitlines():
        element = re.match(r"( *)(?:\(world\))?(\w+) \(.\)\s*(.*)$", line)
        if element is not None:
            names = [*names[: len(element[1]) // 3], element[2]]
            own = found.setdefault(names[-1] if names[1:2] != ["equality"] else "equality", set())
        own |= set((element[3] if element else line).split())
    return found


# ---------------------------------------------------------------------- trees

ORIENTATIONS = {"quat", "euler", "axisangle", "zaxis", "xyaxes"}
RARE = {"joint": {"springyield"}, "option": {"density", "viscosity"}, "compiler": {"settotalmass"}, "frame": {"scale"}}
"""Attributes that are drawn less often, for a tree that has one is refused or differs from all others."""


def drawn(rng: Rng, element: str, share: float, /, **own: str) -> str:
    """Attributes of an element: its own, and others of which each is drawn with a probability."""
    own |= {key: VALUES[element][key](rng) for key in NEEDED.get(element, ())}
    chosen = [key for key in VALUES[element] if rng.random() < share * (0.1 if key in RARE.get(element, ()) else 1.0)]
    turned = [key for key in chosen if key in ORIENTATIONS]
    chosen = [key for key in chosen if key not in own and key not in turned[1:]]
    return " ".join(f'{key}="{x}"' for key, x in (own | {key: VALUES[element][key](rng) for key in chosen}).items())


def inertial(rng: Rng) -> str:
    """Mass and inertia of a possible body."""
    mass, axes = rng.uniform(0.1, 3.0), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    moments = mass * rng.uniform(0.02, 0.15, 3) ** 2
    inertia = axes @ np.diag(moments.sum() - moments) @ axes.T
    entries = text([*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]])
    return f'<inertial mass="{mass!r}" pos="{text(rng.uniform(-0.1, 0.1, 3))}" fullinertia="{entries}"/>'


def tree(seed: int) -> str:
    """MJCF of a random robot; the base of every third one is free."""
    rng = np.random.default_rng(seed)
    n, joints, inside = int(rng.integers(1, 6)), list[str](), dict[int, list[str]]()
    parents = [-1, *(int(rng.integers(0, k)) for k in range(1, n))]
    own = list[str]()
    for k in range(n):
        parts = [inertial(rng)] if rng.random() < 0.8 else []
        parts += (
            [f"<geom {drawn(rng, 'geom', 0.3, size='0.05 0.06 0.07')}/>"] if not parts or rng.random() < 0.3 else []
        )
        if k == 0 and seed % 3 == 2:
            parts.insert(0, '<freejoint name="base"/>')
        else:
            names = [f"j{k}{x}" for x in "abc"[: rng.integers(k == 0 or len(joints) == 0, 3)]]
            kinds = [str(rng.choice(["hinge", "hinge", "slide"])) for _ in names]
            parts += [f"<joint {drawn(rng, 'joint', 0.3, name=x, type=y)}/>" for x, y in zip(names, kinds, strict=True)]
            joints += names
        own.append("".join(parts))
    for k in reversed(range(n)):
        body = f"<body {drawn(rng, 'body', 0.3, name=f'b{k}')}>{own[k]}{''.join(inside.get(k, []))}</body>"
        if rng.random() < 0.15:
            body = f"<frame {drawn(rng, 'frame', 0.5)}>{body}</frame>"
        inside.setdefault(parents[k], []).insert(0, body)
    flags = f"<flag {drawn(rng, 'flag', 0.06)}/>"
    return (
        f"<mujoco><compiler {drawn(rng, 'compiler', 0.15)}/><option {drawn(rng, 'option', 0.1)}>{flags}</option>"
        f"<worldbody>{''.join(inside[-1])}</worldbody>{further(rng, joints, n)}</mujoco>"
    )


def further(rng: Rng, joints: list[str], n_bodies: int) -> str:
    """Equality constraints, tendons and actuators."""
    equality, tendons, drives = list[str](), list[str](), list[str]()
    if len(joints) > 1 and rng.random() < 0.4:
        first, second = rng.choice(joints, 2, replace=False)
        leader = f'joint2="{second}" ' if rng.random() < 0.8 else ""
        polynomial = text(np.resize([*rng.uniform(-0.5, 0.5, rng.integers(1, 6)), 0, 0, 0, 0], 5))
        equality.append(f'<joint joint1="{first}" {leader}polycoef="{polynomial}" {drawn(rng, "equality", 0.3)}/>')
    if n_bodies > 1 and rng.random() < 0.05:
        kind = rng.choice(["connect", "weld"])
        anchor = 'anchor="0 0 0" ' if kind == "connect" else ""
        equality.append(f'<{kind} body1="b0" body2="b1" {anchor}{drawn(rng, "equality", 0.3)}/>')
    if joints and rng.random() < 0.15:
        some = rng.choice(joints, min(2, len(joints)), replace=False)
        parts = "".join(f'<joint joint="{x}" coef="{rng.uniform(0.5, 2)!r}"/>' for x in some)
        tendons.append(f"<fixed {drawn(rng, 'fixed', 0.12, name='t')}>{parts}</fixed>")
    kinds = ("motor", "position", "velocity", "damper", "general", "pid", "dcmotor")
    for joint in joints:
        if rng.random() < 0.5:
            kind, place = str(rng.choice(kinds)), str(rng.choice(["joint", "joint", "jointinparent"]))
            drives.append(f"<{kind} {drawn(rng, kind, 0.3, **{place: joint})}/>")
    if tendons and rng.random() < 0.3:
        drives.append(f"<motor {drawn(rng, 'motor', 0.3, tendon='t')}/>")
    sections = (("equality", equality), ("tendon", tendons), ("actuator", drives))
    return "".join(f"<{name}>{''.join(found)}</{name}>" for name, found in sections if found)


LIMITS = ("ctrlrange", "forcerange")
NEEDED = {
    **dict.fromkeys(("motor", "position", "velocity", "general", "pid", "damper"), LIMITS),
    "dcmotor": ("ctrlrange", "motorconst", "resistance"), "joint": ("range", "actuatorfrcrange"),
    "fixed": ("range", "actuatorfrcrange"),
}  # fmt: skip
"""Attributes without which MuJoCo may refuse an element."""


# ---------------------------------------------------------------------- references


@dataclass(frozen=True)
class Reference:
    """MuJoCo's own model of a text, without constraints; its couplings, and the flags by which the file disables."""

    machine: mujoco.MjModel
    couplings: tuple[tuple[int, int, tuple[float, ...]], ...]
    without: int

    @classmethod
    def of(cls, path: Path) -> Reference:
        """Of a file."""
        machine, bits = mujoco.MjModel.from_xml_path(str(path)), mujoco.mjtDisableBit
        without = int(machine.opt.disableflags)
        tied = not without & (bits.mjDSBL_CONSTRAINT | bits.mjDSBL_EQUALITY)
        rows = [k for k in range(machine.neq) if tied and machine.eq_active0[k]]
        couplings = tuple(
            (int(machine.eq_obj1id[k]), int(machine.eq_obj2id[k]), tuple(machine.eq_data[k, :5].tolist())) for k in rows
        )
        machine.opt.disableflags |= bits.mjDSBL_CONSTRAINT
        machine.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_INVDISCRETE)
        return cls(machine, couplings, without)

    def motion(self, names: list[str], moved: np.ndarray, held: bool, rng: Rng) -> tuple[mujoco.MjData, np.ndarray]:
        """State in which the named joints have positions, velocities and accelerations ``(3, n)``; slopes ``(nv, n)``.

        A free base rests in its pose if it is held, and moves at random otherwise.
        """
        machine, data = self.machine, mujoco.MjData(self.machine)
        slopes = np.zeros((machine.nv, len(names)))
        if machine.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and not held:
            data.qpos[:7] = rng.normal(size=7)
            data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
            data.qvel[:6], data.qacc[:6] = rng.normal(size=(2, 6))
        for k, name in enumerate(names):
            at, dof = machine.joint(name).qposadr[0], machine.joint(name).dofadr[0]
            data.qpos[at], data.qvel[dof], data.qacc[dof] = moved[:, k]
            slopes[dof, k] = 1.0
        left = list(self.couplings)
        while left:
            left = [x for x in left if not self._followed(data, slopes, x, {y[0] for y in left})]
        return data, slopes

    def _followed(
        self, data: mujoco.MjData, slopes: np.ndarray, coupling: tuple[int, int, tuple[float, ...]], waiting: set[int]
    ) -> bool:
        """Move a joint by its leader, and return True; False: the leader waits for its own."""
        machine, (follower, leader, c) = self.machine, coupling
        if leader in waiting:
            return False
        at, dof = machine.jnt_qposadr, machine.jnt_dofadr
        polynomial, own, x, v, a = np.polynomial.Polynomial(c), machine.qpos0[at[follower]], 0.0, 0.0, 0.0
        if leader >= 0:
            x = data.qpos[at[leader]] - machine.qpos0[at[leader]]
            v, a = data.qvel[dof[leader]], data.qacc[dof[leader]]
        first, second = polynomial.deriv()(x) if leader >= 0 else 0.0, polynomial.deriv(2)(x)
        data.qpos[at[follower]], data.qvel[dof[follower]] = own + polynomial(x), first * v
        data.qacc[dof[follower]] = first * a + second * v**2
        slopes[dof[follower]] = first * slopes[dof[leader]] if leader >= 0 else 0.0
        return True

    def condition(self, data: mujoco.MjData) -> float:
        """Condition of the mass matrix."""
        columns, still = [], data.qacc.copy()
        for unit in (np.zeros(self.machine.nv), *np.eye(self.machine.nv)):
            data.qacc[:] = unit
            mujoco.mj_inverse(self.machine, data)
            columns.append(data.qfrc_inverse.copy())
        data.qacc[:] = still
        return float(np.linalg.cond(np.array(columns[1:]) - columns[0]))

    def friction(self, data: mujoco.MjData) -> np.ndarray:
        """Smooth dry friction of every degree of freedom, as `diransac.models.robot` has it."""
        bits = mujoco.mjtDisableBit
        off = self.without & (bits.mjDSBL_FRICTIONLOSS | bits.mjDSBL_CONSTRAINT)
        return (0.0 if off else 1.0) * self.machine.dof_frictionloss * np.tanh(data.qvel / SPEED)


def differences(path: Path, model: dr.Model, base: str | None, seed: int) -> Iterator[tuple[str, float]]:
    """Largest differences of forces, and of accelerations, over the largest values, for random motions."""
    reference, rng, names = Reference.of(path), np.random.default_rng(seed), list(model.coordinates)
    nominal = {n: x.value for n, x in model.parameters.items()}
    p, smooth = (
        model.parameter_vector(x)
        for x in (nominal, {n: 0.0 if n.startswith("friction_") else x for n, x in nominal.items()})
    )
    for moved in rng.normal(size=(5, 3, len(names))):
        data, slopes = reference.motion(names, moved, base != "measured", rng)
        mujoco.mj_inverse(reference.machine, data)
        expected = slopes.T @ (data.qfrc_inverse + reference.friction(data))
        inputs = [*np.zeros(len(names)), *(of_base(reference.machine, data) if base == "measured" else ())]
        found = model.residual(*moved, inputs, p).full().ravel()
        yield "forces", float(np.abs(found - expected).max() / max(np.abs(expected).max(), 1e-3))
        if base is None and not reference.couplings and reference.condition(data) < WELL_CONDITIONED:
            data.ctrl[:] = rng.normal(size=reference.machine.nu)
            mujoco.mj_forward(reference.machine, data)
            exact = slopes.T @ data.qacc
            own = model.dynamics(moved[:2].ravel(), slopes.T @ data.qfrc_actuator, smooth)[1].full().ravel()
            yield "accelerations", float(np.abs(own - exact).max() / max(np.abs(exact).max(), 1e-3))


def of_base(machine: mujoco.MjModel, data: mujoco.MjData) -> list[float]:
    """Angular velocity and acceleration of a free base, and its acceleration less gravity, in its frame."""
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, data.qpos[3:7])
    off = machine.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    gravity = np.zeros(3) if off else machine.opt.gravity
    return [*data.qvel[3:6], *data.qacc[3:6], *(rotation.reshape(3, 3).T @ (data.qacc[:3] - gravity))]


REASONS = (
    r"[a-z ()]+ of (?:tendon|joint|body|actuator)(?= \")", "density", "viscosity", "springyield", "kinematic loop",
    "friction of a tendon", "nothing can move", "nothing is unknown", "follows two others", "in a circle",
    "follow each other", "gravity compensation on a base", "moves has a mass", "cannot be scaled",
    "no joint is modelled", "there are no joints",
)  # fmt: skip


def outcome(seed: int, folder: Path) -> tuple[str, float]:
    """What becomes of a tree: "equal", "wrong", or the reason of a refusal; and the largest difference."""
    path, base = folder / "tree.xml", (None, "held", "measured")[seed // 3 % 2 + 1 if seed % 3 == 2 else 0]
    path.write_text(tree(seed))
    try:
        model = dr.models.robot(path, unknown=("armature", "damping", "friction", "spring"), base=base)
    except dr.DiransacError as error:
        reasons = [found[0] for reason in REASONS if (found := re.search(reason, str(error)))]
        return (reasons[0] if reasons else f"unnamed: {error}"), 0.0
    try:
        mujoco.MjModel.from_xml_path(str(path))
    except ValueError:  # of a body that MuJoCo takes to be without a mass
        return "read, not compiled by MuJoCo", 0.0
    largest = max(x for _, x in differences(path, model, base, seed))
    return ("equal" if largest < EQUAL else "wrong"), largest


def main() -> None:
    """Compare, and print what became of the trees."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--last", type=int, default=1999)
    options = parser.parse_args()
    mujoco.set_mju_user_warning(lambda _: None)
    found, largest = Counter[str](), 0.0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.first, options.last + 1):
            reason, difference = outcome(seed, Path(folder))
            found[reason] += 1
            largest = max(largest, difference)
            if reason == "wrong" or reason.startswith("unnamed"):
                print(f"seed {seed}: {reason}, {difference:.2g}", flush=True)
    known = schema()
    drawn_of = {name: len(set(VALUES[name]) & attributes) for name, attributes in known.items() if name in VALUES}
    print(f"MuJoCo {mujoco.__version__}: {sum(drawn_of.values())} attributes of {len(drawn_of)} elements are drawn, of")
    print(f"{sum(len(known[name] - NAMES) for name in drawn_of)} that are no names. Largest difference {largest:.1e}.")
    print("| trees | |")
    print("|--:|---|")
    for reason, count in found.most_common():
        print(f"| {count} | {reason if reason.startswith(('equal', 'read')) else f'refused: {reason}'} |")


if __name__ == "__main__":
    main()
