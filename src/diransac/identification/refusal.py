"""Causes of refusals: logs in which nothing moves or no force is known, reversed signals, wrong units, bounds.

References
----------
Ljung and Box 1978 (serial correlation); Holland and Welsch 1977 (iteratively reweighted least squares).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.checks import rows_per_sample
from diransac.data.segment import bulk_range
from diransac.errors import IdentificationError
from diransac.identification.identifiability import (
    Ambiguity,
    NullSpace,
    Ranges,
    in_words,
    null_space,
    of_log,
    structural,
)
from diransac.identification.regression import regression_rows

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset, ParameterLayout
    from diransac.model import Model

__all__ = ["MotionRows", "cause_of_refusal", "check_known_terms", "check_motion", "check_signs", "motion_rows"]

# Lags of serial correlation; its RMS over them above which a signal is a motion: in standard errors, and at least.
_LAGS, _SIGNIFICANT, _CORRELATED = 5, 3.0, 0.1
# Fewest rows for it; clipping, in robust standard deviations; variation over the size of a signal that is rounding.
_FEWEST_ROWS, _CLIP, _ROUNDING = 30, 1.5, 1e-12
# Ratio of small differences of neighbours to those of distant samples below which a signal moves, and samples for it.
_NEARER, _ENOUGH_FOR_QUANTILES = 0.5, 150
# Steps of iteratively reweighted least squares, and the residual, in median ones, from which on a row counts less.
_STEPS, _FAR = 10, 3.0
# Rows of a log that are enough to find a cause; size from which on the square of a number overflows.
_ENOUGH_ROWS, _HUGE, _TINY = 5000, 1e150, 1e-300
# Largest increase of the median residual by another sign or unit that explains a log as well.
_AS_GOOD = 1.05
_MILLI, _DEGREE = 1e-3, np.pi / 180.0
_ADVICE = "check the model, the signs and units of the signals, and the bounds"
_WITHIN = "all parameters are within their bounds"
# Eigenvalue of a log's rows, over their number, below which it is zero.
_RANK_OF_LOG = 1e-9


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
    """True if a signal ``(N,)`` is not constant and has serial correlation, or is too short for a decision.

    Where half of the samples are outliers, their size hides a correlation; the small differences do not.
    """
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return False
    values = values[known[0] :: rows_per_sample(np.isfinite(values))]
    values = values[:: _samples_held(values[np.isfinite(values)])]
    known = np.isfinite(values)
    x = np.where(known, values - np.median(values[known]), 0.0) / (np.abs(values[known]).max() + _TINY)
    size = np.abs(x[known])
    if size.max() < _ROUNDING:
        return False
    if known.sum() < _FEWEST_ROWS:
        return True
    x = np.clip(x / (1.4826 * float(np.median(size)) or float(size.mean())), -_CLIP, _CLIP)
    pairs = [(known[:-k] & known[k:], x[:-k] * x[k:]) for k in range(1, _LAGS + 1)]
    covariances = np.array([both @ product / max(1, both.sum()) for both, product in pairs])
    correlation = np.sqrt(np.mean(np.square(covariances))) / np.mean(np.square(x[known]))
    if correlation > max(_CORRELATED, _SIGNIFICANT / np.sqrt(known.sum())):
        return True
    good = values[known]
    near, far = (_small_difference(good, apart) for apart in (1, len(good) // 3))
    return bool(near < _NEARER * far and len(good) > _ENOUGH_FOR_QUANTILES)


def _small_difference(values: FloatArray, apart: int) -> float:
    """The 10 % quantile of the differences of samples that are so many apart."""
    return float(np.quantile(np.abs(values[apart:] - values[:-apart]), 0.1))


def _samples_held(values: FloatArray) -> int:
    """Median number of samples between changes of a signal that is held."""
    changes = np.flatnonzero(np.diff(values))
    return int(np.median(np.diff(changes))) if len(changes) > 1 else 1


# ---------------------------------------------------------------------- causes of a refusal


@dataclass(frozen=True)
class MotionRows:
    """Rows of one log at which the equations are evaluated.

    Parameters
    ----------
    q, v, a, u : (N, n_q), (N, n_v), (N, n_v), (N, n_u) array
        Coordinates, velocities, accelerations and inputs, each in its unit.
    y : (N, n_y) array
        Sensors; NaN where one is missing.
    """

    q: FloatArray
    v: FloatArray
    a: FloatArray
    u: FloatArray
    y: FloatArray

    def scaled(self, model: Model, factors: Mapping[str, float]) -> MotionRows:
        """The rows with inputs, coordinates and states of first order, and their derivatives, multiplied by factors."""
        names = (model.coordinates, model.rate_names, model.inputs)
        of_q, of_v, of_u = (np.array([factors.get(n, 1.0) for n in group]) for group in names)
        return MotionRows(self.q * of_q, self.v * of_v, self.a * of_v, self.u * of_u, self.y)


def motion_rows(dataset: Dataset) -> list[MotionRows]:
    """Rows of each log that count; 0 in signals that a log lacks."""
    parts = ((one.valid, (*one.state_arrays(), one.acting_inputs(), one.sensor_samples())) for one in dataset.segments)
    return [MotionRows(*(x[valid] for x in arrays)) for valid, arrays in parts]


def cause_of_refusal(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> str:
    """Reason why samples of logs give no parameters within their bounds, as a sentence without a stop.

    Least squares of all rows, without bounds, names the parameters.  Another sign or unit of a signal is named if all
    parameters are within their bounds then, and the equations hold as well.

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
    found = None if model.nonlinear_parameters else _solved(model, layout, logs)
    if any(x.noun == "ratio" for x in of_model) or (found is None and of_model):
        return "; ".join(x.sentence(x.of_equations()) for x in of_model)
    if found is None:
        why = "no simulation within the bounds follows the log" if model.nonlinear_parameters else "no row is finite"
        return f"{', '.join(layout.names)} cannot be estimated, since {why}; {_ADVICE}"
    if not found.has_known_terms:
        return _no_known_terms(model, layout, logs)
    return _cause_of_solution(_Alternatives(model, layout, logs, found), of_model)


