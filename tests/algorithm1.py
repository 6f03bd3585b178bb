"""Algorithm 1 as the paper and its notes tell it: plain NumPy, one hypothesis after another, nothing clever.

It shares nothing with the package; whoever runs it brings the sampler and the simulator.  The smallest margin of all
the comparisons it makes is kept: where it is far above rounding, any right implementation takes the same decisions.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

MIN_EIGENVALUE = 1e-6


@dataclass(frozen=True)
class Problem:
    """A log, and what simulates it.

    Parameters
    ----------
    W, b : (N, r, n_p), (N, r)   eqs. (1) and (5), row by row
    measured : (N, n_y)   Y
    usable : (N,)   rows that count; samples and inliers are numbered among them
    lower, upper, positive : (n_p,)   bounds of the preliminary test, strictly above 0 where positive
    sampler : ``(seed, k, n_rows) -> order``, a permutation of the rows; sample k is its beginning
    simulator : ``parameters -> (N, n_y)``, not finite from a divergence on
    """

    W: np.ndarray
    b: np.ndarray
    measured: np.ndarray
    usable: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    positive: np.ndarray
    sampler: Callable[[int, int, int], Sequence[int]]
    simulator: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Choices:
    """The algorithm's inputs, in the paper's symbols; ``variant`` is "i-diransac" or "diransac"."""

    variant: str
    s: int
    k_m: int
    f_stop: float | None
    eps: np.ndarray
    xi: int
    w: np.ndarray
    nu: tuple[float, float] = (1.0, 0.06)
    refit: bool = True
    seed: int = 0


@dataclass
class Hypothesis:
    """One pass of the loop: the rows it came from, and what became of it."""

    k: int
    is_refit: bool
    rows: np.ndarray
    parameters: np.ndarray
    fate: str = ""
    error: float = np.inf
    fraction: float = 0.0
    inliers: np.ndarray | None = None
    offers_refit: bool = False


@dataclass
class Story:
    """All that happened; ``cycles`` counts the chains that came back to a set that was not the last one."""

    hypotheses: list[Hypothesis] = field(default_factory=list)
    best: Hypothesis | None = None
    k: int = 0
    cycles: int = 0
    fixed_points: int = 0
    grown: int = 0
    never_run: int = 0
    margin: float = np.inf

    def weigh(self, *differences: float) -> None:
        """Keep the smallest margin by which a comparison of real numbers was decided."""
        finite = [abs(x) for x in differences if np.isfinite(x)]
        self.margin = min([self.margin, *finite])

    @property
    def fates(self) -> Counter[str]:
        """How many hypotheses went no further, by reason."""
        return Counter(h.fate for h in self.hypotheses if h.fate != "stored")


def algorithm1(problem: Problem, choices: Choices) -> Story:
    """Run the loop of Algorithm 1; in brackets, its line numbers."""
    story = Story()
    biased = choices.variant == "i-diransac"
    W, b = problem.W[problem.usable], problem.b[problem.usable]
    rms = np.sqrt((W**2).mean(axis=(0, 1)))
    n_rows = len(W)
    e, f, k = np.inf, 0.0, 0  # [1]
    get_new_sample = True  # [2]
    S, used = np.array([], dtype=int), set()
    while k < choices.k_m and not has_enough(choices, f):  # [3]
        is_refit = not get_new_sample
        if get_new_sample:  # [4]
            S = draw_sample(story, choices, problem.sampler(choices.seed, k, n_rows), W, rms)
            used = {frozenset(S.tolist())}
            k += 1  # [11]
        p_hat = ordinary_least_squares(W[S], b[S])  # [13]
        get_new_sample = True  # [14]
        now = Hypothesis(k, is_refit, S, p_hat)
        story.hypotheses.append(now)
        if not preliminary_test(story, problem, p_hat):  # [15]
            now.fate = "out of bounds"
            continue
        Y_hat = problem.simulator(p_hat)  # [16]
        now.error = model_fit_error(problem, choices, Y_hat)  # [17]
        now.inliers = inliers(story, problem, choices, Y_hat)  # [18]
        now.fraction = len(now.inliers) / n_rows
        story.weigh(relative(now.error, e))
        less_error, more_inliers = now.error < e, now.fraction > f
        if not (less_error or (biased and more_inliers)):  # [19]
            now.fate = "diverged" if now.error == np.inf else "no improvement"
            continue
        if not biased or acceptance_metric(story, now.error, e, now.fraction, f, choices.nu):  # [20]
            e, f = now.error, now.fraction  # [21, and the line that the print lost]
            story.best, now.fate = now, "stored"  # [22]
        else:
            now.fate = "diverged" if now.error == np.inf else "not accepted"
        now.offers_refit = choices.refit and (biased or now.fate == "stored")
        if not now.offers_refit:
            continue
        found = frozenset(now.inliers.tolist())
        if found in used:  # [25], and the end of a chain that runs in circles
            is_last = found == frozenset(S.tolist())
            story.fixed_points += is_last
            story.cycles += not is_last
            continue
        if well_defined(story, W[now.inliers], rms):  # [27-29]
            S = now.inliers  # [26]
            used.add(found)
            get_new_sample = False  # [30]
    story.k, story.never_run = k, int(not get_new_sample)
    return story


def has_enough(choices: Choices, f: float) -> bool:
    """Whether the inlier fraction ends the search; DIRANSAC knows no such end."""
    return choices.variant == "i-diransac" and choices.f_stop is not None and f >= choices.f_stop


def draw_sample(story: Story, choices: Choices, order: Sequence[int], W: np.ndarray, rms: np.ndarray) -> np.ndarray:
    """A new sample: s - 1 observations, then one more at a time until the solution is well-defined (lines 5-10)."""
    S, rest = list(order[: choices.s - 1]), list(order[choices.s - 1 :])
    solution_is_well_defined = False
    while not solution_is_well_defined and rest:
        S.append(rest.pop(0))
        solution_is_well_defined = well_defined(story, W[S], rms)
    assert solution_is_well_defined, "the whole log is not well-defined"
    story.grown += len(S) > choices.s
    return np.array(S)


def well_defined(story: Story, W: np.ndarray, rms: np.ndarray) -> bool:
    """Whether the smallest eigenvalue of ``W^T W``, its columns over their RMS in the log, exceeds the threshold."""
    stacked = (W / rms).reshape(-1, len(rms))
    smallest = np.linalg.eigvalsh(stacked.T @ stacked)[0]
    story.weigh(smallest - MIN_EIGENVALUE)
    return bool(smallest > MIN_EIGENVALUE)


def ordinary_least_squares(W: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``p`` of the smallest ``|W p - b|``, with all equations stacked as in eq. (1), by QR."""
    stacked = W.reshape(-1, W.shape[-1])
    scale = np.sqrt((stacked**2).mean(axis=0))
    Q, R = np.linalg.qr(stacked / scale)
    return np.linalg.solve(R, Q.T @ b.reshape(-1)) / scale


