"""Mobile manipulator of eight joints, 80 s at 50 Hz: time, verdict or refusal, and errors beside those of filtered OLS.

``python benchmarks/large_arms.py [VARIANT ...] [--seeds N]``

Joint 1 is a torso's lift, a slide; 2 to 8 are hinges of an arm.  Its motion is a Fourier series per joint, whose forces
are MuJoCo's inverse dynamics; positions have noise of 0.1 mrad or 0.1 mm, forces noise of 1 % of their spread and 2 %
outliers of up to three times it.  The machine differs from its description by up to a quarter.  Variants:

- ``joints``: armature, damping and friction are unknown.
- ``gains``: and a factor of each force, 0.7 to 1.4.
- ``bodies``: all base parameters, damping and friction.
- ``efforts``: as ``gains``, of forces in units of their own, 0.01 to 0.1 of SI, two of them reversed.
- ``unmodelled``: as ``joints``, with a spring at joint 3, efforts that are recorded 20 ms late, and friction that grows
  with the load by a tenth of it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np
from robot_arms import Link, R, machine_like, mjcf

import diransac as dr

DT, DURATION, NOISE, FORCE_NOISE, OUTLIERS, OUTLIER_SIZE = 0.02, 80.0, 1e-4, 0.01, 0.02, 3.0
FREQUENCIES, TRANSITION = 2.0 * np.pi * np.array([0.05, 0.1, 0.15, 0.2, 0.3]), 0.05
REACH = np.array([0.12, 1.2, 0.9, 1.2, 1.0, 1.5, 1.0, 1.5])
SPRING, LATE, OF_LOAD = 8.0, 0.02, 0.1
EIGHT = (
    Link((0.0, 0.0, 0.8), (0.0, 0.0, 0.0), 12.0, (0.0, 0.0, 0.1), (0.30, 0.28, 0.15), 20.0, 80.0, 25.0, "slide"),
    Link((0.15, 0.0, 0.0), (0.0, 0.0, 0.0), 2.7, (0.06, 0.0, 0.0), (0.005, 0.010, 0.010), 0.30, 1.5, 2.0),
    Link((0.12, 0.0, 0.0), (-R, 0.0, 0.0), 2.5, (0.02, -0.05, 0.0), (0.009, 0.004, 0.010), 0.30, 1.5, 2.0),
    Link((0.05, -0.03, 0.0), (R, 0.0, 0.0), 2.7, (0.01, 0.0, 0.20), (0.030, 0.030, 0.005), 0.15, 1.0, 1.5),
    Link((0.0, 0.02, 0.31), (-R, 0.0, 0.0), 1.6, (0.02, -0.04, 0.0), (0.006, 0.003, 0.007), 0.15, 1.0, 1.2),
    Link((0.0, -0.12, 0.0), (R, 0.0, 0.0), 1.7, (0.0, 0.01, 0.08), (0.008, 0.008, 0.002), 0.05, 0.4, 0.5),
    Link((0.0, 0.0, 0.19), (-R, 0.0, 0.0), 0.5, (0.0, 0.01, 0.0), (0.001, 0.001, 0.001), 0.05, 0.3, 0.4),
    Link((0.0, 0.0, 0.0), (R, 0.0, 0.0), 1.2, (0.01, 0.0, 0.12), (0.008, 0.008, 0.002), 0.03, 0.2, 0.3),
)
NAMES = tuple(f"joint{k + 1}" for k in range(len(EIGHT)))
UNKNOWN = ("armature", "damping", "friction")


@dataclass(frozen=True)
class Variant:
    """What is unknown, and what the machine does besides: factors of recorded forces, and effects of no parameter."""

    unknown: tuple[str, ...] = UNKNOWN
    bodies: str | tuple[str, ...] = ()
    factors: tuple[float, float] = (1.0, 1.0)
    reversed: tuple[int, ...] = ()
    unmodelled: bool = False


VARIANTS = {
    "joints": Variant(),
    "gains": Variant((*UNKNOWN, "torque_gain"), factors=(0.7, 1.4)),
    "bodies": Variant(("damping", "friction"), bodies="all"),
    "efforts": Variant((*UNKNOWN, "torque_gain"), factors=(0.01, 0.1), reversed=(3, 6)),
    "unmodelled": Variant(unmodelled=True),
}


def motion(rng: np.random.Generator, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, velocities and accelerations (N, n) of a random Fourier series."""
    a, b = rng.uniform(-1.0, 1.0, (2, len(EIGHT), len(FREQUENCIES)))
    size = REACH / (np.abs(a) + np.abs(b)).sum(axis=1)
    a, b, w = a * size[:, None], b * size[:, None], FREQUENCIES
    s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    return s @ a.T + c @ b.T, (c * w) @ a.T - (s * w) @ b.T, -(s * w**2) @ a.T - (c * w**2) @ b.T


