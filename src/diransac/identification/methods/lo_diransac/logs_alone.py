"""Estimates of each of several logs alone, from the answer of all of them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.errors import IdentificationError
from diransac.identification.core.minimise import make_prior
from diransac.identification.estimate import LogEstimate
from diransac.identification.method import report
from diransac.identification.methods.lo_diransac.local_search import LocalSearch
from diransac.identification.methods.lo_diransac.motion_equations import discrepancy_units
from diransac.identification.methods.lo_diransac.preparation import FEWEST_INTERVALS
from diransac.identification.methods.lo_diransac.search import Searched, parameters_of
from diransac.identification.methods.lo_diransac.simulation_error import estimates_of_logs

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.core.fit import Fit
    from diransac.identification.core.windows import Windows
    from diransac.identification.method import Callback
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings


def estimates_alone(
    settings: LoDiransacSettings, dataset: Dataset, found: Searched, callback: Callback | None
) -> list[LogEstimate]:
    """Estimates of each log alone: by simulation error where that was decided on, else by a fit.

    A fit begins with that of all logs, and has its own noise and errors of its own recordings.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset
    found : Searched
        The search of all logs.
    callback : callable or None

    Returns
    -------
    list of LogEstimate
        With infinite standard errors of logs that are too short, or whose fit fails.

    Raises
    ------
    TimeLimitError
        The time limit was reached.
    """
    report(callback, "comparing logs", 0.0)
    if (decided := found.decided) is not None:
        return estimates_of_logs(decided.answer, found.motion, decided.n_rows, outliers=settings.outliers)
    each = []
    for i in range(len(dataset.segments)):
        report(callback, f"log {i + 1} alone", i / len(dataset.segments))
        one = dataset.subset([i])
        estimate = LogEstimate(dict.fromkeys(one.layout.names, 0.0), dict.fromkeys(one.layout.names, np.inf))
        if (found.likeliest.intervals.log_of == i).sum() >= FEWEST_INTERVALS:
            with suppress(IdentificationError, np.linalg.LinAlgError):
                estimate = _estimate_of_log(settings, one, found, i)
        each.append(estimate)
    return each


def _estimate_of_log(settings: LoDiransacSettings, one: Dataset, found: Searched, i: int) -> LogEstimate:
    """Estimate of the i-th log, of which a dataset is given."""
    every = found.likeliest.intervals
    intervals, rows = every.of_log(i, one.layout), every.rows_of_logs[i]
    fit = _of_log(every, found.likeliest.refinement.fit, i)
    motion = replace(found.motion, signals=found.motion.signals[rows])
    p = fit.shared[: intervals.n_p]
    prior = make_prior(settings, intervals, motion, discrepancy_units(intervals, motion, p))
    search = LocalSearch(settings, motion, p, prior, None)
    likeliest = search.continued(intervals, fit, found.likeliest)
    own = Searched(motion, (), 1, likeliest, *parameters_of(likeliest))
    errors = np.sqrt(np.diag(own.result.covariance))
    errors[one.layout.on_bounds(own.result.parameters)] = np.inf
    late, names = own.common_timing, one.layout.names
    delay = (late.size * every.dt, late.std * every.dt) if late else (0.0, np.inf)
    values, spans = (dict(zip(names, x.tolist(), strict=True)) for x in (own.result.parameters, errors))
    return LogEstimate(values, spans, *delay)


def _of_log(intervals: Windows, fit: Fit, i: int) -> Fit:
    """The part of a fit that is of one log."""
    chosen, rows = intervals.log_of == i, intervals.rows_of_logs[i]
    place = np.concatenate([intervals.layout.index[i], np.arange(intervals.n_p, len(fit.shared))])
    shared = {name: getattr(fit, name)[place] for name in ("shared", "prior", "prior_mean")}
    of_intervals = {name: getattr(fit, name)[chosen] for name in ("x", "d", "ends")}
    return replace(fit, residuals=fit.residuals[rows], **shared, **of_intervals)
