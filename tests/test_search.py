"""Algorithm 1: ours against a slow and literal one, which shares nothing with it but what it is given."""

import math
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import cache
from hashlib import sha256

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from algorithm1 import Choices, Problem, Story, algorithm1
from diransac.data.dataset import Dataset
from diransac.errors import IdentificationError
from diransac.identification.evaluation.scoring import (
    choose_scoring,
    judged_signals,
    mean_squared_error,
    rms_error,
)
from diransac.identification.method import Progress
from diransac.identification.methods.ransac import Diransac, IDiransac, SearchState, search
from diransac.identification.methods.samples import Evaluator, Samples, Score, ScoredBatch
from diransac.identification.regression.estimators import OrdinaryLeastSquares
from diransac.identification.settings import Settings
from diransac.model.library import builtin
from simulated import MACHINES, as_log, flight, rollout, with_outliers

VARIANTS = ("i-diransac", "diransac")
FAR = 1e-9
UNUSED = {"x", "z"}


@dataclass(frozen=True, eq=False)
class Case:
    """A log and the settings that it is searched with.

    Parameters
    ----------
    size : rows, and seconds from one to the next
    corruption : probability and magnitude of outliers, standard deviation of white noise over each signal's own
    gaps : rows and signals that are NaN
    """

    name: str
    machine: str
    size: tuple[int, float]
    corruption: tuple[float, float, float]
    seed: int
    settings: Settings
    first_row: str = "clean"
    gaps: tuple[tuple[int, str], ...] = ()


TABLE_IV = replace(Settings.table_iv(), max_iterations=40, stop_inlier_fraction=None)
EARLY = replace(TABLE_IV, sample_size=9, stop_inlier_fraction=0.85)
BY_ERROR = replace(TABLE_IV, sample_size=4, acceptance_weights=(1.0, 0.0))
BY_INLIERS = replace(BY_ERROR, acceptance_weights=(0.0, 1.0))
BY_FOUR = replace(BY_ERROR, max_iterations=60, min_inlier_signals=4)
DEFAULT = Settings(sample_size=5, max_iterations=60, stop_inlier_fraction=None)
DEFAULT_BY_ERROR = replace(DEFAULT, acceptance_weights=(1.0, 0.0))
DEFAULT_BY_INLIERS = replace(DEFAULT, sample_size=15, acceptance_weights=(0.0, 1.0))
GAPS = ((3, "x_dot"), (40, "theta"), (41, "theta_ddot"), (90, "z"), (199, "x_ddot"))
PLANE, VEHICLE, SERVO = "planar-rotorcraft", "underwater-vehicle", "servo-axis"

CASES = [
    Case("table iv", PLANE, (250, 0.02), (0.1, 80.0, 0.02), 0, replace(TABLE_IV, sample_size=12)),
    Case("early stop", PLANE, (250, 0.02), (0.1, 80.0, 0.02), 14, EARLY),
    Case("first row hit", PLANE, (250, 0.02), (0.1, 20.0, 0.05), 3, replace(TABLE_IV, sample_size=10), "hit"),
    Case("gaps", PLANE, (200, 0.02), (0.1, 30.0, 0.05), 4, replace(TABLE_IV, sample_size=8), gaps=GAPS),
    Case("near misses", PLANE, (120, 0.02), (0.1, 5.0, 0.2), 21, BY_ERROR),
    Case("by inliers", PLANE, (120, 0.02), (0.1, 5.0, 0.05), 105, BY_INLIERS),
    Case("circles", PLANE, (40, 0.02), (0.2, 3.0, 0.5), 32, BY_FOUR),
    Case("no refits", PLANE, (250, 0.02), (0.2, 10.0, 0.1), 5, replace(TABLE_IV, sample_size=6, refit="none")),
    Case("one iteration", PLANE, (150, 0.02), (0.0, 0.0, 0.1), 8, replace(TABLE_IV, max_iterations=1)),
    Case("grown samples", VEHICLE, (250, 0.1), (0.1, 2.0, 0.1), 0, replace(DEFAULT, sample_size=3)),
    Case("stiff", VEHICLE, (120, 0.4), (0.02, 20.0, 0.05), 24, DEFAULT),
    Case("small circles", VEHICLE, (40, 0.4), (0.1, 2.0, 0.1), 95, DEFAULT_BY_ERROR),
    Case("fixed point", VEHICLE, (40, 0.4), (0.1, 2.0, 0.1), 10, DEFAULT_BY_ERROR),
    Case("divergent and accepted", VEHICLE, (120, 0.4), (0.1, 20.0, 0.1), 14, DEFAULT_BY_INLIERS),
    Case("dry friction", SERVO, (40, 0.02), (0.2, 3.0, 0.5), 66, DEFAULT_BY_ERROR),
]


