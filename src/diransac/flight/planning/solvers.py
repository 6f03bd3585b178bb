"""Interior-point solution of a `Program` by IPOPT through CasADi, with the program's own derivatives.

An `nlpsol` object is built once per layout and serves every program of it: its functions read the program that is being
solved. They are passed through CasADi's function cache, so that nothing is differentiated a second time.

References: Waechter and Biegler 2006 (IPOPT).
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from threading import Lock
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray, IntArray
from diransac.flight.planning.transcription import Layout, Program

__all__ = ["TIME_LIMIT", "SearchLimits", "Solution", "Strategy", "interior_point"]

Strategy: TypeAlias = Literal["line search", "warm start", "full steps"]
"""``warm start``: the guess is close to the solution, the barrier starts small; ``full steps``: without line search."""

TIME_LIMIT = "time limit reached"


@dataclass(frozen=True)
class SearchLimits:
    """Limits of a search by one attempt after the other.

    Parameters
    ----------
    iterations : of one attempt
    seconds : of all of them together
    deadline : their end by the monotonic clock, s; by default that many seconds from now
    """

    iterations: int
    seconds: float
    deadline: float = field(default=0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "deadline", self.deadline or time.monotonic() + self.seconds)

    @property
    def left(self) -> float:
        """Time to the deadline, s."""
        return max(0.0, self.deadline - time.monotonic())


@dataclass(frozen=True)
class Solution:
    """Result of IPOPT.

    Parameters
    ----------
    unknowns : (n_unknowns,)   the last iterate
    success : whether that is a solution
    status : IPOPT's return status
    iterations : None where it does not report them
    """

    unknowns: FloatArray
    success: bool
    status: str
    iterations: int | None

    @property
    def summary(self) -> str:
        """Status and iterations in words."""
        count = "" if self.iterations is None else f" after {self.iterations} iterations"
        return f"ipopt says {self.status}{count}"


def interior_point(
    program: Program, guess: FloatArray, limits: SearchLimits, strategy: Strategy = "line search"
) -> Solution:
    """Solution by IPOPT from a first iterate (n_unknowns,).  Raises KeyboardInterrupt: the user stopped it."""
    return _solver(program.layout, limits.iterations, strategy).solve(program, guess, limits.deadline)


@lru_cache(maxsize=64)
def _solver(layout: Layout, iterations: int, strategy: Strategy) -> _Solver:
    return _Solver(layout, iterations, strategy)


@contextmanager
def _interrupts_noted() -> Iterator[list[int]]:
    """Interrupts (Ctrl-C) during the block, recorded in place of an exception, which CasADi may swallow."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # interrupts come to the main thread alone
        yield noted
        return
    before = signal.getsignal(signal.SIGINT)
    if before in (None, signal.SIG_IGN):  # not Python's to handle, or ignored, as in a background job of a shell
        yield noted
        return
    signal.signal(signal.SIGINT, lambda number, _frame: noted.append(number))
    try:
        yield noted
    finally:
        signal.signal(signal.SIGINT, before)


class _Stopped(Exception):
    """The search is stopped, for the reason given."""


class _Solver:
    """`nlpsol` object of one layout, for one solve at a time."""

    def __init__(self, layout: Layout, iterations: int, strategy: Strategy) -> None:
        self._layout, self._options = layout, _options(iterations, strategy)
        self._lock = Lock()
        self._program: Program | None = None
        self._nlpsol: ca.Function | None = None
        self._functions: dict[str, _Evaluation] = {}
        self._deadline = 0.0
        self._stopped: BaseException | None = None
        self._interrupts: list[int] = []

    def solve(self, program: Program, guess: FloatArray, deadline: float) -> Solution:
        """Solution of one program of this layout."""
        with self._lock:
            self._program, self._stopped, self._deadline = program, None, deadline
            try:
                return self._run(program, guess)
            finally:
                self._program = self._stopped = None

    def _run(self, program: Program, guess: FloatArray) -> Solution:
        if self._nlpsol is None:
            self._build(program)
        assert self._nlpsol is not None
        numbers = program.numbers
        with _interrupts_noted() as self._interrupts:
            try:
                found = self._nlpsol(x0=guess, lbx=numbers.lower, ubx=numbers.upper, lbg=0.0, ubg=0.0)
            except RuntimeError:
                if self._stopped is None:
                    raise
        if self._interrupts:
            raise KeyboardInterrupt
        if isinstance(self._stopped, _Stopped):
            return Solution(guess, False, str(self._stopped), None)
        if self._stopped is not None:
            raise self._stopped
        stats, unknowns = self._nlpsol.stats(), np.array(found["x"]).ravel()
        success = bool(stats["success"]) and bool(np.isfinite(unknowns).all())
        return Solution(unknowns, success, str(stats["return_status"]), int(stats["iter_count"]))

    def _build(self, program: Program) -> None:
        structure = _Structure(program)
        self._functions = {name: _Evaluation(name, results, structure, self._values) for name, results in _RESULTS}
        nlp, cache = self._functions["nlp"], {name: x for name, x in self._functions.items() if name != "nlp"}
        self._nlpsol = ca.nlpsol("plan", "ipopt", nlp, {**self._options, "cache": cache})

    def _values(self, name: str, x: FloatArray, objective_factor: float, multipliers: FloatArray) -> FloatArray:
        """One of `_COMPUTE` at a point.

        Raises whatever stopped the search: from then on no function has a value, which ends it.
        """
        if self._stopped is None and self._interrupts:
            self._stopped = KeyboardInterrupt()
        if self._stopped is None and time.monotonic() > self._deadline:
            self._stopped = _Stopped(TIME_LIMIT)
        if self._stopped is not None:
            raise self._stopped
        assert self._program is not None
        try:
            return np.asarray(_COMPUTE[name](self._program, x, objective_factor, multipliers))
        except BaseException as error:  # an interrupt too: solvers print or hide what is raised in them
            self._stopped = error
            raise


