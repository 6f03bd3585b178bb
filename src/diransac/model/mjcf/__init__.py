"""Models that MuJoCo simulates: any MJCF, with free bases, contacts, tendons and closed loops.

In come a file and masks of what is unknown in it, `mujoco`; out comes a `MujocoModel`, which has the names, units and
bounds of a `Model`, but no equations: identification asks its simulator alone.  Begin with `model.py`.

| file | contents |
|---|---|
| `model.py` | `mujoco`, and `MujocoModel` |
| `description.py` | the file as MuJoCo compiles it, without what is only looked at; names of its signals |
| `masks.py` | unknown parameters by mask: places in MuJoCo's compiled model |
| `calibration.py` | estimates in the text of the file |
"""

from diransac.model.mjcf.calibration import calibrated_text
from diransac.model.mjcf.model import MujocoModel, mujoco

__all__ = ["MujocoModel", "calibrated_text", "mujoco"]
