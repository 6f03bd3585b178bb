#!/usr/bin/env bash
# MuJoCo 4.0.0: a rod is possible by diaginertia and not by fullinertia, also where it cannot move.
#
# Guess: diaginertia="1 1 0" and fullinertia="1 1 0 0 0 0" are the same body; of a body that is fixed to the world neither matters.
# Is:    the first compiles, the second is refused for its eigenvalue of zero, welded to the world as it is.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><worldbody><body><inertial pos="0 0 0" mass="1" {}/></body>
  <body><joint/><geom size=".1"/></body></worldbody></mujoco>"""


def said(inertia):
    try:
        mujoco.MjModel.from_xml_string(TEXT.format(inertia))
    except ValueError as error:
        return str(error).splitlines()[0]
    return "compiled"


print("MuJoCo", mujoco.__version__)
found = said('diaginertia="1 1 0"'), said('fullinertia="1 1 0 0 0 0"')
print("a fixed rod by diaginertia, by fullinertia:", *found, sep="\n  ")
assert mujoco.__version__ == "4.0.0" and found[0] == "compiled" and "positive eigenvalues" in found[1]
EOF
