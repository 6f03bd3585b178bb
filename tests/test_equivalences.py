"""Properties of the estimator that any form of it must have: what changes no answer, and which problems are one.

The machine is a damped spring that is driven by steps; its log is made by a plain Runge-Kutta loop.
"""

from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares

import diransac as dr
from diransac.data.dataset import Dataset
from diransac.identification.core.fit import Fit, with_residuals
from diransac.identification.core.minimise import SegmentsApart, minimise
from diransac.identification.core.noise import Mixture
from diransac.identification.methods.lo_diransac.local_search import LocalSearch
from diransac.identification.methods.lo_diransac.preparation import prepared

TRUTH = {"stiffness": 9.0, "damping": 0.6}
DT = 0.02


def spring(sign: float = 1.0, unit: float = 1.0, time: float = 1.0) -> dr.Model:
    """The machine with another sign or unit of its coordinate, or of time; ``a = u - stiffness y - damping v``."""
    return dr.Model(
        name="spring",
        coordinates={"y": "m"},
        inputs={"force": "N"},
        parameters={
            "stiffness": dr.Parameter("N/m", positive=True),
            "damping": dr.Parameter("N s/m", lower=0),
        },
        equations=lambda q, v, a, u, p: [
            sign * unit * (time**2 * a.y + p.stiffness * q.y + time * p.damping * v.y) - u.force
        ],
    )


