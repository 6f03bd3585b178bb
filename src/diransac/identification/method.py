"""`Method`: the protocol of an identification method, and the progress that all of them report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from diransac.data.dataset import Dataset
from diransac.data.log import Log
from diransac.errors import IdentificationError
from diransac.identification.regression.rows import motion_rows
from diransac.identification.settings import Settings
from diransac.identification.structure.identifiability import equations_in_words
from diransac.identification.structure.refusal import cause_of_refusal
from diransac.identification.structure.structural import structural
from diransac.model import Model

if TYPE_CHECKING:
    from diransac.identification.estimate import Estimate


@dataclass(frozen=True)
class Progress:
    """Progress of an identification.

    Parameters
    ----------
    stage : str
        Name of the current stage.
    fraction : float
        Completed fraction of the whole work, 0 to 1; it never falls.
    note : str, optional
        Intermediate finding, or empty.
    parameters : mapping of str to float, optional
        Best parameters so far, in their units; empty where there are none yet.
    residuals : mapping of str to float, optional
        Standard deviation of the residuals of each signal with them, outliers apart, in its unit.
    warning : str, optional
        What will not work, with its remedy, to be shown at once; or empty.
    """

    stage: str
    fraction: float
    note: str = ""
    parameters: Mapping[str, float] = field(default_factory=dict)
    residuals: Mapping[str, float] = field(default_factory=dict)
    warning: str = ""


Callback = Callable[[Progress], None]


class Method(Protocol):
    """An identification method: a frozen object that owns its settings."""

    @property
    def name(self) -> str:
        """Name of the method, such as ``"i-diransac"``."""

    @property
    def criteria(self) -> Settings:
        """Settings of the evaluation: weights, thresholds and initial state."""

    @property
    def needs_all_signals(self) -> bool:
        """True if the method evaluates the equations at each row and needs every signal in them."""

    def regresses(self, model: Model) -> bool:
        """True if the method solves ``W p = b``, in which a sensor must be affine in the parameters."""

    @property
    def uses(self) -> tuple[str, ...]:
        """Names of the criteria that the method or its evaluation uses."""

    def options(self) -> Mapping[str, Any]:
        """The method's own settings, ready for JSON."""

    def fit(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> Estimate:
        """Parameters of the dataset's model.

        Parameters
        ----------
        dataset : Dataset
        seed : int
            Seed of all random numbers.
        callback : callable, optional
            Called with a `Progress` at every stage.

        Returns
        -------
        Estimate
        """


def fit(method: Method, dataset: Dataset, seed: int, callback: Callback | None = None) -> Estimate:
    """The method's estimate; numbers that overflow, and matrices without an inverse, are refused in words.

    Parameters
    ----------
    method : Method
    dataset : Dataset
    seed : int
    callback : callable, optional
        Arguments of `Method.fit`.

    Returns
    -------
    Estimate

    Raises
    ------
    IdentificationError
        As `Method.fit`; or its equations are singular or not finite, and the message names the cause.
    """
    try:
        with np.errstate(all="ignore"):  # what is not finite is refused, or an infinite error
            found = method.fit(dataset, seed, callback)
    except np.linalg.LinAlgError as error:
        failed = f"a matrix of {method.name} is singular or not finite ({error})"
        raise IdentificationError(f"{dataset.source}: {failed}: {_cause_of_failure(dataset)}") from error
    forces = [] if found.diagnosis is None else list(found.diagnosis.unmodelled_accelerations.values())
    if not all(np.isfinite(x).all() for x in (found.values, *forces)):
        finds = f"{method.name} finds no finite parameters"
        raise IdentificationError(f"{dataset.source}: {finds}: {_cause_of_failure(dataset)}")
    return found


def _cause_of_failure(dataset: Dataset) -> str:
    """Cause of numbers that are not finite: the equations, or the logs where these have every signal of them.

    Rows without velocities or accelerations excite nothing, whatever the motion: the method estimates what they lack.
    """
    model = dataset.model
    found = structural(model, ranges=dataset.ranges) if model.has_equations else ()
    if found:
        return equations_in_words(found)
    needed = {*model.state, *model.accelerations}
    if not (model.has_equations and all(needed <= set(one.present) for one in dataset.segments)):
        return "the fit diverges; check the model's constants and units, bound the parameters, or try another method"
    try:
        return cause_of_refusal(model, dataset.layout, motion_rows(dataset))
    except np.linalg.LinAlgError:
        return extremes(dataset.given)


@contextmanager
def numerical_failures(logs: Sequence[Log]) -> Iterator[None]:
    """Context of all that is computed from logs.  Raises IdentificationError: linear algebra fails; the cause is named.

    Parameters
    ----------
    logs : sequence of Log
    """
    try:
        yield
    except np.linalg.LinAlgError as error:
        source = ", ".join(dict.fromkeys(log.source for log in logs))
        raise IdentificationError(f"{source}: the numbers exceed floating point ({error}): {extremes(logs)}") from error


def extremes(logs: Sequence[Log]) -> str:
    """Sentence on the signal whose values range most widely.

    Parameters
    ----------
    logs : sequence of Log

    Returns
    -------
    str
    """
    found = []
    for log in logs:
        for name in log.names:
            sizes = np.abs(log[name])
            sizes = sizes[np.isfinite(sizes) & (sizes > 0.0)]
            if len(sizes):
                with np.errstate(all="ignore"):
                    usual, largest = float(np.median(sizes)), float(sizes.max())
                    found.append((max(np.log10(largest) - np.log10(usual), abs(np.log10(usual))), name, usual, largest))
    if not found:
        return "all signals are zero; record a motion"
    _, name, usual, largest = max(found)
    return f'"{name}" is {usual:.3g} in the median and {largest:.3g} at most; check its unit, and remove such outliers'


def report(callback: Callback | None, stage: str, fraction: float, note: str = "", **found: Any) -> None:
    """Call the callback, if there is one, with a `Progress`.

    Parameters
    ----------
    callback : callable, optional
    stage : str
    fraction : float
    note : str, optional
    **found
        Fields of the `Progress`.
    """
    if callback is not None:
        callback(Progress(stage, fraction, note, **found))


def within(callback: Callback | None, low: float, high: float, prefix: str = "") -> Callback | None:
    """Callback of a part of the work.

    Parameters
    ----------
    callback : callable, optional
        Callback of the whole work.
    low, high : float
        Fractions of the whole work at which the part begins and ends.
    prefix : str, optional
        Text before the stages of the part.

    Returns
    -------
    callable or None
    """
    if callback is None:
        return None
    return lambda x: callback(replace(x, stage=prefix + x.stage, fraction=low + (high - low) * x.fraction))
