"""Fingers: which joints belong to a gripper, which bodies grip, and where the joints are when it is open and closed."""

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence

import numpy as np

from mjx_nero import config
from mjx_nero.types import UserError
from mjx_nero.urdf import chain, primitives
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.swing import Meeting, Swing, endless, limits, surface
from mjx_nero.urdf.tree import Body, Pose, Tree, Vec, below, bodies, poses

_NAMES = re.compile(r"grip|grasp|fi?nge?r|jaw|hand|knuckle|claw|clamp|pinch|tong", re.IGNORECASE)
MOST_JOINTS = 4  # greatest number of driven joints of a finger
JAW = 2.8  # [rad] greatest opening of a single jaw; a joint that turns further is a wrist
STILL = 2e-3  # [m] a joint grips if it changes a distance between fingers by more
FINGERS, TURNS = 4, 13  # fewest fingers of a hand with a thumb that turns, and positions in which it is tried
ALIKE = 0.8  # a third finger opens by more than this share of the best pair's opening
Chosen = tuple[Tree, tuple[str, ...], str]


@dataclasses.dataclass(kw_only=True)
class Hand:
    """The gripper, or the last link of an arm that has none.

    Attributes:
        joints: the joints that drive it; empty without a gripper.
        open, close: their positions [rad, m].
        link: the link that the fingers move against; ``site`` is in its frame.
        fingers: the bodies that grip.
        site: pose of the grasp point in ``link`` [4, 4].
        approach, opening: unit vectors in the frame of ``site`` [3]: where the fingers point, and along what they open.
        pads: link -> collision shape in its frame, including the fixed jaw of a gripper with one moving jaw.
        backs: link -> shape of the finger's rest.
        inside: the bodies that only the gripper's joints move.
        gap, closed: distance between the pads when open and when closed [m]; a gap of 0 is unknown.
        pad: size of the first pad along the approach, across, and along the opening [m].
        grip: middle of a gripped cube, in the grasp point's frame [m].
    """

    joints: tuple[str, ...]
    open: tuple[float, ...]
    close: tuple[float, ...]
    link: str
    fingers: tuple[str, ...]
    site: Pose
    approach: Vec
    opening: Vec
    pads: dict[str, primitives.Primitive]
    backs: dict[str, primitives.Primitive]
    inside: tuple[str, ...]
    gap: float = 0.0
    closed: float = 0.0
    pad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grip: Vec = dataclasses.field(default_factory=lambda: np.zeros(3))


@dataclasses.dataclass(frozen=True)
class Grip:
    """The bodies that grip, and how the gripper's joints move them.

    Attributes:
        joints: the joints that drive it, with their positions ``open`` and ``close`` [rad, m].
        fork: the body that carries the gripper.
        link: the fork's link that carries the first joint.
        fingers: the moving bodies, the pair that meets best first.
        jaw: the fork's link that a single finger meets; empty if two fingers move.
        meeting: the meeting of the first finger and its counterpart.
    """

    joints: tuple[str, ...]
    open: tuple[float, ...]
    close: tuple[float, ...]
    fork: str
    link: str
    fingers: tuple[str, ...]
    jaw: str
    meeting: Meeting


def opposed(tree: Tree, looks: Mapping[str, Look], notes: Notes) -> Tree:
    """Returns the robot with the joint that turns a thumb across the palm held where the thumb stands opposite the fingers.

    Only the hands of four or more fingers have such a joint: the first of the one finger with two joints. Without it, these hands
    close like a gripper of two jaws.
    """
    parts = bodies(tree)
    end = chain.limb(parts).end
    if sum(map(bool, _branches(parts, end))) < FINGERS:
        return tree
    joints, fork = _guess(tree, parts, end, looks, Notes())
    if not (thumb := _thumb(parts, fork, joints)):
        return tree
    at = _opposite(tree, looks, tuple(name for name in joints if name != thumb[0]), thumb, fork)
    notes.add("guessed", "joint", thumb[0], f"turns the thumb: held at {at:g}, opposite the fingers (--fix {thumb[0]}=VALUE)")
    return chain.fixed(tree, {thumb[0]: at}, Notes())


