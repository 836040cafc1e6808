"""Selects the arm's joints. A robot with more (a second arm, a head, wheels) is reduced to the one arm that its user names."""

import dataclasses
import re
from collections.abc import Mapping, Sequence

import numpy as np

from mjx_nero import config
from mjx_nero.types import UserError
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Joint, Tree, below, bodies, body_of

MOST_CHOICES = 4
HAND, LONG = 4, 0.3  # most driven joints and greatest length [m] of a branch, if only fingers leave the base
SENSORS = re.compile(r"camera|imu|optical|depth|color|lidar|laser|sensor|realsense|vision|_ft(_|$)", re.IGNORECASE)
FINGERS = 3  # least driven joints in series that make a branch an arm, not a finger


@dataclasses.dataclass(frozen=True)
class Limb:
    """An arm.

    Attributes:
        base: the body that it branches off from.
        end: the body that carries its hand.
        joints: its driven joints, from the base outwards.
    """

    base: str
    end: str
    joints: tuple[str, ...]


def selected(tree: Tree, chain: str | None, fix: Mapping[str, float | None], notes: Notes) -> Tree:
    """Returns the robot with one moving arm.

    Args:
        chain: ``BASE:TIP``, two links. Joints that are neither between them nor on the tip's body are held still.
        fix: joint -> position to hold it at [rad, m]; None: the position nearest to 0.

    Raises:
        UserError: ``chain`` or ``fix`` names something that does not exist, no moving joint is left, or the robot is more than an
            arm and neither selects a part of it.
    """
    held = {name: _position(tree, name, value) for name, value in fix.items()}
    if chain is not None:
        held = {name: nearest(tree.joints[name]) for name in _outside(tree, chain)} | held
    tree = fixed(tree, held, notes)
    if not any(j.moves and not j.mimic for j in tree.joints.values()):
        raise UserError("no joint is left that moves: hold fewer")
    if chain is None:
        _check(tree)
    return tree


def fixed(tree: Tree, held: Mapping[str, float], notes: Notes) -> Tree:
    """Holds joints still at the given positions [rad, m], together with the joints that mimic them."""
    joints = dict(tree.joints)
    for name, joint in tree.joints.items():
        source, multiplier, offset = joint.mimic or (name, 1.0, 0.0)
        if name not in held and source not in held:
            continue
        at = held[name] if name in held else multiplier * held[source] + offset
        origin = joint.origin @ joint.motion(np.array([at]))[0]
        joints[name] = dataclasses.replace(joint, type="fixed", origin=origin, mimic=None)
        notes.add("note", "joint", name, f"held still at {at:g}")
    return dataclasses.replace(tree, joints=joints)


def limb(parts: dict[str, Body]) -> Limb:
    """Finds the robot's arm; the first of several."""
    return _limbs(parts)[0]


def _check(tree: Tree) -> None:
    """Refuses a robot that is more than an arm, and lists the choices."""
    parts = bodies(tree)
    limbs = _limbs(parts)
    branches = [b.name for b in parts.values() if b.parent == next(iter(parts))]
    driven = {b.name for b in parts.values() if b.joint and not b.joint.mimic}
    counts = [len(driven & set(below(parts, name))) for name in branches]
    short = max(counts) < FINGERS or max(_length(parts, name) for name in branches) < LONG
    if len(branches) > 1 and max(counts) <= HAND and short:
        joints = f"{len(branches)} branches of at most {max(counts)} driven joint{'s' * (max(counts) > 1)} leave its base"
        choice = f"--chain {limbs[0].base}:{_named(parts, limbs[0].end)}"
        advice = f"Import it with an arm that carries it, or one of its branches, {choice}"
        raise UserError(f"{tree.name} is not an arm: {joints}, as in a hand alone. {advice}")
    arms = {j for one in limbs for j in one.joints}
    ends = {name for one in limbs for name in below(parts, one.end)}
    spare = [b.joint.name for b in parts.values() if b.joint and not b.joint.mimic and b.name not in ends]
    spare = [name for name in spare if name not in arms]
    if len(limbs) == 1 and not spare:
        return
    longest = sorted(limbs, key=lambda one: -len(one.joints))[:MOST_CHOICES]  # arms have more joints than legs
    choices = ", ".join(f"--chain {one.base}:{_named(parts, one.end)}" for one in longest)
    more = f"{len(limbs)} arms" if len(limbs) > 1 else "an arm"
    more += f", and {len(spare)} joint{'s' * (len(spare) > 1)} beside {'them' if len(limbs) > 1 else 'it'}" if spare else ""
    rest = f" ({', '.join(spare[:4])}{', ...' * (len(spare) > 4)})" if spare else ""
    hold = f"; or hold joints still, --fix {spare[0]}[=VALUE]" if spare else ""
    raise UserError(f"{tree.name} is more than an arm: it has {more}{rest}. Choose {choices}{hold}")


