"""`PlantChoice`: the plant of a study, by its kind and its arguments.

Kinds are the paper's rotorcraft, machines with effects that their models leave out, and functions in files of users.
Effects of machines (periodic forces of drives, gusts, waves and currents) are sums of sines, whose phases the seed of a
flight draws.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import pi, sqrt
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Self

from casadi import cos, fabs, sin
from pydantic import Field, ValidationInfo, field_validator, model_validator

from diransac.errors import DiransacError, ModelError, SettingsError
from diransac.model import Model, Parameter
from diransac.model.derivation import Symbols
from diransac.model.library import TABLE_I, builtin, extended_rotorcraft
from diransac.model.plant import Disturbance, Plant, check_possible
from diransac.study.tables import RANDOM, FunctionTable, Text, check_signature, function_arguments
from diransac.user_files import blaming, definitions, file_and_name, running

# Machines -------------------------------------------------------------------------------------------------------------
PARAMETERS: Mapping[str, Mapping[str, float]] = MappingProxyType({
    # kg, N s/m, N, N: an axis of the size of EMPS.
    "servo axis": {"mass": 95.0, "viscous_friction": 200.0, "dry_friction": 20.0, "offset": -12.0},
    # kg m^2, kg m, N m s/rad and N m: a desktop machine.
    "double pendulum": {
        "inertia1": 0.09, "moment1": 0.3, "inertia2": 0.025, "moment2": 0.12, "rotor_inertia": 6e-5,
        "viscous_friction1": 0.02, "dry_friction1": 0.08, "viscous_friction2": 0.02, "dry_friction2": 0.05,
    },
    # kg, m, N m s/rad.
    "pendulum": {"mass": 0.5, "length": 0.6, "friction": 0.05},
    # kg, N s/m, N s^2/m^2, N: a vehicle that a person can carry.
    "underwater vehicle": {"mass": 42.0, "linear_drag": 11.0, "quadratic_drag": 38.0, "bias": 1.6},
})  # fmt: skip
"""Default parameters of the machines."""


def servo_axis(cogging: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["servo axis"]) -> Plant:
    """`models.servo_axis` with a cogging force of amplitude `cogging`, N, and a period of 24 mm."""
    model = builtin("servo-axis")

    def magnets(q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        # m, period of the cogging force.
        return {"position": d.cogging * cos(2 * pi * q.position / 0.024 + d.phase)}

    cogs = _vibration(model, "magnets", {"cogging": cogging}, 40.0, {"phase": 0.0}, forces=magnets)
    return Plant(model, parameters, (cogs,))


def double_pendulum(ripple: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["double pendulum"]) -> Plant:
    """`models.double_pendulum` with a torque ripple of amplitude `ripple`, N m, 126 periods per turn, at each joint."""
    model = builtin("double-pendulum")

    def motors(q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        return {f"q{i}": _ripple(d, q[f"q{i}"], d[f"phase_{i}"]) for i in (1, 2)}

    ripples = _rippled(model, "motors", ripple, ("phase_1", "phase_2"), forces=motors)
    return Plant(model, parameters, (ripples,))


def pendulum(ripple: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["pendulum"]) -> Plant:
    """``a = -g/l sin(q) + (torque - c v) / (m l^2)``: a mass on a rod of unknown length, with a torque ripple, N m.

    The length enters as 1/l and 1/l^2: the model is not affine in its parameters.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        torque = u.torque - p.friction * v.angle
        return [a.angle + 9.81 / p.length * sin(q.angle) - torque / (p.mass * p.length**2)]

    def motor(q: Symbols, _v: Symbols, _u: Symbols, p: Symbols, d: Symbols) -> dict[str, Any]:
        return {"angle": _ripple(d, q.angle, d.phase) / (p.mass * p.length**2)}

    model = Model(
        "pendulum",
        coordinates={"angle": "rad"},
        inputs={"torque": "N m"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "length": Parameter("m", positive=True),
            "friction": Parameter("N m s/rad", lower=0.0),
        },
        equations=equations,
    )
    ripples = _rippled(model, "motor", ripple, ("phase",), accelerations=motor)
    return Plant(model, parameters, (ripples,))


def _ripple(d: Symbols, angle: Any, phase: Any) -> Any:
    """Torque of a motor with 126 periods per turn of its joint: 21 pole pairs behind a gear of 6."""
    return d.ripple * cos(126 * angle + phase)


def _rippled(model: Model, name: str, ripple: float, phases: Sequence[str], **effect: Any) -> Disturbance:
    """Torque ripple, which integration steps resolve up to joint velocities of 10 rad/s, 200 Hz."""
    return _vibration(model, name, {"ripple": ripple}, 200.0, dict.fromkeys(phases, 0.0), **effect)


