"""Expression graphs of SX functions: walked, and stored as plain data.

The data of a function are arguments with their sizes, a list of operations, and for each result the operations that
give its elements. An operation is a line of text with its own number, a word, and what the word applies to::

    {"version": 1, "arguments": {"q": 1, "v": 1, "a": 1, "u": 1, "p": 2},
     "operations": ["0 = p 0", "1 = a 0", "2 = mul 0 1", "3 = u 0", "4 = sub 2 3"],
     "results": {"r": [4]}}

``p 0`` is the first element of the argument ``p``, ``const 9.81`` a number, ``mul 0 1`` the product of the results of
lines 0 and 1. Operations refer to earlier lines only, and their words are those of a fixed list: data can describe an
expression, and nothing else. Elements of a result that are structurally zero are null. Numbers have the digits that
restore all of their bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from math import isfinite, isnan
from typing import Any, NamedTuple

import casadi as ca

from diransac.errors import ModelError, ResultError
from diransac.limits import MOST_OPERATIONS, beyond

_VERSION = 1


# fmt: off
OPERANDS = {**dict.fromkeys((
    "neg", "sqrt", "sq", "twice", "inv", "fabs", "floor", "ceil", "sign", "not", "exp", "expm1", "log", "log1p", "sinh",
    "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "erfinv", "sin", "cos", "tan", "asin", "acos", "atan",
), 1), **dict.fromkeys((
    "add", "sub", "mul", "div", "copysign", "fmin", "fmax", "fmod", "remainder", "hypot", "lt", "le", "eq", "ne", "and",
    "or", "if_else_zero", "pow", "constpow", "atan2",
), 2)}
# fmt: on
"""Number of operands of each operation that equations may have."""

_SAME = ("assign", "lift", "printme")
"""Operations whose value is their first operand."""


class Step(NamedTuple):
    """One instruction of an SX function, by the values that it uses instead of registers.

    Attributes
    ----------
    operation : str
        CasADi's name without ``OP_``, in lower case.
    operands : tuple of int
        Positions of the steps whose values it takes.
    place : (int, int)
        Of ``input`` and ``output``: argument or result, and its structural non-zero; (-1, -1) for others.
    constant : float
        Of ``const``.
    """

    operation: str
    operands: tuple[int, ...] = ()
    place: tuple[int, int] = (-1, -1)
    constant: float = 0.0


@cache
def _names() -> dict[int, str]:
    """CasADi's names of its operations by their codes."""
    return {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}


def steps(function: ca.Function) -> Iterator[Step]:
    """Instructions of an SX function in its order.

    Parameters
    ----------
    function : casadi.Function
        Of SX expressions.

    Yields
    ------
    Step
    """
    names, register = _names(), dict[int, int]()
    for k in range(function.n_instructions()):
        name = names[function.instruction_id(k)]
        sources, targets = function.instruction_input(k), function.instruction_output(k)
        if name == "output":
            yield Step(name, (register[sources[0]],), (targets[0], targets[1]))
            continue
        if name == "input":
            step = Step(name, place=(sources[0], sources[1]))
        elif name == "const":
            step = Step(name, constant=function.instruction_constant(k))
        else:
            step = Step(name, tuple(register.get(i, -1) for i in sources))
        yield step
        register.update(dict.fromkeys(targets, k))


def check_size(label: str, function: ca.Function) -> None:
    """Raises ModelError: a function has more operations than a model may have."""
    n = function.n_instructions()
    if n > MOST_OPERATIONS:
        raise ModelError(
            f"{label}: the equations have {beyond(MOST_OPERATIONS, 'operations', n)}. Simplify them, or split the "
            "machine into independent parts"
        )


def has_nan(function: ca.Function) -> bool:
    """True if a constant of an SX function is NaN."""
    constants = (k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_CONST)
    return any(isnan(function.instruction_constant(k)) for k in constants)


# ---------------------------------------------------------------------- data


