"""Primitive shapes fitted around meshes. Mesh collisions are slow in MJX; a capsule costs only two contacts with the table."""

import dataclasses
import functools
import itertools
import math

import numpy as np
import trimesh
from jaxtyping import Bool, Float
from scipy import spatial

from mjx_nero.urdf.tree import Matrix, Points, Pose, Shape, Values, Vec

SAMPLES = 3000
GRID = 9  # points along an edge of a box, for measuring its distance from another
OUTSIDE = 0.02  # share of the surface that may stick out, so that no bolt's head thickens the whole shape
CONTACTS = {"sphere": 1, "capsule": 2, "box": 4}  # contacts with a plane
_PENALTY = {"sphere": 1.0, "capsule": 1.0, "box": 1.3}  # at similar volume, prefer fewer contacts


@dataclasses.dataclass(frozen=True)
class Primitive:
    """A collision shape.

    Attributes:
        kind: ``sphere``, ``capsule`` or ``box``.
        size: MJCF's size: (radius,), (radius, half length of the cylinder along z) or half extents [m].
        pose: pose in the link [4, 4].
        covered: share of the mesh's surface inside it.
        fill: volume of the mesh's convex hull divided by the shape's.
    """

    kind: str
    size: tuple[float, ...]
    pose: Pose
    covered: float = 1.0
    fill: float = 1.0

    @property
    def volume(self) -> float:
        """Volume [m3]."""
        if self.kind == "box":
            return 8 * math.prod(self.size)
        r, half = self.size[0], self.size[1] if self.kind == "capsule" else 0.0
        return math.pi * r * r * (4 / 3 * r + 2 * half)

    @property
    def radius(self) -> float:
        """Radius of the bounding ball about its centre [m]."""
        return math.hypot(*self.size) if self.kind == "box" else sum(self.size)

    def contains(self, points: Points) -> Bool[np.ndarray, " n"]:
        """True for each of the points [n, 3] inside or on it."""
        p = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        if self.kind == "box":
            return (np.abs(p) <= np.array(self.size) + 1e-9).all(1)
        half = self.size[1] if self.kind == "capsule" else 0.0
        p[:, 2] -= np.clip(p[:, 2], -half, half)
        return np.linalg.norm(p, axis=1) <= self.size[0] + 1e-9

    def lowest(self, heights: Float[np.ndarray, "n 4"]) -> Values:
        """Height [n] of its lowest point, given the third rows of the link's poses [n, 4]."""
        at = heights @ self.pose
        if self.kind == "box":
            return at[:, 3] - np.abs(at[:, :3]) @ np.array(self.size)
        half = self.size[1] if self.kind == "capsule" else 0.0
        return at[:, 3] - np.abs(at[:, 2]) * half - self.size[0]


def sample(mesh: trimesh.Trimesh, count: int = SAMPLES) -> Points:
    """Samples points [count, 3] evenly over the surface; always the same ones for the same mesh."""
    rng = np.random.default_rng(0)
    triangles = np.asarray(mesh.triangles, float)
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    if not areas.sum() > 0:
        return np.resize(mesh.vertices, (count, 3))
    corner, *edges = np.moveaxis(triangles[rng.choice(len(areas), count, p=areas / areas.sum())], 1, 0)
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return corner + u * (edges[0] - corner) + v * (edges[1] - corner)


def best(points: Points, volume: float, boxes: bool = True) -> Primitive:
    """Fits the smallest of sphere, capsules and boxes along the link's and the points' principal axes.

    Args:
        points: points on the surface [n, 3]; all but the share ``OUTSIDE`` end up inside.
        volume: volume of their convex hull [m3].
        boxes: allow boxes, which cost the most contacts.
    """
    frames = [np.eye(3), _principal(points)]
    turned = [frame[:, [(k + 1) % 3, (k + 2) % 3, k]] for frame in frames for k in range(3)]
    options = [_sphere(points), *(box(points, f) for f in frames if boxes), *(_capsule(points, f) for f in turned)]
    found = min(options, key=lambda p: p.volume * _PENALTY[p.kind])
    return measured(found, points, volume)


