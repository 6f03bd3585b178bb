"""`Estimate`: parameters and covariance that a method returns, with its comparisons; `Evaluation`: its agreement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.identification.diagnosis import Diagnosis, Resolution
from diransac.identification.finding import Finding
from diransac.identification.serialization import Mask, Number, Numbers, Values
from diransac.identification.structure.lacking_terms import PossibleTerm, Suggestion

TIME_LIMIT = "time limit reached"
"""Stop reason of a search that a limit on its time ended."""
TELLING = 0.1
"""Sensitivity of predictions to 1 % of the parameters and to the start, up to which a horizon tells models apart."""


@dataclass(frozen=True)
class Competitor:
    """An estimate that took part in the comparison of predictions.

    Parameters
    ----------
    name : str
        Source and variant.
    errors : tuple of float
        Root mean square error of the predicted samples at each horizon, over that of the better trivial prediction:
        that nothing changes, or the median.
    score : float
        Geometric mean of the losses of held-out blocks, of predicted motion and of predicted forces; lower is better.
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


def predicts(errors: Sequence[float] | FloatArray) -> bool:
    """True if an error at one of the horizons is less than half of that of a trivial prediction."""
    return bool(np.min(errors) < 0.5)


def _error(error: float) -> str:
    """An error in a table; that of a simulation that diverges is no number."""
    return f"{error:.2g}" if np.isfinite(error) else "diverges"


@dataclass(frozen=True)
class Competition:
    """Comparison of estimates by the prediction of blocks of the logs that they were not estimated from.

    Parameters
    ----------
    winner : str
        Name of the estimate that predicts best, whose parameters are the result; no two have the same.
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
        return predicts(next(x for x in self.competitors if x.name == self.winner).errors)

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
        Delay of the inputs, s, all of it or, by simulation error, what exceeds that of all logs; its standard error is
        infinite where it is not estimated.
    degrees_of_freedom : int, optional
        Of the standard errors.
    """

    parameters: Values
    standard_errors: Values
    input_delay: Number = 0.0
    input_delay_error: Number = np.inf
    degrees_of_freedom: int = 10_000


@dataclass(frozen=True)
class Disagreement:
    """Other parameters that a part of the logs gives: one half, or one of several logs.

    Parameters
    ----------
    claim : str
        What was found, without a stop.
    action : str
        What to do about it.
    name : str
        Parameter that differs most; empty where it is the delay of the inputs.
    parameters : mapping of str to float
        Parameters of that part, by name.
    input_delay : float, optional
        Further delay of the inputs, s.
    log : int, optional
        Index of the log that disagrees; -1: a part of all logs.
    effect : float, optional
        RMS change of predictions by these parameters, over the error of the better trivial prediction in excess of the
        noise; 0 below the noise, NaN where no prediction was scored.
    """

    claim: str
    action: str
    name: str
    parameters: Values
    input_delay: Number = 0.0
    log: int = -1
    effect: Number = np.nan


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
    disagreements : tuple of Disagreement, optional
        Parts of the logs that give other parameters.
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
    resolution: Resolution = field(default_factory=Resolution)
    squared_error: bool = False
    notes: tuple[str, ...] = ()
    diagnosis: Diagnosis | None = None
    checks: tuple[Finding, ...] = ()
    disagreements: tuple[Disagreement, ...] = ()
    mistakes: tuple[Finding, ...] = ()
    n_columns_tested: int = 0
    suggestions: tuple[Suggestion, ...] = ()
    competition: Competition | None = None
    possible_terms: tuple[PossibleTerm, ...] | None = None

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
class HorizonScores:
    """Open-loop prediction at one horizon, by signal.

    Robust scores leave out outliers: samples further than six standard deviations of the noise from the motion as it
    is smoothed without the model, so that no error of the model is one.

    Parameters
    ----------
    horizon : float
        Time after which the simulation restarts, s; infinite: never.
    windows : int
        Number of simulations that were scored.
    diverged : int
        Number of simulations that became infinite, which makes the scores infinite.
    rmse : mapping of str to float
        Root mean squared error of each signal, its unit.
    fit_percent : mapping of str to float
        ``100 (1 - |y - y_sim| / |y - mean(y)|)``.
    r_squared : mapping of str to float
        ``1 - sum (y - y_sim)^2 / sum (y - mean(y))^2``.
    robust_rmse : mapping of str to float
        The first without outliers.
    hold_last : mapping of str to float
        RMSE, without outliers, of the prediction that nothing changes after the start of a window.
    constant_velocity : mapping of str to float
        RMSE, without outliers, of the prediction that every coordinate goes on at the velocity of the start.
    relative_error : mapping of str to float
        Of each state and sensor that moves: RMSE in excess of the noise and of the effect of uncertain starts, over the
        excess of the better of these two predictions.  0: perfect; 1: no better than a trivial prediction.
    sensitivity : mapping of str to float
        Of each state and sensor that moves: RMS effect on the prediction of 1 % changes of the parameters, of random
        signs, and of uncertain starts, over the same excess.
    of_starts : mapping of str to float
        The part of uncertain starts in it, an error up to which cannot be seen.
    """

    horizon: Number
    windows: int
    diverged: int
    rmse: Values
    fit_percent: Values
    r_squared: Values
    robust_rmse: Values
    hold_last: Values
    constant_velocity: Values
    relative_error: Values
    sensitivity: Values
    of_starts: Values

    @property
    def name(self) -> str:
        """The horizon in words."""
        return "whole log" if np.isinf(self.horizon) else f"{self.horizon:g} s"


@dataclass(frozen=True)
class Predictions:
    """Open-loop predictions of logs at several horizons, the shortest first, and the one that is judged.

    Parameters
    ----------
    horizons : tuple of HorizonScores
    asked : int
        Index of the judged horizon: the requested one, else the longest over which predictions tell models apart.
    outlier_fraction : mapping of str to float
        Part of each signal's samples that robust scores leave out.
    sensors : tuple of str
        Those signals that are sensors.
    unsmoothed : tuple of str
        Names of the logs that are too short to be smoothed: their windows start at recorded samples, with their noise.
    """

    horizons: tuple[HorizonScores, ...]
    asked: int
    outlier_fraction: Values
    sensors: tuple[str, ...]
    unsmoothed: tuple[str, ...]

    @property
    def judged(self) -> HorizonScores:
        """Scores of the judged horizon."""
        return self.horizons[self.asked]


@dataclass(frozen=True)
class Prediction:
    """Accelerations of one log that the model does not explain, rows that count, and the weakest window.

    Parameters
    ----------
    unexplained : mapping of str to float
        Share of each acceleration that the model leaves unexplained; empty where that is unknown.
    n_rows, n_excluded : int
        Number of rows that count, and of those in which a required signal is missing.
    weakest_window : tuple of float
        Beginning and end of the window of the log with the lowest inlier fraction, s, and that fraction.
    """

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
