"""Pads: the boxes that grip, fitted to the fingers where they hold the gripper's cube."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool

from mjx_nero.urdf import primitives
from mjx_nero.urdf.primitives import Primitive
from mjx_nero.urdf.tree import Body, Matrix, Points, Pose, Vec

DISTAL = 0.4  # share of a finger's length, from the tip, that grips
PAD = (0.02, 0.02, 0.006)  # [m] along approach, across, and thickness, for fingers without meshes
FEW = 20  # least points that a box is fitted to
THICK, MARGIN = 0.01, 0.005  # [m] least thickness of a fixed jaw's pad; how much wider than the other pad it may be


@dataclasses.dataclass(frozen=True)
class Finger:
    """A finger that holds the cube.

    Attributes:
        name: name of its body, or of the link that is the fixed jaw.
        points: points of its surface [n, 3], in the frame of the gripper's link; None: unknown.
        pose: pose of the body or link there [4, 4].
        shut: pose of the body when the gripper is closed [4, 4].
        outward: side along the opening to which it moves away, 1 or -1; a fixed jaw's own side.
    """

    name: str
    points: Points | None
    pose: Pose
    shut: Pose
    outward: float


@dataclasses.dataclass(frozen=True)
class Pads:
    """Pads and backs of a hand (name -> shape in its frame), and the pads where the cube is held."""

    pads: dict[str, Primitive]
    backs: dict[str, Primitive]
    held: list[Primitive]


def fitted(moving: list[tuple[Finger, Body]], fixed: Finger | None, frame: Matrix) -> Pads:
    """Fits a box to the distal part of each finger, along the columns of ``frame`` [3, 3] (approach, opening, across).

    The fixed jaw's pad is fitted to what faces the moving one's. Without a mesh it is a copy of that pad, where the two touch.
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
    if fixed is not None and fixed.points is not None and (faces := _facing(fixed, moving[0][0], out, frame)).any():
        _split(out, fixed, fixed.points, faces, frame)
    elif fixed is not None:
        _add(out, fixed, _like(out.held[0], fixed, frame))
    return out


def _add(out: Pads, finger: Finger, pad: Primitive) -> None:
    out.held.append(pad)
    out.pads[finger.name] = dataclasses.replace(pad, pose=np.linalg.inv(finger.pose) @ pad.pose)


def _split(out: Pads, finger: Finger, points: Points, end: Bool[np.ndarray, " n"], frame: Matrix) -> None:
    """Adds a pad for the part that grips, and a shape for what lies behind it."""
    box = primitives.box(points[end], frame)
    _add(out, finger, primitives.measured(box, points[end], primitives.hull(points[end])))
    behind = points[points @ frame[:, 0] < (points[end] @ frame[:, 0]).min()]
    if len(behind) >= FEW:
        back = primitives.best(behind, primitives.hull(behind), boxes=False)
        if _reach(back, frame) > _reach(box, frame):  # such as a ball about a palm
            back = primitives.measured(primitives.box(behind, frame), behind, primitives.hull(behind))
        out.backs[finger.name] = dataclasses.replace(back, pose=np.linalg.inv(finger.pose) @ back.pose)


def _reach(shape: Primitive, frame: Matrix) -> float:
    """Reach of the shape along the approach [m]."""
    return -float(shape.lowest(np.append(-frame[:, 0], 0.0)[None])[0])


def _distal(points: Points, frame: Matrix, length: float) -> Bool[np.ndarray, " n"]:
    """Selects the points [n] of the part that grips; all, if hardly any are."""
    along = points @ frame[:, 0]
    chosen = along >= np.quantile(along, 0.999) - DISTAL * length
    return chosen if FEW <= chosen.sum() <= len(points) - FEW else np.ones(len(points), bool)


