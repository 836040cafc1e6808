"""Which joints are the gripper's, and where the robot grasps: guessed from the tree and from names, or as the user says."""

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence

import numpy as np

from mjx_nero import config
from mjx_nero.types import UserError
from mjx_nero.urdf import chain, fingers, primitives
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Matrix, Pose, Tree, Vec, below, bodies, body_of, depth, poses

_NAMES = re.compile(r"grip|finger|jaw|hand|knuckle|claw", re.IGNORECASE)
_TIPS = re.compile(r"tcp|(^|[_/])ee(_|$)|end_?effector|grasp|gripper_frame|hand_tip", re.IGNORECASE)
_TOOLS = (  # of an arm without gripper, the best name first
    re.compile(r"tcp", re.IGNORECASE),
    re.compile(r"tool", re.IGNORECASE),
    re.compile(r"(^|[_/])ee(_|$)|(^|[_/])eef(_|$)|end_?effector|grasp", re.IGNORECASE),
    re.compile(r"flange", re.IGNORECASE),
)
_SENSORS = re.compile(r"camera|imu|optical|depth|color|lidar|laser|sensor|realsense|vision|_ft(_|$)", re.IGNORECASE)
MOST_JOINTS = 4  # driven joints of a finger
NEAR = 0.06  # [m] a named frame this far from where the fingers meet is their grasp point; the flange's is further away
ASKEW = np.radians(10)  # pads that are further off where a tool's axis points are fitted anew, along it
TOOL_AXIS = 50.0  # [degrees] a tool's frame has an axis along which it works: the one within this of where the fingers point
JAW = 2.8  # [rad] the only jaw of a gripper opens by no more: a hand that turns further is at the wrist
STILL = 2e-3  # [m] a joint that changes no distance between fingers by more does not grip
Chosen = tuple[Tree, tuple[str, ...], str]


def choose(tree: Tree, looks: Mapping[str, Look], gripper: Sequence[str] | None, notes: Notes) -> Chosen:
    """The robot with arm and gripper alone moving, the joints that drive the gripper, and the body on which it hangs.

    The gripper is what hangs on the body that ends the arm: joints that change the distance between fingers, driven or by
    ``mimic``; or the last joint, if its name or its link's speaks of a gripper. Others there, a spinning horn for show or the
    many joints of a human hand, are held still.

    Args:
        gripper: joints that drive it, in place of the guess; empty for none.

    Raises:
        UserError: ``gripper`` names what is not there.
    """
    parts = bodies(tree)
    limb = chain.limb(parts)
    if gripper is None:
        joints, fork = _guess(tree, parts, limb.end, looks, notes)
        text = f"gripper: {', '.join(joints)}" if joints else "no gripper found"
        notes.add("guessed", "robot", tree.name, f"{text} (--gripper changes it)")
    else:
        joints, fork = _given(parts, gripper)
    idle = [n for n in _driven(parts, list(parts)) if n not in joints and n not in limb.joints]
    return chain.fixed(tree, {n: chain.nearest(tree.joints[n]) for n in idle}, notes), joints, fork


