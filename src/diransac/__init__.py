"""From the messy log of a real machine to a dynamical model that can be simulated, flown and trusted.

``import diransac as dr``: equations in a `Model`, measurements in a `Log`, `identify` in between, a `Result` out.
Models and errors are here at once; everything else is imported when it is first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

from diransac import models
from diransac.errors import (
    DiransacError,
    IdentificationError,
    LogError,
    ModelError,
    PlanningError,
    ResultError,
    SettingsError,
    StudyError,
)
from diransac.model import Model, Parameter
from diransac.plant import Disturbance, Plant

if TYPE_CHECKING:
    from diransac.controller import Controller, tvlqr, tvlqr_all
    from diransac.estimators import OrdinaryLeastSquares, ScikitLearnEstimator, TotalLeastSquares
    from diransac.flight import fly, fly_all, tracking_error
    from diransac.identification import METHODS, identify
    from diransac.log import Log
    from diransac.noise import CorruptedLog, Noise, corrupt
    from diransac.nonlinear import NonlinearLeastSquares
    from diransac.planning import places, plan, sine, sines, square, star
    from diransac.plots import plot_flight
    from diransac.prepare import despike, differentiate, rename, resample, scale, shift
    from diransac.readers import read_log
    from diransac.report import write_report
    from diransac.result import Result
    from diransac.settings import Settings
    from diransac.study import Study, run_study
    from diransac.trajectory import Trajectory
    from diransac.validation import Validation, validate

__all__ = [
    "METHODS",
    "Controller",
    "CorruptedLog",
    "DiransacError",
    "Disturbance",
    "IdentificationError",
    "Log",
    "LogError",
    "Model",
    "ModelError",
    "Noise",
    "NonlinearLeastSquares",
    "OrdinaryLeastSquares",
    "Parameter",
    "PlanningError",
    "Plant",
    "Result",
    "ResultError",
    "ScikitLearnEstimator",
    "Settings",
    "SettingsError",
    "Study",
    "StudyError",
    "TotalLeastSquares",
    "Trajectory",
    "Validation",
    "corrupt",
    "despike",
    "differentiate",
    "fly",
    "fly_all",
    "identify",
    "models",
    "places",
    "plan",
    "plot_flight",
    "read_log",
    "rename",
    "resample",
    "run_study",
    "scale",
    "shift",
    "sine",
    "sines",
    "square",
    "star",
    "tracking_error",
    "tvlqr",
    "tvlqr_all",
    "validate",
    "write_report",
]

_FOUND_IN = {
    "flight": ("fly", "fly_all", "tracking_error"),
    "controller": ("Controller", "tvlqr", "tvlqr_all"),
    "estimators": ("OrdinaryLeastSquares", "ScikitLearnEstimator", "TotalLeastSquares"),
    "identification": ("METHODS", "identify"),
    "log": ("Log",),
    "noise": ("CorruptedLog", "Noise", "corrupt"),
    "nonlinear": ("NonlinearLeastSquares",),
    "planning": ("places", "plan", "sine", "sines", "square", "star"),
    "plots": ("plot_flight",),
    "prepare": ("despike", "differentiate", "rename", "resample", "scale", "shift"),
    "readers": ("read_log",),
    "report": ("write_report",),
    "result": ("Result",),
    "settings": ("Settings",),
    "study": ("Study", "run_study"),
    "trajectory": ("Trajectory",),
    "validation": ("Validation", "validate"),
}
_LATER = {name: module for module, names in _FOUND_IN.items() for name in names}
_SUBMODULES = ("prepare", "simulate", "study")


def __getattr__(name: str) -> Any:
    """What is imported when it is first asked for."""
    if name in _SUBMODULES:
        return importlib.import_module(f"diransac.{name}")
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"diransac.{_LATER[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Everything, imported or not."""
    return sorted({*globals(), *__all__} - {"TYPE_CHECKING", "Any"})
