"""The one vector of shared unknowns: parameters of all logs, discrepancies, and errors of recordings ("effects").

An effect is a systematic error of a sensor or an input: a delay, a lag, a bias, a drift of a gain.  Like a parameter,
it has a name, bounds and a Gaussian prior, which is so wide that cost and evidence leave it out: it decides where a log
does not.  An effect that is off is not among the unknowns.  A per-log parameter has a place
of each log in the vector, and windows touch the places of their own log alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray

if TYPE_CHECKING:
    from diransac.identification.core.windows import Windows

_LATEST = 0.1
"""Largest delay or lag, over the duration of the longest log."""


@dataclass(frozen=True)
class EffectKind:
    """Kind of error of a recording, of one signal or input, or of a group alike.

    Parameters
    ----------
    columns : tuple of int
        Indices of the signals, or of the inputs.
    what : str
        "delay", in samples; of signals "bias", in their unit; of inputs "lag", the time constant of a first-order lag
        in samples, and "drift", the relative change of their gain over a log.
    of_inputs : bool, optional
    """

    columns: tuple[int, ...]
    what: Literal["delay", "bias", "lag", "drift"]
    of_inputs: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class Effects:
    """Systematic errors of the sensors and of the inputs, and what the sensors measured.

    Parameters
    ----------
    measured : (N, n_s) array
    sampled : (N, n_s) bool array
        As recorded.
    n_inputs : int
    sizes : mapping from EffectKind to float, optional
        Errors that are estimated; those of one signal or input add.
    """

    measured: FloatArray
    sampled: BoolArray
    n_inputs: int
    sizes: Mapping[EffectKind, float] = field(default_factory=dict)

    @property
    def kinds(self) -> tuple[EffectKind, ...]:
        """Errors that are estimated."""
        return tuple(self.sizes)

    @property
    def delay(self) -> FloatArray:
        """Samples ``(n_s,)`` by which each signal is recorded late."""
        return self._total("delay", of_inputs=False)

    @property
    def bias(self) -> FloatArray:
        """Constant error ``(n_s,)`` of each signal, its unit."""
        return self._total("bias", of_inputs=False)

    @property
    def input_delay(self) -> FloatArray:
        """Samples ``(n_u,)`` after which each input acts."""
        return self._total("delay", of_inputs=True)

    @property
    def input_lag(self) -> FloatArray:
        """Time constant ``(n_u,)`` of each actuator, samples."""
        return np.maximum(self._total("lag", of_inputs=True), 0.0)

    @property
    def gain_drift(self) -> FloatArray:
        """Relative change ``(n_u,)`` of each input's gain over a log."""
        return self._total("drift", of_inputs=True)

    def _total(self, what: str, *, of_inputs: bool) -> FloatArray:
        found = np.zeros(self.n_inputs if of_inputs else self.measured.shape[1])
        for kind, size in self.sizes.items():
            if kind.what == what and kind.of_inputs == of_inputs:
                found[list(kind.columns)] += size
        return found

    def plus(self, more: Mapping[EffectKind, float]) -> Effects:
        """These errors and others.

        Parameters
        ----------
        more : mapping from EffectKind to float

        Returns
        -------
        Effects
        """
        sizes = {**self.sizes, **{kind: self.sizes.get(kind, 0.0) + x for kind, x in more.items()}}
        return replace(self, sizes=sizes)


def places(intervals: Windows) -> IntArray:
    """Places of the shared unknowns of each log, (n_logs, n)."""
    rest = np.arange(intervals.n_p, intervals.n_shared)
    return np.hstack([intervals.layout.index, np.broadcast_to(rest, (intervals.layout.n_logs, len(rest)))])


def of_logs(intervals: Windows, values: FloatArray, part: slice = slice(None)) -> FloatArray:
    """Values of the shared unknowns of each interval's own log.

    Parameters
    ----------
    intervals : Windows
    values : (n_s, ...) array
    part : slice, optional
        Intervals; all where none are given.

    Returns
    -------
    (W, n_own, ...) array
    """
    logs = intervals.log_of[part]
    if intervals.layout.is_shared:
        return np.broadcast_to(values, (len(logs), *values.shape))
    return np.asarray(values[places(intervals)[logs]])


