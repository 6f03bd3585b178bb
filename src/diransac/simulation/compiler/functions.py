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
from diransac.simulation.compiler.lanes import ARGUMENTS, arranged_lanes, map_signature, run_time_loop
from diransac.simulation.compiler.machine_code import LANES, MachineCode, Target, compile_function, run_blocks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from diransac.simulation.compiler.time_loop import LoopSpecification
    from diransac.simulation.compiler.vectors import Value


__all__ = ["Map", "Scan", "compile_map", "compile_scan"]


class Map:
    """An SX function over many rows; made by `compile_map`, compiled when first called."""

    def __init__(self, serialized: str, target: Target | None) -> None:
        self._function, self._serialized = ca.Function.deserialize(serialized), serialized
        self._target = target
        self._code: dict[tuple[bool, ...], MachineCode] = {}
        self._lock = Lock()
        check_compilable(self._function)

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
        inputs, n_rows = self._checked(arrays)
        shared = tuple(array.ndim == 1 for array in inputs)
        outputs = tuple(np.empty((n_rows, self._function.numel_out(k))) for k in range(self._function.n_out()))
        if n_rows:
            pointers = [array.ctypes.data for array in (*inputs, *outputs)]
            run_blocks(self._compiled(shared).call, [*pointers, n_rows], -(-n_rows // LANES), threads)
        return outputs

    def _checked(self, arrays: Sequence[ArrayLike]) -> tuple[list[FloatArray], int]:
        """Contiguous arrays, and their common number of rows."""
        function = self._function
        if len(arrays) != function.n_in():
            raise SettingsError(f"function {function.name()!r} takes {function.n_in()} arrays; found {len(arrays)}.")
        inputs = [np.ascontiguousarray(array, np.float64) for array in arrays]
        lengths = {len(array) for array in inputs if array.ndim == 2}
        widths = [function.numel_in(k) for k in range(function.n_in())]
        fits = all(array.ndim in (1, 2) and array.shape[-1] == n for array, n in zip(inputs, widths, strict=True))
        if not fits or len(lengths) > 1:
            raise SettingsError(
                f"function {function.name()!r} takes arrays (n_rows, n) or (n,) with n = {widths} and one n_rows; "
                f"found {[array.shape for array in inputs]}."
            )
        return inputs, lengths.pop() if lengths else 1

    def _compiled(self, shared: tuple[bool, ...]) -> MachineCode:
        """Machine code for inputs some of which are shared by all rows."""
        function, definition = self._function, ("map", self._serialized, repr(shared))

        def emit() -> Value:
            from diransac.simulation.compiler.operations import emit_map_loop

            graph = read_graph(function, [k for k, fixed in enumerate(shared) if fixed])
            return emit_map_loop(graph, [function.numel_in(k) for k in range(function.n_in())])

        with self._lock:
            if shared not in self._code:
                signature = map_signature(function.n_in() + function.n_out())
                self._code[shared] = compile_function(emit, definition, "map_loop", signature, self._target)
            return self._code[shared]


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
    if not function.is_a("SXFunction"):
        raise ModelError(f"function {function.name()!r} is not made of SX symbols; expand it: Function.expand().")
    return _map(function.serialize(), target)


@lru_cache(maxsize=64)
def _map(serialized: str, target: Target | None) -> Map:
    """Map by value of what defines it."""
    return Map(serialized, target)


class Scan:
    """A recurrence over rows, many lanes at once; made by `compile_scan`, compiled when first called.

    It runs in the time loop of a simulation, with the carry as state, the outputs as signals and the rows as inputs.
    The results of a lane depend neither on the other lanes, nor on their number, nor on `threads`.
    """

    def __init__(self, serialized: str, target: Target | None) -> None:
        self._function, self._serialized = ca.Function.deserialize(serialized), serialized
        self._target = target
        self._code: dict[bool, MachineCode] = {}
        self._lock = Lock()
        check_compilable(self._function)

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
        n_c, n_r, n_k = (self._function.numel_in(k) for k in range(3))
        n_lanes, n_rows = len(start) if start.ndim else 0, row.shape[-2] if row.ndim > 1 else 0
        fits = start.shape == (n_lanes, n_c) and constant.shape == (n_lanes, n_k) and n_rows > 0
        if not fits or row.shape not in ((n_rows, n_r), (n_lanes, n_rows, n_r)):
            raise SettingsError(
                f"function {self._function.name()!r} takes carry (n_lanes, {n_c}), rows (n_lanes, n_rows, {n_r}) or "
                f"(n_rows, {n_r}) with at least one row, and constants (n_lanes, {n_k}); found {start.shape}, "
                f"{row.shape} and {constant.shape}."
            )
        series = np.empty((n_lanes, n_rows, self._function.numel_out(1)))
        if not n_lanes:
            return series
        own = np.arange(n_lanes) * n_rows if row.ndim == 3 and n_lanes > 1 else None
        lanes = arranged_lanes((n_k, n_c, n_r), constant, start, row.reshape(-1, n_r), own, n_rows)
        run_time_loop(self._compiled(lanes.has_windows), lanes, {"series": series}, threads)
        return series

    def _compiled(self, windows: bool) -> MachineCode:
        """Machine code for lanes with rows of their own, or with the same ones."""

        def emit() -> Value:
            from diransac.simulation.compiler.outputs import SignalOutput
            from diransac.simulation.compiler.time_loop import emit_time_loop, inputs_from_log

            return emit_time_loop(self._specification(), SignalOutput, inputs_from_log, windows=windows)

        definition = ("scan", self._serialized, repr(windows))
        with self._lock:
            if windows not in self._code:
                code = compile_function(emit, definition, "time_loop", ARGUMENTS.values(), self._target)
                self._code[windows] = code
            return self._code[windows]

    def _specification(self) -> LoopSpecification:
        """The recurrence as a simulation without sub-steps and without scored signals."""
        from diransac.simulation.compiler.time_loop import LoopSpecification

        return LoopSpecification(
            step=read_graph(self._function, (2,), reciprocals=True),
            substeps=1,
            n_states=self._function.numel_in(0),
            n_inputs=self._function.numel_in(1),
            n_signals=self._function.numel_out(1),
            scored=(),
            quaternions=(),
            state_quaternions=(),
        )


def compile_scan(function: ca.Function, target: Target | None = None) -> Scan:
    """Compiled recurrence of an SX function; the same object again for an equal function.

    Parameters
    ----------
    function : casadi.Function
        SX function (carry, row, constants) -> (carry of the next row, outputs). The last carry is returned only if it
        is among the outputs.
    target : Target, optional
        Processor to compile for; this one by default.

    Raises
    ------
    ModelError
        The function is not a recurrence, or an operation cannot be compiled.
    """
    if not function.is_a("SXFunction"):
        raise ModelError(f"function {function.name()!r} is not made of SX symbols; expand it: Function.expand().")
    if function.n_in() != 3 or function.n_out() != 2 or function.numel_in(0) != function.numel_out(0):
        raise ModelError(
            f"function {function.name()!r} is not a recurrence; it must take carry, row and constants, and return a "
            "carry of the same size and outputs."
        )
    return _scan(function.serialize(), target)


@lru_cache(maxsize=64)
def _scan(serialized: str, target: Target | None) -> Scan:
    """Scan by value of what defines it."""
    return Scan(serialized, target)
