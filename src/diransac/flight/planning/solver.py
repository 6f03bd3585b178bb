"""Interior-point solution of a `Program` by IPOPT through CasADi, with the program's own derivatives.

The functions are passed through CasADi's function cache, so that nothing is differentiated a second time.

References: Waechter and Biegler 2006 (IPOPT).
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.flight.planning.transcription import Program

Start: TypeAlias = Literal["cold", "warm"]
"""``warm``: the guess is close to the solution, and the barrier starts small."""

TIME_LIMIT = "time limit reached"

_STARTS: dict[Start, dict[str, Any]] = {
    "cold": {},
    "warm": {"mu_init": 1e-4, "bound_push": 1e-6, "bound_frac": 1e-6},
}


@dataclass(frozen=True)
class Solution:
    """Result of IPOPT.

    Parameters
    ----------
    unknowns : (n_unknowns,)   the last iterate
    success : whether that is a solution
    summary : return status and iterations in words; `TIME_LIMIT` at the deadline
    """

    unknowns: FloatArray
    success: bool
    summary: str


class _OutOfTime(Exception):
    """The deadline has passed."""


def interior_point(
    program: Program, guess: FloatArray, iterations: int, deadline: float, start: Start = "cold"
) -> Solution:
    """Solution by IPOPT from a first iterate (n_unknowns,), until a deadline by the monotonic clock, s.

    Raises KeyboardInterrupt: the user stopped it.  Raises whatever a function of the program raises.
    """
    search = _Functions(program, deadline)
    # Without a file of options; the default, ipopt.opt of the working directory, may load a library.
    fixed = {"print_level": 0, "sb": "yes", "bound_relax_factor": 0.0, "tol": 1e-9, "option_file_name": ""}
    # Parameters far from plausible ones, such as an inertia of a fiftieth of the true one, make the constraints so
    # curved that line searches stall: the fifth shorter step is taken whatever it brings. With three, turns of a body
    # end in poor optima.
    line_search = {"accept_after_max_steps": 5}
    options: dict[str, Any] = {
        "print_time": False,
        "error_on_fail": False,
        "show_eval_warnings": False,
        "no_nlp_grad": True,
        "calc_lam_p": False,
        "cache": search.functions,
        "ipopt": {**fixed, **line_search, **_STARTS[start], "max_iter": iterations},
    }
    solver = ca.nlpsol("plan", "ipopt", search.functions["nlp"], options)
    with _interrupts_noted() as search.interrupts:
        try:
            found = solver(x0=guess, lbx=program.lower, ubx=program.upper, lbg=0.0, ubg=0.0)
        except RuntimeError:
            if search.stopped is None:
                raise
    if search.interrupts:
        raise KeyboardInterrupt
    if isinstance(search.stopped, _OutOfTime):
        return Solution(guess, False, TIME_LIMIT)
    if search.stopped is not None:
        raise search.stopped
    stats, unknowns = solver.stats(), np.array(found["x"]).ravel()
    success = bool(stats["success"]) and bool(np.isfinite(unknowns).all())
    return Solution(unknowns, success, f"ipopt says {stats['return_status']} after {stats['iter_count']} iterations")


@contextmanager
def _interrupts_noted() -> Iterator[list[int]]:
    """Interrupts (Ctrl-C) during the block, recorded in place of an exception, which CasADi may swallow."""
    noted: list[int] = []
    # Interrupts come to the main thread alone; None is a handler that is not Python's, SIG_IGN a background job's.
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (None, signal.SIG_IGN):
        yield noted
        return
    signal.signal(signal.SIGINT, lambda number, _frame: noted.append(number))
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


class _Functions:
    """Functions of a program for CasADi by its names, and what stops their evaluation."""

    def __init__(self, program: Program, deadline: float) -> None:
        n, m = program.n_unknowns, program.n_constraints
        self.deadline, self.interrupts = deadline, list[int]()
        self.stopped: BaseException | None = None
        jacobian, hessian = (
            _compressed((columns * height + rows).tobytes(), (height, n))
            for (rows, columns), height in ((program.jacobian_entries, m), (program.hessian_entries, n))
        )
        f = _Result("f", ca.Sparsity.dense(1, 1), lambda x: program.objective(x))
        g = _Result("g", ca.Sparsity.dense(m, 1), lambda x: program.constraints(x))
        slope = _Result("grad_f_x", ca.Sparsity.dense(n, 1), lambda x: program.gradient(x))
        slopes = _Result("jac_g_x", jacobian[0], lambda x: _summed(program.jacobian(x), jacobian[1]))
        curvature = _Result(
            "triu_hess_gamma_x_x",
            hessian[0],
            lambda x, factor, weights: _summed(program.hessian(x, float(factor[0]), weights), hessian[1]),
        )
        at, weighted = {"x": n, "p": 0}, {"x": n, "p": 0, "lam_f": 1, "lam_g": m}
        # Derivatives stand last and are computed first: values are by-products of them.
        self.functions = {
            "nlp": _Evaluation("nlp", at, [f, g], self),
            "nlp_f": _Evaluation("nlp_f", at, [f], self),
            "nlp_g": _Evaluation("nlp_g", at, [g], self),
            "nlp_grad_f": _Evaluation("nlp_grad_f", at, [f, slope], self),
            "nlp_jac_g": _Evaluation("nlp_jac_g", at, [g, slopes], self),
            "nlp_hess_l": _Evaluation("nlp_hess_l", weighted, [curvature], self),
        }

    def check(self) -> None:
        """Raise whatever stopped the search: from then on no function has a value, which ends it."""
        if self.stopped is None and self.interrupts:
            self.stopped = KeyboardInterrupt()
        if self.stopped is None and time.monotonic() > self.deadline:
            self.stopped = _OutOfTime()
        if self.stopped is not None:
            raise self.stopped


@dataclass(frozen=True)
class _Result:
    """Result of a function: CasADi's name, sparsity, and nonzeros from the unknowns and multipliers."""

    name: str
    sparsity: ca.Sparsity
    values: Callable[..., float | FloatArray]


