"""A page on this machine from logs to a calibrated model: a face of the command line, which it runs.

In come folders; out comes what commands write there, and a project file.  Begin with `app.py`.

| file | contents |
|---|---|
| `app.py`, `guard.py` | the ASGI application; what a request must pass before it |
| `project.py`, `stages.py` | `Project`, and the commands of its stages |
| `jobs.py` | commands that run |
| `folders.py` | files that the page may see |
| `series.py`, `scene.py` | logs, and the machine in three dimensions, as the page draws them |
| `static/` | the page |
"""

from __future__ import annotations

import secrets
import signal
import socket
from collections.abc import Callable, Sequence
from pathlib import Path

from diransac.errors import SettingsError

__all__ = ["serve"]

_LOOPBACK = "127.0.0.1"


def serve(given: Sequence[Path], port: int, tell: Callable[[str], None]) -> None:
    """Serve the page until Ctrl-C, SIGTERM, or the end of the terminal; called by the main thread.

    Parameters
    ----------
    given : sequence of Path
        Files and folders; none: the working directory.
    port : int
        On the loopback address; 0: any free one.
    tell : callable
        Called with the address once it can be opened.

    Raises
    ------
    LogError
        A file does not exist.
    SettingsError
        A library is missing, the port is taken, or the project file is not valid.
    """
    try:
        import uvicorn

        from diransac.studio.app import Studio, application
        from diransac.studio.guard import Guard
    except ModuleNotFoundError as error:
        raise SettingsError(f"the page needs {error.name}: pip install 'diransac[studio]'") from error
    from diransac.studio.folders import Folders

    listening = _listening(port)
    port = listening.getsockname()[1]
    token = secrets.token_urlsafe(24)
    studio = Studio(Folders(given))
    app = Guard(application(studio), token, hosts_of(port))
    config = uvicorn.Config(
        app, log_level="critical", access_log=False, ws="none", server_header=False, timeout_graceful_shutdown=1
    )

    class Server(uvicorn.Server):
        """Server that tells when it has started, and lets go of open streams when it is to end."""

        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            tell(f"http://{_LOOPBACK}:{port}/{token}/")

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            studio.ended = True
            studio.changed()
            await super().shutdown(sockets)

    # Another end of this process than Ctrl-C is a tidy one, too, with its jobs; nohup's is none.
    signal.signal(signal.SIGTERM, _leave)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        signal.signal(signal.SIGHUP, lambda *_: signal.raise_signal(signal.SIGTERM))
    with listening:
        Server(config).run([listening])


def _leave(number: int, _frame: object) -> None:
    """Leave the program, with what its contexts do in the end."""
    raise SystemExit(128 + number)


def _listening(port: int) -> socket.socket:
    """A socket on the loopback address.  Raises SettingsError: the port is taken."""
    found = socket.socket()
    try:
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.bind((_LOOPBACK, port))
        found.listen(64)
    except (OSError, OverflowError) as error:
        found.close()
        raise SettingsError(f"port {port} of this machine is not free; give another one: --port 0") from error
    return found


def hosts_of(port: int) -> list[str]:
    """Names by which a browser asks for this server, which leaves HTTP's own port out."""
    names = [_LOOPBACK, "localhost"]
    return [f"{name}:{port}" for name in names] + (names if port == 80 else [])
