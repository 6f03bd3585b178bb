"""Predictions of logs over horizons that suit them, and the horizon by which a model is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import Dataset
from diransac.errors import SettingsError
from diransac.identification.diagnosis import Resolution
from diransac.identification.estimate import TELLING, Disagreement, HorizonScores, Predictions
from diransac.identification.prediction.open_loop import OpenLoop, StartRule, pooled_scores


def predictions_of(
    dataset: Dataset,
    parameters: Sequence[Mapping[str, float]],
    resolution: Resolution,
    horizon: float | None = None,
    start: StartRule = "smoothed",
    noise: Mapping[str, float] | None = None,
) -> tuple[list[OpenLoop], Predictions]:
    """Predictions of the logs of a dataset, log by log, and their scores.

    Parameters
    ----------
    dataset : Dataset
    parameters : sequence of mapping of str to float
        Those of each log.
    resolution : Resolution
        With the timing of the inputs.
    horizon : float, optional
        s; None: up to three that suit the length of the logs.  The whole of each log is scored besides.
    start, noise : optional
        As in `OpenLoop`.

    Raises
    ------
    LogError
        A log has no complete state to start from.
    SettingsError
        The horizon is shorter than a sample.
    """
    logs = [OpenLoop(dataset, i, own, resolution, start, noise) for i, own in enumerate(parameters)]
    scores = [pooled_scores(dataset.signals, h, logs) for h in _horizons(horizon, logs)]
    return logs, Predictions(
        tuple(scores),
        0 if horizon is not None else _most_telling(scores),
        _outlier_fraction(dataset, logs),
        tuple(dataset.model.sensors),
        tuple(x.segment.log.source for x in logs if start == "smoothed" and x.smoothed is None),
    )


def effect_of(found: Disagreement, logs: Sequence[OpenLoop], horizon: float) -> float:
    """Effect of a disagreement on predictions over a horizon, s, as `Disagreement` has it; the most of any log.

    It is the lesser of those of all parameters and of the one that differs most: others may make up for it, and
    parameters that a part of the logs does not determine are not its own.
    """
    effects = []
    for one in [logs[found.log]] if found.log >= 0 else logs:
        names = list(one.segment.model.parameters)
        alone = {found.name: found.parameters[found.name]} if found.name else {}
        every = [_replaced(names, one.parameters, x) for x in (found.parameters, alone)]
        effects.append(min(one.change(horizon, p, found.input_delay) for p in every))
    return max(effects)


def _replaced(names: Sequence[str], values: FloatArray, other: Mapping[str, float]) -> FloatArray:
    """Parameters ``(n,)`` with others in their places; those of single logs are named otherwise, and stay."""
    return np.array([other.get(n, x) for n, x in zip(names, values, strict=True)])


def _horizons(given: float | None, predictions: Sequence[OpenLoop]) -> list[float]:
    """Horizons that are scored, s, the shortest first; the last is infinite.

    Raises SettingsError: the given one is shorter than a sample.
    """
    dt = max(one.segment.log.dt for one in predictions)
    if given is not None and not given > 0.5 * dt:
        raise SettingsError(f"horizon is {given} s; give at least one sample, {dt:g} s")
    span = max(one.duration for one in predictions)
    parts = {_nice(span / part) for part in (200.0, 50.0, 20.0, 10.0)}
    # Horizons are of five samples at least, but for the longest.
    wanted = sorted(x for x in parts if x > 4.5 * dt or x == max(parts)) if given is None else [given]
    return [*(h for h in wanted if any(one.steps(h) for one in predictions)), np.inf]


def _most_telling(scores: list[HorizonScores]) -> int:
    """Index of the longest horizon to which the effects of small changes do not amount; else where they are least."""
    effects = [np.inf if one.diverged else max(one.sensitivity.values(), default=np.inf) for one in scores]
    telling = [i for i, x in enumerate(effects) if x <= TELLING]
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
