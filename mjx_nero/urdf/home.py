"""The home pose: over the middle of the workspace, hand down, away from limits and singularities, with ``pick`` in reach."""

import dataclasses
import itertools
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from mjx_nero.urdf.cloud import Cloud
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.primitives import Primitive
from mjx_nero.urdf.regions import Place, Quat
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.swing import surface
from mjx_nero.urdf.tree import Body, Points, Poses, Values, Vec, body_of, carriers
from mjx_nero.urdf.workspace import Box

STARTS = 48  # number of descents to the middle of the workspace
CALM = 0.5  # [m/rad] the descents' ``calm``
CLEAR = 0.01  # [m] least height above the table
MARGIN = 0.15  # share of a joint's range beyond which distance from its limits no longer counts
AGILE = 0.15  # least singular value of the Jacobian (in arm lengths) beyond which more no longer counts
HIGH = 0.15  # share of the reach beyond which height above the table no longer counts
POINTS = 60  # points of a link's surface that are tested for lying inside another link
RANDOM = 200  # random poses: links that touch in all of them always do
TRAVEL = 0.1  # [m] height above the bottom of ``pick`` at which the hand travels
ACROSS, DOWNWARD, STEPS = 12, 5, 4  # points of the path across and down, and steps of inverse kinematics at each
NEAR = 0.005  # [m] tolerance of arriving
OVER = 0.2  # [m] greatest height of the hand above the bottom of ``pick``, over its middle
NEARER = 0.1  # share of ``pick`` that a home may give up to spare the hand half a turn


@dataclasses.dataclass(frozen=True)
class Search:
    """A robot whose home pose is searched for.

    Attributes:
        start: joint -> fallback position [rad, m].
        given: joint -> position from the user.
        shapes: link, shape in its frame, and whether it collides with the table.
    """

    parts: dict[str, Body]
    looks: Mapping[str, Look]
    hand: Hand
    cloud: Cloud
    start: dict[str, float]
    given: Mapping[str, float]
    shapes: list[tuple[str, Primitive, bool]]

    @property
    def low(self) -> list[tuple[str, Primitive]]:
        """The shapes that collide with the table."""
        return [(link, shape) for link, shape, meets in self.shapes if meets]

    @property
    def free(self) -> tuple[str, ...]:
        """The joints that the search may move."""
        return tuple(j for j in self.start if j not in self.given and j not in self.hand.joints)

    def pose(self, q: Float[np.ndarray, " k"]) -> dict[str, float]:
        """Returns joint -> position [rad, m] of a candidate; joints that are not free stay at ``start``."""
        arm = zip(self.cloud.arm, q, strict=True)
        return {**self.start, **{j: float(v) + 0.0 for j, v in arm if j in self.free}}

    def amid(self, box: Box | None, down: bool, tilt: float = 0.0) -> Float[np.ndarray, "n k"]:
        """Finds poses with the grasp point in the middle of a box and the links clear of the table and of one another.

        If ``down``, the hand points down or leans by up to ``tilt``. Poses farthest from joint limits and singularities come
        first.
        """
        cloud = self.cloud
        if box is None or not self.free:
            return np.zeros((0, len(cloud.arm)))
        found = cloud.solve(np.mean(box, axis=1)[None], down, STARTS, self.given, CALM, tilt=tilt)[0]
        found = np.round(_unwound(found[~np.isnan(found[:, 0])], cloud), 3)
        if not len(found):
            return found
        poses = cloud.at(found)
        above = np.min([cloud.lowest(link, s, poses) for link, s in self.low] or [np.ones(len(found))], axis=0)
        clear = above > CLEAR
        apart = clear & ~_touching(self.parts, self.looks, cloud, poses, self.shapes)
        fits = apart if apart.any() else clear
        order = np.argsort(-_comfort(cloud, found, poses, above), kind="stable")
        return found[order[fits[order]]]


