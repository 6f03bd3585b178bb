#!/usr/bin/env bash
# MuJoCo 4.0.0: a dcmotor with both nominal and motorconst has the geometric mean of the two constants.
#
# Guess: nominal values of a data sheet are a way to leave out motorconst and resistance; where these are given, they hold.
# Is:    the given resistance holds, but the motor constant becomes sqrt(given * the one that nominal implies).
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>
  <actuator><dcmotor joint="j" {}/></actuator></mujoco>"""


def constants(attributes):
    model = mujoco.MjModel.from_xml_string(TEXT.format(attributes))
    return [round(float(x), 4) for x in model.actuator_gainprm[0, :2]]


print("MuJoCo", mujoco.__version__)
given = constants('motorconst=".1" resistance="3"')
implied = constants('nominal="24 5 100"')
both = constants('motorconst=".1" resistance="3" nominal="24 5 100"')
print("resistance and motor constant, given, implied, both:", given, implied, both)
assert mujoco.__version__ == "4.0.0" and given == [3.0, 0.1] and both == [3.0, 0.1549]  # sqrt(0.1 * 0.24)
EOF
