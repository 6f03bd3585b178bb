"""`Plant`, a model with its parameters, and `Disturbance`, effects on a plant that its model does not contain.

A disturbed plant obeys ``M a + c = f`` where its model has ``M a + c = 0``, or has ``a + e`` for the model's ``a``.
Planning, control and identification use the model alone; only simulations include the disturbances.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import casadi as ca
import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.errors import ModelError, SettingsError, check_known
from diransac.model import derivation, expressions
from diransac.model.derivation import Symbols
from diransac.model.model import Model

Effect = Callable[[Symbols, Symbols, Symbols, Symbols, Symbols], Mapping[str, Any]]
"""``effect(q, v, u, p, d)`` gives expressions by name."""


class ModelWithParameters(Protocol):
    """A `Plant` or a `Result`."""

    @property
    def model(self) -> Model:
        """Equations of motion."""

    @property
    def parameters(self) -> Mapping[str, float]:
        """Parameters by name."""


class Disturbance:
    """Forces on a plant, or accelerations of it, that its model does not contain.

    Parameters
    ----------
    model : Model
        Of the disturbed plant.
    name : str
        Name in messages, and prefix of the names of constants and states.
    forces : callable, optional
        ``forces(q, v, u, p, d)`` returns generalised forces ``f`` in ``M a + c = f`` by name of the acceleration in the
        equations (``{"z": ..., "theta": ...}``), N for m, N m for rad; 0 where not named.
    accelerations : callable, optional
        The same for terms added to the accelerations.
    constants : mapping of str to float, optional
        Available as ``d.name``. Another value needs no new compilation.
    states : mapping of str to str, optional
        Units of additional states by name, such as the phase of a rotor, available as ``d.name``.
    rates : callable, optional
        ``rates(q, v, u, p, d)`` returns the derivative of each additional state by name.
    start : mapping of str to float or (float, float), optional
        Initial value of a state, or a range from which the seed of a flight draws it; 0 where not named.
    highest_frequency : float
        Hz, of the fastest effect. Simulations take at least 8 integration steps per period of it.

    Raises
    ------
    ModelError
        An unknown name, a NaN constant, Python branching on a symbol, states without rates, or a force on a model whose
        equations are not a balance of forces (``M`` not symmetric and definite).

    Notes
    -----
    ``d.t`` is the time since the start of the simulation, s. Functions are CasADi's.
    """

    def __init__(
        self,
        model: Model,
        name: str,
        *,
        forces: Effect | None = None,
        accelerations: Effect | None = None,
        constants: Mapping[str, float] | None = None,
        states: Mapping[str, str] | None = None,
        rates: Effect | None = None,
        start: Mapping[str, float | Sequence[float]] | None = None,
        highest_frequency: float = 0.0,
    ) -> None:
        self.model, self.name = model, name
        self.constants, self.states = dict(constants or {}), dict(states or {})
        # A number as it is, a range as a pair.
        given = {n: tuple(x) if isinstance(x, Sequence | np.ndarray) else x for n, x in (start or {}).items()}
        self.start: dict[str, Any] = {**dict.fromkeys(self.states, 0.0), **given}
        self.highest_frequency = float(highest_frequency)
        self._check(rates is not None)
        q, v, u, p, own = (ca.SX.sym(name, size) for name, size in self._sizes.items())
        known = model.named(q, v, v, u, p)
        d = Symbols(self._label, "constants and states", dict(zip(self._own, ca.vertsplit(own), strict=True)))
        arguments = (*known[:2], *known[3:], d)
        effects, names = {"forces": forces, "accelerations": accelerations, "rates": rates}, model.rate_names
        results = [
            self._expressions(what, one, tuple(self.states) if what == "rates" else names, arguments)
            for what, one in effects.items()
        ]
        effect = ca.Function("effect", [q, v, u, p, own], results, list("qvupd"), list(effects))
        self._effect_data = expressions.stored(self._label, effect)
        self.effect = self._restored_effect()
        if forces is not None:
            model.force_response  # noqa: B018  refuses a model that is no balance of forces

    @property
    def _label(self) -> str:
        return f'disturbance "{self.name}"'

    @property
    def _own(self) -> tuple[str, ...]:
        """Names of the attributes of ``d``."""
        return (*self.constants, *self.states, "t")

    @property
    def _sizes(self) -> dict[str, int]:
        """Number of elements of the arguments q, v, u, p and d."""
        return {**{n: size for n, size in self.model.argument_sizes.items() if n != "a"}, "d": len(self._own)}

    def _check(self, has_rates: bool) -> None:
        """Raise ModelError for arguments that do not fit together."""
        if not self.name.replace("-", "_").isidentifier():
            raise ModelError(f"{self._label}: the name is part of others; use letters, digits and hyphens")
        if len(set(self._own)) < len(self._own):
            raise ModelError(f"{self._label}: a name is used twice; found {', '.join(self._own)}; t is the time")
        if bool(self.states) != has_rates:
            raise ModelError(f"{self._label}: states need rates; give both or neither")
        check_known(self.start, self.states, f"{self._label}: start names", "states are", ModelError)
        numbers = {**self.constants, **self.start, "highest_frequency": self.highest_frequency}
        for name, value in numbers.items():
            is_range = name in self.start and isinstance(value, tuple)
            if np.size(value) != (2 if is_range else 1) or not np.isfinite(value).all():
                raise ModelError(f"{self._label}: {name} is {value!r}; give a finite number")
            if is_range and value[0] > value[1]:
                raise ModelError(f"{self._label}: {name} is {value!r}; give the low end of a range first")
        highest = 1e5  # Hz: 8000 integration steps per sample at 100 Hz
        if not 0.0 <= self.highest_frequency <= highest:
            raise ModelError(
                f"{self._label}: highest_frequency is {self.highest_frequency:g}; give Hz, from 0 to {highest:g}, "
                "which integration steps can resolve"
            )

    def _expressions(
        self, what: str, effect: Effect | None, names: Sequence[str], arguments: Sequence[Symbols]
    ) -> ca.SX:
        """Expressions that a user's function returns, in order; zero where it names none."""
        if effect is None:
            return ca.SX(len(names), 1)

        def ordered(*symbols: Symbols) -> list[Any]:
            returned = effect(*symbols)
            check_known(returned, names, f"{self._label}: {what} name", "there are", ModelError)
            return [returned.get(name, 0.0) for name in names]

        column = derivation.call_user(self._label, what, ordered, *arguments)
        derivation.check_constants(self._label, what, ca.Function(what, [ca.vertcat(*ca.symvar(column))], [column]))
        return column

    def _restored_effect(self) -> ca.Function:
        """Function ``(q, v, u, p, d) -> (forces, accelerations, rates)`` of the stored effect."""
        n_v = self.model.n_v
        results = {"forces": n_v, "accelerations": n_v, "rates": len(self.states)}
        return expressions.restored("effect", self._effect_data, self._sizes, results)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "effect"}

    def __setstate__(self, kept: Mapping[str, Any]) -> None:
        vars(self).update(kept)
        self.effect = self._restored_effect()

    def __repr__(self) -> str:
        return f"Disturbance({self.name!r} of {self.model.name!r}, constants={self.constants})"


