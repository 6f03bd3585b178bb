"""Recordings for the Rerun viewer: measured and predicted signals, outliers, inputs and unmodelled forces over time.

========================  ====================================================================================
entity                    contents
========================  ====================================================================================
``/x/measured``           samples of the signal ``x``; a line that ends at gaps
``/x/predicted``          the simulation that a report shows: restarted where the motion is known; nothing in gaps
``/x/outliers``           samples that are outliers, as points
``/inputs/thrust``        an input
``/unmodelled/x``         unmodelled force, or acceleration, means over windows; of logs of the identification
``/replay``               bodies of a machine that MuJoCo simulates (`replay`), in logs of the identification
========================  ====================================================================================

Entities of several logs stand below the name of their log.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, runs
from diransac.atomic import write_with
from diransac.data.checks import rows_per_sample
from diransac.data.log import Log
from diransac.errors import ResultError
from diransac.identification.result import Result
from diransac.plain_text import one_line
from diransac.report.rendering import encodable
from diransac.report.replay import can_replay, send_replay
from diransac.report.runs import Entry, Run, simulate_all

_MEASURED, _PREDICTED, _OUTLIERS, _OTHER = (120, 120, 120), (31, 119, 180), (214, 39, 40), (44, 160, 44)
"""Colours, red, green and blue."""


def write_recording(result: Result, logs: Sequence[Log], path: str | Path) -> list[str]:
    """Write an ``.rrd`` file for the Rerun viewer about a result and one or several logs, with the layout of the views.

    Parameters
    ----------
    result : Result
    logs : sequence of Log
        Those that were given to `identify`, or others.
    path : str or Path
        Written whole or not at all.

    Returns
    -------
    list of str
        Sentences on what the file lacks.

    Raises
    ------
    ResultError
        The package rerun-sdk is missing, a log cannot be simulated by the model, or the file cannot be written.
    """
    rerun = _rerun()
    (entry,) = simulate_all({result.method: result}, logs)
    try:
        write_with(path, lambda draft: _write(rerun, entry, draft))
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror or error}") from error
    unknown = [run.log_name for run in entry.runs if run.view.diagnosis is None]
    return [f"{name}: unmodelled forces are unknown; lo-diransac estimates them in its own logs" for name in unknown]


def _rerun() -> Any:
    """The library.  Raises ResultError: it is missing."""
    try:
        import rerun
        import rerun.blueprint
    except ImportError as error:
        raise ResultError(
            'recordings for Rerun need the package rerun-sdk; install it with pip install "diransac[rerun]"'
        ) from error
    return rerun


# ---------------------------------------------------------------------- contents


@dataclass(frozen=True)
class _Series:
    """Samples over time, under the parts of an entity's path; NaN is no sample."""

    path: tuple[str, str]
    name: str
    time: FloatArray
    values: FloatArray
    colour: tuple[int, int, int]
    is_points: bool = False


def _series(run: Run) -> Iterator[_Series]:
    """All series of a log."""
    observations, model = run.observations, run.result.model
    time = observations.log.time[observations.offset :]
    for k, name in enumerate(observations.signals):
        unit, measured = model.units[name], observations.column(name)
        outliers = _outliers(run, name)
        yield _Series((name, "measured"), f"measured, {unit}", time, measured, _MEASURED)
        yield _Series((name, "predicted"), f"predicted, {unit}", time, run.simulated[:, k], _PREDICTED)
        yield _Series((name, "outliers"), "outliers", time[outliers], measured[outliers], _OUTLIERS, is_points=True)
    for name, unit in model.inputs.items():
        recorded = observations.log[name][observations.offset :]
        yield _Series(("inputs", name), f"{name}, {unit}", time, recorded, _OTHER)
    found = run.view.diagnosis
    if found is not None:
        series = found.unmodelled_forces or found.unmodelled_accelerations
        end = float(time[-1]) + observations.log.dt
        stamps = np.column_stack([found.smoothed_time, np.append(found.smoothed_time[1:], end) - observations.log.dt])
        for (name, values), rate in zip(series.items(), model.rate_names, strict=True):
            label = f"unmodelled force on {rate}" if found.unmodelled_forces else f"unmodelled {name}"
            yield _Series(("unmodelled", rate), label, stamps.ravel(), np.repeat(values, 2), _OTHER)


def _outliers(run: Run, name: str) -> BoolArray:
    """Samples (N,) of a signal that are outliers, or whose row disagrees where the noise is unknown."""
    measured = np.isfinite(run.observations.column(name))
    apart = run.outliers[name] if run.screened else run.observations.valid & ~run.inliers
    return np.asarray(apart & measured)


# ---------------------------------------------------------------------- file


def _write(rerun: Any, entry: Entry, file: Path) -> None:
    """Write every log, and a view for the bodies, each signal, the inputs and the unmodelled forces."""
    layout, several = rerun.blueprint, len(entry.runs) > 1
    tabs = []
    recording = rerun.RecordingStream("diransac")
    recording.send_recording_name(_text(f"{entry.result.model.name}: {entry.result.method}"))
    for run in entry.runs:
        above, series = ([_text(run.log_name)] if several else []), list(_series(run))
        for one in series:
            _send(rerun, recording, rerun.new_entity_path([*above, *map(_text, one.path)]), one)
        views = [
            layout.TimeSeriesView(origin=rerun.new_entity_path([*above, _text(group)]), name=_text(group))
            for group in dict.fromkeys(one.path[0] for one in series)
        ]
        if can_replay(run):
            send_replay(rerun, recording, above, run, {"measured": _MEASURED, "predicted": _PREDICTED})
            views.insert(0, layout.Spatial3DView(origin=rerun.new_entity_path([*above, "replay"]), name="replay"))
        tabs.append(layout.Grid(*views, name=_text(run.log_name)))
    whole = layout.Tabs(*tabs) if several else tabs[0]
    recording.save(file, default_blueprint=layout.Blueprint(whole))
    recording.flush()
    recording.disconnect()


def _send(rerun: Any, recording: Any, path: str, series: _Series) -> None:
    """Send the look of a series, and its samples; at the begin of a gap an empty entry, at which a line ends."""
    look = rerun.SeriesPoints if series.is_points else rerun.SeriesLines
    recording.log(path, look(names=_text(series.name), colors=[series.colour]), static=True)
    known = np.isfinite(series.values)
    sent, usual = known.copy(), rows_per_sample(known)
    sent[[rows.start for rows in runs(~known) if rows.stop - rows.start >= usual]] = True
    if sent.any():
        columns = rerun.Scalars.columns(scalars=series.values[known]).partition(known[sent].astype(np.int64))
        recording.send_columns(path, [rerun.TimeColumn("time", duration=series.time[sent])], columns)


def _text(text: str) -> str:
    """Text of one line in Unicode."""
    return encodable(one_line(text))
