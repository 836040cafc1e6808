"""Meshes that a URDF names: read with limits, parsed without following references, returned as triangles in metres."""

import io
import logging
import pathlib
import re
from typing import Any

import numpy as np
import trimesh
from lxml import etree

from mjx_nero.files import parse_xml, read_bytes
from mjx_nero.types import UserError
from mjx_nero.urdf.files import Foreign, Missing, Roots

KINDS = {"stl": 100_000_000, "obj": 40_000_000, "dae": 30_000_000}  # bytes
MAX_BYTES = 300_000_000  # all meshes of a robot together
MAX_TRIANGLES = 1_000_000  # per mesh
MAX_ALL = 4_000_000  # triangles of all meshes together
MAX_NUMBERS = 8_000_000  # numbers in an OBJ file
MAX_INDICES = 4_000_000  # indices in a DAE file
MAX_PLACED = 10_000  # how often a DAE file may place its geometries

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # failures are reported by this package
Part = tuple[trimesh.Trimesh, tuple[float, ...] | None]  # mesh and colour


class Meshes:
    """Loads the meshes of a URDF, each once, unscaled, in metres by the file's own unit."""

    def __init__(self, roots: Roots):
        self._roots = roots
        self._read: dict[pathlib.Path, list[Part] | Missing] = {}
        self._bytes = self._triangles = 0

    def load(self, name: str) -> tuple[str, list[Part]]:
        """Returns a name for derived files, and the mesh's parts by colour.

        Raises:
            UserError: the file lies outside the folders, or it or all meshes together are too large.
            Missing: the file is absent, holds no mesh, or has too many triangles.
        """
        path = self._roots.find(name)
        if path not in self._read:
            self._read[path] = self._parsed(path)
        found = self._read[path]
        if isinstance(found, Missing):
            raise found
        return re.sub(r"\W+", "_", path.stem)[:60] or "mesh", found

    def _parsed(self, path: pathlib.Path) -> list[Part] | Missing:
        kind = path.suffix[1:].lower()
        if kind not in KINDS:
            return Foreign(f"a .{kind[:10]} file: only {', '.join(KINDS)} are read")
        content = read_bytes(path, KINDS[kind])
        self._bytes += len(content)
        if self._bytes > MAX_BYTES:
            raise UserError(f"the meshes have more than {MAX_BYTES / 1e6:.0f} MB together: use simpler ones")
        try:
            parts = _parse(content, kind)
        except Missing as error:
            return error
        self._triangles += sum(len(mesh.faces) for mesh, _ in parts)
        if self._triangles > MAX_ALL:
            raise UserError(f"the meshes have {self._triangles:,} triangles together, more than {MAX_ALL:,}: use simpler ones")
        return parts


def _parse(content: bytes, kind: str) -> list[Part]:
    check = {"stl": _check_stl, "obj": _plain_obj, "dae": _check_dae}[kind]
    content = check(content)
    try:  # from bytes and without a resolver, so that no other file is opened for materials or textures
        options: dict[str, Any] = {"skip_materials": True} if kind == "obj" else {}
        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(io.BytesIO(content), file_type=kind, process=False, **options)
            _check_count(sum(len(getattr(scene.geometry[scene.graph[n][1]], "faces", ())) for n in scene.graph.nodes_geometry))
            dumped = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
            unit = trimesh.units.unit_conversion(scene.units, "meters") if scene.units else 1.0
            solids = [solid for solid in (_solid(mesh, unit) for mesh in dumped) if solid is not None]
    except Missing:
        raise
    except Exception as error:  # each parser fails in its own ways
        raise Missing(f"cannot be read: {' '.join(str(error).split())[:200] or type(error).__name__}") from None
    by_colour: dict[tuple[float, ...] | None, list[trimesh.Trimesh]] = {}
    for mesh in solids:
        by_colour.setdefault(_colour(mesh) if kind == "dae" else None, []).append(mesh)
    if not by_colour:
        raise Missing("holds no triangles")
    return [(joined(group), colour) for colour, group in by_colour.items()]


