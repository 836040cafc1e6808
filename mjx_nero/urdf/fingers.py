"""How the fingers open, where they grasp, and the shapes that do: guessed from where the joints move them."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from mjx_nero.sim import grasp
from mjx_nero.urdf import primitives
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Joint, Matrix, Points, Pose, Tree, Vec, below, body_of, depth
from mjx_nero.urdf.tree import poses as body_poses

DISTAL = 0.4  # share of a finger's length, from the tip, that grips
ON_AXIS = 5e-3  # [m] a tool this near to the last joint's axis is turned by it, not carried around
PAD = (0.02, 0.02, 0.006)  # [m] along approach, across, thickness: of fingers whose meshes are missing


@dataclasses.dataclass
class Hand:
    """The gripper, or the last link of an arm that has none.

    Attributes:
        joints: that drive it; empty without a gripper.
        open, close: their positions [rad, m].
        link: that the fingers move against; ``site`` is given in its frame.
        fingers: bodies that grip.
        site: pose of the grasp point in ``link`` [4, 4].
        approach, opening: unit vectors in the frame of ``site`` [3]: where the fingers point, along which they open.
        pads: link -> collision shape in its frame; the fixed jaw of a gripper with one moving jaw is among them.
        backs: link -> shape of the rest of a finger.
        inside: bodies that only the gripper's joints move.
        gap: between the pads when open [m].
        pad: size of the first along the approach, across, and along the opening [m].
        grip: where the middle of a cube is that it grips, from the grasp point, in its frame [m].
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
    pad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    grip: Vec = dataclasses.field(default_factory=lambda: np.zeros(3))


