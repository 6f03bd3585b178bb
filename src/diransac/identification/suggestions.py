"""`Suggestion`: a term that a model lacks; models with such terms added."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from diransac.identification.serialization import Number
from diransac.model import Model, Parameter, expressions

__all__ = ["INPUT_CHANGES", "INPUT_GAIN", "Suggestion", "with_terms"]

INPUT_GAIN = "input gain"
INPUT_CHANGES = (INPUT_GAIN, "input offset", "curved input", "dead band", "saturation")
"""Kinds of the terms that change an input."""


@dataclass(frozen=True)
class Suggestion:
    """A term that explains a part of the unmodelled forces, as a line of model code.

    Parameters
    ----------
    kind : str
        Effect, such as ``"Coulomb friction"``.
    equation : str
        Coordinate or velocity whose equation lacks the term; the input, for a change of one.
    text : str
        The finding in a sentence.
    parameter : str
        Name of the new parameter.
    value, standard_error : float
        Coefficient in its unit.
    unit : str
        Unit of the coefficient; empty if unknown.
    explained : float
        Fraction of the mean square unmodelled force of the equation that the term explains.
    code : str
        Python code, with CasADi as ``ca``: a summand of the residual with its sign, or what replaces the input.
    term : mapping of str to object
        The term without its coefficient, ``(q, v, a, u, p) -> h (n_v)``, as data.
    name : str, optional
        Name in an engineer's words, such as ``dry friction of x``.
    """

    kind: str
    equation: str
    text: str
    parameter: str
    value: Number
    standard_error: Number
    unit: str
    explained: Number
    code: str
    term: Mapping[str, Any]
    name: str = ""

    @property
    def declaration(self) -> str:
        """Entry of the model's ``parameters``."""
        return f'"{self.parameter}": dr.Parameter("{self.unit or "1"}")'

    @property
    def change(self) -> str:
        """Change of the model, in a sentence."""
        where = (
            f"replace u.{self.equation} by"
            if self.kind in INPUT_CHANGES
            else f"add to the equation of {self.equation}:"
        )
        return f"{where} {self.code}, with the parameter {self.declaration}"


def with_terms(model: Model, suggestions: Sequence[Suggestion]) -> Model:
    """The model with suggested terms, whose coefficients are further parameters.

    Parameters
    ----------
    model : Model
    suggestions : sequence of Suggestion
        Of a result with this model.

    Returns
    -------
    Model

    Raises
    ------
    ModelError
        A parameter exists already.
    ResultError
        A stored term is damaged.
    """
    results = {"h": model.n_v}
    terms = [expressions.restored("term", x.term, model.argument_sizes, results) for x in suggestions]
    derived = model.kinematics is None

    def arguments(q, v, a, u, p):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
        return [*(ca.vertcat(*x) for x in (q, v, a, u)), ca.vertcat(*(p[n] for n in model.parameters))]

    def equations(q, v, a, u, p):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
        own = arguments(q, v, a, u, p)  # type: ignore[no-untyped-call]
        added = [p[x.parameter] * h(*own) for x, h in zip(suggestions, terms, strict=True)]
        return list(ca.vertsplit(sum(added, model.residual(*own))))

    def kinematics(q, v):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
        assert model.kinematics is not None
        return list(ca.vertsplit(model.kinematics(ca.vertcat(*q), ca.vertcat(*v))))

    new = {x.parameter: Parameter(x.unit or "1") for x in suggestions}
    names = ", ".join(x.parameter for x in suggestions)
    return Model(
        f"{model.name} with {names}",
        model.coordinates,
        model.inputs,
        {**model.parameters, **new},
        equations,
        velocities=None if derived else model.velocities_of_motion,
        kinematics=None if derived else kinematics,
        first_order=model.first_order,
        sensors=model.sensors_of(arguments),
        description=model.description,
    )
