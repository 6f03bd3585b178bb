#!/usr/bin/env bash
# MuJoCo 4.0.0: MjSpec reads a file by its ending, MjModel by its content.
#
# Guess: MjSpec.from_file and MjModel.from_xml_path read the same files.
# Is:    the second reads "robot.mjcf" and "robot.XML"; for the first they are resources without a decoder.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/env"
"$folder/env/bin/pip" install --quiet --disable-pip-version-check mujoco==4.0.0
"$folder/env/bin/python" - <<'EOF'
import tempfile
from pathlib import Path

import mujoco

TEXT = '<mujoco><worldbody><body><joint/><geom size=".1"/></body></worldbody></mujoco>'
folder, found = Path(tempfile.mkdtemp()), {}
for name in ("robot.xml", "robot.mjcf", "robot.XML"):
    (folder / name).write_text(TEXT)
    mujoco.MjModel.from_xml_path(str(folder / name))
    try:
        mujoco.MjSpec.from_file(str(folder / name))
        found[name] = "read"
    except ValueError as error:
        found[name] = "no decoder" if "decoder" in str(error) else str(error)
print("MuJoCo", mujoco.__version__)
print("MjModel reads all three; MjSpec:", found)
assert mujoco.__version__ == "4.0.0"
assert found == {"robot.xml": "read", "robot.mjcf": "no decoder", "robot.XML": "no decoder"}
EOF
