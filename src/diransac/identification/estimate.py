"""`Estimate`: parameters, covariance and diagnosis that a method returns; `Evaluation`: its simulation's agreement.

`Finding` is a sentence for or against a result, with its level.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.data.input_timing import InputTiming
from diransac.identification.serialization import (
    Mask,
    Masks,
    Number,
    Numbers,
    Series,
    Values,
    WholeNumbers,
)
from diransac.identification.structure import PossibleTerm
from diransac.identification.suggestions import Suggestion

__all__ = [
    "TIME_LIMIT",
    "Competition",
    "Competitor",
    "Diagnosis",
    "Estimate",
    "Evaluation",
    "Finding",
    "Level",
    "LogEstimate",
    "LogSummary",
    "Prediction",
    "Resolution",
]

_LARGEST, _PREDICTS = 1e150, 0.5
"""Bound of figures of windows; their squares are finite."""

TIME_LIMIT = "time limit reached"
"""Stop reason of a search that a limit on its time ended."""

Level = Literal["note", "good", "care", "bad"]
"""Levels of findings, the least serious first."""


class Finding(str):
    """A sentence for or against a result: a string with a level and an action.

    Parameters
    ----------
    level : {"note", "good", "care", "bad"}
        ``good`` supports the result, ``care`` and ``bad`` oppose it, a ``note`` is neutral.
    claim : str
        What was found: a sentence, without a stop where an action follows.
    action : str, optional
        What to do about it, in the imperative; the sentence ends with it.

    Raises
    ------
    ValueError
        There is no such level.
    """

    level: Level
    action: str

    def __new__(cls, level: Level, claim: str, action: str = "") -> Finding:
        """A finding of a level."""
        if level not in get_args(Level):
            raise ValueError(f"level {level!r} of a finding; there are {', '.join(get_args(Level))}")
        made = super().__new__(cls, f"{claim}; {action}." if action else claim)
        made.level, made.action = level, action
        return made

    @property
    def claim(self) -> str:
        """The sentence without the action."""
        return self.removesuffix(f"; {self.action}.") if self.action else str(self)

    def __getnewargs__(self) -> tuple[Level, str, str]:  # type: ignore[override]  # a string's are its text alone
        return self.level, self.claim, self.action

    def __repr__(self) -> str:
        return f"Finding({self.level!r}, {self.claim!r}, {self.action!r})"

    @property
    def seriousness(self) -> int:
        """Place of the level among the levels: 0 for a note, 3 for bad."""
        return get_args(Level).index(self.level)

    def to_dict(self) -> dict[str, str]:
        """Form in JSON: level, the whole sentence, and the action at its end."""
        return {"level": self.level, "text": str(self), "action": self.action}

    @classmethod
    def _from_dict(cls, data: Mapping[str, Any]) -> Finding:
        """The finding of `to_dict`; those of earlier versions have no action."""
        action = data.get("action", "")
        return cls(data["level"], data["text"].removesuffix(f"; {action}.") if action else data["text"], action)

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: object, _handler: object) -> Any:
        """Form in JSON: that of `to_dict`."""
        from pydantic_core import core_schema

        text = core_schema.str_schema(strict=True)
        fields = {
            "level": core_schema.typed_dict_field(core_schema.literal_schema(list(get_args(Level)))),
            "text": core_schema.typed_dict_field(text),
            "action": core_schema.typed_dict_field(text, required=False),
        }
        return core_schema.no_info_after_validator_function(
            cls._from_dict,
            core_schema.typed_dict_schema(fields),
            serialization=core_schema.plain_serializer_function_ser_schema(lambda found: found.to_dict()),
        )


@dataclass(frozen=True)
class Resolution:
    """Integration and inputs of a simulation.

    Parameters
    ----------
    integrator : str, optional
        "rk4", "euler" or "semi-implicit-euler".
    substeps : int, optional
        Integration steps per sample.
    hold : str, optional
        Inputs between samples: "zero-order", held; "linear" or "smooth", interpolated.
    timing : InputTiming, optional
        Delay and lag after which recorded inputs act.
    """

    integrator: str = "rk4"
    substeps: int = 1
    hold: str = "zero-order"
    timing: InputTiming = field(default_factory=InputTiming)

    @property
    def interpolation(self) -> str:
        """Interpolation of the inputs, in words; empty where they are held."""
        how = {"linear": "linearly", "smooth": "smoothly"}.get(self.hold)
        return f"inputs interpolated {how}" if how else ""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Sensor noise, outliers, unmodelled forces and input delay, as lo-diransac separates them.

    Samples are the rows of the logs as they were given, log after log.  Windows are the W intervals over which
    unmodelled accelerations are constant.

    Parameters
    ----------
    noise_std : mapping of str to float
        Standard deviation of the Gaussian noise of each measured signal, its unit.
    outlier_fraction : mapping of str to float
        Fraction of the samples of each signal that are outliers.
    outliers : mapping of str to (N,) bool array
        Samples of each signal that are outliers with a probability above one half.
    window_log : (W,) int array
        Index of the log of each window.
    unmodelled_time : (W,) array
        Middle of each window in the time of its log, s.
    unmodelled_accelerations : mapping of str to (W,) array
        Part of each acceleration that the model does not explain, its unit.
    unmodelled_forces : mapping of str to (W,) array
        The generalised force of each, N where the coordinate is in m, N m where it is in rad; empty where the model's
        equations are not a balance of forces.
    smoothed_time : (W,) array
        First row of each window, s.
    smoothed_states : mapping of str to (W,) array
        Most probable value of each state at those times, measured or not.
    input_delay, input_delay_error : float
        Delay of the inputs with respect to the log, lag included, and its standard error, s.
    input_delay_significant : bool
        Whether the delay exceeds three standard errors and a quarter of a sample.
    unidentifiable : tuple of str
        Names of the parameters that the logs do not determine.
    combinations : tuple of str, optional
        Sentences about these parameters: the combinations that are determined, the reason, the remedy.
    suggested_terms : mapping of str to (W,) array, optional
        What suggested terms explain of each unmodelled force, or of each acceleration where there are no forces, beside
        the parameters that would change with them; empty without suggestions.
    """

    noise_std: Values
    outlier_fraction: Values
    outliers: Masks
    window_log: WholeNumbers
    unmodelled_time: Numbers
    unmodelled_accelerations: Series
    unmodelled_forces: Series
    smoothed_time: Numbers
    smoothed_states: Series
    input_delay: Number
    input_delay_error: Number
    input_delay_significant: bool
    unidentifiable: tuple[str, ...]
    combinations: tuple[str, ...] = ()
    suggested_terms: Series = field(default_factory=dict)

    def __post_init__(self) -> None:
        series = [self.window_log, self.unmodelled_time, self.smoothed_time]
        for name in (
            "noise_std",
            "outlier_fraction",
            "outliers",
            "unmodelled_accelerations",
            "unmodelled_forces",
            "suggested_terms",
            "smoothed_states",
        ):
            values = dict(getattr(self, name))
            series += [x for x in values.values() if isinstance(x, np.ndarray)]
            object.__setattr__(self, name, MappingProxyType(values))
        for array in series:
            array.setflags(write=False)

    def check_windows(self) -> None:
        """Raise ValueError: the figures of windows are not as many as these, or squares of them overflow."""
        named = (self.unmodelled_accelerations, self.unmodelled_forces, self.suggested_terms, self.smoothed_states)
        figures = (self.unmodelled_time, self.smoothed_time, *(x for values in named for x in values.values()))
        if any(len(x) != len(self.window_log) for x in figures):
            raise ValueError(f"figures of other than {len(self.window_log)} windows")
        if not all((np.abs(x) < _LARGEST).all() for x in figures):
            raise ValueError("figures of windows that no machine has")

    def windows_of(self, log: int) -> IntArray:
        """Indices of the windows of one log."""
        return np.flatnonzero(self.window_log == log)

    def of_log(self, log: int, rows: slice) -> Diagnosis:
        """The diagnosis of one log alone, whose rows among those of all logs are given."""
        windows = self.windows_of(log)
        return replace(
            self,
            outliers={name: mask[rows] for name, mask in self.outliers.items()},
            window_log=np.zeros_like(windows),
            unmodelled_time=self.unmodelled_time[windows],
            unmodelled_accelerations={n: x[windows] for n, x in self.unmodelled_accelerations.items()},
            unmodelled_forces={n: x[windows] for n, x in self.unmodelled_forces.items()},
            suggested_terms={n: x[windows] for n, x in self.suggested_terms.items()},
            smoothed_time=self.smoothed_time[windows],
            smoothed_states={n: x[windows] for n, x in self.smoothed_states.items()},
        )

    def first_states(self, log: int) -> dict[str, float]:
        """Most probable state at the first row of one log, by name."""
        first = self.windows_of(log)[0]
        return {name: float(values[first]) for name, values in self.smoothed_states.items()}

    def unidentifiable_sentences(self) -> tuple[str, ...]:
        """Sentences about the parameters that are not identifiable, without stops; empty where there is none."""
        each = (f"{name} is not identifiable from this log; excite it" for name in self.unidentifiable)
        return self.combinations or tuple(each)

    def lines(self, units: Mapping[str, str]) -> list[list[str]]:
        """Rows of a table: signal, noise, outliers, and the RMS that the model does not explain.

        Parameters
        ----------
        units : mapping of str to str
            Unit of each signal.

        Returns
        -------
        list of list of str
        """
        rows = [["signal", "noise", "outliers", "unexplained", "unit"]]
        for name in dict.fromkeys((*self.noise_std, *self.unmodelled_accelerations)):
            measured, latent = name in self.noise_std, self.unmodelled_accelerations.get(name)
            noise = f"{self.noise_std[name]:.2g}" if measured else ""
            fraction = f"{100.0 * self.outlier_fraction[name]:.1f} %" if measured else ""
            unexplained = "" if latent is None else f"{np.sqrt(np.mean(np.square(latent))):.2g}"
            rows.append([name, noise, fraction, unexplained, units[name]])
        return rows


