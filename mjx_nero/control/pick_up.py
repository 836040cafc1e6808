"""Picks an object up from above, with the hand turned to fit it, and holds it at the goal."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import Positive
from mjx_nero.control import setpoint
from mjx_nero.control.gripper import GRIP_FILTER, ParallelGripper
from mjx_nero.control.ik import IkCfg, InverseKinematics
from mjx_nero.sim import grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError, View

ABOVE, DOWN, CLOSE, UP, CARRY = range(5)
_CHOICES = 8  # number of turns of the hand to consider
UNREACHABLE = 100.0  # cost of a pose out of reach, in radians of joint motion
_ROOM_COUNTS = 60.0  # [rad/m] joint motion that a metre of room for the fingers is worth
_LOST = 0.05  # [m] distance from its place in a good grasp beyond which the object has been lost
_SLOW = 0.2  # [rad/s]
_THERE = 0.02  # [rad] tolerance within which an arm has arrived where it was sent, even if that is beside a place out of reach
_STILL = 0.05  # [1/s] share of their way: fingers that close more slowly have met something
# [m/rad] weight of the hand's orientation at the goal. Where the hand has to lean, more leaves it centimetres beside the goal.
_HELD = 0.003
# [rad] On its way down the hand waits while a joint lags by more. Only then do all joints lag alike (``setpoint.follow``);
# otherwise the hand leaves its line and lands on the object.
_BEHIND = 0.1


@dataclasses.dataclass(frozen=True)
class PickUpCfg:
    """Settings of the grasp and its speed.

    Attributes:
        object: name of the object to pick up.
        heading: for each object that may be commanded (``View.target``), the axis that lies across the opening of the hand when
            the fingers fit: 0, 1 or 2.
        turns: for each of these objects, how many turns about the vertical look the same; 0: it is round.
        aside: for each of these objects, offset of the pads' middle from its usual place along the opening [m] (``grasp.aside``);
            empty: none.
        lowest: least height of the pads' middle above the robot's root [m].
        beyond: how far the pads' middle is below the grasp point [m].
        above: height over the object from which the hand comes down, and to which it lifts the object before carrying it away
            [m].
        speed: speed of the grasp point [m/s].
        closing: time that the fingers take to close [s], besides the lag of their drives.
        ik: settings of the arm's motion. Orientation has little weight, least at the goal: a hand that cannot point down leans.
    """

    object: str = "cube"
    heading: tuple[int, ...] = (0,)
    turns: tuple[int, ...] = (4,)
    aside: tuple[float, ...] = ()
    lowest: float = 0.0
    beyond: float = 0.0
    above: Positive = 0.08
    speed: Positive = 0.3
    closing: Positive = 0.3
    ik: IkCfg = IkCfg(orientation_weight=0.01, restarts=3)


@struct.dataclass
class PickUpMemory(setpoint.Script):
    """The state of ``PickUp`` between two steps."""

    above: Float[Array, " nj"]  # the arm over the object [rad]
    pos: Float[Array, "3"]  # set-point of the grasp point [m]
    pick: Float[Array, "3"]  # where the grasp point has to be to grasp [m]
    yaw: Float[Array, ""]  # the hand's turn about the vertical [rad]
    grip: Float[Array, "3"]  # from the object to the set-point, while it is carried [m]


class PickUp:
    """Grasps the object from above and holds it at the goal. If the object slips out, it tries again.

    | phase | above | down | close | up | to the goal |
    | --- | --- | --- | --- | --- | --- |
    | grasp point | over the object | at the object | stays | over where the object lay | carries it to the goal |
    | fingers | open | open | close | closed | closed |

    A phase ends when the arm has arrived, or when its time is up. Of the turns of the hand that fit the object and that the arm
    can reach, it takes one with much room for the fingers beside other objects, and with little way to go.

    Args:
        robot: the robot that picks.
        dt: control step [s].
        cfg: see ``PickUpCfg``.

    Attributes:
        gripper, ik: the hand's fingers, and the arm's kinematics.
        lead: how far the arm's targets lead its set-point, by joint [s].
        gentle: greatest acceleration of the arm with the object in its hand [rad/s2].
        closed, pressed, finger_step: time after which the fingers have closed [s], and after which they press if something has
            stopped them; how far they move in a step.
        lost: distance of the object from its place in the hand beyond which it counts as lost [m].

    Raises:
        UserError: ``heading``, ``turns`` or ``aside`` differ in length, or name no axis.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: PickUpCfg = PickUpCfg()):
        if len(cfg.heading) != len(cfg.turns) or not set(cfg.heading) <= {0, 1, 2} or min(cfg.turns, default=-1) < 0:
            raise UserError(f"heading and turns take an axis (0 to 2) and a number per object, got {cfg.heading} and {cfg.turns}")
        if cfg.aside and len(cfg.aside) != len(cfg.turns):
            raise UserError(f"aside takes one value per object, got {cfg.aside} for {len(cfg.turns)}")
        self.dt, self.cfg = dt, cfg
        self._n, self._opening = len(robot.arm.joints), np.array(grasp.opening(robot), np.float32)
        self._down, self._grip = np.array(robot.down, np.float32), np.array(robot.grip, np.float32)
        same = cfg.aside[0] if len({*cfg.aside}) == 1 else 0.0
        self._point = self._grip + same * self._opening  # point of the hand that has to be at the object
        x, y, z = map(float, self._point)
        self.gripper, self.ik = ParallelGripper(robot), InverseKinematics(robot, cfg=cfg.ik, point=(x, y, z))
        self.lead, self._speed = np.array(robot.arm.lead, np.float32), np.array(robot.arm.speed, np.float32)
        self.gentle = setpoint.gentle(robot.arm.lead)
        self.closed, self.finger_step = self.gripper.pace(cfg.closing, dt)
        lag = float(np.max(robot.gripper.lead, initial=0.0))
        self.pressed = self.closed - lag
        self._closing = np.subtract(robot.gripper.close, robot.gripper.open).astype(np.float32)  # the fingers' way
        self.lost = float(np.linalg.norm(robot.grip)) + _LOST
        self._reach = robot.opening / 2  # distance of a finger from the grasp point
        # Relative to an object's heading; a round object has none.
        angles = [np.arange(_CHOICES) * 2 * np.pi / (turns or _CHOICES) for turns in cfg.turns]
        self._choices = np.array(angles, np.float32)

    def init(self, view: View) -> PickUpMemory:
        """Starts the first phase."""
        q, zero = view.joint_pos[: self._n], jnp.zeros((), jnp.int32)
        angles = self._angles(view)
        quats = jax.vmap(self.hand)(angles)
        picks = jax.vmap(self._pick, (None, 0))(view, angles)
        over, way = self.reaching(q, picks, quats)
        best = jnp.argmin(way - _ROOM_COUNTS * self._room(view, angles))
        above, pick, yaw = over[best], picks[best], angles[best]
        return PickUpMemory(zero, zero, q, jnp.zeros_like(q), zero, above, pick + self._up, pick, yaw, jnp.zeros(3))

    def reaching(
        self, q: Float[Array, " nj"], picks: Float[Array, "n 3"], quats: Float[Array, "n 4"]
    ) -> tuple[Float[Array, "n nj"], Float[Array, " n"]]:
        """Returns the joints over each grasp, and the way there from ``q`` [rad]; the way to what is out of reach is longer."""
        starts = jnp.broadcast_to(q, (len(picks), self._n))
        path = jnp.stack([picks + self._up, picks]), jnp.stack([quats, quats])
        found = self.ik.solve_path(*path, starts, jax.random.PRNGKey(0))
        return found.q[0], jnp.linalg.norm(found.q[0] - q, axis=1) + UNREACHABLE * ~jnp.all(found.success, axis=0)

    def step(self, memory: PickUpMemory, view: View) -> tuple[PickUpMemory, Float[Array, " nu"]]:
        """Computes the targets of all drives."""
        phase, seen = memory.phase, view.objects[self.cfg.object].pos_w
        # Measured from the set-point, while the arm hardly moves, so that the arm's own error is corrected as well.
        off, slow = memory.pos - seen, jnp.max(jnp.abs(memory.qd)) < _SLOW
        grip = jnp.where(phase == CLOSE, off, memory.grip)
        grip += jnp.where((phase == CARRY) & slow, GRIP_FILTER, 0.0) * (off - grip)

        over = memory.pick + self._up
        wanted = jnp.select([phase == CARRY, (phase == DOWN) | (phase == CLOSE)], [view.goal_pos_w + grip, memory.pick], over)
        way = wanted - memory.pos
        far = jnp.linalg.norm(way)
        pos = jnp.where(phase == ABOVE, over, memory.pos + way * jnp.minimum(1.0, self.cfg.speed * self.dt / (far + 1e-6)))
        upright = jnp.where(phase == CARRY, min(_HELD, self.cfg.ik.orientation_weight), self.cfg.ik.orientation_weight)
        found, anew = self.solved(memory, view, pos, self.hand(memory.yaw), upright)
        waits = (phase == DOWN) & (jnp.max(jnp.abs(found - memory.q)) > _BEHIND)
        pos = jnp.where(waits, memory.pos, pos)
        wanted_q = jnp.where(phase == ABOVE, memory.above, found)
        fastest = jnp.where(phase <= DOWN, setpoint.FASTEST, self.gentle)
        q, qd = setpoint.follow(memory.q, memory.qd, wanted_q, jnp.asarray(self._speed), self.dt, fastest)

        fingers = self.fingers(memory, view, phase >= CLOSE)
        lost = (phase >= UP) & (self.off(memory, view) > self.lost)
        falls = (phase == ABOVE) & (memory.tries > 0)
        held, meant = (math.rotate(quat, jnp.asarray(self._point)) for quat in (view.ee_quat_w, self.hand(memory.yaw)))
        there = jnp.max(jnp.abs(view.joint_pos[: self._n] - memory.above)) < _THERE
        arrived = jnp.where(phase == ABOVE, there, far < 1e-3)
        gripped = jnp.all(view.joint_vel[self._n :] * self._closing <= _STILL * self._closing**2)
        ended = self._ended(memory, jnp.linalg.norm(view.ee_pos_w + held - meant - wanted), arrived, gripped)
        memory = dataclasses.replace(
            jax.tree.map(functools.partial(jnp.where, lost | falls), anew, memory),
            phase=jnp.where(lost, ABOVE, phase + ended),
            count=jnp.where(lost | ended, 0, memory.count + 1),
            q=q,
            qd=qd,
            pos=pos,
            grip=grip,
            tries=memory.tries + lost,
        )
        return memory, jnp.concatenate([q + self.lead * qd, fingers])

    def fingers(self, memory: PickUpMemory, view: View, closes: Bool[Array, ""]) -> Float[Array, " ng"]:
        """Computes the targets of the fingers' drives."""
        return self.gripper.paced(closes, view.ctrl[self._n :], self.finger_step)

    def off(self, memory: PickUpMemory, view: View) -> Float[Array, ""]:
        """Distance of the grasp point from where the object is to be held [m]."""
        return jnp.linalg.norm(view.ee_pos_w - view.objects[self.cfg.object].pos_w)

    def _ended(
        self, memory: PickUpMemory, error: Float[Array, ""], arrived: Bool[Array, ""], gripped: Bool[Array, ""]
    ) -> Bool[Array, ""]:
        """True if the phase is done, or its time is up.

        Args:
            error: position error of the grasp point [m].
            arrived: the arm is as near to the place above the object as it comes; in later phases, the set-point has arrived.
            gripped: the fingers close no further.
        """
        time = (memory.count + 1) * self.dt
        still = jnp.max(jnp.abs(memory.qd)) < 0.1
        return jnp.select(
            [memory.phase == ABOVE, memory.phase == DOWN, memory.phase == CLOSE, memory.phase == UP],
            [
                (error < 0.01) | still & arrived | (time > 2.5),
                arrived & (still & (error < 0.004) | (time > 0.8)) | (time > 1.5),
                (time > self.closed) | gripped & (time > self.pressed),
                arrived | (time > 1.0),
            ],
            False,
        )

    def solved(
        self, memory: PickUpMemory, view: View, pos: Float[Array, "3"], quat: Float[Array, "4"], weight: float | Array
    ) -> tuple[Float[Array, " nj"], PickUpMemory]:
        """Solves a pose of the hand from the set-point, and beside it the plan for a lost object: one solver compiles faster."""
        anew = self.again(memory, view)
        each = (pos, anew.pick + self._up), (quat, self.hand(anew.yaw)), (memory.q, memory.above)
        poses, quats, starts = map(jnp.stack, each)
        found = self.ik.each(poses, quats, starts, jnp.array([weight, self.cfg.ik.orientation_weight])).q
        return found[0], dataclasses.replace(anew, above=found[1])

    def again(self, memory: PickUpMemory, view: View) -> PickUpMemory:
        """Plans again for a lost object, turning the hand as little as possible, without a search. Leaves the joints over it."""
        angles = self._angles(view)
        off = jnp.mod(angles - memory.yaw + jnp.pi, 2 * jnp.pi) - jnp.pi
        yaw = memory.yaw + off[jnp.argmin(jnp.abs(off))]
        return dataclasses.replace(memory, pick=self._pick(view, yaw), yaw=yaw)

    @property
    def _up(self) -> Float[Array, "3"]:
        return jnp.array([0.0, 0.0, self.cfg.above])

    def _angles(self, view: View) -> Float[Array, " n"]:
        """Turns of the hand about the vertical that fit the object [rad]."""
        index = 0 if view.target is None else view.target
        axis = math.rotation_matrix(view.objects[self.cfg.object].quat_w)[:, jnp.array(self.cfg.heading)[index]]
        round = jnp.array(self.cfg.turns)[index] == 0
        return jnp.where(round, 0.0, jnp.arctan2(axis[1], axis[0])) + jnp.asarray(self._choices)[index]

    def _pick(self, view: View, yaw: Float[Array, ""]) -> Float[Array, "3"]:
        """Computes where the grasp point must be."""
        aside = jnp.array(self.cfg.aside or (0.0,))[0 if view.target is None else view.target]
        return self.around(view, view.objects[self.cfg.object].pos_w, yaw, aside)

    def around(self, view: View, middle: Float[Array, "3"], yaw: Float[Array, ""], aside: Float[Array, ""]) -> Float[Array, "3"]:
        """Computes where the grasp point must be so that the pads hold what is at ``middle``, without touching the table [m].

        Args:
            aside: offset of the pads' middle from its usual place along the opening [m].
        """
        table = view.root_pos_w[2]
        low = jnp.maximum(0.0, grasp.CLEAR - (middle[2] - table) / 2)  # a low object must not be at the pads' lower edges
        height = jnp.maximum(middle[2], table + self.cfg.lowest - low) + self.cfg.beyond
        return middle.at[2].set(height) - math.rotate(self.hand(yaw), jnp.asarray(self._grip) + aside * self._opening)

    def _room(self, view: View, angles: Float[Array, " n"]) -> Float[Array, " n"]:
        """Distance from the open fingers to the nearest of the other objects' centres [m], at most half the hand's opening."""
        middle = view.objects[self.cfg.object].pos_w[:2]
        tips = self._reach * jnp.stack([-jnp.sin(angles), jnp.cos(angles)], axis=1)  # the fingers open along the hand's y
        others = jnp.stack([other.pos_w for other in view.objects.values()])[:, :2] - middle
        far = jnp.linalg.norm(others[:, None, None] - jnp.stack([tips, -tips]), axis=-1)
        itself = jnp.linalg.norm(others, axis=1) < 1e-3
        return jnp.min(jnp.where(itself[:, None, None], jnp.inf, far), axis=(0, 1), initial=self._reach)

    def hand(self, yaw: Float[Array, ""]) -> Float[Array, "4"]:
        """The hand's orientation in the world: it points down, turned by ``yaw`` [rad] about the vertical."""
        return math.quat_mul(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), yaw), jnp.asarray(self._down))

    def warning(self, memory: PickUpMemory) -> str:
        """Says how many objects were lost."""
        tries = np.asarray(memory.tries)
        return f"{(tries > 0).sum()} of {tries.size} episodes lost the object and tried again" if tries.any() else ""
