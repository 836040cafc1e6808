"""Regions where the gripper can grasp on the table and where it can hold an object, found by inverse kinematics."""

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from mjx_nero.sim import grasp, quats
from mjx_nero.urdf.cloud import Cloud
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.primitives import Primitive
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Points, Poses, Values, Vec
from mjx_nero.urdf.workspace import Box

CELLS = 16  # cells along the reach
NEAR, ASIDE = 0.25, 0.3125  # shares of the reach: least distance ahead of the shoulder, greatest to its side
LONG, WIDE = 0.25, 0.4  # shares of the reach: greatest size of a region, ahead and aside
SPARE = 0.02  # share of the reach: margin that the hand can reach beyond the region, if there is such a region
OVER = 0.06  # [m] height above the grasp at which the hand still points down, to approach from above
TALL = 0.4  # share of the reach: greatest height above the table for holding
WIDTH = 0.15  # share of the reach: a hand with a narrower region tries to lean further
LEANS = tuple(np.radians((15, 30, 45)))  # leans of a hand that cannot point down, the least first
HELD = np.radians(60)  # greatest lean while holding
DESCENTS, STARTS = 8, 12  # descents per cell, and per point of a region
TURNS = 5  # least joints of an arm that can turn its hand freely while the hand points down
SHRINKS = (1.0, 0.85, 0.7, 0.55, 0.4)
Quat = tuple[float, float, float, float]
Way = tuple[Vec | None, Quat]  # a way to turn the hand
Shapes = list[tuple[str, Primitive]]  # link and shape, for shapes that collide with the table


@dataclasses.dataclass(frozen=True)
class Place:
    """The regions for grasping and holding, and how the hand is turned there.

    Attributes:
        pick, hold: the boxes of ``RobotCfg``; None if there are none.
        lean: the hand's angle from pointing down [rad].
        turns: the hand can be turned there so that its fingers open along y.
        ways: ways to turn the hand about the vertical, the usual one first. Each is a direction in the grasp point's frame [3]
            that lies along y (None: any turn will do), and the orientation ``RobotCfg.down``.
    """

    pick: Box | None
    hold: Box | None
    lean: float
    turns: bool
    ways: tuple[Way, ...]


@dataclasses.dataclass(frozen=True)
class Reaching:
    """Inverse kinematics that stays above the table.

    Attributes:
        shapes: the shapes that must stay above it.
        shun, tilt, along: arguments of ``Cloud.solve``.
    """

    cloud: Cloud
    shapes: Shapes
    shun: Bool[np.ndarray, " n"]
    tilt: float = 0.0
    along: Vec | None = None

    def __call__(self, goals: Points, starts: int) -> Bool[np.ndarray, " g"]:
        """True for each of the goals [g, 3] that the grasp point reaches."""
        if not len(goals):
            return np.zeros(0, bool)
        q = self.cloud.solve(goals, True, starts, tilt=self.tilt, along=self.along, shun=self.shun)
        there = ~np.isnan(q[:, :, 0])
        there[there] = _above(self.cloud, self.shapes, self.cloud.at(q[there]))
        return there.any(1)

    def everywhere(self, box: Box) -> bool:
        """True if it reaches the corners of a box and the points midway."""
        return bool(self(np.array(list(itertools.product(*(dict.fromkeys((a, (a + b) / 2, b)) for a, b in box)))), STARTS).all())


def _above(cloud: Cloud, shapes: Shapes, poses: Mapping[str, Poses]) -> Bool[np.ndarray, " n"]:
    """True for each pose in which no shape is below the table."""
    heights = [cloud.lowest(link, shape, poses) for link, shape in shapes]
    return np.min(heights, axis=0) > 0 if heights else np.ones(len(next(iter(poses.values()))), bool)


