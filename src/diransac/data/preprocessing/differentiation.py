"""Velocities and accelerations from positions, and regression rows low-pass filtered against their noise.

Two zero-phase filters of one kind are used (see `diransac.data.filters`).  Signals are derived with four times the
bandwidth, so that nonlinear terms, such as the sign of a velocity, switch at the right time.  The rows of the
regression ``W p = b``, which holds at every instant, are filtered with the bandwidth itself, both sides alike: a
weighted sum of true equations is a true equation, whatever ``W``.  So the bandwidth selects the part of the motion that
is used, and does not distort the equations.

Inputs are held from each sample to the next, as in every simulation of this package.  The mean input around a sample is
half of the input before it and half of the input after it: `acting_inputs`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, runs
from diransac.data.checks import other_spelling, rows_per_sample
from diransac.data.filters import REACH, FilterSpecification, convolve, half_length, kernels
from diransac.data.preprocessing.continuity import continuous, unit_quaternions, whole_quaternions
from diransac.data.preprocessing.steps import in_units
from diransac.data.units import same_unit
from diransac.errors import LogError, SettingsError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from diransac.data.log import Log
    from diransac.model import Model

_LONGEST_BRIDGE = 0.25
"""Gaps that are bridged, at most, in periods of the bandwidth."""
_HIGHEST = 0.1
"""Bandwidth times sample interval that is chosen at most."""


def differentiate(log: Log, model: Model, bandwidth: float | None = None) -> Log:
    """Log with the velocities and accelerations that the model needs and the log lacks, all signals filtered alike.

    Parameters
    ----------
    log : Log
    model : Model
    bandwidth : float, optional
        Bandwidth of the regression's rows, Hz.  None: `choose_bandwidth`.

    Returns
    -------
    Log
        With `Log.filter` set, fewer rows at both ends, and the model's signals and inputs filtered.

    Raises
    ------
    LogError
        A signal that the equations need is missing and cannot be derived, or holds an infinity; the log is too short.
    SettingsError
        The bandwidth is not positive, or too high for the log's rate.

    Notes
    -----
    Accelerations are derived from measured velocities where there are any, from coordinates otherwise.  All of the
    model's signals and inputs pass the same zero-phase filter; rows at both ends that it cannot fill are cut.  Missing
    samples are bridged by a cubic if they last no longer than a quarter of the bandwidth's period; a longer gap stays
    NaN, with the samples within the filter's reach.  Coordinates are made continuous first, and filtered quaternions
    have unit norm; see `continuous`.
    """
    sources = _sources(log, model)
    log = continuous(in_units(log, model), model)
    names = _filtered(log, model)
    log.check(names)
    bridged = {name: _bridge(log[name]) for name in names}
    chosen = None
    if bandwidth is None:
        chosen = choose_bandwidth([(bridged[name], order) for name, order in _motions(log, model)], log.dt)
        bandwidth = chosen.value
    wide = _derivation_bandwidth(log, bandwidth)
    L = half_length(wide, log.dt)
    derived = {**{name: (name, 0) for name in names}, **sources}
    blank = {name: _near_long_gaps(log[name], _LONGEST_BRIDGE / (bandwidth * log.dt), L) for name in names}
    signals = _on_spheres({**log.signals, **_derived(bridged, derived, blank, kernels(wide, log.dt))}, model)
    _check_slow(log, model, signals, bandwidth)
    specification = FilterSpecification(bandwidth, wide, {name: source for name, (source, _) in sources.items()})
    filtered = log.with_step(
        _step(specification, chosen, names, L),
        time=log.time[L:-L],
        signals={name: values[L:-L] for name, values in signals.items()},
        units={**log.units, **_units(log, model, sources)},
        notes=_notes(bandwidth, chosen, sources, L * log.dt),
    )
    return replace(filtered, filter=specification)


def _check_slow(log: Log, model: Model, signals: Mapping[str, FloatArray], bandwidth: float) -> None:
    """Raise LogError: samples of a signal are so far apart that the filter bridges none of its gaps."""
    for name in model.required_signals:
        if name in log and np.isnan(signals[name]).all():
            every = rows_per_sample(np.isfinite(log[name]))
            raise LogError(
                f'{log.source}: "{name}" has a sample every {every} rows, too slow for a filter of {bandwidth:.3g} Hz; '
                f"give --bandwidth below {_LONGEST_BRIDGE / (every * log.dt):.2g} Hz, or use lo-diransac, which needs "
                "no filter"
            )


def _derived(
    bridged: Mapping[str, FloatArray],
    derived: Mapping[str, tuple[str, int]],
    blank: Mapping[str, BoolArray],
    responses: FloatArray,
) -> dict[str, FloatArray]:
    """Filtered derivatives of order 0 to 2; NaN in the rows where the source is blank."""
    signals = {}
    for name, (source, order) in derived.items():
        mean = bridged[source].mean()
        filtered = convolve(bridged[source] - mean, responses[order]) + (mean if order == 0 else 0.0)
        signals[name] = np.where(blank[source], np.nan, filtered)
    return signals


def _on_spheres(signals: Mapping[str, FloatArray], model: Model) -> dict[str, FloatArray]:
    """The signals, with whole quaternions of unit norm."""
    projected = dict(signals)
    for names in whole_quaternions(signals, model):
        q = np.column_stack([signals[name] for name in names])
        projected.update(zip(names, unit_quaternions(q).T, strict=True))
    return projected


def filter_rows(
    specification: FilterSpecification | None, dt: float, array: FloatArray, valid: BoolArray | None = None
) -> FloatArray:
    """Rows of a regression ``W p = b``, filtered as a log's specification demands.

    Parameters
    ----------
    specification : FilterSpecification or None
        `Log.filter`; with None the array is returned as it is.
    dt : float
        Time from row to row, seconds.
    array : (N, ...) array
        ``W`` or ``b``; both sides of the equation are filtered alike.
    valid : (N,) bool array, optional
        Rows that hold equations; the others have no weight and are NaN in the result.  None: the rows without NaN.

    Returns
    -------
    (N, ...) array
    """
    if specification is None:
        return array
    found = np.isfinite(array).all(axis=tuple(range(1, array.ndim))) if valid is None else valid
    held = np.reshape(found, (-1, *(1,) * (array.ndim - 1)))
    filtered = convolve(np.where(held, array, 0.0), kernels(specification.bandwidth, dt)[0])
    return np.where(held, filtered, np.nan)


def acting_inputs(specification: FilterSpecification | None, inputs: FloatArray) -> FloatArray:
    """Mean inputs that act around each row of a regression whose accelerations were derived by `differentiate`.

    An input is held until the next sample, so that half a sample lies between the recorded input and its mean effect.
    A recorded acceleration belongs to the input that begins in its row.

    Parameters
    ----------
    specification : FilterSpecification or None
        `Log.filter`; with None the inputs are returned as they are.
    inputs : (N, n_u) array
        Recorded inputs.

    Returns
    -------
    (N, n_u) array
    """
    if specification is None or len(inputs) < 2:
        return inputs
    padded = np.concatenate([inputs[:1], inputs[:1], inputs, inputs[-1:]])
    n = len(inputs)
    # Half a sample later, and the droop of a held input, to fourth order.
    weights = (-1.0 / 24.0, 13.0 / 24.0, 13.0 / 24.0, -1.0 / 24.0)
    return np.asarray(sum(weight * padded[i : i + n] for i, weight in enumerate(weights)))


# ---------------------------------------------------------------------- sources of derived signals


def _sources(log: Log, model: Model) -> dict[str, tuple[str, int]]:
    """Missing signal -> the measured signal that it is derived from, and the order of the derivative."""
    sources: dict[str, tuple[str, int]] = {}
    for chain in model.chains:
        # A state of first order is no derivative: a log that lacks it is refused where rows of equations are needed.
        given = chain[0] in model.first_order or chain[0] not in model.velocities
        for k, name in enumerate(chain):
            nearest = next((i for i in range(k - 1, -1, -1) if chain[i] in log), None)
            if name in log or (k == 0 and given):
                continue
            if nearest is not None:
                sources[name] = (chain[nearest], k - nearest)
            elif name in model.required_signals and chain[0] not in model.first_order:
                raise LogError(_underivable(log, model, name, chain[0] if k else None))
    return sources


def _underivable(log: Log, model: Model, name: str, source: str | None) -> str:
    found = ", ".join(("t", *log.names))
    if source is None:
        why = f'model "{model.name}" has velocities that are not derivatives of its coordinates'
        return f'{log.source}: signal "{name}" is missing and cannot be derived: {why}; found {found}. Give it.'
    give = f"Give either, as in --map {source}={other_spelling(source, log.names, model) or 'COLUMN'}."
    return f'{log.source}: signal "{name}" is missing, and so is "{source}", its source; found {found}. {give}'


def _filtered(log: Log, model: Model) -> list[str]:
    """Names of the log's signals that pass the filter.

    Coordinates without a unit that are no velocity's integral and no quaternion may have jumps, and pass none.
    """
    quaternions = {name for names in whole_quaternions(log.signals, model) for name in names}
    smooth = [n for n, unit in model.coordinates.items() if model.kinematics is None or unit != "1" or n in quaternions]
    return [n for n in (*smooth, *model.velocities, *model.accelerations, *model.inputs) if n in log]


def _motions(log: Log, model: Model) -> list[tuple[str, int]]:
    """The lowest measured derivative of every degree of freedom, and the order from it to the acceleration."""
    chains = [chain for chain in model.chains if chain[-1] in model.accelerations]
    measured = [[(n, len(chain) - 1 - k) for k, n in enumerate(chain) if n in log] for chain in chains]
    return [chain[0] for chain in measured if chain]


def _units(log: Log, model: Model, sources: Mapping[str, tuple[str, int]]) -> dict[str, str]:
    """Units of the signals that are derived from signals in the model's units."""
    known = {n for n, unit in log.units.items() if n in model.units and same_unit(unit, model.units[n])}
    return {name: model.units[name] for name, (source, _) in sources.items() if source in known}


