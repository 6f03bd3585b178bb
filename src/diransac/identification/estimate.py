"""`Estimate`: the parameters that a method found, with everything that it found beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.serialization import (
    Mask,
    Masks,
    Number,
    Numbers,
    Series,
    Values,
    WholeNumbers,
)

__all__ = ["Diagnosis", "Estimate", "Evaluation", "LogSummary", "Resolution"]


@dataclass(frozen=True)
class Resolution:
    """Integrator and integration steps per sample of a simulation."""

    integrator: str = "rk4"
    substeps: int = 1


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Faults of the logs, and forces that the model lacks, as lo-diransac separates them.

    Samples are the rows of the logs as they were given, log after log.  Windows are the W intervals over which
    unmodelled accelerations are constant.

    Parameters
    ----------
    noise_std : signal -> standard deviation of its Gaussian noise, its unit; of the measured signals
    outlier_fraction : signal -> fraction of its samples that are outliers
    outliers : signal -> (N,) samples that are more likely outliers than not: sensor faults
    window_log : (W,)   index of the log that each window belongs to
    unmodelled_time : (W,)   s, middle of each window, time of its log
    unmodelled_accelerations : acceleration -> (W,), its unit: the part that the model does not explain
    unmodelled_forces : the same as generalised forces, N where a coordinate is in m, N m where it is in rad; empty
        where the model's equations are no balance of forces
    smoothed_time : (W,)   s, first row of each window
    smoothed_states : state -> (W,)   the most probable states at those times, measured or not
    input_delay, input_delay_error : s by which the inputs act later than the log has them; its standard error
    input_delay_significant : whether that exceeds errors of estimation
    unidentifiable : names of the parameters that the logs do not determine
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

    def __post_init__(self) -> None:
        series = [self.window_log, self.unmodelled_time, self.smoothed_time]
        for name in (
            "noise_std",
            "outlier_fraction",
            "outliers",
            "unmodelled_accelerations",
            "unmodelled_forces",
            "smoothed_states",
        ):
            values = dict(getattr(self, name))
            series += [x for x in values.values() if isinstance(x, np.ndarray)]
            object.__setattr__(self, name, MappingProxyType(values))
        for array in series:
            array.setflags(write=False)

    def windows_of(self, log: int) -> IntArray:
        """Indices of the windows of one log."""
        return np.flatnonzero(self.window_log == log)

    def first_states(self, log: int) -> dict[str, float]:
        """Most probable state at the first row of one log, by name."""
        first = self.windows_of(log)[0]
        return {name: float(values[first]) for name, values in self.smoothed_states.items()}

    def lines(self, units: Mapping[str, str]) -> list[list[str]]:
        """Rows of a table: signal, noise, outliers, and the RMS that the model does not explain.

        Parameters
        ----------
        units : unit of each signal
        """
        rows = [["signal", "noise", "outliers", "unexplained", "unit"]]
        for name in dict.fromkeys((*self.noise_std, *self.unmodelled_accelerations)):
            measured, latent = name in self.noise_std, self.unmodelled_accelerations.get(name)
            noise = f"{self.noise_std[name]:.2g}" if measured else ""
            fraction = f"{100.0 * self.outlier_fraction[name]:.1f} %" if measured else ""
            unexplained = "" if latent is None else f"{np.sqrt(np.mean(np.square(latent))):.2g}"
            rows.append([name, noise, fraction, unexplained, units[name]])
        return rows


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters of a model, their covariance, and how a method came to them.

    Parameters
    ----------
    parameters : name -> value; ``bias[0]``, ``bias[1]``, ... for a per-log parameter of several logs
    covariance : (n, n)   of these; infinite where the logs do not determine a parameter
    degrees_of_freedom : of that covariance, for intervals
    n_fitted : observations that the parameters were fitted to
    estimator : name of what fitted them
    iterations : k, samples drawn
    n_hypotheses : hypotheses judged, refits included
    stop_reason : why the search ended
    rejected : hypotheses that went no further, by reason
    resolution : of the simulation that fitted, in which an evaluation simulates
    squared_error : whether the fit error is DIRANSAC's mean square rather than eq. (2)
    notes : what was found and done, a sentence each
    diagnosis : lo-diransac's
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
    fit_error : eq. (2) over all logs (DIRANSAC's mean square with its method); NaN where nothing could be simulated,
        infinite where the simulation diverged
    inlier_fraction : inliers over the rows that count
    inliers : (N,)   over the rows of the logs that were given, log after log
    fit_errors, inlier_fractions : (n_logs,)   the same of each log alone
    """

    fit_error: Number
    inlier_fraction: Number
    inliers: Mask
    fit_errors: Numbers
    inlier_fractions: Numbers

    def __post_init__(self) -> None:
        inliers: BoolArray = np.array(self.inliers, bool)
        inliers.setflags(write=False)
        object.__setattr__(self, "inliers", inliers)


@dataclass(frozen=True)
class LogSummary:
    """A log that was identified from.

    Parameters
    ----------
    source : how messages name it
    fingerprint : SHA-256 of its samples
    start, dt : first time and sampling time, s
    n_rows : rows
    preparation : what was done to it, in order
    fit_error, inlier_fraction : of the simulation of this log
    remark : empty, or how its own estimate disagrees with those of the other logs
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
