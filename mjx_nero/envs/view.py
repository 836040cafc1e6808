"""Turns the physics state and the carry into the ``View`` that terms read."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.mdp.terms import CommandTerm
from mjx_nero.sim import kinematics
from mjx_nero.sim.fixtures import Fixtures
from mjx_nero.sim.objects import shapes
from mjx_nero.sim.obstacles import Obstacles
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import SHAPE, TARGET, Carry, ObjectView, Picture, ShapeView, Sim, View


class Viewer:
    """Reads views. It looks names up once; ``__call__`` is pure.

    Args:
        model: the compiled scene.
        robot: the robot whose joints and end effector to read.
        objects: the scene's objects; of their configs, if they come with these, the shapes of meshes.
        max_steps: control steps of an episode.
        dt: duration of a control step [s].
        command: how the goal moves, and which objects may be commanded.
        obstacles: the scene's obstacles.
        fixtures: the scene's fixtures.
        pictures: what the scene's cameras see; None: the scene has none.

    Attributes:
        objects: each object's addresses in qpos and qvel, by name.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: RobotCfg,
        objects: Iterable[str] | Mapping[str, Any],
        max_steps: int,
        dt: float,
        command: CommandTerm,
        obstacles: Obstacles,
        fixtures: Fixtures,
        pictures: Callable[[Sim, Carry], dict[str, Picture]] | None = None,
    ):
        self.qpos_ids = np.array([model.joint(j).qposadr[0] for j in robot.joints])
        self.dof_ids = np.array([model.joint(j).dofadr[0] for j in robot.joints])
        self.objects = {name: (int(model.joint(name).qposadr[0]), int(model.joint(name).dofadr[0])) for name in objects}
        self._shapes = _shapes(objects) if isinstance(objects, Mapping) else {}
        self._ee_pose = kinematics.site_pose_fn(model, robot.ee_site)
        self._gain = np.array(model.actuator_gainprm, np.float32)
        self._default = np.asarray(robot.home, np.float32)
        self._root = np.asarray(robot.base_pos, np.float32)
        self._max_steps, self._dt, self._motion = max_steps, dt, command.motion
        self._obstacles, self._fixtures, self._targets, self._pictures = obstacles, fixtures, command.targets, pictures

    def __call__(self, sim: Sim, carry: Carry, action: Float[Array, " na"]) -> View:
        """Returns the view after the step that ``action`` caused; ``carry.action`` is the action before it."""
        ee_pos, ee_quat = self._ee_pose(sim.qpos)
        goal, goal_linvel = self.goal(carry)
        objects = {name: _object(sim.qpos[at:][:7], sim.qvel[dof:][:6]) for name, (at, dof) in self.objects.items()}
        for name, table in self._shapes.items():
            index = carry.memory.get(SHAPE, {}).get(name, jnp.zeros((), jnp.int32))
            shape = ShapeView(index, *(jnp.asarray(values)[index] for values in table))
            objects[name] = dataclasses.replace(objects[name], shape=shape)
        target = carry.memory[TARGET] if self._targets else None
        if target is not None:
            each = [dataclasses.replace(objects[name], shape=None) for name in self._targets]
            objects[TARGET] = jax.tree.map(lambda *each: jnp.stack(each)[target], *each)
        return View(
            joint_pos=sim.qpos[self.qpos_ids],
            joint_vel=sim.qvel[self.dof_ids],
            default_joint_pos=jnp.asarray(self._default),
            ctrl=sim.ctrl,
            ee_pos_w=ee_pos,
            ee_quat_w=ee_quat,
            objects=objects,
            root_pos_w=jnp.asarray(self._root),
            command=carry.command,
            goal_pos_w=goal,
            goal_quat_w=carry.command_quat,
            goal_linvel_w=goal_linvel,
            action=action,
            last_action=carry.action,
            step=carry.step,
            time=carry.step * self._dt,
            encoder_bias=self._encoder_bias(sim),
            obstacles=self._obstacles.views(sim.fields),
            fixtures=self._fixtures.views(sim.qpos, sim.qvel, sim.fields),
            readings=sim.readings,
            cameras=self._pictures(sim, carry) if self._pictures else {},
            target=target,
            max_steps=self._max_steps,
        )

    def _encoder_bias(self, sim: Sim) -> Float[Array, " nj"] | None:
        """Recovers the bias of ``randomization.encoder_bias``: drives pull with stiffness * (target - joint - bias) - ..."""
        if "actuator_biasprm" not in sim.fields:
            return None
        gain = sim.fields.get("actuator_gainprm", self._gain)
        return -sim.fields["actuator_biasprm"][:, 0] / gain[:, 0]

    def goal(self, carry: Carry) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Returns the goal's current position [m] and velocity [m/s] in the world frame."""
        at = carry.command + self._root
        if self._motion is None:
            return at, jnp.zeros(3)
        motion, time = self._motion, carry.step * self._dt
        return jax.jvp(lambda t: motion(at, t), (time,), (jnp.ones_like(time),))


def _object(pose: Float[Array, "7"], speed: Float[Array, "6"]) -> ObjectView:
    return ObjectView(pos_w=pose[:3], quat_w=pose[3:], linvel_w=speed[:3], angvel_local=speed[3:])


def _shapes(objects: Mapping[str, Any]) -> dict[str, tuple[np.ndarray, ...]]:
    """The shapes of each object of a mesh, [shapes, ...]: points, middle, edges and code, as in ``ShapeView``."""
    out = {}
    for name, item in objects.items():
        if item.shape == "mesh":
            boxes = [shapes.box(solid) for solid in item.solids]
            points, codes = (np.stack([make(solid) for solid in item.solids]) for make in (shapes.points, shapes.code))
            out[name] = tuple(x.astype(np.float32) for x in (points, np.stack(boxes)[:, 0], np.stack(boxes)[:, 1], codes))
    return out
