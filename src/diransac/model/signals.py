"""`Signals`: names, units and sizes of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model import derivation
from diransac.model.derivation import Symbols
from diransac.model.parameter import Parameter


class Signals:
    """Coordinates, velocities, accelerations, inputs, parameters and sensors of a model by name, with their units.

    A model without ``kinematics`` has the derivatives of its coordinates as velocities, ``x_dot`` of ``x``.
    """

    has_equations = True
    """True where the residuals are known as expressions; otherwise a simulator alone knows the machine."""
    kinematics: ca.Function | None

    def _name_signals(
        self,
        name: str,
        coordinates: Mapping[str, str],
        inputs: Mapping[str, str],
        parameters: Mapping[str, Parameter],
        velocities: Mapping[str, str] | None,
        first_order: Mapping[str, str],
        description: str,
        sensors: Mapping[str, str],
    ) -> None:
        derivation.check_texts({"name": name, "description": description})
        self.name, self.description, self.sensors = name, description, dict(sensors)
        units = {"coordinates": coordinates, "inputs": inputs, "velocities": velocities or {}}
        derivation.check_groups(self._label, {**units, "first_order": first_order, "sensors": sensors}, parameters)
        self.coordinates, self.inputs, self.parameters = dict(coordinates), dict(inputs), dict(parameters)
        self.first_order = dict(first_order)
        if velocities is None:
            of_motion = {f"{q}_dot": _per_second(unit) for q, unit in coordinates.items()}
            accelerations = {f"{q}_ddot": _per_second(unit, 2) for q, unit in coordinates.items()}
        else:
            of_motion = dict(velocities)
            accelerations = {f"{v}_dot": _per_second(unit) for v, unit in velocities.items()}
        rates = {f"{s}_dot": _per_second(unit) for s, unit in first_order.items()}
        groups = (coordinates, of_motion, first_order, accelerations, rates, inputs, parameters, sensors)
        derivation.check_names(self._label, groups, masks=not self.has_equations)
        self.velocities, self.accelerations = {**of_motion, **self.first_order}, {**accelerations, **rates}

    def _name_ranges(self, ranges: Mapping[str, Sequence[float]], targets: Mapping[str, str]) -> None:
        """Take the ranges of coordinates, and the coordinates that inputs are targets of.

        Raises ModelError: a name is unknown, or a range is none.
        """
        for what, own, known in (
            ("ranges", ranges, self.coordinates),
            ("targets", targets, self.inputs),
            ("targets", targets.values(), self.coordinates),
        ):
            for name in own:
                if name not in known:
                    raise ModelError(f"{self._label}: {what}: there is no {name!r}; found {', '.join(known)}")
        for name, (low, high) in ranges.items():
            if not low < high:
                raise ModelError(f"{self._label}: the range of {name} is {low:g} to {high:g}; give low < high")
        self.ranges = {name: (float(low), float(high)) for name, (low, high) in ranges.items()}
        self.targets = dict(targets)

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
        """Names of the simulated signals: coordinates, velocities, accelerations, sensors."""
        return (*self.state, *self.accelerations, *self.sensors)

    @property
    def units(self) -> dict[str, str]:
        """Unit of every signal and input by name."""
        return {**self.coordinates, **self.velocities, **self.accelerations, **self.sensors, **self.inputs}

    @property
    def argument_sizes(self) -> dict[str, int]:
        """Number of elements of the arguments q, v, a, u and p."""
        return {"q": self.n_q, "v": self.n_v, "a": self.n_v, "u": self.n_u, "p": self.n_p}

    @property
    def argument_names(self) -> tuple[tuple[str, ...], ...]:
        """Names of the elements of the arguments q, v, a, u and p in the equations."""
        rates = self.rate_names
        return tuple(self.coordinates), rates, rates, tuple(self.inputs), tuple(self.parameters)

    def _symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        q, v, a, u, p = (ca.vertcat(*(ca.SX.sym(n) for n in names)) for names in self._groups)
        return q, v, a, u, p

    @property
    def _groups(self) -> tuple[Mapping[str, Any], ...]:
        """Names behind the arguments q, v, a, u and p."""
        return (self.coordinates, self.velocities, self.accelerations, self.inputs, self.parameters)

    @property
    def rate_names(self) -> tuple[str, ...]:
        """Names of velocities and accelerations in the equations: ``theta``, not ``theta_dot``."""
        of_motion = self.velocities_of_motion
        are_derivatives = list(of_motion) == [f"{q}_dot" for q in self.coordinates]
        return (*(self.coordinates if are_derivatives else of_motion), *self.first_order)

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
        kinds = ("coordinates", "velocities", "accelerations", "inputs", "parameters")
        return tuple(
            Symbols(self._label, kind, dict(zip(names, ca.vertsplit(x), strict=True)))
            for kind, names, x in zip(kinds, self.argument_names, vectors, strict=False)
        )

    def parameter_vector(self, parameters: Mapping[str, float]) -> FloatArray:
        """Values ``(n_p,)`` in the model's order.

        Raises ModelError: a name is missing or unknown, or its value is not finite.
        """
        if set(parameters) != set(self.parameters):
            raise ModelError(
                f"{self._label}: parameters are {', '.join(self.parameters)}; found {', '.join(map(str, parameters))}"
            )
        values = np.array([parameters[n] for n in self.parameters], dtype=float)
        if not np.isfinite(values).all():
            bad = [n for n, x in zip(self.parameters, values, strict=True) if not np.isfinite(x)]
            raise ModelError(f"{self._label}: parameter {bad[0]} is {parameters[bad[0]]}; give a finite number")
        return values


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