def find(
    tree: Tree, parts: dict[str, Body], looks: Mapping[str, Look], chosen: tuple[Sequence[str], str], ee: str | None, notes: Notes
) -> Hand:
    """The hand: how the fingers open, and where they grasp.

    Open is where the fingers' ends are farthest apart (of one jaw: from its counterpart). The grasp point lies amid the distal
    40% of the fingers, or is the frame nearest to it whose name says so (``tcp``, ``ee_...``, ``grasp``, ...); without gripper it
    is the tool's frame by name (``tcp``, ``tool0``, ``end_effector``, ``ee_...``), or the last link. It is no camera's frame.

    Args:
        chosen: joints and fork of ``choose``.
        ee: ``LINK`` or ``LINK:x,y,z``: the grasp point, in place of the guess.

    Raises:
        UserError: ``ee`` names what is not there.
    """
    joints, fork = tuple(chosen[0]), chosen[1]
    if not joints:
        link, at = _placed(tree, ee) if ee is not None else (_tool(parts), np.zeros(3))
        hand = fingers.bare(parts, looks, link, at)
    else:
        hand = fingers.gripper(tree, parts, looks, joints, fork, notes)
        named = _frame(parts, hand) if ee is None else None
        if named is not None or ee is not None:
            link, at = _placed(tree, ee) if ee is not None else (str(named), np.zeros(3))
            moved = _moved(parts, hand, link, at)
            ahead = _turn(parts, hand, link) @ moved.approach
            if ahead @ hand.approach < np.cos(ASKEW):
                hand = fingers.gripper(tree, parts, looks, joints, fork, Notes(), ahead)
                moved = _moved(parts, hand, link, at)
            hand = moved
    if ee is None:
        at_text = " ".join(f"{v:.4g}" for v in hand.site[:3, 3])
        why = "by its name" if any(p.search(hand.link) for p in (_TIPS, *_TOOLS)) else "the last one"
        text = f"{at_text} in link {hand.link!r}" if hand.site[:3, 3].any() else f"link {hand.link!r}, {why}"
        notes.add("guessed", "robot", tree.name, f"grasp point: {text} (--ee changes it)")
    return hand


def _guess(tree: Tree, parts: dict[str, Body], end: str, looks: Mapping[str, Look], notes: Notes) -> tuple[tuple[str, ...], str]:
    """Driven joints of the gripper, and the body on which it hangs."""
    branches = [_driven(parts, below(parts, b.name)) for b in parts.values() if b.parent == end and b.joint]
    if branches and parts[end].parent:
        if max(map(len, branches)) > MOST_JOINTS:
            count = sum(map(len, branches))
            notes.add("warning", "robot", tree.name, f"its hand has {count} joints: held still (--gripper J1,J2 moves some)")
            return (), end
        return tuple(_gripping(parts, end, [j for branch in branches for j in branch], looks)), end
    here, above = end, parts[end].parent
    last = parts[here].joint
    while last and last.mimic and above:  # what follows another joint is driven by that one
        here, above = above, parts[above].parent
        last = parts[here].joint
    if above and parts[above].joint and last and (_NAMES.search(last.name) or _NAMES.search(last.child)):
        lower, upper = fingers.limits(last)
        if last.type == "prismatic" or upper - lower <= JAW:
            return (last.name,), above
    return (), end


def _gripping(parts: dict[str, Body], end: str, joints: list[str], looks: Mapping[str, Look]) -> list[str]:
    """Those of the joints that change the distance between two fingers; of endless ones none, if others do."""
    by_name = {b.joint.name: b.joint for b in parts.values() if b.joint}
    inside = below(parts, end)[1:]
    leaves = [n for n in inside if not any(parts[m].parent == n for m in inside)]
    if len(leaves) < 2:
        return joints
    spots = {n: np.append(fingers.spot(parts[n], looks), 1.0) for n in leaves}
    bounds = {n: fingers.limits(by_name[n]) for n in joints}
    middle = {n: np.full(9, sum(bounds[n]) / 2) for n in joints}
    out = []
    for name in joints:
        at = poses(parts, {**middle, name: np.linspace(*bounds[name], 9)}, 9)
        ends = {n: at[n] @ spots[n] for n in leaves}
        apart = [np.ptp(np.linalg.norm(ends[a] - ends[b], axis=1)) for a, b in itertools.combinations(leaves, 2)]
        if max(apart) > STILL:
            out.append(name)
    bounded = [n for n in out if by_name[n].type != "continuous"]
    return bounded or out


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


def _tool(parts: dict[str, Body]) -> str:
    """The tool's frame of an arm without gripper: of the names on its last body the best, of equals the outermost.

    If no name tells, it is one on the last joint's axis, where flanges are.
    """
    last = parts[max(parts, key=lambda n: depth(parts, n))]
    links = [n for n in last.links if not _SENSORS.search(n)] or list(last.links)
    for pattern in _TOOLS:
        found = [n for n in links if pattern.search(n)]
        if found:
            return found[-1]
    if last.joint is not None and last.joint.type != "prismatic":
        links = [n for n in links if np.linalg.norm(np.cross(last.links[n][:3, 3], last.joint.axis)) < fingers.ON_AXIS] or links
    return links[-1]


