"""Detour: carries the grasp point over obstacles. The target moves up, across and down.

With RMPflow the whole arm keeps clear of the boxes. A robot without RMPflow's files follows the same path by inverse kinematics,
which ignores the boxes.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from mjx_nero.control.follow_target import Motion, RmpCfg, mover
from mjx_nero.control.gripper import GRIP_FILTER, ParallelGripper
from mjx_nero.control.ik import IkCfg
from mjx_nero.control.rmpflow import Target
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import View

Corners = Float[Array, "n 3"]


@dataclasses.dataclass(frozen=True)
class DetourCfg:
    """Settings of the path and the arm's motion.

    Attributes:
        clearance: height of the end effector above the highest obstacle while it crosses [m].
        speed: speed of the target along the path [m/s].
        ramp: distance from a corner within which the target slows down, nearly to rest [m]: a jerk would shake the object off.
        lead: distance from the end effector beyond which the target waits [m].
        motion: what moves the arm: ``rmpflow``, or ``ik`` for a robot without RMPflow's files.
        rmpflow, ik: settings of the arm's motion.
    """

    clearance: float = 0.12
    speed: float = 0.2
    ramp: float = 0.04
    lead: float = 0.08
    motion: Motion = "rmpflow"
    rmpflow: RmpCfg = RmpCfg()
    ik: IkCfg = IkCfg(orientation_weight=0.03)


@struct.dataclass
class Way:
    """A path of straight legs, the target's distance along it [m], and the arm's set-point."""

    corners: Corners
    travelled: Float[Array, ""]
    setpoint: Float[Array, " nj"]  # [rad]

    @classmethod
    def through(cls, setpoint: Float[Array, " nj"], *corners: Float[Array, "3"]) -> "Way":
        """Makes the path through these corners, with the target at its beginning."""
        return cls(jnp.stack(corners), jnp.zeros(()), setpoint)

    @property
    def ends(self) -> Float[Array, " n"]:
        """Distances of the corners along the path [m]."""
        return jnp.append(0.0, jnp.cumsum(jnp.linalg.norm(jnp.diff(self.corners, axis=0), axis=1)))

    @property
    def length(self) -> Float[Array, ""]:
        """Length of the whole path [m]."""
        return self.ends[-1]

    def to_corner(self) -> Float[Array, ""]:
        """Distance from the target to the nearest corner [m]."""
        return jnp.min(jnp.abs(self.travelled - self.ends))

    def target(self) -> Float[Array, "3"]:
        """Position of the target."""
        legs, lengths = jnp.diff(self.corners, axis=0), jnp.diff(self.ends)
        done = jnp.clip(self.travelled - self.ends[:-1], 0.0, lengths)
        return self.corners[0] + jnp.sum((done / jnp.maximum(lengths, 1e-6))[:, None] * legs, axis=0)

    def on(self, by) -> "Way":
        """Moves the target ``by`` further along the path, at most to its end [m]."""
        return dataclasses.replace(self, travelled=jnp.minimum(self.travelled + by, self.length))


def over(setpoint: Float[Array, " nj"], start: Float[Array, "3"], goal: Float[Array, "3"], view: View, clearance: float) -> Way:
    """Makes a path from start to goal, ``clearance`` above the highest obstacle in between. Obstacles stand upright."""
    tops = [jnp.where(box.pos_w[2] > 0, box.pos_w[2] + box.size[2] / 2, -jnp.inf) for box in view.obstacles.values()]
    height = jnp.maximum(jnp.max(jnp.stack(tops)) + clearance, jnp.maximum(start[2], goal[2]))
    return Way.through(setpoint, start, start.at[2].set(height), goal.at[2].set(height), goal)


class Detour:
    """Brings the end effector to the goal, over the obstacles. Its orientation there is free.

    Args:
        robot: robot whose ``ee_site`` moves.
        dt: control step [s].
        cfg: see ``DetourCfg``.

    Raises:
        UserError: the robot has no RMPflow files, or they do not fit it.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: DetourCfg = DetourCfg()):
        self.dt, self.cfg, self._n = dt, cfg, len(robot.arm.joints)
        self._move = mover(robot, dt, cfg.motion, cfg.rmpflow, cfg.ik)
        self._down = np.array(robot.down, np.float32)

    def init(self, view: View) -> Way:
        """Plans the path from the end effector's position."""
        return over(view.joint_pos[: self._n], view.ee_pos_w, view.goal_pos_w, view, self.cfg.clearance)

    def step(self, memory: Way, view: View) -> tuple[Way, Float[Array, " nu"]]:
        """Computes the targets of the arm's drives; the gripper's stay."""
        memory, targets = self._follow(memory, view, jnp.zeros(3), None)
        return memory, jnp.concatenate([targets, view.ctrl[self._n :]])

    def _follow(self, way: Way, view: View, offset, orientation, weight=None) -> tuple[Way, Float[Array, " nj"]]:
        """Takes one step along a path; the end effector's place is ``offset`` from the path [m]."""
        position = way.target()
        goes = jnp.linalg.norm(position + offset - view.ee_pos_w) < self.cfg.lead
        # Constant acceleration within ``ramp``. At a corner a tenth of the speed remains, or the target would stay there.
        speed = self.cfg.speed * jnp.clip(jnp.sqrt(way.to_corner() / self.cfg.ramp), 0.1, 1.0)
        after = way.on(jnp.where(goes, speed * self.dt, 0.0))
        if self.cfg.motion == "ik":  # the hand points down as far as it can: it would drift if it kept its present orientation
            orientation = jnp.asarray(self._down)
        target = Target(position + offset, orientation, (after.target() - position) / self.dt, weight)
        setpoint, targets = self._move(way.setpoint, view, target)
        return dataclasses.replace(after, setpoint=setpoint), targets

    def warning(self, memory: Way) -> str:
        """Says in how many episodes the target did not reach the goal."""
        left = _lengths(memory) - np.asarray(memory.travelled)
        late = left > 1e-3
        return f"{late.sum()} of {late.size} episodes ended on the way" if late.any() else ""