class _Evaluation(ca.Callback):
    """CasADi callback that fills its buffers with some results of a program."""

    def __init__(self, name: str, sizes: dict[str, int], results: list[_Result], search: _Functions) -> None:
        ca.Callback.__init__(self)
        self._sizes, self._results, self._search = sizes, results, search
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._sizes)

    def get_n_out(self) -> int:
        return len(self._results)

    def get_name_in(self, i: int) -> str:
        return list(self._sizes)[i]

    def get_name_out(self, i: int) -> str:
        return self._results[i].name

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(list(self._sizes.values())[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._results[i].sparsity

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        """Fill the buffers; return 1 if there is no value."""
        sizes = self._sizes.values()
        x, _, *of = [np.zeros(n) if a is None else np.frombuffer(a) for a, n in zip(arguments, sizes, strict=True)]
        try:
            for result, buffer in reversed(list(zip(self._results, results, strict=True))):
                if buffer is not None:
                    self._search.check()
                    np.frombuffer(buffer)[:] = result.values(x, *of)
        except BaseException as error:  # noqa: BLE001 - an interrupt too: CasADi would print it; raised after the search
            self._search.stopped = self._search.stopped or error
            return 1
        return 0


@lru_cache(maxsize=64)
def _compressed(entries: bytes, shape: tuple[int, int]) -> tuple[ca.Sparsity, IntArray]:
    """Column-compressed sparsity of entries at places in column order, and the nonzero of each.

    Plans of a study share it.
    """
    places, position = np.unique(np.frombuffer(entries, np.int64), return_inverse=True)
    starts = np.searchsorted(places // shape[0], np.arange(shape[1] + 1))
    return ca.Sparsity(*shape, starts.tolist(), (places % shape[0]).tolist()), position


def _summed(entries: FloatArray, position: IntArray) -> FloatArray:
    """Nonzeros: the sums of the entries of each place."""
    return np.bincount(position, entries).astype(np.float64)
