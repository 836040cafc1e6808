"""Turns the physics state and the carry into the ``View`` that terms read."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.mdp.terms import CommandTerm
from mjx_nero.sim import kinematics, team
from mjx_nero.sim.parts import Part
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import Carry, Picture, RobotView, Sim, View


class Viewer:
    """Reads views. It looks names up once; ``__call__`` is pure.

    Args:
        model: the compiled scene.
        robot: the robot whose joints and end effector to read.
        others: further robots by name.
        parts: everything in the scene but the robot.
        max_steps: control steps of an episode.
        dt: duration of a control step [s].
        command: how the goal moves.
        pictures: what the scene's cameras see; None: the scene has none.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: RobotCfg,
        parts: Part,
        max_steps: int,
        dt: float,
        command: CommandTerm,
        pictures: Callable[[Sim, Carry], dict[str, Picture]] | None = None,
        others: team.Robots | None = None,
    ):
        self._team = team.of(robot, others or {})
        self.qpos_ids = np.array([model.joint(j).qposadr[0] for j in team.joints(self._team)])
        self.dof_ids = np.array([model.joint(j).dofadr[0] for j in team.joints(self._team)])
        self._ends = {name: kinematics.site_pose_fn(model, each.ee_site) for name, each in self._team.items()}
        self._gain = np.array(model.actuator_gainprm, np.float32)
        self._default = np.asarray(team.home(self._team), np.float32)
        self._root = np.asarray(robot.base_pos, np.float32)
        self._max_steps, self._dt, self._motion = max_steps, dt, command.motion
        self._parts, self._pictures = parts, pictures

    def __call__(self, sim: Sim, carry: Carry, action: Float[Array, " na"]) -> View:
        """Returns the view after the step that ``action`` caused; ``carry.action`` is the action before it."""
        ee_pos, ee_quat = self._ends[""](sim.qpos)
        goal, goal_linvel = self.goal(carry)
        return View(
            joint_pos=sim.qpos[self.qpos_ids],
            joint_vel=sim.qvel[self.dof_ids],
            default_joint_pos=jnp.asarray(self._default),
            ctrl=sim.ctrl,
            ee_pos_w=ee_pos,
            ee_quat_w=ee_quat,
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
            readings=sim.readings,
            cameras=self._pictures(sim, carry) if self._pictures else {},
            max_steps=self._max_steps,
            robots=self._robots(sim, (ee_pos, ee_quat)) if len(self._team) > 1 else {},
            **self._parts.view(sim, carry),
        )

    def _robots(self, sim: Sim, first: kinematics.Pose) -> dict[str, RobotView]:
        """Reads each of several robots; ``first`` is the pose of the first robot's hand."""
        found, begin = {}, 0
        for name, robot in self._team.items():
            pos, quat = self._ends[name](sim.qpos) if name else first
            own = begin, begin + len(robot.joints)
            found[name], begin = RobotView(pos, quat, jnp.asarray(robot.base_pos), own), own[1]
        return found

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
