#!/usr/bin/env bash
# MuJoCo 4.0.0: a thin body that MjSpec saves may not compile again.
#
# Guess: what MjSpec.to_xml() writes, MuJoCo reads.
# Is:    numbers are written with six digits, and A + B >= C is tested without a tolerance: of a flat plate that compiles, the
#        saved text is refused.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

TEXT = """<mujoco><worldbody><body><joint/>
  <inertial pos="0 0 0" mass="1" diaginertia="0.01234564 0.02345674 0.035802379"/></body></worldbody></mujoco>"""
spec = mujoco.MjSpec.from_string(TEXT)
moments = spec.compile().body_inertia[1].tolist()
try:
    mujoco.MjSpec.from_string(spec.to_xml()).compile()
    said = ""
except ValueError as error:
    said = str(error).splitlines()[0]
print("MuJoCo", mujoco.__version__)
print("compiled:", moments, "- saved and compiled again:", said or "read")
assert mujoco.__version__ == "4.0.0" and "A + B >= C" in said
EOF
