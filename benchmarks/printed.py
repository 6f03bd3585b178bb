"""Comparison of the output that a page shows with what its command prints, and the block of the page by today's output.

Of a shown block, a line ``...`` stands for any lines, and ``...`` at an end of a line for any characters.  Blank lines
and the width of spaces do not count.  A number agrees within half a unit of its last shown digit, and within half the
width of the narrowest interval in its line (``1 .. 3`` or ``2 ± 1``).
"""

import re
from difflib import SequenceMatcher, unified_diff

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
INTERVAL = re.compile(rf"({NUMBER.pattern}) \.\. ({NUMBER.pattern})")
ERROR = re.compile(rf"± ?({NUMBER.pattern})")
ABRIDGED = "..."
# Part of two lines without their numbers that is equal if one is today's form of the other.
_ALIKE = 0.6


def disagreement(shown: str, printed: str) -> str:
    """What a shown block differs in from the output, as a unified diff; empty where they agree."""
    now = renewed(shown, printed).splitlines()
    return "\n".join(unified_diff(shown.splitlines(), now, "the page", "today's output", lineterm="", n=1))


def agrees(shown: str, printed: str) -> bool:
    """True if a shown block is what was printed."""
    lines = [line for line in printed.splitlines() if line.strip()]
    reached = {0}  # numbers of printed lines that the shown lines so far may stand for
    for line in filter(None, map(str.strip, shown.splitlines())):
        if line == ABRIDGED:
            reached = set(range(min(reached, default=len(lines) + 1), len(lines) + 1))
        else:
            reached = {k + 1 for k in reached if k < len(lines) and is_same_line(line, lines[k])}
    return len(lines) in reached


def is_same_line(shown: str, printed: str) -> bool:
    """True if a shown line, which may be abridged at its ends, is the printed one."""
    shown, printed = " ".join(shown.split()), " ".join(printed.split())
    whole = shown.removeprefix(ABRIDGED).removesuffix(ABRIDGED)
    pattern = f"({NUMBER.pattern})".join(map(re.escape, NUMBER.split(whole)))
    before, after = (".*" if end else "" for end in (shown.startswith(ABRIDGED), shown.endswith(ABRIDGED)))
    found = re.fullmatch(before + pattern + after, printed)
    spread = half_width(shown)
    return bool(found) and all(
        abs(float(one) - float(other)) <= half_unit(one) * (1.0 + 1e-9) + spread
        for one, other in zip(NUMBER.findall(whole), found.groups(), strict=True)
    )


def half_unit(number: str) -> float:
    """Half a unit of the last digit of a number."""
    digits, _, exponent = number.partition("e")
    return 0.5 * 10.0 ** (int(exponent or 0) - len(digits.partition(".")[2]))


def half_width(line: str) -> float:
    """Half the width of the narrowest interval in a line; 0 without one."""
    found = [0.5 * abs(float(b) - float(a)) for a, b in INTERVAL.findall(line)]
    return min([*found, *map(float, ERROR.findall(line))], default=0.0)


def renewed(shown: str, printed: str) -> str:
    """The block by today's output: as it is if it agrees; all of the output, or of abridged blocks the like lines."""
    lines, kept = printed.strip("\n").splitlines(), [x.strip() for x in shown.splitlines()]
    if agrees(shown, printed):
        return shown
    if ABRIDGED not in shown:
        return "\n".join([*lines, ""])
    kept = [line for line in kept if line not in ("", ABRIDGED)]
    found, last = list[str](), -1
    for line, k in [*zip(kept, nearest(kept, lines), strict=True), ("", len(lines))]:
        if k is None:
            continue
        found += [ABRIDGED] if any(map(str.strip, lines[last + 1 : k])) else []
        if k < len(lines):
            found += [""] if found and k and not lines[k - 1].strip() else []
            found.append(cut(lines[k], line))
        last = k
    return "\n".join([*found, ""])


def cut(line: str, shown: str) -> str:
    """A line after as many words as a shown one, if that is abridged at its end."""
    words = len(shown.removesuffix(ABRIDGED).split())
    return re.match(rf"(\s*\S+){{0,{words}}}", line)[0] + f" {ABRIDGED}" if shown.endswith(ABRIDGED) else line


def nearest(kept: list[str], lines: list[str]) -> list[int | None]:
    """Index of today's line for each kept line, in the same order; None where there is none."""
    best: list[tuple[float, list[int | None]]] = [(0.0, [])] * (len(lines) + 1)
    for line in kept:
        following = [(best[0][0], [*best[0][1], None])]
        for k, ratio in enumerate(alike(line, x) for x in lines):
            taken = [(best[k][0] + ratio, [*best[k][1], k])] if ratio >= _ALIKE else []
            missed = best[k + 1][0], [*best[k + 1][1], None]
            following.append(max([following[k], missed, *taken], key=lambda x: x[0]))
        best = following
    return best[-1][1]


def alike(shown: str, printed: str) -> float:
    """Part of two lines that is equal, by words and without their numbers."""
    one, other = (NUMBER.sub("0", x).split() for x in (shown, cut(printed, shown)))
    return 1.0 if is_same_line(shown, printed) else SequenceMatcher(None, one, other, autojunk=False).ratio()
