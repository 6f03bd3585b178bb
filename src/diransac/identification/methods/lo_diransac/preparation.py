"""Logs in shooting intervals, and their smoothed motion; rows that repeat the row before are missing samples."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, long_runs, robust_std, runs
from diransac.data.segment import silent_rows
from diransac.errors import LogError
from diransac.identification.core.windows import Windows
from diransac.identification.methods.lo_diransac.smoothing import Motion, Samples, choose_half_widths, smooth
from diransac.simulation import default_threads

if TYPE_CHECKING:
    from collections.abc import Sequence

    from diransac.data.dataset import Dataset
    from diransac.data.segment import Segment
    from diransac.identification.methods.lo_diransac.settings import LoDiransacSettings

FEWEST_INTERVALS = 4
"""Intervals of all logs at least, and of one that is compared with the others."""


def prepared(settings: LoDiransacSettings, dataset: Dataset) -> tuple[Windows, Motion, tuple[str, ...]]:
    """The logs in intervals of the motion's own time scale, the motion in their rows, and notes.

    Raises
    ------
    LogError
        The logs are too short.
    """
    samples, notes = screened(dataset)
    halves, length = choose_half_widths(dataset.model, samples, dataset.dt, settings.smoothing_half_width)
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
    motions = smooth(dataset.model, samples, dataset.dt, halves)
    intervals = cut(settings, dataset, samples, length)
    missing = [r.stop - r.start - len(x.signals) for x, r in zip(motions, intervals.rows_of_logs, strict=True)]
    signals = [np.pad(x.signals, ((0, n), (0, 0)), mode="edge") for x, n in zip(motions, missing, strict=True)]
    return intervals, Motion(np.concatenate(signals), motions[0].spread), notes


def cut(settings: LoDiransacSettings, dataset: Dataset, samples: Sequence[Samples], length: int) -> Windows:
    """Intervals of ``length`` rows, of the samples of each log."""
    logs = [(x.measured, x.known, log.inputs, x.gaps) for x, log in zip(samples, dataset.segments, strict=True)]
    intervals = Windows.of(dataset.model, dataset.layout, logs, dataset.dt, length, settings.substeps, dataset.hold)
    return replace(intervals, threads=settings.criteria.threads or default_threads())


def screened(dataset: Dataset) -> tuple[list[Samples], tuple[str, ...]]:
    """Samples of each log without rows that are stuck, and a note on each log that has some."""
    samples, notes = [], []
    for log in dataset.segments:
        stuck = stuck_rows(log.measured[:, [log.signals.index(name) for name in log.present]])
        samples.append(_samples(log, stuck, dataset.dt))
        if stuck.any():
            source = f"{log.log.source}: " if len(dataset.segments) > 1 else ""
            notes.append(f"{source}{stuck.sum()} rows repeat the row before in every signal, and were taken as missing")
    return samples, tuple(notes)


def _samples(log: Segment, stuck: BoolArray, dt: float) -> Samples:
    """Samples of a log in the model's order of signals."""
    order = list(log.model.signals)
    measured = np.full((len(log), len(order)), np.nan)
    measured[:, [order.index(name) for name in log.signals]] = log.measured
    known = np.isfinite(measured) & ~stuck[:, None]
    return Samples.of(np.where(known, measured, 0.0), known, log.gaps | silent_rows(known, dt), dt)


def stuck_rows(measured: FloatArray) -> BoolArray:
    """Rows that repeat the previous row exactly in every signal, and are no standing still: nothing new was measured.

    Rows that repeat more often than the noise of the signals, in steps of their resolution, lets them by chance are
    stuck.  Signals of a coarse resolution repeat at rest.  Rows are at rest if motion then begins from rest in each
    signal, with a step that is no larger than the one that follows, or one of its resolution, within the noise; a
    recorder that was stuck catches up.

    Parameters
    ----------
    measured : (N, n) array

    Returns
    -------
    (N,) bool array
    """
    last, repeated = len(measured) - 1, np.zeros(len(measured), bool)
    repeated[1:] = np.all(measured[1:] == measured[:-1], axis=1)
    if not repeated.any():
        return repeated
    resolution, noise = _resolutions(measured), _noise(measured[~repeated])
    # Two samples with noise are equal, in steps of the resolution, with this probability.
    chance = np.divide(resolution, 2.0 * np.sqrt(np.pi) * noise, out=np.ones_like(noise), where=noise > resolution)
    begin, end = np.array([(run.start, run.stop) for run in runs(repeated)]).T
    ahead, further = (np.minimum(rows, last) for rows in (end, end + 1))
    leap, step = np.abs(measured[ahead] - measured[begin]), np.abs(measured[further] - measured[ahead])
    at_rest = np.all(leap < 1.5 * np.maximum(resolution, step) + 3.0 * noise, axis=1)
    is_chance = len(measured) * chance.prod() ** (end - begin) > _CHANCE
    repeated[repeated] = np.repeat(~(at_rest & is_chance), end - begin)
    return repeated


# Expected number of runs of equal rows in a log up to which one is no chance.
_CHANCE = 0.01


def _resolutions(measured: FloatArray) -> FloatArray:
    """Smallest step ``(n,)`` of each signal that is no rounding error; infinite for a constant one."""
    changes = np.abs(np.diff(measured, axis=0))
    least = np.sqrt(np.finfo(float).eps) * np.nan_to_num(np.abs(measured)).max(axis=0)
    return np.asarray(np.where(changes > least, changes, np.inf).min(axis=0))


def _noise(measured: FloatArray) -> FloatArray:
    """Standard deviation ``(n,)`` of the noise of signals by differences of fourth order, in which motion is small."""
    fourth = np.diff(measured, 4, axis=0)
    fourth = fourth[np.isfinite(fourth).all(axis=1)]
    # The variance of a difference of fourth order is 1 + 16 + 36 + 16 + 1 times that of a sample.
    return np.asarray(robust_std(fourth, axis=0) / np.sqrt(70.0) if len(fourth) else np.zeros(measured.shape[1]))
