"""Coordinates that are continuous in time: angles without their wraps, quaternions without changes of sign.

An angle modulo one turn, and a quaternion up to its sign, are points of a circle and of a projective sphere.  Both are
compared with the medoid of a few neighbours there: the sample whose distances from all others in the window sum to the
least.  It is a sample that was measured, whatever the outliers beside it, and the sequence of medoids is continued from
one to the next.  An outlier therefore neither adds a turn nor changes a sign for the samples after it.

References
----------
Kaufman and Rousseeuw 1990, "Finding Groups in Data" (medoid).  Huynh 2009, "Metrics for 3D Rotations" (distances up to
sign).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray, robust_std, size_or_one
from diransac.data.checks import ROUNDING
from diransac.data.filters import median_filter, mirrored_windows
from diransac.data.units import one_turn
from diransac.errors import SettingsError

if TYPE_CHECKING:
    from collections.abc import Callable, Container, Sequence

    from diransac.data.log import Log
    from diransac.model import Model

_WINDOW, _PERSISTS = 25, 5
"""Samples of the running medians."""
_CLOSE, _FAR = 0.05, 0.25
"""Departures from the medoid, in turns, that are always or never those of a good sample."""
_MARGIN, _MUCH_MOTION = 0.02, 3.0
"""Turns by which good samples leave the turn to which an angle is wrapped; usual steps that count as motion."""
_USUAL_MIDDLES = (0.0, 0.5)
_OWN_NORM = 0.1
"""Relative deviation of a quaternion's norm that is its own."""
_NOTHING: Mapping[str, Any] = MappingProxyType({})


def continuous(log: Log, model: Model) -> Log:
    """Log with the coordinates of a model as continuous functions of time.

    Parameters
    ----------
    log : Log
    model : Model
        Coordinates in rad or deg are angles; `Model.quaternions` are unit quaternions.

    Returns
    -------
    Log
        The same log if nothing is to be changed.  Otherwise angles are unwrapped, as in `unwrap`, and quaternions that
        are in the log as a whole have a continuous sign and unit norm.
    """
    angles = {name: turn for name, unit in model.coordinates.items() if name in log and (turn := one_turn(unit))}
    log = _without_wraps(log, angles)
    for names in whole_quaternions(log.signals, model):
        log = _with_one_sign(log, names)
    return log


# ---------------------------------------------------------------------- interpolation


def interpolated(signals: Mapping[str, FloatArray], left: IntArray, weight: FloatArray) -> dict[str, FloatArray]:
    """Signals between rows, by linear interpolation; wrapped angles and quaternions along the shorter way.

    Names and units need not be known: an angle is a signal that `unwrap` would change, in rad or deg, and four
    neighbouring columns of unit norm are a quaternion.

    Parameters
    ----------
    signals : mapping of str to (N,) array
    left : (M,) int array
        Row before each new one; at most N - 2.
    weight : (M,) array
        Part of the way to the next row, from 0 to 1.

    Returns
    -------
    dict of str to (M,) array
        On the turn, and of the sign, of the nearer row.  A neighbour of zero weight is left out, so that NaN does not
        spread.
    """
    nearest = left + (weight > 0.5)
    found = {}
    with np.errstate(over="ignore", invalid="ignore"):  # of samples that are damaged
        for name, values in signals.items():
            turns = sum((turn * _revolutions(values, turn) for turn in (2.0 * math.pi, 360.0)), np.zeros(len(values)))
            found[name] = _between(values + turns, left, weight) - turns[nearest]
        for names in _quaternions_of(signals):
            q = np.column_stack([signals[name] for name in names])
            signs = np.where(np.nansum(continuous_quaternions(q) * q, axis=1) < 0.0, -1.0, 1.0)
            for name in names:
                found[name] = _between(signals[name] * signs, left, weight) * signs[nearest]
    return found


def _between(values: FloatArray, left: IntArray, weight: FloatArray) -> FloatArray:
    """Linear interpolation without neighbours of zero weight."""
    mixed = (1.0 - weight) * values[left] + weight * values[left + 1]
    return np.where(weight < ROUNDING, values[left], np.where(weight > 1.0 - ROUNDING, values[left + 1], mixed))


