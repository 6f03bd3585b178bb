"""Causes of refusals: logs in which nothing moves or no force is known, reversed signals, bounds.

References
----------
Ljung and Box 1978 (serial correlation).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diransac.arrays import FloatArray, bulk_range, robust_std
from diransac.data.checks import rows_per_sample
from diransac.data.dataset import Dataset, ParameterLayout
from diransac.errors import IdentificationError
from diransac.identification.regression.rows import (
    MotionRows,
    RowsSolution,
    lacks_known_terms,
    motion_rows,
    outside_bounds,
    solved,
)
from diransac.identification.regression.uncertainty import CLEAR
from diransac.identification.structure.column_corrections import CorrectionTests
from diransac.identification.structure.columns import explanations, reversed_signs
from diransac.identification.structure.identifiability import Ambiguity, equations_in_words, in_words, of_log
from diransac.identification.structure.prospects import ADVICE, Prospects
from diransac.identification.structure.structural import Ranges, structural
from diransac.model import Model

# ---------------------------------------------------------------------- a log without motion


def check_motion(dataset: Dataset) -> None:
    """Raise IdentificationError for logs whose coordinates and velocities are constant or white noise.

    A signal moves if it has serial correlation: noise of a sensor at rest has none.  Signals are clipped, so that
    outliers do not hide a motion.  Logs without coordinates and velocities, and short ones, pass.

    Parameters
    ----------
    dataset : Dataset
    """
    states = [n for n in dataset.model.state if any(n in log for log in dataset.given)]
    if not states or any(_moves(log[n]) for log in dataset.given for n in states if n in log):
        return
    every = Ambiguity(dataset.layout.names, 0, ())
    clause = f"nothing moves: the variation of {', '.join(states)} does not exceed the noise. Record a motion"
    raise IdentificationError(f"{dataset.source}: {every.sentence(clause)}")


def _moves(values: FloatArray) -> bool:
    """True if a signal ``(N,)`` is not constant and has serial correlation over five lags, or less than 30 samples.

    Where half of the samples are outliers, their size hides a correlation; the small differences of neighbours, which
    are half of those of distant samples at most, do not.
    """
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return False
    values = values[known[0] :: rows_per_sample(np.isfinite(values))]
    values = values[:: _samples_held(values[np.isfinite(values)])]
    known = np.isfinite(values)
    x = np.where(known, values - np.median(values[known]), 0.0) / (np.abs(values[known]).max() + 1e-300)
    size = np.abs(x[known])
    if size.max() < 1e-12:  # a variation by rounding
        return False
    if known.sum() < 30:
        return True
    x = np.clip(x / (float(robust_std(size)) or float(size.mean())), -1.5, 1.5)
    pairs = [(known[:-k] & known[k:], x[:-k] * x[k:]) for k in range(1, 6)]
    covariances = np.array([both @ product / max(1, both.sum()) for both, product in pairs])
    correlation = np.sqrt(np.mean(np.square(covariances))) / np.mean(np.square(x[known]))
    # White noise has a correlation of one over the root of the number of samples.
    if correlation > max(0.1, CLEAR / np.sqrt(known.sum())):
        return True
    good = values[known]
    # The 10 % quantile of the differences of neighbours, and of distant samples.
    near, far = (np.quantile(np.abs(good[apart:] - good[:-apart]), 0.1) for apart in (1, len(good) // 3))
    return bool(near < 0.5 * far and len(good) > 150)


def _samples_held(values: FloatArray) -> int:
    """Median number of samples between changes of a signal that is held."""
    changes = np.flatnonzero(np.diff(values))
    return int(np.median(np.diff(changes))) if len(changes) > 1 else 1


# ---------------------------------------------------------------------- causes of a refusal


def cause_of_refusal(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> str:
    """Reason why samples of logs give no parameters within their bounds, as a sentence without a stop.

    Least squares of all rows, without bounds, names the parameters.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    logs : sequence of MotionRows

    Returns
    -------
    str
    """
    of_model = structural(model, ranges=_ranges(model, logs))
    found = None if model.nonlinear_parameters else solved(model, layout, logs)
    if any(x.noun == "ratio" for x in of_model) or (found is None and of_model):
        return equations_in_words(of_model)
    names = ", ".join(layout.names)
    if model.nonlinear_parameters:
        why = "no simulation within the bounds follows the log"
        return f"{names} cannot be estimated, since {why}; give narrower bounds, or {ADVICE}"
    if found is None:
        return f"{names} cannot be estimated: in each row of the log the equations overflow; {ADVICE}"
    if not found.has_known_terms:
        return _no_known_terms(model, layout, logs)
    return _cause_of_solution(Prospects(model, layout, logs), found, of_model)


def _ranges(model: Model, logs: Sequence[MotionRows]) -> Ranges:
    """Range of the bulk of each state and input; 0 of one that is missing."""
    columns = np.concatenate([np.hstack([one.q, one.v, one.u]) for one in logs]).T
    return tuple((n, *bulk_range(x)) for n, x in zip((*model.state, *model.inputs), columns, strict=True))


def _cause_of_solution(prospects: Prospects, found: RowsSolution, of_model: Sequence[Ambiguity]) -> str:
    """The cause where least squares of all rows has a solution: ambiguities, bounds, or noise."""
    layout = prospects.layout
    if of_model:
        return equations_in_words(of_model)
    of_rows = in_words(of_log(layout.names, found.space), len(prospects.rows))
    if of_rows:
        return of_rows
    values = dict(zip(layout.names, zip(found.parameters, found.errors, strict=True), strict=True))
    clearly, outside = outside_bounds(layout, found.parameters, found.errors), layout.violations(found.parameters)
    named = ", ".join(f"{n} = {values[n][0]:.4g} ± {values[n][1]:.2g}" for n in clearly or outside or values)
    fitted = f"least squares of all rows gives {named}"
    if clearly:
        bounds = "its bounds" if len(clearly) == 1 else "their bounds"
        return f"{fitted}, clearly outside {bounds}; {prospects.remedy(clearly)}"
    if outside:
        return f"{fitted}, an error that reaches across the bounds: noise hides the motion; record more, or smooth more"
    return f"{fitted}, within the bounds, but simulations with it do not follow the log; {ADVICE}"


def check_known_terms(dataset: Dataset) -> None:
    """Raise IdentificationError for logs in which ``b = 0`` in each row of ``W p = b``, so that zero solves it.

    Models that are not affine in their parameters pass.

    Parameters
    ----------
    dataset : Dataset
    """
    model, logs = dataset.model, motion_rows(dataset)
    if not model.nonlinear_parameters and lacks_known_terms(model, dataset.layout, logs):
        raise IdentificationError(f"{dataset.source}: {_no_known_terms(model, dataset.layout, logs)}")


def _no_known_terms(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> str:
    """Sentence about logs in which ``b = 0`` in each row, with the inputs that are zero."""
    every = Ambiguity(layout.names, max(1, len(layout) - 1), (), "ratio")
    zero = [name for i, name in enumerate(model.inputs) if not any(one.u[:, i].any() for one in logs)]
    verb = "is" if len(zero) == 1 else "are"
    cause = f"{', '.join(zero)} {verb} zero throughout" if zero else "each known term is zero throughout"
    advice = f"record known forces, or fix one, {every.remedy()}"
    return every.sentence(f"b = 0 in each row of W p = b, since {cause}: {every.determined()}; {advice}")


def check_drives(dataset: Dataset) -> None:
    """Raise IdentificationError if the forces of drives are reversed, before anything is searched.

    Parameters
    ----------
    dataset : Dataset
    """
    mistakes = reversed_signs(dataset.model, dataset.given)
    if mistakes:
        raise IdentificationError(f"{dataset.source}: {mistakes[0].claim}; {mistakes[0].action}")


def check_signs(dataset: Dataset, rows: Sequence[MotionRows]) -> None:
    """Raise IdentificationError if a signal is reversed, beyond doubt.

    Least squares of all rows violates the bounds of each parameter whose sign is known, and with the sign of a signal
    reversed it violates none and explains the rows as well.  Models that are not affine in their parameters pass.

    Parameters
    ----------
    dataset : Dataset
    rows : sequence of MotionRows
        Of its motion.
    """
    model, layout = dataset.model, dataset.layout
    bounds = zip(layout.names, layout.bounds, strict=True)
    signed = {n for n, x in bounds if x.positive or x.lower >= 0.0 or x.upper <= 0.0}
    if model.nonlinear_parameters or structural(model, ranges=_ranges(model, rows)):
        return
    found = solved(model, layout, rows)
    if found is None or not signed or not signed <= set(layout.violations(found.parameters)):
        return
    mistakes, _ = explanations(CorrectionTests(model, layout, rows), dataset.given)
    if mistakes and "reversed" in mistakes[0].what:
        raise IdentificationError(f"{dataset.source}: {mistakes[0].claim}; {mistakes[0].action}")
