"""Thrust of a Crazyflie's rotors from its accelerometer and its motor commands alone.

The accelerometer's body-z reading times the mass is the thrust of four rotors, each ``k1 w + k2 w^2`` in its command w
(0 to 1; the log has it as 0 to 65535).  Nothing depends on the state, so no position or velocity is needed.
"""

from diransac import Model, Parameter

MASS = 0.027

model = Model(
    name="crazyflie-thrust",
    coordinates={"z": "m"},
    inputs={f"m{i}": "1" for i in range(1, 5)},
    parameters={"k1": Parameter("N"), "k2": Parameter("N")},
    equations=lambda q, v, a, u, p: [MASS * a.z - sum(p.k1 * (w / 65536) + p.k2 * (w / 65536) ** 2 for w in u)],
)
