"""One arm takes a long object from the table and holds it out; another takes it over in the air and brings it to the goal."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import math
from mjx_nero.config.bounds import Positive
from mjx_nero.control import setpoint
from mjx_nero.control.gripper import GRIP_FILTER, ParallelGripper
from mjx_nero.control.ik import IkCfg, InverseKinematics
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError, View

OVER, DOWN, CLOSE, UP, MEET, NEAR, REACH, GRIP, LET, LEAVE, BRING, HOLD = range(12)
_SLOW = 0.1  # [rad/s]
_THERE = 0.05  # [rad] greatest joint error of an arm that has arrived
_LONGEST = 4.0  # [s] time limit of a motion across
_SHORT = 1.0  # [s] time limit of a motion up or down, beyond its usual duration
_CLOSE = 0.005  # [m] distance from its place on the object at which a hand closes
_WITHIN = 0.01  # [m] distance from its place over the object at which the taking hand comes down
_AHEAD = 0.03  # [m] greatest correction of the set-point for the object's place at the goal


@dataclasses.dataclass(frozen=True)
class HandOverCfg:
    """Settings of the script.

    Attributes:
        object: name of an object that is long along its own x axis. The giver holds it on the negative side of its middle, the
            taker on the positive side.
        taker: name of the robot that takes the object.
        along: distance of each hand from the object's middle [m].
        meet: place of the object's middle when it changes hands, relative to the giver's root [m]. The object then lies along x.
        turns: how far the first joint of giver and taker turns from home to the meeting point [rad].
        lowest: least height of the pads' middle above the table, of giver and taker [m].
        beyond: how far the pads' middle is below the grasp point, of giver and taker [m].
        closing: time that the fingers take to close [s], besides the lag of their drives, of giver and taker.
        above: height over the object at which hands start their descent, and to which they lift it [m].
        speed: speed of a grasp point on its way up or down [m/s].
        ik: settings of the arms' motion.
    """

    object: str = "bar"
    taker: str = "taker"
    along: Positive = 0.09
    meet: tuple[float, float, float] = (0.44, 0.0, 0.12)
    turns: tuple[float, float] = (0.0, 0.0)
    lowest: tuple[float, float] = (0.0, 0.0)
    beyond: tuple[float, float] = (0.0, 0.0)
    closing: tuple[Positive, Positive] = (0.3, 0.3)
    above: Positive = 0.08
    speed: Positive = 0.25
    ik: IkCfg = IkCfg(orientation_weight=0.1, restarts=3)


@struct.dataclass
class ArmMemory:
    """The set-point of one arm."""

    q: Float[Array, " nj"]  # [rad]
    qd: Float[Array, " nj"]  # [rad/s]
    pos: Float[Array, "3"]  # the grasp point [m]
    yaw: Float[Array, ""]  # the hand's turn about the vertical [rad]
    first: Float[Array, " nj"]  # the arm over the object [rad]
    second: Float[Array, " nj"]  # the arm where it brings the object [rad]


@struct.dataclass
class HandOverMemory:
    """The state of ``HandOver`` between two steps."""

    stage: Int[Array, ""]
    count: Int[Array, ""]  # steps made in this stage
    giver: ArmMemory
    taker: ArmMemory
    grip: Float[Array, "3"]  # correction of the set-point at the goal [m]


class _Arm:
    """One robot of the script. ``faces`` is the turn of its mount about the vertical [rad]."""

    def __init__(self, robot: RobotCfg, dt: float, cfg: HandOverCfg, place: int):
        self.gripper, self.ik = ParallelGripper(robot), InverseKinematics(robot, cfg=cfg.ik)
        self.n, self.dt, self.faces = len(robot.arm.joints), dt, np.float32(np.pi * place)
        self.home = np.array(robot.arm.home, np.float32)
        self.meeting = self.home + np.eye(self.n, dtype=np.float32)[0] * cfg.turns[place]
        self.down, self.held = np.array(robot.down, np.float32), np.array(robot.grip, np.float32)
        self.lead, self.speed = np.array(robot.arm.lead, np.float32), np.array(robot.arm.speed, np.float32)
        self.gentle = setpoint.gentle(robot.arm.lead)
        self.closed, self.finger_step = self.gripper.pace(cfg.closing[place], dt)
        self.lowest, self.beyond = cfg.lowest[place], cfg.beyond[place]
        self.side = np.float32(cfg.along * (2 * place - 1))  # place of the hand along the object's x axis [m]

    def hand(self, yaw: Float[Array, ""]) -> Float[Array, "4"]:
        """The orientation of a hand that points down on an object with this heading."""
        return math.quat_mul(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), yaw + self.faces), jnp.asarray(self.down))

    def place(self, pos: Float[Array, "3"], yaw: Float[Array, ""], pitch: Float[Array, ""]) -> Float[Array, "3"]:
        """Place of the grasp point for an object with its middle at ``pos``, its heading ``yaw`` and its slope ``pitch``."""
        along = jnp.stack([jnp.cos(yaw) * jnp.cos(pitch), jnp.sin(yaw) * jnp.cos(pitch), jnp.sin(pitch)])
        end = pos + self.side * along
        height = jnp.maximum(end[2], self.lowest) + self.beyond
        return end.at[2].set(height) - math.rotate(self.hand(yaw), jnp.asarray(self.held))

    def fingers(self, view: View, closed: Bool[Array, ""]) -> Float[Array, " ng"]:
        """The fingers' next targets; ``view`` is the robot's own."""
        return self.gripper.paced(closed, view.ctrl[self.n :], self.finger_step)

    def step(
        self, arm: ArmMemory, across: Bool[Array, ""], to: Float[Array, " nj"], pos: Float[Array, "3"], held: Bool[Array, ""]
    ) -> ArmMemory:
        """Moves the set-point: to the joint positions ``to`` if ``across``, otherwise straight to ``pos``."""
        found = self.ik.local(pos, self.hand(arm.yaw), arm.q).q
        fastest = jnp.where(held, self.gentle, setpoint.FASTEST)
        wanted = jnp.where(across, to, found)
        q, qd = setpoint.follow(arm.q, arm.qd, wanted, jnp.asarray(self.speed), self.dt, fastest)
        now = self.ik.chain.poses(q)[0][0]
        return dataclasses.replace(arm, q=q, qd=qd, pos=jnp.where(across, now, pos))


def _there(view: View, arm: ArmMemory, end: Float[Array, " nj"]) -> Bool[Array, ""]:
    """True if the arm is at ``end``, and its set-point rests."""
    return (jnp.max(jnp.abs(end - view.joint_pos[: len(end)])) < _THERE) & (jnp.max(jnp.abs(arm.qd)) < _SLOW)


class HandOver:
    """The giver picks the object up and holds it out. The taker takes it over and brings it to the goal.

    | stage | over, down, close, up | meet | near, reach, grip | let, leave | bring, hold |
    | --- | --- | --- | --- | --- | --- |
    | giver | picks the object up | holds it out | holds it out | opens, goes up | goes home |
    | taker | goes over the meeting point | is there | comes down at the other end, closes | holds | brings it to the goal |

    A stage ends when the arms have arrived, or when its time is up.

    Args:
        robot: the robot that gives.
        dt: control step [s].
        cfg: see ``HandOverCfg``.
        others: the scene's further robots by name.

    Raises:
        UserError: ``taker`` is not one of them.
    """

    def __init__(
        self, robot: RobotCfg, dt: float, cfg: HandOverCfg = HandOverCfg(), others: Mapping[str, RobotCfg] | None = None
    ):
        if cfg.taker not in (others or {}):
            there = ", ".join(others or {}) or "none but the first"
            raise UserError(f"hand_over: taker is {cfg.taker!r}, but the scene's further robots are: {there}")
        self.dt, self.cfg, self._root = dt, cfg, np.array(robot.base_pos, np.float32)
        taker = (others or {})[cfg.taker]
        self._giver, self._taker = _Arm(robot, dt, cfg, 0), _Arm(taker, dt, cfg, 1)

    def init(self, view: View) -> HandOverMemory:
        """Plans where the arms go."""
        pos, yaw, _ = self._seen(view)
        meet, zero = jnp.asarray(self._root + np.array(self.cfg.meet, np.float32)), jnp.zeros(())
        goal = math.yaw(view.goal_quat_w)
        giver = self._plan(self._giver, view.of(), [(pos, yaw, self._giver.home, True), (meet, zero, self._giver.meeting, False)])
        taker = self._plan(
            self._taker,
            view.of(self.cfg.taker),
            [(meet, zero, self._taker.meeting, True), (view.goal_pos_w, goal, self._taker.home, False)],
        )
        start = jnp.zeros((), jnp.int32)
        return HandOverMemory(start, start, giver, taker, jnp.zeros(3))

    def _plan(self, arm: _Arm, view: View, ways: list) -> ArmMemory:
        """Finds the arm at two places; each is the object's middle, its heading, a first guess, and whether to stay above."""
        zero = jnp.zeros(())
        places = [arm.place(pos, yaw, zero) + over * self._up for pos, yaw, _, over in ways]
        quats, starts = [arm.hand(yaw) for _, yaw, _, _ in ways], [jnp.asarray(q) for _, _, q, _ in ways]
        found = arm.ik.solve_batch(jnp.stack(places), jnp.stack(quats), jnp.stack(starts), jax.random.PRNGKey(0)).q
        q = view.joint_pos[: arm.n]
        return ArmMemory(q, jnp.zeros_like(q), view.ee_pos_w, ways[0][1], found[0], found[1])

    def step(self, memory: HandOverMemory, view: View) -> tuple[HandOverMemory, Float[Array, " nu"]]:
        """Computes the targets of all drives."""
        stage, first, second = memory.stage, view.of(), view.of(self.cfg.taker)
        pos, yaw, pitch = self._seen(view)
        giver, low = self._give(memory, pos, yaw, pitch)
        taker, to_taker = self._take(memory, second, pos, yaw, pitch)
        grip = jnp.clip(memory.grip + GRIP_FILTER * (view.goal_pos_w - pos), -_AHEAD, _AHEAD)
        off = [jnp.linalg.norm(own.ee_pos_w - to) for own, to in ((first, low), (second, to_taker))]
        reached = [[_there(own, arm, end) for end in (arm.first, arm.second)] for own, arm in ((first, giver), (second, taker))]
        ended = self._ended(memory, reached, off)
        memory = HandOverMemory(
            stage=stage + ended,
            count=jnp.where(ended, 0, memory.count + 1),
            giver=giver,
            taker=taker,
            grip=jnp.where(stage == HOLD, grip, 0.0),
        )
        fingers = [
            self._giver.fingers(first, (stage >= CLOSE) & (stage < LET)),
            self._taker.fingers(second, stage >= GRIP),
        ]
        arms = [arm.q + side.lead * arm.qd for arm, side in ((giver, self._giver), (taker, self._taker))]
        return memory, jnp.concatenate([arms[0], fingers[0], arms[1], fingers[1]])

    def _give(
        self, memory: HandOverMemory, pos: Float[Array, "3"], yaw: Float[Array, ""], pitch: Float[Array, ""]
    ) -> tuple[ArmMemory, Float[Array, "3"]]:
        """The giver's next set-point, and where its grasp point has to be on an object seen at ``pos``."""
        stage, arm, mine = memory.stage, memory.giver, self._giver
        arm = dataclasses.replace(arm, yaw=jnp.where(stage < MEET, arm.yaw, 0.0))  # the object then lies along x
        low = mine.place(pos, yaw, pitch)
        # Straight down on the object; then up from wherever the hand is.
        end = jnp.where(stage == DOWN, low, arm.pos + self._up)
        moves = (stage == DOWN) | (stage == UP) | (stage == LEAVE)
        left = (stage == UP) | (stage == LEAVE)
        risen = memory.count * self.cfg.speed * self.dt >= self.cfg.above
        end = jnp.where(left & risen, arm.pos, end)
        across = (stage == OVER) | (stage == MEET) | (stage >= BRING)
        to = jnp.select([stage == OVER, stage >= BRING], [arm.first, jnp.asarray(mine.home)], arm.second)
        next = jnp.where(moves, self._towards(arm.pos, end), arm.pos)
        return mine.step(arm, across, to, next, (stage > CLOSE) & (stage < LEAVE)), low

    def _take(
        self, memory: HandOverMemory, view: View, pos: Float[Array, "3"], yaw: Float[Array, ""], pitch: Float[Array, ""]
    ) -> tuple[ArmMemory, Float[Array, "3"]]:
        """The taker's next set-point, and where its grasp point has to be."""
        stage, arm, mine = memory.stage, memory.taker, self._taker
        goal_yaw = math.yaw(view.goal_quat_w)
        low, goal = mine.place(pos, yaw, pitch), mine.place(view.goal_pos_w, goal_yaw, jnp.zeros(())) + memory.grip
        heading = jnp.select([stage < NEAR, stage == NEAR, stage == HOLD], [jnp.zeros(()), yaw, goal_yaw], arm.yaw)
        arm = dataclasses.replace(arm, yaw=heading)
        end = jnp.select([stage == NEAR, stage == REACH, stage == HOLD], [low + self._up, low, goal], arm.pos)
        across = (stage < NEAR) | (stage == BRING)
        to = jnp.where(stage < NEAR, arm.first, arm.second)
        moves = (stage == NEAR) | (stage == REACH) | (stage == HOLD)
        next = jnp.where(moves, self._towards(arm.pos, end), arm.pos)
        return mine.step(arm, across, to, next, stage > GRIP), end

    def _ended(self, memory: HandOverMemory, reached: list, off: list) -> Bool[Array, ""]:
        """True if the stage is done, or its time is up.

        Args:
            reached: for giver and taker, whether the arm is at its first and at its second place.
            off: for giver and taker, how far the hand is from where it takes the object, or from over it [m].
        """
        time, way = (memory.count + 1) * self.dt, self.cfg.above / self.cfg.speed
        (over, meets), (waits, brought) = reached
        return jnp.stack(
            [
                over | (time > _LONGEST),
                (off[0] < _CLOSE) | (time > way + _SHORT),
                time > self._giver.closed,
                time > way + 0.1,
                meets & waits | (time > _LONGEST),
                (off[1] < _WITHIN) | (time > _SHORT),
                (off[1] < _CLOSE) | (time > way + _SHORT),
                time > self._taker.closed,
                time > self._giver.closed,
                time > way,
                brought | (time > _LONGEST),
                jnp.zeros((), bool),
            ]
        )[memory.stage]

    def _towards(self, pos: Float[Array, "3"], end: Float[Array, "3"]) -> Float[Array, "3"]:
        """One step of the way from ``pos`` to ``end``."""
        way = end - pos
        return pos + way * jnp.minimum(1.0, self.cfg.speed * self.dt / (jnp.linalg.norm(way) + 1e-6))

    def _seen(self, view: View) -> tuple[Float[Array, "3"], Float[Array, ""], Float[Array, ""]]:
        """The object's middle, and the heading and slope of its x axis."""
        seen = view.objects[self.cfg.object]
        axis = math.rotate(seen.quat_w, jnp.array([1.0, 0.0, 0.0]))
        return seen.pos_w, jnp.arctan2(axis[1], axis[0]), jnp.arcsin(jnp.clip(axis[2], -1.0, 1.0))

    @property
    def _up(self) -> Float[Array, "3"]:
        return jnp.array([0.0, 0.0, self.cfg.above])

    def warning(self, memory: HandOverMemory) -> str:
        """Says how many objects did not change hands."""
        stage = np.asarray(memory.stage)
        return (
            f"{(stage < BRING).sum()} of {stage.size} episodes ended before the object changed hands"
            if (stage < BRING).any()
            else ""
        )
