"""Values that a tracker returns: `TrackedEstimate`, one a step, and `Change`, which it reports once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

from diransac.arrays import FloatArray
from diransac.errors import SettingsError

__all__ = ["Change", "TrackedEstimate"]


@dataclass(frozen=True)
class Change:
    """Change of a parameter of a machine while it runs.

    Parameters
    ----------
    time : float
        Most probable time of a step, s; of a drift, when it began to exceed its standard error.
    parameter : str
    before, after : float
        Value before it and after it, in the parameter's unit.
    kind : "step", "drift" or "return"
        A return is a step or a drift to a value from before an earlier change.
    detected : float
        Time of the estimate that reports it, s.
    before_error, after_error : float
        Standard errors of both values.
    """

    time: float
    parameter: str
    before: float
    after: float
    kind: Literal["step", "drift", "return"] = "step"
    detected: float = float("nan")
    before_error: float = float("nan")
    after_error: float = float("nan")


@dataclass(frozen=True, eq=False)
class TrackedEstimate:
    """Parameters of a machine at one moment of its run.

    Parameters
    ----------
    time : float
        Of the last sample that counts, s of the stream's clock.
    parameters, standard_errors : mapping of str to float
        Of each parameter, in its unit.
    covariance : (n_p, n_p) array
        Of the parameters in their order.
    changes : tuple of Change
        Those found since the estimate before.
    outliers : mapping of str to float
        Fraction of outliers of each measured signal, in the window.
    noise : mapping of str to float
        Standard deviation of the noise of each measured signal, its unit.
    state : mapping of str to float
        Most probable state at `time`.
    notes : tuple of str
        Findings since the estimate before, a sentence each: gaps, a clock that restarts, a sensor that stops.
    """

    time: float
    parameters: Mapping[str, float]
    standard_errors: Mapping[str, float]
    covariance: FloatArray
    changes: tuple[Change, ...]
    outliers: Mapping[str, float]
    noise: Mapping[str, float]
    state: Mapping[str, float]
    notes: tuple[str, ...] = ()

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Credible interval of each parameter.

        Parameters
        ----------
        level : float, optional
            Probability, between 0 and 1.

        Returns
        -------
        dict of str to (float, float)
            Lower and upper limit in the parameter's unit.

        Raises
        ------
        SettingsError
            The level is not between 0 and 1.
        """
        if not 0.0 < level < 1.0:
            raise SettingsError(f"level is {level}; give a number between 0 and 1, such as 0.95")
        width = NormalDist().inv_cdf(0.5 + level / 2.0)
        errors = self.standard_errors
        return {n: (x - width * errors[n], x + width * errors[n]) for n, x in self.parameters.items()}
