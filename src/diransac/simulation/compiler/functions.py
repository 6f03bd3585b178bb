"""SX functions compiled over arrays: `Map` evaluates one in every row, `Scan` applies one row after row."""

from __future__ import annotations

from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError, SettingsError
from diransac.simulation.compiler.graph import check_compilable, read_graph
from diransac.simulation.compiler.lanes import ARGUMENTS, Lanes, arranged_lanes, time_loop_arguments
from diransac.simulation.compiler.machine_code import (
    LANES,
    MachineCode,
    Target,
    compile_function,
    run_blocks,
    signature,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence

    from numpy.typing import ArrayLike

    from diransac.simulation.compiler.time_loop import LoopSpecification
    from diransac.simulation.compiler.vectors import Value


class _Compiled:
    """An SX function, and its machine code by variant.  Raises ModelError: an operation cannot be compiled."""

    def __init__(self, serialized: str, target: Target | None) -> None:
        self._function = function = ca.Function.deserialize(serialized)
        self._serialized, self._target = serialized, target
        self._code: dict[object, MachineCode] = {}
        self._lock = Lock()
        self._widths_in = [function.numel_in(k) for k in range(function.n_in())]
        self._widths_out = [function.numel_out(k) for k in range(function.n_out())]
        check_compilable(function)

    def _variant(
        self, kind: str, variant: object, emit: Callable[[], Value], arguments: Collection[str]
    ) -> MachineCode:
        """Machine code of one variant, compiled when it is first asked for."""
        with self._lock:
            if variant not in self._code:
                definition = (kind, self._serialized, repr(variant))
                name = "map_loop" if kind == "map" else "time_loop"
                self._code[variant] = compile_function(emit, definition, name, arguments, self._target)
            return self._code[variant]


class Map(_Compiled):
    """An SX function over many rows; made by `compile_map`, compiled when first called."""

    def __call__(self, *arrays: ArrayLike, threads: int = 1) -> tuple[FloatArray, ...]:
        """Evaluate the function in every row.

        Parameters
        ----------
        arrays : (n_rows, n_i) or (n_i,) each
            n_i is the number of elements of input i, column by column; an array (n_i,) is shared by all rows.
        threads : int
            Number of threads.

        Returns
        -------
        tuple of (n_rows, n_o)
            One array per output, structural zeros included; n_rows is 1 if every input is shared.

        Raises
        ------
        SettingsError
            An array has another shape.
        """
        return self.prepare(*arrays).run(threads=threads)

    def prepare(self, *arrays: ArrayLike) -> PreparedMap:
        """Evaluation of the function in every row of these arrays, for many runs.

        Parameters and exceptions are those of a call. Contiguous arrays of float64 are not copied: each run reads what
        they hold then.
        """
        inputs, n_rows = self._checked(arrays)
        code = self._compiled(tuple(array.ndim == 1 for array in inputs))
        return PreparedMap(code, inputs, n_rows, self._widths_out)

    def _checked(self, arrays: Sequence[ArrayLike]) -> tuple[list[FloatArray], int]:
        """Contiguous arrays, and their common number of rows."""
        function, widths = self._function, self._widths_in
        if len(arrays) != len(widths):
            raise SettingsError(f"function {function.name()!r} takes {len(widths)} arrays; found {len(arrays)}.")
        inputs = [np.ascontiguousarray(array, np.float64) for array in arrays]
        lengths = {len(array) for array in inputs if array.ndim == 2}
        fits = all(array.ndim in (1, 2) and array.shape[-1] == n for array, n in zip(inputs, widths, strict=True))
        if not fits or len(lengths) > 1:
            raise SettingsError(
                f"function {function.name()!r} takes arrays (n_rows, n) or (n,) with n = {widths} and one n_rows; "
                f"found {[array.shape for array in inputs]}."
            )
        return inputs, lengths.pop() if lengths else 1

    def _compiled(self, shared: tuple[bool, ...]) -> MachineCode:
        """Machine code for inputs some of which are shared by all rows."""

        def emit() -> Value:
            from diransac.simulation.compiler.operations import emit_map_loop

            graph = read_graph(self._function, [k for k, fixed in enumerate(shared) if fixed])
            return emit_map_loop(graph, self._widths_in)

        return self._variant("map", shared, emit, signature(len(self._widths_in) + len(self._widths_out), 3))


def compile_map(function: ca.Function, target: Target | None = None) -> Map:
    """Compiled evaluation of an SX function over many rows; the same object again for an equal function.

    Parameters
    ----------
    function : casadi.Function
        SX function.
    target : Target, optional
        Processor to compile for; this one by default.

    Raises
    ------
    ModelError
        An operation cannot be compiled.
    """
    _check_expanded(function)
    return _map(function.serialize(), target)


_map = lru_cache(maxsize=64)(Map)


def _check_expanded(function: ca.Function) -> None:
    if not function.is_a("SXFunction"):
        raise ModelError(f"function {function.name()!r} is not made of SX symbols; expand it: Function.expand().")


class PreparedMap:
    """Evaluation of a `Map` on the same arrays in every run; made by `Map.prepare`.

    Attributes
    ----------
    outputs : (n_rows, n_o) each   results, overwritten by each run
    """

    def __init__(self, code: MachineCode, inputs: Sequence[FloatArray], n_rows: int, widths: Sequence[int]) -> None:
        self.outputs = tuple(np.empty((n_rows, width)) for width in widths)
        self._code, self._inputs, self._n_rows = code, inputs, n_rows
        self._arguments = [*(array.ctypes.data for array in (*inputs, *self.outputs)), n_rows]

    def run(self, *, threads: int = 1) -> tuple[FloatArray, ...]:
        """Outputs of every row."""
        if self._n_rows:
            run_blocks(self._code.call, self._arguments, -(-self._n_rows // LANES), threads)
        return self.outputs


class Scan(_Compiled):
    """A recurrence over rows, many lanes at once; made by `compile_scan`, compiled when first called.

    It runs in the time loop of a simulation, with the carry as state, the outputs as signals and the rows as inputs.
    The results of a lane depend neither on the other lanes, nor on their number, nor on `threads`.
    """

    def __call__(self, carry: ArrayLike, rows: ArrayLike, constants: ArrayLike, *, threads: int = 1) -> FloatArray:
        """Outputs of every lane and row.

        Parameters
        ----------
        carry : (n_lanes, n_c)
            Initial carry of each lane.
        rows : (n_lanes, n_rows, n_r) or (n_rows, n_r)
            Rows of each lane, or of all lanes.
        constants : (n_lanes, n_k)
            Constants of each lane.
        threads : int
            Number of threads.

        Returns
        -------
        (n_lanes, n_rows, n_o)
            Outputs; NaN from the first row on in which an output of the lane is not finite.

        Raises
        ------
        SettingsError
            An array has another shape, or there is no row.
        """
        start, row, constant = (np.asarray(array, np.float64) for array in (carry, rows, constants))
        n_c, n_r, n_k = self._widths_in
        n_lanes, n_rows = len(start) if start.ndim else 0, row.shape[-2] if row.ndim > 1 else 0
        fits = start.shape == (n_lanes, n_c) and constant.shape == (n_lanes, n_k) and n_rows > 0
        if not fits or row.shape not in ((n_rows, n_r), (n_lanes, n_rows, n_r)):
            raise SettingsError(
                f"function {self._function.name()!r} takes carry (n_lanes, {n_c}), rows (n_lanes, n_rows, {n_r}) or "
                f"(n_rows, {n_r}) with at least one row, and constants (n_lanes, {n_k}); found {start.shape}, "
                f"{row.shape} and {constant.shape}."
            )
        if not n_lanes:
            return np.empty((0, n_rows, self._widths_out[1]))
        own = np.arange(n_lanes) * n_rows if row.ndim == 3 and n_lanes > 1 else None
        lanes = arranged_lanes((n_k, n_c, n_r), constant, start, row.reshape(-1, n_r), own, n_rows)
        return self._prepared(lanes).run(threads=threads)

    def prepare(self, n_lanes: int, n_rows: int) -> PreparedScan:
        """Recurrence of this many lanes, each with this many rows of its own, at least one, for many runs."""
        n_c, n_r, n_k = self._widths_in
        starts = np.arange(n_lanes) * n_rows if n_lanes > 1 else None
        constants, carry = np.zeros((n_lanes, n_k)), np.zeros((n_lanes, n_c))
        rows = np.zeros((n_lanes * n_rows, n_r))
        return self._prepared(arranged_lanes((n_k, n_c, n_r), constants, carry, rows, starts, n_rows))

    def _prepared(self, lanes: Lanes) -> PreparedScan:
        return PreparedScan(self._compiled(lanes.has_windows), lanes, self._widths_in[0], self._widths_out[1])

    def _compiled(self, windows: bool) -> MachineCode:
        """Machine code for lanes with rows of their own, or with the same ones."""

        def emit() -> Value:
            from diransac.simulation.compiler.outputs import SignalOutput
            from diransac.simulation.compiler.time_loop import emit_time_loop, inputs_from_log

            return emit_time_loop(self._specification(), SignalOutput, inputs_from_log, windows=windows)

        return self._variant("scan", windows, emit, ARGUMENTS.values())

    def _specification(self) -> LoopSpecification:
        """The recurrence as a simulation without sub-steps and without scored signals."""
        from diransac.simulation.compiler.time_loop import LoopSpecification

        return LoopSpecification(
            step=read_graph(self._function, (2,), reciprocals=True),
            divided=False,
            n_states=self._widths_in[0],
            n_inputs=self._widths_in[1],
            n_signals=self._widths_out[1],
            scored=(),
            quaternions=(),
            state_quaternions=(),
        )


class PreparedScan:
    """Recurrence of a `Scan` on the same arrays in every run; made by `Scan.prepare`.

    Attributes
    ----------
    rows : (n_lanes, n_rows, n_r)   rows of each lane; zero until they are set
    outputs : (n_lanes, n_rows, n_o)   those of a call, overwritten by each run
    """

    def __init__(self, code: MachineCode, lanes: Lanes, n_c: int, n_o: int) -> None:
        self.rows = lanes.arrays["inputs"].reshape(-1, lanes.n_rows, lanes.arrays["inputs"].shape[1])
        self.outputs = np.empty((lanes.n_lanes, lanes.n_rows, n_o))
        self._final = np.empty((lanes.n_lanes, n_c))
        self._code, self._lanes = code, lanes
        self._arguments = time_loop_arguments(lanes, {"series": self.outputs, "final": self._final})

    def set_carry(self, values: FloatArray, first: int = 0) -> None:
        """Set elements of the initial carry from `first` on to values (n_lanes, n)."""
        self._set("initial_states", values, first)

    def set_constants(self, values: FloatArray, first: int = 0) -> None:
        """Set constants from `first` on to values (n_lanes, n)."""
        self._set("parameters", values, first)

    def _set(self, name: str, values: FloatArray, first: int) -> None:
        """Set elements of an array of lanes; the last lane fills the last vector."""
        n_lanes, n = values.shape
        array = self._lanes.arrays[name][first : first + n]
        array[:, :n_lanes] = values.T
        array[:, n_lanes:] = values[-1:].T

    def run(self, *, threads: int = 1) -> FloatArray:
        """Outputs of every lane and row."""
        run_blocks(self._code.call, self._arguments, self._lanes.n_padded // LANES, threads)
        return self.outputs

    def last_carry(self) -> FloatArray:
        """Carry (n_lanes, n_c) after the last row of the run; NaN in a lane with an output that is not finite."""
        return self._final


def compile_scan(function: ca.Function, target: Target | None = None) -> Scan:
    """Compiled recurrence of an SX function; the same object again for an equal function.

    Parameters
    ----------
    function : casadi.Function
        SX function (carry, row, constants) -> (carry of the next row, outputs). A call returns the last carry only if
        it is among the outputs.
    target : Target, optional
        Processor to compile for; this one by default.

    Raises
    ------
    ModelError
        The function is not a recurrence, or an operation cannot be compiled.
    """
    _check_expanded(function)
    if function.n_in() != 3 or function.n_out() != 2 or function.numel_in(0) != function.numel_out(0):
        raise ModelError(
            f"function {function.name()!r} is not a recurrence; it must take carry, row and constants, and return a "
            "carry of the same size and outputs."
        )
    return _scan(function.serialize(), target)


_scan = lru_cache(maxsize=64)(Scan)
