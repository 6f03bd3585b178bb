"""A model that may deviate from itself: what a log can show that the equations do not hold.

Three things are added to a model's equations, each as further parameters, so that all of the machinery of rollouts and
their derivatives serves unchanged:

- a latent acceleration for each of the model's, ``a = f(q, v, u, p) + d``: forces that come and go;
- pushes: in every equation a steady force, and one in proportion to each input.  An actuator that is stronger or points
  elsewhere than the model says repeats itself for as long as the motion lasts; latent accelerations, free from window
  to window, would take that for proof that the parameters are at fault;
- a delay of the inputs, ``u(t - tau) = u - tau du/dt``.

References: Kennedy, O'Hagan 2001 (models with a discrepancy); Tremolet 2006 (weak-constraint 4D-Var).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca

from diransac.model import Model, Parameter

if TYPE_CHECKING:
    from collections.abc import Iterable

    from diransac.model.derivation import Symbols

__all__ = ["Freed", "freed"]


@dataclass(frozen=True)
class Freed:
    """The freed form of a model.

    Parameters
    ----------
    model : its parameters are the model's ``p``; the pushes, equation by equation the steady one and one an input; the
        delay in rows; the latent accelerations.  Its inputs are u, and the change of u with a row of delay
    n_p, n_v, n_u : of the model
    """

    model: Model
    n_p: int
    n_v: int
    n_u: int

    @property
    def n_pushes(self) -> int:
        """Forces that go with the inputs."""
        return self.n_v * (self.n_u + 1)

    @property
    def n_shared(self) -> int:
        """Parameters that all windows share: p, pushes and delay."""
        return self.n_p + self.n_pushes + 1


@lru_cache(maxsize=16)
def freed(model: Model) -> Freed:
    """The model with latent accelerations, pushes, and an input delay."""
    derived = model.kinematics is None
    own = list(model.coordinates if derived else model.velocities)
    later, latent = [f"{n}_later" for n in model.inputs], [f"latent_{n}" for n in own]
    pushes = [f"push_{i}_{k}" for i in range(model.n_v) for k in range(model.n_u + 1)]

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        motion = [_stacked(q, model.coordinates), _stacked(v, own), _stacked(a, own) - _stacked(p, latent)]
        applied = _stacked(u, model.inputs) + p.input_delay * _stacked(u, later)
        forces = ca.reshape(_stacked(p, pushes), model.n_u + 1, model.n_v).T @ ca.vertcat(1, applied)
        return list(ca.vertsplit(model.residual(*motion, applied, _stacked(p, model.parameters)) - forces))

    def kinematics(q: Symbols, v: Symbols) -> list[object]:
        assert model.kinematics is not None
        return list(ca.vertsplit(model.kinematics(_stacked(q, model.coordinates), _stacked(v, own))))

    augmented = Model(
        f"{model.name}, freed",
        model.coordinates,
        {**model.inputs, **dict(zip(later, model.inputs.values(), strict=True))},
        {**model.parameters, **{n: Parameter("") for n in (*pushes, "input_delay", *latent)}},
        equations,
        velocities=None if derived else model.velocities,
        kinematics=None if derived else kinematics,
    )
    return Freed(augmented, model.n_p, model.n_v, model.n_u)


def _stacked(symbols: Symbols, names: Iterable[str]) -> ca.SX:
    return ca.SX(ca.vertcat(*(getattr(symbols, n) for n in names)))
