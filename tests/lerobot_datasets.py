"""Support for tests: a writer of LeRobot datasets of both formats, as the library of that name writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

DATA_PATHS = {
    "v2.1": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
    "v3.0": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
}
JOINTS = ["shoulder_pan.pos", "elbow_flex.pos"]


def write_dataset(
    folder: Path,
    episodes: list[dict[str, np.ndarray]],
    *,
    version: str = "v2.1",
    fps: float = 30,
    names: Any = tuple(JOINTS),
    per_file: int = 2,
    **info: Any,
) -> Path:
    """Write episodes, each of which maps a feature to its numbers ``(n, k)`` or ``(n,)``; ``info`` is written last.

    Format 2 has an episode per file and ``meta/episodes.jsonl``, format 3 ``per_file`` episodes per file and
    ``meta/episodes/chunk-000/file-000.parquet``.
    """
    names = list(names) if isinstance(names, tuple) else names
    widths = {feature: values.shape[1:] or (1,) for feature, values in episodes[0].items()}
    features = {f: {"dtype": "float32", "shape": list(w), "names": names} for f, w in widths.items()}
    counters = ("timestamp", "frame_index", "episode_index", "index", "task_index")
    features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in counters}
    n_rows = [len(next(iter(episode.values()))) for episode in episodes]
    about = {
        "codebase_version": version,
        "robot_type": "so101_follower",
        "total_episodes": len(episodes),
        "total_frames": sum(n_rows),
        "chunks_size": 1000,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA_PATHS[version],
        "video_path": None,
        "features": features,
    }
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(about | info, indent=4))
    tables, start = [], 0
    for k, (episode, n) in enumerate(zip(episodes, n_rows, strict=True)):
        tables.append(table_of(episode, k, start, n, fps))
        start += n
    chunk = folder / "data" / "chunk-000"
    chunk.mkdir(parents=True)
    if version.startswith("v2"):
        lines = [{"episode_index": k, "tasks": ["move"], "length": n} for k, n in enumerate(n_rows)]
        (folder / "meta" / "episodes.jsonl").write_text("\n".join(map(json.dumps, lines)) + "\n")
        for k, table in enumerate(tables):
            pq.write_table(table, chunk / f"episode_{k:06d}.parquet")
        return folder
    for k in range(0, len(tables), per_file):
        pq.write_table(pa.concat_tables(tables[k : k + per_file]), chunk / f"file-{k // per_file:03d}.parquet")
    listed = folder / "meta" / "episodes" / "chunk-000"
    listed.mkdir(parents=True)
    places = {"data/chunk_index": [0] * len(tables), "data/file_index": [k // per_file for k in range(len(tables))]}
    facts = {"episode_index": list(range(len(tables))), "length": n_rows, **places}
    pq.write_table(pa.table(facts), listed / "file-000.parquet")
    return folder


def table_of(episode: dict[str, np.ndarray], k: int, start: int, n: int, fps: float) -> pa.Table:
    """Rows of an episode, single precision, as Hugging Face's library of data sets stores features."""
    columns: dict[str, Any] = {}
    for feature, values in episode.items():
        if values.ndim == 1:
            columns[feature] = pa.array(values.astype(np.float32))
        else:
            flat = pa.array(values.astype(np.float32).ravel())
            columns[feature] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    columns["timestamp"] = pa.array((np.arange(n) / fps).astype(np.float32))
    columns |= {"frame_index": np.arange(n), "episode_index": np.full(n, k), "index": start + np.arange(n)}
    return pa.table({**columns, "task_index": np.zeros(n, np.int64)})
