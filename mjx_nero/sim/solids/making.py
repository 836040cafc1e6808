"""Makes solids of meshes: cleans, weighs and cuts them."""

import importlib.util
import io
import itertools
import pathlib
import subprocess
import sys
from typing import Any

import numpy as np
import trimesh

from mjx_nero.sim.solids import pieces, rests
from mjx_nero.sim.solids.reading import Raw
from mjx_nero.sim.solids.solid import DENSITY, MAX_CORNERS, MAX_PARTS, Solid
from mjx_nero.types import UserError

MAX_DRAWN = 40_000  # triangles
COARSE = 2_500  # triangles of a mesh to cut into pieces
SECONDS = {"careful": 12, "quick": 14}  # CPU time for cutting [s]; the quick search follows if the careful one does not finish
MAX_LOOSE = 300  # disconnected pieces
FLAT = 1e-4  # least thickness, as a share of the length
HOLE = 1.0  # greatest length of a hole's edge that is filled, as a share of the length; the rim of a cup is three times it
CONVEX = 0.97  # least share of its hull's volume that a convex piece fills


def make(raw: Raw, parts: list[np.ndarray] | None, density: float = DENSITY) -> Solid:
    """Makes a solid of a mesh.

    Args:
        parts: its convex parts, if it is cut already.

    Raises:
        UserError: the mesh encloses nothing, is too flat, or cannot be cut, or the library that cuts is not installed.
    """
    mesh, drawn, note = _cleaned(raw)
    hulls = [_hull(part) for part in (parts if parts is not None else _parts(mesh))]
    if len(hulls) > MAX_PARTS:
        raise UserError(f"has {len(hulls)} convex parts: at most {MAX_PARTS}")
    volume, center, inertia = _weighed(mesh if mesh.is_volume else None, hulls)
    points = np.concatenate([part.vertices for part in hulls]) - center
    hull = np.asarray(_hull(points).vertices)
    quats, shares = rests.find(hull, inertia / volume)
    return Solid(
        points=points,
        sizes=np.array([len(part.vertices) for part in hulls]),
        hull=hull,
        volume=volume,
        inertia=inertia,
        center=center,
        rest_quat=quats,
        rest_share=shares,
        vertices=drawn.vertices - center,
        faces=np.asarray(drawn.faces),
        uv=raw.uv if drawn.metadata.get("uv") else np.zeros((0, 2), np.float32),
        texture=raw.texture if drawn.metadata.get("uv") else np.zeros((0, 0, 3), np.uint8),
        rgba=_colour(raw) if not drawn.metadata.get("uv") else raw.rgba,
        density=density,
        note="; ".join(filter(None, (note, raw.missing and f"drawn without {raw.missing}, which is not there"))),
    )


def _cleaned(raw: Raw) -> tuple[trimesh.Trimesh, trimesh.Trimesh, str]:
    """Returns the mesh to weigh and cut, the mesh to draw, and a note of what was lost."""
    size = float(np.ptp(raw.vertices[np.unique(raw.faces)], axis=0).max())
    if not size > 0:
        raise UserError("has no size")
    note, drawn = "", trimesh.Trimesh(raw.vertices, raw.faces, process=False)
    if len(raw.faces) > MAX_DRAWN:
        merged = trimesh.Trimesh(raw.vertices, raw.faces, process=True)
        drawn = _coarser(merged, MAX_DRAWN)
        note = f"{len(raw.faces):,} triangles are drawn as {len(drawn.faces):,}" + (", without texture" if len(raw.uv) else "")
    drawn.metadata["uv"] = bool(len(raw.uv)) and not note
    mesh = trimesh.Trimesh(drawn.vertices, drawn.faces, process=False)
    if not mesh.is_watertight:  # in a closed mesh, merging nearly equal vertices would open it
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh = _filled(mesh, HOLE * size)
    a, b, c = mesh.faces.T
    mesh.update_faces((a != b) & (b != c) & (c != a))  # thin triangles stay: without them a closed surface has slits
    mesh.update_faces(mesh.unique_faces())
    mesh.remove_unreferenced_vertices()
    if len(mesh.faces) < 4:
        raise UserError("encloses nothing: it has fewer than four triangles that are not points or lines")
    if mesh.is_watertight and not mesh.is_volume:
        mesh.fix_normals()
    return mesh, drawn, note


def _filled(mesh: trimesh.Trimesh, longest: float) -> trimesh.Trimesh:
    """Fills holes whose edge is at most ``longest``: triangles that a scan lacks, and ends of handles within the body."""
    alone = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    follow = {int(b): int(a) for a, b in mesh.edges[alone]}
    if len(follow) < len(alone):
        return mesh  # holes that touch
    faces: list[tuple[int, int, int]] = []
    while follow:
        loop = [next(iter(follow))]
        while (after := follow.pop(loop[-1], loop[0])) != loop[0]:
            loop.append(after)
        follow.pop(loop[-1], None)
        points = mesh.vertices[loop]
        if len(loop) > 2 and np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum() <= longest:
            faces += [(loop[0], b, c) for b, c in itertools.pairwise(loop[1:])]
    return trimesh.Trimesh(mesh.vertices, np.concatenate([mesh.faces, faces]), process=False) if faces else mesh


def _coarser(mesh: trimesh.Trimesh, most: int, force: float = 7) -> trimesh.Trimesh:
    """Removes triangles where the surface is flattest until ``most`` are left; with less ``force`` fewer folds arise."""
    if len(mesh.faces) <= most:
        return mesh
    if importlib.util.find_spec("fast_simplification") is None:
        raise UserError(f"has more than {most:,} triangles: make it coarser, or pip install 'mjx-nero[meshes]'")
    import fast_simplification

    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)
    vertices, faces = fast_simplification.simplify(vertices, faces, target_count=most, agg=force)
    return trimesh.Trimesh(vertices, faces, process=True)


