"""Where a time loop's inputs come from: the log, or a feedback law."""

from __future__ import annotations

from typing import TYPE_CHECKING

from diransac.simulation.compiler.vectors import DOUBLE, Value, integer

if TYPE_CHECKING:
    from diransac.simulation.compiler.time_loop import Block, TimeLoop

__all__ = ["fed_back", "fed_back_alike", "held"]


def held(loop: TimeLoop, block: Block, row: Value) -> list[Value]:
    """Emit the log's inputs at a row."""
    return loop.logged("inputs", loop.plan.n_inputs, block, row)


def fed_back(loop: TimeLoop, block: Block, row: Value) -> list[Value]:
    """Emit the inputs of a law of its own for each lane."""
    rows = [loop.builder.add(start, row) for start in loop.whole_numbers("law_starts", block.first)]
    return _law_inputs(loop, [loop.v.join(column) for column in _columns(loop, rows)])


def fed_back_alike(loop: TimeLoop, _block: Block, row: Value) -> list[Value]:
    """Emit the inputs of one law, at the same row for all lanes."""
    return _law_inputs(loop, [loop.v.splat(*column) for column in _columns(loop, [row])])


def _columns(loop: TimeLoop, rows: list[Value]) -> list[list[Value]]:
    """Numbers of the laws' rows, column by column: u_ref, x_ref, and the gains row by row."""
    n_u, n_x = loop.plan.n_inputs, loop.plan.n_states
    width = n_u + n_x + n_u * n_x
    return [[loop.v.element(loop.arguments["laws"], at, width, k, DOUBLE) for at in rows] for k in range(width)]


def _law_inputs(loop: TimeLoop, law: list[Value]) -> list[Value]:
    """clip(u_ref - K (x - x_ref)); the state's quaternions first take the sign that is nearer to the reference's."""
    v, n_u, n_x = loop.v, loop.plan.n_inputs, loop.plan.n_states
    u_ref, x_ref, gains = law[:n_u], law[n_u : n_u + n_x], law[n_u + n_x :]
    x = [v.get(cell) for cell in loop.state]
    for four in loop.plan.state_quaternions:
        x, _ = v.turned_towards(x, x_ref, four)
    errors = [v.sub(a, b) for a, b in zip(x, x_ref, strict=True)]
    inputs = []
    for k, u in enumerate(u_ref):
        for gain, error in zip(gains[k * n_x : (k + 1) * n_x], errors, strict=True):
            u = v.fma(v.neg(gain), error, u)
        lowest, highest = (v.splat(v.load(loop.arguments["limits"], integer(k + at), DOUBLE)) for at in (0, n_u))
        inputs.append(v.smaller(v.larger(u, lowest), highest))
    return inputs
