"""Shapes of the links: what is drawn, and the surfaces that collision shapes are fitted to."""

import dataclasses

import mujoco
import numpy as np
import trimesh

from mjx_nero.urdf import files, fit
from mjx_nero.urdf.notes import Notes
from mjx_nero.urdf.tree import Body, Link, Matrix, Points, Pose, Shape, Tree, Vec

MAX_FACES = 100_000  # a part; MuJoCo takes 200,000 of an STL
MAX_PARTS = 8  # colours of one mesh that are kept apart
GREY = (0.75, 0.76, 0.78, 1.0)
STAND_IN = (0.9, 0.6, 0.2, 1.0)


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A visual geom: of MuJoCo's type ``kind`` and size (a mesh: the name of its file), at ``pose`` in the link [4, 4]."""

    kind: str
    size: tuple[float, ...]
    pose: Pose
    rgba: tuple[float, ...]
    mesh: str = ""


@dataclasses.dataclass
class Look:
    """Of one link: visual geoms, and the surface to fit, in the link's frame: points [n, 3] and volume [m3] of each collision.

    ``exact`` are those collisions that are primitives already. ``guessed``: a stand-in, for want of meshes.
    """

    drawn: list[Drawn]
    surfaces: list[tuple[Points, float]]
    exact: list[fit.Primitive | None]
    guessed: bool = False

    @property
    def points(self) -> Points | None:
        return np.concatenate([points for points, _ in self.surfaces]) if self.surfaces else None


