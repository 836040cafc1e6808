"""The hand: where the robot grasps, where the hand points, and the pads that grip. All are guessed, or given by the user."""

import dataclasses
import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from mjx_nero import config
from mjx_nero.sim import grasp
from mjx_nero.types import UserError
from mjx_nero.urdf import fingers, pads, primitives
from mjx_nero.urdf.chain import SENSORS
from mjx_nero.urdf.fingers import Grip, Hand
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.swing import Swing, surface
from mjx_nero.urdf.tree import Body, Matrix, Points, Pose, Poses, Tree, Values, Vec, body_of, carriers
from mjx_nero.urdf.tree import poses as body_poses

_TIPS = re.compile(r"tcp|(^|[_/])ee(_|$)|end_?effector|grasp|gripper_frame|hand_tip", re.IGNORECASE)
_TOOLS = (  # tool names of an arm without gripper, the best first
    re.compile(r"tcp", re.IGNORECASE),
    re.compile(r"tool", re.IGNORECASE),
    re.compile(r"(^|[_/])ee(_|$)|(^|[_/])eef(_|$)|end_?effector|grasp", re.IGNORECASE),
    re.compile(r"flange", re.IGNORECASE),
)
NEAR = 0.06  # [m] a named frame this near to where the fingers meet is their grasp point; the flange's is farther away
TOOL_AXIS = 50.0  # [degrees] the working axis of a tool's frame is the one within this of where the fingers point
ON_AXIS = 5e-3  # [m] the last joint turns a tool this near to its axis, and carries others around
SHARES, NUDGE = 41, 0.02  # samples between closed and open; step in share that shows how the fingers move
ASIDE = 4e-3  # [m] gap between cube and fixed jaw as the hand comes down, as arms are exact to a few millimetres
ROUNDS = 3  # rounds of fitting pads to a held cube: the cube's size follows from the pads in turn


def find(
    tree: Tree,
    parts: dict[str, Body],
    looks: Mapping[str, Look],
    chosen: tuple[Sequence[str], str],
    ee: str | None,
    notes: Notes,
    open: Mapping[str, float] | None = None,
    closed: Mapping[str, float] | None = None,
) -> Hand:
    """Finds how the fingers open, and where they grasp.

    Closed is where the fingers' shapes are nearest; open is where they have parted. The grasp point is the middle of the pads
    that hold the cube, or a named frame near it (``tcp``, ``ee_...``, ``grasp``, ...). Without a gripper it is the tool's named
    frame (``tcp``, ``tool0``, ``end_effector``, ``ee_...``), or the last link. It is never a camera's frame.

    Args:
        chosen: joints and fork of ``fingers.choose``.
        ee: ``LINK`` or ``LINK:x,y,z``: the grasp point, instead of a guess.
        open, closed: positions of some of the gripper's joints [rad, m], instead of a guess.

    Raises:
        UserError: ``ee``, ``open`` or ``closed`` names something unknown.
    """
    joints, fork = tuple(chosen[0]), chosen[1]
    if not joints:
        link, at = _placed(tree, ee) if ee is not None else (_tool(parts), np.zeros(3))
        hand = bare(parts, looks, link, at)
    else:
        swing = Swing(tree, parts, looks, joints, fork)
        gripper = _Gripper(swing, looks, fingers.grip(swing, joints, open or {}, closed or {}, notes))
        held = gripper.held()
        named = _named(parts, gripper.grip.link, held.site) if ee is None else None
        if named is None and ee is None:
            hand = gripper.hand(held)
        else:
            link, at = _placed(tree, ee) if ee is not None else (str(named), np.zeros(3))
            hand = gripper.hand_at(held, link, at)
        _tell(gripper, hand, tree.name, notes)
    if ee is None:
        at_text = " ".join(f"{v:.4g}" for v in hand.site[:3, 3])
        why = "by its name" if any(p.search(hand.link) for p in (_TIPS, *_TOOLS)) else "the last one"
        text = f"{at_text} in link {hand.link!r}" if hand.site[:3, 3].any() else f"link {hand.link!r}, {why}"
        notes.add("guessed", "robot", tree.name, f"grasp point: {text} (--ee changes it)")
    return hand


