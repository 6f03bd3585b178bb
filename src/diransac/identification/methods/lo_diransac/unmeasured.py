"""Trajectories of states that no signal measures, such as the thrust behind the lag of a motor.

Simulations that the smoothed motion of all other states drives, and the smoothed sensors, give parameters and
trajectories (`regression.observers`).  The best of them simulates the shooting intervals best, by the scores of
hypotheses. Its trajectories take the place of smoothed signals until shooting estimates these states with all others.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.core.noise import lower_scale
from diransac.identification.methods.lo_diransac.hypotheses import robust_scores
from diransac.identification.methods.lo_diransac.smoothing import Motion
from diransac.identification.regression.uncertainty import CLEAR

if TYPE_CHECKING:
    from collections.abc import Sequence

    from diransac.identification.core.windows import Windows
    from diransac.identification.regression.observers import ObserverFit
    from diransac.model import Model

DRIVEN = ((0.25, 15, 12), (0.25, 60, 12))
"""Stages of simulations that the smoothed motion drives: bandwidth over that of an interval, in which errors of the
smoothed motion average out, steps, and the number of starts that go on."""
OBSERVED = ((1.5, 60, 64), (0.75, 20, 32), (0.375, 20, 12))
"""Stages of observers that follow the samples, which become simulations."""


def unmeasured_states(intervals: Windows) -> tuple[str, ...]:
    """Names of the states of which no signal, and no derivative of one, is measured.

    Velocities of a model with kinematics follow from the measured coordinates whose rates depend on them.

    Parameters
    ----------
    intervals : Windows

    Returns
    -------
    tuple of str
        In the order of the model's states.
    """
    return _states_without(intervals.model, measured_signals(intervals))


def measured_velocities(intervals: Windows) -> BoolArray:
    """Velocities that signals, derivatives of them, or sensors measure.

    Parameters
    ----------
    intervals : Windows

    Returns
    -------
    (n_v,) bool array
    """
    model, seen = intervals.model, measured_signals(intervals)
    of_sensors = [n for name in seen if name in model.sensors for n in model.sensor_arguments[name]]
    lost = _states_without(model, (*seen, *of_sensors))
    return np.array([n not in lost for n in model.velocities])


@lru_cache(maxsize=64)
def _states_without(model: Model, names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the states that are not among some names, and whose derivatives are not."""
    seen = set(names)
    lost = {name for chain in model.chains if seen.isdisjoint(chain) for name in chain}
    if model.kinematics is not None:
        lost -= _velocities_behind(model, tuple(n for n in model.coordinates if n in seen))
    return tuple(n for n in model.state if n in lost)


def _velocities_behind(model: Model, coordinates: tuple[str, ...]) -> set[str]:
    """Names of the velocities on which the rates of some coordinates depend, by the kinematics."""
    assert model.kinematics is not None
    q, v = (ca.SX.sym(name, n) for name, n in (("q", model.n_q), ("v", model.n_v)))
    rates = model.kinematics(q, v)[[list(model.coordinates).index(n) for n in coordinates]]
    depends = ca.which_depends(rates, v, 1, False) if coordinates else [False] * model.n_v
    return {n for n, d in zip(model.velocities, depends, strict=True) if d}


def unmeasured_by_name(intervals: Windows) -> str:
    """Unmeasured states in words: those of which the others are derivatives.

    Parameters
    ----------
    intervals : Windows

    Returns
    -------
    str
        Names, separated by commas; empty without any.
    """
    lost = unmeasured_states(intervals)
    return ", ".join(chain[0] for chain in intervals.model.chains if chain[0] in lost)


def measured_signals(intervals: Windows) -> tuple[str, ...]:
    """Names of the signals with a sample.

    Parameters
    ----------
    intervals : Windows

    Returns
    -------
    tuple of str
        In the order of the model's signals.
    """
    seen = np.flatnonzero(intervals.known.any(axis=0))
    return tuple(intervals.model.signals[i] for i in seen)


def with_unmeasured_states(intervals: Windows, motion: Motion) -> Motion | None:
    """The motion with trajectories of the unmeasured states and of their derivatives.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.

    Returns
    -------
    Motion or None
        None if every simulation diverges.
    """
    return _best(intervals, motion, _driven(intervals, motion), DRIVEN)


