"""Terms that a model lacks: suggested ones, models with them, and the uncertainty of parameters by possible ones.

Either the model is complete, or it lacks one of the terms that the log does not exclude, or two of them, each with its
weight.  Given the coefficient of a term, the estimate is another one, by ``g`` times the coefficient.  The distribution
of a parameter is therefore a mixture of normal ones: ``N(p, C)`` of the complete model, and ``N(p + g m, C + v g^2)``
with a term whose coefficient has the mean m and the variance v.

References
----------
Draper 1995 (model uncertainty); Hoeting, Madigan, Raftery, Volinsky 1999 (Bayesian model averaging); Leamer 1978.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import NormalDist
from typing import Any

import casadi as ca
import numpy as np

from diransac.arrays import FloatArray
from diransac.identification.serialization import Number, Values
from diransac.model import Model, Parameter, expressions

INPUT_GAIN = "input gain"
_RICHER = "richer motion of {place}"
INPUT_CHANGES = (INPUT_GAIN, "input offset", "curved input", "dead band", "saturation")
"""Kinds of the terms that change an input."""
KINDS = {
    "Coulomb friction": ("dry friction of {x}", "reversals of {place} at low speed"),
    "Stribeck friction": ("Stribeck friction of {x}", "reversals of {place} at low speed"),
    "viscous friction": ("viscous friction of {x}", "speeds of {place} over a wider range"),
    "quadratic drag": ("quadratic drag of {x}", "speeds of {place} over a wider range"),
    "asymmetric drag": ("drag of {x} in a current", "motion of {place} in both directions"),
    "linear term": ("decay of {x}", "a wider range of {place}"),
    "quadratic term": ("quadratic decay of {x}", "a wider range of {place}"),
    "constant term": ("constant rate of {x}", "a wider range of {place}"),
    "mass of a body": ("mass of {x}", "accelerations and poses of {place} over a wider range"),
    "inertia of a body": ("inertia of {x}", "larger accelerations of {place}, of both signs"),
    "load-dependent friction": ("friction of {x} that grows with its load", "reversals of {place} under several loads"),
    "constant force": ("constant {force} {x}", "larger accelerations of {place}, of both signs"),
    "stiffness": ("spring on {x}", "a wider range of {place}"),
    "quadratic stiffness": ("quadratic spring on {x}", _RICHER),
    "cubic stiffness": ("cubic spring on {x}", _RICHER),
    "product of velocities": ("", "motion in which the velocities of {formula} vary independently"),
    INPUT_GAIN: ("gain of {x}", "a wider range of {place}"),
    "input offset": ("offset of {x}", "a wider range of {place}, of both signs"),
    "curved input": ("curved gain of {x}", "a wider range of {place}"),
    "dead band": ("dead band of {x}", "small and large values of {place}"),
    "saturation": ("saturation of {x}", "small and large values of {place}"),
}
"""Name in an engineer's words, by kind, and the motion that separates a term from the parameters.

