"""Picks an object up and puts it into a hole or over a post, from above. It searches if the hole is not where it should be."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Positive
from mjx_nero.control import setpoint
from mjx_nero.control.grasp_thing import GraspThing, GraspThingCfg
from mjx_nero.control.gripper import GRIP_FILTER
from mjx_nero.control.pick_up import ABOVE, CARRY, PickUp, PickUpCfg, PickUpMemory
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import View

PICK, OVER, IN, OPEN, AWAY = range(5)
_SLOW = 0.1  # [rad/s]
_UP, _STILL = np.array([0.0, 0.0, 1.0], np.float32), np.array([1.0, 0.0, 0.0, 0.0], np.float32)
_TURN, _TURN_SHARE = 1.0, 0.1  # [rad/s] greatest speed of the hand's turn; share of a missing turn made per step
_STANDS = 0.25  # share of the speed down: an object that is slower than this stands on something
_SHARE, _AHEAD = 0.06, 0.004  # share of an error along the table corrected per control step; their greatest sum [m]
# The same share while the object rubs on the rim, and the greatest speed of the search [rad/s]: a set-point that circles
# faster than errors are corrected leaves the object stuck where it is.
_RUBS, _ROUND = 0.2, 5.0
_OWN = 0.005  # [m] greatest error of the arm along each axis that is corrected above the goal
_CLEARS = 0.003  # [m] height of the object above the rim before it moves across
_STROKE = 0.005  # [m] depth below the rim at which an object is in
_CLOSE, _ALIGNED = 1.5e-3, 0.03  # [m, rad] greatest errors of an object that is over its place


@dataclasses.dataclass(frozen=True)
class PutInCfg:
    """Settings of the motion once the object is held.

    Attributes:
        pick: settings of the grasp.
        foot: distance of the object's lower end from its centre [m]. This end has to be over the hole.
        over: height over the goal from which the object comes down [m].
        top: height over the goal of the hole's rim or the post's tip, on which an object that misses comes to stand [m].
        turns: how many turns of the object about the vertical look the same; 0: it is round.
        speed: speed on the way down [m/s].
        press: greatest depth of the set-point below the hand while the object stands on the rim [m].
        push: greatest depth of the set-point below the hand elsewhere, such as in the hole [m].
        reach: greatest radius of the search, a spiral about the goal [m]; 0: none.
        pitch: pitch of the spiral [m].
        sweep: speed along the spiral [m/s].
        done: height over the goal at or below which the object counts as inserted [m].
        patience: time for the way down, after which the hand begins again above the goal [s].
        away: how far the hand rises once it has let go [m].
    """

    pick: PickUpCfg = PickUpCfg()
    foot: NonNegative = 0.0
    over: Positive = 0.04
    top: Positive = 0.025
    turns: int = 0
    speed: Positive = 0.04
    press: Positive = 0.001
    push: Positive = 0.008
    reach: NonNegative = 0.0
    pitch: Positive = 5e-4
    sweep: Positive = 0.005
    done: Positive = 0.002
    patience: Positive = 3.5
    away: Positive = 0.06


@dataclasses.dataclass(frozen=True)
class PutThingCfg(PutInCfg):
    """``PutInCfg`` for a mesh object, which is picked up by its own grasps."""

    pick: GraspThingCfg = GraspThingCfg()


@struct.dataclass
class PutInMemory:
    """The state of ``PutIn`` between two steps."""

    pick: PickUpMemory  # its set-point is the arm's in all stages
    stage: Int[Array, ""]
    count: Int[Array, ""]  # steps made in this stage
    grip: Float[Array, "3"]  # from the object to the set-point of the grasp point [m]
    turned: Float[Array, ""]  # how far the search has gone along its spiral [rad]
    upright: Float[Array, "4"]  # turns a hand that points down so that the object is as upright as at the goal


class PutIn:
    """Carries the object over the goal, lowers it, lets go and leaves.

    | stage | pick | over | in | open | away |
    | --- | --- | --- | --- | --- | --- |
    | hand | ``PickUp`` | over the goal, the object turned to fit | down, searching if it stands on something | stays | up |

    If the object presses on the rim, the hand moves it along a spiral until it drops. In the hole, the arm yields sideways.

    Args:
        robot: the robot that picks.
        dt: control step [s].
        cfg: see ``PutInCfg``.
    """

    picker: Any = PickUp

    def __init__(self, robot: RobotCfg, dt: float, cfg: PutInCfg = PutInCfg()):
        self.dt, self.cfg = dt, cfg
        self._pick = self.picker(robot, dt, cfg.pick)
        self._n, self._speed, self._lead = len(robot.arm.joints), np.array(robot.arm.speed, np.float32), self._pick.lead
        self._object = cfg.pick.object

    def init(self, view: View) -> PutInMemory:
        """Starts the grasp."""
        zero = jnp.zeros((), jnp.int32)
        return PutInMemory(self._pick.init(view), zero, zero, jnp.zeros(3), jnp.zeros(()), jnp.asarray(_STILL))

    def step(self, memory: PutInMemory, view: View) -> tuple[PutInMemory, Float[Array, " nu"]]:
        """Computes the targets of all drives."""
        picked, targets = self._pick.step(memory.pick, view)
        put, arm = self._put(memory, view)
        picking = memory.stage == PICK
        pick = jax.tree.map(lambda a, b: jnp.where(picking, a, b), picked, put.pick)
        begun = picking & (picked.phase == CARRY)
        grip = jnp.where(picking, picked.grip, put.grip)
        memory = dataclasses.replace(
            put,
            pick=pick,
            stage=jnp.where(picking, jnp.where(begun, OVER, PICK), put.stage),
            count=jnp.where(picking, 0, put.count),
            grip=grip,
            upright=jnp.where(picking, jnp.asarray(_STILL), put.upright),
        )
        return memory, jnp.where(picking, targets, arm)

    def _put(self, memory: PutInMemory, view: View) -> tuple[PutInMemory, Float[Array, " nu"]]:
        """Makes one step of the stages after the grasp."""
        stage, pick, seen = memory.stage, memory.pick, view.objects[self._object]
        slow = jnp.max(jnp.abs(pick.qd)) < _SLOW
        # Above the goal, turns are corrected relative to the commanded hand, because the hand lags on its way there.
        told = math.quat_mul(math.quat_mul(memory.upright, self._pick.hand(pick.yaw)), math.quat_conj(view.ee_quat_w))
        turned = jnp.where(stage == OVER, math.quat_mul(told, seen.quat_w), seen.quat_w)
        off, lacks = self._off(view, seen.quat_w), self._off(view, turned)
        end = self._end(view)
        way = view.goal_pos_w - end
        steers = (stage == OVER) | (stage == IN) & (-way[2] > self.cfg.top - _STROKE)
        leans = jnp.cross(math.rotate(turned, self._own_up(view)), jnp.asarray(_UP))
        upright = math.quat_mul(math.quat_exp(jnp.where(steers, _SHARE, 0.0) * leans), memory.upright)
        share = jnp.where((stage == OVER) & slow, GRIP_FILTER, 0.0)
        # Measured from the set-point, so that the arm's own error is corrected as well, but not the lag of an arm on its way.
        own = view.ee_pos_w + jnp.clip(pick.pos - view.ee_pos_w, -_OWN, _OWN)
        grip = memory.grip + share * (own - end - memory.grip)
        turn = jnp.clip(_TURN_SHARE * lacks, -_TURN * self.dt, _TURN * self.dt)
        yaw = pick.yaw + jnp.where(steers, turn, 0.0)
        pos, sought = self._position(memory, view, grip, end)

        quat, weight = math.quat_mul(upright, self._pick.hand(yaw)), self._pick.cfg.ik.orientation_weight
        found, anew = self._pick.solved(pick, view, pos, quat, weight)
        wanted = jnp.where(stage == OPEN, pick.q, found)
        fastest = jnp.where(stage == AWAY, setpoint.FASTEST, self._pick.gentle)
        q, qd = setpoint.follow(pick.q, pick.qd, wanted, jnp.asarray(self._speed), self.dt, fastest)
        fingers = self._pick.fingers(pick, view, stage < OPEN)

        lost = ((stage == OVER) | (stage == IN)) & (self._pick.off(pick, view) > self._pick.lost)
        again = (stage == IN) & ((memory.count + 1) * self.dt > self.cfg.patience)
        ended = self._ended(memory, way, off)
        following = jnp.where(lost, PICK, jnp.where(ended, stage + 1, jnp.where(again, OVER, stage)))
        pick = dataclasses.replace(
            jax.tree.map(functools.partial(jnp.where, lost), anew, pick),
            phase=jnp.where(lost, ABOVE, pick.phase),
            count=jnp.where(lost, 0, pick.count),
            q=q,
            qd=qd,
            pos=pos,
            tries=pick.tries + (lost | again & ~ended),
        )
        pick = dataclasses.replace(pick, yaw=jnp.where(lost, pick.yaw, yaw))
        fresh = following != stage
        count = jnp.where(fresh, 0, memory.count + 1)
        after = PutInMemory(pick, following, count, grip, jnp.where(fresh, 0.0, sought), upright)
        return after, jnp.concatenate([q + self._lead * qd, fingers])

    def _position(
        self, memory: PutInMemory, view: View, grip: Float[Array, "3"], seen: Float[Array, "3"]
    ) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """Returns the set-point of the grasp point and how far the search has gone."""
        cfg, stage, pos = self.cfg, memory.stage, memory.pick.pos
        goal, step, falls = view.goal_pos_w, cfg.speed * self.dt, -view.objects[self._object].linvel_w[2]
        # Up, and once above the rim across, at the grasp's speed.
        way = goal + jnp.array([0.0, 0.0, cfg.over]) + grip - pos
        way = jnp.where(seen[2] - goal[2] > cfg.top + _CLEARS, way, way * jnp.asarray(_UP))
        far = jnp.linalg.norm(way)
        over = pos + way * jnp.minimum(1.0, self._pick.cfg.speed * self.dt / (far + 1e-6))
        # Down, but never far below the hand.
        height = seen[2] - goal[2]
        entered = height < cfg.top - _STROKE
        press = jnp.where(entered | (height > cfg.top + _STROKE), cfg.push, cfg.press)
        low = jnp.maximum(pos[2] - step, jnp.maximum(view.ee_pos_w[2] - press, goal[2] + grip[2] - press))
        stands = ~entered & (height < cfg.top + _STROKE) & (falls < _STANDS * cfg.speed)
        radius = cfg.pitch * memory.turned / (2 * jnp.pi)
        speed = jnp.minimum(_ROUND, cfg.sweep / jnp.maximum(radius, cfg.pitch))
        turned = memory.turned + jnp.where(stands & (cfg.reach > 0), speed * self.dt, 0.0)
        turned = jnp.where(radius > cfg.reach, 0.0, turned)
        aside = jnp.minimum(radius, cfg.reach) * jnp.stack([jnp.cos(turned), jnp.sin(turned)])
        # Above the rim the set-point moves on until the object follows, however it sticks; below, the arm yields to the walls.
        sought = pos[:2] + jnp.where(stands, _RUBS, _SHARE) * (goal[:2] + aside - seen[:2])
        sought = jnp.clip(sought, goal[:2] + grip[:2] - _AHEAD, goal[:2] + grip[:2] + _AHEAD)
        beside = jnp.where(entered, pos[:2] + _SHARE * (view.ee_pos_w[:2] - pos[:2]), sought)
        down = jnp.append(beside, low)
        rise = self._pick.cfg.speed * self.dt
        up = pos + jnp.array([0.0, 0.0, 1.0]) * jnp.where(memory.count * rise < cfg.away, rise, 0.0)
        return jnp.select([stage == OVER, stage == IN, stage == AWAY], [over, down, up], pos), turned

    def _end(self, view: View) -> Float[Array, "3"]:
        """The place of the object's centre if it stood upright on the same end [m]."""
        seen = view.objects[self._object]
        return seen.pos_w + self.cfg.foot * (jnp.asarray(_UP) - math.rotate(seen.quat_w, self._own_up(view)))

    @staticmethod
    def _own_up(view: View) -> Float[Array, "3"]:
        """The object's own direction that is up at the goal, since a thing may belong there on any of its sides."""
        return math.rotate(math.quat_conj(view.goal_quat_w), jnp.asarray(_UP))

    def _ended(self, memory: PutInMemory, way: Float[Array, "3"], off: Float[Array, ""]) -> Bool[Array, ""]:
        """True if the stage is done, or its time is up."""
        time = (memory.count + 1) * self.dt
        there = (jnp.linalg.norm(way[:2]) < _CLOSE) & (jnp.abs(off) < _ALIGNED)
        return jnp.select(
            [memory.stage == OVER, memory.stage == IN, memory.stage == OPEN],
            [there | (time > 4.0), -way[2] < self.cfg.done, time > self._pick.closed],
            False,
        )

    def _off(self, view: View, quat: Float[Array, "4"]) -> Float[Array, ""]:
        """Angle about the vertical from the object to the goal, the shortest of those that look the same [rad]."""
        if not self.cfg.turns:
            return jnp.zeros(())
        most = jnp.pi / self.cfg.turns
        lacks = math.yaw(math.quat_mul(view.goal_quat_w, math.quat_conj(quat)))
        return jnp.mod(lacks + most, 2 * most) - most

    def warning(self, memory: PutInMemory) -> str:
        """Says how many objects were lost, or did not go in at the first try."""
        tries = np.asarray(memory.pick.tries)
        return f"{(tries > 0).sum()} of {tries.size} episodes lost the object, or began again" if tries.any() else ""


class PutThing(PutIn):
    """``PutIn`` for a mesh object."""

    picker = GraspThing
