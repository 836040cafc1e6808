"""Quarter turns of a cube by a hand: which of them an arm can make, and which to make next."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.control.ik import InverseKinematics
from mjx_nero.control.pick_up import UNREACHABLE
from mjx_nero.sim.robot import RobotCfg

TOP = 0.7  # least cosine between the vertical and a side that counts as up
_Z = np.array([0.0, 0.0, 1.0], np.float32)
_EACH = 8.0  # [rad] cost of a turn that is still to come, in joint motion
_WAYS = 8  # directions in which the hand leans: multiples of an eighth of a turn from straight away from the robot


@struct.dataclass
class Table:
    """What the arm can do at the spot, by the direction in which the hand leans and the side to which its fingers open."""

    fails: Float[Array, "ways 2"]  # 0 if the arm gets there
    q: Float[Array, "ways 2 nj"]  # over the spot [rad]
    down: Float[Array, " ways"]  # 0 if the hand can point straight down, turned that way
    go: Float[Array, " ways"]  # remaining cost if the wanted side faces there [rad]


@struct.dataclass
class Plan:
    """One turn: the hand's orientation when it grasps and when it lets go, and the arm near both places [rad]."""

    grasp: Float[Array, "*n 4"]
    end: Float[Array, "*n 4"]
    near: Float[Array, "*n nj"]
    over: Float[Array, "*n nj"]


