#!/usr/bin/env bash
# MuJoCo 4.0.0: elements of Xacro in a URDF are skipped without a word.
#
# Guess: a Xacro file that was not expanded is an error: its macros are no URDF.
# Is:    macros are skipped, and with them the links and joints that they stand for: the robot that is read has fewer.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import mujoco

INERTIAL = '<inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
JOINT = '<joint name="{0}" type="continuous"><parent link="base"/><child link="{0}"/><axis xyz="0 1 0"/></joint>'
TEXT = (
    '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><link name="base"/>'
    f'<link name="left">{INERTIAL}</link>{JOINT.format("left")}'
    f'<xacro:macro name="arm" params="side"><link name="${{side}}">{INERTIAL}</link>{JOINT.format("${side}")}</xacro:macro>'
    '<xacro:arm side="right"/></robot>'
)
model = mujoco.MjModel.from_xml_string(TEXT)
names = [model.joint(k).name for k in range(model.njnt)]
print("MuJoCo", mujoco.__version__)
print("joints of a robot with a left and, by a macro, a right arm:", names)
assert mujoco.__version__ == "4.0.0" and names == ["left"]
EOF
