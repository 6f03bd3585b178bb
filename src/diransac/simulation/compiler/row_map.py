"""One function evaluated over many rows."""

from __future__ import annotations

from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError, SettingsError
from diransac.simulation.compiler.graph import read_graph
from diransac.simulation.compiler.machine_code import LANES, MachineCode, Target, compile_function, run_blocks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike


__all__ = ["Map", "compile_map"]


class Map:
    """An SX function over many rows; made by `compile_map`, compiled when first called."""

    def __init__(self, serialized: str, target: Target | None) -> None:
        self._function = ca.Function.deserialize(serialized)
        self._target = target
        self._code: dict[tuple[bool, ...], MachineCode] = {}
        self._lock = Lock()
        read_graph(self._function)  # refuses now what could not be compiled later

    def __call__(self, *arrays: ArrayLike, threads: int = 1) -> tuple[FloatArray, ...]:
        """Evaluate the function in every row.

        Parameters
        ----------
        arrays : (n_rows, n_i) each, n_i the number of elements of input i, column by column; or (n_i,), the same for
            all rows
        threads : how many blocks of rows run at a time

        Returns
        -------
        (n_rows, n_o) for each output, structural zeros included; n_rows is 1 if every input is shared

        Raises SettingsError: an array of another shape.
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
        from diransac.simulation.compiler.map_loop import emit_map_loop, map_signature

        with self._lock:
            if shared not in self._code:
                function = self._function
                graph = read_graph(function, [k for k, fixed in enumerate(shared) if fixed])
                module = emit_map_loop(graph, [function.numel_in(k) for k in range(function.n_in())])
                signature = map_signature(function.n_in() + function.n_out())
                self._code[shared] = compile_function(module, "map_loop", signature, self._target)
            return self._code[shared]


def compile_map(function: ca.Function, target: Target | None = None) -> Map:
    """Compiled form of an SX function that evaluates it over many rows; the same one again for an equal function.

    Parameters
    ----------
    function : CasADi SX function
    target : processor to compile for; this one by default

    Raises ModelError: an operation that cannot be compiled.
    """
    if not function.is_a("SXFunction"):
        raise ModelError(f"function {function.name()!r} is not made of SX symbols; expand it: Function.expand().")
    return _map(function.serialize(), target)


@lru_cache(maxsize=64)
def _map(serialized: str, target: Target | None) -> Map:
    """Map by value of what defines it."""
    return Map(serialized, target)
