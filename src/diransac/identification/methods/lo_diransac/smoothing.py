"""The motion without a model: local polynomials that a coordinate shares with its velocity and acceleration.

In a window about each knot a polynomial of degree 4 is fitted to the measured ones of a coordinate and its derivatives.
Weights are Geman and McClure's, the scale of each signal a low quantile of its residuals, so that more than half of the
samples may be outliers; residuals start from a running median, and scales decrease gradually, to avoid local optima
(graduated non-convexity).  Between two knots their polynomials are blended.

Arrays are ``(C, c, K, n_t)``: C chains, each of c signals of which one is the derivative of the one before, K windows
of ``n_t`` rows.

References
----------
Geman, McClure 1987; Black, Rangarajan 1996; Yang, Antonante, Tzoumas, Carlone 2020 (graduated non-convexity);
Cleveland 1979 (robust local regression).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, interpolated, robust_std, size_or_one
from diransac.data.checks import rows_per_sample
from diransac.data.filters import median_filter
from diransac.identification.core.noise import lower_scale
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.model import Model

# Of the polynomials.
_DEGREE = 4
# Samples of a signal to either side of a knot, usually at most.
_MOST = 25
# Factor between half widths that are compared, and by which a window widens that has too few samples.
_WIDER = 3
# Reweightings.
_PASSES = 12
# Least factor of a scale from one reweighting to the next.
_SHRINK = 0.3
# Least scale of residuals over the spread of a signal: polynomials are not exact.
_FLOOR = 1e-4
# Least error of a coordinate over its spread that narrow windows, whose derivatives are noisier, are worth.
_VISIBLE = 0.01
# Windows in which half widths are compared, of the usual one.
_TRIALS = 24
# Residuals that a scale is taken from; more would only cost time.
_ENOUGH = 4000


@dataclass(frozen=True, eq=False, repr=False)
class Samples:
    """Samples of one log, in the model's order of signals.

    Parameters
    ----------
    measured : (N, n_signals) array
        Each signal in its unit; 0 where missing.
    known : (N, n_signals) bool array
        Samples that are measured.
    gaps : (N,) bool array
        Rows of gaps in inputs, or in all sensors.
    centre : (N, n_signals) array
        Running median; missing samples are interpolated between medians, and 0 in signals without any.
    """

    measured: FloatArray
    known: BoolArray
    gaps: BoolArray
    centre: FloatArray

    @classmethod
    def of(cls, measured: FloatArray, known: BoolArray, gaps: BoolArray, half_width: float) -> Samples:
        """Samples with medians over 1.2 half widths, rows; of at least 5 and at most 31 samples of a signal."""
        rows, centre = np.arange(len(measured)), np.zeros(measured.shape)
        for median, values, mask in zip(centre.T, measured.T, known.T, strict=True):
            if mask.any():
                half = min(half_width / rows_per_sample(mask), _MOST)
                size = max(_DEGREE + 1, 2 * round(0.6 * half) + 1)
                median[:] = np.interp(rows, rows[mask], median_filter(values[mask], size))
        return cls(measured, known, gaps, centre)


@dataclass(frozen=True, eq=False, repr=False)
class Motion:
    """Smoothed motion.

    Parameters
    ----------
    signals : (N, n_signals) array
        Each in its unit; sensors are NaN where they are not measured.
    spread : (n_signals,) array
        Robust standard deviation of each signal over all logs.
    """

    signals: FloatArray
    spread: FloatArray

    def parts(self, model: Model, rows: BoolArray | IntArray | slice) -> list[FloatArray]:
        """Coordinates, velocities, accelerations and sensors in some rows."""
        return split_signals(model, self.signals[rows])


def split_signals(model: Model, signals: FloatArray) -> list[FloatArray]:
    """Coordinates, velocities, accelerations and sensors ``(N, n)`` of all signals ``(N, n_signals)``."""
    n_q, n_v = model.n_q, model.n_v
    return np.split(signals, [n_q, n_q + n_v, n_q + 2 * n_v], axis=1)


# ---------------------------------------------------------------------- the motion


def smooth(model: Model, logs: Sequence[Samples], dt: float, halves: IntArray) -> list[Motion]:
    """Smoothed motion of every log.

    Parameters
    ----------
    model : Model
    logs : sequence of Samples
    dt : float
        Sampling time, s.
    halves : (n_signals,) int array
        Rows that a polynomial of each signal covers to either side of its knot; those of a chain are equal.

    Returns
    -------
    list of Motion
        The spread of each signal is that over all logs; its unit for one that is at rest.
    """
    signals = [_smoothed_log(model, log, dt, halves) for log in logs]
    middle = [np.where(log.known.any(axis=0), log.centre, x) for log, x in zip(logs, signals, strict=True)]
    spread = size_or_one(_spread(model, middle))
    return [Motion(x, spread) for x in signals]


def _smoothed_log(model: Model, log: Samples, dt: float, halves: IntArray) -> FloatArray:
    """Smoothed signals ``(N, n_signals)`` of all rows of one log; those that it lacks follow from those that it has.

    Sensors are smoothed one by one; they are NaN in rows without a sample nearby.
    """
    measured, known, centre = log.measured.T.copy(), log.known.T.copy(), log.centre.T.copy()
    signals, spread, (_, N) = np.zeros(measured.shape), _spread(model, [log.centre]), measured.shape
    chains = _chains(model)

    def smoothed(columns: IntArray, derivatives: int = 0) -> FloatArray:
        samples, half = (measured[columns], known[columns], centre[columns]), int(halves[columns[0, 0]])
        return _smoothed(*samples, log.gaps, spread[columns], dt, half, derivatives)

    if model.kinematics is not None:
        rates = np.zeros((model.n_q, N))
        for columns in _alike(chains[: model.n_q], halves, N):
            parts = smoothed(columns, derivatives=1)
            signals[columns], rates[columns[:, 0]] = parts[:, :1], parts[:, 1]
        _project(model, signals, rates, known)
        lacking = model.n_q + np.flatnonzero(~known[model.n_q :][: len(model.velocities_of_motion)].any(axis=1))
        if len(lacking):
            velocities = _velocities_of_rates(model, signals, rates, np.where(known, measured, np.nan), lacking)
            measured[lacking], known[lacking], centre[lacking] = velocities, ~log.gaps, velocities
            spread[lacking] = [_spread_of(x) for x in velocities]
        chains = chains[model.n_q :]
    for columns in _alike(chains, halves, N):
        signals[columns] = smoothed(columns)
    for chain in chains:
        _integrate(signals, known, chain, dt)
    for k in range(len(signals) - len(model.sensors), len(signals)):
        counts = np.cumsum(np.pad(known[k], (halves[k] + 1, halves[k])))
        signals[k, counts[2 * halves[k] + 1 :] == counts[:N]] = np.nan
    rows, seen = np.arange(N), np.flatnonzero(~log.gaps)
    for x in signals if len(seen) else ():
        x[:] = np.interp(rows, seen, x[seen])
    return signals.T.copy()


def _project(model: Model, signals: FloatArray, rates: FloatArray, known: BoolArray) -> None:
    """Scale smoothed quaternions to unit norm, and their rates by the same factor, in place.

    The error of a polynomial in the four components is of the order of the fit's along the norm, and vanishes there.
    """
    for four in map(list, model.quaternions):
        if known[four].any(axis=1).all():
            norms = size_or_one(np.linalg.norm(signals[four], axis=0))
            signals[four] /= norms
            rates[four] /= norms


def _velocities_of_rates(
    model: Model, signals: FloatArray, rates: FloatArray, measured: FloatArray, lacking: IntArray
) -> FloatArray:
    """Velocities ``(n, N)`` that a log lacks, from the rates of its coordinates by least squares of the kinematics."""
    n_q, n_v = model.n_q, model.n_v
    q, v = (ca.SX.sym(name, n) for name, n in (("q", n_q), ("v", n_v)))
    assert model.kinematics is not None
    rate = model.kinematics(q, v)
    evaluate = compile_map(ca.Function("rates", [q, v], [ca.densify(rate), ca.densify(ca.jacobian(rate, v))]))
    at_known, slopes = evaluate(signals[:n_q].T, interpolated(measured[n_q : n_q + n_v].T))
    seen = np.isfinite(measured[:n_q]).any(axis=1)
    J = slopes.reshape(-1, n_v, n_q).swapaxes(1, 2)[:, seen][:, :, lacking - n_q]
    return np.asarray(np.einsum("nvq,nq->vn", np.linalg.pinv(J, rcond=1e-6), (rates.T - at_known)[:, seen]))


def _integrate(signals: FloatArray, known: BoolArray, chain: Sequence[int], dt: float) -> None:
    """Fill signals below the first of a chain that the log has with its integral, in place: the constant is unknown."""
    first = next((j for j, k in enumerate(chain) if known[k].any()), 0)
    for j in range(first, 0, -1):
        rate = signals[chain[j]]
        integral = np.concatenate([[0.0], np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))])
        signals[chain[j - 1]] = integral - integral.mean()


# ---------------------------------------------------------------------- polynomials


def _chains(model: Model) -> list[list[int]]:
    """Places among the model's signals of each quantity and of its derivatives, and of each sensor alone."""
    return [[model.signals.index(name) for name in chain] for chain in (*model.chains, *([x] for x in model.sensors))]


