"""Dynamical models, given by their equations of motion.

A plant has coordinates ``q``, velocities ``v``, accelerations ``a``, inputs ``u`` and constant parameters ``p``.  A
state of first order, such as a temperature or the speed of a motor, is a velocity without a coordinate: the state is in
``v``, its derivative in ``a``.  The user writes residuals ``r(q, v, a, u, p) = 0``, one per acceleration.  From them
come

* the regressor ``W p = b`` with ``W = dr/dp`` and ``b = W p - r`` (Dimmig et al. 2023, eqs. (1) and (5)),
* the forward dynamics ``a = -M^-1 r(a=0)`` with ``M = dr/da``,
* the linearisation of the state equation, with ``M da = -dr``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError, ResultError
from diransac.model import derivation
from diransac.model.derivation import Probe, Symbols
from diransac.model.parameter import Parameter

__all__ = ["Model"]

Equations = Callable[[Symbols, Symbols, Symbols, Symbols, Symbols], Sequence[Any]]
Kinematics = Callable[[Symbols, Symbols], Sequence[Any]]


class Model:
    """A dynamical model with named, unit-carrying signals and parameters.

    Parameters
    ----------
    name : str
        Name in messages and files.
    coordinates : mapping from name to unit
        A coordinate ``x`` has velocity ``x_dot`` and acceleration ``x_ddot``. Empty for a model of first order.
    inputs : mapping from name to unit
        Known signals that act on the plant.
    parameters : mapping from name to Parameter
        Constants to be identified.
    equations : callable
        ``equations(q, v, a, u, p)`` returns the residuals, one per acceleration. Each argument has its components as
        attributes (``q.theta``, ``v.theta``, ``a.theta``, ``u.thrust``, ``p.mass``); mathematical functions are
        CasADi's.
    velocities : mapping from name to unit, optional
        Velocities that are not the derivatives of the coordinates (``wx`` with acceleration ``wx_dot``); requires
        ``kinematics``.
    kinematics : callable, optional
        ``kinematics(q, v)`` returns the derivative of every coordinate. Four consecutive coordinates whose norm it
        conserves are a unit quaternion: it is normalised after every integration step, and errors ignore its sign.
    first_order : mapping from name to unit, optional
        States with a first derivative only: in the equations ``v.motor`` is the state and ``a.motor`` its derivative;
        the signals are ``motor`` and ``motor_dot``.
    description : str
        One line for lists of models.

    Raises
    ------
    ModelError
        A name is unknown or repeated, the number of residuals is wrong, a constant is NaN (such as ``math.sin`` of a
        symbol), Python code branches on a symbol, the residuals are not affine in the accelerations, or the mass matrix
        is singular.

    Notes
    -----
    Models are immutable. Two are equal, and share compiled code, if their names, units, bounds and equations are.
    """

    def __init__(
        self,
        name: str,
        coordinates: Mapping[str, str],
        inputs: Mapping[str, str],
        parameters: Mapping[str, Parameter],
        equations: Equations,
        *,
        velocities: Mapping[str, str] | None = None,
        kinematics: Kinematics | None = None,
        first_order: Mapping[str, str] | None = None,
        description: str = "",
    ) -> None:
        self._name_signals(name, coordinates, inputs, parameters, velocities, first_order or {}, description)
        if (velocities is None) != (kinematics is None):
            given, missing = ("velocities", "kinematics") if kinematics is None else ("kinematics", "velocities")
            raise ModelError(f'model "{name}": {given} without {missing}; give both, or neither')
        q, v, a, u, p = self._symbols()
        residual = derivation.call_user(self._label, "equations", equations, *self.named(q, v, a, u, p))
        self.residual = ca.Function("residual", [q, v, a, u, p], [residual], list("qvaup"), ["r"])
        self.kinematics: ca.Function | None = None
        if kinematics is not None:
            rates = derivation.call_user(self._label, "kinematics", kinematics, *self.named(q, v))
            self.kinematics = ca.Function("kinematics", [q, v], [rates], list("qv"), ["q_dot"])
        self._check()

    # ------------------------------------------------------------------ names and sizes

    def _name_signals(
        self,
        name: str,
        coordinates: Mapping[str, str],
        inputs: Mapping[str, str],
        parameters: Mapping[str, Parameter],
        velocities: Mapping[str, str] | None,
        first_order: Mapping[str, str],
        description: str,
    ) -> None:
        self.name, self.description = name, description
        units = {"coordinates": coordinates, "inputs": inputs, "velocities": velocities or {}}
        derivation.check_groups(self._label, {**units, "first_order": first_order}, parameters)
        self.coordinates, self.inputs, self.parameters = dict(coordinates), dict(inputs), dict(parameters)
        self.first_order = dict(first_order)
        if velocities is None:
            of_motion = {f"{q}_dot": _per_second(unit) for q, unit in coordinates.items()}
            accelerations = {f"{q}_ddot": _per_second(unit, 2) for q, unit in coordinates.items()}
        else:
            of_motion = dict(velocities)
            accelerations = {f"{v}_dot": _per_second(unit) for v, unit in velocities.items()}
        rates = {f"{s}_dot": _per_second(unit) for s, unit in first_order.items()}
        groups = (coordinates, of_motion, first_order, accelerations, rates, inputs, parameters)
        derivation.check_names(self._label, groups)
        self.velocities, self.accelerations = {**of_motion, **self.first_order}, {**accelerations, **rates}

    @property
    def _label(self) -> str:
        return f'model "{self.name}"'

    @property
    def n_q(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates)

    @property
    def n_v(self) -> int:
        """Number of velocities, states of first order included, and of accelerations."""
        return len(self.velocities)

    @property
    def n_u(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def n_p(self) -> int:
        """Number of parameters."""
        return len(self.parameters)

    @property
    def state(self) -> tuple[str, ...]:
        """Names of the state ``x = [q; v]``."""
        return (*self.coordinates, *self.velocities)

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the simulated signals: coordinates, velocities, accelerations."""
        return (*self.state, *self.accelerations)

    @property
    def units(self) -> dict[str, str]:
        """Unit of every signal and input by name."""
        return {**self.coordinates, **self.velocities, **self.accelerations, **self.inputs}

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        groups = (self.coordinates, self.velocities, self.accelerations, self.inputs, self.parameters)
        q, v, a, u, p = (ca.vertcat(*(ca.SX.sym(n) for n in names)) for names in groups)
        return q, v, a, u, p

    @property
    def rate_names(self) -> tuple[str, ...]:
        """Names of velocities and accelerations in the equations: ``theta``, not ``theta_dot``."""
        of_motion = self.coordinates if self._velocities_are_derivatives else self.velocities_of_motion
        return (*of_motion, *self.first_order)

    @property
    def velocities_of_motion(self) -> dict[str, str]:
        """Velocities by name, without the states of first order, which follow them."""
        return {name: unit for name, unit in self.velocities.items() if name not in self.first_order}

    @property
    def chains(self) -> tuple[tuple[str, ...], ...]:
        """Signals of which each is the derivative of the one before, ordered by the last: ``(x, x_dot, x_ddot)``.

        Coordinates of a model with kinematics, whose derivatives are no signals, come first, alone.
        """
        pairs = tuple(zip(self.velocities, self.accelerations, strict=True))
        if self.kinematics is not None:
            return (*((q,) for q in self.coordinates), *pairs)
        n = self.n_q
        return (*((q, *pair) for q, pair in zip(self.coordinates, pairs[:n], strict=True)), *pairs[n:])

    def named(self, *vectors: ca.SX) -> tuple[Symbols, ...]:
        """The arguments of the equations: the vectors q, v, a, u and p, or the first few, with named components."""
        names = {
            "coordinates": self.coordinates,
            "velocities": self.rate_names,
            "accelerations": self.rate_names,
            "inputs": self.inputs,
            "parameters": self.parameters,
        }
        return tuple(
            Symbols(self._label, kind, dict(zip(names[kind], ca.vertsplit(x), strict=True)))
            for kind, x in zip(names, vectors, strict=False)
        )

    @property
    def _velocities_are_derivatives(self) -> bool:
        return list(self.velocities_of_motion) == [f"{q}_dot" for q in self.coordinates]

    # ------------------------------------------------------------------ checks

    def _check(self) -> None:
        derivation.check_residual(self._label, self.residual, tuple(self.accelerations))
        if self.kinematics is not None:
            derivation.check_kinematics(self._label, self.kinematics)
        self._probe = Probe(self.residual, tuple(self.parameters.values()))
        self._mass_matrix, self._bias = derivation.affine_in_acceleration(self._label, self._probe, self.accelerations)
        self._definite = derivation.mass_matrix_sign(self._label, self._probe, self._mass_matrix, self.accelerations)

    @property
    def force_sign(self) -> int:
        """1 or -1 where ``M = dr/da`` is symmetric and positive or negative definite, so that r is a force; else 0."""
        return self._definite

    @cached_property
    def nonlinear_parameters(self) -> tuple[str, ...]:
        """Names of the parameters in which the residuals are not affine; empty where ``W p = b`` holds."""
        return derivation.nonlinear_parameters(self._probe, tuple(self.parameters))

    @cached_property
    def required_signals(self) -> tuple[str, ...]:
        """Names of the signals and inputs that the residuals depend on, which a pointwise estimator requires."""
        names = (*self.signals, *self.inputs)
        q, v, a, u, p = self._symbols()
        depends = ca.which_depends(self.residual(q, v, a, u, p), ca.vertcat(q, v, a, u), 1, False)
        return tuple(n for n, d in zip(names, depends, strict=True) if d)

    def states_behind(self, signals: Iterable[str]) -> tuple[str, ...]:
        """Names of the states whose initial value affects the simulation of any of these signals."""
        x = ca.vertcat(*(ca.SX.sym(n) for n in self.state))
        u, p = ca.SX.sym("u", self.n_u), ca.SX.sym("p", self.n_p)
        rates, accelerations = self.dynamics(x, u, p)
        feeds = np.array(ca.DM(ca.jacobian_sparsity(ca.vertcat(x, accelerations), x), 1), dtype=bool)
        wanted = set(signals)
        matter = np.any(feeds[[n in wanted for n in self.signals]], axis=0)
        flows = np.array(ca.DM(ca.jacobian_sparsity(rates, x), 1), dtype=bool)
        for _ in self.state:
            matter = matter | np.any(flows[matter], axis=0)
        return tuple(n for n, m in zip(self.state, matter, strict=True) if m)

    @cached_property
    def quaternions(self) -> tuple[tuple[int, int, int, int], ...]:
        """Indices of the coordinates that form unit quaternions, found by the norm that ``kinematics`` conserves."""
        return () if self.kinematics is None else derivation.find_quaternions(self.kinematics)

    # ------------------------------------------------------------------ derived functions

    @cached_property
    def regressor(self) -> ca.Function:
        """Function ``(q, v, a, u) -> (W (r, n_p), b (r))`` with ``W p = b`` for every solution, eqs. (1) and (5).

        Raises
        ------
        ModelError
            The residuals are not affine in the parameters that the message names.
        """
        if self.nonlinear_parameters:
            raise ModelError(
                f"{self._label}: the equations are not affine in {', '.join(self.nonlinear_parameters)}: there is no "
                'regression W p = b; use method="nls" or a RANSAC method, which fit by nonlinear least squares'
            )
        q, v, a, u, p = self._symbols()
        W, r0 = self._probe.affine_parts("p", (q, v, a, u, p))
        return ca.Function("regressor", [q, v, a, u], [ca.densify(W), ca.densify(-r0)], list("qvau"), ["W", "b"])

    @cached_property
    def dynamics(self) -> ca.Function:
        """Function ``(x, u, p) -> (x_dot (n_x), a (n_v))`` with ``x = [q; v]``."""
        q, v, _, u, p = self._symbols()
        a = -self._solve_mass(q, v, u, p, self._bias(q, v, u, p))
        q_dot = self._coordinate_rates(q, v)
        x = ca.vertcat(q, v)
        outputs = [ca.densify(ca.vertcat(q_dot, a)), ca.densify(a)]
        return ca.Function("dynamics", [x, u, p], ca.cse(outputs), ["x", "u", "p"], ["x_dot", "a"])

    @cached_property
    def linearization(self) -> ca.Function:
        """Function ``(x, u, p) -> (A (n_x, n_x), B (n_x, n_u))`` of ``d x_dot = A dx + B du``."""
        x, u, p = (ca.SX.sym(n, size) for n, size in (("x", len(self.state)), ("u", self.n_u), ("p", self.n_p)))
        outputs = [ca.densify(J) for J in self.rate_jacobians(x, u, p)[:2]]
        return ca.Function("linearization", [x, u, p], outputs, ["x", "u", "p"], ["A", "B"])

    @cached_property
    def rate_jacobians(self) -> ca.Function:
        """Function ``(x, u, p) -> d x_dot / d(x, u, p)``, three sparse matrices, by ``M da = -dr``."""
        q, v, a, u, p = self._symbols()
        x = ca.vertcat(q, v)
        r = self.residual(q, v, a, u, p)
        q_dot = self._coordinate_rates(q, v)
        solved = -self._solve_mass(q, v, u, p, ca.jacobian(r, ca.vertcat(x, u, p)))
        solved = ca.sparsify(ca.substitute(solved, a, self.dynamics(x, u, p)[1]))
        both = ca.vertcat(ca.jacobian(q_dot, ca.vertcat(x, u, p)), solved)
        edges = [0, x.numel(), x.numel() + u.numel(), both.size2()]
        names = ["dx", "du", "dp"]
        return ca.Function("rate_jacobians", [x, u, p], ca.cse(ca.horzsplit(both, edges)), ["x", "u", "p"], names)

    @cached_property
    def force_response(self) -> ca.Function:
        """Function ``(q, v, u, p, f) -> M^-1 f (n_v)``, the accelerations by generalised forces: ``M a + c = f``.

        Raises
        ------
        ModelError
            ``M`` is not symmetric and definite, so the residuals are not a balance of forces.
        """
        if self._definite == 0:
            raise ModelError(
                f"{self._label}: the mass matrix dr/da is not symmetric and definite, so the equations are not a "
                "balance of forces to which others could be added; write them as such, or give accelerations"
            )
        q, v, _, u, p = self._symbols()
        f = ca.SX.sym("f", self.n_v)
        a = self._definite * self._solve_mass(q, v, u, p, f)
        return ca.Function("force_response", [q, v, u, p, f], [ca.densify(a)], list("qvupf"), ["a"])

    def with_fixed(self, values: Mapping[str, float]) -> Model:
        """The model with some of its parameters replaced by constants in the equations.

        Parameters
        ----------
        values : mapping of str to float
            Value of each of these parameters in its unit.

        Raises
        ------
        ModelError
            No parameter is left, or the equations with these constants are not those of a model.
        """
        if not values:
            return self

        def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[Any]:
            motion = [ca.vertcat(*x) for x in (q, v, a, u)]
            own = ca.vertcat(*(values[n] if n in values else p[n] for n in self.parameters))
            return [self.residual(*motion, own)]

        def kinematics(q: Symbols, v: Symbols) -> list[Any]:
            assert self.kinematics is not None
            return [self.kinematics(ca.vertcat(*q), ca.vertcat(*v))]

        has_kinematics = self.kinematics is not None
        return Model(
            self.name,
            self.coordinates,
            self.inputs,
            {n: x for n, x in self.parameters.items() if n not in values},
            equations,
            velocities=self.velocities_of_motion if has_kinematics else None,
            kinematics=kinematics if has_kinematics else None,
            first_order=self.first_order,
            description=self.description,
        )

    def _coordinate_rates(self, q: ca.SX, v: ca.SX) -> ca.SX:
        """Derivatives of the coordinates."""
        return v[: self.n_q, 0] if self.kinematics is None else self.kinematics(q, v)

    def _solve_mass(self, q: ca.SX, v: ca.SX, u: ca.SX, p: ca.SX, rhs: ca.SX) -> ca.SX:
        """``M^-1 rhs``: LDL^T where the probe found ``M`` symmetric and definite, CasADi's solve elsewhere."""
        M = self._mass_matrix(q, v, u, p)
        if self._definite == 0:
            return ca.solve(ca.densify(M), ca.densify(rhs))
        D, LT, order = ca.ldl(ca.sparsify(self._definite * M))
        return self._definite * ca.ldl_solve(ca.densify(rhs), D, LT, order)

    def equations_text(self) -> tuple[str, ...]:
        """Every residual as readable text, ``0 = ...``, in the signals' names."""
        return tuple(f"0 = {r}" for r in ca.vertsplit(self.residual(*self._symbols())))

    def parameter_vector(self, parameters: Mapping[str, float]) -> FloatArray:
        """Values ``(n_p,)`` in the model's order.

        Raises
        ------
        ModelError
            A name is missing or unknown, or its value is not finite.
        """
        if set(parameters) != set(self.parameters):
            raise ModelError(
                f"{self._label}: parameters are {', '.join(self.parameters)}; found {', '.join(parameters)}"
            )
        values = np.array([parameters[n] for n in self.parameters], dtype=float)
        if not np.isfinite(values).all():
            bad = [n for n, x in zip(self.parameters, values, strict=True) if not np.isfinite(x)]
            raise ModelError(f"{self._label}: parameter {bad[0]} is {parameters[bad[0]]}; give a finite number")
        return values

    # ------------------------------------------------------------------ identity and storage

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the names, units, bounds and equations."""
        return str(self.to_dict()["checksum"])

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Model):
            return NotImplemented
        return self is other or self.fingerprint == other.fingerprint

    def __hash__(self) -> int:
        return hash(self.fingerprint)

    def to_dict(self) -> dict[str, Any]:
        """Names, units, bounds and serialised equations as JSON data, which `from_dict` reads."""
        data = {
            "name": self.name,
            "description": self.description,
            "coordinates": self.coordinates,
            "velocities": None if self.kinematics is None else self.velocities_of_motion,
            "inputs": self.inputs,
            "parameters": {n: _parameter_to_dict(x) for n, x in self.parameters.items()},
            "residual": self.residual.serialize(),
            "kinematics": None if self.kinematics is None else self.kinematics.serialize(),
            **({"first_order": self.first_order} if self.first_order else {}),
        }
        return {**data, "checksum": _checksum(data)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Model:
        """The model that `to_dict` wrote.

        Raises
        ------
        ResultError
            The data are damaged.
        """
        try:
            return cls._from_checked(data)
        except (KeyError, TypeError, AttributeError, ValueError, ModelError) as error:
            raise ResultError(
                f"the stored model is damaged: {type(error).__name__}: {error}; identify again"
            ) from error

    @classmethod
    def _from_checked(cls, data: Mapping[str, Any]) -> Model:
        model = cls.__new__(cls)
        if data["checksum"] != _checksum({k: x for k, x in data.items() if k != "checksum"}):
            raise ResultError("the stored model is damaged: its checksum does not match; identify again")
        parameters = {n: _parameter_from_dict(x) for n, x in data["parameters"].items()}
        units = (data["coordinates"], data["inputs"], parameters, data["velocities"], data.get("first_order", {}))
        model._name_signals(data["name"], *units, data["description"])
        model.residual = derivation.deserialize(data["residual"])
        stored = data["kinematics"]
        model.kinematics = None if stored is None else derivation.deserialize(stored)
        sizes = [model.residual.size1_in(i) for i in range(model.residual.n_in())]
        if sizes != [model.n_q, model.n_v, model.n_v, model.n_u, model.n_p]:
            raise ResultError("the stored model is damaged: its names do not fit its equations; identify again")
        model._check()
        return model

    def __reduce__(self) -> tuple[Any, ...]:
        return (Model.from_dict, (self.to_dict(),))

    def __repr__(self) -> str:
        first_order = f", first_order={list(self.first_order)}" if self.first_order else ""
        names = f"coordinates={list(self.coordinates)}{first_order}, parameters={list(self.parameters)}"
        return f"Model({self.name!r}, {names})"


def _per_second(unit: str, order: int = 1) -> str:
    """``m -> m/s``, ``m -> m/s^2``; a unit that has a divisor already gets it multiplied."""
    power = "s" if order == 1 else f"s^{order}"
    if unit in ("", "1"):
        return f"1/{power}"
    head, slash, tail = unit.partition("/")
    if not slash:
        return f"{unit}/{power}"
    if tail == "s":
        return f"{head}/s^{order + 1}"
    return f"{head}/({tail} {power})"


def _parameter_to_dict(parameter: Parameter) -> dict[str, Any]:
    def finite(x: float) -> float | None:
        return float(x) if np.isfinite(x) else None

    lower, upper = finite(parameter.lower), finite(parameter.upper)
    stored = {"unit": parameter.unit, "lower": lower, "upper": upper, "positive": parameter.positive}
    own_values = {"per_log": True} if parameter.per_log else {}
    nominal = {} if parameter.value is None else {"value": float(parameter.value)}
    return {**stored, **own_values, **nominal}


def _parameter_from_dict(data: Mapping[str, Any]) -> Parameter:
    lower = -np.inf if data["lower"] is None else data["lower"]
    upper = np.inf if data["upper"] is None else data["upper"]
    own_values, nominal = bool(data.get("per_log", False)), data.get("value")
    return Parameter(data["unit"], lower, upper, data["positive"], own_values, nominal)


def _checksum(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()