@cache
def order(seed: int, k: int, n_rows: int) -> tuple[int, ...]:
    """The rows in an order that (seed, k) decides, whatever becomes of anybody's random numbers."""
    return tuple(sorted(range(n_rows), key=lambda row: sha256(f"{seed} {k} {row}".encode()).digest()))


def shuffled(seed, iterations, n_rows, start, stop):
    """The same as a sampler of ours."""
    return np.array([order(seed, int(k), n_rows)[start:stop] for k in iterations], dtype=np.int64)


class Recorder:
    """An evaluator that keeps the inlier sets it is asked for."""

    def __init__(self, evaluator: Evaluator) -> None:
        self._evaluator = evaluator
        self.admits = evaluator.admits
        self.inlier_sets: list[np.ndarray] = []

    def score(self, parameters):
        """As the evaluator says, in a batch that is watched."""
        return RecordedBatch(self._evaluator.score(parameters), self.inlier_sets)


class RecordedBatch:
    """A scored batch that keeps the inlier sets it is asked for."""

    def __init__(self, batch: ScoredBatch, inlier_sets: list[np.ndarray]) -> None:
        self._batch, self._inlier_sets = batch, inlier_sets
        self.scores = batch.scores

    def inliers(self, lane):
        """As the batch says, and kept."""
        self._inlier_sets.append(self._batch.inliers(lane))
        return self._inlier_sets[-1]


@cache
def recorded(case: Case):
    """Signals and inputs of a case's log, as they were recorded."""
    machine = MACHINES[case.machine]
    probability, magnitude, noise = case.corruption
    clean, inputs = flight(machine, *case.size)
    white = np.random.default_rng(1000 + case.seed).normal(size=clean.shape)
    noisy = with_outliers(clean, probability, magnitude, case.seed, first_row=case.first_row)
    noisy += noise * clean.std(axis=0) * white
    for row, name in case.gaps:
        noisy[row, machine.signals.index(name)] = np.nan
    return noisy, inputs


def observed(case: Case, settings: Settings | None = None):
    machine, model, settings = MACHINES[case.machine], builtin(case.machine), settings or case.settings
    log = as_log(machine, *recorded(case), case.size[1])
    dataset = Dataset.of(model, log, judged_signals(model, [log], settings))
    return dataset, choose_scoring(dataset, settings)


def variant_of(name: str, settings: Settings) -> IDiransac | Diransac:
    """The variant; DIRANSAC has no acceptance weights, and refuses any."""
    if name == "i-diransac":
        return IDiransac(settings)
    return Diransac(replace(settings, acceptance_weights=Settings().acceptance_weights))


@cache
def run_ours(case: Case, name: str, **changes) -> tuple[SearchState | str, list[np.ndarray]]:
    """What our search found, or what it says where it found nothing, and the inlier sets that it asked for."""
    settings = replace(case.settings, **changes)
    dataset, scoring = observed(case, settings)
    variant = variant_of(name, settings)
    evaluator = Recorder(Evaluator(dataset, scoring, settings))
    estimator = OrdinaryLeastSquares().bind(dataset)
    try:
        state = search(variant, Samples(estimator, evaluator, shuffled, settings.sample_size, case.seed))
    except IdentificationError as error:
        return str(error), evaluator.inlier_sets
    return state, evaluator.inlier_sets


@cache
def run_literal(case: Case, variant: str) -> Story:
    machine, model = MACHINES[case.machine], builtin(case.machine)
    (signals, inputs), (_, dt) = recorded(case), case.size
    usable = np.ones(len(signals), dtype=bool)
    for row, name in case.gaps:
        usable[row] = name in UNUSED
    start = signals[0, : 2 * len(machine.coordinates)]
    bounds = list(model.parameters.values())
    _, scoring = observed(case)
    problem = Problem(
        *machine.rows(signals, inputs),
        signals,
        usable,
        np.array([x.lower for x in bounds]),
        np.array([x.upper for x in bounds]),
        np.array([x.positive for x in bounds]),
        order,
        lambda p: rollout(machine, p, start, inputs, dt),
    )
    s = case.settings
    choices = Choices(
        variant,
        s.sample_size,
        s.max_iterations,
        s.stop_inlier_fraction,
        scoring.thresholds,
        scoring.min_inlier_signals,
        scoring.weights,
        s.acceptance_weights,
        s.refit == "inliers",
        case.seed,
    )
    return algorithm1(problem, choices)


