"""Which joints are the gripper's, and where the robot grasps: guessed from the tree and from names, or as the user says."""

import dataclasses
import re
from collections.abc import Mapping, Sequence

import numpy as np

from mjx_nero import config
from mjx_nero.types import UserError
from mjx_nero.urdf import fingers, fit
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.looks import Look
from mjx_nero.urdf.notes import Notes
from mjx_nero.urdf.tree import Body, Tree, below, body_of, depth, poses

_NAMES = re.compile(r"grip|finger|jaw|hand|knuckle|claw", re.IGNORECASE)
_TIPS = re.compile(r"tcp|(^|_)ee(_|$)|end_?effector|grasp|gripper_frame|hand_tip", re.IGNORECASE)
_TOOLS = re.compile(r"tool", re.IGNORECASE)  # a flange's frame: the grasp point of an arm without gripper only
MOST_JOINTS = 4  # driven joints of a finger


def find(
    tree: Tree, parts: dict[str, Body], looks: Mapping[str, Look], gripper: Sequence[str] | None, ee: str | None, notes: Notes
) -> Hand:
    """The hand.

    The gripper is what hangs on the body where the arm forks: two or more fingers, coupled by ``mimic`` or not; or the last
    joint, if its name or its link's speaks of a gripper. Open is where the fingers' ends are farthest apart (of one jaw: from its
    counterpart). The grasp point is a bare frame at the end of the tree whose name says so (``tcp``, ``grasp``, ...; without
    gripper also ``tool0``), or lies amid the distal 40% of the fingers.

    Args:
        gripper: joints that drive it, in place of the guess; empty for none.
        ee: ``LINK`` or ``LINK:x,y,z``: the grasp point, in place of the guess.

    Raises:
        UserError: ``gripper`` or ``ee`` name what is not there.
    """
    if gripper is None:
        joints, fork = _guess(tree, parts)
        text = f"gripper: {', '.join(joints)}" if joints else "no gripper found"
        notes.add("guessed", "robot", tree.name, f"{text} (--gripper changes it)")
    else:
        joints, fork = _given(parts, gripper)
    hand = _plain(tree, parts) if not joints else fingers.gripper(tree, parts, looks, joints, fork, notes)
    inner = {j.parent for j in tree.joints.values()}
    bare = [n for n in body_of(parts, hand.link).links if not looks[n].drawn and n not in inner]
    tips = [n for n in bare if _TIPS.search(n) or not joints and _TOOLS.search(n)]
    if ee is None and tips and tips[-1] != hand.link:
        ee = tips[-1]
        notes.add("guessed", "robot", tree.name, f"grasp point: link {ee!r}, by its name (--ee changes it)")
    if ee is not None:
        return _moved(tree, parts, hand, ee)
    at = " ".join(f"{v:.4g}" for v in hand.site[:3, 3])
    notes.add("guessed", "robot", tree.name, f"grasp point: {at} in link {hand.link!r} (--ee changes it)")
    return hand


def _guess(tree: Tree, parts: dict[str, Body]) -> tuple[tuple[str, ...], str]:
    """Driven joints of the gripper, and the body on which it hangs."""
    children = {name: [b for b in parts.values() if b.parent == name and b.joint] for name in parts}
    here, above = tree.root, ""
    while children[here]:
        if len(children[here]) > 1 and above:
            branches = [_driven(parts, below(parts, b.name)) for b in children[here]]
            if max(map(len, branches)) <= MOST_JOINTS and any(branches):
                return tuple(j for branch in branches for j in branch), here
        here, above = max(children[here], key=lambda b: len(below(parts, b.name))).name, here
    last = parts[here].joint
    while last and last.mimic and above:  # what follows another joint is driven by that one
        here, above = above, parts[above].parent
        last = parts[here].joint
    if above and parts[above].joint and last and (_NAMES.search(last.name) or _NAMES.search(last.child)):
        return (last.name,), above
    return (), ""


def _given(parts: dict[str, Body], joints: Sequence[str]) -> tuple[tuple[str, ...], str]:
    moved = {b.joint.name: b for b in parts.values() if b.joint and not b.joint.mimic}
    for name in joints:
        if name not in moved:
            raise UserError(f"--gripper names joint {name!r}{config.hint(name, moved)}: choose from {', '.join(moved)}")
    if len(set(joints)) == len(moved):
        raise UserError("--gripper takes all joints: leave the arm at least one")
    return tuple(dict.fromkeys(joints)), moved[joints[0]].parent if joints else ""


def _driven(parts: dict[str, Body], names: Sequence[str]) -> list[str]:
    return [b.joint.name for b in parts.values() if b.name in names and b.joint and not b.joint.mimic]


def _plain(tree: Tree, parts: dict[str, Body]) -> Hand:
    """Without a gripper: the outermost link of the longest branch, approaching along its z."""
    last = max(parts, key=lambda n: depth(parts, n))
    link = list(parts[last].links)[-1]
    z, y = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    return Hand((), (), (), link, (), np.eye(4), z, y, {}, {}, ())


def _moved(tree: Tree, parts: dict[str, Body], hand: Hand, ee: str) -> Hand:
    """The hand with its grasp point in the frame of a named link."""
    link, _, offset = ee.partition(":")
    if link not in tree.links:
        raise UserError(f"--ee names link {link!r}{config.hint(link, tree.links)}: choose from {', '.join(tree.links)}")
    try:
        at = np.array([float(v) for v in offset.split(",")]) if offset else np.zeros(3)
    except ValueError:
        at = np.zeros(0)
    if at.shape != (3,) or not (np.abs(at) < 10).all():
        raise UserError(f"--ee takes LINK or LINK:x,y,z in metres, got {ee!r}")
    q = dict(zip(hand.joints, (np.array([v]) for v in hand.close), strict=True))
    world = {n: p[0] for n, p in poses(parts, q).items()}
    old, new = (world[b.name] @ b.links[n] for n, b in ((n, body_of(parts, n)) for n in (hand.link, link)))
    turn = new[:3, :3].T @ old[:3, :3]
    approach, opening = hand.approach, hand.opening
    if hand.joints:  # directions stay where the fingers point
        approach, opening = turn @ hand.site[:3, :3] @ approach, turn @ hand.site[:3, :3] @ opening
    return dataclasses.replace(hand, link=link, site=fit.pose(np.eye(3), at), approach=fingers.snapped(approach), opening=opening)
