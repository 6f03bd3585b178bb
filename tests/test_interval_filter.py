"""One-interval predictions: linear models of an interval, and what its samples tell."""

import numpy as np
import pytest

from diransac.identification.methods.lo_diransac.interval_filter import (
    RADIUS,
    Belief,
    LinearInterval,
    Update,
    bounded_influence,
)
from diransac.identification.methods.lo_diransac.prediction_error import is_worse, with_widths


def intervals_of(n: int = 200) -> np.ndarray:
    """Information of intervals on four parameters, of different sizes."""
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(n, 6, 4)) * [1.0, 10.0, 0.1, 3.0]
    return slopes.swapaxes(1, 2) @ slopes


def test_intervals_that_tell_alike_keep_their_weights():
    assert (bounded_influence(intervals_of()) == 1.0).all()


@pytest.mark.parametrize("steep", [[80], [79, 80]])
def test_a_contact_that_is_about_to_change_does_not_outweigh_the_log(steep: list[int]):
    ordinary = intervals_of()
    information = ordinary.copy()
    information[steep] += 1e6 * np.outer([1.0, -5.0, 0.2, 1.0], [1.0, -5.0, 0.2, 1.0])
    weights = bounded_influence(information)
    assert (weights[steep] < 1e-2).all()
    assert (np.delete(weights, steep) == 1.0).all()
    with_it = np.linalg.inv(np.einsum("w,wij->ij", weights, information))
    without = np.linalg.inv(ordinary.sum(axis=0))
    assert np.sqrt(np.diag(without) / np.diag(with_it)).max() < 1.25
    free = np.linalg.inv(information.sum(axis=0))
    assert np.sqrt(np.diag(without) / np.diag(free)).max() > 1.25


def test_intervals_without_samples_tell_nothing():
    information = intervals_of()
    information[20:40] = 0.0
    assert np.isfinite(bounded_influence(information)).all()


def test_losses_differ_where_most_intervals_agree_that_they_do():
    rng = np.random.default_rng(1)
    jumps = 50.0 * rng.normal(size=200)
    jumps -= jumps.mean()
    assert not is_worse(jumps + 1.0, np.zeros(200))
    assert is_worse(np.full(200, 1.0), np.zeros(200))
    assert not is_worse(np.full(200, 1e-3), np.zeros(200))  # a fifth of a nat


N_X, N_Q, N_P, ROWS = 3, 2, 2, 4


def belief_of(seed: int = 0) -> tuple[Belief, np.ndarray]:
    """Belief of a state, and a root of the covariance of two parameters."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N_X, N_X))
    return Belief(root @ root.T, rng.normal(size=(N_X, N_P))), np.array([[0.2, 0.0], [-0.1, 0.05]])


def pairs(belief: Belief, root: np.ndarray) -> np.ndarray:
    """Differences of state and parameters over their spread: none, those of one sign, of the other."""
    ahead = RADIUS * belief.directions(root).T
    return np.vstack([np.zeros(N_X + N_P), ahead, -ahead])


def of_values(belief: Belief, points: np.ndarray, errors: np.ndarray, ends: np.ndarray) -> LinearInterval:
    """Linear interval by errors ``(k, m)`` and ends ``(k, n_x)`` at points ``(k, n_x + n)``."""
    return LinearInterval.of(belief, N_Q, points, np.hstack([errors, ends]))


def test_slopes_over_the_spread_of_a_linear_interval_are_local_ones():
    belief, root = belief_of()
    rng = np.random.default_rng(1)
    errors, J = rng.normal(size=ROWS), rng.normal(size=(ROWS, N_X + N_P))
    end, F = rng.normal(size=N_X), rng.normal(size=(N_X, N_X + N_P))
    local, over = (
        of_values(belief, x, errors + x @ J.T, end + x @ F.T)
        for x in (np.vstack([np.zeros(N_X + N_P), 1e-3 * np.eye(N_X + N_P)]), pairs(belief, root))
    )
    assert local.is_local
    assert not over.is_local
    slopes = np.vstack([J, F])
    np.testing.assert_allclose(local.values, np.append(errors, end))
    np.testing.assert_allclose(local.of_unknown, slopes[:, :N_X] @ belief.root, atol=1e-9)
    np.testing.assert_allclose(local.of_parameters, slopes[:, N_X:] + slopes[:, :N_X] @ belief.slopes, atol=1e-9)
    np.testing.assert_allclose(local.of_velocities, F[:, N_Q:N_X], atol=1e-9)
    for name in ("values", "of_parameters", "of_velocities"):
        np.testing.assert_allclose(getattr(over, name), getattr(local, name), atol=1e-9)
    np.testing.assert_allclose(over.of_unknown[:, :N_X], local.of_unknown, atol=1e-9)
    np.testing.assert_allclose(over.of_unknown[:, N_X:], 0.0, atol=1e-9)


def test_the_mean_and_variance_over_a_spread_are_those_of_a_gaussian_state():
    """For the square of a state's coordinate, both are known: ``m^2 + s^2`` and ``4 m^2 s^2 + 2 s^4``."""
    belief, root = Belief(np.diag([0.09, 1.0, 1.0]), np.zeros((N_X, N_P))), 0.1 * np.eye(N_P)
    points = pairs(belief, root)
    squares = np.square(2.0 + points[:, :1])
    over = of_values(belief, points, squares, squares @ np.ones((1, N_X)))
    np.testing.assert_allclose(over.values, 4.0 + 0.09)
    np.testing.assert_allclose(np.square(over.of_unknown).sum(axis=1), 4.0 * 4.0 * 0.09 + 2.0 * 0.09**2)