def assert_agree(state: SearchState | str, inlier_sets: list[np.ndarray], story: Story) -> None:
    offered = [h.inliers for h in story.hypotheses if h.offers_refit]
    assert len(inlier_sets) == len(offered)
    assert all(np.array_equal(ours, theirs) for ours, theirs in zip(inlier_sets, offered, strict=True))
    if story.best is None:
        counts = ", ".join(f"{n} {reason}" for reason, n in story.fates.most_common())
        assert f"no hypothesis was accepted in {story.k} samples ({counts})" in state
        return
    assert state.iterations == story.k
    assert state.n_hypotheses == len(story.hypotheses)
    assert state.rejected == story.fates
    assert np.array_equal(np.sort(state.best.rows), np.sort(story.best.rows))
    assert state.best.score.inlier_fraction == story.best.fraction
    assert state.best.score.error == pytest.approx(story.best.error, rel=1e-9)
    assert state.best.parameters == pytest.approx(story.best.parameters, rel=1e-9)


# ---------------------------------------------------------------------- agreement


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_search_agrees_with_the_literal_algorithm_and_its_own_simulator_where_nothing_is_close(case, variant):
    story = run_literal(case, variant)
    assert story.margin > FAR, "this log decides by rounding; choose another seed"
    assert_agree(*run_ours(case, variant), story)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
@pytest.mark.parametrize(("batch_size", "threads"), [(1, 1), (7, 2), (1024, 3)])
def test_batch_size_and_threads_never_change_a_bit(case, variant, batch_size, threads):
    usual, usual_sets = run_ours(case, variant)
    other, other_sets = run_ours(case, variant, batch_size=batch_size, threads=threads)
    assert [x.tobytes() for x in other_sets] == [x.tobytes() for x in usual_sets]
    if isinstance(usual, str):
        assert other == usual
        return
    assert other.best.parameters.tobytes() == usual.best.parameters.tobytes()
    assert (other.best.rows.tobytes(), other.best.score) == (usual.best.rows.tobytes(), usual.best.score)
    for name in ("iterations", "n_hypotheses", "rejected", "stop_reason"):
        assert getattr(other, name) == getattr(usual, name)


def test_the_cases_hold_every_turn_that_the_algorithm_can_take():
    stories = {(c.name, v): run_literal(c, v) for c in CASES for v in VARIANTS}
    fates = sum((s.fates for s in stories.values()), Counter())
    assert all(fates[reason] > 0 for reason in ("out of bounds", "diverged", "no improvement", "not accepted"))
    assert sum(s.cycles > 0 for s in stories.values()) >= 3
    assert sum(s.fates["diverged"] for s in stories.values()) >= 5
    assert sum(s.fixed_points for s in stories.values()) > 0
    assert sum(s.grown for s in stories.values()) > 0
    assert stories["early stop", "i-diransac"].k < TABLE_IV.max_iterations
    assert sum(s.never_run for s in stories.values()) > 0
    assert any(h.is_refit and h.fate == "stored" for s in stories.values() for h in s.hypotheses)
    assert any(h.is_refit and h.fate == "out of bounds" for s in stories.values() for h in s.hypotheses)
    assert any(s.best is not None and np.isinf(s.best.error) for s in stories.values())
    assert any(s.best is None for s in stories.values())


# ---------------------------------------------------------------------- single turns, by a script


