"""The workspace, and the orientation of a hand that points down."""

import itertools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Int

from mjx_nero import config
from mjx_nero.sim import quats
from mjx_nero.types import UserError
from mjx_nero.urdf.cloud import Cloud
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Points, Values, Vec

CELLS = 12  # cells along the reach
STARTS, DESCENTS = 8, 3  # descents per point, and per cell
TABLE = 0.05  # [m] least height of the workspace above the table
SIDES = ((0, 1), (1, 1), (1, -1), (0, -1))  # axis and sign
DOWNWARD = 0.85  # cosine of the tilt of a hand that points down
TURNED = 0.3  # least cosine between opening and y that decides which way round is nearer
FRONT = 2.5  # the workspace lies on another side only if that has this many times the cells in front
Grid = Bool[np.ndarray, "a b c"]
Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


def first_home(parts: Mapping[str, Body], hand: Hand, given: Mapping[str, float]) -> dict[str, float]:
    """Guesses a home: 0 for a joint with a tenth of its range on both sides, else the middle; the gripper is open.

    ``given`` has priority.

    Raises:
        UserError: ``given`` names an unknown joint or a position beyond its limits.
    """
    joints = {b.joint.name: b.joint for b in parts.values() if b.joint and not b.joint.mimic}
    for name, value in given.items():
        if name not in joints:
            raise UserError(f"--home names joint {name!r}{config.hint(name, joints)}: choose from {', '.join(joints)}")
        if not joints[name].lower <= value <= joints[name].upper:
            raise UserError(f"--home {name}={value:g} is beyond its limits {joints[name].lower:g} .. {joints[name].upper:g}")
    home = {}
    for name, joint in joints.items():
        spare = 0.1 * (joint.upper - joint.lower)
        home[name] = 0.0 if joint.lower + spare <= 0 <= joint.upper - spare else (joint.lower + joint.upper) / 2
    return {**home, **dict(zip(hand.joints, hand.open, strict=True)), **given}


def workspace(cloud: Cloud, name: str, notes: Notes) -> tuple[Box | None, bool]:
    """Finds a box that the grasp point reaches everywhere, in the unturned frame, and whether it does so pointing down.

    The space about the shoulder is cut into cells of a twelfth of the reach. A cell is reachable if the grasp point visits it, or
    four of its six neighbours. Cells that inverse kinematics reaches with the hand pointing down are preferred. Candidate boxes
    of such cells lie at least 5 cm above the table and a fifth of the reach in front of the shoulder, and are at most half the
    reach wide. The best has the largest volume weighted by nearness to the middle of the space in front; it spans from the centre
    of its first cell to that of its last. In front means +x, unless another side has more than ``FRONT`` times as many reachable
    cells. The box shrinks until inverse kinematics reaches 27 of its points, including corners and centre.
    """
    origin, reach = cloud.shoulder, cloud.reach
    if reach < 0.02:
        notes.add("warning", "robot", name, "no workspace: the grasp point hardly moves; give one in robot.yaml")
        return None, False
    cell = reach / CELLS
    centre = (np.arange(2 * CELLS) - CELLS + 0.5) * cell
    seen = _visited(cloud.site[1:, :3, 3] - origin, cell)
    floor = -cloud.height - origin[2] + TABLE  # lowest height of a box, from the shoulder
    room = [(seen & _ahead(centre, reach, floor, side)).sum() * (1 if side else FRONT) for side in range(len(SIDES))]
    side = int(np.argmax(room))
    pointing = _pointing(cloud, centre, reach, floor, side)
    found, pointed = None, False
    for cells, down in ((pointing, True), (seen, False)):
        box = None if found else _largest(cells, centre, reach, floor, side)
        if box is not None:
            found, pointed = _checked(cloud, _shifted(box, origin), down), down
    if found is None:
        notes.add("warning", "robot", name, "no workspace found above the table: give one in robot.yaml")
        return None, False
    text = ", ".join(f"{k} {a:g} .. {b:g}" for k, (a, b) in zip("xyz", found, strict=True))
    how = "the hand can point down in all of it" if pointed else "the hand cannot point down in all of it"
    notes.add("guessed", "robot", name, f"workspace: {text}; {how}; poses in it may touch the robot itself")
    return found, pointed


def _ahead(centre: Values, reach: float, floor: float, side: int) -> Grid:
    """Selects the cells in front of the shoulder, on one of the ``SIDES``, above the table."""
    axis, sign = SIDES[side]
    at = np.stack(np.meshgrid(centre, centre, centre, indexing="ij"))
    up = at[2] - floor
    return (sign * at[axis] >= 0.2 * reach) & (np.abs(at[1 - axis]) < 0.4 * reach) & (up > 0) & (up < 0.7 * reach)


def _pointing(cloud: Cloud, centre: Values, reach: float, floor: float, side: int) -> Grid:
    """Selects the cells in front of the shoulder that the hand reaches pointing down."""
    pointing = _ahead(centre, reach, floor, side)
    cells = np.argwhere(pointing)
    if len(cells):
        pointing[tuple(cells.T)] = _reached(cloud, centre[cells] + cloud.shoulder, True, DESCENTS)
    return pointing | (_around(pointing) >= 4)


def _visited(at: Points, cell: float) -> Grid:
    """Selects the cells in which points [n, 3] lie, and gaps in their midst."""
    index = np.floor(at / cell).astype(int) + CELLS
    seen = np.zeros((2 * CELLS,) * 3, bool)
    inside = ((index >= 0) & (index < 2 * CELLS)).all(1)
    seen[tuple(index[inside].T)] = True
    return seen | (_around(seen) >= 4)


