"""The plain format: one safetensors file per piece with one array per feature, and an index. ``safetensors.numpy.load_file``
reads a piece."""

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
from mjx_nero.data.episode import Episode, Feature, Schema, check
from mjx_nero.errors import UserError

INDEX = "meta/pieces.json"
_LENGTHS = "lengths"  # array of a piece's episode lengths, beside the features


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
                raise UserError(f"{index} is damaged: write the data set again") from None

    def _column(self, name: str) -> np.ndarray:
        return np.array([x for piece in self._pieces for x in piece[name]], int)

    @property
    def lengths(self) -> np.ndarray:
        """Number of steps of each episode."""
        return self._column("lengths")

    @property
    def numbers(self) -> np.ndarray:
        """Number of each episode."""
        return self._column("numbers")

    @property
    def success(self) -> np.ndarray:
        """Whether each episode succeeded, bool."""
        return self._column("success").astype(bool)

    def tidy(self) -> None:
        """Removes a piece that the index does not list."""
        (self.path / _name(len(self._pieces))).unlink(missing_ok=True)

    def put(self, episodes: Sequence[Episode]) -> None:
        """Adds episodes as a piece, whole or not at all.

        Raises:
            UserError: it cannot be written.
        """
        for episode in episodes:
            check(episode, self.schema)
        arrays = {  # C order, because safetensors writes the memory as it is
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
        """Does nothing: everything is written already."""

    def column(self, name: str) -> np.ndarray:
        """Returns all steps of a feature, episode by episode: [steps, numbers], or [steps, height, width, 3]."""
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
            raise UserError(f"{self.path} is damaged (its steps of {name} cannot be read): write the data set again") from None
        return found

    def frames(self, name: str) -> Iterator[np.ndarray]:
        """Yields a camera's frames."""
        for i in range(len(self._pieces)):
            with safe_open(files.inside(self.path, *_name(i).split("/")), framework="numpy") as file:
                part = file.get_slice(name)
                for k in range(part.get_shape()[0]):
                    yield part[k : k + 1][0]


def _save(arrays: dict[str, np.ndarray], path: pathlib.Path) -> None:
    try:
        save_file(arrays, path)
    except SafetensorError as error:  # also for a full disk
        raise OSError(str(error)) from None


def _array(episode: Episode, name: str, feature: Feature) -> np.ndarray:
    return np.stack(list(episode.pictures[name]())) if feature.picture else episode.arrays[name]


_COLUMNS = ("lengths", "numbers", "success")


def _name(piece: int) -> str:
    return f"data/piece-{piece:05d}.safetensors"
