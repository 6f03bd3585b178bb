"""Results with parts replaced, by the names that a result shows them under."""

import dataclasses

from diransac.identification.estimate import Estimate, Evaluation
from diransac.identification.result import Result


def changed(result: Result, **changes) -> Result:
    """A result with other fields, whether they are its own, its estimate's or its evaluation's."""
    own = {k: v for k, v in changes.items() if k in _names(Result)}
    of_estimate = {k: v for k, v in changes.items() if k not in own and k in _names(Estimate)}
    of_evaluation = {k: v for k, v in changes.items() if k in _names(Evaluation)}
    assert len(own) + len(of_estimate) + len(of_evaluation) == len(changes)
    return dataclasses.replace(
        result,
        estimate=dataclasses.replace(result.estimate, **of_estimate),
        evaluation=dataclasses.replace(result.evaluation, **of_evaluation),
        **own,
    )


def _names(kind) -> set[str]:
    return {f.name for f in dataclasses.fields(kind)}


def assert_needs_no_care_but_for_terms(result):
    """The verdict is "usable", or terms that the log does not exclude are the only reason for care."""
    assert all(x.level in ("note", "good") or str(x).startswith("If the model lacks a term") for x in result.findings)
