"""The compiler from expression graphs to vector machine code."""

import math
import pickle
import subprocess
import sys
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from diransac.errors import ModelError, SettingsError
from diransac.simulation.compiler import Target, compile_map
from diransac.simulation.compiler.graph import read_graph
from diransac.simulation.compiler.operations import OPERATIONS
from rolling import ON_EVERY_TARGET

x, y, z = (ca.SX.sym(name) for name in "xyz")
UNARY = [
    "NEG",
    "EXP",
    "LOG",
    "SQRT",
    "SQ",
    "TWICE",
    "SIN",
    "COS",
    "TAN",
    "ASIN",
    "ACOS",
    "ATAN",
    "FLOOR",
    "CEIL",
    "NOT",
    "FABS",
    "SIGN",
    "ERF",
    "INV",
    "SINH",
    "COSH",
    "TANH",
]
BINARY = [
    "ADD",
    "SUB",
    "MUL",
    "DIV",
    "POW",
    "LT",
    "LE",
    "EQ",
    "NE",
    "AND",
    "OR",
    "FMOD",
    "COPYSIGN",
    "IF_ELSE_ZERO",
    "FMIN",
    "FMAX",
    "ATAN2",
    "HYPOT",
]


def operations_of(graph):
    """Names of what a graph computes for its outputs."""
    needed = graph.needed(k for row in graph.outputs for k in row)
    return sorted(graph.instructions[k].operation for k in needed if graph.instructions[k].operation != "INPUT")


def close(found, expected):
    """Within five units in the last place; NaN and infinities where they belong."""
    with np.errstate(all="ignore"):
        near = np.abs(found - expected) <= 5 * np.spacing(np.maximum(np.abs(expected), 2.0**-1022))
    return near | (found == expected) | (np.isnan(found) & np.isnan(expected))


# The graph -----------------------------------------------------------------------------------------------------------
def test_equal_expressions_are_computed_once():
    f = ca.Function("f", [x, y], [ca.sin(x * y) + ca.exp(ca.sin(x * y)), ca.cos(x * y)])
    assert operations_of(read_graph(f)).count("MUL") == 1
    assert operations_of(read_graph(f)).count("SIN") == 1


@pytest.mark.parametrize(
    ("expression", "fused"),
    [
        (x * y + z, ["FMA"]),
        (z + x * y, ["FMA"]),
        (x * y - z, ["FMS"]),
        (z - x * y, ["FNMA"]),
        (x * x + z, ["FMA"]),
        (2 * x + z, ["CONST", "FMA"]),
        (x * y + y * z, ["FMA", "MUL"]),
    ],
)
def test_a_product_is_fused_into_its_sum(expression, fused):
    assert operations_of(read_graph(ca.Function("f", [x, y, z], [expression]))) == fused


def test_a_sum_is_fused_alike_whatever_is_computed_beside_it():
    alone = read_graph(ca.Function("f", [x, y, z], [x * y + z]))
    beside = read_graph(ca.Function("f", [x, y, z], [x * y + z, x * y, x * y - y]))
    assert operations_of(alone) == ["FMA"]
    assert operations_of(beside) == ["FMA", "FMS", "MUL"]


def test_what_depends_on_invariant_inputs_alone_is_marked_and_kept_out_of_sums():
    graph = read_graph(ca.Function("f", [x, y], [x + ca.exp(2 * y) * y]), [1])
    assert operations_of(graph) == ["ADD", "CONST", "EXP", "MUL", "MUL"]
    marked = {graph.instructions[k].operation for k in range(len(graph.instructions)) if graph.invariant[k]}
    assert marked == {"INPUT", "CONST", "EXP", "MUL"}


def test_a_division_by_an_invariant_becomes_a_product_only_if_asked():
    f = ca.Function("f", [x, y], [x / y])
    assert operations_of(read_graph(f, [1])) == ["DIV"]
    assert operations_of(read_graph(f, [1], reciprocals=True)) == ["CONST", "DIV", "MUL"]
    assert operations_of(read_graph(f, [0], reciprocals=True)) == ["DIV"]


# Completeness --------------------------------------------------------------------------------------------------------
def elementary_functions():
    """An SX function for every operation that SX can hold, by name."""
    found = {}
    for name in dir(ca):
        if not name.startswith("OP_"):
            continue
        for make, operands in ((ca.SX.unary, (x,)), (ca.SX.binary, (x, y))):
            try:
                expression = make(getattr(ca, name), *operands)
            except RuntimeError:
                continue
            f = ca.Function("f", [x, y], [expression])
            if f.n_nodes() > 0 and not expression.is_constant():
                found[name, len(operands)] = f
    return found


def test_every_operation_that_sx_can_hold_is_compiled():
    functions = elementary_functions()
    assert len(functions) > 90
    for f in functions.values():
        compile_map(f)(np.ones((1, 1)), np.ones((1, 1)))


def test_the_table_holds_nothing_that_casadi_does_not_know():
    fused = {"FMA", "FMS", "FNMA"}
    assert all(hasattr(ca, f"OP_{name}") for name in OPERATIONS.keys() - fused)