def forces(path: Path, moved: tuple[np.ndarray, np.ndarray, np.ndarray], *, unmodelled: bool) -> np.ndarray:
    """Forces (N, n) of the drives along a motion."""
    machine = mujoco.MjModel.from_xml_path(str(path))
    friction, damping = machine.dof_frictionloss.copy(), machine.dof_damping.copy()
    machine.dof_frictionloss[:] = machine.dof_damping[:] = 0.0
    machine.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data, found = mujoco.MjData(machine), []
    for q, v, a in zip(*moved, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(machine, data)
        load = data.qfrc_inverse.copy()
        dry = friction + OF_LOAD * np.abs(load) * unmodelled
        spring = SPRING * q * (np.arange(len(q)) == 2) * unmodelled
        found.append(load + damping * v + dry * np.tanh(v / TRANSITION) + spring)
    return np.array(found)


def machine_log(variant: Variant, path: Path, seed: int) -> tuple[dr.Log, np.ndarray]:
    """Log of a machine, and the factors from recorded forces to those that act."""
    rng, t = np.random.default_rng((seed, 3)), np.arange(0.0, DURATION, DT)
    moved = motion(rng, t)
    late = motion(np.random.default_rng((seed, 3)), t - LATE) if variant.unmodelled else moved
    tau = forces(path, late, unmodelled=variant.unmodelled)
    factors = np.exp(rng.uniform(*np.log(variant.factors), len(EIGHT)))
    factors[list(variant.reversed)] *= -1.0
    efforts = tau * factors
    spread = efforts.std(axis=0)
    efforts += FORCE_NOISE * spread * rng.standard_normal(efforts.shape)
    hit = rng.random(efforts.shape) < OUTLIERS
    efforts[hit] += (OUTLIER_SIZE * spread * rng.uniform(-1.0, 1.0, efforts.shape))[hit]
    positions = moved[0] + NOISE * rng.standard_normal(efforts.shape)
    columns = dict(zip(NAMES, positions.T, strict=True))
    columns |= {f"{n}_torque": x for n, x in zip(NAMES, efforts.T, strict=True)}
    return dr.Log.from_arrays(t, columns), 1.0 / factors


def model_of(variant: Variant, path: Path) -> dr.Model:
    """Model of the described machine."""
    return dr.models.robot(path, unknown=variant.unknown, bodies=variant.bodies, friction_speed=TRANSITION)


def machine(variant: Variant, seed: int) -> tuple[Link, ...]:
    """Links of the machine: inertial parameters are those of the description where they are no unknowns."""
    found = machine_like(EIGHT, seed)
    if variant.bodies:  # whose armature is known
        return tuple(replace(y, armature=x.armature) for x, y in zip(EIGHT, found, strict=True))
    joints = ({n: getattr(y, n) for n in UNKNOWN} for y in found)
    return tuple(replace(x, **y) for x, y in zip(EIGHT, joints, strict=True))


def errors_of(result: dr.Result, truth: Mapping[str, float]) -> str:
    """Median and largest errors, and coverage of intervals."""
    wide = result.intervals()
    known = [n for n in truth if np.isfinite(wide[n]).all()]
    percent = [100.0 * abs(result.parameters[n] / truth[n] - 1.0) for n in known if truth[n]]
    sigmas = [abs(result.parameters[n] - truth[n]) / max(result.standard_errors[n], 1e-300) for n in known]
    inside = sum(wide[n][0] <= truth[n] <= wide[n][1] for n in known)
    worst = known[int(np.argmax(sigmas))]
    text = f"{inside} of {len(truth)} inside, {len(truth) - len(known)} not identifiable"
    return (
        f"{text}; errors {np.median(percent):.2g} % in the median, {max(percent):.3g} % and "
        f"{max(sigmas):.1f} standard errors ({worst}) at most"
    )


def identified(model: dr.Model, log: dr.Log, truth: Mapping[str, float], method: str) -> str:
    """A line on one method: processor seconds, verdict or refusal, errors."""
    begin = time.process_time()
    try:
        result = dr.identify(model, log, method, differentiate=True)
    except dr.DiransacError as error:
        return f"{time.process_time() - begin:.1f} s, refused: {error}"
    seconds = time.process_time() - begin
    return f"{seconds:.1f} s, {result.verdict}; {errors_of(result, truth)}"


def main() -> None:
    """Print two lines per variant and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variants", nargs="*", metavar="VARIANT", help=", ".join(VARIANTS))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--from", type=int, default=0, dest="first")
    parser.add_argument("--methods", nargs="+", default=["ols", "lo-diransac"])
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path, true_path = (Path(folder) / f"{name}.xml" for name in ("description", "machine"))
        path.write_text(mjcf(EIGHT))
        for name in given.variants or VARIANTS:
            variant = VARIANTS[name]
            model = model_of(variant, path)
            for seed in range(given.first, given.first + given.seeds):
                true_path.write_text(mjcf(machine(variant, seed)))
                log, gains = machine_log(variant, true_path, seed)
                truth = {n: float(p.value or 0.0) for n, p in model_of(variant, true_path).parameters.items()}
                truth |= (
                    {f"torque_gain_{n}": x for n, x in zip(NAMES, gains.tolist(), strict=True)}
                    if ("torque_gain" in variant.unknown)
                    else {}
                )
                for method in given.methods:
                    print(f"{name}, seed {seed}, {method}: {identified(model, log, truth, method)}", flush=True)


if __name__ == "__main__":
    main()
