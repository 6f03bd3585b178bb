"""From the messy log of a real machine to a dynamical model that can be simulated, flown and trusted.

``import diransac as dr``: equations in a `Model`, measurements in a `Log`, `identify` in between, a `Result` out.
"""

from typing import TYPE_CHECKING, Any

from diransac import models
from diransac.errors import (
    DiransacError,
    IdentificationError,
    LogError,
    ModelError,
    ResultError,
    SettingsError,
)
from diransac.estimators import OrdinaryLeastSquares, ScikitLearnEstimator, TotalLeastSquares
from diransac.identify import METHODS, identify
from diransac.log import Log
from diransac.model import Model, Parameter, Plant
from diransac.nonlinear import NonlinearLeastSquares
from diransac.prepare import despike, differentiate, rename, resample, scale, shift
from diransac.readers import read_log
from diransac.result import Result
from diransac.settings import Settings
from diransac.validate import Validation, validate

if TYPE_CHECKING:
    from diransac.report import write_report

__all__ = [
    "METHODS",
    "DiransacError",
    "IdentificationError",
    "Log",
    "LogError",
    "Model",
    "ModelError",
    "NonlinearLeastSquares",
    "OrdinaryLeastSquares",
    "Parameter",
    "Plant",
    "Result",
    "ResultError",
    "ScikitLearnEstimator",
    "Settings",
    "SettingsError",
    "TotalLeastSquares",
    "Validation",
    "despike",
    "differentiate",
    "identify",
    "models",
    "read_log",
    "rename",
    "resample",
    "scale",
    "shift",
    "validate",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """What is imported when it is first asked for: identifying needs no page."""
    if name == "write_report":
        from diransac.report import write_report

        return write_report
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Everything, imported or not."""
    return sorted({*globals(), *__all__} - {"TYPE_CHECKING", "Any"})