@dataclass(frozen=True)
class Competitor:
    """An estimate that took part in the comparison of predictions.

    Parameters
    ----------
    name : str
        Source and variant.
    errors : tuple of float
        Root mean square error of the predicted samples at each horizon, over that of the prediction that nothing
        changes.
    score : float
        Mean loss of the predictions of held-out blocks; lower is better.
    as_good : bool
        Whether it predicts as well as the best, within the noise of the comparison.
    parameters : mapping of str to float
        Its parameters, each in its unit.
    """

    name: str
    errors: tuple[Number, ...]
    score: Number
    as_good: bool
    parameters: Values


def _error(error: float) -> str:
    """An error in a table; that of a simulation that diverges is no number."""
    return f"{error:.2g}" if np.isfinite(error) else "diverges"


@dataclass(frozen=True)
class Competition:
    """Comparison of estimates by the prediction of blocks of the logs that they were not estimated from.

    Parameters
    ----------
    winner : str
        Name of the estimate that predicts best; no two have the same.  The result is its mean with those that predict
        as well.
    horizons : tuple of float
        Horizons of the predictions, s.
    competitors : tuple of Competitor
    """

    winner: str
    horizons: tuple[Number, ...]
    competitors: tuple[Competitor, ...]

    @property
    def predicts(self) -> bool:
        """True if the winner predicts much better than that nothing changes, at one horizon at least."""
        return min(next(x for x in self.competitors if x.name == self.winner).errors) < _PREDICTS

    def lines(self) -> list[list[str]]:
        """Rows of a table: the best variant of each source, its errors at each horizon, and whether it is as good."""
        rows = [["estimate", *(f"{h:.2g} s" for h in self.horizons), ""]]
        for one in self._best_of_sources():
            said = "chosen" if one.name == self.winner else "as good" if one.as_good else ""
            rows.append([one.name, *map(_error, one.errors), said])
        return rows

    def sentence(self) -> str:
        """The winner, and the errors of the others, in a line."""
        middle = len(self.horizons) // 2
        best = self._best_of_sources()
        own = next(x for x in best if x.name == self.winner)
        others = ", ".join(f"{x.name} {_error(x.errors[middle])}" for x in best if x is not own)
        n = sum(x.as_good for x in self.competitors if x.name != self.winner)
        also = f" and {n} that predict as well" if n else ""
        text = f"held-out prediction over {self.horizons[middle]:.2g} s chose: {self.winner}{also}"
        error = f"error {own.errors[middle]:.2g} of that of no change"
        return f"{text}, {error}" + (f"; {others}" if others else "")

    def _best_of_sources(self) -> list[Competitor]:
        """The winner, and the best variant of every other source."""
        best: dict[str, Competitor] = {}
        for one in sorted(self.competitors, key=lambda x: (x.name != self.winner, x.score)):
            best.setdefault(one.name.partition(",")[0], one)
        return list(best.values())


