"""Case of a machine in MuJoCo: a nominal MJCF, a log of the true machine, and true values.

Nothing happens when this file is run; `mujoco_cases` has the machines.  The true machine is the nominal
file recompiled with true values, simulated at its own time step of 2 ms.  Row j of a log holds the state at ``t_j`` and
the sensors at ``t_j`` under the input of the row, which is held until the next row.  Inputs are recorded exactly;
sensors have Gaussian noise, constant biases of the IMU, Bernoulli outliers in every signal and gaps without any sensor.
A delay acts between the recorded targets and the drives: a fraction of a sample mixes two successive targets.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, TypeAlias

import mujoco
import numpy as np

import diransac as dr

Array: TypeAlias = np.ndarray[Any, Any]
Control: TypeAlias = Callable[[int, Any], Array]
DT, MOCAP_ROWS, OUTLIER_SIZE = 0.002, 5, 200.0
"""Time step, s; rows per sample of motion capture; largest error of an outlier in standard deviations of the noise."""
ENCODER, SPEED, GYRO, ACCELEROMETER, POSITION, QUATERNION = 5e-4, 0.02, 0.01, 0.2, 1e-3, 1e-3
"""Standard deviations: rad, rad/s, rad/s, m/s^2, m, and 1, which is 2 mrad of rotation."""
POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
AXES = {1: ("",), 3: ("_x", "_y", "_z"), 4: ("_qw", "_qx", "_qy", "_qz")}
PART = re.compile(r"(?:each:)?(\w+)/(.+)\.(\w+?)(?:\[(\d+)\])?$")


@dataclass(frozen=True)
class Case:
    """A machine, its log and the truth.

    Parameters
    ----------
    name : str
    xml : str                       nominal MJCF
    unknown : tuple of str          masks, as `diransac.models.mujoco` takes them
    actuation : Actuation or None   None: inputs are the controls of the file's actuators
    log : Log
    truth, nominal : dict           true and nominal value of every parameter, SI units
    noise : dict                    standard deviation of every measured column, in its unit
    states : (N, nq + nv)           true positions and velocities, which no method but a baseline may use
    inputs : (N, nu)                controls of `driven`, with the delay
    delay : float                   s, from the recorded targets to the drives
    """

    name: str
    xml: str
    unknown: tuple[str, ...]
    actuation: dr.PositionControl | dr.JointTorques | None
    log: dr.Log
    truth: Mapping[str, float]
    nominal: Mapping[str, float]
    noise: Mapping[str, float]
    states: Array = field(repr=False)
    inputs: Array = field(repr=False)
    delay: float = 0.0


@dataclass(frozen=True)
class Recording:
    """Faults of a recording: probability of an outlier per sample and signal, and whether there are gaps."""

    outliers: float = 0.05
    gaps: bool = True


# ---------------------------------------------------------------------- values, simulation, columns


def elements(spec: mujoco.MjSpec, mask: str) -> list[tuple[Any, str, int]]:
    """Elements of a description that a mask matches, with field and index."""
    kind, pattern, name, index = _parts(mask)
    kinds = {"body": spec.bodies, "joint": spec.joints, "geom": spec.geoms, "tendon": spec.tendons}
    return [(x, name, int(index or 0)) for x in kinds[kind] if fnmatchcase(x.name, pattern)]


def _parts(mask: str) -> tuple[str, str, str, str | None]:
    found = PART.match(mask)
    if found is None:
        raise ValueError(f"mask {mask!r} is not KIND/NAME.FIELD[INDEX]")
    return found[1], found[2], found[3], found[4]


def is_bias(name: str) -> bool:
    """Whether a parameter is a bias of a sensor, which the simulated machine does not have."""
    return name.startswith("sensor/")


def set_values(spec: mujoco.MjSpec, values: Mapping[str, float]) -> None:
    """Write the values of parameters into a description; biases of sensors have no place there."""
    for mask, value in values.items():
        for element, name, index in [] if is_bias(mask) else elements(spec, mask):
            if np.ndim(getattr(element, name)):
                getattr(element, name)[index] = value
            else:
                setattr(element, name, value)


def driven(xml: str, actuation: object, values: Mapping[str, float] | None = None) -> mujoco.MjSpec:
    """Description with values, whose motors follow position targets where the actuation says so."""
    spec = mujoco.MjSpec.from_string(xml)
    set_values(spec, values or {})
    if isinstance(actuation, dr.PositionControl):
        for actuator in spec.actuators:
            actuator.set_to_position(kp=actuation.kp, kv=actuation.kd)
    return spec


def simulated(model: mujoco.MjModel, control: Control, rows: int, settling: int = 0) -> tuple[Array, Array, Array]:
    """States ``(rows, nq + nv)``, controls ``(rows, nu)`` and sensors ``(rows, nsensordata)``.

    ``control(j, data)`` gives the controls of row j; rows before 0 settle and are left out.
    """
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    states, inputs = np.empty((rows, model.nq + model.nv)), np.empty((rows, model.nu))
    readings = np.empty((rows, model.nsensordata))
    for j in range(-settling, rows):
        data.ctrl[:] = control(j, data)
        if j >= 0:
            states[j], inputs[j] = np.concatenate([data.qpos, data.qvel]), data.ctrl
        mujoco.mj_step(model, data)
        if j >= 0:
            readings[j] = data.sensordata
    return states, inputs, readings


def delayed(control: Control, delay: float) -> Control:
    """Control without feedback, later by a time in s; its mean over a time step."""
    whole, part = divmod(delay / DT, 1.0)
    k = int(whole)
    return lambda j, data: (1.0 - part) * control(j - k, data) + (part * control(j - k - 1, data) if part else 0.0)


def columns(model: mujoco.MjModel, states: Array, readings: Array) -> dict[str, Array]:
    """Columns of a log by name from states ``(..., nq + nv)`` and sensors ``(..., nsensordata)``."""
    found: dict[str, Array] = {}
    for j in range(model.njnt):
        name, q, v = model.joint(j).name, model.jnt_qposadr[j], model.nq + model.jnt_dofadr[j]
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
            found |= {f"{name}_{x}": states[..., q + k] for k, x in enumerate(POSE)}
            found |= {f"{name}_{x}": states[..., v + k] for k, x in enumerate(TWIST)}
        else:
            found |= {name: states[..., q], f"{name}_dot": states[..., v]}
    for i in range(model.nsensor):
        first, size = model.sensor_adr[i], model.sensor_dim[i]
        found |= {f"{model.sensor(i).name}{x}": readings[..., first + k] for k, x in enumerate(AXES[int(size)])}
    return found


def recorded(
    rng: np.random.Generator, exact: Mapping[str, Array], noise: Mapping[str, float], recording: Recording
) -> dict[str, Array]:
    """Measured columns: noise, outliers, gaps of 0.1 to 0.3 s, and motion capture (``_x``, ..., ``_qz``) at 100 Hz."""
    rows = len(next(iter(exact.values())))
    lost = np.zeros(rows, dtype=bool)
    for begin in rng.integers(0, rows, size=round(0.4 * rows * DT)):
        lost[begin : begin + round(rng.uniform(0.1, 0.3) / DT)] = recording.gaps
    found = {}
    for name, deviation in noise.items():
        values = exact[name] + deviation * rng.standard_normal(rows)
        wrong = rng.random(rows) < recording.outliers
        values += np.where(wrong, OUTLIER_SIZE * deviation * rng.uniform(-1.0, 1.0, rows), 0.0)
        slow = name.rsplit("_", 1)[-1] in POSE and not name.startswith("imu")
        found[name] = np.where(lost | (slow & (np.arange(rows) % MOCAP_ROWS > 0)), np.nan, values)
    return found


def drawn(
    xml: str, ranges: Mapping[str, tuple[float, float]], rng: np.random.Generator
) -> tuple[dict[str, float], ...]:
    """True values, uniform in their ranges, and nominal ones, which are those of the file; of each match of a mask."""
    spec = mujoco.MjSpec.from_string(xml)
    truth: dict[str, float] = {}
    nominal: dict[str, float] = {}
    for mask, (low, high) in ranges.items():
        if is_bias(mask):
            names = {f"{mask}[{k}]": 0.0 for k in range(3)}
        else:
            kind, _, attribute, index = _parts(mask)
            suffix = attribute if index is None else f"{attribute}[{index}]"
            found = {x.name: float(np.ravel(getattr(x, a))[i]) for x, a, i in elements(spec, mask)}
            each = {f"{kind}/{name}.{suffix}": value for name, value in found.items()}
            names = each if mask.startswith("each:") else {mask: next(iter(found.values()))}
        nominal |= names
        truth |= {name: float(rng.uniform(low, high)) for name in names}
    return truth, nominal


def case_of(
    name: str,
    xml: str,
    ranges: Mapping[str, tuple[float, float]],
    noise: Mapping[str, float],
    control: Callable[[np.random.Generator], Control],
    recording: Recording,
    *,
    seed: int,
    rows: int,
    actuation: dr.PositionControl | dr.JointTorques | None = None,
    fixed: Mapping[str, float] | None = None,
    settling: int = 0,
    delay: float = 0.0,
) -> Case:
    """Case of a file; the first random stream draws values, the second the motion, the third the recording."""
    values, motion, faults = (np.random.default_rng([seed, k]) for k in range(3))
    truth, nominal = drawn(xml, ranges, values)
    truth |= fixed or {}
    model = driven(xml, actuation, truth).compile()
    targets = control(motion)
    states, inputs, readings = simulated(model, delayed(targets, delay), rows, settling)
    exact = columns(model, states, readings)
    for bias, value in truth.items():
        if is_bias(bias):
            sensor, axis = bias.removeprefix("sensor/").split(".bias[")
            exact[sensor + AXES[3][int(axis[0])]] += value
    given = np.array([targets(j, None) for j in range(rows)]) if delay else inputs
    measured = recorded(faults, exact, noise, recording)
    pattern = {dr.PositionControl: "{}_target", dr.JointTorques: "{}_torque"}.get(type(actuation), "{}")
    joints = [model.joint(int(model.actuator_trnid[i, 0])).name for i in range(model.nu)]
    labels = joints if actuation is not None else [model.actuator(i).name for i in range(model.nu)]
    measured |= {pattern.format(label): given[:, i] for i, label in enumerate(labels)}
    log = dr.Log.from_arrays(DT * np.arange(rows), measured, source=f"{name}-{seed}")
    return Case(name, xml, tuple(ranges), actuation, log, truth, nominal, dict(noise), states, inputs, delay)
