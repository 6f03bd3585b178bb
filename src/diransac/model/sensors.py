"""Measurement equations ``y = h(q, v, a, u, p)``: `Sensor`, and those of common instruments.

Each function returns a mapping from the name of a log's column to a `Sensor`, so that several are combined in a line::

    sensors={**accelerometer(("x", "z"), "theta"), **gyroscope("theta", scale=True)}

A sensor brings the parameters that it needs (biases, scales, lever arms); a model that declares a parameter of the same
name gives it other bounds, or one value per log.

An attitude is the name of a planar angle, the names of a unit quaternion (w first), or a function ``(q, p)`` that
returns a rotation matrix. It rotates from the body frame to the world frame; the planar angle turns the first axis
towards the second.

References
----------
Titterton and Weston 2004, "Strapdown Inertial Navigation Technology", chapters 3 and 12.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import pi
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.errors import ModelError
from diransac.model.parameter import Parameter
from diransac.plain_text import is_one_line

Attitude: TypeAlias = str | Sequence[str] | Callable[[Any, Any], Any]
Vector: TypeAlias = Sequence[float]


@dataclass(frozen=True)
class Sensor:
    """Measurement equation of a column of a log.

    Parameters
    ----------
    unit : str
        Unit of the column.
    equation : callable
        ``equation(q, v, a, u, p)`` returns the value that the sensor shows, with the arguments of the model's
        ``equations``: coordinates, velocities, accelerations, inputs and parameters, such as a bias ``p.bias``.
    parameters : mapping from name to Parameter, optional
        Parameters that the sensor adds to those of the model.

    Raises
    ------
    ModelError
        The unit is not a text of one line, the equation is not a function, or parameters are not a mapping of
        `Parameter`.
    """

    unit: str
    equation: Callable[..., Any]
    parameters: Mapping[str, Parameter] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not is_one_line(self.unit):
            raise ModelError(f'the unit of a sensor is {self.unit!r:.60}; give a text of one line, such as "m/s^2"')
        if not callable(self.equation):
            raise ModelError(f"the equation of a sensor is {self.equation!r}; give a function of (q, v, a, u, p)")
        if not all(isinstance(x, Parameter) for x in dict(self.parameters).values()):
            raise ModelError(f"the parameters of a sensor are {self.parameters!r}; map names to dr.Parameter")


def with_parameters_of(
    label: str, sensors: Mapping[str, Sensor] | None, parameters: Mapping[str, Parameter]
) -> Mapping[str, Parameter]:
    """Parameters of a model, followed by those that its sensors add.

    Raises ModelError: sensors are not a mapping of `Sensor`, or two of them need different parameters of one name.
    """
    if sensors is None or not isinstance(parameters, Mapping):
        return parameters
    if not isinstance(sensors, Mapping):
        raise ModelError(f"{label}: sensors = {sensors!r:.80}; give a mapping from name to dr.Sensor")
    added: dict[str, Parameter] = {}
    for name, sensor in sensors.items():
        if not isinstance(sensor, Sensor):
            raise ModelError(f'{label}: sensor {name!r} is {sensor!r:.80}; give dr.Sensor("m/s^2", equation)')
        for key, parameter in sensor.parameters.items():
            if added.setdefault(key, parameter) != parameter:
                raise ModelError(
                    f"{label}: sensors need different parameters {key!r}; declare it among the model's parameters, or "
                    "give the sensors different names"
                )
    return {**parameters, **{n: x for n, x in added.items() if n not in parameters}} if added else parameters


# ---------------------------------------------------------------------- instruments


def accelerometer(
    position: Sequence[str],
    attitude: Attitude,
    *,
    rates: Sequence[str] | None = None,
    lever_arm: Vector | str | None = None,
    gravity: Sequence[float] | None = None,
    axes: Sequence[str] | None = None,
    bias: bool = True,
    scale: bool = False,
    name: str = "acc",
) -> dict[str, Sensor]:
    """Specific force in the body frame, ``f = R' (a - g) + alpha x r + omega x (omega x r)``, m/s^2.

    Parameters
    ----------
    position : sequence of str
        The two or three coordinates whose accelerations are those of a point of the body in the world frame.
    attitude : str, sequence of str or callable
        Rotation R from the body to the world frame; see the module.
    rates : sequence of str, optional
        The three angular velocities in the body frame, where there is a lever arm in three dimensions; in the plane,
        they are those of the angle.
    lever_arm : sequence of float or "estimated", optional
        Position r of the sensor in the body frame, m, from that point; "estimated": parameters ``acc_arm_x``, ...
    gravity : sequence of float, optional
        Gravity g in the world frame, m/s^2; by default 9.81 against the last axis.
    axes : sequence of str, optional
        Names of the axes of the body; by default those of the position.
    bias, scale : bool, optional
        Whether each axis has a bias (``acc_bias_x``, m/s^2) and a scale factor (``acc_scale_x``) as parameters.
    name : str, optional
        Beginning of the names: columns are ``acc_x``, ..., after the names of the axes.
    """
    n = _dimension("accelerometer", position)
    names = _axes("accelerometer", axes, position)
    g = _vector("gravity", (*(0.0,) * (n - 1), -9.81) if gravity is None else gravity, n)
    own_names = [f"{name}_arm_{x}" for x in names]
    arm, arms = (None, {}) if lever_arm is None else _estimated(lever_arm, own_names, "m", "lever_arm")
    if arm is not None and not (isinstance(attitude, str) if n == 2 else rates):
        raise ModelError(
            "accelerometer: a lever arm needs the angular velocity; give attitude by the name of a planar angle"
            if n == 2
            else 'accelerometer: a lever arm needs the angular velocities; give rates=("wx", "wy", "wz")'
        )

    def force(at: _Arguments) -> ca.SX:
        f = _rotation(attitude, at, n).T @ (_column(at.a, position) - g)
        if arm is None:
            return f
        r = _values(arm, at.p)
        if n == 2:
            w, alpha = at.v[attitude], at.a[attitude]
            return ca.SX(f + alpha * ca.vertcat(-r[1], r[0]) - w**2 * r)
        assert rates is not None
        w, alpha = _column(at.v, rates), _column(at.a, rates)
        return f + ca.cross(alpha, r) + ca.cross(w, ca.cross(w, r))

    return _triad(name, names, "m/s^2", force, bias, scale, arms)


def gyroscope(
    rates: str | Sequence[str],
    *,
    attitude: Attitude | None = None,
    axes: Sequence[str] | None = None,
    bias: bool = True,
    scale: bool = False,
    name: str = "gyro",
) -> dict[str, Sensor]:
    """Angular velocity in the body frame, ``R' omega``, rad/s.

    Parameters
    ----------
    rates : str or sequence of str
        A planar angle, whose derivative is measured, or the three angular velocities.
    attitude : str, sequence of str or callable, optional
        Rotation R from the body to the world frame, where the angular velocities are those in the world frame; see the
        module. None: they are in the body frame.
    axes : sequence of str, optional
        Names of the axes of the body in three dimensions; by default those of the rates.
    bias, scale : bool, optional
        Whether each axis has a bias (``gyro_bias_wx``, rad/s) and a scale factor (``gyro_scale_wx``) as parameters.
    name : str, optional
        Name of the column in the plane; beginning of the names ``gyro_wx``, ... in three dimensions.
    """
    if isinstance(rates, str):
        return {name: _calibrated("rad/s", lambda at: at.v[rates], name, "", bias, scale)}
    if len(rates) != 3:
        raise ModelError(f"gyroscope: rates = {rates!r}; give the name of a planar angle, or three angular velocities")

    def turned(at: _Arguments) -> ca.SX:
        w = _column(at.v, rates)
        return w if attitude is None else _rotation(attitude, at, 3).T @ w

    return _triad(name, _axes("gyroscope", axes, rates), "rad/s", turned, bias, scale)


def encoder(
    coordinate: str,
    *,
    counts: float | None = None,
    ratio: float = 1.0,
    unit: str = "rad",
    bias: bool = True,
    scale: bool = False,
    name: str | None = None,
) -> dict[str, Sensor]:
    """Coordinate as an encoder shows it: ``ratio q``, in its unit or in counts.

    Parameters
    ----------
    coordinate : str
        An angle, rad; or, without ``counts``, any coordinate.
    counts : float, optional
        Counts per revolution of the encoder's shaft; None: the column is in ``unit``.
    ratio : float, optional
        Revolutions of the encoder's shaft per revolution of the coordinate.
    unit : str, optional
        Unit of the column without counts.
    bias, scale : bool, optional
        Whether the zero (``<name>_bias``, in the column's unit) and a scale factor (``<name>_scale``) are parameters.
    name : str, optional
        Name of the column; ``<coordinate>_encoder`` by default.
    """
    for label, value in (("counts", 1.0 if counts is None else counts), ("ratio", ratio)):
        if not (np.isfinite(value) and value):
            raise ModelError(f"encoder: {label} = {value}; give a finite number other than 0")
    column = name or f"{coordinate}_encoder"
    factor = ratio if counts is None else ratio * counts / (2.0 * pi)
    shown = unit if counts is None else "1"
    return {column: _calibrated(shown, lambda at: factor * at.q[coordinate], column, "", bias, scale)}


def magnetometer(
    attitude: Attitude,
    field: Vector | str = "estimated",
    *,
    axes: Sequence[str] = ("x", "y", "z"),
    unit: str = "uT",
    bias: bool = True,
    scale: bool = False,
    name: str = "mag",
) -> dict[str, Sensor]:
    """Magnetic field in the body frame, ``R' B``.

    Parameters
    ----------
    attitude : str, sequence of str or callable
        Rotation R from the body to the world frame; see the module.
    field : sequence of float or "estimated", optional
        The field B in the world frame, in ``unit``; "estimated": parameters ``mag_field_x``, ...
    axes : sequence of str, optional
        Names of the two or three axes; two with a planar angle.
    unit : str, optional
    bias, scale : bool, optional
        Whether each axis has a bias (``mag_bias_x``, hard iron) and a scale factor (``mag_scale_x``) as parameters;
        of an estimated field, a common scale is not identifiable.
    name : str, optional
        Beginning of the names of columns, ``mag_x``, ...
    """
    n = _dimension("magnetometer", axes)
    B, fields = _estimated(field, [f"{name}_field_{x}" for x in axes], unit, "field")

    def turned(at: _Arguments) -> ca.SX:
        return _rotation(attitude, at, n).T @ _values(B, at.p)

    return _triad(name, axes, unit, turned, bias, scale, fields)


def range_to(
    point: Vector | str,
    position: Sequence[str],
    *,
    unit: str = "m",
    bias: bool = True,
    scale: bool = False,
    name: str = "range",
) -> dict[str, Sensor]:
    """Distance to a point of the world, ``|x - x_point|``.

    Parameters
    ----------
    point : sequence of float or "estimated"
        The point in the world frame, in ``unit``; "estimated": parameters ``range_point_x``, ...
    position : sequence of str
        The two or three coordinates of the machine.
    unit : str, optional
    bias, scale : bool, optional
        Whether a bias (``range_bias``) and a scale factor (``range_scale``) are parameters.
    name : str, optional
        Name of the column.
    """
    _dimension("range_to", position)
    aim, points = _estimated(point, [f"{name}_point_{x}" for x in position], unit, "point")

    def distance(at: _Arguments) -> ca.SX:
        return ca.norm_2(_column(at.q, position) - _values(aim, at.p))

    return {name: _calibrated(unit, distance, name, "", bias, scale, points)}


# ---------------------------------------------------------------------- parts


class _Arguments(NamedTuple):
    """Arguments of a measurement equation, with components by name."""

    q: Any
    v: Any
    a: Any
    u: Any
    p: Any


def _triad(
    name: str,
    axes: Sequence[str],
    unit: str,
    ideal: Callable[[_Arguments], ca.SX],
    bias: bool,
    scale: bool,
    parameters: Mapping[str, Parameter] | None = None,
) -> dict[str, Sensor]:
    """A sensor for each axis of a vector, each with its own bias and scale."""
    return {
        f"{name}_{axis}": _calibrated(unit, partial(_component, ideal, i), name, f"_{axis}", bias, scale, parameters)
        for i, axis in enumerate(axes)
    }


def _component(ideal: Callable[[_Arguments], ca.SX], i: int, at: _Arguments) -> ca.SX:
    return ca.SX(ideal(at)[i])


def _calibrated(
    unit: str,
    ideal: Callable[[_Arguments], Any],
    name: str,
    axis: str,
    bias: bool,
    scale: bool,
    parameters: Mapping[str, Parameter] | None = None,
) -> Sensor:
    """A sensor that shows ``scale * ideal + bias``."""
    zero, factor = f"{name}_bias{axis}", f"{name}_scale{axis}"
    own = {**(parameters or {})}
    own |= {zero: Parameter(unit)} if bias else {}
    own |= {factor: Parameter("1", positive=True)} if scale else {}

    def equation(q: Any, v: Any, a: Any, u: Any, p: Any) -> Any:
        value = ideal(_Arguments(q, v, a, u, p))
        value = p[factor] * value if scale else value
        return value + p[zero] if bias else value

    return Sensor(unit, equation, own)


def _estimated(
    given: Vector | str | None, names: Sequence[str], unit: str, what: str
) -> tuple[list[float] | list[str], dict[str, Parameter]]:
    """A vector as numbers, or as the names of its parameters; and these parameters."""
    if given is None or isinstance(given, str):
        if given != "estimated":
            raise ModelError(f'{what} = {given!r}; give {len(names)} numbers, or "estimated"')
        return list(names), {name: Parameter(unit) for name in names}
    return _vector(what, given, len(names)).tolist(), {}


def _values(vector: Sequence[float] | Sequence[str], p: Any) -> ca.SX:
    """A vector of numbers, or of parameters by name."""
    return ca.SX(ca.vertcat(*(p[x] if isinstance(x, str) else x for x in vector)))


def _vector(what: str, values: Sequence[float], n: int) -> FloatArray:
    """Finite numbers ``(n,)``."""
    try:
        found = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise ModelError(f"{what} = {values!r}; give {n} numbers") from error
    if found.shape != (n,) or not np.isfinite(found).all():
        raise ModelError(f"{what} = {values!r}; give {n} finite numbers")
    return found


def _dimension(what: str, names: Sequence[str]) -> int:
    """Two or three, the number of names."""
    if isinstance(names, str) or len(names) not in (2, 3):
        raise ModelError(f"{what}: {names!r} are not two or three axes; give a sequence of their names")
    return len(names)


def _axes(what: str, axes: Sequence[str] | None, default: Sequence[str]) -> Sequence[str]:
    """Names of the axes, as many as the default."""
    if axes is None:
        return default
    if isinstance(axes, str) or len(axes) != len(default):
        raise ModelError(f"{what}: axes = {axes!r}; give {len(default)} names")
    return axes


def _column(symbols: Any, names: Sequence[str]) -> ca.SX:
    """Components by name as a column."""
    return ca.SX(ca.vertcat(*(symbols[name] for name in names)))


def _rotation(attitude: Attitude, at: _Arguments, n: int) -> ca.SX:
    """Rotation matrix ``(n, n)`` from the body to the world frame."""
    if callable(attitude):
        R = ca.SX(attitude(at.q, at.p))
        if R.shape != (n, n):
            raise ValueError(f"attitude returns a matrix {R.shape}, not {(n, n)}")
        return R
    if isinstance(attitude, str):
        if n != 2:
            raise ValueError(f"attitude {attitude!r} is a planar angle, but there are {n} axes")
        s, c = ca.sin(at.q[attitude]), ca.cos(at.q[attitude])
        return ca.SX(ca.vertcat(ca.horzcat(c, -s), ca.horzcat(s, c)))
    if len(attitude) != 4 or n != 3:
        raise ValueError(f"attitude {tuple(attitude)!r} is not a unit quaternion (w first) of three axes")
    w, x, y, z = (at.q[name] for name in attitude)
    rows = (
        ca.horzcat(1 - 2 * (y**2 + z**2), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x**2 + z**2), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)),
    )
    return ca.SX(ca.vertcat(*rows))