@dataclass
class Script:
    """Estimator and evaluator of a world in which parameter ``p`` of a set of rows, and its fate, are written down.

    Parameters
    ----------
    fits : rows (in any order) -> p; every other set gives 0
    found : p -> (error, inliers); every other p diverges at once
    smallest : rows that a set needs to be well-defined
    fitted : the sets that were fitted, in order
    """

    fits: dict[tuple[int, ...], float]
    found: dict[float, tuple[float, list[int]]]
    n_rows: int = 10
    smallest: int = 1
    fitted: list[tuple[int, ...]] = field(default_factory=list)

    def select(self, row_sets):
        """The sets, to be checked and fitted."""
        return ScriptedSelection(self, [tuple(sorted(np.asarray(rows).tolist())) for rows in row_sets])

    def admits(self, parameters):
        """Nothing negative."""
        return parameters[:, 0] >= 0.0

    def score(self, parameters):
        """As it is written down."""
        return ScriptedBatch([self.found.get(p, (np.inf, [])) for p in parameters[:, 0]], self.n_rows)


@dataclass
class ScriptedSelection:
    """Sets of rows, as their script has them."""

    script: Script
    keys: list[tuple[int, ...]]

    def well_defined(self):
        """By the number of rows."""
        return np.array([len(key) >= self.script.smallest for key in self.keys])

    def fit(self):
        """As it is written down."""
        self.script.fitted += self.keys
        return np.array([[self.script.fits.get(key, 0.0)] for key in self.keys])


@dataclass
class ScriptedBatch:
    """Errors and inliers, as their script has them."""

    found: list[tuple[float, list[int]]]
    n_rows: int

    def scores(self, *, squared_error):
        """Of every hypothesis; the script has one error."""
        return [Score(error, len(rows) / self.n_rows) for error, rows in self.found]

    def inliers(self, lane):
        """Of one."""
        return np.array(self.found[lane][1], dtype=np.int64)


def first_two(seed, iterations, n_rows, start, stop):
    """Sample k begins with rows k and k + 1."""
    return np.array([[(k + j) % n_rows for j in range(start, stop)] for k in np.atleast_1d(iterations)])


def run_script(script, variant=IDiransac, sampler=first_two, callback=None, **changes):
    settings = Settings(**{"sample_size": 2, "max_iterations": 1, "stop_inlier_fraction": None, **changes})
    return search(variant(settings), Samples(script, script, sampler, settings.sample_size, 0), callback)


def test_refit_that_is_pending_at_the_iteration_limit_never_runs():
    script = Script({(0, 1): 1.0, (2, 3, 4): 2.0}, {1.0: (5.0, [2, 3, 4]), 2.0: (1.0, [2, 3, 4])})
    state = run_script(script)
    assert state.best.parameters == [1.0]
    assert (state.iterations, state.n_hypotheses) == (1, 1)


def test_refit_runs_before_the_next_sample_and_does_not_count():
    script = Script(
        {(0, 1): 1.0, (2, 3, 4): 2.0, (1, 2): 3.0}, {1.0: (5.0, [2, 3, 4]), 2.0: (1.0, [2, 3, 4]), 3.0: (9.0, [])}
    )
    state = run_script(script, max_iterations=2, batch_size=1)
    assert script.fitted == [(0, 1), (2, 3, 4), (1, 2)]
    assert state.best.parameters == [2.0]
    assert (state.iterations, state.n_hypotheses) == (2, 3)


def test_refit_that_is_pending_when_the_inlier_fraction_is_reached_never_runs():
    script = Script({(0, 1): 1.0, (2, 3, 4): 2.0}, {1.0: (5.0, [2, 3, 4]), 2.0: (1.0, [2, 3, 4])})
    state = run_script(script, max_iterations=5, batch_size=1, stop_inlier_fraction=0.3)
    assert state.best.parameters == [1.0]
    assert (state.iterations, state.n_hypotheses, state.stop_reason) == (1, 1, "inlier fraction reached")


def test_refit_that_fails_the_preliminary_test_ends_its_chain():
    script = Script({(0, 1): 1.0, (2, 3, 4): -1.0, (1, 2): 3.0}, {1.0: (5.0, [2, 3, 4]), 3.0: (9.0, [])})
    state = run_script(script, max_iterations=2)
    assert state.best.parameters == [1.0]
    assert state.rejected == {"out of bounds": 1, "no improvement": 1}


def test_chain_that_meets_a_set_again_ends():
    fits = {(0, 1): 1.0, (2, 3, 4): 2.0, (5, 6, 7, 8): 3.0, (2, 3, 4, 5): 2.0}
    found = {1.0: (1.0, [2, 3, 4]), 2.0: (9.0, [5, 6, 7, 8]), 3.0: (9.0, [2, 3, 4, 5])}
    script = Script(fits, found)
    state = run_script(script, acceptance_weights=(1.0, 0.0), max_iterations=2)
    assert (state.iterations, state.best.parameters) == (2, [1.0])
    assert script.fitted == [(0, 1), (1, 2), (2, 3, 4), (5, 6, 7, 8), (2, 3, 4, 5)]


