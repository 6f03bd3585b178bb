#!/usr/bin/env bash
# MuJoCo 4.0.0: polynomial stiffness and polynomial damping of a joint have different parity.
#
# Guess: stiffness="k0 k1 k2" acts as damping="d0 d1 d2" does, odd in its argument: k0 x + k1 |x| x + k2 x^3.
# Is:    damping is odd, stiffness is the plain polynomial k0 x + k1 x^2 + k2 x^3: its second term pushes the same way on
#        both sides of the rest position, so that a stiffening spring softens on one side.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" {}/>
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody></mujoco>"""


def passive(attribute, q, v):
    model = mujoco.MjModel.from_xml_string(TEXT.format(attribute))
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = q, v
    mujoco.mj_forward(model, data)
    return round(float(data.qfrc_passive[0]), 6)


print("MuJoCo", mujoco.__version__)
damper = [passive('damping="5 2 1"', 0.0, v) for v in (-0.5, 0.5)]
spring = [passive('stiffness="5 2 1"', x, 0.0) for x in (-0.5, 0.5)]
print("damping   at v = -0.5, 0.5:", damper)
print("stiffness at x = -0.5, 0.5:", spring)
assert mujoco.__version__ == "4.0.0" and damper == [3.125, -3.125] and spring == [2.125, -3.125]
EOF
