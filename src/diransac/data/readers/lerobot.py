"""LeRobot datasets, formats 2.0 to 3.0: a folder of Parquet files with the episodes of a robot.

::

    meta/info.json                         format, rate, and names of the numbers of each feature
    data/chunk-000/episode_000000.parquet  format 2: a file per episode
    data/chunk-000/file-000.parquet        format 3: several episodes, by their column ``episode_index``

A feature is a column with one number or a list of numbers per row.  No path is taken from ``meta/info.json``: files are
those that are there.

References: Hugging Face, LeRobot, "LeRobotDataset v3.0".
"""

from __future__ import annotations

import math
import os
import re
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data.readers.parquet import is_numeric, numbers_of, scanned
from diransac.data.readers.table import Table, check_size, check_unique, readable
from diransac.errors import LogError
from diransac.limits import LARGEST_LOG, LARGEST_TABLE, MOST_COUNTED, beyond, read_bytes
from diransac.plain_data import json_data, read_text
from diransac.plain_text import one_line

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import polars as pl

_EPISODE = re.compile(r"(?:episode_|train-)(\d{1,9})(?:-of-\d{1,9})?\.parquet")
_FILE = re.compile(r"file-\d{1,9}\.parquet")
_INDEX = "episode_index"
_WIDEST = 1000
"""Numbers of a feature per row; images are larger."""


