#!/usr/bin/env bash
# MuJoCo 4.0.0: a file that MjSpec saves compiles to other masses where it has settotalmass and boundmass.
#
# Guess: MjSpec.to_xml() saves a text that compiles to the model that was saved.
# Is:    masses are saved as they were after the total was set, with boundmass beside them, which bounds them once more.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import warnings

import mujoco

warnings.simplefilter("ignore")
TEXT = """<mujoco><compiler settotalmass="2" boundmass="0.9"/><worldbody><body><joint/><geom size=".1"/>
  <body pos="0 0 1"><joint/><inertial pos="0 0 0" mass=".3" diaginertia=".01 .01 .01"/></body></body></worldbody></mujoco>"""
spec = mujoco.MjSpec.from_string(TEXT)
first = spec.compile().body_mass[1:].round(3).tolist()
again = mujoco.MjModel.from_xml_string(spec.to_xml()).body_mass[1:].round(3).tolist()
print("MuJoCo", mujoco.__version__)
print("masses compiled, and compiled from what was saved:", first, again)
assert mujoco.__version__ == "4.0.0" and sum(first) == 2.0 and min(first) < 0.4 and first != again
EOF