def _around(cells: Grid) -> Int[np.ndarray, "a b c"]:
    """Counts the set cells among each cell's six neighbours."""
    padded = np.pad(cells.astype(int), 1)
    total = sum(np.roll(padded, shift, axis) for axis in range(3) for shift in (-1, 1))
    return np.asarray(total)[1:-1, 1:-1, 1:-1]


def _largest(seen: Grid, centre: Values, reach: float, floor: float, side: int) -> Box | None:
    """Finds the best box of reachable cells on a side."""
    axis, sign = SIDES[side]
    total = np.pad(seen.astype(int), ((1, 0),) * 3).cumsum(0).cumsum(1).cumsum(2)  # reachable cells below a corner
    cell = float(centre[1] - centre[0])
    n = len(centre)
    spans = [(i, k) for i in range(n) for k in range(i + 1, min(i + n // 4, n - 1) + 1)]
    ranges = []
    for k in range(3):
        flat = [(i, i) for i in range(n)] if k == 2 else []  # some hands can point down only in a thin layer
        ok = [s for s in spans + flat if k != axis or min(sign * centre[s[0]], sign * centre[s[1]]) >= 0.2 * reach]
        ok = [s for s in ok if k != 2 or centre[s[0]] > floor + cell / 2]
        if not ok:
            return None
        ranges.append(np.array(ok))
    grids = np.ix_(*(np.arange(len(r)) for r in ranges))
    first, last = ([r[g, e] for r, g in zip(ranges, grids, strict=True)] for e in (0, 1))
    found, wanted = 0, 1
    for corner in itertools.product((0, 1), repeat=3):
        ends = tuple(last[k] + 1 if corner[k] else first[k] for k in range(3))
        found = found + total[ends] * (-1) ** (3 - sum(corner))
    score: np.ndarray | float = 1.0
    middle = np.array([0.0, 0.0, floor + 0.25 * reach])
    middle[axis] += sign * 0.5 * reach
    for k in range(3):
        wanted = wanted * (last[k] + 1 - first[k])
        away = (centre[first[k]] + centre[last[k]]) / 2 - middle[k]
        width = 0.2 if k == 1 - axis else 0.4  # shares of the reach; ahead of the shoulder rather than to its side
        score = score * (last[k] - first[k] + 0.5 * (k == 2)) * np.exp(-0.5 * (away / (width * reach)) ** 2)
    score = np.where(found == wanted, score, 0.0)
    i = np.unravel_index(np.argmax(score), score.shape)
    if score[i] <= 0:
        return None
    x, y, z = ((float(centre[ranges[k][i[k], 0]]), float(centre[ranges[k][i[k], 1]])) for k in range(3))
    z = (z[0] - cell / 4, z[1] + cell / 4) if z[0] == z[1] else z
    return x, y, z


def _shifted(box: Box, by: Vec) -> Box:
    x, y, z = ((lower + float(d), upper + float(d)) for (lower, upper), d in zip(box, by, strict=True))
    return x, y, z


def _checked(cloud: Cloud, box: Box, down: bool) -> Box | None:
    """Shrinks the box about its centre until inverse kinematics reaches its corners and the points midway."""
    ends = np.array(box)
    grid = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    corner = np.abs(grid).all(1)
    for shrink in (1.0, 0.85, 0.7, 0.55, 0.4):
        half = shrink * np.ptp(ends, axis=1) / 2
        if all(_reached(cloud, ends.mean(1) + points * half, down, STARTS).all() for points in (grid[corner], grid[~corner])):
            x, y, z = ((round(float(m - h), 3), round(float(m + h), 3)) for m, h in zip(ends.mean(1), half, strict=True))
            return x, y, z
    return None


def _reached(cloud: Cloud, goals: Points, down: bool, starts: int) -> Bool[np.ndarray, " g"]:
    """True for each of the goals [g, 3] that inverse kinematics reaches."""
    return ~np.isnan(cloud.solve(goals, down, starts, one=True)[:, :, 0]).all(1)


def down(cloud: Cloud, hand: Hand, box: Box | None, home: Mapping[str, float]) -> tuple[float, float, float, float]:
    """Orientation (wxyz) of the grasp point with the approach straight down and the opening along y.

    Two such orientations exist, half a turn apart. The one nearer at home wins, because turning by half a turn costs time; if
    neither is near, the one that more random poses in the workspace are near to.
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
    downward = near & ((sites @ approach)[:, 2] < -DOWNWARD)
    along = (sites[downward] @ opening)[:, 1]
    votes = [(along > 0.7).sum(), (along < -0.7).sum()]
    first = cloud.grasp_point(home)[:3, :3]
    turned = (first @ opening)[1]
    if (first @ approach)[2] < -DOWNWARD and abs(turned) > TURNED:
        votes = [turned > 0, turned < 0]
    found = []
    for turn in turns:
        quat = quats.of_matrix(turn)
        found.append(quat * (np.sign(quat[np.argmax(np.abs(quat))]) or 1.0))
    better = int(votes[1] > votes[0]) if votes[0] != votes[1] else int(abs(found[1][1]) > abs(found[0][1]))
    w, x, y, z = (float(round(v, 9)) + 0.0 for v in found[better])
    return w, x, y, z
