"""Validation: open-loop prediction of logs by a plant at several horizons, and the verdict that follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np

from diransac.data.dataset import Dataset, as_logs
from diransac.data.log import Log
from diransac.errors import SettingsError
from diransac.identification.assessment.horizons import HorizonScores, OpenLoop, StartRule, pooled_scores
from diransac.identification.assessment.innovations import Innovations, innovations
from diransac.identification.assessment.open_loop import resolution_of
from diransac.identification.finding import (
    FAR,
    Finding,
    Verdict,
    by_seriousness,
    graded,
    next_line,
    shown_lines,
    verdict_of,
)
from diransac.identification.result import Result
from diransac.model.plant import ModelWithParameters, as_plant
from diransac.text_table import aligned, listed, number, percent

_GOOD = 0.1
"""Relative error of predictions of held-out logs up to which a model is good."""
_TELLING = 0.1
"""Sensitivity of predictions to 1 % of the parameters and to the start, up to which a horizon tells models apart."""


@dataclass(frozen=True)
class Validation:
    """Scores at several horizons, shortest first; `rmse`, `fit_percent` and `r_squared` are those of the judged one.

    Parameters
    ----------
    source : str
        Names of the logs in messages.
    units : mapping of str to str
        Unit of each signal.
    horizons : tuple of HorizonScores
        Scores of each horizon.
    asked : int
        Index of the judged horizon: the requested one, else the longest over which predictions tell models apart.
    notes : tuple of str, optional
        Findings in the logs, a sentence each.
    force_error_percent : mapping of str to float, optional
        Relative error of the force of the inputs in the equation of each coordinate or velocity, as inverse dynamics
        predict it from the smoothed motion: RMS error over the RMS of the force, %.  The force of a target under
        position control is stiffness times target less position.
    innovations : tuple of Innovations, optional
        One-step innovations of each log that can be smoothed.
    outlier_fraction : mapping of str to float, optional
        Part of each signal's samples that robust scores leave out.
    sensors : tuple of str, optional
        Those signals that are sensors.
    unsmoothed : tuple of str, optional
        Names of the logs that are too short to be smoothed: their windows start at recorded samples, with their noise.
    """

    source: str
    units: Mapping[str, str]
    horizons: tuple[HorizonScores, ...]
    asked: int
    notes: tuple[str, ...] = ()
    force_error_percent: Mapping[str, float] = field(default_factory=dict)
    innovations: tuple[Innovations, ...] = ()
    outlier_fraction: Mapping[str, float] = field(default_factory=dict)
    sensors: tuple[str, ...] = ()
    unsmoothed: tuple[str, ...] = ()

    @property
    def judged(self) -> HorizonScores:
        """Scores of the judged horizon."""
        return self.horizons[self.asked]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings for and against the model, the most serious first."""
        return by_seriousness([*_prediction(self), *_remarks(self)])

    @property
    def verdict(self) -> Verdict:
        """The verdict by these predictions alone: "usable", "usable with care" or "do not rely on this"."""
        return verdict_of(self.findings)

    @property
    def rmse(self) -> Mapping[str, float]:
        """Root mean squared error of each signal, in its unit."""
        return self.judged.rmse

    @property
    def fit_percent(self) -> Mapping[str, float]:
        """``100 (1 - |y - y_sim| / |y - mean(y)|)`` of each signal."""
        return self.judged.fit_percent

    @property
    def r_squared(self) -> Mapping[str, float]:
        """Coefficient of determination of each signal."""
        return self.judged.r_squared

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON (a figure that is not finite becomes null)."""
        rows = [{k: _finite(x) for k, x in vars(scores).items()} for scores in self.horizons]
        top = {k: rows[self.asked][k] for k in ("horizon", "rmse", "fit_percent", "r_squared", "robust_rmse")}
        return {
            "log": self.source,
            "verdict": self.verdict,
            "findings": [x.to_dict() for x in self.findings],
            **top,
            "units": dict(self.units),
            "horizons": rows,
            "force_error_percent": _finite(self.force_error_percent),
            "outlier_fraction": dict(self.outlier_fraction),
            "innovations": [_finite(one.to_dict()) for one in self.innovations],
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        forces = [["force of the inputs", "relative error %"]]
        forces += [[n, f"{x:.1f}"] for n, x in self.force_error_percent.items()]
        parts = [
            [f"{self.verdict}: {self.source}", *shown_lines(self.findings, good=True)],
            *([*_head(scores), *aligned(self._rows(scores))] for scores in self.horizons),
            aligned(forces) if self.force_error_percent else [],
            *(_innovation_lines(one) for one in self.innovations),
            [next_line(self.findings, "use the model: diransac export RESULT.json -o dynamics.c")],
        ]
        return "\n\n".join("\n".join(lines) for lines in parts if lines)

    def _rows(self, scores: HorizonScores) -> list[list[str]]:
        """Table of one horizon."""
        rows = [["signal", "unit", "RMSE", "robust", "hold last", "const. vel.", "fit %", "robust", "R^2", "robust"]]
        for name in scores.rmse:
            errors = (scores.rmse, scores.robust_rmse, scores.hold_last, scores.constant_velocity)
            fits = (scores.fit_percent, scores.robust_fit_percent)
            texts = [*(f"{x[name]:.4g}" for x in errors), *(_short(x[name], 1) for x in fits)]
            texts += [_short(x[name], 4) for x in (scores.r_squared, scores.robust_r_squared)]
            rows.append([name, self.units[name], *texts])
        return rows


# ---------------------------------------------------------------------- findings


def _prediction(found: Validation) -> Iterator[Finding]:
    """The predictions of the worst state and of the worst sensor over the judged horizon."""
    scores = found.judged
    states = {n: x for n, x in scores.relative_error.items() if n not in found.sensors}
    worst, effect = max(states.values(), default=0.0), max(scores.sensitivity.values(), default=0.0)
    # Errors are not seen under an effect of the starts of a fifth of the motion, and bad ones exceed the sensitivity.
    unseen = worst <= _GOOD and max(scores.of_starts.values(), default=0.0) > 0.2
    over = "the whole log" if np.isinf(scores.horizon) else scores.name
    if scores.diverged:
        yield Finding("bad", f"The simulation diverges ({scores.name})", "validate over a shorter --horizon")
    elif not scores.relative_error:
        claim = "No state moves ten times as far as its noise, so that this log tells little of the model"
        yield Finding("care", claim, "give a log with more motion")
    elif found.unsmoothed:
        where = f"a log, or its stretches between gaps, are too short ({listed(found.unsmoothed)})"
        yield Finding("care", f"Noise and starts are unknown where {where}", "give longer ones")
    elif unseen or FAR < worst <= 3.0 * effect:
        claim = f"Prediction over {over} tells little of the model, since {_cause(effect)}"
        yield Finding("care", claim, "give a shorter --horizon, or a log with less noise or more motion")
    else:
        yield from _worst_state(states, over)
        yield from _worst_sensor({n: x for n, x in scores.relative_error.items() if n in found.sensors}, over)


def _worst_state(errors: Mapping[str, float], over: str) -> Iterator[Finding]:
    """The largest relative error of a state; none without one."""
    name = max(errors, key=lambda n: errors[n], default="")
    if not name:
        return
    x = errors[name]
    if not x:
        yield Finding("good", f"Over {over} every state is predicted within its noise.")
        return
    level = graded(x, _GOOD, FAR)
    text = f"Over {over} the prediction of {name} is off by {percent(x)} of its motion, in excess of the noise"
    others = "; the other states are closer" if len(errors) > 1 else ""
    correct = "identify from this log, too, with --with-suggestions for terms that the model lacks"
    yield Finding(level, f"{text}{others}.") if level == "good" else Finding(level, f"{text}{others}", correct)


def _worst_sensor(errors: Mapping[str, float], over: str) -> Iterator[Finding]:
    """The largest relative error of a sensor, where it is large; the motion may be right."""
    name = max(errors, key=lambda n: errors[n], default="")
    if name and errors[name] > _GOOD:
        text = f"Over {over} the predicted reading of {name} is off by {percent(errors[name])} of its motion"
        yield Finding("care", f"{text}, in excess of the noise", "check the parameters of this sensor")


def _remarks(found: Validation) -> Iterator[Finding]:
    """Horizons that are not judged, samples that are left out, and innovations that are not white."""
    longer = found.horizons[found.asked + 1 :]
    most = max((x for one in longer for x in one.sensitivity.values()), default=0.0)
    if longer and most > _TELLING:
        names = listed([one.name for one in longer])
        yield Finding("note", f"Prediction over {names} is not judged: {_cause(most)}.")
    left_out = {n: x for n, x in found.outlier_fraction.items() if x > 0.01}
    if left_out:
        name = max(left_out, key=lambda n: left_out[n])
        yield Finding(
            "note",
            f"Outliers are left out of robust scores: {percent(left_out[name])} of {name}, the most of any signal.",
        )
    for one in found.innovations:
        if one.coloured:
            names = listed([f"{n} ({number(x, 2)})" for n, x in one.coloured.items()])
            where = f" of {one.source}" if len(found.innovations) > 1 else ""
            yield Finding("note", f"One-step innovations{where} are not white, with autocorrelations of {names}.")


def _cause(effect: float) -> str:
    """The sensitivity of a prediction as a reason not to judge by it."""
    size = number(effect, 2)
    return f"1 % of the parameters, or errors of the start within the noise, change it by up to {size} times the motion"


def _short(x: float, decimals: int) -> str:
    """A score with decimals, as long as it is no disaster."""
    return f"{x:.{decimals}f}" if abs(x) < 1e4 else f"{x:.3g}"


def _head(scores: HorizonScores) -> list[str]:
    """Heading of a table: horizon and number of windows."""
    windows = f"{scores.windows} window{'s' * (scores.windows > 1)}"
    lost = f", {scores.diverged} diverged" if scores.diverged else ""
    return [f"{scores.name} ({windows}{lost})"]


def _innovation_lines(one: Innovations) -> list[str]:
    """Table of the innovations of a log."""
    rows = [["innovation", "normalised std", "autocorrelation", "P(white)"]]
    for name, x in one.autocorrelation.items():
        largest = x[np.argmax(np.abs(x))]
        rows.append([name, f"{one.standard_deviation[name]:.3g}", f"{largest:.2f}", f"{one.whiteness[name]:.2g}"])
    forces = f"unmodelled forces of {percent(one.unmodelled)} of the changes of velocity"
    return [f"one-step innovations of {one.source}, with {forces}", *aligned(rows)]


# ---------------------------------------------------------------------- entry


def validate(
    plant: ModelWithParameters,
    logs: Log | Iterable[Log],
    horizon: float | None = None,
    *,
    integrator: str | None = None,
    substeps: int | None = None,
    input_hold: str | None = None,
    start: StartRule = "smoothed",
) -> Validation:
    """Scores of the open-loop prediction of logs by a plant.

    Parameters
    ----------
    plant : Plant or Result
        Model with its parameters.
    logs : Log or iterable of Log
        One log, or several, whose errors are pooled.  A per-log parameter takes its own value in a log that the result
        was identified from, and the mean of these in others.
    horizon : float, optional
        Time after which the simulation restarts, s; the model is judged by it.  None: up to three that suit the length
        of the logs; the longest one is judged over which 1 % of the parameters and the uncertainty of the start change
        the prediction by less than a tenth of the motion.  The whole of each log is always scored, too.  No window
        passes through a gap: windows end there, and begin again after it.
    integrator : str, optional
    substeps : int, optional
    input_hold : str, optional
        As in `Settings` and `identify`; None: those of the identification of a result, else "rk4", 1 and "zero-order".
        A result's inputs act after the delay or lag that was identified.
    start : {"smoothed", "measured"}, optional
        Initial states of windows: estimated from the samples about each start, without outliers; or the recorded
        samples, for logs without noise.  A log that is too short to be smoothed starts from the recorded ones.

    Returns
    -------
    Validation
        Scores by signal, findings and verdict.  The first row of a window is not scored.

    Raises
    ------
    LogError
        A log lacks an input or an initial state.
    SettingsError
        An argument is of another type, or unknown, or a horizon is shorter than a sample.
    """
    several = as_logs(logs)
    if horizon is not None and not isinstance(horizon, (int, float, np.number)):
        raise SettingsError(f"horizon is {horizon!r:.60}; give seconds")
    if start not in get_args(StartRule):
        raise SettingsError(f"start is {start!r:.60}; there are {', '.join(get_args(StartRule))}")
    known = as_plant(plant)
    resolution = resolution_of(plant, integrator, substeps, input_hold)
    dataset = Dataset.of(known.model, several, pointwise=False)
    own = [plant.parameters_in(log) if isinstance(plant, Result) else known.parameters for log in several]
    predictions = [OpenLoop(dataset, i, parameters, resolution, start) for i, parameters in enumerate(own)]
    scores = [pooled_scores(dataset.signals, h, predictions) for h in _horizons(horizon, predictions, several)]
    from diransac.identification.assessment.inverse_dynamics import force_errors  # which needs all of lo-diransac

    return Validation(
        dataset.source,
        {n: known.model.units[n] for n in dataset.signals},
        tuple(scores),
        0 if horizon is not None else _most_telling(scores),
        dataset.notes,
        force_errors(dataset, own, resolution),
        tuple(x for x in map(innovations, predictions) if x is not None),
        _outlier_fraction(dataset, predictions),
        tuple(known.model.sensors),
        tuple(x.segment.log.source for x in predictions if start == "smoothed" and x.smoothed is None),
    )


def _horizons(given: float | None, predictions: list[OpenLoop], logs: Sequence[Log]) -> list[float]:
    """Horizons that are scored, s, the shortest first; the last is infinite.

    Raises SettingsError: the given one is shorter than a sample.
    """
    dt = max(log.dt for log in logs)
    if given is not None and not given > 0.5 * dt:
        raise SettingsError(f"horizon is {given} s; give at least one sample, {dt:g} s")
    span = max(one.duration for one in predictions)
    parts = {_nice(span / part) for part in (200.0, 50.0, 10.0)}
    # Horizons are of five samples at least, but for the longest.
    wanted = sorted(x for x in parts if x > 4.5 * dt or x == max(parts)) if given is None else [given]
    return [*(h for h in wanted if any(one.steps(h) for one in predictions)), np.inf]


def _most_telling(scores: list[HorizonScores]) -> int:
    """Index of the longest horizon to which the effects of small changes do not amount; else where they are least."""
    effects = [np.inf if one.diverged else max(one.sensitivity.values(), default=np.inf) for one in scores]
    telling = [i for i, x in enumerate(effects) if x <= _TELLING]
    return telling[-1] if telling else len(scores) - 1 if np.isinf(min(effects)) else int(np.argmin(effects))


def _outlier_fraction(dataset: Dataset, predictions: list[OpenLoop]) -> dict[str, float]:
    """Part of the samples of each signal that are outliers."""
    known = sum(np.isfinite(one.segment.measured).sum(axis=0) for one in predictions)
    found = sum(one.outliers.sum(axis=0) for one in predictions) / np.maximum(known, 1)
    return dict(zip(dataset.signals, np.asarray(found).tolist(), strict=True))


def _nice(seconds: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``seconds``."""
    decade = 10.0 ** np.floor(np.log10(seconds))
    return float(max(x * decade for x in (1.0, 2.0, 5.0) if x * decade <= seconds * (1.0 + 1e-9)))


def _finite(x: object) -> object:
    if isinstance(x, Mapping):
        return {k: _finite(v) for k, v in x.items()}
    return x if not isinstance(x, float) or np.isfinite(x) else None
