"""The application behind the page: state of the project, logs, jobs, and files, as an ASGI application."""

from __future__ import annotations

import asyncio
import hashlib
import io
import tokenize
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import Route

from diransac.errors import DiransacError, LogError, SettingsError
from diransac.limits import read_bytes
from diransac.plain_data import json_data, json_text
from diransac.plain_text import printable
from diransac.studio.folders import MODELS, Folders
from diransac.studio.jobs import Jobs
from diransac.studio.project import NAME, Project
from diransac.studio.scene import Scenes
from diransac.studio.series import Logs, Shown
from diransac.studio.stages import CALLS_CODE, RESULTS, command, lines

_STATIC = Path(__file__).parent / "static"
_MOST_SHOWN = 100_000
"""Characters of a program that is shown to be confirmed."""


class Studio:
    """State that all tabs share: the project, which is a file, and the jobs.

    Parameters
    ----------
    folders : Folders
    """

    def __init__(self, folders: Folders) -> None:
        self.folders, self.logs, self.scenes = folders, Logs(), Scenes()
        self.file = folders.first / NAME
        named = [folders.name_of(path) for path in folders.files if path.suffix != ".toml"]
        self.project = Project.load(self.file) if self.file.exists() else _first_project(named)
        self.jobs = Jobs(folders.first, self.changed)
        self.version, self._news, self.ended = 0, asyncio.Event(), False
        self._confirmed = set[tuple[str, str]]()
        self._digests = dict[Path, tuple[tuple[int, int], str]]()
        self._solved: dict[str, Any] | None = None

    def _solvable(self) -> dict[str, Any]:
        """Options that a solution depends on."""
        return {key: value for key, value in self.project.options.items() if key != "held-out"}

    def changed(self) -> None:
        """Tell every tab."""
        self.version += 1
        self._news.set()
        self._news = asyncio.Event()

    async def news(self, known: int) -> bool:
        """Wait for a version later than the known one; False where there is none for a while."""
        if self.version == known and not self.ended:
            try:
                await asyncio.wait_for(self._news.wait(), timeout=5.0)
            except TimeoutError:
                return False
        return True

    def state(self) -> dict[str, Any]:
        """State that every tab shows."""
        code = self.code()
        return {
            "version": self.version,
            "folder": str(self.folders.first),
            "file": NAME,
            "project": self.project.options,
            "robot": self.project.names_robot,
            "code": None
            if code is None
            else {"name": code[0], "sha256": code[1], "confirmed": code in self._confirmed},
            "results": self.results(),
            "stale": self._solved is not None and self._solved != self._solvable(),
            "commands": lines(self.project, self.results()),
            "jobs": {kind: job.state() for kind, job in self.jobs.latest.items()},
        }

    def results(self) -> list[str]:
        """Files of the latest solution, one for each limb of a robot."""
        folder = self.folders.first / RESULTS
        if not folder.is_dir():
            return []
        limbs = sorted(path.name for path in folder.glob("model-*.json"))
        whole = folder / "model.json"
        newest = max((folder / name).stat().st_mtime for name in limbs) if limbs else 0.0
        names = [whole.name] if whole.exists() and whole.stat().st_mtime >= newest else limbs
        return [f"{RESULTS}/{name}" for name in names]

    def code(self) -> tuple[str, str] | None:
        """Name and digest of the user's own code that the model is; None for any other model.

        The digest is empty where the code cannot be shown.
        """
        if not self.project.code:
            return None
        try:
            path = self.folders.find(self.project.code)
            about = path.stat()
            as_of = about.st_mtime_ns, about.st_size
            if self._digests.get(path, (None, ""))[0] != as_of:
                self._digests[path] = as_of, self.code_shown()[0]
            return self.project.code, self._digests[path][1]
        except (DiransacError, OSError):
            return self.project.code, ""

    def code_shown(self) -> tuple[str, str]:
        """Digest and text of the user's own code, from one reading, in the encoding in which Python reads it.

        Raises LogError, OSError: it is not there; SettingsError: it is too long to be shown, or no text.
        """
        name = self.project.code
        try:
            content = read_bytes(self.folders.find(name), 4 * _MOST_SHOWN)
        except ValueError:
            content = b"#" * (_MOST_SHOWN + 1)
        try:
            encoding, _ = tokenize.detect_encoding(io.BytesIO(content).readline)
            text = io.TextIOWrapper(io.BytesIO(content), encoding).read()
        except (SyntaxError, LookupError, UnicodeError) as error:
            raise SettingsError(f"Python cannot read {name}: {error}") from error
        if len(text) > _MOST_SHOWN:
            raise SettingsError(f"{name} has more than {_MOST_SHOWN:,} characters; move parts of it to other files")
        return hashlib.sha256(content).hexdigest(), text

    def confirm(self, name: object, digest: object) -> None:
        """Allow the user's code to be run.  Raises SettingsError: it is other code than was shown."""
        if not digest or self.code() != (name, digest):
            raise SettingsError("the file has changed since it was shown; read it again")
        self._confirmed.add((str(name), str(digest)))
        self.changed()

    def change(self, changes: Mapping[str, Any]) -> None:
        """Change the project, and its file.  Raises SettingsError, LogError: it is not valid."""
        project = self.project.changed(changes)
        self.check_files(project)
        project.save(self.file)
        self.project = project
        self.changed()

    def read_first(self) -> None:
        """Read what a page will show first, while a browser starts; errors are told to those who ask for it."""
        import polars  # noqa: F401  # which reads logs

        with suppress(DiransacError, OSError):
            for name in self.project.logs[:1]:
                self.shown(name)
        self.listed()

    def listed(self) -> dict[str, Any]:
        """Logs and models that may be chosen."""
        from diransac.model.library import BUILTIN

        found = self.folders.listed()
        for kind in ("logs", "models"):
            found[kind] = [x for x in found[kind] if not x["name"].startswith(RESULTS)]
        return {**found, "builtin": list(BUILTIN)}

    def check_files(self, project: Project) -> None:
        """Raise LogError, ModelError: a file of a project is not below the folders that were given."""
        model = project.code or (project.model if Path(project.model or "").suffix else None)
        for name in filter(None, (*project.logs, *project.held_out, model, project.mapping_file)):
            self.folders.find(name)
        if project.model is not None and project.names_robot:
            self.folders.find_description(project.model)

    async def run(self, kind: str, given: Mapping[str, Any]) -> None:
        """Begin a job.  Raises SettingsError, LogError: it lacks something, or has no right to it."""
        words = command(kind, self.project, given, self.results())
        self.check_files(self.project)
        if isinstance(given.get("log"), str):
            self.folders.find(given["log"])
        code = self.code()
        confirmed = code[1] if code in self._confirmed and code is not None else ""
        if code is not None and kind in CALLS_CODE and not confirmed:
            raise SettingsError(f"{code[0]} is a program, which would be run; confirm that first, in Model")
        self._check_results()
        if kind == "solve":
            self.project.save(self.file)
            self._solved = self._solvable()
        (self.folders.first / RESULTS).mkdir(exist_ok=True)
        await self.jobs.start(kind, words, as_json=kind not in ("predict", "export"), confirmed=confirmed)

    def _check_results(self) -> None:
        """Raise SettingsError: results would be written through a link, to wherever it leads."""
        folder = self.folders.first / RESULTS
        if folder.is_symlink() or any(path.is_symlink() for path in folder.rglob("*")):
            raise SettingsError(f"{RESULTS} is or has a link, through which results would be written; remove it")

    def shown(self, name: str) -> Shown:
        """A log of the project as far as it can be read."""
        options = dict(self.project.options)
        known = ("mapping", "columns", "rate", "repair", "scale", "resample", "unmeasured")
        reading = {key: options[key] for key in known if key in options}
        if self.project.mapping_file:
            reading["mapping"] = str(self.folders.find(self.project.mapping_file))
        if options.get("map"):
            reading["rename"] = options["map"]
        return self.logs.read(self.folders.find(name), reading)


