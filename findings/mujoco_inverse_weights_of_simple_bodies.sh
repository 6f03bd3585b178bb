#!/usr/bin/env bash
# MuJoCo 4.0.0: body_invweight0 of a body on one slide depends on a shortcut of the compiler.
#
# Guess: shortcuts for bodies whose frames are aligned (body_simple, dof_simplenum) save time and change no number.
# Is:    the inverse weight by which contacts are softened is three times as large with the shortcut as in general.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><worldbody><body><joint type="slide" axis="1 0 0"/><geom size=".1"/></body></worldbody></mujoco>"""
model = mujoco.MjModel.from_xml_string(TEXT)
short = float(model.body_invweight0[1, 0])
model.body_simple[:] = model.dof_simplenum[:] = model.body_sameframe[:] = 0
mujoco.mj_setConst(model, mujoco.MjData(model))
general = float(model.body_invweight0[1, 0])
print("MuJoCo", mujoco.__version__)
print("inverse weight with the shortcut, and without:", round(short, 4), round(general, 4))
assert mujoco.__version__ == "4.0.0" and abs(short / general - 3.0) < 1e-6
EOF