{force} is a force along or a torque about a coordinate, or what acts on a velocity.
"""


def name_of_term(kind: str, place: str, formula: str, unit: str) -> str:
    """Name of a term in an engineer's words.

    Parameters
    ----------
    kind, place, formula : str
        As those of `PossibleTerm`.
    unit : str
        Unit of the coordinate; empty for a velocity that is the derivative of none.
    """
    force, first = {"m": "force along", "rad": "torque about"}.get(unit, "force on"), kind.partition(" ")[0]
    if kind in KINDS and KINDS[kind][0]:
        return KINDS[kind][0].format(x=place, force=force)
    if first in ("gravity", "harmonic"):
        angle = kind.rpartition(" ")[2]
        if first == "harmonic":
            return f"ripple of the {force} {place}, {kind.split()[1]} periods per turn of {angle}"
        return f"gravity {force.removeprefix('force ')} {place}" + (f", as {angle} tilts" if angle != place else "")
    if first == "coupling":
        return f"viscous coupling of {place} to {kind.rpartition(' ')[2]}"
    if kind == "product of velocities":
        a, b = formula.split(" ")
        cause = "Coriolis" if a != b else "centrifugal"
        return f"{cause} {force} {place}, by {a if a == b else f'{a} and {b}'}"
    return f"{kind} on {place}"


_QUOTIENTS = {
    "m": "/m", "rad": "/rad", "m/s": " s/m", "rad/s": " s/rad", "(m/s)^2": " s^2/m^2", "(rad/s)^2": " s^2/rad^2",
    "(m/s) (m/s)": " s^2/m^2", "(rad/s) (rad/s)": " s^2/rad^2", "(m/s) (rad/s)": " s^2/(m rad)",
    "(rad/s) (m/s)": " s^2/(m rad)", "N": "/N",
}  # fmt: skip


def unit_over(force: str, unit: str) -> str:
    """Unit of a force over that of an expression: ``N`` over ``m/s`` is ``N s/m``."""
    return force + _QUOTIENTS.get(unit, f"/({unit})") if unit else force


@dataclass(frozen=True)
class PossibleTerm:
    """A term that the model may lack, or two: the evidence, the coefficient, and the effect on the parameters.

    Parameters
    ----------
    kind : str
        Effect, such as ``"Coulomb friction"``.
    place : str
        Coordinate or velocity whose equation may lack the term; the input, for a change of one.
    formula : str
        The term for readers, such as ``sign(x_dot)``; may be empty.
    weight : float
        Probability of the term, by its evidence and its prior.
    variance : float
        Of its coefficient, if the model lacks the term.
    effects : mapping of str to float
        Change of each parameter per unit of the coefficient; of two terms, that with the variance by both.
    shifts : mapping of str to float
        Parameters if the model lacks the term, less those of the estimate.
    name : str, optional
        Name in an engineer's words, such as ``dry friction of x``; of two terms, both names.
    """

    kind: str
    place: str
    formula: str
    weight: Number
    variance: Number
    effects: Values
    shifts: Values
    name: str = ""

    def __str__(self) -> str:
        name = self.name or f"{self.kind} {'of' if self.kind in INPUT_CHANGES else 'on'} {self.place}"
        return f"{name} ({self.formula})" if self.formula and self.kind != INPUT_GAIN else name

    @property
    def motion(self) -> str:
        """Motion that separates the term from the parameters."""
        other = self.kind.partition(" of " if " of " in self.kind else " to ")[2]
        of_other = {
            "harmonic ": "a wider range of {other}",
            "gravity ": "a wider range of {other}",
            "coupling ": "motion in which {other} and {place} vary independently",
        }
        of_prefix = next((x for start, x in of_other.items() if self.kind.startswith(start)), _RICHER)
        _, motion = KINDS.get(self.kind, ("", of_prefix))
        return motion.format(place=self.place, formula=self.formula, other=other)


@dataclass(frozen=True)
class StructuralUncertainty:
    """Uncertainty of one parameter by terms that the model may lack.

    Parameters
    ----------
    term : str
        The term that contributes most.
    weight : float
        Probability of that term.
    widening : float
        Width of the 95 % interval if the model may lack a term, over that if it is complete.
    motion : str
        Motion that separates the term from the parameters.
    """

    term: str
    weight: float
    widening: float
    motion: str


def check_terms(terms: Sequence[PossibleTerm]) -> None:
    """Raise ValueError: weights are no probabilities, or a coefficient or an effect is none.

    Parameters
    ----------
    terms : sequence of PossibleTerm
        As read from a file.
    """
    figures = [x for one in terms for x in (one.variance, *one.effects.values(), *one.shifts.values())]
    if not all(abs(x) < 1e100 for x in figures) or any(x.variance < 0.0 for x in terms):
        raise ValueError("possible_terms: a coefficient that no term has")
    if not all(0.0 <= x.weight <= 1.0 for x in terms) or sum(x.weight for x in terms) > 1.0 + 1e-9:
        raise ValueError("possible_terms: weights that are no probabilities")


def mixture_intervals(
    values: FloatArray,
    errors: FloatArray,
    weights: FloatArray,
    shifts: FloatArray,
    variances: FloatArray,
    probability: float,
    reach: float,
) -> FloatArray:
    """Central intervals of mixtures of normal distributions, which hold those of the complete model.

    Parameters
    ----------
    values, errors : (n,) array
        Mean and standard deviation of each parameter, if the model is complete.
    weights : (K,) array
        Of the terms; the complete model has the rest of 1.
    shifts, variances : (K, n) array
        What each term adds to mean and variance.
    probability : float
        Of the intervals.
    reach : float
        Half width of the interval of a complete model, standard deviations.

    Returns
    -------
    (n, 2) array
        Infinite where an error is.
    """
    # Normal tails as long as those of Student's t at this level.
    scale = reach / NormalDist().inv_cdf(0.5 + 0.5 * probability)
    ordinary = np.stack([values - reach * errors, values + reach * errors], axis=1)
    known = np.flatnonzero(np.isfinite(errors) & (errors > 0.0))
    if not (len(known) and len(weights)):
        return ordinary
    share = np.append(weights, 1.0 - weights.sum())
    means = np.vstack([shifts[:, known], np.zeros((1, len(known)))])
    deviations = scale * np.sqrt(np.square(errors[known]) + np.vstack([variances[:, known], np.zeros((1, len(known)))]))
    for side, level in enumerate((0.5 - 0.5 * probability, 0.5 + 0.5 * probability)):
        found = values[known] + _quantiles(share, means, deviations, level)
        ordinary[known, side] = (np.minimum, np.maximum)[side](ordinary[known, side], found)
    return ordinary


def _quantiles(weights: FloatArray, means: FloatArray, deviations: FloatArray, level: float) -> FloatArray:
    """Quantile ``(n,)`` of each mixture (K, n), by Newton's method; by bisection where it leaves the bounds."""
    # Beyond nine standard deviations a normal distribution has nothing, to rounding errors.
    low, high = (means - 9.0 * deviations).min(axis=0), (means + 9.0 * deviations).max(axis=0)
    found = 0.5 * (low + high)
    for _ in range(60):
        z, before = (found - means) / deviations, found
        excess = weights @ _normal(z) - level
        low, high = np.where(excess < 0.0, found, low), np.where(excess < 0.0, high, found)
        density = weights @ (np.exp(-0.5 * np.square(z)) / deviations) / math.sqrt(2.0 * math.pi)
        found = found - excess / np.maximum(density, 1e-300)
        found = np.where((low <= found) & (found <= high), found, 0.5 * (low + high))
        if (np.abs(found - before) <= 1e-12 * deviations.min(axis=0)).all():
            break
    return np.asarray(found)


