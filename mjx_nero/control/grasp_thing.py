"""Picks up a mesh object by one of the grasps that fit its resting pose, and holds it at the goal."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import Positive
from mjx_nero.control.pick_up import PickUp, PickUpCfg, PickUpMemory
from mjx_nero.sim import grasp
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.solids import kept_grasps
from mjx_nero.sim.solids.grasps import Hand
from mjx_nero.types import UserError, View

_GAPS = 9  # number of gaps for which the place of the pads' middle is computed
_COST_COUNTS = 1.5  # [rad] joint motion that one unit of a grasp's cost is worth


@dataclasses.dataclass(frozen=True)
class GraspThingCfg(PickUpCfg):
    """Settings of the grasp and its speed; ``heading`` and ``turns`` are not used.

    Attributes:
        files: files of the object's shapes: its ``file`` and its ``bank``.
        scale: factor of the meshes' lengths.
    """

    files: tuple[str, ...] = ()
    scale: Positive = 1.0


@struct.dataclass
class GraspThingMemory(PickUpMemory):
    """The state of ``GraspThing`` between two steps."""

    opened: Float[Array, " ng"]  # positions of the open fingers [rad or m]
    middle: Float[Array, "3"]  # middle of the pads, in the thing's frame [m]


def hand_of(robot: RobotCfg) -> Hand:
    """The hand of a robot, for finding grasps of meshes.

    Raises:
        UserError: the robot has no gripper, or its opening is unknown.
    """
    grasp.cube_for(robot)
    return Hand(robot.opening, robot.closed, robot.pad, grasp.lowest(robot.pad))


class GraspThing(PickUp):
    """``PickUp`` for things of any shape: tables of grasps replace headings and turns.

    Args:
        robot: the robot that picks.
        dt: control step [s].
        cfg: see ``GraspThingCfg``.

    Raises:
        UserError: ``files`` is empty, or the hand cannot grasp any of the things.
    """

    def __init__(self, robot: RobotCfg, dt: float, cfg: GraspThingCfg = GraspThingCfg()):
        super().__init__(robot, dt, cfg)
        if not cfg.files:
            raise UserError("grasp_thing needs files (control.files): those of the meshes to pick up")
        table = kept_grasps.table(cfg.files, cfg.scale, hand_of(robot))
        self._ups, self._middles, self._across, self._gaps, self._costs = (np.asarray(x, np.float32) for x in table)
        formulas = grasp.formulas(robot)
        self._positions = formulas[1] if formulas else None
        self._opened = np.linspace(robot.closed, robot.opening, _GAPS)
        self._aside = np.array([grasp.aside(robot, gap) for gap in self._opened])

    def init(self, view: View) -> GraspThingMemory:
        """Chooses a grasp and starts the first phase."""
        q = view.joint_pos[: self._n]
        middles, angles, gaps, costs = self._ways(view)
        quats = jax.vmap(self.hand)(angles)
        picks = jax.vmap(self._over, (None, 0, 0, 0))(view, middles, angles, gaps)
        over, way = self.reaching(q, picks, quats)
        best = jnp.argmin(way + _COST_COUNTS * costs)
        zero, pick = jnp.zeros((), jnp.int32), picks[best]
        return GraspThingMemory(
            phase=zero,
            count=zero,
            q=q,
            qd=jnp.zeros_like(q),
            above=over[best],
            pos=pick + self._up,
            pick=pick,
            yaw=angles[best],
            grip=jnp.zeros(3),
            tries=zero,
            opened=self._open(gaps[best]),
            middle=self._local(view, middles[best]),
        )

    def fingers(self, memory: PickUpMemory, view: View, closes: Bool[Array, ""]) -> Float[Array, " ng"]:
        assert isinstance(memory, GraspThingMemory)
        return self.gripper.paced(closes, view.ctrl[self._n :], self.finger_step, memory.opened)

    def off(self, memory: PickUpMemory, view: View) -> Float[Array, ""]:
        assert isinstance(memory, GraspThingMemory)
        seen = view.objects[self.cfg.object]
        return jnp.linalg.norm(view.ee_pos_w - seen.pos_w - math.rotate(seen.quat_w, memory.middle))

    def again(self, memory: PickUpMemory, view: View) -> PickUpMemory:
        assert isinstance(memory, GraspThingMemory)
        middles, angles, gaps, costs = self._ways(view)
        off = jnp.mod(angles - memory.yaw + jnp.pi, 2 * jnp.pi) - jnp.pi
        best = jnp.argmin(jnp.abs(off) + _COST_COUNTS * costs)
        yaw = memory.yaw + off[best]
        pick, middle = self._over(view, middles[best], yaw, gaps[best]), self._local(view, middles[best])
        return dataclasses.replace(memory, pick=pick, yaw=yaw, opened=self._open(gaps[best]), middle=middle)

    def _ways(self, view: View) -> tuple[Array, Array, Array, Array]:
        """Middles of the pads in the world, turns of the hand, gaps and costs of all grasps that fit the thing's resting pose."""
        seen = view.objects[self.cfg.object]
        index = jnp.zeros((), jnp.int32) if seen.shape is None else seen.shape.index
        up = math.rotation_matrix(seen.quat_w)[2]
        rest = jnp.argmax(jnp.asarray(self._ups)[index] @ up)
        middles, across, gaps, costs = (
            jnp.asarray(x)[index, rest] for x in (self._middles, self._across, self._gaps, self._costs)
        )
        places = seen.pos_w + jax.vmap(functools.partial(math.rotate, seen.quat_w))(middles)
        ways = jax.vmap(functools.partial(math.rotate, seen.quat_w))(across)
        turn = jnp.arctan2(ways[:, 1], ways[:, 0]) - jnp.pi / 2  # the fingers open along the hand's y
        return (
            jnp.concatenate([places, places]),
            jnp.concatenate([turn, turn + jnp.pi]),
            jnp.concatenate([gaps, gaps]),
            jnp.concatenate([costs, costs]),
        )

    def _over(self, view: View, middle: Float[Array, "3"], yaw: Float[Array, ""], gap: Float[Array, ""]) -> Float[Array, "3"]:
        """Computes the place of the grasp point for this middle of the pads, which is kept off the table."""
        return self.around(view, middle, yaw, jnp.interp(gap, self._opened, self._aside))

    def _local(self, view: View, place: Float[Array, "3"]) -> Float[Array, "3"]:
        seen = view.objects[self.cfg.object]
        return math.rotate(math.quat_conj(seen.quat_w), place - seen.pos_w)

    def _open(self, gap: Float[Array, ""]) -> Float[Array, " ng"]:
        """Positions of the fingers at which the pads are ``gap`` apart."""
        if self._positions is None:
            return jnp.asarray(self.gripper.opened)
        return self.gripper._clip(self._positions(gap))