@dataclasses.dataclass(frozen=True)
class _Held:
    """A gripper that holds its cube, in the frame of ``Grip.link``.

    Attributes:
        frame: the columns are approach, opening, and across both [3, 3].
        site: the middle of the pads [3].
        share: position between closed (0) and open (1).
        gaps: distances between the pads when closed and when open [m].
    """

    frame: Matrix
    site: Vec
    share: float
    pads: pads.Pads
    gaps: tuple[float, float]


class _Gripper:
    """A gripper whose joints go from closed (0) to open (1), in the frame of ``Grip.link``."""

    def __init__(self, swing: Swing, looks: Mapping[str, Look], grip: Grip):
        self.swing, self.looks, self.grip, self.parts = swing, looks, grip, swing.parts
        self._at_link = self.parts[grip.fork].links[grip.link]
        # No pose holds a cube without shapes, or with fingers that curl by joints of their own.
        self._known = not swing.blind and len(grip.joints) <= len(grip.fingers)
        self._shares = np.linspace(0, 1, SHARES)
        self._way = self.poses(self._shares)

    def poses(self, shares: Values) -> dict[str, Poses]:
        """Poses of the moving bodies and of the fork's links [n, 4, 4]."""
        ends = zip(self.grip.joints, self.grip.close, self.grip.open, strict=True)
        found = self.swing.poses({j: close + shares * (open - close) for j, close, open in ends})
        base = np.linalg.inv(self._at_link)
        links = {n: np.tile(base @ at, (len(shares), 1, 1)) for n, at in self.parts[self.grip.fork].links.items()}
        return links | {n: base @ found[n] for n in self.swing.inside}

    def held(self, ahead: Vec | None = None) -> _Held:
        """Fits the pads where they hold the cube that fits them; or closed, if that pose is unknown.

        Args:
            ahead: where the fingers point [3], instead of a guess.
        """
        share = 0.0
        if self._known:
            apart = self.grip.meeting.apart
            parted = np.maximum.accumulate(apart) - apart[0]
            share = float(np.interp(grasp.SHARE * parted[-1], parted, np.linspace(0, 1, len(parted))))
        for _ in range(ROUNDS if self._known else 1):
            frame = self._frame(share, ahead)
            moving, jaw = self._fingers(share, frame)
            fit = pads.fitted(moving, jaw, frame)
            sides = {finger.name: finger.outward for finger in (*(f for f, _ in moving), *([jaw] if jaw else []))}
            at = [{n: self._way[n][k] for n in fit.pads} for k in range(SHARES)]
            gaps = np.array([pads.gap(fit.pads, poses, sides) for poses in at])
            held = _Held(frame, frame @ pads.middle(fit.held, frame), share, fit, (float(gaps[0]), float(gaps[-1])))
            edge = grasp.edge(held.gaps[1], self._extents(held), held.gaps[0])
            if not gaps[0] < edge < gaps[-1]:
                break
            share = float(np.interp(edge, np.maximum.accumulate(gaps) + 1e-9 * self._shares, self._shares))
        return held

    def _frame(self, share: float, ahead: Vec | None) -> Matrix:
        """Builds the frame of the fingers there: where they point, how they open, and across both."""
        spots = self._spots(share)
        moved = spots[:, 1] - spots[:, 0]
        sides = [way - np.delete(moved, k, 0).mean(0) for k, way in enumerate(moved)]  # of three fingers, one against two
        way = max(sides, key=lambda v: float(np.linalg.norm(v)) + 1e-9)
        if self.grip.jaw and not self.swing.blind:  # from face to face: the bisector of holding jaws points ahead
            way = (spots[0] - spots[1]).mean(0)
        pivot, axis = self._hinge(share)
        opening = snapped(_unit(way - axis * (axis @ way), np.array([0.0, 1.0, 0.0])))
        if ahead is None:
            tip, across = spots.mean((0, 1)), np.cross(axis, opening)
            ahead = _ahead(tip, opening, self._wrist())
            if np.linalg.norm(across) > 0.8:
                ahead = across / np.linalg.norm(across) * (np.sign(across @ (tip - pivot)) or 1.0)
        opening = _unit(opening - ahead * (ahead @ opening), opening)
        return np.column_stack([ahead, opening, np.cross(ahead, opening)])

    def _spots(self, share: float) -> Float[np.ndarray, "fingers 2 3"]:
        """Positions of the meeting faces of the fingers, the fixed jaw's last, shortly before and after."""
        at, (one, two) = self.poses(self._around(share)), self.grip.meeting.spots
        met = dict(zip(self.grip.meeting.names, (one, two), strict=True))
        if self.grip.jaw:
            base = np.linalg.inv(self._at_link) @ np.append(two, 1.0)
            return np.array([_placed_at(at[self.grip.fingers[0]], one), np.tile(base[:3], (2, 1))])
        return np.array([_placed_at(at[n], met.get(n, self.swing.shapes[n].mean(0))) for n in self.grip.fingers])

    def _around(self, share: float) -> Values:
        return np.clip([share - NUDGE, share + NUDGE], 0, 1) if self._known or self.swing.blind else np.array([0.0, 1.0])

    def _hinge(self, share: float) -> tuple[Vec, Vec]:
        """Position and axis of the joint that turns the first finger; zeros if none does."""
        name, pivot, axis = self.grip.meeting.names[0], np.zeros(3), np.zeros(3)
        there = self.poses(np.array([share]))
        while name in self.swing.inside:
            joint, pose = self.parts[name].joint, there[name][0]
            if joint is not None and joint.type != "prismatic":
                pivot, axis = pose[:3, 3], pose[:3, :3] @ joint.axis
            name = self.parts[name].parent
        return pivot, axis

    def _wrist(self) -> Vec:
        """Position of the joint before the last one."""
        world, fork = body_poses(self.parts, {}), self.grip.fork
        base, above = np.linalg.inv(world[fork][0] @ self._at_link), self.parts[fork].parent
        return base[:3, :3] @ world[above][0][:3, 3] + base[:3, 3] if above else base[:3, 3]

    def _fingers(self, share: float, frame: Matrix) -> tuple[list[tuple[pads.Finger, Body]], pads.Finger | None]:
        """Returns the moving fingers, and the fixed jaw of a single one."""
        there, around = self.poses(np.array([share, 0.0])), self.poses(self._around(share))
        moving = []
        for name in self.grip.fingers:
            points = None if self.swing.blind else surface(self.parts[name].links, self.looks)
            spot = np.append(self.swing.shapes[name].mean(0), 1.0)
            way = (around[name][1] - around[name][0]) @ spot
            points = None if points is None else points @ there[name][0][:3, :3].T + there[name][0][:3, 3]
            outward = float(np.sign(frame[:, 1] @ way[:3])) or 1.0
            moving.append((pads.Finger(name, points, there[name][0], there[name][1], outward), self.parts[name]))
        if not self.grip.jaw:
            return moving, None
        pose = there[self.grip.jaw][0]
        points = None if self.swing.blind else surface({self.grip.jaw: pose}, self.looks)
        return moving, pads.Finger(self.grip.jaw, points, pose, pose, -moving[0][0].outward)

    def hand(self, held: _Held) -> Hand:
        """Builds the hand, with the grasp point in the middle of its pads."""
        grip, frame = self.grip, held.frame
        extents = self._extents(held)
        closed, gap = (round(float(v), 4) for v in held.gaps)
        hand = Hand(
            joints=grip.joints,
            open=grip.open,
            close=grip.close,
            link=grip.link,
            fingers=grip.fingers,
            site=primitives.pose(np.eye(3), np.round(held.site, 6) + 0.0),  # [m] a guess deserves no more digits
            approach=frame[:, 0],
            opening=frame[:, 1],
            pads=held.pads.pads,
            backs=held.pads.backs,
            inside=tuple(self.swing.inside),
            gap=gap if np.isfinite(grip.meeting.worth) else 0.0,
            closed=closed,
            pad=extents,
        )
        if grip.jaw:  # leaves room beside the fixed jaw; the moving jaw then pushes the cube against it
            edge = grasp.edge(hand.gap, extents, closed)
            aside = min(ASIDE, max(0.0, hand.gap - edge) / 4) + (edge / 2 if self.swing.blind else 0.0)
            hand.grip = np.round(frame[:, 1] * self._fingers(held.share, frame)[0][0][0].outward * aside, 4) + 0.0
        return hand

    def _extents(self, held: _Held) -> tuple[float, float, float]:
        """Size of a pad, as long as the fingers reach beyond the grasp point anywhere between open and the cube."""
        along, across, between = pads.extents(held.pads.held[0], held.frame)
        way = self._shares >= held.share
        row = np.append(-held.frame[:, 0], 0.0)
        shapes = [(n, shape) for found in (held.pads.pads, held.pads.backs) for n, shape in found.items()]
        reach = max(-float(shape.lowest(row @ self._way[n][way]).min()) for n, shape in shapes) - held.site @ held.frame[:, 0]
        return round(max(along, 2 * float(reach)), 4), across, between

    def hand_at(self, held: _Held, link: str, at: Vec) -> Hand:
        """Builds the hand with the grasp point in the frame of a named link, one of whose axes tells where the fingers point.

        Pads that stand in for missing meshes are moved there, because the frame is more reliable.
        """
        there = self._in_link(link, held.share)
        held = self.held(there[:3, :3] @ snapped(there[:3, :3].T @ held.frame[:, 0], TOOL_AXIS))
        there = self._in_link(link, held.share)
        hand, turn = self.hand(held), there[:3, :3].T
        away = turn @ (held.site - there[:3, 3]) - at
        if self.swing.blind:
            by = there[:3, :3] @ -away
            poses = {n: p[0] for n, p in self.poses(np.array([held.share])).items()}
            hand.pads = {n: _shifted(pad, poses[n], by) for n, pad in hand.pads.items()}
            away = np.zeros(3)
        return dataclasses.replace(
            hand,
            link=link,
            site=primitives.pose(np.eye(3), at),
            approach=turn @ hand.approach,
            opening=turn @ hand.opening,
            grip=np.round(away + turn @ hand.grip, 4) + 0.0,
        )

    def _in_link(self, link: str, share: float) -> Pose:
        """Pose of any link of the robot in the frame of ``Grip.link`` [4, 4]."""
        ends = zip(self.grip.joints, self.grip.close, self.grip.open, strict=True)
        world = body_poses(self.parts, {j: np.array([close + share * (open - close)]) for j, close, open in ends})
        fork, body = self.grip.fork, body_of(self.parts, link)
        return np.linalg.inv(world[fork][0] @ self._at_link) @ world[body.name][0] @ body.links[link]


