"""Parameters that are known beforehand: fixed ones, and those with a Gaussian prior.

A fixed parameter is a constant of the equations that a method sees, so that no method distinguishes it; the estimate is
completed by it afterwards.  A prior is part of the layout of a dataset's parameters.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.data.dataset import ParameterLayout
from diransac.errors import SettingsError
from diransac.model.derivation import deserialize

if TYPE_CHECKING:
    from diransac.identification.estimate import Estimate
    from diransac.identification.suggestions import Suggestion
    from diransac.model import Model

__all__ = ["KnownParameters"]


@dataclass(frozen=True)
class KnownParameters:
    """Fixed values and priors of a model's parameters; made by `KnownParameters.of`.

    Parameters
    ----------
    model : Model
        With all parameters.
    fixed : mapping of str to float, optional
        Value of each fixed parameter in its unit.
    priors : mapping of str to (float, float), optional
        Mean and standard deviation of the prior of each other parameter that has one, in its unit.
    """

    model: Model
    fixed: Mapping[str, float] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, fixed: object, priors: object) -> KnownParameters:
        """What the arguments ``fixed`` and ``priors`` of `identify` say of a model.

        Parameters
        ----------
        model : Model
        fixed : mapping of str to float or None, iterable of str, or None
        priors : mapping of str to (float, float), or None

        Raises
        ------
        SettingsError
            A name is unknown, or is in both; a value is not finite or outside the bounds; a parameter without nominal
            value is given by its name alone; a standard deviation is not positive; no parameter is left.
        """
        values = {n: _fixed_value(model, n, x) for n, x in _as_mapping(fixed).items()}
        if values and set(values) == set(model.parameters):
            raise SettingsError(f'model "{model.name}": all parameters are fixed, and none is left to be identified')
        if not isinstance(priors, Mapping | None):
            raise SettingsError(f'priors is {priors!r:.60}; give means and deviations: {{"inertia": (0.004, 0.001)}}')
        beforehand = {n: _prior(model, n, x) for n, x in (priors or {}).items()}
        both = [n for n in beforehand if n in values]
        if both:
            raise SettingsError(f"{both[0]} is fixed and has a prior; give one of them")
        return cls(model, values, beforehand)

    def free(self) -> Model:
        """The model whose parameters are those to be identified."""
        return self.model.with_fixed(self.fixed)

    def completed(self, estimate: Estimate, n_logs: int) -> Estimate:
        """The estimate of `free` with the fixed parameters: their values, and a covariance of zero.

        Parameters
        ----------
        estimate : Estimate
        n_logs : int

        Returns
        -------
        Estimate
        """
        if not self.fixed:
            return estimate
        names = ParameterLayout(self.model.parameters, n_logs).names
        found = {**{n: self.fixed.get(n.partition("[")[0]) for n in names}, **estimate.parameters}
        places = [names.index(n) for n in estimate.parameters]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(places, places)] = estimate.covariance
        return replace(
            estimate,
            parameters={n: float(found[n]) for n in names},  # type: ignore[arg-type]  # none is missing
            covariance=covariance,
            suggestions=tuple(self._suggestion(x) for x in estimate.suggestions),
        )

    def _suggestion(self, found: Suggestion) -> Suggestion:
        """A suggestion for `free` as one for the whole model, under a name that no fixed parameter has."""
        name = found.parameter
        while name in self.fixed:
            name += "_2"
        code = re.sub(rf"\bp\.{found.parameter}\b", f"p.{name}", found.code)
        term = deserialize(found.term)
        q, v, a, u = (ca.SX.sym(n, term.size1_in(i)) for i, n in enumerate("qvau"))
        p = ca.vertcat(*(ca.SX.sym(n) for n in self.model.parameters))
        own = ca.vertcat(
            *(x for n, x in zip(self.model.parameters, ca.vertsplit(p), strict=True) if n not in self.fixed)
        )
        h = ca.Function("term", [q, v, a, u, p], [term(q, v, a, u, own)], list("qvaup"), ["h"])
        return replace(found, parameter=name, code=code, term=h.serialize())


def _as_mapping(fixed: object) -> Mapping[str, object]:
    """Values by name; None where the nominal value is meant."""
    if fixed is None:
        return {}
    if isinstance(fixed, Mapping):
        return fixed
    if isinstance(fixed, str) or not isinstance(fixed, Iterable):
        raise SettingsError(f'fixed is {fixed!r:.60}; give values, {{"mass": 0.25}}, or names, ["mass"]')
    return dict.fromkeys(fixed)


def _check_name(model: Model, name: object, what: str) -> None:
    if name not in model.parameters:
        known = ", ".join(model.parameters)
        raise SettingsError(f'{what}: model "{model.name}" has no parameter "{name}"; it has {known}')


def _finite(what: str, value: object) -> float:
    """The number itself.  Raises SettingsError: it is none, or not finite."""
    is_number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    if not is_number or not np.isfinite(value):  # type: ignore[call-overload]  # a number
        raise SettingsError(f"{what} is {value!r:.60}; give a finite number")
    return float(value)  # type: ignore[arg-type]


def _fixed_value(model: Model, name: str, value: object) -> float:
    _check_name(model, name, "fixed")
    bounds = model.parameters[name]
    if value is None:
        if bounds.value is None:
            raise SettingsError(f"{name} has no nominal value; give one, as in fixed={{{name!r}: ...}}")
        return float(bounds.value)
    found = _finite(f"the fixed value of {name}", value)
    if not bounds.admits(found):
        raise SettingsError(f"the fixed value {found:g} of {name} is outside its bounds")
    return found


def _prior(model: Model, name: str, pair: object) -> tuple[float, float]:
    _check_name(model, name, "priors")
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise SettingsError(f"the prior of {name} is {pair!r:.60}; give its mean and standard deviation")
    mean = _finite(f"the prior mean of {name}", pair[0])
    std = _finite(f"the prior standard deviation of {name}", pair[1])
    if not std > 0.0:
        raise SettingsError(f"the prior standard deviation of {name} is {std:g}; give a positive number, or fix {name}")
    if not model.parameters[name].admits(mean):
        raise SettingsError(f"the prior mean {mean:g} of {name} is outside its bounds")
    return mean, std
