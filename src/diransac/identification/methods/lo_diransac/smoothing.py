"""The motion without a model.

The motion is local polynomials that a coordinate shares with its velocity and acceleration.  In a window about each
knot a polynomial of degree 4 is fitted to the measured ones of a coordinate and its derivatives.  Weights are Geman
and McClure's, the scale of each signal a low quantile of its residuals, so that more than half of the samples may be
outliers; residuals start from a running median, and scales decrease gradually, to avoid local optima (graduated
non-convexity).

References
----------
Hampel 1974; Geman, McClure 1987; Black, Rangarajan 1996; Yang, Antonante, Tzoumas, Carlone 2020 (graduated
non-convexity); Cleveland 1979 (robust local regression).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

import casadi as ca
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from diransac.arrays import BoolArray, FloatArray, IntArray, robust_std, row_blocks
from diransac.data.checks import rows_per_sample
from diransac.data.filters import median_filter
from diransac.identification.core.noise import lower_scale
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.model import Model

Scalar = TypeVar("Scalar", bound=np.generic)

_DEGREE = 4
"""Of the polynomials."""
_STEPS = 12
"""Reweightings."""
_SHRINK = 0.3
"""Least factor of a scale from one reweighting to the next."""
_FLOOR = 1e-4
"""Least scale of residuals over the spread of a signal: polynomials are not exact."""
_VISIBLE = 1e-2
"""Least error of a coordinate over its spread that narrow windows, whose derivatives are noisier, are worth."""
_AT_REST = 0.1
"""Part of the spread of all rows below which signals are at rest in a window."""
_TRIALS = 24
"""Windows in which half widths are compared, of the usual one."""
_MEDIAN = 0.31
"""Window of the running median from which smoothing starts, s."""
_MOST_MEDIAN = 31
"""Samples of that window at most."""
_WIDER = 3
"""Factor between half widths that are compared, and by which a window widens that has too few samples."""
_UNINFORMED = 1e-9
"""Weight of a polynomial that was fitted to fewer samples than it has coefficients."""
_FEWEST = 5
"""Samples of a window at least."""
_ENOUGH_SAMPLES = 25
"""Samples to either side of a knot that always suffice."""
_ENOUGH = 4000
"""Residuals that a scale is taken from; more would only cost time."""
_NUMBERS_TOGETHER = 100_000
"""Numbers of the windows that are fitted together at most; more would only take memory."""


@dataclass(frozen=True, eq=False, repr=False)
class Samples:
    """Samples of one log, in the model's order of signals.

    Parameters
    ----------
    measured : (N, n_signals) array
        Each signal in its unit; 0 where missing.
    known : (N, n_signals) bool array
        Samples that are measured.
    centre : (N, n_signals) array
        Running median.
    gaps : (N,) bool array
        Rows of gaps in inputs, or in all sensors.
    """

    measured: FloatArray
    known: BoolArray
    centre: FloatArray
    gaps: BoolArray

    @classmethod
    def of(cls, measured: FloatArray, known: BoolArray, gaps: BoolArray, dt: float) -> Samples:
        """Samples with running medians, between which missing samples are interpolated; 0 in signals without any."""
        rows, medians = np.arange(len(measured)), np.zeros(measured.shape)
        window = max(_FEWEST, min(_MOST_MEDIAN, 2 * round(0.5 * (_MEDIAN / dt - 1.0)) + 1))
        for i in np.flatnonzero(known.any(axis=0)):
            size = max(_FEWEST, 2 * (window // rows_per_sample(known[:, i]) // 2) + 1)
            values = median_filter(measured[known[:, i], i], min(size, window))
            medians[:, i] = np.interp(rows, rows[known[:, i]], values)
        return cls(measured, known, medians, gaps)


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


def _chains(model: Model) -> list[list[int]]:
    """Columns among the model's signals of each quantity and of its derivatives, without sensors."""
    return [[model.signals.index(name) for name in chain] for chain in model.chains]