def find(cloud: Cloud, hand: Hand, work: Box | None, down: Quat, shapes: Shapes, name: str, notes: Notes) -> Place:
    """Finds the boxes ``pick`` and ``hold`` of ``RobotCfg``, and how the hand is turned there.

    The table in front of the shoulder, on the side of the workspace, is cut into cells of a sixteenth of the reach. A cell counts
    if inverse kinematics reaches it with the hand pointing down and its fingers opening along y, at the height of a grasp and
    ``OVER`` above it, with nothing below the table. If there are no such cells either way round, any turn about the vertical will
    do; if there are still none, the hand may lean by one of ``LEANS``.

    ``pick`` is the rectangle of such cells, up to ``LONG`` by ``WIDE``, with the largest area weighted by nearness to the middle
    in front of the shoulder. It shrinks until inverse kinematics reaches 27 of its points, including the corners. ``hold`` rises
    from there as far as the arm reaches with the hand within ``HELD`` of down.

    Args:
        work: the workspace, which tells the side of the work.
        down: orientation of the grasp point with the hand pointing down, wxyz.
        shapes: the shapes that must stay above the table.
    """
    along, turned = opening(down), _half_turn(down)
    either: tuple[Way, ...] = (along, down), (-along, turned)
    if not hand.joints or not grasp.edge(hand.gap, hand.pad, hand.closed) or work is None:
        return Place(None, None, 0.0, True, either[:1])
    low = grasp.height(hand.gap, hand.pad, hand.closed) + hand.grip @ hand.approach - cloud.height
    shun = ~_above(cloud, shapes, cloud.poses)
    exact, any_way, few = "pointing down, fingers along y", "pointing down", len(cloud.arm) < TURNS
    tries: list[tuple[str, float, tuple[Way, ...]]] = [
        *((exact, 0.0, (way,)) for way in either if not few),
        (any_way, 0.0, ((None, down),)),
        *(("leaning", tilt, ((None, down),)) for tilt in LEANS),
    ]
    found = []
    for how, tilt, ways in tries:
        pick = _pick(Reaching(cloud, shapes, shun, tilt, ways[0][0]), work, low)
        if pick is not None:
            found.append((_width(pick), pick, how, tilt, ways))
            if not tilt or _width(pick) > WIDTH * cloud.reach:
                break
    if found:
        _, pick, how, tilt, ways = max(found, key=lambda item: item[0])
        hold = _hold(Reaching(cloud, shapes, shun, HELD), pick, reach=cloud.reach)
        notes.add("guessed", "robot", name, f"pick: {_text(pick)}, the hand {how}")
        notes.add("guessed", "robot", name, f"hold: {_text(hold)}")
        if how == exact and ways[0] is either[0] and Reaching(cloud, shapes, shun, tilt, -along).everywhere(pick):
            ways = either
        return Place(pick, hold, round(float(tilt), 4), how != any_way, ways)
    notes.add("warning", "robot", name, "no place found to grasp at on the table: lift needs pick and hold in robot.yaml")
    return Place(None, None, 0.0, True, either[:1])


def _width(box: Box) -> float:
    """Length of the shorter side of a region on the table [m]."""
    return min(upper - lower for lower, upper in box[:2])


def _half_turn(down: Quat) -> Quat:
    """Turns an orientation by half a turn about the vertical."""
    w, x, y, z = down
    return -z + 0.0, -y + 0.0, x, w


def opening(down: Quat) -> Vec:
    """Direction in the grasp point's frame that lies along y when the hand has the orientation ``down``."""
    return quats.matrix(down).T @ np.array([0.0, 1.0, 0.0])


def _text(box: Box) -> str:
    return ", ".join(f"{k} {a:g} .. {b:g}" for k, (a, b) in zip("xyz", box, strict=True))