class LerobotDataset:
    """Episodes of a dataset, which are read one at a time.

    Parameters
    ----------
    folder : Path
    source : str
        Name in messages, such as ``log "pusht"``.

    Raises
    ------
    LogError
        ``meta/info.json`` cannot be read, is of another format, or there is no episode.
    """

    def __init__(self, folder: Path, source: str) -> None:
        self.folder, self.source = folder, source
        self._info = _information(self._inside(folder / "meta" / "info.json"), source)
        self._last: tuple[Path, bytes] | None = None

    @cached_property
    def files(self) -> dict[int, Path]:
        """File of each episode, in their order.

        Raises LogError: there is none; two files have one episode; a file is damaged, or leads out of the folder.
        """
        found: dict[int, Path] = {}
        for file in sorted(self._data_files()):
            match = _EPISODE.fullmatch(file.name)
            for episode in [int(match[1])] if match else self._episodes_in(file):
                if episode in found:
                    names = f'"{found[episode].name}" and "{file.name}"'
                    raise LogError(f"{self.source}: {names} both have episode {episode}; remove one of them")
                found[episode] = file
        if not found:
            raise LogError(
                f"{self.source}: there is no episode in data/chunk-*/episode_*.parquet or file-*.parquet; "
                "download the dataset with its data"
            )
        return dict(sorted(found.items()))

    def table(self, episode: int) -> Table:
        """Table of an episode: ``observation.state.shoulder`` is the number ``shoulder`` of the feature.

        Raises LogError: there is no such episode, or its file is damaged or too large.
        """
        if episode not in self.files:
            raise LogError(f"{self.source}: there is no episode {episode}; found {self.listed}")
        with scanned(self._content(self.files[episode]), self.source) as (lazy, schema):
            # Columns that count rows, episodes and tasks are no signals.
            counters = (_INDEX, "frame_index", "index", "task_index")
            kinds = {name: kind for name, kind in schema.items() if name not in counters}
            read = [name for name, kind in kinds.items() if is_numeric(kind) or self._is_vector(name, kind)]
            counted = ["frame_index"] if "frame_index" in schema and is_numeric(schema["frame_index"]) else []
            if _FILE.fullmatch(self.files[episode].name):
                import polars as pl

                lazy = lazy.filter(pl.col(_INDEX) == episode)
            frame = lazy.select(read + counted).collect()
            widths = {name: _width(frame[name]) for name in read}
            numbers = sum(width for width in widths.values() if isinstance(width, int))
            check_size(self.source, len(frame), numbers)
            vectors = {
                name: width if isinstance(width, str) else _matrix(frame[name], width) for name, width in widths.items()
            }
            counts = numbers_of(frame["frame_index"]) if counted else np.arange(float(len(frame)))
        left = {name: f"holds no short lists of numbers ({kinds[name]!s:.40})" for name in kinds if name not in read}
        pieces = [piece for name, values in vectors.items() for piece in self._columns(name, values)]
        columns: dict[str, FloatArray | str] = {name: values for name, values in pieces if name != "timestamp"}
        check_unique([name for name, _ in pieces], self.source)
        time = self._time(vectors.get("timestamp"), counts)
        timed: dict[str, FloatArray | str] = {"t": time} if time is not None and "t" not in columns else {}
        step = {"step": "episode", "episode": episode, "format": self._info["codebase_version"]}
        robot = self._info.get("robot_type")
        step |= {"robot": one_line(robot)} if isinstance(robot, str) else {}
        return Table(timed | columns | left, {"t": "s"}, history=(step,), elements=self.joints)

    @property
    def listed(self) -> str:
        """The episodes in words: ``50 episodes, 0 to 49``."""
        own = list(self.files)
        return f"episode {own[0]}" if len(own) == 1 else f"{len(own)} episodes, {own[0]} to {own[-1]}"

    @property
    def joints(self) -> tuple[str, ...]:
        """Names in state and action without the ending of their quantity, ``.pos`` and the like."""
        named = [name for feature in ("observation.state", "action") for name in _names(self._features.get(feature))]
        return tuple(dict.fromkeys(_without_quantity(name) for name in named))

    # ------------------------------------------------------------------ files

    def _inside(self, path: Path) -> Path:
        """The path itself.  Raises LogError: links lead from it out of the folder, or out of the hub's cache of it."""
        root = Path(os.path.realpath(self.folder))
        places = [root, *([root.parent.parent / "blobs"] if root.parent.name == "snapshots" else [])]
        target = Path(os.path.realpath(path))
        if not any(target.is_relative_to(place) for place in places):
            shown = path.relative_to(self.folder)
            raise LogError(f'{self.source}: "{shown}" is a link out of the folder; copy the dataset with its files')
        return path

    def _data_files(self) -> Iterator[Path]:
        """Files with episodes.  Raises LogError: they cannot be listed."""
        data, n = self.folder / "data", 0
        try:
            folders = data.iterdir() if data.is_dir() else ()
            chunks = [chunk for chunk in folders if re.fullmatch(r"chunk-\d{1,9}", chunk.name)]
            for chunk in map(self._inside, chunks):
                for file in chunk.iterdir() if chunk.is_dir() else ():
                    if _EPISODE.fullmatch(file.name) or _FILE.fullmatch(file.name):
                        if (n := n + 1) > MOST_COUNTED:
                            raise LogError(f"{self.source}: it has {beyond(MOST_COUNTED, 'files')}; split it")
                        yield file
        except OSError as error:
            raise LogError(f"{self.source}: its folder data cannot be read: {error.strerror}") from error

    def _content(self, file: Path) -> bytes:
        """Bytes of a file; those of the last one are kept."""
        if self._last is None or self._last[0] != file:
            with readable(f'{self.source}: "{self._inside(file).relative_to(self.folder)}"'):
                self._last = file, read_bytes(file, LARGEST_LOG)
        return self._last[1]

    def _episodes_in(self, file: Path) -> list[int]:
        """Episodes of a file with several."""
        with scanned(self._content(file), f'{self.source}: "{file.name}"') as (lazy, schema):
            if _INDEX not in schema or not schema[_INDEX].is_integer():
                raise LogError(f'{self.source}: "{file.name}" has no whole numbers in a column {_INDEX}')
            found = lazy.select(_INDEX).unique().collect()[_INDEX]
        if found.null_count() or (len(found) and int(found.min()) < 0):  # type: ignore[arg-type]
            raise LogError(f'{self.source}: "{file.name}" has rows without a number in {_INDEX}')
        return sorted(map(int, found.to_list()))

    # ------------------------------------------------------------------ columns

    @property
    def _features(self) -> dict[str, Any]:
        """Features by name, as far as ``meta/info.json`` describes them."""
        found = self._info.get("features")
        return {name: x for name, x in found.items() if isinstance(x, dict)} if isinstance(found, dict) else {}

    def _is_vector(self, name: str, kind: pl.DataType) -> bool:
        """True for lists of numbers that are short by type and by description."""
        import polars as pl

        if isinstance(kind, pl.Array):
            return len(kind.shape) == 1 and kind.shape[0] <= _WIDEST and is_numeric(kind.inner)  # type: ignore[arg-type]
        shape = self._features.get(name, {}).get("shape")
        lengths = shape if isinstance(shape, list) else []
        small = all(type(n) is int and 0 <= n <= _WIDEST for n in lengths) and math.prod(lengths) <= _WIDEST
        return isinstance(kind, pl.List) and small and is_numeric(kind.inner)  # type: ignore[arg-type]

    def _columns(self, feature: str, values: FloatArray | str) -> list[tuple[str, FloatArray | str]]:
        """A column for each number of a feature, under its name or its index."""
        if isinstance(values, str) or values.ndim == 1:
            return [(feature, values)]
        width, names = values.shape[1], _names(self._features.get(feature))
        if len(set(names)) == len(names) == width:
            return [(f"{feature}.{name}", values[:, k].copy()) for k, name in enumerate(names)]
        return [(f"{feature}[{k}]", values[:, k].copy()) for k in range(width)]

    def _time(self, stamps: FloatArray | str | None, counts: FloatArray) -> FloatArray | None:
        """Seconds of the rows; those of the rate where stamps agree to single precision, or are missing."""
        fps: Any = self._info.get("fps")
        even: FloatArray | None = counts / float(fps) if type(fps) in (int, float) and 1e-6 < fps < 1e9 else None
        if not isinstance(stamps, np.ndarray) or stamps.ndim != 1:
            return even
        if even is not None and len(even) and np.abs(stamps - even).max() <= 2.0**-22 * np.abs(even).max():
            return even
        return stamps


