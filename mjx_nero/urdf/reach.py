"""Home pose, workspace and the downward orientation, from random poses of the robot."""

import itertools
from collections.abc import Mapping

import mujoco
import numpy as np

from mjx_nero import config
from mjx_nero.types import UserError
from mjx_nero.urdf import fit
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.notes import Notes
from mjx_nero.urdf.tree import Body, Points, Pose, Poses, Values, body_of
from mjx_nero.urdf.tree import poses as body_poses

SAMPLES = 20_000
CELLS = 12  # of the reach
STARTS, ITERATIONS = 8, 40  # of the inverse kinematics that checks a workspace
MISS = 2e-3  # [m] how near it has to come
TABLE = 0.05  # [m] the workspace stays above
Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


class Cloud:
    """The robot in ``SAMPLES`` random poses, where it is mounted.

    Attributes:
        q: joint -> positions [n] of the driven joints: first the arm's guess of a home pose, then random; the gripper is open.
        poses: body -> [n, 4, 4], in the unturned frame (the mount's position left out).
        height: of that frame above the table [m].
    """

    def __init__(self, parts: dict[str, Body], hand: Hand, mount: Pose, home: Mapping[str, float]):
        rng = np.random.default_rng(0)
        self.q: dict[str, Values] = {}
        self._limits: dict[str, tuple[float, float]] = {}
        for joint in (b.joint for b in parts.values() if b.joint and not b.joint.mimic):
            lower, upper = (-np.pi, np.pi) if joint.type == "continuous" else (joint.lower, joint.upper)
            drawn = rng.uniform(lower, upper, SAMPLES)
            if joint.name in hand.joints:
                drawn[:] = hand.open[hand.joints.index(joint.name)]
            else:
                self._limits[joint.name] = lower, upper
            drawn[0] = home[joint.name]
            self.q[joint.name] = drawn
        self._parts, self._hand, self._turn = parts, hand, mount.copy()
        self.height, self._turn[:3, 3] = float(mount[2, 3]), 0.0
        self.poses = {name: self._turn @ p for name, p in body_poses(parts, self.q, SAMPLES).items()}
        self.site = self._sites(self.poses)

    def _sites(self, poses: Mapping[str, Poses]) -> Poses:
        body = body_of(self._parts, self._hand.link)
        return poses[body.name] @ body.links[self._hand.link] @ self._hand.site

    def miss(self, goals: Points) -> Values:
        """How near the grasp point gets to each of the goals [n, 3] by damped least squares from the nearest poses [n]."""
        at, joints, step = self.site[1:, :3, 3], list(self._limits), 1e-5
        lower, upper = np.array([self._limits[j] for j in joints]).T
        nearest = [1 + np.argsort(np.linalg.norm(at - g, axis=1))[:STARTS] for g in goals]
        q = np.array([[self.q[j][i] for j in joints] for i in np.concatenate(nearest)])
        wanted = np.repeat(goals, STARTS, axis=0)
        held = {j: self.q[j][1] for j in self.q if j not in joints}
        around = step * np.vstack([np.zeros(len(joints)), np.eye(len(joints))])  # here, and a bit along each joint
        best = np.full(len(q), np.inf)
        for _ in range(ITERATIONS):
            tried = (q[:, None] + around).reshape(-1, len(joints))
            n = len(tried)
            driven = {j: tried[:, k] for k, j in enumerate(joints)} | {j: np.full(n, v) for j, v in held.items()}
            p = self._sites(body_poses(self._parts, driven, n))[:, :3, 3] @ self._turn[:3, :3].T
            p = p.reshape(len(q), -1, 3)
            error, jacobian = wanted - p[:, 0], np.moveaxis(p[:, 1:] - p[:, :1], 1, 2) / step
            best = np.minimum(best, np.linalg.norm(error, axis=1))
            square = jacobian @ np.moveaxis(jacobian, 1, 2) + 1e-4 * np.eye(3)
            move = np.moveaxis(jacobian, 1, 2) @ np.linalg.solve(square, error[:, :, None])
            q = np.clip(q + np.clip(move[:, :, 0], -0.3, 0.3), lower, upper)
        return best.reshape(len(goals), STARTS).min(1)

    def lowest(self, link: str, shape: fit.Primitive) -> Values:
        """Height [n] of the shape's lowest point above the table."""
        body = body_of(self._parts, link)
        return shape.lowest(self.poses[body.name] @ body.links[link]) + self.height


