"""`Diagnosis`: what lo-diransac found beside the parameters - noise, faults, and what the model leaves out."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray

__all__ = ["Diagnosis"]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What is wrong with a log, and what the model doesn't explain of it.

    Parameters
    ----------
    noise_std : signal -> standard deviation of its Gaussian noise, its unit; of the measured signals
    outlier_fraction : signal -> share of its samples that are outliers
    outliers : signal -> (N,) samples that are more likely outliers than not: sensor faults, over the log's rows
    unmodelled_time : (W,)   s, middle of each window in which the latent accelerations are constant
    unmodelled_accelerations : acceleration -> (W,), its unit: what acts on the machine and is not in the model
    unmodelled_forces : the same as generalised forces, N where a coordinate is in m, N m where in rad; empty where
        the model's equations are no balance of forces
    smoothed_time : (W,)   s, first row of each window
    smoothed_states : state -> (W,)   the most probable motion at those times, measured or not
    input_delay, input_delay_error : s by which the inputs act later than the log says; its standard error
    input_delay_significant : whether that is more than errors of estimation
    unidentifiable : parameters that the log cannot tell
    """

    noise_std: Mapping[str, float]
    outlier_fraction: Mapping[str, float]
    outliers: Mapping[str, BoolArray]
    unmodelled_time: FloatArray
    unmodelled_accelerations: Mapping[str, FloatArray]
    unmodelled_forces: Mapping[str, FloatArray]
    smoothed_time: FloatArray
    smoothed_states: Mapping[str, FloatArray]
    input_delay: float
    input_delay_error: float
    input_delay_significant: bool
    unidentifiable: tuple[str, ...]

    def __post_init__(self) -> None:
        series = [self.unmodelled_time, self.smoothed_time]
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

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON; `from_dict` reads it back."""
        return {
            "noise_std": dict(self.noise_std),
            "outlier_fraction": dict(self.outlier_fraction),
            "outliers": {
                n: base64.b64encode(np.packbits(mask).tobytes()).decode() for n, mask in self.outliers.items()
            },
            "unmodelled_time": self.unmodelled_time.tolist(),
            "unmodelled_accelerations": {n: x.tolist() for n, x in self.unmodelled_accelerations.items()},
            "unmodelled_forces": {n: x.tolist() for n, x in self.unmodelled_forces.items()},
            "smoothed_time": self.smoothed_time.tolist(),
            "smoothed_states": {n: x.tolist() for n, x in self.smoothed_states.items()},
            "input_delay": self.input_delay,
            "input_delay_error": self.input_delay_error,
            "input_delay_significant": self.input_delay_significant,
            "unidentifiable": list(self.unidentifiable),
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any], n_rows: int) -> Diagnosis:
        """The diagnosis that `to_dict` wrote, of a log with so many rows.

        Raises KeyError, TypeError or ValueError: the data are damaged.
        """
        return cls(
            noise_std={name: float(x) for name, x in data["noise_std"].items()},
            outlier_fraction={name: float(x) for name, x in data["outlier_fraction"].items()},
            outliers={name: _unpacked(text, n_rows) for name, text in data["outliers"].items()},
            unmodelled_time=np.array(data["unmodelled_time"], np.float64),
            unmodelled_accelerations=_series(data["unmodelled_accelerations"]),
            unmodelled_forces=_series(data["unmodelled_forces"]),
            smoothed_time=np.array(data["smoothed_time"], np.float64),
            smoothed_states=_series(data["smoothed_states"]),
            input_delay=float(data["input_delay"]),
            input_delay_error=float(data["input_delay_error"]),
            input_delay_significant=bool(data["input_delay_significant"]),
            unidentifiable=tuple(map(str, data["unidentifiable"])),
        )

    def lines(self, units: Mapping[str, str]) -> list[list[str]]:
        """Rows of a table: signal, noise, outliers, and what the model leaves out of it.

        Parameters
        ----------
        units : unit of each signal
        """
        rows = [["signal", "noise", "outliers", "unexplained", "unit"]]
        for name in dict.fromkeys((*self.noise_std, *self.unmodelled_accelerations)):
            measured, latent = name in self.noise_std, self.unmodelled_accelerations.get(name)
            noise = f"{self.noise_std[name]:.2g}" if measured else ""
            share = f"{100.0 * self.outlier_fraction[name]:.1f} %" if measured else ""
            unexplained = "" if latent is None else f"{np.sqrt(np.mean(np.square(latent))):.2g}"
            rows.append([name, noise, share, unexplained, units[name]])
        return rows


def _series(columns: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Arrays (W,) by name."""
    return {name: np.array(values, np.float64) for name, values in columns.items()}


def _unpacked(text: str, n_rows: int) -> BoolArray:
    """A mask ``(n_rows,)`` that was packed into text.  Raises ValueError: it is of another length."""
    packed = np.frombuffer(base64.b64decode(text, validate=True), dtype=np.uint8)
    if len(packed) != (n_rows + 7) // 8:
        raise ValueError(f"a mask of {n_rows} rows")
    return np.unpackbits(packed, count=n_rows).astype(bool)
