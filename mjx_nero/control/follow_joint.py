"""Takes hold of a fixture's handle and moves it along its joint's path: opens drawers and doors, turns knobs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Positive, Share
from mjx_nero.control import setpoint
from mjx_nero.control.gripper import ParallelGripper
from mjx_nero.control.ik import IkCfg, InverseKinematics
from mjx_nero.control.pick_up import UNREACHABLE
from mjx_nero.mdp import fixtures as terms
from mjx_nero.mdp.fixtures import Handle
from mjx_nero.sim import fixtures
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError, View

BEFORE, IN, CLOSE, MOVE = range(4)
_SETTLING = 0.25  # [s] time constant with which the set-point makes up for a handle that has slipped in the hand
_STILL = 0.05  # [rad/s]
_STIFF = UNREACHABLE / 2  # cost of a hand that does not turn with the handle, in radians of joint motion
_LOST = 0.04  # [m] distance from the grasp point beyond which the handle has been lost
Pose = tuple[Float[Array, "3"], Float[Array, "4"]]


@dataclasses.dataclass(frozen=True)
class FollowJointCfg:
    """Settings of the grasp and the motion.

    Attributes:
        file: name of the fixture's file (``FixtureCfg.file``).
        handle: what to take hold of, how, and where its joint has to go.
        beyond: how far past its target the joint is moved, as a share of the target.
        follow: share of the joint's rotation that the hand follows; none if the arm cannot. A round bar turns between the pads.
        before: distance in front of the handle from which the hand comes [m].
        depth: how far the grasp point goes beyond the middle of the handle, in the hand's direction [m].
        speed: speed of the grasp point [m/s].
        ahead: greatest lead of the set-point over the handle, with which the hand pulls [m].
        closing: time that the fingers take to close [s].
        ik: settings of the arm's motion.
    """

    file: str = "cabinet"
    handle: Handle = Handle("cabinet", "drawer", "drawer_handle")
    beyond: NonNegative = 0.0
    follow: Share = 1.0
    before: Positive = 0.08
    depth: float = 0.0
    speed: Positive = 0.15
    ahead: Positive = 0.03
    closing: Positive = 0.4
    ik: IkCfg = IkCfg(orientation_weight=0.1, iterations=40, restarts=3)


@struct.dataclass
class FollowJointMemory(setpoint.Script):
    """The state of ``FollowJoint`` between two steps."""

    before: Float[Array, " nj"]  # the arm in front of the handle [rad]
    flip: Float[Array, ""]  # turn of the hand about its approach: 0 or half a turn [rad]
    follow: Float[Array, ""]  # share of the joint's rotation that the hand follows
    out: Float[Array, ""]  # how far in front of the handle the set-point is [m]
    joint: Float[Array, ""]  # where the set-point is on the joint's path [rad or m]
    slip: Float[Array, ""]  # how far the set-point has to go beyond the target, so that the joint gets there [rad or m]


class FollowJoint:
    """Grasps the handle and moves it. If the handle slips out, it tries again.

    | phase | before | in | close | move |
    | --- | --- | --- | --- | --- |
    | grasp point | in front of the handle | at the handle | stays | along the joint's path, to its target |
    | fingers | open | open | close | closed |

    A phase ends when the arm has arrived, or when its time is up. The fixture's file says how the handle moves with its joint,
    slide or hinge.

    Args:
        robot: the robot that pulls.
        dt: control step [s].
        cfg: see ``FollowJointCfg``.

    Raises:
        UserError: the fixture lacks the joint or the site.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: FollowJointCfg = FollowJointCfg()):
        handle = cfg.handle
        self._chain = fixtures.chain(cfg.file)
        for what, name, there in (("joint", handle.joint, self._chain.joints), ("site", handle.site, self._chain.frames)):
            if name not in there:
                raise UserError(f"the fixture {cfg.file} has no {what} {name!r}: it has {', '.join(there) or 'none'}")
        self.dt, self.cfg = dt, cfg
        self.gripper, self._ik = ParallelGripper(robot), InverseKinematics(robot, cfg=cfg.ik)
        self._n = len(robot.arm.joints)
        self._lead, self._speed = np.array(robot.arm.lead, np.float32), np.array(robot.arm.speed, np.float32)
        travel = np.abs(self.gripper.opened - self.gripper.closed)
        self._finger_step = np.minimum(np.array(robot.gripper.speed), travel / cfg.closing).astype(np.float32) * dt
        self._step = cfg.speed * dt / handle.lever  # of the joint [rad or m]
        self._grip, self._frame = np.array(robot.grip, np.float32), self._chain.frames.index(handle.site)
        # The direction in which the hand points, in its own frame.
        self._approach = np.array(math.rotate(math.quat_conj(jnp.array(robot.down)), jnp.array([0.0, 0.0, -1.0])), np.float32)
        self._lost = float(np.linalg.norm(robot.grip)) + _LOST

    def init(self, view: View) -> FollowJointMemory:
        """Chooses the grasp: of the two turns of the hand that fit, the one that reaches the whole path with the least motion.

        If neither reaches it while the hand follows the joint's rotation, the hand does not follow it.
        """
        zero, q = jnp.zeros((), jnp.int32), view.joint_pos[: self._n]
        now, follows = self._now(view), jnp.array([self.cfg.follow, self.cfg.follow, 0.0, 0.0])
        flips = jnp.array([0.0, jnp.pi, 0.0, jnp.pi])
        path = [(now, self.cfg.before), (now, 0.0), (self._target(view), 0.0)]
        ways = jax.vmap(self._pose, (None, 0, 0, None, None))
        poses = [ways(view, flips, follows, at, out) for at, out in path]
        start = jnp.broadcast_to(q, (len(flips), self._n))
        found = [self._ik.solve_batch(*poses[0], start, jax.random.PRNGKey(0))]
        for pose in poses[1:]:
            found.append(jax.vmap(self._ik.local)(*pose, found[-1].q))
        way = jnp.linalg.norm(found[0].q - q, axis=1) + UNREACHABLE * sum(~one.success for one in found)
        best = jnp.argmin(way + _STIFF * (jnp.arange(len(flips)) >= 2))
        out, slip, still = jnp.asarray(self.cfg.before), jnp.zeros(()), jnp.zeros_like(q)
        return FollowJointMemory(zero, zero, q, still, zero, found[0].q[best], flips[best], follows[best], out, now, slip)

    def step(self, memory: FollowJointMemory, view: View) -> tuple[FollowJointMemory, Float[Array, " nu"]]:
        """Computes the targets of all drives."""
        phase, now = memory.phase, self._now(view)
        holds = phase == MOVE
        step = self.cfg.speed * self.dt
        out = jnp.where(phase == BEFORE, self.cfg.before, jnp.maximum(memory.out - step, 0.0))
        ahead = self.cfg.ahead / self.cfg.handle.lever
        target = self._target(view)
        left = target + memory.slip - memory.joint
        moved = memory.joint + jnp.clip(left, -self._step, self._step)
        there = holds & (jnp.abs(left) < self._step) & (jnp.max(jnp.abs(memory.qd)) < _STILL)
        slip = memory.slip + jnp.where(there, self.dt / _SETTLING, 0.0) * (target - now)
        joint = jnp.where(holds, jnp.clip(moved, now - ahead, now + ahead), now)
        pos, quat = self._pose(view, memory.flip, memory.follow, joint, out)
        found = self._ik.local(pos, quat, memory.q).q
        wanted = jnp.where(phase == BEFORE, memory.before, jnp.where(phase == CLOSE, memory.q, found))
        q, qd = setpoint.follow(memory.q, memory.qd, wanted, jnp.asarray(self._speed), self.dt)
        fingers = self.gripper.paced(phase >= CLOSE, view.ctrl[self._n :], self._finger_step)

        lost = holds & (terms.distance(view, self.cfg.handle) > self._lost)
        ended = self._ended(memory, jnp.linalg.norm(view.ee_pos_w - pos), out)
        start = self._ik.local(*self._pose(view, memory.flip, memory.follow, now, self.cfg.before), memory.before).q
        memory = dataclasses.replace(
            memory,
            phase=jnp.where(lost, BEFORE, phase + ended),
            count=jnp.where(lost | ended, 0, memory.count + 1),
            q=q,
            qd=qd,
            before=jnp.where(lost, start, memory.before),
            out=out,
            joint=joint,
            slip=jnp.where(holds, jnp.clip(slip, -ahead, ahead), 0.0),
            tries=memory.tries + lost,
        )
        return memory, jnp.concatenate([q + self._lead * qd, fingers])

    def warning(self, memory: FollowJointMemory) -> str:
        """Says how often the handle was lost."""
        tries = np.asarray(memory.tries)
        return f"{(tries > 0).sum()} of {tries.size} episodes lost the handle and tried again" if tries.any() else ""

    def _ended(self, memory: FollowJointMemory, error: Float[Array, ""], out: Float[Array, ""]) -> Bool[Array, ""]:
        """True if the phase is done, or its time is up.

        Args:
            error: position error of the grasp point [m].
            out: how far the set-point is in front of the handle [m].
        """
        time, still = (memory.count + 1) * self.dt, jnp.max(jnp.abs(memory.qd)) < 0.1
        near = (out == 0.0) & (error < 0.005) & still
        return jnp.select(
            [memory.phase == BEFORE, memory.phase == IN, memory.phase == CLOSE],
            [
                still & (jnp.linalg.norm(memory.q - memory.before) < 0.02) & (error < 0.02) | (time > 3.0),
                near | (time > self.cfg.before / self.cfg.speed + 1.0),
                time > self.cfg.closing + 0.15,
            ],
            False,
        )

    def _now(self, view: View) -> Float[Array, ""]:
        return view.fixtures[self.cfg.handle.fixture].joint_pos[self.cfg.handle.joint]

    def _target(self, view: View) -> Float[Array, ""]:
        """Returns the position to move the joint to, within its range [rad or m]."""
        wanted = (1 + self.cfg.beyond) * terms.target(view, self.cfg.handle)
        low, high = view.fixtures[self.cfg.handle.fixture].joint_range[self.cfg.handle.joint]
        return jnp.clip(wanted, low, high)

    def _pose(self, view: View, flip: Float[Array, ""], follow: Float[Array, ""], joint: Array, out: float | Array) -> Pose:
        """Pose of the hand ``out`` in front of the handle [m], if the handle's joint were at ``joint``.

        The hand follows the share ``follow`` of the joint's rotation.
        """
        (pos, _), (_, turn) = self._site(view, joint), self._site(view, follow * joint)
        site = math.quat_mul(turn, math.axis_angle(jnp.array([1.0, 0.0, 0.0]), flip))
        quat = math.quat_mul(site, jnp.array(self.cfg.handle.grip))
        into = math.rotate(quat, jnp.asarray(self._approach))
        return pos - math.rotate(quat, jnp.asarray(self._grip)) + (self.cfg.depth - out) * into, quat

    def _site(self, view: View, joint: Float[Array, ""]) -> Pose:
        """Pose of the handle in the world, if its joint were at ``joint``."""
        seen, name = view.fixtures[self.cfg.handle.fixture], self.cfg.handle.joint
        q = jnp.stack([joint if other == name else seen.joint_pos[other] for other in self._chain.joints])
        pos, quat = self._chain.poses(q)
        return seen.pos_w + math.rotate(seen.quat_w, pos[self._frame]), math.quat_mul(seen.quat_w, quat[self._frame])
