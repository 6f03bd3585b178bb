"""Example of a user-defined model, for ``diransac identify LOG --model examples/my_axis.py``."""

from casadi import sign

from diransac import Model, Parameter

model = Model(
    name="my-axis",
    coordinates={"position": "m"},
    inputs={"force": "N"},
    parameters={"mass": Parameter("kg"), "fv": Parameter("N s/m"), "fc": Parameter("N"), "f0": Parameter("N")},
    equations=lambda q, v, a, u, p: [
        p.mass * a.position + p.fv * v.position + p.fc * sign(v.position) + p.f0 - u.force
    ],
)