def test_inliers_that_are_the_sample_itself_in_whatever_order_are_not_fitted_again():
    def backwards(*arguments):
        return first_two(*arguments)[:, ::-1]

    script = Script({(0, 1): 1.0}, {1.0: (5.0, [0, 1])})
    run_script(script, sampler=backwards, max_iterations=2)
    assert script.fitted == [(0, 1), (1, 2)]


@pytest.mark.parametrize(
    ("variant", "changes"), [(IDiransac, {"acceptance_weights": (1.0, 0.0)}), (Diransac, {})], ids=VARIANTS
)
def test_no_inliers_at_all_lead_to_a_new_sample(variant, changes):
    script = Script({(0, 1): 1.0, (1, 2): 2.0}, {1.0: (5.0, []), 2.0: (4.0, [])})
    state = run_script(script, variant, max_iterations=2, **changes)
    assert state.best.parameters == [2.0]
    assert () not in script.fitted


def test_no_inliers_are_never_stored_while_inliers_have_weight():
    script = Script({(0, 1): 1.0, (1, 2): 2.0}, {1.0: (5.0, []), 2.0: (6.0, [1])})
    state = run_script(script, max_iterations=2)
    assert state.best.parameters == [2.0]
    assert state.rejected["not accepted"] == 1


def test_sample_grows_by_as_few_observations_as_it_needs():
    script = Script({(0, 1, 2, 3, 4): 1.0}, {1.0: (5.0, [1]), 0.0: (9.0, [])}, smallest=5)
    state = run_script(script)
    assert state.best.rows.tolist() == [0, 1, 2, 3, 4]


def test_log_that_never_becomes_well_defined_is_refused():
    with pytest.raises(IdentificationError, match="not well-defined"):
        run_script(Script({}, {}, smallest=11))


def test_nothing_accepted_says_how_many_failed_at_which_step():
    found = {1.0: (np.inf, [1]), 2.0: (5.0, [])}
    script = Script({(0, 1): 1.0, (1, 2): 2.0, (2, 3): -1.0}, found, smallest=2)
    with pytest.raises(IdentificationError, match="3 samples") as caught:
        run_script(script, max_iterations=3)
    for count in ("1 diverged", "1 out of bounds", "1 not accepted"):
        assert count in str(caught.value)


def test_progress_is_reported_after_every_batch():
    calls = []
    script = Script({}, {0.0: (5.0, [1])})
    run_script(script, Diransac, callback=calls.append, max_iterations=10, batch_size=4)
    assert calls == [Progress("searching", k / 10, "10% inliers") for k in (4, 8, 10)]


# ---------------------------------------------------------------------- eq. (2)

SQUARES = np.array([[8.0, 18.0, 2.0], [0.0, 50.0, 32.0]])
WEIGHTS = np.array([1.0, 0.0, 0.5])
FINITE = st.floats(0.0, 1e200)
FRACTIONS = st.integers(0, 100).map(lambda n: n / 100)


def test_rms_error_is_eq_2():
    assert rms_error(SQUARES, 2, WEIGHTS) == pytest.approx([2.0 + 0.5 * 1.0, 0.0 + 0.5 * 4.0], rel=1e-15)


def test_mean_squared_error_is_eq_2_without_the_root():
    assert mean_squared_error(SQUARES, 2, WEIGHTS) == pytest.approx([4.0 + 0.5 * 1.0, 0.5 * 16.0], rel=1e-15)


@pytest.mark.parametrize("error", [rms_error, mean_squared_error])
def test_signal_of_zero_weight_adds_no_zero_times_infinity(error):
    assert error(np.array([[2.0, np.inf]]), 2, np.array([1.0, 0.0])) == [1.0]


@pytest.mark.parametrize("error", [rms_error, mean_squared_error])
def test_divergence_in_a_signal_of_any_weight_is_infinite(error):
    assert error(np.array([[2.0, np.inf]]), 2, np.array([1.0, 1e-12])) == [np.inf]


