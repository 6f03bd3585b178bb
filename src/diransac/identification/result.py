"""`Result`: an estimate with its evaluation and provenance; printed as a table, saved as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.atomic import write_text
from diransac.data.dataset import ParameterLayout
from diransac.data.log import Log
from diransac.errors import DiransacError, ResultError, SettingsError
from diransac.identification.estimate import (
    Competition,
    Diagnosis,
    Estimate,
    Evaluation,
    Finding,
    LogSummary,
    Resolution,
)
from diransac.identification.findings import Verdict, findings_of, next_line, shown_lines, verdict_of
from diransac.identification.serialization import NumberPairs, Numbers, Series, Values, dump, load
from diransac.identification.settings import Settings
from diransac.identification.structure import StructuralUncertainty, check_terms, largest, mixture_intervals
from diransac.identification.suggestions import Suggestion
from diransac.identification.uncertainty import student_quantile, students_draws
from diransac.model import Model
from diransac.plain_data import json_data, read_text
from diransac.simulation import HOLDS
from diransac.text_table import aligned, telling_digits

if TYPE_CHECKING:
    from diransac.export import PortableModel
    from diransac.identification.structure import PossibleTerm

__all__ = ["Result"]

_FORMAT = 10
_SINCE: Mapping[int, Mapping[str, object]] = {9: {"mistakes": (), "n_columns_tested": 0}}
"""Formats that are read besides, with the values of what they lack."""
_LATEST = 1e9
"""Bound of delays and lags, s, and of the drift of gains."""
_BY_LOG = ("parameters", "covariance")
"""Fields of an estimate that its JSON keeps apart from those of the result, where parameters are per log."""
_ROUNDING = 1e-3
"""Errors of correlations, by far: those of collinear parameters come from matrices that are nearly singular."""
_N_EXPORTED = 1000
"""Draws of the parameters in a YAML file."""


def _check_resolution(resolution: Resolution, n_u: int) -> None:
    """Raise ValueError: the inputs of a simulation have no such hold or timing."""
    timing = resolution.timing
    of_inputs = (timing.own_delays, timing.own_lags, timing.gain_drifts)
    if resolution.hold not in HOLDS:
        raise ValueError(f"hold {resolution.hold}")
    if any(len(x) not in (0, n_u) for x in of_inputs):
        raise ValueError(f"timing of other than {n_u} inputs")
    if not all(abs(x) < _LATEST for x in chain((timing.delay, timing.lag), *of_inputs)):
        raise ValueError("timing: it is that of no machine")


def _is_covariance(covariance: FloatArray) -> bool:
    """True if variances are not negative, and the correlations of those that are finite are symmetric and definite."""
    variances = np.diag(covariance)
    if (variances < 0.0).any():
        return False
    known = np.isfinite(variances) & (variances > 0.0)
    deviations = np.sqrt(variances[known])
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        correlation = covariance[np.ix_(known, known)] / deviations[:, None] / deviations
    if not np.isfinite(correlation).all() or np.abs(correlation - correlation.T).max(initial=0.0) > _ROUNDING:
        return False
    return bool(np.linalg.eigvalsh(correlation).min(initial=0.0) >= -_ROUNDING)


def _write(path: str | Path, text: str) -> None:
    """Write a file, atomically.  Raises ResultError: it cannot be written."""
    try:
        write_text(path, text)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror}") from error


@dataclass(frozen=True)
class _Provenance:
    """Provenance of a result in its JSON."""

    method: str
    seed: int
    logs: tuple[LogSummary, ...]
    notes: tuple[str, ...]
    options: Mapping[str, Any]
    bandwidth_sensitivity: NumberPairs | None
    fixed: tuple[str, ...]
    priors: NumberPairs


@dataclass(frozen=True)
class _Public:
    """Parameters of a result's JSON where some are per log: one value each, and the values of every log."""

    parameters: Values
    covariance: Numbers
    per_log: Series


@dataclass(frozen=True)
class _Derived:
    """Derived figures in a result's JSON, for programs that read it."""

    units: Mapping[str, str]
    standard_errors: Values
    intervals_95: NumberPairs
    structural_intervals_95: NumberPairs | None
    structure: Mapping[str, StructuralUncertainty] | None
    violations: tuple[str, ...]
    verdict: Verdict
    findings: tuple[Finding, ...]


