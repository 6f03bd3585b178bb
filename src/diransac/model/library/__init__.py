"""Built-in models, and `builtin`, which returns one by name."""

from collections.abc import Callable

from diransac.errors import ModelError
from diransac.model.library.double_pendulum import double_pendulum
from diransac.model.library.extended_rotorcraft import BLADE_FLAPPING, TABLE_I, extended_rotorcraft
from diransac.model.library.planar_rotorcraft import planar_rotorcraft
from diransac.model.library.servo_axis import servo_axis
from diransac.model.library.underwater_vehicle import underwater_vehicle
from diransac.model.model import Model

__all__ = [
    "BLADE_FLAPPING",
    "BUILTIN",
    "TABLE_I",
    "builtin",
    "double_pendulum",
    "extended_rotorcraft",
    "planar_rotorcraft",
    "servo_axis",
    "underwater_vehicle",
]

BUILTIN: dict[str, Callable[[], Model]] = {
    "planar-rotorcraft": planar_rotorcraft,
    "servo-axis": servo_axis,
    "underwater-vehicle": underwater_vehicle,
    "double-pendulum": double_pendulum,
}


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
