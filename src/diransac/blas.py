"""Linear algebra on one thread: where matrices are small, or every core is busy already, more would only wait."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from threadpoolctl import threadpool_limits

__all__ = ["single_threaded"]


class _Limit:
    """One thread for the whole process as long as anybody asks for it; then as many as before the first did.

    The number is the process's: threads that each kept and restored what they found would restore each other's one.
    """

    def __init__(self) -> None:
        self._lock, self._asking = threading.Lock(), 0
        self._limits: threadpool_limits | None = None

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """BLAS takes one thread meanwhile."""
        with self._lock:
            if self._limits is None:
                self._limits = threadpool_limits(limits=1, user_api="blas")
            self._asking += 1
        try:
            yield
        finally:
            with self._lock:
                self._asking -= 1
                if not self._asking:
                    self._limits.restore_original_limits()
                    self._limits = None


single_threaded = _Limit()
"""``with single_threaded():`` BLAS takes one thread, whatever other threads of the process begin or end meanwhile."""
