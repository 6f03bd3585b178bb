"""Independent parts of a model: equations that share neither states nor parameters, such as the legs of a robot."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from itertools import takewhile
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray
from diransac.model.derivation import Symbols
from diransac.model.model import Model

__all__ = ["independent_parts"]


def independent_parts(model: Model) -> dict[str, Model]:
    """Models of the parts of a machine that do not act on each other, which can be identified one by one.

    Equations belong to one part if they share a state or a parameter, also by others; they may share inputs.

    Parameters
    ----------
    model : Model

    Returns
    -------
    dict of str to Model
        By the beginning that the names of a part's states have in common up to an underscore, ``FL`` of ``FL_hip`` and
        ``FL_thigh``, or by the first of them. A model that is in one part, and one with kinematics, by its own name.
    """
    groups = [] if model.kinematics is not None else _groups(model)
    if len(groups) < 2:
        return {model.name: model}
    states = [tuple(np.array(model.rate_names)[group]) for group in groups]
    names = [_common_beginning(own) for own in states]
    if "" in names or len(set(names)) < len(names):
        names = [own[0] for own in states]
    return {name: _part(model, name, own) for name, own in zip(names, states, strict=True)}


def _common_beginning(names: Collection[str]) -> str:
    """Words, up to the last but one, that all names begin with; empty if there are none."""
    words = zip(*(name.split("_")[:-1] for name in names), strict=False)
    return "_".join(first for first, *_ in takewhile(lambda same: len(set(same)) == 1, words))


def _groups(model: Model) -> list[list[int]]:
    """Indices of the accelerations of every part, in the order of the first of each."""
    equations = _arguments(model, model.residual)
    sensors = np.zeros((0, equations.shape[1]), bool)
    if model.measurement is not None:
        sensors = _arguments(model, model.measurement)
    together = np.vstack([equations, sensors]).astype(int)
    linked = together.T @ together > 0
    n_v = model.n_v
    groups, left = list[list[int]](), set(range(n_v))
    while left:
        reached = np.zeros(len(linked), bool)
        reached[min(left)] = True
        while (linked[reached].any(axis=0) & ~reached).any():
            reached |= linked[reached].any(axis=0)
        groups.append(np.flatnonzero(reached[:n_v]).tolist())
        left -= {*groups[-1], min(left)}
    return groups


def _arguments(model: Model, function: ca.Function) -> BoolArray:
    """Accelerations of whose states, and parameters, each element of a function depends ``(n, n_v + n_p)``."""
    q, v, a, u, p = (ca.SX.sym(n, function.size1_in(k)) for k, n in enumerate("qvaup"))
    values = function(q, v, a, u, p)

    def used(x: ca.SX) -> BoolArray:
        return np.array(ca.DM(ca.jacobian_sparsity(values, x), 1), dtype=bool)

    states = used(v) | used(a)
    states[:, : model.n_q] |= used(q)
    return np.hstack([states, used(p)])


def _part(model: Model, name: str, states: Collection[str]) -> Model:
    """The equations, sensors and parameters of some of a model's states."""
    signals = dict(zip(model.rate_names, zip(model.velocities, model.accelerations, strict=True), strict=True))
    own = {*states, *(signal for state in states for signal in signals[state])}
    rows = [i for i in range(model.n_v) if own & set(model._names_in(model.residual, i))]
    used = {n for i in rows for n in model._names_in(model.residual, i)}
    sensors = {n: x for n, x in model.sensor_arguments.items() if own & set(x)}
    used |= {n for arguments in sensors.values() for n in arguments}
    kept = own | used

    def arguments(*vectors: Symbols) -> list[ca.SX]:
        rates = list(model.rate_names)
        every = (list(model.coordinates), rates, rates, list(model.inputs), list(model.parameters))
        pairs = zip(vectors, every, strict=True)
        return [ca.SX(ca.vertcat(*(x[n] if n in kept else ca.SX(0) for n in names))) for x, names in pairs]

    def equations(*vectors: Symbols) -> Sequence[Any]:
        return [model.residual(*arguments(*vectors))[rows]]

    return Model(
        f"{model.name} {name}",
        {n: unit for n, unit in model.coordinates.items() if n in own},
        {n: unit for n, unit in model.inputs.items() if n in used},
        {n: x for n, x in model.parameters.items() if n in used},
        equations,
        first_order={n: unit for n, unit in model.first_order.items() if n in own},
        sensors={n: x for n, x in model.sensors_of(arguments).items() if n in sensors},
        description=model.description,
    )