def choose(tree: Tree, looks: Mapping[str, Look], gripper: Sequence[str] | None, notes: Notes) -> Chosen:
    """Returns the robot with only arm and gripper moving, the gripper's joints, and the body that carries it.

    The gripper hangs on the body that ends the arm. It consists of joints that change the distance between fingers, driven or by
    ``mimic``; or of the last joint, if its name or its link's suggests a gripper. Other joints there, such as a decorative horn
    or the many joints of a human hand, are held still.

    Args:
        gripper: the joints that drive it, instead of a guess; empty: no gripper.

    Raises:
        UserError: ``gripper`` names an unknown joint.
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


def grip(swing: Swing, joints: tuple[str, ...], open: Mapping[str, float], closed: Mapping[str, float], notes: Notes) -> Grip:
    """Finds the bodies that grip: the two that part most and come nearest as the joints move, and others that do so equally well.

    Bodies without shapes, such as the frame of a tip, do not count.

    Args:
        open, closed: positions of some joints, instead of a guess [rad, m].

    Raises:
        UserError: ``open`` or ``closed`` names a joint outside the gripper, or both are the same.
    """
    for flag, given in (("--open", open), ("--closed", closed)):
        for name in given:
            if name not in joints:
                raise UserError(f"{flag} names joint {name!r}{config.hint(name, joints)}: the gripper has {', '.join(joints)}")
    close, wide = swing.ends(joints, open, closed)
    for name in swing.assumed:
        if name not in open or name not in closed:
            ends = f"closed at {close[name]:.3g} and open at {wide[name]:.3g}"
            text = f"it has no limits, and its link meets nothing: {ends} are assumed"
            notes.add(
                "warning", "joint", name, f"{text}; give its limits in the URDF, or --open {name}=VALUE and --closed {name}=VALUE"
            )
    for name in swing.shortened:
        if name not in open:
            far = swing.joints[name].upper - swing.joints[name].lower
            text = f"slides by {far:g} m, farther than any hand opens: open at {wide[name]:.3g}, where its finger leaves the hand"
            text += f"; correct its limits in the URDF, or give --open {name}=VALUE"
            notes.add("warning", "joint", name, text)
    meetings = swing.between(close, wide)
    if not meetings:
        raise UserError(
            f"open and closed are the same for {', '.join(joints)}: give --open and --closed, or --gripper with others"
        )
    first = meetings[0]
    fingers = first.names[:1] if first.fixed else _fingers(swing, meetings)
    for finger in fingers:
        joint = swing.parts[finger].joint
        text = ", ".join(f"{n} {wide[n]:g}" for n in joints)
        notes.add("guessed", "joint", joint.name if joint else "", f"a finger of the gripper, open at {text}")
    return Grip(
        joints,
        tuple(wide[j] for j in joints),
        tuple(close[j] for j in joints),
        swing.fork,
        swing.link,
        fingers,
        first.names[1] if first.fixed else "",
        first,
    )


def _fingers(swing: Swing, meetings: Sequence[Meeting]) -> tuple[str, ...]:
    """Returns the two bodies of the best meeting, and the best body of each other branch that meets as well."""
    worth: dict[str, float] = {}
    for meeting in meetings:
        for name in meeting.names if not meeting.fixed else ():
            worth[name] = max(worth.get(name, -1.0), meeting.worth)
    first = meetings[0].names
    taken = {_branch(swing, name) for name in first}
    others: dict[str, str] = {}
    for name in sorted(worth, key=lambda n: -worth[n]):
        if worth[name] > ALIKE * meetings[0].worth and _branch(swing, name) not in taken:
            others.setdefault(_branch(swing, name), name)
    return (*sorted(first, key=swing.inside.index), *sorted(others.values(), key=swing.inside.index))


def _branch(swing: Swing, name: str) -> str:
    """Returns the body next to the fork on which a finger hangs."""
    while swing.parts[name].parent in swing.inside:
        name = swing.parts[name].parent
    return name


def _guess(tree: Tree, parts: dict[str, Body], end: str, looks: Mapping[str, Look], notes: Notes) -> tuple[tuple[str, ...], str]:
    """Guesses the driven joints of the gripper, and the body that carries it."""
    branches = _branches(parts, end)
    if branches and parts[end].parent:
        if max(map(len, branches)) > MOST_JOINTS:
            count = sum(map(len, branches))
            notes.add("warning", "robot", tree.name, f"its hand has {count} joints: held still (--gripper J1,J2 moves some)")
            return (), end
        return tuple(_gripping(parts, end, [j for branch in branches for j in branch], looks)), end
    here, above = end, parts[end].parent
    last = parts[here].joint
    while last and last.mimic and above:  # a follower is driven by the joint above
        here, above = above, parts[above].parent
        last = parts[here].joint
    if above and parts[above].joint and last and (_NAMES.search(last.name) or _NAMES.search(last.child)):
        lower, upper = limits(last)
        if last.type == "prismatic" or upper - lower <= JAW:
            return (last.name,), above
        if endless(last):
            if Swing(tree, parts, looks, (last.name,), above).jaw(last.name, {last.name: np.zeros(1)}) is not None:
                return (last.name,), above
            text = f"joint {last.name!r} turns without limits, and its link meets nothing: a wrist. If it is a jaw, give "
            text += f"--gripper {last.name} --open {last.name}=VALUE --closed {last.name}=VALUE"
            notes.add("guessed", "robot", tree.name, text)
    return (), end


def _branches(parts: dict[str, Body], end: str) -> list[list[str]]:
    """Lists the driven joints of each branch that leaves a body."""
    return [_driven(parts, below(parts, b.name)) for b in parts.values() if b.parent == end and b.joint]


def _gripping(parts: dict[str, Body], end: str, joints: list[str], looks: Mapping[str, Look]) -> list[str]:
    """Selects the joints that change the distance between two fingers; endless joints only if no others do."""
    by_name = {b.joint.name: b.joint for b in parts.values() if b.joint}
    inside = below(parts, end)[1:]
    leaves = [n for n in inside if not any(parts[m].parent == n for m in inside)]
    if len(leaves) < 2:
        return joints
    spots = {n: np.append(_spot(parts[n], looks), 1.0) for n in leaves}
    bounds = {n: limits(by_name[n]) for n in joints}
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


def _thumb(parts: dict[str, Body], fork: str, joints: tuple[str, ...]) -> list[str]:
    """Returns the joints that turn and bend a thumb: those of the one finger with two, if all others have one; else none."""
    fingers = [[joint for joint in branch if joint in joints] for branch in _branches(parts, fork)]
    fingers = sorted(filter(None, fingers), key=len)
    return fingers[-1] if len(fingers) >= FINGERS and list(map(len, fingers[-2:])) == [1, 2] else []


def _opposite(tree: Tree, looks: Mapping[str, Look], joints: tuple[str, ...], thumb: Sequence[str], fork: str) -> float:
    """Returns the position of the thumb's first joint at which the thumb meets the fingers best, all taken together [rad]."""
    (turns, bends), worth = thumb, {}
    for value in np.linspace(*limits(tree.joints[turns]), TURNS):
        held = chain.fixed(tree, {turns: float(value)}, Notes())
        swing = Swing(held, bodies(held), looks, joints, fork)
        met: dict[str, float] = {}
        own = _branch(swing, next(b.name for b in swing.parts.values() if b.joint and b.joint.name == bends))
        for meeting in swing.between(*swing.ends(joints, {}, {})):
            pair = {_branch(swing, name) for name in meeting.names} if not meeting.fixed else set()
            if own in pair and len(pair) == 2:  # the best with each finger comes first
                met.setdefault((pair - {own}).pop(), meeting.worth)
        worth[round(float(value), 3)] = sum(met.values())
    return max(worth, key=worth.__getitem__)


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


def _spot(body: Body, looks: Mapping[str, Look]) -> Vec:
    """Returns a point that represents a finger: the mean of its surface, or its centre of mass."""
    points = surface(body.links, looks)
    return body.mass.com if points is None else points.mean(0)
