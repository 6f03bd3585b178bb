"""The command ``studio``."""

from __future__ import annotations

import tempfile
import threading
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from diransac.cli import screen

app = typer.Typer(add_completion=False)


@app.command("studio")
def _studio(
    files: Annotated[
        list[Path] | None, typer.Argument(metavar="[FILES]", help="Logs, models, folders; else the working directory.")
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of this machine; 0: any.")] = 8710,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address, and open nothing.")] = False,
) -> None:
    """Open a page on this machine that leads from logs to a calibrated model; Ctrl-C ends it."""
    from diransac.studio import serve

    with tempfile.TemporaryDirectory() as private:

        def tell(address: str) -> None:
            screen.note(f"{address}  (Ctrl-C ends it)")
            if not no_browser:
                # Everybody may see a browser's arguments: it is given a file of this user alone, not the token.
                file = Path(private, "studio.html")
                file.touch(0o600)
                file.write_text(f'<!DOCTYPE html><meta http-equiv="refresh" content="0; url={address}">')
                # A browser of the terminal would hold the server up.
                threading.Thread(target=webbrowser.open, args=(file.as_uri(),), daemon=True).start()

        serve(files or [], port, tell)