# ---------------------------------------------------------------------- bandwidth


@dataclass(frozen=True)
class Bandwidth:
    """A bandwidth, Hz, and an upper bound of the noise's share in the acceleration's power below it."""

    value: float
    noise_share: float


def choose_bandwidth(motions: list[tuple[FloatArray, int]], dt: float) -> Bandwidth:
    """The lowest of the bandwidths in which a log's motions exceed their noise; rows of a regression mix all motions.

    Differentiation amplifies a position's noise with frequency, while limited forces move a body less the higher the
    frequency.  So the power spectrum ``A(f)`` of the acceleration falls, and rises again where noise prevails.  Its
    lowest value at or above a frequency bounds the noise there from above, whatever the noise's colour (an encoder's
    counts, a resolver, a filtered tachometer):

        N(f) = min over f' >= f of A(f').

    The bandwidth is the ``B`` that maximises the sum of ``A(f) - 10 N(f)`` over ``f <= B``: above it, the motion may be
    less than ten times as strong as the noise.  The least error of the acceleration itself would take two instead of
    ten, but noise in a regressor biases its parameter towards zero by the ratio of powers, and more so where regressors
    are correlated.

    Parameters
    ----------
    motions : list of (array (N,), int)
        Each a signal and the number of differentiations that make it an acceleration.
    dt : float
        Seconds.

    Returns
    -------
    Bandwidth
        Signals that nowhere exceed their noise are left out; the highest bandwidth, if all are.
    """
    found = [x for values, order in motions if (x := _of_one_motion(values, order, dt)) is not None]
    chosen = min(found, key=lambda x: x.value, default=Bandwidth(_HIGHEST / dt, 1.0))
    n = max((len(values) for values, _ in motions), default=0)
    lowest = min(10.0 / max(n * dt, dt), _HIGHEST / dt)
    return Bandwidth(float(np.clip(chosen.value, lowest, _HIGHEST / dt)), chosen.noise_share)


