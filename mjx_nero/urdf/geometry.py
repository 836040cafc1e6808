"""Shapes of the links: visual geoms, and the surfaces that collision shapes are fitted to."""

import dataclasses
import functools
import time
from collections.abc import Mapping

import numpy as np
import trimesh

from mjx_nero.types import UserError
from mjx_nero.urdf import drawing, files, meshes, primitives
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Link, Matrix, Points, Shape, Tree, Vec

APART = 2e-3  # [m, and of the axes] least difference of pose between a collision and a visual of the same mesh
MAX_SHAPES = 4_000  # visuals and collisions of a robot
MAX_WORK = 8_000_000  # triangles of all its shapes; a mesh counts once per scale
MAX_SECONDS = 60.0  # [s] of processor time
MAX_POINTS = 60_000  # on the surface of a link, all its shapes together
_Loaded = tuple[Shape, str, list[meshes.Part]]  # a shape, the stem of its mesh file, and its pieces
STAND_IN = (0.9, 0.6, 0.2, 1.0)


@dataclasses.dataclass
class Look:
    """Shapes of one link: visual geoms, and points [n, 3] and volume [m3] of each collision surface, in the link's frame.

    ``exact`` holds the collisions that are primitives already. ``guessed`` marks a stand-in for missing meshes.
    """

    drawn: list[drawing.Visual]
    surfaces: list[tuple[Points, float]]
    exact: list[primitives.Primitive | None]
    guessed: bool = False

    @functools.cached_property
    def points(self) -> Points | None:
        return np.concatenate([points for points, _ in self.surfaces]) if self.surfaces else None


class Work:
    """Counts processed triangles, and the time since it was made.

    Attributes:
        triangles: triangles so far.
    """

    def __init__(self) -> None:
        self.triangles, self._started = 0, time.process_time()

    def spend(self, parts: list[meshes.Part]) -> None:
        """Counts work that grows with triangles.

        Raises:
            UserError: the limit is exceeded.
        """
        self.triangles += sum(len(mesh.faces) for mesh, _ in parts)
        seconds = time.process_time() - self._started
        if self.triangles > MAX_WORK or seconds > MAX_SECONDS:
            spent = f"{self.triangles:,} triangles in {seconds:.0f} s"
            raise UserError(
                f"its meshes, counted once per scale, took {spent}: the limit is {MAX_WORK:,} in {MAX_SECONDS:g} s; "
                "use simpler ones"
            )