class DisturbedModel:
    """Equations of a model with disturbances, for `diransac.simulation.rollouts`.

    Parameters
    ----------
    model : Model
        Without disturbances.
    disturbances : sequence of Disturbance
        Each made for this model.

    Notes
    -----
    The state is ``[q; v; states of the disturbances; t]``, with t only if it is used; the parameters are the model's,
    followed by the constants of the disturbances.  Two are equal if these equations are, for any values of constants.
    """

    def __init__(self, model: Model, disturbances: Sequence[Disturbance]) -> None:
        self.model, self.disturbances = model, tuple(disturbances)
        self.name = " with ".join((model.name, " and ".join(one.name for one in self.disturbances)))
        own = [f"{one.name}.{state}" for one in self.disturbances for state in one.states]
        self.own_states = (*own, "t") if any(_uses_time(one) for one in self.disturbances) else tuple(own)
        self.parameters = (*model.parameters, *(f"{one.name}.{n}" for one in self.disturbances for n in one.constants))
        self.state = (*model.state, *self.own_states)
        self.signals = (*self.state, *model.accelerations, *model.sensors)
        self.quaternions = model.quaternions
        # As of a model: states of disturbances are velocities, their constants parameters.
        self.n_q, self.n_v, self.n_u = model.n_q, model.n_v + len(self.own_states), model.n_u
        self.n_p = len(self.parameters)

    @cached_property
    def _equations(self) -> tuple[Any, ...]:
        """The model, and the names and effect of every disturbance."""
        effects = (
            (one.name, *one.constants, "", *one.states, json.dumps(one._effect_data)) for one in self.disturbances
        )
        return (self.model, *effects)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, DisturbedModel):
            return NotImplemented
        return self is other or self._equations == other._equations

    def __hash__(self) -> int:
        return hash(self._equations)

    @cached_property
    def dynamics(self) -> ca.Function:
        """Function ``(x, u, p) -> (x_dot, a (n_v of the model))``."""
        x, u, p = (ca.SX.sym(n, size) for n, size in (("x", len(self.state)), ("u", self.n_u), ("p", self.n_p)))
        model, n_x = self.model, len(self.model.state)
        q, v = x[: model.n_q, 0], x[model.n_q : n_x, 0]
        known, acceleration = model.dynamics(x[:n_x], u, p[: model.n_p])
        forces, rates = ca.SX(model.n_v, 1), []
        for force, further, rate in self._effects(q, v, x[n_x:, 0], u, p):
            forces += force
            acceleration += further
            rates.append(rate)
        if forces.nnz():
            acceleration += model.force_response(q, v, u, p[: model.n_p], forces)
        clock = ca.SX.ones(int("t" in self.own_states))
        x_dot = ca.vertcat(known[: model.n_q, 0], acceleration, *rates, clock)
        outputs = ca.cse([ca.densify(x_dot), ca.densify(acceleration)])
        return ca.Function("dynamics", [x, u, p], outputs, ["x", "u", "p"], ["x_dot", "a"])

    def _effects(self, q: ca.SX, v: ca.SX, own: ca.SX, u: ca.SX, p: ca.SX) -> Iterator[tuple[ca.SX, ca.SX, ca.SX]]:
        """Forces, accelerations and rates of every disturbance."""
        constants, states = iter(ca.vertsplit(p)[self.model.n_p :]), iter(ca.vertsplit(own))
        time = own[-1, 0] if "t" in self.own_states else ca.SX(0)
        for one in self.disturbances:
            values = [*(next(constants) for _ in one.constants), *(next(states) for _ in one.states)]
            forces, accelerations, rates = one.effect(q, v, u, p[: self.model.n_p], ca.vertcat(*values, time))
            yield forces, accelerations, rates

    @cached_property
    def readings(self) -> ca.Function:
        """Function ``(x, a, u, p) -> y``: the model's sensors, which show the disturbed accelerations."""
        sizes = {"x": len(self.state), "a": self.model.n_v, "u": self.n_u, "p": self.n_p}
        x, a, u, p = (ca.SX.sym(n, size) for n, size in sizes.items())
        y = self.model.readings(x[: len(self.model.state)], a, u, p[: self.model.n_p])
        return ca.Function("readings", [x, a, u, p], [y], list(sizes), ["y"])

    @cached_property
    def rate_jacobians(self) -> ca.Function:
        """Function ``(x, u, p) -> d x_dot / d(x, u, p)``, three sparse matrices."""
        x, u, p = self.dynamics.sx_in()
        x_dot = self.dynamics(x, u, p)[0]
        jacobians = ca.cse([ca.jacobian(x_dot, z) for z in (x, u, p)])
        return ca.Function("rate_jacobians", [x, u, p], jacobians, ["x", "u", "p"], ["dx", "du", "dp"])


