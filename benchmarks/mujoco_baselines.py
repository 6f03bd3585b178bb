"""What an engineer would use instead of the default on the cases of `mujoco_cases`, and what any method can attain.

Nothing happens when this file is run.  A log is cut into windows; rollouts from their first states are compared with
the measured columns in units of the noise.  Three things are known to the baselines that the default has to find: the
noise, the true state of free bodies at the beginning of every window, and, to `mujoco.sysid`, the delay.  Joints start
where filtered encoders say.

References: `mujoco.sysid` is MuJoCo's own system identification, ``pip install 'mujoco[sysid]'``.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from mujoco_simulation import AXES, DT, Array, Case, columns, driven, is_bias, set_values
from scipy.optimize import least_squares
from scipy.signal import medfilt, savgol_filter

LENGTH, LONGEST_DELAY, CAP = 0.2, 0.02, 1e3
"""Windows, s; longest delay, s; largest error in standard deviations, for rollouts that diverge."""
DELAY = "delay"
STARTS, ITERATIONS, STAGES = 8, 40, ((100.0, 0.1), (100.0, 1e-2), (10.0, 1e-3), (3.0, 1e-4))
"""Starts on small machines; iterations of `mujoco.sysid`; by stage, scale of the loss (deviations) and step."""


@dataclass(frozen=True)
class Windows:
    """Windows of a log; rollouts of all of them with given values.

    Parameters
    ----------
    case : Case
    length : float                      s
    """

    case: Case
    length: float = LENGTH

    @cached_property
    def rows(self) -> Array:
        """Rows of the log, (windows, steps); windows that begin in a gap are left out."""
        steps, log = round(self.length / DT), self.case.log
        begins = np.arange(0, len(log) - steps + 1, steps)
        encoders = [x for x in self.case.noise if f"{x}_dot" in self.case.noise]
        return begins[np.isfinite(log[encoders[0]][begins])][:, None] + np.arange(steps)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """Nominal model."""
        return driven(self.case.xml, self.case.actuation).compile()

    @cached_property
    def measured(self) -> Array:
        """Measured columns, (windows, steps, signals)."""
        return np.stack([self.case.log[name] for name in self.case.noise], axis=-1)[self.rows]

    @cached_property
    def commands(self) -> Array:
        """Recorded inputs of the whole log, (N, nu)."""
        given = list(self.case.log.signals)[len(self.case.noise) :]
        return np.stack([self.case.log[name] for name in given], axis=-1)

    @cached_property
    def starts(self) -> Array:
        """First states, (windows, nq + nv): the truth of free bodies, filtered encoders of joints."""
        states = np.array(self.case.states)
        for name, values in columns(self.model, states, np.zeros((len(states), self.model.nsensordata))).items():
            if name in self.case.noise and not name.endswith(("_x", "_y", "_z", "_qw", "_qx", "_qy", "_qz")):
                values[:] = filtered(self.case.log[name])  # a view of the states
        return states[self.rows[:, 0]]

    def inputs(self, delay: float) -> Array:
        """Inputs, (windows, steps, nu), later by a time in s."""
        whole, part = divmod(delay / DT, 1.0)
        early = [self.commands[np.maximum(self.rows - int(whole) - k, 0)] for k in (0, 1)]
        return (1.0 - part) * early[0] + part * early[1]

    def predicted(self, values: Mapping[str, float], starts: Array, exact: bool = False) -> Array:
        """Columns of rollouts, (windows, steps, signals); ``exact`` for differences."""
        model = driven(self.case.xml, self.case.actuation, machine(values)).compile()
        if exact:
            model.opt.tolerance, model.opt.iterations = 1e-12, 200
        data = [mujoco.MjData(model) for _ in range(2)]
        first = np.column_stack([np.zeros(len(starts)), starts])
        states, readings = mujoco.rollout.rollout(
            model, data, first, self.inputs(values.get(DELAY, 0.0)), persistent_pool=True
        )
        states = np.concatenate([starts[:, None], states[:, :-1, 1 : 1 + model.nq + model.nv]], axis=1)
        return with_biases(self.case, columns(model, states, readings), values)


def machine(values: Mapping[str, float]) -> dict[str, float]:
    """Values without the delay, which no description has."""
    return {name: x for name, x in values.items() if name != DELAY}


def with_biases(case: Case, found: Mapping[str, Array], values: Mapping[str, float]) -> Array:
    """Measured columns in a last axis, with the sensors' biases."""
    biases = dict.fromkeys(found, 0.0)
    for name in filter(is_bias, values):
        sensor, axis = name.removeprefix("sensor/").split(".bias[")
        biases[sensor + AXES[3][int(axis[0])]] = values[name]
    return np.stack([found[x] + biases[x] for x in case.noise], axis=-1)


