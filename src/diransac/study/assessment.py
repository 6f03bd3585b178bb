"""Assessment of estimates against the pseudo-true parameters of a flight.

The pseudo-true parameters are those of the model that is closest to the disturbed plant, in the sense of least squares
on a flight without noise. They differ from the plant's own where a disturbance lies in the regressor's column space:
an excess of thrust in proportion to the thrust, as aerodynamic imbalance causes, is equivalent to a smaller mass.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray
from diransac.data.dataset import Dataset
from diransac.data.log import Log
from diransac.errors import IdentificationError
from diransac.identification.regression.estimators import Estimator, OrdinaryLeastSquares
from diransac.identification.regression.nonlinear import NonlinearLeastSquares
from diransac.identification.structure.identifiability import of_log
from diransac.model.plant import DisturbedModel, Plant
from diransac.simulation.compiler import compile_map


@dataclass(frozen=True)
class PlantFacts:
    """Properties of a plant that summaries need and that stores keep, so that a user's file need not be present.

    Parameters
    ----------
    units : state of the model -> unit, in order
    parameters : true parameters by name, in order
    disturbed : True if a disturbance acts on the plant that its model leaves out
    """

    units: Mapping[str, str]
    parameters: Mapping[str, float]
    disturbed: bool

    @classmethod
    def from_dict(cls, facts: Mapping[str, Any]) -> PlantFacts:
        """Properties as a store holds them.  Raises TypeError, KeyError: they are none."""
        units, parameters, disturbed = facts["units"], facts["parameters"], facts["disturbed"]
        if not units or not all(isinstance(unit, str) for unit in units.values()) or type(disturbed) is not bool:
            raise TypeError("properties of a plant")
        if any(type(value) not in (int, float) for value in parameters.values()):
            raise TypeError("parameters of a plant")
        return cls(dict(units), {name: float(value) for name, value in parameters.items()}, disturbed)

    @classmethod
    def of(cls, plant: Plant) -> PlantFacts:
        """Properties of a plant."""
        units = {name: plant.model.units[name] for name in plant.model.state}
        return cls(units, dict(plant.parameters), is_disturbed(plant))


def pseudo_true_parameters(plant: Plant, log: Log) -> dict[str, float]:
    """Least-squares parameters of the model, by name, on a flight without noise and without vibration.

    Accelerations are those of `mean_accelerations`: the mean effect of the plant's disturbances remains, vibration is
    averaged out. Without a mean disturbance these are the plant's own parameters. Equations are fitted where the model
    is affine in its parameters, accelerations otherwise, as the methods ``ols`` and ``nls`` do.

    Parameters
    ----------
    plant : that flew, disturbances included
    log : of the flight, as `fly` returns it

    Raises
    ------
    IdentificationError
        The flight does not determine the parameters even without noise.
    """
    model = plant.model
    columns = dict(zip(model.accelerations, mean_accelerations(plant, log).T, strict=True))
    calm = Log.from_arrays(log.time, {**log.signals, **columns}, log.units, source="vibration-free log")
    estimator: Estimator = NonlinearLeastSquares() if model.nonlinear_parameters else OrdinaryLeastSquares()
    bound = estimator.bind(Dataset.of(model, calm))
    selected = bound.select([np.arange(bound.n_rows)])
    if not selected.well_defined()[0]:
        loose = ", ".join(name for x in of_log(list(model.parameters), bound.null_space()) for name in x.names)
        raise IdentificationError(
            f"the flight without noise does not determine {loose or 'the parameters'}: there are no pseudo-true "
            "parameters to compare with; fly more for data, or leave evaluation.parameters out"
        )
    return dict(zip(model.parameters, selected.fit()[0].tolist(), strict=True))


def mean_accelerations(plant: Plant, log: Log) -> FloatArray:
    """Accelerations (N, n_v) at the state and inputs of each sample, averaged over the phases of vibrations.

    Notes
    -----
    A phase is a state of a disturbance whose name begins with ``phase``: an angle, rad, in which the disturbance is
    periodic. All phases are averaged over at once, which is exact for sums of vibrations. The recorded accelerations
    are returned where a disturbance depends on time or on other states, which the log does not contain.
    """
    simulated, names = plant.simulated, plant.model
    recorded = np.column_stack([log[name] for name in names.accelerations])
    if not isinstance(simulated, DisturbedModel) or not all(map(_is_phase, simulated.own_states)):
        return recorded
    x, u = (np.column_stack([log[name] for name in some]) for some in (names.state, names.inputs))
    evaluate, n_own = compile_map(simulated.dynamics), len(simulated.own_states)
    total, n_phases = np.zeros_like(recorded), 8  # harmonics up to the seventh cancel exactly
    for phase in 2.0 * np.pi * np.arange(n_phases) / n_phases:
        _, accelerations = evaluate(np.hstack([x, np.full((len(x), n_own), phase)]), u, plant.constants)
        total += accelerations
    return total / n_phases


def relative_errors(found: npt.ArrayLike, reference: npt.ArrayLike) -> FloatArray:
    """``|found / reference - 1|``; infinite without an estimate, NaN where the reference is 0 or not known."""
    x, p = np.broadcast_arrays(np.asarray(found, dtype=float), np.asarray(reference, dtype=float))
    comparable = ~np.isnan(p) & (p != 0.0)
    ratio = np.divide(x, p, out=np.full(x.shape, np.nan), where=comparable)
    return np.where(comparable, np.nan_to_num(np.abs(ratio - 1.0), nan=np.inf, posinf=np.inf), np.nan)


def covers(low: npt.ArrayLike, high: npt.ArrayLike, pseudo_true: npt.ArrayLike) -> FloatArray:
    """1 where the interval contains the pseudo-true parameter, 0 where not, NaN where one of the three is not finite.

    The tolerance is one millionth of the parameter.
    """
    a, b, p = (np.asarray(one, dtype=float) for one in (low, high, pseudo_true))
    # Tolerance of `covers`, relative to the parameter. Without noise, intervals are points.
    slack = 1e-6 * np.abs(p)
    known = np.isfinite(a) & np.isfinite(b) & np.isfinite(p)
    return np.where(known, (a - slack <= p) & (p <= b + slack), np.nan)


def differ(pseudo_true: npt.ArrayLike, true: npt.ArrayLike) -> BoolArray:
    """True where pseudo-true and true parameters differ by more than 0.2 %."""
    # Relative difference up to which pseudo-true and true parameters are taken for the same.
    return relative_errors(pseudo_true, true) > 2e-3


def is_disturbed(plant: Plant) -> bool:
    """True if the plant has a disturbance whose constants are not all zero."""
    return any(not one.constants or any(one.constants.values()) for one in plant.disturbances)


def _is_phase(state: str) -> bool:
    """True for a disturbance's state ``<disturbance>.phase...``."""
    return state.rpartition(".")[2].startswith("phase")
