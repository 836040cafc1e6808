"""Moves a gripper through its range: which of its shapes meet, where, and how far apart they are."""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy import spatial

from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.tree import Body, Joint, Points, Poses, Tree, Values, Vec, below
from mjx_nero.urdf.tree import poses as body_poses

FOLLOWED, KEPT = 250, 2000  # points of a shape that are moved, and points that they are compared with
STEPS, TURN = 13, 73  # positions of a swing, and of a whole turn
FACE = 0.2  # a shape's face parts within this share of the range over its points
BESIDE = 0.7  # worth of meeting a fixed shape: two moving shapes that meet equally well are preferred
INNER = 0.25  # shapes have met on the way only if they part again by this share of the range
STILL = 1e-6  # [m, 1] least change of pose that counts as motion
TOUCH = 5e-3  # [m] distance at which shapes touch, as sampled points are millimetres apart
SLIDE = 0.3  # [m] a slide that is longer has placeholders for limits
WIDE = 0.01  # [m] shapes that part by less never met
AT_ZERO, NEAR_ZERO = 0.1, 1.2  # [rad] an endless jaw closes this near to zero; farther round it meets the arm
Positions = Mapping[str, Values]


@dataclasses.dataclass(frozen=True)
class Meeting:
    """Two shapes of a gripper over its swing.

    Attributes:
        names: a moving body, and another one or a link that carries the gripper.
        fixed: the second is such a link.
        apart: distance between the meeting faces [n]; for points in place of shapes, beyond their least distance.
        spots: the middles of these faces, each in its body's frame; a fixed one in the fork's.
    """

    names: tuple[str, str]
    fixed: bool
    apart: Values
    spots: tuple[Vec, Vec]

    @property
    def worth(self) -> float:
        """Distance by which the two part, minus their least distance [m].

        It is -inf for a finger that never comes near a fixed shape.
        """
        parted = float(np.ptp(self.apart) - self.apart.min())
        return parted if not self.fixed else BESIDE * parted if parted > 0 else -np.inf