def filtered(samples: Array) -> Array:
    """Samples without short outliers and with less noise; gaps are bridged."""
    seen = np.isfinite(samples)
    rows = np.arange(len(samples))
    return np.asarray(savgol_filter(medfilt(np.interp(rows, rows[seen], samples[seen]), 5), 9, 2))


def errors(windows: Windows, predicted: Array) -> Array:
    """Prediction errors in standard deviations of the noise, zero where nothing is measured."""
    deviation = np.array(list(windows.case.noise.values()))
    found = (predicted - windows.measured) / deviation
    found = np.where(np.isfinite(windows.measured), np.nan_to_num(found, nan=CAP, posinf=CAP, neginf=-CAP), 0.0)
    return np.clip(found, -CAP, CAP)


def sizes(case: Case) -> dict[str, float]:
    """Size of a change of each parameter, which scales optimisers and differences."""
    found = {name: max(abs(x), 0.01) for name, x in case.nominal.items()}
    return found | ({DELAY: 0.002} if case.delay else {})


def limits(case: Case) -> tuple[Array, Array]:
    """Lower and upper bounds; positions and biases may be negative."""
    free = [is_bias(name) or ".ipos" in name for name in case.nominal]
    low, high = np.where(free, -1.0, 1e-5), np.where(free, 1.0, 20.0)
    return (np.append(low, 0.0), np.append(high, LONGEST_DELAY)) if case.delay else (low, high)


# ---------------------------------------------------------------------- methods


def output_error(case: Case) -> dict[str, float]:
    """Multiple shooting: SciPy's ``least_squares`` over windows from filtered first states, from the nominal values.

    Rollouts jump where contacts begin a step earlier, on which a plain fit stalls: steps of differences and scale of
    the soft-L1 loss shrink in stages.  Small machines have further starts within a factor of three.
    """
    windows, size, rng = Windows(case), sizes(case), np.random.default_rng(0)
    names, scale = list(size), np.array(list(size.values()))
    low, high = (x / scale for x in limits(case))
    nominal = np.array([case.nominal.get(name, 0.002) for name in names]) / scale
    count = STARTS if windows.model.nv < 12 else 1
    starts = [nominal] + [nominal * 3.0 ** rng.uniform(-1.0, 1.0, len(names)) for _ in range(count - 1)]

    def residual(z: Array) -> Array:
        values = dict(zip(names, z * scale, strict=True))
        return errors(windows, windows.predicted(values, windows.starts)).ravel()

    def fitted(z: Array, loss_scale: float, step: float) -> Any:
        return least_squares(
            residual, np.clip(z, low, high), bounds=(low, high), loss="soft_l1", f_scale=loss_scale, diff_step=step,
            x_scale="jac", max_nfev=20,
        )  # fmt: skip

    best = min((fitted(z, *STAGES[0]) for z in starts), key=lambda fit: float(fit.cost))
    for stage in STAGES[1:]:
        best = fitted(best.x, *stage)
    return dict(zip(names, (best.x * scale).tolist(), strict=True))


