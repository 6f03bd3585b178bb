"""Outputs of a time loop: scores, sums for Gauss-Newton steps, or series row by row."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING

from llvmlite import ir

from diransac.simulation.compiler.machine_code import LANES
from diransac.simulation.compiler.vectors import BYTE, DOUBLE, INTEGER, Value, integer

if TYPE_CHECKING:
    from diransac.simulation.compiler.time_loop import Block, LoopRow, TimeLoop


class Output:
    """Output of a variant of the loop; it emits its own code into the loop that it is made with."""

    ends_early = False
    """True if a block ends once all its lanes have diverged."""

    def __init__(self, loop: TimeLoop) -> None:
        self.loop, self.v, self.specification, self.arguments = loop, loop.v, loop.specification, loop.arguments

    def start(self, block: Block) -> None:
        """Emit the code before a block's first row."""

    def row(self, block: Block, row: LoopRow) -> None:
        """Emit the output of a row."""
        raise NotImplementedError

    def end(self, block: Block) -> None:
        """Emit the code after a block's last row."""

    def lanes(self, block: Block) -> list[Value]:
        """Numbers of a block's lanes; the last lane stands for those that fill the block."""
        return self.v.lanes_from(block.first, self.arguments["n_lanes"])

    def errors(self, block: Block, row: LoopRow) -> list[Value]:
        """Simulated less measured; a quaternion, and its derivatives, first take the sign that is nearer."""
        v = self.v
        predicted = [row.signals[k] for k in self.specification.scored]
        measured = self.loop.logged("measured", len(predicted), block, row.index)
        for four in self.specification.quaternions:
            predicted, opposite = v.turned_towards(predicted, measured, four)
            if self.loop.columns is not None:
                self.loop.columns.turn(opposite, four)
        return [v.sub(x, y) for x, y in zip(predicted, measured, strict=True)]


# Sums ----------------------------------------------------------------------------------------------------------------
class ScoreOutput(Output):
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
        for k, (error, total) in enumerate(zip(self.errors(block, row), self.sums, strict=True)):
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


