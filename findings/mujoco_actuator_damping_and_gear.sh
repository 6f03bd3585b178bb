#!/usr/bin/env bash
# MuJoCo 4.0.0: polynomial damping of an actuator scales with gear^2 in every order.
#
# Guess: an actuator's damping="0 0 d2" is a force d2 w^3 at its own speed w = gear v, so that the joint feels
#        gear^4 d2 v^3.
# Is:    the joint feels gear^2 d2 v^3: higher orders are in the speed of the joint, scaled by the square of the gear alone.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j"/>
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body></worldbody>
  <actuator><motor joint="j" gear="10" damping="{}"/></actuator></mujoco>"""


def drag(coefficients, v):
    model = mujoco.MjModel.from_xml_string(TEXT.format(coefficients))
    data = mujoco.MjData(model)
    data.qvel[0] = v
    mujoco.mj_forward(model, data)
    return -round(float(data.qfrc_passive[0]), 6)


print("MuJoCo", mujoco.__version__)
found = {c: drag(c, 2.0) for c in ("0.001", "0 0.001", "0 0 0.001")}
print("drag of the joint at 2 rad/s behind a gear of 10:", found)
assert mujoco.__version__ == "4.0.0" and list(found.values()) == [0.2, 0.4, 0.8]  # not 0.2, 4, 80
EOF
