"""Models of robots from their description files."""

from diransac.model.robots.actuation import Actuation, JointTorques, MotorCurrents, PositionControl, drive_forces
from diransac.model.robots.robot import robot, robot_limits

__all__ = ["Actuation", "JointTorques", "MotorCurrents", "PositionControl", "drive_forces", "robot", "robot_limits"]