def home(search: Search, amid: Float[np.ndarray, "n k"], place: Place, name: str, notes: Notes) -> tuple[dict[str, float], Quat]:
    """Returns joint -> home position [rad, m], and the turn of the hand there (wxyz).

    The home is the candidate from which the hand reaches the most of ``place.pick``. Of two turns that do equally well, the
    nearer one wins, because half a turn of the hand costs time.

    If no candidate in the middle of the workspace leads to all of ``pick``, others over its middle are tried. Without any
    candidate the home is ``start``; or, if a shape is below the table there, the nearest random pose in which none is.
    """
    poses, best, way = amid, 0, 0
    if place.pick is not None:
        values = _values(search, poses, place)
        if values.max(initial=0.0) < 1:
            x, y, (bottom, top) = place.pick
            over = min(top, bottom + OVER)
            poses = np.concatenate([poses, search.amid((x, y, (over, over)), True, place.lean)])
            values = _values(search, poses, place)
        if len(poses):
            best, way = (int(i) for i in np.unravel_index(np.argmax(values), values.shape))
    if not len(poses):
        return _clear(search, name, notes), place.ways[0][1]
    where = "over the middle of the workspace" if best < len(amid) else "over the middle of pick"
    notes.add("guessed", "robot", name, f"home: {where} (--home changes it)")
    return search.pose(poses[best]), place.ways[way][1]


def _values(search: Search, q: Float[np.ndarray, "n k"], place: Place) -> Float[np.ndarray, "n w"]:
    """Rates each pose as a start, for each way to turn the hand. 1 and more leads to all of ``pick``."""
    out = np.zeros((len(q), len(place.ways)))
    if len(q) and place.pick is not None:
        across = search.cloud.sites(search.cloud.at(q))[:, 1, :3]
        for way, (along, _) in enumerate(place.ways):
            near = 0.0 if along is None else across @ along > 0
            out[:, way] = _reached(q, search.cloud, search.low, place.pick, along, place.lean) + NEARER * near
    return out


def _reached(
    q: Float[np.ndarray, "n k"], cloud: Cloud, low: list[tuple[str, Primitive]], pick: Box, along: Vec | None, tilt: float
) -> Values:
    """Share of the corners and the middle of ``pick`` that each pose leads to.

    The path is one that a controller without a planner takes: around the base at travel height, then straight down. No shape may
    go below the table.
    """
    x, y, (bottom, top) = pick
    places = np.array([*itertools.product(x, y), (np.mean(x), np.mean(y))])
    at = np.repeat(q, len(places), axis=0)
    ends = np.tile(places, (len(q), 1))
    first = cloud.sites(cloud.at(at))[:, :3, 3]
    over, fine = min(top, bottom + TRAVEL), np.ones(len(at), bool)
    radius, angle = np.hypot(first[:, 0], first[:, 1]), np.arctan2(first[:, 1], first[:, 0])
    far, turn = np.hypot(*ends.T) - radius, (np.arctan2(ends[:, 1], ends[:, 0]) - angle + np.pi) % (2 * np.pi) - np.pi
    shares = [(s, 0.0) for s in np.linspace(0, 1, ACROSS + 1)[1:]] + [(1.0, s) for s in np.linspace(0, 1, DOWNWARD + 1)[1:]]
    goal = first
    for across, down in shares:
        r, a = radius + across * far, angle + across * turn
        height = first[:, 2] + across * (over - first[:, 2]) + down * (bottom - over)
        goal = np.column_stack([r * np.cos(a), r * np.sin(a), height])
        at = cloud.followed(at, goal, STEPS, tilt, along)
        poses = cloud.at(at)
        fine &= np.min([cloud.lowest(link, shape, poses) for link, shape in low] or [np.ones(len(at))], axis=0) > 0
    fine &= np.linalg.norm(cloud.sites(cloud.at(at))[:, :3, 3] - goal, axis=1) < NEAR
    return fine.reshape(len(q), -1).mean(1)


