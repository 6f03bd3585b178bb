"""Models of robots from their description files."""

from diransac.model.robots.actuation import Actuation, JointTorques, MotorCurrents, PositionControl, drive_forces
from diransac.model.robots.robot import body_position, coordinates_of_bodies, robot, robot_limits

__all__ = [
    "Actuation", "JointTorques", "MotorCurrents", "PositionControl", "body_position", "coordinates_of_bodies",
    "drive_forces", "robot", "robot_limits",
]  # fmt: skip
