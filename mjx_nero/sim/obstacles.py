"""Where a scene's obstacles stand, as model fields that differ from world to world."""

from collections.abc import Iterable, Mapping

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from mjx_nero.types import ObstacleView, UserError

FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_rbound")


class Obstacles:
    """The boxes of one world: from views to fields, and back.

    Args:
        model: compiled scene.
        names: of its obstacles.
    """

    def __init__(self, model: mujoco.MjModel, names: Iterable[str]):
        self._rows = {name: int(model.geom(name).id) for name in names}
        self._nominal = {name: np.array(getattr(model, name), np.float32) for name in FIELDS}

    def placed(self, fields: Mapping[str, Array], boxes: Mapping[str, ObstacleView]) -> dict[str, Array]:
        """``fields`` with these boxes in their places; those that are not named stay in theirs.

        Raises:
            UserError: the scene has no obstacle of a name.
        """
        if unknown := [name for name in boxes if name not in self._rows]:
            there = ", ".join(self._rows) or "none"
            raise UserError(f"obstacles draws {', '.join(unknown)}, and the scene's obstacles are: {there}")
        now = {name: jnp.asarray(fields.get(name, self._nominal[name])) for name in FIELDS}
        for name, box in boxes.items():
            half = box.size / 2
            values = (box.pos_w, box.quat_w, half, jnp.sqrt(jnp.sum(half**2)))
            now = {f: now[f].at[self._rows[name]].set(v) for f, v in zip(FIELDS, values, strict=True)}
        return {**fields, **now}

    def views(self, fields: Mapping[str, Array]) -> dict[str, ObstacleView]:
        """The boxes by name."""
        pos, quat, half = (jnp.asarray(fields.get(name, self._nominal[name])) for name in FIELDS[:3])
        return {name: ObstacleView(pos[row], quat[row], 2 * half[row]) for name, row in self._rows.items()}
