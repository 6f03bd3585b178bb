"""Outputs of a time loop: scores, sums for Gauss-Newton steps, or series row by row."""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

from llvmlite import ir

from diransac.simulation.compiler.machine_code import LANES
from diransac.simulation.compiler.vectors import BYTE, DOUBLE, NUMBERS, Value, integer

if TYPE_CHECKING:
    from diransac.simulation.compiler.time_loop import Block, LoopRow, TimeLoop

__all__ = [
    "ClosedLoopOutput",
    "ErrorOutput",
    "GaussNewtonOutput",
    "LinearizedErrorOutput",
    "ScoreOutput",
    "SignalOutput",
]


class _Output:
    """Base of the outputs: the loop, and errors against the measurements."""

    ends_early = False

    def __init__(self, loop: TimeLoop) -> None:
        self.loop, self.v, self.specification, self.arguments = loop, loop.v, loop.specification, loop.arguments

    def start(self, block: Block) -> None:
        """Nothing before the first row."""

    def end(self, block: Block) -> None:
        """Nothing after the last row."""

    def errors(self, block: Block, row: LoopRow) -> tuple[list[Value], list[list[Value | None]]]:
        """Simulated less measured, and the Jacobian; a quaternion first takes the sign that is nearer."""
        v = self.v
        predicted, slopes = [row.signals[k] for k in self.specification.scored], row.slopes
        measured = self.loop.logged("measured", len(predicted), block, row.index)
        for four in self.specification.quaternions:
            predicted, opposite = v.turned_towards(predicted, measured, four)
            slopes = [
                [s if s is None else v.select(opposite, v.neg(s), s) for s in row_of] if k in four else row_of
                for k, row_of in enumerate(slopes)
            ]
        return [v.sub(x, y) for x, y in zip(predicted, measured, strict=True)], slopes


# Sums ----------------------------------------------------------------------------------------------------------------
class ScoreOutput(_Output):
    """`sums` (n_s, n_padded) of squared errors, and `counts` (2, n_padded): inliers, and 1 where the lane diverged.

    `inlier_bits` (n_blocks, n_rows) has a bit for every inlier, up to the row at which all lanes have diverged.
    """

    ends_early = True

    def __init__(self, loop: TimeLoop) -> None:
        super().__init__(loop)
        self.sums = [self.v.variable(self.v.number(0.0)) for _ in self.specification.scored]
        self.inliers = self.v.variable(self.v.integer(0))

    def start(self, block: Block) -> None:
        """Set the sums and the count to zero."""
        for variable in self.sums:
            self.v.set(variable, self.v.number(0.0))
        self.v.set(self.inliers, self.v.integer(0))
        builder = self.loop.builder
        self.first_bits = builder.mul(builder.udiv(block.first, integer(LANES)), self.arguments["n_rows"])

    def row(self, block: Block, row: LoopRow) -> None:
        """Add a row's squared errors to the sums, and count its inliers."""
        v = self.v
        (flags,) = self.loop.logged("valid", 1, block, row.index, BYTE)
        valid = self.loop.builder.icmp_unsigned("!=", flags, ir.Constant(flags.type, [ir.Constant(BYTE, 0)] * LANES))
        n_inside = v.integer(0)
        for k, (error, total) in enumerate(zip(self.errors(block, row)[0], self.sums, strict=True)):
            counted = v.select(valid, error, v.number(0.0))
            square = v.mul(counted, counted)
            v.set(total, v.add(v.get(total), square))
            bound = v.splat(v.load(self.arguments["squared_thresholds"], integer(k), DOUBLE))
            n_inside = v.count(n_inside, v.compare("<", square, bound))
        enough = self.loop.builder.icmp_signed(">=", n_inside, v.splat(self.arguments["min_inlier_signals"]))
        inlier = v.both(v.both(enough, valid), row.alive)
        v.set(self.inliers, v.count(v.get(self.inliers), inlier))
        v.store_bits(inlier, self.arguments["inlier_bits"], self.loop.builder.add(self.first_bits, row.index))

    def end(self, block: Block) -> None:
        """Write a block's sums and counts; the sums of a lane that diverged are infinite."""
        v, builder, n_padded = self.v, self.loop.builder, self.arguments["n_padded"]
        diverged = v.is_nan(v.get(self.loop.guard))
        for k, total in enumerate(self.sums):
            index = builder.add(builder.mul(n_padded, integer(k)), block.first)
            v.store(v.select(diverged, v.number(float("inf")), v.get(total)), self.arguments["sums"], index)
        v.store(v.get(self.inliers), self.arguments["counts"], block.first)
        flag = v.count(v.integer(0), diverged)
        v.store(flag, self.arguments["counts"], builder.add(n_padded, block.first))