def first_home(parts: Mapping[str, Body], hand: Hand, given: Mapping[str, float]) -> dict[str, float]:
    """0 within the joint's limits, else their middle; the gripper open; ``given`` goes first.

    Raises:
        UserError: ``given`` names an unknown joint or a position beyond its limits.
    """
    joints = {b.joint.name: b.joint for b in parts.values() if b.joint and not b.joint.mimic}
    for name, value in given.items():
        if name not in joints:
            raise UserError(f"--home names joint {name!r}{config.hint(name, joints)}: choose from {', '.join(joints)}")
        if not joints[name].lower <= value <= joints[name].upper:
            raise UserError(f"--home {name}={value:g} is beyond its limits {joints[name].lower:g} .. {joints[name].upper:g}")
    home = {n: 0.0 if j.lower <= 0 <= j.upper else (j.lower + j.upper) / 2 for n, j in joints.items()}
    return {**home, **dict(zip(hand.joints, hand.open, strict=True)), **given}


def clear_home(
    hand: Hand,
    cloud: Cloud,
    home: dict[str, float],
    given: Mapping[str, float],
    shapes: list[tuple[str, fit.Primitive]],
    name: str,
    notes: Notes,
) -> dict[str, float]:
    """``home``, or if a shape is below the table there, the nearest of the random poses in which none is."""
    guessed = [j for j in home if j not in given and j not in hand.joints]
    clear = np.min([cloud.lowest(link, s) for link, s in shapes], axis=0) > 0.01 if shapes else np.ones(SAMPLES, bool)
    if clear[0] or not guessed:
        if guessed:
            notes.add("guessed", "robot", name, "home: 0 where limits allow, else the middle (--home changes it)")
        if not clear[0]:
            notes.add("warning", "robot", name, "at home it reaches below the table: change --home or base_pos")
        return home
    fits = clear & np.all([np.abs(cloud.q[j] - v) < 1e-9 for j, v in given.items() if j not in hand.joints] or [clear], axis=0)
    if not fits.any():
        notes.add("warning", "robot", name, "at home it reaches below the table: change --home or base_pos")
        return home
    away = np.sum([(cloud.q[j] - home[j]) ** 2 for j in guessed], axis=0)
    best = int(np.argmin(np.where(fits, away, np.inf)))
    notes.add("guessed", "robot", name, "home: near 0, moved until nothing is below the table (--home changes it)")
    return {**home, **{j: float(round(cloud.q[j][best], 3)) for j in guessed}}