def _quaternions_of(signals: Mapping[str, FloatArray]) -> list[list[str]]:
    """Names of each four neighbouring columns that are a unit quaternion in nearly all rows in which they are known."""
    names, found = list(signals), list[list[str]]()
    while len(names) >= 4:
        norms = np.linalg.norm([signals[name] for name in names[:4]], axis=0)
        known = np.isfinite(norms)
        is_one = known.any() and (np.abs(norms[known] - 1.0) <= _OWN_NORM).mean() >= 0.8
        found += [names[:4]] if is_one else []
        names = names[4 if is_one else 1 :]
    return found


# ---------------------------------------------------------------------- angles


def unwrap(log: Log, names: Sequence[str] | Mapping[str, float] | None = None) -> Log:
    """Log with the leaps by one turn removed from wrapped angles, or by one period from counters.

    Parameters
    ----------
    log : Log
    names : sequence of str, or mapping of str to float, optional
        Angles; the turn is 360 for a signal in degrees, 2 pi otherwise.  A mapping gives the period of each, in its
        unit, such as 65536 ticks.  None: the signals whose unit is one of angles.

    Raises
    ------
    LogError
        There is no such signal.
    SettingsError
        A period is not positive.

    Notes
    -----
    A leap is a wrap if it is one turn to within the motion from sample to sample and a tenth of a turn, also across
    missing samples, and if the signal lies within one turn.  Outliers keep their distance from the angle.
    """
    if isinstance(names, Mapping):
        for name, period in names.items():
            if not 0.0 < period < math.inf:
                raise SettingsError(f'the period of "{name}" is {period}; give a positive number, in its unit')
        return _without_wraps(log, names, {"periods": {n: float(x) for n, x in names.items()}})
    turns = {name: one_turn(log.units.get(name, "1")) for name in (log.names if names is None else names)}
    return _without_wraps(log, {n: x or 2.0 * math.pi for n, x in turns.items() if x or names is not None})


def _without_wraps(log: Log, turns: Mapping[str, float], given: Mapping[str, Any] = _NOTHING) -> Log:
    """Log with its wrapped ones among the named columns unwrapped; name -> one turn, in the signal's unit."""
    found = {name: _revolutions(log[name], turn) for name, turn in turns.items()}
    wrapped = {name: k for name, k in found.items() if k.any()}
    if not wrapped:
        return log
    signals = {**log.signals, **{name: log[name] + turns[name] * k for name, k in wrapped.items()}}
    leaps = {name: int((np.diff(k) != 0).sum()) for name, k in wrapped.items()}
    what = {name: f"a period of {turns[name]:.6g}" if given else "one turn" for name in leaps}
    notes = [f'"{name}" was wrapped to {what[name]}; {n} jumps are removed' for name, n in leaps.items()]
    return log.with_step({"step": "unwrap", "jumps": leaps, **given}, signals=signals, notes=notes)


def _revolutions(values: FloatArray, turn: float) -> IntArray:
    """Whole turns ``(N,)`` that are missing in each sample of an angle; all 0 if it is not wrapped."""
    k = np.zeros(len(values), np.int64)
    rows = np.flatnonzero(np.isfinite(values))
    y = values[rows] / turn
    if len(y) < 2 or np.abs(np.diff(y)).max() <= 0.5 or _is_continuous_beside_outliers(y):
        return k
    motion = _motion(y, rows)
    good = _agreeing(y, motion)
    middle = _middle_of_leaps(y[good], motion[good])
    inside = np.abs(y - middle) <= 0.5 + _MARGIN
    # Fraction of the good samples that lie within that turn, at least.
    if not good.any() or median_filter(inside[good], _PERSISTS).mean() < 0.95:
        return k
    good &= inside
    angle = _continued(y[good], rows[good])
    found = np.round(angle - y[good]).astype(np.int64)
    if not _is_wrapped(y[good], found, middle):
        return k
    first = int(np.median(found[:_PERSISTS]))
    k = found[_nearest(rows[good], len(values))] - first
    off = np.interp(rows, rows[good], angle) - y
    close = inside & (np.abs(_remainder(off)) <= np.minimum(_CLOSE + _MUCH_MOTION * motion, _FAR))
    k[rows[close]] = np.round(off[close]).astype(np.int64) - first
    return k


