"""`CorruptedLog`: a log that knows which of its samples a fault has made wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.log import Log
from diransac.errors import LogError

__all__ = ["CorruptedLog"]


@dataclass(frozen=True, eq=False, repr=False)
class CorruptedLog(Log):
    """A `Log` with the mask of its faulty samples.

    Parameters
    ----------
    fault_mask : name -> (N,) Boolean, True where the recorded value is not what it would be without faults: outliers,
        bursts, frozen values, one-sided offsets, dropouts.  Gaussian noise, delay and quantisation are no faults, nor
        is a fault that leaves the value as it is, such as a frozen sample of a signal that rests

    Parts of the log have the masks of their rows.  A step of preparation that keeps the rows keeps the mask of every
    signal whose samples it leaves as they are, be it under another name; where none is left, it gives a plain `Log`.
    `write` writes what a recorder would have: no masks.

    Raises LogError: as `Log`; a mask that is not (N,) Boolean, or of no signal.
    """

    fault_mask: Mapping[str, BoolArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        masks = {}
        for name, mask in self.fault_mask.items():
            copy = np.array(mask)
            if name not in self.signals or copy.shape != self.time.shape or copy.dtype != np.bool_:
                raise LogError(
                    f'{self.source}: the mask "{name}" is {copy.dtype} {copy.shape}; give one Boolean a row, '
                    f"{self.time.shape}, of a signal: {', '.join(self.signals)}"
                )
            copy.flags.writeable = False
            masks[name] = copy
        object.__setattr__(self, "fault_mask", MappingProxyType(masks))

    @classmethod
    def of(cls, log: Log, fault_mask: Mapping[str, BoolArray]) -> CorruptedLog:
        """A log with masks."""
        rows = (log.time, log.signals, log.units, log.source, log.history, log.notes, log.unusable)
        return cls(*rows, fault_mask)

    def without_masks(self) -> Log:
        """The plain log."""
        return Log(self.time, self.signals, self.units, self.source, self.history, self.notes, self.unusable)

    def _cut(self, rows: slice) -> Log:
        return CorruptedLog.of(self.without_masks()[rows], {name: mask[rows] for name, mask in self.fault_mask.items()})

    def with_step(
        self,
        step: Mapping[str, Any],
        *,
        time: FloatArray | None = None,
        signals: Mapping[str, FloatArray] | None = None,
        units: Mapping[str, str] | None = None,
        notes: Sequence[str] = (),
    ) -> Log:
        """As `Log.with_step`, with the masks of signals whose samples stay as they are."""
        # A step hands on the very arrays that it does not touch, so a mask is found again by its samples.
        masks = {id(self.signals[name]): mask for name, mask in self.fault_mask.items()}
        kept = self.signals if signals is None else signals
        fault_mask = {name: masks[id(values)] for name, values in kept.items() if id(values) in masks}
        log = self.without_masks().with_step(step, time=time, signals=kept, units=units, notes=notes)
        return log if time is not None or not fault_mask else CorruptedLog.of(log, fault_mask)

    def __reduce__(self) -> tuple[Any, ...]:
        _, rows = super().__reduce__()
        return (CorruptedLog, (*rows, dict(self.fault_mask)))
