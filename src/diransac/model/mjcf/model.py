"""`mujoco`: a model of any MJCF, and `MujocoModel`, which MuJoCo simulates."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.mjcf.description import (
    activations,
    compiled_of,
    compiled_text,
    file_drives,
    joint_columns,
    joint_ranges,
    position_targets,
    sensor_columns,
)
from diransac.model.mjcf.masks import Unknown, unknowns_of
from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.robots.compiled import mujoco_module
from diransac.model.robots.fields import ARRAYS, Place
from diransac.model.robots.mechanism import identifier
from diransac.model.robots.sizes import check_text

if TYPE_CHECKING:
    from diransac.model.mjcf.description import SensorColumns
    from diransac.model.robots.actuation import Actuation


def mujoco(
    path: str | Path,
    *,
    unknown: Collection[str],
    actuation: Actuation | None = None,
    name: str | None = None,
) -> MujocoModel:
    """Model of a machine from its MJCF, simulated by MuJoCo: free bases, contacts, tendons and closed loops.

    `robot` has equations, and is the better choice for chains and trees on a fixed base without contacts.

    Parameters
    ----------
    path : str or Path
        MJCF or URDF; read by MuJoCo (``pip install 'diransac[robots]'``).
    unknown : collection of str
        Masks ``kind/name.field[index]`` of what is to be identified; ``*`` stands for anything in a name.  One
        parameter per mask: all that it matches have one value; with ``each:`` before it, one per match. Without index,
        one per entry of the field. Fields are those of MuJoCo's compiled model: ``body/trunk.mass``,
        ``body/payload.ipos[0]``, ``geom/*_foot.friction[0]``, ``joint/*.armature``, ``joint/*.damping``,
        ``joint/*.frictionloss``, ``pair/...``; also ``sensor/*.bias``. Actuators have the numerical attributes of their
        kind, as the file names them: ``actuator/*.kp`` of ``position`` and ``pid``, ``actuator/*.lugre[2]`` of
        ``dcmotor``; and ``gear``, ``armature``, ``damping``, ``gainprm``, ``biasprm``, ``dynprm``. Nominal values are
        the file's.
    actuation : Actuation, optional
        Drives of hinges and slides in place of the file's actuators, of those joints that the file drives, or all:
        `PositionControl`, `JointTorques` or `MotorCurrents`. None: the file's actuators, whose controls are the inputs.
    name : str, optional
        Name of the model; by default that of the file.

    Returns
    -------
    MujocoModel
        Hinges and slides have the columns ``knee`` and ``knee_dot``; a free joint ``base`` has ``base_x``, ...,
        ``base_qw``, ... (position and attitude in the world), ``base_vx``, ... (velocity in the world) and
        ``base_wx``, ... (angular velocity in its frame); an actuator with dynamics has the state ``<name>_activation``,
        which need not be measured; sensors have their own names, with ``_x``, ``_y``, ``_z``.

    Raises
    ------
    ModelError
        MuJoCo is not installed; the file cannot be read, or has what is not simulated here; a mask matches nothing;
        nothing that a joint moves has a mass. Inertias that no body can have are the nearest possible ones
        (`Model.notes`).

    References
    ----------
    Todorov, Erez, Tassa 2012 (MuJoCo).
    """
    text, drives, notes = compiled_text(path, actuation)
    label = f'robot description "{path}"'
    compiled = compiled_of(label, text)
    states = [n for x in joint_columns(compiled) for n in (*x.coordinates, *x.velocities)]
    sensors = list(sensor_columns(compiled, states))
    unknowns = unknowns_of(label, compiled, sensors, (unknown,) if isinstance(unknown, str) else tuple(unknown))
    inputs = file_drives(compiled, states) if drives is None else drives
    model = MujocoModel(name or identifier(Path(path).stem), text, unknowns, inputs)
    model.notes = notes
    return model


class MujocoModel(Model):
    """A machine that MuJoCo simulates; made by `mujoco`.

    It has the names, units and bounds of a model, but no equations: what needs these (regression, candidate terms,
    planning, export of code) raises ModelError.

    Parameters
    ----------
    name : str
    text : str
        MJCF that needs no other file.
    unknowns : sequence of Unknown
    inputs : mapping of str to str
        Unit by name, in the order of MuJoCo's controls.
    constants : sequence of (Unknown, float), optional
        Parameters that have a value.
    sensors : collection of str, optional
        Readings that belong to the model; None: all.
    """

    has_equations = False

    def __init__(
        self,
        name: str,
        text: str,
        unknowns: Sequence[Unknown],
        inputs: Mapping[str, str],
        *,
        constants: Sequence[tuple[Unknown, float]] = (),
        sensors: Collection[str] | None = None,
    ) -> None:
        self.text, self.unknowns, self.constants = text, tuple(unknowns), tuple(constants)
        compiled = compiled_of(f'model "{name}"', text)
        joints = list(joint_columns(compiled))
        coordinates = {n: unit for x in joints for n, unit in x.coordinates.items()}
        velocities = {n: unit for x in joints for n, unit in x.velocities.items()}
        derived = len(coordinates) == len(velocities)
        self._given_sensors = None if sensors is None else tuple(sensors)
        self._sensors: tuple[SensorColumns, ...] = tuple(sensor_columns(compiled, (*coordinates, *velocities)))
        readings = {n: x.unit for x in self._sensors for n in x.columns if sensors is None or n in sensors}
        parameters = {x.name: x.parameter for x in self.unknowns}
        taken = {n: unit for n, unit in readings.items() if n not in inputs}
        self.kinematics = None if derived else self._rates_of_coordinates  # type: ignore[assignment]
        first_order = activations(compiled, (*coordinates, *velocities, *inputs, *readings))
        groups = (coordinates, inputs, parameters, None if derived else velocities, first_order)
        self._name_signals(name, *groups, "", taken)
        names = [*(n for x in joints for n in x.accelerations), *(f"{n}_dot" for n in first_order)]
        self.accelerations = dict(zip(names, self.accelerations.values(), strict=True))
        targets = position_targets(compiled, list(inputs))
        self._name_ranges(joint_ranges(compiled), {n: q for n, q in targets.items() if q in coordinates})

    # ------------------------------------------------------------------ what the simulator reads

    @cached_property
    def compiled(self) -> Any:
        """MuJoCo's model, with the constants in it."""
        found = compiled_of(self._label, self.text)
        for unknown, value in self.constants:
            write(found, unknown.places, value)
        self.complete(found, mujoco_module().MjData(found))
        return found

    def complete(self, compiled: Any, data: Any) -> None:
        """Bring what MuJoCo derives from its model up to date after entries were written.

        Parameters
        ----------
        compiled : mujoco.MjModel
        data : mujoco.MjData
            Of a model of the same sizes; it is changed.
        """
        mujoco_module().mj_setConst(compiled, data)
        if self._moved_bodies:  # MuJoCo leaves out what is aligned but for a small tolerance
            compiled.body_sameframe[self._moved_bodies], compiled.body_simple[self._moved_bodies] = 0, 0
            compiled.dof_simplenum[:] = 0

    @cached_property
    def _moved_bodies(self) -> list[int]:
        """Bodies whose frame of inertia is not that of the file."""
        every = (*self.unknowns, *(x for x, _ in self.constants))
        return sorted({x.index[0] for u in every for x in u.places if x.array == "body_ipos"})

    @cached_property
    def reading_places(self) -> dict[str, int]:
        """Place of each reading in MuJoCo's ``sensordata``."""
        places = {n: x.first + k for x in self._sensors for k, n in enumerate(x.columns)}
        return {n: places[n] for n in self.sensors}

    @cached_property
    def biases(self) -> tuple[tuple[int, int], ...]:
        """Index of each parameter that is the bias of a reading, and of the reading among the sensors."""
        names = list(self.sensors)
        pairs = [(k, c) for k, x in enumerate(self.unknowns) for c in x.columns]
        pairs += [(-1 - k, c) for k, (x, _) in enumerate(self.constants) for c in x.columns]
        return tuple((k, names.index(c)) for k, c in pairs if c in names)

    @cached_property
    def home(self) -> FloatArray:
        """State ``(n_x,)`` of the file's first keyframe, or of its reference pose; at rest."""
        compiled = self.compiled
        pose, activation = compiled.qpos0, np.zeros(compiled.na)
        if compiled.nkey:
            pose, activation = compiled.key_qpos[0], compiled.key_act[0]
        return np.concatenate([pose, np.zeros(compiled.nv), activation])

    def _rates_of_coordinates(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """Derivatives of the coordinates ``(n_q, n)`` at some states, by MuJoCo's integration of positions."""
        module, step = mujoco_module(), 1e-6
        rates = np.empty((self.n_q, np.asarray(q).shape[1]))
        for k, (own, speed) in enumerate(zip(np.asarray(q, float).T, np.asarray(v, float).T, strict=True)):
            after, before = own.copy(), own.copy()
            module.mj_integratePos(self.compiled, after, speed[: self.compiled.nv], step)
            module.mj_integratePos(self.compiled, before, speed[: self.compiled.nv], -step)
            rates[:, k] = (after - before) / (2.0 * step)
        return rates

    # ------------------------------------------------------------------ what identification asks of a model

    def __getattr__(self, name: str) -> Any:
        """Raises ModelError where equations are asked for."""
        if name in ("residual", "measurement", "force_sign", "_probe", "_mass_matrix", "_bias", "_equations_data"):
            raise ModelError(f"{self._label} has no equations, which this needs: MuJoCo simulates it")
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @cached_property
    def nonlinear_parameters(self) -> tuple[str, ...]:
        """All parameters: nothing is known to be linear."""
        return tuple(self.parameters)

    @property
    def is_affine(self) -> bool:
        """False."""
        return False

    @cached_property
    def affine_sensors(self) -> tuple[str, ...]:
        """None."""
        return ()

    @cached_property
    def required_signals(self) -> tuple[str, ...]:
        """The inputs."""
        return tuple(self.inputs)

    @cached_property
    def quaternions(self) -> tuple[tuple[int, int, int, int], ...]:
        """Places of the coordinates that are unit quaternions."""
        first = [k for k, n in enumerate(self.coordinates) if n.endswith("_qw") and self.coordinates[n] == "1"]
        return tuple((k, k + 1, k + 2, k + 3) for k in first)

    @cached_property
    def sensor_arguments(self) -> dict[str, tuple[str, ...]]:
        """States, accelerations, inputs and parameters that each reading may depend on."""
        of_forces = {n for x in self._sensors if x.of_forces for n in x.columns}
        own = {c: x.name for x in self.unknowns for c in x.columns}
        found = {}
        for name in self.sensors:
            more = (*self.accelerations, *self.inputs) if name in of_forces else ()
            found[name] = (*self.state, *more, *((own[name],) if name in own else ()))
        return found

    @cached_property
    def sensor_parameters(self) -> tuple[str, ...]:
        """Parameters that only sensors depend on."""
        return tuple(x.name for x in self.unknowns if x.columns)

    @cached_property
    def biased_sensors(self) -> tuple[str, ...]:
        """Sensors with a bias among the parameters."""
        return tuple(c for x in self.unknowns for c in x.columns)

    def states_behind(self, signals: Iterable[str]) -> tuple[str, ...]:
        """All states: any may act on any signal through contacts."""
        return self.state if tuple(signals) else ()

    def equations_text(self) -> tuple[str, ...]:
        """Lines in place of equations in a report."""
        return (f"simulated by MuJoCo: {self.compiled.nbody - 1} bodies, {self.compiled.nv} degrees of freedom",)

    # ------------------------------------------------------------------ other models of the same machine

    def with_sensors(self, names: Collection[str]) -> MujocoModel:
        """The model with these readings alone, without biases of others."""
        kept = tuple(n for n in self.sensors if n in names)
        if len(kept) == len(self.sensors):
            return self
        left = [x for x in self.unknowns if not x.columns or set(x.columns) & set(kept)]
        return self._reduced(left, self.constants, kept)

    def with_fixed(self, values: Mapping[str, float]) -> MujocoModel:
        """The model in which parameters are constants."""
        if not values:
            return self
        fixed = [(x, float(values[x.name])) for x in self.unknowns if x.name in values]
        left = [x for x in self.unknowns if x.name not in values]
        return self._reduced(left, (*self.constants, *fixed), self._given_sensors)

    def _reduced(
        self, unknowns: Sequence[Unknown], constants: Sequence[tuple[Unknown, float]], sensors: Collection[str] | None
    ) -> MujocoModel:
        model = MujocoModel(self.name, self.text, unknowns, self.inputs, constants=constants, sensors=sensors)
        model.notes = self.notes
        return model

    # ------------------------------------------------------------------ identity and storage

    def _to_dict(self) -> dict[str, Any]:
        """Text, parameters and names."""
        return {
            "simulator": "mujoco",
            "name": self.name,
            "mjcf": self.text,
            "unknowns": [_stored(x) for x in self.unknowns],
            "constants": [[_stored(x), value] for x, value in self.constants],
            "inputs": dict(self.inputs),
            "sensors": None if self._given_sensors is None else list(self._given_sensors),
        }

    @classmethod
    def _from_checked(cls, data: Mapping[str, Any]) -> Self:
        check_text(str(data["mjcf"]).encode(), "the stored model")
        model = cls(
            str(data["name"]),
            str(data["mjcf"]),
            [_restored(x) for x in data["unknowns"]],
            {str(n): str(unit) for n, unit in data["inputs"].items()},
            constants=[(_restored(x), float(value)) for x, value in data["constants"]],
            sensors=None if data["sensors"] is None else [str(n) for n in data["sensors"]],
        )
        for unknown in (*model.unknowns, *(x for x, _ in model.constants)):
            for place in unknown.places:
                getattr(model.compiled, place.array)[place.index]
        return model

    def __repr__(self) -> str:
        return f"MujocoModel({self.name!r}, coordinates={list(self.coordinates)}, parameters={list(self.parameters)})"


def write(compiled: Any, places: Sequence[Place], value: float) -> None:
    """Give entries of MuJoCo's model the value of a parameter.

    Parameters
    ----------
    compiled : mujoco.MjModel
    places : sequence of Place
    value : float
    """
    for place in places:
        getattr(compiled, place.array)[place.index] = place.factor * value


def _stored(unknown: Unknown) -> dict[str, Any]:
    places = [[x.array, list(x.index), x.factor] for x in unknown.places]
    columns, elements = list(unknown.columns), [list(x) for x in unknown.elements]
    own = {"name": unknown.name, "parameter": unknown.parameter.to_dict(), "places": places}
    return {**own, "elements": elements, "columns": columns}


def _restored(data: Mapping[str, Any]) -> Unknown:
    """Raises LookupError, TypeError, ValueError, ModelError: the data are not those of a parameter."""
    places = [Place(str(array), tuple(int(k) for k in at), float(factor)) for array, at, factor in data["places"]]
    if not {x.array for x in places} <= ARRAYS:
        raise ValueError("a parameter has a place that is none")
    elements = tuple((str(kind), str(name)) for kind, name in data["elements"])
    parameter = Parameter.from_dict(data["parameter"])
    return Unknown(str(data["name"]), parameter, tuple(places), elements, tuple(map(str, data["columns"])))
