"""Models: equations of motion written once, what is derived from them, and plants."""

from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.plant import Disturbance, Plant
from diransac.model.sensors import Sensor

__all__ = ["Disturbance", "Model", "Parameter", "Plant", "Sensor"]