def measured(shape: Primitive, points: Points, volume: float) -> Primitive:
    """Adds to ``shape`` its coverage of the points and of the volume that they enclose."""
    covered = float(shape.contains(points).mean())
    return dataclasses.replace(shape, covered=round(covered, 4), fill=round(volume / shape.volume, 4))


def box(points: Points, frame: Matrix, outside: float = OUTSIDE) -> Primitive:
    """Fits a box along the columns of ``frame`` [3, 3] that leaves the share ``outside`` of the points out."""
    p = points @ frame
    lower, upper = np.quantile(p, [outside / 6, 1 - outside / 6], axis=0)
    half = np.maximum((upper - lower) / 2, 5e-4)
    return Primitive("box", tuple(half.tolist()), pose(frame, frame @ (lower + upper) / 2))


def pose(turn: Matrix, at: Vec) -> Pose:
    """Builds the pose [4, 4] with columns ``turn`` [3, 3] at ``at`` [3]."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = turn, at
    return out


def distance(a: Primitive, b: Primitive) -> float:
    """Distance between two boxes [m], 0 if they overlap, measured from a grid of points on each one's faces."""
    away = []
    for one, other in ((a, b), (b, a)):
        points = _grid() * np.array(one.size) @ one.pose[:3, :3].T + one.pose[:3, 3]
        local = (points - other.pose[:3, 3]) @ other.pose[:3, :3]
        away.append(np.linalg.norm(np.maximum(np.abs(local) - np.array(other.size), 0.0), axis=1).min())
    return float(min(away))


@functools.lru_cache(maxsize=1)
def _grid() -> Points:
    """Points on the faces of the box from -1 to 1 [n, 3]."""
    line = np.linspace(-1, 1, GRID)
    points = np.array(list(itertools.product(line, line, line)))
    return points[(np.abs(points) == 1).any(1)]


def hull(points: Points) -> float:
    """Volume of the convex hull [m3]; 0 if flat."""
    try:
        return float(spatial.ConvexHull(points).volume)
    except spatial.QhullError:
        return 0.0


def _sphere(points: Points) -> Primitive:
    centre = (points.min(0) + points.max(0)) / 2
    radius = max(float(np.quantile(np.linalg.norm(points - centre, axis=1), 1 - OUTSIDE)), 5e-4)
    return Primitive("sphere", (radius,), pose(np.eye(3), centre))


def _capsule(points: Points, frame: Matrix) -> Primitive:
    """Fits a capsule along the last column of ``frame``."""
    p = points @ frame
    centre = (p.min(0) + p.max(0)) / 2
    p -= centre
    across = np.linalg.norm(p[:, :2], axis=1)
    radius = max(float(np.quantile(across, 1 - OUTSIDE / 2)), 5e-4)
    reach = np.abs(p[:, 2]) - np.sqrt(np.maximum(radius**2 - across**2, 0))
    half = max(float(np.quantile(reach, 1 - OUTSIDE / 2)), 5e-4)
    return Primitive("capsule", (radius, half), pose(frame, frame @ centre))


def _principal(points: Points) -> Matrix:
    axes = np.linalg.eigh(np.cov(points.T))[1]
    return axes * np.sign(np.linalg.det(axes))


def exact(shape: Shape) -> Primitive | None:
    """Converts a URDF's box, sphere or capsule; None for other shapes."""
    if shape.kind == "box":
        return Primitive("box", tuple(s / 2 for s in shape.size), shape.origin)
    if shape.kind == "capsule":
        return Primitive("capsule", (shape.size[0], shape.size[1] / 2), shape.origin)
    return Primitive("sphere", shape.size, shape.origin) if shape.kind == "sphere" else None
