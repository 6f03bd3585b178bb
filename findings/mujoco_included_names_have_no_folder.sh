#!/usr/bin/env bash
# MuJoCo 4.0.0: texts given to MjSpec.from_file(include=...) replace files of that name in every folder.
#
# Guess: include={"robot.xml": text} replaces the one file "robot.xml"; "parts/robot.xml" is another file.
# Is:    keys match by the name without its folder: a description that includes a part of its own name in another folder, which
#        reads well from disk, is refused as included twice.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import tempfile
from pathlib import Path

import mujoco

folder = Path(tempfile.mkdtemp())
(folder / "parts").mkdir()
part = '<mujocoinclude><body><joint/><geom size=".1"/></body></mujocoinclude>'
text = '<mujoco><worldbody><include file="parts/robot.xml"/></worldbody></mujoco>'
(folder / "parts" / "robot.xml").write_text(part)
(folder / "robot.xml").write_text(text)
print("MuJoCo", mujoco.__version__)
joints = mujoco.MjSpec.from_file(str(folder / "robot.xml")).compile().njnt
try:
    mujoco.MjSpec.from_file(str(folder / "robot.xml"), include={"robot.xml": text.encode()})
    said = ""
except ValueError as error:
    said = str(error)
print("joints from disk:", joints, "- with the same text given:", said.splitlines()[0] if said else "read")
assert mujoco.__version__ == "4.0.0" and joints == 1 and "already included" in said
EOF
