"""Systematic errors of sensors and inputs, and recordings that are corrected of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from diransac.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class ErrorKind:
    """Kind of error of a recording, of one signal or input, or of a group alike.

    Parameters
    ----------
    columns : tuple of int
        Indices of the signals, or of the inputs.
    what : str
        "delay", in samples; of signals "bias", in their unit; of inputs "lag", the time constant of a first-order lag
        in samples, and "drift", the relative change of their gain over a log.
    of_inputs : bool, optional
    """

    columns: tuple[int, ...]
    what: Literal["delay", "bias", "lag", "drift"]
    of_inputs: bool = False


@dataclass(frozen=True, eq=False, repr=False)
class RecordingErrors:
    """Systematic errors of the sensors and of the inputs, and what the sensors measured.

    Parameters
    ----------
    measured : (N, n_s) array
    sampled : (N, n_s) bool array
        As recorded.
    n_inputs : int
    sizes : mapping from ErrorKind to float, optional
        Errors that are estimated; those of one signal or input add.
    """

    measured: FloatArray
    sampled: BoolArray
    n_inputs: int
    sizes: Mapping[ErrorKind, float] = field(default_factory=dict)

    @property
    def kinds(self) -> tuple[ErrorKind, ...]:
        """Errors that are estimated."""
        return tuple(self.sizes)

    @property
    def delay(self) -> FloatArray:
        """Samples ``(n_s,)`` by which each signal is recorded late."""
        return self._total("delay", of_inputs=False)

    @property
    def bias(self) -> FloatArray:
        """Constant error ``(n_s,)`` of each signal, its unit."""
        return self._total("bias", of_inputs=False)

    @property
    def input_delay(self) -> FloatArray:
        """Samples ``(n_u,)`` after which each input acts."""
        return self._total("delay", of_inputs=True)

    @property
    def input_lag(self) -> FloatArray:
        """Time constant ``(n_u,)`` of each actuator, samples."""
        return np.maximum(self._total("lag", of_inputs=True), 0.0)

    @property
    def gain_drift(self) -> FloatArray:
        """Relative change ``(n_u,)`` of each input's gain over a log."""
        return self._total("drift", of_inputs=True)

    def _total(self, what: str, *, of_inputs: bool) -> FloatArray:
        found = np.zeros(self.n_inputs if of_inputs else self.measured.shape[1])
        for kind, size in self.sizes.items():
            if kind.what == what and kind.of_inputs == of_inputs:
                found[list(kind.columns)] += size
        return found

    def plus(self, more: Mapping[ErrorKind, float]) -> RecordingErrors:
        """These errors and others.

        Parameters
        ----------
        more : mapping from ErrorKind to float

        Returns
        -------
        RecordingErrors
        """
        sizes = {**self.sizes, **{kind: self.sizes.get(kind, 0.0) + x for kind, x in more.items()}}
        return replace(self, sizes=sizes)
