"""Stdout is for results, stderr for a few lines: what a user's own code prints goes to neither."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout

__all__ = ["leave_stdout", "silenced"]

_STDOUT, _STDERR = 1, 2


@contextmanager
def silenced() -> Iterator[None]:
    """Drop what is printed meanwhile, in whatever language; with ``--debug`` it goes to stderr.

    By every thread of the process; two of them must not do so at a time: the later would put back what the earlier
    had put there.
    """
    _flush()
    kept = {channel: os.dup(channel) for channel in (_STDOUT, _STDERR) if _is_open(channel)}
    sink = os.dup(_STDERR) if "--debug" in sys.argv and _STDERR in kept else os.open(os.devnull, os.O_WRONLY)
    try:
        for channel in kept:
            os.dup2(sink, channel)
        with redirect_stdout(sys.stdout), redirect_stderr(sys.stderr):  # user's code may assign to them
            yield
    finally:
        _flush()
        for channel, copy in kept.items():
            os.dup2(copy, channel)
            os.close(copy)
        os.close(sink)


def leave_stdout() -> None:
    """Drop what is printed on stdout from here on, such as by the exit handlers of user's code."""
    sink = os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, _STDOUT)


def _is_open(channel: int) -> bool:
    try:
        os.fstat(channel)
    except OSError:
        return False
    return True


def _flush() -> None:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:  # where a process has none
            stream.flush()
