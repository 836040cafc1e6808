"""A mesh object: its convex parts, mass properties and resting poses for the physics, and the mesh to draw."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from mjx_nero.sim.solids import rests

MAX_PARTS, MAX_CORNERS = 16, 48  # parts of an object; corners of a part
DENSITY = 500.0  # [kg/m3] if none is given


@dataclasses.dataclass(frozen=True)
class Solid:
    """A solid of density 1, with its origin at the centre of mass and the file's axes.

    Attributes:
        points: corners of all convex parts, one part after another.
        sizes: how many corners each part has.
        hull: corners of the convex hull of all parts.
        volume, inertia: volume [m3], and inertia about the centre of mass [m5].
        center: the centre of mass in the file's frame [m].
        rest_quat, rest_share: orientations (wxyz) in which it rests on a table, and the share of throws that end in each.
        vertices, faces, uv, texture, rgba: what is drawn (``reading.Raw``).
        density: density [kg/m3].
        note: what was lost in the making, for the user.
    """

    points: Float[np.ndarray, "n 3"]
    sizes: Int[np.ndarray, " parts"]
    hull: Float[np.ndarray, "h 3"]
    volume: float
    inertia: Float[np.ndarray, "3 3"]
    center: Float[np.ndarray, "3"]
    rest_quat: Float[np.ndarray, "rests 4"]
    rest_share: Float[np.ndarray, " rests"]
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "v2 2"]
    texture: UInt8[np.ndarray, "height width 3"]
    rgba: tuple[float, float, float, float]
    density: float = DENSITY
    note: str = ""

    @property
    def parts(self) -> list[Float[np.ndarray, "k 3"]]:
        """Corners of each convex part [m]."""
        return np.split(self.points, np.cumsum(self.sizes)[:-1])

    @classmethod
    def of(cls, arrays: Mapping[str, np.ndarray]) -> "Solid":
        """Makes a solid of its ``arrays``."""
        volume, density, rgba = (arrays[name].tolist() for name in ("volume", "density", "rgba"))
        plain: dict[str, Any] = {"volume": volume, "density": density, "rgba": tuple(rgba)}
        return cls(**{**arrays, **plain, "note": arrays["note"].tobytes().decode()})

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns all fields as arrays, to be kept in a file."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {**fields, "note": np.frombuffer(self.note.encode(), np.uint8)}

    def scaled(self, by: float) -> "Solid":
        """The same thing ``by`` times as large."""
        if by == 1.0:
            return self
        lengths = {name: getattr(self, name) * by for name in ("points", "hull", "vertices", "center")}
        return dataclasses.replace(self, volume=self.volume * by**3, inertia=self.inertia * by**5, **lengths)

    def height(self, quat: Float[np.ndarray, "4"]) -> float:
        """Height of the centre of mass above a table on which it lies with this orientation [m]."""
        return float(-(self.hull @ rests.up(quat)).min())
