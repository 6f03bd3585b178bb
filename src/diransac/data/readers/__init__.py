"""Readers of logs: one module per format, imported at its first use, and `read_log` for all formats.

In comes a path; out comes a `Log`.  A module of a format returns a `Table` or a `Recording`, which `reading.py` makes a
log of.  Begin with `npz.py`, a short one.

| file | contents |
|---|---|
| `comma_separated.py`, `npz.py`, `parquet.py`, `mat.py`, `hdf5.py` | formats with one table |
| `ulog.py`, `bags.py`, `crazyflie.py` | formats with topics |
| `lerobot.py` | a folder of episodes |
| `table.py` | `Table`, and what readers of tables share |
| `recording.py`, `topics.py` | `Recording`, topics with clocks of their own; their one table |
| `reading.py`, `repair.py` | `Reading`: from contents to a log; repairs of faults |
| `growing.py` | files that grow while they are read |
"""

from __future__ import annotations

import importlib
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diransac.data.files import place_of_metadata
from diransac.data.log import Log
from diransac.data.readers.reading import Reading
from diransac.data.readers.repair import Repairs
from diransac.data.readers.table import Table, readable, with_metadata
from diransac.errors import LogError
from diransac.limits import LARGEST_LOG, LARGEST_RESULT, LARGEST_TEXT, MOST_COUNTED, check_ordinary, read_bytes
from diransac.plain_text import one_line

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from diransac.data.readers.lerobot import LerobotDataset
    from diransac.data.readers.recording import Recording
    from diransac.data.readers.topics import TopicTable

__all__ = ["ENDINGS", "episodes_of", "read_fields", "read_log", "read_logs", "read_topics"]

_TABLES = {
    ".parquet": "parquet:read_parquet",
    ".npz": "npz:read_npz",
    ".mat": "mat:read_mat",
    ".h5": "hdf5:read_hdf5",
    ".hdf5": "hdf5:read_hdf5",
}
_TEXTS = {
    ".csv": "comma_separated:read_csv",
    ".csv.gz": "comma_separated:read_csv_gz",
    ".tsv": "comma_separated:read_csv",
    ".txt": "comma_separated:read_csv",
}
_RECORDINGS = {
    ".ulg": "ulog:UlogRecording",
    ".ulog": "ulog:UlogRecording",
    ".mcap": "bags:open_mcap",
    ".bag": "bags:open_bag",
}
"""Ending -> module of this package, and what opens or reads a file there."""
_REMEDIES = {
    ".xlsx .xls .ods": "export the sheet as CSV",
    ".dat .asc .log .prn": "if it is text, rename it to .txt",
    ".json .jsonl .pkl .pickle .feather": "write it as CSV or Parquet",
    ".bbl .bfl": "convert it to CSV by Betaflight's blackbox_decode",
    ".db3 .yaml": "name the folder of the bag",
    ".bin": "of ArduPilot's, convert it to CSV by mavlogdump.py",
    ".npy": "name its columns: np.savez(file, t=..., x=...)",
}
"""Endings that are not read -> what to do."""

ENDINGS = (*_TEXTS, *_TABLES, *_RECORDINGS)
"""Endings of files that are read, lower case; some files have none, and some logs are folders."""