def _alike(chains: Sequence[Sequence[int]], halves: IntArray, n_rows: int = 0) -> Iterator[IntArray]:
    """Signals ``(C, c)`` of chains of one length and half width, which are fitted together if a log is not long."""
    for kind in sorted({(len(x), halves[x[0]]) for x in chains}):
        columns = np.array([x for x in chains if (len(x), halves[x[0]]) == kind])
        yield from np.split(columns, range(1, len(columns))) if n_rows > _LONG else [columns]


# Rows of a log from which on chains are smoothed one by one, which saves memory.
_LONG = 10_000


def _smoothed(
    values: FloatArray, known: BoolArray, centre: FloatArray, gaps: BoolArray, spread: FloatArray, dt: float,
    half: int, derivatives: int,
) -> FloatArray:  # fmt: skip
    """Chains ``(C, c + derivatives, N)``: measured ones ``(C, c, N)``, smoothed, and derivatives of their last.

    Rows with no more samples about them than a polynomial has coefficients are those of wider windows.
    """
    (_, c, N), step, basis = values.shape, half // 2, _basis(half, 1, dt)
    knots = np.arange(0, N + step, step)
    middle = np.clip(knots, half, max(N - 1 - half, half))  # of windows, which lie within the log
    rows = middle[:, None] + np.arange(-half, half + 1)
    samples, rows = known[:, :, np.minimum(rows, N - 1)] & (rows < N), np.minimum(rows, N - 1)
    coefficients = _coefficients(values[:, :, rows], samples, centre[:, :, rows], basis[:c], spread)
    informed = samples.any(axis=1).sum(axis=2) > _DEGREE + 1
    signals, total, rows = np.zeros((len(values), c + derivatives, N)), np.zeros((len(values), 1, N)), np.arange(N)
    for k in (rows // step, rows // step + 1):
        of_rows = basis[: c + derivatives, half + rows - middle[k]]
        weight = (1.0 - np.abs(rows - knots[k]) / step) * np.where(informed[:, k], 1.0, np.finfo(float).eps)
        signals += weight[:, None] * np.einsum("Cna,jna->Cjn", coefficients[:, k], of_rows)
        total += weight[:, None]
    signals /= total
    lacking = (total < 0.5 / step) & ~gaps
    some = np.flatnonzero(lacking.any(axis=(1, 2)) & known.any(axis=(1, 2)))
    if len(some) and _WIDER * half < N:
        less = values[some], known[some], centre[some], gaps, spread[some]
        signals[some] = np.where(lacking[some], _smoothed(*less, dt, _WIDER * half, derivatives), signals[some])
    return signals


def _basis(half: int, stride: int, dt: float) -> FloatArray:
    """Powers of scaled time and their first three derivatives ``(4, n_t, 5)`` in every so many rows of a window."""
    t, powers, factor, orders = (
        np.arange(-half, half + 1, stride) / half,
        np.arange(_DEGREE + 1),
        np.ones(_DEGREE + 1),
        [],
    )
    for order in range(4):
        orders.append(factor * t[:, None] ** np.maximum(powers - order, 0) / (half * dt) ** order)
        factor = factor * (powers - order)
    return np.stack(orders)


def _coefficients(
    values: FloatArray, known: BoolArray, centre: FloatArray, basis: FloatArray, spread: FloatArray
) -> FloatArray:
    """Coefficients ``(C, K, 5)`` of the polynomials of chains ``(C, c, K, n_t)`` by reweighted least squares."""
    products = (basis[:, :, :, None] * basis[:, :, None, :]).reshape(*basis.shape[:2], -1)
    residuals, scale, floor = values - centre, np.zeros(spread.shape), _FLOOR * size_or_one(spread)
    for _ in range(_PASSES):
        scale = np.fmax(np.fmax(_scale(residuals, known), floor), _SHRINK * scale)
        s = scale[:, :, None, None]
        weights = known / np.square(s * (1.0 + np.square(residuals / (3.0 * s))))
        G = (weights @ products).sum(axis=1).reshape(len(values), -1, _DEGREE + 1, _DEGREE + 1)
        h = ((weights * values) @ basis).sum(axis=1)
        d = np.sqrt(np.einsum("ckii->cki", G)) + 1e-12
        G = G / d[..., None] / d[..., None, :] + 1e-9 * np.eye(_DEGREE + 1)
        coefficients = np.linalg.solve(G, (h / d)[..., None])[..., 0] / d
        residuals = values - coefficients[:, None] @ basis.swapaxes(1, 2)
    return np.asarray(coefficients)


def _scale(residuals: FloatArray, known: BoolArray) -> FloatArray:
    """Robust standard deviation ``(C, c)`` of residuals ``(C, c, K, n_t)``; NaN where nothing is measured."""
    every = max(1, residuals[0, 0].size // _ENOUGH)
    flat = (*residuals.shape[:2], -1)
    some, mask = residuals[:, :, ::every].reshape(flat), known[:, :, ::every].reshape(flat)
    return np.asarray(lower_scale(some.swapaxes(1, 2), mask.swapaxes(1, 2)))


# ---------------------------------------------------------------------- half widths


def choose_half_widths(model: Model, logs: Sequence[Samples], dt: float, narrowest: float) -> tuple[IntArray, int]:
    """Half widths of the polynomials that best predict samples that they were not fitted to (cross-validation).

    The smallest of each signal are so many of its own samples.  One factor times these is that of all signals: every
    other sample is left out and predicted; the error is a low quantile, so that outliers have no influence.

    Parameters
    ----------
    model : Model
    logs : sequence of Samples
    dt : float
        Sampling time, s.
    narrowest : float
        Usual half width, s, at most 25 samples.  Candidates are a third of it, itself, three, nine, ... times it.

    Returns
    -------
    halves : (n_signals,) int array
        Rows; those of a chain are equal.
    length : int
        Rows in which signals move as little as in the half width of the fastest one; of the usual one at least.
    """
    motion = [k for chain in model.chains for k in map(model.signals.index, chain)]
    apart = np.ones(len(model.signals), int)
    for chain in _chains(model):
        apart[chain] = _rows_apart(logs, chain)
    usual, length = (
        np.maximum((_DEGREE + 1) * x, np.minimum(round(narrowest / dt), _MOST * x))
        for x in (apart, _rows_apart(logs, motion))
    )
    longest = max(len(log.measured) for log in logs)
    factors = [k for k in range(20) if k == 0 or 8 * length * _WIDER**k < longest]
    candidates = [np.maximum(usual // _WIDER, (_DEGREE + 1) * apart), *(usual * _WIDER**k for k in factors)]
    errors = [_prediction_errors(model, logs, dt, halves, usual, apart) for halves in candidates]
    best = 1 + int(np.argmin([np.nansum(np.log(x)) for x in errors[1:]]))
    # Narrower windows have noisier derivatives: they are taken where the others miss a visible part of the motion.
    first = [next((k for k in chain if np.isfinite(errors[0][k])), chain[0]) for chain in _chains(model)]
    narrow, wide = (np.nansum(np.log(np.maximum(errors[k][first], _VISIBLE))) for k in (0, best))
    best = 0 if narrow < wide else best
    return candidates[best], int(length) * _WIDER ** max(best - 1, 0)


def _rows_apart(logs: Sequence[Samples], columns: Sequence[int]) -> int:
    """Rows from one sample of any of some signals to the next, in the log where they are slowest."""
    return max(rows_per_sample(np.asarray(log.known[:, columns].any(axis=1))) for log in logs)


def _prediction_errors(
    model: Model, logs: Sequence[Samples], dt: float, halves: IntArray, usual: IntArray, apart: IntArray
) -> FloatArray:
    """Robust scale of left-out samples over the spread of each signal; NaN of a signal without samples, and sensors."""
    measured, known, centre = (
        np.concatenate([getattr(log, name) for log in logs]).T for name in ("measured", "known", "centre")
    )
    spread, errors = size_or_one(_spread(model, [log.centre for log in logs])), np.full(len(measured), np.nan)
    ends = np.cumsum([len(log.measured) for log in logs])
    for columns in _alike(_chains(model)[: len(model.chains)], halves):
        k, half = columns[0, 0], int(halves[columns[0, 0]])
        stride = max(1, half // usual[k]) if apart[k] == 1 else 1
        offsets, basis = np.arange(-half, half + 1, stride), _basis(half, stride, dt)[: columns.shape[1]]
        knots = np.linspace(0, ends[-1] - 1, _TRIALS * max(1, usual[k] // half)).astype(int)
        begin, end = (np.concatenate([[0], ends])[np.searchsorted(ends, knots, "right") + x] for x in (0, 1))
        middle = np.clip(knots, begin + half, np.maximum(end - 1 - half, begin + half))
        rows = np.clip(middle[:, None] + offsets, begin[:, None], end[:, None] - 1)
        values, oks, about = (x[columns][:, :, rows] for x in (measured, known, centre))
        every_other = np.cumsum(oks, axis=3) % 2 == 1
        coefficients = _coefficients(values, oks & every_other, about, basis, spread[columns])
        fitted = coefficients[:, None] @ basis.swapaxes(1, 2)
        scale = _scale(values - fitted, oks & ~every_other & (np.abs(offsets) <= half // 2))
        errors[columns] = np.where(oks.any(axis=(2, 3)), np.fmax(scale / spread[columns], _FLOOR), np.nan)
    return errors


def _spread(model: Model, logs: Sequence[FloatArray]) -> FloatArray:
    """Robust standard deviation ``(n_signals,)`` over logs, of coordinates about the median of each log."""
    if len(logs) > 1:
        centred = np.arange(len(model.signals)) < model.n_q
        logs = [x - np.where(centred, np.median(x, axis=0), 0.0) for x in logs]
    return np.array([_spread_of(x) for x in np.concatenate(logs).T])


def _spread_of(values: FloatArray) -> float:
    """Standard deviation of finite values by the MAD; by the central 80 % where half are one value."""
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0
    low, median, high = np.quantile(values, [0.1, 0.5, 0.9])
    mad, wide = float(robust_std(values - median)), float(high - low) / 2.563
    return mad if mad > 0.1 * wide else wide