def preliminary_test(story: Story, problem: Problem, p: np.ndarray) -> bool:
    """Whether every parameter is within its bounds."""
    story.weigh(*(p - problem.lower), *(problem.upper - p), *p[problem.positive])
    inside = (p >= problem.lower) & (p <= problem.upper)
    return bool((inside & ((p > 0.0) | ~problem.positive)).all())


def finite_until(Y_hat: np.ndarray) -> int:
    """The row at which a simulation diverges; its length where it does not."""
    for j, row in enumerate(Y_hat):
        if not np.isfinite(row).all():
            return j
    return len(Y_hat)


def model_fit_error(problem: Problem, choices: Choices, Y_hat: np.ndarray) -> float:
    """Eq. (2), and for DIRANSAC the same without the root; infinite where the simulation diverges."""
    if finite_until(Y_hat) < len(Y_hat):
        return np.inf
    total = 0.0
    n_rows = int(problem.usable.sum())
    for i, w_i in enumerate(choices.w):
        if w_i == 0.0:
            continue
        squares = sum((Y_hat[j, i] - problem.measured[j, i]) ** 2 for j in np.flatnonzero(problem.usable))
        mean = squares / n_rows
        total += w_i * (np.sqrt(mean) if choices.variant == "i-diransac" else mean)
    return float(total)


def inliers(story: Story, problem: Problem, choices: Choices, Y_hat: np.ndarray) -> np.ndarray:
    """Usable rows with at least xi signals strictly within their thresholds, up to a divergence (section III.D)."""
    found = []
    end = finite_until(Y_hat)
    for number, j in enumerate(np.flatnonzero(problem.usable)):
        if j >= end:
            break
        near = 0
        for i, eps_i in enumerate(choices.eps):
            if eps_i > 0.0:
                distance = abs(Y_hat[j, i] - problem.measured[j, i])
                story.weigh(distance - eps_i)
                near += bool(distance < eps_i)
        if near >= choices.xi:
            found.append(number)
    return np.array(found, dtype=int)


def acceptance_metric(story: Story, e_hat: float, e: float, f_hat: float, f: float, nu: tuple[float, float]) -> bool:
    """Eq. (3); a term of zero weight is left out, and no inliers at all are refused where inliers have weight."""
    if nu[1] > 0.0 and f_hat == 0.0:
        return False
    sides = []
    for error, fraction in ((e_hat, f_hat), (e, f)):
        cost = 0.0
        if nu[0] > 0.0:
            cost += nu[0] * error**2
        if nu[1] > 0.0:
            cost += nu[1] * (1.0 / fraction) ** 2 if fraction > 0.0 else np.inf
        sides.append(cost)
    if nu[0] > 0.0:
        story.weigh(relative(*sides))
    return bool(sides[0] < sides[1])


def relative(a: float, b: float) -> float:
    """The difference of two numbers, relative to the larger; infinite where either is not finite."""
    return (a - b) / max(abs(a), abs(b), 1e-300) if np.isfinite(a) and np.isfinite(b) else np.inf
