"""Arrays of many rollouts, arranged for the time loop; a lane is one rollout."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.errors import SettingsError
from diransac.simulation.compiler.machine_code import LANES, run_blocks

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike, NDArray

    from diransac.simulation.compiler.machine_code import MachineCode

ARGUMENTS = {
    "parameters": "pointer",  # (n_p, n_padded) float64
    "initial_states": "pointer",  # (n_states, n_padded) float64
    "inputs": "pointer",  # (n_log, n_inputs) float64, read where the log gives the inputs
    "feedback": "pointer",  # (n_laws, n_log, width) float64, read where feedback gives the inputs
    "feedback_starts": "pointer",  # (n_padded,) int64, row of all laws' rows at which each lane's law starts
    "limits": "pointer",  # (2, n_u) float64, smallest and largest inputs of the feedback
    "measured": "pointer",  # (n_log, n_s) float64
    "valid": "pointer",  # (n_log,) bytes, 0 or 1
    "weights": "pointer",  # (n_log, n_s) float64
    "directions": "pointer",  # (n_log, n_directions, n_s) float64
    "squared_thresholds": "pointer",  # (n_s,) float64
    "start_rows": "pointer",  # (n_padded,) int64, read where lanes start at different rows
    "places": "pointer",  # int64, of sums and final states in the arrays of a lane; see `Sensitivities.places`
    "scratch": "pointer",  # float64, vectors of a block, for every block
    "sums": "pointer",  # (n_s, n_padded) float64, written by the output; so are the next seven
    "first": "pointer",  # (n_lanes, 1 + n_z) float64
    "along": "pointer",  # (n_lanes, n_directions, 1 + n_z) float64
    "matrix": "pointer",  # (n_lanes, n_z, n_z) float64
    "counts": "pointer",  # (2, n_padded) int64
    "inlier_bits": "pointer",  # (n_blocks, n_rows) bytes, one bit per lane
    "series": "pointer",  # (n_lanes, n_rows, width) float64
    "final": "pointer",  # (n_lanes, n_states or more) float64
    "step": "number",  # seconds, of one sub-step
    "substeps": "integer",  # of a row, read where rows are divided
    "min_inlier_signals": "integer",
    "products": "integer",  # 0 leaves out J' W J
    "n_directions": "integer",
    "n_lanes": "integer",
    "n_padded": "integer",  # n_lanes rounded up to whole vectors; the last lane is repeated
    "n_rows": "integer",
    "first_block": "integer",  # vectors of lanes to run: first_block .. end_block - 1
    "end_block": "integer",
}
"""Arguments of the compiled time loop, in order, and their kinds."""
_BEFORE_BLOCKS = [name for name in ARGUMENTS if not name.endswith("_block")]


@dataclass(frozen=True, eq=False, repr=False)
class Lanes:
    """Parameters, initial states and inputs of rollouts.

    Attributes
    ----------
    n_lanes : number of rollouts
    n_log : rows of the log
    window : rows of the log that any lane uses
    n_rows : rows that each lane simulates
    arrays : by their names in the time loop: parameters (n_p, n_padded), initial_states (n_x, n_padded), inputs
        (n_window, n_inputs), and start_rows (n_padded,) unless all lanes start at the window's first row
    """

    n_lanes: int
    n_log: int
    window: slice
    n_rows: int
    arrays: dict[str, NDArray[Any]]

    @property
    def n_padded(self) -> int:
        """Number of lanes with those that fill the last vector, copies of the last lane."""
        return _padded_size(self.n_lanes)

    @property
    def has_windows(self) -> bool:
        """True if lanes start at different rows."""
        return "start_rows" in self.arrays

    def with_windows(self) -> Lanes:
        """The same lanes, as if they started at different rows."""
        starts = {"start_rows": np.zeros(self.n_padded, np.int64)}
        return replace(self, arrays={**starts, **self.arrays})


def arranged_lanes(
    sizes: tuple[int, int, int],
    parameters: FloatArray,
    initial_states: FloatArray,
    inputs: FloatArray,
    start_rows: IntArray | None,
    n_rows: int,
) -> Lanes:
    """Lanes of a batch of rollouts.

    Parameters
    ----------
    sizes : n_p, n_x, n_inputs
    parameters : (n_lanes, n_p)
    initial_states : (n_x,) or (n_lanes, n_x)
    inputs : (n_log, n_inputs)
    start_rows : (n_lanes,), optional   row of the log at which each lane starts
    n_rows : rows that each lane simulates, which lie within the log

    Raises SettingsError: an array does not fit the sizes.
    """
    n_p, n_x, n_inputs = sizes
    p = checked_array("parameters", parameters, (None, n_p))
    x = initial_states
    x = np.broadcast_to(x, (len(p), n_x)) if x.shape == (n_x,) else checked_array("initial_states", x, (len(p), n_x))
    u = checked_array("inputs", inputs, (None, n_inputs))
    starts = np.zeros(len(p), np.int64) if start_rows is None else start_rows.astype(np.int64)
    shared = not len(starts) or bool(np.all(starts == starts[0]))
    first = int(starts.min()) if len(starts) else 0
    window = slice(first, (int(starts.max()) if len(starts) else 0) + n_rows)
    arrays = {"parameters": _padded(p), "initial_states": _padded(x), "inputs": u[window]}
    if not shared:
        arrays["start_rows"] = _padded(starts - first)
    return Lanes(len(p), len(u), window, n_rows, arrays)


def arranged_measurements(
    lanes: Lanes, n_signals: int, values: FloatArray, valid: BoolArray
) -> dict[str, NDArray[Any]]:
    """Measured signals (n_window, n_signals) and valid rows (n_window,).

    Parameters
    ----------
    values : (n_log, n_signals)
    valid : (n_log,)

    Raises SettingsError: an array does not fit the lanes, or a value in a valid row is not finite.
    """
    y = checked_array("measurements.values", values, (lanes.n_log, n_signals))
    # One sum is a quick test: it is finite unless a term is not finite, or is huge.
    if not np.isfinite(y.sum()) and not np.isfinite(y[valid]).all():
        raise SettingsError(
            "measurements.values holds a NaN or an infinity in a valid row; mark such rows as not valid."
        )
    return {"measured": y[lanes.window], "valid": valid[lanes.window]}


def arranged_weights(
    lanes: Lanes, n_signals: int, values: FloatArray, valid: BoolArray, weights: ArrayLike
) -> dict[str, NDArray[Any]]:
    """Measured signals and weights, (n_window, n_signals) each.

    The weights of rows that do not count are zero, and values without weight are finite.

    Parameters
    ----------
    values : (n_log, n_signals)
    valid : (n_log,)
    weights : (n_signals,) or (n_log, n_signals)

    Raises SettingsError: an array does not fit the lanes, a weight is negative or not finite, or a value with a weight
    is not finite.
    """
    w = np.asarray(weights, np.float64)
    w = np.broadcast_to(w, (lanes.n_log, n_signals)) if w.shape == (n_signals,) else w
    w = checked_array("weights", w, (lanes.n_log, n_signals))[lanes.window]
    if w.size and not (w.min() >= 0.0 and w.max() < np.inf):
        raise SettingsError("weights hold a number that is negative or not finite.")
    y, counts = (
        checked_array("measurements.values", values, (lanes.n_log, n_signals))[lanes.window],
        valid[lanes.window],
    )
    w = w if counts.all() else np.where(counts[:, None], w, 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        total = y.sum()
    if np.isfinite(total):  # as is then every term
        return {"measured": y, "weights": w}
    finite = np.isfinite(y)
    if not finite[w > 0].all():
        raise SettingsError(
            "measurements.values holds a NaN or an infinity in a valid row and a signal that has a weight; set the "
            "weight to 0, or mark the row as not valid."
        )
    return {"measured": np.where(finite, y, 0.0), "weights": w}


def arranged_directions(lanes: Lanes, n_signals: int, directions: ArrayLike | None) -> dict[str, Any]:
    """Directions (n_window, n_directions, n_signals), none by default, and their number.

    Parameters
    ----------
    directions : (n_log, n_directions, n_signals)

    Raises SettingsError: an array does not fit the lanes.
    """
    d = np.empty((lanes.n_log, 0, n_signals)) if directions is None else directions
    d = checked_array("directions", d, (lanes.n_log, None, n_signals))[lanes.window]
    return {"directions": d, "n_directions": d.shape[1]}


def arranged_feedback(
    lanes: Lanes, table: FloatArray, n_laws: int | None, feedback_of_lane: ArrayLike | None
) -> dict[str, NDArray[Any]]:
    """Feedback laws, and feedback_starts (n_padded,) unless all lanes have the same law and rows.

    Parameters
    ----------
    table : (n_laws, n_log, width)
    n_laws : None if there is one law for all
    feedback_of_lane : (n_lanes,)

    Raises SettingsError: not one law per lane.
    """
    if n_laws is None and feedback_of_lane is None and not lanes.has_windows:
        return {"feedback": table[0, lanes.window]}
    own = np.zeros(lanes.n_lanes, np.int64) if n_laws is None else np.arange(lanes.n_lanes)
    chosen = own if feedback_of_lane is None else np.asarray(feedback_of_lane)
    fits = chosen.shape == (lanes.n_lanes,) and chosen.dtype.kind in "iu"
    if not fits or (lanes.n_lanes and not (chosen.min() >= 0 and chosen.max() < len(table))):
        raise SettingsError(
            f"feedback_of_lane must be one integer per lane, {lanes.n_lanes} in all, from 0 to {len(table) - 1}; "
            "without it there must be one law per lane."
        )
    starts = lanes.arrays.get("start_rows", np.zeros(lanes.n_padded, np.int64))
    first_rows = _padded(chosen.astype(np.int64)) * lanes.n_log + lanes.window.start + starts
    return {"feedback": table, "feedback_starts": first_rows}


def squared_thresholds(thresholds: ArrayLike, n_signals: int) -> FloatArray:
    """Squares of the thresholds (n_signals,), the bounds of squared errors.

    Rounding keeps the order of squares, so `error**2 < threshold**2` wherever `|error| < threshold` and nowhere else,
    for thresholds from 1e-150 to 1e150.

    Raises SettingsError: an array of another shape, a negative threshold, or NaN.
    """
    limits = checked_array("thresholds", thresholds, (n_signals,))
    if not (limits >= 0).all():
        raise SettingsError(f"thresholds are {limits.tolist()}, but each must be 0 (off) or positive.")
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(np.square(limits))


def run_time_loop(code: MachineCode, lanes: Lanes, values: Mapping[str, Any], threads: int) -> None:
    """Run a compiled time loop over all blocks of lanes; `values` are its other arguments by name, 0 where absent."""
    run_blocks(code.call, time_loop_arguments(lanes, values), lanes.n_padded // LANES, threads)


def time_loop_arguments(lanes: Lanes, given: Mapping[str, Any]) -> list[Any]:
    """Arguments of the compiled time loop, all but the blocks; arrays as addresses, which do not keep them alive."""
    sizes = {"n_lanes": lanes.n_lanes, "n_padded": lanes.n_padded, "n_rows": lanes.n_rows}
    known = {**lanes.arrays, **given, **sizes}
    values = [known.get(name, 0) for name in _BEFORE_BLOCKS]
    return [value.ctypes.data if isinstance(value, np.ndarray) else value for value in values]


def aligned(shape: tuple[int, ...]) -> FloatArray:
    """New array that starts at a multiple of a vector's size, so that no vector straddles two cache lines."""
    size = int(np.prod(shape))
    memory = np.empty(size + LANES)
    start = -(memory.ctypes.data // 8) % LANES
    return memory[start : start + size].reshape(shape)


def checked_array(name: str, values: ArrayLike, shape: tuple[int | None, ...]) -> FloatArray:
    """Contiguous float64 array of a shape in which None is any length.

    Raises SettingsError: the shape differs.
    """
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
    n, found = len(lanes), np.empty((*lanes.shape[1:], _padded_size(len(lanes))), lanes.dtype)
    found[..., :n] = lanes.T
    found[..., n:] = lanes[-1:].T
    return found
