"""Stretches of a log in which the model does not hold: on the ground, in somebody's hand, against a stop.

There the unmodelled accelerations are many times those of the rest of the log, over longer than a moment.  The
robust scale of the rest holds as long as it is more than half of the log.

References
----------
Rousseeuw, Croux 1993 (the median absolute deviation as a scale with a breakdown point of one half).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.segment import runs

if TYPE_CHECKING:
    from collections.abc import Mapping

    from diransac.identification.estimate import Diagnosis

__all__ = ["Departure", "departures"]

_LENGTH = 8
"""Windows of the unmodelled accelerations over which their RMS is taken."""
_FEWEST = 5 * _LENGTH
_NORMAL = 1.4826
_FAR, _OWN = 6.0, 3.0
"""RMS of a stretch, and size within it, over the scale of the log.

Of one log of each regime of the robustness benchmark, those of saturated and of wrong inputs alone exceed it.
"""
_MATERIAL = 0.3
"""RMS of a stretch over that of the accelerations by the model."""


@dataclass(frozen=True)
class Departure:
    """A stretch in which the model does not hold.

    Parameters
    ----------
    start, stop : float
        In the time of its log, s.
    ratio : float
        RMS of the unmodelled acceleration there over its robust scale, of the acceleration where that is largest.
    """

    start: float
    stop: float
    ratio: float


def departures(diagnosis: Diagnosis, log: int, unexplained: Mapping[str, float]) -> list[Departure]:
    """Stretches of a log in which the model does not hold, in their order.

    Parameters
    ----------
    diagnosis : Diagnosis
    log : int
        Number of the log.
    unexplained : mapping of str to float
        Share of each acceleration that the model leaves unexplained in this log, ``u / (u + m)``.
    """
    windows = diagnosis.windows_of(log)
    time = diagnosis.unmodelled_time[windows]
    if len(windows) < _FEWEST:
        return []
    departing, ratios = np.zeros(len(windows), bool), np.zeros(len(windows))
    for name, share in unexplained.items():
        values = diagnosis.unmodelled_accelerations[name][windows]
        ratio = _ratio(values)
        if share <= 0.0 or ratio is None:
            continue
        scale = _scale(values)
        modelled = float(np.sqrt(np.mean(np.square(values)))) * (1.0 - share) / share
        far = (ratio > _FAR) & (ratio * scale > _MATERIAL * modelled)
        departing |= far & (np.abs(values) > _OWN * scale)
        ratios = np.maximum(ratios, np.where(far, ratio, 0.0))
    width = float(np.median(np.diff(time)))
    return [
        Departure(float(time[x.start] - width), float(time[x.stop - 1] + width), float(ratios[x].max()))
        for x in _joined(departing)
    ]


def _scale(values: FloatArray) -> float:
    """Robust standard deviation about zero of the values that are not zero, as in gaps."""
    moving = np.abs(values[values != 0.0])
    return _NORMAL * float(np.median(moving)) if len(moving) >= _FEWEST else 0.0


def _ratio(values: FloatArray) -> FloatArray | None:
    """Largest RMS ``(W,)`` of the stretches that hold each window, over the scale; None without a scale."""
    scale = _scale(values)
    if scale <= 0.0:
        return None
    total = np.cumsum(np.r_[0.0, np.square(values / scale)])
    rms = np.sqrt((total[_LENGTH:] - total[:-_LENGTH]) / _LENGTH)
    padded = np.pad(rms, _LENGTH - 1)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, _LENGTH).max(axis=1))


def _joined(flags: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[slice]:
    """Stretches of set flags; those apart by less than a stretch's length are one."""
    found: list[slice] = []
    for one in runs(flags):
        if found and one.start - found[-1].stop < _LENGTH:
            found[-1] = slice(found[-1].start, one.stop)
        else:
            found.append(one)
    return found
