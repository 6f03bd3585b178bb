"""Descriptions of robots in MuJoCo: read, repaired, and compiled; what of a file is not needed for that is dropped."""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from uuid import uuid4

import numpy as np

from diransac.errors import ModelError
from diransac.model.robots.formats import Outline, check_format, outline
from diransac.model.robots.inertias import THIN, Flaw, gives_inertia, repair
from diransac.model.robots.sizes import check_description
from diransac.process import module_path_safe

_ALONE = threading.Lock()
"""Held while warnings are dropped, which all threads share."""
_FAILURES = (ValueError, RuntimeError, MemoryError)
"""Errors of MuJoCo's reader and compiler."""
_STATES = {
    "TIME", "QPOS", "QVEL", "ACT", "WARMSTART", "CTRL", "QFRC_APPLIED", "XFRC_APPLIED", "EQ_ACTIVE", "MOCAP_POS",
    "MOCAP_QUAT", "USERDATA",
}  # fmt: skip
"""Parts of MuJoCo's state that are those of joints, drives and users."""
_ATTRIBUTES = {"HISTORY": "delays (delay, nsample)", "PLASTIC": "springs that yield (springyield)", "PLUGIN": "plugins"}
"""Attributes from which further parts come."""


def mujoco_module() -> ModuleType:
    """The package `mujoco`, which is imported here alone.

    Raises
    ------
    ModelError
        It is not installed.
    """
    try:
        with module_path_safe():  # glfw, which it imports, starts a process
            import mujoco
    except ImportError as error:
        raise ModelError(
            "descriptions of robots are read by MuJoCo, which is not installed: pip install 'diransac[robots]'"
        ) from error
    return mujoco  # type: ignore[no-any-return]  # without annotations


@dataclass(frozen=True)
class Parsed:
    """A file before it is compiled.

    Parameters
    ----------
    spec : MjSpec
        MuJoCo's editable form, in which all inertias are possible.
    flaws : list of (body of the spec, Flaw)
        Inertias that are not those of the file.
    outline : Outline
        Of the file's text.
    """

    spec: Any
    flaws: list[tuple[Any, Flaw]]
    outline: Outline


def parsed(path: str | Path, text: str | None = None, thin: float = THIN) -> Parsed:
    """A description file in MuJoCo's editable form.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF.
    text : str, optional
        What is read in place of the file's text, as if it stood in the same folder.
    thin : float, optional
        Least second moment of a body over the largest, as of `repair`.

    Raises
    ------
    ModelError
        There is no such file, or it is neither MJCF nor URDF.
    """
    mujoco, label = mujoco_module(), f'robot description "{path}"'
    if not Path(path).is_file():
        raise ModelError(f"{label} does not exist; give an MJCF (.xml) or URDF file")
    check_description(Path(path), label)
    source = Path(path).read_bytes() if text is None else text.encode()
    own = outline(source)
    check_format(own, path, label)
    content = own.completed(source)
    is_read = text is None and content == source and Path(path).suffix in (".xml", ".urdf")  # by MuJoCo, by itself
    try:
        with without_warnings():
            if is_read:
                spec = mujoco.MjSpec.from_file(str(path))
            else:
                name = uuid4().hex + (".urdf" if own.root == "robot" else ".xml")  # of a file that is not there
                spec = mujoco.MjSpec.from_file(str(Path(path).with_name(name)), include={name: content})
    except _FAILURES as error:
        raise unreadable(path, error) from error
    return Parsed(spec, repair(spec, is_urdf=own.root == "robot", thin=thin), own)


def compiled_file(path: str | Path, text: str | None = None, *, bare: bool = False) -> Any:
    """MuJoCo's compiled model of a file, with all of its bodies.

    Parameters
    ----------
    path, text
        As for `parsed`.
    bare : bool, optional
        Without shapes that give no inertia, whose files need not be there.

    Raises
    ------
    ModelError
        The file cannot be read or compiled.
    """
    spec = parsed(path, text).spec
    if bare:
        drop_shapes(spec)
    return compiled(path, spec)


def compiled(path: str | Path, spec: Any) -> Any:
    """MuJoCo's model of its editable form, with all of its bodies."""
    spec.compiler.fusestatic = False
    try:
        with without_warnings():
            return spec.compile()
    except _FAILURES as error:
        raise _missing_mesh(path, spec, error) or unreadable(path, error) from error


