"""`Diagnosis`: noise, outliers, unmodelled forces and input delay that a method finds; `Resolution` of its simulations.

`departures` are stretches of a log in which the model does not hold: on the ground, in somebody's hand, against a stop.
There the unmodelled accelerations are many times those of the rest of the log, over longer than a moment.  The robust
scale of the rest holds as long as it is more than half of the log.

References
----------
Rousseeuw, Croux 1993 (the median absolute deviation as a scale with a breakdown point of one half).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from diransac.arrays import FloatArray, IntArray, long_runs, robust_std, runs
from diransac.data.input_timing import InputTiming
from diransac.identification.serialization import Masks, Number, Numbers, Series, Values, WholeNumbers


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


# Series of a diagnosis with a value for each window.
_BY_WINDOW = ("unmodelled_accelerations", "unmodelled_forces", "suggested_terms", "smoothed_states")


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
    known_up_to : tuple of (tuple of str, str), optional
        Parameters of which only a combination is determined, and a sentence about each such group.
    suggested_terms : mapping of str to (W,) array, optional
        What suggested terms explain of each unmodelled force, or of each acceleration where there are no forces, beside
        the parameters that would change with them; empty without suggestions.
    input_noise : mapping of str to float, optional
        Standard deviation of the white noise of each input that shows it, its unit.
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
    known_up_to: tuple[tuple[tuple[str, ...], str], ...] = ()
    suggested_terms: Series = field(default_factory=dict)
    input_noise: Values = field(default_factory=dict)

    def __post_init__(self) -> None:
        series = [self.window_log, self.unmodelled_time, self.smoothed_time]
        for name in ("noise_std", "outlier_fraction", "outliers", "input_noise", *_BY_WINDOW):
            values = dict(getattr(self, name))
            series += [x for x in values.values() if isinstance(x, np.ndarray)]
            object.__setattr__(self, name, MappingProxyType(values))
        for array in series:
            array.setflags(write=False)

    def check_windows(self) -> None:
        """Raise ValueError: the figures of windows are not as many as these, or squares of them overflow."""
        named = (x for name in _BY_WINDOW for x in getattr(self, name).values())
        figures = (self.unmodelled_time, self.smoothed_time, *named)
        if any(len(x) != len(self.window_log) for x in figures):
            raise ValueError(f"figures of other than {len(self.window_log)} windows")
        if not all((np.abs(x) < 1e150).all() for x in figures):
            raise ValueError("figures of windows that no machine has")

    def windows_of(self, log: int) -> IntArray:
        """Indices of the windows of one log."""
        return np.flatnonzero(self.window_log == log)

    def of_log(self, log: int, rows: slice) -> Diagnosis:
        """The diagnosis of one log alone, whose rows among those of all logs are given."""
        windows = self.windows_of(log)
        series: Any = {name: {n: x[windows] for n, x in getattr(self, name).items()} for name in _BY_WINDOW}
        return replace(
            self,
            outliers={name: mask[rows] for name, mask in self.outliers.items()},
            window_log=np.zeros_like(windows),
            unmodelled_time=self.unmodelled_time[windows],
            smoothed_time=self.smoothed_time[windows],
            **series,
        )

    def unidentifiable_sentences(self) -> tuple[str, ...]:
        """Sentences about the parameters that are not identifiable, without stops; empty where there is none."""
        each = (f"{name} is not identifiable from this log; excite it" for name in self.unidentifiable)
        return self.combinations or tuple(each)

    def lines(self, units: Mapping[str, str]) -> list[list[str]]:
        """Rows of a table: signal or noisy input, noise, outliers, and the RMS that the model does not explain.

        Parameters
        ----------
        units : mapping of str to str
            Unit of each signal and input.

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
        rows += [[name, f"{std:.2g}", "", "", units[name]] for name, std in self.input_noise.items()]
        return rows


# Windows of the unmodelled accelerations over which their RMS is taken.
_LENGTH = 8
# RMS over the robust scale from which on the model does not hold.
# Of the regimes of the robustness benchmark, saturated and wrong inputs alone exceed this multiple.
_FAR = 6.0
# The same RMS over that of the accelerations by the model, at least.
_MATERIAL = 0.3


@dataclass(frozen=True)
class Departure:
    """A stretch in which the model does not hold.

    Parameters
    ----------
    start, stop : float
        In the time of its log, s.
    ratio : float
        RMS of the unmodelled acceleration there over its robust scale, of the acceleration where that is largest.
    """

    start: float
    stop: float
    ratio: float


def departures(diagnosis: Diagnosis, log: int, unexplained: Mapping[str, float]) -> list[Departure]:
    """Stretches of a log in which the model does not hold, in their order.

    Parameters
    ----------
    diagnosis : Diagnosis
    log : int
        Number of the log.
    unexplained : mapping of str to float
        Share of each acceleration that the model leaves unexplained in this log, ``u / (u + m)``.
    """
    windows = diagnosis.windows_of(log)
    time = diagnosis.unmodelled_time[windows]
    departing, ratios = np.zeros(len(windows), bool), np.zeros(len(windows))
    for name, share in unexplained.items():
        values = diagnosis.unmodelled_accelerations[name][windows]
        moving = values[values != 0.0]  # which they are in gaps
        if share <= 0.0 or len(moving) < 5 * _LENGTH or not (scale := float(robust_std(moving))):
            continue
        rms = np.sqrt(_stretches(np.square(values)).mean(axis=1))
        largest = _stretches(np.pad(rms, _LENGTH - 1)).max(axis=1)  # of the stretches that hold each window
        modelled = float(np.sqrt(np.mean(np.square(values)))) * (1.0 - share) / share
        far = (largest > _FAR * scale) & (largest > _MATERIAL * modelled)
        departing |= far & (np.abs(values) > 0.5 * _FAR * scale)
        ratios = np.maximum(ratios, np.where(far, largest / scale, 0.0))
    # Stretches that are apart by less than their length are one.
    departing = ~long_runs(np.pad(~departing, _LENGTH, constant_values=True), _LENGTH)[_LENGTH:-_LENGTH]
    width = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return [
        Departure(float(time[x.start] - width), float(time[x.stop - 1] + width), float(ratios[x].max()))
        for x in runs(departing)
    ]


def _stretches(values: FloatArray) -> FloatArray:
    """Values of all stretches of so many windows, (n, length)."""
    return np.lib.stride_tricks.sliding_window_view(values, _LENGTH)
