#!/usr/bin/env bash
# MuJoCo 4.0.0: without springs and dampers there is no gravity compensation and no drag of a fluid.
#
# Guess: the flags spring and damper take out springs and dampers; gravcomp and the surrounding fluid are neither, and stay.
# Is:    each flag alone leaves them; both together end all passive forces: a compensated arm falls, and water has no drag.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><option density="{}"><flag {}/></option><worldbody><body gravcomp="1"><joint axis="0 1 0"/>
  <inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/></body></worldbody></mujoco>"""
FLAGS = ("", 'spring="disable"', 'damper="disable"', 'spring="disable" damper="disable"')


def passive(density, flags, v):
    model = mujoco.MjModel.from_xml_string(TEXT.format(density, flags))
    data = mujoco.MjData(model)
    data.qvel[0] = v
    mujoco.mj_forward(model, data)
    return round(float(data.qfrc_passive[0]), 3)


print("MuJoCo", mujoco.__version__)
weight = [passive(0, flags, 0.0) for flags in FLAGS]
drag = [round(passive(1000, flags, 3.0) - w, 3) for flags, w in zip(FLAGS, weight)]
print("compensated weight:", weight)
print("drag of water:     ", drag)
assert mujoco.__version__ == "4.0.0" and weight == [-1.962, -1.962, -1.962, 0.0]
assert drag[0] < -1.0 and drag[3] == 0.0
EOF
