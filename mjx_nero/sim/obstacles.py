"""A scene's obstacles as model fields that differ between worlds."""

from collections.abc import Iterable, Mapping

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from mjx_nero.types import ObstacleView, UserError

FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_rbound")


class Obstacles:
    """Converts the obstacles of one world between views and model fields.

    Args:
        model: compiled scene.
        names: names of its obstacles.
    """

    def __init__(self, model: mujoco.MjModel, names: Iterable[str]):
        self._rows = {name: int(model.geom(name).id) for name in names}
        self._nominal = {name: np.array(getattr(model, name), np.float32) for name in FIELDS}

    def placed(self, fields: Mapping[str, Array], boxes: Mapping[str, ObstacleView]) -> dict[str, Array]:
        """Returns ``fields`` with the named boxes moved.

        Raises:
            UserError: the scene lacks an obstacle of that name.
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
        """Returns the boxes by name."""
        pos, quat, half = (jnp.asarray(fields.get(name, self._nominal[name])) for name in FIELDS[:3])
        return {name: ObstacleView(pos[row], quat[row], 2 * half[row]) for name, row in self._rows.items()}
