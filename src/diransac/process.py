"""Settings that belong to the whole process, for the time of some work: threads of linear algebra, kept memory, the
module path of processes that it starts.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
import threading
from collections.abc import Callable, Iterator
from functools import lru_cache

from threadpoolctl import ThreadpoolController

_HUGE_PAGE = 2 << 20
_AHEAD = 64 << 20
"""Bytes of kept memory that the system clears in huge pages: in a fifth of the time."""


def end_with_parent() -> None:
    """End this process once its parent has ended, also where that was killed."""
    from multiprocessing import parent_process

    parent = parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


class _Setting:
    """Context in which a setting of the process holds; the last context to end undoes it, whichever began.

    Threads that each restored their own earlier value would restore each other's.
    """

    def __init__(self, begin: Callable[[], Callable[[], object]]) -> None:
        self._begin, self._lock, self._n_contexts = begin, threading.Lock(), 0
        self._undo: Callable[[], object] = _nothing

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """A context with the setting."""
        with self._lock:
            if not self._n_contexts:
                self._undo = self._begin()
            self._n_contexts += 1
        try:
            yield
        finally:
            with self._lock:
                self._n_contexts -= 1
                if not self._n_contexts:
                    self._undo()


def _nothing() -> None:
    """Undo nothing."""


@lru_cache(maxsize=1)
def _thread_pools(_n_modules: int) -> ThreadpoolController:
    """The thread pools of the loaded libraries: searched for, in milliseconds, once for the modules there are."""
    return ThreadpoolController()


def _one_blas_thread() -> Callable[[], object]:
    limited = _thread_pools(len(sys.modules)).limit(limits=1, user_api="blas")
    undo: Callable[[], object] = limited.restore_original_limits
    return undo


def _freed_memory_kept() -> Callable[[], object]:
    chosen = any(name == "GLIBC_TUNABLES" or name.startswith("MALLOC_") for name in os.environ)
    if sys.platform != "linux" or chosen:
        return _nothing
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):
        return _nothing
    trim_threshold, mmap_threshold, mmap_max = -1, -3, -4  # options of mallopt(3)
    libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    libc.madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]

    def undo() -> None:
        largest = 32 << 20  # threshold of a mapping that the allocator itself would choose
        libc.mallopt(mmap_max, 65536)  # its default
        libc.mallopt(mmap_threshold, largest)
        libc.mallopt(trim_threshold, 2 * largest)
        libc.malloc_trim(0)

    libc.mallopt(mmap_max, 0)
    libc.mallopt(trim_threshold, -1)  # never
    if block := libc.malloc(_AHEAD):
        libc.madvise(-(-block // _HUGE_PAGE) * _HUGE_PAGE, _AHEAD - _HUGE_PAGE, 14)  # MADV_HUGEPAGE of Linux
        libc.free(block)
    return undo


def _working_directory_off_module_path() -> Callable[[], object]:
    name = "PYTHONSAFEPATH"
    before = os.environ.get(name)
    os.environ[name] = "1"

    def undo() -> None:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before

    return undo


single_threaded = _Setting(_one_blas_thread)
"""``with single_threaded():`` BLAS has one thread, also while other threads of the process enter and leave."""

memory_kept = _Setting(_freed_memory_kept)
"""``with memory_kept():`` freed arrays leave their memory to the next ones, and to the system at the end.

glibc gives arrays of more than 32 MB back at once, and at first those of more than 128 kB. The next one then waits for
the system to clear new pages: a fit of a million rows, of which every temporary array is as large, would spend a
quarter of its time there. Nothing changes with another allocator, or where the environment has options for this one.
"""

module_path_safe = _Setting(_working_directory_off_module_path)
"""``with module_path_safe():`` Python processes start without the working directory on their module path.

``python -c``, with which pools of processes begin and libraries test others, has it there: a file ``struct.py`` in the
working directory would run in place of Python's own.
"""
