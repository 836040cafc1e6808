"""How the fingers open, where they grasp, and the shapes that do: guessed from where the joints move them."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool

from mjx_nero.urdf import fit
from mjx_nero.urdf.looks import Look
from mjx_nero.urdf.notes import Notes
from mjx_nero.urdf.tree import Body, Matrix, Points, Pose, Tree, Vec, below, depth
from mjx_nero.urdf.tree import poses as body_poses

DISTAL = 0.4  # share of a finger's length, from the tip, that grips
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
    """

    joints: tuple[str, ...]
    open: tuple[float, ...]
    close: tuple[float, ...]
    link: str
    fingers: tuple[str, ...]
    site: Pose
    approach: Vec
    opening: Vec
    pads: dict[str, fit.Primitive]
    backs: dict[str, fit.Primitive]
    inside: tuple[str, ...]


def gripper(
    tree: Tree, parts: dict[str, Body], looks: Mapping[str, Look], joints: tuple[str, ...], fork: str, notes: Notes
) -> Hand:
    moved = {b.joint.name: b for b in parts.values() if b.joint}
    inside = [n for n in parts if parts[n].joint and any(n in below(parts, moved[j].name) for j in _followers(parts, joints))]
    leaves = [n for n in inside if not any(parts[m].parent == n for m in inside)]
    deepest = max(depth(parts, n) for n in leaves)
    fingers = [n for n in leaves if depth(parts, n) == deepest]
    link = moved[joints[0]].joint.parent  # type: ignore[union-attr]
    if link not in parts[fork].links:
        link = fork
    at_link = parts[fork].links[link]

    def seen(q: Mapping[str, float]) -> dict[str, Pose]:
        """Poses [4, 4] of bodies in ``link``."""
        world = body_poses(parts, {j: np.array([v]) for j, v in q.items()})
        base = np.linalg.inv(world[fork][0] @ at_link)
        return {n: base @ world[n][0] for n in inside}

    spots = {f: _spot(parts[f], looks) for f in fingers}
    still = _still(tree, looks, link)
    middle = {j: (moved[j].joint.lower + moved[j].joint.upper) / 2 for j in joints}  # type: ignore[union-attr]

    def spread(q: Mapping[str, float]) -> float:
        """How far the fingers are apart."""
        poses = seen(q)
        ends = [poses[f][:3, :3] @ spots[f] + poses[f][:3, 3] for f in fingers]
        centre = still if len(ends) == 1 else np.mean(ends, axis=0)
        return float(sum(np.linalg.norm(e - centre) for e in ends))

    open: dict[str, float] = {}
    close: dict[str, float] = {}
    for name in joints:
        joint = moved[name].joint
        assert joint is not None
        lower, upper = joint.lower, joint.upper
        wider = spread({**middle, name: upper}) >= spread({**middle, name: lower})
        close[name], open[name] = (lower, upper) if wider else (upper, lower)
    for finger in fingers:
        joint = parts[finger].joint
        text = ", ".join(f"{n} {open[n]:g}" for n in joints)
        notes.add("guessed", "joint", joint.name if joint else "", f"a finger of the gripper, open at {text}")

    shut, apart = seen(close), seen(open)
    moves = [(apart[f][:3, :3] @ spots[f] + apart[f][:3, 3]) - (shut[f][:3, :3] @ spots[f] + shut[f][:3, 3]) for f in fingers]
    opening = snapped(_unit(moves[0] - (moves[1] if len(moves) > 1 else 0.0), np.array([0.0, 1.0, 0.0])))
    ahead = np.mean([shut[f][:3, :3] @ spots[f] + shut[f][:3, 3] for f in fingers], axis=0)
    ahead = ahead - opening * (ahead @ opening)
    fallback = np.array([0.0, 0.0, 1.0]) if abs(opening[2]) < 0.7 else np.array([1.0, 0.0, 0.0])
    approach = snapped(_unit(ahead, fallback - opening * (fallback @ opening)))
    approach = _unit(approach - opening * (approach @ opening), approach)
    frame = np.column_stack([approach, opening, np.cross(approach, opening)])

    surfaces = {f: _surface(parts[f], looks, shut[f]) for f in fingers}
    meshed = {f: s for f, s in surfaces.items() if s is not None}
    length = float(np.median([np.ptp(s @ approach) for s in meshed.values()])) if meshed else 0.0
    boxes: list[fit.Primitive] = []
    pads: dict[str, fit.Primitive] = {}
    backs: dict[str, fit.Primitive] = {}

    def split(name: str, points: Points, pose: Pose) -> None:
        """A pad for the distal part, a shape for the rest; ``points`` in ``link``, in which the body has the ``pose``."""
        end = _distal(points, frame, length or float(np.ptp(points @ approach)))
        boxes.append(fit.box(points[end], frame))
        pad = fit.measured(boxes[-1], points[end], fit.hull(points[end]))
        pads[name] = dataclasses.replace(pad, pose=np.linalg.inv(pose) @ pad.pose)
        if not end.all():
            back = fit.best(points[~end], fit.hull(points[~end]), boxes=False)
            backs[name] = dataclasses.replace(back, pose=np.linalg.inv(pose) @ back.pose)

    for f in fingers:
        if f in meshed:
            split(f, meshed[f], shut[f])
            text = f"a box pad on the distal {100 * DISTAL:.0f}%, along the opening; the rest meets the table only"
            notes.add("guessed", "link", f, text)
        else:
            turns = parts[f].joint.type != "prismatic"  # type: ignore[union-attr]
            origin = shut[f] @ np.append(2 * parts[f].mass.com * turns, 1.0)  # of a slide its frame, of a jaw about its end
            origin, outward = origin[:3], np.sign(opening @ moves[fingers.index(f)]) or 1.0
            half = np.array([PAD[0], PAD[2], PAD[1]]) / 2
            pose = fit.pose(frame, origin + opening * outward * half[1] - approach * half[0])
            boxes.append(fit.Primitive("box", tuple(half.tolist()), pose, covered=0.0, fill=0.0))
            pads[f] = dataclasses.replace(boxes[-1], pose=np.linalg.inv(shut[f]) @ pose)
            text = "no mesh: a box pad of 20 x 20 x 6 mm stands at its frame, or at a turning jaw's end"
            notes.add("guessed", "link", f, text)
    look = looks[link]
    if len(fingers) == 1 and look.points is not None and not look.guessed:
        split(link, look.points, np.eye(4))
        notes.add("guessed", "link", link, "the fixed jaw: a box pad on its end")
    return Hand(
        joints,
        tuple(open[j] for j in joints),
        tuple(close[j] for j in joints),
        link,
        tuple(fingers),
        fit.pose(np.eye(3), np.round(frame @ _middle(boxes, frame), 6) + 0.0),  # [m]: what is guessed has no more digits
        approach,
        opening,
        pads,
        backs,
        tuple(inside),
    )


