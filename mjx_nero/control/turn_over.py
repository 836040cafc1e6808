"""Turns a cube over until a commanded side is up: grasps it with a leaning hand, turns it by a quarter, and sets it down."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from mjx_nero.config.bounds import NonNegative, Positive
from mjx_nero.control import setpoint
from mjx_nero.control.gripper import ParallelGripper
from mjx_nero.control.ik import IkCfg, InverseKinematics
from mjx_nero.control.turns import TOP, Plan, Table, Turns
from mjx_nero.mdp import sides
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import View

ABOVE, DOWN, CLOSE, UP, TURN, SET, OPEN, BACK, REST = range(9)
_LOST = 0.05  # [m] distance from the grasp point beyond which the cube has been lost
_UNDER = 0.01  # [m] greatest distance of the cube below its lifting height when the hand begins to turn
_LATE = {ABOVE: 2.5, DOWN: 1.0, UP: 1.0, TURN: 4.0, SET: 1.5, BACK: 1.0}  # [s] time limits of the phases


@dataclasses.dataclass(frozen=True)
class TurnOverCfg:
    """Settings of the turns.

    Attributes:
        object: name of the cube.
        rest: height of the resting cube's centre [m].
        spot: place where the hand sets the cube down: x and y in the world [m].
        lean: angle of the hand from straight down: to one side when it grasps, to the other when it lets go [rad].
        beyond: distance from the grasp point to the pads' middle, along the hand's direction [m].
        before: distance in front of the cube from which the hand comes, and to which it leaves [m].
        lift: height to which the hand lifts the cube before it turns it [m].
        speed: speed of the grasp point [m/s].
        closing: time that the fingers take to close [s], besides the lag of their drives.
        clear: clearance of the cube's edge above the table during a turn [m]. A fast hand is lower than its set-point.
        rises: least height of the hand near the end of its way to a grasp, per radian of joint motion left [m/rad], so that it
            passes over the cube; 0: the joints move straight.
        ik: settings of the arm's motion.
    """

    object: str = "box"
    rest: Positive = 0.02
    spot: tuple[float, float] = (0.35, 0.0)
    lean: Positive = 0.7854
    beyond: float = 0.0
    before: Positive = 0.07
    lift: Positive = 0.06
    speed: Positive = 0.25
    closing: Positive = 0.4
    clear: Positive = 0.01
    rises: NonNegative = 0.0
    ik: IkCfg = IkCfg(orientation_weight=0.1, iterations=40, restarts=3)


@struct.dataclass
class TurnOverMemory(setpoint.Script):
    """The state of ``TurnOver`` between two steps."""

    pos: Float[Array, "3"]  # set-point of the grasp point on a straight way [m]
    plan: Plan
    table: Table


class TurnOver:
    """Turns the cube by quarters, one after another.

    | phase | above | down | close | up | turn | set | open | back |
    | --- | --- | --- | --- | --- | --- | --- | --- | --- |
    | hand | before the cube | at it | stays | up | over the spot, turned | down | stays | away |

    The first turn may just bring the cube to the spot, turned about the vertical as needed: see ``Turns``.

    Args:
        robot: the robot that turns.
        dt: control step [s].
        cfg: see ``TurnOverCfg``.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: TurnOverCfg = TurnOverCfg()):
        self.dt, self.cfg = dt, cfg
        self.gripper, self._ik = ParallelGripper(robot), InverseKinematics(robot, cfg=cfg.ik)
        self._n = len(robot.arm.joints)
        self._lead, self._speed = np.array(robot.arm.lead, np.float32), np.array(robot.arm.speed, np.float32)
        self._gentle = setpoint.gentle(robot.arm.lead)
        self._closed, self._finger_step = self.gripper.pace(cfg.closing, dt)
        self._lost = float(np.linalg.norm(robot.grip)) + abs(cfg.beyond) + _LOST
        self._turns = Turns(robot, self._ik, (*cfg.spot, cfg.rest), cfg.lean, cfg.beyond, cfg.before, cfg.lift)

    def init(self, view: View) -> TurnOverMemory:
        """Finds out what the arm can do, and plans the first turn."""
        q, zero, table = view.joint_pos[: self._n], jnp.zeros((), jnp.int32), self._turns.table()
        here = self._turns.leaning(view.objects[self.cfg.object].pos_w, self.cfg.lean)
        plan = self._plan(view, table, q, here)
        return TurnOverMemory(zero, zero, q, jnp.zeros_like(q), zero, view.ee_pos_w, plan, table)

    def step(self, memory: TurnOverMemory, view: View) -> tuple[TurnOverMemory, Float[Array, " nu"]]:
        """Computes the targets of all drives."""
        phase, plan, seen = memory.phase, memory.plan, view.objects[self.cfg.object].pos_w
        quat = jnp.where(phase <= UP, plan.grasp, plan.end)
        wanted = self._wanted(memory, seen)
        way = wanted - memory.pos
        far, leaps = jnp.linalg.norm(way), (phase == ABOVE) | (phase == TURN)
        pos = memory.pos + way * jnp.where(leaps, 1.0, jnp.minimum(1.0, self.cfg.speed * self.dt / (far + 1e-6)))
        seed = jnp.select([phase == ABOVE, phase == TURN], [plan.near, plan.over], memory.q)
        found = self._ik.local(pos, quat, seed).q
        stays = (phase == CLOSE) | (phase == OPEN)
        wanted_q = jnp.where(stays, memory.q, found)
        closed = (phase >= CLOSE) & (phase <= SET)
        fastest = jnp.where(closed, self._gentle, setpoint.FASTEST)
        q, qd = setpoint.follow(memory.q, memory.qd, wanted_q, jnp.asarray(self._speed), self.dt, fastest, phase == TURN)
        lifts = leaps if self.cfg.rises else phase == TURN
        q = jnp.where(lifts, self._above(memory, q, wanted_q, wanted), q)
        qd = jnp.where(lifts, (q - memory.q) / self.dt, qd)  # the drives' targets lead by it
        fingers = self.gripper.paced(closed, view.ctrl[self._n :], self._finger_step)

        lost = (phase >= UP) & (phase <= SET) & (jnp.linalg.norm(view.ee_pos_w - seen) > self._lost)
        near = jnp.linalg.norm(memory.q - wanted_q) < 0.05
        ended = self._ended(memory, jnp.where(leaps, near, far < 1e-3), jnp.linalg.norm(view.ee_pos_w - wanted))
        up = sides.normal(view, self.cfg.object)[2] > TOP
        after = jnp.where(lost | ended & (phase == BACK) & ~up, ABOVE, phase + ended)
        begins = (after == ABOVE) & (phase != ABOVE)
        new = self._plan(view, memory.table, q)
        memory = dataclasses.replace(
            memory,
            phase=after,
            count=jnp.where(after != phase, 0, memory.count + 1),
            q=q,
            qd=qd,
            pos=pos,
            plan=jax.tree.map(lambda a, b: jnp.where(begins, a, b), new, plan),
            tries=memory.tries + begins,
        )
        return memory, jnp.concatenate([q + self._lead * qd, fingers])

    def _above(
        self, memory: TurnOverMemory, q: Float[Array, " nj"], end: Float[Array, " nj"], wanted: Float[Array, "3"]
    ) -> Float[Array, " nj"]:
        """Lifts the hand where the cube in it would hit the table with an edge, or where the hand would hit the cube.

        Straight motion of the joints may dip.
        """
        pos, quat = (x[0] for x in self._ik.chain.poses(q))
        turns = np.sqrt(2) * self.cfg.rest + self.cfg.clear - self._turns.held(pos, quat)[2]
        rises = jnp.minimum(memory.count * self.cfg.speed * self.dt, self.cfg.rises * jnp.linalg.norm(end - q))
        comes = wanted[2] + jnp.minimum(rises, self.cfg.lift) - pos[2]
        lacks = jnp.maximum(0.0, jnp.where(memory.phase == TURN, turns, comes))
        return self._ik.local(pos + lacks * jnp.array([0.0, 0.0, 1.0]), quat, q).q

    def _wanted(self, memory: TurnOverMemory, cube: Float[Array, "3"]) -> Float[Array, "3"]:
        """The place where the grasp point has to be at the end of the phase."""
        phase, plan, pos = memory.phase, memory.plan, memory.pos
        hold = self._turns.hold
        low, put = hold(cube, plan.grasp), hold(jnp.asarray(self._turns.spot), plan.end)
        up, before = jnp.array([0.0, 0.0, self.cfg.lift]), self.cfg.before
        into, out = self._turns.into(plan.grasp), self._turns.into(plan.end)
        raised = pos.at[2].set(jnp.maximum(pos[2], self.cfg.rest + self.cfg.lift))
        lifted = pos.at[2].set(low[2] - cube[2] + self.cfg.rest + self.cfg.lift)
        cases = {
            ABOVE: low - before * into,
            DOWN: low,
            UP: lifted,
            TURN: put + up,
            SET: put,
            BACK: put - before * out,
            REST: raised,
        }
        return jnp.select([phase == each for each in cases], list(cases.values()), pos)

    def _ended(self, memory: TurnOverMemory, arrived: Bool[Array, ""], error: Float[Array, ""]) -> Bool[Array, ""]:
        """True if the phase is done, or its time is up."""
        phase, time = memory.phase, (memory.count + 1) * self.dt
        still = jnp.max(jnp.abs(memory.qd)) < 0.2
        careful = (phase == ABOVE) | (phase == TURN) | (phase == DOWN) | (phase == SET)
        done = jnp.where(careful, arrived & still & (error < 0.008), arrived & ((phase != UP) | (error < _UNDER)))
        done = jnp.where((phase == CLOSE) | (phase == OPEN), time > self._closed, done)
        late = jnp.select([phase == each for each in _LATE], [time > most for most in _LATE.values()], False)
        return (done | late) & (phase != REST)

    def _plan(self, view: View, table: Table, q: Float[Array, " nj"], here: tuple[Array, Array] | None = None) -> Plan:
        cube = view.objects[self.cfg.object].quat_w
        return self._turns.plan(table, cube, sides.normal(view, self.cfg.object), q, here)

    def warning(self, memory: TurnOverMemory) -> str:
        """Says how many cubes are still to be turned."""
        busy = np.asarray(memory.phase) != REST
        return f"{busy.sum()} of {busy.size} episodes ended before the cube was turned" if busy.any() else ""
