"""Derivatives of the state in the time loop: columns in memory, in loops whose code does not grow with their number.

The state's own step is that of every variant of the loop. Its stages, the points at which the dynamics are evaluated,
are handed to one function that computes the Jacobians there. The integrator's step of a column of derivatives needs
these and nothing else of the model. Columns with the same structural zeros are a group, and one loop steps them.

All arrays are of vectors of eight lanes, and belong to one block of lanes at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

from diransac.simulation.compiler.operations import evaluate, evaluate_into, numbers
from diransac.simulation.compiler.stage_function import StageCalls, StageFunction

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from diransac.simulation.compiler.graph import Graph
    from diransac.simulation.compiler.vectors import Value, Vectors


@dataclass(frozen=True)
class ColumnGroup:
    """Unknowns whose columns of derivatives have their zeros at the same places.

    Attributes
    ----------
    unknowns : positions of the unknowns
    rows : states whose derivatives are stored
    initial : (n_unknowns, n_rows) values of these at the first row, 0 or 1
    signals : scored signals whose derivatives are not always zero
    driven : (n_unknowns, n_driving) elements of df/dp that drive the column's derivatives, column by column
    step : graph of (column's rows, shared, its driving elements in each stage, h) -> (rows after one sub-step,
        derivatives of the signals before it); shared are the elements of df/dx in each stage, then `quaternions`
    """

    unknowns: tuple[int, ...]
    rows: tuple[int, ...]
    initial: tuple[tuple[float, ...], ...]
    signals: tuple[int, ...]
    driven: tuple[tuple[int, ...], ...]
    step: Graph


@dataclass(frozen=True)
class DerivativeSpecification:
    """Expressions of the derivatives of a time loop's state.

    Attributes
    ----------
    groups : of all unknowns
    jacobians : graph of (x, u, p) -> (elements of df/dx that are not constant, all elements of df/dp)
    n_stages : evaluations of the dynamics in a sub-step
    """

    groups: tuple[ColumnGroup, ...]
    jacobians: Graph
    n_stages: int


class _Places:
    """Places of values in two arrays: those that are computed in every stage, and those that are fixed for a block."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.fixed: list[int] = []
        self.varying: list[int] = []

    def add(self, positions: Sequence[int]) -> tuple[bool, int]:
        """Place the results of instructions side by side; whether they are fixed, and the place of the first."""
        is_fixed = all(self.graph.invariant[k] for k in positions)
        places = self.fixed if is_fixed else self.varying
        places.extend(positions)
        return is_fixed, len(places) - len(positions)


