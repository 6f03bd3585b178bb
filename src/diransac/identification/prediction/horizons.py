"""Predictions of logs over horizons that suit them, and the horizon by which a model is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import Dataset
from diransac.errors import SettingsError
from diransac.identification.diagnosis import Resolution
from diransac.identification.estimate import TELLING, Disagreement, HorizonScores, Predictions
from diransac.identification.prediction.open_loop import OpenLoop, StartRule, Sums, excess


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
    loops = [OpenLoop(dataset, i, own, resolution, start, noise) for i, own in enumerate(parameters)]
    scores = [_scores(dataset, h, loops) for h in _horizons(horizon, loops)]
    n_known = sum(np.isfinite(x.segment.measured).sum(axis=0) for x in loops)
    n_outliers = sum(x.outliers.sum(axis=0) for x in loops)
    return loops, Predictions(
        tuple(scores),
        0 if horizon is not None else _most_telling(scores),
        dict(zip(dataset.signals, (n_outliers / np.maximum(n_known, 1)).tolist(), strict=True)),
        tuple(dataset.model.sensors),
        tuple(x.segment.log.source for x in loops if start == "smoothed" and x.smoothed is None),
    )


def effect_of(found: Disagreement, logs: Sequence[OpenLoop], horizon: float) -> float:
    """Effect of a disagreement on predictions over a horizon, s, as `Disagreement` has it; the most of any log.

    It is the lesser of those of all parameters and of the one that differs most: others may make up for it, and
    parameters that a part of the logs does not determine are not its own.
    """
    names = list(logs[0].segment.model.parameters)
    alone = {found.name: found.parameters[found.name]} if found.name else {}
    return max(
        min(
            loop.change(horizon, _replaced(names, loop.parameters, x), found.input_delay)
            for x in (found.parameters, alone)
        )
        for loop in ([logs[found.log]] if found.log >= 0 else logs)
    )


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


def _nice(seconds: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``seconds``."""
    decade = 10.0 ** np.floor(np.log10(seconds))
    return float(max(x * decade for x in (1.0, 2.0, 5.0) if x * decade <= seconds * (1.0 + 1e-9)))


def _most_telling(scores: list[HorizonScores]) -> int:
    """Index of the longest horizon to which the effects of small changes do not amount; else where they are least."""
    effects = [np.inf if one.diverged else max(one.sensitivity.values(), default=np.inf) for one in scores]
    telling = [i for i, x in enumerate(effects) if x <= TELLING]
    return telling[-1] if telling else len(scores) - 1 if np.isinf(min(effects)) else int(np.argmin(effects))


def _scores(dataset: Dataset, horizon: float, logs: Sequence[OpenLoop]) -> HorizonScores:
    """Scores of one horizon, s, over all logs: root mean squares, and the measure of what they are beside the motion.

    The measure is the error in excess of what is known, noise and uncertain starts, over that of the better trivial
    prediction in excess of the noise.
    """
    x = Sums(*(sum(parts) for parts in zip(*(loop.sums(horizon) for loop in logs), strict=True)))
    judged = np.array([n in dataset.model.state or n in dataset.model.sensors for n in dataset.signals])
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.array([x.robust, x.held, x.uniform, x.of_starts, x.of_parameters, x.of_noise]) / x.regular
        robust, held, uniform, of_starts, of_parameters, noise = squares
        of_motion = excess(held, uniform, noise)
        shares = np.array([np.maximum(robust - noise - of_starts, 0.0), of_starts + of_parameters, of_starts])
        ratio = x.squared / x.spread
        columns = (
            np.sqrt(x.squared / np.maximum(x.known, 1)),
            100.0 * (1.0 - np.sqrt(ratio)),
            1.0 - ratio,
            np.sqrt(x.robust / np.maximum(x.regular, 1)),
            np.sqrt(held),
            np.sqrt(uniform),
        )
        relative = np.nan_to_num(np.sqrt(shares / of_motion), nan=np.inf, posinf=np.inf)
    moving = np.flatnonzero(judged & np.isfinite(of_motion))
    return HorizonScores(
        horizon,
        x.windows,
        x.diverged,
        *(dict(zip(dataset.signals, y.tolist(), strict=True)) for y in columns),
        *({dataset.signals[k]: float(y[k]) for k in moving} for y in relative),
    )
