"""Figures of the spectra of one-step innovations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from diransac.identification.assessment.innovations import Innovations
from diransac.report.figures import Figure, Panel, Timeline, Trace, padded, time_axis, time_plot
from diransac.report.runs import Entry, Run
from diransac.text_table import number

__all__ = ["spectrum_figures"]

_MOST, _DEEPEST = 12, 40.0
"""Figures of a page at most; depth of a spectrum that is shown, dB."""


def spectrum_figures(entries: Sequence[Entry]) -> list[Figure]:
    """A figure for each signal, with a line for every result, of the first log whose innovations are known.

    Parameters
    ----------
    entries : results of the page
    """
    having = [(i, one) for i, entry in enumerate(entries) for one in _first(entry.runs)]
    names = list(dict.fromkeys(name for _, one in having for name in one.normalized))
    return [
        _figure(name, [(i, entries[i].label, one) for i, one in having if name in one.normalized]) for name in names
    ][:_MOST]


def _first(runs: Sequence[Run]) -> list[Innovations]:
    """Innovations of the first log that has any."""
    found = [one for run in runs if not isinstance(run.validation, str) for one in run.validation.innovations]
    return found[:1]


def _figure(name: str, having: Sequence[tuple[int, str, Innovations]]) -> Figure:
    traces, lowest, highest = [], 0.0, 0.0
    axis = Timeline(1, 0.0, 1.0)
    for i, label, one in having:
        f, density = one.spectrum(name)
        level = 10.0 * np.log10(np.maximum(density[1:] / (2.0 * one.dt), 1e-12))
        highest, lowest = max(highest, float(level.max())), min(lowest, float(level.min()))
        axis = Timeline(len(level), float(f[1]), float(f[1]), 400)
        traces.append(Trace(label, f"m{i}", "line", np.arange(len(level)), level))
    scale = padded(max(lowest, highest - _DEEPEST), highest)
    plot = time_plot(traces, scale, axis, f"Spectrum of the innovations of {name}", levels=(0.0,), still=True)
    facts = tuple(f"deviation {number(one.standard_deviation[name], 3)}" for _, _, one in having)
    return Figure(name, "dB of white noise", facts, (Panel(plot),), time_axis(axis), x_label="frequency, Hz")
