"""Changes of the parameters while a machine runs: when one is declared, what follows, and when it is reported.

`Drift` has the rates at which parameters drift, `Doubt` the changes that a window cannot exclude.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.regression.uncertainty import CLEAR
from diransac.identification.tracking.estimates import Change
from diransac.identification.tracking.forces import Forces, with_forces
from diransac.identification.tracking.search import Found, sought
from diransac.identification.tracking.step_tests import ChangeTests, ages_of, change_tests, fine_ages_of
from diransac.identification.tracking.window import AS_LIKELY

if TYPE_CHECKING:
    from diransac.identification.core.boundary import BoundaryPrior
    from diransac.identification.tracking.starting import Setup
    from diransac.identification.tracking.stepped_fits import SteppedFit
    from diransac.identification.tracking.window import Linearization, Window

# Time over which the scatter of the tests, and drifts, are remembered, s.
_MEMORY = 60.0
# Ages that are tested at most: those of a window of 2^30 intervals.
_MOST_AGES = 32
# Samples times unknowns of the fits of a search in an update: three windows of a quadrotor at 250 Hz.
_WORK = 150_000
# Standard deviations of the changes by a drift in a second, over the size of a parameter.
_RATES = np.concatenate([[0.0], np.logspace(-6.0, -1.0, 16)])
# Evidence, nats, from which on a parameter drifts, or a change counts that no force has been asked to explain.
_CLEAR = 3.0


@dataclass(frozen=True)
class _Pending:
    """A change that is not yet determined well enough to be reported."""

    index: int
    time: float
    before: float
    before_error: float


class Drift:
    """Random walks of the parameters, whose rates follow from how much windows differ from what was known before them.

    The variance of a parameter that drifts grows by q per second.  The estimate of a window alone differs from that of
    everything before by more than their variances then.  The rate is the likeliest of a grid, with 0 as long as another
    is not clearly likelier.  Unmodelled forces hide slow drifts from single windows, so that these must be allowed for
    before they are clear: of a model that is not exact, the likeliest rate counts by its probability.

    Parameters
    ----------
    names : tuple of str
    given : mapping of str to float
        Standard deviations of the changes in a second, of parameters whose drift is not estimated.

    Attributes
    ----------
    rate : (n,) array
        Growth of the variances, per second.
    drifting : (n,) array of bool
        Parameters that clearly drift.
    """

    def __init__(self, names: tuple[str, ...], given: Mapping[str, float]) -> None:
        self.given = np.array([given.get(name, np.nan) for name in names])
        self.likelihood = np.zeros((len(names), len(_RATES)))
        self.rate = np.nan_to_num(np.square(self.given))
        self.drifting: BoolArray = self.rate > 0.0

    def learn(
        self,
        values: FloatArray,
        size: FloatArray,
        information: FloatArray,
        window: float,
        weight: float,
        *,
        exact: bool,
    ) -> None:
        """Update the rates by the difference of a window from what was known before it.

        Parameters
        ----------
        values : (n,) array
            Parameters.
        size, information : (n,) array
            Differences, and their inverse variances; 0 of those that are not determined or not to be counted.
        window : float
            Duration of the window, s.
        weight : float
            Part of the window that is new.
        exact : bool
            Whether its fit is without unmodelled accelerations.
        """
        known = information > 0.0
        variance = 1.0 / np.where(known, information, 1.0)
        rates = np.square(np.abs(values)[:, None] * _RATES)
        more = (rates - self.rate[:, None]) * window
        # Some of the variance of a difference is no drift.
        total = np.maximum(variance[:, None] + more, 0.05 * variance[:, None])
        gain = -0.5 * (np.log(total) + np.square(size)[:, None] / total)
        self.likelihood *= np.exp(-weight * window / _MEMORY)
        # A single window, however much it differs, is no drift.
        self.likelihood[known] += weight * np.minimum(gain - gain[:, :1], 2.0)[known]
        best = np.argmax(self.likelihood, axis=1)
        own = np.arange(len(best))
        clear = self.likelihood[own, best] - self.likelihood[:, 0] - _CLEAR
        probability = clear > 0.0 if exact else 1.0 / (1.0 + np.exp(-clear))
        estimated = rates[own, best] * probability
        self.rate = np.where(np.isnan(self.given), estimated, np.square(self.given))
        self.drifting = np.where(np.isnan(self.given), clear > 0.0, self.given > 0.0)


class Doubt:
    """Variances that changes which a window cannot exclude add to those of n parameters.

    - What was known of a parameter before the window contradicts the window, but unmodelled forces explain that nearly
      as well as a change does: it may be either value.
    - Tests have found a change, but a search has not told whether a step or forces explain it: parameters may be those
      with the step.
    - A machine of which one parameter has changed may have changed in others, as a payload takes its inertia with it.
      Each may have changed by the same ratio until the motion since then tells that it has not.

    Parameters
    ----------
    n : int

    Attributes
    ----------
    variance : (n,) array
    """

    def __init__(self, n: int) -> None:
        self.variance, self._undecided = np.zeros(n), np.zeros(n)
        self._ratio = 0.0

    def since(self, ratio: float) -> None:
        """Doubt all parameters: one has changed by this ratio where the window begins."""
        self._ratio = min(abs(ratio), 1.0)

    def undecided(self, change: FloatArray) -> None:
        """Doubt parameters that would change by some sizes ``(n,)`` with a step that is as likely as forces."""
        self._undecided = np.square(change)

    def update(self, tests: ChangeTests, values: FloatArray, certain: Sequence[int], *, full: bool) -> None:
        """Doubt what the tests of a window leave open.

        Parameters
        ----------
        tests : ChangeTests
        values : (n,) array
            Parameters.
        certain : sequence of int
            Parameters that are known to have changed.
        full : bool
            Whether the window is full, so that it has begun with no change.
        """
        self._ratio = 0.0 if full else self._ratio
        contradicted = tests.gain(values)[:, -1] > _CLEAR
        possible = np.square(self._ratio * values)
        possible[list(certain)] = 0.0
        self.variance = np.where(contradicted, np.square(tests.size[:, -1]), 0.0).max(axis=0)
        self.variance += possible / (1.0 + possible * tests.information[0, -1]) + self._undecided


class Changes:
    """Tests of changes, the drift of parameters, and the honesty of their standard errors.

    Parameters
    ----------
    setup : Setup
    step : float
        Time between estimates, s.
    false_alarms_per_hour : float
    drift : mapping of str to float
        As of `Tracker`.
    """

    def __init__(self, setup: Setup, step: float, false_alarms_per_hour: float, drift: Mapping[str, float]) -> None:
        self.names, self._layout = tuple(setup.model.parameters), setup.layout
        self.step, self.false_alarms = step, false_alarms_per_hour
        self.drift = Drift(self.names, drift)
        shape = (2, _MOST_AGES, len(self.names))
        self._squares, self._counts = np.zeros(shape), np.zeros(shape)
        self._learned, self._rest, self._firing = 0.0, 0, 0
        self._usual: FloatArray | None = None
        self._doubt = Doubt(len(self.names))
        self._before = np.full(len(self.names), np.inf)
        self._anchor, self._since = np.zeros((2, len(self.names))), np.zeros(len(self.names))
        self._is_said = np.zeros(len(self.names), bool)
        self._pending: list[_Pending] = []
        # What was known where the window begins with a change, as long as that may turn out to be none.
        self._kept: BoundaryPrior | None = None
        self._searched: tuple[Window, Generator[None, None, tuple[int, Found | None]]] | None = None
        self._is_sure = False
        self._reported: list[Change] = []
        self._new: list[Change] = []

    def before_step(self, window: Window) -> None:
        """Let the parameters drift for a step, before the window."""
        window.diffuse(np.sqrt(self.drift.rate * self.step))

    def after_step(self, window: Window, found: Linearization) -> None:
        """Test for changes, release a parameter that has changed, and report what is determined."""
        usual = self._usual_forces(window)
        of_calm = with_forces(found, usual)
        is_full = len(window) == window.most
        tests = change_tests(of_calm, self._ages(window))
        gain = tests.gain(window.fit.shared, self._scatter(tests.ages, len(window))).max()
        self._doubt.update(tests, window.fit.shared, [x.index for x in self._pending], full=is_full)
        if is_full:
            self._learn_drift(window, tests)
            self._learned += np.inf if window.is_exact or window.setup.exact else self.step
        # The scatter of a model that is not exact is known after three windows.
        calibrated = self._learned > 3.0 * self._duration(window)
        fires = gain > self._price(tests.ages)
        if is_full and not (fires and calibrated):
            self._learn_scatter(tests)
        self._rest -= 1
        self._firing = self._firing + 1 if fires and calibrated else 0
        if not fires:
            self._doubt.undecided(np.zeros(len(self.names)))
        if is_full and self._kept is not None:
            self._is_sure, self._kept, self._searched = True, None, None
        if self._searched is not None or (calibrated and (fires or self._kept is not None) and self._rest < 0):
            self._search(window, usual)
        self._report(window)
        self._follow_drift(window)

    @property
    def is_suspected(self) -> bool:
        """True while tests that are calibrated find a change, or one is not yet certain."""
        return self._firing > 0 or self._kept is not None

    def _ages(self, window: Window, ages: Callable[[int], IntArray] = ages_of) -> IntArray:
        """Ages of changes that are tested: where a change has begun the window, those that came with it."""
        n = len(window)
        return ages(n) if n == window.most else np.array([n])

    def _usual_forces(self, window: Window) -> Forces:
        """Unmodelled accelerations from before the window.

        They follow those of the fit with a delay of a window, so that a change which unmodelled accelerations seem to
        explain is tested against those that the machine usually has.
        """
        now = np.stack([np.log(window.fit.tau), window.fit.rho])
        self._usual = now if self._usual is None else self._usual
        self._usual = self._usual + min(1.0, self.step / self._duration(window)) * (now - self._usual)
        return Forces(np.broadcast_to(np.exp(self._usual[0]), window.fit.d.shape), self._usual[1])

    def _duration(self, window: Window) -> float:
        """Duration of the window, s."""
        return len(window) * window.length * window.stream.dt

    def _price(self, ages: IntArray) -> float:
        """Evidence, nats, that a change must gain: the logarithm of the number of tests between two false alarms.

        Of one age, as many tests are independent as fit into an hour without overlapping.
        """
        per_hour = 3600.0 / self.step * (1.0 / ages).sum() * 2 * len(self.names)
        return float(np.log(per_hour / self.false_alarms))

    def _scatter(self, ages: IntArray, n: int) -> FloatArray:
        """Variance ``(2, A, n_p)`` of the ratios of tests of some ages in n intervals, as remembered; 1 at least."""
        places = self._places(ages, n)
        # Twenty tests as they should be count, too.
        found = (self._squares[:, places] + 20.0) / (self._counts[:, places] + 20.0)
        return np.asarray(np.maximum(found, 1.0))

    def _places(self, ages: IntArray, n: int) -> IntArray:
        """Places ``(A,)`` of ages in what is remembered: by powers of two; the last one is that of a whole window."""
        return np.where(ages == n, _MOST_AGES - 1, np.log2(ages).astype(np.int64))

    def _learn_scatter(self, tests: ChangeTests) -> None:
        """Remember the scatter of the tests of a full window."""
        n = int(tests.ages[-1])
        places, most = self._places(tests.ages, n), 2.0 * self._price(tests.ages) * self._scatter(tests.ages, n)
        seen = np.minimum(np.square(tests.ratio), most), tests.information > 0.0
        faded = np.exp(-self.step / _MEMORY)
        for sums, new in zip((self._squares, self._counts), seen, strict=True):
            sums[:, places] = faded * sums[:, places] + new / tests.ages[:, None]

    def _learn_drift(self, window: Window, tests: ChangeTests) -> None:
        """Remember how much a full window differs from what was known before it."""
        T, information = self._duration(window), tests.information[0, -1].copy()
        information[[x.index for x in self._pending]] = 0.0
        size, share = tests.size[0, -1], self.step / T
        self.drift.learn(window.fit.shared, size, information, T, share, exact=window.is_exact)

    # ------------------------------------------------------------------ a change

    def _search(self, window: Window, usual: Forces) -> None:
        """Begin a search, or go on with it, and decide what has changed when it ends."""
        if self._searched is None:
            frozen, ages = window.frozen(), self._ages(window, fine_ages_of)
            self._searched = frozen, sought(frozen, usual, self._kept, ages, self._scatter(ages, len(window))[0])
        then, search = self._searched
        n_rows, n_unknowns = len(then) * then.length, then.fit.x.shape[1] + then.fit.d.shape[1] + len(self.names)
        for _ in range(max(1, round(_WORK / (n_rows * n_unknowns)))):
            try:
                next(search)
            except StopIteration as end:
                self._searched = None
                age, found = end.value
                # What has not been clear is asked again with a quarter more intervals.
                self._rest = age // 4
                if found is not None:
                    self._decide(window, then, found)
                return

    def _decide(self, window: Window, then: Window, found: Found) -> None:
        """Release the parameters that have changed, unless forces or a drift explain as much.

        Parameters
        ----------
        window, then : Window
            Now, and when the search began.
        found : Found
        """
        step, larger, price = found.step, found.larger, self._price(ages_of(len(then)))
        clear = AS_LIKELY * len(step.changed)
        if found.over_rivals > clear and found.over_usual > found.scatter * price:
            if step.first >= window.first_of(then) and not self._is_no_step(step, found.fits.linearized(step)):
                self._release(window, then, step, found.known)
        elif self._kept is not None and found.over_rivals < 0.0:
            none = np.zeros(0)
            window.begin_with(then, 0, found.fits.stepped(0, step.changed[:0], none, larger).fit)
            self._pending, self._kept = [], None
        elif found.over_rivals < -AS_LIKELY and self._firing * self.step > self._duration(window):
            self._usual = np.stack([np.log(larger.tau[-1]), larger.rho])
        elif found.over_usual > price and found.over_rivals > -price:
            self._doubt.undecided(window.fit.shared - step.fit.shared)

    def _is_no_step(self, step: SteppedFit, after: Linearization) -> bool:
        """True if parameters change further after a step, or end outside their bounds, or at one."""
        values, age = step.fit.shared, np.array([len(after.fit.x)])
        moves = change_tests(after, age).gain(values, self._scatter(age, step.first + int(age[0])))[1].max() > AS_LIKELY
        return bool(moves or self._layout.violations(values) or self._layout.on_bounds(values)[step.changed].any())

    def _release(self, window: Window, then: Window, step: SteppedFit, known: FloatArray) -> None:
        """Begin the window with a step, whose values are reported once it is found again, and they are known.

        Parameters
        ----------
        window, then : Window
            Now, and when the search began.
        step : SteppedFit
        known : (m,) array
            Inverse variances of its sizes.
        """
        if self._kept is not None and not step.first and [x.index for x in self._pending] == step.changed.tolist():
            self._is_sure = True
            return
        # Steps that follow one another are those of a drift.
        size, information = np.zeros((2, len(self.names)))
        size[step.changed], information[step.changed] = step.sizes, known
        self.drift.learn(window.fit.shared, size, information, self._duration(window), 1.0, exact=window.is_exact)
        time, before = float(then.times[step.first]), step.before[step.changed]
        self._doubt.since(float(np.abs(step.sizes / before[:, 0]).max()))
        self._doubt.undecided(np.zeros(len(self.names)))
        window.begin_with(then, step.first, step.fit)
        earlier = [x for x in self._pending if self._kept is None and x.index not in step.changed]
        new = zip(step.changed, before.tolist(), strict=True)
        self._pending = [*earlier, *(_Pending(int(k), time, *x) for k, x in new)]
        self._is_sure, self._kept, self._rest = False, step.kept, 0

    def _report(self, window: Window) -> None:
        """Report the changes that are determined, and forget those that have turned out to be none."""
        errors, now = np.sqrt(np.diag(self.covariance(window))), window.times[-1] + window.length * window.stream.dt
        significant, at_bound = self._significant(window), self._layout.on_bounds(window.fit.shared)
        for one in list(self._pending):
            after, error = float(window.fit.shared[one.index]), float(errors[one.index])
            change, both = abs(after - one.before), float(np.hypot(error, one.before_error))
            settled = abs(after - self._before[one.index]) < error and not at_bound[one.index]
            if settled and change > significant * both and self._is_sure:
                self._pending.remove(one)
                self._say(one, after, error, float(now))
                self._kept, self._searched = None, None
            elif now - one.time > 2.0 * window.most * window.length * window.stream.dt:
                self._pending.remove(one)
        self._before = window.fit.shared

    def _follow_drift(self, window: Window) -> None:
        """Report each drift once, when a parameter has moved further than chance moves it."""
        now = float(window.times[-1] + window.length * window.stream.dt)
        values, errors = window.fit.shared, np.sqrt(np.diag(self._without_doubt(window)))
        still = ~self.drift.drifting | np.isin(np.arange(len(values)), [x.index for x in self._pending])
        self._since = np.where(still, now, self._since)
        self._anchor = np.where(still, [values, errors], self._anchor)
        self._is_said &= ~still
        moved = np.abs(values - self._anchor[0]) > self._significant(window) * np.hypot(errors, self._anchor[1])
        for k in np.flatnonzero(moved & ~self._is_said):
            before, before_error = self._anchor[:, k].tolist()
            one = _Pending(int(k), float(self._since[k]), before, before_error)
            self._say(one, float(values[k]), float(errors[k]), now, "drift")
            self._is_said[k] = True

    def _significant(self, window: Window) -> float:
        """Standard errors of a change that chance gives as seldom as the false alarms."""
        return float(np.sqrt(2.0 * self._price(ages_of(len(window)))))

    def _say(
        self, one: _Pending, after: float, error: float, now: float, kind: Literal["step", "drift"] = "step"
    ) -> None:
        """Report a change, as a return where it ends at a value from before an earlier one."""
        name = self.names[one.index]
        earlier = [x for x in self._reported if x.parameter == name]
        back = any(abs(after - x.before) < CLEAR * np.hypot(error, x.before_error) for x in earlier)
        found: Literal["step", "drift", "return"] = "return" if back else kind
        change = Change(one.time, name, one.before, after, found, now, one.before_error, error)
        self._reported = [*self._reported, change][-32:]
        self._new.append(change)

    def covariance(self, window: Window) -> FloatArray:
        """Covariance of the parameters at the end of the window, with changes that it cannot exclude."""
        return self._without_doubt(window) + np.diag(self._doubt.variance)

    def _without_doubt(self, window: Window) -> FloatArray:
        """Covariance with the drift during the window, larger where windows scatter more than their covariances."""
        assert window.last is not None
        drift = np.diag(self.drift.rate * self._duration(window) / 3.0)
        n = len(window)
        more = np.sqrt(self._scatter(np.array([n]), n)[0, -1])
        return np.asarray((window.last.solved.var_p + drift) * np.outer(more, more))

    def taken(self) -> tuple[Change, ...]:
        """Changes since the last call."""
        new, self._new = tuple(self._new), []
        return new
