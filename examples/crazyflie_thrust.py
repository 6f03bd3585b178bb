"""Motor lag and rotor thrust of a Crazyflie from its motor commands and the accelerometer along its z axis alone.

The thrust of four rotors, each ``k1 w + k2 w^2`` at rest with the command w (0 to 1), follows the commands with a lag.
The accelerometer shows the thrust over the mass; nothing else is measured.
"""

from diransac import Model, Parameter, Sensor

MASS = 0.027

model = Model(
    name="crazyflie-thrust",
    coordinates={},
    first_order={"thrust": "N"},
    inputs={f"m{i}": "1" for i in range(1, 5)},
    parameters={"k1": Parameter("N"), "k2": Parameter("N"), "lag": Parameter("s", positive=True)},
    equations=lambda q, v, a, u, p: [p.lag * a.thrust + v.thrust - sum(p.k1 * w + p.k2 * w**2 for w in u)],
    sensors={"acc": Sensor("m/s^2", lambda q, v, a, u, p: v.thrust / MASS)},
)
