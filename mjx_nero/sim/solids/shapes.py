"""Describes the shape of a thing to terms and policies: by how far it reaches in evenly spread directions, and its moments."""

import numpy as np
from jaxtyping import Float

from mjx_nero.sim.solids.solid import Solid

DIRECTIONS = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z], float)
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
CODED = (DIRECTIONS != 0).sum(1) != 2  # towards the sides and the corners of a cube, not to the middles of its edges


def points(solid: Solid) -> Float[np.ndarray, "26 3"]:
    """The corners that reach farthest in 26 directions [m]."""
    return solid.hull[np.argmax(solid.hull @ DIRECTIONS.T, axis=0)]


def box(solid: Solid) -> Float[np.ndarray, "2 3"]:
    """Middle and edges of the solid's bounding box, along its axes [m]."""
    low, high = solid.points.min(0), solid.points.max(0)
    return np.stack([(low + high) / 2, high - low])


def code(solid: Solid) -> Float[np.ndarray, "17"]:
    """Returns the solid's reach in 14 directions, and its three radii of gyration, the least first [m]."""
    reach = (solid.hull @ DIRECTIONS[CODED].T).max(0)
    return np.concatenate([reach, np.sqrt(np.linalg.eigvalsh(solid.inertia) / solid.volume)])