def _clear(search: Search, name: str, notes: Notes) -> dict[str, float]:
    hand, cloud, start, given, shapes = search.hand, search.cloud, search.start, search.given, search.low
    guessed = [j for j in start if j not in given and j not in hand.joints]
    clear = np.min([cloud.lowest(link, s) for link, s in shapes], axis=0) > CLEAR if shapes else np.ones(len(cloud.site), bool)
    if clear[0] or not guessed:
        if guessed:
            notes.add("guessed", "robot", name, "home: 0 where limits allow, else the middle (--home changes it)")
        if not clear[0]:
            notes.add("warning", "robot", name, "at home it reaches below the table: change --home or base_pos")
        return start
    fits = clear & np.all([np.abs(cloud.q[j] - v) < 1e-9 for j, v in given.items() if j not in hand.joints] or [clear], axis=0)
    if not fits.any():
        notes.add("warning", "robot", name, "at home it reaches below the table: change --home or base_pos")
        return start
    away = np.sum([(cloud.q[j] - start[j]) ** 2 for j in guessed], axis=0)
    best = int(np.argmin(np.where(fits, away, np.inf)))
    notes.add("guessed", "robot", name, "home: near 0, moved until nothing is below the table (--home changes it)")
    return {**start, **{j: float(round(cloud.q[j][best], 3)) for j in guessed}}


def _unwound(q: Float[np.ndarray, "n k"], cloud: Cloud) -> Float[np.ndarray, "n k"]:
    """Moves joints with room for a whole turn as near to 0 as possible."""
    turned = q - 2 * np.pi * np.round(q / (2 * np.pi))
    room = cloud.upper - cloud.lower >= 2 * np.pi - 1e-6
    return np.where(room & (turned >= cloud.lower) & (turned <= cloud.upper), turned, q)


def _comfort(cloud: Cloud, q: Float[np.ndarray, "n k"], poses: Mapping[str, Poses], above: Values) -> Values:
    """Rates poses as starts: far from limits, singularities and the table, joints turned little, links high."""
    spare = np.minimum(q - cloud.lower, cloud.upper - q) / (cloud.upper - cloud.lower)
    spare = np.where(cloud.endless, 1.0, spare).min(1)
    jacobian, reach = cloud.jacobian(poses), cloud.reach
    jacobian[:, :3] /= reach
    agile = np.linalg.svd(jacobian, compute_uv=False)[:, min(jacobian.shape[1:]) - 1]
    turned = np.abs(q - np.array([cloud.q[j][0] for j in cloud.arm])).mean(1) / np.pi
    height = np.mean([p[:, 2, 3] for p in poses.values()], axis=0) / reach
    far = [np.minimum(spare / MARGIN, 1), np.minimum(agile / AGILE, 1), np.minimum(above / (HIGH * reach), 1)]
    return np.sum(far, axis=0) - 1.5 * turned + 1.5 * height


def _touching(
    parts: dict[str, Body],
    looks: Mapping[str, Look],
    cloud: Cloud,
    poses: Mapping[str, Poses],
    shapes: list[tuple[str, Primitive, bool]],
) -> Bool[np.ndarray, " n"]:
    """True where links that are not neighbours lie inside one another, judged by points of one in a shape of the other.

    Pairs that do so in every random pose, such as the links of a gripper's linkage, are ignored.
    """
    n = len(next(iter(poses.values())))
    poses = {name: np.concatenate([p, cloud.poses[name][1 : RANDOM + 1]]) for name, p in poses.items()}
    out = np.zeros(n, bool)
    surfaces: dict[str, Points] = {}
    for body in parts.values():
        if (points := surface(body.links, looks)) is not None:
            surfaces[body.name] = points[:: 1 + len(points) // POINTS]
    for link, shape, _ in shapes:
        body = body_of(parts, link)
        inverse = np.linalg.inv(poses[body.name] @ body.links[link])
        for other, points in surfaces.items():
            if _apart(parts, other, body.name) <= 2:  # joint limits keep these apart
                continue
            local = inverse @ poses[other]
            places = points @ np.moveaxis(local[:, :3, :3], 1, 2) + local[:, None, :3, 3]
            within = shape.contains(places.reshape(-1, 3)).reshape(len(local), -1).mean(1) > 0.05
            if not within[n:].all():
                out |= within[:n]
    return out


def _apart(parts: dict[str, Body], a: str, b: str) -> int:
    """Number of joints between two bodies."""
    return len(set(carriers(parts, a)) ^ set(carriers(parts, b)))
