"""Elimination of block-tridiagonal systems, emitted.

Blocks are eliminated from the first to the last, ``F_w = D_w - E_{w-1} Y_{w-1}`` with ``Y_w = F_w^-1 E_w'``; then
solutions and blocks of the inverse follow from the last to the first: ``X_w = F_w^-1 R_w - Y_w X_{w+1}`` and
``S_w = F_w^-1 + Y_w S_{w+1} Y_w'``.  A block is inverted in its place by Gauss-Jordan elimination without exchanges of
rows, which is stable for positive definite matrices.  Sizes are arguments: one function serves all systems.

References
----------
Higham 2002, "Accuracy and stability of numerical algorithms", chapter 14; Takahashi, Fagan, Chen 1973 (selected
inverse).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from llvmlite import ir

from diransac.simulation.compiler.machine_code import LANES, signature
from diransac.simulation.compiler.vectors import DOUBLE, NUMBERS, Value, Vectors, integer, new_function


def emit_block_elimination() -> Value:
    """LLVM module with one function, `solve_blocks`.

    Its arguments are the arrays `blocks` (n, k, 2 padded_k + padded_c), `below` (n - 1, k, k), `inverse_below`
    (n - 1, padded_k, padded_k) and `pivots` (n, k), and the sizes n, k, padded_k and padded_c.  A row of a block has
    those of D_w, E_w' and R_w beside each other, padded by zeros to whole vectors, which S_w, Y_w and X_w replace.
    `inverse_below` is zero at first; `pivots` are the least that are admitted, which the pivots replace.
    """
    function = new_function("solve_blocks", signature(4, 4))
    emitter = _Emitter(Vectors(function), *function.args)
    with emitter.v.repeat(integer(0), emitter.n) as block:
        emitter.eliminate(block.index)
        emitter.invert(block.index)
    with emitter.v.repeat(integer(0), emitter.n) as counter:
        emitter.substitute(emitter.b.sub(emitter.b.sub(emitter.n, integer(1)), counter.index))
    emitter.b.ret_void()
    return function.module


@dataclass(frozen=True)
class _Emitter:
    """Emitter of the steps of one block; arguments of the function."""

    v: Vectors
    blocks: Value
    below: Value
    inverse_below: Value
    pivots: Value
    n: Value
    k: Value
    padded_k: Value
    padded_c: Value

    @property
    def b(self) -> Value:
        """LLVM's builder."""
        return self.v.builder

    def eliminate(self, w: Value) -> None:
        """Emit ``F_w = D_w - E Y`` and ``R_w - E X`` with the block before, where there is one."""
        b, v = self.b, self.v
        with b.if_then(b.icmp_signed(">", w, integer(0))):
            before = b.sub(w, integer(1))
            with self._rows() as i, self._rows() as j:
                factor = v.load(self.below, b.add(self._place(before, i, self.k, self.k), j), DOUBLE)
                # Couplings are mostly zeros.
                with b.if_then(b.fcmp_unordered("!=", factor, ir.Constant(DOUBLE, 0.0))):
                    minus, source, target = v.splat(b.fneg(factor)), self._row(before, j), self._row(w, i)
                    y, x, right = b.add(source, self.padded_k), b.add(source, self._right), b.add(target, self._right)
                    self._add(minus, (self.blocks, y), (self.blocks, target), self.padded_k)
                    self._add(minus, (self.blocks, x), (self.blocks, right), self.padded_c)

    def invert(self, w: Value) -> None:
        """Emit the inverse of F_w in its place, and its products with what is beside it."""
        b, v, one = self.b, self.v, ir.Constant(DOUBLE, 1.0)
        with self._rows() as j:
            row = self._row(w, j)
            at = b.add(row, j)
            place = b.add(b.mul(w, self.k), j)
            least, found = v.load(self.pivots, place, DOUBLE), v.load(self.blocks, at, DOUBLE)
            pivot = b.select(b.fcmp_unordered("<", found, least), least, found)
            v.store(pivot, self.pivots, place)
            v.store(one, self.blocks, at)
            factor = v.splat(b.fdiv(one, pivot))
            with self._vectors(self._width) as column:
                place = b.add(row, column)
                v.store(v.mul(v.load(self.blocks, place, NUMBERS), factor), self.blocks, place)
            with self._rows() as i, b.if_then(b.icmp_signed("!=", i, j)):
                other = self._row(w, i)
                at = b.add(other, j)
                minus = v.splat(b.fneg(v.load(self.blocks, at, DOUBLE)))
                v.store(ir.Constant(DOUBLE, 0.0), self.blocks, at)
                self._add(minus, (self.blocks, row), (self.blocks, other), self._width)

    def substitute(self, w: Value) -> None:
        """Emit X_w, S_w and the block of the inverse below S_w, where there is a block after it."""
        b, v = self.b, self.v
        after = b.add(w, integer(1))
        with b.if_then(b.icmp_signed("<", after, self.n)):
            with self._rows() as i, self._rows() as j:
                minus = v.splat(b.fneg(self._coupling(w, i, j)))
                source, target = b.add(self._row(after, j), self._right), b.add(self._row(w, i), self._right)
                self._add(minus, (self.blocks, source), (self.blocks, target), self.padded_c)
            with self._rows() as i:
                self._inverse_below(w, after, i)
            with self._rows() as i, self._rows() as j:
                minus = v.splat(b.fneg(self._coupling(w, i, j)))
                source = (self.inverse_below, self._place(w, j, self.padded_k, self.padded_k))
                self._add(minus, source, (self.blocks, self._row(w, i)), self.padded_k)

    def _inverse_below(self, w: Value, after: Value, i: Value) -> None:
        """Emit column i of the block of the inverse below S_w, ``-(Y_w S_{w+1})'``."""
        b, v = self.b, self.v
        with self._vectors(self.padded_k) as column:
            total = v.variable(v.number(0.0))
            with self._rows() as j:
                y = v.splat(b.fneg(self._coupling(w, i, j)))
                row = v.load(self.blocks, b.add(self._row(after, j), column), NUMBERS)
                v.set(total, v.fma(y, row, v.get(total)))
            found = v.get(total)
            for lane in range(LANES):
                row = self._place(w, b.add(column, integer(lane)), self.padded_k, self.padded_k)
                v.store(v.lane(found, lane), self.inverse_below, b.add(row, i))

    def _add(self, factor: Value, source: tuple[Value, Value], target: tuple[Value, Value], size: Value) -> None:
        """Emit ``target += factor source`` for rows: an array and the place of the first element, each."""
        with self._vectors(size) as column:
            x = self.v.load(source[0], self.b.add(source[1], column), NUMBERS)
            place = self.b.add(target[1], column)
            self.v.store(self.v.fma(factor, x, self.v.load(target[0], place, NUMBERS)), target[0], place)

    @property
    def _right(self) -> Value:
        """First column of the right-hand sides."""
        return self.b.mul(self.padded_k, integer(2))

    @property
    def _width(self) -> Value:
        """Columns of a row of `blocks`."""
        return self.b.add(self._right, self.padded_c)

    def _row(self, w: Value, i: Value) -> Value:
        """Place of row i of block w."""
        return self._place(w, i, self.k, self._width)

    def _coupling(self, w: Value, i: Value, j: Value) -> Value:
        """Element of Y_w."""
        return self.v.load(self.blocks, self.b.add(self.b.add(self._row(w, i), self.padded_k), j), DOUBLE)

    def _place(self, w: Value, i: Value, n_rows: Value, width: Value) -> Value:
        """Place of row i of matrix w of a stack."""
        return self.b.mul(self.b.add(self.b.mul(w, n_rows), i), width)

    @contextmanager
    def _rows(self) -> Iterator[Value]:
        """Emit a loop over the rows of a block; the context is its body."""
        with self.v.repeat(integer(0), self.k) as loop:
            yield loop.index

    @contextmanager
    def _vectors(self, size: Value) -> Iterator[Value]:
        """Emit a loop over the first columns of vectors."""
        with self.v.repeat(integer(0), self.b.sdiv(size, integer(LANES))) as loop:
            yield self.b.mul(loop.index, integer(LANES))
