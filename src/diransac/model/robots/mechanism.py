"""Forces of a robot's joints by what is known and unknown of it, as the equations and parameters of a model.

Forces are linear in the parameters, ``F = Y(q, v, a) x``.  Columns of Y that vanish, or that are combinations of others
for every motion, are found numerically, from many random motions (Gautier 1991, "Numerical calculation of the base
inertial parameters of robots", Journal of Robotic Systems 8(4)).
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.derivation import Symbols
from diransac.model.held import HeldConstant
from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.robots.actuation import Actuation, targets_among
from diransac.model.robots.description import Coupling, Description, Joint
from diransac.model.robots.rigid_body import INERTIAL_NAMES, inertial_parameters, inverse_dynamics, pseudo_inertia


class _Motion(NamedTuple):
    """Position, velocity and acceleration of a joint, and its velocity per velocity of its coordinate."""

    q: Any
    v: Any
    a: Any
    slope: Any
    coordinate: str | None


_UNITS = {
    "armature": ("kg m^2", "kg"),
    "damping": ("N m s/rad", "N s/m"),
    "friction": ("N m", "N"),
    "stribeck": ("N m", "N"),
    "spring": ("N m/rad", "N/m"),
    "offset": ("N m", "N"),
}
"""Units of the parameters to which forces of a joint are proportional, of hinges and of slides."""

_GAIN, _BIAS = "torque_gain", "encoder_bias"
UNKNOWN = (*_UNITS, _GAIN, _BIAS)
"""Parameters of joints that can be unknown."""

_BASE = {"base_w{}": "rad/s", "base_w{}_dot": "rad/s^2", "base_f{}": "m/s^2"}
"""Inputs of a measured base."""


@dataclass(frozen=True)
class Mechanism:
    """Joints and bodies of a description with what is unknown of them.

    Parameters
    ----------
    label : str
        Subject of messages.
    description : Description
    coordinates : mapping of str to int
        Index of the joint of each coordinate.
    unknown, bodies : tuple of str, tuple of int
        Unknown parameters of joints; indices of the bodies of which inertial parameters are unknown.
    speeds : (float, float)
        Of smoothed friction, and of the Stribeck effect.
    """

    label: str
    description: Description
    coordinates: Mapping[str, int]
    unknown: tuple[str, ...]
    bodies: tuple[int, ...]
    speeds: tuple[float, float]

    def model(self, actuation: Actuation, passive: Collection[str]) -> Model:
        """The model with these drives."""
        driven = [name for name in self.coordinates if name not in passive]

        def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[Any]:
            position = {n: q[n] - p[f"{_BIAS}_{n}"] if _BIAS in self.unknown else q[n] for n in self.coordinates}
            base = [ca.vertcat(*(u[n] for n in names)) for names in self._base_inputs]
            forces = self.forces(position, v, a, self._values(p), base)
            for n in driven:
                drive = actuation.force(n, q[n], v[n], u)
                forces[n] -= p[f"{_GAIN}_{n}"] * drive if _GAIN in self.unknown else drive
            return [ca.cse(ca.vertcat(*forces.values()))]

        units = {n: ("rad", "N m") if self._joint(n).turns else ("m", "N") for n in self.coordinates}
        drives = {n: actuation.inputs(n, units[n]) for n in driven}
        limits = {n: self._joint(n).position_limits for n in self.coordinates}
        model = Model(
            name=self.description.name,
            description=f"robot with {len(units)} joints, from its description",
            coordinates={n: position for n, (position, _) in units.items()},
            inputs={name: unit for own in drives.values() for name, unit in own.items()}
            | {n: unit for names, unit in zip(self._base_inputs, _BASE.values(), strict=False) for n in names},
            parameters=self.parameters(driven),
            equations=equations,
            ranges={n: x for n, x in limits.items() if np.isfinite(x).all() and x[0] < x[1]},
            targets=targets_among(drives, units),
        )
        model.held_by = self.held
        return model

    def held(self, model: Model) -> list[HeldConstant]:
        """Masses, at their centres, and inertias, about these, of the moving bodies that the description fixes.

        Parameters
        ----------
        model : Model
            Of this mechanism.
        """
        q, v, a, u, _ = symbols = [ca.SX.sym(n, size) for n, size in model.argument_sizes.items()]
        named = model.named(*symbols)
        base = [ca.vertcat(*(named[3][n] for n in names)) for names in self._base_inputs]
        fixed = [i for i, x in enumerate(self.description.bodies) if i not in self.bodies and x.inertial[3, 3] > 0.0]
        changes = {i: ca.SX.sym(f"changes_{i}", 2) for i in fixed}
        everything = ca.vertcat(*changes.values())
        values = {n: x.value for n, x in self.nominal.items()}
        forces = self.forces(named[0], named[1], named[2], values, base, changes)
        effects = ca.jacobian(ca.vertcat(*forces.values()), everything)
        found = []
        for k, i in enumerate(fixed):
            body, mass = self.description.bodies[i].name, float(self.description.bodies[i].inertial[3, 3])
            for j, (kind, unit, least) in enumerate((("mass", "kg", -mass), ("inertia", "1", -1.0))):
                h = effects[:, 2 * k + j]
                if h.nnz():
                    effect = ca.Function("effect", [q, v, a, u], [ca.densify(h)])
                    label, option = f"{kind}_change_{identifier(body)}", f"--bodies {body}"
                    found.append(HeldConstant(f"{kind} of a body", body, label, unit, option, least, effect))
        return found

    @property
    def _base_inputs(self) -> list[list[str]]:
        """Names of the inputs of angular velocity, angular acceleration and specific force of a measured base."""
        return [] if self.description.base is None else [[key.format(axis) for axis in "xyz"] for key in _BASE]

    def _joint(self, coordinate: str) -> Joint:
        return self.description.joints[self.coordinates[coordinate]]

    # ------------------------------------------------------------------ parameters

    @cached_property
    def nominal(self) -> dict[str, Parameter]:
        """Parameters to which forces are proportional, before they are grouped, with their values in the file."""
        found = {}
        for n in self.coordinates:
            joint = self._joint(n)
            for kind in (x for x in self.unknown if x in _UNITS):
                unit, lower = _UNITS[kind][0 if joint.turns else 1], -np.inf if kind == "offset" else 0.0
                place = ((f"{kind} {joint.name}", 1.0),)
                value = _nominal(joint)[kind]
                found[f"{kind}_{n}"] = Parameter(unit, lower=lower, value=value, combination=place)
        for body in (self.description.bodies[i] for i in self.bodies):
            values = dict(zip(INERTIAL_NAMES, inertial_parameters(body.inertial).tolist(), strict=True))
            # Order in which inertial parameters of a body are kept as base parameters: the mass goes
            # first.
            for kind in (*INERTIAL_NAMES[1:], INERTIAL_NAMES[0]):
                positive = kind in ("mass", "Ixx", "Iyy", "Izz") and values[kind] > 0.0
                unit = "kg" if kind == "mass" else "kg m" if kind.startswith("h") else "kg m^2"
                found[f"{kind}_{identifier(body.name)}"] = Parameter(
                    unit, positive=positive, value=values[kind], combination=((f"{kind} {body.name}", 1.0),)
                )
        return found

    @cached_property
    def groups(self) -> dict[str, dict[str, float]]:
        """Weights of the parameters that each base parameter combines, by the name of the one that stands for it."""
        names = list(self.nominal)
        if not self.bodies:
            return {n: {n: 1.0} for n in names}
        q, v, a, x = (
            ca.SX.sym(n, size) for n, size in (*((n, len(self.coordinates)) for n in "qva"), ("x", len(names)))
        )
        at = [dict(zip(self.coordinates, ca.vertsplit(y), strict=True)) for y in (q, v, a)]
        values = dict(zip(names, ca.vertsplit(x), strict=True))
        base = [ca.SX.sym("base", 3) for _ in self._base_inputs]
        forces = ca.vertcat(*self.forces(at[0], at[1], at[2], values, base).values())
        regressor = ca.Function("regressor", [q, v, a, *base], [ca.densify(ca.jacobian(forces, x))])
        found = _base_parameters(regressor, names)
        seen = {name for weights in found.values() for name in weights}
        for i in self.bodies:
            body = self.description.bodies[i].name
            if not any(f"{kind}_{identifier(body)}" in seen for kind in INERTIAL_NAMES):
                raise ModelError(f'{self.label}: body "{body}" does not move with the joints; leave it out of bodies')
        return found

    def parameters(self, driven: Collection[str]) -> dict[str, Parameter]:
        """Base parameters, and those of drives and encoders."""
        found = {}
        for name, weights in self.groups.items():
            parameter = self.nominal[name]
            if len(weights) > 1:
                value = sum(weight * float(self.nominal[n].value or 0.0) for n, weight in weights.items())
                places = tuple((self.nominal[n].combination[0][0], weight) for n, weight in weights.items())
                parameter = Parameter(parameter.unit, value=value, combination=places)
            found[_base_name(name, weights)] = parameter
        for n in driven if _GAIN in self.unknown else ():
            place = ((f"{_GAIN} {self._joint(n).name}", 1.0),)
            found[f"{_GAIN}_{n}"] = Parameter("1", positive=True, value=1.0, combination=place)
        for n in self.coordinates if _BIAS in self.unknown else ():
            joint = self._joint(n)
            place = ((f"{_BIAS} {joint.name}", 1.0),)
            unit, turn = ("rad", np.pi) if joint.turns else ("m", np.inf)  # a whole turn more is the same bias
            found[f"{_BIAS}_{n}"] = Parameter(unit, lower=-turn, upper=turn, value=0.0, combination=place)
        if not found:
            raise ModelError(f"{self.label}: nothing is unknown; name unknown parameters of joints, or bodies")
        return found

    def _values(self, p: Symbols) -> dict[str, Any]:
        """Values of all `nominal` parameters by the base parameters: those that these replace have the file's."""
        values: dict[str, Any] = {n: x.value for n, x in self.nominal.items()}
        for name, weights in self.groups.items():
            others = sum(weight * values[n] for n, weight in weights.items() if n != name)
            values[name] = p[_base_name(name, weights)] - others
        return values

    # ------------------------------------------------------------------ forces

    def forces(
        self,
        q: Any,
        v: Any,
        a: Any,
        values: Mapping[str, Any],
        base: Sequence[ca.SX],
        changes: Mapping[int, ca.SX] | None = None,
    ) -> dict[str, Any]:
        """Force that a motion takes, by coordinate, with values of the `nominal` parameters, and of a measured base.

        ``changes`` are those of the mass of some bodies at its centre, kg, and of the inertia about it, over its value.
        """
        motions = self.motions(q, v, a)
        inertials = [self._inertial(i, values) for i in range(len(self.description.bodies))]
        for i, (mass, inertia) in ((i, ca.vertsplit(x)) for i, x in (changes or {}).items()):
            J = self.description.bodies[i].inertial
            point = np.outer(J[:, 3], J[:, 3]) / J[3, 3] ** 2
            inertials[i] = J + mass * ca.DM(point) + inertia * ca.DM(J - J[3, 3] * point)
        q, v, a = ([x[k] for x in motions] for k in range(3))
        of_joints = inverse_dynamics(self.description, q, v, a, inertials, base)
        forces: dict[str, Any] = dict.fromkeys(self.coordinates, ca.SX(0))
        for joint, x, force in zip(self.description.joints, motions, of_joints, strict=True):
            if x.coordinate is not None:
                forces[x.coordinate] += x.slope * (force + self._own_force(joint, x, values))
        return forces

    def _own_force(self, joint: Joint, x: _Motion, values: Mapping[str, Any]) -> Any:
        """Force of armature, spring, damping and friction of a joint."""
        unknown: Mapping[str, Any] = values if joint is self._joint(str(x.coordinate)) else {}
        nominal, force = _nominal(joint), 0.0
        for kind, signal in _signals(joint, x, self.speeds).items():
            force += unknown.get(f"{kind}_{x.coordinate}", nominal[kind]) * signal
        stretch = x.q - joint.spring_reference
        force += sum(c * ca.fabs(x.v) ** k * x.v for k, c in enumerate(joint.damping[1:], 1))
        return force + sum(c * stretch ** (k + 1) for k, c in enumerate(joint.stiffness[1:], 1))

    def _inertial(self, i: int, values: Mapping[str, Any]) -> Any:
        """Pseudo-inertia of a body."""
        body = self.description.bodies[i]
        if i not in self.bodies:
            return body.inertial
        return pseudo_inertia([values[f"{kind}_{identifier(body.name)}"] for kind in INERTIAL_NAMES])

    def motions(self, q: Any, v: Any, a: Any) -> list[_Motion]:
        """Motion of every joint of the description, from those of the coordinates: its own, coupled to one, or none."""
        found = [_Motion(joint.reference, 0.0, 0.0, 0.0, None) for joint in self.description.joints]
        for n, k in self.coordinates.items():
            found[k] = _Motion(q[n], v[n], a[n], 1.0, n)
        for coupling in ordered_couplings(self.label, self.description):
            joint = self.description.joints[coupling.follower]
            found[coupling.follower] = self._followed(coupling, joint, found)
        return found

    def _followed(self, coupling: Coupling, joint: Joint, found: Sequence[_Motion]) -> _Motion:
        """Motion of a joint that another determines."""
        c = coupling.coefficients
        y = followed(self.description, coupling, [x.q for x in found])
        if coupling.leader is None:
            return _Motion(y, 0.0, 0.0, 0.0, None)
        leader = found[coupling.leader]
        x = leader.q - self.description.joints[coupling.leader].reference
        slope = sum(k * b * x ** (k - 1) for k, b in enumerate(c) if k > 0)
        curvature = sum(k * (k - 1) * b * x ** (k - 2) for k, b in enumerate(c) if k > 1)
        a = slope * leader.a + curvature * leader.v**2
        return _Motion(y, slope * leader.v, a, slope * leader.slope, leader.coordinate)


