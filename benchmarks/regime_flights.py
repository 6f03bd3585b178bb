"""Regimes: a machine, its flight, its sensors and its fault; and the logs of every seed, all seeds at once.

Nothing happens when this file is run.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import regime_machines as machines
from regime_machines import Array, Machine, Multisine

import diransac as dr

Force = Callable[[float, Array, Array, Array, SimpleNamespace], Array]
"""``(t, q, v, u, p) -> f``, generalised forces (n_v, L) that the model lacks."""
Rngs = Sequence[np.random.Generator]


@dataclass(frozen=True)
class Fault:
    """What distinguishes the plant, or its log, from the model.

    Parameters
    ----------
    force : ``rngs -> Force``; None: no force
    changed : ``(share of the log, p) -> p``, parameters in the course of the log
    supply : ``share of the log -> gain`` of the inputs
    actuator : ``u -> u`` (n_u, L), what the actuators make of their inputs
    lag : time constants of the actuators, s, one of each or one of all; (): they answer at once, as with 0
    later : by input, how much later it acts, s, whole samples of inputs that are held
    late : by signal, how much later it is logged, s
    corrupted : ``(rng, columns, inputs)`` corrupts the columns of a log in place
    """

    force: Callable[[Rngs], Force] | None = None
    changed: Callable[[float, SimpleNamespace], SimpleNamespace] = lambda _, p: p
    supply: Callable[[float], float] = lambda _: 1.0
    actuator: Callable[[Array], Array] = lambda u: u
    lag: tuple[float, ...] = ()
    later: Mapping[str, float] = field(default_factory=dict)
    late: Mapping[str, float] = field(default_factory=dict)
    corrupted: Callable[[np.random.Generator, dict[str, Array], Sequence[str]], None] | None = None


@dataclass(frozen=True)
class Regime:
    """A machine and what is done to it.

    Parameters
    ----------
    name : of the row
    machine : with the flight
    exact : whether the model is exact, and only noise is in the log
    signals : that are logged; None: all that have noise
    noise : factor of the sensors' noise
    fault : what is wrong
    held : whether inputs are held between samples, not continuous
    """

    name: str
    machine: Machine
    exact: bool = True
    signals: tuple[str, ...] | None = None
    noise: float = 1.0
    fault: Fault = field(default_factory=Fault)
    held: bool = True


@dataclass(frozen=True)
class Recording:
    """One seed of a regime: its columns (N,), time (N,), true parameters and exact signals (N,)."""

    time: Array
    columns: Mapping[str, Array]
    truth: Mapping[str, float]
    exact: Mapping[str, Array]

    @property
    def log(self) -> dr.Log:
        """What the package is given."""
        return dr.Log.from_arrays(self.time, self.columns)


def recordings(regime: Regime, seeds: Sequence[int]) -> list[Recording]:
    """The logs of some seeds; a seed's log is the same whichever others are simulated with it."""
    parameters = regime.machine.drawn(_rngs(regime.machine.name, "parameters", seeds))
    reference = regime.machine.reference(_rngs(regime.machine.name, "reference", seeds))
    time, exact = _simulated(regime, parameters, reference, seeds)
    noise = _rngs(regime.name, "noise", seeds)
    found = []
    for lane, rng in enumerate(noise):
        own = {name: values[:, lane] for name, values in exact.items()}
        truth = {name: float(getattr(parameters, name)[lane]) for name in regime.machine.model.parameters}
        found.append(Recording(time, _measured(regime, time, own, rng), truth, own))
    return found


def _rngs(name: str, stream: str, seeds: Sequence[int]) -> list[np.random.Generator]:
    """A generator per seed, independent between streams."""
    return [np.random.default_rng([seed, zlib.crc32(f"{name}/{stream}".encode())]) for seed in seeds]


# ---------------------------------------------------------------------- simulation


def _simulated(
    regime: Regime, drawn: SimpleNamespace, reference: Multisine, seeds: Sequence[int]
) -> tuple[Array, dict[str, Array]]:
    """Time, and every signal of the model (N, L), by RK4 with several steps a sample."""
    machine = regime.machine
    rate, control, acceleration = _plant(regime, drawn, reference, _rngs(regime.name, "force", seeds))
    x = _start(regime, reference, control)
    n_rows = round(machine.duration / machine.dt)
    h = machine.dt / machine.substeps
    rows, inputs = [], []
    for k in range(n_rows):
        t = k * machine.dt
        inputs.append(control(t, x))
        acting = _delayed(regime, inputs)
        rows.append((x[: machine.n_q + machine.n_v], acceleration(t, x, acting)))
        for i in range(machine.substeps):
            x = rk4(rate, t + i * h, x, acting if regime.held else None, h)
    states, accelerations = (np.stack(parts) for parts in zip(*rows, strict=True))
    return machine.dt * np.arange(n_rows), _named(machine, states, accelerations, np.stack(inputs))