def rotorcraft_in_gusts(
    gusts: float = 0.0, moment_gusts: float = 0.0, parameters: Mapping[str, float] = TABLE_I
) -> Plant:
    """The planar rotorcraft in gusts of 0.1 to 2.6 Hz."""
    model = builtin("planar-rotorcraft")
    rates = (0.11, 0.23, 0.54, 1.2, 2.6)  # Hz, up to the bandwidth of an attitude controller

    def air(_q: Symbols, _v: Symbols, _u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
        sizes = {"x": d.gusts, "z": d.gusts, "theta": d.moment_gusts}
        return {name: size * _sines(d, f"phase_{name}", rates) for name, size in sizes.items()}

    turning = _turning({f"phase_{name}": rates for name in model.coordinates})
    sizes = {"gusts": gusts, "moment_gusts": moment_gusts}
    air_in_motion = _vibration(model, "air", sizes, max(rates), turning, forces=air)
    return Plant(model, parameters, (air_in_motion,))


def underwater_vehicle(
    waves: float = 0.0, current: float = 0.0, parameters: Mapping[str, float] = PARAMETERS["underwater vehicle"]
) -> Plant:
    """`models.underwater_vehicle` in waves and in a slow current, whose drag is that of the motion through the water.

    Parameters
    ----------
    waves : RMS of their force, N, at 0.12 to 0.27 Hz
    current : RMS of its velocity, m/s, at 0.02 Hz
    parameters : of the model
    """
    model = builtin("underwater-vehicle")
    of_waves, of_current = (0.12, 0.19, 0.27), (0.02,)  # Hz: waves of a lake, a tide in the time of a dive

    def water(_q: Symbols, v: Symbols, _u: Symbols, p: Symbols, d: Symbols) -> dict[str, Any]:
        def drag(speed: Any) -> Any:
            return p.linear_drag * speed + p.quadratic_drag * fabs(speed) * speed

        through_water = v.x - d.current * _sines(d, "phase_current", of_current)
        return {"x": drag(v.x) - drag(through_water) + d.waves * _sines(d, "phase_waves", of_waves)}

    turning = _turning({"phase_waves": of_waves, "phase_current": of_current})
    sizes = {"waves": waves, "current": current}
    water_in_motion = _vibration(model, "water", sizes, max(of_waves), turning, forces=water)
    return Plant(model, parameters, (water_in_motion,))


def _sines(d: Symbols, name: str, frequencies: Sequence[float]) -> Any:
    """Sum of sines, of RMS 1, with the states of `_turning`."""
    return sqrt(2.0 / len(frequencies)) * sum(sin(d[f"{name}_{i}"]) for i in range(len(frequencies)))


def _turning(groups: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """Rates, rad/s, of the states ``name_i``, the phases of sines with these frequencies, Hz."""
    return {f"{name}_{i}": 2 * pi * rate for name, some in groups.items() for i, rate in enumerate(some)}


def _vibration(
    model: Model, name: str, constants: Mapping[str, float], highest: float, rates: Mapping[str, float], **effect: Any
) -> Disturbance:
    """Disturbance of phases with constant rates, rad/s, up to a frequency, Hz; a flight's seed draws each phase."""
    states, start = dict.fromkeys(rates, "rad"), dict.fromkeys(rates, (0.0, 2 * pi))
    fixed: dict[str, Any] = {"constants": constants, "states": states, "rates": lambda *_: dict(rates), "start": start}
    return Disturbance(model, name, highest_frequency=highest, **fixed, **effect)


def _undisturbed(parameters: Mapping[str, float] = TABLE_I) -> Plant:
    """The planar rotorcraft without any disturbance."""
    return Plant(builtin("planar-rotorcraft"), parameters)


_KINDS: dict[str, Callable[..., Plant]] = {
    "extended-rotorcraft": extended_rotorcraft,
    "planar-rotorcraft": _undisturbed,
    "rotorcraft-in-gusts": rotorcraft_in_gusts,
    "servo-axis": servo_axis,
    "double-pendulum": double_pendulum,
    "pendulum": pendulum,
    "underwater-vehicle": underwater_vehicle,
}


# The choice of a plant ------------------------------------------------------------------------------------------------
class PlantChoice(FunctionTable):
    """The plant of a study, the table ``[plant]``, with all of its arguments, defaults included.

    Parameters
    ----------
    kind : ``extended-rotorcraft`` (`models.extended_rotorcraft`); ``planar-rotorcraft``, with parameters only;
        ``rotorcraft-in-gusts``, ``servo-axis``, ``double-pendulum``, ``pendulum``, ``underwater-vehicle``; or
        ``FILE.py:NAME``, a function of that name (default ``plant``) in a file, which is run wherever trials run
    file_digest : of the file, so that every worker and every resumed run uses the same one; "" for other kinds
    arguments : by name, as TOML has them: a list for a pair, ``random`` for a rotor phase that each flight draws;
        model parameters that are not given have the plant's defaults, such as Table I

    Raises
    ------
    SettingsError
        An unknown kind or key, a value that makes no plant, a parameter outside its bounds, a file that is missing or
        has changed.
    """

    PLACE: ClassVar[str] = "plant"

    kind: Text
    file_digest: Text = Field("", validate_default=True)
    arguments: dict[str, Any] = Field({})

    @field_validator("kind")
    @classmethod
    def _known(cls, kind: str) -> str:
        if kind not in _KINDS and file_and_name(kind, "plant") is None:
            raise SettingsError(f"plant.kind is {kind!r:.60}; there are {', '.join(_KINDS)}, or give FILE.py:NAME")
        return kind

    @field_validator("file_digest")
    @classmethod
    def _of_the_file(cls, digest: str, info: ValidationInfo) -> str:
        kind = info.data.get("kind")
        if kind is None or kind in _KINDS:
            return digest
        found = _digest(kind)  # also where one is given: the file must be there
        return digest or found

    @field_validator("arguments")
    @classmethod
    def _complete(cls, given: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        if "kind" not in info.data:
            return given
        kind, digest = info.data["kind"], info.data["file_digest"]
        if kind in _KINDS and digest:
            given = {**given, "file_digest": digest}  # which is then refused
        with _settings_errors():
            function = _function(kind, digest)
            return function_arguments(function, given, "plant", ["kind"], random="rotor_phase", pairs=True)

    @model_validator(mode="after")
    def _makes_a_plant(self) -> Self:
        with _settings_errors():  # also of arguments that make no plant
            check_possible(self.plant.model, self.plant.parameters)
        return self

    @property
    def plant(self) -> Plant:
        """The plant itself."""
        return _made(self.kind, self.file_digest, json.dumps(self.arguments))

    @property
    def is_drawn(self) -> bool:
        """True if the seed of a flight draws a start value of a disturbance."""
        return any(isinstance(start, tuple) for one in self.plant.disturbances for start in one.start.values())


@contextlib.contextmanager
def _settings_errors() -> Iterator[None]:
    """Raises SettingsError in place of the other errors of a plant."""
    try:
        yield
    except SettingsError:
        raise
    except DiransacError as error:
        raise SettingsError(f"plant: {error}") from error


@functools.lru_cache(maxsize=64)
def _made(kind: str, digest: str, arguments: str) -> Plant:
    """A plant from its arguments as JSON; levels with the same arguments share it."""
    function = _function(kind, digest)
    return function(**{name: _as_argument(name, value) for name, value in json.loads(arguments).items()})


def _as_argument(name: str, value: Any) -> Any:
    """A value of a table as the plant's function takes it."""
    if name == "rotor_phase" and value == RANDOM:
        return None
    return tuple(value) if isinstance(value, list) else value


# Files of users -------------------------------------------------------------------------------------------------------
@functools.lru_cache(maxsize=8)
def _function(kind: str, digest: str) -> Callable[..., Plant]:
    """The function that makes plants of a kind.

    Raises ModelError: a user's file cannot be run, or has no such function.
    Raises SettingsError: the file is missing, or has another digest.
    """
    if kind in _KINDS:
        return _KINDS[kind]
    if _digest(kind) != digest:
        raise SettingsError(
            f"plant.kind: {kind} is not the file that the study was begun with: its digest is {_digest(kind)}, not "
            f"{digest}; give that one, or begin a new store"
        )
    file, name = _file_and_name(kind)
    defined = definitions(file, "plant")
    made_by = defined.get(name)
    if not callable(made_by):
        found = ", ".join(key for key, value in defined.items() if inspect.isfunction(value)) or "none"
        raise ModelError(
            f'plant file "{file}" has no function "{name}" that returns a diransac.Plant; functions found: {found}'
        )
    with blaming(file, "plant"):
        check_signature(made_by, name)
    return _checked(made_by, file, name)


def _digest(kind: str) -> str:
    """Digest of the bytes of a user's file.  Raises SettingsError: the file cannot be read."""
    file, _ = _file_and_name(kind)
    try:
        return hashlib.blake2b(file.read_bytes(), digest_size=8).hexdigest()
    except OSError as error:
        raise SettingsError(
            f'plant.kind: "{file}" cannot be read: {error.strerror}; it must be there wherever trials run, by this name'
        ) from error


def _checked(function: Callable[..., Any], file: Path, name: str) -> Callable[..., Plant]:
    """The function, with its errors and its result checked."""

    @functools.wraps(function)  # keeps the signature, whose arguments are keys
    def made(**arguments: Any) -> Plant:
        with running(file, "plant"):
            found = function(**arguments)
        if not isinstance(found, Plant):
            raise ModelError(f'plant file "{file}": "{name}" returns a {type(found).__name__}, not a diransac.Plant')
        return found

    return made


def _file_and_name(kind: str) -> tuple[Path, str]:
    """File and function of a user's plant."""
    found = file_and_name(kind, "plant")
    assert found is not None
    return found