def _frame(parts: dict[str, Body], hand: Hand) -> str | None:
    """The named frame nearest to where the fingers meet, if it is not far from there."""
    body = body_of(parts, hand.link)
    centre = (body.links[hand.link] @ hand.site)[:3, 3]
    away = {
        n: float(np.linalg.norm(at[:3, 3] - centre)) for n, at in body.links.items() if _TIPS.search(n) and not _SENSORS.search(n)
    }
    nearest = min(away, key=away.__getitem__, default=None)
    return nearest if nearest is not None and away[nearest] < NEAR else None


def _placed(tree: Tree, ee: str) -> tuple[str, Vec]:
    link, _, offset = ee.partition(":")
    if link not in tree.links:
        raise UserError(f"--ee names link {link!r}{config.hint(link, tree.links)}: choose from {', '.join(tree.links)}")
    try:
        at = np.array([float(v) for v in offset.split(",")]) if offset else np.zeros(3)
    except ValueError:
        at = np.zeros(0)
    if at.shape != (3,) or not (np.abs(at) < 10).all():
        raise UserError(f"--ee takes LINK or LINK:x,y,z in metres, got {ee!r}")
    return link, at


def _moved(parts: dict[str, Body], hand: Hand, link: str, at: Vec) -> Hand:
    """The hand with its grasp point in the frame of a named link; directions stay where the fingers point.

    Pads that stand in for missing meshes are moved there: the frame knows more than they.
    """
    world = _shut(parts, hand)
    old, new = (world[b.name] @ b.links[n] for n, b in ((n, body_of(parts, n)) for n in (hand.link, link)))
    turn = new[:3, :3].T @ old[:3, :3] @ hand.site[:3, :3]
    site = new @ primitives.pose(np.eye(3), at)
    away = new[:3, :3].T @ (old @ hand.site - site)[:3, 3]  # from the new grasp point to the old one
    approach, opening = fingers.snapped(turn @ hand.approach, TOOL_AXIS), turn @ hand.opening
    side = opening - approach * (approach @ opening)
    side = side / max(float(np.linalg.norm(side)), 1e-9)
    moved = dataclasses.replace(hand, link=link, site=primitives.pose(np.eye(3), at), approach=approach, opening=opening)
    aside = side * (hand.grip @ hand.opening)
    if any(pad.fill > 0 for pad in hand.pads.values()):
        return dataclasses.replace(moved, grip=np.round(away + aside, 4) + 0.0)
    frame = new[:3, :3] @ np.column_stack([approach, side, np.cross(approach, side)])
    pads = {}
    for name, pad in hand.pads.items():
        body = body_of(parts, name)
        pose = world[body.name] @ body.links[name]
        off = ((pose @ pad.pose)[:3, 3] - (old @ hand.site)[:3, 3]) @ (old[:3, :3] @ hand.opening)
        there = primitives.pose(frame, site[:3, 3] + off * frame[:, 1])
        pads[name] = dataclasses.replace(pad, pose=np.linalg.inv(pose) @ there)
    return dataclasses.replace(moved, opening=side, pads=pads, grip=np.round(aside, 4) + 0.0)


def _turn(parts: dict[str, Body], hand: Hand, link: str) -> Matrix:
    """The axes of another link of the same hand in those of the grasp point [3, 3]."""
    world = _shut(parts, hand)
    old, new = (world[b.name] @ b.links[n] for n, b in ((n, body_of(parts, n)) for n in (hand.link, link)))
    return (old @ hand.site)[:3, :3].T @ new[:3, :3]


def _shut(parts: dict[str, Body], hand: Hand) -> dict[str, Pose]:
    """Poses [4, 4] of the bodies with the gripper closed."""
    q = {j: np.array([v]) for j, v in zip(hand.joints, hand.close, strict=True)}
    return {n: p[0] for n, p in poses(parts, q).items()}
