"""Models of robots from their description files."""

from diransac.model.robots.actuation import Actuation, JointTorques, MotorCurrents, PositionControl
from diransac.model.robots.robot import robot

__all__ = ["Actuation", "JointTorques", "MotorCurrents", "PositionControl", "robot"]
