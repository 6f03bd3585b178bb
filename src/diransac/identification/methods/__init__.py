"""Identification methods, each a frozen object with its own settings; `METHODS` names them.

A new method is a file here and a line in the registry: its name, and the function that returns it from `Settings`.

| file | methods |
|---|---|
| `least_squares.py` | ols, tls, nls |
| `ransac.py`, `samples.py` | diransac, i-diransac; their hypotheses |
| `lo_diransac/` | lo-diransac, the default |
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, cast

from diransac.errors import SettingsError, check_known
from diransac.identification.settings import EXECUTION, Settings

if TYPE_CHECKING:
    from diransac.identification.method import Method

__all__ = [
    "DEFAULT", "ESTIMATORS", "METHODS", "WITH_ESTIMATOR", "configured", "default_options", "estimator_named", "factory",
    "setting_names",
]  # fmt: skip

ESTIMATORS = {
    "ols": "regression.estimators:OrdinaryLeastSquares",
    "tls": "regression.estimators:TotalLeastSquares",
    "nls": "regression.nonlinear:NonlinearLeastSquares",
}
"""Places of the estimators by name, those of the methods that fit all rows with them."""

_SEARCHES = {
    "diransac": "methods.ransac:Diransac",
    "i-diransac": "methods.ransac:IDiransac",
    "lo-diransac": "methods.lo_diransac:configured",
}
METHODS = (*ESTIMATORS, *_SEARCHES)
"""Names of all methods."""

DEFAULT = "lo-diransac"
WITH_ESTIMATOR = ("diransac", "i-diransac")
"""Names of the methods with an estimator inside."""


def factory(name: str) -> Callable[..., Method]:
    """Function that returns a method from `Settings`.

    Parameters
    ----------
    name : str
        Name of the method, one of `METHODS`.

    Returns
    -------
    callable

    Raises
    ------
    SettingsError
        There is no method of that name; the message lists all.
    """
    check_known([name], METHODS, "there is no method", "there are")
    if name in ESTIMATORS:
        return partial(_imported("methods.least_squares:LeastSquares"), estimator_named(name))
    return cast("Callable[..., Method]", _imported(_SEARCHES[name]))


def estimator_named(name: str) -> object:
    """Estimator for the inside of a RANSAC method.

    Parameters
    ----------
    name : str
        One of `ESTIMATORS`.

    Returns
    -------
    Estimator

    Raises
    ------
    SettingsError
        There is no estimator of that name; the message lists all.
    """
    if name not in ESTIMATORS:
        raise SettingsError(
            f"estimator is {name!r:.60}; give {', '.join(ESTIMATORS)}, an object such as dr.TotalLeastSquares(), or a "
            "scikit-learn linear regressor"
        )
    return _imported(ESTIMATORS[name])()


def _imported(place: str) -> Any:
    """An attribute of a module of this package, by ``module:attribute``."""
    module, _, attribute = place.partition(":")
    return getattr(importlib.import_module(f"diransac.identification.{module}"), attribute)


def default_options(name: str) -> Mapping[str, Any]:
    """Default values of a method's own settings; empty for a method that is not in the registry.

    Parameters
    ----------
    name : str
        Name of the method.

    Returns
    -------
    mapping of str to object
    """
    return factory(name)(Settings()).options() if name in METHODS else {}


def setting_names(name: str) -> tuple[str, ...]:
    """Names of all settings of a method: its own, and those of `Settings` that it uses.

    Parameters
    ----------
    name : str
        Name of the method, one of `METHODS`.

    Returns
    -------
    tuple of str
    """
    method = factory(name)(Settings())
    return tuple(dict.fromkeys((*method.options(), *method.uses, *EXECUTION)))


def configured(name: str, values: Mapping[str, Any], **of_search: Any) -> Method:
    """A method with settings by name, its own or those of `Settings`.

    Parameters
    ----------
    name : str
        Name of the method, one of `METHODS`.
    values : mapping of str to object
        Settings by name.
    of_search : object
        Other arguments of the method, such as ``estimator``.

    Returns
    -------
    Method

    Raises
    ------
    SettingsError
        There is no such method or setting, or a value is out of range.
    """
    own = default_options(name)
    options = {key: value for key, value in values.items() if key in own}
    rest = {key: value for key, value in values.items() if key not in own}
    return factory(name)(Settings.from_dict(rest), **options, **of_search)