def _first_project(named: list[str]) -> Project:
    """A project of the files that were named: logs, and a model."""
    models = [name for name in named if name.endswith(MODELS)]
    return Project(logs=[name for name in named if name not in models], model=next(iter(models), None))


# ---------------------------------------------------------------------- requests

Endpoint = Callable[[Studio, Request], Awaitable[Response]]


async def _page(_studio: Studio, _request: Request) -> Response:
    return FileResponse(_STATIC / "index.html")


async def _static(_studio: Studio, request: Request) -> Response:
    name = request.path_params["name"]
    known = {path.name: path for path in _STATIC.iterdir() if path.is_file()}
    return FileResponse(known[name]) if name in known else Response(status_code=404)


async def _events(studio: Studio, _request: Request) -> Response:
    async def told() -> AsyncIterator[str]:
        known = -1
        while not studio.ended:
            if await studio.news(known):
                known = studio.version
                yield f"data: {_json(studio.state())}\n\n"
                await asyncio.sleep(0.05)  # several changes are told at once
            else:
                yield ": here\n\n"

    return StreamingResponse(told(), media_type="text/event-stream")


async def _files(studio: Studio, _request: Request) -> Response:
    return _answer(await run_in_threadpool(studio.listed))


async def _project(studio: Studio, request: Request) -> Response:
    studio.change(await _body(request))
    return _answer({})