@cache
def motion(seed: int = 0, wind: float = 0.0, rows: int = 1200, late: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Noisy positions ``(N,)`` and forces ``(N,)``; the wind is a force that the model lacks."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, rows // 25), 25)
    acting = np.concatenate([np.full(late, u[0]), u])[:rows]
    gusts, y, v, positions = 0.0, 0.0, 0.0, np.empty(rows)

    def rate(y: float, v: float, force: float) -> float:
        return force - TRUTH["stiffness"] * y - TRUTH["damping"] * v

    h = DT / 5
    for i in range(rows):
        positions[i] = y
        gusts += -DT / 0.5 * gusts + wind * np.sqrt(2 * DT / 0.5) * rng.standard_normal()
        force = acting[i] + gusts
        for _ in range(5):
            k1 = (v, rate(y, v, force))
            k2 = (v + h / 2 * k1[1], rate(y + h / 2 * k1[0], v + h / 2 * k1[1], force))
            k3 = (v + h / 2 * k2[1], rate(y + h / 2 * k2[0], v + h / 2 * k2[1], force))
            k4 = (v + h * k3[1], rate(y + h * k3[0], v + h * k3[1], force))
            y += h / 6 * (k1[0] + 2 * k2[0] + 2 * k3[0] + k4[0])
            v += h / 6 * (k1[1] + 2 * k2[1] + 2 * k3[1] + k4[1])
    return positions + 1e-3 * rng.standard_normal(rows), u


def log_of(seed: int = 0, wind: float = 0.0, sign: float = 1.0, unit: float = 1.0, time: float = 1.0) -> dr.Log:
    """Log with another sign or unit of its coordinate, or of time."""
    y, u = motion(seed, wind)
    return dr.Log.from_arrays(np.arange(len(y)) * DT * time, {"y": y / (sign * unit), "force": u})


@cache
def answer(wind: float = 0.0) -> dr.Result:
    """Estimate of the plain log."""
    return dr.identify(spring(), log_of(wind=wind))


def assert_same(one: dr.Result, other: dr.Result, errors: float) -> None:
    """Estimates agree within a part of a standard error."""
    assert one.verdict == other.verdict
    for name, value in one.parameters.items():
        assert other.parameters[name] == pytest.approx(value, abs=errors * one.standard_errors[name]), name


# ---------------------------------------------------------------------- what changes nothing


@pytest.mark.parametrize("wind", [0.0, 0.1])
@pytest.mark.parametrize("change", [{"sign": -1.0}, {"unit": 1e-3}], ids=["sign", "unit"])
def test_sign_and_unit_of_a_coordinate_change_no_estimate(change: dict[str, float], wind: float) -> None:
    other = dr.identify(spring(**change), log_of(wind=wind, **change))
    assert_same(answer(wind), other, 0.05)
    for name, error in answer(wind).standard_errors.items():
        assert other.standard_errors[name] == pytest.approx(error, rel=0.05)


@pytest.mark.parametrize(("wind", "errors"), [(0.0, 0.05), (0.1, 0.5)])
def test_the_unit_of_time_changes_no_estimate_of_an_exact_model(wind: float, errors: float) -> None:
    """Windows are a quarter of a second; other ones attribute gusts otherwise, within half a standard error."""
    other = dr.identify(spring(time=0.25), log_of(wind=wind, time=0.25))
    assert_same(answer(wind), other, errors)


def test_the_order_of_logs_changes_no_estimate() -> None:
    logs = [log_of(seed) for seed in (1, 2, 3)]
    assert_same(dr.identify(spring(), logs), dr.identify(spring(), logs[::-1]), 0.05)


def test_an_estimate_is_found_again_in_its_own_simulation() -> None:
    result, log = answer(), log_of()
    again = dr.identify(spring(), dr.simulate(result, log))
    for name, value in result.parameters.items():
        assert again.parameters[name] == pytest.approx(value, rel=1e-3)


# ---------------------------------------------------------------------- problems that are one


def test_segments_are_the_joint_fit_without_links() -> None:
    """Simulation error by the one loop is that of an independent solver over all initial states and parameters."""
    dataset = Dataset.of(spring(), log_of(), pointwise=False)
    intervals, smooth, _ = prepared(dr.LoDiransac(), dataset)
    starts, length, n_s = np.arange(0, 1000, 100), 100, intervals.measured.shape[1]
    windows = intervals.parts_apart(intervals.recorded, "zero-order", starts, length)
    nothing, mean, std = np.zeros(0), smooth.signals[starts, :2], np.array([1.0, 10.0])
    noise = Mixture(np.full(n_s, 1e-3), np.zeros(n_s), np.ones(n_s), np.full(n_s, 1e-6))
    fit = Fit(
        np.array([5.0, 1.0]), mean.copy(), np.zeros((len(starts), 0)), nothing, nothing, noise, nothing, nothing,
        np.ones(2), np.full(2, np.inf), np.zeros(2), x_mean=mean, x_std=std,
    )  # fmt: skip
    found = minimise(windows, with_residuals(windows, fit), SegmentsApart(outliers=False), 60)
    sigma = found.fit.noise.sigma[0]

    def residuals(z: np.ndarray) -> np.ndarray:
        x = z[2:].reshape(-1, 2)
        errors, _ = windows.simulated(z[:2], x, np.zeros((len(x), 0)))
        return np.concatenate([errors[:, 0] / sigma, ((x - mean) / std).ravel()])

    best = least_squares(residuals, np.concatenate([[5.0, 1.0], mean.ravel()]), x_scale="jac", xtol=1e-12, ftol=1e-12)
    spread = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    assert found.converged
    assert (np.abs(found.fit.shared - best.x[:2]) < 0.1 * spread[:2]).all()
    assert (np.abs(found.fit.x.ravel() - best.x[2:]) < 0.1 * spread[2:]).all()


def test_the_exact_model_is_the_limit_of_the_flexible_one() -> None:
    """An exact log leaves no unmodelled acceleration, so that forbidding it changes nothing."""
    stiff = dr.identify(spring(), log_of(), method=dr.LoDiransac(model_error=False))
    assert_same(answer(), stiff, 0.05)


@pytest.mark.parametrize(("wind", "late"), [(0.0, 0), (0.1, 0), (0.0, 3)], ids=["exact", "gusts", "late"])
def test_evidence_rises_along_accepted_moves(wind: float, late: int, monkeypatch: pytest.MonkeyPatch) -> None:
    y, u = motion(0, wind, late=late)
    costs, stages = list[float](), LocalSearch._ever_likelier

    def recorded(self, *arguments, **options):
        for explanation in stages(self, *arguments, **options):
            costs.append(explanation.cost)
            yield explanation

    monkeypatch.setattr(LocalSearch, "_ever_likelier", recorded)
    log = dr.Log.from_arrays(np.arange(len(y)) * DT, {"y": y, "force": u})
    dr.identify(spring(), log)
    assert len(costs) >= 3
    assert (np.diff(costs) < 0.5).all()  # half a nat: what fewer integration steps may cost