def test_a_call_of_another_function_is_refused_by_name():
    inner = ca.Function("inner", [x], [ca.sin(x)], {"never_inline": True})
    outer = ca.Function("outer", [x], [inner(x) + 1])
    with pytest.raises(ModelError, match=r"'outer'.*CALL.*expand\(\)"):
        compile_map(outer)
    table = ca.interpolant("table", "linear", [[0.0, 1.0]], [0.0, 1.0])
    with pytest.raises(ModelError, match=r"'table'.*expand\(\)"):
        compile_map(table)


def test_a_symbol_that_is_no_argument_is_refused_by_name():
    f = ca.Function("f", [x], [x * y], {"allow_free": True})
    with pytest.raises(ModelError, match="y is a symbol that is none of its arguments"):
        compile_map(f)


# Values --------------------------------------------------------------------------------------------------------------
@st.composite
def graphs(draw):
    """Nodes of a random expression over three inputs, and for each the operation and operands that gave it."""
    nodes, origins = [x, y, z], [None] * 3
    for _ in range(draw(st.integers(1, 12))):
        name = draw(st.sampled_from(UNARY + BINARY))
        places = draw(st.lists(st.integers(0, len(nodes) - 1), min_size=2, max_size=2))[: 1 + (name in BINARY)]
        make = ca.SX.binary if name in BINARY else ca.SX.unary
        nodes.append(make(getattr(ca, f"OP_{name}"), *(nodes[k] for k in places)))
        origins.append((name, places))
    return nodes, origins


def within_a_fused_product(found, stepwise, k, origins):
    """Where a sum differs as it may if a product that it adds is not rounded first, and so does not overflow either."""
    operands = origins[k][1]
    with np.errstate(all="ignore"):
        size = np.abs(found[:, operands]).max(axis=1)
        near = np.abs(found[:, k] - stepwise) <= np.spacing(size)
    for j in operands:
        name, factors = origins[j] or ("", [])
        if name in ("MUL", "SQ", "TWICE"):
            near |= np.isinf(found[:, j]) & np.isfinite(found[:, factors]).all(axis=1)
    return near


