"""Finds grasps: places where a hand with two pads can hold a thing that lies on a table, from straight above.

A grasp is a level line through the thing: the pads close along it from both sides. Lines in many directions, at many places and
heights are tried. One is good if the surface is nearly perpendicular to it at both ends, if there is room for the open fingers
beside the thing and above the table, and if the pads lie flat on it, near the centre of mass.
"""

import dataclasses
import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from mjx_nero.sim.solids import rests
from mjx_nero.sim.solids.solid import Solid

MOST = 8  # grasps per resting pose
TURNS = 12  # directions in half a turn
STEP = 0.005  # [m] distance between parallel lines
LEVELS = 4  # heights
CELL = 0.002  # [m] cell of the map of heights
ROOM = (0.012, 0.006)  # [m] room for the open hand on each side of the thing: the first that fits
CLEAR = 0.0015  # [m] between a finger and what it must not touch
STEEP = np.cos(np.radians(35.0))  # least cosine between a line and the surface's normal
FINEST = 40  # candidates to examine closely
APART = (0.01, np.radians(25.0))  # [m, rad] grasps that differ by less count as the same


@dataclasses.dataclass(frozen=True)
class Hand:
    """A hand with two pads.

    Attributes:
        opening: greatest distance between the pads [m].
        closed: least distance [m].
        pad: size of a pad along the approach, across, and along the opening [m].
        lowest: least height of the pads' middle above the table [m].
        depth: how far a thing may reach up between the fingers, above the pads' middle [m].
    """

    opening: float
    closed: float
    pad: tuple[float, float, float]
    lowest: float
    depth: float = 0.06


@dataclasses.dataclass(frozen=True)
class Grasps:
    """Grasps of a thing in one resting pose, the best first, in the thing's own frame.

    Attributes:
        middle: middle of the pads [m].
        across: the direction in which the fingers close.
        gap: distance between the pads when they come down [m].
        cost: lower is better.
    """

    middle: Float[np.ndarray, "n 3"]
    across: Float[np.ndarray, "n 3"]
    gap: Float[np.ndarray, " n"]
    cost: Float[np.ndarray, " n"]


@functools.lru_cache(maxsize=1024)
def _sides(points: bytes) -> Float[np.ndarray, "m 4"]:
    """The planes of a convex part: normals and offsets, n x + b <= 0 inside."""
    from scipy.spatial import ConvexHull

    return ConvexHull(np.frombuffer(points).reshape(-1, 3)).equations


def find(solid: Solid, quat: Float[np.ndarray, "4"], hand: Hand) -> Grasps:
    """Searches for grasps of a thing that rests in the orientation ``quat``; there may be none."""
    up = rests.up(quat)
    aside = np.linalg.svd(up[None])[2][1]
    turn = np.stack([aside, np.cross(up, aside), up])  # rows: the world's axes in the thing's frame
    lift = solid.height(quat)
    parts = []
    for part in solid.parts:
        sides = _sides(np.ascontiguousarray(part, float).tobytes())
        normals = sides[:, :3] @ turn.T
        parts.append(np.column_stack([normals, sides[:, 3] - normals[:, 2] * lift]))
    corners = solid.points @ turn.T + [0, 0, lift]
    field = _Heights(parts, corners, margin=hand.opening / 2 + 3 * hand.pad[2] + 2 * hand.pad[1])
    found = [each for angle in np.pi * np.arange(TURNS) / TURNS for each in _along(angle, parts, corners, hand)]
    likely = _unlike(sorted(found, key=lambda each: each[0]), FINEST, 0.5, lambda each: _opened(each, field, hand))
    best = _unlike(sorted((_fine(each, parts, hand) for each in likely), key=lambda each: each[0]), MOST, 1.0)
    middles = np.array([each[1] for each in best]).reshape(-1, 3) - [0, 0, lift]
    angles = np.array([each[2] for each in best])
    across = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))], axis=1).reshape(-1, 3)
    gaps, costs = np.array([each[3] for each in best]), np.array([each[0] for each in best])
    return Grasps(middles @ turn, across @ turn, gaps, costs)


class _Heights:
    """Height of a thing above the table at each place; 0 beside the thing."""

    def __init__(self, parts: list[np.ndarray], corners: np.ndarray, margin: float):
        self._low = corners[:, :2].min(0) - margin
        shape = np.ceil((corners[:, :2].max(0) + margin - self._low) / CELL).astype(int) + 1
        places = self._low + CELL * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 2)
        at = np.column_stack([places, np.zeros(len(places))])
        ends = [_cut(sides, at, np.array([0.0, 0.0, 1.0])) for sides in parts]
        top = np.max([np.where(last > first, last, 0.0) for first, last, *_ in ends], axis=0)
        self._top = top.reshape(shape)

    def highest(self, places: np.ndarray) -> np.ndarray:
        """Greatest height over sets of places, [n] of [n, k, 2]."""
        cells = np.clip(np.round((places - self._low) / CELL).astype(int), 0, np.array(self._top.shape) - 1)
        return self._top[cells[..., 0], cells[..., 1]].max(-1)