def _ranges(model: Model, logs: Sequence[MotionRows]) -> Ranges:
    """Range of the bulk of each state and input; 0 of one that is missing."""
    columns = np.concatenate([np.hstack([one.q, one.v, one.u]) for one in logs]).T
    return tuple((n, *bulk_range(x)) for n, x in zip((*model.state, *model.inputs), columns, strict=True))


def _cause_of_solution(alternatives: _Alternatives, of_model: Sequence[Ambiguity]) -> str:
    """The cause where least squares of all rows has a solution: signals, ambiguities, or bounds."""
    found, layout = alternatives.found, alternatives.layout
    values, outside = dict(zip(layout.names, found.parameters, strict=True)), layout.violations(found.parameters)
    named = f"least squares of all rows gives {', '.join(f'{n} = {values[n]:.4g}' for n in outside or values)}"
    named += f", outside {'its' if len(outside) == 1 else 'their'} bounds" if outside else ", within the bounds"
    remedy = (alternatives.signs() or alternatives.unit()) if outside else ""
    if remedy:
        return f"{named}; {remedy}"
    if of_model:
        return "; ".join(x.sentence(x.of_equations()) for x in of_model)
    return in_words(of_log(layout.names, found.space), len(alternatives.logs)) or f"{named}; {_ADVICE}"


def check_known_terms(dataset: Dataset) -> None:
    """Raise IdentificationError for logs in which ``b = 0`` in each row of ``W p = b``, so that zero solves it.

    Models that are not affine in their parameters pass.

    Parameters
    ----------
    dataset : Dataset
    """
    model, logs = dataset.model, motion_rows(dataset)
    if model.nonlinear_parameters:
        return
    rows = _equations(model, dataset.layout, logs)
    if len(rows) and not rows[:, -1].any():
        raise IdentificationError(f"{dataset.source}: {_no_known_terms(model, dataset.layout, logs)}")


def _no_known_terms(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> str:
    """Sentence about logs in which ``b = 0`` in each row, with the inputs that are zero."""
    every = Ambiguity(layout.names, max(1, len(layout) - 1), (), "ratio")
    zero = [name for i, name in enumerate(model.inputs) if not any(one.u[:, i].any() for one in logs)]
    verb = "is" if len(zero) == 1 else "are"
    cause = f"{', '.join(zero)} {verb} zero throughout" if zero else "each known term is zero throughout"
    advice = f"record known forces, or fix one, {every.remedy()}"
    return every.sentence(f"b = 0 in each row of W p = b, since {cause}: {every.determined()}; {advice}")


def check_signs(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows], source: str) -> None:
    """Raise IdentificationError if a signal is reversed, beyond doubt.

    Least squares of all rows violates the bounds of each parameter whose sign is known, and with the sign of a signal
    reversed it violates none and explains the rows as well.  Models that are not affine in their parameters pass.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    logs : sequence of MotionRows
    source : str
        Name of the logs in the message.
    """
    signed = {
        n for n, x in zip(layout.names, layout.bounds, strict=True) if x.positive or x.lower >= 0.0 or x.upper <= 0.0
    }
    found = (
        None
        if model.nonlinear_parameters or structural(model, ranges=_ranges(model, logs))
        else _solved(model, layout, logs)
    )
    if found is None or not signed or not signed <= set(layout.violations(found.parameters)):
        return
    if _Alternatives(model, layout, logs, found).signs():
        raise IdentificationError(f"{source}: {cause_of_refusal(model, layout, logs)}")