class _Structure:
    """Sparsity of each function of a program, and the order of its entries."""

    def __init__(self, program: Program) -> None:
        n, m = program.layout.n_unknowns, program.layout.n_constraints
        self.n_unknowns, self.n_constraints = n, m
        (rows, columns), (upper, right) = program.jacobian_entries, program.hessian_entries
        self.parts: dict[str, tuple[ca.Sparsity, IntArray]] = {
            "f": _column(1),
            "g": _column(m),
            "grad_f_x": _column(n),
            "grad_gamma_x": _column(n),
            "grad_gamma_p": _column(0),
            "jac_g_x": _sorted((rows, columns), (m, n)),
            "triu_hess_gamma_x_x": _sorted((upper, right), (n, n)),
        }


_COMPUTE: Mapping[str, Callable[[Program, FloatArray, float, FloatArray], Any]] = {
    "f": lambda program, x, _factor, _multipliers: [program.objective(x)],
    "g": lambda program, x, _factor, _multipliers: program.constraints(x),
    "grad_f_x": lambda program, x, _factor, _multipliers: program.gradient(x),
    "jac_g_x": lambda program, x, _factor, _multipliers: program.jacobian(x),
    "triu_hess_gamma_x_x": Program.hessian,
}
"""Functions by CasADi's names: (program, unknowns, objective's factor, multipliers) -> entries."""

_RESULTS = (
    ("nlp", ("f", "g")),
    ("nlp_f", ("f",)),
    ("nlp_g", ("g",)),
    ("nlp_grad_f", ("f", "grad_f_x")),
    ("nlp_jac_g", ("g", "jac_g_x")),
    ("nlp_hess_l", ("triu_hess_gamma_x_x",)),
    ("nlp_grad", ("f", "g", "grad_gamma_x", "grad_gamma_p")),
)
"""Functions that IPOPT calls, and the results of each; CasADi's names decide which take multipliers."""


class _Evaluation(ca.Callback):
    """CasADi callback of a program: (x, p, lam_f, lam_g) or (x, p) -> some of `_COMPUTE`."""

    def __init__(
        self, name: str, results: tuple[str, ...], structure: _Structure, values: Callable[..., FloatArray]
    ) -> None:
        ca.Callback.__init__(self)
        self._results, self._structure, self._values = results, structure, values
        weighted = name in ("nlp_hess_l", "nlp_grad")
        sizes = {"x": structure.n_unknowns, "p": 0}
        if weighted:
            sizes |= {"lam_f": 1, "lam_g": structure.n_constraints}
        self._sizes = sizes
        # CasADi computes multipliers even of a stopped search, and warns where it cannot; they are not used.
        self._unread = name == "nlp_grad"
        self.construct(name, {})

    def get_n_in(self) -> int:
        return len(self._sizes)

    def get_n_out(self) -> int:
        return len(self._results)

    def get_name_in(self, i: int) -> str:
        return list(self._sizes)[i]

    def get_name_out(self, i: int) -> str:
        return self._results[i]

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(list(self._sizes.values())[i], 1)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        return self._structure.parts[self._results[i]][0]

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        """Fill the buffers; return 1 if there is no value."""
        wanted = [(name, np.frombuffer(b)) for name, b in zip(self._results, results, strict=True) if b is not None]
        if self._unread:
            for _, buffer in wanted:
                buffer[:] = 0.0
            return 0
        sizes = self._sizes.values()
        given = [np.zeros(n) if a is None else np.frombuffer(a) for a, n in zip(arguments, sizes, strict=True)]
        factor, multipliers = (float(given[2][0]), given[3]) if len(given) > 2 else (0.0, np.zeros(0))
        try:
            # Derivatives stand last and are computed first; values are by-products of them.
            for name, buffer in reversed(wanted):
                values = self._values(name, given[0], factor, multipliers)
                values.take(self._structure.parts[name][1], out=buffer, mode="clip")
        except BaseException:  # noqa: BLE001 - CasADi would print it; `_run` raises it
            return 1
        return 0


def _column(n: int) -> tuple[ca.Sparsity, IntArray]:
    """Sparsity of a dense column, and the order of its entries."""
    return ca.Sparsity.dense(n, 1), np.arange(n)


def _sorted(entries: tuple[IntArray, IntArray], shape: tuple[int, int]) -> tuple[ca.Sparsity, IntArray]:
    """Column-compressed sparsity of entries, and their order in it."""
    rows, columns = entries
    order = np.lexsort((rows, columns))
    starts = np.searchsorted(columns[order], np.arange(shape[1] + 1))
    return ca.Sparsity(*shape, starts.tolist(), rows[order].tolist()), order


def _options(iterations: int, strategy: Strategy) -> dict[str, Any]:
    options = {"print_level": 0, "sb": "yes", "bound_relax_factor": 0.0, "max_iter": iterations, "tol": 1e-9}
    options["option_file_name"] = ""  # else ipopt.opt of the working directory is read, which may load a library
    if strategy == "warm start":
        options |= {"mu_init": 1e-4, "bound_push": 1e-6, "bound_frac": 1e-6}
    if strategy == "full steps":
        options |= {"accept_every_trial_step": "yes", "mu_init": 1e-3}
    return {"print_time": False, "error_on_fail": False, "show_eval_warnings": False, "ipopt": options}
