"""Independent parts of a model: equations that share neither states nor parameters, such as the legs of a robot."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import takewhile
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray
from diransac.model.derivation import Symbols
from diransac.model.model import Model


def independent_parts(model: Model) -> dict[str, Model]:
    """Models of the parts of a machine that do not act on each other, which can be identified one by one.

    Equations belong to one part if they share a state or a parameter, also by others; they may share inputs.

    Returns
    -------
    dict of str to Model
        By the beginning that the names of a part's states have in common up to an underscore, ``FL`` of ``FL_hip`` and
        ``FL_thigh``, or by the first of them. A model that is in one part, and one with kinematics, by its own name.
    """
    groups = [] if model.kinematics is not None else _groups(model)
    if len(groups) < 2:
        return {model.name: model}
    states = [[model.rate_names[k] for k in group] for group in groups]
    names = [_common_beginning(own) for own in states]
    if "" in names or len(set(names)) < len(names):
        names = [own[0] for own in states]
    return {name: _part(model, name, group) for name, group in zip(names, groups, strict=True)}


def _common_beginning(names: Collection[str]) -> str:
    """Words, up to the last but one, that all names begin with; empty if there are none."""
    words = zip(*(name.split("_")[:-1] for name in names), strict=False)
    return "_".join(first for first, *_ in takewhile(lambda same: len(set(same)) == 1, words))


def _groups(model: Model) -> list[list[int]]:
    """Indices of the accelerations of every part, in the order of the first of each."""
    used = [_dependence(model, function) for function in (model.residual, model.measurement) if function is not None]
    together = np.vstack([np.hstack([x.states, x.parameters]) for x in used]).astype(int)
    linked = together.T @ together > 0
    groups, left = list[list[int]](), set(range(model.n_v))
    while left:
        reached = np.zeros(len(linked), bool)
        reached[min(left)] = True
        while (linked[reached].any(axis=0) & ~reached).any():
            reached |= linked[reached].any(axis=0)
        groups.append(np.flatnonzero(reached[: model.n_v]).tolist())
        left -= {*groups[-1], min(left)}
    return groups


class _Dependence(NamedTuple):
    """Arguments of each element of a function: states, by their accelerations, inputs and parameters; ``(n, ...)``."""

    states: BoolArray
    inputs: BoolArray
    parameters: BoolArray

    def of(self, rows: BoolArray) -> tuple[BoolArray, BoolArray]:
        """Inputs and parameters on which some elements depend."""
        return np.logical_or.reduce(self.inputs[rows]), np.logical_or.reduce(self.parameters[rows])


def _dependence(model: Model, function: ca.Function) -> _Dependence:
    symbols = function.sx_in()
    values = function(*symbols)
    q, v, a, u, p = (np.array(ca.DM(ca.jacobian_sparsity(values, x), 1), dtype=bool) for x in symbols)
    states = v | a
    states[:, : model.n_q] |= q
    return _Dependence(states, u, p)


def _part(model: Model, name: str, group: Sequence[int]) -> Model:
    """The equations, sensors and parameters of some of a model's states."""
    dynamics = _dependence(model, model.residual)
    rows: BoolArray = np.logical_or.reduce(dynamics.states[:, group], axis=1)
    inputs, parameters = dynamics.of(rows)
    shown = np.zeros(0, bool)
    if model.measurement is not None:
        readings = _dependence(model, model.measurement)
        shown = np.logical_or.reduce(readings.states[:, group], axis=1)
        more = readings.of(shown)
        inputs, parameters = inputs | more[0], parameters | more[1]
    states = {model.rate_names[k] for k in group}
    kept = {*states, *_selected(model.inputs, inputs), *_selected(model.parameters, parameters)}

    def arguments(*vectors: Symbols) -> list[ca.SX]:
        pairs = zip(vectors, model.argument_names, strict=True)
        return [ca.SX(ca.vertcat(*(x[n] if n in kept else ca.SX(0) for n in names))) for x, names in pairs]

    def equations(*vectors: Symbols) -> Sequence[Any]:
        return [model.residual(*arguments(*vectors))[np.flatnonzero(rows).tolist()]]

    own_inputs = _selected(model.inputs, inputs)
    part = Model(
        f"{model.name} {name}",
        {n: unit for n, unit in model.coordinates.items() if n in states},
        own_inputs,
        _selected(model.parameters, parameters),
        equations,
        first_order={n: unit for n, unit in model.first_order.items() if n in states},
        sensors=_selected(model.sensors_of(arguments), shown),
        description=model.description,
        ranges={n: x for n, x in model.ranges.items() if n in states},
        targets={n: x for n, x in model.targets.items() if n in own_inputs and x in states},
    )
    part.notes = model.notes
    return part


def _selected(items: Mapping[str, Any], mask: BoolArray) -> dict[str, Any]:
    """Items of a mapping by a mask in its order."""
    return {n: x for (n, x), is_in in zip(items.items(), mask, strict=True) if is_in}
