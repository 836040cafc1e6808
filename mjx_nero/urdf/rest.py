"""The stand of the robot: on the table, on the floor beside it, or hanging."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.swing import surface
from mjx_nero.urdf.tree import Body, Pose, body_of, carriers

SINKS = 0.1  # [m] a base that goes further below its frame is a pedestal on the floor beside the table
UPRIGHT = 0.99  # least cosine of a base's tilt on the table
TILTED = 0.5  # least cosine of the tilt of a base that stands at all
HANGS = (0.3, 0.9)  # range of a hanging arm's shoulder height above the table, in arm lengths
TALL = 0.6  # [m] a robot stands on the floor if its shoulder is higher than this ...
SHARE = 0.4  # ... and higher than this share of the arm's length
BELOW = 0.3  # depth of the table below the shoulder in that case, in arm lengths


@dataclasses.dataclass(frozen=True)
class Stand:
    """Pose of the mount [4, 4], with the table at height 0, and the height of the floor that the robot stands on [m]."""

    mount: Pose
    floor: float


def stand(parts: dict[str, Body], looks: Mapping[str, Look], hand: Hand, mount: Pose, name: str, notes: Notes) -> Stand:
    """Places the robot: on the table, on the floor beside it, or hanging as the URDF mounts it.

    A pedestal, or a robot as tall as a person, stands on the floor. The top of a pedestal, where the arm begins, is at the
    table's height. A hanging robot hangs where the table is within reach.
    """
    base = next(iter(parts.values()))
    points = surface(base.links, looks)
    low = 0.0 if points is None else float((points @ mount[2, :3]).min())
    chain = _chain(parts, hand)
    shoulder = float((mount[:3, :3] @ _pose(parts, chain[0].name)[:3, 3])[2]) if chain else 0.0
    length = sum(float(np.linalg.norm(b.frame[:3, 3])) for b in chain[1:])
    if mount[2, 2] < TILTED:
        return _hung(mount, shoulder, length, name, notes)
    if low < -SINKS:
        top = float((mount[:3, :3] @ _foot(base, chain)[:3, 3])[2])
        mount = _at(mount, -round(top, 3))
        text = f"its base goes {top - low:.2f} m below where the arm begins: a pedestal, on the floor beside the table"
        notes.add("guessed", "robot", name, f"{text}, its top at the table's height (base_pos, floor)")
        return Stand(mount, round(float(mount[2, 3]) + low, 3))
    if shoulder - low > TALL and shoulder - low > SHARE * length:
        mount = _at(mount, -round(shoulder - BELOW * length, 2))
        notes.add("guessed", "robot", name, f"it stands on the floor: the table is {-mount[2, 3]:g} m higher (base_pos)")
        return Stand(mount, round(float(mount[2, 3]) + low, 3))
    if points is not None and mount[2, 2] > UPRIGHT and mount[2, 3] + low > SINKS:
        notes.add("guessed", "robot", name, f"mounted {mount[2, 3]:.2f} m up on nothing: put on the table (base_pos)")
        mount = _at(mount, -low)
    return Stand(mount, 0.0)


def _hung(mount: Pose, shoulder: float, length: float, name: str, notes: Notes) -> Stand:
    """Hangs a base that is too tilted to stand, lower or higher if the arm would not reach the table.

    Args:
        shoulder: height of the first joint above the mount [m].
        length: length of the arm [m].
    """
    height = float(mount[2, 3]) + shoulder
    fits = HANGS[0] * length <= height <= HANGS[1] * length
    if not fits:
        mount = _at(mount, round(sum(HANGS) / 2 * length - shoulder, 2))
    angle = np.degrees(np.arccos(np.clip(mount[2, 2], -1, 1)))
    where = f"its mount is {mount[2, 3]:.2f} m above the table{'' if fits else ', where that is in reach'} (base_pos)"
    notes.add("guessed", "robot", name, f"its base is tilted by {angle:.0f} degrees: it hangs from a plate, and {where}")
    return Stand(mount, 0.0)


def _chain(parts: dict[str, Body], hand: Hand) -> list[Body]:
    """Lists the bodies from the base to the hand, without the slides of a lift at the start."""
    chain = [parts[n] for n in carriers(parts, body_of(parts, hand.link).name)[-2::-1]]
    while len(chain) > 1 and chain[0].joint and chain[0].joint.type == "prismatic":
        chain = chain[1:]
    return chain


def _foot(base: Body, chain: list[Body]) -> Pose:
    """Frame of the base's link that carries the arm [4, 4]."""
    joint = chain[0].joint if chain else None
    return base.links.get(joint.parent if joint else base.name, np.eye(4))


def _at(mount: Pose, height: float) -> Pose:
    """Moves the mount to another height [m]."""
    out = mount.copy()
    out[2, 3] = height
    return out


def _pose(parts: dict[str, Body], name: str) -> Pose:
    """Pose of a body in the base at joint positions 0."""
    return _pose(parts, parts[name].parent) @ parts[name].frame if parts[name].parent else parts[name].frame
