"""`Method`: the protocol of an identification method, and the progress that all of them report."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from diransac.data.dataset import Dataset
    from diransac.identification.estimate import Estimate
    from diransac.identification.settings import Settings

__all__ = ["Callback", "Method", "Progress", "report", "within"]


@dataclass(frozen=True)
class Progress:
    """How far an identification has come.

    Parameters
    ----------
    stage : what is being done
    fraction : of the whole work that is done, 0 to 1; it never falls
    note : what has been found so far, or empty
    """

    stage: str
    fraction: float
    note: str = ""


Callback = Callable[[Progress], None]


class Method(Protocol):
    """An identification method: a frozen object that owns its settings."""

    @property
    def name(self) -> str:
        """Name of the method, such as ``"i-diransac"``."""

    @property
    def criteria(self) -> Settings:
        """Settings of the evaluation: what judges a simulation, and where it starts."""

    @property
    def needs_all_signals(self) -> bool:
        """Whether the method evaluates the equations at each row, so that every signal in them must be there."""

    @property
    def uses(self) -> tuple[str, ...]:
        """Names of the criteria that the method, or its evaluation, depends on."""

    def options(self) -> Mapping[str, Any]:
        """The method's own settings, ready for JSON."""

    def fit(self, dataset: Dataset, seed: int, callback: Callback | None = None) -> Estimate:
        """Parameters of the dataset's model.

        Parameters
        ----------
        seed : of all that is random
        callback : called with the `Progress` now and then
        """


def report(callback: Callback | None, stage: str, fraction: float, note: str = "") -> None:
    """Report progress, if somebody listens."""
    if callback is not None:
        callback(Progress(stage, fraction, note))


def within(callback: Callback | None, low: float, high: float, prefix: str = "") -> Callback | None:
    """The callback of a part of the work, which takes it from one fraction to another."""
    if callback is None:
        return None
    return lambda x: callback(Progress(prefix + x.stage, low + (high - low) * x.fraction, x.note))