def _information(path: Path, source: str) -> Mapping[str, Any]:
    """Content of ``meta/info.json``.  Raises LogError: it cannot be read, or is of another format."""
    try:
        found = json_data(read_text(path, LARGEST_TABLE))
    except OSError as error:
        raise LogError(f"{source}: its meta/info.json cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise LogError(f"{source}: its meta/info.json is not JSON that can be read ({error!s:.100})") from error
    version = found.get("codebase_version") if isinstance(found, dict) else None
    if not isinstance(version, str) or not re.fullmatch(r"v[23]\.\d{1,3}", version):
        what = "no dataset of LeRobot" if version is None else f"a dataset of LeRobot's format {version!s:.20}"
        raise LogError(f"{source}: by its meta/info.json it is {what}; formats v2.0 to v3.0 are read, convert it")
    return dict(found)


def _names(feature: Any) -> list[str]:
    """Names of a feature's numbers: a list, or lists in a mapping or list; empty where they are anything else."""
    names = feature.get("names") if isinstance(feature, dict) else None
    groups = list(names.values()) if isinstance(names, dict) else [names]
    if len(groups) == 1 and isinstance(groups[0], list) and all(isinstance(x, list) for x in groups[0]):
        groups = groups[0]
    flat = [name for group in groups if isinstance(group, list) for name in group]
    usable = all(isinstance(name, str) and name == name.strip() and name for name in flat)
    return flat if usable else []


def _without_quantity(name: str) -> str:
    # Endings of the names of numbers that belong to one joint.
    ending = next((x for x in (".pos", ".vel", ".torque", ".effort", ".current") if name.endswith(x) and name != x), "")
    return name.removesuffix(ending)


def _width(series: pl.Series) -> int | str:
    """Numbers per row of a column, or the reason why it is no signal."""
    import polars as pl

    if is_numeric(series.dtype):
        return 1
    counts = series.list.len() if isinstance(series.dtype, pl.List) else series.arr.len()
    lengths = counts.drop_nulls().to_numpy()
    if not len(lengths):
        return "is empty"
    low, high = int(lengths.min()), int(lengths.max())
    if low != high or not 0 < high <= _WIDEST:
        return f"has {low} to {high} numbers in a row; equal rows of up to {_WIDEST} are read"
    return high


def _matrix(series: pl.Series, width: int) -> FloatArray:
    """Numbers ``(n,)`` or ``(n, width)`` of a column, null as NaN."""
    import polars as pl

    if is_numeric(series.dtype):
        return numbers_of(series)
    full = np.full((len(series), width), np.nan)
    flat = series.drop_nulls().cast(pl.List(pl.Float64)).explode()
    full[series.is_not_null().to_numpy()] = numbers_of(flat).reshape(-1, width)
    return full[:, 0] if width == 1 else full
