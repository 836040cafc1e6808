"""Makes the package's objects from convex parts: python assets/objects/make.py

Every object is a list of convex parts, each the hull of a few points in metres, z up. NAME/parts.obj has the parts, for contacts;
NAME/NAME.obj is their union, for drawing and mass; NAME/object.yaml names both files and gives the density.
"""

import math
import pathlib
from collections.abc import Callable

import numpy as np
import trimesh
import yaml
from scipy.spatial.transform import Rotation

HERE = pathlib.Path(__file__).resolve().parent
Points = np.ndarray  # [n, 3]


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0), turn: float = 0.0) -> Points:
    """A box with its middle ``at``, turned about the vertical."""
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(size) / 2
    return Rotation.from_euler("z", turn).apply(corners) + at


def frustum(low: float, high: float, bottom: float, top: float, sides: int = 16) -> Points:
    """A cone's slice about z, from height ``bottom`` with radius ``low`` to height ``top`` with radius ``high``."""
    angles = 2 * math.pi * (np.arange(sides) + 0.5) / sides
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(sides)], axis=1)
    return np.concatenate([low * ring + [0, 0, bottom], high * ring + [0, 0, top]])


def wall(inner: tuple[float, float], outer: tuple[float, float], bottom: float, top: float, sides: int) -> list[Points]:
    """A hollow slice of a cone, as a ring of convex pieces. Radii are at the bottom and at the top."""
    pieces = []
    for i in range(sides):
        ends = 2 * math.pi * np.array([i, i + 1]) / sides
        ring = np.stack([np.cos(ends), np.sin(ends)], axis=1)
        pieces.append(
            np.array(
                [
                    (*(radius * corner), height)
                    for (low, high) in (inner, outer)
                    for radius, height in ((low, bottom), (high, top))
                    for corner in ring
                ]
            )
        )
    return pieces


def along_x(points: Points, at: float = 0.0) -> Points:
    """Lays points that stand along z down along x, with their foot at ``at``."""
    return points[:, [2, 1, 0]] * [1, 1, -1] + [at, 0, 0]


def mug() -> list[Points]:
    handle = [box((0.022, 0.01, 0.01), (0.039, 0, 0.062)), box((0.022, 0.01, 0.01), (0.039, 0, 0.022))]
    handle += [box((0.01, 0.01, 0.05), (0.053, 0, 0.042))]
    return [frustum(0.03, 0.03, 0.0, 0.006, 8), *_octagon((0.026, 0.026), (0.031, 0.031), 0.004, 0.08), *handle]


def _octagon(inner: tuple[float, float], outer: tuple[float, float], bottom: float, top: float) -> list[Points]:
    return wall(inner, outer, bottom, top, 8)


def bottle() -> list[Points]:
    return [frustum(0.027, 0.027, 0.0, 0.1), frustum(0.027, 0.012, 0.1, 0.125), frustum(0.013, 0.013, 0.12, 0.15)]


def bowl() -> list[Points]:
    return [frustum(0.03, 0.032, 0.0, 0.008, 8), *_octagon((0.026, 0.038), (0.032, 0.044), 0.004, 0.045)]


def hammer() -> list[Points]:
    head = [box((0.028, 0.08, 0.026), (0.1, 0, 0)), box((0.032, 0.014, 0.03), (0.1, 0.042, 0))]
    return [box((0.2, 0.024, 0.02), (0, 0, 0)), *head]


def screwdriver() -> list[Points]:
    return [along_x(frustum(0.014, 0.016, 0.0, 0.095, 8), -0.09), along_x(frustum(0.005, 0.004, 0.0, 0.09, 8), 0.0)]


def l_bracket() -> list[Points]:
    return [box((0.07, 0.03, 0.012), (0.0, 0, 0.006)), box((0.012, 0.03, 0.06), (-0.029, 0, 0.03))]


def ring() -> list[Points]:
    return wall((0.02, 0.02), (0.035, 0.035), 0.0, 0.018, 10)


