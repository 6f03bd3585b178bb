"""Hypotheses from random minimal samples of the equations in weak form, and their consensus by simulation.

An equation that holds at every moment holds under any average, too.  Rows ``W p = b`` of the smoothed motion are
averaged under a bump of a window's length: vibration and noise average out, and since the bump ends in zero, as if by
parts, little depends on the accelerations.  A sample of few averages of each equation gives a first guess, and every
guess is judged by simulation.

References: Fischler, Bolles 1981 (RANSAC); Messenger, Bortz 2021 (weak form); Nister 2005 (judging many on little, few
on all); Torr, Zisserman 2000.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.methods.lo_diransac.mixture import lower_scale
from diransac.identification.nonlinear import NonlinearLeastSquares
from diransac.identification.sampling import sample_rows
from diransac.simulation import Measurements, RolloutBatch, rollouts
from diransac.simulation.compiler import compile_map

if TYPE_CHECKING:
    from diransac.data.dataset import Observations
    from diransac.identification.methods.lo_diransac.smoothing import Motion
    from diransac.identification.methods.lo_diransac.windows import Windows
    from diransac.model import Model

__all__ = ["WeakForm", "find_hypotheses", "n_samples", "robust_scores", "weak_form"]


_COUNT = 200
_NONLINEAR_COUNT = 100
# Rows of a sample at most, in parameters: the fewer, the likelier that none of them is wrong.
_MOST = 4
_OVERLAP = 5
_FIRST_WINDOWS, _FINALISTS = 12, 12


def n_samples(model: Model) -> int:
    """Samples that are drawn for a model."""
    return _NONLINEAR_COUNT if model.nonlinear_parameters else _COUNT


def find_hypotheses(
    windows: Windows, motion: Motion, seed: int, observations: Observations
) -> tuple[FloatArray, FloatArray]:
    """Hypotheses ``(n, n_p)`` within their bounds, and their scores ``(n,)``, best first.

    Samples are judged on a few windows, the best on all.
    """
    if windows.model.nonlinear_parameters:
        finalists = _nonlinear(motion, seed, observations)
    else:
        finalists = _linear(windows, motion, seed)
    if not len(finalists):
        return finalists, np.zeros(0)
    scores = robust_scores(windows, motion, finalists, np.arange(len(windows)))
    order = np.argsort(scores, kind="stable")[: np.isfinite(scores).sum()]
    return finalists[order], scores[order]


def _linear(windows: Windows, motion: Motion, seed: int) -> FloatArray:
    """Finalists of a model that is affine in its parameters: the best of least squares of random averages."""
    weak = weak_form(windows, motion)
    few = np.unique(np.linspace(0, len(windows) - 1, min(_FIRST_WINDOWS, len(windows))).astype(int))
    samples = _admitted(windows, weak.solve(_samples(weak, seed)))
    if not len(samples):
        return samples
    return samples[np.argsort(robust_scores(windows, motion, samples, few), kind="stable")[:_FINALISTS]]


def _nonlinear(motion: Motion, seed: int, observations: Observations) -> FloatArray:
    """Finalists of any model: nonlinear least squares of all and of random rows of the smoothed motion."""
    smoothed = replace(
        observations,
        signals=tuple(observations.model.signals),
        measured=motion.signals,
        valid=np.ones(len(motion.signals), bool),
    )
    n, n_p = len(smoothed), observations.model.n_p
    rows = sample_rows(seed, np.arange(_NONLINEAR_COUNT), n, 0, min(n, _MOST * n_p))
    sizes = _generator(seed).integers(n_p, rows.shape[1] + 1, len(rows))
    samples = [np.sort(some[:size]) for some, size in zip(rows, sizes, strict=True)]
    return NonlinearLeastSquares().bind(smoothed).fit([np.arange(n), *samples])


@dataclass(frozen=True)
class WeakForm:
    """Averaged rows ``W (n, r, n_p)``, ``b (n, r)``, each equation scaled by its own size."""

    W: FloatArray
    b: FloatArray

    def solve(self, chosen: BoolArray) -> FloatArray:
        """Least squares of each set of rows ``(n_sets, n, r)``: parameters ``(n_sets, n_p)``."""
        n, r, n_p = self.W.shape
        masks = chosen.reshape(len(chosen), -1).astype(np.float64)
        G = (masks @ np.einsum("nri,nrj->nrij", self.W, self.W).reshape(n * r, -1)).reshape(-1, n_p, n_p)
        h = masks @ (self.W * self.b[:, :, None]).reshape(n * r, -1)
        d = np.sqrt(np.einsum("kii->ki", G)) + 1e-300
        G = G / d[:, :, None] / d[:, None, :] + 1e-10 * np.eye(n_p)
        return np.asarray(np.linalg.solve(G, (h / d)[:, :, None])[:, :, 0] / d)


def _samples(weak: WeakForm, seed: int) -> BoolArray:
    """All rows, and random sets of n_p to `_MOST` n_p rows of each equation."""
    rng = _generator(seed)
    n, r, n_p = weak.W.shape
    sizes = np.r_[n, np.minimum(rng.integers(n_p, _MOST * n_p + 1, _COUNT), n)]
    ranks = rng.random((len(sizes), n, r)).argsort(axis=1).argsort(axis=1)
    return np.asarray(ranks < sizes[:, None, None])


def _generator(seed: int) -> np.random.Generator:
    return np.random.default_rng([int(seed < 0), abs(seed)])


def weak_form(windows: Windows, motion: Motion) -> WeakForm:
    """Rows of the smoothed motion under overlapping bumps."""
    model, H = windows.model, windows.length
    n_q, n_v, n_p = model.n_q, model.n_v, model.n_p
    N = len(motion.signals)
    q, v, a = np.split(motion.signals, [n_q, n_q + n_v], axis=1)
    W, b = compile_map(model.regressor)(q, v, a, windows.inputs[:N])
    rows = np.concatenate([W, b], axis=1)
    bump = np.sin(np.pi * (np.arange(H) + 0.5) / H) ** 2
    bump /= bump.sum()
    firsts = np.arange(0, N - H + 1, max(1, H // _OVERLAP))
    means = np.lib.stride_tricks.sliding_window_view(rows, H, axis=0)[firsts] @ bump
    W, b = means[:, : n_p * n_v].reshape(-1, n_p, n_v).swapaxes(1, 2), means[:, n_p * n_v :]
    scale = np.maximum(np.median(np.abs(b - np.median(b, axis=0)), axis=0), 1e-9)
    return WeakForm(np.ascontiguousarray(W / scale[:, None]), b / scale)


def _admitted(windows: Windows, p: FloatArray) -> FloatArray:
    """Moved to a bound that may be touched; without those outside one that may not."""
    bounds = list(windows.model.parameters.values())
    lower = np.array([-np.inf if x.positive else x.lower for x in bounds])
    p = np.clip(p, lower, np.array([x.upper for x in bounds]))
    inside = np.all([x.admits(p[:, i]) for i, x in enumerate(bounds)], axis=0)
    return p[inside]


def robust_scores(windows: Windows, motion: Motion, parameters: FloatArray, places: IntArray) -> FloatArray:
    """Each hypothesis simulated over windows from the smoothed states, judged by its residuals' robust scale.

    The score is the sum over signals of the log of the 35 % quantile of the residuals' size: no threshold is asked
    for, and units do not matter.
    """
    n, n_x = len(parameters), windows.model.n_q + windows.model.n_v
    starts = windows.starts[places]
    seen: BoolArray = np.asarray(windows.known.any(axis=0))
    names = [s for s, k in zip(windows.model.signals, seen, strict=True) if k]
    batch = RolloutBatch(
        np.repeat(parameters, len(starts), axis=0), np.tile(motion.signals[starts, :n_x], (n, 1)), windows.inputs,
        windows.dt, np.tile(starts, n), windows.length,
    )  # fmt: skip
    measurements = Measurements(windows.measured[:, seen], windows.every)
    errors = rollouts(windows.model, names).errors(batch, measurements).reshape(n, -1, len(names))
    rows = (starts[:, None] + np.arange(windows.length)).ravel()
    known = np.broadcast_to(windows.known[rows][:, seen], errors.shape)
    scale = lower_scale(np.nan_to_num(errors, nan=np.inf), known)
    return np.asarray(np.log(np.maximum(scale, 1e-4 * motion.spread[seen])).sum(axis=1))
