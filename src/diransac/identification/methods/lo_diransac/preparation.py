"""Logs in shooting intervals, with screened inputs, and their smoothed motion."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray, long_runs
from diransac.data.segment import silent_rows
from diransac.errors import LogError
from diransac.identification.core.windows import ShootingIntervals
from diransac.identification.methods.lo_diransac.screening import (
    odd_window,
    running_median,
    screened_inputs,
    stuck_rows,
)
from diransac.identification.methods.lo_diransac.smoothing import Motion, Samples, choose_half_widths, smooth
from diransac.simulation import default_threads

if TYPE_CHECKING:
    from collections.abc import Sequence

    from diransac.data.dataset import Dataset
    from diransac.data.segment import Segment
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings

FEWEST_INTERVALS = 4
"""Intervals of all logs at least, and of one that is compared with the others."""

_MOST_INPUTS, _MOST_SAMPLES = 15, 31
"""Samples of running medians at most: spikes last for samples, however many of them there are in a second."""


def prepared(settings: LoDiransacSettings, dataset: Dataset) -> tuple[ShootingIntervals, Motion, tuple[str, ...]]:
    """The logs in intervals of the motion's own time scale, and the motion, row by row of them.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset

    Returns
    -------
    intervals : ShootingIntervals
        Inputs are screened, and act as recorded.
    motion : Motion
    notes : tuple of str

    Raises
    ------
    LogError
        The logs are too short.
    """
    model, dt = dataset.model, dataset.dt
    found = [screened(settings, one, dt) for one in dataset.segments]
    samples = [x for x, _, _ in found]
    several = len(samples) > 1
    notes = [
        f"{one.log.source}: {note}" if several else note
        for one, (_, _, said) in zip(dataset.segments, found, strict=True)
        for note in said
    ]
    halves, length = choose_half_widths(model, samples, dt, settings.smoothing_half_width)
    n_rows, longest = sum(map(len, dataset.segments)), max(map(len, dataset.segments))
    if n_rows < FEWEST_INTERVALS * length or longest < length:
        raise LogError(
            f"{dataset.source}: {n_rows} rows are too few; lo-diransac needs at least "
            f"{FEWEST_INTERVALS * length}. Give a longer log"
        )
    if not any(long_runs(~x.gaps, length).any() for x in samples):
        raise LogError(
            f"{dataset.source}: no {length} rows in a row are without a gap in the inputs or in all sensors; give a "
            "log with longer stretches"
        )
    motions = smooth(model, samples, dt, halves)
    intervals = cut(settings, dataset, found, length)
    rows = zip(motions, intervals.rows_of_logs, strict=True)
    signals = np.concatenate([_to_length(x.signals, r.stop - r.start) for x, r in rows])
    return intervals, Motion(signals, motions[0].spread), tuple(notes)


def cut(
    settings: LoDiransacSettings,
    dataset: Dataset,
    samples: Sequence[tuple[Samples, FloatArray, list[str]]],
    length: int,
) -> ShootingIntervals:
    """Intervals of the logs.

    Parameters
    ----------
    settings : LoDiransacSettings
    dataset : Dataset
    samples : sequence of (Samples, (N, n_u) array, list of str)
        Of each log, as from `screened`.
    length : int
        Rows of an interval.
    """
    logs = [(x.measured, x.known, u, x.gaps) for x, u, _ in samples]
    found = ShootingIntervals.of(
        dataset.model, dataset.layout, logs, dataset.dt, length, settings.substeps, dataset.hold
    )
    return replace(found, threads=settings.criteria.threads or default_threads())


def _to_length(values: FloatArray, n_rows: int) -> FloatArray:
    return np.pad(values, ((0, n_rows - len(values)), (0, 0)), mode="edge")


def screened(settings: LoDiransacSettings, one: Segment, dt: float) -> tuple[Samples, FloatArray, list[str]]:
    """Samples and inputs of one log, and findings, a sentence each.

    Parameters
    ----------
    settings : LoDiransacSettings
    one : Segment
    dt : float
        Sampling time, s.
    """
    model, notes, measured = one.model, [], one.measured
    if one.signals != tuple(model.signals):
        measured = np.full((len(one), len(model.signals)), np.nan)
        measured[:, [model.signals.index(n) for n in one.signals]] = one.measured
    present = [one.signals.index(n) for n in one.present]
    stuck = stuck_rows(one.measured[:, present]) if settings.stuck_rows else np.zeros(len(one), bool)
    known = np.isfinite(measured) & ~stuck[:, None]
    measured = measured if known.all() else np.where(known, measured, 0.0)
    inputs, n_leaps = screened_inputs(
        one.inputs, odd_window(settings.input_window, dt, _MOST_INPUTS), settings.input_threshold
    )
    if stuck.any():
        notes.append(f"{stuck.sum()} rows repeat the row before in every signal, and were taken as missing")
    if n_leaps:
        notes.append(f"inputs leap for a moment in {n_leaps} rows; the running median replaces them")
    centre = running_median(measured, known, odd_window(settings.median_window, dt, _MOST_SAMPLES))
    return Samples(measured, known, centre, one.gaps | silent_rows(known, dt)), inputs, notes
