"""Collision shapes: which links collide, with what, and as which shape."""

import numpy as np
from jaxtyping import Float

from mjx_nero.urdf import mjcf, primitives
from mjx_nero.urdf.cloud import Cloud
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.geometry import Look, Looks
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Points, Pose, Tree

SMALL = 0.05  # shapes with less than this share of the volume of their body's largest shape are left out
FEW = 3  # most collisions of a link that may each have a shape of their own
NEAR = 0.02  # [m] links that stay this far above the table never touch it
FEW_POINTS = 20  # least number of points to fit a shape to
_CUBE = {"sphere": 1, "capsule": 2, "box": 8}  # contacts of a shape with a cube; with the table: primitives.CONTACTS
Vec4 = Float[np.ndarray, "4"]
Collisions = dict[str, list[tuple[str, primitives.Primitive, int]]]  # link -> (name, shape in its frame, contact bits)


def collisions(tree: Tree, parts: dict[str, Body], looks: Looks, hand: Hand, cloud: Cloud, notes: Notes) -> Collisions:
    """Returns each link's collision shapes. Pads collide with table and cube; links that get near the table collide with it.

    The base and the inner links of a gripper have none, because the pads touch things first. For the same reason, shapes around
    the palm end where the pads begin: descriptions often put hulls there that reach beyond the fingers, for planning.
    """
    out: Collisions = {name: [] for name in tree.links}
    for body in parts.values():
        done: list[tuple[primitives.Primitive, Pose]] = []
        balls: list[Vec4] = []  # bounding balls in the body: centre and radius
        fitted = {
            link: shapes_of(look.surfaces, look.exact)
            for link, look in ((link, looks.of[link]) for link in body.links)
            if look.surfaces and link not in hand.pads and body.joint is not None and body.name not in hand.inside
        }
        largest = max((shape.volume for shapes in fitted.values() for shape in shapes), default=0.0)
        for link, at in body.links.items():
            if link in hand.pads:
                out[link].append((f"{link}_pad", hand.pads[link], mjcf.TABLE | mjcf.CUBE))
                if link in hand.backs:
                    out[link].append((f"{link}_back", hand.backs[link], mjcf.TABLE))
                continue
            if link not in fitted:
                continue
            shapes, points = fitted[link], looks.of[link].points
            if points is not None and hand.link in body.links and hand.joints:
                shapes = _palm(shapes, points, np.linalg.inv(at) @ body.links[hand.link] @ hand.site, hand, link, notes)
            hidden = points is not None and _hidden(points, at, done, balls)
            if hidden or sum(shape.volume for shape in shapes) < SMALL * largest:
                notes.add("note", "link", link, "small beside, or within, the collision shape of what it is fixed to: has none")
                continue
            for i, shape in enumerate(shapes):
                low = cloud.lowest(link, shape)
                bits = mjcf.TABLE if low.min() < NEAR < low.max() else 0
                if low.min() >= NEAR:
                    notes.add("note", "link", link, f"stays {low.min():.2f} m or more above the table: does not collide")
                elif not bits:
                    notes.add("note", "link", link, "never leaves the table, as a base: does not collide")
                out[link].append((link if len(shapes) == 1 else f"{link}_{i + 1}", shape, bits))
                done.append((shape, at))
                balls.append(np.append((at @ shape.pose)[:3, 3], shape.radius))
    return out


def shapes_of(surfaces: list[tuple[Points, float]], exact: list[primitives.Primitive | None]) -> list[primitives.Primitive]:
    """Fits one shape to all collisions of a link, or one to each if they are few and that is much tighter."""
    few = len(surfaces) <= FEW
    each = [e or primitives.best(points, volume) for e, (points, volume) in zip(exact, surfaces, strict=True) if few]
    if len(each) == 1:
        return each
    points = np.concatenate([p for p, _ in surfaces])
    whole = primitives.best(points, primitives.hull(points))
    return each if few and sum(s.volume for s in each) < 0.6 * whole.volume else [whole]


def _palm(
    shapes: list[primitives.Primitive], points: Points, site: Pose, hand: Hand, link: str, notes: Notes
) -> list[primitives.Primitive]:
    """Fits the shapes of a link beside the gripper.

    If one reaches beyond the pads, a box around the part behind the pads replaces all of them.

    Args:
        points: points of its surface [n, 3]; ``site``: the grasp point's pose [4, 4]. Both are in the link's frame.
    """
    approach = site[:3, :3] @ hand.approach
    middle = approach @ (site[:3, 3] + site[:3, :3] @ hand.grip)
    row = np.append(-approach, 0.0)[None]
    if max(-float(shape.lowest(row)[0]) for shape in shapes) <= middle + hand.pad[0] / 2:
        return shapes
    behind = points[points @ approach < middle - hand.pad[0] / 2]
    across = site[:3, :3] @ hand.opening
    notes.add("repaired", "link", link, "its collision shape reached beyond the fingers: ends where their pads begin")
    if len(behind) < FEW_POINTS:
        return []
    box = primitives.box(behind, np.column_stack([approach, across, np.cross(approach, across)]))
    return [primitives.measured(box, points, primitives.hull(points))]


def _hidden(points: Points, at: Pose, done: list[tuple[primitives.Primitive, Pose]], balls: list[Vec4]) -> bool:
    """True if 95% of a link's points, with the link at ``at`` in its body, lie inside a shape of another link."""
    if not done:
        return False
    points = points @ at[:3, :3].T + at[:3, 3]
    # The median lies near a shape that contains most of the points, so a ball test rules most shapes out.
    around = np.array(balls)
    away = np.abs(around[:, :3] - np.median(points, axis=0)).max(1)
    for i in np.flatnonzero(away <= around[:, 3]):
        shape, other = done[i]
        if shape.contains((points - other[:3, 3]) @ other[:3, :3]).mean() > 0.95:
            return True
    return False


def contacts(found: Collisions) -> dict[str, int]:
    """Counts the robot's greatest possible contacts with the table, and those of table, robot and one cube together."""
    shapes = [(s.kind, bits) for items in found.values() for _, s, bits in items]
    table = sum(primitives.CONTACTS[kind] for kind, bits in shapes if bits & mjcf.TABLE)
    cube = sum(_CUBE[kind] for kind, bits in shapes if bits & mjcf.CUBE)
    return {"table": table, "table_and_cube": table + cube + 4}


def covered(look: Look, shapes: list[primitives.Primitive]) -> float | None:
    """Share of the link's surface inside any of its collision shapes; None if it lacks a surface or shapes."""
    if look.points is None or look.guessed or not shapes:
        return None
    return round(float(np.any([s.contains(look.points) for s in shapes], axis=0).mean()), 4)
