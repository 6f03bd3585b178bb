"""One function applied row after row: its results are what it starts the next row from."""

from __future__ import annotations

from functools import lru_cache
from threading import Lock
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError, SettingsError
from diransac.simulation.compiler.graph import Graph, read_graph
from diransac.simulation.compiler.lanes import arranged_lanes, run_time_loop
from diransac.simulation.compiler.machine_code import MachineCode, Target, compile_function

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from diransac.simulation.compiler.time_loop import LoopSpecification


__all__ = ["Scan", "compile_scan"]


class Scan:
    """A recurrence over rows, many lanes at once; made by `compile_scan`, compiled when first called.

    It is the time loop of a simulation: the carry is its state, the outputs are its signals, the rows are its inputs. A
    lane gives the same bits whatever the other lanes are, their number, and `threads`.
    """

    def __init__(self, serialized: str, target: Target | None) -> None:
        self._function = ca.Function.deserialize(serialized)
        self._target = target
        self._code: dict[bool, MachineCode] = {}
        self._lock = Lock()
        self._graph = _graph_of(self._function)  # refuses now what could not be compiled later

    def __call__(self, carry: ArrayLike, rows: ArrayLike, constants: ArrayLike, *, threads: int = 1) -> FloatArray:
        """Outputs of every lane and row.

        Parameters
        ----------
        carry : (n_lanes, n_c)   what each lane's first row starts from
        rows : (n_lanes, n_rows, n_r), or (n_rows, n_r) for all lanes alike
        constants : (n_lanes, n_k)   what a lane keeps for all its rows
        threads : how many blocks of lanes run at a time

        Returns
        -------
        (n_lanes, n_rows, n_o); NaN from the first row on in which an output of the lane is not finite

        Raises SettingsError: an array of another shape, or no row.
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
        from diransac.simulation.compiler.outputs import SignalOutput
        from diransac.simulation.compiler.time_loop import ARGUMENTS, emit_time_loop, inputs_from_log

        with self._lock:
            if windows not in self._code:
                module = emit_time_loop(self._specification(), SignalOutput, inputs_from_log, windows=windows)
                self._code[windows] = compile_function(module, "time_loop", ARGUMENTS.values(), self._target)
            return self._code[windows]

    def _specification(self) -> LoopSpecification:
        """The recurrence as a simulation that has no sub-steps and is compared with nothing."""
        from diransac.simulation.compiler.time_loop import LoopSpecification

        return LoopSpecification(
            step=self._graph,
            further_step=Graph((), ((),), ()),
            substeps=1,
            n_states=self._function.numel_in(0),
            n_inputs=self._function.numel_in(1),
            n_signals=self._function.numel_out(1),
            n_unknowns=0,
            scored=(),
            quaternions=(),
            state_quaternions=(),
        )


def compile_scan(function: ca.Function, target: Target | None = None) -> Scan:
    """Compiled form of a recurrence that is given as an SX function; the same one again for an equal function.

    Parameters
    ----------
    function : CasADi SX function (carry, row, constants) -> (carry for the next row, outputs); to know the last carry,
        let it be an output
    target : processor to compile for; this one by default

    Raises ModelError: another kind of function, or an operation that cannot be compiled.
    """
    if not function.is_a("SXFunction"):
        raise ModelError(f"function {function.name()!r} is not made of SX symbols; expand it: Function.expand().")
    if function.n_in() != 3 or function.n_out() != 2 or function.numel_in(0) != function.numel_out(0):
        raise ModelError(
            f"function {function.name()!r} is no recurrence; it must take carry, row and constants, and give a carry "
            "of the same size and outputs."
        )
    return _scan(function.serialize(), target)


@lru_cache(maxsize=64)
def _scan(serialized: str, target: Target | None) -> Scan:
    """Scan by value of what defines it."""
    return Scan(serialized, target)


def _graph_of(function: ca.Function) -> Graph:
    """Graph of the recurrence as the time loop takes it: with a Jacobian, which is empty."""
    arguments = [ca.SX.sym(function.name_in(k), function.sparsity_in(k)) for k in range(3)]
    whole = ca.Function(function.name(), arguments, [*function(*arguments), ca.SX(0, 0)])
    return read_graph(whole, (2,), reciprocals=True)
