"""How the robot stands, and its home pose: over the middle of the workspace, hand down, away from limits and singularities."""

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from mjx_nero.urdf.cloud import Cloud
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.geometry import Look
from mjx_nero.urdf.primitives import Primitive
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Points, Pose, Poses, Values, body_of
from mjx_nero.urdf.workspace import Box

SINKS = 0.1  # [m] a base that goes further below its frame is a pedestal, which stands on the floor beside the table
UPRIGHT = 0.99  # least cosine of a base's tilt that stands and does not hang
TALL = 0.6  # [m] a shoulder higher than this above the floor, and than ...
SHARE = 0.4  # ... this share of the arm's length, is a robot's that stands on the floor
BELOW = 0.3  # of the arm's length: the table then lies so far below the shoulder
STARTS = 48  # descents to the middle of the workspace
CALM = 0.5  # [m/rad] of its starts
CLEAR = 0.01  # [m] above the table
MARGIN = 0.15  # of a joint's range: further from its limits is no better
AGILE = 0.15  # smallest singular value of the Jacobian (lengths in arm's lengths) that is as good as any
HIGH = 0.15  # of the reach: further above the table is no better
POINTS = 60  # of a link's surface, that are tested for lying within another link


@dataclasses.dataclass(frozen=True)
class Stand:
    """Where the base is mounted [4, 4], the table being at height 0, and the height of the floor that it stands on [m]."""

    mount: Pose
    floor: float


def stand(parts: dict[str, Body], looks: Mapping[str, Look], hand: Hand, mount: Pose, name: str, notes: Notes) -> Stand:
    """On the table; a pedestal beside it on the floor, its frame at the table's height; and so what is as tall as a person."""
    base = next(iter(parts.values()))
    points = [(look.points @ at[:3, :3].T + at[:3, 3]) for link, at in base.links.items() if (look := _seen(looks[link]))]
    low = min(float((p @ mount[2, :3]).min()) for p in points) if points else 0.0
    chain: list[Body] = []
    at = body_of(parts, hand.link)
    while at.joint is not None:
        chain.insert(0, at)
        at = parts[at.parent]
    while len(chain) > 1 and chain[0].joint and chain[0].joint.type == "prismatic":
        chain = chain[1:]
    shoulder = float((mount[:3, :3] @ _pose(parts, chain[0].name)[:3, 3])[2]) if chain else 0.0
    length = sum(float(np.linalg.norm(b.frame[:3, 3])) for b in chain[1:])
    if low < -SINKS:
        notes.add(
            "guessed", "robot", name, f"its base goes {-low:.2f} m below its frame: a pedestal, on the floor beside the table"
        )
        return Stand(mount, round(float(mount[2, 3]) + low, 3))
    if shoulder - low > TALL and shoulder - low > SHARE * length:
        mount = mount.copy()
        mount[2, 3] = -round(shoulder - BELOW * length, 2)
        notes.add("guessed", "robot", name, f"it stands on the floor: the table is {-mount[2, 3]:g} m higher (base_pos)")
        return Stand(mount, round(float(mount[2, 3]) + low, 3))
    if points and mount[2, 2] > UPRIGHT and mount[2, 3] + low > SINKS:
        notes.add("guessed", "robot", name, f"mounted {mount[2, 3]:.2f} m up on nothing: put on the table (base_pos)")
        mount = mount.copy()
        mount[2, 3] = -low
    return Stand(mount, 0.0)


def home(
    parts: dict[str, Body],
    looks: Mapping[str, Look],
    hand: Hand,
    cloud: Cloud,
    start: dict[str, float],
    given: Mapping[str, float],
    shapes: list[tuple[str, Primitive, bool]],
    work: tuple[Box | None, bool],
    name: str,
    notes: Notes,
) -> dict[str, float]:
    """Joint -> home position [rad, m].

    Of the poses that inverse kinematics finds with the grasp point amid the workspace, hand down if it can, the one is taken that
    is farthest from joint limits and singularities, its links well above the table and clear of one another. Without one it is
    ``start``; if a shape is below the table there, the nearest of the random poses in which none is.

    Args:
        given: joints whose position is the user's.
        shapes: link, shape in its frame, whether it meets the table.
    """
    guessed = [j for j in start if j not in given and j not in hand.joints]
    low = [(link, shape) for link, shape, meets in shapes if meets]
    box, down = work
    if box is not None and guessed:
        middle = np.mean(box, axis=1)[None]
        found = cloud.solve(middle, down, STARTS, given, CALM)[0]
        found = np.round(_unwound(found[~np.isnan(found[:, 0])], cloud), 3)
        if len(found):
            poses = cloud.at(found)
            above = np.min([cloud.lowest(link, s, poses) for link, s in low] or [np.ones(len(found))], axis=0)
            clear = above > CLEAR
            free = clear & ~_touching(parts, looks, poses, shapes)
            if clear.any():
                best = int(np.argmax(np.where(free if free.any() else clear, _comfort(cloud, found, poses, above), -np.inf)))
                text = "pointing down" if down else "any way round"
                notes.add("guessed", "robot", name, f"home: amid the workspace, {text} (--home changes it)")
                return {**start, **{j: float(v) + 0.0 for j, v in zip(cloud.arm, found[best], strict=True) if j in guessed}}
    return _clear(hand, cloud, start, given, low, name, notes)