async def _run(studio: Studio, request: Request) -> Response:
    given = await _body(request)
    await studio.run(str(given.get("kind")), given)
    return _answer({})


async def _stop(studio: Studio, request: Request) -> Response:
    given = await _body(request)
    await studio.jobs.stop(str(given.get("kind")), at_once=given.get("at_once") is True)
    return _answer({})


async def _confirm(studio: Studio, request: Request) -> Response:
    given = await _body(request)
    studio.confirm(given.get("name"), given.get("sha256"))
    return _answer({})


async def _code(studio: Studio, _request: Request) -> Response:
    name = studio.project.code
    if not name:
        return Response(status_code=404)
    digest, text = studio.code_shown()
    return _answer({"name": name, "sha256": digest, "text": text})


async def _log(studio: Studio, request: Request) -> Response:
    shown = await run_in_threadpool(studio.shown, request.query_params["name"])
    return _answer(await run_in_threadpool(shown.facts))


async def _series(studio: Studio, request: Request) -> Response:
    query = request.query_params
    begin, end = float(query["begin"]), float(query["end"])
    width = min(int(query["width"]), 4000)  # more cells than a screen has columns

    def content() -> bytes:
        shown, parts = studio.shown(query["name"]), []
        for name in query.getlist("signal"):
            if name not in shown.log:  # it has just been renamed
                parts.append(np.zeros(2 if "outliers" in query else 3))
            elif "outliers" in query:
                times, values, total = shown.outliers(name, begin, end)
                parts += [np.array([len(times), total]), times, values]
            else:
                start, step, low, high = shown.window(name, begin, end, width)
                parts += [np.array([start, step, len(low)]), low, high]
        return np.concatenate([np.asarray(x, np.float64) for x in parts]).tobytes() if parts else b""

    return Response(await run_in_threadpool(content), media_type="application/octet-stream")


async def _job(studio: Studio, request: Request) -> Response:
    job = studio.jobs.latest.get(request.query_params["kind"])
    return Response(status_code=404) if job is None else _answer({"number": job.number, "printed": job.printed})


async def _result(studio: Studio, request: Request) -> Response:
    from diransac.identification.result import Result
    from diransac.report.sections import interval_text

    name = request.query_params["name"]
    if name not in studio.results():
        raise LogError("there is no such result")
    result = await run_in_threadpool(Result.load, studio.folders.find(name))
    rows = [] if result.competition is None else result.competition.lines()
    keys = ("parameters", "units", "fixed", "verdict", "findings", "suggestions")
    shown = {key: value for key, value in result.to_dict().items() if key in keys or key.endswith("intervals_95")}
    structural = result.structural_intervals() if result.has_structure else {}
    for key, intervals in (("intervals_text", result.intervals()), ("structural_text", structural)):
        shown[key] = {name: interval_text(*ends) for name, ends in intervals.items()}
    shown["changes"] = [x.change for x in result.suggestions]
    return _answer({**shown, "competition": {"header": rows[0], "rows": rows[1:]} if rows else None})


