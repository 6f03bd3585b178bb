#!/usr/bin/env bash
# MuJoCo 4.0.0: springdamper silently replaces a stiffness and a damping that the same joint states.
#
# Guess: an explicit stiffness and damping are the joint's; springdamper fills in what is not given, as a default class would.
# Is:    both stated values are dropped without a warning, also where springdamper comes from a class and the joint itself
#        states the others; springdamper="0 0" brings them back.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><default><joint {}/></default><worldbody><body>
  <joint axis="0 1 0" stiffness="3" damping="4" {}/><geom size=".1"/></body></worldbody></mujoco>"""


def compiled(of_class, own):
    model = mujoco.MjModel.from_xml_string(TEXT.format(of_class, own))
    return round(float(model.jnt_stiffness[0]), 3), round(float(model.dof_damping[0]), 3)


print("MuJoCo", mujoco.__version__)
plain, by_class = compiled("", ""), compiled('springdamper=".1 .5"', "")
zero = compiled('springdamper=".1 .5"', 'springdamper="0 0"')
print("stiffness and damping stated, with a class, with zero:", plain, by_class, zero)
assert mujoco.__version__ == "4.0.0" and plain == zero == (3.0, 4.0) and by_class == (6.702, 0.335)
EOF