def _delayed(regime: Regime, inputs: Sequence[Array]) -> Array:
    """The last of all inputs so far; of those that act later, an earlier one."""
    acting = inputs[-1]
    for name, time in regime.fault.later.items():
        k = list(regime.machine.model.inputs).index(name)
        acting = acting.copy()
        acting[k] = inputs[max(0, len(inputs) - 1 - round(time / regime.machine.dt))][k]
    return acting


def _plant(
    regime: Regime, drawn: SimpleNamespace, reference: Multisine, rngs: Rngs
) -> tuple[Callable[..., Array], Callable[[float, Array], Array], Callable[..., Array]]:
    """Functions ``rate(t, x, u)``, ``control(t, x)`` and ``acceleration(t, x, u)`` of ``x = [q, v, actuators]``."""
    machine, fault = regime.machine, regime.fault
    n_q, n_x = machine.n_q, machine.n_q + machine.n_v
    force = fault.force(rngs) if fault.force else None
    none, lag = np.zeros((machine.n_v, len(rngs))), np.reshape(fault.lag, (-1, 1))
    kinematics = machine.kinematics or (lambda q, v: v)

    def control(t: float, x: Array) -> Array:
        return machine.control(t, x[:n_q], x[n_q:n_x], reference, drawn)

    def acceleration(t: float, x: Array, u: Array) -> Array:
        share = t / machine.duration
        q, v, p = x[:n_q], x[n_q:n_x], fault.changed(share, drawn)
        acting = fault.actuator(np.where(lag > 0.0, x[n_x:], u) if fault.lag else u) * fault.supply(share)
        return machine.accelerations(q, v, acting, p, force(t, q, v, acting, p) if force else none)

    def rate(t: float, x: Array, held: Array | None) -> Array:
        u = control(t, x) if held is None else held
        parts = [kinematics(x[:n_q], x[n_q:n_x]), acceleration(t, x, u)]
        return np.concatenate([*parts, (u - x[n_x:]) / np.where(lag > 0.0, lag, np.inf)] if fault.lag else parts)

    return rate, control, acceleration


def _start(regime: Regime, reference: Multisine, control: Callable[[float, Array], Array]) -> Array:
    machine = regime.machine
    lanes = reference(0.0).shape[1]
    q, v = np.zeros((machine.n_q, lanes)), np.zeros((machine.n_v, lanes))
    if machine.on_reference:
        q, v = machine.on_reference(reference)
    x = np.concatenate([q, v])
    return np.concatenate([x, control(0.0, x)]) if regime.fault.lag else x


def rk4(rate: Callable[..., Array], t: float, x: Array, u: Array | None, h: float) -> Array:
    """One step of the classical Runge-Kutta method."""
    k1 = rate(t, x, u)
    k2 = rate(t + h / 2.0, x + h / 2.0 * k1, u)
    k3 = rate(t + h / 2.0, x + h / 2.0 * k2, u)
    k4 = rate(t + h, x + h * k3, u)
    return x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)


def _named(machine: Machine, states: Array, accelerations: Array, inputs: Array) -> dict[str, Array]:
    """Signals of the model; what the plant has beyond it comes last of each kind, and is left out."""
    model = machine.model
    parts = [
        (model.coordinates, states),
        (model.velocities, states[:, machine.n_q :]),
        (model.accelerations, accelerations),
        (model.inputs, inputs),
    ]
    return {name: values[:, i] for names, values in parts for i, name in enumerate(names)}


# ---------------------------------------------------------------------- sensors


def _measured(regime: Regime, time: Array, exact: Mapping[str, Array], rng: np.random.Generator) -> dict[str, Array]:
    """Columns of a log: late, noisy and corrupted signals, and the commanded inputs."""
    machine, columns = regime.machine, dict[str, Array]()
    for name, std in machine.noise.items():
        values = np.interp(time - regime.fault.late.get(name, 0.0), time, exact[name])
        noisy = values + regime.noise * std * rng.standard_normal(len(time))
        if regime.signals is None or name in regime.signals:
            columns[name] = noisy
    columns.update({name: exact[name].copy() for name in machine.model.inputs})
    if regime.fault.corrupted:
        regime.fault.corrupted(rng, columns, tuple(machine.model.inputs))
    return columns