def _clear(
    hand: Hand,
    cloud: Cloud,
    start: dict[str, float],
    given: Mapping[str, float],
    shapes: list[tuple[str, Primitive]],
    name: str,
    notes: Notes,
) -> dict[str, float]:
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
    """Joints that have room for a whole turn as near to 0 as they get."""
    turned = q - 2 * np.pi * np.round(q / (2 * np.pi))
    room = cloud.upper - cloud.lower >= 2 * np.pi - 1e-6
    return np.where(room & (turned >= cloud.lower) & (turned <= cloud.upper), turned, q)


def _comfort(cloud: Cloud, q: Float[np.ndarray, "n k"], poses: Mapping[str, Poses], above: Values) -> Values:
    """How good a pose is to start from: limits, singularities and table far, joints turned little, links high."""
    spare = np.minimum(q - cloud.lower, cloud.upper - q) / (cloud.upper - cloud.lower)
    spare = np.where(cloud.endless, 1.0, spare).min(1)
    reach = float(np.quantile(np.linalg.norm(cloud.site[1:, :3, 3] - cloud.shoulder, axis=1), 0.99))
    jacobian = cloud.jacobian(poses)
    jacobian[:, :3] /= reach
    agile = np.linalg.svd(jacobian, compute_uv=False)[:, min(jacobian.shape[1:]) - 1]
    turned = np.abs(q - np.array([cloud.q[j][0] for j in cloud.arm])).mean(1) / np.pi
    height = np.mean([p[:, 2, 3] for p in poses.values()], axis=0) / reach
    far = [np.minimum(spare / MARGIN, 1), np.minimum(agile / AGILE, 1), np.minimum(above / (HIGH * reach), 1)]
    return np.sum(far, axis=0) - 1.5 * turned + 1.5 * height


def _touching(
    parts: dict[str, Body], looks: Mapping[str, Look], poses: Mapping[str, Poses], shapes: list[tuple[str, Primitive, bool]]
) -> Bool[np.ndarray, " n"]:
    """Whether links that are no neighbours lie within one another, by points of one in a shape of the other."""
    n = len(next(iter(poses.values())))
    out = np.zeros(n, bool)
    surfaces: dict[str, Points] = {}
    for body in parts.values():
        found = [look.points @ at[:3, :3].T + at[:3, 3] for link, at in body.links.items() if (look := _seen(looks[link]))]
        if found:
            points = np.concatenate(found)
            surfaces[body.name] = points[:: 1 + len(points) // POINTS]
    for link, shape, _ in shapes:
        body = body_of(parts, link)
        inverse = np.linalg.inv(poses[body.name] @ body.links[link])
        for other, points in surfaces.items():
            if _apart(parts, other, body.name) <= 2:  # what their joints' limits take care of
                continue
            local = inverse @ poses[other]
            places = points @ np.moveaxis(local[:, :3, :3], 1, 2) + local[:, None, :3, 3]
            out |= shape.contains(places.reshape(-1, 3)).reshape(n, -1).mean(1) > 0.05
    return out


def _apart(parts: dict[str, Body], a: str, b: str) -> int:
    """How many joints lie between two bodies."""
    return len(set(_line(parts, a)) ^ set(_line(parts, b)))


def _line(parts: dict[str, Body], name: str) -> list[str]:
    return [name, *_line(parts, parts[name].parent)] if name else []


def _pose(parts: dict[str, Body], name: str) -> Pose:
    """Pose of a body in the base at joint positions 0."""
    return _pose(parts, parts[name].parent) @ parts[name].frame if parts[name].parent else parts[name].frame


def _seen(look: Look) -> Look | None:
    return look if look.points is not None and not look.guessed else None
