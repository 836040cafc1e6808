"""Writes and reads LeRobotDataset v3.0, with Arrow only.

Source of the format: huggingface/lerobot 0.4.4 and 0.6.1, ``src/lerobot/datasets``. A piece is a Parquet file of steps
(``data/``) and one of episodes (``meta/episodes/``); the index is ``meta/info.json``. The episodes' columns ``success`` and
``number`` are our additions to the format.
"""

import concurrent.futures
import functools
import importlib
import json
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mjx_nero import files
from mjx_nero.config.values import read
from mjx_nero.data import folder, stats, video
from mjx_nero.data import lerobot_files as lf
from mjx_nero.data.episode import Episode, Schema, check
from mjx_nero.data.lerobot_files import pa, parquet
from mjx_nero.errors import UserError

_PLAIN = {"use_dictionary": False, "write_statistics": False}  # numbers rarely repeat, and both would take most of the time


class LeRobotForm:
    """See ``dataset.Form``."""

    def __init__(self, path: pathlib.Path, schema: Schema):
        self.path, self.schema = path, schema
        self.lengths, self.numbers, self.success = np.zeros(0, int), np.zeros(0, int), np.zeros(0, bool)
        self._pieces = 0
        self._pictures = [name for name, feature in schema.features.items() if feature.picture]
        if self._pictures:
            importlib.import_module("av")  # before the first episode is played
        index = files.inside(path, *lf.INFO.split("/"))
        if index.exists():
            self._load(files.read_json(index), index)

    def _load(self, found: Any, index: pathlib.Path) -> None:
        """Reads as many pieces as the index lists."""
        try:
            total = read(int, found["total_episodes"], "total_episodes")
            while len(self.lengths) < total:
                table = parquet.read_table(self._place(lf.EPISODES, self._pieces), columns=["length", "number", "success"])
                self._add(*(table[name].to_numpy() for name in table.column_names))
            if self.lengths.sum() != found["total_frames"] or len(self.lengths) != total:
                raise ValueError
        except (KeyError, TypeError, ValueError, OSError, pa.ArrowException):
            raise UserError(f"{index} does not match the files beside it: the data set is damaged, write it again") from None

    def _add(self, lengths: np.ndarray, numbers: np.ndarray, success: np.ndarray) -> None:
        self.lengths = np.concatenate([self.lengths, lengths])
        self.numbers = np.concatenate([self.numbers, numbers])
        self.success = np.concatenate([self.success, success])
        self._pieces += 1

    def _place(self, pattern: str, piece: int) -> pathlib.Path:
        return files.inside(self.path, *lf.name_of(pattern, piece).split("/"))

    def tidy(self) -> None:
        """Removes files of a piece that the index does not list, because their process died between two renames."""
        for pattern in (lf.DATA, lf.EPISODES, *map(lf.film, self._pictures)):
            self._place(pattern, self._pieces).unlink(missing_ok=True)

    def put(self, episodes: Sequence[Episode]) -> None:
        """Adds episodes as a piece, whole or not at all.

        Raises:
            UserError: it cannot be written.
        """
        steps, of_pictures = self._steps(episodes), dict[str, list[stats.Stats]]()
        totals = len(self.lengths) + len(episodes), int(self.lengths.sum()) + steps.num_rows
        first = {} if self._pieces else {lf.TASKS: lambda path: parquet.write_table(lf.tasks(self.schema.task), path)}

        def film(name: str, path: pathlib.Path) -> None:
            films = [(len(each), each.pictures[name]) for each in episodes]
            of_pictures[name] = video.write(path, films, self.schema.features[name].shape, self.schema.fps)

        folder.commit(
            self.path,
            {
                **first,
                **{lf.name_of(lf.film(name), self._pieces): functools.partial(film, name) for name in self._pictures},
                lf.name_of(lf.DATA, self._pieces): lambda path: parquet.write_table(steps, path, **_PLAIN),
                lf.name_of(lf.EPISODES, self._pieces): lambda path: parquet.write_table(
                    self._about(episodes, of_pictures), path, **_PLAIN
                ),
                lf.INFO: lambda path: path.write_text(json.dumps(lf.info(self.schema, *totals), indent=2)),
            },
        )
        self._add(*(np.array(x) for x in zip(*((len(each), each.number, each.success) for each in episodes), strict=True)))

    def finish(self) -> None:
        """Writes the statistics of the whole data set."""
        if len(self.lengths):
            names = [name for name in [*self.schema.features, *lf.OWN] if name not in self._pictures]
            with concurrent.futures.ThreadPoolExecutor(2) as pool:  # each holds a whole column in memory
                found = pool.map(lambda name: stats.of(self.column(name)), names)
            plain = {name: {k: v.tolist() for k, v in each.items()} for name, each in zip(names, found, strict=True)}
            for name in self._pictures:
                plain[name] = lf.per_channel(stats.together(self._of_pictures(name)))
            files.write_json(self.path / lf.STATS, plain)

    def _of_pictures(self, name: str) -> list[stats.Stats]:
        """Returns a camera's statistics of each episode."""
        wanted = [*stats.QUANTILES, "min", "max", "mean", "std", "count"]
        out = []
        for piece in range(self._pieces):
            table = parquet.read_table(self._place(lf.EPISODES, piece), columns=[f"stats/{name}/{what}" for what in wanted])
            out += [{what: np.ravel(row[f"stats/{name}/{what}"]) for what in wanted} for row in table.to_pylist()]
        return out

    def column(self, name: str) -> np.ndarray:
        """Returns all steps of a feature, episode by episode: [steps, numbers], or [steps, height, width, 3]."""
        feature = self.schema.features.get(name)
        dtype, size = (feature.dtype, feature.size) if feature else (lf.OWN[name], 1)
        try:
            if name in self._pictures:
                return np.stack(list(self.frames(name)))
            parts = [
                lf.flat(parquet.read_table(self._place(lf.DATA, i), columns=[name])[name])
                .astype(dtype, copy=False)
                .reshape(-1, size)
                for i in range(self._pieces)
            ]
            out = np.concatenate([np.zeros((0, size), dtype), *parts])
            if len(out) != self.lengths.sum():
                raise ValueError
        except (OSError, ValueError, KeyError, pa.ArrowException):
            raise UserError(f"{self.path} is damaged (its steps of {name} cannot be read): write the data set again") from None
        return out

    def frames(self, name: str) -> Iterator[np.ndarray]:
        """Yields a camera's frames."""
        for piece in range(self._pieces):
            yield from video.frames(self._place(lf.film(name), piece))

    def _steps(self, episodes: Sequence[Episode]) -> pa.Table:
        for episode in episodes:
            check(episode, self.schema)
        columns = {}
        for name, feature in self.schema.features.items():
            if feature.picture:
                continue
            flat = pa.array(np.concatenate([episode.arrays[name] for episode in episodes]).reshape(-1))
            columns[name] = flat if feature.size == 1 else pa.FixedSizeListArray.from_arrays(flat, feature.size)
        return pa.table({**columns, **self._own(episodes)})

    def _own(self, episodes: Sequence[Episode]) -> dict[str, np.ndarray]:
        """Returns the columns of ``lf.OWN``."""
        lengths = [len(episode) for episode in episodes]
        frame, first = np.concatenate([np.arange(n) for n in lengths]), int(self.lengths.sum())
        return {
            "timestamp": (frame / self.schema.fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.repeat(len(self.lengths) + np.arange(len(lengths)), lengths),
            "index": first + np.arange(len(frame)),
            "task_index": np.zeros(len(frame), np.int64),
        }

    def _about(self, episodes: Sequence[Episode], of_pictures: Mapping[str, Sequence[stats.Stats]]) -> pa.Table:
        """Makes one row per episode: its place, its description, and its own statistics, which LeRobot's tools combine."""
        n, lengths = len(episodes), np.array([len(episode) for episode in episodes])
        chunk, file = (np.full(n, x) for x in divmod(self._pieces, lf.CHUNK))
        ends, begin, fps = np.cumsum(lengths), int(self.lengths.sum()), self.schema.fps
        values = {
            **{name: np.concatenate([episode.arrays[name] for episode in episodes]) for name in episodes[0].arrays},
            **{name: column[:, None] for name, column in self._own(episodes).items()},
        }
        columns = {
            "episode_index": len(self.lengths) + np.arange(n),
            "tasks": [[self.schema.task]] * n,
            "length": lengths,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": begin + ends - lengths,
            "dataset_to_index": begin + ends,
            "success": [episode.success for episode in episodes],
            "number": [episode.number for episode in episodes],
            "meta/episodes/chunk_index": chunk,
            "meta/episodes/file_index": file,
            **lf.statistics(values, lengths),
        }
        for name in self._pictures:
            columns |= {f"videos/{name}/chunk_index": chunk, f"videos/{name}/file_index": file}
            columns |= {f"videos/{name}/from_timestamp": (ends - lengths) / fps, f"videos/{name}/to_timestamp": ends / fps}
            of_each = [lf.per_channel(found) for found in of_pictures[name]]
            columns |= {f"stats/{name}/{what}": [found[what] for found in of_each] for what in of_each[0]}
        return pa.table(columns)
