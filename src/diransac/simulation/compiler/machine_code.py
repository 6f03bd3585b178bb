"""Machine code from LLVM's intermediate representation or from the cache, run on several threads."""

from __future__ import annotations

import ctypes
import os
import time
from collections import deque
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from itertools import pairwise
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from diransac.errors import SettingsError
from diransac.simulation.compiler.code_cache import CodeCache, hashed

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence
    from concurrent.futures import ThreadPoolExecutor

LANES = 8
"""Lanes of a vector, on every processor: results do not depend on the width of its registers."""

_PATIENCE = 0.2
"""Longest time, s, for which signals are not noticed, where the work can be interrupted."""

_MOMENT = 3e-4
"""Time, s, after which a loop is shared among threads: to wake them takes a third of it."""

LLVM: TypeAlias = Any
"""An object of llvmlite, which has no type annotations."""


@dataclass(frozen=True)
class Target:
    """A processor to generate code for.

    Attributes
    ----------
    cpu : LLVM's name of it
    features : LLVM's list of its features, such as `+avx2,-avx512f`
    """

    cpu: str
    features: str = ""

    @staticmethod
    @cache
    def host() -> Target:
        """Return the processor of this process, with its full register width."""
        binding = _binding()
        features = binding.get_host_cpu_features()
        if "avx512f" in features:
            features["prefer-256-bit"] = False
        return Target(binding.get_host_cpu_name(), features.flatten())


@dataclass(frozen=True)
class MachineCode:
    """A compiled function; it can be called as long as this object lives.

    Attributes
    ----------
    call : takes the arguments of its signature; releases Python's lock while it runs
    engine : owns the memory
    """

    call: Callable[..., None]
    engine: LLVM


@dataclass(frozen=True)
class Part:
    """A function in a module of its own.

    Attributes
    ----------
    emit : returns the llvmlite `ir.Module`; called only if the code is not in the cache
    definition : texts that, with the sources of this package, determine the module
    name : the function
    """

    emit: Callable[[], LLVM]
    definition: Iterable[str]
    name: str


@cache
def _binding() -> LLVM:
    """LLVM, set up for this processor; loaded when first asked for."""
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


def compile_function(
    emit: Callable[[], LLVM],
    definition: Iterable[str],
    name: str,
    signature: Collection[str],
    target: Target | None = None,
    parts: Sequence[Part] = (),
) -> MachineCode:
    """Machine code of one function of an LLVM module, from the cache if it is there.

    Parameters
    ----------
    emit : returns the llvmlite `ir.Module`; called only if the code is not in the cache
    definition : texts that, with the sources of this package, determine the module
    name : the function
    signature : kind of each argument, `pointer`, `integer` (64 bits) or `number` (float64)
    target : processor to compile for; this one by default
    parts : functions of other modules that the module declares and calls
    """
    binding, machine = _binding(), _machine(target or Target.host())
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    for part in (*parts, Part(emit, definition, name)):
        code = _object_code(part.emit, _key(target or Target.host(), part.name, part.definition), machine)
        engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    kinds = {"pointer": ctypes.c_void_p, "integer": ctypes.c_int64, "number": ctypes.c_double}
    prototype = ctypes.CFUNCTYPE(None, *(kinds[kind] for kind in signature))
    return MachineCode(prototype(engine.get_function_address(name)), engine)


def signature(n_arrays: int, n_integers: int) -> list[str]:
    """Kinds of the arguments of a function of arrays and then of integers."""
    return ["pointer"] * n_arrays + ["integer"] * n_integers


def _machine(target: Target) -> LLVM:
    """LLVM's code generator for a processor."""
    triple = _binding().Target.from_default_triple()
    # LLVM's level of code generation. From 2 on, instructions are scheduled again after registers are allocated,
    # in a time quadratic in the length of a block: up to 1.7 times the compilation, for the same bits and no
    # measurable speed.
    return triple.create_target_machine(cpu=target.cpu, features=target.features, opt=1)


def _object_code(emit: Callable[[], LLVM], key: str, machine: LLVM) -> bytes:
    """Object file of a module, from the cache or compiled and kept there."""
    cache = CodeCache.of_user()
    if cache is not None and (kept := cache.read(key)) is not None:
        return kept
    code = _awaited(_compiled, str(emit()), machine)
    if cache is not None:
        cache.write(key, code)
    return code


def _compiled(assembly: str, machine: LLVM) -> bytes:
    """Object file of a module in LLVM's intermediate representation."""
    parsed = _binding().parse_assembly(assembly)
    _optimise(parsed, machine)
    return bytes(machine.emit_object(parsed))


