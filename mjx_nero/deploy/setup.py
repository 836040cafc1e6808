"""Makes the safety layer of an arm from the metadata of an exported policy."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjx_nero.deploy.body import Body
from mjx_nero.deploy.executor import Joints, names
from mjx_nero.deploy.fence import Box, Fence, FenceCfg
from mjx_nero.deploy.safety import Limits, Safety, SafetyCfg
from mjx_nero.errors import UserError

Ranges = tuple[np.ndarray, np.ndarray]
USUAL, USUAL_FENCE = SafetyCfg(), FenceCfg()
_FAR, _FAST, _SLOW = 20.0, 12.0, 0.2  # [rad or m], [rad/s or m/s], [s]: larger values are a mistake or an attack
NEEDED = ("env", "preset", "robot", "control_dt", "observations", "joints", "gripper", "base", "body", "command", "objects")
NEAR, POSTURES = 0.15, 10_000  # how near to a goal some of so many postures come [m]
MOST = {"bodies": 150, "shapes": 150, "couplings": 100}  # the fence compares all pairs of shapes


def check(metadata: Mapping[str, Any]) -> None:
    """Checks that a policy's metadata have everything that an arm needs.

    Raises:
        UserError: an older version exported it, or its limits are implausible.
    """
    if missing := [name for name in NEEDED if name not in metadata]:
        raise UserError(f"the policy file lacks {', '.join(missing)}: export the policy again with this version")
    try:
        own, grips = Joints.of(metadata), names(metadata, "gripper")
    except ValueError as error:
        raise UserError(str(error)) from None
    body: Any = metadata["body"]
    if not isinstance(body, Mapping) or not all(isinstance(metadata[name], str) for name in ("env", "preset", "robot")):
        raise UserError("the policy file takes names for env, preset and robot, and a description of the body: export it again")
    for name, most in MOST.items():
        if not isinstance(body.get(name), list) or len(body[name]) > most:
            raise UserError(
                f"the policy file's body takes a list of at most {most} {name}: export it again, or use a simpler model"
            )
    if not set(own.names) - set(grips):
        raise UserError("the policy file takes all joints for the gripper's: export the policy again")
    right = (-_FAR <= own.lower) & (own.lower <= own.home) & (own.home <= own.upper) & (own.upper <= _FAR) & (own.speed <= _FAST)
    if not right.all() or own.dt > _SLOW:
        name = own.names[int(np.argmin(right))]
        raise UserError(
            f"the policy file's limits of {name} are implausible: home must be within its range, that within {_FAR:g} rad or m, "
            f"the speed at most {_FAST:g} rad/s or m/s, and the control step at most {_SLOW:g} s"
        )


def body_of(metadata: Mapping[str, Any]) -> Body:
    """Makes the robot's links."""
    return Body(metadata["body"], metadata["joints"]["names"], metadata["base"]["position"])


def safety_of(
    metadata: Mapping[str, Any], cfg: SafetyCfg = USUAL, fence: FenceCfg = USUAL_FENCE, ranges: Ranges | None = None
) -> Safety:
    """Makes the safety layer with the limits of the policy's robot and, if no box is given, a box for its task.

    Args:
        ranges: the arm's own ranges, see ``Arm.ranges``; None: the model's.

    Raises:
        UserError: home is outside these ranges.
    """
    limits, body = Limits.of(metadata, cfg), body_of(metadata)
    if ranges is not None:
        limits = limits.within(*ranges)
    if fence.box is None:
        fence = dataclasses.replace(fence, box=room_for(metadata, body, fence.room))
    arm = tuple(name for name, mine in zip(limits.names, limits.arm, strict=True) if mine)
    return Safety(limits, Fence(body, arm, limits.home, (limits.lower, limits.upper), fence), cfg)


def check_reach(metadata: Mapping[str, Any], body: Body, flag: str, point: Sequence[float], table: float = 0.0) -> None:
    """Checks that the hand can come near a point, by random postures that keep it above the table.

    Args:
        flag: names the point in the message.
        point: position in the robot's root frame [m].
        table: height of the table top in the world [m].

    Raises:
        UserError: no posture brings the hand within ``NEAR``.
    """
    own, where = Joints.of(metadata), np.asarray(point, float) + body.base
    hands = body.hands(np.random.default_rng(0).uniform(own.lower, own.upper, (POSTURES, len(own.names))))
    above = hands[hands[:, 2] > table]
    least = float(np.linalg.norm((above if len(above) else hands) - where, axis=1).min())
    if not least <= NEAR:
        raise UserError(f"{flag} is out of reach: the hand of {metadata['robot']} comes no nearer to it than {least:.2f} m")


def room_for(metadata: Mapping[str, Any], body: Body, room: float) -> Box:
    """Returns a box around home and the regions of robot and task, with a margin ``room`` on all sides [m]."""
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
