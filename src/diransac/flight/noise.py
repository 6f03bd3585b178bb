"""Measurement noise and recording faults of logs: their specification and their realisation.

Each effect on each signal reads a random stream of its own: a counter-based generator whose key is a hash of
``(seed, effect, signal)``. Switching an effect on, or leaving a signal out, changes no other number.

References: Salmon et al. 2011, "Parallel random numbers: as easy as 1, 2, 3" (Philox).
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.units import conversion
from diransac.errors import LogError, SettingsError

if TYPE_CHECKING:
    from diransac.data.log import Log


@dataclass(frozen=True)
class Noise:
    """Noise and faults that `corrupt` adds to a log; ``Noise()`` adds none.

    Parameters
    ----------
    outlier_probability : float
        pi_o, probability of an outlier.
    outlier_magnitude : float
        a_o, each signal's unit: an outlier or a sample in a burst gets uniform(-a_o, a_o) added.
    acceleration_std : float
        Standard deviation of signals that are linear accelerations, m/s^2.
    rate_std : float
        Standard deviation of signals that are angular velocities, rad/s.
    angular_acceleration_std : float, optional
        rad/s^2; None: ``rate_std / dt``.
    integrated : {"white", "random-walk"}
        Gaussian noise of the signals that accelerations and rates integrate to.
    first_row : {"clean", "corrupted"}
        ``"clean"``: the first row, from which simulations start, has neither Gaussian noise nor faults. The paper does
        not say.
    burst_probability : float
        Probability per sample that a burst of consecutive outliers starts.
    burst_length : float
        Mean length of bursts, samples.
    stuck_probability, stuck_length : float
        The same for runs that repeat the sample before them.
    dropout_probability, dropout_length : float
        The same for runs of NaN.
    correlated : bool
        True: bursts, stuck runs and dropouts occur in the same rows of all signals. False: independently per signal.
    leverage_probability : float
        Probability of a one-sided offset per sample, in the rows in which ``leverage_signal`` is large.
    leverage_offset : float
        Such a sample gets uniform(0, leverage_offset) added, each signal's unit, either sign.
    leverage_signal : str, optional
        Signal or input that selects these rows, such as ``"thrust"``.
    leverage_quantile : float
        A row is selected if its ``|leverage_signal|`` is above this quantile over the log.
    delay : float
        Delay of the signals after the inputs, s.
    quantisation : float or mapping of str to float
        Step by signal, in its unit; or one number for all signals, the step as a fraction of the signal's range.
    outliers : {"signals", "rows"}
        ``"signals"``: each sample of each signal is an outlier with ``outlier_probability``. ``"rows"``: each row is,
        in all signals, of which each draws its own error.

    Raises
    ------
    SettingsError
        A value has no meaning.

    Notes
    -----
    The Gaussian noise is drawn with standard deviations, as the units of Table III's "covariances" imply. With ``dt``
    the sampling time, the unit of a signal selects it (deg, rpm and other units are converted; dimensionless signals
    are angles):

    ===========================================  ==================================================
    m/s^2, m/s, m                                ``sigma, sigma dt, sigma dt^2 / 2`` of acceleration_std
    rad/s, rad                                   ``sigma, sigma dt`` of rate_std
    rad/s^2                                      angular_acceleration_std, or ``rate_std / dt``
    ===========================================  ==================================================

    The paper states that "the covariance was integrated for the lower order terms". With ``integrated="white"``, an
    error held for one sample changes its n-fold integral by ``sigma dt^n / n!``, and each sample of each signal is
    drawn independently with that standard deviation: a state estimate without drift. With ``"random-walk"`` the errors
    themselves are integrated from the first row on, ``e_v[k+1] = e_v[k] + dt e_a[k]`` and
    ``e_x[k+1] = e_x[k] + dt e_v[k] + dt^2/2 e_a[k]``: dead reckoning, whose velocity error has the standard deviation
    ``sigma dt sqrt(k)`` after ``k`` samples. (Integrating the variance over one sample, ``sigma^2 dt``, would need a
    spectral density, which Table III does not give.)

    The paper gives no noise of theta_ddot. The same rule applied in reverse gives ``sigma = rate_std / dt``, the
    angular acceleration that changes the rate by rate_std within one sample: at 100 Hz, a hundred times rate_std. It
    dominates the error of an identified inertia. ``angular_acceleration_std=0`` follows the paper literally.

    The paper adds outliers "to each signal with a probability", which ``outliers="signals"`` does. An inlier of its
    Algorithm 1 is an observation, all signals of a row, and its figures look as with ``"rows"``.

    ============================  ==================================  =================
    Table III                     field                               range
    ============================  ==================================  =================
    sigma of theta_dot            rate_std                            0.003 to 1.0 rad/s
    sigma of x_ddot, z_ddot       acceleration_std                    0.04 to 2.5 m/s^2
    a_o                           outlier_magnitude                   0 to 100
    pi_o                          outlier_probability                 0.05 to 0.5
    ============================  ==================================  =================

    References
    ----------
    Dimmig et al. 2023, section IV-E and Table III.
    """

    outlier_probability: float = 0.0
    outlier_magnitude: float = 0.0
    acceleration_std: float = 0.0
    rate_std: float = 0.0
    angular_acceleration_std: float | None = None
    integrated: str = "white"
    first_row: str = "clean"
    burst_probability: float = 0.0
    burst_length: float = 10.0
    stuck_probability: float = 0.0
    stuck_length: float = 10.0
    dropout_probability: float = 0.0
    dropout_length: float = 10.0
    correlated: bool = False
    leverage_probability: float = 0.0
    leverage_offset: float = 0.0
    leverage_signal: str | None = None
    leverage_quantile: float = 0.7
    delay: float = 0.0
    quantisation: Mapping[str, float] | float = 0.0
    outliers: str = "signals"

    def __post_init__(self) -> None:
        fractions = [f.name for f in fields(self) if f.name.endswith(("_probability", "_quantile"))]
        self._check(fractions, 0.0, 1.0, "a number from 0 to 1")
        self._check(
            ["burst_length", "stuck_length", "dropout_length"], 1.0, math.inf, "a finite number from 1, samples"
        )
        self._check(["leverage_offset"], -math.inf, math.inf, "a finite number")
        sizes = ["outlier_magnitude", "acceleration_std", "rate_std", "delay"]
        if self.angular_acceleration_std is not None:
            sizes.append("angular_acceleration_std")
        if not isinstance(self.quantisation, Mapping):
            sizes.append("quantisation")
        self._check(sizes, 0.0, math.inf, "a finite number from 0")
        for name, choices in (
            ("outliers", ("signals", "rows")),
            ("integrated", ("white", "random-walk")),
            ("first_row", ("clean", "corrupted")),
        ):
            if getattr(self, name) not in choices:
                raise SettingsError(f"{name} is {getattr(self, name)!r}; choose {' or '.join(map(repr, choices))}")
        if not isinstance(self.correlated, bool):
            raise SettingsError(f"correlated is {self.correlated!r:.60}; give True or False")
        self._check_leverage_signal()
        if isinstance(self.quantisation, Mapping):
            steps = {str(name): _number(f"quantisation of {name!r}", x) for name, x in self.quantisation.items()}
            object.__setattr__(self, "quantisation", steps)

    def _check(self, names: list[str], low: float, high: float, wanted: str) -> None:
        """Replace fields by floats.  Raises SettingsError: a value is out of range."""
        for name in names:
            object.__setattr__(self, name, _number(name, getattr(self, name), low, high, wanted))

    def _check_leverage_signal(self) -> None:
        """Raise SettingsError for a leverage_signal that is missing or not a name."""
        if self.leverage_signal is None and self.leverage_probability > 0.0:
            raise SettingsError(
                f"leverage_probability is {self.leverage_probability} and no leverage_signal is named; "
                "name the signal or input whose largest values select the rows"
            )
        if self.leverage_signal is not None and not isinstance(self.leverage_signal, str):
            raise SettingsError(f"leverage_signal is {self.leverage_signal!r}; give a signal's name")

    @property
    def changed(self) -> dict[str, Any]:
        """Fields that differ from ``Noise()``, by name, for JSON."""
        return {f.name: value for f in fields(self) if (value := getattr(self, f.name)) != f.default}


def _number(
    name: str, value: object, low: float = 0.0, high: float = math.inf, wanted: str = "a finite number from 0"
) -> float:
    """The value as a float.  Raises SettingsError: it is not a number in the range."""
    real = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    # Compared before conversion: a large integer has no float.
    if not real or not (low <= value <= high and abs(value) <= sys.float_info.max):  # type: ignore[operator, arg-type]
        raise SettingsError(f"{name} is {value!r:.60}; give {wanted}")
    return float(value)  # type: ignore[arg-type]


# Random streams ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Draws:
    """Random numbers for the rows of a log, by effect and signal."""

    seed: int
    n_rows: int
    skipped: int = 0

    def _stream(self, effect: str, signal: str) -> np.random.Generator:
        """Generator of one effect on one signal."""
        key = hashlib.sha256(f"{self.seed}\0{effect}\0{signal}".encode()).digest()[:16]
        return np.random.Generator(np.random.Philox(key=int.from_bytes(key, "little")))

    def uniform(self, effect: str, signal: str) -> FloatArray:
        """Uniform in [0, 1), (rows,)."""
        return self._stream(effect, signal).random(self.n_rows)[self.skipped :]

    def normal(self, effect: str, signal: str) -> FloatArray:
        """Gaussian of mean 0 and variance 1, (rows,)."""
        return self._stream(effect, signal).standard_normal(self.n_rows)[self.skipped :]

    def runs(self, effect: str, signal: str, probability: float, mean_length: float) -> BoolArray:
        """Mask of rows in runs, (rows,): a run starts at each row with ``probability``; its length is geometric."""
        stream = self._stream(effect, signal)
        starts = stream.random(self.n_rows) < probability
        rows = np.arange(self.n_rows)
        ends = np.where(starts, rows + stream.geometric(1.0 / mean_length, self.n_rows), 0)
        return (rows < np.maximum.accumulate(ends))[self.skipped :]


# Gaussian noise ------------------------------------------------------------------------------------------------------


def gaussian_errors(log: Log, names: Iterable[str], noise: Noise, draws: Draws) -> dict[str, FloatArray]:
    """Gaussian errors (N,) of each signal, in its unit; empty without Gaussian noise.

    Raises LogError: the unit of a signal is unknown, or is not that of a position, velocity or acceleration.
    """
    if not (noise.acceleration_std or noise.rate_std or noise.angular_acceleration_std):
        return {}
    return {name: _error(name, log, noise, draws) for name in names}


def _error(name: str, log: Log, noise: Noise, draws: Draws) -> FloatArray:
    """Gaussian errors (N,) of one signal, in its unit."""
    sources, unit = _sources(noise, log.dt), log.units.get(name)
    kind = next((kind for kind in sources if unit and conversion(unit, kind)), None)
    if unit is None or kind is None:
        found = f'has the unit "{unit}"' if unit else "has no unit"
        raise LogError(
            f'{log.source}: signal "{name}" {found}, but Gaussian noise needs m, m/s, m/s^2, rad, rad/s or rad/s^2; '
            "give units with dataclasses.replace(log, units=model.units), or choose other signals with signals="
        )
    std, order = sources[kind]
    in_its_unit = std * (conversion(kind, unit) or 0.0)
    if noise.integrated == "white" or kind == "rad/s^2":
        # Integral of order n of an error of 1 held for one sample.
        held = log.dt**order / math.factorial(order)
        return np.asarray(in_its_unit * held * draws.normal("gaussian", name))
    # All orders of one coordinate integrate the same errors: those of its acceleration, or of its angular velocity.
    coordinate = name.removesuffix("_ddot").removesuffix("_dot")
    return in_its_unit * _integrated(draws.normal("gaussian", coordinate), order, log.dt)


def _sources(noise: Noise, dt: float) -> dict[str, tuple[float, int]]:
    """SI unit of a signal -> standard deviation, and number of integrations from it to the signal."""
    angular = noise.angular_acceleration_std
    return {
        "m/s^2": (noise.acceleration_std, 0),
        "m/s": (noise.acceleration_std, 1),
        "m": (noise.acceleration_std, 2),
        "rad/s^2": (noise.rate_std / dt if angular is None else angular, 0),
        "rad/s": (noise.rate_std, 0),
        "rad": (noise.rate_std, 1),
    }


def _integrated(errors: FloatArray, order: int, dt: float) -> FloatArray:
    """Errors, each held for one sample, integrated from zero at the first row."""
    if order == 0:
        return errors
    first = _sum_before(errors) * dt
    return first if order == 1 else _sum_before(first + dt / 2.0 * errors) * dt


def _sum_before(values: FloatArray) -> FloatArray:
    """Sum of the samples before each sample (N,)."""
    return np.concatenate([[0.0], np.cumsum(values[:-1])])


# Quantisation and faults ---------------------------------------------------------------------------------------------


def quantised(values: FloatArray, name: str, noise: Noise) -> FloatArray:
    """Samples (N,) rounded to multiples of the signal's step, if it has one."""
    if isinstance(noise.quantisation, float):
        finite = values[np.isfinite(values)]
        step = noise.quantisation * float(np.ptp(finite)) if len(finite) else 0.0
    else:
        step = noise.quantisation.get(name, 0.0)
    return np.rint(values / step) * step if step > 0.0 else values