def _awaited(work: Callable[..., bytes], *arguments: Any) -> bytes:
    """Result of work that runs in a thread of its own, as no signal reaches a thread in LLVM: Ctrl-C ends the wait."""
    from concurrent.futures import ThreadPoolExecutor, wait

    pool = ThreadPoolExecutor(1, thread_name_prefix="diransac LLVM")
    future = pool.submit(work, *arguments)
    pool.shutdown(wait=False)
    while not wait([future], _PATIENCE).done:
        pass
    return future.result()


def _key(target: Target, name: str, definition: Iterable[str]) -> str:
    """Key of a function's machine code: what it is compiled from, by what, and for which processor."""
    binding = _binding()
    settings = (binding.get_default_triple(), target.cpu, target.features, name)
    return hashed([*_versions(), *settings, *definition])


@cache
def _versions() -> tuple[str, ...]:
    """Versions of what emits and compiles code: the libraries, and the sources of this package."""
    import casadi as ca
    import llvmlite

    llvm = ".".join(str(number) for number in _binding().llvm_version_info)
    sources = sorted(Path(__file__).parents[1].rglob("*.py"))
    return (llvmlite.__version__, llvm, ca.CasadiMeta.version(), hashed(path.read_text("utf-8") for path in sources))


def _optimise(module: LLVM, machine: LLVM) -> None:
    """Run optimisation passes over a parsed module."""
    binding = _binding()
    builder = binding.create_pass_builder(machine, binding.create_pipeline_tuning_options())
    passes = binding.create_new_function_pass_manager()
    # Variables into registers, tidying. LLVM's default list takes 3 times as long, for no gain.
    passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.add_loop_rotate_pass()
    for function in module.functions:
        if not function.is_declaration:
            passes.run(function, builder)


def default_threads() -> int:
    """Default number of threads: `DIRANSAC_THREADS`, else one in a worker process, else all available cores.

    A process pool has one worker per core already; set the variable where workers are started in other ways.

    Raises
    ------
    SettingsError
        The variable is not a positive whole number.
    """
    asked = os.environ.get("DIRANSAC_THREADS", "")
    if asked:
        # Of a number of threads.
        if not asked.isdecimal() or len(asked) > 6 or int(asked) < 1:
            raise SettingsError(f"DIRANSAC_THREADS is {asked!r:.40}; give a positive whole number, or unset it.")
        return int(asked)
    from multiprocessing import parent_process

    if parent_process() is not None:
        return 1
    # The cores that this process may use; not every system has the call.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_blocks(call: Callable[..., None], arguments: Sequence[Any], n_blocks: int, threads: int) -> None:
    """Call a compiled loop for blocks 0 .. n_blocks - 1; what is left after a moment is shared among threads.

    The loop is left between two blocks after Ctrl-C, which reaches Python only there.

    Raises SettingsError: fewer than one thread.
    """
    if threads < 1:
        raise SettingsError(f"threads is {threads}, but at least 1 has to run.")
    loop, stopped = partial(call, *arguments), Event()
    moment = time.monotonic() + _MOMENT if threads > 1 else np.inf
    first = _run_some(loop, 0, n_blocks, stopped, moment)
    if first == n_blocks:
        return
    from concurrent.futures import Future, wait

    edges = np.linspace(first, n_blocks, min(n_blocks - first, threads * 4) + 1).astype(int).tolist()
    parts, others = deque(pairwise(edges)), list[Future[None]]()
    try:
        for _ in range(min(threads, len(parts)) - 1):
            others.append(_pool(os.getpid(), threads - 1).submit(_run_parts, loop, parts, stopped))
        _run_parts(loop, parts, stopped)
        for other in others:
            if not other.cancel():  # it has begun
                other.result()
    finally:  # the loop's arrays live as long as this call
        stopped.set()
        wait([other for other in others if not other.cancel()])


def _run_parts(loop: Callable[[int, int], None], parts: deque[tuple[int, int]], stopped: Event) -> None:
    """Take parts of a loop and run them until none is left."""
    while True:
        try:
            first, end = parts.popleft()
        except IndexError:
            return
        _run_some(loop, first, end, stopped)


def _run_some(loop: Callable[[int, int], None], first: int, end: int, stopped: Event, moment: float = np.inf) -> int:
    """First of the blocks first .. end - 1 that is left when a loop has run until it is stopped or some moment.

    It is called for some blocks at a time, for a part of a second at most.
    """
    at_a_time = max(1, min(8, (end - first) // 16))
    while first < end and not stopped.is_set() and (begin := time.monotonic()) < moment:
        last = min(first + at_a_time, end)
        loop(first, last)
        first = last
        at_a_time = 2 * at_a_time if time.monotonic() - begin < 0.5 * _PATIENCE else at_a_time
    return first


@lru_cache(maxsize=4)
def _pool(_process: int, threads: int) -> ThreadPoolExecutor:
    """Threads of this process, made when first needed; a forked process makes its own."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(threads, thread_name_prefix="diransac")
