"""Tapes: recorded frames that a session shows instead of its physics."""

import dataclasses
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from mjx_nero.data import Schema, open_with
from mjx_nero.data import episode as names
from mjx_nero.errors import UserError
from mjx_nero.tools.view.session import Frame

_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")


def frames(frame: Frame, qpos: Sequence[np.ndarray], goals: np.ndarray) -> Iterator[Frame]:
    """Yields one frame per step, with the first environment as recorded; everything else stays as in ``frame``.

    Args:
        qpos: recorded positions [steps, nq].
        goals: recorded goal poses [steps, 7], wxyz.
    """
    for i, (at, goal) in enumerate(zip(qpos, goals, strict=True)):
        both, pos, quat = (np.array(x) for x in (frame.qpos, frame.scenery.goal_pos_w, frame.scenery.goal_quat_w))
        both[0], pos[0], quat[0] = at, goal[:3], goal[3:]
        seen: Any = {"goal_pos_w": pos, "goal_quat_w": quat}
        yield dataclasses.replace(frame, qpos=both, step=i, scenery=dataclasses.replace(frame.scenery, **seen))


def of_dataset(path: pathlib.Path, index: int, frame: Frame) -> Iterator[Frame]:
    """Yields the frames of an episode of a data set.

    Raises:
        UserError: there is no such episode, or the data set is from another scene.
    """
    found = open_with(path, index)
    if missing := {names.QPOS, names.ENVIRONMENT} - set(found.schema.features):
        raise UserError(f"{path} has no {' and no '.join(sorted(missing))}: give a data set written by demos with --holds all")
    size = found.schema.features[names.QPOS].size
    if size != frame.qpos.shape[1]:
        raise UserError(f"{path} has {size} positions, but this environment has {frame.qpos.shape[1]}: pass the data set's --env")
    episode = found.episodes((names.QPOS, names.ENVIRONMENT))[index]
    return frames(frame, list(episode.arrays[names.QPOS].astype(float)), episode.arrays[names.ENVIRONMENT][:, goal(found.schema)])


def goal(schema: Schema) -> list[int]:
    """Returns the indices of the goal's pose in ``episode.ENVIRONMENT``."""
    known = schema.features[names.ENVIRONMENT].names
    return [known.index(f"goal.{axis}") for axis in _POSE]
