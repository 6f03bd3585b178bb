"""A model that may deviate from itself: what a log can show that the equations do not hold.

Three things are added to a model's equations, each as further parameters, so that all of the machinery of rollouts and
their derivatives serves unchanged:

- a latent acceleration for each of the model's, ``a = f(q, v, u, p) + d``: forces that come and go;
- for each equation its own value of every parameter that several equations share, ``p_j + delta_ij``: forces that go
  with the motion, such as a thrust that lifts more than it pushes.  They repeat for as long as the motion does, so they
  would look like proof to latent accelerations that are free from window to window;
- a delay of the inputs, ``u(t - tau) = u - tau du/dt``.

References: Kennedy, O'Hagan 2001 (models with a discrepancy); Tremolet 2006 (weak-constraint 4D-Var).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.model import Model, Parameter

if TYPE_CHECKING:
    from collections.abc import Iterable

    from diransac.derivation import Symbols

__all__ = ["Freed", "freed"]


@dataclass(frozen=True)
class Freed:
    """A model that may deviate from itself.

    Its parameters are: the model's ``p``; a deviation ``delta`` of every parameter that several equations share, for
    each of these equations; the inputs' delay in rows; and an acceleration ``d`` for each of the model's.

    Parameters
    ----------
    model : with these parameters, and inputs (u, change of u with a row of delay)
    pairs : (equation, parameter) of each deviation
    n_p, n_v : of the model
    """

    model: Model
    pairs: tuple[tuple[int, int], ...]
    n_p: int
    n_v: int

    @property
    def n_shared(self) -> int:
        """Parameters that all windows share: p, delta and the delay."""
        return self.n_p + len(self.pairs) + 1


def freed(model: Model) -> Freed:
    """The model with latent accelerations, deviations of its equations from each other, and an input delay."""
    return _freed(_ByEquations(model))


class _ByEquations:
    """A model as a key: equal where the equations are."""

    def __init__(self, model: Model) -> None:
        self.model = model

    def __hash__(self) -> int:
        return hash(self.model.fingerprint)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _ByEquations) and other.model.fingerprint == self.model.fingerprint


@lru_cache(maxsize=16)
def _freed(key: _ByEquations) -> Freed:
    model, pairs = key.model, _shared_parameters(key.model)
    own = list(model.coordinates if model.kinematics is None else model.velocities)
    names, latent = list(model.parameters), [f"latent_{n}" for n in own]
    later = [f"{n}_later" for n in model.inputs]

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        motion = [_stacked(q, model.coordinates), _stacked(v, own), _stacked(a, own) - _stacked(p, latent)]
        applied = _stacked(u, model.inputs) + p.input_delay * _stacked(u, later)
        return [model.residual(*motion, applied, _parameters_of(i, p))[i] for i in range(model.n_v)]

    def _parameters_of(equation: int, p: Symbols) -> ca.SX:
        values = _stacked(p, names)
        for j in (j for i, j in pairs if i == equation):
            values[j] += getattr(p, f"deviation_{equation}_{names[j]}")
        return values

    def kinematics(q: Symbols, v: Symbols) -> list[object]:
        assert model.kinematics is not None
        return list(ca.vertsplit(model.kinematics(_stacked(q, model.coordinates), _stacked(v, own))))

    derived = model.kinematics is None
    further = [*(f"deviation_{i}_{names[j]}" for i, j in pairs), "input_delay", *latent]
    augmented = Model(
        f"{model.name}, freed",
        model.coordinates,
        {**model.inputs, **dict(zip(later, model.inputs.values(), strict=True))},
        {**model.parameters, **{n: Parameter("") for n in further}},
        equations,
        velocities=None if derived else model.velocities,
        kinematics=None if derived else kinematics,
    )
    return Freed(augmented, pairs, model.n_p, model.n_v)


def _shared_parameters(model: Model) -> tuple[tuple[int, int], ...]:
    """(equation, parameter) for every parameter that stands in more than one equation."""
    q, v, a, u, p = (ca.SX.sym(n, model.residual.size1_in(i)) for i, n in enumerate("qvaup"))
    stands = np.array(ca.DM(ca.jacobian_sparsity(model.residual(q, v, a, u, p), p), 1), bool)
    several = [j for j in range(model.n_p) if stands[:, j].sum() > 1]
    return tuple((int(i), j) for j in several for i in np.flatnonzero(stands[:, j]))


def _stacked(symbols: Symbols, names: Iterable[str]) -> ca.SX:
    return ca.SX(ca.vertcat(*(getattr(symbols, n) for n in names)))
