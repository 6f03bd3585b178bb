"""`Folders`: the files that the page may see, those below the folders that were given."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from xml.parsers import expat

from diransac.data.readers import ENDINGS
from diransac.errors import LogError, ModelError
from diransac.limits import LARGEST_TABLE, read_bytes

MODELS = (".urdf", ".mjcf", ".xml", ".py", ".json")
_MOST, _DEEPEST = 2000, 5


class Folders:
    """Folders that were given, or those of the files that were given; the first one holds project and results.

    Parameters
    ----------
    given : iterable of Path
        Files and folders; none: the working directory.

    Raises
    ------
    LogError
        One of them does not exist.
    """

    def __init__(self, given: Iterable[Path]) -> None:
        paths = [Path(os.path.realpath(path)) for path in given]
        absent = next((path for path in paths if not path.exists()), None)
        if absent is not None:
            raise LogError(f'"{absent}" does not exist; give files or folders')
        roots = [path if path.is_dir() and not _is_recording(path) else path.parent for path in paths]
        self.roots = tuple(dict.fromkeys(roots)) or (Path(os.path.realpath(Path.cwd())),)
        self.files = tuple(path for path, root in zip(paths, roots, strict=True) if path != root)
        """Files that were named one by one, which are the first logs of a project."""

    @property
    def first(self) -> Path:
        """Folder of the project, to which names are relative."""
        return self.roots[0]

    def find(self, name: str) -> Path:
        """Path of a file, by its name relative to the first folder.

        Raises LogError: there is no such file below the folders, links followed, or it is a folder with others.
        """
        try:
            path = Path(os.path.realpath(self.first / name))
            inside = self._holds(path) and path.exists()
        except (OSError, ValueError):  # a name with a null, or too long
            inside = False
        if not inside:
            raise LogError(f"{name!r:.200}: there is no such file below the folders that were given")
        for place, folders, files in os.walk(path):  # a recording or data set, whose readers open what is in it
            linked = next((x for x in folders if Path(place, x).is_symlink()), None)
            strange = next((x for x in files if not self._holds(Path(os.path.realpath(Path(place, x))))), linked)
            if strange is not None:
                raise LogError(f"{name!r:.200}: {strange!r:.200} in it is a link that leaves it; put a copy there")
        return path

    def find_description(self, name: str) -> Path:
        """Path of a robot's description, as `find`.

        Raises LogError: as there; ModelError: it takes in a description that is not below the folders.
        """
        path = self.find(name)
        known, left = {path}, [path]
        while left:
            file = left.pop()
            for other in _taken_in(file, name):
                # MuJoCo looks beside the first file, beside the one that names the other, and where it runs.
                places = {Path(os.path.realpath(x / other)) for x in (path.parent, file.parent, self.first, Path.cwd())}
                found = {x for x in places if x.exists()}
                if not all(map(self._holds, found)):
                    raise ModelError(f"{name!r:.200} includes {other!r:.200}, which is not below the given folders")
                left += found - known
                known |= found
        return path

    def _holds(self, real: Path) -> bool:
        """True for a path without links below the folders."""
        return any(real.is_relative_to(root) for root in self.roots)

    def name_of(self, path: Path) -> str:
        """Name of a file relative to the first folder."""
        return os.path.relpath(path, self.first)

    def listed(self) -> dict[str, Any]:
        """Names and sizes of logs and models below the folders, at most 2000, and whether there are more."""
        found: dict[str, list[dict[str, Any]]] = {"logs": [], "models": []}
        n = 0
        for path, is_log in self._walked():
            n += 1
            if n > _MOST:
                break
            size = path.stat().st_size if path.is_file() else 0
            found["logs" if is_log else "models"].append({"name": self.name_of(path), "size": size})
        return {**found, "more": n > _MOST}

    def _walked(self) -> Iterator[tuple[Path, bool]]:
        """Files that may be logs or models; a folder with a recording is a log."""
        for root in self.roots:
            if any(root != other and root.is_relative_to(other) for other in self.roots):
                continue  # what is in it is in the other
            for place, folders, files in os.walk(root):
                folder = Path(place)
                if folder != root and _is_recording(folder):
                    folders[:] = []
                    yield folder, True
                    continue
                deep = len(folder.relative_to(root).parts) >= _DEEPEST
                folders[:] = [] if deep else sorted(x for x in folders if x[0] != "." and x != "__pycache__")
                for name in sorted(files):
                    path, lower = folder / name, name.lower()
                    if lower.endswith((*ENDINGS, *MODELS)) and self._is_inside(path):
                        yield path, lower.endswith(ENDINGS)

    def _is_inside(self, path: Path) -> bool:
        real = Path(os.path.realpath(path))
        return real.is_file() and self._holds(real)


def _is_recording(folder: Path) -> bool:
    """True for a folder with a ROS 2 bag or a LeRobot dataset, which is one log."""
    return (folder / "metadata.yaml").is_file() or (folder / "meta/info.json").is_file()


def _taken_in(file: Path, label: str) -> list[str]:
    """Names of descriptions that one takes in.  Raises ModelError: it cannot be read, or they cannot be told."""
    parser, found = expat.ParserCreate(), list[str]()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag in ("include", "model") and "file" in attributes:
            found.append(attributes["file"])

    parser.StartElementHandler = start
    try:
        content = read_bytes(file, 64 * LARGEST_TABLE)
        parser.Parse(content, True)
    except expat.ExpatError as error:
        if b"include" in content or b"<model" in content:  # MuJoCo is less strict, and might take them in
            raise ModelError(f"{label!r:.200} is no XML: {error}") from error
    except (OSError, ValueError) as error:
        raise ModelError(f"{label!r:.200} cannot be read: {error}") from error
    return found