def stored(label: str, function: ca.Function) -> dict[str, Any]:
    """An SX function as data that JSON can hold; `restored` makes the function again.

    Parameters
    ----------
    label : str
        Of the model, for messages.
    function : casadi.Function
        Its arguments and results are columns.

    Raises
    ------
    ModelError
        The function calls another, holds an infinite constant, or is too large.
    """
    check_size(label, function)
    arguments = {function.name_in(i): function.numel_in(i) for i in range(function.n_in())}
    results = {function.name_out(i): [None] * function.numel_out(i) for i in range(function.n_out())}
    names, columns = list(arguments), list(results.values())
    rows_out = [function.sparsity_out(i).row() for i in range(function.n_out())]
    lines, position = list[str](), list[int]()
    for step in steps(function):
        position.append(len(lines))
        operands = [position[k] for k in step.operands if k >= 0]
        if step.operation == "output":
            columns[step.place[0]][rows_out[step.place[0]][step.place[1]]] = operands[0]  # type: ignore[call-overload]
        elif step.operation in _SAME:
            position[-1] = operands[0]
        elif step.operation == "input":
            lines.append(f"{len(lines)} = {names[step.place[0]]} {step.place[1]}")
        elif step.operation == "const":
            lines.append(f"{len(lines)} = const {_number(label, step.constant)}")
        else:
            lines.append(f"{len(lines)} = {_word(label, step.operation)} {' '.join(map(str, operands))}")
    return {"version": _VERSION, "arguments": arguments, "operations": lines, "results": results}


def _number(label: str, value: float) -> str:
    """Digits of a constant.  Raises ModelError: it is infinite or NaN."""
    if not isfinite(value):
        raise ModelError(f"{label}: the equations are not finite: they hold the constant {value}; leave it out")
    return repr(value)


def _word(label: str, operation: str) -> str:
    """The operation itself.  Raises ModelError: it is not in the list."""
    if operation in OPERANDS:
        return operation
    if operation == "call":
        raise ModelError(
            f"{label}: the equations call another function, an interpolant or external code for example; a model "
            "consists of expressions: write the function as one, or expand it: Function.expand()"
        )
    raise ModelError(f"{label}: the equations hold the operation {operation}, which a model cannot; write it otherwise")


def restored(name: str, data: object, arguments: Mapping[str, int], results: Mapping[str, int]) -> ca.Function:
    """SX function from the data that `stored` returned. Nothing but arithmetic on symbols is done with them.

    Parameters
    ----------
    name : str
        Of the function.
    data : object
        Decoded JSON, from any source.
    arguments, results : mapping of str to int
        Sizes that the function must have.

    Raises
    ------
    ResultError
        The data are of another version, or damaged.
    """
    lines = _checked(data, arguments, results)
    symbols = {argument: ca.SX.sym(argument, size) for argument, size in arguments.items()}
    elements = {argument: ca.vertsplit(symbol) if symbol.numel() else [] for argument, symbol in symbols.items()}
    values = list[ca.SX]()
    try:
        for line in lines:
            values.append(_value(line, values, elements))
        columns = [_column(data["results"][result], values) for result in results]  # type: ignore[index]  # checked
    except (ValueError, IndexError, KeyError, TypeError) as error:
        raise ResultError(f"the stored equations are damaged at operation {len(values)}; identify again") from error
    return ca.Function(name, list(symbols.values()), columns, list(arguments), list(results))


def _checked(data: object, arguments: Mapping[str, int], results: Mapping[str, int]) -> list[str]:
    """The lines of a function's data.  Raises ResultError: its parts are not those of such a function."""
    if isinstance(data, str):
        raise ResultError("the equations are stored as an earlier version did, as CasADi's code; identify again")
    if not isinstance(data, Mapping) or data.get("version") != _VERSION:
        raise ResultError(f"the equations are stored in a form other than {_VERSION}, this version's; identify again")
    lines, found = data.get("operations"), data.get("results")
    if data.get("arguments") != dict(arguments) or not isinstance(found, Mapping) or list(found) != list(results):
        raise ResultError("the stored equations are damaged: they have other arguments or results; identify again")
    if any(not isinstance(found[name], list) or len(found[name]) != size for name, size in results.items()):
        raise ResultError("the stored equations are damaged: results are of another size; identify again")
    if not isinstance(lines, list) or len(lines) > MOST_OPERATIONS:
        raise ResultError(f"the stored equations are no list of up to {MOST_OPERATIONS} operations; identify again")
    # Characters of the longest line of data.
    if not all(isinstance(line, str) and len(line) <= 80 and line.isascii() for line in lines):
        raise ResultError("the stored equations are damaged: an operation is no short text; identify again")
    return lines


