"""`design_experiment`: the motion within limits from which the parameters of a machine are identified best."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.errors import PlanningError, SettingsError, check_known
from diransac.flight.planning.excitation import (
    FourierSeries,
    Limit,
    Limited,
    Observed,
    check_rest,
    drawn_motion,
    grid,
    motion_of,
    ranges_of,
    resting_pose,
)
from diransac.flight.planning.optimisation import DesignProblem, Search, best_motion
from diransac.flight.planning.trajectories import check_numbers, inverse_dynamics
from diransac.flight.trajectory import Trajectory
from diransac.process import single_threaded
from diransac.text_table import aligned, number
from diransac.time_limit import time_left

if TYPE_CHECKING:
    from diransac.model import Model
    from diransac.model.plant import ModelWithParameters

Outputs: TypeAlias = Callable[..., Mapping[str, Any]]

_N_DRAWS = 9
"""Plain multisines; the median one is the comparison, and the best one the start of the optimisation."""


_ROOM = 1e-3
"""Fraction of a limit that is left for extremes between the rows of the check."""

_NARROWED = 5e-3
"""Fraction of limits that the optimisation leaves for extremes between its rows."""


@dataclass(frozen=True, eq=False)
class Experiment(Trajectory):
    """A designed motion with the standard errors that an identification from it should have.

    Parameters
    ----------
    standard_errors : mapping of str to float
        Predicted standard error of each parameter, in its unit, for white noise of these sizes in every row; infinite
        where no motion shows the parameter alone.
    multisine_standard_errors : mapping of str to float
        The same of `multisine`.
    multisine : Trajectory, optional
        A plain multisine within the same limits: the median, by the determinant of the information, of nine.
    units : mapping of str to str
        Of parameters and signals.
    noise : mapping of str to float
        Standard deviation of each signal with noise, in its unit.
    extremes : mapping of str to ((float, float), (float, float))
        Range of each limited quantity along the motion, and its limits.
    stop_reason : str
        Why the optimisation ended.

    Notes
    -----
    Other parameters are those of `Trajectory`. ``print`` shows the standard errors side by side.
    """

    standard_errors: Mapping[str, float] = field(default_factory=dict)
    multisine_standard_errors: Mapping[str, float] = field(default_factory=dict)
    multisine: Trajectory | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)
    extremes: Mapping[str, tuple[tuple[float, float], tuple[float, float]]] = field(default_factory=dict)
    stop_reason: str = ""

    @property
    def ratios(self) -> dict[str, float]:
        """Predicted standard error over that of the multisine, of each parameter; NaN where both are infinite."""
        pairs = ((n, x, self.multisine_standard_errors[n]) for n, x in self.standard_errors.items())
        return {n: x / other if math.isfinite(x) else math.nan for n, x, other in pairs}

    def to_dict(self) -> dict[str, Any]:
        """Predictions, limits and noise as JSON data."""
        ratios = self.ratios
        parameters = {
            n: {
                "unit": self.units[n],
                "standard_error": x,
                "multisine_standard_error": self.multisine_standard_errors[n],
                "ratio": ratios[n],
            }
            for n, x in self.standard_errors.items()
        }
        return {
            "parameters": parameters,
            "limits": {n: {"range": list(found), "limits": list(x)} for n, (found, x) in self.extremes.items()},
            "noise": dict(self.noise),
            "rows": len(self),
            "rate": 1.0 / self.dt,
            "stop_reason": self.stop_reason,
        }

    def __str__(self) -> str:
        rows = [["parameter", "unit", "standard error, multisine", "designed", "ratio"]]
        for n, x in self.standard_errors.items():
            errors = [number(self.multisine_standard_errors[n], 3), number(x, 3)]
            shown = [*errors, number(self.ratios[n], 2)] if math.isfinite(x) else ["", "not identifiable", ""]
            rows.append([n, self.units[n], *shown])
        noise = ", ".join(f"{n} {number(x, 3)} {self.units[n]}" for n, x in self.noise.items())
        return "\n".join(
            [
                f"{self.time[-1] - self.time[0]:g} s of excitation, {len(self)} rows at {1.0 / self.dt:.4g} Hz; "
                f"{self.stop_reason}",
                *aligned(rows),
                "",
                *aligned(self._limit_rows()),
                f"predicted for noise (standard deviation per row) of {noise}",
            ]
        )

    def _limit_rows(self) -> list[list[str]]:
        rows = [["limited", "unit", "range", "limits", ""]]
        for n, (found, limits) in self.extremes.items():
            texts = [f"{number(low, 3)} to {number(high, 3)}" for low, high in (found, limits)]
            width = limits[1] - limits[0]
            near = min(found[0] - limits[0], limits[1] - found[1])
            # Fraction of a range within which an extreme is at the limit.
            at = near < 0.03 * (0.5 * width if math.isfinite(width) else max(map(abs, found)))
            rows.append([n, self.units.get(n, ""), *texts, "at a limit" if at else ""])
        return rows


def design_experiment(
    plant: ModelWithParameters,
    *,
    limits: Mapping[str, Limit],
    duration: float = 20.0,
    frequency: float = 1.0,
    harmonics: int = 12,
    noise: Mapping[str, float] | None = None,
    outputs: Outputs | None = None,
    rate: float = 100.0,
    seed: int = 0,
    max_iterations: int = 400,
    time_limit: float = 60.0,
    progress: Callable[[str, float], None] | None = None,
) -> Experiment:
    """Motion within limits whose log determines the parameters best: D-optimal excitation by Fourier series.

    Each coordinate is a Fourier series whose coefficients maximise the determinant of the Fisher information of the
    equations of motion; the motion is periodic and starts and ends at rest.

    Parameters
    ----------
    plant : Plant or Result
        Fully actuated: as many inputs as coordinates, linear in the equations. Its parameters are those at which inputs
        and limits are computed, such as the values of a robot's description.
    limits : mapping of str to float or (float, float)
        Range, or largest magnitude, of states, accelerations, inputs, sensors and ``outputs``, by name. Each coordinate
        needs a limit of its position or velocity.
    duration : float
        s, 3600 at most.
    frequency : float
        Highest frequency of the series, Hz.
    harmonics : int
        Sines of each coordinate, at most; 4 or more. A longer motion consists of equal periods.
    noise : mapping of str to float, optional
        Standard deviation of states, accelerations and inputs, as the identification has them, in their units. By
        default of all inputs, 1 % of what each varies by along plain multisines.
    outputs : callable, optional
        ``outputs(q, v, a, u, p)`` returns further quantities for ``limits``, by name, as the equations of a model do:
        the height of a tool, ``{"height": 0.3 * cos(q.shoulder)}``, or the force of a drive under position control.
    rate : float
        Rows per second.
    seed : int
        Of the plain multisines; at least 0.
    max_iterations : int
        Of the optimisation.
    time_limit : float
        s; the optimisation ends with what it has found.
    progress : callable, optional
        Called with the stage and the done fraction.

    Returns
    -------
    Experiment
        A `Trajectory` from rest to rest with predicted standard errors, beside those of a plain multisine. An input,
        held from row to row, is that of inverse dynamics in the middle between both rows.

    Raises
    ------
    SettingsError
        The model is not fully actuated, a limit is missing or has no meaning, or a number is out of range.
    PlanningError
        The machine cannot rest within its limits, or no motion shows any parameter.

    Notes
    -----
    The information is ``sum (dr/dp)^T S^-1 (dr/dp)`` over all rows, with S the covariance of the residuals r by the
    noise of the signals, at the plant's parameters. It does not include the bias of noise in regressors. Combinations
    of parameters that no motion shows are left out of the determinant. The optimum is a local one: it is never worse
    than the best of nine plain multisines.

    References
    ----------
    Swevers et al. 1997, "Optimal robot excitation and identification", IEEE Trans. Robotics and Automation 13(5);
    Park 2006, Robotica 24(5).
    """
    check_numbers(seed, duration, frequency=frequency, rate=rate, time_limit=time_limit, max_iterations=max_iterations)
    deadline, steps = time.monotonic() + min(time_limit, time_left()), round(duration * rate)
    machine = _Machine(plant.model, plant.model.parameter_vector(plant.parameters), outputs)
    series = _series(steps / rate, frequency, harmonics)
    search = Search(int(max_iterations), deadline, progress)
    with single_threaded():  # the same sums, and the same design, however many cores there are
        return _Design(machine, series, limits, noise, seed).solved(np.arange(steps + 1) / rate, search)


# Task ----------------------------------------------------------------------------------------------------------------
class _Machine:
    """Functions of a machine's motion: positions, velocities and accelerations, one below the other.

    Parameters
    ----------
    model : Model
    parameters : (n_p,) array
    outputs : callable, optional
        Further quantities.

    Raises SettingsError: the model is not fully actuated.
    """

    def __init__(self, model: Model, parameters: FloatArray, outputs: Outputs | None) -> None:
        self.model, self.parameters = model, parameters
        self.x = ca.SX.sym("x", 3 * model.n_v)
        q, v, a = ca.vertsplit(self.x, model.n_v)
        u = inverse_dynamics(model)(q, v, a, parameters)
        self._at = (q, v, a, u, ca.SX(ca.DM(parameters)))
        self.inputs = ca.Function("inputs", [self.x], [u])
        names = (*model.state, *model.accelerations, *model.inputs)
        self._quantities = dict(zip(names, ca.vertsplit(ca.vertcat(self.x, u)), strict=True))
        if model.measurement is not None:
            self._quantities |= dict(zip(model.sensors, ca.vertsplit(model.measurement(*self._at)), strict=True))
        if outputs is not None:
            self._quantities |= self._further(outputs)

    def _further(self, outputs: Outputs) -> dict[str, ca.SX]:
        """Quantities of the user.  Raises SettingsError: they are not expressions by name, or are signals."""
        found = outputs(*self.model.named(*self._at))
        try:
            named = {str(name): ca.SX(value) for name, value in found.items()}
        except (AttributeError, NotImplementedError) as error:
            raise SettingsError(f"outputs return {found!r:.60}; return a mapping from names to expressions") from error
        for name, value in named.items():
            if value.numel() != 1 or name in self._quantities:
                raise SettingsError(f'outputs: "{name}" must be one expression, and have a name that no signal has')
        return named

    def limited(self, limits: Mapping[str, tuple[float, float]]) -> Limited:
        """Quantities with limits.  Raises SettingsError: one is unknown."""
        for name in limits:
            if name not in self._quantities:
                raise SettingsError(
                    f'limits: there is no quantity "{name}"; there are {", ".join(self._quantities)}, '
                    "and more by outputs="
                )
        lower, upper = np.array(list(limits.values())).T
        values = ca.cse(ca.densify(ca.vertcat(*(self._quantities[n] for n in limits))))
        return Limited(tuple(limits), ca.Function("limited", [self.x], [values]), lower, upper)

    def observed(self, sigma: Mapping[str, float], motions: FloatArray) -> Observed:
        """Equations of motion with noise of signals.  Raises SettingsError: an equation has none."""
        model = self.model
        q, v, a, u, p = (ca.SX.sym(n, x.numel()) for n, x in zip("qvaup", self._at, strict=True))
        r, noisy = model.residual(q, v, a, u, p), ca.vertcat(q, v, a, u)
        names = (*model.state, *model.accelerations, *model.inputs)
        G = ca.sparsify(ca.jacobian(r, noisy) @ ca.diag([sigma.get(n, 0.0) for n in names]))
        for k, equation in enumerate(model.accelerations):
            if not ca.sparsify(G[k, :]).nnz():
                raise SettingsError(f"noise: no signal with noise is in the equation of {equation}; give an input's")
        whitened = ca.solve(ca.chol(ca.densify(G @ G.T)).T, ca.densify(ca.jacobian(r, p)))
        at = ca.Function("observed", [q, v, a, u, p], [whitened.T])(*self._at)
        return Observed.of(ca.Function("observed", [self.x], [ca.cse(ca.densify(at))]), motions)


class _Design:
    """Limits, observations and first motions of a design.

    Raises SettingsError, PlanningError: as `design_experiment`.
    """

    def __init__(
        self,
        machine: _Machine,
        series: FourierSeries,
        limits: Mapping[str, Limit],
        noise: Mapping[str, float] | None,
        seed: int,
    ) -> None:
        model, rng = machine.model, np.random.default_rng(seed)
        self.machine, self.series = machine, series
        self.limits = ranges_of(limits, model)
        self.limited = machine.limited(self.limits)
        lower, upper = np.array([self.limits.get(n, (-np.inf, np.inf)) for n in model.coordinates]).T
        self.bounded = np.isfinite(upper - lower)
        self.sizes = _sizes(model, self.limits, series)
        self.pose = resting_pose(self.limited, lower, upper, rng)
        check_rest(model, self.limited, self.pose)
        # Amplitude of the sines of a drawn motion over half the range of the coordinate, before limits reduce it.
        draws = [drawn_motion(series, self.limited, self.pose, 4.0 * self.sizes, rng) for _ in range(_N_DRAWS)]
        plain = [motion_of(z, series.basis(grid(series))) for z in draws]
        self.noise = _noise_of(machine, noise, np.hstack(plain))
        self.observed = machine.observed(self.noise, _random_motions(self.pose, self.sizes, series, rng))
        scores = [self.observed.log_determinant(x) for x in plain]
        if not max(scores) > -np.inf:
            raise PlanningError("no plain multisine within the limits shows what motions can show; widen the limits")
        self.draws = [draws[k] for k in np.argsort(scores, kind="stable")]

    def solved(self, time: FloatArray, search: Search) -> Experiment:
        """The best motion that is found, beside the median of the plain multisines, in rows at some times, s."""
        times, found, check_times = grid(self.series, 2), self.draws[-1], _check_times(time, self.series)
        in_rows, check = self.series.basis(time), self.series.basis(check_times)
        within = check_times < self.series.period
        # First barrier parameters of the optimisation, and of those that follow with the times at which
        # limits are exceeded. They are also the fractions of the limits that the first motions leave.
        for barrier in (3e-2, 1e-3, 1e-3, 1e-3):
            start = self.limited.shrunk(found, self.pose, self.series.basis(times), _NARROWED + barrier)
            free = np.ones(start.shape, bool)
            free[-1] = self.bounded
            problem = DesignProblem(self.series, self.limited, self.observed, self.sizes, free, start, times, _NARROWED)
            found = best_motion(problem, search, barrier)
            exceeding = self._exceeding(motion_of(found, check[:, within]))
            if not exceeding.any():
                break
            times = np.union1d(times, check_times[within][exceeding])
        multisine, *others = (
            self.limited.shrunk(z, self.pose, check, _ROOM) for z in (self.draws[_N_DRAWS // 2], self.draws[-1], found)
        )
        best = max(others, key=lambda z: self.observed.log_determinant(motion_of(z, in_rows)))
        extremes = self.limited.extremes(motion_of(best, check))
        model, designed = self.machine.model, self._trajectory(best, time, in_rows)
        errors, plain = (
            dict(zip(model.parameters, self.observed.standard_errors(motion_of(z, in_rows)).tolist(), strict=True))
            for z in (best, multisine)
        )
        return Experiment(
            **{x.name: getattr(designed, x.name) for x in fields(Trajectory)},
            standard_errors=errors,
            multisine_standard_errors=plain,
            multisine=self._trajectory(multisine, time, in_rows),
            units={**model.units, **{n: x.unit for n, x in model.parameters.items()}},
            noise=self.noise,
            extremes={n: (extremes[n], self.limits[n]) for n in self.limits},
            stop_reason=search.reason,
        )

    def _exceeding(self, motion: FloatArray) -> BoolArray:
        """Mask (K,) of the times at which a quantity of a motion (3 n, K) is farthest beyond a limit."""
        d = self.limited.distances(motion)
        around = np.pad(d, ((0, 0), (1, 1)), constant_values=np.inf)
        return np.asarray(((d < _ROOM) & (d <= around[:, :-2]) & (d <= around[:, 2:])).any(axis=0))

    def _trajectory(self, z: FloatArray, time: FloatArray, in_rows: FloatArray) -> Trajectory:
        """Trajectory of coefficients, and its inputs in the middle between rows."""
        model = self.machine.model
        between = motion_of(z, self.series.basis(time + 0.5 * time[1]))
        states, inputs = motion_of(z, in_rows)[: 2 * model.n_v].T, np.array(self.machine.inputs(between)).T
        of_inputs = {n: self.limits[n] for n in model.inputs if n in self.limits}
        return Trajectory(time, states, inputs, model.state, tuple(model.inputs), of_inputs)


def _check_times(time: FloatArray, series: FourierSeries) -> FloatArray:
    """Times at which limits are checked, s: rows, between them, and more often if the fastest sine needs it."""
    # Rows of the check per period of the fastest sine, at least.
    wanted = 64 * series.highest / (2.0 * np.pi)
    per_row = 2 * math.ceil(max(wanted * time[1], 1.0) / 2.0 + 0.5)
    return np.asarray(np.arange(per_row * len(time)) * (time[1] / per_row))


def _series(duration: float, frequency: float, harmonics: int) -> FourierSeries:
    """Series with a whole number of periods.  Raises SettingsError: numbers that do not fit together."""
    # With 4 a period is always long enough for two.
    if not (np.ndim(harmonics) == 0 and harmonics >= 4 and harmonics == int(harmonics)):
        raise SettingsError(f"harmonics is {harmonics!r:.60}; give a whole number of at least 4")
    cycles = duration * frequency * (1.0 + 1e-9)
    if not cycles >= 2.0:
        raise SettingsError(
            f"{duration:g} s are {cycles:.2g} periods of {frequency:g} Hz, the highest frequency; "
            "give 2 or more by a longer duration or a higher frequency"
        )
    n_periods = math.ceil(cycles / harmonics)
    return FourierSeries(duration / n_periods, int(cycles / n_periods))


def _sizes(model: Model, limits: Mapping[str, tuple[float, float]], series: FourierSeries) -> FloatArray:
    """Size of each coordinate's motion (n,): half its range, or what a slow sine reaches at the largest velocity."""
    slow = 2.0 * np.pi / series.period
    sizes = []
    for q, v in zip(model.coordinates, model.velocities, strict=True):
        low, high = limits[q] if q in limits else (x / slow for x in limits[v])
        sizes.append(0.5 * (high - low))
    return np.array(sizes)