def _of_one_motion(values: FloatArray, order: int, dt: float) -> Bandwidth | None:
    if len(values) <= order:
        return None
    f, A = _acceleration_spectrum(values, order, dt)
    if not len(f) or not A.all():
        return None
    noise = np.minimum.accumulate(A[::-1])[::-1]
    gain = np.cumsum(A - 10.0 * noise)
    best = int(gain.argmax())
    if gain[best] <= 0.0:
        return None
    return Bandwidth(float(f[best]), float(noise[: best + 1].sum() / A[: best + 1].sum()))


def _acceleration_spectrum(values: FloatArray, order: int, dt: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies, Hz, and relative power density of the acceleration, to twice the highest bandwidth, lines smoothed.

    Welch's average over segments of the differences, which are nearly white, so that little leaks from low
    frequencies to high ones; then a geometric mean over a fifth of the frequency to either side.
    """
    differences = np.diff(values - values.mean(), order) / dt**order
    n = min(len(differences), max(32, 2 * len(differences) // 9))  # eight segments, half of each in the next
    segments = np.lib.stride_tricks.sliding_window_view(differences, n)[:: max(1, n // 2)]
    spectra = np.abs(np.fft.rfft(np.hanning(n + 1)[:n] * segments, axis=1)) ** 2
    f = np.fft.rfftfreq(n, dt).astype(np.float64)
    inside = (f > 0.0) & (f <= 2.0 * _HIGHEST / dt)
    f, power = f[inside], spectra.mean(axis=0)[inside]
    response = (np.pi * f * dt / np.sin(np.pi * f * dt)) ** (2 * order)
    return f, _smooth(f, power * response)


def _smooth(f: FloatArray, power: FloatArray) -> FloatArray:
    """The geometric mean of the power at ``f / 1.2`` to ``1.2 f``; 0 where there is none."""
    low, high = np.searchsorted(f, f / 1.2, side="left"), np.searchsorted(f, f * 1.2, side="right")
    with np.errstate(divide="ignore", invalid="ignore"):
        total = np.concatenate([[0.0], np.cumsum(np.log(power))])
        mean = np.exp((total[high] - total[low]) / (high - low))
    return np.where(np.isfinite(mean), mean, 0.0)


def _derivation_bandwidth(log: Log, bandwidth: float) -> float:
    """Bandwidth of the filter that derives signals, Hz.  Raises where the log is too short or too slow for it."""
    highest, duration = 1.0 / 3.0 / log.dt, len(log) * log.dt
    if not 0.0 < bandwidth <= highest * (1.0 + 1e-9):
        raise SettingsError(
            f"a bandwidth of {bandwidth:.4g} Hz has no meaning at {1.0 / log.dt:.6g} Hz; give up to {highest:.4g} Hz"
        )
    wide, n_periods = min(4.0 * bandwidth, highest), 2.0 * REACH
    if bandwidth * duration < n_periods or len(log) < 2 * half_length(wide, log.dt) + 2:
        raise LogError(
            f"{log.source}: {duration:.4g} s are too short to be filtered at {bandwidth:.4g} Hz, which takes "
            f"{n_periods / bandwidth:.4g} s; give a longer log or a higher bandwidth"
        )
    return wide


# ---------------------------------------------------------------------- gaps


def _bridge(values: FloatArray) -> FloatArray:
    """The samples with each gap filled by the cubic that fits as many samples and two more to either side of it."""
    missing = np.isnan(values)
    rows = np.arange(len(values))
    bridged = np.interp(rows, rows[~missing], values[~missing])
    for gap in runs(missing):
        begin, end = gap.start, gap.stop
        near = slice(max(0, 2 * begin - end - 2), 2 * end - begin + 2)
        x, known = 2.0 * (rows[near] - begin) / (end - begin) - 1.0, ~missing[near]
        if begin > 0 and end < len(values) and known.sum() > 4:
            cubic = np.polynomial.polynomial.polyfit(x[known], values[near][known], 3)
            bridged[begin:end] = np.polynomial.polynomial.polyval(x[(rows[near] >= begin) & (rows[near] < end)], cubic)
    return bridged


def _near_long_gaps(values: FloatArray, longest: float, reach: int) -> BoolArray:
    """Rows (N,) within the filter's reach of more than ``longest`` missing samples in a row."""
    near = np.zeros(len(values), dtype=bool)
    for gap in runs(np.isnan(values)):
        if gap.stop - gap.start > max(longest, 1.0):
            near[max(0, gap.start - reach) : gap.stop + reach] = True
    return near


# ---------------------------------------------------------------------- history and notes


def _step(
    specification: FilterSpecification, chosen: Bandwidth | None, filtered: list[str], n_cut: int
) -> dict[str, Any]:
    return {
        "step": "differentiate",
        "bandwidth": specification.bandwidth,
        "chosen": chosen is not None,
        "noise_share": None if chosen is None else chosen.noise_share,
        "derivation_bandwidth": specification.derivation_bandwidth,
        "row_filter": specification.bandwidth,
        "derived": dict(specification.derived),
        "filtered": filtered,
        "rows_cut": n_cut,
    }


def _notes(bandwidth: float, chosen: Bandwidth | None, sources: Mapping[str, tuple[str, int]], cut: float) -> list[str]:
    derived = f"derived {', '.join(sources)}; " if sources else "nothing to derive; "
    origin = "given" if chosen is None else "chosen from the log"
    notes = [f"{derived}filtered at {bandwidth:.3g} Hz ({origin}), {cut:.3g} s cut at either end"]
    if chosen is not None and chosen.noise_share > 0.05:
        share = min(1.0, chosen.noise_share)
        notes.append(
            f"noise may be {share:.0%} of the accelerations' power up to {bandwidth:.3g} Hz: expect biased masses"
        )
    return notes
