"""Figures of friction: force over speed of each joint, with the fitted curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import Dataset
from diransac.identification.assessment.inverse_dynamics import PredictedForces, predicted_forces
from diransac.identification.result import Result
from diransac.model import Model
from diransac.report.figures import Figure, Scale, Timeline, Trace, padded, time_axis, time_plot
from diransac.report.runs import Entry
from diransac.text_table import number, percent

# Part of the samples at either end of the speeds, and of the forces, that may be outside of the figure.
_TAIL = 0.005


def friction_figures(entries: Sequence[Entry]) -> list[Figure]:
    """A figure for each joint of a robot with an estimate of its friction, of each result.

    The dots are the force of the drive less all other forces of the model, in the smoothed motion; rows with spikes of
    an input are left out.
    """
    found = []
    for entry in entries:
        of_joints = _friction_parameters(entry.result.model)
        logs = _forces(entry) if of_joints else []
        for joint, names in of_joints.items() if logs else ():
            title = f"{joint}, {entry.label}" if len(entries) > 1 else joint
            if all(entry.identifies(name) for name in names):
                found.append(_figure(title, joint, names, entry.result, logs))
    return found


def _friction_parameters(model: Model) -> dict[str, list[str]]:
    """Parameters of damping and friction of each joint, by coordinate."""
    found: dict[str, list[str]] = {}
    for name, parameter in model.parameters.items():
        kind, _, coordinate = name.partition("_")
        if (
            kind in ("damping", "friction", "stribeck")
            and len(parameter.combination) == 1
            and coordinate in model.coordinates
        ):
            found.setdefault(coordinate, []).append(name)
    return found


def _forces(entry: Entry) -> list[PredictedForces]:
    """Forces over every log."""
    logs = [run.observations.log for run in entry.runs]
    dataset = Dataset.of(entry.result.model, logs, pointwise=False)
    own = [entry.result.parameters_in(log) for log in logs]
    return predicted_forces(dataset, own, entry.result.estimate.resolution)


def _figure(title: str, joint: str, names: Sequence[str], result: Result, logs: Sequence[PredictedForces]) -> Figure:
    """Force over speed of one joint."""
    model, i = result.model, list(result.model.coordinates).index(joint)
    speed, error = (np.concatenate([getattr(x, n)[x.counted, i] for x in logs]) for n in ("velocities", "errors"))
    force = _friction(result, i, names, speed) - error
    low, high = np.quantile(speed, [_TAIL, 1.0 - _TAIL])
    low, high = (float(low), float(high)) if high > low else (-1.0, 1.0)
    n_cells = 1000
    axis = Timeline(n_cells + 1, low, (high - low) / n_cells, cells=400)
    grid = np.asarray(low + axis.dt * np.arange(axis.n_rows), dtype=float)
    curve = _friction(result, i, names, grid)
    inside = (speed >= low) & (speed <= high)
    order = np.argsort(speed[inside], kind="stable")
    places = np.rint((speed[inside][order] - low) / axis.dt).astype(np.int64)
    traces = (
        Trace("log", "measured", "dots", places, force[inside][order]),
        Trace("fitted", "m0", "line", np.arange(axis.n_rows), curve),
    )
    turns = model.coordinates[joint] == "rad"
    unit = "N m" if turns else "N"
    label = f"Friction of {joint} over speed"
    plot = time_plot(traces, _scale(force[inside], curve), axis, label, levels=(0.0,), still=True)
    values = "; ".join(f"{n.partition('_')[0]} {number(result.parameters[n])} {result.units[n]}" for n in names)
    driven = np.concatenate([x.forces[x.counted, i] for x in logs])
    share = float(np.linalg.norm(error) / np.linalg.norm(driven)) if driven.any() else np.nan
    facts = (values, f"predicted force off by {percent(share)} (RMS)") if np.isfinite(share) else (values,)
    return Figure(title, unit, facts, (plot,), time_axis(axis), x_label=f"speed, {'rad/s' if turns else 'm/s'}")


def _friction(result: Result, i: int, names: Sequence[str], speed: FloatArray) -> FloatArray:
    """Force of damping and friction of a joint at some speeds (n,): that of the model less that without them."""
    model, n = result.model, len(speed)
    p = model.parameter_vector(result.parameters)
    without = np.where([name in names for name in model.parameters], 0.0, p)
    still = [np.zeros((size, n)) for size in (model.n_q, model.n_v, model.n_v, model.n_u)]
    still[1][i] = speed
    both = (model.residual(*still, np.repeat(x[:, None], n, axis=1)) for x in (p, without))
    first, second = (np.array(x)[i] for x in both)
    return np.asarray(first - second)


def _scale(force: FloatArray, curve: FloatArray) -> Scale:
    """Range of most samples, and of the curve."""
    low, high = np.quantile(force, [_TAIL, 1.0 - _TAIL]) if len(force) else (0.0, 0.0)
    return padded(float(min(low, curve.min())), float(max(high, curve.max())))
