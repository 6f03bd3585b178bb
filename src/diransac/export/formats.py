"""Files of an identified model, one function per format."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from diransac.atomic import write_text, write_with
from diransac.errors import ModelError, SettingsError
from diransac.export.portable import PortableModel
from diransac.export.statements import PYTHON, C, statements
from diransac.plain_text import comment, literal

FORMATS = {
    "c": (".c",),
    "python": (".py",),
    "casadi": (".casadi",),
    "yaml": (".yaml", ".yml"),
    "mjcf": (".xml", ".mjcf"),
    "urdf": (".urdf", ".xml"),
}
"""Endings of the files of each format; the last two are a robot's description with the estimates in it."""


def format_of(path: str | Path, to: str | None = None) -> str:
    """Format of a file to write, by name or by its ending.

    Parameters
    ----------
    path : str or Path
    to : str, optional
        Name of the format; None: by the ending.

    Raises
    ------
    SettingsError
        There is no such format, or the ending is that of another one.
    """
    known = ", ".join(f"{name} ({' or '.join(endings)})" for name, endings in FORMATS.items())
    ending = Path(path).suffix.lower()
    of_ending = [name for name, endings in FORMATS.items() if ending in endings]
    if to is None:
        if not of_ending:
            raise SettingsError(f'"{path}": a model is not exported to "{ending}"; there are {known}')
        return of_ending[0]
    if to == "sdf":
        raise SettingsError(
            "SDF is not written: its joints have no armature, and models are not read from it; export to mjcf or urdf"
        )
    if to not in FORMATS:
        raise SettingsError(f'a model is not exported to "{to}"; there are {known}')
    if of_ending and to not in of_ending:
        raise SettingsError(f'"{path}": {ending} is the ending of {of_ending[0]}, not of {to}; give one of the two')
    return to


def write_model(model: PortableModel, path: str | Path, to: str) -> None:
    """Write a model whole or not at all.

    Parameters
    ----------
    model : PortableModel
    path : str or Path
    to : str
        "c", "python", "casadi" or "yaml".

    Raises
    ------
    ModelError
        The format lacks an operation of the equations.
    OSError
        The file cannot be written.
    """
    if to == "casadi":
        function = casadi_function(model)
        write_with(path, lambda temporary: _save(function, temporary))
    else:
        text_of = {"c": c_source, "python": python_source, "yaml": yaml_document}[to]
        write_text(path, text_of(model))


def _save(function: ca.Function, path: Path) -> None:
    """Write a function, and read it back: CasADi reports nothing where the disk is full.  Raises OSError."""
    function.save(str(path))
    try:
        is_whole = ca.Function.load(str(path)).serialize() == function.serialize()
    except RuntimeError:
        is_whole = False
    if not is_whole:
        raise OSError(errno.EIO, "CasADi could not write the whole function; is the disk full?")


# ---------------------------------------------------------------------- C


def c_source(model: PortableModel) -> str:
    """Standalone C99 source of the state derivative and of a step; it needs ``math.h`` alone."""
    name, n_x, n_u, n_p = model.identifier, len(model.model.state), model.model.n_u, model.model.n_p
    state, inputs = f"const double x[{n_x}]", f"const double u[{max(1, n_u)}]"
    definitions, results = statements(model.model.dynamics, ("x", "u", "p"), C)
    values = [f"    {C.number(value)}, /* {comment(parameter)} */" for parameter, value in model.parameters.items()]
    unused = [] if n_u and any("u[" in line for line in (*definitions, *results)) else ["    (void)u;"]
    body = [
        *_comment(model.description()),
        "#include <math.h>",
        "",
        f"const double {name}_parameters[{n_p}] = {{",
        *values,
        "};",
        "",
        "/* State derivative x_dot for given parameters p. */",
        f"void {name}_derivative_of({state}, {inputs}, const double p[{n_p}], double x_dot[{n_x}])",
        "{",
        *unused,
        *(f"    {line}" for line in definitions),
        *(f"    x_dot[{k}] = {text};" for k, text in enumerate(results)),
        "}",
        "",
        "/* State derivative x_dot for the estimated parameters. */",
        f"void {name}_derivative({state}, {inputs}, double x_dot[{n_x}])",
        "{",
        f"    {name}_derivative_of(x, u, {name}_parameters, x_dot);",
        "}",
        "",
        "/* State after dt seconds with constant inputs: one classical Runge-Kutta step. x_next may be x. */",
        f"void {name}_step({state}, {inputs}, double dt, double x_next[{n_x}])",
        "{",
        *_step_in_c(model),
        "}",
        "",
    ]
    return "\n".join(body)


