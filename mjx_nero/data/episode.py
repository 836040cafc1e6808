"""The schema of a recorded step, and episodes of such steps. All formats of data sets use them, whoever made the data."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mjx_nero.errors import UserError

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"  # LeRobot's names
EXECUTED = "executed"  # targets that the drives received; ``action`` is the label, without noise
SEEN, DONE_BY = "mdp.observation", "mdp.action"  # the observation of a policy of the task, and its action without noise
QPOS = "mdp.qpos"  # simulated positions, for a viewer
REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"
PICTURES = "observation.images."  # followed by a camera's name
VIDEO = "video"  # pictures, uint8 [height, width, 3]; encoding changes them slightly
DTYPES = ("float32", "bool", VIDEO)
MAX_SIZE = 100_000  # maximum count of a feature's numbers


@dataclasses.dataclass(frozen=True)
class Feature:
    """One array of a step.

    Attributes:
        names: names of its numbers; for a picture, names of its axes.
        units: units of its numbers, such as ``rad``; empty: they have none.
        dtype: one of ``DTYPES``.
        picture: height and width [pixels]; empty: not a picture.
    """

    names: tuple[str, ...]
    units: tuple[str, ...] = ()
    dtype: str = "float32"
    picture: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array in a step."""
        return (*self.picture, 3) if self.picture else (len(self.names),)

    @property
    def size(self) -> int:
        """Count of numbers in a step."""
        return math.prod(self.shape)


@dataclasses.dataclass(frozen=True)
class Schema:
    """The contents of a data set's steps.

    Attributes:
        fps: control steps per second.
        robot: the robot's name.
        task: a sentence that says what the robot does.
        features: features by name.
        about: how the data set is made, as plain JSON. All its episodes must be made this way.
    """

    fps: float
    robot: str
    task: str
    features: Mapping[str, Feature]
    about: Mapping[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Converts it to plain JSON, which ``from_json`` reads."""
        return dataclasses.asdict(self) | {"about": dict(self.about)}


def from_json(found: Any, where: Any) -> Schema:
    """Reads a schema written by ``Schema.to_json``.

    Raises:
        UserError: it is not a schema.
    """
    try:
        features = {str(name): _feature(each) for name, each in found["features"].items()}
        return Schema(float(found["fps"]), str(found["robot"]), str(found["task"]), features, dict(found["about"]))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise UserError(
            f"{where} does not describe demonstrations of mjx_nero, or it is damaged: give another data set"
        ) from None


def _feature(found: Mapping[str, Any]) -> Feature:
    names, units, dtype = tuple(found["names"]), tuple(found["units"]), found["dtype"]
    picture = tuple(found.get("picture", ()))
    good = all(isinstance(word, str) for word in (*names, *units)) and len(units) in (0, len(names)) and dtype in DTYPES
    good &= len(picture) == 2 * (dtype == VIDEO) and all(type(n) is int and 0 < n <= 8192 for n in picture)
    if not good or not 0 < len(names) <= MAX_SIZE:
        raise ValueError
    return Feature(names, units, dtype, picture)


def picture(height: int, width: int) -> Feature:
    """Makes the feature of a camera's pictures."""
    return Feature(("height", "width", "channels"), dtype=VIDEO, picture=(height, width))


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        arrays: arrays [steps, numbers] by name, as in the schema.
        success: whether the episode succeeded.
        number: determines all random draws of the episode, together with the data set's seed.
        pictures: by name, functions that yield the frames, uint8 [height, width, 3], which are drawn only when needed.
    """

    arrays: Mapping[str, np.ndarray]
    success: bool
    number: int
    pictures: Mapping[str, Callable[[], Iterable[np.ndarray]]] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))


def check(episode: Episode, schema: Schema) -> None:
    """Checks an episode against the schema.

    Raises:
        ValueError: an array is missing, or has another shape or type.
    """
    for name, feature in schema.features.items():
        if feature.picture:
            episode.pictures[name]
            continue
        found, wanted = episode.arrays[name], (len(episode), feature.size)
        if found.shape != wanted or found.dtype != np.dtype(feature.dtype):
            raise ValueError(f"{name} is {found.dtype}{list(found.shape)}, but the schema has {feature.dtype}{list(wanted)}")


@dataclasses.dataclass(frozen=True)
class Dataset:
    """An opened data set. Arrays are read when they are needed.

    Attributes:
        lengths: number of steps of each episode, int [n].
        success: whether each episode succeeded, bool [n].
        numbers: number of each episode, int [n] (``Episode.number``).
        read: name of a feature -> all its steps [steps, ...].
        frames: name of a camera's feature -> its frames, uint8 [height, width, 3], in order.
    """

    schema: Schema
    lengths: np.ndarray
    success: np.ndarray
    numbers: np.ndarray
    read: Callable[[str], np.ndarray]
    frames: Callable[[str], Iterable[np.ndarray]]

    def __len__(self) -> int:
        return len(self.lengths)

    def column(self, name: str) -> np.ndarray:
        """Returns all steps of a feature, episode by episode: [steps, numbers], or [steps, height, width, 3].

        Raises:
            UserError: the data set has no such feature.
        """
        if name not in self.schema.features:
            raise UserError(f"the data set has no {name!r}: choose from {', '.join(self.schema.features)}")
        return self.read(name)

    def episodes(self, names: Sequence[str] = ()) -> list[Episode]:
        """Returns all episodes with only the named features; without names, with all features but pictures."""
        ends = np.cumsum(self.lengths)[:-1]
        usual = [name for name, feature in self.schema.features.items() if not feature.picture]
        parts = {name: np.split(self.column(name), ends) for name in names or usual}
        return [
            Episode({name: parts[name][i] for name in parts}, bool(self.success[i]), int(self.numbers[i]))
            for i in range(len(self))
        ]