def _lengths(ways: Way) -> np.ndarray:
    """Lengths of a batch of paths."""
    return np.linalg.norm(np.diff(np.asarray(ways.corners), axis=-2), axis=-1).sum(-1)


@dataclasses.dataclass(frozen=True)
class CarryPastCfg(DetourCfg):
    """``DetourCfg`` with the settings of the grasp.

    Attributes:
        approach: height above the object from which the gripper comes down [m].
        end_effector_offset: offset of the grasp point from the object's centre [m].
        near: distance from the grasp at which the end effector counts as arrived [m].
        settling: wait before the gripper closes [s]: moving fingers would push the object away.
        closing: time until the arm carries the object off [s]. The fingers take as long to close: faster ones would dig into the
            object before contact stops them, and shoot it out.
        object: name of the object to carry.
    """

    approach: float = 0.12
    end_effector_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    near: float = 0.008
    settling: float = 0.4
    closing: float = 0.6
    object: str = "cube"


@struct.dataclass
class CarryMemory:
    """Memory of ``CarryPast``."""

    way: Way  # to the object, then the object's to the goal
    there: Int[Array, ""]  # steps since the end effector arrived at the object; 0: it has not
    grip: Float[Array, "3"]  # from the object to the grasp point


class CarryPast(Detour):
    """Picks the object up with the gripper straight down, and carries it to the goal over the obstacles.

    Args:
        robot: the robot that carries.
        dt: control step [s].
        cfg: see ``CarryPastCfg``.
    """

    cfg: CarryPastCfg

    def __init__(self, robot: RobotCfg, dt: float, cfg: CarryPastCfg = CarryPastCfg()):
        super().__init__(robot, dt, cfg)
        self._gripper = ParallelGripper(robot)
        self._settled = max(1, round(cfg.settling / dt))
        self._closed = self._settled + max(1, round(cfg.closing / dt))
        way = np.abs(np.subtract(robot.gripper.close, robot.gripper.open)) / np.array(robot.gripper.speed)
        self._pace = min(1.0, float(np.max(way, initial=0.0)) / cfg.closing)
        self._offset = np.array(cfg.end_effector_offset, np.float32)

    def init(self, view: View) -> CarryMemory:  # type: ignore[override]
        """Plans the path to the object, from above."""
        at = view.objects[self.cfg.object].pos_w + self._offset
        above = at + jnp.array([0.0, 0.0, self.cfg.approach])
        way = Way.through(view.joint_pos[: self._n], view.ee_pos_w, above, above, at)  # as many corners as over obstacles
        return CarryMemory(way, jnp.zeros((), jnp.int32), jnp.asarray(self._offset))

    def step(self, memory: CarryMemory, view: View) -> tuple[CarryMemory, Float[Array, " nu"]]:  # type: ignore[override]
        """Computes the targets of all drives."""
        at, holds = view.objects[self.cfg.object].pos_w, memory.there >= self._closed
        off = over(memory.way.setpoint, at, view.goal_pos_w, view, self.cfg.clearance)
        way = jax.tree.map(lambda new, old: jnp.where(memory.there == self._closed, new, old), off, memory.way)
        arrived = jnp.linalg.norm(way.corners[-1] - view.ee_pos_w) < self.cfg.near
        slip = jnp.clip(view.ee_pos_w - at, self._offset - 0.03, self._offset + 0.03)
        grip = memory.grip + jnp.where(holds, GRIP_FILTER, 0.0) * (slip - memory.grip)
        # A hand that holds the object may turn freely.
        way, targets = self._follow(way, view, jnp.where(holds, grip, 0.0), jnp.asarray(self._down), jnp.where(holds, 0.0, 1.0))
        there = memory.there + (arrived | (memory.there > 0))
        fingers = self._gripper.forward(
            there > self._settled, view.joint_pos[self._n :], view.ctrl[self._n :], self._pace * self.dt
        )
        return CarryMemory(way, there, grip), jnp.concatenate([targets, fingers])

    def warning(self, memory: CarryMemory) -> str:  # type: ignore[override]
        """Says in how many episodes the object did not reach the goal."""
        return super().warning(memory.way)
