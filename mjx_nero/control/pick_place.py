"""Pick and place in ten phases, like Isaac Sim's controller of this name: by time alone, without planning."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative
from mjx_nero.control.follow_target import Motion, RmpCfg, mover
from mjx_nero.control.gripper import GRIP_FILTER, ParallelGripper
from mjx_nero.control.ik import IkCfg
from mjx_nero.control.rmpflow import Target
from mjx_nero.mdp.towers import GOAL
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError, View

_FASTEST = 1.0  # [m/s] a target that moves faster than this has jumped
PHASES = ("above pick", "down", "settle", "close", "up", "across", "down", "open", "up", "away")
_CLOSE, _OPEN = PHASES.index("close"), PHASES.index("open")


@dataclasses.dataclass(frozen=True)
class PickPlaceCfg:
    """Settings of the script.

    Attributes:
        events_dt: the share of each phase that one control step takes; a phase has ceil(1 / share) steps.
        wait: extra time of the fingers in the phases in which they close and open [s].
        end_effector_initial_height: height above the robot's root at which the grasp point travels [m].
        end_effector_offset: offset of the grasp point from the cube's centre [m]. The tutorial's 0.25 m is measured from the
            flange, and would press the fingertips 3 mm into the table; the grasp point lies 0.26 m beyond the flange.
        arc: travel from pick to place about the robot's axis; False: on a straight line.
        motion: what moves the arm: ``rmpflow``, or ``ik`` for a robot without RMPflow's files.
        rmpflow, ik: settings of the arm's motion.
        tower: the objects from the bottom up. Each is put onto the one before it. The first one stays where it is, or is the goal
            (see ``mdp.towers``).
        rise: height from the centre of an object to that of the one on it [m].
        turn: turns the hand to the object's heading, and then to the goal's.
    """

    # The tutorial's shares work, too, but take 96 s at 50 Hz. These take 17 s: the arc to the tutorial's goal turns the base by
    # up to 2.6 rad, which RMPflow's cap of 1 rad/s allows in the 5 s of phase 5.
    events_dt: tuple[float, ...] = (0.01, 0.0125, 0.05, 0.02, 0.0125, 0.004, 0.01, 0.025, 0.0125, 0.02)
    wait: NonNegative = 0.0
    end_effector_initial_height: float = 0.2
    end_effector_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # A straight line from the front to the tutorial's goal runs through the robot's base.
    arc: bool = True
    motion: Motion = "rmpflow"
    rmpflow: RmpCfg = RmpCfg()
    # Tight: the solver corrects at once, in a later step, what it leaves out now, and the drives' lead turns that into a kick.
    ik: IkCfg = IkCfg(position_tolerance=1e-5, orientation_tolerance=1e-4)
    tower: tuple[str, ...] = (GOAL, "cube")
    rise: float = 0.0
    turn: bool = False


Pose = Float[Array, "4"]  # position [m], and turn about the vertical [rad]


@struct.dataclass
class PickPlaceMemory:
    """The state of ``PickPlace`` between two steps."""

    move: Int[Array, ""]  # which object, from 0
    phase: Int[Array, ""]  # 0 to 9; 10: done
    count: Int[Array, ""]  # steps made in this phase
    start: Pose  # the grasp point where the way to this object began
    tilt: Float[Array, "3"]  # tilt of the hand there from pointing straight down: a rotation vector in its frame [rad]
    pick: Pose  # where the object was when the fingers last went for it
    grip: Float[Array, "3"]  # from the object to the grasp point, while it is carried, as if the hand were not turned
    target: Pose  # set-point of the grasp point
    setpoint: Float[Array, " nj"]  # set-point of the arm [rad]


class PickPlace:
    """Moves objects, one after another, to the goal or onto one another.

    | phase | 0 | 1 | 2 | 3 | 4 | 5 | 6 | 7 | 8 | 9 |
    | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
    | grasp point over | start to pick | pick | stays | stays | pick | pick to place | place | stays | place | place |
    | height | start to travel | down | stays | stays | up | travel | down | stays | up | travel |
    | fingers | open | open | open | close | closed | closed | closed | open | open | open |

    Time alone ends a phase. Differences from the tutorial: the travel height (0.6 m is out of reach over its goal), the arc, a
    smooth start, and a velocity target besides the position. The controller also observes where the object is in the grip and
    corrects for it, because the object slides by some millimetres in a turn (assets/cobotta_pro_900/README.md).

    Args:
        robot: the robot that picks, with its gripper straight down.
        dt: control step [s].
        cfg: see ``PickPlaceCfg``.

    Raises:
        UserError: ``events_dt`` is not ten shares in 0 to 1, or ``tower`` has nothing to move.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: PickPlaceCfg = PickPlaceCfg()):
        if len(cfg.events_dt) != len(PHASES) or not all(0 < share <= 1 for share in cfg.events_dt):
            raise UserError(f"events_dt takes {len(PHASES)} shares above 0 and up to 1, got {cfg.events_dt}")
        if len(cfg.tower) < 2:
            raise UserError(f"tower names what stays or {GOAL!r}, then one or more objects to put there, got {cfg.tower}")
        self.dt, self.cfg = dt, cfg
        # Integers: adding up shares in float32 gives other counts. The small term absorbs 1 / 0.05 = 20.000000000000004.
        self.steps = np.array([int(np.ceil(1 / share - 1e-6)) for share in cfg.events_dt], np.int32)
        self.steps[[_CLOSE, _OPEN]] += round(cfg.wait / dt)
        self.gripper = ParallelGripper(robot)
        self._move = mover(robot, dt, cfg.motion, cfg.rmpflow, cfg.ik)
        self._n, self._down = len(robot.arm.joints), np.array(robot.down, np.float32)
        self._offset = np.array(cfg.end_effector_offset, np.float32)
        self._moves = len(cfg.tower) - 1

    def init(self, view: View) -> PickPlaceMemory:
        """Starts phase 0 of the first object."""
        zero, start = jnp.zeros((), jnp.int32), jnp.append(view.ee_pos_w, 0.0)
        return PickPlaceMemory(
            move=zero,
            phase=zero,
            count=zero,
            start=start,
            tilt=math.quat_log(math.quat_mul(math.quat_conj(jnp.asarray(self._down)), view.ee_quat_w)),
            pick=self._pose(view, self.cfg.tower[1]),
            grip=jnp.asarray(self._offset),
            target=start,
            setpoint=view.joint_pos[: self._n],
        )

    def is_done(self, memory: PickPlaceMemory) -> Bool[Array, ""]:
        """True once all ten phases are over for all objects; the arm then stays where it is."""
        return memory.phase >= len(PHASES)

    def step(self, memory: PickPlaceMemory, view: View) -> tuple[PickPlaceMemory, Float[Array, " nu"]]:
        """Computes the targets of all drives."""
        phase = jnp.minimum(memory.phase, len(PHASES) - 1)
        steps = jnp.asarray(self.steps)[phase]
        seen = jnp.stack([self._pose(view, name) for name in self.cfg.tower[1:]])[memory.move]
        place = jnp.stack([self._place(view, below) for below in self.cfg.tower[:-1]])[memory.move]
        memory = dataclasses.replace(memory, pick=jnp.where(phase <= 1, seen, memory.pick))
        # Measured only while the object is carried, and limited to what can still be a grip. Horizontally it counts from the
        # target: an arm that yields to its load moves the object aside by more than the hand's own error.
        carried = (phase >= 4) & (phase <= 6)
        slip = _turned(memory.target[:3].at[2].set(view.ee_pos_w[2]) - seen[:3], -memory.target[3])
        slip = jnp.clip(slip, self._offset - 0.03, self._offset + 0.03)
        grip = memory.grip + jnp.where(carried, GRIP_FILTER, 0.0) * (slip - memory.grip)
        s = (1 - jnp.cos(jnp.pi * memory.count / steps)) / 2
        target = self._target(memory, s, place, grip, view.root_pos_w)
        stays = (phase == 2) | (phase == 3) | (phase == 7) | self.is_done(memory)
        target = jnp.where(stays, memory.target, target)

        setpoint, arm = self._arm(memory, view, target, jnp.where(phase == 0, (1 - s) * memory.tilt, 0.0))
        closing = (phase >= 3) & (phase <= 6)
        fingers = self.gripper.forward(closing, view.joint_pos[self._n :], view.ctrl[self._n :], self.dt)

        over = memory.count + 1 >= steps
        again = over & (phase == len(PHASES) - 1) & (memory.move + 1 < self._moves)
        memory = dataclasses.replace(
            memory,
            move=memory.move + again,
            phase=jnp.where(again, 0, jnp.minimum(memory.phase + over, len(PHASES))),
            count=jnp.where(over, 0, memory.count + 1),
            start=jnp.where(again, target, memory.start),
            tilt=jnp.where(again, 0.0, memory.tilt),
            grip=jnp.where(again, self._offset, grip),
            target=target,
            setpoint=setpoint,
        )
        return memory, jnp.concatenate([arm, fingers])

    def _pose(self, view: View, name: str) -> Pose:
        seen = view.objects[name]
        return jnp.append(seen.pos_w, math.yaw(seen.quat_w) if self.cfg.turn else 0.0)

    def _place(self, view: View, below: str) -> Pose:
        if below == GOAL:
            return jnp.append(view.goal_pos_w, math.yaw(view.goal_quat_w) if self.cfg.turn else 0.0)
        return self._pose(view, below) + jnp.array([0.0, 0.0, self.cfg.rise, 0.0])

    def _arm(self, memory: PickPlaceMemory, view: View, target: Pose, tilt) -> tuple[Float[Array, " nj"], Float[Array, " nj"]]:
        """The next set-point, and the targets of the arm's drives."""
        down = math.quat_mul(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), target[3]), jnp.asarray(self._down))
        velocity = (target - memory.target)[:3] / self.dt
        jump = jnp.linalg.norm(velocity) > _FASTEST
        wanted = Target(target[:3], math.quat_mul(down, math.quat_exp(tilt)), jnp.where(jump, 0.0, velocity))
        return self._move(memory.setpoint, view, wanted)

    def _target(self, memory: PickPlaceMemory, s, place: Pose, grip, root) -> Pose:
        phase, pick, start, center = memory.phase, memory.pick, memory.start, root[:2]
        over_pick = pick + jnp.append(_turned(self._offset, pick[3]), 0.0)
        over_place = place + jnp.append(_turned(grip, place[3]), 0.0)
        near, across = (
            _arc(a[:2], b[:2], s, center) if self.cfg.arc else _mix(a[:2], b[:2], s)
            for a, b in ((start, over_pick), (over_pick, over_place))
        )
        xy = jnp.select([phase == 0, phase <= 4, phase == 5], [near, over_pick[:2], across], over_place[:2])
        turn = jnp.select(
            [phase == 0, phase <= 4, phase == 5],
            [_mix(start[3], pick[3], s), pick[3], _mix(pick[3], place[3], s)],
            place[3],
        )
        travel, low, put = root[2] + self.cfg.end_effector_initial_height, over_pick[2], over_place[2]
        height = jnp.select(
            [phase == k for k in (0, 1, 4, 6, 8)],
            [_mix(a, b, s) for a, b in ((start[2], travel), (travel, low), (low, travel), (travel, put), (put, travel))],
            travel,
        )
        return jnp.concatenate([xy, jnp.stack([height, turn])])

    def warning(self, memory: PickPlaceMemory) -> str:
        """Says if the episodes were too short."""
        done = np.asarray(self.is_done(memory))
        if done.all():
            return ""
        long = self._moves * self.steps.sum() * self.dt
        return f"{(~done).sum()} of {done.size} episodes ended before the ten phases ({long:.1f} s)"


def _mix(a, b, s):
    return (1 - s) * a + s * b


def _turned(vec, angle: Float[Array, ""]) -> Float[Array, "3"]:
    return math.rotate(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), angle), jnp.asarray(vec))


def _arc(a: Float[Array, "2"], b: Float[Array, "2"], s, center: Float[Array, "2"]) -> Float[Array, "2"]:
    """Interpolates from ``a`` to ``b`` at a constant rate of angle and radius about ``center``, the short way round."""
    a, b = a - center, b - center
    start = jnp.arctan2(a[1], a[0])
    turn = jnp.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)
    angle = start + s * turn
    return center + _mix(jnp.linalg.norm(a), jnp.linalg.norm(b), s) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