def _alike(chains: Sequence[Sequence[int]], halves: IntArray, size: int) -> list[tuple[IntArray, int]]:
    """Columns ``(C, c)`` of chains of one length and half width, which are fitted together, and the half width.

    Fewer are fitted together, the larger each is.
    """
    together, found = max(1, _NUMBERS_TOGETHER // size), []
    for c, half in sorted({(len(x), int(halves[x[0]])) for x in chains}):
        columns = np.array([x for x in chains if (len(x), halves[x[0]]) == (c, half)])
        found += [(columns[k : k + together], half) for k in range(0, len(columns), together)]
    return found


def _n_motion(model: Model) -> int:
    """Number of signals before the sensors."""
    return len(model.signals) - len(model.sensors)


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
    signals = [_smoothed(model, log, dt, halves) for log in logs]
    middle = _joined(
        model, [np.where(log.known.any(axis=0), log.centre, x) for log, x in zip(logs, signals, strict=True)]
    )
    n = _n_motion(model)
    spread = np.concatenate([_spread(middle[:, :n]), *map(_spread_of_known, middle[:, n:].T)])
    spread = np.where(spread > 0.0, spread + 1e-9, 1.0)
    return [Motion(x, spread) for x in signals]


def _smoothed(model: Model, log: Samples, dt: float, halves: IntArray) -> FloatArray:
    """Smoothed signals ``(N, n_signals)`` of all rows of one log; those that it lacks follow from those that it has.

    Sensors are smoothed one by one; they are NaN in rows without a sample nearby.
    """
    measured, known, centre = log.measured, log.known, log.centre
    signals = np.zeros(measured.shape)
    chains = _chains(model)

    def smoothed(columns: IntArray, half: int, derivatives: int = 0) -> FloatArray:
        some = measured[:, columns], known[:, columns], centre[:, columns]
        return _with_wider_windows(*some, log.gaps, dt, half, derivatives)

    if model.kinematics is not None:
        rates = np.zeros((len(measured), model.n_q))
        for columns, half in _alike(chains[: model.n_q], halves, 4 * len(measured)):
            parts = smoothed(columns, half, derivatives=1)
            signals[:, columns], rates[:, columns[:, 0]] = parts[:, :, :1], parts[:, :, 1]
        _project(model, signals, rates, known)
        n_x = model.n_q + len(model.velocities_of_motion)
        lacking = model.n_q + np.flatnonzero(~known[:, model.n_q : n_x].any(axis=0))
        if len(lacking):
            inferred = _velocities_of_rates(model, signals, rates, measured, known, lacking)
            measured, known, centre = measured.copy(), known.copy(), centre.copy()
            measured[:, lacking], known[:, lacking], centre[:, lacking] = inferred, ~log.gaps[:, None], inferred
        chains = chains[model.n_q :]
    for columns, half in _alike(chains, halves, 4 * len(measured)):  # a row is in four windows
        signals[:, columns] = smoothed(columns, half)
    for chain in chains:
        _integrate(signals, known, chain, dt)
    for k in range(_n_motion(model), len(model.signals)):
        near = _near(known[:, k], halves[k])
        signals[:, [k]] = np.nan
        if near.any():
            signals[near, k] = smoothed(np.array([[k]]), halves[k])[near, 0, 0]
    rows, seen = np.arange(len(signals)), np.flatnonzero(~log.gaps)
    for x in signals.T if len(seen) else ():
        x[:] = np.interp(rows, seen, x[seen])
    return signals


def _with_wider_windows(
    values: FloatArray, known: BoolArray, centre: FloatArray, gaps: BoolArray, dt: float, half: int, derivatives: int
) -> FloatArray:
    """Smoothed chains, as `_Smoother.smoothed`; rows with too few samples about them are those of wider windows."""
    found, informed = _Smoother.of(dt, half).smoothed(values, known, centre, derivatives)
    lacking = ~(informed | gaps[:, None])
    some = np.flatnonzero(lacking.any(axis=0) & known.any(axis=(0, 2)))
    if len(some) and _WIDER * half < len(values):
        wider = _with_wider_windows(
            values[:, some], known[:, some], centre[:, some], gaps, dt, _WIDER * half, derivatives
        )
        found[:, some] = np.where(lacking[:, some, None], wider, found[:, some])
    return found


def _near(known: BoolArray, reach: int) -> BoolArray:
    """Mask ``(N,)`` of the rows with a known sample at most so many rows away."""
    counts, rows, n = np.concatenate([[0], np.cumsum(known)]), np.arange(len(known)), len(known)
    return np.asarray(counts[np.minimum(rows + reach + 1, n)] > counts[np.maximum(rows - reach, 0)])


def _project(model: Model, signals: FloatArray, rates: FloatArray, known: BoolArray) -> None:
    """Scale smoothed quaternions to unit norm, and their rates by the same factor, in place.

    The error of a polynomial in the four components is of the order of the fit's along the norm, and vanishes there.
    """
    for four in model.quaternions:
        columns = list(four)
        if known[:, columns].any(axis=0).all():
            norms = np.linalg.norm(signals[:, columns], axis=1, keepdims=True)
            factor = 1.0 / np.where(norms > _FLOOR, norms, 1.0)
            signals[:, columns] *= factor
            rates[:, columns] *= factor


def _velocities_of_rates(
    model: Model, signals: FloatArray, rates: FloatArray, measured: FloatArray, known: BoolArray, lacking: IntArray
) -> FloatArray:
    """Velocities ``(N, n)`` that a log lacks, from the rates of its coordinates by least squares of the kinematics."""
    n_q, n_v = model.n_q, model.n_v
    q, v = (ca.SX.sym(name, n) for name, n in (("q", n_q), ("v", n_v)))
    assert model.kinematics is not None
    rate = model.kinematics(q, v)
    evaluate = compile_map(ca.Function("rates", [q, v], [ca.densify(rate), ca.densify(ca.jacobian(rate, v))]))
    rows = np.arange(len(signals))
    v_known = np.zeros((len(signals), n_v))
    for d in range(n_v):
        ok = known[:, n_q + d]
        if ok.any():
            v_known[:, d] = np.interp(rows, rows[ok], measured[ok, n_q + d])
    at_known, slopes = evaluate(signals[:, :n_q], v_known)
    J = slopes.reshape(len(signals), n_v, n_q).swapaxes(1, 2)[:, :, lacking - n_q]
    seen = known[:, :n_q].any(axis=0)
    return np.asarray(np.einsum("nvq,nq->nv", np.linalg.pinv(J[:, seen], rcond=1e-6), (rates - at_known)[:, seen]))


def _integrate(signals: FloatArray, known: BoolArray, columns: Sequence[int], dt: float) -> None:
    """Fill signals below the first of a chain that the log has with its integral, in place: the constant is unknown."""
    has = [bool(known[:, c].any()) for c in columns]
    if not any(has):
        return
    for j in range(has.index(True), 0, -1):
        rate = signals[:, columns[j]]
        integral = np.concatenate([[0.0], np.cumsum(0.5 * dt * (rate[1:] + rate[:-1]))])
        signals[:, columns[j - 1]] = integral - integral.mean()


@dataclass(frozen=True, eq=False, repr=False)
class _Smoother:
    """Overlapping windows, whose polynomials are blended; their knots are ``step`` rows apart.

    Parameters
    ----------
    step : int
    basis : (4, 2 half + 1, 5) array
        Polynomials and their derivatives.
    blend : (2 half + 1,) array
        Weight of a polynomial by its distance from the knot.
    """

    step: int
    basis: FloatArray
    blend: FloatArray

    @classmethod
    def of(cls, dt: float, half: int) -> _Smoother:
        step, offsets = max(1, half // 2), np.arange(-half, half + 1)
        return cls(step, _basis(offsets / half, half * dt), np.maximum(0.0, 1.0 - np.abs(offsets) / (step + 1.0)))

    def smoothed(
        self, values: FloatArray, known: BoolArray, centre: FloatArray, derivatives: int
    ) -> tuple[FloatArray, BoolArray]:
        """Signals ``(N, C, c + derivatives)`` of C chains of c signals, and further derivatives of their last.

        A mask ``(N, C)`` is that of the rows in a window with more samples than its polynomial has coefficients.
        """
        (N, C, c), n, n_t = values.shape, values.shape[2] + derivatives, len(self.blend)
        some, oks, about = self._windows(values), self._windows(known), self._windows(centre)
        coefficients = _coefficients(some, oks, about, self.basis[:c], _spread(centre))
        log, of_rows = slice(n_t // 2, n_t // 2 + N), np.zeros((C, 1 + n, (oks.shape[1] + 1) * self.step + n_t))
        for i, (own, ok) in enumerate(zip(coefficients, oks, strict=True)):
            for knots in row_blocks(len(ok), max(1, 8 * _NUMBERS_TOGETHER // ok[0].size)):
                fitted = np.einsum("ka,jta->ktj", own[knots], self.basis[:n])
                enough = ok[knots].any(axis=2).sum(axis=1) > _DEGREE + 1
                weight = self.blend * np.where(enough, 1.0, _UNINFORMED)[:, None]
                self._add(of_rows[i, 0, knots.start * self.step :], weight)
                for j in range(n):
                    self._add(of_rows[i, 1 + j, knots.start * self.step :], fitted[:, :, j] * weight)
        of_rows = of_rows[:, :, log]
        of_rows[:, 1:] /= of_rows[:, :1]
        return np.moveaxis(of_rows[:, 1:], 2, 0), (of_rows[:, 0] > _UNINFORMED * n_t).T

    def _windows(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """Views ``(C, K, n_t, c)`` of chains ``(N, C, c)`` about every knot; no sample is known beyond the log."""
        wide = (0, 0), (len(self.blend) // 2,) * 2, (0, 0)
        rows = np.pad(np.moveaxis(values, 1, 0), wide, mode="constant" if values.dtype == bool else "edge")
        return np.moveaxis(sliding_window_view(rows, len(self.blend), axis=1)[:, :: self.step], 3, 2)

    def _add(self, rows: FloatArray, windows: FloatArray) -> None:
        """Add windows ``(K, n_t)`` of successive knots to rows from the first of the first one on, knot by knot."""
        for t in reversed(range(0, windows.shape[1], self.step)):
            some = windows[:, t : t + self.step]
            rows[t : t + len(some) * self.step].reshape(len(some), -1)[:, : some.shape[1]] += some


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
    chains, n_motion = _chains(model), _n_motion(model)
    longest, apart = max(len(log.measured) for log in logs), np.ones(len(model.signals), int)
    for columns in (*chains, *([k] for k in range(n_motion, len(model.signals)))):
        apart[columns] = max(rows_per_sample(np.asarray(log.known[:, columns].any(axis=1))) for log in logs)
    together = max(rows_per_sample(np.asarray(log.known[:, :n_motion].any(axis=1))) for log in logs)
    usual, length = (
        np.maximum(_FEWEST * x, np.minimum(round(narrowest / dt), _ENOUGH_SAMPLES * x)) for x in (apart, together)
    )
    factors = [k for k in range(20) if k == 0 or 8 * length * _WIDER**k < longest]
    candidates = [np.maximum(usual // _WIDER, _FEWEST * apart), *(usual * _WIDER**k for k in factors)]
    spread = _spread(_joined(model, [log.centre for log in logs]))
    tried = [_prediction_errors(model, logs, dt, halves, usual, apart, spread) for halves in candidates]
    best = 1 + int(np.argmin([np.log(errors).sum() for errors, _ in tried[1:]]))
    # Narrower windows have noisier derivatives: they are taken where the others miss a visible part of the motion.
    visible = [float(np.log(np.maximum(first, _VISIBLE)).sum()) for _, first in tried]
    best = 0 if visible[0] < visible[best] else best
    return candidates[best], int(length) * _WIDER ** max(best - 1, 0)


def _prediction_errors(
    model: Model,
    logs: Sequence[Samples],
    dt: float,
    halves: IntArray,
    usual: IntArray,
    apart: IntArray,
    sizes: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Robust scale of the left-out samples over a signal's spread: of each signal, and of the first of each chain."""
    measured, known, centre = (
        np.concatenate([getattr(log, name) for log in logs]) if len(logs) > 1 else getattr(logs[0], name)
        for name in ("measured", "known", "centre")
    )
    found, first_of_chains = list[FloatArray](), list[float]()
    for columns, half in _alike(_chains(model), halves, _TRIALS * (2 * int(usual.max()) + 1)):
        k = columns[0, 0]
        stride = max(1, half // usual[k]) if apart[k] == 1 else 1
        offsets = np.arange(-half, half + 1, stride)
        rows = _trial_rows([len(log.measured) for log in logs], _TRIALS * max(1, usual[k] // half), half, offsets)
        near = np.abs(offsets) <= half // 2
        basis = _basis(offsets / half, half * dt)
        values, oks, about = (np.moveaxis(x[:, columns][rows], 2, 0) for x in (measured, known, centre))
        spread, even, orders = sizes[columns], _every_other(oks), basis[: columns.shape[1]]
        coefficients = _coefficients(values, oks & even, about, orders, spread)
        fitted = np.einsum("Cka,jta->Cktj", coefficients, orders)
        tested, n = oks & near[:, None] & ~even, oks.shape[1] * oks.shape[2]
        scale = _scale(_sampled([values - fitted], n), _sampled([tested], n))
        seen: BoolArray = np.asarray(oks.any(axis=(1, 2)))
        errors = np.maximum(scale, _FLOOR * spread + 1e-12) / (spread + 1e-12)
        found.append(errors[seen])
        first_of_chains += [float(own[ok][0]) for own, ok in zip(errors, seen, strict=True) if ok.any()]
    return np.concatenate(found), np.array(first_of_chains)


def _every_other(known: BoolArray) -> BoolArray:
    """Every other row ``(C, K, n_t, c)``, and of the samples of slow signals every other one."""
    rows = np.arange(known.shape[2])[:, None] % 2 == 0
    slow = known.mean(axis=(1, 2), keepdims=True) < 0.5
    return np.asarray(np.where(slow, np.cumsum(known, axis=2) % 2 == 1, rows) if slow.any() else rows)


def _joined(model: Model, logs: Sequence[FloatArray]) -> FloatArray:
    """Signals of all logs, of which spreads are taken: coordinates of several logs about the median of their log."""
    if len(logs) == 1:
        return logs[0]
    centred = np.arange(len(model.signals)) < model.n_q
    return np.concatenate([x - np.where(centred, np.median(x, axis=0), 0.0) for x in logs])


def _trial_rows(sizes: Sequence[int], trials: int, half: int, offsets: IntArray) -> IntArray:
    """Rows (K, n_offsets) about so many knots, spread over logs of so many rows in proportion to their length."""
    rows, begin = [], 0
    for N in sizes:
        n_trials = max(1, round(trials * N / sum(sizes)))
        knots = np.linspace(min(half, N // 2), max(N - 1 - half, N // 2), n_trials).astype(int)
        rows.append(begin + np.clip(knots[:, None] + offsets, 0, N - 1))
        begin += N
    return np.concatenate(rows)


def _spread(values: FloatArray) -> FloatArray:
    """Standard deviation of each column by the MAD; by the central 80 % where half the samples have one value."""

    def of_one(own: FloatArray) -> float:
        low, median, high = np.quantile(own, [0.1, 0.5, 0.9])
        mad, wide = float(robust_std(own - median)), float(high - low) / 2.563
        return mad if mad > _AT_REST * wide else wide

    return np.apply_along_axis(of_one, 0, values)


def _spread_of_known(values: FloatArray) -> FloatArray:
    """Spread ``(1,)`` of the finite values of a signal; 0 without any."""
    known = values[np.isfinite(values)]
    return _spread(known[:, None]) if len(known) else np.zeros(1)


def _basis(t: FloatArray, unit: float) -> FloatArray:
    """Powers of scaled time and their first three derivatives, (4, n_t, 5)."""
    powers, factor, orders = np.arange(_DEGREE + 1), np.ones(_DEGREE + 1), []
    for order in range(4):
        orders.append(factor * t[:, None] ** np.maximum(powers - order, 0) / unit**order)
        factor = factor * (powers - order)
    return np.stack(orders)


def _coefficients(
    values: FloatArray, known: BoolArray, centre: FloatArray, basis: FloatArray, spread: FloatArray
) -> FloatArray:
    """Coefficients ``(C, K, 5)`` of the polynomials of C chains of c signals, ``(C, K, n_t, c)``."""
    C, K, n_t, c = values.shape
    floor = _FLOOR * spread + 1e-12
    products = np.einsum("jta,jtb->tjab", basis, basis).reshape(n_t * c, -1)
    flat = basis.swapaxes(0, 1).reshape(n_t * c, -1)
    found = np.empty((C, K, _DEGREE + 1))
    blocks = list(row_blocks(K, max(1, 8 * _NUMBERS_TOGETHER // (C * n_t * c))))  # of three signals, some 60,000 rows
    seen = _sampled((known[:, k] for k in blocks), K * n_t)

    @lru_cache(maxsize=1)
    def left(i: int, step: int) -> FloatArray:
        """Residuals ``(C, K, n_t, c)`` of a block before a step: of the last one's polynomials, or of the centre."""
        of = blocks[i]
        fitted = (found[:, of].reshape(-1, _DEGREE + 1) @ flat.T).reshape(C, -1, n_t, c) if step else centre[:, of]
        return np.asarray(values[:, of] - fitted)

    scale = np.zeros((C, c))
    for step in range(_STEPS):
        own = _scale(_sampled((left(i, step) for i in range(len(blocks))), K * n_t), seen)
        scale = np.maximum(np.maximum(own, floor), _SHRINK * scale)
        for i, k in enumerate(blocks):
            weights = left(i, step).reshape(C, -1, n_t * c)
            weights *= np.tile(1.0 / (3.0 * scale), n_t)[:, None]
            weights *= weights
            weights += 1.0
            weights *= weights
            weights *= np.tile(np.square(scale), n_t)[:, None]
            np.divide(known[:, k].reshape(weights.shape), weights, out=weights)
            G = (weights.reshape(-1, n_t * c) @ products).reshape(-1, _DEGREE + 1, _DEGREE + 1)
            weights *= values[:, k].reshape(weights.shape)
            h = weights.reshape(-1, n_t * c) @ flat
            d = np.sqrt(np.einsum("kii->ki", G)) + 1e-12
            G = G / d[:, :, None] / d[:, None, :] + 1e-9 * np.eye(_DEGREE + 1)
            found[:, k] = (np.linalg.solve(G, (h / d)[:, :, None])[:, :, 0] / d).reshape(C, -1, _DEGREE + 1)
    return found


def _sampled(blocks: Iterable[NDArray[Scalar]], n: int) -> NDArray[Scalar]:
    """Every so many of the n rows of all windows, ``(C, m, c)``; blocks are ``(C, K, n_t, c)``, one after the other."""
    every, at, found = max(1, n // _ENOUGH) | 1, 0, []
    for one in blocks:
        rows = one.reshape(len(one), -1, one.shape[3])
        found.append(rows[:, -at % every :: every])
        at += rows.shape[1]
    return np.concatenate(found, axis=1)


def _scale(residuals: FloatArray, known: BoolArray) -> FloatArray:
    """Robust standard deviation ``(C, c)`` of each chain's signals; one where nothing is measured."""
    return np.nan_to_num(lower_scale(residuals, known), nan=1.0, posinf=np.inf)
