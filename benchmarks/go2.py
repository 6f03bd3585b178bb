"""A real Unitree Go2, hanging, from joint positions and targets: parameters, and open-loop errors in MuJoCo.

Each leg's armature, damping and friction are identified from the first half of the record by lo-diransac, by least
squares of differentiated signals, and by mujoco.sysid (pip install 'mujoco[sysid]'), and are compared with the values
in the description. Every set of parameters then drives MuJoCo through both halves with the recorded targets; errors on
other legs' records are those of one leg's parameters in another leg's model.

``python benchmarks/go2.py [FL FR RL RR]``
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import diransac as dr

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "unitree_go2"
PARTS, KP, KD, DT, STEPS = ("hip", "thigh", "calf"), 20.0, 1.5, 0.005, 5
KINDS = {"armature": "armature", "damping": "damping", "friction": "frictionloss"}


def read() -> dr.Log:
    """The record: positions and targets of twelve joints at 200 Hz."""
    return dr.read_log(DATA / "traj_0.parquet", rename={"t": "time"})


def model_of(leg: str) -> dr.Model:
    """Model of a leg under position control."""
    joints = {f"{leg}_{part}": f"{leg}_{part}_joint" for part in PARTS}
    control = dr.PositionControl(kp=KP, kd=KD, target="des_{}")
    return dr.models.robot(DATA / "go2.xml", joints=joints, unknown=tuple(KINDS), actuation=control)


def alone(leg: str) -> mujoco.MjSpec:
    """Description of a leg without the others."""
    spec = mujoco.MjSpec.from_file(str(DATA / "go2.xml"))
    for other in {"FL", "FR", "RL", "RR"} - {leg}:
        spec.delete(spec.body(f"{other}_hip"))
    spec.option.timestep = DT / STEPS
    return spec


# ---------------------------------------------------------------------- identification


def described(leg: str, _log: dr.Log) -> tuple[np.ndarray, float, dr.Result | None]:
    """Values of the description."""
    return np.array([x.value for x in model_of(leg).parameters.values()]), 0.0, None


def least_squares(leg: str, log: dr.Log) -> tuple[np.ndarray, float, dr.Result | None]:
    """Least squares of filtered derivatives."""
    result = dr.identify(model_of(leg), log, "ols", differentiate=True)
    return np.array(list(result.parameters.values())), 0.0, result


def lo_diransac(leg: str, log: dr.Log) -> tuple[np.ndarray, float, dr.Result | None]:
    """lo-diransac, with the delay of the targets that it finds."""
    result = dr.identify(model_of(leg), log, differentiate=True)
    delay = result.diagnosis.input_delay if result.diagnosis.input_delay_significant else 0.0
    return np.array(list(result.parameters.values())), delay, result


def sysid(leg: str, log: dr.Log) -> tuple[np.ndarray, float, dr.Result | None]:
    """mujoco.sysid: nonlinear least squares of one rollout, from the values of the description."""
    from mujoco import sysid as tool

    spec, names = alone(leg), [f"{leg}_{part}" for part in PARTS]
    for name in names:
        servo = spec.add_actuator(name=name, target=f"{name}_joint", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=KP, kv=KD)
        spec.add_sensor(
            name=f"{name}_position",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=f"{name}_joint",
        )
    model, t = spec.compile(), log.time - log.time[0]
    held = np.column_stack([log[f"des_{name}"] for name in names]).repeat(STEPS, axis=0)
    control = tool.TimeSeries(np.arange(len(held)) * DT / STEPS, held)
    positions, velocities = start(leg, log)
    sensors = tool.TimeSeries.from_names(t, np.column_stack([log[name] for name in names]), model)
    initial = tool.create_initial_state(model, positions, velocities, np.zeros(0))
    parameters = tool.ParameterDict()
    for name, value in zip(model_of(leg).parameters, described(leg, log)[0], strict=True):
        kind, _, joint = name.partition("_")

        def modify(spec: Any, parameter: Any, joint: str = f"{joint}_joint", attribute: str = KINDS[kind]) -> None:
            """Set an attribute of a joint."""
            number = float(parameter.value[0])
            old = getattr(spec.joint(joint), attribute)
            setattr(spec.joint(joint), attribute, [number, 0.0, 0.0] if np.size(old) > 1 else number)

        parameters.add(tool.Parameter(name, nominal=value, min_value=1e-5, max_value=3.0, modifier=modify))
    sequences = tool.ModelSequences(leg, spec, "record", initial, control, sensors)
    found, _ = tool.optimize(
        initial_params=parameters, residual_fn=tool.build_residual_fn(models_sequences=[sequences]), verbose=False
    )
    return found.as_vector(), 0.0, None


METHODS = {"description": described, "ols": least_squares, "mujoco.sysid": sysid, "lo-diransac": lo_diransac}


# ---------------------------------------------------------------------- open loop


def start(leg: str, log: dr.Log) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities at the beginning of a log."""
    t, names = log.time[:9] - log.time[0], [f"{leg}_{part}" for part in PARTS]
    lines = np.array([np.polyfit(t, log[name][:9], 2) for name in names])
    return lines[:, 2], lines[:, 1]


