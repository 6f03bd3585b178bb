"""`mujoco.sysid` in the gauntlet, where ``mujoco[sysid]`` is installed.  Nothing happens when this file is run.

MuJoCo has a servo axis: a slide joint with damping and frictionloss, and a motor with a bias. It has no drag that grows
with thrust, no rotors' inertia across two joints, and a pendulum's length changes its geometry, not a number.
"""

from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np

from diransac import Log, Model
from diransac.data.dataset import bind_log

AXIS = """
<mujoco>
  <option timestep="{dt}" integrator="RK4"/>
  <worldbody><body name="carriage">
    <joint name="position" type="slide" axis="1 0 0" damping="1" frictionloss="1"/>
    <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  </body></worldbody>
  <actuator><general name="motor" joint="position" gainprm="1" biastype="affine"/></actuator>
</mujoco>"""

SETTERS = {
    "mass": lambda spec, p: setattr(spec.body("carriage"), "mass", p.value[0]),
    "viscous_friction": lambda spec, p: spec.joint("position").damping.__setitem__(0, p.value[0]),
    "dry_friction": lambda spec, p: setattr(spec.joint("position"), "frictionloss", p.value[0]),
    "offset": lambda spec, p: spec.actuator("motor").biasprm.__setitem__(0, -p.value[0]),
}


def fitted(model: Model, log: Log, start: dict[str, float]) -> dict[str, float]:
    """Soft-L1 loss of the simulated states in units of their spread, within two decades of the start."""
    import mujoco
    from mujoco import sysid

    if model.name != "servo-axis":
        raise ValueError("MuJoCo has no such parameters")
    spec = mujoco.MjSpec.from_string(AXIS.format(dt=log.dt))
    compiled, seen = spec.compile(), bind_log(model, log)
    first, states = seen.initial_state("robust"), seen.measured[:, : len(model.state)]
    spread = 1.4826 * np.nanmedian(np.abs(states - np.nanmedian(states, axis=0)), axis=0)
    unknown = sysid.ParameterDict()
    for name, value in start.items():
        size = max(abs(value), 1.0)
        nominal, low = (value, -100.0 * size) if name == "offset" else (size, 0.01 * size)
        unknown.add(sysid.Parameter(name, nominal, min_value=low, max_value=100.0 * size, modifier=SETTERS[name]))

    def residual(*_: Any, state: Any, **__: Any) -> tuple[Any, Any, Any]:
        rows = np.rint(state[:, 0] / log.dt).astype(int)  # MuJoCo gives the states after each step
        rows, moved = rows[rows < len(states)], state[rows < len(states), 1:3]
        return np.nan_to_num((moved - states[rows]) / spread), recording, recording

    control = sysid.TimeSeries.from_control_names(log.dt * np.arange(len(seen)), seen.inputs, compiled)
    recording = sysid.TimeSeries.from_custom_map(control.times, states, list(model.state))
    origin = sysid.create_initial_state(compiled, first[:1], first[1:], np.zeros(0))
    sequence = sysid.ModelSequences("axis", spec, "log", origin, control, recording, allow_missing_sensors=True)
    errors = sysid.build_residual_fn(models_sequences=[sequence], modify_residual=residual)
    with redirect_stdout(StringIO()):  # its solver prints every iteration
        found, _ = sysid.optimize(
            initial_params=unknown, residual_fn=errors, optimizer="scipy_parallel_fd", verbose=False,
            loss="soft_l1", x_scale="jac", max_iters=30,
        )  # fmt: skip
    return dict(zip(start, np.asarray(found.as_vector()).tolist(), strict=True))
