"""Which links collide, with what, and by which shape."""

import numpy as np

from mjx_nero.urdf import fit, mjcf, reach
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.looks import Look, Looks
from mjx_nero.urdf.notes import Notes
from mjx_nero.urdf.tree import Body, Points, Pose, Tree

SMALL = 0.05  # of the largest collision shape of a body: others below this volume are left out
NEAR = 0.02  # [m] links that stay this far above the table never meet it
_CUBE = {"sphere": 1, "capsule": 2, "box": 8}  # contacts of a shape with a cube; with the table: fit.CONTACTS
Collisions = dict[str, list[tuple[str, fit.Primitive, int]]]  # link -> (name, shape in its frame, contact bits)


def collisions(tree: Tree, parts: dict[str, Body], looks: Looks, hand: Hand, cloud: reach.Cloud, notes: Notes) -> Collisions:
    """Link -> its collision shapes. The gripper's pads meet table and cube, links that get near the table meet that.

    The base has none, and the inner links of a gripper have none: the pads get to things first.
    """
    out: Collisions = {name: [] for name in tree.links}
    for body in parts.values():
        done: list[tuple[fit.Primitive, Pose]] = []
        fitted = {
            link: _shapes(look.surfaces, look.exact)
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
            hidden = points is not None and any(_within(points, at, shape, other) for shape, other in done)
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
    return out


def _shapes(surfaces: list[tuple[Points, float]], exact: list[fit.Primitive | None]) -> list[fit.Primitive]:
    """One shape for all collisions of a link, or one each if that is much tighter and they are few."""
    each = [e or fit.best(points, volume) for e, (points, volume) in zip(exact, surfaces, strict=True)]
    if len(each) == 1:
        return each
    points = np.concatenate([p for p, _ in surfaces])
    whole = fit.best(points, fit.hull(points))
    return each if len(each) <= 3 and sum(s.volume for s in each) < 0.6 * whole.volume else [whole]


def _within(points: Points, at: Pose, shape: fit.Primitive, other: Pose) -> bool:
    """Whether 95% of a link's points, the link at ``at`` in its body, lie inside another link's shape."""
    pose = np.linalg.inv(other) @ at
    return bool(shape.contains(points @ pose[:3, :3].T + pose[:3, 3]).mean() > 0.95)


def contacts(found: Collisions) -> dict[str, int]:
    """Most contacts of the robot with the table, and of table, robot and one cube together."""
    shapes = [(s.kind, bits) for items in found.values() for _, s, bits in items]
    table = sum(fit.CONTACTS[kind] for kind, bits in shapes if bits & mjcf.TABLE)
    cube = sum(_CUBE[kind] for kind, bits in shapes if bits & mjcf.CUBE)
    return {"table": table, "table_and_cube": table + cube + 4}


def covered(look: Look, shapes: list[fit.Primitive]) -> float | None:
    """Share of the link's surface inside any of its collision shapes; None without either."""
    if look.points is None or look.guessed or not shapes:
        return None
    return round(float(np.any([s.contains(look.points) for s in shapes], axis=0).mean()), 4)
