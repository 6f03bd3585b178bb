"""Leave-one-log-out cross-validation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from diransac.data.dataset import distinct_logs
from diransac.data.log import Log
from diransac.errors import DiransacError, SettingsError
from diransac.identification.assessment.validation import Validation, validate
from diransac.identification.identify import identify
from diransac.identification.method import Callback, Method, within
from diransac.identification.methods import DEFAULT
from diransac.identification.result import Result
from diransac.model import Model
from diransac.text_table import aligned
from diransac.time_limit import check_time, time_limited, time_unlimited


@dataclass(frozen=True)
class CrossValidation:
    """Leave-one-log-out cross-validation: each log predicted by the model of the others.

    Parameters
    ----------
    sources : tuple of str
        Name of each log in messages.
    results : tuple of Result or str
        Result of all logs but that one; or the reason why there is none.
    validations : tuple of Validation or str
        Validation with that log; or the reason why there is none.
    """

    sources: tuple[str, ...]
    results: tuple[Result | str, ...]
    validations: tuple[Validation | str, ...]

    @property
    def rmse(self) -> dict[str, float]:
        """Median over the logs of each signal's root mean squared error; infinite where a log has none."""
        names = dict.fromkeys(n for one in self.validations if isinstance(one, Validation) for n in one.rmse)
        found = {
            n: [one.rmse.get(n, np.inf) if isinstance(one, Validation) else np.inf for one in self.validations]
            for n in names
        }
        return {n: float(np.median(x)) for n, x in found.items()}

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON."""
        folds = [
            {
                "log": source,
                "parameters": result if isinstance(result, str) else result.parameters,
                "validation": found if isinstance(found, str) else found.to_dict(),
            }
            for source, result, found in zip(self.sources, self.results, self.validations, strict=True)
        ]
        return {"folds": folds, "rmse": {n: x if np.isfinite(x) else None for n, x in self.rmse.items()}}

    def __str__(self) -> str:
        signals = list(self.rmse)
        parameters = next((list(x.parameters) for x in self.results if not isinstance(x, str)), [])
        rows = [["log left out", *parameters, *(f"RMSE {n}" for n in signals)]]
        remarks = []
        for source, result, found in zip(self.sources, self.results, self.validations, strict=True):
            estimates = ["" if isinstance(result, str) else f"{result.parameters[n]:.5g}" for n in parameters]
            errors = ["" if isinstance(found, str) else f"{found.rmse.get(n, np.nan):.4g}" for n in signals]
            rows.append([source, *estimates, *errors])
            remarks += [x if x.startswith(source) else f"{source}: {x}" for x in (result, found) if isinstance(x, str)]
        return "\n".join([*aligned(rows), *remarks])


def cross_validate(
    model: Model,
    logs: Iterable[Log],
    method: str | Method = DEFAULT,
    *,
    horizon: float | None = None,
    time_limit: float | None = None,
    progress: Callback | None = None,
    **arguments: Any,
) -> CrossValidation:
    """Leave-one-log-out cross-validation: prediction of each log by the model identified from the others.

    A per-log parameter of the log that is left out is the mean over the others.

    Parameters
    ----------
    model : Model
    logs : iterable of Log
        Two or more.
    method : str or Method, optional
        As in `identify`.
    horizon : float, optional
        As in `validate`, s.
    time_limit : float, optional
        Time after which no further log is left out, s; those that are not say so.
    progress : callable, optional
        Called with a `Progress` at every stage.
    arguments : object
        Other arguments of `identify`.

    Returns
    -------
    CrossValidation

    Raises
    ------
    SettingsError
        There are fewer than two logs, or an argument is out of range.
    LogError
        A log is given twice.
    """
    several = distinct_logs(logs)
    if len(several) < 2:
        raise SettingsError("cross-validation leaves one log out; give at least two logs")
    arguments = {"compare_logs": False, **arguments}
    folds = list[tuple[Result | str, Validation | str]]()
    with time_limited(time_limit):
        for i, left_out in enumerate(several):
            part = within(progress, i / len(several), (i + 1) / len(several), f"without log {i + 1}: ")
            result: Result | str = "no model of the other logs"
            try:
                others = [*several[:i], *several[i + 1 :]]
                answer = identify(model, others, method, progress=part, **arguments)
                check_time()
                result = answer
                with time_unlimited():
                    folds.append((answer, validate(answer, left_out, horizon)))
            except SettingsError:
                raise
            except DiransacError as error:
                folds.append((result, str(error)) if isinstance(result, Result) else (str(error), result))
    results, validations = zip(*folds, strict=True)
    return CrossValidation(tuple(x.source for x in several), results, validations)