def test_a_curved_effect_of_parameters_moves_no_prediction():
    belief, root = belief_of()[0], 0.5 * np.eye(N_P)
    points = pairs(belief, root)
    over = of_values(belief, points, np.square(1.0 + points[:, N_X : N_X + 1]), np.zeros((len(points), N_X)))
    np.testing.assert_allclose(over.values[0], 1.0)
    np.testing.assert_allclose(over.of_parameters[0], [2.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(over.of_unknown[:, N_X:], 0.0, atol=1e-12)


def test_an_update_is_that_of_bayes_with_what_slopes_leave_as_noise():
    belief, root = belief_of(2)
    rng = np.random.default_rng(3)
    points = pairs(belief, root)
    bent = rng.normal(size=(ROWS, N_X)) * 0.3
    linear = of_values(belief, points, rng.normal(size=ROWS) + np.square(points[:, :N_X]) @ bent.T, points[:, :N_X])
    weights = rng.uniform(0.5, 2.0, (ROWS, 1))
    update = Update.of(belief, linear, weights)

    unknown, end = np.split(linear.of_unknown, [ROWS])
    of_p, errors = linear.of_parameters[:ROWS], linear.values[:ROWS]
    S = np.linalg.inv(unknown @ unknown.T + np.diag(1.0 / weights.ravel()))
    gain = belief.root @ unknown[:, :N_X].T @ S
    np.testing.assert_allclose(update.moved, -gain @ errors)
    covariance = belief.covariance - gain @ unknown[:, :N_X] @ belief.root.T
    np.testing.assert_allclose(update.belief.covariance, covariance, atol=1e-9)
    np.testing.assert_allclose(update.information, of_p.T @ S @ of_p)
    np.testing.assert_allclose(update.score, -of_p.T @ S @ errors)
    np.testing.assert_allclose(update.values[ROWS:], linear.values[ROWS:] - end @ unknown.T @ S @ errors)
    covariance = end @ (np.eye(2 * N_X) - unknown.T @ S @ unknown) @ end.T
    np.testing.assert_allclose(update.belief_of_end.covariance, covariance, atol=1e-9)


def test_samples_that_are_wrong_together_count_less():
    belief, rng = belief_of(4)[0], np.random.default_rng(5)
    slopes = rng.normal(size=(400 + N_X, N_X + N_P))
    noise, weights = rng.standard_normal(400), np.full((400, 1), 100.0)
    noise *= 0.1 / np.sqrt(np.mean(np.square(noise)))
    shares, points = [], np.vstack([np.zeros(N_X + N_P), np.eye(N_X + N_P)])
    for error in (0.5 * noise, noise, 10.0 * noise, noise + 1.0):
        linear = LinearInterval.of(belief, N_Q, points, np.append(error, np.zeros(N_X)) + points @ slopes.T)
        shares.append(Update.of(belief, linear, weights).share(400.0))
    assert shares == pytest.approx([1.0, 1.0, 0.1, 0.1], rel=0.1)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 1.0])
def test_a_spread_has_a_width_in_every_direction(correlation: float):
    """That of parameters which the logs tell together alone, or not at all, as well."""
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = 4.0 * np.array([[1.0, -correlation], [-correlation, 1.0]])
    spread = with_widths(covariance, np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(np.sqrt(np.diag(spread)), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(spread[0, 1], -0.99 * correlation * 0.02)
    assert np.linalg.eigvalsh(spread).min() > 1e-6