@dataclass(frozen=True)
class LogEstimate:
    """Estimate from one of several logs alone.

    Parameters
    ----------
    parameters, standard_errors : mapping of str to float
        Each parameter, in its unit; its standard error is infinite where the log does not tell it.
    input_delay, input_delay_error : float, optional
        Delay of the inputs, s, beyond that of an estimate of all logs, and its standard error; infinite where it is not
        estimated.
    degrees_of_freedom : int, optional
        Of the standard errors.
    """

    parameters: Values
    standard_errors: Values
    input_delay: Number = 0.0
    input_delay_error: Number = np.inf
    degrees_of_freedom: int = 10_000


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters of a model, their covariance, and the search that found them.

    Parameters
    ----------
    parameters : mapping of str to float
        Value of each parameter in its unit; ``bias[0]``, ``bias[1]``, ... for a per-log parameter of several logs.
    covariance : (n, n) array
        Covariance of the parameters; infinite where one is not identifiable.
    degrees_of_freedom : int
        Degrees of freedom of the covariance, for intervals.
    n_fitted : int
        Number of observations that the parameters were fitted to.
    estimator : str
        Name of the estimator.
    iterations : int, optional
        Number of samples drawn, the paper's k.
    n_hypotheses : int, optional
        Number of hypotheses evaluated, refits included.
    stop_reason : str, optional
        Reason why the search ended; `TIME_LIMIT` where a limit on its time ended it.
    rejected : mapping of str to int, optional
        Number of rejected hypotheses by reason.
    resolution : Resolution, optional
        Integration and inputs of the simulation in the fit; `evaluate` simulates with the same.
    squared_error : bool, optional
        Whether the fit error is DIRANSAC's mean square rather than eq. (2).
    notes : tuple of str, optional
        Findings and changes, a sentence each.
    diagnosis : Diagnosis, optional
        Noise, outliers and unmodelled forces; of lo-diransac alone.
    checks : tuple of Finding, optional
        Findings of the method's own tests.
    mistakes : tuple of Finding, optional
        Mistakes of the logs' columns: units, signs, inputs that are zero.  A bad one explains all that is bad.
    n_columns_tested : int, optional
        Number of other signs and units of columns that were tested, and that explain the logs no better; 0 where they
        were not tested.
    suggestions : tuple of Suggestion, optional
        Terms that the model lacks, by the unmodelled forces; of lo-diransac alone.
    competition : Competition, optional
        Comparison with other estimates; None where the exact model predicts the logs within their noise.
    possible_terms : tuple of PossibleTerm, optional
        Terms that the model may lack, with their weights; None: they were not tested.
    of_logs : tuple of LogEstimate, optional
        Estimates from each of several logs alone; empty where they are not compared with each other, or a fit of each
        log is fast.
    """

    parameters: Values
    covariance: Numbers
    degrees_of_freedom: int
    n_fitted: int
    estimator: str
    iterations: int = 0
    n_hypotheses: int = 1
    stop_reason: str = "whole log fitted"
    rejected: Mapping[str, int] = field(default_factory=dict)
    resolution: Resolution = Resolution()
    squared_error: bool = False
    notes: tuple[str, ...] = ()
    diagnosis: Diagnosis | None = None
    checks: tuple[Finding, ...] = ()
    mistakes: tuple[Finding, ...] = ()
    n_columns_tested: int = 0
    suggestions: tuple[Suggestion, ...] = ()
    competition: Competition | None = None
    possible_terms: tuple[PossibleTerm, ...] | None = None
    of_logs: tuple[LogEstimate, ...] = ()

    def __post_init__(self) -> None:
        covariance = np.array(self.covariance, np.float64).reshape(len(self.parameters), len(self.parameters))
        covariance.setflags(write=False)
        object.__setattr__(self, "covariance", covariance)

    @property
    def values(self) -> FloatArray:
        """Parameters as a vector ``(n,)``."""
        return np.array(list(self.parameters.values()), np.float64)


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Agreement of one simulation of every log with the measured signals.

    Parameters
    ----------
    fit_error : float
        Error of eq. (2) over all logs, for DIRANSAC its mean square; NaN where a log lacks its initial state, infinite
        where the simulation diverged.
    inlier_fraction : float
        Number of inliers over the number of rows that count.
    inliers : (N,) bool array
        Inliers among the rows of the given logs, log after log.
    fit_errors, inlier_fractions : (n_logs,) array
        Fit error and inlier fraction of each log alone.
    thresholds : mapping of str to float
        Inlier threshold of each signal that has one, in its unit.
    """

    fit_error: Number
    inlier_fraction: Number
    inliers: Mask
    fit_errors: Numbers
    inlier_fractions: Numbers
    thresholds: Values = field(default_factory=dict)

    def __post_init__(self) -> None:
        inliers: BoolArray = np.array(self.inliers, bool)
        inliers.setflags(write=False)
        object.__setattr__(self, "inliers", inliers)


