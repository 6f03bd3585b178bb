#!/usr/bin/env bash
# MuJoCo 4.0.0: stiffness and damping by springdamper change when another body gets a joint.
#
# Guess: springdamper="1 1" gives a joint the stiffness and damping of its own link, a property of the joint.
# Is:    both come from the inertia that the whole mechanism shows at the joint: with a free joint on the base, the same arm's
#        spring is a ninth as stiff, so that fixing a robot's base for a test changes its springs.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><worldbody><body>{}<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .01"/>
  <body pos=".4 0 0"><joint name="j" axis="0 1 0" springdamper="1 1"/>
  <inertial pos=".2 0 0" mass="1" diaginertia=".01 .01 .01"/></body></body></worldbody></mujoco>"""

print("MuJoCo", mujoco.__version__)
found = {}
for base in ("fixed", "free"):
    model = mujoco.MjModel.from_xml_string(TEXT.format("<freejoint/>" if base == "free" else ""))
    found[base] = round(float(model.joint("j").stiffness[0]), 6), round(float(model.joint("j").damping[0]), 6)
print("stiffness and damping of j by base:", found)
assert mujoco.__version__ == "4.0.0" and found == {"fixed": (0.05, 0.1), "free": (0.0055, 0.011)}
EOF