def _solid(mesh: trimesh.Trimesh, unit: float) -> trimesh.Trimesh | None:
    """Keeps the triangles whose points are finite and less than 1000 km away, in metres; None if there are none."""
    vertices, faces = np.asarray(mesh.vertices, float) * unit, np.asarray(mesh.faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(faces):
        return None
    good = np.asarray((np.abs(vertices) < 1e6).all(axis=1))  # excludes NaN
    faces = faces[((faces >= 0) & (faces < len(vertices))).all(1)]
    faces = faces[good[faces].all(1)]
    if not len(faces):
        return None
    solid = trimesh.Trimesh(np.where(good[:, None], vertices, 0.0), faces, process=False, visual=mesh.visual)
    solid.remove_unreferenced_vertices()
    return solid


def _check_count(triangles: int) -> None:
    if triangles > MAX_TRIANGLES:
        raise Missing(f"has {triangles:,} triangles: more than {MAX_TRIANGLES:,} are not read")


def _check_stl(content: bytes) -> bytes:
    """Counts triangles. A binary file has 84 bytes plus 50 per triangle."""
    binary = len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")
    _check_count((len(content) - 84) // 50 if binary else content.count(b"endfacet"))
    return content


def _plain_obj(content: bytes) -> bytes:
    """Keeps only lines of points and faces. Groups, materials, textures and normals are not used."""
    lines = re.findall(rb"^[ \t]*[vf][ \t][^\r\n]*", content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" "), re.MULTILINE)
    _check_count(sum(line.lstrip().startswith(b"f") for line in lines))
    plain = re.sub(rb"/[^ \t\n]*", b"", b"\n".join(lines)) + b"\n"
    numbers = len(re.findall(rb"[ \t]+", plain)) if len(plain) > MAX_NUMBERS else 0
    if numbers > MAX_NUMBERS:
        raise Missing(f"has {numbers:,} numbers: more than {MAX_NUMBERS:,} are not read")
    return plain


def _check_dae(content: bytes) -> bytes:
    try:
        root = parse_xml(content, "the mesh")
    except UserError as error:
        raise Missing(f"cannot be read: {error}") from None
    if _placed(root) > MAX_PLACED:
        raise Missing(f"places its parts more than {MAX_PLACED} times")
    indices = sum(len((p.text or "").split()) for p in root.iter("{*}p", "{*}vcount", "{*}v"))
    if indices > MAX_INDICES:
        raise Missing(f"has {indices:,} indices: more than {MAX_INDICES:,} are not read")
    return content


def _placed(root: etree._Element) -> int:
    """Counts how often a COLLADA scene places geometries.

    Nodes may place one another, doubling at every level, or in a circle.
    """
    nodes = {node.get("id"): node for node in root.iter("{*}node") if node.get("id")}
    known: dict[str, int] = {}

    def count(element: etree._Element, above: tuple[str, ...]) -> int:
        total = sum(1 for _ in element.iter("{*}instance_geometry", "{*}instance_controller"))
        for place in element.iter("{*}instance_node"):
            name = (place.get("url") or "").lstrip("#")
            if name in above or len(above) > 100:
                return MAX_PLACED + 1
            if name not in known and name in nodes:
                known[name] = count(nodes[name], (*above, name))
            total += known.get(name, 0)
        return min(total, MAX_PLACED + 1)

    return sum(count(scene, ()) for scene in root.iter("{*}visual_scene"))


def joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Merges all triangles to one mesh without colours."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)])
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, process=False)


def _colour(mesh: trimesh.Trimesh) -> tuple[float, ...] | None:
    rgba = getattr(getattr(mesh.visual, "material", None), "main_color", None)
    return None if rgba is None else tuple(round(float(c) / 255, 3) for c in rgba)
