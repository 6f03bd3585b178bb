"""Built-in models, `robot` for models from description files, and `builtin`, which returns a model by name.

| file | models |
|---|---|
| `drives.py` | servo axis, direct-current motor, flexible joint |
| `pendulums.py` | cart-pole, double pendulum |
| `rotorcraft.py`, `quadrotor.py` | planar rotorcraft, with and without effects of its rotors; multirotors |
| `vehicles.py` | underwater vehicle, single-track car, differential drive |
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from diransac.errors import ModelError
from diransac.model.library.drives import dc_motor, flexible_joint, servo_axis
from diransac.model.library.pendulums import cart_pole, double_pendulum
from diransac.model.library.quadrotor import quadrotor
from diransac.model.library.rotorcraft import BLADE_FLAPPING, TABLE_I, extended_rotorcraft, planar_rotorcraft
from diransac.model.library.vehicles import differential_drive, single_track_vehicle, underwater_vehicle

if TYPE_CHECKING:
    from collections.abc import Callable

    from diransac.model.mjcf import mujoco
    from diransac.model.model import Model
    from diransac.model.robots import body_position, coordinates_of_bodies, drive_forces, robot, robot_limits

__all__ = [
    "BLADE_FLAPPING", "BUILTIN", "TABLE_I", "body_position", "builtin", "cart_pole", "coordinates_of_bodies",
    "dc_motor", "differential_drive", "double_pendulum", "drive_forces", "extended_rotorcraft", "flexible_joint",
    "mujoco", "planar_rotorcraft", "quadrotor", "robot", "robot_limits", "servo_axis", "single_track_vehicle",
    "underwater_vehicle",
]  # fmt: skip

BUILTIN: dict[str, Callable[[], Model]] = {
    "planar-rotorcraft": planar_rotorcraft,
    "servo-axis": servo_axis,
    "underwater-vehicle": underwater_vehicle,
    "double-pendulum": double_pendulum,
    "cart-pole": cart_pole,
    "flexible-joint": flexible_joint,
    "dc-motor": dc_motor,
    "differential-drive": differential_drive,
    "single-track-vehicle": single_track_vehicle,
    "quadrotor": quadrotor,
}


def __getattr__(name: str) -> Any:
    """Functions that read descriptions of robots, imported at their first use."""
    if name not in ("body_position", "coordinates_of_bodies", "drive_forces", "mujoco", "robot", "robot_limits"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from diransac.model import mjcf, robots

    globals()[name] = found = getattr(mjcf if name == "mujoco" else robots, name)
    return found


def builtin(name: str) -> Model:
    """Built-in model by name, such as ``planar-rotorcraft`` or ``planar_rotorcraft``.

    Raises
    ------
    ModelError
        There is no such model.
    """
    key = name.replace("_", "-")
    if key not in BUILTIN:
        raise ModelError(f'there is no built-in model "{name}"; there are {", ".join(BUILTIN)}, or give file.py[:name]')
    return BUILTIN[key]()
