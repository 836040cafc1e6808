"""How the robot stands: on the table, or on the floor beside it."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Pose, body_of

SINKS = 0.1  # [m] a base that goes further below its frame is a pedestal, which stands on the floor beside the table
UPRIGHT = 0.99  # least cosine of a base's tilt that stands and does not hang
TALL = 0.6  # [m] a shoulder higher than this above the floor, and than ...
SHARE = 0.4  # ... this share of the arm's length, is a robot's that stands on the floor
BELOW = 0.3  # of the arm's length: the table then lies so far below the shoulder


@dataclasses.dataclass(frozen=True)
class Stand:
    """Where the base is mounted [4, 4], the table being at height 0, and the height of the floor that it stands on [m]."""

    mount: Pose
    floor: float


def stand(parts: dict[str, Body], looks: Mapping[str, Look], hand: Hand, mount: Pose, name: str, notes: Notes) -> Stand:
    """On the table; a pedestal beside it on the floor, its frame at the table's height; and so what is as tall as a person."""
    base = next(iter(parts.values()))
    points = [(look.points @ at[:3, :3].T + at[:3, 3]) for link, at in base.links.items() if (look := _seen(looks[link]))]
    low = min(float((p @ mount[2, :3]).min()) for p in points) if points else 0.0
    chain: list[Body] = []
    at = body_of(parts, hand.link)
    while at.joint is not None:
        chain.insert(0, at)
        at = parts[at.parent]
    while len(chain) > 1 and chain[0].joint and chain[0].joint.type == "prismatic":
        chain = chain[1:]
    shoulder = float((mount[:3, :3] @ _pose(parts, chain[0].name)[:3, 3])[2]) if chain else 0.0
    length = sum(float(np.linalg.norm(b.frame[:3, 3])) for b in chain[1:])
    if low < -SINKS:
        notes.add(
            "guessed", "robot", name, f"its base goes {-low:.2f} m below its frame: a pedestal, on the floor beside the table"
        )
        return Stand(mount, round(float(mount[2, 3]) + low, 3))
    if shoulder - low > TALL and shoulder - low > SHARE * length:
        mount = mount.copy()
        mount[2, 3] = -round(shoulder - BELOW * length, 2)
        notes.add("guessed", "robot", name, f"it stands on the floor: the table is {-mount[2, 3]:g} m higher (base_pos)")
        return Stand(mount, round(float(mount[2, 3]) + low, 3))
    if points and mount[2, 2] > UPRIGHT and mount[2, 3] + low > SINKS:
        notes.add("guessed", "robot", name, f"mounted {mount[2, 3]:.2f} m up on nothing: put on the table (base_pos)")
        mount = mount.copy()
        mount[2, 3] = -low
    return Stand(mount, 0.0)


def _pose(parts: dict[str, Body], name: str) -> Pose:
    """Pose of a body in the base at joint positions 0."""
    return _pose(parts, parts[name].parent) @ parts[name].frame if parts[name].parent else parts[name].frame


def _seen(look: Look) -> Look | None:
    return look if look.points is not None and not look.guessed else None
