"""Linear algebra on one thread, for small matrices and for processes whose cores are busy already."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from threadpoolctl import threadpool_limits

__all__ = ["single_threaded"]


class _Limit:
    """Context in which BLAS has one thread; the process has its earlier number again when the last context ends.

    The number belongs to the process, so that threads which each restored their own would restore each other's.
    """

    def __init__(self) -> None:
        self._lock, self._n_contexts = threading.Lock(), 0
        self._limits: threadpool_limits | None = None

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """A context with one BLAS thread."""
        with self._lock:
            if self._limits is None:
                self._limits = threadpool_limits(limits=1, user_api="blas")
            self._n_contexts += 1
        try:
            yield
        finally:
            with self._lock:
                self._n_contexts -= 1
                if not self._n_contexts:
                    self._limits.restore_original_limits()
                    self._limits = None


single_threaded = _Limit()
"""``with single_threaded():`` BLAS has one thread, also while other threads of the process enter and leave."""