def open_loop_error(leg: str, log: dr.Log, values: np.ndarray, delay: float, sharp: bool) -> float:
    """RMS error of the three joints, degrees, of MuJoCo under the recorded targets; NaN of impossible joints.

    Sharp dry friction is that of diransac's models; otherwise MuJoCo's default holds, which is softer.
    """
    if (values < 0.0).any():
        return np.nan
    model = alone(leg).compile()
    model.dof_armature[:], model.dof_damping[:], model.dof_frictionloss[:] = values.reshape(3, 3).T
    if sharp:
        model.dof_solref[:, 0] = 2.0 * model.opt.timestep
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start(leg, log)
    names = [f"{leg}_{part}" for part in PARTS]
    measured, targets = (np.column_stack([log[f"{x}{n}"] for n in names]) for x in ("", "des_"))
    late, error = round(delay / DT * STEPS), 0.0
    for k in range(len(measured)):
        error += np.sum((data.qpos - measured[k]) ** 2)
        for j in range(STEPS):
            row = max(0, (STEPS * k + j - late) // STEPS)
            data.qfrc_applied[:] = KP * (targets[row] - data.qpos) - KD * data.qvel
            mujoco.mj_step(model, data)
    return float(np.degrees(np.sqrt(error / measured.size)))


def main() -> None:
    """Print a table of parameters and one of errors."""
    legs, log = sys.argv[1:] or ["FL", "FR", "RL", "RR"], read()
    middle = 0.5 * (log.time[0] + log.time[-1])
    halves = log.between(log.time[0], middle), log.between(middle + 0.5 * DT, log.time[-1])
    print("| leg | method | " + " | ".join(f"{k} {p}" for p in PARTS for k in KINDS) + " | delay, ms | s |")
    found: dict[tuple[str, str], tuple[np.ndarray, float]] = {}
    for leg in legs:
        for name, method in METHODS.items():
            begin = time.perf_counter()
            try:
                values, delay, result = method(leg, halves[0])
            except dr.DiransacError as error:
                print(f"| {leg} | {name} | {error} |")
                continue
            seconds, found[leg, name] = time.perf_counter() - begin, (values, delay)
            widths = [""] * 9 if result is None else [f" ± {0.5 * (b - a):.2g}" for a, b in result.intervals().values()]
            cells = " | ".join(f"{x:.3g}{width}" for x, width in zip(values, widths, strict=True))
            print(f"| {leg} | {name} | {cells} | {1e3 * delay:.1f} | {seconds:.1f} |", flush=True)
    print("\n| leg | method | first half | second half | second halves of the other legs |")
    for (leg, name), (values, delay) in found.items():
        sharp, others = name in ("ols", "lo-diransac"), [x for x in legs if x != leg]
        errors = [open_loop_error(leg, half, values, delay, sharp) for half in halves]
        elsewhere = [open_loop_error(other, halves[1], values, delay, sharp) for other in others]
        print(
            f"| {leg} | {name} | {errors[0]:.2f} | {errors[1]:.2f} | {', '.join(f'{x:.2f}' for x in elsewhere)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
