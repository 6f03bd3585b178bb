"""Files that are written whole or not at all.

A file is written in a private folder beside its place and then renamed. The folder is made under a name that nobody can
guess, and fails where something of that name exists, so that no link of another user's is written through. It is locked
while its process lives: the next file that is written in the same place removes what a killed process has left.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform != "win32":
    import fcntl


@contextmanager
def draft(target: Path) -> Iterator[Path]:
    """Context with a file's place in a private folder beside it, of the same name; the folder is then removed.

    Parameters
    ----------
    target : Path
        File that the draft, which the block writes, is to replace: ``draft.replace(target)``.

    Yields
    ------
    Path
        Nothing is there yet.

    Raises
    ------
    OSError
        The folder cannot be made.
    """
    _remove_abandoned(target.parent)
    folder, lock = _locked_folder(target.parent)
    try:
        yield folder / target.name
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _locked_folder(parent: Path) -> tuple[Path, int | None]:
    """A new private folder, and its lock; None where the file system has none."""
    while True:
        folder = Path(tempfile.mkdtemp(dir=parent, prefix=".diransac-", suffix=".part"))
        lock = _lock(folder, wait=True)
        if lock is None or folder.exists():  # else another process took it for abandoned before it was locked
            return folder, lock
        os.close(lock)


def _lock(folder: Path, *, wait: bool) -> int | None:
    """Descriptor of a folder that is locked until it is closed; None if that is impossible, or another has it."""
    if sys.platform == "win32":  # which has no locks of this kind: what killed processes leave, stays
        return None
    found = None
    try:
        found = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
        fcntl.flock(found, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        if found is not None:
            os.close(found)
        return None
    return found


def _remove_abandoned(parent: Path) -> None:
    """Remove private folders of the user's own whose processes are dead."""
    if sys.platform == "win32":
        return
    with suppress(OSError):
        for entry in list(os.scandir(parent)):
            if re.fullmatch(r"\.diransac-\w{8}\.part", entry.name) and entry.is_dir(follow_symlinks=False):
                if entry.stat(follow_symlinks=False).st_uid != os.geteuid():
                    continue
                lock = _lock(Path(entry.path), wait=False)
                if lock is not None:
                    shutil.rmtree(entry.path, ignore_errors=True)
                    os.close(lock)


def write_with(path: str | Path, write: Callable[[Path], object], *, mode: int | None = None) -> None:
    """Write a file whole or not at all: a temporary file in a private folder beside it, then a rename.

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
    with draft(target) as temporary:
        write(temporary)
        if mode is not None:
            temporary.chmod(mode)
        elif target.exists():
            temporary.chmod(target.stat().st_mode)
        temporary.replace(target)


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 text, whole or not at all."""
    write_bytes(path, text.encode())


def write_bytes(path: str | Path, content: bytes | memoryview, *, mode: int | None = None) -> None:
    """Write a file's content, whole or not at all; its permissions as in `write_with`."""
    write_with(path, lambda temporary: temporary.write_bytes(content), mode=mode)