class Swing:
    """The bodies that a gripper's joints move, and the body that carries them.

    Attributes:
        inside: the moving bodies.
        link: the fork's link that carries the first joint.
        shapes: surfaces of moving bodies in their frames [n, 3]; a single point each if none has a surface.
        fixed: surfaces of the fork's links, in the fork's frame.
        blind: True if no shape is known.
        assumed: joints without limits that meet nothing, for which ``ends`` assumed a quarter turn.
        limits: joint -> its limits, without those that are placeholders [rad, m].
        shortened: slides whose limits are placeholders.
    """

    def __init__(self, tree: Tree, parts: dict[str, Body], looks: Mapping[str, Look], joints: Sequence[str], fork: str):
        self.parts, self.fork = parts, fork
        self.assumed: list[str] = []
        self.joints = {b.joint.name: b.joint for b in parts.values() if b.joint}
        self.inside = _moved(parts, joints)
        found = {n: surface(parts[n].links, looks) for n in self.inside}
        self.shapes = {n: _some(points) for n, points in found.items() if points is not None}
        self.blind = not self.shapes
        held = {n: surface({n: at}, looks) for n, at in parts[fork].links.items()}
        self.fixed = {n: _some(points) for n, points in held.items() if points is not None}
        if self.blind:
            drawn = [n for n in self.inside if any(looks[link].drawn for link in parts[n].links)]
            self.shapes = {n: parts[n].mass.com[None] for n in drawn or self.inside}
        parent = self.joints[joints[0]].parent
        self.link = parent if parent in parts[fork].links else fork
        if self.blind or not self.fixed:
            self.fixed = {self.link: (parts[fork].links[self.link] @ np.append(tree.links[self.link].mass.com, 1.0))[None, :3]}
        self.limits = {j: self._limits(j) for j in joints}
        self.shortened = [j for j in joints if self.limits[j] != limits(self.joints[j])]
        self._trees = {n: spatial.cKDTree(points) for n, points in {**self.fixed, **self.shapes}.items()}

    def _limits(self, name: str) -> tuple[float, float]:
        """Returns a joint's limits [rad, m]. A slide of placeholders ends where the middle of its finger leaves the hand."""
        lower, upper = limits(self.joints[name])
        body = next(b for b in self.parts.values() if b.joint and b.joint.name == name)
        if self.joints[name].type != "prismatic" or upper - lower <= SLIDE or self.blind or body.name not in self.shapes:
            return lower, upper
        at = self.poses({j: np.zeros(1) for j in self.joints})[body.name][0]
        axis = at[:3, :3] @ self.joints[name].axis
        finger = (self.shapes[body.name] @ at[:3, :3].T + at[:3, 3]) @ axis
        hand = np.concatenate(list(self.fixed.values())) @ axis
        middle = (finger.min() + finger.max()) / 2
        return float(np.clip(hand.min() - middle, lower, upper)), float(np.clip(hand.max() - middle, lower, upper))

    def poses(self, q: Positions) -> dict[str, Poses]:
        """Poses of the moving bodies and of the fork, in the fork's frame [n, 4, 4]."""
        count = len(next(iter(q.values())))
        world = body_poses(self.parts, dict(q), count)
        base = np.linalg.inv(world[self.fork])
        return {n: base @ world[n] for n in (self.fork, *self.inside)}

    def meetings(self, q: Positions) -> list[Meeting]:
        """All pairs of shapes that move against each other, the likeliest grip first."""
        poses = self.poses(q)
        inverse = {n: np.linalg.inv(pose) for n, pose in poses.items()}
        pairs = [(a, b, False) for a, b in itertools.combinations(self.shapes, 2)]
        pairs += [(a, b, True) for a in self.shapes for b in self.fixed]
        found = []
        for a, b, fixed in pairs:
            there = inverse[self.fork if fixed else b] @ poses[a]
            if np.ptp(there, axis=0).max() > STILL:
                one, spot = self._face(self.shapes[a], there, b)
                two, face = self._face(self.fixed[b] if fixed else self.shapes[b], np.linalg.inv(there), a)
                apart = (one + two) / 2
                found.append(Meeting((a, b), fixed, apart - apart.min() if self.blind else apart, (spot, face)))
        return sorted(found, key=lambda m: -m.worth)

    def _face(self, points: Points, poses: Float[np.ndarray, "s 4 4"], other: str) -> tuple[Float[np.ndarray, " s"], Vec]:
        """Distance of the face that meets ``other`` in each of the poses [s], and the middle of that face."""
        some = _some(points, FOLLOWED)
        moved = some @ np.moveaxis(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        away = self._trees[other].query(moved.reshape(-1, 3))[0].reshape(len(poses), -1)
        worth = np.ptp(away, axis=0) - away.min(0)
        low, high = np.quantile(worth, (0.1, 0.99))
        face = worth >= high - FACE * (high - low)
        return away[:, face].mean(1), some[face].mean(0)

    def ends(
        self, joints: Sequence[str], open: Mapping[str, float], closed: Mapping[str, float]
    ) -> tuple[dict[str, float], dict[str, float]]:
        """Finds the positions of the joints when the gripper is closed, and when it is open [rad, m].

        Each joint goes from the end at which shapes meet to the one at which they are farther apart. Then all go together; if the
        shapes meet on the way, or are farthest apart there, the gripper is closed, or open, there.

        Args:
            open, closed: positions that are known already.
        """
        rest = {j: np.zeros(1) if endless(self.joints[j]) else np.array([np.mean(self.limits[j])]) for j in joints}
        ways = {j: self._way(j, rest) for j in joints}
        start = {j: closed.get(j, ways[j][0]) for j in joints}
        end = {j: open.get(j, ways[j][1]) for j in joints}
        if not (open or closed):
            shares = np.linspace(0, 1, STEPS)
            found = self.between(start, end)
            first, last = _turned(found[0].apart) if found else (0, STEPS - 1)
            start, end = ({j: (1 - shares[k]) * start[j] + shares[k] * end[j] for j in joints} for k in (first, last))
        return {j: float(start[j]) for j in joints}, {j: float(end[j]) for j in joints}

    def between(self, closed: Mapping[str, float], open: Mapping[str, float]) -> list[Meeting]:
        """Returns the ``meetings`` on the straight path from closed to open."""
        shares = np.linspace(0, 1, STEPS)
        return self.meetings({j: closed[j] + shares * (open[j] - closed[j]) for j in closed})

    def _way(self, name: str, rest: Positions) -> tuple[float, float]:
        """Returns the joint's position when shapes meet, and when they are apart, if it moves alone."""
        joint = self.joints[name]
        if endless(joint):
            ends = self.jaw(name, rest)
            self.assumed += [] if ends else [name]
            return ends or (0.0, np.pi / 2)
        lower, upper = self.limits[name]
        q = np.linspace(lower, upper, STEPS)
        found = self.meetings({**{j: np.repeat(v, STEPS) for j, v in rest.items()}, name: q})
        apart = found[0].apart if found else q
        return (lower, upper) if apart.argmin() <= apart.argmax() else (upper, lower)

    def jaw(self, name: str, rest: Positions) -> tuple[float, float] | None:
        """Returns where a joint without limits closes and opens, at most a quarter turn apart; None if nothing meets.

        It closes where its shape first meets another on the way from zero, or at zero. It opens the other way.
        """
        q = np.linspace(-np.pi, np.pi, TURN)
        for meeting in self.meetings({**{j: np.repeat(v, TURN) for j, v in rest.items()}, name: q}):
            apart = meeting.apart
            if np.ptp(apart) < max(WIDE, 2 * apart.min()):
                continue
            met = np.flatnonzero((apart < apart.min() + max(TOUCH, INNER / 2 * np.ptp(apart))) & (np.abs(q) < NEAR_ZERO))
            if not len(met):
                continue
            first = int(met[np.argmin(np.abs(q[met]))])
            away = {way: apart[(first + way * np.arange(TURN // 4 + 1)) % (TURN - 1)] for way in (1, -1)}
            way = -int(np.sign(q[first])) if abs(q[first]) > AT_ZERO else max(away, key=lambda w: float(away[w].mean()))
            return float(q[first]), float(q[first] + way * (q[1] - q[0]) * away[way].argmax())
        return None


def _turned(apart: Values) -> tuple[int, int]:
    """Returns the closed and the open end of a swing, by the distance of the shapes on the way."""
    low, high = int(apart.argmin()), int(apart.argmax())
    ends = (0, len(apart) - 1) if low <= high else (len(apart) - 1, 0)
    way = INNER * float(np.ptp(apart))
    return (low if apart[ends[0]] - apart[low] > way else ends[0]), (high if apart[high] - apart[ends[1]] > 2 * way else ends[1])


def endless(joint: Joint) -> bool:
    """True if the joint turns without limits, or by more than a turn."""
    return joint.type == "continuous" or joint.type == "revolute" and joint.upper - joint.lower > 2 * np.pi + 1e-6


def limits(joint: Joint) -> tuple[float, float]:
    """Limits of a gripper's joint; a quarter turn either way if it is endless."""
    return (-np.pi / 2, np.pi / 2) if endless(joint) else (joint.lower, joint.upper)


def surface(links: Mapping[str, np.ndarray], looks: Mapping[str, Look]) -> Points | None:
    """Points [n, 3] of links at their poses [4, 4], without stand-ins."""
    found = []
    for name, at in links.items():
        points = looks[name].points
        if points is not None and not looks[name].guessed:
            found.append(points @ at[:3, :3].T + at[:3, 3])
    return np.concatenate(found) if found else None


def _moved(parts: dict[str, Body], joints: Sequence[str]) -> list[str]:
    """Lists the bodies that the joints and their followers move."""
    driven = [b.name for b in parts.values() if b.joint and (b.joint.name in joints or (b.joint.mimic or ("",))[0] in joints)]
    moved = {n for name in driven for n in below(parts, name)}
    return [n for n in parts if n in moved]


def _some(points: Points, most: int = KEPT) -> Float[np.ndarray, "k 3"]:
    """Thins points evenly to at most ``most``."""
    return points[:: -(-len(points) // most)]
