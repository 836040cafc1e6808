"""Drawing of a robot: its visual geoms, and the mesh files that they need."""

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np
import trimesh

from mjx_nero.sim import model_file
from mjx_nero.types import UserError
from mjx_nero.urdf import meshes, primitives
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Pose, Shape

MAX_FACES = 100_000  # per part; MuJoCo reads up to 200,000 from an STL
LEAST_FACES = 1_000  # a part keeps at least these
MAX_DRAWN = 300_000  # triangles of all drawn meshes together; finer ones cost seconds and look the same
MAX_PARTS = 8  # greatest number of colours of one mesh
MAX_FILES = model_file.MAX_MESHES  # drawn mesh files
GREY = (0.75, 0.76, 0.78, 1.0)


@dataclasses.dataclass(frozen=True)
class Visual:
    """A visual geom of MuJoCo's type ``kind`` and size (for a mesh, the name of its file), at ``pose`` in the link [4, 4]."""

    kind: str
    size: tuple[float, ...]
    pose: Pose
    rgba: tuple[float, ...]
    mesh: str = ""


class MeshFiles:
    """Makes visual geoms of shapes, and collects the mesh files to write, one per mesh, scale and colour.

    Args:
        count: number of meshes to draw, which share ``MAX_DRAWN`` triangles.
        spend: counts work that grows with triangles, and refuses excess.

    Attributes:
        stl: name -> content of a file.

    Raises:
        UserError: there are too many files, or they are too large.
    """

    def __init__(self, count: int, spend: Callable[[list[meshes.Part]], None], notes: Notes):
        self.stl: dict[str, bytes] = {}
        self._spend, self._notes, self._share = spend, notes, MAX_DRAWN // max(count, 1)
        self._written: dict[tuple, list[tuple[str, tuple[float, ...]]]] = {}

    def visuals(self, shape: Shape, stem: str, parts: list[meshes.Part], link: str) -> list[Visual]:
        """Makes the geoms of a link's shape, whose mesh has the name ``stem`` and the given parts."""
        exact = primitives.exact(shape)
        if exact is not None:
            return [Visual(exact.kind, exact.size, exact.pose, shape.rgba or GREY)]
        if shape.kind == "cylinder":
            return [Visual("cylinder", (shape.size[0], shape.size[1] / 2), shape.origin, shape.rgba or GREY)]
        key = (shape.file, shape.size)
        if key not in self._written:
            self._written[key] = self._write(stem, parts, shape.size, link)
        return [Visual("mesh", (), shape.origin, shape.rgba or rgba, name) for name, rgba in self._written[key]]

    def _write(self, stem: str, parts: list[meshes.Part], scale: tuple, link: str) -> list[tuple[str, tuple[float, ...]]]:
        self._spend(parts)
        if len(parts) > MAX_PARTS:
            merged = meshes.joined([mesh for mesh, _ in parts[MAX_PARTS - 1 :]])
            parts = [*parts[: MAX_PARTS - 1], (merged, parts[MAX_PARTS - 1][1])]
        out, share = [], self._share / max(sum(len(mesh.faces) for mesh, _ in parts), 1)
        for mesh, rgba in parts:
            mesh = scaled(mesh, scale)
            limit = min(max(int(share * len(mesh.faces)), LEAST_FACES), MAX_FACES)
            if len(mesh.faces) > limit:
                before, mesh = len(mesh.faces), _coarser(mesh, limit)
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
            if len(self.stl) > MAX_FILES or sum(map(len, self.stl.values())) > model_file.MAX_MESH_BYTES:
                most = f"{MAX_FILES} files of {model_file.MAX_MESH_BYTES / 1e6:.0f} MB"
                raise UserError(f"its meshes, one for each scale and colour, are more than {most}: use fewer or simpler ones")
            out.append((name, rgba or GREY))
        return out


def scaled(mesh: trimesh.Trimesh, scale: tuple[float, ...]) -> trimesh.Trimesh:
    """Scales a mesh along each axis."""
    faces = mesh.faces[:, ::-1] if np.prod(np.sign(scale)) < 0 else mesh.faces  # a mirror image turns triangles inside out
    return trimesh.Trimesh(mesh.vertices * np.array(scale), faces, process=False)


def _coarser(mesh: trimesh.Trimesh, most: int) -> trimesh.Trimesh:
    """Merges vertices on about the finest grid that leaves at most ``most`` triangles."""
    lower, extent, cells = mesh.vertices.min(0), float(np.ptp(mesh.vertices, axis=0).max()) or 1.0, 512
    while True:
        grid = np.floor((mesh.vertices - lower) / (extent / cells)).astype(np.int64)
        _, first, group = np.unique(grid @ [1 << 20, 1 << 10, 1], return_index=True, return_inverse=True)
        faces = group[mesh.faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
        if len(faces) > most:  # remove duplicates
            key = (faces[:, 0] * len(first) + faces[:, 1]) * len(first) + faces[:, 2]
            faces = faces[np.unique(key, return_index=True)[1]]
        if len(faces) <= most:
            return trimesh.Trimesh(mesh.vertices[first], faces, process=False)
        cells = int(cells * min(0.8, np.sqrt(most / len(faces))))  # triangles grow with the square of the cells


def _loads(stl: bytes) -> bool:
    """True if MuJoCo accepts the mesh; it refuses flat ones."""
    spec = mujoco.MjSpec()
    spec.assets = {"m.stl": stl}
    spec.add_mesh(name="m", file="m.stl")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="m", contype=0, conaffinity=0, mass=0)
    try:
        spec.compile()
    except ValueError:
        return False
    return True
