"""What a test identifies: a model and logs with the truth, or with a judge of held-out logs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import diransac as dr

Array = np.ndarray[Any, Any]
Identified = Callable[[str], dr.Result]


@dataclass(frozen=True)
class Case:
    """One log, or several of one machine.

    Parameters
    ----------
    model, logs : what ``dr.identify`` is given
    error : of an identification: of its parameters, or of the held-out logs that it predicts, in the row's unit
    truth : by name, values that intervals must hold; empty of records, whose truth nobody knows
    identified : by the name of a method, the identification; None: ``dr.identify`` with derived velocities
    """

    model: dr.Model
    logs: Sequence[dr.Log]
    error: Callable[[dr.Result], float]
    truth: Mapping[str, float] = field(default_factory=dict)
    identified: Identified | None = None

    def identify(self, method: str) -> dr.Result:
        """The answer of a method, as a user gets it without any setting."""
        if self.identified is not None:
            return self.identified(method)
        logs = self.logs[0] if len(self.logs) == 1 else list(self.logs)
        return dr.identify(self.model, logs, method, differentiate=True)


def values_of(result: dr.Result) -> dict[str, float]:
    """Estimates by the names that intervals have, ``offset[0]`` for a parameter's value in the first log."""
    per_log = {f"{name}[{k}]": x for name, values in result.per_log.items() for k, x in enumerate(values)}
    return {**result.parameters, **per_log}


def worst_of(truth: Mapping[str, float], *left_out: str) -> Callable[[dr.Result], float]:
    """Error, %, of the worst parameter; of those that the model can have right where it lacks something."""

    def error(result: dr.Result) -> float:
        found = values_of(result)
        return max(100.0 * abs(found[name] / x - 1.0) for name, x in truth.items() if name not in left_out)

    return error
