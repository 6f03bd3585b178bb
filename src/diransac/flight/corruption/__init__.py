"""Noise: a log as a recorder would have written it, and which of its samples are wrong.

Effects follow the way of a measurement: the machine's signals reach the sensor late (delay), the sensor adds its own
(Gaussian noise), a converter rounds (quantisation), a driver repeats its last value (frozen runs), and what is
transmitted is damaged (outliers alone and in bursts, one-sided offsets) or lost (dropouts).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.data.log import Log
from diransac.data.preprocessing import shift
from diransac.errors import LogError, SettingsError
from diransac.flight.corruption.corrupted_log import CorruptedLog
from diransac.flight.corruption.draws import Draws
from diransac.flight.corruption.faults import leverage_rows, quantised, with_faults
from diransac.flight.corruption.gaussian import gaussian_errors
from diransac.flight.corruption.specification import Noise

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

__all__ = ["CorruptedLog", "Noise", "corrupt"]


def corrupt(log: Log, noise: Noise, seed: int = 0, *, signals: Sequence[str] | None = None) -> CorruptedLog:
    """The log as a recorder with this noise would have written it, with the mask of what is wrong in it.

    Parameters
    ----------
    log : what a perfect recorder writes; it stays as it is
    noise : what is wrong with this one
    seed : each effect on each signal draws from (seed, effect, signal) alone, so none changes what another does
    signals : names of what is corrupted, such as ``model.signals``.  None: every column whose name ends in ``_dot`` or
        ``_ddot``, and those that these are derivatives of, such as ``x, x_dot, x_ddot`` or ``wx, wx_dot``.  Inputs have
        no such partners and stay as they are; a coordinate without any, such as a quaternion's, must be named

    Returns the log with ``.fault_mask``, name -> (N,) Boolean, one more step in its history and a note.  A delay cuts
    the rows at the start that no delayed sample covers; fractions of a sample are interpolated linearly.  With a clean
    first row that row is only delayed and quantised.  A log that is corrupted already keeps its masks and gets more;
    give another seed then, or the same numbers are drawn again.

    Raises LogError: a signal is missing, none is found to corrupt, Gaussian noise meets a signal whose unit is not
    known, or the delay leaves no rows.  SettingsError: an argument has no meaning.
    References: Dimmig et al. 2023, section IV-E and Table III.

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
    strong = leverage_rows(late, noise)
    recorded = {name: with_faults(measured[name], name, noise, draws, strong) for name in names}

    fault_mask = _masks_of(log, delays)
    for name in names:
        wrong = _differ(recorded[name], measured[name])
        fault_mask[name] = fault_mask[name] | wrong if name in fault_mask else wrong
    n_wrong = {name: int(fault_mask[name].sum()) for name in names}
    step = {"step": "corrupt", "seed": int(seed), "noise": noise.changed, "signals": names, "faults": n_wrong}
    note = (
        f"corrupted on purpose (seed {seed}): {sum(n_wrong.values())} of {len(names) * len(late)} samples have faults"
    )
    corrupted = late.with_step(step, signals={**late.signals, **recorded}, notes=[note] if noise.changed else [])
    return CorruptedLog.of(corrupted, fault_mask)


def _check_arguments(log: object, noise: object, seed: object, signals: Sequence[str] | None) -> list[str]:
    """The names of the signals that are corrupted."""
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
            raise SettingsError('signals names "t", the time, which stays as it is')
        log[name]
    strange = [] if isinstance(noise.quantisation, float) else [n for n in noise.quantisation if n not in names]
    if strange:
        raise SettingsError(f'quantisation names "{strange[0]}"; the signals that are corrupted: {", ".join(names)}')
    return names


def _moving(log: Log) -> list[str]:
    """Names that say that they are derivatives, and those that they are derivatives of.  Raises LogError: none do."""
    names = [
        name for name in log.names if name.endswith(("_dot", "_ddot")) or f"{name}_dot" in log or f"{name}_ddot" in log
    ]
    if not names:
        raise LogError(
            f"{log.source}: no name ends in _dot or _ddot, which would tell signals from inputs; "
            f"found {', '.join(log.names)}: name what to corrupt with signals="
        )
    return names


def _measured(log: Log, names: Sequence[str], noise: Noise, draws: Draws) -> dict[str, FloatArray]:
    """What a recorder without faults writes: the signals with Gaussian noise, rounded."""
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
    """The masks that the log has already, delayed with its signals: what mixes a wrong sample in is wrong."""
    if not isinstance(log, CorruptedLog):
        return {}
    none = np.zeros(len(log), dtype=bool)
    masks = Log(log.time, {name: log.fault_mask.get(name, none).astype(float) for name in log.names})
    late = shift(masks, delays)
    return {name: late[name] > 0.0 for name in log.fault_mask}


def _differ(a: FloatArray, b: FloatArray) -> BoolArray:
    """Where two columns are not the same; NaN is the same as NaN."""
    return np.asarray((a != b) & ~(np.isnan(a) & np.isnan(b)))
