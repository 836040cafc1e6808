"""Builds the safety layer of an arm from the metadata of an exported policy."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.body import Body
from mjx_nero.deploy.executor import Joints
from mjx_nero.deploy.fence import Box, Fence, FenceCfg
from mjx_nero.deploy.safety import Limits, Safety, SafetyCfg
from mjx_nero.errors import UserError

Ranges = tuple[np.ndarray, np.ndarray]
USUAL, USUAL_FENCE = SafetyCfg(), FenceCfg()
_FAR, _FAST, _SLOW = 20.0, 12.0, 0.2  # [rad or m], [rad/s or m/s], [s]: more is a mistake, or somebody's trick
NEEDED = ("joints", "gripper", "body", "command", "objects")


def check(metadata: Mapping[str, Any]) -> None:
    """Checks that a file says all that an arm needs.

    Raises:
        UserError: an older version exported it, or its limits are no arm's.
    """
    if missing := [name for name in NEEDED if name not in metadata]:
        raise UserError(f"the file does not say {', '.join(missing)}: export the policy again with this version")
    own = Joints.of(metadata)
    right = (-_FAR <= own.lower) & (own.lower <= own.home) & (own.home <= own.upper) & (own.upper <= _FAR) & (own.speed <= _FAST)
    if not right.all() or own.dt > _SLOW:
        name = own.names[int(np.argmin(right))]
        raise UserError(
            f"the file's limits of {name} are no arm's: home within its range, this within {_FAR:g} rad or m, a speed of at most "
            f"{_FAST:g} rad/s or m/s, and a target at least every {_SLOW:g} s"
        )


def body_of(metadata: Mapping[str, Any]) -> Body:
    """The robot's links."""
    return Body(metadata["body"], metadata["joints"]["names"], metadata["base"]["position"])


def safety_of(
    metadata: Mapping[str, Any], cfg: SafetyCfg = USUAL, fence: FenceCfg = USUAL_FENCE, ranges: Ranges | None = None
) -> Safety:
    """The layer with the limits of the policy's robot, and, where no box is given, the room that its task needs.

    Args:
        ranges: of the arm, where it has its own; see ``Arm.ranges``.

    Raises:
        UserError: these leave home out.
    """
    limits, body = Limits.of(metadata, cfg), body_of(metadata)
    if ranges is not None:
        limits = limits.within(*ranges)
    if fence.box is None:
        fence = dataclasses.replace(fence, box=room_for(metadata, body, fence.room))
    arm = tuple(name for name, mine in zip(limits.names, limits.arm, strict=True) if mine)
    return Safety(limits, Fence(body, arm, limits.home, (limits.lower, limits.upper), fence), cfg)


def room_for(metadata: Mapping[str, Any], body: Body, room: float) -> Box:
    """The box about home and the regions of the robot and of the task, and some room on all sides [m]."""
    low, high = body.bounds(body.shapes(np.array(metadata["joints"]["home"], float)))
    points = [low[0].min(axis=0), high[0].max(axis=0)]
    regions = [np.array(box, float) for box in metadata.get("regions", {}).values()]
    command = metadata.get("command", {})
    if all(axis in command for axis in "xyz"):
        regions.append(np.array([command[axis] for axis in "xyz"], float))
    points += [corner + body.base for box in regions for corner in box.T]
    least, most = np.min(points, axis=0) - room, np.max(points, axis=0) + room
    x, y, z = ((float(a), float(b)) for a, b in zip(least, most, strict=True))
    return x, y, z
