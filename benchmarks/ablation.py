"""What each stage of lo-diransac buys: it is taken out, and the worst parameter's error is measured.

Errors are relative to the truth; where the model is wrong, to what least squares gives without noise.

Run: ``OPENBLAS_NUM_THREADS=1 python benchmarks/ablation.py [number of seeds]``.  Prints the worst parameter's error, %,
the median over seeds (and the worst), for each scenario and each stage that is left out.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import diransac as dr
from diransac.data.dataset import observe
from diransac.errors import DiransacError
from diransac.identification.methods.lo_diransac import find, hypotheses, method, mixture, readout, refinement
from simulated import MACHINES, as_log, flight

MACHINE, MODEL, DT = MACHINES["planar-rotorcraft"], dr.models.planar_rotorcraft(), 0.01
TRUTH = np.array(list(MACHINE.truth.values()))

Arrays = tuple[np.ndarray, np.ndarray]


# ---------------------------------------------------------------------- scenarios: signals and inputs, seed by seed
def outliers(probability: float, magnitude: float) -> Callable[[int], Arrays]:
    """Each sample is hit independently."""

    def make(seed: int) -> Arrays:
        (signals, inputs), rng = CLEAN, np.random.default_rng(seed)
        hit = rng.random(signals.shape) < probability
        return signals + hit * rng.uniform(-magnitude, magnitude, signals.shape), inputs

    return make


def leverage(seed: int) -> Arrays:
    """One-sided outliers at high thrust, with probability 0.8."""
    (signals, inputs), rng = CLEAN, np.random.default_rng(seed)
    high = np.abs(inputs[:, 0]) > np.quantile(np.abs(inputs[:, 0]), 0.7)
    hit = (rng.random(signals.shape) < 0.8) & high[:, None]
    return signals + hit * rng.uniform(0.0, 80.0, signals.shape), inputs


def noise(seed: int) -> Arrays:
    """Table III's largest: 2.5 m/s^2 and 1 rad/s, and what integrates from them."""
    (signals, inputs), rng, r = CLEAN, np.random.default_rng(seed), np.sqrt(DT)
    sizes = [2.5 * DT, 2.5 * DT, r, 2.5 * r, 2.5 * r, 1.0, 2.5, 2.5, 1.0 / r]
    return signals + sizes * rng.normal(size=signals.shape), inputs


def frozen(seed: int) -> Arrays:
    """A fifth of the log stands still, a tenth of the rest is hit, some noise."""
    signals, inputs = outliers(0.1, 80.0)(seed)
    rng = np.random.default_rng(seed)
    signals = signals + 0.02 * CLEAN[0].std(axis=0) * rng.normal(size=signals.shape)
    for first in rng.choice(np.arange(50, 2400, 50), 10, replace=False):
        signals[first : first + 50] = signals[first - 1]
    return signals, inputs


def delayed(seed: int) -> Arrays:
    """Inputs that act 20 ms after they were recorded, and outliers."""
    signals, inputs = outliers(0.1, 80.0)(seed)
    return signals, np.vstack([inputs[2:], inputs[-1:], inputs[-1:]])


def lifted_acceleration(q: object, v: object, u: object, p: object) -> tuple[float, ...]:
    """The rotorcraft with a tenth of its thrust on top, straight up, as unequal rotor blades do."""
    x, z, theta = MACHINE.acceleration(q, v, u, p)
    return x, z + 0.1 * u[0] / p[0], theta


def mismatch(seed: int) -> Arrays:
    """A tenth of the thrust too much, straight up; noise; outliers."""
    (signals, inputs), rng = LIFTED, np.random.default_rng(seed)
    hit = rng.random(signals.shape) < 0.2
    noisy = signals + 0.05 * signals.std(axis=0) * rng.normal(size=signals.shape)
    return noisy + hit * rng.uniform(-80.0, 80.0, signals.shape), inputs


SCENARIOS: dict[str, Callable[[int], Arrays]] = {
    "outliers .5": outliers(0.5, 80.0),
    "leverage .8": leverage,
    "noise": noise,
    "frozen": frozen,
    "delay": delayed,
    "mismatch": mismatch,
}


# ---------------------------------------------------------------------- what is left out
def everything() -> list:
    """The method as it is."""
    return []


def samples() -> list:
    """One hypothesis, from all of the log: no samples, no consensus."""
    return [patch.object(hypotheses, "_COUNT", 0)]


def further_starts() -> list:
    """The best hypothesis alone is refined."""
    return [patch.object(method, "_MAX_STARTS", 1)]


def refinement_stage() -> list:
    """The best hypothesis is the answer."""

    def keep(_windows: object, fit: refinement.Fit, _belief: object) -> refinement.Refinement:
        return refinement.Refinement(fit, 0.0, 0, settled=True)

    return [patch.object(method, "refine", keep), *read_out_stage()]


