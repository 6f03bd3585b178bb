"""Validation: open-loop prediction of logs by a plant at several horizons, and the verdict that follows from it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import numpy as np

from diransac.data.dataset import Dataset, as_logs
from diransac.data.log import Log
from diransac.errors import SettingsError
from diransac.identification.assessment.innovations import Innovations, innovations
from diransac.identification.assessment.open_loop import resolution_of
from diransac.identification.estimate import HorizonScores, Predictions
from diransac.identification.evaluation.findings import findings_of
from diransac.identification.evaluation.verdict import findings_of_predictions
from diransac.identification.finding import Finding, Verdict, by_seriousness, next_line, shown_lines, verdict_of
from diransac.identification.prediction.horizons import predictions_of
from diransac.identification.prediction.open_loop import StartRule
from diransac.identification.result import Result
from diransac.model.plant import ModelWithParameters, as_plant
from diransac.text_table import aligned, listed, number, percent

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
    innovations : tuple of Innovations, optional
        One-step innovations of each log that can be smoothed.
    """

    source: str
    units: Mapping[str, str]
    predictions: Predictions
    findings: tuple[Finding, ...]
    notes: tuple[str, ...] = ()
    force_error_percent: Mapping[str, float] = field(default_factory=dict)
    innovations: tuple[Innovations, ...] = ()

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
        top = {
            k: rows[self.predictions.asked][k] for k in ("horizon", "rmse", "fit_percent", "r_squared", "robust_rmse")
        }
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


def _findings(
    plant: ModelWithParameters, logs: tuple[Log, ...], found: Predictions, of_logs: Sequence[Innovations]
) -> tuple[Finding, ...]:
    """Findings for and against a plant by the prediction of some logs, and on the identification of a result."""
    if not isinstance(plant, Result):
        return by_seriousness([*findings_of_predictions(found, _CORRECT), *_of_innovations(of_logs)])
    held_out = any(plant.index_of(log) is None for log in logs)
    return by_seriousness([*findings_of(plant, found, _CORRECT if held_out else ""), *_of_innovations(of_logs)])


def _of_innovations(of_logs: Sequence[Innovations]) -> Iterator[Finding]:
    """Innovations that are not white."""
    for one in of_logs:
        if one.coloured:
            names = listed([f"{n} ({number(x, 2)})" for n, x in one.coloured.items()])
            where = f" of {one.source}" if len(of_logs) > 1 else ""
            yield Finding("note", f"One-step innovations{where} are not white, with autocorrelations of {names}.")


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
    several = as_logs(logs)
    if horizon is not None and not isinstance(horizon, (int, float, np.number)):
        raise SettingsError(f"horizon is {horizon!r:.60}; give seconds")
    if start not in get_args(StartRule):
        raise SettingsError(f"start is {start!r:.60}; there are {', '.join(get_args(StartRule))}")
    known = as_plant(plant)
    resolution = resolution_of(plant, integrator, substeps, input_hold)
    dataset = Dataset.of(known.model, several, pointwise=False)
    own = [plant.parameters_in(log) if isinstance(plant, Result) else known.parameters for log in several]
    noise = None
    if isinstance(plant, Result):
        horizon = plant.options.get("horizon") if horizon is None else horizon
        noise = None if plant.diagnosis is None else plant.diagnosis.noise_std
    loops, predictions = predictions_of(dataset, own, resolution, horizon, start, noise)
    of_logs = tuple(x for x in map(innovations, loops) if x is not None)
    from diransac.identification.assessment.inverse_dynamics import force_errors  # which needs all of lo-diransac

    return Validation(
        dataset.source,
        {n: known.model.units[n] for n in dataset.signals},
        predictions,
        _findings(plant, tuple(several), predictions, of_logs),
        dataset.notes,
        force_errors(dataset, own, resolution),
        of_logs,
    )


def _finite(x: object) -> object:
    if isinstance(x, Mapping):
        return {k: _finite(v) for k, v in x.items()}
    return x if not isinstance(x, float) or np.isfinite(x) else None