def leverage_rows(log: Log, noise: Noise) -> BoolArray:
    """Mask (N,) of the rows in which one-sided offsets may occur.

    Raises LogError: the log has no such signal, or it is all NaN.
    """
    if noise.leverage_signal is None:
        return np.zeros(len(log), dtype=bool)
    log.check([noise.leverage_signal])
    size = np.abs(log[noise.leverage_signal])
    return np.asarray(size > np.nanquantile(size, noise.leverage_quantile))


def with_faults(values: FloatArray, name: str, noise: Noise, draws: Draws, eligible: BoolArray) -> FloatArray:
    """Samples (N,) with stuck runs, outliers, one-sided offsets in ``eligible`` rows and dropouts, in this order."""
    spared = np.arange(len(values)) < (noise.first_row == "clean")
    stuck = _runs("stuck", name, noise, draws) & ~spared
    recorded = values[np.maximum.accumulate(np.where(stuck, 0, np.arange(len(values))))]

    is_outlier = draws.uniform("outlier", "" if noise.outliers == "rows" else name) < noise.outlier_probability
    is_outlier |= _runs("burst", name, noise, draws)
    outliers = noise.outlier_magnitude * (2.0 * draws.uniform("outlier size", name) - 1.0)
    recorded = np.where(is_outlier & ~spared, recorded + outliers, recorded)

    has_offset = eligible & (draws.uniform("leverage", name) < noise.leverage_probability)
    offsets = noise.leverage_offset * draws.uniform("leverage size", name)
    recorded = np.where(has_offset & ~spared, recorded + offsets, recorded)

    return np.where(_runs("dropout", name, noise, draws) & ~spared, np.nan, recorded)


def _runs(fault: str, name: str, noise: Noise, draws: Draws) -> BoolArray:
    """Rows (N,) in runs of a fault: burst, stuck or dropout."""
    # Fault -> key of its random stream where it is not the name; keys determine the numbers of a seed.
    stream = {"stuck": "freeze"}.get(fault, fault)
    signal = "" if noise.correlated else name
    return draws.runs(stream, signal, getattr(noise, f"{fault}_probability"), getattr(noise, f"{fault}_length"))
