"""The colours and dashes of the report's page, so that a method looks the same on page and picture."""

from __future__ import annotations

__all__ = ["COLOURS", "DASHES", "INK", "MUTED", "PAPER", "REFERENCE", "RULE", "SOFT"]

PAPER, INK, MUTED, RULE, SOFT = "#ffffff", "#1c2126", "#5a646e", "#d8dde2", "#f4f6f8"
REFERENCE = "#a3adb6"
COLOURS = ("#0072b2", "#00875f", "#a63a79", "#946a00", "#2e9bd6", "#4b4bb5")
# On and off, in widths of the line.
DASHES = ((), (5.3, 1.8), (1.8, 1.8), (5.3, 1.8, 1.2, 1.8), (8.2, 2.4), (3.5, 0.9))