@contextmanager
def without_warnings() -> Iterator[None]:
    """Context of one thread at a time in which MuJoCo warns of nothing, neither here nor in MUJOCO_LOG.TXT.

    It warns of what is left out, such as cloth.
    """
    mujoco = mujoco_module()
    with _ALONE, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        before = mujoco.get_mju_user_warning()
        mujoco.set_mju_user_warning(lambda _: None)
        try:
            yield
        finally:
            mujoco.set_mju_user_warning(before)


def unreadable(path: str | Path, error: Exception) -> ModelError:
    """The error of a file that MuJoCo does not read."""
    return ModelError(f'robot description "{path}" cannot be read: {" ".join(str(error).split())}')


def _missing_mesh(path: str | Path, spec: Any, error: Exception) -> ModelError | None:
    """The error of a file of a mesh that is not there and gives a body its inertia; None for another error."""
    missing = re.search(r"opening file '(.*?)'", str(error))
    if missing is None:
        return None
    bodies = list(dict.fromkeys(shape.parent.name or "without a name" for shape in spec.geoms if shape.meshname))
    named = ", ".join(bodies[:5]) + (f" and {len(bodies) - 5} more" if len(bodies) > 5 else "")
    return ModelError(
        f'robot description "{path}": the mesh file "{missing[1]}" does not exist, and bodies without an inertial have '
        f"that of their meshes ({named}); give each an inertial in the description, or the file"
    )


def drop_shapes(spec: Any) -> None:
    """Remove looks, shapes that give no inertia, and what refers to shapes: files of meshes need not be there."""
    mujoco = mujoco_module()
    for element in (*spec.geoms, *spec.sites, *spec.tendons, *spec.flexes):
        element.material = ""
    _delete(spec, spec.pairs, spec.sensors, spec.keys, spec.skins, spec.lights, spec.materials, spec.textures)
    spec.compiler.LRopt.mode = mujoco.mjtLRMode.mjLRMODE_NONE  # lengths of muscles, which MuJoCo simulates
    path = [x.target for tendon in spec.tendons for x in getattr(tendon, "path", ())]
    wrapped = {target.name for target in path if target is not None}  # of a pulley, or of what is not in the file
    _delete(spec, [shape for shape in spec.geoms if shape.name not in wrapped and not _counts(spec, shape)])
    needed = {name for shape in spec.geoms for name in (shape.meshname, shape.hfieldname)}
    _delete(spec, [x for x in (*spec.meshes, *spec.hfields) if x.name not in needed])


def _counts(spec: Any, shape: Any) -> bool:
    """True if a shape gives its body an inertia that has an effect."""
    rule, body = spec.compiler.inertiafromgeom, shape.parent
    if body.explicitinertial and rule != mujoco_module().mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return False
    return gives_inertia(spec, shape) and (_moves(body) or spec.compiler.settotalmass > 0.0)  # which scales all masses


def _moves(body: Any) -> bool:
    """True if joints move a body of MuJoCo's editable form."""
    return body.parent is not None and (bool(list(body.joints)) or _moves(body.parent))


def _delete(spec: Any, *groups: Iterable[Any]) -> None:
    for element in [x for group in groups for x in group]:
        spec.delete(element)


def further_states(model: Any, known: Collection[str] = ()) -> list[str]:
    """Attributes by which a model has states besides positions, velocities, activations and the `known` parts."""
    mujoco, found = mujoco_module(), list[str]()
    for name, part in mujoco.mjtState.__members__.items():
        kind, is_one = name.removeprefix("mjSTATE_"), name != "mjNSTATE" and part.value & (part.value - 1) == 0
        if is_one and kind not in _STATES | set(known) and mujoco.mj_stateSize(model, part.value):
            found.append(_ATTRIBUTES.get(kind, kind))
    return found


def drive_limits(spec: Any) -> dict[str, tuple[float, float]]:
    """Range of the force that the actuators of a joint exert, by its name."""
    mujoco = mujoco_module()
    found: dict[str, tuple[float, float]] = {}
    for drive in spec.actuators:
        if drive.trntype != mujoco.mjtTrn.mjTRN_JOINT:
            continue
        ranges = [np.array(drive.forcerange)]
        if drive.gaintype == mujoco.mjtGain.mjGAIN_FIXED and drive.biastype == mujoco.mjtBias.mjBIAS_NONE:
            ranges.append(np.array(drive.ctrlrange) * drive.gainprm[0])
        for force in (np.sort(x * drive.gear[0]) for x in ranges if np.ptp(x) > 0.0):
            low, high = found.get(drive.target, (-np.inf, np.inf))
            found[drive.target] = max(low, float(force[0])), min(high, float(force[1]))
    return found
