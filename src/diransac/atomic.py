"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["write_text", "write_with"]


def write_with(path: str | Path, write: Callable[[Path], None], *, mode: int | None = None) -> None:
    """Write a file whole or not at all: a temporary file beside it, then a rename.

    Parameters
    ----------
    path : str or Path
    write : callable
        ``write(temporary)`` fills the temporary file.  Its errors pass through; ``path`` is then untouched, and nothing
        is left beside it.
    mode : int, optional
        Permissions of the file; by default those of the file that it replaces, else those that new files have.
    """
    target = Path(path)
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(_default_mode(target) if mode is None else mode)
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text, whole or not at all."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(text.encode())

    write_with(path, write)


def _default_mode(target: Path) -> int:
    """Permissions of a file, or of a new one."""
    if target.exists():
        return target.stat().st_mode
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask
