"""Model of a Crazyflie's rotor thrust, identifiable from accelerometer and motor commands alone.

The body-z acceleration times the mass equals the thrust of four rotors, each ``k1 w + k2 w^2`` with the command w (0 to
1; 0 to 65535 in the log). The equation has no states, so that no position or velocity is needed.
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