def _noise_of(machine: _Machine, noise: Mapping[str, float] | None, motions: FloatArray) -> dict[str, float]:
    """Standard deviations by signal.  Raises SettingsError: a signal is unknown, or a number is not positive."""
    model = machine.model
    if noise is None:
        spread = np.array(machine.inputs(motions)).std(axis=1)
        spread = np.where(spread > 0.0, spread, max(spread.max(), 1.0))
        # Default standard deviation of an input's noise, over what the input varies by.
        return dict(zip(model.inputs, (0.01 * spread).tolist(), strict=True))
    names = (*model.state, *model.accelerations, *model.inputs)
    check_known(noise, names, "noise: there is no signal", "there are")
    for name, value in noise.items():
        if not (np.ndim(value) == 0 and 0.0 < value < np.inf):
            raise SettingsError(f'noise: "{name}" is {value!r:.60}; give a positive standard deviation')
    return {name: float(value) for name, value in noise.items()}


def _random_motions(pose: FloatArray, sizes: FloatArray, series: FourierSeries, rng: np.random.Generator) -> FloatArray:
    """Random motions (3 n, K) about a pose, of the size and speed of the machine's."""
    w = series.highest
    scale = np.concatenate([sizes, w * sizes, w**2 * sizes])[:, None]
    # Random states in which the derivatives show what any motion can show.
    return np.concatenate([pose, np.zeros(2 * len(pose))])[:, None] + scale * rng.uniform(-1.0, 1.0, (len(scale), 200))
