"""Arrays of many rollouts, checked and arranged as the time loop reads them: a lane is one rollout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import SettingsError
from diransac.simulation.compiler.machine_code import LANES, run_blocks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray

    from diransac.simulation.compiler.machine_code import MachineCode


__all__ = [
    "Lanes",
    "aligned",
    "arranged_lanes",
    "arranged_laws",
    "arranged_measurements",
    "arranged_weights",
    "run_time_loop",
    "squared_thresholds",
]


@dataclass(frozen=True)
class Lanes:
    """What a number of rollouts start from.

    Attributes
    ----------
    n_lanes : rollouts
    n_log : rows of the log
    window : rows of the log that any of them uses
    n_rows : rows that each of them simulates
    arrays : by their names in the time loop: parameters (n_p, n_padded), initial_states (n_x, n_padded), inputs
        (n_window, n_u), and start_rows (n_padded,) unless all lanes start at the window's first row
    """

    n_lanes: int
    n_log: int
    window: slice
    n_rows: int
    arrays: dict[str, NDArray[Any]]

    @property
    def n_padded(self) -> int:
        """Lanes with those that fill the last vector, which repeat the last."""
        return _padded_size(self.n_lanes)

    @property
    def has_windows(self) -> bool:
        """Whether lanes start at rows of their own."""
        return "start_rows" in self.arrays


def arranged_lanes(
    sizes: tuple[int, int, int],
    parameters: ArrayLike,
    initial_states: ArrayLike,
    inputs: ArrayLike,
    start_rows: ArrayLike | None,
    n_rows: int | None,
) -> Lanes:
    """Check what rollouts start from, and arrange it.

    Parameters
    ----------
    sizes : n_p, n_x, n_u
    parameters : (n_lanes, n_p)
    initial_states : (n_x,) or (n_lanes, n_x)
    inputs : (n_log, n_u)
    start_rows, n_rows : windows, as `Rollouts` has them

    Raises SettingsError: an array of another shape, or a window outside the log.
    """
    n_p, n_x, n_u = sizes
    p = _array("parameters", parameters, (None, n_p))
    x = np.asarray(initial_states, np.float64)
    x = np.broadcast_to(x, (len(p), n_x)) if x.shape == (n_x,) else _array("initial_states", x, (len(p), n_x))
    u = _array("inputs", inputs, (None, n_u))
    starts, length = _windows(len(p), len(u), start_rows, n_rows)
    shared = not len(starts) or bool(np.all(starts == starts[0]))
    first = int(starts.min()) if len(starts) else 0
    window = slice(first, (int(starts.max()) if len(starts) else 0) + length)
    arrays = {"parameters": _padded(p), "initial_states": _padded(x), "inputs": u[window]}
    if not shared:
        arrays["start_rows"] = _padded(starts - first)
    return Lanes(len(p), len(u), window, length, arrays)


def arranged_measurements(
    lanes: Lanes, n_signals: int, measured: ArrayLike, valid: ArrayLike
) -> dict[str, NDArray[Any]]:
    """Check what rollouts are compared with: measured (n_log, n_signals) and valid (n_log,), cut to their window.

    Raises SettingsError: an array of another shape, or a number in a valid row that isn't finite.
    """
    n_log = lanes.n_log
    y = _array("measured", measured, (n_log, n_signals))
    flags = _flags(valid, n_log)
    # One sum is a quick first look: it is finite unless something in it isn't, or is huge.
    if not np.isfinite(y.sum()) and not np.isfinite(y[flags]).all():
        raise SettingsError("measured holds a NaN or an infinity in a valid row; mark such rows as not valid.")
    return {"measured": y[lanes.window], "valid": flags[lanes.window]}


def arranged_weights(
    lanes: Lanes, n_signals: int, measured: ArrayLike, valid: ArrayLike, weights: ArrayLike
) -> dict[str, NDArray[Any]]:
    """Check what rollouts are compared with, and arrange it: measured and weights (n_window, n_signals).

    The weights of rows that do not count are zero, and what has no weight is finite.

    Parameters
    ----------
    weights : (n_signals,) or (n_log, n_signals)

    Raises SettingsError: an array of another shape, a weight that is negative or not finite, or a measurement with a
    weight that isn't finite.
    """
    w = np.asarray(weights, np.float64)
    w = np.broadcast_to(w, (lanes.n_log, n_signals)) if w.shape == (n_signals,) else w
    w = _array("weights", w, (lanes.n_log, n_signals))[lanes.window]
    if not (np.isfinite(w).all() and (w >= 0).all()):
        raise SettingsError("weights hold a number that is negative or not finite.")
    y = _array("measured", measured, (lanes.n_log, n_signals))[lanes.window]
    w = np.where(_flags(valid, lanes.n_log)[lanes.window, None], w, 0.0)
    finite = np.isfinite(y)
    if not finite[w > 0].all():
        raise SettingsError(
            "measured holds a NaN or an infinity in a valid row and a signal that has a weight; give it none, or mark "
            "the row as not valid."
        )
    return {"measured": np.where(finite, y, 0.0), "weights": w}


def arranged_laws(
    lanes: Lanes, table: FloatArray, n_laws: int | None, law_of_lane: ArrayLike | None
) -> dict[str, NDArray[Any]]:
    """Check which laws steer the lanes, and arrange them: laws, and law_starts (n_padded,) unless one steers all alike.

    Parameters
    ----------
    table : (n_laws, n_log, width)
    n_laws : None if there is one law for all
    law_of_lane : (n_lanes,)

    Raises SettingsError: not one law for each lane.
    """
    if n_laws is None and law_of_lane is None and not lanes.has_windows:
        return {"laws": table[0, lanes.window]}
    own = np.zeros(lanes.n_lanes, np.int64) if n_laws is None else np.arange(lanes.n_lanes)
    chosen = own if law_of_lane is None else np.asarray(law_of_lane)
    fits = chosen.shape == (lanes.n_lanes,) and chosen.dtype.kind in "iu"
    if not fits or (lanes.n_lanes and not (chosen.min() >= 0 and chosen.max() < len(table))):
        raise SettingsError(
            f"law_of_lane must be one integer a lane, {lanes.n_lanes} in all, from 0 to {len(table) - 1}; without it "
            "there must be a law for each lane."
        )
    starts = lanes.arrays.get("start_rows", np.zeros(lanes.n_padded, np.int64))
    return {"laws": table, "law_starts": _padded(chosen.astype(np.int64)) * lanes.n_log + lanes.window.start + starts}


def squared_thresholds(thresholds: ArrayLike, n_signals: int) -> FloatArray:
    """Squares of the thresholds (n_signals,), which squared errors are compared with.

    Rounding keeps the order of squares, so `error**2 < threshold**2` wherever `|error| < threshold` and nowhere else,
    for thresholds from 1e-150 to 1e150.

    Raises SettingsError: an array of another shape, a negative threshold, or NaN.
    """
    limits = _array("thresholds", thresholds, (n_signals,))
    if not (limits >= 0).all():
        raise SettingsError(f"thresholds are {limits.tolist()}, but each must be 0 (off) or positive.")
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(np.square(limits))


def run_time_loop(code: MachineCode, lanes: Lanes, values: Mapping[str, Any], threads: int) -> None:
    """Run a compiled time loop over all blocks of lanes; `values` are its other arguments by name, 0 where absent."""
    from diransac.simulation.compiler.time_loop import ARGUMENTS

    sizes = {"n_lanes": lanes.n_lanes, "n_padded": lanes.n_padded, "n_rows": lanes.n_rows}
    known = {**lanes.arrays, **values, **sizes}
    arguments = [
        array.ctypes.data if isinstance(array := known.get(name), np.ndarray) else array or 0
        for name in ARGUMENTS
        if not name.endswith("_block")
    ]
    run_blocks(code.call, arguments, lanes.n_padded // LANES, threads)


def _windows(
    n_lanes: int, n_log: int, start_rows: ArrayLike | None, n_rows: int | None
) -> tuple[NDArray[np.int64], int]:
    """First row of each lane, and how many rows it has."""
    length = n_log if n_rows is None else int(n_rows)
    starts = np.zeros(n_lanes, np.int64) if start_rows is None else np.asarray(start_rows)
    if start_rows is not None and n_rows is None:
        raise SettingsError("start_rows is given without n_rows; say how many rows each window has.")
    if starts.shape != (n_lanes,) or starts.dtype.kind not in "iu":
        raise SettingsError(f"start_rows must be one integer a lane, {n_lanes} in all; found shape {starts.shape}.")
    if not 1 <= length <= n_log:
        raise SettingsError(f"n_rows is {length}, but the log has {n_log} rows.")
    if n_lanes and (starts.min() < 0 or starts.max() + length > n_log):
        raise SettingsError(
            f"windows of {length} rows that start at rows {starts.min()} to {starts.max()} do not lie within the "
            f"log's {n_log} rows."
        )
    return starts.astype(np.int64), length


def aligned(shape: tuple[int, ...]) -> FloatArray:
    """New array that starts at a multiple of a vector's size, so that none of its vectors straddles two cache lines."""
    size = int(np.prod(shape))
    memory = np.empty(size + LANES)
    start = -(memory.ctypes.data // 8) % LANES
    return memory[start : start + size].reshape(shape)


def _flags(valid: ArrayLike, n_log: int) -> NDArray[np.bool_]:
    """One Boolean a row."""
    flags = np.ascontiguousarray(valid)
    if flags.shape != (n_log,) or flags.dtype != np.bool_:
        raise SettingsError(f"valid must be {n_log} Booleans, one a row; found {flags.shape} of {flags.dtype}.")
    return flags


def _array(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
    """Contiguous float64 array of the shape, None being any length."""
    array = np.ascontiguousarray(values, np.float64)
    matches = (want in (None, found) for want, found in zip(shape, array.shape, strict=False))
    if array.ndim != len(shape) or not all(matches):
        wanted = ", ".join("any" if length is None else str(length) for length in shape)
        raise SettingsError(f"{name} has shape {array.shape}, but ({wanted}) is needed.")
    return array


def _padded_size(n_lanes: int) -> int:
    """Lanes rounded up to whole vectors."""
    return -(-n_lanes // LANES) * LANES


def _padded(lanes: NDArray[Any]) -> NDArray[Any]:
    """Lanes on the last axis, the last one repeated to fill whole vectors."""
    padding = np.repeat(lanes[-1:], _padded_size(len(lanes)) - len(lanes), axis=0)
    return np.ascontiguousarray(np.concatenate([lanes, padding]).T)
