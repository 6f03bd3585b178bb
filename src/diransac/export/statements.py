"""Expression graph of a function as assignments in C or Python.

Both languages share the names of arguments, `x[0]`, `u[1]`, `p[2]`, and of intermediate results, `w3`. A result that is
used once stands where it is used, as long as the line stays short; equal ones are computed once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from diransac.errors import ModelError
from diransac.model.expressions import OPERANDS
from diransac.simulation.compiler.graph import Graph, Instruction, read_graph


@dataclass(frozen=True)
class Dialect:
    """A language's texts for the operations of an expression graph.

    Parameters
    ----------
    name : str
        Name of the language in messages.
    forms : mapping of str to str
        Text of each operation, with operands in braces, by CasADi's name without ``OP_``.
    assignment : str
        Text of the definition of an intermediate result, with its name and value.
    not_finite : mapping of str to str
        Text of the numbers ``inf``, ``-inf`` and ``nan``.
    """

    name: str
    forms: Mapping[str, str]
    assignment: str
    not_finite: Mapping[str, str]

    def number(self, value: float) -> str:
        """The number itself, to the last bit."""
        return repr(value) if np.isfinite(value) else self.not_finite[repr(value)]

    def is_call(self, operation: str) -> bool:
        """True for the call of a function, which needs no parentheses around it or its operands."""
        return operation in _IN_C and not self.forms.get(operation, "(").startswith("(")

    def form(self, operation: str) -> str:
        """Text of an operation.  Raises ModelError: the language has none."""
        if operation not in self.forms:
            raise ModelError(
                f"the equations use {operation}, which {self.name} lacks; export to CasADi, or write it differently"
            )
        return self.forms[operation]


_ARITHMETIC = {
    "ASSIGN": "{0}",
    "LIFT": "{0}",
    "PRINTME": "{0}",
    "ADD": "{0} + {1}",
    "SUB": "{0} - {1}",
    "MUL": "{0} * {1}",
    "DIV": "{0} / {1}",
    "FMA": "{0} * {1} + {2}",
    "FMS": "{0} * {1} - {2}",
    "FNMA": "{2} - {0} * {1}",
    "NEG": "-{0}",
}
_COMPARISONS = {"LT": "<", "LE": "<=", "EQ": "==", "NE": "!="}
_IN_C = {
    **{name: name.lower() for name in ("SQRT", "FABS", "FLOOR", "CEIL", "EXP", "EXPM1", "LOG", "LOG1P", "ERF")},
    **{name: name.lower() for name in ("SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN")},
    **{name: name.lower() for name in ("SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH")},
    **{name: name.lower() for name in ("COPYSIGN", "FMIN", "FMAX", "FMOD", "REMAINDER", "HYPOT", "POW", "ATAN2")},
    "CONSTPOW": "pow",
}
"""Functions of C's ``math.h``."""
_IN_NUMPY = {
    "FABS": "abs",
    "POW": "power",
    "CONSTPOW": "power",
    **{name: f"arc{name[1:].lower()}" for name in ("ASIN", "ACOS", "ATAN", "ATAN2", "ASINH", "ACOSH", "ATANH")},
}
"""NumPy's functions where their names differ from those of C."""


def _call(function: str, operation: str) -> str:
    return f"{function}({{0}}, {{1}})" if OPERANDS[operation.lower()] == 2 else f"{function}({{0}})"


