"""The command ``cache``."""

from __future__ import annotations

from typing import Annotated

import typer

from diransac.cli import screen
from diransac.cli.options import JsonFlag
from diransac.cli.views import CacheState
from diransac.simulation.compiler.code_cache import CodeCache

__all__ = ["app"]

app = typer.Typer(add_completion=False)


@app.command("cache")
def _cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all entries.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Show the folder of compiled machine code, and the number and size of its entries."""
    cache = CodeCache.of_user()
    if clear and cache is not None:
        cache.clear()
    screen.show(CacheState(cache), as_json)