@dataclass(frozen=True)
class Prediction:
    """Agreement of the simulation of one log, which restarts periodically where the smoothed states are known.

    Parameters
    ----------
    restart_period : float
        Time after which the simulation restarts, s; infinite: one simulation of the whole log.
    divergence : float
        Time of the log at which the simulation becomes infinite, s; infinite if it does not.
    relative_errors : mapping of str to float
        Median absolute error of each signal with an inlier threshold, less that of its noise where that is known, over
        the range of the signal.
    unexplained : mapping of str to float
        Share of each acceleration that the model leaves unexplained; empty where that is unknown.
    n_rows, n_excluded : int
        Number of rows that count, and of those in which a required signal is missing.
    weakest_window : tuple of float
        Beginning and end of the window of the log with the lowest inlier fraction, s, and that fraction.
    """

    restart_period: Number
    divergence: Number
    relative_errors: Values
    unexplained: Values
    n_rows: int
    n_excluded: int
    weakest_window: tuple[Number, Number, Number]


@dataclass(frozen=True)
class LogSummary:
    """Provenance and scores of one log of an identification.

    Parameters
    ----------
    source : str
        Name of the log in messages.
    fingerprint : str
        SHA-256 of the samples.
    start, dt : float
        First time and sampling time, s.
    n_rows : int
        Number of rows.
    preparation : tuple of mapping of str to object, optional
        Preparation steps in order.
    fit_error, inlier_fraction : float, optional
        Scores of the simulation of this log.
    remark : str, optional
        Disagreement of this log's own estimate with those of the other logs; empty where they agree.
    prepared_fingerprint : str, optional
        Digest of the log after its preparation.
    prediction : Prediction, optional
        Agreement of the simulation of this log; None where it lacks its initial state.
    """

    source: str
    fingerprint: str
    start: Number
    dt: Number
    n_rows: int
    preparation: tuple[Mapping[str, object], ...] = ()
    fit_error: Number = np.nan
    inlier_fraction: Number = np.nan
    remark: str = ""
    prepared_fingerprint: str = ""
    prediction: Prediction | None = None
