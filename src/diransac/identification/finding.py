"""`Finding`: a sentence for or against a result, with its level and action; the verdict that follows from several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, get_args

from diransac.identification.serialization import Form

Level = Literal["note", "good", "care", "bad"]
"""Levels of findings, the least serious first."""


class Finding(str):
    """A sentence for or against a result: a string with a level and an action.

    Parameters
    ----------
    level : {"note", "good", "care", "bad"}
        ``good`` supports the result, ``care`` and ``bad`` oppose it, a ``note`` is neutral.
    claim : str
        What was found: a sentence, without a stop where an action follows.
    action : str, optional
        What to do about it, in the imperative; the sentence ends with it.

    Raises
    ------
    ValueError
        There is no such level.
    """

    level: Level
    action: str

    def __new__(cls, level: Level, claim: str, action: str = "") -> Finding:
        """A finding of a level."""
        if level not in get_args(Level):
            raise ValueError(f"level {level!r} of a finding; there are {', '.join(get_args(Level))}")
        made = super().__new__(cls, f"{claim}; {action}." if action else claim)
        made.level, made.action = level, action
        return made

    @classmethod
    def of(cls, level: Level, claim: str, action: str) -> Finding:
        """A finding of a level; one that supports the result needs no action."""
        return cls(level, f"{claim}.") if level == "good" else cls(level, claim, action)

    @property
    def claim(self) -> str:
        """The sentence without the action."""
        return self.removesuffix(f"; {self.action}.") if self.action else str(self)

    def __getnewargs__(self) -> tuple[Level, str, str]:  # type: ignore[override]  # a string's are its text alone
        return self.level, self.claim, self.action

    def __repr__(self) -> str:
        return f"Finding({self.level!r}, {self.claim!r}, {self.action!r})"

    @property
    def seriousness(self) -> int:
        """Place of the level among the levels: 0 for a note, 3 for bad."""
        return get_args(Level).index(self.level)

    def to_dict(self) -> dict[str, str]:
        """Form in JSON: level, the whole sentence, and the action at its end."""
        return {"level": self.level, "text": str(self), "action": self.action}

    @classmethod
    def _from_dict(cls, data: Mapping[str, Any]) -> Finding:
        """The finding of `to_dict`; those of earlier versions have no action."""
        text, action = data["text"], data.get("action", "")
        if not (isinstance(text, str) and isinstance(action, str)):
            raise TypeError("a finding that is no text")
        return cls(data["level"], text.removesuffix(f"; {action}.") if action else text, action)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: object, handler: object) -> Any:
        """Form in JSON: that of `to_dict`."""
        return Form(cls.to_dict, cls._from_dict).__get_pydantic_core_schema__(source, handler)


Verdict = Literal["usable", "usable with care", "do not rely on this"]


NEAR = 0.1
"""Error of a prediction over the motion up to which a model is good."""
FAR = 0.25
"""Error of a prediction over the motion up to which a model needs care, and beyond which it is bad."""
VALIDATE = "predict a log that it was not identified from: diransac validate RESULT.json OTHER_LOG"
"""Action for a result that nothing opposes."""


def by_seriousness(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, the most serious first, in their order within a level."""
    return tuple(sorted(findings, key=lambda finding: -finding.seriousness))


def shown(findings: Iterable[Finding], *, good: bool = False) -> tuple[list[Finding], int]:
    """The findings that a person is shown, the most serious first, and the number of those that are left out.

    Of findings with the same action, which are consequences of one cause, the first is shown.

    Parameters
    ----------
    findings : iterable of Finding
    good : bool, optional
        Whether findings that support the result are shown, too; notes are not.
    """
    levels = ("bad", "care", "good") if good else ("bad", "care")
    found = [x for x in by_seriousness(findings) if x.level in levels]
    first = dict[str, Finding]()
    for one in found:
        first.setdefault(one.action or one, one)
    kept = list(first.values())[:5]
    return kept, len(found) - len(kept)


def shown_lines(findings: Iterable[Finding], *, good: bool = False) -> list[str]:
    """The findings that a person is shown, a line each, and one on those that are left out.  Parameters as `shown`."""
    found, more = shown(findings, good=good)
    marks = {"bad": "!", "care": "·", "good": " "}
    return [f"{marks[x.level]} {x}" for x in found] + ([f"  and {more} more in the JSON"] if more else [])


def next_line(findings: Iterable[Finding], otherwise: str = VALIDATE) -> str:
    """A line on the single most useful thing to do: the action of the most serious finding.

    Parameters
    ----------
    findings : iterable of Finding
    otherwise : str, optional
        What to do where no finding opposes the result.
    """
    actions = [x.action for x in shown(findings)[0] if x.action]
    return f"Next: {(actions or [otherwise])[0]}."


def graded(value: float, good: float, care: float) -> Level:
    """Level of a value of which less is better."""
    return "good" if value <= good else "care" if value <= care else "bad"


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """The verdict by the most serious finding; "usable" only where a finding supports the result.

    Parameters
    ----------
    findings : iterable of Finding
    """
    levels = {finding.level for finding in findings}
    if "bad" in levels:
        return "do not rely on this"
    return "usable" if "good" in levels and "care" not in levels else "usable with care"
