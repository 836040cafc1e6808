"""The files that a URDF names: found within given folders only, read with limits, parsed without following references."""

import io
import logging
import os
import pathlib
import re
import stat
import urllib.parse
from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh
from lxml import etree

from mjx_nero.types import UserError

MAX_URDF = 10_000_000  # bytes
MAX_MESH = 100_000_000  # bytes
MAX_MESHES = 1_000_000_000  # bytes, all together
MAX_PLACED = 10_000  # how often a DAE file may place its geometries
MAX_TRIANGLES = 5_000_000  # ... and what a mesh may have then
KINDS = ("stl", "dae", "obj")

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # what it cannot read is reported here


class Missing(Exception):
    """A file that cannot be used; the message says why. The importer goes on without it."""


class Roots:
    """The folders that a URDF may name files in.

    These are the URDF's own folder; the one above, if the URDF lies in a folder called ``urdf``, ``robots`` or ``xacro`` or the
    one above holds a ``package.xml`` (the usual layout of a description: ``urdf/`` beside ``meshes/``); and ``packages``.

    Args:
        urdf: path of the URDF.
        packages: name -> folder, for ``package://name/...``.

    Raises:
        UserError: a package's folder does not exist.
    """

    def __init__(self, urdf: pathlib.Path, packages: Mapping[str, pathlib.Path]):
        self.here = urdf.resolve().parent
        self.packages = {}
        for name, folder in packages.items():
            if not pathlib.Path(folder).is_dir():
                raise UserError(f"--package {name}={folder}: no such folder")
            self.packages[name] = pathlib.Path(folder).resolve()
        above, usual = self.here.parent, self.here.name in ("urdf", "robots", "xacro")
        own = [self.here] + [above] * (above != above.parent and (usual or (above / "package.xml").is_file()))
        self.folders = [*own, *self.packages.values()]
        self._own = own

    def find(self, name: str) -> pathlib.Path:
        """The file that a URDF calls ``name``: ``package://``, ``model://``, ``file://``, relative or absolute.

        Raises:
            UserError: it lies outside the folders, be it by a symbolic link.
            Missing: there is no such file.
        """
        scheme, _, rest = name.replace("\\", "/").rpartition("://")
        rest = urllib.parse.unquote(rest) if scheme == "file" else rest
        if "\0" in rest or not rest.strip("/ "):
            raise Missing("names no file")
        if scheme in ("package", "model"):
            package, _, rest = rest.partition("/")
            rest = rest.lstrip("/")
            if package in self.packages:
                places = [self.packages[package]]
            else:  # the package that holds the URDF goes by any name
                places = [f.parent for f in self._own if f.name == package and f.parent in self._own] + self._own
                places = [f for f in self._own if f.name == package] + places
            lacking = "" if package in self.packages else f"; for package {package!r} pass --package {package}=DIR"
        elif scheme in ("", "file"):
            places, lacking = [self.here], ""
        else:
            raise Missing(f"{scheme}:// is not fetched")
        for place in dict.fromkeys(places):
            path = self._inside(place / rest, name)
            if path is not None:
                return path
        raise Missing(f"there is no such file{lacking}")

    def _inside(self, path: pathlib.Path, name: str) -> pathlib.Path | None:
        """``path`` without links and ``..`` if it is a regular file within the folders, None if it is none."""
        try:
            real = path.resolve()
            regular = stat.S_ISREG(real.stat().st_mode)
        except (OSError, RuntimeError, ValueError):  # absent, no permission, a loop of links, too long a name
            real, regular = pathlib.Path(os.path.normpath(path)), False
        if not any(real.is_relative_to(folder) for folder in self.folders):
            raise UserError(f"{name!r} lies outside the URDF's folder: name its folder with --package NAME=DIR, if you trust it")
        return real if regular else None