# Long: its steps share what they find.
def gripper(
    tree: Tree,
    parts: dict[str, Body],
    looks: Mapping[str, Look],
    joints: tuple[str, ...],
    fork: str,
    notes: Notes,
    ahead: Vec | None = None,
) -> Hand:
    """The whole of a gripper: which bodies grip, how they open, and the shapes that they grip with.

    Args:
        joints: that drive it.
        fork: body that carries it.
        ahead: where the fingers point, in the axes of ``Hand.link`` [3], in place of the guess.
    """
    moved = {b.joint.name: b.joint for b in parts.values() if b.joint}
    inside, fingers = _moving(parts, joints)
    link = moved[joints[0]].parent if moved[joints[0]].parent in parts[fork].links else fork
    at_link = parts[fork].links[link]

    def seen(q: Mapping[str, float]) -> dict[str, Pose]:
        """Poses [4, 4] of bodies in ``link``."""
        world = body_poses(parts, {j: np.array([v]) for j, v in q.items()})
        base = np.linalg.inv(world[fork][0] @ at_link)
        return {n: base @ world[n][0] for n in inside}

    def wrist(q: Mapping[str, float]) -> Vec:
        """Where the joint before the last one is, in ``link``."""
        world = body_poses(parts, {j: np.array([v]) for j, v in q.items()})
        base, above = np.linalg.inv(world[fork][0] @ at_link), parts[fork].parent
        return base[:3, :3] @ world[above][0][:3, 3] + base[:3, 3] if above else base[:3, 3]

    spots = {f: spot(parts[f], looks) for f in fingers}
    still = _still(tree, looks, link)

    def spread(q: Mapping[str, float]) -> float:
        """How far the fingers are apart."""
        poses = seen(q)
        ends = [poses[f][:3, :3] @ spots[f] + poses[f][:3, 3] for f in fingers]
        centre = still if len(ends) == 1 else np.mean(ends, axis=0)
        return float(sum(np.linalg.norm(e - centre) for e in ends))

    open, close = _ends({j: limits(moved[j]) for j in joints}, spread)
    for finger in fingers:
        joint = parts[finger].joint
        text = ", ".join(f"{n} {open[n]:g}" for n in joints)
        notes.add("guessed", "joint", joint.name if joint else "", f"a finger of the gripper, open at {text}")

    shut, apart = seen(close), seen(open)
    tips = [shut[f][:3, :3] @ spots[f] + shut[f][:3, 3] for f in fingers]
    moves = [(apart[f][:3, :3] @ spots[f] + apart[f][:3, 3]) - tip for f, tip in zip(fingers, tips, strict=True)]
    opening = snapped(_unit(moves[0] - (moves[1] if len(moves) > 1 else 0.0), np.array([0.0, 1.0, 0.0])))
    approach = _ahead(np.mean(tips, axis=0), opening, wrist(close)) if ahead is None else ahead
    opening = _unit(opening - approach * (approach @ opening), opening)
    frame = np.column_stack([approach, opening, np.cross(approach, opening)])

    surfaces = {f: _surface(parts[f], looks, shut[f]) for f in fingers}
    meshed = {f: s for f, s in surfaces.items() if s is not None}
    length = float(np.median([np.ptp(s @ approach) for s in meshed.values()])) if meshed else 0.0
    boxes: list[primitives.Primitive] = []
    pads: dict[str, primitives.Primitive] = {}
    backs: dict[str, primitives.Primitive] = {}

    def split(name: str, points: Points, pose: Pose) -> None:
        """A pad for the distal part, a shape for the rest; ``points`` in ``link``, in which the body has the ``pose``."""
        end = _distal(points, frame, length or float(np.ptp(points @ approach)))
        boxes.append(primitives.box(points[end], frame))
        pad = primitives.measured(boxes[-1], points[end], primitives.hull(points[end]))
        pads[name] = dataclasses.replace(pad, pose=np.linalg.inv(pose) @ pad.pose)
        if not end.all():
            back = primitives.best(points[~end], primitives.hull(points[~end]), boxes=False)
            backs[name] = dataclasses.replace(back, pose=np.linalg.inv(pose) @ back.pose)

    for f in fingers:
        if f in meshed:
            split(f, meshed[f], shut[f])
            text = f"a box pad on the distal {100 * DISTAL:.0f}%, along the opening; the rest meets the table only"
            notes.add("guessed", "link", f, text)
        else:
            boxes.append(_blind(parts[f], shut[f], frame, np.sign(opening @ moves[fingers.index(f)]) or 1.0))
            pads[f] = dataclasses.replace(boxes[-1], pose=np.linalg.inv(shut[f]) @ boxes[-1].pose)
            text = "no mesh: a box pad of 20 x 20 x 6 mm stands at its frame, or at a turning jaw's end"
            notes.add("guessed", "link", f, text)
    look = looks[link]
    if len(fingers) == 1 and look.points is not None and not look.guessed:
        split(link, look.points, np.eye(4))
        notes.add("guessed", "link", link, "the fixed jaw: a box pad on its end")
    elif len(fingers) == 1:
        shut_pad = shut[fingers[0]] @ pads[fingers[0]].pose
        across = opening * (np.sign(opening @ moves[0]) or 1.0)
        thick = 2 * float(np.abs(opening @ shut_pad[:3, :3]) @ np.array(pads[fingers[0]].size))
        shut_pad[:3, 3] -= across * thick
        boxes.append(dataclasses.replace(pads[fingers[0]], pose=shut_pad))
        pads[link] = boxes[-1]
        notes.add("guessed", "link", link, "the fixed jaw, no mesh: a box pad like the other's, where that closes")
    gap, pad = (
        _gap([apart.get(n, np.eye(4)) @ p.pose for n, p in pads.items()], list(pads.values()), opening),
        _extents(boxes[0], frame),
    )
    # Of a fixed jaw half a cube away: the other one comes to it.
    aside = np.sign(opening @ moves[0]) * grasp.edge(gap, pad) / 2 if len(fingers) == 1 else 0.0
    return Hand(
        joints,
        tuple(open[j] for j in joints),
        tuple(close[j] for j in joints),
        link,
        tuple(fingers),
        primitives.pose(np.eye(3), np.round(frame @ _middle(boxes, frame), 6) + 0.0),  # [m]: what is guessed has no more digits
        approach,
        opening,
        pads,
        backs,
        tuple(inside),
        gap,
        pad,
        opening * aside,
    )


