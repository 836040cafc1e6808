"""The plain form: a safetensors file a piece, each feature one array, and an index. ``safetensors.numpy.load_file`` reads it."""

import json
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from mjx_nero import files
from mjx_nero.config.values import read
from mjx_nero.data import folder
from mjx_nero.data.episode import Dataset, Episode, Feature, Schema, check
from mjx_nero.errors import UserError

INDEX = "meta/pieces.json"
_LENGTHS = "lengths"  # of a piece's episodes, beside the features


class ArraysForm:
    """See ``dataset.Form``."""

    def __init__(self, path: pathlib.Path, schema: Schema):
        self.path, self.schema = path, schema
        self._pieces: list[dict[str, Any]] = []
        index = files.inside(path, *INDEX.split("/"))
        if index.exists():
            try:
                found = files.read_json(index, limit=100_000_000)
                self._pieces = [{name: read(tuple[int, ...], piece[name], name) for name in _COLUMNS} for piece in found]
            except (KeyError, TypeError):
                raise UserError(f"{index} is damaged: make the data set anew") from None

    def _column(self, name: str) -> np.ndarray:
        return np.array([x for piece in self._pieces for x in piece[name]], int)

    @property
    def lengths(self) -> np.ndarray:
        """Steps of each episode."""
        return self._column("lengths")

    @property
    def numbers(self) -> np.ndarray:
        """Number of each episode."""
        return self._column("numbers")

    @property
    def success(self) -> np.ndarray:
        """Success of each episode, bool."""
        return self._column("success").astype(bool)

    def tidy(self) -> None:
        """Removes a piece that the index does not know of."""
        (self.path / _name(len(self._pieces))).unlink(missing_ok=True)

    def put(self, episodes: Sequence[Episode]) -> None:
        """Adds a piece, whole or not at all.

        Raises:
            UserError: it cannot be written.
        """
        for episode in episodes:
            check(episode, self.schema)
        arrays = {  # in the order of C: safetensors writes the memory as it lies
            name: np.ascontiguousarray(np.concatenate([_array(each, name, feature) for each in episodes]))
            for name, feature in self.schema.features.items()
        }
        piece = {
            "lengths": [len(each) for each in episodes],
            "numbers": [each.number for each in episodes],
            "success": [int(each.success) for each in episodes],
        }
        pieces = [*self._pieces, piece]
        arrays[_LENGTHS] = np.array(piece["lengths"])
        folder.commit(
            self.path,
            {
                _name(len(self._pieces)): lambda path: _save(arrays, path),
                INDEX: lambda path: path.write_text(json.dumps(pieces)),
            },
        )
        self._pieces = pieces

    def finish(self) -> None:
        """Does nothing: all is written."""

    def column(self, name: str) -> np.ndarray:
        """All steps of a feature, one episode after another [steps, numbers], or [steps, height, width, 3]."""
        feature = self.schema.features[name]
        dtype = "uint8" if feature.picture else feature.dtype
        out = [np.zeros((0, *feature.shape), dtype)]
        try:
            for i in range(len(self._pieces)):
                with safe_open(files.inside(self.path, *_name(i).split("/")), framework="numpy") as file:
                    out.append(file.get_tensor(name).astype(dtype, copy=False).reshape(-1, *feature.shape))
            found = np.concatenate(out)
            if len(found) != self.lengths.sum():
                raise ValueError
        except (SafetensorError, OSError, ValueError):
            raise UserError(f"{self.path} is damaged: its steps of {name} cannot be read, make it anew") from None
        return found

    def frames(self, name: str) -> Iterator[np.ndarray]:
        """A camera's frames, one after another."""
        for i in range(len(self._pieces)):
            with safe_open(files.inside(self.path, *_name(i).split("/")), framework="numpy") as file:
                part = file.get_slice(name)
                for k in range(part.get_shape()[0]):
                    yield part[k : k + 1][0]

    def dataset(self) -> Dataset:
        """The data set as it is."""
        return Dataset(self.schema, self.lengths, self.success, self.numbers, self.column, self.frames)


def _save(arrays: dict[str, np.ndarray], path: pathlib.Path) -> None:
    try:
        save_file(arrays, path)
    except SafetensorError as error:  # a full disk's, too
        raise OSError(str(error)) from None


def _array(episode: Episode, name: str, feature: Feature) -> np.ndarray:
    return np.stack(list(episode.pictures[name]())) if feature.picture else episode.arrays[name]


_COLUMNS = ("lengths", "numbers", "success")


def _name(piece: int) -> str:
    return f"data/piece-{piece:05d}.safetensors"