class GaussNewtonOutput(_Output):
    """`sums` (n_blocks, 1 + n_z + n_z (n_z + 1) / 2, 8) of e'we, J'we, J'wJ's upper triangle; `final` states.

    The sums exceed the registers: each is loaded, increased and stored in its final place, close together for a block.
    In a lane that diverged e'we is infinite, the other sums are zero, and the final state is NaN.
    """

    ends_early = True

    def __init__(self, loop: TimeLoop) -> None:
        super().__init__(loop)
        n_z = self.specification.n_unknowns
        self.pairs = list(combinations_with_replacement(range(n_z), 2))
        self.n_sums = 1 + n_z + len(self.pairs)

    def start(self, block: Block) -> None:
        """Set the sums to zero."""
        for k in range(self.n_sums):
            self.v.store(self.v.number(0.0), *self._place("sums", block, self.n_sums, k))

    def row(self, block: Block, row: LoopRow) -> None:
        """Add a row to the sums."""
        v, n_z = self.v, self.specification.n_unknowns
        errors, slopes = self.errors(block, row)
        weights = self.loop.logged("weights", len(errors), block, row.index)
        weighted = [v.mul(w, e) for w, e in zip(weights, errors, strict=True)]
        scaled = [
            [None if s is None else v.mul(w, s) for s in of_signal]
            for w, of_signal in zip(weights, slopes, strict=True)
        ]
        self._add(block, 0, list(zip(weighted, errors, strict=True)))
        for j in range(n_z):
            self._add(block, 1 + j, [(s[j], w) for s, w in zip(slopes, weighted, strict=True)])
        for k, (i, j) in enumerate(self.pairs):
            self._add(block, 1 + n_z + k, [(s[i], t[j]) for s, t in zip(slopes, scaled, strict=True)])

    def _add(self, block: Block, k: int, products: list[tuple[Value | None, Value | None]]) -> None:
        """Add products, one per signal, to a sum; those with a factor that is always zero are left out."""
        v = self.v
        present = [(x, y) for x, y in products if x is not None and y is not None]
        if not present:
            return
        base, index = self._place("sums", block, self.n_sums, k)
        total = v.load(base, index, NUMBERS)
        for x, y in present:
            total = v.fma(x, y, total)
        v.store(total, base, index)

    def end(self, block: Block) -> None:
        """Write the sums and the final state; mark lanes in which anything is not finite."""
        v = self.v
        n_states = self.specification.n_states
        totals = [v.load(*self._place("sums", block, self.n_sums, k), NUMBERS) for k in range(self.n_sums)]
        states = [v.get(variable) for variable in self.loop.state]
        guard = v.get(self.loop.guard)
        for value in (*totals, *states):
            guard = v.fma(value, v.number(0.0), guard)
        diverged = v.is_nan(guard)
        for k, total in enumerate(totals):
            instead = v.number(0.0 if k else float("inf"))
            v.store(v.select(diverged, instead, total), *self._place("sums", block, self.n_sums, k))
        for k, state in enumerate(states):
            final = v.select(diverged, v.number(float("nan")), state)
            v.store(final, *self._place("final", block, n_states, k))

    def _place(self, name: str, block: Block, width: int, k: int) -> tuple[Value, Value]:
        """Array, and position in it, of a block's vector; `first` is eight times the block."""
        builder = self.loop.builder
        return self.arguments[name], builder.add(builder.mul(block.first, integer(width)), integer(k * LANES))


# Series --------------------------------------------------------------------------------------------------------------
class _SeriesOutput(_Output):
    """`series` (n_lanes, n_rows, width) of `values`, NaN from a lane's divergence on."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """Values of a row."""
        raise NotImplementedError

    def row(self, block: Block, row: LoopRow) -> None:
        """Write a row of every lane; lanes that fill the block write the last one again."""
        v, builder = self.v, self.loop.builder
        values = self.values(block, row)
        last = builder.sub(self.arguments["n_lanes"], integer(1))
        shown = [v.select(row.alive, value, v.number(float("nan"))) for value in values]
        for lane in range(LANES):
            own = builder.add(block.first, integer(lane))
            own = builder.select(builder.icmp_signed("<", own, last), own, last)
            place = builder.add(builder.mul(own, self.arguments["n_rows"]), row.index)
            place = builder.mul(place, integer(len(values)))
            for k, value in enumerate(shown):
                v.store(v.lane(value, lane), self.arguments["series"], builder.add(place, integer(k)))


class SignalOutput(_SeriesOutput):
    """All signals."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """All signals."""
        return row.signals


class ClosedLoopOutput(_SeriesOutput):
    """All signals, then the inputs."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """All signals, then the inputs."""
        return [*row.signals, *row.inputs]


class ErrorOutput(_SeriesOutput):
    """Errors of the scored signals."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """Errors of the scored signals."""
        return self.errors(block, row)[0]


class LinearizedErrorOutput(_SeriesOutput):
    """Errors of the scored signals, then their Jacobian, signal by signal."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """Errors of the scored signals, then their Jacobian."""
        errors, slopes = self.errors(block, row)
        zero = self.v.number(0.0)
        return [*errors, *(zero if s is None else s for of_signal in slopes for s in of_signal)]
