"""Plain text in columns: the same on a terminal, in a file and in a notebook."""

from __future__ import annotations

import math
from collections.abc import Sequence

__all__ = ["aligned", "telling_digits"]


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells as lines, each column as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def telling_digits(low: float, high: float) -> int:
    """Number of significant digits in which the ends of an interval differ, at least 5."""
    size, width = max(abs(low), abs(high)), high - low
    return 5 if not 0.0 < width < size else min(12, max(5, 2 + math.ceil(math.log10(size / width))))