def bare(parts: dict[str, Body], looks: Mapping[str, Look], link: str, at: Vec) -> Hand:
    """Without a gripper: a tool that points along the last joint's axis, outwards, if it lies on that axis; else away from it."""
    body = body_of(parts, link)
    frame = body.links[link] @ primitives.pose(np.eye(3), at)
    direction = frame[:3, 3]
    if body.joint is not None and body.joint.type != "prismatic":
        axis = body.joint.axis
        if np.linalg.norm(np.cross(frame[:3, 3], axis)) < ON_AXIS:
            along = float((frame[:3, 3] - np.linalg.inv(body.frame)[:3, 3]) @ axis)  # from the joint before
            if abs(along) < ON_AXIS:  # a bare wrist: to where its link lies
                surface = _surface(body, looks, np.eye(4))
                along = 1.0 if surface is None else float((surface.max(0) + surface.min(0)) @ axis) or 1.0
            direction = axis * np.sign(along)
    approach = snapped(frame[:3, :3].T @ _unit(direction, frame[:3, 2]))
    across = np.array([0.0, 1.0, 0.0]) if abs(approach[1]) < 0.7 else np.array([1.0, 0.0, 0.0])
    opening = _unit(across - approach * (approach @ across), across)
    return Hand((), (), (), link, (), primitives.pose(np.eye(3), at), approach, opening, {}, {}, ())


def _moving(parts: dict[str, Body], joints: Sequence[str]) -> tuple[list[str], list[str]]:
    """The bodies that the joints and their followers move, and the fingers among them: those farthest down the tree."""
    moved = {b.joint.name: b for b in parts.values() if b.joint}
    inside = [n for n in parts if parts[n].joint and any(n in below(parts, moved[j].name) for j in _followers(parts, joints))]
    leaves = [n for n in inside if not any(parts[m].parent == n for m in inside)]
    deepest = max(depth(parts, n) for n in leaves)
    return inside, [n for n in leaves if depth(parts, n) == deepest]


def _ends(
    ranges: Mapping[str, tuple[float, float]], spread: Callable[[Mapping[str, float]], float]
) -> tuple[dict[str, float], dict[str, float]]:
    """Open and closed positions: the end of each joint's range at which the fingers are farther apart, and the other."""
    middle = {j: sum(ends) / 2 for j, ends in ranges.items()}
    open: dict[str, float] = {}
    close: dict[str, float] = {}
    for name, (lower, upper) in ranges.items():
        wider = spread({**middle, name: upper}) >= spread({**middle, name: lower})
        close[name], open[name] = (lower, upper) if wider else (upper, lower)
    return open, close


def _ahead(tip: Vec, opening: Vec, wrist: Vec) -> Vec:
    """Where the fingers point, across the opening: from the origin to their ``tip``, but never back to the ``wrist``."""
    fallback = np.array([0.0, 0.0, 1.0]) if abs(opening[2]) < 0.7 else np.array([1.0, 0.0, 0.0])
    approach = snapped(_unit(tip - opening * (tip @ opening), fallback - opening * (fallback @ opening)))
    approach = _unit(approach - opening * (approach @ opening), approach)
    return approach if approach @ (tip - wrist) >= 0 else -approach


def _blind(finger: Body, at: Pose, frame: Matrix, outward: float) -> primitives.Primitive:
    """The pad of a finger without a mesh; ``outward``: to which side along the opening it moves away, 1 or -1."""
    assert finger.joint is not None
    turns = finger.joint.type != "prismatic"
    origin = (at @ np.append(2 * finger.mass.com * turns, 1.0))[:3]  # of a slide its frame, of a jaw about its end
    half = np.array([PAD[0], PAD[2], PAD[1]]) / 2
    pose = primitives.pose(frame, origin + frame[:, 1] * outward * half[1] - frame[:, 0] * half[0])
    return primitives.Primitive("box", tuple(half.tolist()), pose, covered=0.0, fill=0.0)


