"""The config of a free object."""

import dataclasses
from typing import Annotated

import mujoco
import numpy as np

from mjx_nero.config.bounds import Density, Edge, Mass, NonNegative, OneOf, Point, Positive
from mjx_nero.sim import quats, solids

# Shape -> MuJoCo's type, and what ``ObjectCfg.size`` says of it.
SHAPES = {
    "box": (mujoco.mjtGeom.mjGEOM_BOX, "its three edges"),
    "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, "its radius"),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, "its radius and the length between the centres of its ends"),
    "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, "its radius and its length"),
    "can": (mujoco.mjtGeom.mjGEOM_CYLINDER, "its radius and its length"),
}


@dataclasses.dataclass(frozen=True)
class ObjectCfg:
    """A free body.

    Attributes:
        shape: ``box``, ``sphere``, ``capsule``, ``cylinder`` or ``can``; the last three stand along z. A can meets the table as a
            cylinder and everything else as the capsule inside it: a flat pad touches a cylinder's side at a single point that
            jumps about, and MJX-JAX finds no contact there.
        size: edges of a box; radius of a sphere; radius and length of a cylinder, or of a capsule without its ends [m].
        mass: mass [kg]; a mesh gets its mass from ``density``.
        friction: sliding [1], spinning and rolling [m].
        condim: contact dimension: 3 slides, 4 also spins, 6 also rolls. Of two geoms, the larger one counts.
        pos: place before the reset events: x, y, and height above the table [m].
        quat: orientation before the reset events, wxyz.
        rgba: colour.
        file: for a ``mesh``: an OBJ, STL or GLB file, a folder with an ``object.yaml``, or one of the package's objects by name.
            The mesh is cut into convex parts; its origin is its centre of mass.
        bank: further mesh files; in each episode the object has one of all these shapes (``sim.meshes.bank``).
        scale: factor of a mesh's lengths.
        density: density of a mesh, which gives its mass [kg/m3]; 0: the density in its ``object.yaml``, or else 500.
    """

    shape: Annotated[str, OneOf(*SHAPES, "mesh")] = "box"
    size: tuple[Edge, ...] = (0.03, 0.03, 0.03)
    mass: Mass = 0.03
    friction: tuple[NonNegative, NonNegative, NonNegative] = (1.0, 0.005, 0.0001)
    condim: Annotated[int, OneOf(1, 3, 4, 6)] = 3
    pos: Point = (0.35, 0.0, 0.0)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rgba: tuple[float, float, float, float] = (0.85, 0.3, 0.2, 1.0)
    file: str = ""
    bank: tuple[str, ...] = ()
    scale: Positive = 1.0
    density: Density = 0.0

    @property
    def solids(self) -> list[solids.Solid]:
        """The shapes of a mesh, at its scale."""
        return [solids.find(file).scaled(self.scale) for file in (self.file, *self.bank)]

    @property
    def masses(self) -> list[float]:
        """The masses of the shapes of a mesh [kg]."""
        return [(self.density or solid.density) * solid.volume for solid in self.solids]

    @property
    def rest_height(self) -> float:
        """Height of its centre when it rests on the table [m]."""
        if self.shape == "mesh":
            return self.solids[0].height(np.array(self.quat))
        up, (first, *rest) = quats.matrix(self.quat)[2], self.size
        if self.shape == "box":
            return float(np.abs(up) @ np.asarray(self.size) / 2)
        if self.shape in ("cylinder", "can"):
            return float(abs(up[2]) * rest[0] / 2 + np.sqrt(1 - min(1.0, up[2] ** 2)) * first)
        return float(first + (abs(up[2]) * rest[0] / 2 if rest else 0.0))


def cube(edge: float, mass: float) -> ObjectCfg:
    """A cube [m, kg]."""
    return ObjectCfg(size=(edge,) * 3, mass=mass)


def side(name: str) -> str:
    """Name of the geom that forms the side of can ``name``."""
    return f"{name}_side"


def as_geom(item: ObjectCfg) -> tuple[mujoco.mjtGeom, list[float]]:
    """MuJoCo's geom type and size of an object."""
    half = [item.size[0], *(x / 2 for x in item.size[1:])] if item.shape != "box" else [x / 2 for x in item.size]
    return SHAPES[item.shape][0], half + [0.0] * (3 - len(half))