def _pick(reaching: Reaching, work: Box, low: float) -> Box | None:
    cloud = reaching.cloud
    reach, origin = cloud.reach, cloud.shoulder
    cell = reach / CELLS
    middle = np.mean(work, axis=1)[:2] - origin[:2]
    axis = int(np.argmax(np.abs(middle)))
    sign = float(np.sign(middle[axis])) or 1.0
    ahead = np.arange(np.ceil(NEAR * CELLS), CELLS + 1) * cell
    aside = np.arange(-ASIDE * CELLS, ASIDE * CELLS + 1) * cell
    grid = np.zeros((len(ahead), len(aside), 3))
    grid[:, :, axis], grid[:, :, 1 - axis] = origin[axis] + sign * ahead[:, None], origin[1 - axis] + aside
    met = np.ones(grid.shape[:2], bool)
    for height in (low, low + OVER):
        grid[:, :, 2] = height
        met[met] = reaching(grid[met], DESCENTS)
    # Fills gaps that the few descents left; the whole region is checked again below.
    beside = np.pad(met.astype(int), 1)
    met |= beside[2:, 1:-1] + beside[:-2, 1:-1] + beside[1:-1, 2:] + beside[1:-1, :-2] >= 3
    found = _largest(met, ahead / reach, aside / reach)
    if found is None:
        return None
    (a, b), (c, d) = found
    ends = np.sort([sign * ahead[[a, b]] + origin[axis], aside[[c, d]] + origin[1 - axis]], axis=1)
    ends = ends if axis == 0 else ends[::-1]
    for spare, shrink in itertools.product((SPARE * reach, 0.0), SHRINKS):
        box = (*_about(ends, shrink), (_rounded(low), _rounded(low + OVER)))
        if reaching.everywhere(_grown(box, spare)):
            return *box[:2], _raised(reaching, _grown(box, spare), TALL * reach, cell)[2]
    return None


def _grown(box: Box, by: float) -> Box:
    """Grows the box by ``by`` on each side [m], because an arm stretched out at its edge would not keep to a path there."""
    x, y, z = box
    return (x[0] - by, x[1] + by), (y[0] - by, y[1] + by), z


def _hold(reaching: Reaching, pick: Box, reach: float) -> Box:
    """Finds the box above ``pick``, as high as the arm reaches; at the top of ``pick`` if nowhere."""
    low = pick[2][0] + max(0.05, 0.1 * reach)
    for shrink in SHRINKS:
        box = (*_about(np.array(pick[:2]), shrink), (_rounded(low), _rounded(low)))
        if reaching.everywhere(box):
            return _raised(reaching, box, TALL * reach, reach / CELLS)
    return (*pick[:2], (pick[2][1], pick[2][1]))


def _raised(reaching: Reaching, box: Box, most: float, step: float) -> Box:
    """Raises the box by up to ``most``, as long as every layer is reached everywhere."""
    x, y, (low, high) = box
    while high + step <= low + most and reaching.everywhere((x, y, (high + step, high + step))):
        high += step
    return x, y, (low, _rounded(high))


def _largest(
    met: Bool[np.ndarray, "a b"], ahead: Float[np.ndarray, " a"], aside: Float[np.ndarray, " b"]
) -> tuple[tuple[int, int], tuple[int, int]] | None:
    """Finds the best rectangle of reachable cells, at least two cells either way: first and last index on both axes."""
    total = np.pad(met.astype(int), ((1, 0), (1, 0))).cumsum(0).cumsum(1)

    def spans(places: Values, most: float) -> list[tuple[int, int]]:
        return [(i, k) for i, k in itertools.combinations(range(len(places)), 2) if places[k] - places[i] <= most + 1e-9]

    best, score = None, 0.0
    for (a, b), (c, d) in itertools.product(spans(ahead, LONG), spans(aside, WIDE)):
        if total[b + 1, d + 1] - total[a, d + 1] - total[b + 1, c] + total[a, c] == (b + 1 - a) * (d + 1 - c):
            away = ((ahead[a] + ahead[b]) / 2 - 0.5) ** 2 / 0.3**2 + ((aside[c] + aside[d]) / 2) ** 2 / 0.15**2
            value = (b - a) * (d - c) * np.exp(-0.5 * away)
            if value > score:
                best, score = ((a, b), (c, d)), value
    return best


def _about(ends: Float[np.ndarray, "2 2"], shrink: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Shrinks the rectangle about its centre."""
    x, y = ((_rounded(m - h), _rounded(m + h)) for m, h in zip(ends.mean(1), shrink * np.ptp(ends, axis=1) / 2, strict=True))
    return x, y


def _rounded(value: float) -> float:
    return round(float(value), 3) + 0.0
