"""Contents of an exported model, and its description in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.data.input_timing import InputTiming
from diransac.model import Model
from diransac.plain_text import identifier
from diransac.text_table import duration


@dataclass(frozen=True)
class PortableModel:
    """A model with its estimates, as it is written for other programs.

    Parameters
    ----------
    model : Model
        Equations of motion.
    parameters : mapping of str to float
        Estimate of each parameter in its unit, in the model's order.
    standard_errors : mapping of str to float
        Standard error of each in its unit; infinite where it is not known.
    covariance : (n_p, n_p) array
        Covariance of the estimates.
    samples : mapping of str to (n,) array, optional
        Draws from the joint distribution of the parameters; empty where there is none.
    timing : InputTiming, optional
        Delays and lag after which recorded inputs act, and the drift of their gains.
    hold : str, optional
        Inputs between samples: "zero-order", "linear" or "smooth".
    per_log : mapping of str to tuple of float, optional
        Values of each parameter that has one per log; what is exported is their mean.
    name : str, optional
        Name in the file, of which the names of C's functions begin; empty: that of the model.
    intervals, structural_intervals : mapping of str to (float, float), optional
        95 % interval of each parameter if the model is complete, and if it may lack a term; empty where not known.
    """

    model: Model
    parameters: Mapping[str, float]
    standard_errors: Mapping[str, float]
    covariance: FloatArray
    samples: Mapping[str, FloatArray] = field(default_factory=dict)
    timing: InputTiming = field(default_factory=InputTiming)
    hold: str = "zero-order"
    per_log: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    name: str = ""
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    structural_intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def of_sensors(self) -> tuple[str, ...]:
        """Parameters of sensors alone, on which the motion does not depend."""
        model = self.model
        if not model.sensors or not model.has_equations:
            return tuple(model.sensor_parameters)
        x, u, p = model.dynamics.sx_in()
        depends = ca.which_depends(model.dynamics(x, u, p)[0], p, 1, False)
        return tuple(n for n, used in zip(model.parameters, depends, strict=True) if not used)

    @property
    def identifier(self) -> str:
        """Name of the model as an identifier of C and CasADi."""
        return identifier(self.name or self.model.name)

    @property
    def version(self) -> str:
        """Name and version of the package."""
        return f"diransac {version('diransac')}"

    @property
    def input_delays(self) -> dict[str, float]:
        """Delay of each input, s; empty if none is delayed."""
        return self._by_input(self.timing.delays)

    @property
    def input_lags(self) -> dict[str, float]:
        """Time constant of each input's actuator, s; empty if none has a lag."""
        return self._by_input(self.timing.lags)

    def _by_input(self, times: tuple[float, ...]) -> dict[str, float]:
        of_each = times if len(times) > 1 else times * self.model.n_u
        return dict(zip(self.model.inputs, of_each, strict=True)) if any(times) else {}

    @property
    def remarks(self) -> list[str]:
        """Duties of a caller towards the inputs, a sentence each."""
        between = {
            "zero-order": "held between samples",
            "linear": "interpolated linearly between samples: give a step the mean of those at its ends",
            "smooth": "interpolated smoothly between samples: give a step their mean over it",
        }
        found = [f"In the identification, the inputs were {between[self.hold]}."]
        if self.input_delays:
            delays = ", ".join(f"{n} by {duration(x)}" for n, x in self.input_delays.items())
            found.append(f"Recorded inputs act late; the caller delays {delays}.")
        if self.input_lags:
            lags = ", ".join(f"{duration(x)} of {n}" for n, x in self.input_lags.items())
            found.append(f"The caller filters recorded inputs by first-order lags with the time constants {lags}.")
        if any(self.timing.gain_drifts):
            pairs = zip(self.model.inputs, self.timing.gain_drifts, strict=True)
            drifts = ", ".join(f"{n} by {100.0 * x:.2g} %" for n, x in pairs)
            found.append(f"Over the log, the gain of the inputs changed: {drifts}; this is not in the model.")
        if self.model.quaternions:
            found.append("A step normalises quaternions.")
        for name, values in self.per_log.items():
            each = ", ".join(f"{x:.6g}" for x in values)
            found.append(f"{name} has a value for each log ({each}); what stands here is their mean.")
        if self.of_sensors:
            found.append(f"The motion does not depend on {', '.join(self.of_sensors)}: they describe sensors.")
        return found

    def description(self) -> Iterator[str]:
        """Lines that name the states, inputs and parameters in order, with units, values and standard errors."""
        yield f"{self.model.name}: model identified by {self.version}"
        yield ""
        for title, symbol, names in (("States", "x", self.model.state), ("Inputs", "u", tuple(self.model.inputs))):
            yield f"{title}:" if names else f"{title}: none"
            width = max(map(len, names), default=0)
            yield from (f"  {symbol}[{k}]  {n:{width}}  {_unit(self.model.units[n])}" for k, n in enumerate(names))
        yield "Parameters, with standard errors:"
        width = max(map(len, self.parameters))
        for k, (name, value) in enumerate(self.parameters.items()):
            error = self.standard_errors[name]
            spread = f"+- {error:.2g}" if np.isfinite(error) else "(standard error unknown)"
            yield f"  p[{k}]  {name:{width}}  {value:.10g} {spread}  {_unit(self.model.parameters[name].unit)}"
        yield ""
        yield from self.remarks


def _unit(unit: str) -> str:
    return unit or "1"