@dataclass(frozen=True, eq=False)
class Result:
    """Parameters of a model, with their evaluation and the provenance that repeats them.

    Two results are equal if their JSON is.  A result can be used wherever a plant is required: it has a ``model`` and
    its ``parameters``.

    Parameters
    ----------
    model : Model
        Identified model, equations included.
    method : str
        Name of the method.
    seed : int
        Seed of all random numbers.
    settings : Settings
        Criteria of the method.
    estimate : Estimate
        Parameters, covariance, and diagnosis.
    evaluation : Evaluation
        Agreement of a simulation of every log with the measured signals.
    logs : tuple of LogSummary
        Provenance and scores of each log.
    notes : tuple of str, optional
        Findings, a sentence each.
    options : mapping of str to object, optional
        The method's own settings.
    bandwidth_sensitivity : mapping of str to (float, float), optional
        Relative change of each parameter at half and at twice the differentiating filter's bandwidth; None without one.
    fixed : tuple of str, optional
        Names of the parameters that were not identified but given; their standard errors are zero.
    priors : mapping of str to (float, float), optional
        Mean and standard deviation of the Gaussian prior of each parameter that had one, in its unit.
    """

    model: Model
    method: str
    seed: int
    settings: Settings
    estimate: Estimate
    evaluation: Evaluation
    logs: tuple[LogSummary, ...]
    notes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    bandwidth_sensitivity: Mapping[str, tuple[float, float]] | None = None
    fixed: tuple[str, ...] = ()
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    # ------------------------------------------------------------------ parameters

    @cached_property
    def layout(self) -> ParameterLayout:
        """Places of each log's parameters in the estimate."""
        return ParameterLayout(self.model.parameters, len(self.logs))

    @property
    def parameters(self) -> dict[str, float]:
        """Estimate of each parameter in its unit; of a per-log parameter, the mean over the logs."""
        if self.layout.is_shared:
            return dict(self.estimate.parameters)
        return dict(zip(self.model.parameters, (self.layout.mean_map @ self.estimate.values).tolist(), strict=True))

    @property
    def per_log(self) -> dict[str, tuple[float, ...]]:
        """Values of each per-log parameter that was identified, one per log."""
        return self._by_log(self.estimate.values)

    def parameters_in(self, log: Log) -> dict[str, float]:
        """Parameters that hold in a log: per-log ones of that log if it was identified from, else their mean."""
        index = self.index_of(log)
        if index is None:
            return self.parameters
        return {**self.parameters, **{name: values[index] for name, values in self.per_log.items()}}

    def index_of(self, log: Log) -> int | None:
        """Index of a log among those identified from; None if it is not one of them.

        Raises
        ------
        SettingsError
            What is given is no log.
        """
        if not isinstance(log, Log):
            raise SettingsError(f"log is {log!r}; give a dr.Log (result.per_log has the parameters by index)")
        known = [(one.fingerprint, one.prepared_fingerprint) for one in self.logs]
        return next((i for i, own in enumerate(known) if log.fingerprint in own), None)

    @property
    def per_log_standard_errors(self) -> dict[str, tuple[float, ...]]:
        """Standard errors of `per_log`."""
        return self._by_log(np.sqrt(np.diag(self.estimate.covariance)))

    def _by_log(self, values: FloatArray) -> dict[str, tuple[float, ...]]:
        pairs = zip(self.model.parameters.items(), self.layout.index.T, strict=True)
        return {n: tuple(values[own].tolist()) for (n, x), own in pairs if x.per_log and n not in self.fixed}

    @property
    def covariance(self) -> FloatArray:
        """Covariance ``(n_p, n_p)`` of `parameters`; infinite variances where one is not identifiable."""
        if self.layout.is_shared:
            return self.estimate.covariance
        known = np.isfinite(np.diag(self.estimate.covariance))
        finite = np.where(np.outer(known, known), self.estimate.covariance, 0.0)
        mapped = self.layout.mean_map @ finite @ self.layout.mean_map.T
        lost = (self.layout.mean_map[:, ~known] != 0.0).any(axis=1)
        mapped[lost] = mapped[:, lost] = np.inf
        return np.asarray(mapped)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each parameter in its unit."""
        return dict(zip(self.model.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence interval of each parameter by Student's t.

        Parameters
        ----------
        level : float, optional
            Confidence level, between 0 and 1.

        Returns
        -------
        dict of str to (float, float)
            Lower and upper limit in the parameter's unit.

        Raises
        ------
        SettingsError
            The level is not between 0 and 1.
        """
        if not 0.0 < level < 1.0:
            raise SettingsError(f"level is {level}; give a number between 0 and 1, such as 0.95")
        width = student_quantile(self.degrees_of_freedom, 0.5 + level / 2.0)
        errors = self.standard_errors
        return {n: (x - width * errors[n], x + width * errors[n]) for n, x in self.parameters.items()}

    def structural_intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Interval of each parameter, if the model may lack a term.

        Candidate terms that the log does not exclude widen the intervals of the parameters that they are correlated
        with, by their evidence; `intervals` are those of a complete model.

        Parameters
        ----------
        level : float, optional
            Probability, between 0 and 1.

        Returns
        -------
        dict of str to (float, float)
            Lower and upper limit in the parameter's unit; never narrower than `intervals`.

        Raises
        ------
        SettingsError
            The level is not between 0 and 1.
        ResultError
            The method has not tested any terms.
        """
        terms, intervals = self._tested_terms(), self.intervals(level)
        effects, shifts = (
            np.array([[values.get(n, 0.0) for n in self.layout.names] for values in of_terms]).reshape(
                -1, len(self.layout)
            )
            @ self._of_parameters.T
            for of_terms in ([x.effects for x in terms], [x.shifts for x in terms])
        )
        variances = np.array([x.variance for x in terms])[:, None]
        found = mixture_intervals(
            np.array(list(self.parameters.values())),
            np.array(list(self.standard_errors.values())),
            np.array([x.weight for x in terms]),
            shifts,
            np.square(effects) * variances,
            level,
            student_quantile(self.degrees_of_freedom, 0.5 + level / 2.0),
        )
        return dict(zip(intervals, map(tuple, found.tolist()), strict=True))

    @cached_property
    def structure(self) -> Mapping[str, StructuralUncertainty]:
        """Of each parameter that a possible term widens: the term that does so most, and the motion that would tell.

        Raises
        ------
        ResultError
            The method has not tested any terms.
        """
        terms, ordinary, structural = self._tested_terms(), self.intervals(), self.structural_intervals()
        found = dict[str, StructuralUncertainty]()
        for place, (name, (low, high)) in zip(self._of_parameters, structural.items(), strict=True):
            width = ordinary[name][1] - ordinary[name][0]
            term = largest(terms, dict(zip(self.layout.names, place.tolist(), strict=True)))
            if term is not None and 0.0 < width < np.inf:
                found[name] = StructuralUncertainty(str(term), term.weight, (high - low) / width, term.motion)
        return found

    @property
    def has_structure(self) -> bool:
        """True if terms that the model may lack were tested, and structural intervals are known."""
        return self.estimate.possible_terms is not None

    @property
    def _of_parameters(self) -> FloatArray:
        """Derivatives ``(n_p, n)`` of `parameters` with respect to the values of the estimate."""
        return np.eye(len(self.layout)) if self.layout.is_shared else self.layout.mean_map

    def _tested_terms(self) -> tuple[PossibleTerm, ...]:
        """Terms that the model may lack.  Raises ResultError: none were tested."""
        terms = self.estimate.possible_terms
        if terms is None:
            raise ResultError(
                f"{self.method} has not tested what the model may lack: structural intervals are those of lo-diransac "
                "with suggestions=True; identify with it"
            )
        return terms

    def sample(self, n: int, seed: int = 0) -> dict[str, FloatArray]:
        """Draws from the joint distribution of the parameters, for simulations with random parameters.

        It is that of `intervals`, Student's t with the covariance of the estimate, within the bounds of the parameters.

        Parameters
        ----------
        n : int
            Number of draws.
        seed : int, optional
            Seed of the draws.

        Returns
        -------
        dict of str to (n,) array
            Values of each parameter in its unit; draw k is the k-th value of all.

        Raises
        ------
        SettingsError
            The number is not positive.
        ResultError
            A parameter has no finite variance, or next to no draws are within the bounds.
        """
        if n < 1:
            raise SettingsError(f"n is {n}; give a positive number of draws")
        mean, bounds = np.array(list(self.parameters.values())), list(self.model.parameters.values())
        unknown = [name for name, error in self.standard_errors.items() if not np.isfinite(error)]
        if unknown:
            raise ResultError(f"{', '.join(unknown)}: no interval is known, and nothing can be drawn; fix it")
        free = [name for name in self.parameters if name not in self.fixed]
        own = np.array([list(self.parameters).index(name) for name in free], np.int64)
        draws = np.tile(mean[:, None], n)
        draws[own] = students_draws(
            mean[own], self.covariance[np.ix_(own, own)], self.degrees_of_freedom, [bounds[k] for k in own], n, seed
        )
        return dict(zip(self.parameters, draws, strict=True))

    def export(
        self, path: str | Path, into: str | Path | None = None, *, to: str | None = None, name: str | None = None
    ) -> tuple[str, ...]:
        """Write the model for other programs, atomically; the ending of the file names the format.

        - ``dynamics.c``: C99 without allocation, the derivative of the state and a Runge-Kutta step
        - ``dynamics.py``: the same in Python with NumPy, over leading axes
        - ``dynamics.casadi``: serialised CasADi function with an argument for each parameter
        - ``model.yaml``: estimates, standard errors, covariance, 1000 draws, delay and lag of the inputs
        - ``.xml``, ``.urdf``: the robot description ``into`` with the estimates in it

        A description is that of ``into`` but for the values that were identified. Parameters of joints are the
        estimates; inertials are the physically consistent ones nearest to those of the description, of all that explain
        the estimated base parameters. What is not identifiable stays as it is there.

        Parameters
        ----------
        path : str or Path
            File to be written.
        into : str or Path, optional
            MJCF or URDF file from which `diransac.models.robot` made the model; for a description only.
        to : str, optional
            Format, "c", "python", "casadi", "yaml", "mjcf" or "urdf"; by default that of the ending.
        name : str, optional
            Name with which the functions of C, and that of CasADi, begin, so that several results of one model can be
            linked together; by default that of the model.

        Returns
        -------
        tuple of str
            Names of the parameters that are not in the file: those of which a description has no value, because they
            are not identifiable, or the format has no place for them, such as the bias of an encoder.

        Raises
        ------
        SettingsError
            There is no such format, or ``into`` is missing or has no use.
        ModelError
            The description cannot be read, or is not that of the model; the format lacks an operation of the equations.
        ResultError
            The file cannot be written.
        """
        from diransac.export import format_of, write_model

        chosen = format_of(path, to)
        if chosen in ("mjcf", "urdf"):
            if into is None:
                raise SettingsError(f"{chosen} is a robot's description with the estimates in it; give it, as into=")
            return self._export_description(path, into)
        if into is not None:
            raise SettingsError(f'"{into}" has no use: only mjcf and urdf are written into a description')
        try:
            write_model(self._portable(name), path, chosen)
        except OSError as error:
            raise ResultError(f"{path}: cannot be written: {error.strerror}") from error
        return ()

    def _export_description(self, path: str | Path, into: str | Path) -> tuple[str, ...]:
        """Write a description; return the parameters that are not in it."""
        from diransac.model.robots.calibration import calibrated

        found = self.parameters.items()
        values = np.array([np.nan if name in self.unidentifiable else x for name, x in found])
        text, left_out = calibrated(into, self.model.parameters, values, self.covariance)
        _write(path, text)
        return left_out

    def _portable(self, name: str | None = None) -> PortableModel:
        """The model as it is exported; without draws where a parameter has no finite variance."""
        from diransac.export import PortableModel

        try:
            samples = self.sample(_N_EXPORTED)
        except ResultError:
            samples = {}
        resolution = self.estimate.resolution
        return PortableModel(
            self.model,
            self.parameters,
            self.standard_errors,
            self.covariance,
            samples,
            resolution.timing,
            resolution.hold,
            {} if self.layout.is_shared else self.per_log,
            name or "",
            self.intervals(),
            self.structural_intervals() if self.has_structure else {},
        )

    @property
    def violations(self) -> tuple[str, ...]:
        """Names of the parameters outside their bounds (never with a RANSAC method)."""
        return self.layout.violations(self.estimate.values)

    @property
    def on_bounds(self) -> tuple[str, ...]:
        """Names of the parameters on one of their bounds, where the estimator stopped: their intervals are unknown."""
        stuck = zip(self.layout.names, self.layout.on_bounds(self.estimate.values), strict=True)
        return tuple(n for n, on_bound in stuck if on_bound and n.partition("[")[0] not in self.fixed)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Sentences for and against the result, the most serious first, each with its ``level``."""
        return findings_of(self)

    @property
    def verdict(self) -> Verdict:
        """The verdict: "usable", "usable with care" or "do not rely on this", by the most serious finding."""
        return verdict_of(self.findings)

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter."""
        return {n: x.unit for n, x in self.model.parameters.items()}

    # ------------------------------------------------------------------ estimate and evaluation by their names

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Parameters that the logs do not determine, as lo-diransac finds; a per-log one if it is so in any log."""
        found = () if self.diagnosis is None else self.diagnosis.unidentifiable
        return tuple(dict.fromkeys(name.partition("[")[0] for name in found))

    @property
    def degrees_of_freedom(self) -> int:
        """Degrees of freedom of the covariance."""
        return self.estimate.degrees_of_freedom

    @property
    def n_fitted(self) -> int:
        """Number of observations that the parameters were fitted to: of a sample, or of a set of inliers."""
        return self.estimate.n_fitted

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return self.estimate.estimator

    @property
    def iterations(self) -> int:
        """Number of samples drawn, the paper's k."""
        return self.estimate.iterations

    @property
    def n_hypotheses(self) -> int:
        """Number of hypotheses evaluated, refits included."""
        return self.estimate.n_hypotheses

    @property
    def rejected(self) -> Mapping[str, int]:
        """Number of rejected hypotheses by reason."""
        return self.estimate.rejected

    @property
    def stop_reason(self) -> str:
        """Reason why the search ended."""
        return self.estimate.stop_reason

    @property
    def diagnosis(self) -> Diagnosis | None:
        """Noise, faults and unmodelled forces, from lo-diransac."""
        return self.estimate.diagnosis

    @property
    def suggestions(self) -> tuple[Suggestion, ...]:
        """Terms that would explain the unmodelled forces, the most likely first; from lo-diransac."""
        return self.estimate.suggestions

    @property
    def competition(self) -> Competition | None:
        """Comparison of estimates by held-out prediction, from lo-diransac; None where there was no need of one."""
        return self.estimate.competition

    @property
    def fit_error(self) -> float:
        """Fit error of the parameters, eq. (2), or its mean square for DIRANSAC; NaN if nothing could be simulated."""
        return self.evaluation.fit_error

    @property
    def inlier_fraction(self) -> float:
        """Number of inliers over the number of rows that count."""
        return self.evaluation.inlier_fraction

    @property
    def inliers(self) -> BoolArray:
        """Inliers ``(N,)`` among the rows of the given logs, log after log."""
        return self.evaluation.inliers

    # ------------------------------------------------------------------ logs

    def log_rows(self, i: int) -> slice:
        """Rows of log ``i`` among the rows of all logs."""
        begin = sum(log.n_rows for log in self.logs[:i])
        return slice(begin, begin + self.logs[i].n_rows)

    @property
    def inlier_times(self) -> FloatArray:
        """Time of every inlier in its own log, s."""
        parts = [log.start + log.dt * np.flatnonzero(self.inliers[self.log_rows(i)]) for i, log in enumerate(self.logs)]
        return np.concatenate(parts)

    # ------------------------------------------------------------------ files

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON; `from_dict` reads it back."""
        estimate = dump(self.estimate)
        if not self.layout.is_shared:
            full = {f"{key}_of_logs": estimate[key] for key in _BY_LOG}
            estimate |= full | dump(
                _Public(self.parameters, self.covariance, {n: np.array(x) for n, x in self.per_log.items()})
            )
        return {
            "format": _FORMAT,
            **estimate,
            **dump(self.evaluation),
            # Its notes hold the estimate's, too.
            **dump(_Provenance(**{n: getattr(self, n) for n in _Provenance.__dataclass_fields__})),
            **dump(self._derived()),
            "settings": self.settings.to_dict(),
            "model": self.model.to_dict(),
        }

    def _derived(self) -> _Derived:
        return _Derived(
            self.units,
            self.standard_errors,
            self.intervals(),
            self.structural_intervals() if self.has_structure else None,
            self.structure if self.has_structure else None,
            self.violations,
            self.verdict,
            self.findings,
        )

    @classmethod
    def from_dict(cls, data: object) -> Result:
        """Result from the mapping that `to_dict` returned.

        Parameters
        ----------
        data : object
            Decoded JSON.

        Returns
        -------
        Result

        Raises
        ------
        ResultError
            The data are of another format, or damaged.
        """
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
        try:
            return cls._from_checked({**_SINCE.get(found, {}), **data})
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
            reason = str(error).partition("\n")[0]
            raise ResultError(
                f"the result is damaged: {type(error).__name__} at {reason:.200}; identify again"
            ) from error

    @classmethod
    def _from_checked(cls, data: Mapping[str, Any]) -> Result:
        data = {**data, **{key: data[f"{key}_of_logs"] for key in _BY_LOG if f"{key}_of_logs" in data}}
        model, plain = Model.from_dict(data["model"]), load(_Provenance, data)
        estimate, evaluation = load(Estimate, data), load(Evaluation, data)
        layout = ParameterLayout(model.parameters, len(plain.logs))
        if tuple(estimate.parameters) != layout.names or not np.isfinite(estimate.values).all():
            raise ValueError(f"parameters {', '.join(estimate.parameters)}")
        n_rows = sum(log.n_rows for log in plain.logs)
        masks = [] if estimate.diagnosis is None else estimate.diagnosis.outliers.values()
        if any(len(mask) != n_rows for mask in (evaluation.inliers, *masks)):
            raise ValueError(f"a mask of other than {n_rows} rows")
        if estimate.diagnosis is not None:
            estimate.diagnosis.check_windows()
        check_terms(estimate.possible_terms or ())
        if not _is_covariance(estimate.covariance):
            raise ValueError("covariance: it is that of no distribution")
        _check_resolution(estimate.resolution, model.n_u)
        if not 1 <= estimate.degrees_of_freedom <= 2**53:
            raise ValueError(f"{estimate.degrees_of_freedom} degrees of freedom")
        for log in plain.logs:
            if not (log.n_rows > 0 and 0.0 < log.dt < np.inf and np.isfinite(log.start)):
                raise ValueError(f"a log of {log.n_rows} rows, {log.dt} s apart")
        settings = Settings.from_dict(data["settings"])
        found = cls(model, estimate=estimate, evaluation=evaluation, settings=settings, **vars(plain))
        found._derived(), str(found)  # fail where names and figures do not fit together
        return found

    def save(self, path: str | Path) -> None:
        """Write the result as JSON, atomically.

        Parameters
        ----------
        path : str or Path

        Raises
        ------
        ResultError
            The file cannot be written.
        """
        _write(path, self._text())

    @classmethod
    def load(cls, path: str | Path) -> Result:
        """Result from a file that `save` wrote.

        Parameters
        ----------
        path : str or Path

        Returns
        -------
        Result

        Raises
        ------
        ResultError
            There is no such file, or it does not contain a result; the message names the file.
        """
        try:
            data = json_data(read_text(path))
        except OSError as error:
            raise ResultError(f"{path}: cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise ResultError(f"{path}: is no JSON: {error}") from error
        try:
            return cls.from_dict(data)
        except DiransacError as error:
            raise ResultError(f"{path}: {error}") from error

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Result) and self._text() == other._text()

    def __hash__(self) -> int:
        return hash((self.model, self.method, self.seed, self.fit_error))

    def _text(self) -> str:
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    def __repr__(self) -> str:
        values = ", ".join(f"{name}={value:.4g}" for name, value in self.parameters.items())
        return f"<Result of {self.method} for {self.model.name}: {values}; {self.verdict}>"

    def _repr_html_(self) -> str:
        """Parameters, verdict and the findings against the result, as a notebook shows them."""
        from html import escape

        header, *rows = ([escape(cell) for cell in row] for row in self._cells())
        table = "".join(f"<tr>{''.join(f'<td>{cell}</td>' for cell in row)}</tr>" for row in rows)
        findings = "".join(f"<li>{escape(x)}</li>" for x in shown_lines(self.findings))
        return (
            f"<p>{escape(self._headline())}: <strong>{self.verdict}</strong></p>"
            f"<table><tr>{''.join(f'<th>{cell}</th>' for cell in header)}</tr>{table}</table>"
            + (f"<ul>{findings}</ul>" if findings else "")
            + f"<p>{escape(next_line(self.findings))}</p>"
        )

    def __str__(self) -> str:
        parts = (self._headline(), *aligned(self._cells()), *self._prior_lines(), self._summary())
        return "\n".join([*parts, *self._diagnosed(), *self._assessed()])

    def _headline(self) -> str:
        many = len(self.logs) > 1
        seconds = sum(log.dt * (log.n_rows - 1) for log in self.logs)
        source = f"{len(self.logs)} logs" if many else self.logs[0].source
        rates = sorted({f"{1.0 / log.dt:.4g}" for log in self.logs}, key=float)
        rate = rates[0] if len(rates) == 1 else f"{rates[0]} to {rates[-1]}"
        return f"{self.model.name} by {self.method} from {source} ({seconds:.4g} s at {rate} Hz)"

    def _cells(self) -> list[tuple[str, ...]]:
        """Header and rows of the table of parameters."""
        columns = {"95 % interval": self.intervals()}
        if self.has_structure:
            columns = {
                "95 % interval if the model is complete": self.intervals(),
                "if it may lack a term": self.structural_intervals(),
            }
        rows = [("parameter", "estimate", *columns, "unit")]
        for name in self.parameters:
            intervals = [self._interval(name, *x[name]) for x in columns.values()]
            estimate = "?" if name in self.unidentifiable else f"{self.parameters[name]:.6g}"
            varies = not self.layout.is_shared and self.model.parameters[name].per_log
            averaged = varies and name not in self.fixed
            rows.append((f"{name} (mean of logs)" if averaged else name, estimate, *intervals, self.units[name]))
        return rows

    def _interval(self, name: str, low: float, high: float) -> str:
        """An interval of a parameter as text."""
        digits = telling_digits(low, high)
        interval = f"{low:.{digits}g} .. {high:.{digits}g}" if np.isfinite(high - low) else "unknown"
        return "fixed" if name in self.fixed else interval

    def _prior_lines(self) -> list[str]:
        """The priors, in a line; none without them."""
        texts = [f"{n} = {mean:.6g} ± {std:.2g} {self.units[n]}" for n, (mean, std) in self.priors.items()]
        return [f"prior of {'; '.join(texts)}"] if texts else []

    def _summary(self) -> str:
        whole = "" if self.diagnosis is None else "in one simulation of the whole log: "
        parts = [f"{whole}fit error {self.fit_error:.4g}", f"inliers {100.0 * self.inlier_fraction:.1f} %"]
        if self.estimate.resolution.interpolation:
            parts.append(self.estimate.resolution.interpolation)
        parts.append(f"fitted to {self.n_fitted} rows")
        if self.iterations:
            rejected = ", ".join(f"{n} {reason}" for reason, n in self.rejected.items())
            parts.append(f"{self.iterations} sample{'s' if self.iterations > 1 else ''}, {self.stop_reason}")
            parts.append(f"{self.n_hypotheses} hypotheses" + (f" ({rejected})" if rejected else ""))
        return "; ".join(parts)

    def _diagnosed(self) -> list[str]:
        """Tables of the logs, and of noise, outliers and unexplained accelerations."""
        lines = [] if len(self.logs) == 1 else ["", *aligned(self._log_lines())]
        return lines if self.diagnosis is None else [*lines, "", *aligned(self.diagnosis.lines(self.model.units)), ""]

    def _log_lines(self) -> list[list[str]]:
        """Rows of a table: log, duration, fit error, inliers, per-log parameters."""
        own, errors = self.per_log, self.per_log_standard_errors
        rows = [
            ["log", "s", "fit error", "inliers", *(f"{name} ± standard error [{self.units[name]}]" for name in own)]
        ]
        for i, log in enumerate(self.logs):
            inliers = f"{100.0 * log.inlier_fraction:.1f} %"
            values = [f"{x[i]:.5g} ± {errors[name][i]:.2g}" for name, x in own.items()]
            rows.append([log.source, f"{log.dt * (log.n_rows - 1):.4g}", f"{log.fit_error:.4g}", inliers, *values])
        return rows

    def _assessed(self) -> list[str]:
        """The verdict, the findings against the result, sensitivities and notes."""
        lines = [f"verdict: {self.verdict}", *shown_lines(self.findings)]
        for name, (half, double) in (self.bandwidth_sensitivity or {}).items():
            lines.append(
                f"  {name}: {100 * half:+.2g} % at half the filter's bandwidth, {100 * double:+.2g} % at twice"
            )
        if self.competition is not None:
            lines.append(f"  {self.competition.sentence()}")
        remarks = [log.remark for log in self.logs]
        lines += [f"  {note}" for note in self.notes if note not in remarks]
        return [*lines, *(f"? {suggestion.change}" for suggestion in self.suggestions), next_line(self.findings)]
