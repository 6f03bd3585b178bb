"""Dynamical models, given by their equations of motion.

A plant has coordinates ``q``, velocities ``v``, accelerations ``a``, inputs ``u`` and constant parameters ``p``.  A
state of first order, such as a temperature or the speed of a motor, is a velocity without a coordinate: the state is in
``v``, its derivative in ``a``.  The user writes residuals ``r(q, v, a, u, p) = 0``, one per acceleration.  From them
come

* the regressor ``W p = b`` with ``W = dr/dp`` and ``b = W p - r`` (Dimmig et al. 2023, eqs. (1) and (5)),
* the forward dynamics ``a = -M^-1 r(a=0)`` with ``M = dr/da``,
* the linearisation of the state equation, with ``M da = -dr``.

Sensors are further outputs ``y = h(q, v, a, u, p)``: the measurement equation of an accelerometer, an encoder, ...
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import ModelError, ResultError
from diransac.model import derivation, expressions
from diransac.model.derivation import Probe, Symbols
from diransac.model.held import HeldConstant
from diransac.model.parameter import Parameter
from diransac.model.sensors import Sensor, with_parameters_of
from diransac.model.signals import Signals

Equations = Callable[[Symbols, Symbols, Symbols, Symbols, Symbols], Sequence[Any]]
Kinematics = Callable[[Symbols, Symbols], Sequence[Any]]


class Model(Signals):
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
    sensors : mapping from name to Sensor, optional
        Measurement equations of further columns of a log: an accelerometer, an encoder, ...; see `diransac.sensors`.
        Parameters that come with a sensor follow the model's own; one that the model declares itself is the model's.
    description : str
        One line for lists of models.
    ranges : mapping from coordinate to (float, float), optional
        Smallest and largest value that the machine reaches. Columns beyond it in rad, and within it in degrees, are
        read as degrees.
    targets : mapping from input to coordinate, optional
        Inputs that are targets of coordinates, or of their derivatives.

    Raises
    ------
    ModelError
        A name is unknown or repeated, a text has line breaks, the number of residuals is wrong, a constant is NaN
        (such as ``math.sin`` of a symbol), Python code branches on a symbol, the residuals are not affine in the
        accelerations, the mass matrix is singular, or a sensor returns anything but one value.

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
        sensors: Mapping[str, Sensor] | None = None,
        description: str = "",
        ranges: Mapping[str, tuple[float, float]] | None = None,
        targets: Mapping[str, str] | None = None,
    ) -> None:
        parameters = with_parameters_of(f'model "{name}"', sensors, parameters)
        units = {n: x.unit for n, x in (sensors or {}).items()}
        groups = (coordinates, inputs, parameters, velocities, first_order or {})
        self._name_signals(name, *groups, description, units)
        self._name_ranges(ranges or {}, targets or {})
        if (velocities is None) != (kinematics is None):
            given, missing = ("velocities", "kinematics") if kinematics is None else ("kinematics", "velocities")
            raise ModelError(f'model "{name}": {given} without {missing}; give both, or neither')
        q, v, a, u, p = self._symbols()
        named = self.named(q, v, a, u, p)
        results = {"residual": derivation.call_user(self._label, "equations", equations, *named)}
        if kinematics is not None:
            results["kinematics"] = derivation.call_user(self._label, "kinematics", kinematics, *self.named(q, v))
        outputs = [derivation.call_sensor(self._label, n, x.equation, *named) for n, x in (sensors or {}).items()]
        if outputs:
            results["measurement"] = ca.vertcat(*outputs)
        self._restore(self._written((q, v, a, u, p), results))

    held_by: Callable[[Model], Sequence[HeldConstant]] | None = None
    """Maker of the constants that the model holds; a model that was stored has none."""

    notes: tuple[str, ...] = ()
    """Sentences on how the model was made, such as what its description lacks; a model that was stored has none."""

    @cached_property
    def held(self) -> tuple[HeldConstant, ...]:
        """Constants that are no parameters, such as masses of bodies in a description, and might be wrong."""
        return () if self.held_by is None else tuple(self.held_by(self))

    def _written(self, symbols: Sequence[ca.SX], results: Mapping[str, ca.SX]) -> dict[str, Any]:
        """Equations as data by name, checked; None for those that the model lacks."""
        written: dict[str, Any] = {"kinematics": None, "measurement": None}
        for name, expression in results.items():
            arguments, outputs = self._signature(name)
            function = ca.Function(name, list(symbols[: len(arguments)]), [expression], list(arguments), list(outputs))
            expressions.check_size(self._label, function)
            if name == "residual":
                derivation.check_residual(self._label, function, tuple(self.accelerations))
            elif name == "kinematics":
                derivation.check_kinematics(self._label, function)
            else:
                derivation.check_readings(self._label, function, tuple(self.sensors))
            written[name] = expressions.stored(self._label, function)
        return written

    def _signature(self, name: str) -> tuple[dict[str, int], dict[str, int]]:
        """Sizes of the arguments and of the result of the residual, the kinematics or the measurement."""
        if name == "kinematics":
            return {"q": self.n_q, "v": self.n_v}, {"q_dot": self.n_q}
        return self.argument_sizes, {"r": self.n_v} if name == "residual" else {"y": len(self.sensors)}

    def _restore(self, written: Mapping[str, Any]) -> None:
        """Make the functions of equations as data; those of a new model and of a loaded one are the same.

        Raises ResultError: the data are damaged.
        Raises ModelError: the equations are not those of a model.
        """
        self._equations_data = dict(written)
        made = {
            name: None if data is None else expressions.restored(name, data, *self._signature(name))
            for name, data in written.items()
        }
        if made["residual"] is None:
            raise ResultError("the stored model is damaged: it has no equations; identify again")
        self.residual: ca.Function = made["residual"]
        self.kinematics: ca.Function | None = made["kinematics"]
        self.measurement: ca.Function | None = made["measurement"]
        self._probe = Probe(self.residual, self.parameters.values())
        self._mass_matrix, self._bias = derivation.affine_in_acceleration(self._label, self._probe, self.accelerations)
        # 1 or -1 where M = dr/da is symmetric and positive or negative definite, so that r is a force; else 0.
        self.force_sign = derivation.mass_matrix_sign(self._label, self._probe, self._mass_matrix, self.accelerations)
        if self.measurement is not None:
            probe = Probe(self.measurement, self.parameters.values())
            derivation.check_sensors(self._label, probe, tuple(self.sensors))

    @cached_property
    def nonlinear_parameters(self) -> tuple[str, ...]:
        """Names of the parameters in which the residuals are not affine; empty where ``W p = b`` holds."""
        return derivation.nonlinear_parameters(self._probe, tuple(self.parameters))

    @cached_property
    def required_signals(self) -> tuple[str, ...]:
        """Names of the signals and inputs that the residuals depend on, which a pointwise estimator requires."""
        used = self._names_in(self.residual)
        return tuple(n for n in (*self.state, *self.accelerations, *self.inputs) if n in used)

    def _names_in(self, function: ca.Function, output: int | None = None) -> tuple[str, ...]:
        """Names of the states, accelerations, inputs and parameters that a result, or one element of it, depends on."""
        names = (*self.state, *self.accelerations, *self.inputs, *self.parameters)
        symbols = self._symbols()
        result = function(*symbols)
        depends = ca.which_depends(result if output is None else result[output], ca.vertcat(*symbols), 1, False)
        return tuple(n for n, d in zip(names, depends, strict=True) if d)

    def states_behind(self, signals: Iterable[str]) -> tuple[str, ...]:
        """Names of the states whose initial value affects the simulation of any of these signals."""
        wanted, (feeds, flows) = set(signals), self._dependence
        matter = np.any(feeds[[n in wanted for n in self.signals]], axis=0)
        for _ in self.state:
            matter = matter | np.any(flows[matter], axis=0)
        return tuple(n for n, m in zip(self.state, matter, strict=True) if m)

    @cached_property
    def _dependence(self) -> tuple[BoolArray, BoolArray]:
        """Dependence of the signals ``(n_signals, n_x)``, and of the states' rates ``(n_x, n_x)``, on the states."""
        x, u, p = self.dynamics.sx_in()
        rates, accelerations = self.dynamics(x, u, p)
        outputs = ca.vertcat(x, accelerations, self.readings(x, accelerations, u, p))
        feeds, flows = (np.array(ca.DM(ca.jacobian_sparsity(y, x), 1), dtype=bool) for y in (outputs, rates))
        return feeds, flows

    @cached_property
    def quaternions(self) -> tuple[tuple[int, int, int, int], ...]:
        """Indices of the coordinates that form unit quaternions, found by the norm that ``kinematics`` conserves."""
        return () if self.kinematics is None else derivation.find_quaternions(self.kinematics)

    # ------------------------------------------------------------------ sensors

    @cached_property
    def sensor_arguments(self) -> dict[str, tuple[str, ...]]:
        """Names of the states, accelerations, inputs and parameters that each sensor depends on."""
        if self.measurement is None:
            return {}
        return {name: self._names_in(self.measurement, k) for k, name in enumerate(self.sensors)}

    @cached_property
    def sensor_parameters(self) -> tuple[str, ...]:
        """Names of the parameters that sensors depend on, and no residual."""
        of_sensors = {n for used in self.sensor_arguments.values() for n in used}
        of_motion = set(self._names_in(self.residual))
        return tuple(n for n in self.parameters if n in of_sensors and n not in of_motion)

    @cached_property
    def biased_sensors(self) -> tuple[str, ...]:
        """Names of the sensors with a parameter that adds a constant to them."""
        if self.measurement is None:
            return ()
        symbols = self._symbols()
        slopes = ca.jacobian(self.measurement(*symbols), symbols[4])
        rows = (ca.horzsplit(slopes[k, :]) for k in range(len(self.sensors)))
        return tuple(
            n for n, row in zip(self.sensors, rows, strict=True) if any(x.is_constant() and float(x) for x in row)
        )

    @cached_property
    def affine_sensors(self) -> tuple[str, ...]:
        """Names of the sensors that are affine in the parameters."""
        return tuple(n for n in self.sensors if self._probe_of_sensor(n).is_affine_in_parameters())

    @property
    def is_affine(self) -> bool:
        """True if the residuals and all sensors are affine in the parameters."""
        return not self.nonlinear_parameters and len(self.affine_sensors) == len(self.sensors)

    @cached_property
    def sensor_regressor(self) -> ca.Function:
        """Function ``(q, v, a, u) -> (S (n_y, n_p), c (n_y))`` with ``y = S p + c`` for the sensors affine in p.

        Rows of the others are zero.
        """
        q, v, a, u, p = self._symbols()
        S, c = ca.SX(len(self.sensors), self.n_p), ca.SX(len(self.sensors), 1)
        for k, name in enumerate(self.sensors):
            if name in self.affine_sensors:
                S[k, :], c[k] = self._probe_of_sensor(name).affine_parts("p", (q, v, a, u, p))
        return ca.Function("sensor_regressor", [q, v, a, u], [ca.densify(S), ca.densify(c)], list("qvau"), ["S", "c"])

    @cached_property
    def readings(self) -> ca.Function:
        """Function ``(x, a, u, p) -> y``: the sensors, by the state and the accelerations that belong to it."""
        q, v, a, u, p = self._symbols()
        y = ca.SX(0, 1) if self.measurement is None else self.measurement(q, v, a, u, p)
        return ca.Function("readings", [ca.vertcat(q, v), a, u, p], [ca.densify(y)], ["x", "a", "u", "p"], ["y"])

    def with_sensors(self, names: Collection[str]) -> Model:
        """The model with some of its sensors, and without the parameters that only the others depend on.

        The model itself where it has no others.
        """
        kept = [n for n in self.sensors if n in names]
        if len(kept) == len(self.sensors):
            return self
        needed = {n for name in kept for n in self.sensor_arguments[name]}
        return self._with_constants({n: 0.0 for n in self.sensor_parameters if n not in needed}, kept)

    def sensors_of(self, arguments: Callable[..., Sequence[ca.SX]]) -> dict[str, Sensor]:
        """The sensors for another model, of whose symbols ``arguments(q, v, a, u, p)`` returns this model's vectors."""

        def output(k: int) -> Callable[..., ca.SX]:
            assert self.measurement is not None
            h = self.measurement
            return lambda *symbols: h(*arguments(*symbols))[k]

        return {name: Sensor(unit, output(k)) for k, (name, unit) in enumerate(self.sensors.items())}

    def _probe_of_sensor(self, name: str) -> Probe:
        """Probe of one of the measurement equations."""
        assert self.measurement is not None
        symbols = self.measurement.sx_in()
        y = self.measurement(*symbols)[list(self.sensors).index(name)]
        return Probe(ca.Function("sensor", symbols, [y]), self.parameters.values())

    # ------------------------------------------------------------------ derived functions

    @cached_property
    def regressor(self) -> ca.Function:
        """Function ``(q, v, a, u) -> (W (r, n_p), b (r))`` with ``W p = b`` for every solution, eqs. (1) and (5).

        Raises ModelError: the residuals are not affine in the parameters that the message names.
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
        x, u, p = self.rate_jacobians.sx_in()
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

        Raises ModelError: ``M`` is not symmetric and definite, so the residuals are not a balance of forces.
        """
        if self.force_sign == 0:
            raise ModelError(
                f"{self._label}: the mass matrix dr/da is not symmetric and definite, so the equations are not a "
                "balance of forces to which others could be added; write them as such, or give accelerations"
            )
        q, v, _, u, p = self._symbols()
        f = ca.SX.sym("f", self.n_v)
        a = self.force_sign * self._solve_mass(q, v, u, p, f)
        return ca.Function("force_response", [q, v, u, p, f], [ca.densify(a)], list("qvupf"), ["a"])

    def with_fixed(self, values: Mapping[str, float]) -> Model:
        """The model with constants in the equations in place of some parameters, each value in its unit.

        Raises ModelError: no parameter is left, or the equations with these constants are not those of a model.
        """
        return self._with_constants(values, self.sensors) if values else self

    def _with_constants(self, values: Mapping[str, float], sensors: Collection[str]) -> Model:
        """The model with constants in place of some parameters, and with some of its sensors."""

        def arguments(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[ca.SX]:
            own = ca.vertcat(*(values[n] if n in values else p[n] for n in self.parameters))
            return [*(ca.SX(ca.vertcat(*x)) for x in (q, v, a, u)), own]

        return self.with_equations(
            self.name,
            {n: x for n, x in self.parameters.items() if n not in values},
            lambda *symbols: [self.residual(*arguments(*symbols))],
            {n: x for n, x in self.sensors_of(arguments).items() if n in sensors},
        )

    def with_equations(
        self,
        name: str,
        parameters: Mapping[str, Parameter],
        equations: Callable[..., Sequence[Any]],
        sensors: Mapping[str, Sensor],
    ) -> Model:
        """Another model of the same coordinates, velocities and inputs, with the same kinematics."""

        def kinematics(q: Symbols, v: Symbols) -> list[Any]:
            assert self.kinematics is not None
            return [self.kinematics(ca.vertcat(*q), ca.vertcat(*v))]

        has_kinematics = self.kinematics is not None
        model = Model(
            name,
            self.coordinates,
            self.inputs,
            parameters,
            equations,
            velocities=self.velocities_of_motion if has_kinematics else None,
            kinematics=kinematics if has_kinematics else None,
            first_order=self.first_order,
            sensors=sensors,
            description=self.description,
            ranges=self.ranges,
            targets=self.targets,
        )
        model.held_by, model.notes = self.held_by, self.notes
        return model

    def _coordinate_rates(self, q: ca.SX, v: ca.SX) -> ca.SX:
        """Derivatives of the coordinates."""
        return v[: self.n_q, 0] if self.kinematics is None else self.kinematics(q, v)

    def _solve_mass(self, q: ca.SX, v: ca.SX, u: ca.SX, p: ca.SX, rhs: ca.SX) -> ca.SX:
        """``M^-1 rhs``: LDL^T where the probe found ``M`` symmetric and definite, CasADi's solve elsewhere.

        Raises ModelError: there would be too many operations.
        """
        M = ca.sparsify((self.force_sign or 1) * self._mass_matrix(q, v, u, p))
        M = ca.triu2symm(ca.triu(M)) if self.force_sign else M  # rounding may leave an entry in one triangle alone
        derivation.check_solution(self._label, M.sparsity(), rhs.size2(), symmetric=self.force_sign != 0)
        if self.force_sign == 0:
            return ca.solve(ca.densify(M), ca.densify(rhs))
        D, LT, order = ca.ldl(M)
        return self.force_sign * ca.ldl_solve(ca.densify(rhs), D, LT, order)

    def equations_text(self) -> tuple[str, ...]:
        """Every residual as readable text, ``0 = ...``, in the signals' names, and every sensor, ``name = ...``.

        Parts of very deep expressions come first, ``#1 = ...``.
        """
        names = dict(zip("qvaup", (list(x) for x in self._groups), strict=True))
        texts, n_parts = list[str](), 0
        for function, left in ((self.residual, ["0"] * self.n_v), (self.measurement, list(self.sensors))):
            if function is not None:
                parts, elements = expressions.printed(function, names, n_parts + 1)
                texts += [*parts, *(f"{x} = {y}" for x, y in zip(left, elements, strict=True))]
                n_parts += len(parts)
        return tuple(texts)

    @property
    def home(self) -> FloatArray:
        """State ``(n_x,)`` in which the machine begins if nothing else is known: zero, quaternions (1, 0, 0, 0)."""
        state = np.zeros(len(self.state))
        state[[four[0] for four in self.quaternions]] = 1.0
        return state

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
        """The model as JSON data, which `from_dict` reads."""
        data = self._to_dict()
        return {**data, "checksum": _checksum(data)}

    def _to_dict(self) -> dict[str, Any]:
        """Names, units, bounds and equations."""
        data = {
            "name": self.name,
            "description": self.description,
            "coordinates": self.coordinates,
            "velocities": None if self.kinematics is None else self.velocities_of_motion,
            "inputs": self.inputs,
            "parameters": {n: x.to_dict() for n, x in self.parameters.items()},
            "residual": self._equations_data["residual"],
            "kinematics": self._equations_data["kinematics"],
            **({"first_order": self.first_order} if self.first_order else {}),
        }
        if self.measurement is not None:
            data |= {"sensors": self.sensors, "measurement": self._equations_data["measurement"]}
        if self.ranges or self.targets:
            data |= {"ranges": {n: list(x) for n, x in self.ranges.items()}, "targets": self.targets}
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """The model that `to_dict` wrote.  Raises ResultError: the data are damaged."""
        try:
            if data["checksum"] != _checksum({k: x for k, x in data.items() if k != "checksum"}):
                raise ResultError("the stored model is damaged: its checksum does not match; identify again")
            return cls._from_checked(data)
        except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError, RuntimeError, ModelError) as error:
            reason = str(error).partition("\n")[0]
            raise ResultError(
                f"the stored model is damaged: {type(error).__name__}: {reason:.200}; identify again"
            ) from error

    @classmethod
    def _from_checked(cls, data: Mapping[str, Any]) -> Self:
        """The model of data with the right checksum.  Raises these errors, or ResultError, for others."""
        model = cls.__new__(cls)
        if not isinstance(data["name"], str) or not isinstance(data["description"], str):
            raise TypeError("name or description")
        parameters = {n: Parameter.from_dict(x) for n, x in data["parameters"].items()}
        units = (data["coordinates"], data["inputs"], parameters, data["velocities"], data.get("first_order", {}))
        model._name_signals(data["name"], *units, data["description"], data.get("sensors", {}))
        model._name_ranges(data.get("ranges", {}), data.get("targets", {}))
        has_kinematics, has_sensors = data["kinematics"] is not None, data.get("measurement") is not None
        if has_kinematics != (data["velocities"] is not None) or has_sensors != bool(model.sensors):
            raise ResultError("the stored model is damaged: its names do not fit its equations; identify again")
        model._restore(
            {"residual": data["residual"], "kinematics": data["kinematics"], "measurement": data.get("measurement")}
        )
        return model

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self).from_dict, (self.to_dict(),))

    def __repr__(self) -> str:
        first_order = f", first_order={list(self.first_order)}" if self.first_order else ""
        names = f"coordinates={list(self.coordinates)}{first_order}, parameters={list(self.parameters)}"
        return f"Model({self.name!r}, {names})"


def _checksum(data: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()