def _normal(x: FloatArray) -> FloatArray:
    """Normal distribution function; SciPy's import takes as long as an identification."""
    found = [0.5 * math.erfc(-y / math.sqrt(2.0)) for y in x.ravel().tolist()]
    return np.array(found).reshape(x.shape)


def largest(terms: Sequence[PossibleTerm], shares: Mapping[str, float]) -> PossibleTerm | None:
    """The term that contributes most to the spread of a sum of shares of parameters; None where none does.

    Parameters
    ----------
    terms : sequence of PossibleTerm
    shares : mapping of str to float
        Of each parameter of the estimate; those that are not named have none.

    Returns
    -------
    PossibleTerm or None
    """

    def spread(x: PossibleTerm) -> float:
        effect, shift = (sum(share * y.get(n, 0.0) for n, share in shares.items()) for y in (x.effects, x.shifts))
        return float(x.weight * (effect**2 * x.variance + shift**2))

    found = max(terms, key=spread, default=None)
    return found if found is not None and spread(found) > 0.0 else None


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
        Fraction that the term explains of the mean square unmodelled force that other suggestions leave.
    code : str
        Python code, with CasADi as ``ca``: a summand of the residual with its sign, or what replaces the input.
    term : mapping of str to object
        The term without its coefficient, ``(q, v, a, u, p) -> h (n_v)``, as data.
    name : str, optional
        Name in an engineer's words, such as ``dry friction of x``.
    also : mapping of str to str, optional
        Further equations that lack the term, as one between two bodies, and their code.
    rivals : tuple of str, optional
        Names of terms that explain the same in its place, which the logs do not exclude.
    option : str, optional
        Option that makes a constant of the model a parameter, in place of code.
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
    also: Mapping[str, str] = field(default_factory=dict)
    rivals: tuple[str, ...] = ()
    option: str = ""

    @property
    def declaration(self) -> str:
        """Entry of the model's ``parameters``."""
        return f'"{self.parameter}": dr.Parameter("{self.unit or "1"}")'

    @property
    def change(self) -> str:
        """Change of the model, in a sentence."""
        if self.option:
            return f"identify again with {self.option} (bodies= of dr.models.robot)"
        where = (
            f"replace u.{self.equation} by"
            if self.kind in INPUT_CHANGES
            else f"add to the equation of {self.equation}:"
        )
        also = "".join(f", to that of {name}: {code}" for name, code in self.also.items())
        return f"{where} {self.code}{also}, with the parameter {self.declaration}"


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

    def arguments(q, v, a, u, p):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
        return [*(ca.vertcat(*x) for x in (q, v, a, u)), ca.vertcat(*(p[n] for n in model.parameters))]

    def equations(q, v, a, u, p):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
        own = arguments(q, v, a, u, p)  # type: ignore[no-untyped-call]
        added = [p[x.parameter] * h(*own) for x, h in zip(suggestions, terms, strict=True)]
        return list(ca.vertsplit(sum(added, model.residual(*own))))

    new = {x.parameter: Parameter(x.unit or "1") for x in suggestions}
    names = ", ".join(x.parameter for x in suggestions)
    sensors = model.sensors_of(arguments)
    return model.with_equations(f"{model.name} with {names}", {**model.parameters, **new}, equations, sensors)
