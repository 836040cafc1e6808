"""Follow a target with the end effector: by inverse kinematics at every step, or by RMPflow."""

import dataclasses
import pathlib
from collections.abc import Callable
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from mjx_nero.config.bounds import OneOf
from mjx_nero.control.controller import Memory
from mjx_nero.control.ik import IkCfg, InverseKinematics
from mjx_nero.control.rmpflow import Obstacles, RmpFlow, Target
from mjx_nero.mdp.actions import rate_limit
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import View

Joints = Float[Array, " nj"]
Motion = Annotated[str, OneOf("rmpflow", "ik")]  # what moves an arm


@dataclasses.dataclass(frozen=True)
class RmpCfg:
    """Files and integration of RMPflow."""

    descriptor: str = ""  # YAML file of joints and collision spheres; empty: the robot's own
    config: str = ""  # YAML file of the policies' parameters; empty: the robot's own
    maximum_substep_size: float = 0.00334  # longest integration step [s]


@struct.dataclass
class IkMemory:
    """Memory of ``IkFollower``."""

    q: Float[Array, " nj"]  # the set-point [rad]
    step: Int[Array, ""]
    failures: Int[Array, ""]  # steps without a solution


class IkFollower:
    """Solves the target's pose at every step and moves the set-point there at the drives' speed limits.

    Without a solution the set-point stays where it is.

    Args:
        robot: robot whose ``ee_site`` follows.
        dt: control step [s].
        cfg: settings of the solver.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: IkCfg | None = None):
        self.ik, self.dt = InverseKinematics(robot, cfg=cfg or IkCfg()), dt
        self._max_step = np.array(robot.arm.speed, np.float32) * dt
        self._lead = np.array(robot.arm.lead, np.float32)
        self._n = len(robot.arm.joints)

    def init(self, view: View) -> IkMemory:
        """Starts where the arm is."""
        zero = jnp.zeros((), jnp.int32)
        return IkMemory(q=view.joint_pos[: self._n], step=zero, failures=zero)

    def step(self, memory: IkMemory, view: View) -> tuple[IkMemory, Float[Array, " nu"]]:
        """Computes the targets of the arm's drives; the gripper's stay."""
        key = jax.random.fold_in(jax.random.PRNGKey(0), memory.step)
        found = self.ik.solve(view.goal_pos_w, view.goal_quat_w, memory.q, key)
        goal = jnp.where(found.success, found.q, memory.q)
        q = rate_limit(goal, memory.q, step=jnp.asarray(self._max_step))
        targets = q + self._lead * (q - memory.q) / self.dt
        failures = memory.failures + ~found.success
        return IkMemory(q, memory.step + 1, failures), jnp.concatenate([targets, view.ctrl[self._n :]])

    def warning(self, memory: IkMemory) -> str:
        """Says in how many steps the solver failed."""
        failed = np.asarray(memory.failures)
        if not failed.any():
            return ""
        return (
            f"inverse kinematics found no solution in {failed.sum()} of {np.asarray(memory.step).sum()} steps "
            f"({(failed > 0).sum()} of {failed.size} episodes): the arm did not move there"
        )


class IkArm:
    """Follows a slow target by inverse kinematics from the set-point, without jumps, within the drives' speed limits.

    If the target is out of reach, the arm comes as near as it can.

    Args:
        robot: robot whose ``ee_site`` follows.
        dt: control step [s].
        cfg: settings of the solver.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: IkCfg):
        self._ik, self.dt = InverseKinematics(robot, cfg=cfg, point=robot.grip), dt
        self._max_step = np.array(robot.arm.speed, np.float32) * dt
        self._lead = np.array(robot.arm.lead, np.float32)

    def arm(self, q: Joints, view: View, target: Target) -> tuple[Joints, Joints]:
        """Returns the next set-point on the way to ``target``, and the drives' targets, ahead of it by their lag [rad]."""
        assert target.position is not None and target.orientation is not None
        after = rate_limit(self._ik.local(target.position, target.orientation, q).q, q, step=jnp.asarray(self._max_step))
        return after, after + self._lead * (after - q) / self.dt


class RmpFollower:
    """Follows the target by RMPflow, from the measured joint state at every step.

    Args:
        robot: robot whose ``ee_site`` follows.
        dt: control step [s].
        cfg: files and integration.

    Raises:
        UserError: the robot has no RMPflow files, or they do not fit it.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: RmpCfg = RmpCfg()):
        descriptor, config = (pathlib.Path(f) if f else None for f in (cfg.descriptor, cfg.config))
        self.flow = RmpFlow(robot, None, descriptor, config, cfg.maximum_substep_size)
        self.dt, self._lead = dt, np.array(robot.arm.lead, np.float32)
        self._n = len(robot.arm.joints)

    def init(self, view: View) -> Memory:
        """Returns an empty memory."""
        return ()

    def step(self, memory: Memory, view: View) -> tuple[Memory, Float[Array, " nu"]]:
        """Computes the targets of the arm's drives; the gripper's stay."""
        target = Target(view.goal_pos_w, view.goal_quat_w, view.goal_linvel_w)
        return memory, jnp.concatenate([self.arm(view, target), view.ctrl[self._n :]])

    def arm(self, view: View, target: Target) -> Joints:
        """Computes the targets of the arm's drives on the way to ``target`` [rad]."""
        obstacles = Obstacles.seen(view)
        q, qd = self.flow.step(view.joint_pos[: self._n], view.joint_vel[: self._n], target, obstacles, self.dt)
        return q + self._lead * qd

    def warning(self, memory: Memory) -> str:
        """Returns no warning."""
        return ""


def mover(robot: RobotCfg, dt: float, motion: Motion, rmpflow: RmpCfg, ik: IkCfg) -> Callable[..., tuple[Joints, Joints]]:
    """Makes what moves an arm along a path: (set-point, view, target) -> the next set-point and the drives' targets [rad].

    Args:
        motion: ``rmpflow``, which starts from the measured joints and returns the set-point as it is, or ``ik``.

    Raises:
        UserError: the robot has no RMPflow files, or they do not fit it.
    """
    if motion == "ik":
        return IkArm(robot, dt, ik).arm
    follower = RmpFollower(robot, dt, rmpflow)
    return lambda q, view, target: (q, follower.arm(view, target))