def _value(line: str, values: Sequence[ca.SX], elements: Mapping[str, Sequence[ca.SX]]) -> ca.SX:
    """Expression of one line.  Raises ValueError, IndexError, KeyError: it is no line of this place."""
    number, equals, word, *operands = line.split(" ")
    if equals != "=" or number != str(len(values)):
        raise ValueError(line)
    if word == "const":
        (text,) = operands
        constant = float(text)
        if not isfinite(constant):
            raise ValueError(line)
        return ca.SX(constant)
    if word in elements:
        (text,) = operands
        return elements[word][_index(text)]
    if len(operands) != OPERANDS[word]:
        raise ValueError(line)
    return applied(word, *(values[_index(text)] for text in operands))


def applied(operation: str, *operands: ca.SX) -> ca.SX:
    """Expression of an operation of the list."""
    return (ca.SX.unary if len(operands) == 1 else ca.SX.binary)(_code(operation), *operands)


@cache
def _code(operation: str) -> int:
    """CasADi's number of an operation."""
    return int(getattr(ca, f"OP_{operation.upper()}"))


def _index(text: str) -> int:
    # Digits of the largest index; longer ones are refused before they are converted.
    if not text.isdigit() or len(text) > 12:
        raise ValueError(text)
    return int(text)


def _column(places: Sequence[object], values: Sequence[ca.SX]) -> ca.SX:
    """A result; null is a structural zero.  Raises TypeError, IndexError: a place is no line."""
    column = ca.SX(len(places), 1)
    for row, place in enumerate(places):
        if place is not None:
            if type(place) is not int or place < 0:
                raise TypeError(place)
            column[row] = values[place]
    return column


# ---------------------------------------------------------------------- text


def printed(
    function: ca.Function, arguments: Mapping[str, Sequence[str]], first: int = 1
) -> tuple[list[str], list[str]]:
    """Elements of a function's results as text, and the parts that they refer to by ``#1``, ``#2``, ...

    Parameters
    ----------
    function : casadi.Function
    arguments : mapping of str to sequence of str
        Names of the elements of each argument.
    first : int, optional
        Number of the first part.

    Returns
    -------
    parts : list of str
        ``#1 = ...``, of expressions that are too deep for one text; CasADi prints by recursion.
    elements : list of str
    """
    names = [list(arguments[function.name_in(i)]) for i in range(function.n_in())]
    parts, elements = list[str](), [["0"] * function.numel_out(i) for i in range(function.n_out())]
    rows_out = [function.sparsity_out(i).row() for i in range(function.n_out())]
    values, depths = list[ca.SX](), list[int]()
    for step in steps(function):
        operands = [values[k] for k in step.operands]
        depth = 1 + max((depths[k] for k in step.operands), default=0)
        if step.operation == "output":
            elements[step.place[0]][rows_out[step.place[0]][step.place[1]]] = str(operands[0])
            value = operands[0]
        elif step.operation == "input":
            value = ca.SX.sym(names[step.place[0]][step.place[1]])
        elif step.operation == "const":
            value = ca.SX(step.constant)
        elif step.operation in _SAME:
            value = operands[0]
        else:
            value = applied(step.operation, *operands)
        # Nested operations of a printed expression; deeper ones are printed in several pieces.
        if depth > 150 and step.operation != "output":
            part = f"#{first + len(parts)}"
            parts.append(f"{part} = {value}")
            value, depth = ca.SX.sym(part), 0
        values.append(value)
        depths.append(depth)
    return parts, [text for column in elements for text in column]