def _coarse(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh to cut: coarser, and still closed if possible, as an open surface takes the library much longer."""
    if len(mesh.faces) <= COARSE:
        return mesh
    tries = (_coarser(mesh, round(share * COARSE), force) for share in (1.0, 0.8, 0.6, 0.4) for force in (7, 5, 3))
    first = next(tries)
    return next((found for found in itertools.chain([first], tries) if found.is_volume), first) if mesh.is_volume else first


def _parts(mesh: trimesh.Trimesh) -> list[np.ndarray]:
    """Cuts a mesh into convex parts. A mesh of a few convex pieces is cut already.

    Raises:
        UserError: the library is not installed, or fails.
    """
    labels = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))
    count = int(labels.max()) + 1
    if count > MAX_LOOSE:
        raise UserError(f"is {count:,} disconnected pieces, not a solid: at most {MAX_LOOSE} are cut")
    if count <= MAX_PARTS and mesh.is_volume:
        each: Any = mesh.submesh([np.flatnonzero(labels[mesh.faces[:, 0]] == k) for k in range(count)])
        hulls = [_hull(np.asarray(piece.vertices)) for piece in each]
        if all(piece.volume > CONVEX * hull.volume for piece, hull in zip(each, hulls, strict=True)):
            return [np.asarray(hull.vertices) for hull in hulls]
    if importlib.util.find_spec("coacd") is None:
        raise UserError(
            "is not convex, and cutting it into convex parts needs coacd: install the extra (pip install 'mjx-nero[meshes]')"
        )
    coarse = _coarse(mesh)
    given = io.BytesIO()
    np.savez(given, vertices=np.asarray(coarse.vertices, float), faces=np.asarray(coarse.faces))
    for effort in SECONDS:
        if (found := _cut_apart(given.getvalue(), "closed" if coarse.is_volume else "open", effort)) is not None:
            return found
    raise UserError("cannot be cut into convex parts in time and memory: repair it, or give it fewer triangles")


def _cut_apart(mesh: bytes, surface: str, effort: str) -> list[np.ndarray] | None:
    """Cuts a mesh in a process of its own; None: it fails."""
    seconds = SECONDS[effort]
    command = [sys.executable, pieces.__file__, str(MAX_PARTS), str(MAX_CORNERS), str(seconds), surface, effort]
    try:
        done = subprocess.run(command, input=mesh, capture_output=True, timeout=20 * seconds)
    except subprocess.TimeoutExpired:
        return None
    if done.returncode or not done.stdout:
        return None
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as found:
        return np.split(found["points"], np.cumsum(found["sizes"])[:-1])


def _hull(points: np.ndarray) -> trimesh.Trimesh:
    """The convex hull, with at most ``MAX_CORNERS`` corners.

    Raises:
        UserError: the points lie in a plane.
    """
    size = float(np.ptp(points, axis=0).max()) or 1.0
    try:
        hull = trimesh.PointCloud(points).convex_hull
        if len(hull.vertices) > MAX_CORNERS:  # keep the farthest in evenly spread directions
            directions = trimesh.creation.icosphere(2).vertices
            chosen = np.unique(np.argmax(hull.vertices @ directions.T, axis=0))
            if len(chosen) > MAX_CORNERS:
                chosen = np.unique(np.argmax(hull.vertices @ trimesh.creation.icosphere(1).vertices.T, axis=0))
            hull = trimesh.PointCloud(hull.vertices[chosen]).convex_hull
    except Exception:  # Qhull's own, many lines long
        raise UserError("has a part that is flat: it needs a thickness") from None
    if hull.volume < (FLAT * size) * (0.01 * size) ** 2 or not np.isfinite(hull.volume):
        raise UserError("has a part that is flat: it needs a thickness")
    return hull


def _weighed(mesh: trimesh.Trimesh | None, hulls: list[trimesh.Trimesh]) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre of mass and inertia about it at density 1: of the closed mesh, or else of all parts together."""
    each = [mesh] if mesh is not None and mesh.volume > 0 else hulls
    volumes = np.array([part.volume for part in each])
    centers = np.array([part.center_mass for part in each])
    center = volumes @ centers / volumes.sum()
    inertia = np.zeros((3, 3))
    for part, volume, at in zip(each, volumes, centers - center, strict=True):
        inertia += part.moment_inertia + volume * (at @ at * np.eye(3) - np.outer(at, at))
    if not np.isfinite(inertia).all() or not (np.linalg.eigvalsh(inertia) > 0).all():
        raise UserError("has no inertia: it encloses nothing")
    return float(volumes.sum()), center, inertia


def _colour(raw: Raw) -> tuple[float, float, float, float]:
    """The mean colour of a texture that is not drawn, or the mesh's own."""
    if not raw.texture.size:
        return raw.rgba
    red, green, blue = (float(c) / 255 for c in raw.texture.mean((0, 1)))
    return red, green, blue, 1.0


def cut(path: pathlib.Path, raw: Raw) -> list[np.ndarray]:
    """The convex parts in a file of parts: its connected pieces.

    Raises:
        UserError: there are none, or more than ``MAX_PARTS``.
    """
    mesh = trimesh.Trimesh(raw.vertices, raw.faces, process=False)
    labels = trimesh.graph.connected_component_labels(mesh.edges, node_count=len(mesh.vertices))
    count = int(labels.max()) + 1
    if count > MAX_PARTS:
        raise UserError(f"{path} has {count} convex parts: at most {MAX_PARTS}")
    return [np.asarray(mesh.vertices[labels == k]) for k in range(count)]