def _placed_at(poses: Poses, spot: Vec) -> Points:
    """Positions of a body's point in each of its poses."""
    return poses[:, :3, :3] @ spot + poses[:, :3, 3]


def _shifted(pad: primitives.Primitive, pose: Pose, by: Vec) -> primitives.Primitive:
    """Moves a pad of a body at ``pose``."""
    there = pose @ pad.pose
    there[:3, 3] += by
    return dataclasses.replace(pad, pose=np.linalg.inv(pose) @ there)


def _tell(gripper: _Gripper, hand: Hand, name: str, notes: Notes) -> None:
    """Notes what was guessed about the gripper, and what is missing."""
    grip, blind = gripper.grip, gripper.swing.blind
    for finger in grip.fingers:
        text = f"a box pad on the distal {100 * pads.DISTAL:.0f}%, along the opening; the rest meets the table only"
        blank = "no mesh: a box pad of 20 x 20 x 6 mm stands at its frame, or at a turning jaw's end"
        notes.add("guessed", "link", finger, blank if blind else text)
    if grip.jaw:
        seen = hand.pads[grip.jaw].fill > 0
        text = "a box pad on what faces the moving jaw" if seen else "no mesh: a box pad like the other's, where that closes"
        notes.add("guessed", "link", grip.jaw, f"the fixed jaw, {text}")
    opened, shut = (", ".join(f"{j} {q:.4g}" for j, q in zip(grip.joints, ends, strict=True)) for ends in (grip.open, grip.close))
    known = f"its pads are {1000 * hand.gap:.0f} mm apart when open ({opened}), {1000 * hand.closed:.0f} mm when closed ({shut})"
    if hand.gap and grasp.edge(hand.gap, hand.pad, hand.closed):
        notes.add("guessed", "robot", name, f"{known} (--open and --closed change it)")
        return
    between = ", ".join((*grip.fingers, *([grip.jaw] if grip.jaw else [])))
    lack = "how far its gripper opens is unknown" if hand.gap < grasp.STROKE else "no cube fits between its fingers"
    why = (
        "no mesh of its fingers was found, and " if blind else ""
    ) + f"between {shut} and {opened} the pads on {between} do not part"
    if hand.gap >= grasp.STROKE:
        lack, why = ("closing moves its pads apart", known) if hand.gap < hand.closed else (lack, known)
    flags = " ".join(f"--{flag} {','.join(f'{j}=VALUE' for j in grip.joints)}" for flag in ("open", "closed"))
    text = f"{lack}, and tasks that grasp need it: {why}. Give {flags}; --gripper names other joints"
    notes.add("warning", "robot", name, text)