def workspace(cloud: Cloud, name: str, notes: Notes) -> Box | None:
    """A box that the grasp point gets to everywhere, in the unturned frame.

    Space is cut into cells of a twelfth of the reach; those that the grasp point visits, or four of whose six neighbours it
    visits, count as reachable. Of all boxes of such cells that lie more than 5 cm above the table, at least a fifth of the reach
    before the base and are at most half of it wide, the one is taken whose volume, weighted by nearness to the middle of the
    space in front, is largest; it spans from the centre of its first cell to that of its last. In front means +x, unless there is
    more than 1.5 times as much room on another side. Inverse kinematics then has to get to 27 points of it, corners and centre
    among them, or it is made smaller.
    """
    at = cloud.site[1:, :3, 3]
    reach = float(np.quantile(np.linalg.norm(at, axis=1), 0.99))
    if reach < 0.02:
        notes.add("warning", "robot", name, "no workspace: the grasp point hardly moves; give one in robot.yaml")
        return None
    cell = reach / CELLS
    index = np.floor(at / cell).astype(int) + CELLS
    count = np.zeros((2 * CELLS + 1,) * 3, int)
    inside = ((index >= 0) & (index < 2 * CELLS)).all(1)
    np.add.at(count, tuple(index[inside].T + 1), 1)
    seen = np.minimum(count, 1)
    around = sum(np.roll(seen, shift, axis) for axis in range(3) for shift in (-1, 1))
    seen = np.maximum(seen, around >= 4)  # chance misses cells in the midst of others
    total = seen.cumsum(0).cumsum(1).cumsum(2)  # reachable cells below a corner
    centre = (np.arange(2 * CELLS) - CELLS + 0.5) * cell
    spans = [(i, k) for i in range(2 * CELLS) for k in range(i + 1, min(i + CELLS // 2, 2 * CELLS - 1) + 1)]
    best: tuple[float, Box | None] = (0.0, None)
    for axis, sign in ((0, 1), (1, 1), (1, -1), (0, -1)):
        ranges = []
        for k in range(3):
            ok = [s for s in spans if k != axis or min(sign * centre[s[0]], sign * centre[s[1]]) >= 0.2 * reach]
            ok = [s for s in ok if k != 2 or centre[s[0]] + cloud.height > TABLE + cell / 2]
            ranges.append(np.array(ok or [(0, 0)]))
        grids = np.ix_(*(np.arange(len(r)) for r in ranges))
        first, last = ([r[g, e] for r, g in zip(ranges, grids, strict=True)] for e in (0, 1))
        found, wanted = 0, 1
        for corner in itertools.product((0, 1), repeat=3):
            ends = tuple(last[k] + 1 if corner[k] else first[k] for k in range(3))
            found = found + total[ends] * (-1) ** (3 - sum(corner))
        score: np.ndarray | float = 1.0
        middle = np.array([0.0, 0.0, 0.3 * reach - cloud.height])
        middle[axis] += sign * 0.5 * reach
        for k in range(3):
            wanted = wanted * (last[k] + 1 - first[k])
            away = (centre[first[k]] + centre[last[k]]) / 2 - middle[k]
            score = score * (last[k] - first[k]) * np.exp(-0.5 * (away / (0.4 * reach)) ** 2)
        score = np.where(found == wanted, score, 0.0) * (1.5 if (axis, sign) == (0, 1) else 1.0)
        i = np.unravel_index(np.argmax(score), score.shape)
        if score[i] > best[0]:
            lower, upper = ([float(centre[ranges[k][i[k], e]]) for k in range(3)] for e in (0, 1))
            x, y, z = zip(lower, upper, strict=True)
            best = float(score[i]), (x, y, z)
    found_box = None if best[1] is None else _checked(cloud, best[1])
    if found_box is None:
        notes.add("warning", "robot", name, "no workspace found above the table: give one in robot.yaml")
    else:
        text = ", ".join(f"{k} {a:g} .. {b:g}" for k, (a, b) in zip("xyz", found_box, strict=True))
        notes.add("guessed", "robot", name, f"workspace: {text}; poses in it may touch the robot itself")
    return found_box


def _checked(cloud: Cloud, box: Box) -> Box | None:
    """The box, smaller about its centre until inverse kinematics gets to its corners and the points midway."""
    ends = np.array(box)
    grid = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    for shrink in (1.0, 0.85, 0.7, 0.55, 0.4):
        half = shrink * np.ptp(ends, axis=1) / 2
        if (cloud.miss(ends.mean(1) + grid * half) < MISS).all():
            x, y, z = ((round(float(m - h), 3), round(float(m + h), 3)) for m, h in zip(ends.mean(1), half, strict=True))
            return x, y, z
    return None


def down(cloud: Cloud, hand: Hand, box: Box | None) -> tuple[float, float, float, float]:
    """Orientation (wxyz) of the grasp point with the approach straight down and the opening along y.

    Two are, half a turn apart: the one that more random poses in the workspace are near to.
    """
    approach, opening = hand.approach, hand.opening
    if abs(approach @ opening) > 1e-6:
        opening = opening - approach * (approach @ opening)
        length = np.linalg.norm(opening)
        opening = opening / length if length > 1e-6 else np.cross(approach, np.eye(3)[np.argmin(np.abs(approach))])
        opening = opening / np.linalg.norm(opening)
    local = np.column_stack([approach, opening, np.cross(approach, opening)])
    world = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # columns -z, y, x
    turns = [world @ local.T, world * [1, -1, -1] @ local.T]
    points, sites = cloud.site[1:, :3, 3], cloud.site[1:, :3, :3]
    near = np.ones(len(points), bool)
    for k, (lower, upper) in enumerate(box or ()):
        near &= (points[:, k] > lower) & (points[:, k] < upper)
    downward = near & ((sites @ approach)[:, 2] < -0.85)
    along = (sites[downward] @ opening)[:, 1]
    votes = [(along > 0.7).sum(), (along < -0.7).sum()]
    quats = []
    for turn in turns:
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(turn).reshape(-1))
        quats.append(quat * (np.sign(quat[np.argmax(np.abs(quat))]) or 1.0))
    better = int(votes[1] > votes[0]) if votes[0] != votes[1] else int(abs(quats[1][1]) > abs(quats[0][1]))
    w, x, y, z = (float(round(v, 9)) + 0.0 for v in quats[better])
    return w, x, y, z
