"""Contents of an exported model, and its description in words."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.input_timing import InputTiming
from diransac.model import Model

__all__ = ["PortableModel"]

_HOLDS = {
    "zero-order": "the inputs were held between samples",
    "linear": "the inputs were interpolated linearly between samples: give a step the mean of those at its ends",
    "smooth": "the inputs were interpolated smoothly between samples: give a step their mean over it",
}


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
    """

    model: Model
    parameters: Mapping[str, float]
    standard_errors: Mapping[str, float]
    covariance: FloatArray
    samples: Mapping[str, FloatArray] = field(default_factory=dict)
    timing: InputTiming = field(default_factory=InputTiming)
    hold: str = "zero-order"

    @property
    def identifier(self) -> str:
        """Name of the model as an identifier of C and Python."""
        name = re.sub(r"[^A-Za-z0-9]+", "_", self.model.name).strip("_")
        return name if name and not name[0].isdigit() else f"model_{name}".rstrip("_")

    @property
    def version(self) -> str:
        """Name and version of the package."""
        return f"diransac {version('diransac')}"

    @property
    def input_delays(self) -> dict[str, float]:
        """Delay of each input, s; empty if none is delayed."""
        own = self.timing.own_delays or (0.0,) * self.model.n_u
        delays = {n: self.timing.delay + x for n, x in zip(self.model.inputs, own, strict=True)}
        return delays if any(delays.values()) else {}

    @property
    def remarks(self) -> list[str]:
        """Duties of a caller towards the inputs, a sentence each."""
        found = [f"In the identification, {_HOLDS[self.hold]}."]
        if self.input_delays:
            delays = ", ".join(f"{n} by {1e3 * x:.3g} ms" for n, x in self.input_delays.items())
            found.append(f"Recorded inputs act late; the caller delays {delays}.")
        if self.timing.lag:
            found.append(
                f"Recorded inputs act through a first-order lag; the caller filters them: time constant "
                f"{1e3 * self.timing.lag:.3g} ms."
            )
        if any(self.timing.gain_drifts):
            pairs = zip(self.model.inputs, self.timing.gain_drifts, strict=True)
            drifts = ", ".join(f"{n} by {100.0 * x:.2g} %" for n, x in pairs)
            found.append(f"Over the log, the gain of the inputs changed: {drifts}; this is not in the model.")
        if self.model.quaternions:
            found.append("A step normalises quaternions.")
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