def bare(parts: dict[str, Body], looks: Mapping[str, Look], link: str, at: Vec) -> Hand:
    """Builds the hand of an arm without a gripper.

    Its tool points outwards along the last joint's axis if it lies on that axis, and otherwise away from it.
    """
    body = body_of(parts, link)
    frame = body.links[link] @ primitives.pose(np.eye(3), at)
    direction = frame[:3, 3]
    if body.joint is not None and body.joint.type != "prismatic":
        axis = body.joint.axis
        if np.linalg.norm(np.cross(frame[:3, 3], axis)) < ON_AXIS:
            along = float((frame[:3, 3] - np.linalg.inv(body.frame)[:3, 3]) @ axis)  # from the joint before
            if abs(along) < ON_AXIS:  # a bare wrist points to where its link lies
                points = surface(body.links, looks)
                along = 1.0 if points is None else float((points.max(0) + points.min(0)) @ axis) or 1.0
            direction = axis * np.sign(along)
    approach = snapped(frame[:3, :3].T @ _unit(direction, frame[:3, 2]))
    across = np.array([0.0, 1.0, 0.0]) if abs(approach[1]) < 0.7 else np.array([1.0, 0.0, 0.0])
    opening = _unit(across - approach * (approach @ across), across)
    site = primitives.pose(np.eye(3), at)
    return Hand(
        joints=(),
        open=(),
        close=(),
        link=link,
        fingers=(),
        site=site,
        approach=approach,
        opening=opening,
        pads={},
        backs={},
        inside=(),
    )


