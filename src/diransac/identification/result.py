"""`Result`: an estimate with its evaluation and provenance; printed as a table, saved as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar, cast

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.dataset import ParameterLayout
from diransac.data.log import Log
from diransac.errors import DiransacError, ResultError, SettingsError
from diransac.identification import result_files
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.estimate import Competition, Estimate, Evaluation, LogSummary, Predictions
from diransac.identification.evaluation.findings import findings_of
from diransac.identification.finding import Finding, Verdict, verdict_of
from diransac.identification.regression.uncertainty import student_quantile, students_draws, two_sided
from diransac.identification.result_text import html_of, text_of
from diransac.identification.serialization import Form, NumberPairs
from diransac.identification.settings import Settings
from diransac.identification.structure.lacking_terms import (
    PossibleTerm,
    StructuralUncertainty,
    Suggestion,
    largest,
    mixture_intervals,
)
from diransac.model import Model
from diransac.model.parameter import parameter_of
from diransac.plain_data import json_data, read_text

T = TypeVar("T")


class _Of(Generic[T]):
    """An attribute of a part of a result, under the same name."""

    def __init__(self, part: str) -> None:
        self._part = part

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, result: Any, owner: type) -> T:
        return cast("T", self if result is None else getattr(getattr(result, self._part), self._name))


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
    predictions : Predictions, optional
        Open-loop predictions of the logs; None where they were not scored.
    """

    model: Annotated[Model, Form(lambda model: model.to_dict(), result_files.model_of)]
    method: str
    seed: int
    settings: Annotated[Settings, Form(Settings.to_dict, Settings.from_dict)]
    estimate: Estimate
    evaluation: Evaluation
    logs: tuple[LogSummary, ...]
    notes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    bandwidth_sensitivity: NumberPairs | None = None
    fixed: tuple[str, ...] = ()
    priors: NumberPairs = field(default_factory=dict)
    predictions: Predictions | None = None

    degrees_of_freedom = _Of[int]("estimate")
    """Degrees of freedom of the covariance."""
    n_fitted = _Of[int]("estimate")
    """Number of observations that the parameters were fitted to: of a sample, or of a set of inliers."""
    estimator = _Of[str]("estimate")
    """Name of the estimator."""
    iterations = _Of[int]("estimate")
    """Number of samples drawn, the paper's k."""
    n_hypotheses = _Of[int]("estimate")
    """Number of hypotheses evaluated, refits included."""
    rejected = _Of[Mapping[str, int]]("estimate")
    """Number of rejected hypotheses by reason."""
    stop_reason = _Of[str]("estimate")
    """Reason why the search ended."""
    diagnosis = _Of[Diagnosis | None]("estimate")
    """Noise, faults and unmodelled forces, from lo-diransac."""
    suggestions = _Of[tuple[Suggestion, ...]]("estimate")
    """Terms that would explain the unmodelled forces, the most likely first; from lo-diransac."""
    competition = _Of[Competition | None]("estimate")
    """Comparison of estimates by held-out prediction, from lo-diransac; None where there was no need of one."""
    fit_error = _Of[float]("evaluation")
    """Fit error of the parameters, eq. (2), or its mean square for DIRANSAC; NaN if nothing could be simulated."""
    inlier_fraction = _Of[float]("evaluation")
    """Number of inliers over the number of rows that count."""
    inliers = _Of[BoolArray]("evaluation")
    """Inliers ``(N,)`` among the rows of the given logs, log after log."""

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
        """Index of a log among those identified from, or None.  Raises SettingsError: what is given is no log."""
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
        quantile = partial(student_quantile, self.degrees_of_freedom)
        return two_sided(level, quantile, self.parameters, self.standard_errors)

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
        return result_files.export(self, path, into, to, name)

    @property
    def violations(self) -> tuple[str, ...]:
        """Names of the parameters outside their bounds (never with a RANSAC method)."""
        return self.layout.violations(self.estimate.values)

    @property
    def on_bounds(self) -> tuple[str, ...]:
        """Names of the parameters on one of their bounds, where the estimator stopped: their intervals are unknown."""
        layout = self.layout
        stuck = zip(layout.names, layout.owners, layout.on_bounds(self.estimate.values), strict=True)
        return tuple(n for n, owner, on_bound in stuck if on_bound and owner not in self.fixed)

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

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Parameters that the logs do not determine, as lo-diransac finds; a per-log one if it is so in any log."""
        found = () if self.diagnosis is None else self.diagnosis.unidentifiable
        return tuple(dict.fromkeys(parameter_of(name, self.model.parameters) for name in found))

    @property
    def known_up_to(self) -> list[tuple[tuple[str, ...], str]]:
        """Parameters that only a combination of which is determined, with a sentence; they have no intervals alone."""
        return [] if self.diagnosis is None else list(self.diagnosis.known_up_to)

    @property
    def noise(self) -> Mapping[str, float]:
        """Standard deviation of the noise of each signal, and of the inputs that show it; empty without a diagnosis."""
        return {} if self.diagnosis is None else {**self.diagnosis.noise_std, **self.diagnosis.input_noise}

    @property
    def separates_forces(self) -> bool:
        """True if the method separates unmodelled forces from noise; a simulation of a whole log adds them up."""
        return self.diagnosis is not None

    def log_rows(self, i: int) -> slice:
        """Rows of log ``i`` among the rows of all logs."""
        begin = sum(log.n_rows for log in self.logs[:i])
        return slice(begin, begin + self.logs[i].n_rows)

    @property
    def inlier_times(self) -> FloatArray:
        """Time of every inlier in its own log, s."""
        parts = [log.start + log.dt * np.flatnonzero(self.inliers[self.log_rows(i)]) for i, log in enumerate(self.logs)]
        return np.concatenate(parts)

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON; `from_dict` reads it back."""
        return result_files.as_dict(self)

    @classmethod
    def from_dict(cls, data: object) -> Result:
        """Result from the mapping that `to_dict` returned.

        Raises ResultError: the data are of another format, or damaged.
        """
        return result_files.from_data(data, cls)

    def save(self, path: str | Path) -> None:
        """Write the result as JSON, atomically.  Raises ResultError: the file cannot be written."""
        result_files.write(path, self._text())

    @classmethod
    def load(cls, path: str | Path) -> Result:
        """Result from a file that `save` wrote.

        Raises ResultError: there is no such file, or it contains no result; the message names the file.
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

    def __str__(self) -> str:
        return text_of(self)

    def _repr_html_(self) -> str:
        """Parameters, verdict and the findings against the result, as a notebook shows them."""
        return html_of(self)
