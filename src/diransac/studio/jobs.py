"""`Jobs`: commands that run beside the page, each in a process of its own, with their progress and what they print."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diransac.studio.project import quoted
from diransac.user_files import CONFIRMED


@dataclass
class Job:
    """One run of a command.

    Parameters
    ----------
    words : sequence of str
        After the program's name.
    number : int
        Of all jobs of this process, from 1.
    status : str
        ``running``, ``done``, ``failed`` or ``stopped``.
    steps : list of dict
        Progress, as ``--progress-json`` writes it, with the seconds since the start.
    printed : object
        What the command has printed, JSON or text.
    error : str
        Its message, where it failed.
    """

    words: Sequence[str]
    number: int
    status: str = "running"
    steps: list[dict[str, Any]] = field(default_factory=list)
    printed: Any = None
    error: str = ""
    seconds: float = 0.0
    began: float = field(default_factory=time.monotonic)
    process: asyncio.subprocess.Process | None = None

    def state(self) -> dict[str, Any]:
        """State that a page shows while it runs."""
        running = self.status == "running"
        return {
            "number": self.number,
            "command": quoted(self.words),
            "status": self.status,
            "steps": self.steps,
            "error": self.error,
            "seconds": time.monotonic() - self.began if running else self.seconds,
        }


class Jobs:
    """Latest job of every kind; a new one of a kind ends the one before.

    Parameters
    ----------
    folder : Path
        Working directory of the commands.
    changed : callable
        Called after every change of a job.
    """

    def __init__(self, folder: Path, changed: Callable[[], None]) -> None:
        self._folder, self._changed, self._count = folder, changed, 0
        self._tasks, self._one_at_a_time = set[asyncio.Task[None]](), asyncio.Lock()
        # A pipe that nothing is written to: commands end when this process, which has its other end, is no more.
        self._held: Sequence[int] = os.pipe() if hasattr(os, "killpg") else ()
        self.latest = dict[str, Job]()

    async def start(self, kind: str, words: Sequence[str], *, as_json: bool = True, confirmed: str = "") -> Job:
        """Begin a command.

        Parameters
        ----------
        kind : str
        words : sequence of str
            After the program's name.
        as_json : bool
            Whether the command prints JSON.
        confirmed : str
            SHA-256 of the only user's code that it may run; empty: none.

        Raises
        ------
        OSError
            The system starts no such process; the kind has no new job then.
        """
        async with self._one_at_a_time:
            await self.stop(kind, at_once=True)
            more = ["--json", "--progress-json"] if as_json else []
            program = ["diransac.cli.attached", str(self._held[0])] if self._held else ["diransac"]
            # Paths are given by the words alone: no module beside the logs is imported.
            process = await asyncio.create_subprocess_exec(
                *[sys.executable, "-P", "-m", *program, *words, *more],
                cwd=self._folder,
                env={**os.environ, "PYTHONSAFEPATH": "1", CONFIRMED: confirmed},
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.PIPE,
                limit=1 << 22,  # of a line, bytes
                start_new_session=True,
                pass_fds=self._held[:1],
            )
            self._count += 1
            job = self.latest[kind] = Job(list(words), self._count, process=process)
        task = asyncio.create_task(self._follow(job, as_json=as_json))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        self._changed()
        return job

    async def stop(self, kind: str, *, at_once: bool) -> None:
        """End the job of a kind: at once, or with the best answer so far."""
        job = self.latest.get(kind)
        if job is None or job.process is None or job.status != "running":
            return
        with suppress(ProcessLookupError, ConnectionError):  # it has just ended
            if at_once:
                job.status = "stopped"
                _kill(job.process)
                await job.process.wait()
            elif job.process.stdin is not None:
                job.process.stdin.write(b"stop\n")
                await job.process.stdin.drain()
        self._changed()

    async def end(self) -> None:
        """Kill every job."""
        for kind in self.latest:
            await self.stop(kind, at_once=True)
        for channel in self._held:
            os.close(channel)
        self._held = ()

    async def _follow(self, job: Job, *, as_json: bool) -> None:
        """Take what a command writes until it ends."""
        process = job.process
        assert process is not None
        assert process.stdout is not None
        assert process.stderr is not None
        printed, said = await asyncio.gather(process.stdout.read(), self._progress(job, process.stderr))
        code = await process.wait()
        job.seconds = time.monotonic() - job.began
        if job.status == "running":
            job.status = "done" if code == 0 else "failed"
        if job.status == "done":
            text = printed.decode(errors="replace")
            job.printed = json.loads(text) if as_json else text
        elif job.status == "failed":
            job.error = "\n".join(said[-3:]).removeprefix("error: ") or f"the command ended with exit code {code}"
        self._changed()

    async def _progress(self, job: Job, stream: asyncio.StreamReader) -> list[str]:
        """Keep the progress of a job; other lines."""
        said = list[str]()
        while raw := await stream.readline():
            line = raw.decode(errors="replace").rstrip()
            try:
                step = json.loads(line)
            except ValueError:
                said += [line] if line else []
                continue
            if isinstance(step, dict):
                job.steps = [*job.steps, step | {"seconds": time.monotonic() - job.began}][-200:]
                self._changed()
        return said


def _kill(process: asyncio.subprocess.Process) -> None:
    """End a command and the processes that it has started.  Raises ProcessLookupError: there are none."""
    if hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGKILL)  # its own group, by its session
    else:
        process.kill()