def _uses_time(disturbance: Disturbance) -> bool:
    """True if a disturbance depends on ``d.t``."""
    arguments = disturbance.effect.sx_in()
    results = ca.vertcat(*disturbance.effect(*arguments))
    return bool(ca.which_depends(results, arguments[-1][-1], 1, False)[0])


@dataclass(frozen=True)
class Plant:
    """Model with its parameters, for simulation, planning and control. A `Result` can take its place.

    Parameters
    ----------
    model : Model
        Equations of motion.
    parameters : mapping of str to float
        Value of each parameter.
    disturbances : tuple of Disturbance
        Effects that only simulations include.

    Raises
    ------
    ModelError
        A parameter is missing, unknown or not finite; a disturbance of another model, or two of the same name.
    """

    model: Model
    parameters: Mapping[str, float] = field(default_factory=dict)
    disturbances: tuple[Disturbance, ...] = ()

    def __post_init__(self) -> None:
        values = self.model.parameter_vector(self.parameters)
        ordered = {n: float(x) for n, x in zip(self.model.parameters, values, strict=True)}
        object.__setattr__(self, "parameters", ordered)
        object.__setattr__(self, "disturbances", tuple(self.disturbances))
        names = [one.name for one in self.disturbances]
        for one in self.disturbances:
            if one.model != self.model:
                raise ModelError(
                    f'disturbance "{one.name}" was made for model "{one.model.name}", not for "{self.model.name}"; '
                    "make it for the plant's own"
                )
            if names.count(one.name) > 1:
                raise ModelError(f'two disturbances have the name "{one.name}"; give them different names')

    @cached_property
    def simulated(self) -> Model | DisturbedModel:
        """Simulated equations: the model, with its disturbances if there are any."""
        return DisturbedModel(self.model, self.disturbances) if self.disturbances else self.model

    @property
    def constants(self) -> FloatArray:
        """Parameters and constants of the disturbances: ``p`` of `simulated`."""
        values = [*self.parameters.values(), *(x for one in self.disturbances for x in one.constants.values())]
        return np.array(values)

    def initial_state(self, state: npt.ArrayLike, seed: int = 0) -> FloatArray:
        """Initial state of `simulated` from that of the model (n_x,).

        Parameters
        ----------
        state : (n_x,) array
            Of the model.
        seed : int
            Of the states of disturbances that are drawn from a range.
        """
        x = np.asarray(state, np.float64)
        if isinstance(self.simulated, Model):
            return x
        rng = np.random.default_rng(seed)
        starts = [start for one in self.disturbances for start in one.start.values()]
        own = [float(rng.uniform(*start)) if isinstance(start, tuple) else float(start) for start in starts]
        return np.concatenate([x, own, np.zeros(int("t" in self.simulated.own_states))])

    def substeps(self, dt: float) -> int:
        """Integration steps per sample of dt (s) that resolve every disturbance."""
        fastest = max((one.highest_frequency for one in self.disturbances), default=0.0)
        # Integration steps per period of the fastest disturbance; docs/flying.md has the convergence.
        return max(1, int(np.ceil(8 * fastest * dt)))


def check_possible(model: Model, parameters: Mapping[str, float]) -> None:
    """Raise ModelError: a machine cannot have these parameters, one of which is outside its bounds."""
    for name, bounds in model.parameters.items():
        if not bounds.admits(parameters[name]):
            raise ModelError(f'"{model.name}" cannot have {name} = {parameters[name]:g}, which is outside its bounds')


def as_plant(plant: ModelWithParameters) -> Plant:
    """A plant as it is, or a result as a plant.

    Raises SettingsError: it is neither.
    """
    if isinstance(plant, Plant):
        return plant
    if not isinstance(getattr(plant, "model", None), Model) or not hasattr(plant, "parameters"):
        raise SettingsError(f"plant is {plant!r:.60}; give a dr.Plant or a dr.Result, such as dr.Result.load(path)")
    return Plant(plant.model, plant.parameters)
