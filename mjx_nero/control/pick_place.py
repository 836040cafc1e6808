"""Pick and place in ten phases over RMPflow, as Isaac Sim's controller of this name: purely by time, without any planning."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero.control.follow_target import RmpCfg, RmpFollower
from mjx_nero.control.gripper import ParallelGripper
from mjx_nero.control.rmpflow import Target
from mjx_nero.robots import RobotCfg
from mjx_nero.types import UserError, View

_FASTEST = 1.0  # [m/s]: a target that moves on faster has jumped
# Share of a new measurement in the place in the grip: unfiltered, the arm would follow its own tremor.
_GRIP_FILTER = 0.05
PHASES = ("above pick", "down", "settle", "close", "up", "across", "down", "open", "up", "away")


@dataclasses.dataclass(frozen=True)
class PickPlaceCfg:
    """Arguments of the controller; lengths in m.

    Attributes:
        events_dt: the share of each phase that one control step takes; a phase has ceil(1 / share) steps.
        end_effector_initial_height: of the grasp point above the cube's table, while it travels.
        end_effector_offset: of the grasp point from the cube's centre. The tutorial's 0.25 m counts from the flange and would
            press the fingertips 3 mm into the table; the grasp point lies 0.26 m beyond the flange.
        arc: travel from pick to place about the robot's axis; False: on a straight line.
        rmpflow: of the arm's motion.
    """

    # The tutorial's shares work, too, but take 96 s at 50 Hz. These take 17 s: the arc to the tutorial's goal turns the base by
    # up to 2.6 rad, which RMPflow's cap of 1 rad/s allows in the 5 s of phase 5.
    events_dt: tuple[float, ...] = (0.01, 0.0125, 0.05, 0.02, 0.0125, 0.004, 0.01, 0.025, 0.0125, 0.02)
    end_effector_initial_height: float = 0.2
    end_effector_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # A straight line from the front to the tutorial's goal runs through the robot's base.
    arc: bool = True
    rmpflow: RmpCfg = RmpCfg()


@struct.dataclass
class PickPlaceMemory:
    """Between two steps of ``PickPlace``."""

    phase: Int[Array, ""]  # 0 to 9; 10: done
    count: Int[Array, ""]  # steps made in this phase
    pick: Float[Array, "3"]  # where the cube was when the fingers last went for it
    grip: Float[Array, "3"]  # from the cube to the grasp point, while it is carried
    target: Float[Array, "3"]  # of the grasp point


class PickPlace:
    """Moves the object to the goal.

    | phase | 0 | 1 | 2 | 3 | 4 | 5 | 6 | 7 | 8 | 9 |
    | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
    | grasp point over | pick | pick | stays | stays | pick | pick to place | place | stays | place | place |
    | height | travel | down | stays | stays | up | travel | down | stays | up | travel |
    | fingers | open | open | open | close | closed | closed | closed | open | open | open |

    Time alone changes phase. Not as in the tutorial: the height of the travel (0.6 m is out of reach over its goal), the arc, a
    velocity target beside the position, and that the cube's own place in the grip is seen and made up for while it is carried,
    since it slides by some millimetres in a turn (assets/cobotta_pro_900/README.md).

    Args:
        robot: what picks, gripper straight down.
        dt: control step [s].
        cfg: see ``PickPlaceCfg``.

    Raises:
        UserError: ``events_dt`` has not ten shares in 0 to 1.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: PickPlaceCfg = PickPlaceCfg()):
        if len(cfg.events_dt) != len(PHASES) or not all(0 < share <= 1 for share in cfg.events_dt):
            raise UserError(f"events_dt takes {len(PHASES)} shares above 0 and up to 1, got {cfg.events_dt}")
        self.dt, self.cfg = dt, cfg
        # Integers: adding up shares in float32 gives other counts. The small part forgives 1 / 0.05 = 20.000000000000004.
        self.steps = np.array([int(np.ceil(1 / share - 1e-6)) for share in cfg.events_dt], np.int32)
        self.gripper = ParallelGripper(robot)
        self._arm = RmpFollower(robot, dt, cfg.rmpflow)
        self._n, self._down = len(robot.arm.joints), np.array(robot.down, np.float32)
        self._offset = np.array(cfg.end_effector_offset, np.float32)

    def init(self, view: View) -> PickPlaceMemory:
        """At the start of phase 0."""
        zero = jnp.zeros((), jnp.int32)
        return PickPlaceMemory(zero, zero, view.object_pos_w, jnp.asarray(self._offset), view.ee_pos_w)

    def is_done(self, memory: PickPlaceMemory) -> Bool[Array, ""]:
        """All ten phases are over; the arm then stays where it is."""
        return memory.phase >= len(PHASES)

    def step(self, memory: PickPlaceMemory, view: View) -> tuple[PickPlaceMemory, Float[Array, " nu"]]:
        """Targets of all drives."""
        phase = jnp.minimum(memory.phase, len(PHASES) - 1)
        steps = jnp.asarray(self.steps)[phase]
        share = memory.count / steps
        pick = jnp.where(phase <= 1, view.object_pos_w, memory.pick)
        # Only while it is carried, and only what can still be a grip.
        carried = (phase >= 4) & (phase <= 6)
        slip = jnp.clip(view.ee_pos_w - view.object_pos_w, self._offset - 0.03, self._offset + 0.03)
        grip = memory.grip + jnp.where(carried, _GRIP_FILTER, 0.0) * (slip - memory.grip)
        target = self._target(phase, share, pick, view.goal_pos_w, grip, view.root_pos_w)
        stays = (phase == 2) | (phase == 3) | (phase == 7) | self.is_done(memory)
        target = jnp.where(stays, memory.target, target)

        velocity = (target - memory.target) / self.dt
        jump = jnp.linalg.norm(velocity) > _FASTEST
        arm = self._arm.arm(view, Target(target, jnp.asarray(self._down), jnp.where(jump, 0.0, velocity)))
        closing = (phase >= 3) & (phase <= 6)
        fingers = self.gripper.forward(closing, view.joint_pos[self._n :], view.ctrl[self._n :], self.dt)

        over = memory.count + 1 >= steps
        memory = PickPlaceMemory(
            phase=jnp.minimum(memory.phase + over, len(PHASES)),
            count=jnp.where(over, 0, memory.count + 1),
            pick=pick,
            grip=grip,
            target=target,
        )
        return memory, jnp.concatenate([arm, fingers])

    def _target(self, phase, share, pick, place, grip, root) -> Float[Array, "3"]:
        s = (1 - jnp.cos(jnp.pi * share)) / 2
        travel = root[2] + self.cfg.end_effector_initial_height
        low_pick, low_place = pick[2] + self._offset[2], place[2] + grip[2]
        over_pick = pick[:2] + self._offset[:2]
        over_place = place[:2] + grip[:2]
        across = _arc(over_pick, over_place, s, root[:2]) if self.cfg.arc else _mix(over_pick, over_place, s)
        xy = jnp.where(phase <= 4, over_pick, jnp.where(phase == 5, across, over_place))
        height = jnp.select(
            [phase == 1, phase == 4, phase == 6, phase == 8],
            [_mix(travel, low_pick, s), _mix(low_pick, travel, s), _mix(travel, low_place, s), _mix(low_place, travel, s)],
            travel,
        )
        return jnp.concatenate([xy, height[None]])

    def warning(self, memory: PickPlaceMemory) -> str:
        """Says if the episodes were too short."""
        done = np.asarray(self.is_done(memory))
        if done.all():
            return ""
        return f"{(~done).sum()} of {done.size} episodes ended before the ten phases ({self.steps.sum() * self.dt:.1f} s)"


def _mix(a, b, s):
    return (1 - s) * a + s * b


def _arc(a: Float[Array, "2"], b: Float[Array, "2"], s, center: Float[Array, "2"]) -> Float[Array, "2"]:
    """From ``a`` to ``b`` at a constant rate of angle and radius about ``center``, the short way round."""
    a, b = a - center, b - center
    start = jnp.arctan2(a[1], a[0])
    turn = jnp.arctan2(a[0] * b[1] - a[1] * b[0], a @ b)
    angle = start + s * turn
    return center + _mix(jnp.linalg.norm(a), jnp.linalg.norm(b), s) * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
