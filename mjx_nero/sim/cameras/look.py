"""Fields of the drawn model that differ from episode to episode, as ``mdp.looks`` draws them."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.mdp.curriculum import toward
from mjx_nero.sim.cameras.cfg import MARK
from mjx_nero.sim.fields import Draws, Terms, nominal
from mjx_nero.types import Key, Scenery

# All drawers read them for every picture.
DRAWABLE = "cam_pos cam_quat cam_fovy light_dir light_diffuse geom_rgba geom_pos geom_quat geom_size geom_matid mat_rgba".split()


class Look:
    """Draws the look of one world's episode.

    Args:
        model: the scene with visual shapes.
        terms: by name, each ``(key, model) -> {field: (rows, values)}``.

    Attributes:
        names: names of the fields that differ.

    Raises:
        UserError: a term names something that the model lacks, or draws a field that cannot differ.
    """

    def __init__(self, model: mujoco.MjModel, terms: Terms):
        self._count = len(terms)
        cameras = [model.camera(i).name for i in range(model.ncam)]
        index = {
            "material": {model.mat(i).name: i for i in range(model.nmat)},
            "robot": {str(i): int(i) for i in np.flatnonzero(model.geom_matid >= 0)},  # nothing else has a material of its own
            "camera": {name.removeprefix(MARK): i for i, name in enumerate(cameras) if name.startswith(MARK)},
            "geom": {model.geom(i).name: i for i in range(model.ngeom) if model.geom(i).name},
        }
        self._draws = Draws("look", terms, nominal(model, DRAWABLE), index)
        self.names = tuple(self._draws.rows)

    def __call__(self, key: Key, level: Float[Array, ""] | None = None) -> dict[str, Array]:
        """Draws the fields; empty without terms. ``level``: see ``types.LEVEL``."""
        drawn = self._draws((jax.random.fold_in(key, i) for i in range(self._count)), {})
        return {name: toward(level, jnp.asarray(self._draws.nominal[name]), values) for name, values in drawn.items()}


def rows(model: mujoco.MjModel, scenery: Scenery) -> Iterator[tuple[str, int, Any]]:
    """Yields the looks of a scenery's objects and obstacles as fields of the drawn model: name, row and value."""
    for name, look in scenery.objects.items():
        row = int(model.geom(name).id)
        yield from (("geom_size", row, look.size), ("geom_rgba", row, look.rgba))
    for name, box in scenery.obstacles.items():
        row = int(model.geom(name).id)
        yield from (("geom_pos", row, box.pos_w), ("geom_quat", row, box.quat_w), ("geom_size", row, box.size / 2))