def _limbs(parts: dict[str, Body]) -> list[Limb]:
    """Finds the arms.

    Where the tree forks, a branch with at least ``FINGERS`` more joints is the arm. If several branches have, and are longer than
    the path to the fork, they are arms. Otherwise the fork carries the hand, as it does where three branches of at least two
    joints are shorter than that path: one may be a thumb of ``FINGERS`` joints. A gear beside the last joint of a wrist ends no
    arm.
    """
    children: dict[str, list[Body]] = {name: [] for name in parts}
    for body in parts.values():
        if body.parent:
            children[body.parent].append(body)
    length = dict.fromkeys(parts, 0)  # driven joints in series, including this one
    for body in reversed(parts.values()):
        longest = max((length[b.name] for b in children[body.name]), default=0)
        length[body.name] = longest + bool(body.joint and not body.joint.mimic)
    out: list[Limb] = []

    def walk(base: str, here: str, passed: tuple[str, ...]) -> None:
        branches = children[here]
        long = [b for b in branches if length[b.name] >= FINGERS]
        if len(branches) == 1 or not passed and len(long) < 2:
            long = sorted(branches, key=lambda b: -length[b.name])[:1]
        elif len(long) > 1 or sum(length[b.name] > 1 for b in branches) > 2:  # arms, or fingers and a longer thumb
            long = long if max(length[b.name] for b in branches) > len(passed) else []
        elif not long and len(onward := [b for b in branches if children[b.name]]) == 1 and not any(map(_follows, branches)):
            long = onward if _forks(children, onward[0]) else []  # the others are the gears of a wrist
        if not long or not any(length[b.name] for b in long):
            out.append(Limb(base, here, passed))
        for branch in long if any(length[b.name] for b in long) else []:
            own = (branch.joint.name,) if branch.joint and not branch.joint.mimic else ()
            walk(here if len(long) > 1 else base, branch.name, passed + own)

    walk(next(iter(parts)), next(iter(parts)), ())
    turning = {b.joint.name for b in parts.values() if b.joint and b.joint.type == "continuous"}
    return [one for one in out if set(one.joints) - turning] or out  # a caster turns about three endless axes


def _length(parts: dict[str, Body], branch: str) -> float:
    """Returns how far a branch can reach from its first joint [m]."""
    far = {branch: 0.0}
    for name in below(parts, branch)[1:]:
        far[name] = far[parts[name].parent] + float(np.linalg.norm(parts[name].frame[:3, 3]))
    return max(far.values())


def _follows(body: Body) -> bool:
    return bool(body.joint and body.joint.mimic)


def _forks(children: Mapping[str, Sequence[Body]], body: Body) -> bool:
    """True if a body carries fingers: somewhere beyond it more than one body moves."""
    onward = children[body.name]
    return len(onward) > 1 or bool(onward) and _forks(children, onward[0])


def _named(parts: dict[str, Body], end: str) -> str:
    """Returns the last link of a body, the name by which users know an arm's end; not a sensor's, if there is another."""
    links = list(parts[end].links)
    return ([n for n in links if not SENSORS.search(n)] or links)[-1]


def _outside(tree: Tree, chain: str) -> list[str]:
    """Lists the driven joints that are neither between the chain's links nor on the body of its tip."""
    base, colon, tip = chain.partition(":")
    if not colon:
        raise UserError(f"--chain takes BASE:TIP, two links, got {config.short(chain)}")
    for link in (base, tip):
        if link not in tree.links:
            raise UserError(f"--chain names link {config.short(link)}, which is not there{config.hint(link, tree.links)}")
    above = {j.child: j for j in tree.joints.values()}
    path: list[Joint] = []
    at = tip
    while at != base:
        if at not in above:
            raise UserError(f"--chain {chain}: {tip} does not hang on {base}; start from {', '.join(_line(above, tip)[-3:])}")
        path.append(above[at])
        at = above[at].parent
    parts = bodies(tree)
    kept = {j.name for j in path}
    kept |= {j.name for j in (parts[n].joint for n in below(parts, body_of(parts, tip).name)[1:]) if j}
    if not any(tree.joints[n].moves for n in kept):
        raise UserError(f"--chain {chain}: no joint moves between {base} and {tip}")
    sources = {j.mimic[0] for n in kept if (j := tree.joints[n]).mimic}
    return [j.name for j in tree.joints.values() if j.moves and not j.mimic and j.name not in kept | sources]


def _line(above: Mapping[str, Joint], link: str) -> list[str]:
    return [link, *_line(above, above[link].parent)] if link in above else [link]


def _position(tree: Tree, name: str, value: float | None) -> float:
    moving = {n: j for n, j in tree.joints.items() if j.moves}
    if name not in moving:
        choices = ", ".join([*moving][:12]) + ", ..." * (len(moving) > 12)
        raise UserError(f"--fix names joint {config.short(name)}{config.hint(name, moving)}: choose from {choices}")
    joint = moving[name]
    if value is None:
        return nearest(joint)
    if not joint.lower <= value <= joint.upper:
        raise UserError(f"--fix {name}={value:g} is beyond its limits {joint.lower:g} .. {joint.upper:g}")
    return value


def nearest(joint: Joint) -> float:
    """Returns the position nearest to 0 [rad, m]."""
    return float(np.clip(0.0, joint.lower, joint.upper))