@pytest.mark.parametrize("error", [rms_error, mean_squared_error])
def test_error_of_a_hypothesis_does_not_depend_on_its_neighbours(error):
    squares = np.random.default_rng(0).uniform(size=(33, 5))
    weights = np.array([1.0, 0.3, 0.0, 0.7, 0.1])
    one_by_one = np.concatenate([error(row[None], 7, weights) for row in squares])
    assert np.array_equal(error(squares, 7, weights), one_by_one)


# ---------------------------------------------------------------------- eq. (3)


@given(e=FINITE, f=FRACTIONS, best_e=FINITE, best_f=FRACTIONS, nu=st.tuples(FINITE, FINITE).filter(any))
def test_acceptance_is_eq_3_wherever_it_has_a_meaning(e, f, best_e, best_f, nu):
    accepted = IDiransac(Settings(acceptance_weights=nu)).accepts(Score(e, f), Score(best_e, best_f))
    with np.errstate(all="ignore"):
        new, best = (
            np.float64(nu[0]) * np.float64(error) ** 2 + np.float64(nu[1]) * np.float64(1.0) / np.float64(part) ** 2
            for error, part in ((e, f), (best_e, best_f))
        )
    if np.isfinite(new) and np.isfinite(best) and abs(new - best) > 1e-9 * max(new, best):
        assert accepted == (new < best)


def test_the_first_hypothesis_is_accepted_over_nothing():
    assert IDiransac().accepts(Score(1e6, 0.001), Score())


@pytest.mark.parametrize(
    ("nu", "new", "best", "accepted"),
    [
        ((1.0, 0.06), Score(1.0, 0.0), Score(), False),
        ((1.0, 0.0), Score(1.0, 0.0), Score(), True),
        ((0.0, 1.0), Score(math.inf, 0.1), Score(), True),
        ((0.0, 1.0), Score(math.inf, 0.1), Score(1.0, 0.2), False),
        ((0.0, 1.0), Score(1.0, 0.0), Score(), False),
        ((1.0, 0.0), Score(math.inf, 0.9), Score(), False),
        ((1.0, 0.06), Score(math.inf, 0.9), Score(), False),
        ((1.0, 0.06), Score(2.0, 0.5), Score(2.0, 0.5), False),
        ((1.0, 1.0), Score(1.0, 0.5), Score(2.0, 0.5), True),
        ((1.0, 1.0), Score(2.0, 0.9), Score(2.0, 0.5), True),
        ((1.0, 1.0), Score(1.0, 0.1), Score(2.0, 0.5), False),
    ],
)
def test_acceptance_at_its_edges(nu, new, best, accepted):
    assert IDiransac(Settings(acceptance_weights=nu)).accepts(new, best) is accepted


@pytest.mark.parametrize("huge", [1e155, 1e200, 1.7e308])
def test_error_whose_square_overflows_is_worse_than_any(huge):
    variant = IDiransac()
    assert not variant.accepts(Score(huge, 0.5), Score(1.0, 0.5))
    assert variant.accepts(Score(1.0, 0.5), Score(huge, 0.5))


# ---------------------------------------------------------------------- the variants


def test_more_inliers_or_less_error_improve_i_diransac():
    variant, best = IDiransac(), Score(1.0, 0.5)
    assert variant.improves(Score(2.0, 0.6), best)
    assert variant.improves(Score(0.9, 0.1), best)
    assert not variant.improves(Score(1.0, 0.5), best)
    assert not variant.improves(Score(2.0, 0.4), best)


def test_less_error_alone_improves_diransac_and_is_stored():
    variant, best = Diransac(), Score(1.0, 0.5)
    assert not variant.improves(Score(2.0, 0.9), best)
    assert variant.improves(Score(0.9, 0.0), best)
    assert variant.accepts(Score(0.9, 0.0), best)
    assert not variant.improves(Score(), Score())


def test_near_misses_are_refitted_by_i_diransac_alone():
    assert IDiransac().refits(stored=False)
    assert not Diransac().refits(stored=False)
    assert Diransac().refits(stored=True)


def test_inlier_fraction_ends_i_diransac_alone():
    early = Settings(stop_inlier_fraction=0.85)
    assert IDiransac(early).is_finished(Score(1.0, 0.85))
    assert not IDiransac(early).is_finished(Score(1.0, 0.84))
    assert not IDiransac(Settings(stop_inlier_fraction=None)).is_finished(Score(1.0, 1.0))
    assert not Diransac().is_finished(Score(1.0, 1.0))