def _tool(parts: dict[str, Body]) -> str:
    """Chooses the tool's frame of an arm without gripper: the best name on its last body, the outermost of equals.

    Without a telling name, it is a link on the last joint's axis, where flanges are.
    """
    last = parts[max(parts, key=lambda n: len(carriers(parts, n)))]
    links = [n for n in last.links if not SENSORS.search(n)] or list(last.links)
    for pattern in _TOOLS:
        found = [n for n in links if pattern.search(n)]
        if found:
            return found[-1]
    if last.joint is not None and last.joint.type != "prismatic":
        links = [n for n in links if np.linalg.norm(np.cross(last.links[n][:3, 3], last.joint.axis)) < ON_AXIS] or links
    return links[-1]


def _named(parts: dict[str, Body], link: str, at: Vec) -> str | None:
    """Finds the named frame nearest to where the fingers meet (``at`` in ``link``), if one is near."""
    body = body_of(parts, link)
    centre = (body.links[link] @ np.append(at, 1.0))[:3]
    away = {
        n: float(np.linalg.norm(frame[:3, 3] - centre))
        for n, frame in body.links.items()
        if _TIPS.search(n) and not SENSORS.search(n)
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


def _ahead(tip: Vec, opening: Vec, wrist: Vec) -> Vec:
    """Chooses where the fingers point, across the opening: from the origin to their ``tip``, but never back to the ``wrist``."""
    fallback = np.array([0.0, 0.0, 1.0]) if abs(opening[2]) < 0.7 else np.array([1.0, 0.0, 0.0])
    approach = snapped(_unit(tip - opening * (tip @ opening), fallback - opening * (fallback @ opening)))
    approach = _unit(approach - opening * (approach @ opening), approach)
    return approach if approach @ (tip - wrist) >= 0 else -approach


def _unit(vector: Vec, otherwise: Vec) -> Vec:
    length = np.linalg.norm(vector)
    return vector / length if length > 1e-6 else otherwise / np.linalg.norm(otherwise)


def snapped(vector: Vec, within: float = 25.0) -> Vec:
    """Returns the nearest axis of the frame, if it is within ``within`` degrees."""
    nearest = np.argmax(np.abs(vector))
    if abs(vector[nearest]) < np.cos(np.radians(within)):
        return vector
    return np.eye(3)[nearest] * np.sign(vector[nearest])
