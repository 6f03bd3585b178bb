"""Text of a description, beside what MuJoCo reads of it: its format, and limits of velocities of a URDF."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

import numpy as np

from diransac.errors import ModelError

_NOTHING = {
    "mass": '<mass value="0"/>',
    "inertia": '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>',
}
_REMEDIES = {
    "sdf": "is SDF, which is not read here; give the URDF or MJCF of the robot",
    "mujocoinclude": "is a part that MJCF files include; give the file that includes it",
}


@dataclass
class Outline:
    """Format of a description, and what MuJoCo does not read of its text.

    Parameters
    ----------
    root : str
        Name of the outermost element; empty for text that is no XML.
    has_macros : bool
        Whether there are elements or values of Xacro.
    velocity_limits : dict of str to float
        Of joints of a URDF, by name, rad/s or m/s; those that are positive.
    gaps : dict of int to str
        What inertials of a URDF lack, a mass or an inertia of zero, by the place in the text, in bytes.
    """

    root: str = ""
    has_macros: bool = False
    velocity_limits: dict[str, float] = field(default_factory=dict)
    gaps: dict[int, str] = field(default_factory=dict)

    def completed(self, source: bytes) -> bytes:
        """The text with what inertials lack, without which MuJoCo does not read them."""
        parts, at = list[bytes](), 0
        for place, text in self.gaps.items():
            parts += [source[at:place], text.encode()]
            at = place
        return b"".join([*parts, source[at:]])


def outline(source: bytes) -> Outline:
    """Outline of a description; of text that is no XML, up to where it is.

    Parameters
    ----------
    source : bytes
        Text that `check_description` lets pass.
    """
    found, joints, parts = Outline(), [""], set[str]()

    def start(name: str, attributes: Mapping[str, str]) -> None:
        found.root = found.root or name
        if found.root == "robot":
            found.has_macros |= name.startswith("xacro:") or any(
                "${" in x or ("$(" in x and key != "filename") for key, x in attributes.items()
            )
        if name == "joint":
            joints[0] = attributes.get("name", "")
        elif name == "limit" and found.root == "robot" and (limit := _positive(attributes.get("velocity", ""))):
            found.velocity_limits[joints[0]] = limit
        parts.add(name)
        if name == "inertial":
            parts.clear()

    def end(name: str) -> None:
        missing = "".join(text for part, text in _NOTHING.items() if part not in parts)
        if name == "inertial" and found.root == "robot" and missing:
            found.gaps[parser.CurrentByteIndex] = missing

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, end
    with suppress(expat.ExpatError, ValueError):  # of encodings that it does not know
        parser.Parse(source, True)
    return found


def check_format(found: Outline, path: str | Path, label: str) -> None:
    """Raise ModelError where a description is of a format that MuJoCo does not read, with what to do."""
    if found.has_macros:
        name = Path(path).name
        target = name.removesuffix(".xacro").removesuffix(".urdf") + (
            "-expanded.urdf" if name.endswith(".urdf") else ".urdf"
        )
        raise ModelError(f"{label} has macros of Xacro; expand them: xacro {name} > {target}")
    if found.root in _REMEDIES:
        raise ModelError(f"{label} {_REMEDIES[found.root]}")


def _positive(text: str) -> float:
    """The number in a text; 0 if it is none, or not positive and finite."""
    try:
        number = float(text)
    except ValueError:
        return 0.0
    return number if 0.0 < number < np.inf else 0.0