def _cut(sides: np.ndarray, starts: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Intersects lines with a convex part: where they enter and leave, and the cosine to the surface's normal there, all [n]."""
    slope, off = sides[:, :3] @ way, starts @ sides[:, :3].T + sides[:, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -off / slope
    first = np.where(slope < -1e-9, t, -np.inf)
    last = np.where(slope > 1e-9, t, np.inf)
    beside = (np.abs(slope) <= 1e-9) & (off > 0)
    enter, leave = first.argmax(1), last.argmin(1)
    begin, end = first.max(1), np.where(beside.any(1), -np.inf, last.min(1))
    return begin, end, -slope[enter], slope[leave]


def _along(angle: float, parts: list[np.ndarray], corners: np.ndarray, hand: Hand) -> list[tuple]:
    """Lines in one direction whose ends the pads could hold: cost, middle, angle, gap (unknown yet) and width."""
    way, side = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    reach, top = corners @ side, corners[:, 2].max()
    offsets = np.arange(reach.min() + STEP / 2, reach.max(), STEP)
    low = max(0.004, hand.lowest - hand.pad[0] / 2 + 0.002)  # the pads' middle is above the lines of low things
    levels = np.unique(np.round([*np.linspace(low, max(low, top - 0.003), LEVELS), max(low, top - 0.3 * hand.pad[0])], 4))
    starts = np.array([u * side + [0, 0, z] for u in offsets for z in levels])
    cuts = [_cut(sides, starts, way) for sides in parts]
    out = []
    for k, start in enumerate(starts):
        for begin, end, steep in _runs([[float(x[k]) for x in cut] for cut in cuts]):
            width, middle = end - begin, start + way * (begin + end) / 2
            if not hand.closed + 0.002 < width < hand.opening - 2 * ROOM[-1] or steep < STEEP:
                continue
            away = float(np.hypot(*middle[:2])) / 0.04
            out.append((away + 2 * (1 - steep) + 0.3 * width / hand.opening, middle, angle, 0.0, width))
    return out


def _runs(cuts: list[list[float]]) -> list[tuple[float, float, float]]:
    """Stretches of a line that begin and end at a surface: of one solid piece, or of several with gaps between them."""
    pieces: list[list[float]] = []
    for begin, end, first, last in sorted(cut for cut in cuts if cut[1] > cut[0] + 1e-6):
        if pieces and begin <= pieces[-1][1] + 1e-4:
            if end > pieces[-1][1]:
                pieces[-1][1], pieces[-1][3] = end, last
        else:
            pieces.append([begin, end, first, last])
    return [(a[0], b[1], min(a[2], b[3])) for i, a in enumerate(pieces) for b in pieces[i:]]


def _opened(each: tuple, field: _Heights, hand: Hand) -> tuple | None:
    """The same grasp, with a gap from which the fingers can come down and close; None: something is in their way."""
    cost, middle, angle, _, width = each
    for room in ROOM:
        gap = width + 2 * room
        if gap <= hand.opening and _fits(middle, np.array([np.cos(angle), np.sin(angle)]), width, gap, field, hand):
            return cost + (room != ROOM[0]), middle, angle, gap, width
    return None


def _fits(middle, way, width: float, gap: float, field: _Heights, hand: Hand) -> bool:
    side = np.array([-way[1], way[0]])
    along = np.linspace(width / 2 + CLEAR, gap / 2 + hand.pad[2] + CLEAR, 6)
    beside = np.linspace(-hand.pad[1] / 2, hand.pad[1] / 2, 5)[:, None, None] * side
    pads = max(middle[2], hand.lowest)
    outside = middle[:2] + beside + np.concatenate([along, -along])[:, None] * way
    if field.highest(outside.reshape(1, -1, 2))[0] > max(pads - hand.pad[0] / 2, 1e-6):
        return False
    inside = middle[:2] + beside + np.linspace(-gap / 2, gap / 2, 7)[:, None] * way
    return float(field.highest(inside.reshape(1, -1, 2))[0]) - pads < hand.depth


def _fine(each: tuple, parts: list[np.ndarray], hand: Hand) -> tuple:
    """The same grasp, with a cost for the share of the pads that does not lie on the thing."""
    cost, middle, angle, gap, width = each
    way, side = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    offsets = [(u, z) for u in (-0.3, 0.0, 0.3) for z in (-0.3, 0.0, 0.3)]
    level = max(middle[2], hand.lowest)
    starts = np.array([[*(middle + u * hand.pad[1] * side)[:2], level + z * hand.pad[0]] for u, z in offsets])
    cuts = [_cut(sides, starts, way) for sides in parts]
    begins = np.min(
        [np.where(end > begin, np.where(begin < -width / 2 - 0.03, np.inf, begin), np.inf) for begin, end, *_ in cuts], axis=0
    )
    ends = np.max(
        [np.where(end > begin, np.where(end > width / 2 + 0.03, -np.inf, end), -np.inf) for begin, end, *_ in cuts], axis=0
    )
    flat = np.mean(np.abs(begins + width / 2) < 0.002) + np.mean(np.abs(ends - width / 2) < 0.002)
    return cost + 1.0 * (2 - flat), middle, angle, gap, width


def _unlike(
    sorted_ones: list[tuple], most: int, share: float, test: Callable[[tuple], tuple | None] = lambda x: x
) -> list[tuple]:
    """The first entries of a list that pass the test and differ from all earlier ones."""
    out: list[tuple] = []
    for each in sorted_ones:
        if len(out) == most:
            break
        turns = (abs((each[2] - other[2] + np.pi / 2) % np.pi - np.pi / 2) < share * APART[1] for other in out)
        near = (np.linalg.norm(each[1] - other[1]) < share * APART[0] for other in out)
        if not any(a and b for a, b in zip(turns, near, strict=True)) and (passed := test(each)) is not None:
            out.append(passed)
    return out
