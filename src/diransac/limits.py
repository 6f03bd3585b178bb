"""Sizes up to which files are read and models are made; they are checked before memory and time are spent."""

from __future__ import annotations

import os
import stat
from pathlib import Path

LARGEST_LOG = 2**30
"""Bytes of the file of a table, and of what it unpacks to."""

LARGEST_TEXT = 2**29
"""Bytes of the text of a log, which takes several times as much memory while it is read."""

MOST_NUMBERS = LARGEST_LOG // 8
"""Numbers of a log, in double precision."""

MOST_ROWS, MOST_COLUMNS = 10_000_000, 10_000
"""Rows and columns of a log."""

MOST_COUNTED = 10_000_000
"""Trials of a study at each level, and other counts that a study asks for."""

LARGEST_RESULT = 2**28
"""Bytes of the largest result."""

LARGEST_TABLE = 2**20
"""Bytes of the largest settings or study."""

MOST_NAMES = 3000
"""Names of a model; matrices grow with its square."""

MOST_OPERATIONS = 200_000
"""Operations of a model's equations. A quadruped with twelve joints has some 20,000."""

MOST_SOLVED = 2_000_000
"""Operations of the solution of ``M a = -c``; a dense symmetric mass matrix of 100 accelerations takes 400,000."""

MOST_COMPILED = 60_000
"""Operations of one compiled function, with 15 for a sine and the like: they compile within a minute or two."""

MOST_ELEMENTS, MOST_CELLS = 100_000, 2**24
"""Elements of a robot's description with their copies, and numbers in fields of heights and textures."""

MOST_JOINTS = 400
"""Joints of a robot; the time for its equations grows with the square."""


class SizeError(ValueError):
    """A file is larger than it may be; the message is a part of a sentence."""


def beyond(most: int, what: str, found: int | None = None) -> str:
    """Part of a sentence that refuses a size: ``12,000 columns; up to 10,000 are possible``.

    Parameters
    ----------
    most : int
        The limit; of ``"bytes"``, which are named in MiB.
    what : str
        Things that are counted.
    found : int, optional
        Their number; None: they were counted up to the limit.
    """
    if what == "bytes":
        most, what, found = most // 2**20, "MiB", None if found is None else -(-found // 2**20)
    return f"more than {most:,} {what}" if found is None else f"{found:,} {what}; up to {most:,} are possible"


def check_ordinary(path: str | Path) -> os.stat_result:
    """Status of an ordinary file: a pipe would be waited for, and a device may have no end.

    Raises
    ------
    OSError
        There is no file, or it is of another kind.
    """
    about = Path(path).stat()
    if stat.S_ISDIR(about.st_mode):
        raise IsADirectoryError(0, "it is a folder", str(path))
    if not stat.S_ISREG(about.st_mode):
        raise OSError(0, "it is not an ordinary file, but a device, pipe or socket", str(path))
    return about


def read_bytes(path: str | Path, largest: int) -> bytes:
    """Content of an ordinary file.

    Parameters
    ----------
    path : str or Path
    largest : int
        Bytes that the file has at most.

    Raises
    ------
    OSError
        The file cannot be read, or is not an ordinary one.
    SizeError
        It is larger.
    """
    size = check_ordinary(path).st_size
    if size > largest:
        raise SizeError(f"it has {beyond(largest, 'bytes', size)}")
    with Path(path).open("rb") as file:
        return file.read(size)  # one that grows meanwhile is read as it was
