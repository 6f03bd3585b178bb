"""One identification by the default, what it took and what it said; and the aspects of a row, each checked."""

from __future__ import annotations

import os
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

import diransac as dr
from acceptance.cases import Case
from acceptance.machines import MACHINES
from acceptance.records import DATA, RECORDS
from acceptance.table import REFUSED, Row

COMPILED = 5.0
"""Processor time, s, beside which that of compiling does not matter."""
FAILURES = (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError, np.linalg.LinAlgError)
"""Of a method that neither answers nor refuses."""


@dataclass(frozen=True)
class Answer:
    """What came of a log.

    Parameters
    ----------
    verdict : of the result; "refused", or what it crashed with
    error : in the row's unit; NaN without an answer, or where there is nothing to judge
    findings : sentences, and claims of those that oppose the result
    inside, structural : number of true values that intervals hold
    seconds, reference : processor time of the default, and of least squares
    """

    verdict: str
    error: float = np.nan
    findings: tuple[str, ...] = ()
    against: tuple[str, ...] = ()
    inside: int = 0
    structural: int = 0
    seconds: float = np.nan
    reference: float = np.nan

    @property
    def ratio(self) -> float:
        """Processor time over that of least squares."""
        return self.seconds / self.reference


@cache
def answer(row: Row) -> Answer:
    """The default's answer; each log is identified once for all aspects, and again where it took too long.

    The second time has its machine code.
    """
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        case = MACHINES[row.log](Path(folder)) if row.log in MACHINES else RECORDS[row.log](DATA)
        reference = _least_squares(case) if row.ratio else np.nan
        result, seconds, verdict = _timed(case, "lo-diransac")
        if row.ratio and result is not None and seconds > row.ratio * reference and not row.long:
            seconds = min(seconds, _timed(case, "lo-diransac")[1])
        if result is None:
            return Answer(verdict, seconds=seconds, reference=reference)
        return Answer(
            result.verdict, case.error(result), tuple(map(str, result.findings)),
            tuple(x.claim for x in result.findings if x.level in ("care", "bad")),
            _held(result.intervals(0.95), case.truth),
            _held(result.structural_intervals(0.95), case.truth) if row.structural is not None else 0,
            seconds, reference,
        )  # fmt: skip


def _timed(case: Case, method: str) -> tuple[dr.Result | None, float, str]:
    """Result, processor time of this process and its children, s, and why there is no result."""
    begin, result, verdict = _processor_time(), None, ""
    try:
        result = case.identify(method)
    except dr.DiransacError:
        verdict = REFUSED
    except FAILURES as error:
        verdict = f"crashed: {type(error).__name__}: {error}"
    return result, _processor_time() - begin, verdict


def _processor_time() -> float:
    spent = os.times()
    return time.process_time() + spent.children_user + spent.children_system


def _least_squares(case: Case) -> float:
    """Processor time of ``ols``, of the second time if the first may have compiled; where it refuses, on the arm."""
    result, first, _ = _timed(case, "ols")
    if result is None:
        return _of_the_arm()
    return first if first > COMPILED else min(first, _timed(case, "ols")[1])


@cache
def _of_the_arm() -> float:
    return _least_squares(MACHINES["arm"](Path()))


def _held(intervals: Mapping[str, tuple[float, float]], truth: Mapping[str, float]) -> int:
    return sum(intervals[name][0] <= x <= intervals[name][1] for name, x in truth.items())


# ---------------------------------------------------------------------- aspects


def cases_of(rows: Sequence[Row], *marks: Any) -> list[Any]:
    """An argument of ``pytest.mark.parametrize`` for each aspect of each row, with its marks."""
    found = []
    for row in rows:
        for aspect in row.aspects:
            own = [pytest.mark.slow, *marks, *([pytest.mark.long] if row.long else [])]
            if aspect in row.open:
                own.append(pytest.mark.xfail(strict=True, reason=row.open[aspect]))
            found.append(pytest.param(row, aspect, marks=own, id=f"{row.log}: {aspect}"))
    return found


def failure(row: Row, aspect: str) -> str:
    """Sentence on why an answer fails an aspect of its row; empty where it passes."""
    found = answer(row)
    if aspect != "verdict" and found.verdict == REFUSED and REFUSED in row.verdicts:
        return ""
    return "" if CHECKS[aspect](row, found) else f"{row.log}: {aspect} fails: {found}"


def _named(row: Row, found: Answer) -> bool:
    return any(re.search(row.named, text, re.IGNORECASE) for text in found.findings)


def _accused(row: Row, found: Answer) -> bool:
    return any(re.search(row.accused, text, re.IGNORECASE) for text in found.against)


CHECKS: dict[str, Callable[[Row, Answer], bool]] = {
    "error": lambda row, found: found.error <= (row.error or 0.0),
    "verdict": lambda row, found: found.verdict in row.verdicts,
    "findings": _named,
    "accusations": lambda row, found: bool(found.findings) and not _accused(row, found),
    "coverage": lambda row, found: found.inside >= (row.inside or 0),
    "structural": lambda row, found: found.structural >= (row.structural or 0),
    "seconds": lambda row, found: found.ratio <= (row.ratio or 0.0),
}
