"""Estimates in the text of an MJCF: the same text but for the values that were identified."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.mjcf.model import write
from diransac.model.robots.compiled import compiled_file
from diransac.model.robots.consistency import consistent_parameters
from diransac.model.robots.document import Document, numbers
from diransac.model.robots.fields import Place, fields_of, names_of, places_of
from diransac.model.robots.sizes import check_description
from diransac.model.robots.written import refresh, written

if TYPE_CHECKING:
    from diransac.model.mjcf.masks import Unknown
    from diransac.model.mjcf.model import MujocoModel

_FAR, _FIXED = 3.0, 1e-3
"""Change to a possible inertia that errors explain, standard errors; change of a given one, of its size."""


def calibrated_text(
    path: str | Path, model: MujocoModel, values: Mapping[str, float], covariance: FloatArray
) -> tuple[str, tuple[str, ...]]:
    """Text of an MJCF with estimates in it, and the parameters that are not in it.

    Inertias that are impossible by their errors are the nearest possible ones (`consistent_parameters`).

    Parameters
    ----------
    path : str or Path
        File from which `mujoco` made the model.
    model : MujocoModel
    values : mapping of str to float
        Estimate of each parameter; NaN where there is none.
    covariance : (n_p, n_p) array

    Returns
    -------
    text : str
        The file's, comments and layout included.
    left_out : tuple of str
        Parameters without an estimate, biases of sensors, and those of actuators that the file does not have.

    Raises
    ------
    ModelError
        The file cannot be read, is a URDF, or has an element in another file; an inertia is impossible beyond its
        errors; or MuJoCo compiles the text to other values, whatever is written.
    """
    label = f'robot description "{path}"'
    if not Path(path).is_file():
        raise ModelError(f"{label} does not exist; give the MJCF from which the model was made")
    check_description(Path(path), label)
    document = Document(Path(path).read_bytes(), label)
    if document.is_urdf:
        raise ModelError(f"{label} is a URDF, which has no place for values of MuJoCo; give an MJCF")
    meant, left_out = compiled_file(path), list[str]()
    for unknown, value in (*model.constants, *((x, values[x.name]) for x in model.unknowns)):
        places = _places(label, meant, unknown) if np.isfinite(value) else []
        write(meant, places, value)
        left_out += [] if places else [unknown.name]
    for name in {name for x in model.unknowns if x.field == "inertia" for _, name in x.elements}:
        body = names_of(meant, "body").index(name)
        meant.body_inertia[body] = _possible_inertia(model, meant.body_inertia[body], name, covariance)
    refresh(meant)
    return written(path, document, meant), tuple(left_out)


def _places(label: str, meant: Any, unknown: Unknown) -> list[Place]:
    """Entries of the file's compiled model that are a parameter's; none where it is of a drive that is not the file's.

    Raises ModelError: an element is not in the file.
    """
    places = list[Place]()
    for kind, name in unknown.elements if unknown.places else ():
        names = names_of(meant, kind)
        if name not in names or not name:
            if kind == "actuator":
                return []
            raise ModelError(f'{label} has no {kind} of the name "{name}"')
        k = names.index(name)
        field = fields_of(meant, kind, k).get(unknown.field)
        if field is None or unknown.index >= len(field.numbers):
            raise ModelError(
                f'{label}: {kind} "{name}" has no {unknown.name.rpartition(".")[2]}, as that of the model has'
            )
        places += places_of(meant, kind, k, field.numbers[unknown.index])
    return places


def _possible_inertia(model: MujocoModel, inertia: FloatArray, name: str, covariance: FloatArray) -> FloatArray:
    """Principal inertias ``(3,)`` of a body, kg m^2, moved by their errors to where the triangle inequality holds."""
    if (inertia.sum() - 2.0 * inertia >= -1e-9 * inertia.sum()).all():
        return inertia
    body = model.compiled.body(name).id
    places = [("body_inertia", (body, axis)) for axis in range(3)]
    entries = np.array([[x in {(p.array, p.index) for p in u.places} for u in model.unknowns] for x in places], float)
    errors = entries @ np.where(np.isfinite(covariance), covariance, 0.0) @ entries.T
    mass, described = model.compiled.body_mass[body], model.compiled.body_inertia[body]
    described = np.array([[mass, 0.0, 0.0, 0.0, *described, 0.0, 0.0, 0.0]])
    found = consistent_parameters(described, np.zeros(0), np.eye(10)[4:7], inertia, errors)[0][0, 4:7]
    if (np.abs(found - inertia) > _FAR * np.sqrt(np.diag(errors)) + _FIXED * inertia).any():
        raise ModelError(f'body "{name}" would have the impossible inertia {numbers(inertia)}; fix one of its entries')
    return found
