"""Support for tests of the studio: requests to its application without a network, as raw as an attacker's."""

import asyncio
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import diransac as dr
from command_line import swim
from diransac.studio.app import Studio, application
from diransac.studio.folders import Folders
from diransac.studio.guard import Guard

TOKEN, HOST = "t0k3n", "127.0.0.1:8710"


class Answer(NamedTuple):
    """Status, headers and body of an answer."""

    status: int
    headers: dict[str, str]
    body: bytes

    def json(self) -> Any:
        """The body as JSON."""
        return json.loads(self.body)


class Client:
    """An application with a loop of its own, in which its jobs go on between requests while it waits."""

    def __init__(self, folder: Path, *files: Path) -> None:
        self.runner = asyncio.Runner()
        self.studio = self.runner.run(self._made([folder, *files]))
        self.app = Guard(application(self.studio), TOKEN, [HOST, "localhost:8710"])

    async def _made(self, given):
        return Studio(Folders(given))

    def close(self) -> None:
        """End all jobs."""
        self.runner.run(self.studio.jobs.end())
        self.studio.scenes.close()
        self.runner.close()

    def ask(self, path, body=None, method=None, headers=None, kind="http", chunks=None) -> Answer:
        """A request to a path with all that a scope may have; a body is sent as JSON."""
        sent = [json.dumps(body).encode()] if chunks is None else chunks
        given = {"host": HOST, **({} if body is None else {"content-type": "application/json"}), **(headers or {})}
        path, _, query = path.partition("?")
        scope = {
            "type": kind,
            "method": method or ("GET" if body is None and chunks is None else "POST"),
            "path": path,
            "raw_path": path.encode(),
            "query_string": query.encode(),
            "headers": [(name.encode(), value.encode("latin-1")) for name, value in given.items()],
            "http_version": "1.1",
            "scheme": "http",
            "server": ("127.0.0.1", 8710),
            "client": ("127.0.0.1", 5),
            "root_path": "",
        }
        return self.runner.run(self._asked(scope, sent))

    async def _asked(self, scope, sent) -> Answer:
        said, parts = [], list(sent)

        async def receive():
            if scope["type"] == "websocket":
                return {"type": "websocket.connect"}
            if not parts:
                await asyncio.Event().wait()  # who asks is still there
            return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

        async def send(message):
            said.append(message)

        await self.app(scope, receive, send)
        if said[0]["type"] == "websocket.close":
            return Answer(403, {}, b"")
        headers = {name.decode().lower(): value.decode() for name, value in said[0]["headers"]}
        return Answer(said[0]["status"], headers, b"".join(x.get("body", b"") for x in said[1:]))

    def get(self, path) -> Answer:
        """A request of the page."""
        return self.ask(f"/{TOKEN}/{path}")

    def post(self, path, body) -> Answer:
        """A request of the page that changes something."""
        return self.ask(f"/{TOKEN}/{path}", body)

    def finished(self, kind, seconds=30.0):
        """The job of a kind, once it has ended."""

        async def wait():
            for _ in range(int(50 * seconds)):
                if self.studio.jobs.latest[kind].status != "running":
                    break
                await asyncio.sleep(0.02)

        self.runner.run(wait())
        return self.studio.jobs.latest[kind]


def write_swim(path: Path, n_rows: int = 600, start: float = 0.0) -> None:
    """A log of an underwater vehicle."""
    t = np.arange(n_rows) * 0.01
    dr.Log.from_arrays(t, swim(t + start)).write(path)


def write_spring(path: Path) -> None:
    """A log of an underwater vehicle on a spring, with noise."""
    t = np.arange(300) * 0.01
    columns = swim(t)
    columns["thrust"] = columns["thrust"] + 40.0 * columns["x"]
    noise = 0.001 * np.random.default_rng(0).standard_normal((2, 300))
    columns |= {"x": columns["x"] + noise[0], "x_dot": columns["x_dot"] + noise[1]}
    dr.Log.from_arrays(t, {n: columns[n] for n in ("x", "x_dot", "thrust")}).write(path)
