"""Models of robots from their description files.

In comes an MJCF or URDF file; out comes a `Model` with equations, and after identification the file with other values.
Begin with `robot.py`.

| file | contents |
|---|---|
| `robot.py` | `robot` |
| `compiled.py`, `inertias.py` | files in MuJoCo, read and compiled; inertias that no body can have |
| `description.py` | bodies and joints of a compiled file |
| `formats.py`, `sizes.py` | formats that are not read, and velocity limits; limits of a file's size |
| `rigid_body.py`, `mechanism.py`, `actuation.py` | inverse dynamics; forces of joints; forces of drives |
| `reference.py` | forces of the equations against those of MuJoCo |
| `calibration.py`, `consistency.py` | estimates in the file; possible bodies for base parameters |
| `fields.py` | attributes of elements, and the entries of MuJoCo's compiled model that they hold |
| `document.py`, `written.py` | the file's text; a text that MuJoCo compiles to a given model |
"""

from diransac.model.robots.actuation import Actuation, JointTorques, MotorCurrents, PositionControl, drive_forces
from diransac.model.robots.robot import body_position, coordinates_of_bodies, robot, robot_limits

__all__ = [
    "Actuation", "JointTorques", "MotorCurrents", "PositionControl", "body_position", "coordinates_of_bodies",
    "drive_forces", "robot", "robot_limits",
]  # fmt: skip
