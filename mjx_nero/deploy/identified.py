"""The delay and encoder offsets of an arm, from a file written by ``identify`` or ``deploy --check``."""

import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero import files
from mjx_nero.deploy.arm import Arm, Feedback
from mjx_nero.errors import UserError


def read(path: pathlib.Path, metadata: Mapping[str, Any]) -> tuple[float, list[float]]:
    """Reads the delay [s], and the offset of each joint [rad or m], which is 0 if the file does not name the joint.

    Raises:
        UserError: the file does not exist, is invalid, or is for another robot.
    """
    found = files.read_yaml(path)
    try:
        robot, joints = str(found["robot"]), found["joints"]
        delay = _number(found["delay"])
        offsets = {str(name): _number(joint["offset"]) for name, joint in joints.items()}
    except (TypeError, KeyError, ValueError, AttributeError):
        raise UserError(
            f"{path} is not a file of identify or deploy --check: it needs robot, delay, and joints with an offset"
        ) from None
    names = metadata["joints"]["names"]
    if robot != metadata["robot"] or not set(offsets) <= set(names):
        raise UserError(f"{path} is for {robot} with joints {', '.join(offsets)}, but the policy's robot is {metadata['robot']}")
    if not 0 <= delay <= 1 or any(abs(x) > 0.5 for x in offsets.values()):
        raise UserError(f"{path}: the delay must be 0 to 1 s, and offsets at most 0.5: calibrate an arm with larger ones")
    return delay, [offsets.get(name, 0.0) for name in names]


def _number(part: Any) -> float:
    value = float(part["value"])
    if not math.isfinite(value):
        raise ValueError
    return value


class Offset:
    """An arm whose encoders read the joint positions plus ``offset`` [rad or m]; see ``Arm``."""

    def __init__(self, arm: Arm, offset: np.ndarray):
        self._arm, self._offset, self.joints = arm, offset, arm.joints
        self.connect, self.engage, self.close = arm.connect, arm.engage, arm.close

    def ranges(self) -> tuple[np.ndarray, np.ndarray] | None:
        """See ``Arm``."""
        ranges = self._arm.ranges()
        return ranges and (ranges[0] - self._offset, ranges[1] - self._offset)

    def read(self) -> Feedback:
        """See ``Arm``."""
        seen = self._arm.read()
        return dataclasses.replace(seen, position=seen.position - self._offset)

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """See ``Arm``."""
        return self._arm.command(position + self._offset, velocity) - self._offset
