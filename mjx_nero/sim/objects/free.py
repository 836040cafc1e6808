"""Free objects of a scene: their bodies in the model, and their state in one world."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.config import bounds
from mjx_nero.sim.meshes import body as mesh_body
from mjx_nero.sim.objects.cfg import SHAPES, ObjectCfg, as_geom, side
from mjx_nero.sim.parts import Fields, Part
from mjx_nero.types import LOOK, SHAPE, TARGET, Appearance, Carry, ObjectView, ShapeView, Sim, Start, UserError, View

# Contact bits: objects meet the table by bit 1, robots by bit 2, and one another by bit 4. Robot geoms have no type, so they
# never meet one another.
TABLE, _OBJECT, _OBJECTS = 1, 2, 4
_APPEARANCE = ("geom_size", "geom_rgba")  # as ``types.Appearance`` has them
COMMANDED = (0.2, 0.8, 0.3, 1.0)  # colour of the goal, and of the object that belongs there where there are several


def add(spec: mujoco.MjSpec, objects: Mapping[str, ObjectCfg], visuals: bool) -> None:
    """Adds objects to a scene. Body, joint and geom carry an object's name.

    Args:
        visuals: also add what is only drawn.

    Raises:
        UserError: a shape, size or name is not possible.
    """
    for name, item in objects.items():
        _add(spec, name, item, visuals)


def _add(spec: mujoco.MjSpec, name: str, item: ObjectCfg, visuals: bool) -> None:
    bounds.check(item, name=f"scene.objects.{name}")
    if item.shape == "mesh":
        return _add_mesh(spec, name, item, visuals)
    says = SHAPES[item.shape][1]
    count = {"box": 3, "sphere": 1}.get(item.shape, 2)
    if len(item.size) != count:
        raise UserError(f"scene.objects.{name}.size of a {item.shape} is {says}, got {item.size}")
    if item.shape == "can" and item.size[1] <= 2 * item.size[0]:
        raise UserError(f"scene.objects.{name}.size of a can is its radius and more than twice that as length, got {item.size}")
    shape, extent = as_geom(item)
    body = _add_body(spec, name, item)
    body.add_geom(
        name=name,
        type=shape,
        size=extent,
        mass=item.mass,
        friction=item.friction,
        condim=item.condim,
        contype=0 if item.shape == "can" else _OBJECT | _OBJECTS,
        conaffinity=TABLE if item.shape == "can" else TABLE | _OBJECTS,
        rgba=item.rgba,
    )
    if item.shape == "can":
        radius, length = item.size
        body.add_geom(
            name=side(name),
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=[radius, length / 2 - radius, 0.0],
            mass=0.0,
            friction=item.friction,
            condim=item.condim,
            contype=_OBJECT | _OBJECTS,
            conaffinity=_OBJECTS,
            group=3,
        )


def _add_body(spec: mujoco.MjSpec, name: str, item: ObjectCfg):
    if name == "goal" or spec.body(name) or spec.joint(name) or spec.geom(name):
        raise UserError(f"scene.objects.{name} needs another name: the robot or the scene already uses it")
    x, y, above = item.pos
    body = spec.worldbody.add_body(name=name, pos=[x, y, item.rest_height + above], quat=item.quat)
    body.add_freejoint(name=name)
    return body


def _add_mesh(spec: mujoco.MjSpec, name: str, item: ObjectCfg, visuals: bool) -> None:
    mesh_body.checked(name, item.solids, item.scale)
    slides = {"friction": item.friction, "condim": item.condim}
    table = {**slides, "contype": 0, "conaffinity": TABLE}
    others = {**slides, "contype": _OBJECT | _OBJECTS, "conaffinity": _OBJECTS}
    mesh_body.add(spec, name, item.solids, item.masses, _add_body(spec, name, item), table, others, visuals)
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)  # several contacts where flat sides meet


class Objects(Part):
    """The free objects of a scene.

    Args:
        model: the compiled scene.
        objects: their configs by name.
        targets: objects of which an episode commands one.
        drawn: makes the scene's model for pictures.
        varied: names of the model's fields that randomization draws.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        objects: Mapping[str, ObjectCfg],
        targets: tuple[str, ...] = (),
        drawn: Callable[[], mujoco.MjModel] | None = None,
        varied: Callable[[], Iterable[str]] = tuple,
    ):
        self._model, self._cfg, self._targets, self._drawn, self._varied = model, objects, targets, drawn, varied
        self._at = {name: int(model.joint(name).qposadr[0]) for name in objects}
        self._dofs = {name: int(model.joint(name).dofadr[0]) for name in objects}
        self._qpos0 = np.array(model.qpos0, np.float32)
        self._shapes = {name: mesh_body.shapes_of(item.solids) for name, item in objects.items() if item.shape == "mesh"}

    @property
    def seen(self) -> tuple[str, ...]:  # type: ignore[override]
        """Sizes and colours, where they differ."""
        return _APPEARANCE if self._differ else ()

    def blank(self) -> dict[str, Any]:
        """Returns their places in the scene."""
        poses = {name: self._qpos0[at : at + 7] for name, at in self._at.items()}
        return {
            "object_pos_w": {name: jnp.asarray(pose[:3]) for name, pose in poses.items()},
            "object_quat_w": {name: jnp.asarray(pose[3:]) for name, pose in poses.items()},
        }

    def start(self, view: View, carry: Carry) -> dict[str, Any]:
        """Returns their places, and which is commanded."""
        seen = {name: view.objects[name] for name in self._at}
        return {
            "object_pos_w": {name: each.pos_w for name, each in seen.items()},
            "object_quat_w": {name: each.quat_w for name, each in seen.items()},
            "target": jnp.zeros((), jnp.int32) if view.target is None else view.target,
        }

    def qpos(self, qpos: Float[Array, " nq"], start: Start, fields: Fields) -> Float[Array, " nq"]:
        """Puts the objects in their places, rescaled ones onto the table."""
        for name, at in self._at.items():
            qpos = qpos.at[at : at + 7].set(jnp.concatenate([start.object_pos_w[name], start.object_quat_w[name]]))
            if "geom_size" in fields and self._cfg[name].shape != "mesh":
                geom = self._model.geom(name).id
                factor = fields["geom_size"][geom, 0] / self._model.geom_size[geom, 0]
                qpos = qpos.at[at + 2].add((factor - 1) * self._cfg[name].rest_height)
        return qpos

    def memory(self, start: Start) -> dict[str, Any]:
        """Remembers which object is commanded."""
        return {TARGET: start.target} if self._targets else {}

    def view(self, sim: Sim, carry: Carry) -> dict[str, Any]:
        """Returns the objects, the commanded one also as ``TARGET``, and its index."""
        seen = {}
        for name, at in self._at.items():
            pose, speed = sim.qpos[at:][:7], sim.qvel[self._dofs[name] :][:6]
            seen[name] = ObjectView(pose[:3], pose[3:], speed[:3], speed[3:])
        for name, table in self._shapes.items():
            index = carry.memory.get(SHAPE, {}).get(name, jnp.zeros((), jnp.int32))
            shape = ShapeView(index, *(jnp.asarray(values)[index] for values in table))
            seen[name] = dataclasses.replace(seen[name], shape=shape)
        if not self._targets:
            return {"objects": seen, "target": None}
        target = carry.memory[TARGET]
        each = [dataclasses.replace(seen[name], shape=None) for name in self._targets]
        seen[TARGET] = jax.tree.map(lambda *each: jnp.stack(each)[target], *each)
        return {"objects": seen, "target": target}

    @property
    def _differ(self) -> bool:
        """True if sizes or colours differ from episode to episode."""
        return bool(self._targets or {*_APPEARANCE} & {*self._varied()})

    def scenery(self, sim: Sim, carry: Carry, look: Fields) -> dict[str, Any]:
        """Returns sizes and colours where they differ; the commanded one of the targets gets the goal's green."""
        return {"objects": {name: self._appearance(name, sim, carry) for name in self._cfg} if self._differ else {}}

    def _appearance(self, name: str, sim: Sim, carry: Carry) -> Appearance:
        geom, colors = self._model.geom(name).id, carry.memory.get(LOOK, {}).get("geom_rgba")
        size, rgba = (jnp.asarray(sim.fields.get(f, getattr(self._model, f)), jnp.float32)[geom] for f in _APPEARANCE)
        if colors is not None and self._drawn:
            rgba = colors[self._drawn().geom(name).id]
        if name in self._targets:
            rgba = jnp.where(carry.memory[TARGET] == self._targets.index(name), jnp.array(COMMANDED), rgba)
        return Appearance(size, rgba)
