"""Obstacles: fixed boxes in a scene, whose places differ from world to world."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array

from mjx_nero.config.bounds import Length, Point
from mjx_nero.sim import touch
from mjx_nero.sim.parts import Fields, Part
from mjx_nero.types import Carry, Key, ObstacleView, Sim, UserError, View

FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_rbound")
_APART = 0x0B57AC  # folded into the episode's key, so that the draws of other parts stay the same
_ANYWHERE = 10.0  # [m] half the edge of an obstacle's bounding box: an obstacle may stand anywhere


@dataclasses.dataclass(frozen=True)
class ObstacleCfg:
    """A fixed box that stops robot and objects. It stays below the table unless a task draws its place (``EnvCfg.obstacles``).

    Attributes:
        size: edges [m].
        pos: centre in the world [m].
        quat: orientation, wxyz.
        rgba: colour.
    """

    size: tuple[Length, Length, Length] = (0.05, 0.05, 0.05)
    pos: Point = (0.0, 0.0, -0.5)
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    rgba: tuple[float, float, float, float] = (0.32, 0.38, 0.5, 1.0)


def add(spec: mujoco.MjSpec, bases: Iterable[str], obstacles: Mapping[str, ObstacleCfg], objects: Iterable[str]) -> None:
    """Adds obstacles to a scene, lets robots and objects collide with them, and adds sensors for their contacts.

    Args:
        spec: robots and objects.
        bases: the robots' base links.
        objects: names of objects; body and geom share a name.

    Raises:
        UserError: a name is taken, or a shape cannot collide with a box on every backend.
    """
    if not obstacles:
        return
    shapes = [shape for base in bases for shape in touch.collision_shapes(spec, base)]
    for geom in (*shapes, *(spec.geom(name) for name in objects)):
        if geom.type not in touch.MEETS_BOX:
            kind = mujoco.mjtGeom(geom.type).name.removeprefix("mjGEOM_").lower()
            raise UserError(
                f"scene.obstacles cannot meet {geom.name or geom.parent.name!r}, a {kind}: only spheres, capsules, boxes and "
                "meshes meet boxes on every backend"
            )
        geom.conaffinity |= touch.OBSTACLE
    # On a movable body: MuJoCo Warp assumes that bodies fixed to the world never move.
    body = spec.worldbody.add_body(name="obstacles", mocap=True)
    for name, item in obstacles.items():
        if spec.geom(name):
            raise UserError(f"scene.obstacles.{name} needs another name: the robot or the scene already uses it")
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in item.size],
            pos=item.pos,
            quat=item.quat,
            contype=touch.OBSTACLE,
            conaffinity=0,
            mass=0,
            rgba=item.rgba,
        )
        touch.add_sensor(spec, name)


def unbounded(model: mujoco.MjModel) -> mujoco.MjModel:
    """Widens the bounds of obstacles, which MuJoCo derives from their first poses, so that they hold anywhere."""
    for geom in np.flatnonzero(model.geom_contype & touch.OBSTACLE):
        body = model.geom_bodyid[geom]
        model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.geom_aabb[geom, 3:] = _ANYWHERE
        model.bvh_aabb[model.body_bvhadr[body] : model.body_bvhadr[body] + model.body_bvhnum[body], 3:] = _ANYWHERE
    return model


class Obstacles(Part):
    """The obstacles of a scene.

    Args:
        model: compiled scene.
        names: names of its obstacles.
        place: draws boxes by name from a key and a view (``EnvCfg.obstacles``); None: they stay.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        names: Iterable[str],
        place: Callable[[Key, View], Mapping[str, ObstacleView]] | None = None,
    ):
        self._rows = {name: int(model.geom(name).id) for name in names}
        self._nominal = {name: np.array(getattr(model, name), np.float32) for name in FIELDS}
        self._place = place
        self.fields = FIELDS if place else ()
        self.seen = FIELDS[:3] if self._rows else ()

    def late(self, key: Key, see: Callable[[], View], fields: Fields) -> Fields:
        """Places the boxes. Raises the errors of ``placed``."""
        return self.placed(fields, self._place(jax.random.fold_in(key, _APART), see())) if self._place else fields

    def placed(self, fields: Mapping[str, Array], boxes: Mapping[str, ObstacleView]) -> Fields:
        """Returns ``fields`` with the named boxes moved.

        Raises:
            UserError: the scene lacks an obstacle of that name.
        """
        if unknown := [name for name in boxes if name not in self._rows]:
            there = ", ".join(self._rows) or "none"
            raise UserError(f"obstacles draws {', '.join(unknown)}, but the scene's obstacles are: {there}")
        now = {name: jnp.asarray(fields.get(name, self._nominal[name])) for name in FIELDS}
        for name, box in boxes.items():
            half = box.size / 2
            values = (box.pos_w, box.quat_w, half, jnp.sqrt(jnp.sum(half**2)))
            now = {f: now[f].at[self._rows[name]].set(v) for f, v in zip(FIELDS, values, strict=True)}
        return {**fields, **now}

    def view(self, sim: Sim, carry: Carry) -> dict[str, dict[str, ObstacleView]]:
        """Returns ``obstacles`` of a view."""
        pos, quat, half = (jnp.asarray(sim.fields.get(name, self._nominal[name])) for name in FIELDS[:3])
        return {"obstacles": {name: ObstacleView(pos[row], quat[row], 2 * half[row]) for name, row in self._rows.items()}}

    def scenery(self, sim: Sim, carry: Carry, look: Fields) -> dict[str, dict[str, ObstacleView]]:
        """Returns ``obstacles`` of a scenery."""
        return self.view(sim, carry)