def with_observed_states(intervals: Windows, motion: Motion) -> Motion | None:
    """The motion of observers that follow the samples, of measured states and of others.

    Parameters
    ----------
    intervals : Windows
    motion : Motion
        Smoothed motion over the rows of the intervals.

    Returns
    -------
    Motion or None
        None if every observer diverges.
    """
    return _best(intervals, motion, _observers(intervals, motion), OBSERVED)


def _driven(intervals: Windows, motion: Motion) -> ObserverFit:
    """Least squares in units of the spread of the sensors, and of the accelerations as the observers filter them."""
    from diransac.identification.regression.observers import driven_states

    model, hidden = intervals.model, unmeasured_states(intervals)
    bandwidth = DRIVEN[0][0] / intervals.duration
    others = [i for i, n in enumerate(model.velocities) if n not in hidden]
    first = len(model.signals) - len(model.sensors)
    readings = motion.signals[:, first:]
    scale = np.append(bandwidth / motion.spread[len(model.state) :][others], 1.0 / motion.spread[first:])
    used = np.hstack([np.ones((len(readings), len(others)), bool), np.isfinite(readings)])
    return driven_states(
        model,
        intervals.layout,
        hidden,
        motion.signals[:, : len(model.state)],
        intervals.inputs,
        np.nan_to_num(readings),
        np.where(intervals.counted[:, None] & used, np.square(scale), 0.0),
        intervals.rows_of_logs,
        intervals.dt,
        bandwidth,
        substeps=intervals.substeps,
    )


def _observers(intervals: Windows, motion: Motion) -> ObserverFit:
    """Observers of all states, in units of the noise of the samples.

    Outliers, and what is missing, take the smoothed motion as samples, without weight.  So do velocities that
    kinematics give.
    """
    from diransac.identification.regression.observers import ObserverFit

    model, hidden, measured = intervals.model, unmeasured_states(intervals), measured_signals(intervals)
    corrected = {chain[1] for chain in model.chains if chain[0] in measured and len(chain) > 1}
    sampled = tuple(n for n in model.state if n in measured or (n not in hidden and n not in corrected))
    columns = [model.signals.index(n) for n in (*sampled, *model.sensors)]
    smoothed, known = motion.signals[:, columns], intervals.known[:, columns]
    apart = np.where(known, np.abs(intervals.measured[:, columns] - smoothed), 0.0)
    noise = np.nan_to_num(lower_scale(apart, known))
    inlying = known & (apart < CLEAR * noise + 1e-9)
    values = np.where(inlying, intervals.measured[:, columns], np.nan_to_num(smoothed))
    weights = np.where(inlying, 1.0 / np.square(noise + 1e-9), 0.0) / max(inlying.sum(), 1)
    first = np.array([rows.start for rows in intervals.rows_of_logs])
    scalars = [model.state[four[0]] for four in model.quaternions]
    begin = motion.signals[first][:, [model.signals.index(n) for n in model.state]]
    begin = np.where([n in hidden for n in model.state], [float(n in scalars) for n in model.state], begin)
    recorded = intervals.inputs, values[:, len(sampled) :], weights, intervals.rows_of_logs
    timing = intervals.dt, 1.0 / intervals.duration, intervals.substeps
    every = model, intervals.layout, model.state, (), sampled
    return ObserverFit(*every, values[:, : len(sampled)], begin, *recorded, *timing)


def _best(
    intervals: Windows, motion: Motion, problem: ObserverFit, stages: Sequence[tuple[float, int, int]]
) -> Motion | None:
    """The motion whose parameters simulate the intervals best, of those to which stages lead."""
    fit, z = problem.search([(width / intervals.duration, n_steps, n_kept) for width, n_steps, n_kept in stages])
    completed, every = [_completed(motion, fit, one) for one in z], np.arange(len(intervals))
    pairs = zip(completed, z[:, : len(intervals.layout)], strict=True)
    scores = [robust_scores(intervals, one, p[None], every)[0] for one, p in pairs]
    return completed[int(np.argmin(scores))] if np.isfinite(scores).any() else None


def _completed(motion: Motion, problem: ObserverFit, z: FloatArray) -> Motion:
    """The motion with the states and their derivatives that unknowns (n,) give."""
    signals, spread = motion.signals.copy(), motion.spread.copy()
    for name, values in problem.trajectories(z).items():
        column = problem.model.signals.index(name)
        signals[:, column], spread[column] = values, values.std() + 1e-9
    return Motion(signals, spread)
