"""The schema of a recorded step, and episodes of such steps. Every form of a data set holds these, whoever made them."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from mjx_nero.errors import UserError

STATE, ENVIRONMENT, ACTION = "observation.state", "observation.environment_state", "action"  # LeRobot's names
EXECUTED = "executed"  # what the drives were told; ``action`` is what they ought to have been told
SEEN, DONE_BY = "mdp.observation", "mdp.action"  # what a policy of the task saw, and the action it ought to have taken
QPOS = "mdp.qpos"  # the physics' positions, for a viewer
REWARD, DONE, SUCCESS = "next.reward", "next.done", "next.success"
PICTURES = "observation.images."  # and a camera's name
VIDEO = "video"  # pictures, uint8 [height, width, 3], which an encoder changes a little
DTYPES = ("float32", "bool", VIDEO)
MAX_SIZE = 100_000  # numbers of a feature


@dataclasses.dataclass(frozen=True)
class Feature:
    """One array of a step.

    Attributes:
        names: of its numbers; of a picture, of its axes.
        units: of its numbers, as in ``rad``; empty: they have none.
        dtype: one of ``DTYPES``.
        picture: height and width [pixels]; empty: it is none.
    """

    names: tuple[str, ...]
    units: tuple[str, ...] = ()
    dtype: str = "float32"
    picture: tuple[int, ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of its array in a step."""
        return (*self.picture, 3) if self.picture else (len(self.names),)

    @property
    def size(self) -> int:
        """Count of its numbers."""
        return math.prod(self.shape)


@dataclasses.dataclass(frozen=True)
class Schema:
    """The contents of a data set's steps.

    Attributes:
        fps: control steps a second.
        robot: its name.
        task: a sentence that says what the robot does.
        features: by name.
        about: what made the data set, as plain JSON. Episodes that something else made do not belong into it.
    """

    fps: float
    robot: str
    task: str
    features: Mapping[str, Feature]
    about: Mapping[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Plain JSON, which ``from_json`` reads."""
        return dataclasses.asdict(self) | {"about": dict(self.about)}


def from_json(found: Any, where: Any) -> Schema:
    """A schema from what ``Schema.to_json`` made.

    Raises:
        UserError: it is none.
    """
    try:
        features = {str(name): _feature(each) for name, each in found["features"].items()}
        return Schema(float(found["fps"]), str(found["robot"]), str(found["task"]), features, dict(found["about"]))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise UserError(f"{where} does not describe demonstrations of mjx_nero, or it is damaged") from None


def _feature(found: Mapping[str, Any]) -> Feature:
    names, units, dtype = tuple(found["names"]), tuple(found["units"]), found["dtype"]
    picture = tuple(found.get("picture", ()))
    good = all(isinstance(word, str) for word in (*names, *units)) and len(units) in (0, len(names)) and dtype in DTYPES
    good &= len(picture) == 2 * (dtype == VIDEO) and all(type(n) is int and 0 < n <= 8192 for n in picture)
    if not good or not 0 < len(names) <= MAX_SIZE:
        raise ValueError
    return Feature(names, units, dtype, picture)


def picture(height: int, width: int) -> Feature:
    """The feature of a camera."""
    return Feature(("height", "width", "channels"), dtype=VIDEO, picture=(height, width))


@dataclasses.dataclass(frozen=True)
class Episode:
    """One episode.

    Attributes:
        arrays: by name, [steps, numbers], as the schema says.
        success: whether it succeeded.
        number: draws everything in it, together with the data set's seed.
        pictures: by name, what gives the frames, uint8 [height, width, 3], one after another: they are drawn when needed.
    """

    arrays: Mapping[str, np.ndarray]
    success: bool
    number: int
    pictures: Mapping[str, Callable[[], Iterable[np.ndarray]]] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))


def check(episode: Episode, schema: Schema) -> None:
    """Compares an episode with the schema.

    Raises:
        ValueError: an array is missing, or of another shape or type.
    """
    for name, feature in schema.features.items():
        if feature.picture:
            episode.pictures[name]
            continue
        found, wanted = episode.arrays[name], (len(episode), feature.size)
        if found.shape != wanted or found.dtype != np.dtype(feature.dtype):
            raise ValueError(f"{name} is {found.dtype}{list(found.shape)}, and the schema has {feature.dtype}{list(wanted)}")


@dataclasses.dataclass(frozen=True)
class Dataset:
    """A data set that has been opened; arrays are read when they are asked for.

    Attributes:
        lengths: steps of each episode, int [n].
        success: bool [n].
        numbers: of each episode, int [n] (``Episode.number``).
        read: name of a feature -> all its steps [steps, ...].
        frames: name of a camera's feature -> its frames, uint8 [height, width, 3], one after another.
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
        """All steps of a feature, one episode after another [steps, numbers], or [steps, height, width, 3].

        Raises:
            UserError: there is none of that name.
        """
        if name not in self.schema.features:
            raise UserError(f"the data set has no {name!r}: it has {', '.join(self.schema.features)}")
        return self.read(name)

    def episodes(self, names: Sequence[str] = ()) -> list[Episode]:
        """All episodes, with the named features alone (none named: all but pictures)."""
        ends = np.cumsum(self.lengths)[:-1]
        usual = [name for name, feature in self.schema.features.items() if not feature.picture]
        parts = {name: np.split(self.column(name), ends) for name in names or usual}
        return [
            Episode({name: parts[name][i] for name in parts}, bool(self.success[i]), int(self.numbers[i]))
            for i in range(len(self))
        ]
