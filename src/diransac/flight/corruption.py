"""Corruption of logs: noise and faults as a recorder adds them, and the mask of the faulty samples.

Effects are applied in the order in which a measurement passes them: delay on the way to the sensor, Gaussian noise of
the sensor, quantisation by the converter, repeated values of the driver, and, on transmission, outliers, bursts,
one-sided offsets and dropouts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.log import Log
from diransac.data.preprocessing import shift
from diransac.errors import LogError, SettingsError, check_known
from diransac.flight.noise import Draws, Noise, gaussian_errors, leverage_rows, quantised, with_faults


@dataclass(frozen=True, eq=False, repr=False)
class CorruptedLog(Log):
    """Log with the mask of its faulty samples.

    Parameters
    ----------
    fault_mask : mapping of str to (N,) bool array
        True where the recorded value differs from the value without faults (outliers, bursts, stuck values, one-sided
        offsets, dropouts). Gaussian noise, delay and quantisation are not faults, nor is a fault that leaves the value
        unchanged, such as a stuck sample of a constant signal.

    Raises
    ------
    LogError
        As `Log`; or a mask that is not (N,) Boolean, or not of a signal.

    Notes
    -----
    Slices have the masks of their rows. A preparation step that keeps the rows keeps the mask of every signal whose
    samples it does not change, also under another name; without any such signal it returns a plain `Log`. `write`
    writes no masks.
    """

    fault_mask: Mapping[str, BoolArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        masks = {}
        for name, mask in self.fault_mask.items():
            copy = np.array(mask)
            if name not in self.signals or copy.shape != self.time.shape or copy.dtype != np.bool_:
                raise LogError(
                    f'{self.source}: the mask "{name}" is {copy.dtype} {copy.shape}; give one Boolean per row, '
                    f"{self.time.shape}, of a signal: {', '.join(self.signals)}"
                )
            copy.flags.writeable = False
            masks[name] = copy
        object.__setattr__(self, "fault_mask", MappingProxyType(masks))

    @classmethod
    def of(cls, log: Log, fault_mask: Mapping[str, BoolArray]) -> CorruptedLog:
        """Log with masks."""
        return cls(**{x.name: getattr(log, x.name) for x in fields(Log)}, fault_mask=fault_mask)

    def without_masks(self) -> Log:
        """Log without masks."""
        return Log(**{x.name: getattr(self, x.name) for x in fields(Log)})

    def _cut(self, rows: slice) -> Log:
        """Rows of the log with their masks."""
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
        """As `Log.with_step`, with the masks of signals whose samples do not change."""
        # A step passes on the same array objects that it does not change, which identify the masks.
        masks = {id(self.signals[name]): mask for name, mask in self.fault_mask.items()}
        kept = self.signals if signals is None else signals
        fault_mask = {name: masks[id(values)] for name, values in kept.items() if id(values) in masks}
        log = self.without_masks().with_step(step, time=time, signals=kept, units=units, notes=notes)
        return log if time is not None or not fault_mask else CorruptedLog.of(log, fault_mask)

    def __reduce__(self) -> tuple[Any, ...]:
        _, rows = super().__reduce__()
        return (CorruptedLog, (*rows, dict(self.fault_mask)))


def corrupt(log: Log, noise: Noise, seed: int = 0, *, signals: Sequence[str] | None = None) -> CorruptedLog:
    """Log with noise and faults as a recorder would have written it, and the mask of the faulty samples.

    Parameters
    ----------
    log : Log
        Without noise; it is not modified.
    noise : Noise
        What is added.
    seed : int
        Each effect on each signal depends on (seed, effect, signal) alone: no effect changes another one's numbers.
    signals : sequence of str, optional
        Names of the signals that are corrupted, such as ``model.signals``. None: every column whose name ends in
        ``_dot`` or ``_ddot``, and the columns that these are derivatives of, such as ``x, x_dot, x_ddot`` or
        ``wx, wx_dot``. Inputs have no such names and remain unchanged. A coordinate without derivatives in the log,
        such as a component of a quaternion, must be named.

    Returns
    -------
    CorruptedLog
        With ``fault_mask``, one more step in its history and a note.

    Raises
    ------
    LogError
        A signal is missing, none is found to corrupt, Gaussian noise meets a signal of unknown unit, or the delay
        leaves no rows.
    SettingsError
        An argument has no meaning.

    Notes
    -----
    A delay removes the rows at the start that no delayed sample covers; fractions of a sample are interpolated
    linearly. A clean first row is only delayed and quantised. Corrupting a corrupted log extends its masks; use another
    seed, because the same one gives the same random numbers.

    References
    ----------
    Dimmig et al. 2023, section IV-E and Table III.

    Examples
    --------
    >>> import numpy as np
    >>> t = np.arange(1000) / 100
    >>> log = Log.from_arrays(t, {"x": np.sin(t), "x_dot": np.cos(t), "force": -np.sin(t)})
    >>> noisy = corrupt(log, Noise(outlier_probability=0.1, outlier_magnitude=80.0), seed=1)
    >>> sorted(noisy.fault_mask), np.array_equal(noisy["force"], log["force"])
    (['x', 'x_dot'], True)
    >>> np.array_equal(noisy["x"] != log["x"], noisy.fault_mask["x"])
    True
    """
    names = _check_arguments(log, noise, seed, signals)
    delays = dict.fromkeys(names, noise.delay) if noise.delay else {}
    late = shift(log, delays) if delays else log
    draws = Draws(int(seed), len(log), skipped=len(log) - len(late))
    measured = _measured(late, names, noise, draws)
    eligible = leverage_rows(late, noise)
    recorded = {name: with_faults(measured[name], name, noise, draws, eligible) for name in names}

    fault_mask = _masks_of(log, delays)
    for name in names:
        before, after = measured[name], recorded[name]
        faulty = (after != before) & ~(np.isnan(after) & np.isnan(before))
        fault_mask[name] = fault_mask[name] | faulty if name in fault_mask else faulty
    n_faults = {name: int(fault_mask[name].sum()) for name in names}
    step = {"step": "corrupt", "seed": int(seed), "noise": noise.changed, "signals": names, "faults": n_faults}
    note = (
        f"corrupted by simulation (seed {seed}): "
        f"{sum(n_faults.values())} of {len(names) * len(late)} samples have faults"
    )
    corrupted = late.with_step(step, signals={**late.signals, **recorded}, notes=[note] if noise.changed else [])
    return CorruptedLog.of(corrupted, fault_mask)


def _check_arguments(log: object, noise: object, seed: object, signals: Sequence[str] | None) -> list[str]:
    """Names of the signals to corrupt."""
    if not isinstance(log, Log):
        raise SettingsError(f"log is a {type(log).__name__}; give a Log")
    if not isinstance(noise, Noise):
        raise SettingsError(f"noise is a {type(noise).__name__}; give a Noise")
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise SettingsError(f"seed is {seed!r}; give a whole number")
    if isinstance(signals, str):
        raise SettingsError(f'signals is the text "{signals}"; give a list of names')
    names = _moving(log) if signals is None else list(dict.fromkeys(signals))
    for name in names:
        if name == "t":
            raise SettingsError('signals names "t", the time, which cannot be corrupted')
        log[name]
    if not isinstance(noise.quantisation, float):
        check_known(noise.quantisation, names, "quantisation names", "the corrupted signals are")
    return names


def _moving(log: Log) -> list[str]:
    """Names of derivatives and of the signals they are derivatives of.  Raises LogError: there are none."""
    names = [
        name for name in log.names if name.endswith(("_dot", "_ddot")) or f"{name}_dot" in log or f"{name}_ddot" in log
    ]
    if not names:
        raise LogError(
            f"{log.source}: no name ends in _dot or _ddot, by which signals are distinguished from inputs; "
            f"found {', '.join(log.names)}; name the signals to corrupt with signals="
        )
    return names


def _measured(log: Log, names: Sequence[str], noise: Noise, draws: Draws) -> dict[str, FloatArray]:
    """Signals with Gaussian noise and quantisation, without faults."""
    errors = gaussian_errors(log, names, noise, draws)
    measured = {}
    for name in names:
        values = log[name]
        if name in errors:
            spared = np.arange(len(log)) < (noise.first_row == "clean")
            values = np.where(spared, values, values + errors[name])
        measured[name] = quantised(values, name, noise)
    return measured


def _masks_of(log: Log, delays: Mapping[str, float]) -> dict[str, BoolArray]:
    """Existing masks of the log, delayed with its signals: interpolation from a faulty sample is faulty."""
    if not isinstance(log, CorruptedLog):
        return {}
    none = np.zeros(len(log), dtype=bool)
    masks = Log(log.time, {name: log.fault_mask.get(name, none).astype(float) for name in log.names})
    late = shift(masks, delays)
    return {name: late[name] > 0.0 for name in log.fault_mask}