def read_out_stage() -> list:
    """The parameters of the fit are the answer."""
    original = method.read_out

    def plain(windows: object, fit: refinement.Fit) -> readout.Readout:
        return replace(original(windows, fit), parameters=fit.shared[: MODEL.n_p])

    return [patch.object(method, "read_out", plain)]


def _believing(**changes: float) -> list:
    original = method.believe

    def believe(*arguments: object) -> refinement.Belief:
        belief = original(*arguments)
        scale = changes.get("tau", 1.0)
        return replace(belief, tau=scale * belief.tau, **{k: v for k, v in changes.items() if k != "tau"})

    return [patch.object(method, "believe", believe)]


def pushes() -> list:
    """Actuators are as the model says."""
    return _believing(push=1e-6, guarded=1e-6)


def delay() -> list:
    """Inputs act when they are recorded."""
    return [*_believing(delay=1e-6), patch.object(method, "_MAX_SHIFTS", 0), *whole_rows()]


def weak_belief() -> list:
    """Latent accelerations may vanish without proof."""
    return _believing(tau=0.01)


def unmodelled_accelerations() -> list:
    """The model is exact: tau comes down to nothing, whatever the log says."""
    original = refinement._evidence

    def evidence(belief: np.ndarray, now: np.ndarray, squares: np.ndarray, determined: np.ndarray) -> np.ndarray:
        if np.ndim(belief) and len(belief) == MODEL.n_v:
            return np.maximum(0.4 * now, 1e-3 * belief)
        return original(belief, now, squares, determined)

    return [patch.object(refinement, "_evidence", evidence)]


def robust_tau() -> list:
    """Tau follows the evidence from the start."""
    original = refinement._update

    def update(*arguments: object, **_robust: bool) -> object:
        return original(*arguments, robust=False)

    return [patch.object(refinement, "_update", update)]


def slow_continuity() -> list:
    """The motion is continuous from the start."""
    original = method.start

    def start(windows: object, motion: object, p: np.ndarray, belief: refinement.Belief) -> refinement.Fit:
        fit = original(windows, motion, p, belief)
        return replace(fit, slack=refinement._continuity(windows, fit.tau))

    return [patch.object(method, "start", start)]


def neighbours() -> list:
    """Windows begin where the smoothed motion says, however many outliers there are."""
    return [patch.object(refinement, "_anchored", lambda _windows, fit: fit)]


def whole_rows() -> list:
    """Late inputs are for local optimisation alone."""
    return [patch.object(method, "_likeliest_shift", lambda _windows, _motion, _p: 0)]


def outlier_component() -> list:
    """Noise is Gaussian."""
    return [patch.object(mixture.Mixture, "inlying", lambda _self, _residuals, known: known.astype(float))]


def gate() -> list:
    """Rows that stand still count."""
    return [patch.object(method, "stuck_rows", lambda measured: np.zeros(len(measured), bool))]


LEFT_OUT = {
    "nothing": everything,
    "samples": samples,
    "local optimisation": refinement_stage,
    "further starts": further_starts,
    "neighbours": neighbours,
    "outliers in the noise": outlier_component,
    "latent accelerations": unmodelled_accelerations,
    "belief in a thousandth": weak_belief,
    "pushes": pushes,
    "delay": delay,
    "delay by whole rows first": whole_rows,
    "robust tau at first": robust_tau,
    "slow continuity": slow_continuity,
    "read-out": read_out_stage,
    "gate": gate,
}


def worst_errors(make: Callable[[int], Arrays], patches: Callable[[], list], n_seeds: int) -> Iterator[float]:
    """The worst parameter's error, %, seed by seed; infinite where the method gives up."""
    for seed in range(n_seeds):
        log = as_log(MACHINE, *make(seed), DT)
        with ExitStack() as stack:
            for change in patches():
                stack.enter_context(change)
            try:
                found = find(observe(MODEL, log, pointwise=False), seed).parameters
            except DiransacError:
                yield np.inf
            else:
                yield 100.0 * float(np.abs(found / (EFFECTIVE if make is mismatch else TRUTH) - 1.0).max())


def main() -> None:
    """Print the table."""
    n_seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 3
    print(f"{'left out':28s}" + "".join(f"{name:>20s}" for name in SCENARIOS))
    for name, patches in LEFT_OUT.items():
        cells = [np.array(list(worst_errors(make, patches, n_seeds))) for make in SCENARIOS.values()]
        print(f"{name:28s}" + "".join(f"{np.median(c):>11.3g} [{c.max():.3g}]".rjust(20) for c in cells), flush=True)


CLEAN = flight(MACHINE, 2500, DT)
LIFTED = flight(replace(MACHINE, acceleration=lifted_acceleration), 2500, DT)
W, B = MACHINE.rows(*LIFTED)
EFFECTIVE = np.linalg.lstsq(W.reshape(-1, 3), B.ravel())[0]

if __name__ == "__main__":
    main()