def in_places(intervals: Windows, values: FloatArray) -> FloatArray:
    """Values ``(n, ...)`` of the first intervals' own shared unknowns in the places of their logs, (n, n_s)."""
    if intervals.layout.is_shared:
        return values.copy()
    wide = np.zeros((len(values), intervals.n_shared))
    np.put_along_axis(wide, places(intervals)[intervals.log_of[: len(values)]], values, axis=1)
    return wide


def sum_of_products(intervals: Windows, a: FloatArray, b: FloatArray, part: slice = slice(None)) -> FloatArray:
    """Sums ``(n_s, ...)`` over intervals of ``a @ b``, in the places of their logs.

    Parameters
    ----------
    intervals : Windows
    a : (n, n_own, m) array
        Of the shared unknowns of the first intervals' own logs.
    b : (n, m, ...) array
    part : slice, optional
        Intervals, of which those are the first.
    """
    if intervals.layout.is_shared:
        return np.asarray(np.tensordot(a, b, ([0, 2], [0, 1])))
    found, logs = np.zeros((intervals.n_shared, *b.shape[2:])), intervals.log_of[part][: len(a)]
    for i, at in enumerate(places(intervals)):
        found[at] += np.tensordot(a[logs == i], b[logs == i], ([0, 2], [0, 1]))
    return found


def sum_in_places(intervals: Windows, values: FloatArray) -> FloatArray:
    """Sums over intervals, in the places of their logs.

    Parameters
    ----------
    intervals : Windows
    values : (n, n_own, ...) array
        Of the shared unknowns of the first intervals' own logs.

    Returns
    -------
    (n_s, ...) array
    """
    if intervals.layout.is_shared:
        return np.asarray(values.sum(axis=0))
    found = np.zeros((intervals.n_shared, *values.shape[2:]))
    for i, at in enumerate(places(intervals)):
        found[at] += values[intervals.log_of[: len(values)] == i].sum(axis=0)
    return found


def shared_blocks(
    intervals: Windows, border: FloatArray, corner: FloatArray, right: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Border ``(W, k, n_s)``, sums of corner ``(n_s, n_s)`` and right side ``(n_s,)`` in the places of each log."""
    if intervals.layout.is_shared:
        return border, corner.sum(axis=0), right.sum(axis=0)
    n_s = intervals.n_shared
    wide, whole, total = np.zeros((*border.shape[:2], n_s)), np.zeros((n_s, n_s)), np.zeros(n_s)
    for i, at in enumerate(places(intervals)):
        own = np.flatnonzero(intervals.log_of == i)
        wide[own[:, None, None], np.arange(border.shape[1])[None, :, None], at] = border[own]
        whole[np.ix_(at, at)] += corner[own].sum(axis=0)
        total[at] += right[own].sum(axis=0)
    return wide, whole, total


def largest_size(intervals: Windows, kind: EffectKind) -> float:
    """Largest size of an error, and its prior standard deviation: a tenth of the log, a signal's range, all of a gain.

    Parameters
    ----------
    intervals : Windows
    kind : EffectKind
    """
    if kind.what == "bias":
        columns = list(kind.columns)
        seen = np.where(intervals.sampled[:, columns], intervals.measured[:, columns], np.nan)
        return float(np.nanmax(seen) - np.nanmin(seen)) or 1.0
    return 1.0 if kind.what == "drift" else _LATEST * max(x.stop - x.start for x in intervals.rows_of_logs)


def is_possible(intervals: Windows, kind: EffectKind, more: float) -> bool:
    """True if an error that is larger by some amount stays below the largest one, and time constants positive."""
    size = intervals.all_errors.sizes.get(kind, 0.0) + more
    lags = intervals.all_errors.input_lag[list(kind.columns)] if kind.what == "lag" else np.ones(1)
    return bool(abs(size) < largest_size(intervals, kind) and (kind.what != "lag" or (lags + more > 0.0).all()))


def bounded(intervals: Windows, now: FloatArray, then: FloatArray) -> FloatArray:
    """Shared unknowns ``(n_s,)``, parameters within their bounds; a positive one at most halves or doubles."""
    then = then.copy()
    for j, bounds in enumerate(intervals.layout.bounds):
        then[j] = np.clip(then[j], bounds.lower, bounds.upper)
        if bounds.positive:
            then[j] = np.clip(then[j], 0.5 * now[j], 2.0 * now[j])
    return then