@given(graphs(), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_every_node_of_a_random_graph_agrees_with_casadi(graph, seed):
    nodes, origins = graph
    rng = np.random.default_rng(seed)
    rows = np.concatenate(
        [rng.standard_normal((20, 3)), rng.choice([0, -0.0, 1, -2, np.inf, -np.inf, np.nan], (30, 3))]
    )
    f = ca.Function("f", [ca.vertcat(x, y, z)], [ca.vertcat(*nodes)])
    (found,) = compile_map(f)(rows)
    whole = np.array(f.map(len(rows))(rows.T)).T
    for k, origin in enumerate(origins[3:], 3):
        name, places = origin
        make = ca.SX.binary if name in BINARY else ca.SX.unary
        one = ca.Function("one", [x, y][: len(places)], [make(getattr(ca, f"OP_{name}"), *[x, y][: len(places)])])
        stepwise = np.array(one.map(len(rows))(*(found[:, j][None] for j in places))).ravel()
        # CasADi may have simplified the node (x - x is 0, even for NaN): then the whole expression is the judge.
        near = close(found[:, k], stepwise) | close(found[:, k], whole[:, k])
        if name in ("ADD", "SUB"):
            near |= within_a_fused_product(found, stepwise, k, origins)
        assert np.all(near), name


@st.composite
def polynomials(draw):
    """A random expression of sums, differences and products over three inputs, as SX and as a function of numbers."""
    nodes = [(x, lambda v: v[0]), (y, lambda v: v[1]), (z, lambda v: v[2])]
    for _ in range(draw(st.integers(2, 8))):
        (a, f), (b, g) = (nodes[draw(st.integers(0, len(nodes) - 1))] for _ in range(2))
        sign = draw(st.sampled_from("+-*"))
        if sign == "+":
            nodes.append((a + b, lambda v, f=f, g=g: f(v) + g(v)))
        elif sign == "-":
            nodes.append((a - b, lambda v, f=f, g=g: f(v) - g(v)))
        else:
            nodes.append((a * b, lambda v, f=f, g=g: f(v) * g(v)))
    return nodes[-1]


class Size(Fraction):
    """A number whose differences are sums: how large rounding errors can be."""

    def __add__(self, other):
        return Size(Fraction.__add__(self, other))

    def __mul__(self, other):
        return Size(Fraction.__mul__(self, other))

    __sub__ = __add__


@given(polynomials(), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_fused_sums_stay_within_the_rounding_of_exact_arithmetic(polynomial, seed):
    expression, exact = polynomial
    rows = np.random.default_rng(seed).standard_normal((9, 3))
    f = ca.Function("f", [ca.vertcat(x, y, z)], [expression])
    (found,) = compile_map(f)(rows)
    for row, value in zip(rows, found.ravel(), strict=True):
        bound = exact([Size(abs(Fraction(v))) for v in row]) * Fraction(2 * 300, 2**53)
        assert abs(Fraction(value) - exact([Fraction(v) for v in row])) <= bound


def test_the_fused_product_is_rounded_once():
    a = 1 + 2.0**-30
    f = ca.Function("f", [x, y, z], [x * y - z])
    (found,) = compile_map(f)(*np.full((3, 1, 1), a) * [[[1]], [[1]], [[a]]])
    assert found[0, 0] == float(Fraction(a) * Fraction(a) - Fraction(a * a)) != 0.0


def test_a_branch_not_taken_does_not_leak_its_nan():
    f = ca.Function("f", [x], [ca.if_else(x > 0, ca.log(x), ca.sqrt(-x))])
    (found,) = compile_map(f)(np.array([[1.0], [-4.0], [0.0], [math.e]]))
    np.testing.assert_allclose(found.ravel(), [0.0, 2.0, 0.0, 1.0], rtol=1e-15)


# The map over rows ---------------------------------------------------------------------------------------------------
def regressor():
    q, p = ca.SX.sym("q", 3), ca.SX.sym("p", 2)
    return ca.Function("w", [q, p], [ca.diag(q) * p[0], q / p[1] + ca.sin(q[0]), ca.SX(2, 2)])


def test_every_run_of_a_prepared_map_reads_its_arrays():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    f = compile_map(ca.Function("f", [x, y], [ca.sin(x[0]) * y + x[1], y / x[1]]))
    rng = np.random.default_rng(3)
    rows, shared = rng.uniform(1.0, 2.0, (11, 2)), rng.uniform(1.0, 2.0, 1)
    prepared = f.prepare(rows, shared)
    for _ in range(2):
        rows[:], shared[:] = rng.uniform(1.0, 2.0, (11, 2)), rng.uniform(1.0, 2.0)
        for found, expected in zip(prepared.run(), f(rows, shared), strict=True):
            np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("n_rows", [0, 1, 7, 8, 9, 1000])
def test_map_gives_dense_outputs_of_every_row(n_rows):
    f = regressor()
    rng = np.random.default_rng(0)
    q, p = rng.standard_normal((n_rows, 3)), rng.standard_normal((n_rows, 2))
    found = compile_map(f)(q, p)
    assert [output.shape for output in found] == [(n_rows, 9), (n_rows, 3), (n_rows, 4)]
    for row in range(n_rows):
        for output, expected in zip(found, f(q[row], p[row]), strict=True):
            np.testing.assert_allclose(output[row], np.array(expected.full()).ravel(order="F"), rtol=1e-15, atol=1e-15)


def test_map_takes_inputs_that_all_rows_share():
    f = regressor()
    rng = np.random.default_rng(1)
    q, p = rng.standard_normal((100, 3)), rng.standard_normal(2)
    for shared, repeated in zip(compile_map(f)(q, p), compile_map(f)(q, np.tile(p, (100, 1))), strict=True):
        np.testing.assert_allclose(shared, repeated, rtol=1e-15)
    assert compile_map(f)(q[0], p)[0].shape == (1, 9)


@ON_EVERY_TARGET
def test_map_gives_the_same_bits_for_any_batch_threads_and_target(target):
    f = ca.Function("f", [ca.vertcat(x, y, z)], [ca.sin(x * y) / (1 + z * z) + ca.exp(-x) * y - ca.tanh(z) ** 3.3])
    rows = np.random.default_rng(2).standard_normal((1003, 3))
    (expected,) = compile_map(f)(rows)
    (found,) = compile_map(f, target)(rows, threads=2)
    np.testing.assert_array_equal(found, expected)
    for start, stop in ((0, 1), (5, 6), (3, 500)):
        np.testing.assert_array_equal(compile_map(f, target)(rows[start:stop])[0], expected[start:stop])


def test_map_of_an_equal_function_is_compiled_once():
    assert compile_map(regressor()) is compile_map(regressor())


def test_map_says_which_shapes_it_wants():
    f = compile_map(regressor())
    with pytest.raises(SettingsError, match="takes 2 arrays; found 1"):
        f(np.zeros((4, 3)))
    with pytest.raises(SettingsError, match=r"n = \[3, 2\].*found \[\(4, 2\), \(2,\)\]"):
        f(np.zeros((4, 2)), np.zeros(2))
    with pytest.raises(SettingsError, match="one n_rows"):
        f(np.zeros((4, 3)), np.zeros((5, 2)))
    with pytest.raises(SettingsError, match="threads is 0"):
        f(np.zeros((4, 3)), np.zeros((4, 2)), threads=0)


def test_map_leaves_its_inputs_alone():
    q, p = np.ones((9, 3)), np.ones(2)
    q.flags.writeable = p.flags.writeable = False
    compile_map(regressor())(q, p)
    np.testing.assert_array_equal(q, 1.0)


def test_importing_the_kernel_does_not_load_llvm():
    code = "import sys, diransac.simulation.compiler, diransac.simulation; sys.exit('llvmlite' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_target_survives_pickling():
    target = Target("haswell", "+avx2")
    assert pickle.loads(pickle.dumps(target)) == target