def _followers(parts: dict[str, Body], joints: Sequence[str]) -> list[str]:
    """The joints and those that mimic them."""
    return [b.joint.name for b in parts.values() if b.joint and (b.joint.name in joints or (b.joint.mimic or ("",))[0] in joints)]


def limits(joint: Joint) -> tuple[float, float]:
    """Of a gripper's joint; a quarter turn either way of one without limits, or with room for more than a turn."""
    endless = joint.type == "continuous" or joint.type == "revolute" and joint.upper - joint.lower > 2 * np.pi + 1e-6
    return (-np.pi / 2, np.pi / 2) if endless else (joint.lower, joint.upper)


def spot(body: Body, looks: Mapping[str, Look]) -> Vec:
    """A point that stands for a finger: the mean of its surface, or its centre of mass."""
    surface = _surface(body, looks, np.eye(4))
    return body.mass.com if surface is None else surface.mean(0)


def _surface(body: Body, looks: Mapping[str, Look], pose: Pose) -> Points | None:
    """Points [n, 3] of a body's links, where the body has the ``pose`` [4, 4]; stand-ins do not count."""
    found = []
    for name, at in body.links.items():
        points = looks[name].points
        if points is not None and not looks[name].guessed:
            at = pose @ at
            found.append(points @ at[:3, :3].T + at[:3, 3])
    return np.concatenate(found) if found else None


def _still(tree: Tree, looks: Mapping[str, Look], link: str) -> Vec:
    """A point that stands for the fixed jaw."""
    look = looks[link]
    return tree.links[link].mass.com if look.points is None or look.guessed else look.points.mean(0)


def _distal(points: Points, frame: Matrix, length: float) -> Bool[np.ndarray, " n"]:
    """Which of the points [n] are in the part that grips; all, if hardly any are."""
    along = points @ frame[:, 0]
    chosen = along >= np.quantile(along, 0.999) - DISTAL * length
    return chosen if 20 <= chosen.sum() <= len(points) - 20 else np.ones(len(points), bool)


def _middle(boxes: list[primitives.Primitive], frame: Matrix) -> Vec:
    """Amid the pads, in the axes of ``frame``; along the opening between the faces that look at each other."""
    centres = np.array([b.pose[:3, 3] @ frame for b in boxes])
    middle = centres.mean(0)
    if len(boxes) > 1:
        low, high = np.argmin(centres[:, 1]), np.argmax(centres[:, 1])
        middle[1] = (centres[low, 1] + boxes[low].size[1] + centres[high, 1] - boxes[high].size[1]) / 2
    return middle


def _gap(poses: list[Pose], pads: list[primitives.Primitive], opening: Vec) -> float:
    """How far apart the faces are that look at each other along the opening, at the pads' ``poses`` [m]."""
    centres = np.array([pose[:3, 3] @ opening for pose in poses])
    half = np.array([np.abs(opening @ pose[:3, :3]) @ np.array(pad.size) for pose, pad in zip(poses, pads, strict=True)])
    middle = (centres.min() + centres.max()) / 2
    above = centres > middle
    if len(pads) < 2 or above.all() or not above.any():
        return 0.0
    return round(max(float((centres - half)[above].min() - (centres + half)[~above].max()), 0.0), 4)


def _extents(box: primitives.Primitive, frame: Matrix) -> tuple[float, float, float]:
    """Full size along approach, across and along the opening [m]."""
    along, between, across = (2 * float(np.abs(frame[:, k] @ box.pose[:3, :3]) @ np.array(box.size)) for k in range(3))
    return round(along, 4), round(across, 4), round(between, 4)


def _unit(vector: Vec, otherwise: Vec) -> Vec:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else otherwise / np.linalg.norm(otherwise)


def snapped(vector: Vec, within: float = 25.0) -> Vec:
    """The nearest axis of the frame, if that is within so many degrees."""
    nearest = np.argmax(np.abs(vector))
    if abs(vector[nearest]) < np.cos(np.radians(within)):
        return vector
    return np.eye(3)[nearest] * np.sign(vector[nearest])