def spoon() -> list[Points]:
    angles = 2 * math.pi * np.arange(12) / 12
    rim = np.stack([0.036 * np.cos(angles), 0.024 * np.sin(angles), np.zeros(12)], axis=1)
    blade = np.concatenate([rim + [0, 0, 0.006], 0.8 * rim - [0, 0, 0.006]]) + [0.1, 0, 0]
    return [box((0.15, 0.014, 0.016)), blade]


def wrench() -> list[Points]:
    jaws = [box((0.034, 0.014, 0.018), (0.09, s * 0.018, 0), s * 0.25) for s in (-1, 1)]
    return [
        box((0.14, 0.02, 0.018)),
        box((0.024, 0.046, 0.018), (0.074, 0, 0)),
        *jaws,
        frustum(0.021, 0.021, -0.009, 0.009, 12) - [0.075, 0, 0],
    ]


def dumbbell() -> list[Points]:
    ends = [along_x(frustum(0.028, 0.028, 0.0, 0.03, 6), at) for at in (-0.065, 0.035)]
    return [along_x(frustum(0.013, 0.013, 0.0, 0.09, 8), -0.045), *ends]


def wedge() -> list[Points]:
    profile = np.array([(-0.05, 0.0), (0.05, 0.0), (0.05, 0.04), (0.042, 0.04), (-0.05, 0.014)])
    return [np.array([(x, y, z) for x, z in profile for y in (-0.018, 0.018)])]


def jack() -> list[Points]:
    return [box(tuple(0.075 if i == axis else 0.022 for i in range(3))) for axis in range(3)]


# What an object is made of: parts, density [kg/m3] and colour.
OBJECTS: dict[str, tuple[Callable[[], list[Points]], float, tuple[float, float, float]]] = {
    "mug": (mug, 1500.0, (0.86, 0.42, 0.3)),
    "bottle": (bottle, 400.0, (0.3, 0.55, 0.75)),
    "bowl": (bowl, 1500.0, (0.9, 0.8, 0.6)),
    "hammer": (hammer, 800.0, (0.55, 0.4, 0.28)),
    "screwdriver": (screwdriver, 1000.0, (0.85, 0.65, 0.15)),
    "l_bracket": (l_bracket, 2000.0, (0.55, 0.58, 0.62)),
    "ring": (ring, 1200.0, (0.75, 0.3, 0.55)),
    "spoon": (spoon, 800.0, (0.72, 0.55, 0.35)),
    "wrench": (wrench, 1500.0, (0.5, 0.55, 0.6)),
    "dumbbell": (dumbbell, 1000.0, (0.35, 0.38, 0.5)),
    "wedge": (wedge, 1000.0, (0.45, 0.65, 0.4)),
    "jack": (jack, 1200.0, (0.6, 0.35, 0.7)),
}


def main() -> None:
    """Writes every object into a folder named after it."""
    for name, (make, density, colour) in OBJECTS.items():
        parts = [trimesh.PointCloud(points).convex_hull for points in make()]
        whole = trimesh.boolean.union(parts, engine="manifold") if len(parts) > 1 else parts[0]
        if not whole.is_volume:
            raise SystemExit(f"the union of {name}'s parts is not closed")
        folder = HERE / name
        folder.mkdir(exist_ok=True)
        (folder / f"{name}.obj").write_text(_obj([whole]))
        (folder / "parts.obj").write_text(_obj(parts))
        about = {"mesh": f"{name}.obj", "parts": "parts.obj", "density": density, "rgba": [*colour, 1.0]}
        (folder / "object.yaml").write_text(yaml.safe_dump(about, sort_keys=False))
        about_it = f"{len(parts)} parts, {len(whole.faces)} triangles, {1e6 * whole.volume:.1f} cm3"
        print(f"{name}: {about_it}, {density * whole.volume:.3f} kg")


def _obj(meshes: list[trimesh.Trimesh]) -> str:
    """Wavefront OBJ, each mesh a named object."""
    lines, first = [], 1
    for i, mesh in enumerate(meshes):
        lines += [f"o {i}", *("v " + " ".join(f"{x:.8f}" for x in v) for v in mesh.vertices)]
        lines += ["f " + " ".join(str(k + first) for k in face) for face in mesh.faces]
        first += len(mesh.vertices)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
