"""A model augmented by discrepancies.

All discrepancies are parameters of an ordinary model, so that compiled rollouts and their derivatives need no change:

- Unmodelled accelerations, one for each of the model's: ``a = f(q, v, u, p) + d``.  Or, where the noise of inputs
  explains a log, errors of these: ``a = f(q, v, u + e, p)``.
- Input gain and bias discrepancies: in every equation a constant force, and one in proportion to each input.  An
  actuator with another gain or direction than in the model deviates by the same amount throughout the motion;
  unmodelled accelerations, free in every interval, would attribute that to the parameters.

Sensors measure the motion as it is, unmodelled accelerations included.

References
----------
Kennedy, O'Hagan 2001 (models with a discrepancy); Tremolet 2006 (weak-constraint 4D-Var).
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


@dataclass(frozen=True)
class AugmentedModel:
    """The augmented form of a model.

    Parameters
    ----------
    model : Model
        Model whose parameters are the original ones; the discrepancies, equation by equation the bias and one gain per
        input; the unmodelled accelerations.
    n_p, n_latent : int
        Number of parameters of the original model, and of unmodelled accelerations or errors of inputs.
    n_discrepancies : int
        Number of input gain and bias discrepancies.
    """

    model: Model
    n_p: int
    n_latent: int
    n_discrepancies: int

    @property
    def unknowns(self) -> tuple[str, ...]:
        """The unknowns of an interval: its state, accelerations or errors, and those that intervals share."""
        names = tuple(self.model.parameters)
        last = len(names) - self.n_latent
        return (*self.model.state, *names[last:], *names[:last])


@lru_cache(maxsize=16)
def augmented_model(model: Model, *, discrepancies: bool = True, noisy: bool = False) -> AugmentedModel:
    """The model with unmodelled accelerations, and input gain and bias discrepancies.

    Parameters
    ----------
    model : Model
    discrepancies : bool, optional
        Whether it has input gain and bias discrepancies.
    noisy : bool, optional
        Whether it has errors of the inputs instead of unmodelled accelerations.

    Returns
    -------
    AugmentedModel
    """
    derived, own = model.kinematics is None, model.rate_names
    latent = [f"error_{n}" for n in model.inputs] if noisy else [f"unmodelled_{n}" for n in own]
    gains = [f"discrepancy_{i}_{k}" for i in range(model.n_v) for k in range(model.n_u + 1)] if discrepancies else []

    def arguments(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[ca.SX]:
        motion = [_stacked(q, model.coordinates), _stacked(v, own), _stacked(a, own)]
        applied = _stacked(u, model.inputs) + (_stacked(p, latent) if noisy else 0.0)
        return [*motion, applied, _stacked(p, model.parameters)]

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        coordinates, velocities, accelerations, applied, parameters = arguments(q, v, a, u, p)
        modelled = accelerations - (0.0 if noisy else _stacked(p, latent))
        residuals = model.residual(coordinates, velocities, modelled, applied, parameters)
        if discrepancies:
            residuals -= ca.reshape(_stacked(p, gains), model.n_u + 1, model.n_v).T @ ca.vertcat(1, applied)
        return list(ca.vertsplit(residuals))

    def kinematics(q: Symbols, v: Symbols) -> list[object]:
        assert model.kinematics is not None
        return list(ca.vertsplit(model.kinematics(_stacked(q, model.coordinates), _stacked(v, own))))

    augmented = Model(
        f"{model.name}, augmented",
        model.coordinates,
        model.inputs,
        {**model.parameters, **{n: Parameter("") for n in (*gains, *latent)}},
        equations,
        velocities=None if derived else model.velocities_of_motion,
        kinematics=None if derived else kinematics,
        first_order=model.first_order,
        sensors=model.sensors_of(arguments),
    )
    return AugmentedModel(augmented, model.n_p, len(latent), len(gains))


def _stacked(symbols: Symbols, names: Iterable[str]) -> ca.SX:
    return ca.SX(ca.vertcat(*(getattr(symbols, n) for n in names)))
