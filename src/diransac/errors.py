"""Exceptions of diransac.

::

    DiransacError              base class
    ├── ModelError             the equations of motion cannot be used as written
    ├── LogError               a log, or a file that should hold one, cannot be used
    ├── SettingsError          a setting or an argument is invalid
    ├── IdentificationError    parameters are not identifiable, or no hypothesis was accepted
    ├── PlanningError          no trajectory or controller satisfies the request
    ├── ResultError            a saved result cannot be read or written, or does not match its use
    ├── StudyError             a study's store cannot be used for it, or its workers are lost
    └── TimeLimitError         a time limit was reached before an answer was found

Messages state the problem, the value found, and the remedy.
"""

from collections.abc import Iterable


class DiransacError(Exception):
    """Base class of the exceptions of diransac."""


class ModelError(DiransacError):
    """The equations of motion cannot be used as written."""


class LogError(DiransacError):
    """A log, or a file that should hold one, cannot be used."""


class SettingsError(DiransacError):
    """A setting or an argument is invalid."""


class IdentificationError(DiransacError):
    """Parameters are not identifiable, or no hypothesis was accepted."""


class PlanningError(DiransacError):
    """No trajectory or controller satisfies the request."""


class ResultError(DiransacError):
    """A saved result cannot be read or written, or does not match its use."""


class StudyError(DiransacError):
    """A study's store cannot be used for it, or its workers are lost."""


class TimeLimitError(DiransacError):
    """A time limit was reached before an answer was found."""


def check_known(
    names: Iterable[str], known: Iterable[str], said: str, there: str, error: type[DiransacError] = SettingsError
) -> None:
    """Raise an error of a class, such as ``said "name"; there a, b, c``, where a name is none of those known."""
    there_are = list(known)
    for name in names:
        if name not in there_are:
            raise error(f'{said} "{name}"; {there} {", ".join(there_are) or "none"}')