def read(path: pathlib.Path, limit: int) -> bytes:
    """The bytes of a regular file.

    Raises:
        UserError: there is none, it cannot be read, or it is larger than ``limit`` bytes.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise UserError(f"{path} is not a file")
        if status.st_size > limit:
            raise UserError(f"{path} has {status.st_size / 1e6:.0f} MB: more than {limit / 1e6:.0f} MB are not read")
        with path.open("rb") as file:
            return file.read(limit)
    except FileNotFoundError:
        raise UserError(f"there is no file {path}") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from None


def parse_xml(content: bytes, name: str) -> etree._Element:
    """The root element. Neither entities nor other files are read.

    Raises:
        UserError: malformed, or it declares a document type, which no URDF or mesh needs and entity bombs do.
    """
    parser = etree.XMLParser(resolve_entities=False, load_dtd=False, no_network=True, huge_tree=False)
    try:
        root = etree.fromstring(content, parser)
    except (etree.XMLSyntaxError, ValueError) as error:
        raise UserError(f"{name} is not well-formed XML: {' '.join(str(error).split())}") from None
    if root.getroottree().docinfo.internalDTD is not None:
        raise UserError(f"{name} declares a document type (<!DOCTYPE ...>): remove it, a robot description needs none")
    return root


Part = tuple[trimesh.Trimesh, tuple[float, ...] | None]  # with its colour


class Meshes:
    """Meshes of a URDF: each is read once, in metres as its file says, unscaled."""

    def __init__(self, roots: Roots):
        self._roots = roots
        self._read: dict[pathlib.Path, list[Part] | Missing] = {}
        self._total = 0

    def load(self, name: str) -> tuple[str, list[Part]]:
        """A name for files made of it, and its parts by colour.

        Raises:
            UserError: the file lies outside the folders or is too large.
            Missing: there is none, or it holds no mesh.
        """
        path = self._roots.find(name)
        if path not in self._read:
            content = read(path, MAX_MESH)
            self._total += len(content)
            if self._total > MAX_MESHES:
                raise UserError(f"the meshes have more than {MAX_MESHES / 1e6:.0f} MB together: use simpler ones")
            try:
                self._read[path] = _parse_mesh(content, path.suffix[1:].lower())
            except Missing as error:
                self._read[path] = error
        found = self._read[path]
        if isinstance(found, Missing):
            raise found
        return re.sub(r"\W+", "_", path.stem) or "mesh", found


def _parse_mesh(content: bytes, kind: str) -> list[Part]:
    if kind not in KINDS:
        raise Missing(f"is a .{kind} file: only {', '.join(KINDS)} are read")
    if kind == "dae":
        try:
            root = parse_xml(content, "the mesh")
        except UserError as error:
            raise Missing(f"cannot be read: {error}") from None
        if _placed(root) > MAX_PLACED:
            raise Missing(f"places its parts more than {MAX_PLACED} times")
    try:  # from bytes and without a resolver: materials and textures in other files are not opened
        options: dict[str, Any] = {"skip_materials": True} if kind == "obj" else {}
        with np.errstate(all="ignore"):
            scene = trimesh.load_scene(io.BytesIO(content), file_type=kind, process=False, **options)
            count = sum(len(getattr(scene.geometry[scene.graph[n][1]], "faces", ())) for n in scene.graph.nodes_geometry)
            if count > MAX_TRIANGLES:
                raise ValueError(f"more than {MAX_TRIANGLES} triangles")
            dumped = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
            unit = trimesh.units.unit_conversion(scene.units, "meters") if scene.units else 1.0
    except Exception as error:  # each parser fails in its own ways
        raise Missing(f"cannot be read: {' '.join(str(error).split())[:200] or type(error).__name__}") from None
    by_colour: dict[tuple[float, ...] | None, list[trimesh.Trimesh]] = {}
    for mesh in dumped:
        vertices, faces = np.asarray(mesh.vertices, float) * unit, np.asarray(mesh.faces)
        good = np.asarray((np.abs(vertices) < 1e6).all(axis=1))  # [m]; not NaN either
        faces = faces[good[faces].all(1)] if len(faces) else faces
        if len(faces):
            mesh = trimesh.Trimesh(np.where(good[:, None], vertices, 0.0), faces, process=False, visual=mesh.visual)
            mesh.remove_unreferenced_vertices()
            by_colour.setdefault(_colour(mesh) if kind == "dae" else None, []).append(mesh)
    if not by_colour:
        raise Missing("holds no triangles")
    return [(joined(group), colour) for colour, group in by_colour.items()]


def _placed(root: etree._Element) -> int:
    """How often a COLLADA scene places geometries: nodes may place one another, doubling with every level, or in a circle."""
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
    """One mesh of all triangles, without colours."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)])
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), faces, process=False)


def _colour(mesh: trimesh.Trimesh) -> tuple[float, ...] | None:
    rgba = getattr(getattr(mesh.visual, "material", None), "main_color", None)
    return None if rgba is None else tuple(round(float(c) / 255, 3) for c in rgba)