class Columns:
    """Emitter of the derivatives of a time loop.

    Attributes
    ----------
    groups : the groups of columns
    state : for each group, the array of its derivatives of the state, column by column
    slopes : for each group, the array of its derivatives of the scored signals before the last sub-step
    """

    def __init__(
        self,
        v: Vectors,
        specification: DerivativeSpecification,
        step: Value,
        sizes: tuple[int, int],
        n_quaternions: int,
    ) -> None:
        """Sizes are those of the state and of the inputs of a stage."""
        self.v, self.specification, self.groups = v, specification, specification.groups
        self.step = step
        graph = specification.jacobians
        places = _Places(graph)
        self._shared = [places.add([k]) for k in graph.outputs[0]]
        self._driving = [
            [places.add(elements) for elements in _rows_of(group, graph.outputs[1])] for group in self.groups
        ]
        self._places = places
        stage = StageFunction("jacobians", graph, tuple(places.varying), *sizes)
        function = stage.declare(v.builder.module)
        function.linkage = "internal"
        stage.emit(function)
        self._stages = StageCalls(v, stage, function, specification.n_stages)
        self._fixed = v.array(len(places.fixed))
        self._quaternions = v.array(n_quaternions)
        self.state = [v.array(len(group.unknowns) * len(group.rows)) for group in self.groups]
        self.slopes = [v.array(len(group.unknowns) * len(group.signals)) for group in self.groups]

    # A block ---------------------------------------------------------------------------------------------------------
    def start(self, load: Callable[[int, int], Value]) -> None:
        """Emit the derivatives of the initial state, and what the parameters alone determine."""
        v = self.v
        for group, array in zip(self.groups, self.state, strict=True):
            for k, value in enumerate(chain(*group.initial)):
                v.put(v.number(value), array, k)
        self._stages.start(load)
        evaluate_into(v, self._fixed, self.specification.jacobians, self._places.fixed, load)

    # A sub-step ------------------------------------------------------------------------------------------------------
    def advance(self, points: Sequence[Sequence[Value]], quaternions: Sequence[Value]) -> None:
        """Emit the derivatives of the signals before a sub-step, and those of the state after it.

        Parameters
        ----------
        points : state and inputs of each stage
        quaternions : components after the sub-step, before they are scaled to length one
        """
        for stage, point in enumerate(points):
            self._stages.at(stage, point)
        for k, value in enumerate(quaternions):
            self.v.put(value, self._quaternions, k)
        for number in range(len(self.groups)):
            self._advance_group(number)

    def _advance_group(self, number: int) -> None:
        """Emit the loop over a group's columns."""
        v, group = self.v, self.groups[number]
        graph, n_rows, n_signals = group.step, len(group.rows), len(group.signals)
        wanted = list(chain(*graph.outputs))
        shared = [k for k in graph.needed(wanted) if graph.invariant[k] and graph.instructions[k].operands]
        known = evaluate(v, graph, shared, self._load(number, 0))
        known = {k: known[k] for k in shared}

        def step(column: Value | int) -> None:
            results = evaluate(v, graph, wanted, self._load(number, column), known)
            for array, width, positions in (
                (self.slopes[number], n_signals, graph.outputs[1]),
                (self.state[number], n_rows, graph.outputs[0]),
            ):
                for k, value in enumerate(numbers(v, results, positions)):
                    v.put(value, array, v.affine(column, width, k))

        v.each(0, len(group.unknowns), step)

    def turn(self, opposite: Value, signals: Sequence[int]) -> None:
        """Emit a change of sign of the derivatives of some signals, in some lanes."""
        for group, array in zip(self.groups, self.slopes, strict=True):
            places = [k for k, signal in enumerate(group.signals) if signal in signals]
            self.v.each(0, len(group.unknowns), partial(self._turn, opposite, array, len(group.signals), places))

    def _turn(self, opposite: Value, array: Value, width: int, places: list[int], column: Value | int) -> None:
        """Emit a change of sign of some of a column's derivatives."""
        v = self.v
        for k in places:
            place = v.affine(column, width, k)
            slope = v.pick(array, place)
            v.put(v.select(opposite, v.neg(slope), slope), array, place)

    def _load(self, number: int, column: Value | int) -> Callable[[int, int], Value]:
        """Loader of the inputs of a group's graph for one of its columns."""
        v, n_rows = self.v, len(self.groups[number].rows)
        n_driving, n_shared = len(self._driving[number]), len(self._shared)

        def own(element: int) -> Value:
            return v.pick(self.state[number], v.affine(column, n_rows, element))

        def shared(element: int) -> Value:
            first_quaternion = n_shared * self.specification.n_stages
            if element >= first_quaternion:
                return v.pick(self._quaternions, element - first_quaternion)
            stage, k = divmod(element, n_shared)
            is_fixed, place = self._shared[k]
            return v.pick(self._array(is_fixed, stage), place)

        def driving(element: int) -> Value:
            stage, k = divmod(element, n_driving)
            is_fixed, first = self._driving[number][k]
            return v.pick(self._array(is_fixed, stage), v.affine(column, 1, first))

        sources = own, shared, driving, lambda _element: v.splat(self.step)
        return lambda argument, element: sources[argument](element)

    def _array(self, is_fixed: bool, stage: int) -> Value:
        """Array of a stage's values, or of those that are fixed."""
        return self._fixed if is_fixed else self._stages.results[stage]


def _rows_of(group: ColumnGroup, elements: Sequence[int]) -> list[list[int]]:
    """Instructions that drive a group's columns: for each driven row, one per column."""
    return [[elements[k] for k in row] for row in zip(*group.driven, strict=True)]
