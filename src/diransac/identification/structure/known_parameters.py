"""Parameters that are known beforehand: fixed ones, and those with a Gaussian prior.

A fixed parameter is a constant of the equations that a method sees, so that no method distinguishes it; the estimate is
completed by it afterwards.  A prior is part of the layout of a dataset's parameters, for the method to use.

Where the equations alone do not determine a parameter, such as the scale of homogeneous ones, its prior is all that
is known of it.  The method sees its mean as a constant, and its deviation is added afterwards, along the changes of the
parameters that leave every motion as it is.  A regression could not do that: noise in W draws the solution of
``W p = 0`` to zero.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import ParameterLayout
from diransac.errors import SettingsError, check_known
from diransac.identification.regression.uncertainty import combined
from diransac.identification.settings import finite_number
from diransac.identification.structure.lacking_terms import Suggestion
from diransac.identification.structure.structural import structural, structural_slopes
from diransac.model import Model, expressions

if TYPE_CHECKING:
    from diransac.identification.estimate import Estimate


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
    fixed: dict[str, float] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, model: Model, fixed: object, priors: object) -> KnownParameters:
        """Fixed values and priors from the arguments of `identify`, checked.

        Parameters
        ----------
        model : Model
        fixed : mapping of str to float or None, iterable of str, or None
        priors : mapping of str to (float, float), or None

        Returns
        -------
        KnownParameters

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

    def of_model(self, model: Model) -> KnownParameters:
        """Known parameters of another model, which has some of these."""
        fixed = {n: x for n, x in self.fixed.items() if n in model.parameters}
        return KnownParameters(model, fixed, {n: x for n, x in self.priors.items() if n in model.parameters})

    @cached_property
    def held(self) -> tuple[str, ...]:
        """Parameters with a prior that are constants of `free`, because the equations do not determine them.

        Of as many parameters as are ambiguous, those with the smallest relative deviation.
        """
        model, found = self.model.with_fixed(self.fixed), list[str]()
        for ambiguity in structural(model) if self.priors and model.has_equations else ():
            shared = [n for n in ambiguity.names if n in self.priors and not model.parameters[n].per_log]
            shared.sort(key=lambda n: self.priors[n][1] / (abs(self.priors[n][0]) or np.finfo(float).tiny))
            n_free = len(ambiguity.names) - ambiguity.n_determined
            found += shared[:n_free] if len(shared) >= n_free else []
        return tuple(found)

    @cached_property
    def _late(self) -> tuple[str, ...]:
        """Parameters with a prior in the same ambiguity as one that is held: combined with the finished estimate."""
        groups = [x.names for x in structural(self.model.with_fixed(self.fixed))] if self.held else []
        names = [n for group in groups if set(group) & set(self.held) for n in group]
        return tuple(n for n in names if n in self.priors and n not in self.held)

    def free(self) -> Model:
        """The model whose parameters are those to be identified."""
        return self.model.with_fixed(self.fixed | {n: self.priors[n][0] for n in self.held})

    @property
    def priors_of_fit(self) -> dict[str, tuple[float, float]]:
        """Priors that are part of the estimation of `free`."""
        return {n: x for n, x in self.priors.items() if n not in (*self.held, *self._late)}

    def completed(self, estimate: Estimate, n_logs: int) -> Estimate:
        """The estimate of `free` with all parameters.

        Fixed ones have their values, and a covariance of zero.  Those that are held have their priors: the logs say
        nothing of them, and the others change with them as the equations require, to first order.

        Parameters
        ----------
        estimate : Estimate
        n_logs : int

        Returns
        -------
        Estimate
        """
        if not (self.fixed or self.held):
            return estimate
        layout = ParameterLayout(self.model.parameters, n_logs, self.priors)
        known = self.fixed | {n: self.priors[n][0] for n in self.held}
        owned = zip(layout.names, layout.owners, strict=True)
        values = np.array([estimate.parameters.get(n, known.get(owner, np.nan)) for n, owner in owned])
        covariance, places = np.zeros((len(layout), len(layout))), [layout.names.index(n) for n in estimate.parameters]
        covariance[np.ix_(places, places)] = estimate.covariance
        if self.held:
            values, covariance = self._with_held(layout, values, covariance)
        return replace(
            estimate,
            parameters=dict(zip(layout.names, values.tolist(), strict=True)),
            covariance=covariance,
            suggestions=tuple(self._suggestion(x) for x in estimate.suggestions),
        )

    def _with_held(
        self, layout: ParameterLayout, values: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Values and covariance with the uncertainty of the parameters that are held, and late priors."""
        changes = np.zeros((len(layout), len(self.held)))
        free = np.array([n not in self.fixed for n in self.model.parameters])
        model = self.model.with_fixed(self.fixed)
        given = np.array([list(model.parameters).index(n) for n in self.held])
        for own in layout.index[:, free]:
            changes[own] = structural_slopes(model, values[own], given)
        changes *= [self.priors[n][1] for n in self.held]
        late = np.array([k for k, n in enumerate(layout.owners) if n in self._late], np.int64)
        return combined(
            values, covariance + changes @ changes.T, late, layout.prior_mean[late], np.square(layout.prior_std[late])
        )

    def _suggestion(self, found: Suggestion) -> Suggestion:
        """A suggestion for `free` as one for the whole model, under a name that no other parameter has."""
        name, constants = found.parameter, (*self.fixed, *self.held)
        while name in constants:
            name += "_2"
        code, *others = (
            re.sub(rf"\bp\.{found.parameter}\b", f"p.{name}", x) for x in (found.code, *found.also.values())
        )
        sizes = self.model.argument_sizes
        term = expressions.restored("term", found.term, {**sizes, "p": sizes["p"] - len(constants)}, {"h": sizes["v"]})
        symbols = [ca.SX.sym(n, size) for n, size in sizes.items()]
        own = [k for k, n in enumerate(self.model.parameters) if n not in constants]
        h = ca.Function("term", symbols, [term(*symbols[:4], symbols[4][own])], list(sizes), ["h"])
        also, stored = dict(zip(found.also, others, strict=True)), expressions.stored(f"parameter {name}", h)
        return replace(found, parameter=name, code=code, term=stored, also=also)


def _as_mapping(fixed: object) -> Mapping[str, object]:
    """Values by name; None where the nominal value is meant."""
    if fixed is None or isinstance(fixed, Mapping):
        return fixed or {}
    if isinstance(fixed, str) or not isinstance(fixed, Iterable):
        raise SettingsError(f'fixed is {fixed!r:.60}; give values, {{"mass": 0.25}}, or names, ["mass"]')
    return dict.fromkeys(fixed)


def _fixed_value(model: Model, name: str, value: object) -> float:
    check_known([name], model.parameters, f'fixed: model "{model.name}" has no parameter', "it has")
    bounds = model.parameters[name]
    if value is None:
        if bounds.value is None:
            raise SettingsError(f"{name} has no nominal value; give one, as in fixed={{{name!r}: ...}}")
        return float(bounds.value)
    found = finite_number(f"the fixed value of {name}", value)
    if not bounds.admits(found):
        raise SettingsError(f"the fixed value {found:g} of {name} is outside its bounds")
    return found


def _prior(model: Model, name: str, pair: object) -> tuple[float, float]:
    check_known([name], model.parameters, f'priors: model "{model.name}" has no parameter', "it has")
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise SettingsError(f"the prior of {name} is {pair!r:.60}; give its mean and standard deviation")
    words = ("mean", "standard deviation")
    mean, std = (finite_number(f"the prior {word} of {name}", x) for word, x in zip(words, pair, strict=True))
    if not std > 0.0:
        raise SettingsError(f"the prior standard deviation of {name} is {std:g}; give a positive number, or fix {name}")
    if not model.parameters[name].admits(mean):
        raise SettingsError(f"the prior mean {mean:g} of {name} is outside its bounds")
    return mean, std
