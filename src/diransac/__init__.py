"""Robust identification of dynamical models from logs with noise, outliers and unmodelled forces.

``import diransac as dr``: `identify` estimates the parameters of a `Model` from a `Log` and returns a `Result`.  Models
and errors are imported with the package, everything else on first access.

Packages, each with a docstring to begin with: `model` and `data` (equations; logs), `simulation`, `identification`,
`flight`, `study`, and what shows their results, `export`, `plots`, `report`, `cli` and `studio`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from diransac.errors import (
    DiransacError,
    IdentificationError,
    LogError,
    ModelError,
    PlanningError,
    ResultError,
    SettingsError,
    StudyError,
    TimeLimitError,
)
from diransac.model import Disturbance, Model, Parameter, Plant, Sensor, sensors
from diransac.model import library as models
from diransac.model.parts import independent_parts

if TYPE_CHECKING:
    from diransac.data.filters import FilterSpecification
    from diransac.data.log import Log
    from diransac.data.preprocessing import (
        despike,
        differentiate,
        keep_while,
        leave_out,
        rename,
        resample,
        scale,
        shift,
        unwrap,
    )
    from diransac.data.readers import read_log, read_logs, read_topics
    from diransac.flight.closed_loop import fly, fly_batch, tracking_error
    from diransac.flight.corruption import CorruptedLog, corrupt
    from diransac.flight.noise import Noise
    from diransac.flight.planning import (
        Experiment,
        design_experiment,
        multisine,
        plan,
        random_waypoints,
        sine,
        square,
        star,
    )
    from diransac.flight.trajectory import Trajectory
    from diransac.flight.tvlqr import Controller, tvlqr, tvlqr_batch
    from diransac.identification.assessment.cross_validation import CrossValidation, cross_validate
    from diransac.identification.assessment.open_loop import simulate
    from diransac.identification.assessment.validation import Validation, validate
    from diransac.identification.finding import Finding
    from diransac.identification.identify import identify
    from diransac.identification.method import Progress
    from diransac.identification.methods import METHODS
    from diransac.identification.methods.least_squares import LeastSquares
    from diransac.identification.methods.lo_diransac import LoDiransac
    from diransac.identification.methods.ransac import Diransac, IDiransac
    from diransac.identification.regression.estimators import OrdinaryLeastSquares, TotalLeastSquares
    from diransac.identification.regression.nonlinear import NonlinearLeastSquares
    from diransac.identification.regression.scikit_learn import ScikitLearnEstimator
    from diransac.identification.result import Result
    from diransac.identification.settings import Settings
    from diransac.identification.structure.lacking_terms import Suggestion
    from diransac.identification.tracking import Change, TrackedEstimate, Tracker, track
    from diransac.model.robots import JointTorques, MotorCurrents, PositionControl
    from diransac.plots import plot_flight
    from diransac.report import write_report
    from diransac.study import Study, run_study

__all__ = [
    "METHODS",
    "Change",
    "Controller",
    "CorruptedLog",
    "CrossValidation",
    "Diransac",
    "DiransacError",
    "Disturbance",
    "Experiment",
    "FilterSpecification",
    "Finding",
    "IDiransac",
    "IdentificationError",
    "JointTorques",
    "LeastSquares",
    "LoDiransac",
    "Log",
    "LogError",
    "Model",
    "ModelError",
    "MotorCurrents",
    "Noise",
    "NonlinearLeastSquares",
    "OrdinaryLeastSquares",
    "Parameter",
    "PlanningError",
    "Plant",
    "PositionControl",
    "Progress",
    "Result",
    "ResultError",
    "ScikitLearnEstimator",
    "Sensor",
    "Settings",
    "SettingsError",
    "Study",
    "StudyError",
    "Suggestion",
    "TimeLimitError",
    "TotalLeastSquares",
    "TrackedEstimate",
    "Tracker",
    "Trajectory",
    "Validation",
    "corrupt",
    "cross_validate",
    "design_experiment",
    "despike",
    "differentiate",
    "fly",
    "fly_batch",
    "identify",
    "independent_parts",
    "keep_while",
    "leave_out",
    "models",
    "multisine",
    "plan",
    "plot_flight",
    "random_waypoints",
    "read_log",
    "read_logs",
    "read_topics",
    "rename",
    "resample",
    "run_study",
    "scale",
    "sensors",
    "shift",
    "simulate",
    "sine",
    "square",
    "star",
    "track",
    "tracking_error",
    "tvlqr",
    "tvlqr_batch",
    "unwrap",
    "validate",
    "write_report",
]

_FOUND_IN = {
    "data.filters": ("FilterSpecification",),
    "data.log": ("Log",),
    "data.preprocessing": (
        "despike",
        "differentiate",
        "keep_while",
        "leave_out",
        "rename",
        "resample",
        "scale",
        "shift",
        "unwrap",
    ),
    "data.readers": ("read_log", "read_logs", "read_topics"),
    "flight.closed_loop": ("fly", "fly_batch", "tracking_error"),
    "flight.corruption": ("CorruptedLog", "corrupt"),
    "flight.noise": ("Noise",),
    "flight.planning": (
        "Experiment",
        "design_experiment",
        "multisine",
        "plan",
        "random_waypoints",
        "sine",
        "square",
        "star",
    ),
    "flight.trajectory": ("Trajectory",),
    "flight.tvlqr": ("Controller", "tvlqr", "tvlqr_batch"),
    "identification.finding": ("Finding",),
    "identification.regression.estimators": ("OrdinaryLeastSquares", "TotalLeastSquares"),
    "identification.regression.scikit_learn": ("ScikitLearnEstimator",),
    "identification.identify": ("identify",),
    "identification.method": ("Progress",),
    "identification.methods": ("METHODS",),
    "identification.methods.least_squares": ("LeastSquares",),
    "identification.methods.lo_diransac": ("LoDiransac",),
    "identification.methods.ransac": ("Diransac", "IDiransac"),
    "identification.regression.nonlinear": ("NonlinearLeastSquares",),
    "identification.assessment.open_loop": ("simulate",),
    "identification.result": ("Result",),
    "identification.settings": ("Settings",),
    "identification.structure.lacking_terms": ("Suggestion",),
    "identification.assessment.cross_validation": ("CrossValidation", "cross_validate"),
    "identification.assessment.validation": ("Validation", "validate"),
    "identification.tracking": ("Change", "TrackedEstimate", "Tracker", "track"),
    "model.robots": ("JointTorques", "MotorCurrents", "PositionControl"),
    "plots": ("plot_flight",),
    "report": ("write_report",),
    "study": ("Study", "run_study"),
}
_LATER = {name: module for module, names in _FOUND_IN.items() for name in names}


def __getattr__(name: str) -> Any:
    """Module or object of the public interface, imported on first access."""
    if name in ("simulation", "study"):
        return importlib.import_module(f"diransac.{name}")
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"diransac.{_LATER[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Names of the public interface, imported or not."""
    return sorted({*globals(), *__all__} - {"TYPE_CHECKING", "Any"})