def _comment(lines: Iterator[str]) -> list[str]:
    """A block comment."""
    return ["/*", *(f" * {comment(line)}".rstrip() for line in lines), " */"]


def _step_in_c(model: PortableModel) -> Iterator[str]:
    n_x, name = len(model.model.state), model.identifier
    yield f"    double k1[{n_x}], k2[{n_x}], k3[{n_x}], k4[{n_x}], moved[{n_x}];"
    yield "    int i;"
    yield f"    {name}_derivative(x, u, k1);"
    for slope, following, fraction in (("k1", "k2", "0.5 * dt"), ("k2", "k3", "0.5 * dt"), ("k3", "k4", "dt")):
        yield f"    for (i = 0; i < {n_x}; ++i) moved[i] = x[i] + {fraction} * {slope}[i];"
        yield f"    {name}_derivative(moved, u, {following});"
    yield f"    for (i = 0; i < {n_x}; ++i)"
    yield "        x_next[i] = x[i] + dt / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i]);"
    for four in model.model.quaternions:
        squares = " + ".join(f"x_next[{k}] * x_next[{k}]" for k in four)
        yield "    {"
        yield f"        const double norm = sqrt({squares});"
        yield from (f"        x_next[{k}] /= norm;" for k in four)
        yield "    }"


# ---------------------------------------------------------------------- Python

_PYTHON = '''\
"""{description}
"""

import numpy as np

STATES = {states}
INPUTS = {inputs}
PARAMETERS = {{
{parameters}
}}


@np.errstate(divide="ignore", invalid="ignore")
def derivative(state, inputs, parameters=PARAMETERS):
    """Derivative of the state.

    Parameters
    ----------
    state : (..., {n_x}) array
    inputs : (..., {n_u}) array
    parameters : mapping of str to float or (...) array

    Returns
    -------
    (..., {n_x}) array
    """
    x, u = (np.moveaxis(np.asarray(values, dtype=float), -1, 0) for values in (state, inputs))
    p = [np.asarray(parameters[name], dtype=float) for name in PARAMETERS]
{definitions}    rates = (
{results}
    )
    return np.stack(np.broadcast_arrays(*rates, x[0], *u, *p)[:{n_x}], axis=-1)


def step(state, inputs, dt, parameters=PARAMETERS):
    """State after dt seconds with constant inputs: one classical Runge-Kutta step."""
    state = np.asarray(state, dtype=float)
    k1 = derivative(state, inputs, parameters)
    k2 = derivative(state + 0.5 * dt * k1, inputs, parameters)
    k3 = derivative(state + 0.5 * dt * k2, inputs, parameters)
    k4 = derivative(state + dt * k3, inputs, parameters)
{end}
'''
_NORMALISED = """\
    following = state + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    for four in {quaternions}:
        following[..., four] /= np.linalg.norm(following[..., four], axis=-1, keepdims=True)
    return following"""


def python_source(model: PortableModel) -> str:
    """Python module of the state derivative and of a step, vectorised over leading axes; it needs NumPy alone."""
    definitions, results = statements(model.model.dynamics, ("x", "u", "p"), PYTHON)
    quaternions = [list(four) for four in model.model.quaternions]
    plain = "    return state + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)"
    return _PYTHON.format(
        description="\n".join(map(comment, model.description())),
        states=_flow(list(model.model.state)),
        inputs=_flow(list(model.model.inputs)),
        parameters="\n".join(f"    {literal(n)}: {PYTHON.number(x)}," for n, x in model.parameters.items()),
        n_x=len(model.model.state),
        n_u=model.model.n_u,
        definitions="".join(f"    {line}\n" for line in definitions),
        results="\n".join(f"        {text}," for text in results),
        end=_NORMALISED.format(quaternions=quaternions) if quaternions else plain,
    )