async def _report(studio: Studio, request: Request) -> Response:
    """A page of results: it may run the script of reports alone, and is a page of another origin to the browser."""
    name = {"solve": "report", "validate": "held-out"}[request.query_params["kind"]]
    limb = Path(request.query_params.get("result", "")).stem.removeprefix("model")
    path = studio.folders.find(f"{RESULTS}/{name}{limb if name == 'report' else ''}.html")
    from diransac.report.rendering import script_policy

    policy = f"sandbox allow-scripts; {script_policy('page.js')}; frame-ancestors 'self'"
    return FileResponse(path, headers={"content-security-policy": policy})


async def _download(studio: Studio, request: Request) -> Response:
    name = request.query_params["name"]
    path = studio.folders.find(f"{RESULTS}/{Path(name).name}")
    if not path.is_file():
        raise LogError("there is no such file among the results")
    return FileResponse(path, filename=path.name, media_type="application/octet-stream")


async def _scene(studio: Studio, request: Request) -> Response:
    query, project = request.query_params, studio.project
    if project.model is None:
        raise SettingsError("there is no model yet; choose one")
    path = str(studio.folders.find_description(project.model)) if project.names_robot else None
    measured = await run_in_threadpool(studio.shown, query["name"]) if query.get("name") else None
    predicted = None
    if "predicted" in query:
        predicted = await run_in_threadpool(studio.logs.read, studio.folders.find(f"{RESULTS}/predicted.csv"), {})
    logs = [None if one is None else one.log for one in (measured, predicted)]
    roots = [str(root) for root in studio.folders.roots]
    content = await run_in_threadpool(studio.scenes.content, project.model, path, roots, *logs)
    return Response(content, media_type="application/octet-stream")


_ROUTES: dict[str, tuple[str, Endpoint]] = {
    "/": ("GET", _page),
    "/static/{name}": ("GET", _static),
    "/api/events": ("GET", _events),
    "/api/files": ("GET", _files),
    "/api/log": ("GET", _log),
    "/api/series": ("GET", _series),
    "/api/job": ("GET", _job),
    "/api/code": ("GET", _code),
    "/api/scene": ("GET", _scene),
    "/api/result": ("GET", _result),
    "/api/report": ("GET", _report),
    "/api/download": ("GET", _download),
    "/api/project": ("POST", _project),
    "/api/run": ("POST", _run),
    "/api/stop": ("POST", _stop),
    "/api/confirm": ("POST", _confirm),
}


def application(studio: Studio) -> Starlette:
    """The application, without its guard.

    Parameters
    ----------
    studio : Studio
    """

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        warming = asyncio.create_task(run_in_threadpool(studio.read_first))
        yield
        warming.cancel()
        studio.ended = True
        studio.changed()
        await studio.jobs.end()
        studio.scenes.close()

    routes = [Route(path, _endpoint(studio, call), methods=[method]) for path, (method, call) in _ROUTES.items()]
    return Starlette(routes=routes, lifespan=lifespan)


def _endpoint(studio: Studio, call: Endpoint) -> Callable[[Request], Awaitable[Response]]:
    """A request's handler, whose errors are a sentence: 400 what cannot be done, 404 what is not there."""

    async def answered(request: Request) -> Response:
        try:
            return await call(studio, request)
        except (DiransacError, OSError) as error:
            return _answer({"error": str(error)}, 400)
        except (KeyError, ValueError, TypeError, ArithmeticError) as error:
            return _answer({"error": f"the request is not understood: {error!r:.100}"}, 400)

    return answered


async def _body(request: Request) -> dict[str, Any]:
    """The request's JSON.  Raises SettingsError: it is none."""
    if request.headers.get("content-type") != "application/json":
        raise SettingsError("the body is not JSON")
    found = json_data(await request.body())
    if not isinstance(found, dict):
        raise SettingsError("the body is no JSON object")
    return found


def _json(data: Any) -> str:
    return printable(json_text(data))


def _answer(data: Mapping[str, Any], status: int = 200) -> Response:
    return Response(_json(data), status, media_type="application/json")
