"""How estimates are judged: against the best parameters that a model can reach in a flight.

They are not the plant's own. An excess of thrust in proportion to the thrust, as aerodynamic imbalance has it, *is* a
smaller mass to a model that knows no excess; a method that finds the smaller mass has found what there is to be found.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from diransac.arrays import BoolArray, FloatArray
from diransac.data.dataset import observe
from diransac.data.log import Log
from diransac.errors import IdentificationError
from diransac.identification.estimators import Estimator, OrdinaryLeastSquares
from diransac.identification.nonlinear import NonlinearLeastSquares
from diransac.model.plant import DisturbedModel, Plant
from diransac.simulation.compiler import compile_map

__all__ = ["best_parameters", "differ", "hold", "is_disturbed", "mean_accelerations", "relative_errors"]


_ROUNDING = 1e-6
"""Of a parameter: by so little an interval may miss it. Where nothing is wrong, intervals are points."""

_VISIBLE = 2e-3
"""Of a parameter: best ones that differ by less from the plant's own are taken for the same."""

_N_PHASES = 8
"""Phases that a vibration is averaged over: harmonics up to the seventh vanish exactly."""

_PHASE = "phase"


def best_parameters(plant: Plant, log: Log) -> dict[str, float]:
    """Least squares of the model on the log of a flight without noise and without vibration, by parameter.

    What the plant's disturbances do on average stays; what they shake is gone.  Where nothing is unknown to the model,
    and where what pulls to and fro has no mean, these are the plant's own parameters.  Equations are fitted where the
    model is affine in its parameters, accelerations where it isn't, as `ols` and `nls` do.

    Parameters
    ----------
    plant : what flew, disturbances included
    log : of the flight, as `fly` gives it

    Raises IdentificationError: the flight does not determine the parameters, even so.
    """
    model = plant.model
    columns = dict(zip(model.accelerations, mean_accelerations(plant, log).T, strict=True))
    calm = Log.from_arrays(log.time, {**log.signals, **columns}, log.units, source="vibration-free log")
    estimator: Estimator = NonlinearLeastSquares() if model.nonlinear_parameters else OrdinaryLeastSquares()
    bound = estimator.bind(observe(model, calm))
    rows = np.arange(bound.n_rows)
    if not bound.well_defined([rows])[0]:
        loose = ", ".join(list(model.parameters)[i] for i in bound.unidentifiable())
        raise IdentificationError(
            f"the flight without noise does not determine {loose or 'the parameters'}, so that nothing can be judged "
            "by the best parameters; fly more for data, or leave evaluation.parameters out"
        )
    return dict(zip(model.parameters, bound.fit([rows])[0].tolist(), strict=True))


def mean_accelerations(plant: Plant, log: Log) -> FloatArray:
    """Accelerations (N, n_v) at the state and the inputs of each row, averaged over the phases of what vibrates.

    A phase is a state of a disturbance whose name begins with ``phase``: an angle in rad, of which the disturbance is
    periodic.  All phases are averaged over at once, which serves sums of vibrations.  If a disturbance depends on time,
    or on states that are no phases, the log does not tell where they were: its accelerations then stay as they are.
    """
    simulated, names = plant.simulated, plant.model
    recorded = np.column_stack([log[name] for name in names.accelerations])
    if not isinstance(simulated, DisturbedModel) or not all(map(_is_phase, simulated.own_states)):
        return recorded
    x, u = (np.column_stack([log[name] for name in some]) for some in (names.state, names.inputs))
    evaluate, n_own = compile_map(simulated.dynamics), len(simulated.own_states)
    total = np.zeros_like(recorded)
    for phase in 2.0 * np.pi * np.arange(_N_PHASES) / _N_PHASES:
        _, accelerations = evaluate(np.hstack([x, np.full((len(x), n_own), phase)]), u, plant.constants)
        total += accelerations
    return total / _N_PHASES


def relative_errors(found: npt.ArrayLike, reference: npt.ArrayLike) -> FloatArray:
    """``|found / reference - 1|``: infinite where nothing was found, NaN where the reference is not known, or 0."""
    x, p = np.broadcast_arrays(np.asarray(found, dtype=float), np.asarray(reference, dtype=float))
    judged = ~np.isnan(p) & (p != 0.0)
    ratio = np.divide(x, p, out=np.full(x.shape, np.nan), where=judged)
    return np.where(judged, np.nan_to_num(np.abs(ratio - 1.0), nan=np.inf, posinf=np.inf), np.nan)


def hold(low: npt.ArrayLike, high: npt.ArrayLike, best: npt.ArrayLike) -> FloatArray:
    """1 where intervals hold the best parameter, to a millionth; 0 where not, NaN where one of the three is not known.

    An end that is infinite is not known.
    """
    a, b, p = (np.asarray(one, dtype=float) for one in (low, high, best))
    slack = _ROUNDING * np.abs(p)
    known = np.isfinite(a) & np.isfinite(b) & np.isfinite(p)
    return np.where(known, (a - slack <= p) & (p <= b + slack), np.nan)


def differ(best: npt.ArrayLike, own: npt.ArrayLike) -> BoolArray:
    """Whether best parameters are others than the plant's own: by more than 0.2 %."""
    return relative_errors(best, own) > _VISIBLE


def is_disturbed(plant: Plant) -> bool:
    """Whether something acts on a plant that its model leaves out: a disturbance whose constants aren't all zero."""
    return any(not one.constants or any(one.constants.values()) for one in plant.disturbances)


def _is_phase(state: str) -> bool:
    """Whether a disturbance's state, ``<disturbance>.<state>``, is an angle that vibration has."""
    return state.rpartition(".")[2].startswith(_PHASE)
