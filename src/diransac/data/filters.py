"""Zero-phase low-pass filters of finite length, their specification as a field of a log, and the median filter.

The low-pass filter is a windowed sinc, ``h(t) = 2 B sinc(2 B t) w(t)`` with Kaiser's window ``w`` over ``|t| <= 2.5 /
B``.  It passes half at the bandwidth B, all but 1e-4 below B / 2, and 1e-4 above 3 B / 2.  As it is symmetric, it
shifts no phase; as it is finite, a filtered sample depends on what lies within 2.5 / B of it and on nothing else.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from diransac.arrays import FloatArray, row_blocks
from diransac.errors import SettingsError

REACH = 2.5
_ROWS_AT_A_TIME = 20_000
"""Rows whose windows are copied together."""


@dataclass(frozen=True)
class FilterSpecification:
    """Filters of a log whose velocities or accelerations were derived by `differentiate`.

    Parameters
    ----------
    bandwidth : float
        Bandwidth of the filter for both sides of the regression ``W p = b``, Hz.
    derivation_bandwidth : float
        Bandwidth of the filter that the log's signals have passed, Hz.
    derived : mapping of str to str
        Derived signal -> the measured signal that it is a derivative of.

    Raises
    ------
    SettingsError
        A bandwidth is not a positive finite number.
    """

    bandwidth: float
    derivation_bandwidth: float
    derived: Mapping[str, str] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        for name in ("bandwidth", "derivation_bandwidth"):
            value = float(getattr(self, name))
            if not 0.0 < value < math.inf:
                raise SettingsError(f"the filter's {name} is {value}; give a positive number of Hz")
            object.__setattr__(self, name, value)
        object.__setattr__(self, "derived", MappingProxyType(dict(self.derived)))

    def __reduce__(self) -> tuple[Any, ...]:
        return (FilterSpecification, (self.bandwidth, self.derivation_bandwidth, dict(self.derived)))

    def as_dict(self) -> dict[str, Any]:
        """The fields, as JSON can hold them."""
        return {name: dict(x) if name == "derived" else x for name, x in vars(self).items()}

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> Self:
        """The specification that `as_dict` gave."""
        derived = {name: str(source) for name, source in fields["derived"].items()}
        return cls(fields["bandwidth"], fields["derivation_bandwidth"], derived)

    def renamed(self, origins: Mapping[str, str]) -> FilterSpecification:
        """The specification of a log whose signals have other names; ``origins`` maps new names to old ones."""
        news: dict[str, str] = {}
        for new, old in origins.items():
            news.setdefault(old, new)
        derived = {new: self.derived[old] for new, old in origins.items() if old in self.derived}
        derived = {name: news.get(source, source) for name, source in derived.items()}
        return FilterSpecification(self.bandwidth, self.derivation_bandwidth, derived)


def half_length(bandwidth: float, dt: float) -> int:
    """Number of samples ``L`` of the filter to either side."""
    return max(1, int(np.ceil(REACH / (bandwidth * dt))))


def kernels(bandwidth: float, dt: float) -> FloatArray:
    """Impulse responses of the filter and of its first and second derivatives.

    The filter is exact for a ramp, the first derivative for a parabola, the second for a cubic.

    Parameters
    ----------
    bandwidth : float
        Hz.
    dt : float
        Sample interval, seconds.

    Returns
    -------
    (3, 2 L + 1) array
        In 1, 1/s and 1/s^2.
    """
    L = half_length(bandwidth, dt)
    t = np.arange(-L, L + 1) * dt
    smooth = np.sinc(2.0 * bandwidth * t) * np.kaiser(2 * L + 1, 7.857)
    smooth /= smooth.sum()
    first, second = (_derivative(smooth, order, dt) for order in (1, 2))
    first = first - first[::-1]
    second = second + second[::-1]
    second -= second.sum() * smooth
    return np.stack([smooth, -first / (t * first).sum(), 2.0 * second / (t**2 * second).sum()])


def _derivative(kernel: FloatArray, order: int, dt: float) -> FloatArray:
    """Derivative of the band-limited interpolant of a kernel, at the kernel's samples."""
    n = 4 * len(kernel)
    spectrum = np.fft.rfft(kernel, n) * (2j * np.pi * np.fft.rfftfreq(n, dt)) ** order
    return np.asarray(np.fft.irfft(spectrum, n)[: len(kernel)])


def convolve(values: FloatArray, kernel: FloatArray) -> FloatArray:
    """Convolution ``(N, ...)`` of values ``(N, ...)`` along the first axis, zero outside, with a kernel."""
    N, L = len(values), len(kernel) // 2
    n = 1 << (N + 2 * L).bit_length()
    response = np.fft.rfft(kernel, n).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(np.fft.irfft(np.fft.rfft(values, n, axis=0) * response, n, axis=0)[L : L + N])


def mirrored_windows(values: Any, reach: int) -> Any:
    """The samples ``(N, ..., 2 reach + 1)`` around each along the first axis, mirrored at both ends."""
    padded = np.pad(values, [(reach, reach), *[(0, 0)] * (values.ndim - 1)], mode="reflect")
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=0)


def median_filter(values: Any, size: int) -> Any:
    """Median of the samples around each, mirrored at both ends.

    Parameters
    ----------
    values : (N, ...) array
        Filtered along the first axis; of any kind that can be sorted, without NaN.
    size : int
        Number of samples in a window, odd.

    Returns
    -------
    (N, ...) array
        Of the same kind.
    """
    reach = size // 2
    windows, medians = mirrored_windows(values, reach), np.empty_like(values)
    for some in row_blocks(len(values), _ROWS_AT_A_TIME):
        medians[some] = np.partition(windows[some], reach)[..., reach]
    return medians