def read_log(
    path: str | Path,
    *,
    episode: int | None = None,
    mapping: str | Path | None = None,
    columns: Sequence[str] | None = None,
    rate: float | None = None,
    repair: bool | str | Iterable[str] | None = None,
    rename: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    resample: float | str | None = None,
    unmeasured: Iterable[str] | None = None,
    like: Iterable[Mapping[str, Any]] = (),
) -> Log:
    """Log of a CSV (plain or gzip), Parquet, NPZ, MAT, HDF5, ULog, MCAP or bag file, Crazyflie's log, LeRobot episode.

    Parameters
    ----------
    path : str or Path
        Its ending names the format; a folder is a ROS 2 bag, a LeRobot dataset, or has a CSV file per group of signals.
    episode : int, optional
        Of a dataset with several; `read_logs` reads them all.
    mapping : str or Path, optional
        Name of a built-in mapping, or a TOML file, that says which field of which topic is which signal.
    columns : sequence of str, optional
        Names of the columns of CSV text without a header line.
    rate : float, optional
        Hz, of a table without a time column.
    repair : bool, str or iterable of str, optional
        Repairs by name, True or "safe" for all; `diransac.data.readers.repair.REPAIRS` lists them.
    rename : mapping of str to str, optional
        New name -> name of the column in the file; ``{"t": "t_s"}`` names the time.  Of a file with topics,
        ``topic.field``.
    scale : mapping of str to float, optional
        (New) name -> factor; ``{"t": 0.001}`` for a time in milliseconds.
    resample : float or "median", optional
        Rate in Hz for linear interpolation, or ``"median"`` for one row per median interval.  None: the time must be
        even.
    unmeasured : iterable of str, optional
        Coordinates that the log lacks although a column has a name like theirs.
    like : iterable of dict, optional
        History of a log of the same recorder, such as ``result.logs[0].preparation``, whose mapping, names, factors,
        rates, repairs, delays and despiking apply where none is given and the history in the file itself has none.

    Returns
    -------
    Log
        With the units, filter, history and notes of a log that `Log.write` has written.

    Raises
    ------
    LogError
        The file cannot be read, or does not hold a log; one sentence says where, and what to do.
    SettingsError
        There is no repair of that name; a factor or a rate has no meaning.

    Notes
    -----
    The time is the column ``t``, else the only one with a name such as ``time`` or ``t_ms``, in the unit of its header
    or name.  Every other column is a signal; one without numbers is left out, with a note.  A header ``theta [deg]`` is
    the signal ``theta`` in degrees.  Rows count from 0, lines of text from 1.  Of topics, the rows are those of the
    fastest, or at ``resample`` Hz; a sample of a slower one stands in the nearest row, and rows between are NaN.
    """
    path = Path(path)
    given = Reading.given(
        mapping,
        columns=columns,
        rate=rate,
        repair=repair,
        rename=rename,
        scale=scale,
        resample=resample,
        unmeasured=unmeasured,
    )
    history, dataset = list(like), _dataset(path)
    if dataset is not None:
        return _episode(dataset, _only(dataset) if episode is None else episode, given, history)
    if episode is not None:
        raise LogError(f"{_named(path)}: it is one log without episodes; leave out the episode")
    return given.log(partial(_opened, path, _named(path)), _named(path), history)


def read_logs(path: str | Path, *, episodes: Iterable[int] | None = None, **arguments: Any) -> list[Log]:
    """Logs of a file or folder: one per episode of a LeRobot dataset, else one.

    Parameters
    ----------
    path : str or Path
    episodes : iterable of int, optional
        Episodes of a dataset, in this order; None: all.
    **arguments
        As of `read_log`; they apply to each.

    Returns
    -------
    list of Log

    Raises
    ------
    LogError, SettingsError
        As `read_log`; there is no such episode, or one is named twice.
    """
    path = Path(path)
    dataset = _dataset(path)
    if dataset is None:
        if episodes is not None:
            raise LogError(f"{_named(path)}: it is one log without episodes; leave out their numbers")
        return [read_log(path, **arguments)]
    history = list(arguments.pop("like", ()))
    given = Reading.given(**arguments)
    chosen = list(dataset.files if episodes is None else islice(episodes, MOST_COUNTED))
    if not chosen or len(set(chosen)) < len(chosen):
        raise LogError(f"{dataset.source}: the episodes are {chosen!s:.60}; name one or several, each once")
    return [_episode(dataset, episode, given, history) for episode in chosen]


def episodes_of(path: str | Path) -> tuple[int, ...]:
    """Episodes of a dataset; none for any other file.

    Raises LogError: the dataset cannot be read.
    """
    dataset = _dataset(Path(path))
    return () if dataset is None else tuple(dataset.files)


def _named(path: Path) -> str:
    return one_line(f'log "{path}"')


def _dataset(path: Path) -> LerobotDataset | None:
    """A folder of episodes; None for anything else."""
    if not (path / "meta/info.json").exists():
        return None
    from diransac.data.readers.lerobot import LerobotDataset

    return LerobotDataset(path, _named(path))


def _only(dataset: LerobotDataset) -> int:
    """The episode of a dataset that has one.  Raises LogError: it has several."""
    first, *more = dataset.files
    if more:
        raise LogError(
            f"{dataset.source}: it has {dataset.listed}; choose one (episode={first}, --episodes {first}), "
            "or read them all with read_logs"
        )
    return first


def _episode(dataset: LerobotDataset, episode: int, given: Reading, history: Sequence[Mapping[str, Any]]) -> Log:
    if given.columns is not None:
        raise LogError(f"{dataset.source}: names of columns are those of CSV text without a header; leave them out")
    source = dataset.source if len(dataset.files) == 1 else f"{dataset.source}, episode {episode}"
    return given.log(lambda _columns, _repairs: dataset.table(episode), source, history)