@dataclass(frozen=True)
class _Alternatives:
    """Changes of signals with which all parameters are within their bounds and the equations hold as well."""

    model: Model
    layout: ParameterLayout
    logs: Sequence[MotionRows]
    found: _Solution

    def signs(self) -> str:
        """Clause about signals whose signs are reversed; empty where no reversal explains the logs."""
        signals = [*self.model.inputs, *self._coordinates(), *self.model.first_order]
        single = [name for name in signals if self._explain({name: -1.0})]
        if single:
            return f"with the sign of {' or '.join(single)} reversed, {_WITHIN}: check it"
        if self.model.n_u > 1 and self._explain(dict.fromkeys(self.model.inputs, -1.0)):
            return f"with the signs of {', '.join(self.model.inputs)} reversed, {_WITHIN}: check them"
        return ""

    def unit(self) -> str:
        """Clause about the unit of a signal; empty where no unit, or more than one, explains the logs."""
        angles = [name for name in self._coordinates() if self.model.coordinates[name] == "rad"]
        candidates = [(name, x) for name in self.model.inputs for x in (_MILLI, 1.0 / _MILLI)]
        candidates += [(name, x) for name in angles for x in (_DEGREE, 1.0 / _DEGREE)]
        explain = [(name, x) for name, x in candidates if self._explain({name: x})]
        if len(explain) != 1:
            return ""
        ((name, factor),) = explain
        return f"with {name} multiplied by {factor:.4g}, {_WITHIN}: check its unit"

    def _coordinates(self) -> list[str]:
        """Coordinates that can change with their derivatives."""
        return [] if self.model.kinematics is not None else list(self.model.coordinates)

    def _explain(self, factors: Mapping[str, float]) -> bool:
        other = _solved(self.model, self.layout, [one.scaled(self.model, factors) for one in self.logs])
        if other is None or other.residual > _AS_GOOD * self.found.residual:
            return False
        return bool(self.layout.admits(other.parameters[None])[0])


@dataclass(frozen=True)
class _Solution:
    """Robust least squares of all rows of logs.

    Parameters
    ----------
    parameters : (n,) array
        Each in its unit, whatever its bounds.
    residual : float
        Median size of the residuals over the median size of the equations' terms.
    space : NullSpace
        Directions that the rows do not determine.
    has_known_terms : bool
        Whether b differs from zero in any row.
    """

    parameters: FloatArray
    residual: float
    space: NullSpace
    has_known_terms: bool


def _solved(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> _Solution | None:
    """Solution of ``W p = b`` by iteratively reweighted least squares; None where no row is finite."""
    rows = _equations(model, layout, logs)
    if not len(rows):
        return None
    scale = np.sqrt(np.square(rows).mean(axis=0))
    has_known_terms = bool(scale[-1] > 0.0)
    scale = np.where(scale > 0.0, scale, 1.0)
    rows = rows / scale
    A, y, size = rows[:, :-1], rows[:, -1], np.linalg.norm(rows, axis=1)
    weights = 1.0 / (1.0 + size / (np.median(size) + _TINY))
    for _ in range(_STEPS):
        p = np.linalg.lstsq(A * weights[:, None], y * weights, rcond=None)[0]
        residuals = np.abs(A @ p - y)
        if not np.isfinite(residuals).all():
            return None
        middle = np.median(residuals) + _TINY
        weights = 1.0 / (1.0 + np.square(residuals / (_FAR * middle)))
    whole = np.median(np.abs(A) @ np.abs(p) + np.abs(y)) + _TINY
    return _Solution(
        p * scale[-1] / scale[:-1],
        float(middle / whole),
        null_space(A.T @ A, scale[:-1], _RANK_OF_LOG * len(A)),
        has_known_terms,
    )


def _equations(model: Model, layout: ParameterLayout, logs: Sequence[MotionRows]) -> FloatArray:
    """Finite rows ``[W b]`` of all equations and logs, ``(n, n_p + 1)``, each equation of unit median size."""
    parts = []
    for i, one in enumerate(logs):
        every = max(1, len(one.q) // _ENOUGH_ROWS)
        few = (np.ascontiguousarray(x[::every]) for x in (one.q, one.v, one.a, one.u, one.y))
        W, b = regression_rows(model, *few)
        W = layout.scattered(W, i)
        parts.append(np.concatenate([W, b[:, :, None]], axis=2))
    rows = np.concatenate(parts)
    rows = rows[(np.abs(rows) < _HUGE).all(axis=(1, 2))]
    if not len(rows):
        return np.empty((0, rows.shape[2]))
    size = np.median(np.abs(rows).sum(axis=2), axis=0)
    return np.asarray((rows / np.where(size > 0.0, size, 1.0)[:, None]).reshape(-1, rows.shape[2]))