class Looks:
    """Loads the meshes of all links: their visual geoms, and the surfaces for collision shapes.

    Attributes:
        of: link -> its ``Look``.
        spans: file and scale of each mesh -> its largest extent [m].

    Raises:
        UserError: a mesh lies outside the folders or is too large, or the robot has more shapes than the limits above allow.
    """

    def __init__(self, tree: Tree, parts: dict[str, Body], loader: meshes.Meshes, notes: Notes):
        self._meshes, self._notes, self._work = loader, notes, Work()
        self._sampled: dict[tuple, tuple[Points, float]] = {}
        shapes = sum(len(link.visuals) + len(link.collisions) for link in tree.links.values())
        if shapes > MAX_SHAPES:
            raise UserError(f"the URDF has {shapes:,} visuals and collisions: more than {MAX_SHAPES:,} are not read")
        drawn = {(s.file, s.size) for n in tree.links.values() for s in n.visuals or n.collisions if s.kind == "mesh"}
        self._files = drawing.MeshFiles(len(drawn), self._work.spend, notes)
        self.spans: dict[tuple[str, tuple[float, ...]], float] = {}
        self._shared: dict[type[files.Shared], dict[str, str]] = {}  # name of a mesh -> why it is not read
        seen = [b.links for b in parts.values() if any(tree.links[n].visuals for n in b.links)]
        self._beside = {n for links in seen for n in links}  # links of bodies with visuals: a link without its own is hidden
        self.of = {name: self._look(link) for name, link in tree.links.items()}
        for lost in self._shared.values():
            notes.add("warning", "robot", tree.name, _told(lost))
        for body in parts.values():
            for name in body.links:
                link, look = tree.links[name], self.of[name]
                if not look.drawn and not look.surfaces and (link.visuals or link.collisions):
                    self.of[name] = stand_in(name, tree, notes)

    @property
    def stl(self) -> dict[str, bytes]:
        """Name -> content of the model's mesh files."""
        return self._files.stl

    def _look(self, link: Link) -> Look:
        """Loads a link's shapes.

        Without a visual, the collision mesh is drawn, unless the link is fixed to one with a visual. Without a collision, the
        visual is fitted.
        """
        loaded: dict[str, list[_Loaded]] = {"visual": [], "collision": []}
        failed: dict[str, list[str]] = {"visual": [], "collision": []}
        kind = "note"  # files that share a warning
        for tag, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for shape in shapes:
                try:
                    loaded[tag].append((shape, *self._load(shape)))
                except files.Missing as error:
                    failed[tag].append(f"{shape.file!r}: {error}")
                    if isinstance(error, files.Shared):
                        self._shared.setdefault(type(error), {})[shape.file] = str(error)
                    else:
                        kind = "warning"
        if any(failed.values()) and not any(loaded.values()):
            lost = "; ".join(dict.fromkeys(failed["visual"] + failed["collision"]))
            self._notes.add(kind, "link", link.name, f"mesh {lost}; a stand-in is drawn and fitted")
            return Look([], [], [])
        for tag, other in (("visual", "collision"), ("collision", "visual")):
            what = f"{tag} mesh {'; '.join(failed[tag])}"
            use = {"visual": "drawn", "collision": "fitted"}[tag]
            if failed[tag] and loaded[tag]:
                self._notes.add(kind, "link", link.name, f"{what}; left out")
            elif failed[tag] and loaded[other]:
                self._notes.add(kind, "link", link.name, f"{what}; the {other}'s is {use}")
            elif tag == "visual" and link.name in self._beside and not link.visuals:
                continue
            elif not loaded[tag] and loaded[other]:
                self._notes.add("guessed", "link", link.name, f"no {tag} in the URDF: the {other}'s is {use}")
        shown = loaded["visual"] or (loaded["collision"] if link.visuals or link.name not in self._beside else [])
        drawn = [visual for item in shown for visual in self._files.visuals(*item, link.name)]
        fitted = self._placed(link.name, loaded["visual"], loaded["collision"]) or loaded["visual"]
        count = min(primitives.SAMPLES, max(MAX_POINTS // max(len(fitted), 1), 20))
        surfaces = [self._surface(shape, parts, count) for shape, _, parts in fitted]
        return Look(drawn, surfaces, [primitives.exact(shape) for shape, _, _ in fitted])

    def _placed(self, name: str, shown: list[_Loaded], fitted: list[_Loaded]) -> list[_Loaded]:
        """Moves a link's only collision to its only visual, if both are one mesh: a misplaced visual would have been noticed."""
        if len(shown) != 1 or len(fitted) != 1:
            return fitted
        seen, felt = shown[0][0], fitted[0][0]
        same = seen.kind == "mesh" and (seen.file, seen.size) == (felt.file, felt.size)
        if not same or np.allclose(seen.origin, felt.origin, rtol=0, atol=APART):
            return fitted
        self._notes.add("repaired", "link", name, "its collision is its visual's mesh, but elsewhere: moved to the visual")
        return shown

    def _surface(self, shape: Shape, parts: list[meshes.Part], count: int) -> tuple[Points, float]:
        """Samples points on the shape in the link's frame [count, 3], and computes the volume of its convex hull [m3]."""
        key = (shape.kind, shape.file, shape.size, count)
        if key not in self._sampled:
            self._work.spend(parts)
            scale = shape.size if shape.kind == "mesh" else (1.0,) * 3
            points = primitives.sample(drawing.scaled(meshes.joined([m for m, _ in parts]), scale), count)
            self._sampled[key] = points, _volume(shape) or primitives.hull(points)
        points, volume = self._sampled[key]
        return points @ shape.origin[:3, :3].T + shape.origin[:3, 3], volume

    def _load(self, shape: Shape) -> tuple[str, list[meshes.Part]]:
        if shape.kind != "mesh":
            return "", [(_solid(shape.kind, shape.size), None)]
        stem, parts = self._meshes.load(shape.file)
        corners = np.concatenate([np.zeros((1, 3)), *(mesh.bounds for mesh, _ in parts)]) * shape.size
        self.spans[shape.file, shape.size] = float(np.ptp(corners, axis=0).max())
        return stem, parts


def stand_in(name: str, tree: Tree, notes: Notes) -> Look:
    """Makes a capsule from the link's origin to the next joint, or to twice its centre of mass; or a ball.

    Its radius follows from the mass at 1500 kg/m3, within 15 to 60 mm.
    """
    ends = [j.origin[:3, 3] for j in tree.joints.values() if j.parent == name]
    ends = [e for e in ends if np.linalg.norm(e) > 0.02] or [2 * tree.links[name].mass.com]
    end = max(ends, key=np.linalg.norm)
    length = float(np.linalg.norm(end))
    if length > 2.0 or length < 0.02:
        end, length = np.zeros(3), 0.0
    mass = tree.links[name].mass.mass
    radius = float(np.clip(np.sqrt(mass / 1500 / np.pi / max(length, 0.05)), 0.015, 0.06))
    if length == 0.0:
        shape = primitives.Primitive("sphere", (radius,), np.eye(4))
    else:
        radius = min(radius, length / 2)
        place = primitives.pose(_along(end / length), end / 2)
        shape = primitives.Primitive("capsule", (radius, max(length / 2 - radius, 5e-4)), place)
    notes.add("guessed", "link", name, f"{shape.kind} of radius {radius:.3f} m in place of its meshes")
    mesh = _mesh(shape)
    drawn = drawing.Visual(shape.kind, shape.size, shape.pose, STAND_IN)
    return Look([drawn], [(primitives.sample(mesh), shape.volume)], [shape], guessed=True)


@functools.lru_cache(maxsize=100)
def _solid(kind: str, size: tuple[float, ...]) -> trimesh.Trimesh:
    """Makes the surface of a URDF's box, sphere, capsule or cylinder."""
    if kind == "box":
        return trimesh.creation.box(size)
    if kind == "sphere":
        return trimesh.creation.icosphere(3, size[0])
    if kind == "cylinder":
        return trimesh.creation.cylinder(size[0], size[1])
    capsule = trimesh.creation.capsule(height=size[1], radius=size[0])
    return capsule.apply_translation(-capsule.bounds.mean(0))


def _told(lost: Mapping[str, str]) -> str:
    """Writes one line about meshes that are missing, or in a format that is not read."""
    names, reasons = list(lost), list(dict.fromkeys(lost.values()))
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    lines = "; ".join(reasons[:3]) + ", ..." * (len(reasons) > 3)
    which = f"mesh {names[0]!r}" if len(names) == 1 else f"{len(names)} meshes, {', '.join(map(repr, names[:3]))}{more}"
    return f"{which}: {lines}; the links' other meshes or stand-ins take their place (report.json has which)"


def _mesh(shape: primitives.Primitive) -> trimesh.Trimesh:
    if shape.kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=2, radius=shape.size[0]).apply_transform(shape.pose)
    mesh = trimesh.creation.capsule(height=2 * shape.size[1], radius=shape.size[0], count=(12, 12))
    return mesh.apply_translation(-mesh.bounds.mean(0)).apply_transform(shape.pose)


def _along(z: Vec) -> Matrix:
    """Makes a frame [3, 3] whose last column is the unit vector ``z``."""
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _volume(shape: Shape) -> float | None:
    """Volume of a primitive [m3]; None for other shapes."""
    exact = primitives.exact(shape)
    if exact is not None:
        return exact.volume
    return float(np.pi * shape.size[0] ** 2 * shape.size[1]) if shape.kind == "cylinder" else None
