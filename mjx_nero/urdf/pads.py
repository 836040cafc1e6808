"""The boxes that grip: fitted to the fingers where they hold the cube that the gripper is given."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool

from mjx_nero.urdf import primitives
from mjx_nero.urdf.primitives import Primitive
from mjx_nero.urdf.tree import Body, Matrix, Points, Pose, Vec

DISTAL = 0.4  # share of a finger's length, from the tip, that grips
PAD = (0.02, 0.02, 0.006)  # [m] along approach, across, thickness: of fingers whose meshes are missing
FEW = 20  # points, that no box is fitted to
THICK, MARGIN = 0.01, 0.005  # [m] a fixed jaw's pad is at least as thick as one; beside the other's pad it is as much wider


@dataclasses.dataclass(frozen=True)
class Finger:
    """A finger where it holds the cube.

    Attributes:
        name: of its body, or of the link that is the fixed jaw.
        points: of its surface [n, 3], in the link that the gripper's frame is given in; None: unknown.
        pose: of the body or link there [4, 4].
        outward: to which side along the opening it moves away, 1 or -1; of a fixed jaw the side that it is on.
    """

    name: str
    points: Points | None
    pose: Pose
    outward: float


@dataclasses.dataclass(frozen=True)
class Pads:
    """``pads`` and ``backs`` of a hand: name -> shape in its frame; and the pads where the cube is held."""

    pads: dict[str, Primitive]
    backs: dict[str, Primitive]
    held: list[Primitive]


def fitted(moving: list[tuple[Finger, Body]], fixed: Finger | None, frame: Matrix) -> Pads:
    """A box around the distal part of each finger, along the columns of ``frame`` [3, 3] (approach, opening, across).

    The fixed jaw's is fitted to what faces the moving one's pad; without a mesh it is that pad's like, where the two touch.
    """
    out = Pads({}, {}, [])
    lengths = [np.ptp(finger.points @ frame[:, 0]) for finger, _ in moving if finger.points is not None]
    length = float(np.median(lengths)) if lengths else 0.0
    for finger, body in moving:
        if finger.points is None:
            _add(out, finger, _blind(finger, body, frame))
        else:
            end = _distal(finger.points, frame, length)
            _split(out, finger, finger.points, end, frame)
    if fixed is not None and fixed.points is not None:
        faces = _facing(fixed, out.held[0], frame)
        _split(out, fixed, fixed.points, faces, frame) if faces.any() else _add(out, fixed, _like(out.held[0], fixed, frame))
    elif fixed is not None:
        _add(out, fixed, _like(out.held[0], fixed, frame))
    return out


def _add(out: Pads, finger: Finger, pad: Primitive) -> None:
    out.held.append(pad)
    out.pads[finger.name] = dataclasses.replace(pad, pose=np.linalg.inv(finger.pose) @ pad.pose)


def _split(out: Pads, finger: Finger, points: Points, end: Bool[np.ndarray, " n"], frame: Matrix) -> None:
    """A pad for the part that grips, a shape for the rest."""
    box = primitives.box(points[end], frame)
    _add(out, finger, primitives.measured(box, points[end], primitives.hull(points[end])))
    if np.count_nonzero(~end) >= FEW:
        back = primitives.best(points[~end], primitives.hull(points[~end]), boxes=False)
        out.backs[finger.name] = dataclasses.replace(back, pose=np.linalg.inv(finger.pose) @ back.pose)


def _distal(points: Points, frame: Matrix, length: float) -> Bool[np.ndarray, " n"]:
    """Which of the points [n] are in the part that grips; all, if hardly any are."""
    along = points @ frame[:, 0]
    chosen = along >= np.quantile(along, 0.999) - DISTAL * length
    return chosen if FEW <= chosen.sum() <= len(points) - FEW else np.ones(len(points), bool)


def _facing(jaw: Finger, pad: Primitive, frame: Matrix) -> Bool[np.ndarray, " n"]:
    """Which of the fixed jaw's points [n] face the moving one's pad: no wider than that, as thick, and on the other side.

    Along the approach they are the same, or, if the jaw ends before, as long a part that ends where the jaw does.
    """
    assert jaw.points is not None
    centre, half = pad.pose[:3, 3] @ frame, np.abs(frame.T @ pad.pose[:3, :3]) @ np.array(pad.size)
    at = jaw.points @ frame - centre
    beyond = at[:, 1] * jaw.outward > half[1] - MARGIN
    beside = (np.abs(at[:, 2]) <= half[2] + MARGIN) & beyond
    if beside.sum() < FEW:
        return np.zeros(len(at), bool)
    tip = min(float(np.quantile(at[beside, 0], 0.999)), half[0])
    facing = beside & (at[:, 0] <= tip) & (at[:, 0] >= tip - 2 * half[0])
    if facing.sum() < FEW:
        return np.zeros(len(at), bool)
    depth = at[:, 1] * jaw.outward
    return facing & (depth <= np.quantile(depth[facing], 0.01) + max(2 * half[1], THICK))


def _blind(finger: Finger, body: Body, frame: Matrix) -> Primitive:
    """The pad of a finger without a mesh: at its frame, of a jaw that turns about its end."""
    turns = body.joint is not None and body.joint.type != "prismatic"
    origin = (finger.pose @ np.append(2 * body.mass.com * turns, 1.0))[:3]
    half = np.array([PAD[0], PAD[2], PAD[1]]) / 2
    pose = primitives.pose(frame, origin + frame[:, 1] * finger.outward * half[1] - frame[:, 0] * half[0])
    return Primitive("box", tuple(half.tolist()), pose, covered=0.0, fill=0.0)


def _like(pad: Primitive, jaw: Finger, frame: Matrix) -> Primitive:
    """A pad like the moving jaw's, beside it on the fixed one's side."""
    pose = pad.pose.copy()
    pose[:3, 3] += frame[:, 1] * jaw.outward * 2 * float(np.abs(frame[:, 1] @ pose[:3, :3]) @ np.array(pad.size))
    return dataclasses.replace(pad, pose=pose)


def middle(boxes: list[Primitive], frame: Matrix) -> Vec:
    """Amid the pads, in the axes of ``frame``; along the opening between the faces that look at each other."""
    centres = np.array([b.pose[:3, 3] @ frame for b in boxes])
    half = np.array([np.abs(frame[:, 1] @ b.pose[:3, :3]) @ np.array(b.size) for b in boxes])
    out = centres.mean(0)
    if len(boxes) > 1:
        low, high = np.argmin(centres[:, 1]), np.argmax(centres[:, 1])
        out[1] = (centres[low, 1] + half[low] + centres[high, 1] - half[high]) / 2
    return out


def extents(box: Primitive, frame: Matrix) -> tuple[float, float, float]:
    """Full size along approach, across and along the opening [m]."""
    along, between, across = (2 * float(np.abs(frame[:, k] @ box.pose[:3, :3]) @ np.array(box.size)) for k in range(3))
    return round(along, 4), round(across, 4), round(between, 4)


def gap(pads: Mapping[str, Primitive], poses: Mapping[str, Pose], sides: Mapping[str, float]) -> float:
    """The least distance between pads on different sides of the opening [m], their bodies at ``poses`` [4, 4]."""
    placed = {n: dataclasses.replace(pad, pose=poses[n] @ pad.pose) for n, pad in pads.items()}
    pairs = [(a, b) for a in placed for b in placed if sides[a] > sides[b]]
    return min((primitives.distance(placed[a], placed[b]) for a, b in pairs), default=0.0)
