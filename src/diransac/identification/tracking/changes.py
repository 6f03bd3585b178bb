"""Changes of the parameters while a machine runs: when one is declared, what follows, and when it is reported.

`Drift` has the rates at which parameters drift.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray
from diransac.identification.regression.uncertainty import CLEAR
from diransac.identification.tracking.estimates import Change
from diransac.identification.tracking.fits import Forces, with_forces
from diransac.identification.tracking.steps import (
    Explanation,
    SteppedFit,
    StepTests,
    ages_of,
    fine_ages_of,
    sought,
    step_tests,
)
from diransac.identification.tracking.window import AS_LIKELY, MEMORY

if TYPE_CHECKING:
    from diransac.identification.core.boundary import BoundaryPrior
    from diransac.identification.core.equations import JointEquations
    from diransac.identification.tracking.starting import Setup
    from diransac.identification.tracking.window import Window

_CLEAR = 3.0
"""Evidence, nats, from which on a parameter drifts, or contradicts what was known of it."""
_WORK = 150_000
"""Samples times unknowns of the fits of a search in an update: three windows of a quadrotor at 250 Hz."""


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
        self._given = np.array([given.get(name, np.nan) for name in names])
        # Standard deviations of the changes in a second, over the size of a parameter.
        self._rates = np.concatenate([[0.0], np.logspace(-6.0, -1.0, 16)])
        self._likelihood = np.zeros((len(names), len(self._rates)))
        self.rate = np.nan_to_num(np.square(self._given))
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
        variance = 1.0 / np.where(known, information, 1.0)[:, None]
        rates = np.square(np.abs(values)[:, None] * self._rates)
        # Some of the variance of a difference is no drift.
        total = np.maximum(variance + (rates - self.rate[:, None]) * window, 0.05 * variance)
        gain = -0.5 * (np.log(total) + np.square(size)[:, None] / total)
        self._likelihood *= np.exp(-weight * window / MEMORY)
        # A single window, however much it differs, is no drift.
        self._likelihood[known] += weight * np.minimum(gain - gain[:, :1], 2.0)[known]
        best = np.argmax(self._likelihood, axis=1)[:, None]
        clear = np.take_along_axis(self._likelihood, best, 1)[:, 0] - self._likelihood[:, 0] - _CLEAR
        probability = clear > 0.0 if exact else 1.0 / (1.0 + np.exp(-clear))
        estimated = np.take_along_axis(rates, best, 1)[:, 0] * probability
        self.rate = np.where(np.isnan(self._given), estimated, np.square(self._given))
        self.drifting = np.where(np.isnan(self._given), clear > 0.0, self._given > 0.0)


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
        self._squares, self._counts = np.zeros((2, 32, len(self.names)))
        self._learned, self._rest, self._firing = 0.0, 0, 0
        self._usual: FloatArray | None = None
        self._doubt = np.zeros(len(self.names))
        self._values, self._since = np.full(len(self.names), np.inf), np.zeros(len(self.names))
        self._anchor, self._is_said = np.zeros((2, len(self.names))), np.zeros(len(self.names), bool)
        # Changes that are not yet determined well enough to be reported.
        self._pending: list[Change] = []
        # What was known where the window begins with a change, as long as that may turn out to be none.
        self._kept: BoundaryPrior | None = None
        self._searched: tuple[Window, Generator[None, None, tuple[int, Explanation | None]]] | None = None
        self._is_sure = False
        self._reported: list[Change] = []
        self._new: list[Change] = []

    def before_step(self, window: Window) -> None:
        """Let the parameters drift for a step, before the window."""
        window.diffuse(np.sqrt(self.drift.rate * self.step))

    def after_step(self, window: Window, equations: JointEquations) -> None:
        """Test for changes, release a parameter that has changed, and report what is determined."""
        usual, n, is_full = self._usual_forces(window), len(window), len(window) == window.most
        # Where a change has begun the window, those that came with it are tested.
        tests = step_tests(with_forces(equations, usual), ages_of(n) if is_full else np.array([n]))
        gain = tests.gain(window.fit.shared, self._scatter(tests.ages, n)).max()
        # Forces may explain what contradicts a parameter from before the window: it may be either value.
        contradicted = tests.gain(window.fit.shared)[-1] > _CLEAR
        self._doubt = np.where(contradicted, np.square(tests.sizes[-1]), 0.0)
        if is_full:
            known, T = tests.precision[-1].copy(), self._duration(window)
            known[self._changing] = 0.0
            self.drift.learn(window.fit.shared, tests.sizes[-1], known, T, self.step / T, exact=window.is_exact)
            self._learned += np.inf if window.is_exact or window.setup.exact else self.step
        # The scatter of a model that is not exact is known after three windows.
        calibrated = self._learned > 3.0 * self._duration(window)
        fires = gain > self._price(tests.ages)
        if is_full and not (fires and calibrated):
            self._learn_scatter(tests)
        self._rest -= 1
        self._firing = self._firing + 1 if fires and calibrated else 0
        if is_full and self._kept is not None:
            self._is_sure, self._kept, self._searched = True, None, None
        if self._searched is not None or (calibrated and (fires or self._kept is not None) and self._rest < 0):
            self._search(window, usual)
        self._report(window)

    @property
    def is_suspected(self) -> bool:
        """True while tests that are calibrated find a change, or one is not yet certain."""
        return self._firing > 0 or self._kept is not None

    @property
    def _changing(self) -> list[int]:
        """Parameters with a change that is not yet reported."""
        return [self.names.index(x.parameter) for x in self._pending]

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

        Of one age, and steps of one sign, as many are independent as fit into an hour without overlapping.
        """
        per_hour = 3600.0 / self.step * (1.0 / ages).sum() * 2 * len(self.names)
        return float(np.log(per_hour / self.false_alarms))

    def _scatter(self, ages: IntArray, n: int) -> FloatArray:
        """Variance ``(A, n_p)`` of the ratios of tests of some ages in n intervals, as remembered; 1 at least."""
        places = self._places(ages, n)
        # Twenty tests as they should be count, too.
        return np.maximum((self._squares[places] + 20.0) / (self._counts[places] + 20.0), 1.0)

    def _places(self, ages: IntArray, n: int) -> IntArray:
        """Places ``(A,)`` of ages in what is remembered: by powers of two; the last one is that of a whole window."""
        return np.where(ages == n, -1, np.log2(ages).astype(np.int64))

    def _learn_scatter(self, tests: StepTests) -> None:
        """Remember the scatter of the tests of a full window."""
        n, ages, precision = int(tests.ages[-1]), tests.ages[:, None], tests.precision
        most = 2.0 * self._price(tests.ages) * self._scatter(tests.ages, n)
        seen = np.minimum(np.square(tests.sizes) * precision, most), precision > 0.0
        places, faded = self._places(tests.ages, n), np.exp(-self.step / MEMORY)
        for sums, new in zip((self._squares, self._counts), seen, strict=True):
            sums[places] = faded * sums[places] + new / ages

    # ------------------------------------------------------------------ a change

    def _search(self, window: Window, usual: Forces) -> None:
        """Begin a search, or go on with it, and decide what has changed when it ends."""
        if self._searched is None:
            n, then = len(window), window.frozen()
            ages = fine_ages_of(n) if n == window.most else np.array([n])
            self._searched = then, sought(then, usual, self._kept, ages, self._scatter(ages, n))
        then, search = self._searched
        n_rows, n_unknowns = len(then) * then.length, then.fit.x.shape[1] + then.fit.d.shape[1] + len(self.names)
        for _ in range(max(1, round(_WORK / (n_rows * n_unknowns)))):
            try:
                next(search)
            except StopIteration as end:
                self._searched = None
                age, explanation = end.value
                # What has not been clear is asked again with a quarter more intervals.
                self._rest = age // 4
                if explanation is not None:
                    self._decide(window, then, explanation)
                return

    def _decide(self, window: Window, then: Window, explanation: Explanation) -> None:
        """Release the parameters that have changed, unless forces or a drift explain as much.

        Parameters
        ----------
        window, then : Window
            Now, and when the search began.
        explanation : Explanation
        """
        step, price = explanation.step, self._price(ages_of(len(then)))
        clear = AS_LIKELY * len(step.changed)
        if explanation.over_rivals > clear and explanation.over_usual > explanation.scatter * price:
            is_bound = self._layout.on_bounds(step.fit.shared)[step.changed].any()
            if step.first >= window.first_of(then) and not is_bound:
                self._release(window, then, step, explanation.known)
        elif self._kept is not None and explanation.over_rivals < 0.0:
            window.begin_with(then, 0, explanation.without)
            self._pending, self._kept = [], None
        elif explanation.over_rivals < -AS_LIKELY and self._firing * self.step > self._duration(window):
            self._usual = np.stack([np.log(explanation.larger.tau[-1]), explanation.larger.rho])

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
        if self._kept is not None and not step.first and self._changing == step.changed.tolist():
            self._is_sure = True
            return
        # Steps that follow one another are those of a drift.
        size, information = np.zeros((2, len(self.names)))
        size[step.changed], information[step.changed] = step.sizes, known
        self.drift.learn(window.fit.shared, size, information, self._duration(window), 1.0, exact=window.is_exact)
        window.begin_with(then, step.first, step.fit)
        names = [self.names[k] for k in step.changed]
        self._pending = [x for x in self._pending if self._kept is None and x.parameter not in names]
        for name, (before, error) in zip(names, step.before[step.changed].tolist(), strict=True):
            self._pending.append(Change(float(then.times[step.first]), name, before, np.nan, before_error=error))
        self._is_sure, self._kept, self._rest = False, step.kept, 0

    def _report(self, window: Window) -> None:
        """Report the changes that are determined, and forget those that have turned out to be none."""
        now = float(window.times[-1]) + window.length * window.stream.dt
        values, errors = window.fit.shared, np.sqrt(np.diag(self._covariance(window)))
        at_bound, settled = self._layout.on_bounds(values), np.abs(values - self._values) < errors
        for k, change in zip(self._changing, list(self._pending), strict=True):
            clear = self._is_clear(window, values[k] - change.before, np.hypot(errors[k], change.before_error))
            if settled[k] and not at_bound[k] and clear and self._is_sure:
                self._pending.remove(change)
                self._say(change, float(values[k]), float(errors[k]), now)
                self._kept, self._searched = None, None
            elif now - change.time > 2.0 * self._duration(window) / len(window) * window.most:
                self._pending.remove(change)
        self._values = values
        # A drift is reported once, when a parameter has moved further than chance moves it.
        still = ~self.drift.drifting | np.isin(np.arange(len(values)), self._changing)
        self._since, self._is_said = np.where(still, now, self._since), self._is_said & ~still
        self._anchor = np.where(still, [values, errors], self._anchor)
        moved = self._is_clear(window, values - self._anchor[0], np.hypot(errors, self._anchor[1]))
        for j in np.flatnonzero(moved & ~self._is_said):
            before, error = self._anchor[:, j].tolist()
            drift = Change(float(self._since[j]), self.names[j], before, np.nan, "drift", before_error=error)
            self._say(drift, float(values[j]), float(errors[j]), now)
        self._is_said |= moved

    def _is_clear(self, window: Window, change: FloatArray, error: FloatArray) -> BoolArray:
        """Changes that chance gives as seldom as the false alarms."""
        return np.asarray(np.square(change / error) > 2.0 * self._price(ages_of(len(window))))

    def _say(self, change: Change, after: float, error: float, now: float) -> None:
        """Report a change, as a return where it ends at a value from before an earlier one."""
        earlier = [x for x in self._reported if x.parameter == change.parameter]
        back = any(abs(after - x.before) < CLEAR * np.hypot(error, x.before_error) for x in earlier)
        kind: Literal["return", "step", "drift"] = "return" if back else change.kind
        change = replace(change, after=after, after_error=error, detected=now, kind=kind)
        self._reported = [*self._reported, change][-32:]
        self._new.append(change)

    def covariance(self, window: Window) -> FloatArray:
        """Covariance of the parameters at the end of the window, with changes that forces may hide."""
        return self._covariance(window) + np.diag(self._doubt)

    def _covariance(self, window: Window) -> FloatArray:
        """Covariance with the drift during the window, larger where windows scatter more than their covariances."""
        assert window.last is not None
        drift, n = np.diag(self.drift.rate * self._duration(window) / 3.0), len(window)
        more = np.sqrt(self._scatter(np.array([n]), n)[0])
        return np.asarray((window.last.solved.var_p + drift) * np.outer(more, more))

    def taken(self) -> tuple[Change, ...]:
        """Changes since the last call."""
        new, self._new = tuple(self._new), []
        return new
