"""Metrics of an episode: terms with memory, ``init(key, view) -> memory`` and ``step(memory, view) -> (memory, value)``."""

import dataclasses
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero.config.bounds import Count, Positive
from mjx_nero.mdp.rewards import Heights, held
from mjx_nero.mdp.success import touched
from mjx_nero.mdp.terms import MetricTerm
from mjx_nero.types import Key, View


@dataclasses.dataclass(frozen=True, kw_only=True)
class Grasped:
    """Whether the object has been held (see ``rewards.held``) since the start."""

    minimal_height: Heights
    grasp_radius: Positive
    object: str = "cube"

    def init(self, key: Key, view: View) -> Bool[Array, ""]:
        """Not yet."""
        return jnp.zeros((), bool)

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Now, or before."""
        memory = memory | held(view, **dataclasses.asdict(self))
        return memory, memory


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspTime:
    """When the object was first held (see ``rewards.held``) [s]; 0: not yet."""

    minimal_height: Heights
    grasp_radius: Positive
    object: str = "cube"

    def init(self, key: Key, view: View) -> Float[Array, ""]:
        """Never."""
        return jnp.array(jnp.inf)

    def step(self, memory: Float[Array, ""], view: View) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The first time."""
        memory = jnp.minimum(memory, jnp.where(held(view, **dataclasses.asdict(self)), view.time, jnp.inf))
        return memory, jnp.where(jnp.isfinite(memory), memory, 0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Touched:
    """Whether an obstacle has been touched, or the robot has touched itself, since the start (``View.readings``)."""

    def init(self, key: Key, view: View) -> Bool[Array, ""]:
        """Not yet."""
        return jnp.zeros((), bool)

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Now, or before."""
        memory = memory | touched(view)
        return memory, memory


@dataclasses.dataclass(frozen=True, kw_only=True)
class TargetChange:
    """How far the targets of the arm's drives move in a control step: root mean square since the start [rad or m].

    Attributes:
        joints: of the arm, which come first.
    """

    joints: Count

    def init(self, key: Key, view: View) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        """The targets at the start, and no change."""
        return self._read(view), jnp.zeros(())

    def step(self, memory: tuple, view: View) -> tuple[tuple, Float[Array, ""]]:
        """One step more."""
        (last, total), now = memory, self._read(view)
        total = total + jnp.mean(jnp.square(now - last))
        return (now, total), jnp.sqrt(total / view.step)

    def _read(self, view: View) -> Float[Array, " n"]:
        return view.ctrl[: self.joints]


class JointAcceleration(TargetChange):
    """How much the speeds of the arm's joints change: root mean square since the start, of control steps [rad/s^2 or m/s^2]."""

    def step(self, memory: tuple, view: View) -> tuple[tuple, Float[Array, ""]]:
        """One step more."""
        memory, change = super().step(memory, view)
        return memory, change * view.step / view.time

    def _read(self, view: View) -> Float[Array, " n"]:
        return view.joint_vel[: self.joints]


def grasping(**held: Any) -> dict[str, MetricTerm]:
    """Whether and when an object was first held.

    Args:
        held: parameters of ``rewards.held``.
    """
    return {
        "grasped": MetricTerm(Grasped, params=held, over="rate", figure="grasp"),
        "grasp_time": MetricTerm(GraspTime, params=held, where="grasped", figure="time_to_grasp"),
    }


def calmness(joints: int) -> dict[str, MetricTerm]:
    """What says how calm a policy is, of an arm of so many joints."""
    params = {"joints": joints}
    return {"target_change": MetricTerm(TargetChange, params=params), "joint_acc": MetricTerm(JointAcceleration, params=params)}