def _followers(parts: dict[str, Body], joints: Sequence[str]) -> list[str]:
    """The joints and those that mimic them."""
    return [b.joint.name for b in parts.values() if b.joint and (b.joint.name in joints or (b.joint.mimic or ("",))[0] in joints)]


def _spot(body: Body, looks: Mapping[str, Look]) -> Vec:
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


def _middle(boxes: list[fit.Primitive], frame: Matrix) -> Vec:
    """Amid the pads, in the axes of ``frame``; along the opening between the faces that look at each other."""
    centres = np.array([b.pose[:3, 3] @ frame for b in boxes])
    middle = centres.mean(0)
    if len(boxes) > 1:
        low, high = np.argmin(centres[:, 1]), np.argmax(centres[:, 1])
        middle[1] = (centres[low, 1] + boxes[low].size[1] + centres[high, 1] - boxes[high].size[1]) / 2
    return middle


def _unit(vector: Vec, otherwise: Vec) -> Vec:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else otherwise / np.linalg.norm(otherwise)


def snapped(vector: Vec) -> Vec:
    """The nearest axis of the frame, if that is within 25 degrees."""
    nearest = np.argmax(np.abs(vector))
    if abs(vector[nearest]) < np.cos(np.radians(25)):
        return vector
    return np.eye(3)[nearest] * np.sign(vector[nearest])
