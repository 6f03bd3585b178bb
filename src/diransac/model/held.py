"""Constants that a model holds at values of a description, and the residuals of a change of each."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class HeldConstant:
    """A constant of a model that is no parameter, such as the mass of a body in a file.

    Parameters
    ----------
    kind : str
        ``"mass of a body"`` or ``"inertia of a body"``.
    place : str
        Name of the body.
    label : str
        Name of the parameter that a change of it would be.
    unit : str
        Of a change; "1" of a relative one.
    option : str
        Option that makes it a parameter, as of ``diransac identify``.
    least : float
        Least change that is possible.
    effect : casadi.Function
        ``(q, v, a, u) -> h (n_v)``: change of the residuals per change.
    """

    kind: str
    place: str
    label: str
    unit: str
    option: str
    least: float
    effect: ca.Function
