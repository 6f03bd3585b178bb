#!/usr/bin/env bash
# MuJoCo 4.0.0: actuatorgravcomp compensates only where the model has an actuator, on whichever joint.
#
# Guess: a joint with actuatorgravcomp is compensated by its own actuator's force; what other joints have does not matter.
# Is:    in a model without any actuator nobody compensates the weight; one motor on another joint brings the compensation
#        back, in the force of a joint that has no actuator.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

LINK = '<inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/>'
TEXT = f"""<mujoco><worldbody><body pos="0 1 0"><joint name="other" axis="0 1 0"/>{LINK}</body>
  <body gravcomp="1"><joint name="j" axis="0 1 0" actuatorgravcomp="true"/>{LINK}</body></worldbody>{{}}</mujoco>"""


def compensation(actuators):
    model = mujoco.MjModel.from_xml_string(TEXT.format(actuators))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return round(float(data.qfrc_actuator[1] + data.qfrc_passive[1]), 3), round(float(data.qacc[1]), 1)


print("MuJoCo", mujoco.__version__)
none, elsewhere = compensation(""), compensation('<actuator><motor joint="other"/></actuator>')
print("force on j and its acceleration, no actuator:     ", none)
print("force on j and its acceleration, one on the other:", elsewhere)
assert mujoco.__version__ == "4.0.0" and none == (0.0, 39.2) and elsewhere == (-1.962, 0.0)
EOF