def _facing(jaw: Finger, finger: Finger, out: Pads, frame: Matrix) -> Bool[np.ndarray, " n"]:
    """Selects the fixed jaw's points [n] that face the moving pad: no wider, as thick, and not in front of its face.

    Along the approach they span from where that pad begins when it holds the cube to where it ends when closed, or to the jaw's
    own end.
    """
    assert jaw.points is not None
    held = out.held[0]
    half, met = np.abs(frame.T @ held.pose[:3, :3]) @ np.array(held.size), finger.shut @ np.linalg.inv(finger.pose) @ held.pose
    start, end = held.pose[:3, 3] @ frame, met[:3, 3] @ frame
    at = jaw.points @ frame
    depth = at[:, 1] * jaw.outward - (start[1] * jaw.outward + half[1])
    beside = (np.abs(at[:, 2] - end[2]) <= half[2] + MARGIN) & (depth > -MARGIN)
    if beside.sum() < FEW:
        return np.zeros(len(at), bool)
    tip = min(float(np.quantile(at[beside, 0], 0.999)), end[0] + half[0])
    faces = beside & (at[:, 0] <= tip) & (at[:, 0] >= tip - 2 * half[0])
    if faces.sum() < FEW:
        return np.zeros(len(at), bool)
    face = float(np.quantile(depth[faces], 0.01))
    thick = (depth >= face - MARGIN / 2) & (depth <= face + max(2 * half[1], THICK))
    return beside & thick & (at[:, 0] <= tip) & (at[:, 0] >= min(start[0] - half[0], tip - 2 * half[0]))


def _blind(finger: Finger, body: Body, frame: Matrix) -> Primitive:
    """Makes the pad of a finger without a mesh: at its frame, or about the end of a turning jaw."""
    turns = body.joint is not None and body.joint.type != "prismatic"
    origin = (finger.pose @ np.append(2 * body.mass.com * turns, 1.0))[:3]
    half = np.array([PAD[0], PAD[2], PAD[1]]) / 2
    pose = primitives.pose(frame, origin + frame[:, 1] * finger.outward * half[1] - frame[:, 0] * half[0])
    return Primitive("box", tuple(half.tolist()), pose, covered=0.0, fill=0.0)


def _like(pad: Primitive, jaw: Finger, frame: Matrix) -> Primitive:
    """Copies the moving jaw's pad to the fixed one's side."""
    pose = pad.pose.copy()
    pose[:3, 3] += frame[:, 1] * jaw.outward * 2 * float(np.abs(frame[:, 1] @ pose[:3, :3]) @ np.array(pad.size))
    return dataclasses.replace(pad, pose=pose)


def middle(boxes: list[Primitive], frame: Matrix) -> Vec:
    """Middle of the pads, in the axes of ``frame``: of their overlap along the approach, and between their facing sides."""
    centres = np.array([b.pose[:3, 3] @ frame for b in boxes])
    half = np.array([np.abs(frame[:, 1] @ b.pose[:3, :3]) @ np.array(b.size) for b in boxes])
    reach = np.array([np.abs(frame[:, 0] @ b.pose[:3, :3]) @ np.array(b.size) for b in boxes])
    first, last = (centres[:, 0] - reach).max(), (centres[:, 0] + reach).min()
    out = centres.mean(0)
    out[0] = (first + last) / 2 if first < last else out[0]
    if len(boxes) > 1:
        low, high = np.argmin(centres[:, 1]), np.argmax(centres[:, 1])
        out[1] = (centres[low, 1] + half[low] + centres[high, 1] - half[high]) / 2
    return out


def extents(box: Primitive, frame: Matrix) -> tuple[float, float, float]:
    """Full size along approach, across and along the opening [m]."""
    along, between, across = (2 * float(np.abs(frame[:, k] @ box.pose[:3, :3]) @ np.array(box.size)) for k in range(3))
    return round(along, 4), round(across, 4), round(between, 4)


def gap(pads: Mapping[str, Primitive], poses: Mapping[str, Pose], sides: Mapping[str, float]) -> float:
    """Least distance between pads on different sides of the opening [m], with bodies at ``poses`` [4, 4]."""
    placed = {n: dataclasses.replace(pad, pose=poses[n] @ pad.pose) for n, pad in pads.items()}
    pairs = [(a, b) for a in placed for b in placed if sides[a] > sides[b]]
    return min((primitives.distance(placed[a], placed[b]) for a, b in pairs), default=0.0)
