"""What is printed: results on stdout, progress on stderr."""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

import typer

from diransac.identification.methods.consensus import Score
from diransac.identification.methods.search import Progress

__all__ = ["bar", "show"]


class Showable(Protocol):
    """What prints as text and as JSON."""

    def to_dict(self) -> dict[str, Any]:
        """Everything that the text shows."""

    def __str__(self) -> str: ...


def show(shown: Showable, as_json: bool) -> None:
    """Print on stdout, as JSON if that is wanted; what is not finite is null there."""
    if as_json:
        typer.echo(json.dumps(_finite(shown.to_dict()), indent=1, ensure_ascii=False, allow_nan=False))
    else:
        typer.echo(str(shown))


def _finite(data: object) -> object:
    if isinstance(data, float) and not math.isfinite(data):
        return None
    if isinstance(data, Mapping):
        return {str(key): _finite(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_finite(value) for value in data]
    return data


@contextmanager
def bar(label: str) -> Iterator[Progress | None]:
    """What a search reports its progress to: a bar on a terminal's stderr, nothing elsewhere."""
    if sys.stderr is None or not (sys.stderr.isatty() or os.environ.get("FORCE_COLOR")):
        yield None
        return
    from rich import progress
    from rich.console import Console

    console = Console(stderr=True)
    with progress.Progress(console=console, transient=True) as shown:
        task = shown.add_task(label, total=None)

        def update(done: int, total: int, score: Score) -> None:
            found = f"{label}: {score.inlier_fraction:.0%} inliers"
            shown.update(task, completed=done, total=total, description=found)

        yield update
