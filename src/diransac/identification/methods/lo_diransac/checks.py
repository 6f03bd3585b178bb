"""Findings of a fit on its recordings: errors of sensors and of inputs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from diransac.identification.finding import Finding
from diransac.identification.methods.lo_diransac.recording_errors import LEAST_DELAY
from diransac.text_table import duration, number, percent

if TYPE_CHECKING:
    from diransac.identification.core.windows import Windows
    from diransac.identification.methods.lo_diransac.local_search import Explanation
    from diransac.identification.methods.lo_diransac.segments import ActingInputs


def findings_of_fit(found: Explanation, acting: ActingInputs | None) -> Iterator[Finding]:
    """Findings for and against an estimate.

    Parameters
    ----------
    found : Explanation
    acting : ActingInputs or None
        Inputs of an estimate that is none of the fit, and to which errors of recordings that the fit has do not apply.

    Returns
    -------
    iterator of Finding
    """
    hold = found.intervals.hold if acting is None else acting.hold
    if hold != "zero-order" and not (found.intervals.all_errors.input_lag.any() and acting is None):
        how = {"linear": "linearly", "smooth": "smoothly"}[hold]
        yield Finding("note", f"Inputs that vary {how} between samples explain this log better than held ones.")
    if acting is None:
        yield from _of_recordings(found.intervals)
        for (name, unit), std in zip(found.intervals.model.inputs.items(), found.noise_of_inputs, strict=True):
            if std:
                size = f"{number(std, 2)} {unit}".strip()
                yield Finding(
                    "note", f"{name} is recorded with white noise of {size} (RMS), which the estimate includes."
                )


def _of_recordings(intervals: Windows) -> Iterator[Finding]:
    """Delays and biases of sensors, own delays and lags of inputs, and drifts of their gains."""
    errors = intervals.all_errors
    signals = np.array(intervals.model.signals)
    for delay in dict.fromkeys(errors.delay[errors.delay != 0.0].tolist()):
        late = signals[errors.delay == delay]
        names = f"{', '.join(late[:-1])} and {late[-1]} are" if len(late) > 1 else f"{late[0]} is"
        time, sense = duration(abs(delay) * intervals.dt), "late" if delay > 0.0 else "early"
        text = f"{names} recorded {time} {sense} with respect to the other signals"
        yield Finding(
            "care", f"{text}, a sensor delay that the estimate includes", _shifted(late, delay * intervals.dt)
        )
    for name, bias in zip(signals, errors.bias, strict=True):
        if bias:
            size, unit = number(bias, 3), intervals.model.units[name]
            claim = f"{name} has a sensor bias of {size} {unit}, which the estimate includes"
            yield Finding("care", claim, "correct it where other programs read the sensor")
    own = {x.what: x != intervals.all_inputs(x.what) for x in errors.kinds if x.of_inputs and x.what != "drift"}
    delays, lags = errors.input_delay * own.get("delay", False), errors.input_lag * own.get("lag", False)
    for name, delay, lag, drift in zip(intervals.model.inputs, delays, lags, errors.gain_drift, strict=True):
        if abs(delay) > LEAST_DELAY:
            time, sense = duration(abs(delay) * intervals.dt), "later" if delay > 0.0 else "earlier"
            claim = f"{name} acts {time} {sense} than recorded, a delay that the estimate includes"
            yield Finding("care", claim, "give other simulations this delay, too")
        if lag > LEAST_DELAY:
            time = duration(lag * intervals.dt)
            claim = f"{name} acts after a first-order lag of {time}, which the estimate includes"
            yield Finding("care", claim, "give other simulations this lag, too")
        if drift:
            moves = f"{'rises' if drift > 0.0 else 'falls'} by {percent(abs(drift))} during the log"
            holds = "which the estimate includes, with the parameters of the beginning"
            claim = f"The gain of {name} {moves}, as with a battery that sags, {holds}"
            yield Finding("care", claim, "record the supply, or what the actuator gives, as the input")


def _shifted(names: Sequence[str], delay: float) -> str:
    """The option that corrects a delay of signals."""
    return f"correct it where other programs read the log: --shift {','.join(f'{n}={-delay:.4g}' for n in names)}"
