"""Validation: open-loop prediction of logs by a plant at several horizons, and the verdict that follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np

from diransac.data.dataset import Dataset, as_logs
from diransac.data.log import Log
from diransac.errors import SettingsError
from diransac.identification.assessment.open_loop import resolution_of
from diransac.identification.diagnosis import Resolution
from diransac.identification.estimate import HorizonScores, Predictions
from diransac.identification.evaluation.findings import findings_of
from diransac.identification.evaluation.verdict import findings_of_predictions
from diransac.identification.finding import Finding, Verdict, by_seriousness, next_line, shown_lines, verdict_of
from diransac.identification.prediction.horizons import predictions_of
from diransac.identification.prediction.inverse import force_errors
from diransac.identification.prediction.open_loop import OpenLoop, StartRule
from diransac.identification.result import Result
from diransac.model.plant import ModelWithParameters, as_plant
from diransac.text_table import aligned, number, percent

_CORRECT = "identify from this log, too, with --with-suggestions for terms that the model lacks"


@dataclass(frozen=True)
class Validation:
    """Scores at several horizons, shortest first; `rmse`, `fit_percent` and `r_squared` are those of the judged one.

    Parameters
    ----------
    source : str
        Names of the logs in messages.
    units : mapping of str to str
        Unit of each signal.
    predictions : Predictions
        Scores of each horizon, and the judged one.
    findings : tuple of Finding
        Findings for and against the model, the most serious first; of a result, with those of its identification that
        no prediction revokes.
    notes : tuple of str, optional
        Findings in the logs, a sentence each.
    force_error_percent : mapping of str to float, optional
        Relative error of the force of the inputs in the equation of each coordinate or velocity, as inverse dynamics
        predict it from the smoothed motion: RMS error over the RMS of the force, %.  The force of a target under
        position control is stiffness times target less position.
    """

    source: str
    units: Mapping[str, str]
    predictions: Predictions
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()
    force_error_percent: Mapping[str, float] = field(default_factory=dict)

    @property
    def horizons(self) -> tuple[HorizonScores, ...]:
        """Scores of each horizon, the shortest first; the last is the whole of each log."""
        return self.predictions.horizons

    @property
    def judged(self) -> HorizonScores:
        """Scores of the judged horizon."""
        return self.predictions.judged

    @property
    def outlier_fraction(self) -> Mapping[str, float]:
        """Part of each signal's samples that robust scores leave out."""
        return self.predictions.outlier_fraction

    @property
    def verdict(self) -> Verdict:
        """The verdict: "usable", "usable with care" or "do not rely on this"; on the logs of an identification, its."""
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
        top = rows[self.predictions.asked]
        return {
            "log": self.source,
            "verdict": self.verdict,
            "findings": [x.to_dict() for x in self.findings],
            **{k: top[k] for k in ("horizon", "rmse", "fit_percent", "r_squared", "robust_rmse")},
            "units": dict(self.units),
            "horizons": rows,
            "force_error_percent": _finite(self.force_error_percent),
            "outlier_fraction": dict(self.outlier_fraction),
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        parts = [
            [f"{self.verdict}: {self.source}", *shown_lines(self.findings, good=True)],
            aligned(self.table()),
            [next_line(self.findings, "use the model: diransac export RESULT.json -o dynamics.c")],
        ]
        return "\n\n".join("\n".join(lines) for lines in parts)

    def table(self) -> list[list[str]]:
        """Rows of a table with a header: each signal at each horizon, beside the error of the force of its equation."""
        rows = [["horizon", "signal", "error", "RMSE", "robust", "trivial", "unit", "fit %", "R²", "windows"]]
        for x in self.horizons:
            windows = f"{x.windows}" + (f", {x.diverged} diverged" if x.diverged else "")
            for name in x.rmse:
                error = percent(x.relative_error[name]) if name in x.relative_error else "–"
                trivial = float(np.fmin(x.hold_last[name], x.constant_velocity[name]))
                errors = map(number, (x.rmse[name], x.robust_rmse[name], trivial))
                fits = number(x.fit_percent[name], 3), number(x.r_squared[name])
                rows.append([x.name, name, error, *errors, self.units[name], *fits, windows])
        if self.force_error_percent:
            rows[0].append("force error")
            forces = {n: percent(x / 100.0) for n, x in self.force_error_percent.items()}
            rows[1:] = [[*row, forces.get(row[1], "–")] for row in rows[1:]]
        return rows


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
        Time after which the simulation restarts, s; the model is judged by it.  None: the one that a result was
        identified for, else up to three that suit the length of the logs; the longest one is judged over which 1 % of
        the parameters and the uncertainty of the start change the prediction by less than a tenth of the motion.  The
        whole of each log is always scored, too.  No window passes through a gap: windows end there, and begin again
        after it.
    integrator : str, optional
    substeps : int, optional
    input_hold : str, optional
        As in `Settings` and `identify`; None: those of the identification of a result, else "rk4", 1 and "zero-order".
        A result's inputs act after the delay or lag that was identified.
    start : {"smoothed", "measured"}, optional
        Initial states of windows: estimated with the model from the samples before each, without outliers; or the
        recorded samples, for logs without noise.  A log that is too short to be smoothed starts from the recorded ones.

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
    return validated(plant, logs, horizon, resolution_of(plant, integrator, substeps, input_hold), start)[0]


def validated(
    plant: ModelWithParameters,
    logs: Log | Iterable[Log],
    horizon: float | None,
    resolution: Resolution,
    start: StartRule = "smoothed",
) -> tuple[Validation, list[OpenLoop]]:
    """Scores as `validate` returns them, and the predictions of each log."""
    several = as_logs(logs)
    if horizon is not None and not isinstance(horizon, (int, float, np.number)):
        raise SettingsError(f"horizon is {horizon!r:.60}; give seconds")
    if start not in get_args(StartRule):
        raise SettingsError(f"start is {start!r:.60}; there are {', '.join(get_args(StartRule))}")
    known = as_plant(plant)
    dataset = Dataset.of(known.model, several, pointwise=False)
    own = [plant.parameters_in(log) if isinstance(plant, Result) else known.parameters for log in several]
    noise = None
    if isinstance(plant, Result):
        horizon = plant.options.get("horizon") if horizon is None else horizon
        noise = None if plant.diagnosis is None else plant.diagnosis.noise_std
    loops, predictions = predictions_of(dataset, own, resolution, horizon, start, noise)
    if isinstance(plant, Result):
        held_out = any(plant.index_of(log) is None for log in several)
        findings = findings_of(plant, predictions, _CORRECT if held_out else "")
    else:
        findings = by_seriousness(findings_of_predictions(predictions, _CORRECT))
    units = {n: known.model.units[n] for n in dataset.signals}
    return Validation(dataset.source, units, predictions, findings, dataset.notes, force_errors(loops)), loops


def _finite(x: object) -> object:
    if isinstance(x, Mapping):
        return {k: _finite(v) for k, v in x.items()}
    return x if not isinstance(x, float) or np.isfinite(x) else None
