"""A result as files: its JSON, checked on reading, and exports of its model."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.atomic import write_text
from diransac.errors import ResultError, SettingsError
from diransac.identification.diagnosis import Resolution
from diransac.identification.estimate import Estimate, Evaluation
from diransac.identification.serialization import NumberPairs, Numbers, Series, Values, dump, load
from diransac.identification.structure.lacking_terms import check_terms
from diransac.model import Model
from diransac.simulation import HOLDS

if TYPE_CHECKING:
    from diransac.export import PortableModel
    from diransac.identification.result import Result

_FORMAT = 11
"""Number of the form of the JSON."""
_SINCE: Mapping[int, Mapping[str, object]] = {
    9: {"mistakes": (), "n_columns_tested": 0, "predictions": None, "disagreements": ()},
    10: {"predictions": None, "disagreements": ()},
}
"""Formats that are read besides, with the values of what they lack."""


def as_dict(result: Result) -> dict[str, Any]:
    """Everything, ready for JSON; `from_data` reads it back."""
    data = dump(result)
    # Fields of the estimate and the evaluation stand beside the result's, whose notes hold the estimate's, too.
    estimate, evaluation = data.pop("estimate"), data.pop("evaluation")
    if not result.layout.is_shared:
        estimate |= {f"{key}_of_logs": estimate[key] for key in ("parameters", "covariance")}
        estimate |= {"parameters": dump(result.parameters, Values), "covariance": dump(result.covariance, Numbers)}
        estimate["per_log"] = dump({n: np.array(x) for n, x in result.per_log.items()}, Series)
    model = {"model": data.pop("model")}
    return {"format": _FORMAT, **estimate, **evaluation, **data, **_derived(result), **model}


def _derived(result: Result) -> dict[str, Any]:
    """Figures that follow from others, for programs that read the JSON."""
    structural = result.structural_intervals() if result.has_structure else None
    return {
        "units": result.units,
        "standard_errors": dump(result.standard_errors, Values),
        "intervals_95": dump(result.intervals(), NumberPairs),
        "structural_intervals_95": dump(structural, NumberPairs | None),
        "structure": {n: dump(x) for n, x in result.structure.items()} if result.has_structure else None,
        "violations": list(result.violations),
        "verdict": result.verdict,
        "findings": [x.to_dict() for x in result.findings],
    }


def from_data(data: object, kind: type[Result]) -> Result:
    """The result from a mapping of `as_dict`.  Raises as `Result.from_dict`."""
    found = data.get("format") if isinstance(data, Mapping) else None
    if type(found) is not int:
        raise ResultError("this is no result of diransac; give a file that identify wrote")
    if found != _FORMAT and found not in _SINCE:
        writer = "an earlier version" if found < _FORMAT else "a later version"
        raise ResultError(
            f"the result has format {found}, of {writer} of diransac; this one reads {min(_SINCE)} to {_FORMAT}. "
            "Identify again"
        )
    assert isinstance(data, Mapping)
    own = {
        **_SINCE.get(found, {}),
        **data,
        **{n.removesuffix("_of_logs"): x for n, x in data.items() if n.endswith("_of_logs")},
    }
    try:
        result = load(kind, {**own, "estimate": load(Estimate, own), "evaluation": load(Evaluation, own)})
        _check(result)
        _derived(result), str(result)  # fail where names and figures do not fit together
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        reason = str(error).partition("\n")[0]
        raise ResultError(f"the result is damaged: {type(error).__name__} at {reason:.200}; identify again") from error
    return result


def _check(result: Result) -> None:
    """Raise ValueError: names, figures or sizes do not fit."""
    estimate, n_rows = result.estimate, sum(log.n_rows for log in result.logs)
    if tuple(estimate.parameters) != result.layout.names or not np.isfinite(estimate.values).all():
        raise ValueError(f"parameters {', '.join(estimate.parameters)}")
    masks = [] if estimate.diagnosis is None else estimate.diagnosis.outliers.values()
    if any(len(mask) != n_rows for mask in (result.inliers, *masks)):
        raise ValueError(f"a mask of other than {n_rows} rows")
    if estimate.diagnosis is not None:
        estimate.diagnosis.check_windows()
    check_terms(estimate.possible_terms or ())
    if not _is_covariance(estimate.covariance):
        raise ValueError("covariance: it is that of no distribution")
    _check_resolution(estimate.resolution, result.model.n_u)
    if not 1 <= estimate.degrees_of_freedom <= 2**53:
        raise ValueError(f"{estimate.degrees_of_freedom} degrees of freedom")
    for log in result.logs:
        if not (log.n_rows > 0 and 0.0 < log.dt < np.inf and np.isfinite(log.start)):
            raise ValueError(f"a log of {log.n_rows} rows, {log.dt} s apart")


def model_of(data: Mapping[str, Any]) -> Model:
    """The stored model, with equations or of a simulator."""
    if "simulator" not in data:
        return Model.from_dict(data)
    from diransac.model.mjcf import MujocoModel

    return MujocoModel.from_dict(data)


def _check_resolution(resolution: Resolution, n_u: int) -> None:
    """Raise ValueError: the inputs of a simulation have no such hold or timing."""
    timing = resolution.timing
    of_inputs = (timing.own_delays, timing.own_lags, timing.gain_drifts)
    if resolution.hold not in HOLDS:
        raise ValueError(f"hold {resolution.hold}")
    if any(len(x) not in (0, n_u) for x in of_inputs):
        raise ValueError(f"timing of other than {n_u} inputs")
    if not all(abs(x) < 1e9 for x in chain((timing.delay, timing.lag), *of_inputs)):
        raise ValueError("timing: it is that of no machine")


def _is_covariance(covariance: FloatArray) -> bool:
    """True if variances are not negative, and the correlations of those that are finite are symmetric and definite."""
    variances, rounding = np.diag(covariance), 1e-3  # by far: those of collinear parameters are nearly singular
    if (variances < 0.0).any():
        return False
    known = np.isfinite(variances) & (variances > 0.0)
    deviations = np.sqrt(variances[known])
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        correlation = covariance[np.ix_(known, known)] / deviations[:, None] / deviations
    if not np.isfinite(correlation).all() or np.abs(correlation - correlation.T).max(initial=0.0) > rounding:
        return False
    return bool(np.linalg.eigvalsh(correlation).min(initial=0.0) >= -rounding)


def export(
    result: Result, path: str | Path, into: str | Path | None, to: str | None, name: str | None
) -> tuple[str, ...]:
    """As `Result.export`."""
    from diransac.export import format_of, write_model

    chosen = format_of(path, to)
    if chosen in ("mjcf", "urdf"):
        if into is None:
            raise SettingsError(f"{chosen} is a robot's description with the estimates in it; give it, as into=")
        return _write_description(result, path, into)
    if into is not None:
        raise SettingsError(f'"{into}" has no use: only mjcf and urdf are written into a description')
    try:
        write_model(_portable(result, name), path, chosen)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror}") from error
    return ()


def _write_description(result: Result, path: str | Path, into: str | Path) -> tuple[str, ...]:
    """Write a description with identifiable parameters in it; return those that are not."""
    from diransac.model.mjcf import MujocoModel, calibrated_text
    from diransac.model.robots.calibration import calibrated

    values = {n: np.nan if n in result.unidentifiable else x for n, x in result.parameters.items()}
    if isinstance(result.model, MujocoModel):
        text, left_out = calibrated_text(into, result.model, values, result.covariance)
    else:
        text, left_out = calibrated(into, result.model.parameters, np.array(list(values.values())), result.covariance)
    write(path, text)
    return left_out


def _portable(result: Result, name: str | None = None) -> PortableModel:
    """The model as it is exported; without draws where a parameter has no finite variance."""
    from diransac.export import PortableModel

    try:
        samples = result.sample(1000)
    except ResultError:
        samples = {}
    resolution = result.estimate.resolution
    return PortableModel(
        result.model,
        result.parameters,
        result.standard_errors,
        result.covariance,
        samples,
        resolution.timing,
        resolution.hold,
        {} if result.layout.is_shared else result.per_log,
        name or "",
        result.intervals(),
        result.structural_intervals() if result.has_structure else {},
    )


def write(path: str | Path, text: str) -> None:
    """Write a file, atomically.  Raises ResultError: it cannot be written."""
    try:
        write_text(path, text)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror}") from error
