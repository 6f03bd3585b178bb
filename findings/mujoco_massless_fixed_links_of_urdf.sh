#!/usr/bin/env bash
# MuJoCo 4.0.0: fusing a fixed link of a URDF drops its inertia where its mass is zero.
#
# Guess: fixed links are fused for speed; the robot's dynamics are the same with and without.
# Is:    a rotor's inertia that a description puts on a fixed link without a mass is dropped by fusing, which is what URDFs get.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

INERTIA = '<inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" iyz="0"/>'
LINK = '<link name="{}"><inertial><mass value="{}"/>{}</inertial></link>'
TEXT = (
    '<robot name="r"><link name="base"/>'
    + LINK.format("arm", 1, INERTIA.format(0.1))
    + LINK.format("rotor", 0, INERTIA.format(0.05))
    + '<joint name="j" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>'
    + '<joint name="w" type="fixed"><parent link="arm"/><child link="rotor"/></joint></robot>'
)
found = {}
for fused in (True, False):
    spec = mujoco.MjSpec.from_string(TEXT)
    spec.compiler.fusestatic = fused
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qacc[0] = 1.0
    mujoco.mj_inverse(model, data)
    found[fused] = round(float(data.qfrc_inverse[0]), 6)
print("MuJoCo", mujoco.__version__)
print("inertia at the joint, fused and not:", found)
assert mujoco.__version__ == "4.0.0" and found == {True: 0.1, False: 0.15}
EOF