# ---------------------------------------------------------------------- CasADi


def casadi_function(model: PortableModel) -> ca.Function:
    """Function ``(state, inputs, NAME=estimate, ...) -> derivative``, an argument for each parameter."""
    x, u = ca.SX.sym("x", len(model.model.state)), ca.SX.sym("u", model.model.n_u)
    taken = [name for name in ("state", "inputs", "derivative") if name in model.parameters]
    if taken:
        raise ModelError(
            f"a parameter is named {taken[0]}, as an argument or the result of the CasADi function is; rename it"
        )
    p = [ca.SX.sym(name) for name in model.parameters]
    return ca.Function(
        model.identifier,
        [x, u, *p],
        [model.model.dynamics(x, u, ca.vertcat(*p))[0]],
        ["state", "inputs", *model.parameters],
        ["derivative"],
        {"default_in": [0.0, 0.0, *model.parameters.values()]},
    )


# ---------------------------------------------------------------------- YAML


def yaml_document(model: PortableModel) -> str:
    """Names, units, estimates, covariance and draws of the parameters, and the timing of the inputs, as YAML 1.2."""
    units, values = model.model.units, model.parameters
    document = {
        "model": model.model.name,
        "written_by": model.version,
        "states": {name: units[name] for name in model.model.state},
        "inputs": {name: units[name] for name in model.model.inputs},
        "input_timing": {
            "hold": model.hold,
            "delay_s": model.input_delays or dict.fromkeys(model.model.inputs, 0.0),
            "lag_s": model.input_lags or dict.fromkeys(model.model.inputs, 0.0),
        },
        "parameters": {name: _estimate(model, name) for name in values},
        "covariance": dict(zip(values, model.covariance.tolist(), strict=True)),
        "samples": {name: draws.tolist() for name, draws in model.samples.items()},
    }
    return "\n".join([*(f"# {comment(line)}".rstrip() for line in model.remarks), *_yaml(document, ""), ""])


def _estimate(model: PortableModel, name: str) -> dict[str, Any]:
    """Estimate of a parameter, its standard error, unit and bounds."""
    about = model.model.parameters[name]
    return {
        "value": model.parameters[name],
        "standard_error": model.standard_errors[name],
        **({"interval_95": list(model.intervals[name])} if name in model.intervals else {}),
        **(
            {"interval_95_if_a_term_is_missing": list(model.structural_intervals[name])}
            if name in model.structural_intervals
            else {}
        ),
        "unit": about.unit,
        "lower": max(about.lower, 0.0) if about.positive else about.lower,
        "upper": about.upper,
        **({"per_log": list(model.per_log[name])} if name in model.per_log else {}),
        **({"sensor_only": True} if name in model.of_sensors else {}),
    }


def _yaml(mapping: dict[str, Any], indent: str) -> Iterator[str]:
    """Lines of a mapping in block style; lists in flow style."""
    for key, value in mapping.items():
        name = literal(key)
        # Characters of a key that needs no mark; YAML has 1024.
        begin = f"{name}:" if len(name) <= 1000 else f"? {name}\n{indent}:"
        if isinstance(value, dict) and value:
            yield f"{indent}{begin}"
            yield from _yaml(value, indent + "  ")
        else:
            yield f"{indent}{begin} {_flow(value)}"


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{}"
    return f"[{', '.join(map(_scalar, value))}]" if isinstance(value, list) else _scalar(value)


def _scalar(value: Any) -> str:
    """YAML's text of a text or number."""
    if isinstance(value, float):
        if not np.isfinite(value):
            return ".nan" if np.isnan(value) else f"{'-' if value < 0 else ''}.inf"
        mantissa, exponent, power = repr(value).partition("e")
        point = "" if "." in mantissa or not exponent else ".0"  # without it, YAML 1.1 reads 1e-05 as text
        return f"{mantissa}{point}{exponent}{power}"
    return literal(value) if isinstance(value, str) else str(value).lower()