class GaussNewtonOutput(Output):
    """`first` (n_lanes, 1 + n_z) of e'we and J'we, `matrix` (n_lanes, n_z, n_z) of J'wJ, and `final` states.

    `along` (n_lanes, n_directions, 1 + n_z) has e'wd and J'wd of directions d of the errors.

    The sums exceed the registers: each is loaded, increased and stored, close together for a block, with unknowns in
    the order of their groups.  At its end they go to their `places`.  `final` (n_lanes, n_states (1 + n_z)) is the
    state, then its derivatives without those that are always zero.  In a lane that diverged e'we is infinite, the other
    sums are zero, and `final` is NaN.  Without `products` there is no `matrix`.
    """

    ends_early = True

    def __init__(self, loop: TimeLoop) -> None:
        super().__init__(loop)
        assert loop.columns is not None
        self.columns = loop.columns
        groups = self.columns.groups
        self.first_unknowns = list(accumulate((len(group.unknowns) for group in groups), initial=0))
        self.n_z = self.first_unknowns[-1]
        self.n_sums = 1 + self.n_z + self.n_z * (self.n_z + 1) // 2
        self.n_final = self.specification.n_states + sum(len(group.unknowns) * len(group.rows) for group in groups)
        self.n_weighted = self.n_z * len(self.specification.scored)
        self.weighted = self.v.array(self.n_weighted)

    def start(self, block: Block) -> None:
        """Set the sums to zero; all blocks of a call have the same memory, which stays in the cache."""
        builder, v, n_first = self.loop.builder, self.v, 1 + self.n_z
        n_along = builder.mul(self.arguments["n_directions"], integer(n_first))
        width = builder.add(n_along, integer(self.n_sums + self.n_final))
        start = builder.mul(self.arguments["first_block"], builder.mul(width, integer(LANES)))
        self.sums = builder.gep(self.arguments["scratch"], [start], source_etype=DOUBLE)
        self.final = builder.gep(self.sums, [integer(LANES * self.n_sums)], source_etype=DOUBLE)
        self.along = builder.gep(self.final, [integer(LANES * self.n_final)], source_etype=DOUBLE)
        for array, size in ((self.sums, self.n_sums), (self.weighted, self.n_weighted), (self.along, n_along)):
            v.each(0, size, partial(v.put, v.number(0.0), array))

    def row(self, block: Block, row: LoopRow) -> None:
        """Add a row to the sums."""
        v = self.v
        errors = self.errors(block, row)
        weights = self.loop.logged("weights", len(errors), block, row.index)
        weighted = [v.mul(w, e) for w, e in zip(weights, errors, strict=True)]
        self._add(self.sums, 0, list(zip(weighted, errors, strict=True)))
        for number in range(len(self.columns.groups)):
            self._add_gradient(number, weights, weighted)
        with self._directions() as direction:
            self._add_along(direction, block, row, weighted)
        with self.loop.builder.if_then(self._wants_products):
            for number in range(len(self.columns.groups)):
                self._add_products(number)

    def _add_gradient(self, number: int, weights: list[Value], weighted: list[Value]) -> None:
        """Add a row's J'we of a group, and compute its w J."""
        v, group, first = self.v, self.columns.groups[number], self.first_unknowns[number]

        def add(column: Value | int) -> None:
            products = []
            unknown = v.affine(column, 1, first)
            for k, signal in enumerate(group.signals):
                slope = v.pick(self.columns.slopes[number], v.affine(column, len(group.signals), k))
                v.put(v.mul(weights[signal], slope), self.weighted, v.affine(unknown, len(weights), signal))
                products.append((slope, weighted[signal]))
            self._add(self.sums, v.affine(unknown, 1, 1), products)

        v.each(0, len(group.unknowns), add)

    def _add_along(self, direction: Value, block: Block, row: LoopRow, weighted: list[Value]) -> None:
        """Add a row's e'wd and J'wd of a direction d."""
        v, builder = self.v, self.loop.builder
        rows = [builder.mul(at, self.arguments["n_directions"]) for at in self.loop.rows_at(block, row.index)]
        d = self.loop.columns_at("directions", len(weighted), [builder.add(at, direction) for at in rows])
        first = v.affine(direction, 1 + self.n_z)
        self._add(self.along, first, list(zip(weighted, d, strict=True)))

        def add(unknown: Value | int) -> None:
            slopes = [v.pick(self.weighted, v.affine(unknown, len(d), k)) for k in range(len(d))]
            place = v.affine(unknown, 1, v.affine(first, 1, 1))
            self._add(self.along, place, list(zip(slopes, d, strict=True)))

        v.each(0, self.n_z, add)

    def _add_products(self, number: int) -> None:
        """Add a row's J'wJ of the columns of a group with themselves and with all that follow.

        One loop takes what follows whatever its zeros are: a group's code does not grow with the number of groups.
        """
        v, group, n_signals = self.v, self.columns.groups[number], len(self.specification.scored)

        def add(column: Value | int) -> None:
            slopes = [
                v.pick(self.columns.slopes[number], v.affine(column, len(group.signals), k))
                for k in range(len(group.signals))
            ]
            left = v.affine(column, 1, self.first_unknowns[number])
            line = self._line(left)

            def add_pair(right: Value | int) -> None:
                weighted = (v.pick(self.weighted, v.affine(right, n_signals, signal)) for signal in group.signals)
                self._add(self.sums, v.affine(right, 1, line), list(zip(slopes, weighted, strict=True)))

            v.each(left, self.n_z, add_pair)

        v.each(0, len(group.unknowns), add)

    def _line(self, unknown: Value | int) -> Value | int:
        """Place of (unknown, 0) in the upper triangle, had it one: 1 + n_z + unknown (2 n_z - 1 - unknown) / 2."""
        if isinstance(unknown, int):
            return 1 + self.n_z + unknown * (2 * self.n_z - 1 - unknown) // 2
        builder = self.loop.builder
        twice = builder.mul(unknown, builder.sub(integer(2 * self.n_z - 1), unknown))
        return builder.add(builder.ashr(twice, integer(1)), integer(1 + self.n_z))

    def _add(self, sums: Value, place: Value | int, products: list[tuple[Value, Value]]) -> None:
        """Add products, one per signal, to one of some sums."""
        total = self.v.pick(sums, place)
        for x, y in products:
            total = self.v.fma(x, y, total)
        self.v.put(total, sums, place)

    def end(self, block: Block) -> None:
        """Write the sums and the final state; mark lanes in which anything is not finite."""
        v, builder, guard, final = self.v, self.loop.builder, self.loop.guard, self.final
        for k, variable in enumerate(self.loop.state):
            v.put(v.get(variable), final, k)
        first = self.specification.n_states
        for group, state in zip(self.columns.groups, self.columns.state, strict=True):
            size = len(group.unknowns) * len(group.rows)
            v.each(0, size, partial(self._copy, state, final, first))
            first += size
        n_along = builder.mul(self.arguments["n_directions"], integer(1 + self.n_z))
        written = [(self.sums, self.n_sums, 0.0), (final, self.n_final, float("nan")), (self.along, n_along, 0.0)]
        for array, size, _ in written:
            v.each(0, size, partial(self._guard, array))
        diverged = v.is_nan(v.get(guard))
        with builder.if_then(v.any_lane(diverged)):
            for array, size, instead in written:
                v.each(0, size, partial(self._replace, array, diverged, instead))
            self._replace(self.sums, diverged, float("inf"), 0)
        n_first, n_z = 1 + self.n_z, self.n_z
        n_pairs, lanes = self.n_sums - n_first, self.lanes(block)
        self._place(lanes, "first", n_first, (self.sums, 0, n_first), 0)
        with self._directions() as direction:
            rows = [builder.add(builder.mul(lane, self.arguments["n_directions"]), direction) for lane in lanes]
            self._place(rows, "along", n_first, (self.along, v.affine(direction, n_first), n_first), 0)
        with builder.if_then(self._wants_products):
            for k in range(2):
                self._place(lanes, "matrix", n_z * n_z, (self.sums, n_first, n_pairs), n_first + k * n_pairs)
        width = self.specification.n_states * n_first
        self._place(lanes, "final", width, (final, 0, self.n_final), n_first + 2 * n_pairs)

    def _place(
        self, at: list[Value], name: str, width: int, source: tuple[Value, Value | int, int], first: int
    ) -> None:
        """Copy vectors, some of an array from one on, to their places in rows of an array (n_rows, width)."""
        v, builder, (array, start, size) = self.v, self.loop.builder, source
        rows = [builder.mul(row, integer(width)) for row in at]

        def place(index: Value | int) -> None:
            vector = v.pick(array, v.affine(index, 1, start))
            at = v.affine(index, 1, first)
            column = v.load(self.arguments["places"], integer(at) if isinstance(at, int) else at, INTEGER)
            for lane, row in enumerate(rows):
                v.store(v.lane(vector, lane), self.arguments[name], builder.add(row, column))

        v.each(0, size, place)

    @contextmanager
    def _directions(self) -> Iterator[Value]:
        """Emit a loop over the directions; the context is its body."""
        with self.v.repeat(integer(0), self.arguments["n_directions"]) as loop:
            yield loop.index

    @property
    def _wants_products(self) -> Value:
        """Condition that J'wJ is wanted."""
        return self.loop.builder.icmp_signed("!=", self.arguments["products"], integer(0))

    def _copy(self, source: Value, target: Value, first: int, index: Value | int) -> None:
        """Copy one vector to its place among others."""
        self.v.put(self.v.pick(source, index), target, self.v.affine(index, 1, first))

    def _guard(self, array: Value, index: Value | int) -> None:
        """Include one vector among the values that are to be finite."""
        v, guard = self.v, self.loop.guard
        v.set(guard, v.fma(v.pick(array, index), v.number(0.0), v.get(guard)))

    def _replace(self, array: Value, lanes: Value, value: float, index: Value | int) -> None:
        """Replace some lanes of one vector."""
        self.v.put(self.v.select(lanes, self.v.number(value), self.v.pick(array, index)), array, index)