# ---------------------------------------------------------------------- base parameters


def _base_parameters(regressor: ca.Function, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Weights of the parameters that each base parameter combines, by the name of the first of them.

    Parameters that no motion shows are in none.

    Parameters
    ----------
    regressor : casadi.Function
        ``(q, v, a) -> Y (n, n_x)``, or ``(q, v, a, w, dw, f) -> Y`` with the motion of a base.
    names : (n_x,) sequence of str
    """
    n, n_x = regressor.size1_in(0), len(names)
    # Rounding error of a column relative to the largest, and of weights between columns of unit length.
    rounding = 1e-9
    rng = np.random.default_rng(0)
    n_points = 3 * n_x // n + 10
    sizes = [regressor.size1_in(k) for k in range(regressor.n_in())]
    # Of random motions: position, velocity, acceleration; angular velocity and acceleration of a base, specific
    # force.
    motion = [
        rng.uniform(-x, x, (size, n_points))
        for x, size in zip((np.pi, 3.0, 10.0, 3.0, 10.0, 15.0), sizes, strict=False)
    ]
    stacked = np.hsplit(np.array(ca.densify(regressor(*motion))), n_points)
    Y = np.vstack(stacked)
    lengths = np.linalg.norm(Y, axis=0)
    seen = lengths > rounding * lengths.max()
    Y, lengths = np.where(seen, Y / np.where(seen, lengths, 1.0), 0.0), np.where(seen, lengths, 1.0)
    kept = _independent_columns(Y)
    dropped = [k for k in range(n_x) if k not in kept]
    weights = np.linalg.lstsq(Y[:, kept], Y[:, dropped])[0] if kept and dropped else np.zeros((len(kept), len(dropped)))
    weights[np.abs(weights) < rounding] = 0.0
    weights *= lengths[dropped] / lengths[kept, None]
    # Decimal digits of weights, which are products of lengths in m.
    rows = np.round(weights, 10).tolist()
    return {
        names[k]: {names[k]: 1.0, **{names[l]: w for l, w in zip(dropped, row, strict=True) if w != 0.0}}
        for k, row in zip(kept, rows, strict=True)
    }


def _independent_columns(Y: FloatArray) -> list[int]:
    """Indices of the columns of unit length that are no combination of those before them, by Gram-Schmidt, twice."""
    kept, basis = list[int](), np.zeros((len(Y), 0))
    for k, column in enumerate(Y.T):
        rest = column - basis @ (basis.T @ column)
        rest = rest - basis @ (basis.T @ rest)
        size = float(np.linalg.norm(rest))
        # Share of a column, at most, that is left of it beside the others where it is their combination.
        # Angles in descriptions are rounded: 1.5708 is a right angle. What such an error shows of a parameter
        # is nothing.
        if size > 1e-4:
            kept.append(k)
            basis = np.column_stack([basis, rest / size])
    return kept


# ---------------------------------------------------------------------- forces of a joint


def _nominal(joint: Joint) -> dict[str, float]:
    """Values of a joint's parameters in the description."""
    return {
        "armature": joint.armature,
        "damping": joint.damping[0],
        "friction": joint.friction,
        "stribeck": 0.0,
        "spring": joint.stiffness[0],
        "offset": 0.0,
    }


def _signals(joint: Joint, x: _Motion, speeds: tuple[float, float]) -> dict[str, Any]:
    """Force of a joint per unit of each of its parameters; speeds are those of smoothing and of the Stribeck effect."""
    friction = ca.tanh(x.v / speeds[0])
    return {
        "armature": x.a,
        "damping": x.v,
        "friction": friction,
        "stribeck": friction * ca.exp(-((x.v / speeds[1]) ** 2)),
        "spring": x.q - joint.spring_reference,
        "offset": 1.0,
    }


# ---------------------------------------------------------------------- names and couplings


def identifier(name: str) -> str:
    """A name with letters, digits and underscores alone."""
    found = re.sub(r"\W", "_", name)
    return f"_{found}" if found[:1].isdigit() else found


def _base_name(name: str, weights: Mapping[str, float]) -> str:
    return f"{name}_grouped" if len(weights) > 1 else name


def followed(description: Description, coupling: Coupling, q: Sequence[Any]) -> Any:
    """Position of a joint that another determines, from those of all."""
    reference, c = description.joints[coupling.follower].reference, coupling.coefficients
    if coupling.leader is None:
        return reference + c[0]
    x = q[coupling.leader] - description.joints[coupling.leader].reference
    return reference + sum(b * x**k for k, b in enumerate(c))


def ordered_couplings(label: str, description: Description) -> list[Coupling]:
    """Couplings, each after that of its leader.  Raises ModelError: they are circular, or contradict each other."""
    left = {x.follower: x for x in description.couplings}
    if len(left) < len(description.couplings):
        raise ModelError(f"{label}: a joint follows two others by equality constraints; remove one of them")
    ordered = list[Coupling]()
    while left:
        ready = [x for x in left.values() if x.leader not in left]
        if not ready:
            raise ModelError(f"{label}: equality constraints couple joints in a circle; remove one of them")
        ordered += ready
        left = {k: x for k, x in left.items() if x not in ready}
    return ordered