C = Dialect(
    "C",
    {
        **_ARITHMETIC,
        **{name: _call(function, name) for name, function in _IN_C.items()},
        **{name: f"(double)({{0}} {sign} {{1}})" for name, sign in _COMPARISONS.items()},
        "SIGN": "(double)(({0} > 0.0) - ({0} < 0.0))",
        "NOT": "(double)({0} == 0.0)",
        "AND": "(double)({0} != 0.0 && {1} != 0.0)",
        "OR": "(double)({0} != 0.0 || {1} != 0.0)",
        "IF_ELSE_ZERO": "({0} != 0.0 ? {1} : 0.0)",
    },
    "const double {} = {};",
    {"inf": "INFINITY", "-inf": "(-INFINITY)", "nan": "NAN"},
)
PYTHON = Dialect(
    "NumPy",
    {
        **_ARITHMETIC,
        **{n: _call(f"np.{_IN_NUMPY.get(n, f)}", n) for n, f in _IN_C.items() if n != "ERF"},
        **{name: f"1.0 * ({{0}} {sign} {{1}})" for name, sign in _COMPARISONS.items()},
        "SIGN": "np.sign({0})",
        "REMAINDER": "({0} - {1} * np.rint({0} / {1}))",
        "NOT": "1.0 * ({0} == 0.0)",
        "AND": "1.0 * (({0} != 0.0) & ({1} != 0.0))",
        "OR": "1.0 * (({0} != 0.0) | ({1} != 0.0))",
        "IF_ELSE_ZERO": "np.where({0} != 0.0, {1}, 0.0)",
    },
    "{} = {}",
    {"inf": "np.inf", "-inf": "(-np.inf)", "nan": "np.nan"},
)


def statements(function: ca.Function, arguments: Sequence[str], dialect: Dialect) -> tuple[list[str], list[str]]:
    """Assignments that compute a function, and the expression of each element of its first output.

    Parameters
    ----------
    function : CasADi SX function
        Its arguments are vectors.
    arguments : sequence of str
        Name of each argument, indexed in the text.
    dialect : Dialect

    Returns
    -------
    assignments, results : lists of str

    Raises
    ------
    ModelError
        An operation that the language, or the expression graph, does not have.
    """
    graph = read_graph(function)
    needed = graph.needed(graph.outputs[0])
    uses = Counter(k for position in needed for k in graph.instructions[position].operands)
    uses.update(graph.outputs[0])
    texts: dict[int, str] = {}
    lines = list(_assignments(graph, sorted(needed), uses, arguments, dialect, texts))
    return lines, [_bare(texts[k]) for k in graph.outputs[0]]


def _assignments(
    graph: Graph,
    needed: Sequence[int],
    uses: Mapping[int, int],
    arguments: Sequence[str],
    dialect: Dialect,
    texts: dict[int, str],
) -> Iterator[str]:
    """Definitions of the intermediate results; ``texts`` receives the text that stands for each instruction."""
    n_defined = 0
    for position in needed:
        instruction = graph.instructions[position]
        text, is_atom = _text(instruction, arguments, dialect, texts), instruction.operation in ("CONST", "INPUT")
        # Characters of an intermediate result that is written where it is used.
        if is_atom or (uses[position] == 1 and len(text) <= 70):
            texts[position] = text if is_atom or dialect.is_call(instruction.operation) else f"({text})"
        else:
            texts[position] = f"w{n_defined}"
            n_defined += 1
            yield dialect.assignment.format(texts[position], text)


def _text(instruction: Instruction, arguments: Sequence[str], dialect: Dialect, texts: Mapping[int, str]) -> str:
    """Text of an instruction."""
    if instruction.operation == "CONST":
        number = dialect.number(instruction.value)
        return f"({number})" if number.startswith("-") else number
    if instruction.operation == "INPUT":
        argument, element = instruction.source
        return f"{arguments[argument]}[{element}]"
    operands = [texts[k] for k in instruction.operands]
    if dialect.is_call(instruction.operation):
        operands = [_bare(text) for text in operands]
    return dialect.form(instruction.operation).format(*operands)


def _bare(text: str) -> str:
    """The text without parentheses that enclose all of it."""
    if not text.startswith("("):
        return text
    depth = 0
    for k, character in enumerate(text):
        depth += {"(": 1, ")": -1}.get(character, 0)
        if depth == 0:
            return text[1:-1] if k == len(text) - 1 else text
    return text