# Series --------------------------------------------------------------------------------------------------------------
class _SeriesOutput(Output):
    """`series` (n_lanes, n_rows, width) of `values`, NaN from a lane's divergence on."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """Values of a row."""
        raise NotImplementedError

    def row(self, block: Block, row: LoopRow) -> None:
        """Write a row of every lane; lanes that fill the block write the last one again."""
        v, builder = self.v, self.loop.builder
        values = self.values(block, row)
        shown = [v.select(row.alive, value, v.number(float("nan"))) for value in values]
        for lane, own in enumerate(self.lanes(block)):
            place = builder.add(builder.mul(own, self.arguments["n_rows"]), row.index)
            place = builder.mul(place, integer(len(values)))
            for k, value in enumerate(shown):
                v.store(v.lane(value, lane), self.arguments["series"], builder.add(place, integer(k)))


class _FinalOutput(_SeriesOutput):
    """A series, and `final` states (n_lanes, n_states), NaN in a lane that diverged."""

    def end(self, block: Block) -> None:
        """Write a block's state after its last row."""
        v, builder, diverged = self.v, self.loop.builder, self.v.is_nan(self.v.get(self.loop.guard))
        final = [v.select(diverged, v.number(float("nan")), v.get(x)) for x in self.loop.state]
        for lane, own in enumerate(self.lanes(block)):
            place = builder.mul(own, integer(len(final)))
            for k, value in enumerate(final):
                v.store(v.lane(value, lane), self.arguments["final"], builder.add(place, integer(k)))


class SignalOutput(_FinalOutput):
    """All signals, and `final` states."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """All signals."""
        return row.signals


class ClosedLoopOutput(_SeriesOutput):
    """All signals, then the inputs."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """All signals, then the inputs."""
        return [*row.signals, *row.inputs]


class ErrorOutput(_FinalOutput):
    """Errors of the scored signals, and `final` states."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """Errors of the scored signals."""
        return self.errors(block, row)


class LinearizedErrorOutput(_SeriesOutput):
    """Errors of the scored signals, then their derivatives, unknown by unknown in the order of the groups."""

    def values(self, block: Block, row: LoopRow) -> list[Value]:
        """Errors of the scored signals, then their derivatives."""
        values = self.errors(block, row)
        columns = self.loop.columns
        assert columns is not None
        for group, slopes in zip(columns.groups, columns.slopes, strict=True):
            for column in range(len(group.unknowns)):
                found = dict.fromkeys(range(len(self.specification.scored)), self.v.number(0.0))
                for k, signal in enumerate(group.signals):
                    found[signal] = self.v.pick(slopes, column * len(group.signals) + k)
                values += found.values()
        return values
