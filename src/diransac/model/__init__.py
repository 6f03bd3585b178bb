"""Models: equations of motion written once, what is derived from them, and plants.

In come equations by a user or a robot's description; out comes a `Model` with its regressor, dynamics and derivatives
as CasADi functions, which everything else takes.  Begin with `model.py`.

| file | contents |
|---|---|
| `model.py`, `signals.py` | `Model`; its names, units and sizes |
| `parameter.py`, `sensors.py` | `Parameter`; `Sensor`, and those of common instruments |
| `derivation.py`, `expressions.py` | checks and symbolic parts of equations; expression graphs as plain data |
| `plant.py` | `Plant`, a model with parameters, and `Disturbance` |
| `held.py` | constants of a description that a model holds |
| `parts.py` | independent parts of a model, such as limbs |
| `library/` | the built-in models |
| `robots/` | models from MJCF and URDF |
| `mjcf/` | what MuJoCo simulates: contacts, free bases, loops |
"""

from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.plant import Disturbance, Plant
from diransac.model.sensors import Sensor

__all__ = ["Disturbance", "Model", "Parameter", "Plant", "Sensor"]
