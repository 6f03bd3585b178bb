"""Limits on the time of a computation; a loop that may take long calls `check_time` in each of its turns."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from threading import Event
from time import monotonic
from typing import NamedTuple

from diransac.errors import SettingsError, TimeLimitError


class _Deadline(NamedTuple):
    """Moment at which time is over, s of the monotonic clock, and the limit that sets it, s."""

    moment: float
    limit: float


_NONE = _Deadline(math.inf, math.inf)
_NEXT = ContextVar("deadline", default=_NONE)
_UNLIMITED = _Deadline(math.inf, math.nan)
"""Deadline of what completes an answer."""
_ENDED = Event()
"""Set once somebody has asked for the answer that there is."""


@contextmanager
def time_limited(seconds: float | None) -> Iterator[None]:
    """Context in which `check_time` raises once so much time has passed, or the limit of an enclosing context has.

    Parameters
    ----------
    seconds : float or None
        None: no further limit.

    Raises
    ------
    SettingsError
        The limit is not a positive number.
    """
    if seconds is None:
        yield
        return
    if not seconds > 0.0:
        raise SettingsError(f"time_limit is {seconds!r}; give a positive number of seconds, or None")
    deadline = _Deadline(monotonic() + seconds, float(seconds))
    token = _NEXT.set(min(deadline, _NEXT.get()))
    try:
        yield
    finally:
        _NEXT.reset(token)


@contextmanager
def time_unlimited() -> Iterator[None]:
    """Context without a limit, for what completes an answer that was found in time."""
    token = _NEXT.set(_UNLIMITED)
    try:
        yield
    finally:
        _NEXT.reset(token)


def end_search() -> None:
    """End every search of this process as if its time were over, from any thread; what completes an answer goes on."""
    _ENDED.set()


def time_left() -> float:
    """Time until the limit, s; infinite where there is none."""
    deadline = _NEXT.get()
    if _ENDED.is_set() and deadline is not _UNLIMITED:
        return -math.inf
    return math.inf if math.isinf(deadline.moment) else deadline.moment - monotonic()


def check_time() -> None:
    """Raise TimeLimitError where the time of a `time_limited` context is over."""
    if time_left() <= 0.0:
        limit = _NEXT.get().limit
        if _ENDED.is_set():
            raise TimeLimitError("the search was ended before an answer was found; let it go on for longer")
        raise TimeLimitError(f"the time limit of {limit:g} s was reached before an answer was found; give a longer one")
