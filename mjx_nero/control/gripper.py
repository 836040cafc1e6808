"""Parallel gripper: drive targets that open, close or step it. Pure functions of the measured joint positions."""

import functools
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_nero.mdp.actions import rate_limit
from mjx_nero.sim import grasp, scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

Positions = Float[Array, " n"]
PRESS = 0.15  # [s] how long the fingers press before the hand moves
GRIP_FILTER = 0.05  # weight per control step of a new measurement of where the object is in the grip


class ParallelGripper:
    """A robot's gripper, with the interface of Isaac Sim's class of this name.

    With ``action_deltas``, ``open`` and ``close`` lead the *measured* positions by a constant step (+ opens, - closes), which a
    position drive turns into a roughly constant force. Without ``action_deltas``, the targets are the opened and the closed
    positions. All targets stay within the joints' ranges.

    Args:
        robot: robot with the gripper.
        opened, closed: joint positions [rad or m]; None: the robot's own.
        action_deltas: one step per joint [rad or m], or None.

    Attributes:
        joints: joint names, in the order of all positions.
        opened, closed: joint positions [n].

    Raises:
        UserError: a list does not have one value per joint.
    """

    def __init__(
        self,
        robot: RobotCfg,
        opened: tuple[float, ...] | None = None,
        closed: tuple[float, ...] | None = None,
        action_deltas: tuple[float, ...] | None = None,
    ):
        cfg, model = robot.gripper, scene.robot_model(robot)
        self.joints, self._robot = cfg.joints, robot
        for name, values in (("opened", opened), ("closed", closed), ("action_deltas", action_deltas)):
            if values is not None and len(values) != len(self.joints):
                raise UserError(f"{name} takes one value for each of {', '.join(self.joints)}, got {values}")
        self.opened = np.array(cfg.open if opened is None else opened, np.float32)
        self.closed = np.array(cfg.close if closed is None else closed, np.float32)
        self.deltas = None if action_deltas is None else np.array(action_deltas, np.float32)
        self._range = np.array([model.joint(j).range for j in self.joints], np.float32).T
        self._speed = np.array(cfg.speed, np.float32)

    def open(self, positions: Positions) -> Positions:
        """Returns targets that open, from measured ``positions``."""
        return self.step(positions, self.deltas) if self.deltas is not None else self._clip(self.opened)

    def close(self, positions: Positions) -> Positions:
        """Returns targets that close, from measured ``positions``."""
        return self.step(positions, -self.deltas) if self.deltas is not None else self._clip(self.closed)

    def step(self, positions: Positions, deltas) -> Positions:
        """Returns targets ``deltas`` away from the measured ``positions`` [rad or m]."""
        return self._clip(positions + jnp.asarray(deltas, jnp.float32))

    def pace(self, closing: float, dt: float) -> tuple[float, Float[np.ndarray, " n"]]:
        """Returns the time until a hand that closes gently has closed and presses [s], and its fingers' motion per step.

        Drives that lag press late, and at speed their heavy rotors throw what they hit.

        Args:
            closing: time that the fingers take to close [s], besides the lag of their drives.
            dt: control step [s].
        """
        lag, travel = float(np.max(self._robot.gripper.lead, initial=0.0)), np.abs(self.opened - self.closed)
        return closing + 2 * lag + PRESS, np.minimum(self._speed, travel / (closing + lag)).astype(np.float32) * dt

    def forward(self, closing: Bool[Array, ""], positions: Positions, targets: Positions, dt: float) -> Positions:
        """Moves ``targets`` towards open or closed for ``dt`` seconds at the drives' speed limit."""
        wanted = jnp.where(closing, self.close(positions), self.open(positions))
        return rate_limit(wanted, targets, step=jnp.asarray(self._speed * dt))

    def paced(
        self, closes: Bool[Array, ""], targets: Positions, step: Float[np.ndarray, " n"], opened: Positions | None = None
    ) -> Positions:
        """Moves ``targets`` by at most ``step`` [rad or m] towards closed, or else ``opened``; None: the gripper's own."""
        ends = jnp.where(closes, jnp.asarray(self.closed), jnp.asarray(self.opened) if opened is None else opened)
        return rate_limit(ends, targets, step=jnp.asarray(step))

    def gap(self, positions: Positions) -> Float[Array, ""]:
        """Computes the distance between the pads [m], by the robot's formula or from the pads in its model.

        Raises:
            UserError: there is neither.
        """
        return self._formulas[0](positions)

    def positions(self, gap: Float[Array, ""]) -> Positions:
        """Computes joint positions with ``gap`` [m] between the pads, within the joints' ranges. Raises as ``gap`` does."""
        return self._clip(self._formulas[1](gap))

    @functools.cached_property
    def _formulas(self) -> tuple[Callable, Callable]:
        found = grasp.formulas(self._robot)
        if found is None:
            raise UserError(f"the gap of a gripper with the joints {', '.join(self.joints) or 'none'} is unknown")
        return found

    def _clip(self, positions) -> Positions:
        return jnp.clip(jnp.asarray(positions, jnp.float32), *self._range)