def sysid(case: Case, **settings: Any) -> dict[str, float]:
    """MuJoCo's own optimiser over the same windows; it gets the true delay.

    Raises ImportError: it is not installed.
    """
    from mujoco.sysid import (
        ModelSequences,
        Parameter,
        ParameterDict,
        TimeSeries,
        build_residual_fn,
        create_initial_state,
        optimize,
    )

    windows, model, size = Windows(case), Windows(case).model, sizes(case)
    low, high = (x[: len(case.nominal)] for x in limits(case))
    unknown = ParameterDict()
    names, steps, first = list(case.nominal), windows.rows.shape[1], np.array(list(case.nominal.values()))
    scale = np.array([size[name] for name in names])

    def modify(spec: Any, parameter: Any) -> None:
        set_values(spec, {parameter.name: size[parameter.name] * float(parameter.value[0])})

    for name, *unit in zip(names, first / scale, low / scale, high / scale, strict=True):
        unknown.add(Parameter(name, *unit, modifier=modify))
    times = DT * np.arange(steps)

    def residual(
        params: Any, predicted: Any, measured: Any, model: Any, _all: bool, *, state: Array, **_: Any
    ) -> tuple[Any, Any, Any]:
        k = int(measured.data[0, -1])  # the window's number
        states = np.vstack([windows.starts[k], state[: steps - 1, 1 : 1 + model.nq + model.nv]])
        values = dict(zip(names, params.as_vector() * scale, strict=True))
        found = with_biases(case, columns(model, states, predicted.data[:steps]), values)
        error = (found - windows.measured[k]) / np.array(list(case.noise.values()))
        error = np.where(np.isfinite(windows.measured[k]), np.nan_to_num(error, nan=CAP), 0.0)
        return np.clip(error, -CAP, CAP), measured, measured

    labels = [*case.noise, "window"]
    records = [
        TimeSeries.from_custom_map(times, np.column_stack([x, np.full(steps, k)]), labels)
        for k, x in enumerate(windows.measured)
    ]
    inputs = windows.inputs(case.delay)
    controls = [TimeSeries.from_control_names(DT * np.arange(steps + 1), np.vstack([x, x[-1:]]), model) for x in inputs]
    origins = [create_initial_state(model, x[: model.nq], x[model.nq :], np.zeros(0)) for x in windows.starts]
    sequences = ModelSequences(
        case.name, driven(case.xml, case.actuation), [f"w{k}" for k in range(len(records))], origins, controls, records,
        allow_missing_sensors=True,
    )  # fmt: skip
    settings = {"max_iters": ITERATIONS} | (settings or {"eps": 1e-4})
    with redirect_stdout(StringIO()):  # its solver prints every iteration
        found, _ = optimize(
            initial_params=unknown,
            residual_fn=build_residual_fn(models_sequences=[sequences], modify_residual=residual),
            verbose=False, **settings,
        )  # fmt: skip
    return dict(zip(names, (np.asarray(found.as_vector()) * scale).tolist(), strict=True))


# ---------------------------------------------------------------------- information


def attainable(case: Case, length: float = 0.1) -> tuple[dict[str, float], float]:
    """Standard errors that an efficient method attains, from Fisher's information at the truth; share of windows.

    Every window has a first state of its own, of which nothing is known; outliers and gaps are as in the log.  Rollouts
    jump where a contact begins a step earlier: windows whose slopes depend on the step of the difference are left out.
    """
    windows = Windows(case, length)
    begins, nv = case.states[windows.rows[:, 0]], windows.model.nv
    weights = np.isfinite(windows.measured) / np.array(list(case.noise.values()))
    truth = dict(case.truth) | ({DELAY: case.delay} if case.delay else {})
    size = {name: max(abs(x), 1e-3) for name, x in truth.items()}
    smooth = np.ones(len(begins), dtype=bool)

    def slope(name: str | int, step: float) -> Array:
        """Derivative by a parameter or a coordinate of the first state, (windows, samples)."""
        pair = []
        for change in (step, -step):
            if isinstance(name, str):
                found = windows.predicted(truth | {name: truth[name] + change}, begins, exact=True)
            else:
                found = windows.predicted(truth, moved(windows.model, begins, name, change), exact=True)
            pair.append(found)
        return ((pair[0] - pair[1]) / (2.0 * step) * weights).reshape(len(begins), -1)

    def checked(name: str | int, step: float) -> Array:
        first, second = slope(name, step), slope(name, 0.4 * step)
        smooth[np.linalg.norm(first - second, axis=1) > 0.1 * np.linalg.norm(first, axis=1) + 1e-3] = False
        return first

    by_value = np.stack([checked(name, 1e-5 * size[name]) for name in truth], axis=-1)
    by_state = np.stack([checked(i, 1e-7) for i in range(2 * nv)], axis=-1)
    scale = np.array([size[name] for name in truth])
    information = np.zeros((len(truth), len(truth)))
    for a, b in zip(by_value[smooth] * scale, by_state[smooth], strict=True):
        u, s, _ = np.linalg.svd(b, full_matrices=False)
        u = u[:, s > 1e-6 * s[0]]
        rest = a - u @ (u.T @ a)
        information += rest.T @ rest
    covariance = np.linalg.pinv(information, hermitian=True)
    return dict(zip(truth, (scale * np.sqrt(np.diag(covariance))).tolist(), strict=True)), float(smooth.mean())


def moved(model: mujoco.MjModel, states: Array, i: int, step: float) -> Array:
    """States ``(windows, nq + nv)``, moved along coordinate i of their tangent space."""
    found = np.array(states)
    if i >= model.nv:
        found[:, model.nq + i - model.nv] += step
        return found
    direction = np.zeros(model.nv)
    direction[i] = 1.0
    for row in found:
        q = row[: model.nq].copy()
        mujoco.mj_integratePos(model, q, direction, step)
        row[: model.nq] = q
    return found
