"""Prospects of a search: what robust least squares of all rows tells of a log before seconds are spent on it.

Parameters that the rows do not determine, or determine outside of their bounds, and mass matrices that no machine has
are told at once, each with a remedy.  A log is refused at once if its equations hold with impossible parameters alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.data.dataset import ParameterLayout
from diransac.identification.core.rows import inclusive_bounds
from diransac.identification.regression.rows import (
    MotionRows,
    RowsSolution,
    outside_bounds,
    robust_fit,
    scaled_equations,
    solved,
)
from diransac.identification.structure.identifiability import Ambiguity, in_words, of_log
from diransac.model import Model
from diransac.text_table import listed, percent, some

ADVICE = "compare the terms, constants and bounds of the model with the machine"
"""Advice where equations contradict a log, and nothing tells which part of them."""

_WEAK = 0.5
"""Standard error over estimate from which on a parameter is weakly excited, as in `inspect`."""
_HOLDS = 0.3
"""Residual of an equation over its terms below which it holds."""
_MUCH_WORSE = 2.0
"""Factor by which impossible parameters must be the better ones to be the only ones."""
_FEW = 300
"""Rows of a log at which the mass matrix is computed."""


@dataclass(frozen=True, eq=False)
class Prospects:
    """Robust least squares of the rows of logs of a model that is affine in its parameters, whatever the bounds.

    Parameters
    ----------
    model : Model
    layout : ParameterLayout
    rows : sequence of MotionRows
        Of each log.
    """

    model: Model
    layout: ParameterLayout
    rows: Sequence[MotionRows]

    @cached_property
    def solution(self) -> RowsSolution | None:
        """The parameters; None where they are not affine, priors add to the rows, or numbers exceed floating point."""
        if not (self.rows and self.model.is_affine) or np.isfinite(self.layout.prior_std).any():
            return None
        try:
            return solved(self.model, self.layout, self.rows)
        except np.linalg.LinAlgError:
            return None

    @cached_property
    def outside(self) -> list[str]:
        """Parameters that are clearly outside of their bounds, of those that the rows determine."""
        found = self.solution
        if found is None or not found.has_known_terms or len(found.space.directions):
            return []
        return outside_bounds(self.layout, found.parameters, found.errors)

    @property
    def contradict_bounds(self) -> bool:
        """True if the equations hold with parameters outside of their bounds, and much worse with any within them."""
        found = self.solution
        if found is None or not self.outside:
            return False
        rows, _ = scaled_equations(self.model, self.layout, self.rows)
        within = robust_fit(rows, inclusive_bounds(self.layout.bounds, zero=True))
        if within is None:
            return False
        free, held = (np.median(np.abs(rows.residuals(p)), axis=0) for p in (found.parameters, within.p))
        worse = held > _MUCH_WORSE * free
        return bool((worse & (found.residuals < _HOLDS)).any())

    def sentences(self) -> Iterator[str]:
        """Clauses on what will not work, each with its remedy."""
        found = self.solution
        if found is None or not found.has_known_terms:
            return
        if undetermined := in_words(of_log(self.layout.names, found.space), len(self.rows)):
            yield undetermined
            return
        if self.outside:
            yield f"least squares gives {self.values(self.outside)}, outside the bounds; {self.remedy(self.outside)}"
        if weak := self._weak():
            fix = Ambiguity(tuple(weak), 0, ()).remedy()
            yield f"the motion hardly excites {some(weak)}; record a livelier one, or fix them, {fix}"
        if part := self.impossible_inertia():
            yield (
                f"least squares gives a mass matrix that is not positive definite in {percent(part)} of the rows, so "
                "that nothing can be simulated with it; record faster motions of all joints, or identify fewer "
                "inertial parameters"
            )

    def values(self, names: Sequence[str]) -> str:
        """Parameters with their standard errors."""
        found = self.solution
        assert found is not None
        numbers = zip(self.layout.names, found.parameters, found.errors, strict=True)
        return some(f"{n} = {x:.4g} ± {error:.2g}" for n, x, error in numbers if n in names)

    def remedy(self, names: Sequence[str]) -> str:
        """Remedy of parameters outside of their bounds, as a clause."""
        inputs = listed(list(dict.fromkeys(x for n in names for x in self._inputs_of(n))))
        if inputs:
            multiply = "it multiplies" if len(names) == 1 else "they multiply"
            return f"check the signs and units of {inputs}, which {multiply}"
        return f"{ADVICE}, or fix one, {Ambiguity(tuple(names), 0, ()).remedy()}"

    def _weak(self) -> list[str]:
        """Parameters of a known sign whose standard errors are a large part of them, and of their nominal values."""
        found = self.solution
        assert found is not None
        numbers = zip(self.layout.names, self.layout.bounds, found.parameters, found.errors, strict=True)
        return [
            n
            for n, x, value, error in numbers
            if not x.admits(-1.0) and error > _WEAK * max(abs(value), abs(x.value or 0.0)) and n not in self.outside
        ]

    def _inputs_of(self, name: str) -> list[str]:
        """Inputs that a parameter multiplies, if it multiplies nothing else: a gain."""
        column = list(self.model.parameters).index(self.layout.owners[self.layout.names.index(name)])
        symbols = [ca.SX.sym(n, size) for n, size in self.model.argument_sizes.items()]
        slope = ca.jacobian(self.model.residual(*symbols), symbols[4][column])
        by_motion = ca.jacobian_sparsity(slope, ca.vertcat(*symbols[:3]))
        acting = set(ca.jacobian_sparsity(slope, symbols[3]).get_triplet()[1])
        return [] if by_motion.nnz() else [n for k, n in enumerate(self.model.inputs) if k in acting]

    def impossible_inertia(self) -> float:
        """Part of the rows in which the mass matrix has an eigenvalue of the wrong sign; 0 where r is no force."""
        found, sign = self.solution, self.model.force_sign
        if found is None or not sign:
            return 0.0
        symbols = [ca.SX.sym(n, size) for n, size in self.model.argument_sizes.items()]
        mass = ca.Function("mass", symbols, [ca.densify(ca.jacobian(self.model.residual(*symbols), symbols[2]))])
        wrong: list[bool] = []
        for i, one in enumerate(self.rows):
            p, every = self.layout.of_log(found.parameters, i), max(1, len(one.q) // _FEW)
            motion: list[FloatArray] = [x[::every] for x in (one.q, one.v, one.a, one.u)]
            for row in zip(*motion, strict=True):
                M = sign * np.array(mass(*row, p))
                wrong.append(bool(np.linalg.eigvalsh(0.5 * (M + M.T))[0] <= 0.0))
        return float(np.mean(wrong)) if wrong else 0.0