class Looks:
    """Loads the meshes and gathers the files to write.

    Attributes:
        stl: name -> content of the mesh files of the model.
        of: link -> its ``Look``.

    Raises:
        UserError: a mesh lies outside the folders or is too large.
    """

    def __init__(self, tree: Tree, parts: dict[str, Body], meshes: files.Meshes, notes: Notes):
        self.stl: dict[str, bytes] = {}
        self._meshes, self._notes = meshes, notes
        self._written: dict[tuple, list[tuple[str, tuple[float, ...]]]] = {}
        self.of = {name: self._look(link) for name, link in tree.links.items()}
        for body in parts.values():
            for name in body.links:
                link, look = tree.links[name], self.of[name]
                if not look.drawn and not look.surfaces and (link.visuals or link.collisions):
                    self.of[name] = self._stand_in(name, body, tree)

    def _look(self, link: Link) -> Look:
        """A link's shapes. Without a visual the collision's mesh is drawn, without a collision the visual's is fitted."""
        loaded: dict[str, list[tuple[Shape, str, list[files.Part]]]] = {"visual": [], "collision": []}
        failed: dict[str, list[str]] = {"visual": [], "collision": []}
        for tag, shapes in (("visual", link.visuals), ("collision", link.collisions)):
            for shape in shapes:
                try:
                    loaded[tag].append((shape, *self._load(shape)))
                except files.Missing as error:
                    failed[tag].append(f"{shape.file!r}: {error}")
        if any(failed.values()) and not any(loaded.values()):
            lost = "; ".join(dict.fromkeys(failed["visual"] + failed["collision"]))
            self._notes.add("warning", "link", link.name, f"mesh {lost}; a stand-in is drawn and fitted")
            return Look([], [], [])
        for tag, other in (("visual", "collision"), ("collision", "visual")):
            what = f"{tag} mesh {'; '.join(failed[tag])}"
            use = {"visual": "drawn", "collision": "fitted"}[tag]
            if failed[tag] and loaded[tag]:
                self._notes.add("warning", "link", link.name, f"{what}; left out")
            elif failed[tag] and loaded[other]:
                self._notes.add("warning", "link", link.name, f"{what}; the {other}'s is {use}")
            elif not loaded[tag] and loaded[other]:
                self._notes.add("guessed", "link", link.name, f"no {tag} in the URDF: the {other}'s is {use}")
        drawn = [d for item in loaded["visual"] or loaded["collision"] for d in self._draw(item, link.name)]
        surfaces, exact = [], []
        for shape, _, parts in loaded["collision"] or loaded["visual"]:
            mesh = _placed(files.joined([m for m, _ in parts]), shape)
            points = fit.sample(mesh)
            surfaces.append((points, fit.hull(points)))
            exact.append(_exact(shape))
        return Look(drawn, surfaces, exact)

    def _load(self, shape: Shape) -> tuple[str, list[files.Part]]:
        if shape.kind == "mesh":
            return self._meshes.load(shape.file)
        if shape.kind == "box":
            return "", [(trimesh.creation.box(shape.size), None)]
        if shape.kind == "sphere":
            return "", [(trimesh.creation.icosphere(subdivisions=3, radius=shape.size[0]), None)]
        return "", [(trimesh.creation.cylinder(shape.size[0], shape.size[1]), None)]

    def _draw(self, item: tuple[Shape, str, list[files.Part]], link: str) -> list[Drawn]:
        shape, stem, parts = item
        if shape.kind == "box":
            return [Drawn("box", tuple(s / 2 for s in shape.size), shape.origin, shape.rgba or GREY)]
        if shape.kind == "sphere":
            return [Drawn("sphere", shape.size, shape.origin, shape.rgba or GREY)]
        if shape.kind == "cylinder":
            return [Drawn("cylinder", (shape.size[0], shape.size[1] / 2), shape.origin, shape.rgba or GREY)]
        key = (shape.file, shape.size)
        if key not in self._written:
            self._written[key] = self._write(stem, parts, shape.size, link)
        return [Drawn("mesh", (), shape.origin, shape.rgba or rgba, name) for name, rgba in self._written[key]]

    def _write(self, stem: str, parts: list[files.Part], scale: tuple, link: str) -> list[tuple[str, tuple[float, ...]]]:
        if len(parts) > MAX_PARTS:
            merged = files.joined([mesh for mesh, _ in parts[MAX_PARTS - 1 :]])
            parts = [*parts[: MAX_PARTS - 1], (merged, parts[MAX_PARTS - 1][1])]
        out = []
        for mesh, rgba in parts:
            mesh = _scaled(mesh, scale)
            if len(mesh.faces) > MAX_FACES:
                before, mesh = len(mesh.faces), _coarser(mesh)
                self._notes.add("note", "link", link, f"mesh of {before} triangles drawn with {len(mesh.faces)}")
            content = trimesh.exchange.stl.export_stl(mesh)
            if not _loads(content):
                self._notes.add("note", "link", link, f"a part of mesh {stem!r} is too flat or small to draw: left out")
                continue
            name, n = stem, 1
            while name in self.stl:
                n += 1
                name = f"{stem}_{n}"
            self.stl[name] = content
            out.append((name, rgba or GREY))
        return out

    def _stand_in(self, name: str, body: Body, tree: Tree) -> Look:
        """A capsule from the link's origin to the next joint, or about twice as far as its centre of mass; or a ball.

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
            shape = fit.Primitive("sphere", (radius,), np.eye(4))
        else:
            radius = min(radius, length / 2)
            shape = fit.Primitive("capsule", (radius, max(length / 2 - radius, 5e-4)), fit.pose(_along(end / length), end / 2))
        self._notes.add("guessed", "link", name, f"{shape.kind} of radius {radius:.3f} m in place of its meshes")
        mesh = _mesh(shape)
        drawn = Drawn(shape.kind, shape.size, shape.pose, STAND_IN)
        return Look([drawn], [(fit.sample(mesh), shape.volume)], [shape], guessed=True)


def _mesh(shape: fit.Primitive) -> trimesh.Trimesh:
    if shape.kind == "sphere":
        return trimesh.creation.icosphere(subdivisions=2, radius=shape.size[0]).apply_transform(shape.pose)
    mesh = trimesh.creation.capsule(height=2 * shape.size[1], radius=shape.size[0], count=(12, 12))
    return mesh.apply_translation(-mesh.bounds.mean(0)).apply_transform(shape.pose)


def _along(z: Vec) -> Matrix:
    """Some frame [3, 3] whose last column is the unit vector ``z``."""
    x = np.cross(z, np.eye(3)[np.argmin(np.abs(z))])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _exact(shape: Shape) -> fit.Primitive | None:
    if shape.kind == "box":
        return fit.Primitive("box", tuple(s / 2 for s in shape.size), shape.origin)
    return fit.Primitive("sphere", shape.size, shape.origin) if shape.kind == "sphere" else None


def _scaled(mesh: trimesh.Trimesh, scale: tuple[float, ...]) -> trimesh.Trimesh:
    faces = mesh.faces[:, ::-1] if np.prod(np.sign(scale)) < 0 else mesh.faces  # a mirror turns the triangles inside out
    return trimesh.Trimesh(mesh.vertices * np.array(scale), faces, process=False)


def _placed(mesh: trimesh.Trimesh, shape: Shape) -> trimesh.Trimesh:
    return _scaled(mesh, shape.size if shape.kind == "mesh" else (1.0,) * 3).apply_transform(shape.origin)


def _coarser(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Vertices moved together on a grid, the finest that leaves at most ``MAX_FACES`` triangles."""
    lower, extent, cells = mesh.vertices.min(0), float(np.ptp(mesh.vertices, axis=0).max()), 512
    while True:
        grid = np.floor((mesh.vertices - lower) / (extent / cells)).astype(np.int64)
        _, first, group = np.unique(grid @ [1 << 20, 1 << 10, 1], return_index=True, return_inverse=True)
        faces = group[mesh.faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
        if len(faces) <= MAX_FACES:
            return trimesh.Trimesh(mesh.vertices[first], faces, process=False)
        cells = cells * 3 // 4


def _loads(stl: bytes) -> bool:
    """Whether MuJoCo takes the mesh: not, if it is flat."""
    spec = mujoco.MjSpec()
    spec.assets = {"m.stl": stl}
    spec.add_mesh(name="m", file="m.stl")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m", contype=0, conaffinity=0, mass=0)
    try:
        spec.compile()
    except ValueError:
        return False
    return True