def read_topics(path: str | Path) -> TopicTable | None:
    """Topics of a recording, with their rates, gaps and fields; None for a file with one table.

    Raises LogError: as `read_log`.
    """
    path = Path(path)
    is_folder_of_tables = path.is_dir() and not _is_bag(path)
    if is_folder_of_tables or _ending(path) in (*_TEXTS, *_TABLES):
        return None
    from diransac.data.readers.topics import list_topics

    opened = _opened(path, _named(path), None, Repairs())
    return None if isinstance(opened, Table) else list_topics(opened)


def read_fields(path: str | Path) -> tuple[dict[str, tuple[str, ...]], dict[str, tuple[str, ...]]]:
    """Fields of each topic of a file, and the names of the elements of its arrays; a table has the topic ``""``.

    Raises LogError: as `read_log`.
    """
    path = Path(path)
    dataset = _dataset(path)
    opened = _opened(path, _named(path), None, Repairs()) if dataset is None else dataset.table(min(dataset.files))
    if isinstance(opened, Table):
        return {"": tuple(name for name in opened.columns if name != "t")}, {"": opened.elements}
    return dict(opened.fields), opened.elements


# ---------------------------------------------------------------------- files


def _opened(path: Path, source: str, columns: Sequence[str] | None, repairs: Repairs) -> Table | Recording:
    """Contents of a file, or of a folder.  Raises LogError: it cannot be read."""
    if path.is_dir():
        return _opened_folder(path, source, repairs)
    ending = _ending(path)
    if ending in _RECORDINGS:
        _check_content(path, source)
        return _imported(_RECORDINGS[ending])(path, source)
    if columns is not None and ending not in _TEXTS:
        raise LogError(f"{source}: names of columns are those of CSV text without a header; leave them out")
    if ending in _TEXTS:
        return _described(path, _imported(_TEXTS[ending])(_content(path, source), source, columns, repairs), source)
    if ending is not None:
        return _imported(_TABLES[ending])(_content(path, source), source)
    from diransac.data.readers.crazyflie import MAGIC, CrazyflieRecording

    _check_content(path, source)
    with path.open("rb") as file:
        is_crazyflie = file.read(1) == MAGIC
    if is_crazyflie:
        return CrazyflieRecording(_content(path, source), source)
    remedy = "".join(f"; {what}" for endings, what in _REMEDIES.items() if path.suffix.lower() in endings.split())
    raise LogError(f'{source}: the ending "{path.suffix}" is not known; use one of {", ".join(ENDINGS)}{remedy}')


def _described(path: Path, read: Table | Recording, source: str) -> Table | Recording:
    """A table with the metadata of the file beside it, where there is one."""
    beside = place_of_metadata(path)
    if not beside.is_file() or not isinstance(read, Table) or read.is_described:
        return read
    return with_metadata(read, _content(beside, f'metadata "{beside}"', LARGEST_RESULT), source, f'remove "{beside}"')


def _imported(place: str) -> Callable[..., Table | Recording]:
    """The function of a module of this package, by ``module:function``."""
    module, _, attribute = place.partition(":")
    found: Callable[..., Table | Recording] = getattr(importlib.import_module(f"{__name__}.{module}"), attribute)
    return found


def _ending(path: Path) -> str | None:
    """The longest known ending of a file's name; None where it has none."""
    return max((x for x in ENDINGS if path.name.lower().endswith(x)), key=len, default=None)


def _is_bag(folder: Path) -> bool:
    return (folder / "metadata.yaml").exists()


def _opened_folder(path: Path, source: str, repairs: Repairs) -> Table | Recording:
    """A ROS 2 bag, or a table of the CSV files in a folder."""
    if _is_bag(path):
        return _imported(_RECORDINGS[".bag"])(path, source)
    files = sorted(x for x in path.iterdir() if x.name.lower().endswith(tuple(_TEXTS)))
    if len(files) < 2:  # one file is a log of its own
        raise LogError(
            f"{source}: it is a folder without a bag, a LeRobot dataset or several CSV files; name a file in it"
        )
    from diransac.data.readers.comma_separated import joined

    return joined([(x.name.split(".")[0], _content(x, f'log "{x}"')) for x in files], source, repairs)


def _check_content(path: Path, source: str) -> None:
    """Raise LogError for a file that cannot be read, or is empty."""
    with readable(source):
        if not check_ordinary(path).st_size:
            raise LogError(f"{source}: it is empty")


def _content(path: Path, source: str, largest: int | None = None) -> bytes:
    """The bytes of a file; with the largest size of a log, unless there is another one."""
    is_text = _ending(path) in _TEXTS and not path.name.lower().endswith(".gz")
    with readable(source):
        data = read_bytes(path, largest or (LARGEST_TEXT if is_text else LARGEST_LOG))
    if not data:
        raise LogError(f"{source}: it is empty")
    return data