def _wrong_inputs(rng: np.random.Generator, columns: dict[str, Array], inputs: Sequence[str]) -> None:
    """Runs of 10 samples, 5 % of each input, at a constant drawn from the input's range."""
    for name in inputs:
        values = columns[name]
        low, high = values.min(), values.max()
        for begin in rng.choice(len(values) // 10, len(values) // 200, replace=False):
            values[10 * begin : 10 * begin + 10] = rng.uniform(low, high)


def _missing(rows: int, *, inputs_too: bool) -> Callable[[np.random.Generator, dict[str, Array], Sequence[str]], None]:
    """A gap of some rows somewhere in the middle half."""

    def lose(rng: np.random.Generator, columns: dict[str, Array], inputs: Sequence[str]) -> None:
        n_rows = len(next(iter(columns.values())))
        begin = rng.integers(n_rows // 4, 3 * n_rows // 4 - rows)
        for name, values in columns.items():
            if inputs_too or name not in inputs:
                values[begin : begin + rows] = np.nan

    return lose


# ---------------------------------------------------------------------- actuators


def _dead_band(width: float) -> Callable[[Array], Array]:
    return lambda u: u - np.clip(u, -width, width)


def _curved(curvatures: Sequence[float]) -> Callable[[Array], Array]:
    """Gains that grow with their input."""
    return lambda u: u * (1.0 + np.reshape(curvatures, (-1, 1)) * np.abs(u))


def _saturated(level: float) -> Callable[[Array], Array]:
    return lambda u: np.clip(u, -level, level)


# ---------------------------------------------------------------------- forces


def gusts(rms: Sequence[float], low: float, high: float) -> Callable[[Rngs], Force]:
    """Multisine forces of 12 sines."""

    def draw(rngs: Rngs) -> Force:
        gust = Multisine(rngs, rms, low, high, 12)
        return lambda t, q, v, u, p: gust(t)

    return draw


def _slow_current(rms: float) -> Callable[[Rngs], Force]:
    """Drag of the underwater vehicle in water that moves, less that in water at rest."""

    def draw(rngs: Rngs) -> Force:
        current = Multisine(rngs, (rms,), 0.01, 0.04, 3)

        def drag(v: Array, p: SimpleNamespace) -> Array:
            return p.linear_drag * v + p.quadratic_drag * np.abs(v) * v

        return lambda t, q, v, u, p: drag(v, p) - drag(v - current(t), p)

    return draw


def _coulomb(rngs: Rngs) -> Force:  # noqa: ARG001
    """Coulomb friction of .8 % of the pendulum's gravity moment."""
    return lambda t, q, v, u, p: -0.008 * p.mgl * np.tanh(v / 0.01)


def _stribeck(rngs: Rngs) -> Force:  # noqa: ARG001
    """A fifth more dry friction near standstill, in both joints of the arm."""

    def force(t: float, q: Array, v: Array, u: Array, p: SimpleNamespace) -> Array:  # noqa: ARG001
        dry = np.stack([p.fc1, p.fc2])
        return -0.2 * dry * np.tanh(v / 0.01) * np.exp(-((v / 0.05) ** 2))

    return force


def _ripple(rngs: Rngs) -> Force:  # noqa: ARG001
    """Torque ripple ``sin(40 q)`` in the arm's first joint, a fifth of its dry friction."""
    return lambda t, q, v, u, p: np.stack([0.2 * p.fc1 * np.sin(40.0 * q[0]), 0.0 * q[1]])


def _payload(share: float, p: SimpleNamespace) -> SimpleNamespace:
    """The rotorcraft drops 30 % of its mass midway."""
    return p if share < 0.5 else SimpleNamespace(**{**vars(p), "mass": 0.7 * p.mass})


# ---------------------------------------------------------------------- the regimes

_ROTOR, _QUAD, _ARM, _CART = machines.ROTOR, machines.QUAD, machines.ARM, machines.VISCOUS_CART
_HOVER = replace(_ROTOR, reference=lambda rngs: Multisine(rngs, (1e-6, 1e-6), 0.08, 0.5, 5))
_STEPS = replace(_CART, control=machines.steps)
_SLOW_CART = replace(machines.CART, dt=0.05, substeps=20)
_SLOW_PENDULUM = replace(machines.PENDULUM, dt=0.05, substeps=25, duration=50.0, bandwidth=4.0)
_CLEAN = 0.01
"""Noise of clean logs: about their last digit."""


def _late(signals: str, milliseconds: float) -> Fault:
    return Fault(late=dict.fromkeys(signals.split(), 1e-3 * milliseconds))


_POSE = "x y z phi theta psi"
_GYRO = "wx wy wz"
_ALL = [
    Regime("rotor noise .1x", _ROTOR, noise=0.1),
    Regime("rotor noise 1x", _ROTOR),
    Regime("rotor noise 10x", _ROTOR, noise=10.0),
    Regime("quad mocap and gyro", _QUAD, signals=(*_POSE.split(), *_GYRO.split())),
    Regime("car all measured", machines.CAR),
    Regime("car gyro and lateral acceleration", machines.CAR, signals=("yaw_dot", "lateral_ddot")),
    Regime("flexible joint both angles", machines.JOINT),
    Regime("flexible joint motor angle", machines.JOINT, signals=("motor",)),
    Regime("cart-pole 20 Hz", _SLOW_CART),
    Regime("cart-pole 40 Hz", machines.CART),
    Regime("viscous cart-pole smooth", _CART),
    Regime("viscous cart-pole steps", _STEPS),
    Regime("differential drive all measured", machines.DRIVE),
    Regime("pendulum clean", machines.PENDULUM, noise=_CLEAN),
    Regime("pendulum noisy", machines.PENDULUM),
    Regime("arm clean", _ARM, noise=_CLEAN),
    Regime("arm noisy", _ARM),
    Regime("underwater clean", machines.UNDERWATER, noise=_CLEAN),
    Regime("underwater noisy", machines.UNDERWATER),
    Regime("motor clean", machines.MOTOR, noise=_CLEAN),
    Regime("motor noisy", machines.MOTOR),
    Regime("pendulum 20 Hz continuous input", _SLOW_PENDULUM, held=False),
    Regime("car continuous input", machines.CAR, held=False),
    Regime("servo 1 s missing", machines.SERVO, fault=Fault(corrupted=_missing(100, inputs_too=True))),
    Regime("servo 1 s of sensors missing", machines.SERVO, fault=Fault(corrupted=_missing(100, inputs_too=False))),
    Regime("quad .5 s of sensors missing", _QUAD, fault=Fault(corrupted=_missing(50, inputs_too=False))),
    Regime("rotor x and z 10 ms late", _ROTOR, exact=False, fault=_late("x z", 10.0)),
    Regime("quad mocap 10 ms late", _QUAD, exact=False, fault=_late(_POSE, 10.0)),
    Regime("quad mocap 40 ms late", _QUAD, exact=False, fault=_late(_POSE, 40.0)),
    Regime("rotor slight gusts", _ROTOR, exact=False, fault=Fault(force=gusts((0.1, 0.1, 0.001), 0.05, 3.0))),
    Regime("rotor torque gusts", _ROTOR, exact=False, fault=Fault(force=gusts((0.0, 0.0, 0.008), 0.05, 3.0))),
    Regime("rotor hover with gusts", _HOVER, exact=False, fault=Fault(force=gusts((0.3, 0.3, 0.003), 0.05, 3.0))),
    Regime("underwater waves", machines.UNDERWATER, exact=False, fault=Fault(force=gusts((1.3,), 0.1, 0.3))),
    Regime("underwater slow current", machines.UNDERWATER, exact=False, fault=Fault(force=_slow_current(0.05))),
    *(
        Regime(f"rotor motor lag {1e3 * lag:.0f} ms", _ROTOR, exact=False, fault=Fault(lag=(lag,)))
        for lag in (0.03, 0.05, 0.08)
    ),
    Regime("rotor lags 30 and 80 ms", _ROTOR, exact=False, fault=Fault(lag=(0.03, 0.08))),
    Regime("rotor moment lag 50 ms", _ROTOR, exact=False, fault=Fault(lag=(0.0, 0.05))),
    Regime("underwater lag .5 s", machines.UNDERWATER, exact=False, fault=Fault(lag=(0.5,))),
    Regime("pendulum dead band", machines.PENDULUM, exact=False, fault=Fault(actuator=_dead_band(0.06))),
    Regime("motor dead band", machines.MOTOR, exact=False, fault=Fault(actuator=_dead_band(0.3))),
    Regime("cart-pole saturation", machines.CART, exact=False, fault=Fault(actuator=_saturated(5.0))),
    Regime("rotor curved thrust", _ROTOR, exact=False, fault=Fault(actuator=_curved((0.015, 0.0)))),
    Regime("motor backlash", machines.GEARED_MOTOR, exact=False),
    Regime("arm Stribeck", _ARM, exact=False, fault=Fault(force=_stribeck)),
    Regime("arm ripple", _ARM, exact=False, fault=Fault(force=_ripple)),
    Regime("pendulum Coulomb friction", machines.PENDULUM, exact=False, fault=Fault(force=_coulomb)),
    Regime("rotor payload -30 %", _ROTOR, exact=False, fault=Fault(changed=_payload)),
    Regime("rotor battery sag 15 %", _ROTOR, exact=False, fault=Fault(supply=lambda share: 1.0 - 0.15 * share)),
    Regime("rotor moment 20 ms later", _ROTOR, exact=False, fault=Fault(later={"moment": 0.02})),
    Regime("rotor wrong inputs", _ROTOR, exact=False, fault=Fault(corrupted=_wrong_inputs)),
]
REGIMES = {regime.name: regime for regime in _ALL}
"""Regimes by name, in the order of the table."""
