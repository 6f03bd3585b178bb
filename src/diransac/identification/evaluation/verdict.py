"""Findings that follow from open-loop predictions: one measure, and one rule from its figures to levels.

The measure is the RMS error of a prediction in excess of the noise, over that of the better trivial prediction.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from diransac.identification.estimate import TELLING, Disagreement, Predictions
from diransac.identification.finding import FAR, NEAR, Finding, Level, graded
from diransac.text_table import listed, number, percent


def findings_of_predictions(found: Predictions, action: str) -> Iterator[Finding]:
    """Findings on the predictions of the worst state and of the worst sensor over the judged horizon.

    Parameters
    ----------
    found : Predictions
    action : str
        What to do about predictions that are off.
    """
    scores = found.judged
    states = {n: x for n, x in scores.relative_error.items() if n not in found.sensors}
    worst, effect = max(states.values(), default=0.0), max(scores.sensitivity.values(), default=0.0)
    # Errors are not seen under an effect of the starts of a fifth of the motion, and bad ones exceed the sensitivity.
    unseen = worst <= NEAR and max(scores.of_starts.values(), default=0.0) > 0.2
    over = "the whole log" if np.isinf(scores.horizon) else scores.name
    if scores.diverged:
        yield Finding("bad", f"The simulation diverges ({scores.name})", "validate over a shorter --horizon")
    elif not scores.relative_error:
        claim = "No state moves five times as far as its noise, so that this log tells little of the model"
        yield Finding("care", claim, "give a log with more motion")
    elif found.unsmoothed:
        where = f"a log, or its stretches between gaps, are too short ({listed(found.unsmoothed)})"
        yield Finding("care", f"Noise and starts are unknown where {where}", "give longer ones")
    elif unseen or FAR < worst <= 3.0 * effect:
        claim = f"Prediction over {over} tells little of the model, since {_cause(effect)}"
        yield Finding("care", claim, "give a shorter --horizon, or a log with less noise or more motion")
    else:
        yield from _worst_state(states, over, action)
        yield from _worst_sensor({n: x for n, x in scores.relative_error.items() if n in found.sensors}, over)
    yield from _remarks(found)


def level_of_disagreement(found: Disagreement, moved: float, width: float) -> Level | None:
    """Level of other parameters that a part of the logs gives, by what they change; None where nobody would notice.

    Parameters
    ----------
    found : Disagreement
    moved, width : float
        Difference of its parameter from the answer, and width of the structural interval, both in the parameter's unit;
        0 and infinite of a delay.
    """
    if np.isnan(found.effect):
        return "care"
    if found.effect > FAR or (found.effect > NEAR and moved > width):
        return "bad"
    if found.effect > NEAR or moved > width:
        return "care"
    # Nobody notices a change of predictions by a thousandth of the motion.
    return "note" if found.effect > 1e-3 else None


def _worst_state(errors: Mapping[str, float], over: str, action: str) -> Iterator[Finding]:
    """The largest relative error of a state; none without one."""
    name = max(errors, key=lambda n: errors[n], default="")
    if not name:
        return
    x = errors[name]
    if not x:
        yield Finding("good", f"Over {over} every state is predicted within its noise.")
        return
    level = graded(x, NEAR, FAR)
    text = f"Over {over} the prediction of {name} is off by {percent(x)} of its motion, in excess of the noise"
    others = "; the other states are closer" if len(errors) > 1 else ""
    yield Finding(level, f"{text}{others}.") if level == "good" else Finding(level, f"{text}{others}", action)


def _worst_sensor(errors: Mapping[str, float], over: str) -> Iterator[Finding]:
    """The largest relative error of a sensor, where it is large; the motion may be right."""
    name = max(errors, key=lambda n: errors[n], default="")
    if name and errors[name] > NEAR:
        text = f"Over {over} the predicted reading of {name} is off by {percent(errors[name])} of its motion"
        yield Finding("care", f"{text}, in excess of the noise", "check the parameters of this sensor")


def _remarks(found: Predictions) -> Iterator[Finding]:
    """Horizons that are not judged, and samples that are left out."""
    longer = found.horizons[found.asked + 1 :]
    most = max((x for one in longer for x in one.sensitivity.values()), default=0.0)
    if longer and most > TELLING:
        names = listed([one.name for one in longer])
        yield Finding("note", f"Prediction over {names} is not judged: {_cause(most)}.")
    left_out = {n: x for n, x in found.outlier_fraction.items() if x > 0.01}
    if left_out:
        name = max(left_out, key=lambda n: left_out[n])
        yield Finding(
            "note",
            f"Outliers are left out of robust scores: {percent(left_out[name])} of {name}, the most of any signal.",
        )


def _cause(effect: float) -> str:
    """The sensitivity of a prediction as a reason not to judge by it."""
    size = number(effect, 2)
    return f"1 % of the parameters, or errors of the start within the noise, change it by up to {size} times the motion"
