"""Every error that diransac raises on purpose.

::

    DiransacError              anything below: one clear sentence a user can act on
    ├── ModelError             the equations of motion cannot be used as written
    ├── LogError               a log, or a file that should hold one, cannot be used
    ├── SettingsError          a setting, or an argument of a call, has no meaning here
    ├── IdentificationError    the search ended without parameters
    ├── PlanningError          no trajectory, or no controller, does what was asked for
    ├── ResultError            a saved result cannot be read back, or does not fit what it is used with
    └── StudyError             a study's store cannot be used for it, or its workers are lost

A message says what was wrong, what was found, and what to try.
"""

__all__ = [
    "DiransacError",
    "IdentificationError",
    "LogError",
    "ModelError",
    "PlanningError",
    "ResultError",
    "SettingsError",
    "StudyError",
]


class DiransacError(Exception):
    """Base of every error that diransac raises on purpose."""


class ModelError(DiransacError):
    """The equations of motion cannot be used as written."""


class LogError(DiransacError):
    """A log, or a file that should hold one, cannot be used."""


class SettingsError(DiransacError):
    """A setting, or an argument of a call, has no meaning here."""


class IdentificationError(DiransacError):
    """The search ended without parameters."""


class PlanningError(DiransacError):
    """No trajectory, or no controller, does what was asked for."""


class ResultError(DiransacError):
    """A saved result cannot be read back, or does not fit what it is used with."""


class StudyError(DiransacError):
    """A study's store cannot be used for it, or its workers are lost."""