def _is_continuous_beside_outliers(y: FloatArray) -> bool:
    """True if the medoids of an angle, in turns, are continuous without turns: outliers alone leap.

    Those of a wrapped angle travel around the circle, and need turns from then on.
    """
    around = _neighbours(len(y), _WINDOW // 2)
    medoids = y[_medoids(y[:, None], lambda a, b: np.abs(_remainder(a - b)[:, 0]), around)]
    turns = np.round(np.cumsum(np.r_[medoids[:1], _remainder(np.diff(medoids))]) - medoids)
    return bool(np.ptp(median_filter(turns, _WINDOW)) == 0.0)


def _agreeing(y: FloatArray, motion: FloatArray) -> BoolArray:
    """Samples ``(N,)`` of an angle, in turns, that are close on the circle to a medoid with which most others agree."""
    reach = int(np.clip(_FAR / max(float(np.quantile(motion, 0.9)), _CLOSE), 1, 5))
    around = _neighbours(len(y), reach)
    usual = y[_medoids(y[:, None], lambda a, b: np.abs(_remainder(a - b)[:, 0]), around)]
    off = np.abs(_remainder(usual - y))
    close = off <= np.clip(8.0 * robust_std(off) + _MUCH_MOTION * motion, _CLOSE, _FAR)
    agreement = np.abs(_remainder(y[around] - usual[:, None])) <= np.minimum(_CLOSE + reach * motion, _FAR)[:, None]
    return np.asarray(close & (agreement.mean(axis=1) >= 0.5))


def _remainder(turns: FloatArray) -> FloatArray:
    """Difference of two angles, in turns, on the circle: from -1/2 to 1/2."""
    return np.asarray(turns - np.round(turns))


def _motion(y: FloatArray, rows: IntArray) -> FloatArray:
    """Usual size ``(N,)`` of the step on the circle that leads to each sample, in turns; a gap lasts for several."""
    lasting = np.diff(rows)
    per_row = median_filter(np.abs(_remainder(np.diff(y))) / lasting, _WINDOW)
    return np.concatenate([per_row[:1], per_row * lasting])


def _continued(y: FloatArray, rows: IntArray) -> FloatArray:
    """Angles ``(N,)``, in turns, continued by steps that are nearest to those of the usual rate around them."""
    steps, lasting = np.diff(y), np.diff(rows)
    expected = lasting * median_filter(_remainder(steps) / lasting, _WINDOW)
    return np.cumsum(np.r_[y[:1], expected + _remainder(steps - expected)])


def _middle_of_leaps(y: FloatArray, motion: FloatArray) -> float:
    """Middle of the turn to which an angle is wrapped, from its leaps by nearly a turn; NaN without any.

    0 and half a turn are usual, and found from one leap.  Of several, it is that of the turn with the most samples.
    """
    leaps = np.abs(np.diff(y))
    is_wrap = np.abs(leaps - 1.0) <= np.minimum(0.1 + _MUCH_MOTION * motion[1:], _FAR)
    if not is_wrap.any():
        return np.nan
    middles = (0.5 * (y[1:] + y[:-1]))[is_wrap]
    usual = [x for x in _USUAL_MIDDLES if (np.abs(middles - x) <= _MARGIN + 0.5 * motion[1:][is_wrap]).any()]
    return max([*usual, float(np.median(middles))], key=lambda x: float((np.abs(y - x) <= 0.5 + _MARGIN).mean()))


def _is_wrapped(y: FloatArray, k: IntArray, middle: float) -> bool:
    """True if revolutions ``k`` of good samples, in turns, change for good, or at the ends of a usual turn alone."""
    usual = median_filter(k, _PERSISTS)
    leaps = np.flatnonzero(np.diff(k))
    beyond = np.abs(np.abs(np.r_[y[leaps], y[leaps + 1]] - middle) - 0.5)
    at_ends = bool(len(leaps)) and middle in _USUAL_MIDDLES and bool((beyond <= _MARGIN).all())
    return at_ends or bool((usual != usual[0]).any())


def _nearest(at: IntArray, n: int) -> IntArray:
    """Index ``(n,)`` of the nearest of some ascending rows."""
    return np.searchsorted(0.5 * (at[1:] + at[:-1]), np.arange(n))


# ---------------------------------------------------------------------- quaternions


def whole_quaternions(names: Container[str], model: Model) -> list[list[str]]:
    """Names of the components of each of a model's quaternions that is among some signals as a whole."""
    coordinates = list(model.coordinates)
    found = [[coordinates[k] for k in four] for four in model.quaternions]
    return [own for own in found if all(name in names for name in own)]


def unit_quaternions(q: FloatArray) -> FloatArray:
    """Quaternions ``(N, 4)`` scaled to unit norm; those of norm zero are left as they are."""
    return q / size_or_one(np.linalg.norm(q, axis=1, keepdims=True))


def continuous_quaternions(q: FloatArray) -> FloatArray:
    """Unit quaternions of one sign: each is nearer to its neighbours than its opposite is.

    Parameters
    ----------
    q : (N, 4) array
        Quaternions; NaN where a component is missing.

    Returns
    -------
    (N, 4) array
        Of unit norm where all four components are there and none of them is an outlier, which would spread to the
        others; all others are divided by the median norm.  The first rows have the sign that most of them have.
    """
    whole = np.flatnonzero(np.isfinite(q).all(axis=1))
    norms = np.linalg.norm(q[whole], axis=1)
    usual_norm = float(np.median(norms)) if len(whole) else 0.0
    if not usual_norm > 0.0:
        return q
    scaled, around = q / usual_norm, _neighbours(len(whole), 3)
    medoid = scaled[whole][_medoids(scaled[whole], lambda a, b: np.minimum(*_distances(a, b)), around)]
    medoid *= np.cumprod(np.r_[1.0, _signs(medoid[1:], medoid[:-1])])[:, None]
    signs = _signs(scaled, medoid[_nearest(whole, len(q))])
    if np.median(signs[whole[:_PERSISTS]]) < 0.0:
        signs = -signs
    divisor = np.full(len(q), usual_norm)
    divisor[whole] = np.where(np.abs(norms / usual_norm - 1.0) <= _OWN_NORM, norms, usual_norm)
    divisor[np.abs(divisor - 1.0) <= 1e-9] = 1.0  # rounding
    return np.asarray(q * (signs / divisor)[:, None])


def _distances(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances ``(N,)`` of quaternions from others and from their opposites; an outlying component counts little."""
    near, far = (np.nan_to_num(np.abs(x)) for x in (a - b, a + b))
    near, far = (np.minimum(x, 1.0) + 1e-9 * x for x in (near, far))  # the second term breaks ties
    return near.sum(axis=1), far.sum(axis=1)


def _signs(a: FloatArray, b: FloatArray) -> FloatArray:
    """Sign ``(N,)`` with which each quaternion is nearer to another."""
    near, far = _distances(a, b)
    return np.where(near <= far, 1.0, -1.0)


def _with_one_sign(log: Log, names: Sequence[str]) -> Log:
    q = np.column_stack([log[name] for name in names])
    found = continuous_quaternions(q)
    if np.array_equal(found, q, equal_nan=True):
        return log
    flipped = int((np.nansum(found * q, axis=1) < 0.0).sum())
    signals = {**log.signals, **dict(zip(names, found.T, strict=True))}
    note = (
        f"{', '.join(names)} change sign in {flipped} of {len(q)} rows, which is the same attitude; they are continued"
    )
    return log.with_step(
        {"step": "align", "quaternion": list(names), "rows": flipped}, signals=signals, notes=[note] if flipped else []
    )


# ---------------------------------------------------------------------- medoids


def _neighbours(n: int, reach: int) -> IntArray:
    """Indices ``(n, 2 reach + 1)`` of the samples about each, mirrored at both ends; fewer where there are fewer."""
    return np.asarray(mirrored_windows(np.arange(n), min(reach, n - 1)))


def _medoids(
    points: FloatArray, distance: Callable[[FloatArray, FloatArray], FloatArray], around: IntArray
) -> IntArray:
    """Index ``(N,)`` of the medoid of the neighbours of each of the points ``(N, n)``; of equals, the nearest."""
    n, width = around.shape
    mirrored = points[np.r_[around[:, 0], around[-1, 1:]]]
    apart = [distance(mirrored[k:], mirrored[: n + width - 1 - k]) for k in range(width)]
    total = np.zeros((width, n))
    for i in range(width):
        for j in range(i):
            pair = apart[i - j][j : j + n]
            total[i] += pair
            total[j] += pair
    order = np.argsort(np.abs(np.arange(width) - width // 2), kind="stable")
    chosen = order[np.argmin(total[order], axis=0)]
    return np.asarray(around[np.arange(len(points)), chosen])
