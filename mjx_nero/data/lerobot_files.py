"""Names and contents of the files of a LeRobotDataset v3.0."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import parquet as parquet

from mjx_nero.data import stats, video
from mjx_nero.data.episode import Schema

VERSION, CHUNK = "v3.0", 1000  # version of the format; files per folder
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
_PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA, EPISODES, VIDEOS = (
    f"data/{_PLACE}",
    f"meta/episodes/{_PLACE}",
    "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
)
OWN = {  # columns that the format requires for every step
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}


def statistics(values: Mapping[str, np.ndarray], lengths: np.ndarray) -> dict[str, pa.Array]:
    """Computes the columns ``stats/<feature>/<statistic>`` of each episode, for all features at once.

    Args:
        values: name -> [steps, numbers], episode by episode.
        lengths: number of steps of each episode [n].
    """
    together = stats.of_each(np.concatenate(list(values.values()), axis=1, dtype=np.float32), lengths)
    ends = np.cumsum([x.shape[1] for x in values.values()])[:-1]
    out: dict[str, pa.Array] = {}
    for what, found in together.items():
        parts = [found] * len(values) if what == "count" else np.split(found, ends, axis=1)
        out |= {f"stats/{name}/{what}": rows(part) for name, part in zip(values, parts, strict=True)}
    return out


def rows(values: np.ndarray) -> pa.Array:
    """Makes a column of lists from an array [n, numbers]."""
    n, size = values.shape
    return pa.ListArray.from_arrays(np.arange(n + 1, dtype=np.int32) * size, np.ravel(values))


def info(schema: Schema, episodes: int, steps: int) -> dict[str, Any]:
    """Returns the content of the index."""
    features: dict[str, Any] = {
        name: {"dtype": feature.dtype, "shape": list(feature.shape), "names": list(feature.names)}
        for name, feature in schema.features.items()
    }
    films = [name for name, feature in schema.features.items() if feature.picture]
    for name in films:
        features[name]["info"] = video.describe(schema.features[name].shape, schema.fps)
    features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in OWN.items()}
    return {
        "codebase_version": VERSION,
        "robot_type": schema.robot,
        "total_episodes": episodes,
        "total_frames": steps,
        "total_tasks": 1,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": round(schema.fps) if abs(schema.fps - round(schema.fps)) < 1e-6 else schema.fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": DATA,
        "video_path": VIDEOS if films else None,
        "features": features,
    }


def tasks(sentence: str) -> pa.Table:
    """Makes the table of tasks: a pandas table of the task's number, whose index is the task's sentence."""
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [sentence]})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    about = {"index_columns": ["task"], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    return table.replace_schema_metadata({"pandas": json.dumps(about)})


def per_channel(found: stats.Stats) -> dict[str, Any]:
    """Converts statistics of pictures to LeRobot's shape, [3, 1, 1]."""
    return {what: x.tolist() if what == "count" else [[[float(c)]] for c in x] for what, x in found.items()}


def film(name: str) -> str:
    """Returns the pattern of a camera's file names."""
    return VIDEOS.replace("{video_key}", name)


def name_of(pattern: str, piece: int) -> str:
    """Returns the file name of a piece."""
    chunk, file = divmod(piece, CHUNK)
    return pattern.format(chunk_index=chunk, file_index=file)


def flat(column: pa.ChunkedArray) -> np.ndarray:
    """Returns all numbers of a column as one array."""
    flat = column.combine_chunks()
    return (flat.flatten() if pa.types.is_nested(flat.type) else flat).to_numpy(zero_copy_only=False)
