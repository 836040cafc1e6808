"""From the physics state and the carry to what the terms read."""

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero import kinematics
from mjx_nero.robots import RobotCfg
from mjx_nero.types import Carry, Sim, View


class Viewer:
    """Looks names up once; ``__call__`` is pure.

    Args:
        model: compiled scene.
        robot: whose joints and end effector to read.
        max_steps: control steps of an episode.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg, max_steps: int):
        self.qpos_ids = np.array([model.joint(j).qposadr[0] for j in robot.joints])
        self.dof_ids = np.array([model.joint(j).dofadr[0] for j in robot.joints])
        self.object_qpos = int(model.joint("cube").qposadr[0])
        self._object_dof = int(model.joint("cube").dofadr[0])
        self._ee_pose = kinematics.site_pose_fn(model, robot.ee_site)
        self._default = np.asarray(robot.home, np.float32)
        self._root = np.asarray(robot.base_pos, np.float32)
        self._max_steps = max_steps

    def __call__(self, sim: Sim, carry: Carry, action: Float[Array, " na"]) -> View:
        """The view after a step that ``action`` caused; ``carry.action`` is the action before it."""
        ee_pos, ee_quat = self._ee_pose(sim.qpos)
        obj, dof = self.object_qpos, self._object_dof
        return View(
            joint_pos=sim.qpos[self.qpos_ids],
            joint_vel=sim.qvel[self.dof_ids],
            default_joint_pos=jnp.asarray(self._default),
            ctrl=sim.ctrl,
            ee_pos_w=ee_pos,
            ee_quat_w=ee_quat,
            object_pos_w=sim.qpos[obj : obj + 3],
            object_quat_w=sim.qpos[obj + 3 : obj + 7],
            object_linvel_w=sim.qvel[dof : dof + 3],
            object_angvel_local=sim.qvel[dof + 3 : dof + 6],
            root_pos_w=jnp.asarray(self._root),
            command=carry.command,
            goal_pos_w=carry.command + self._root,
            action=action,
            last_action=carry.action,
            step=carry.step,
            max_steps=self._max_steps,
        )
