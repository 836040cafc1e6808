"""From the physics state and the carry to what the terms read."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero import kinematics
from mjx_nero.robots import RobotCfg
from mjx_nero.types import Carry, Sim, View

Motion = Callable[[Float[Array, "3"], Float[Array, ""]], Float[Array, "3"]]


class Viewer:
    """Looks names up once; ``__call__`` is pure.

    Args:
        model: compiled scene.
        robot: whose joints and end effector to read.
        max_steps: control steps of an episode.
        dt: of a control step [s].
        motion: ``(position, time) -> position`` of a moving goal; None: it stays.
    """

    def __init__(self, model: mujoco.MjModel, robot: RobotCfg, max_steps: int, dt: float, motion: Motion | None = None):
        self.qpos_ids = np.array([model.joint(j).qposadr[0] for j in robot.joints])
        self.dof_ids = np.array([model.joint(j).dofadr[0] for j in robot.joints])
        has_object = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, "cube") >= 0
        self.object_qpos = int(model.joint("cube").qposadr[0]) if has_object else None
        self._object_dof = int(model.joint("cube").dofadr[0]) if has_object else None
        self._ee_pose = kinematics.site_pose_fn(model, robot.ee_site)
        self._default = np.asarray(robot.home, np.float32)
        self._root = np.asarray(robot.base_pos, np.float32)
        self._max_steps, self._dt, self._motion = max_steps, dt, motion

    def __call__(self, sim: Sim, carry: Carry, action: Float[Array, " na"]) -> View:
        """The view after a step that ``action`` caused; ``carry.action`` is the action before it."""
        ee_pos, ee_quat = self._ee_pose(sim.qpos)
        goal, goal_linvel = self.goal(carry)
        if self.object_qpos is not None and self._object_dof is not None:
            pose, speed = sim.qpos[self.object_qpos :][:7], sim.qvel[self._object_dof :][:6]
        else:
            pose = jnp.concatenate([goal, carry.command_quat])
            speed = jnp.concatenate([goal_linvel, jnp.zeros(3)])
        return View(
            joint_pos=sim.qpos[self.qpos_ids],
            joint_vel=sim.qvel[self.dof_ids],
            default_joint_pos=jnp.asarray(self._default),
            ctrl=sim.ctrl,
            ee_pos_w=ee_pos,
            ee_quat_w=ee_quat,
            object_pos_w=pose[:3],
            object_quat_w=pose[3:],
            object_linvel_w=speed[:3],
            object_angvel_local=speed[3:],
            root_pos_w=jnp.asarray(self._root),
            command=carry.command,
            goal_pos_w=goal,
            goal_quat_w=carry.command_quat,
            goal_linvel_w=goal_linvel,
            action=action,
            last_action=carry.action,
            step=carry.step,
            max_steps=self._max_steps,
        )

    def goal(self, carry: Carry) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Position [m] and velocity [m/s] of the goal in the world frame, now."""
        at = carry.command + self._root
        if self._motion is None:
            return at, jnp.zeros(3)
        motion, time = self._motion, carry.step * self._dt
        return jax.jvp(lambda t: motion(at, t), (time,), (jnp.ones_like(time),))
