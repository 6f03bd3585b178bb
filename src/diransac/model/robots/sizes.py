"""Sizes of what MuJoCo builds from the file of a robot's description, counted in its text before MuJoCo reads it.

A line of MJCF repeats bodies or declares a field of heights as large as it likes, and MuJoCo's compiler, which has no
limit of time or memory, waits for pipes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from diransac.errors import ModelError
from diransac.limits import LARGEST_TABLE, MOST_CELLS, MOST_ELEMENTS, beyond, check_ordinary, read_bytes


def check_description(path: Path, label: str) -> None:
    """Raise ModelError where a description, or a file that it includes, is no ordinary file or describes too much.

    Text that is no XML passes: MuJoCo says what is wrong with it.
    """
    counts = _Counts(label, path.parent)
    try:
        counts.read(path, 1.0)
        counts.check_files()
    except OSError as error:
        name = f' (of "{Path(error.filename).name}")' if error.filename and Path(error.filename) != path else ""
        raise ModelError(f"{label} cannot be read: {error.strerror}{name}") from error
    except ValueError as error:
        raise ModelError(f"{label} cannot be read: {error}") from error


def check_text(text: bytes, label: str) -> None:
    """Raise ModelError where a description that is to need no other file names one, or describes too much."""
    parser, others = expat.ParserCreate(), list[str]()

    def start(name: str, attributes: Mapping[str, str]) -> None:
        # Attributes that name files: file, fileright, ..., contenttype's file.
        if name in ("include", "plugin", "extension") or any(key.startswith("file") for key in attributes):
            others.append(name)

    parser.StartElementHandler = start
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        raise ModelError(f"{label} is no XML: {error}") from error
    if others:
        raise ModelError(f"{label} needs other files, or plugins, in its element {others[0]}")
    _Counts(label, Path()).count(text, 1.0)


@dataclass
class _Counts:
    """Elements and cells of a description and of the files that it includes.

    Parameters
    ----------
    label : str
    folder : Path
        Of the description; names of files are relative to it.
    """

    label: str
    folder: Path
    elements: float = 0.0
    cells: float = 0.0
    files: set[str] = field(default_factory=set)
    folders: set[str] = field(default_factory=lambda: {""})
    included: set[Path] = field(default_factory=set)

    def read(self, path: Path, copies: float) -> None:
        """Count what a file has, so many times.  Raises ModelError, OSError, ValueError: as `check_description`."""
        self.count(read_bytes(path, 64 * LARGEST_TABLE), copies)

    def count(self, content: bytes, copies: float) -> None:
        """Count what a text has, so many times."""
        stack = [copies]
        parser = expat.ParserCreate()

        def start(name: str, attributes: Mapping[str, str]) -> None:
            # Attributes whose product is a number of elements, or of points of fields of heights and of
            # textures.
            own = stack[-1] * math.prod(_numbers(attributes, ("count",)))
            stack.append(own)
            self._add(own, own * math.prod(_numbers(attributes, ("nrow", "ncol", "width", "height"))))
            self.folders |= {attributes[key] for key in ("meshdir", "texturedir", "assetdir") if key in attributes}
            if name == "include":
                self._include(attributes.get("file", ""), own)
            elif "file" in attributes:
                self.files.add(attributes["file"])

        parser.StartElementHandler = start
        parser.EndElementHandler = lambda _name: stack.pop()
        try:
            parser.Parse(content, True)
        except expat.ExpatError:
            return

    def _add(self, elements: float, cells: float) -> None:
        self.elements += elements
        self.cells += cells
        for found, most, what in (
            (self.elements, MOST_ELEMENTS, "elements"),
            (self.cells, MOST_CELLS, "cells of textures and fields of heights"),
        ):
            if found > most:
                raise ModelError(f"{self.label} has {beyond(most, what)}; leave out what does not move")

    def _include(self, name: str, copies: float) -> None:
        path = self.folder / name
        if name and path.exists() and path not in self.included:  # MuJoCo refuses to include a file again
            self.included.add(path)
            self.read(path, copies)

    def check_files(self) -> None:
        """Raise OSError: a mesh, texture or the like is no ordinary file."""
        for name in self.files:
            for path in (self.folder / x / name for x in self.folders):
                if path.exists():
                    check_ordinary(path)


def _numbers(attributes: Mapping[str, str], names: tuple[str, ...]) -> Iterator[float]:
    """Numbers in some attributes, each at least 1; what is no number counts as 1."""
    for name in names:
        for text in attributes.get(name, "").split():
            try:
                yield max(float(text), 1.0)
            except ValueError:
                continue
