"""What is wrong with the log, and what acts on the machine that the model lacks: lo-diransac's diagnosis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from diransac.arrays import FloatArray
from diransac.identification.diagnosis import Diagnosis
from diransac.report.figures import Scale, Timeline, Trace, padded, time_axis, time_plot
from diransac.report.markup import Html, join, number, percent, table, tag
from diransac.report.runs import Run

__all__ = ["diagnoses"]


_VISIBLE = 0.01
_FORCES = {"m/s^2": "N", "rad/s^2": "N m"}


def diagnoses(runs: Sequence[Run], timeline: Timeline) -> list[Html]:
    """The section, if any result has a diagnosis."""
    having = [(i, run) for i, run in enumerate(runs) if run.result.diagnosis is not None]
    if not having:
        return []
    several = len(runs) > 1
    parts = [_diagnosis(run, i, timeline, several) for i, run in having]
    return [tag("section", tag("h2", "The log, and what the model leaves out"), *parts, id="diagnosis")]


def _diagnosis(run: Run, i: int, timeline: Timeline, several: bool) -> Html:
    found = run.result.diagnosis
    assert found is not None
    parts = [_table(run, found, several)]
    if found.input_delay_significant:
        delay, error = number(1e3 * found.input_delay, 3), number(1e3 * found.input_delay_error, 2)
        parts.append(tag("p", f"Inputs act {delay} ± {error} ms later than the log says; that is allowed for."))
    if not run.held_out:
        parts.append(_unexplained(run, found, i, timeline))
    return join(parts)


def _table(run: Run, found: Diagnosis, several: bool) -> Html:
    """Noise, outliers, and what is unexplained, a row a signal."""
    units = run.result.model.units
    rows = []
    for name in dict.fromkeys((*found.noise_std, *found.unmodelled_accelerations)):
        measured = name in found.noise_std
        noise = number(found.noise_std[name], 2) if measured else "not measured"
        share = percent(found.outlier_fraction[name]) if measured else "–"
        latent = found.unmodelled_accelerations.get(name)
        unexplained = "" if latent is None else number(_rms(latent), 2)
        rows.append((name, units[name], noise, share, unexplained))
    about = (
        "Noise: standard deviation of what is Gaussian. Outliers: samples that are not. Unexplained: RMS of the "
        "accelerations that the model does not make."
    )
    header = ("Signal", "Unit", "Noise", "Outliers", "Unexplained")
    caption = f"By {run.label}" if several else "Signal by signal"
    return join([tag("p", about, class_="how"), table(header, rows, caption)])


def _unexplained(run: Run, found: Diagnosis, i: int, timeline: Timeline) -> Html:
    """What acts on the machine and is not in the model, over time."""
    forces = found.unmodelled_forces
    if forces:
        about = "What acts on the machine and is not in the model, as a force along each coordinate"
    else:
        forces, about = found.unmodelled_accelerations, "The acceleration of the machine that the model does not make"
    text = f"{about}: zero where the model explains the motion. Each step is the mean over {_window(found)}."
    figures = [_figure(run, name, values, found, i, timeline) for name, values in forces.items()]
    return join([tag("p", text, class_="how"), tag("div", *figures, class_="figures")])


def _window(found: Diagnosis) -> str:
    time = found.smoothed_time
    return f"{number(float(time[1] - time[0]), 3)} s" if len(time) > 1 else "the log"


def _figure(run: Run, name: str, values: FloatArray, found: Diagnosis, i: int, timeline: Timeline) -> Html:
    model = run.result.model
    unit = _FORCES.get(model.units[name], "") if found.unmodelled_forces else model.units[name]
    moved = model.rate_names[list(model.accelerations).index(name)]
    what = f"force on {moved}" if found.unmodelled_forces else name
    trace = Trace(what, f"m{i}", "line", *_steps(found, values, timeline))
    scale = _scale(values, run.unexplained.get(name, 0.0))
    size = f"RMS {number(_rms(values), 2)} {unit}".strip()
    heading = tag("h3", what, " ", tag("span", unit, class_="unit"))
    caption = tag("figcaption", heading, tag("p", f"{size}, {_share(run, name)}"))
    label = f"What the model does not explain: {what}{f' in {unit}' if unit else ''}"
    return tag("figure", caption, time_plot([trace], scale, timeline, label, levels=(0.0,)), time_axis(timeline))


def _scale(values: FloatArray, share: float) -> Scale:
    """The values' range, and at least so much of what moves the machine that nothing looks like nothing."""
    least = _VISIBLE * _rms(values) / share if share > 0.0 else 0.0
    return padded(min(-least, float(values.min())), max(least, float(values.max())))


def _share(run: Run, name: str) -> str:
    """How large the unexplained acceleration is beside the machine's."""
    return f"{percent(run.unexplained[name])} of what moves it" if name in run.unexplained else "the machine rests"


def _steps(found: Diagnosis, values: FloatArray, timeline: Timeline) -> tuple[npt.NDArray[np.int64], FloatArray]:
    """Rows and values of a line that is constant over each window."""
    begins = np.rint((found.smoothed_time - timeline.start) / timeline.dt).astype(np.int64)
    ends = np.append(begins[1:] - 1, timeline.n_rows - 1)
    return np.column_stack([begins, ends]).ravel(), np.repeat(values, 2)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
