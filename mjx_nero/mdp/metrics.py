"""Episode metrics: terms with memory, ``init(key, view) -> memory`` and ``step(memory, view) -> (memory, value)``."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero.config.bounds import Count, Positive
from mjx_nero.mdp.memory import Latch
from mjx_nero.mdp.rewards import Heights, held
from mjx_nero.mdp.success import touched
from mjx_nero.mdp.terms import MetricTerm
from mjx_nero.types import Key, View


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Holding:
    """Base of metrics about a held object (see ``rewards.held``)."""

    minimal_height: Heights
    grasp_radius: Positive
    object: str = "cube"

    def _held(self, view: View) -> Bool[Array, ""]:
        return held(view, **dataclasses.asdict(self))


class Grasped(Latch, _Holding):
    """1 if the object has been held since the start."""

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Becomes true when the object is held."""
        memory = memory | self._held(view)
        return memory, memory


class GraspTime(_Holding):
    """Time at which the object was first held [s]; 0 if it never was."""

    def init(self, key: Key, view: View) -> Float[Array, ""]:
        """Starts with infinity, for never."""
        return jnp.array(jnp.inf)

    def step(self, memory: Float[Array, ""], view: View) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Keeps the earliest time."""
        memory = jnp.minimum(memory, jnp.where(self._held(view), view.time, jnp.inf))
        return memory, jnp.where(jnp.isfinite(memory), memory, 0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Touched(Latch):
    """1 if anything has touched an obstacle, or the robot has touched itself, since the start (``View.readings``)."""

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Becomes true at the first touch."""
        memory = memory | touched(view)
        return memory, memory


@dataclasses.dataclass(frozen=True, kw_only=True)
class TargetChange:
    """Root mean square change of the arm's drive targets per control step, since the start [rad or m].

    Attributes:
        joints: number of arm joints, which come first.
    """

    joints: Count

    def init(self, key: Key, view: View) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """Keeps the first targets, with no change yet."""
        return self._read(view), jnp.zeros(())

    def step(self, memory: tuple, view: View) -> tuple[tuple, Float[Array, ""]]:
        """Adds one step."""
        (last, total), now = memory, self._read(view)
        total = total + jnp.mean(jnp.square(now - last))
        return (now, total), jnp.sqrt(total / view.step)

    def _read(self, view: View) -> Float[Array, " n"]:
        return view.ctrl[: self.joints]


class JointAcceleration(TargetChange):
    """Root mean square acceleration of the arm's joints from one control step to the next, since the start [rad/s^2 or m/s^2]."""

    def step(self, memory: tuple, view: View) -> tuple[tuple, Float[Array, ""]]:
        """Adds one step."""
        memory, change = super().step(memory, view)
        return memory, change * view.step / view.time

    def _read(self, view: View) -> Float[Array, " n"]:
        return view.joint_vel[: self.joints]


def grasping(**held: Any) -> dict[str, MetricTerm]:
    """Builds the metrics of whether and when an object was first held.

    Args:
        held: parameters of ``rewards.held``.
    """
    return {
        "grasped": MetricTerm(Grasped, params=held, over="rate", figure="grasp", milestone=True),
        "grasp_time": MetricTerm(GraspTime, params=held, where="grasped", figure="time_to_grasp"),
    }


def calmness(joints: int) -> dict[str, MetricTerm]:
    """Builds the metrics of how smoothly a policy moves an arm of ``joints`` joints."""
    params = {"joints": joints}
    return {"target_change": MetricTerm(TargetChange, params=params), "joint_acc": MetricTerm(JointAcceleration, params=params)}