class Turns:
    """The turns that a hand can make at a spot of the table.

    A quarter turn about a level axis needs a hand that leans by an eighth of a turn to either side. Any turn about the vertical
    can be added. The directions in which the arm can lean at the spot are found once.

    Args:
        robot: the robot that turns.
        ik: inverse kinematics of its arm.
        spot: where the cube's centre is when it is set down [m].
        lean: angle of the hand from straight down [rad].
        beyond, before, lift: see ``TurnOverCfg``.
    """

    def __init__(
        self,
        robot: RobotCfg,
        ik: InverseKinematics,
        spot: tuple[float, float, float],
        lean: float,
        beyond: float,
        before: float,
        lift: float,
    ):
        self._ik, self._lean, self._beyond, self._before, self._lift = ik, lean, beyond, before, lift
        self._down, self._grip = np.array(robot.down, np.float32), np.array(robot.grip, np.float32)
        self._home, self.spot = np.array(robot.arm.home, np.float32), np.array(spot, np.float32)
        self._approach = np.array(math.rotate(math.quat_conj(jnp.asarray(self._down)), -jnp.asarray(_Z)), np.float32)
        self._out = float(np.arctan2(spot[1] - robot.base_pos[1], spot[0] - robot.base_pos[0]))
        self._angles = (self._out + 2 * np.pi / _WAYS * np.arange(_WAYS)).astype(np.float32)

    def into(self, quat: Float[Array, "4"]) -> Float[Array, "3"]:
        """Direction in which the hand points."""
        return math.rotate(quat, jnp.asarray(self._approach))

    def hold(self, cube: Float[Array, "3"], quat: Float[Array, "4"]) -> Float[Array, "3"]:
        """Place of the grasp point with the cube's centre between the pads."""
        return cube - math.rotate(quat, jnp.asarray(self._grip)) - self._beyond * self.into(quat)

    def held(self, pos: Float[Array, "3"], quat: Float[Array, "4"]) -> Float[Array, "3"]:
        """Place of the centre of a cube between the pads, with the grasp point at ``pos``: the inverse of ``hold``."""
        return pos + math.rotate(quat, jnp.asarray(self._grip)) + self._beyond * self.into(quat)

    def _hand(self, angle: Array, flip: Array, lean: float) -> Float[Array, "4"]:
        """Orientation of a hand that leans in a direction and closes across it, to either side (``flip`` 0 or 1)."""
        axis = jnp.stack([jnp.sin(angle), -jnp.cos(angle), jnp.zeros_like(angle)])
        down = math.quat_mul(math.axis_angle(jnp.asarray(_Z), angle + jnp.pi * (1 + flip)), jnp.asarray(self._down))
        return math.quat_mul(math.axis_angle(axis, jnp.array(lean)), down)

    def leaning(self, cube: Float[Array, "3"], lean: float) -> tuple[Float[Array, "ways 2 nj"], Float[Array, "ways 2"]]:
        """Finds in which directions the hand can lean around a cube: the arm over it [rad], and 0 where the hand can."""
        angles, flips = (x.reshape(-1) for x in jnp.meshgrid(jnp.asarray(self._angles), jnp.arange(2), indexing="ij"))
        quats = jax.vmap(lambda angle, flip: self._hand(angle, flip, lean))(angles, flips)
        low = jax.vmap(self.hold, (None, 0))(cube, quats)
        home = jnp.broadcast_to(jnp.asarray(self._home), (len(quats), len(self._home)))
        over = self._ik.solve_batch(low + jnp.array([0.0, 0.0, self._lift]), quats, home, jax.random.PRNGKey(0))
        before = low - self._before * jax.vmap(self.into)(quats)
        others = [jax.vmap(self._ik.local)(place, quats, over.q) for place in (low, before)]
        fails = jnp.sum(jnp.stack([1.0 - x.success for x in (over, *others)]), axis=0)
        return over.q.reshape(_WAYS, 2, -1), fails.reshape(_WAYS, 2)

    def table(self) -> Table:
        """Finds in which directions the hand can lean at the spot. The result does not depend on the episode."""
        q, fails = self.leaning(jnp.asarray(self.spot), self._lean)
        _, down = self.leaning(jnp.asarray(self.spot), 0.0)
        # To turn a side up, the hand first leans away from where that side faces.
        go = _EACH + UNREACHABLE * jnp.min(jnp.roll(fails, _WAYS // 2, axis=0), axis=1)
        return Table(fails, q, down[:, 0], go)

    def plan(
        self,
        table: Table,
        cube: Float[Array, "4"],
        wanted: Float[Array, "3"],
        q: Float[Array, " nj"],
        here: tuple[Array, Array] | None = None,
    ) -> Plan:
        """Chooses the next turn: one that the arm can make, and after which little remains to be done.

        Args:
            cube: orientation of the cube, wxyz.
            wanted: direction that the side to be turned up faces.
            q: joint positions of the arm [rad].
            here: ``leaning`` where the cube lies; None: it lies at the spot.
        """
        starts, first_fails = here or (table.q, table.fails)
        axes = math.rotation_matrix(cube).T
        level = axes[jnp.argsort(jnp.abs(axes[:, 2]))[0]]
        angle = jnp.arctan2(level[1], level[0])
        face, flip, to = (x.reshape(-1) for x in jnp.meshgrid(jnp.arange(4), jnp.arange(2), jnp.arange(_WAYS), indexing="ij"))
        toward = angle + face * jnp.pi / 2  # direction of the side that is turned up
        ends = jnp.asarray(self._angles)[to]
        first = jnp.mod(jnp.round((toward + jnp.pi - self._out) / (2 * jnp.pi / _WAYS)).astype(jnp.int32), _WAYS)
        lean = jax.vmap(lambda at, flip, lean: self._hand(at, flip, lean), (0, 0, None))
        before, after = lean(toward + jnp.pi, flip, self._lean), lean(ends, 1 - flip, self._lean)
        over, fails = table.q[to, 1 - flip], first_fails[first, flip] + table.fails[to, 1 - flip]
        # The side that was up then faces back; one that faced down faces where the hand leans.
        along = jnp.cos(toward) * wanted[0] + jnp.sin(toward) * wanted[1]
        across = jnp.cos(toward) * wanted[1] - jnp.sin(toward) * wanted[0]
        then = jnp.where(
            jnp.abs(across) > TOP, ends + jnp.pi / 2 * jnp.sign(across), jnp.where(wanted[2] < -TOP, ends, ends + jnp.pi)
        )
        left = jnp.where(along > TOP, 0.0, jnp.where(along < -TOP, 2 * _EACH, self._remains(table, then)))
        near = starts[first, flip]
        cost = jnp.linalg.norm(near - q, axis=1) + jnp.linalg.norm(over - near, axis=1) + UNREACHABLE * fails + left
        quarters = Plan(before, after, near, over)
        turns, more = self._turns(table, angle, wanted)
        best = jnp.argmin(jnp.concatenate([cost, more]))
        return jax.tree.map(lambda a, b: jnp.concatenate([a, b])[best], quarters, turns)

    def _turns(self, table: Table, angle: Float[Array, ""], wanted: Float[Array, "3"]) -> tuple[Plan, Float[Array, " n"]]:
        """Turns about the vertical that bring the cube to the spot, and their costs."""
        closing, to = (x.reshape(-1) for x in jnp.meshgrid(jnp.arange(4), jnp.arange(_WAYS), indexing="ij"))
        start, ends = angle + closing * jnp.pi / 2, jnp.asarray(self._angles)[to]
        turn = ends - start
        lean = jax.vmap(lambda at: self._hand(at, jnp.zeros((), jnp.int32), 0.0))
        flat = jnp.linalg.norm(wanted[:2]) > TOP
        looks = jnp.where(flat, jnp.arctan2(wanted[1], wanted[0]), angle) + turn
        left = jnp.where(flat, self._remains(table, looks), jnp.where(wanted[2] > TOP, 0.0, 2 * _EACH))
        home = jnp.broadcast_to(jnp.asarray(self._home), (len(to), len(self._home)))
        turned = jnp.abs(jnp.mod(turn + jnp.pi, 2 * jnp.pi) - jnp.pi)
        return Plan(lean(start), lean(ends), home, home), _EACH / 2 + turned + UNREACHABLE * table.down[to] + left

    def _remains(self, table: Table, angle: Float[Array, " n"]) -> Float[Array, " n"]:
        """Computes the remaining cost if the wanted side faces a level direction [rad]."""
        return table.go[jnp.mod(jnp.round((angle - self._out) / (2 * jnp.pi / _WAYS)).astype(jnp.int32), _WAYS)]
