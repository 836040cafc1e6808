"""Metrics of an episode: terms with memory, ``init(key, view) -> memory`` and ``step(memory, view) -> (memory, value)``."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero.bounds import Positive
from mjx_nero.mdp.rewards import Heights, held
from mjx_nero.mdp.success import touched
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
    """Whether an obstacle has been touched, or the robot has touched itself, since the start (``View.touch``)."""

    def init(self, key: Key, view: View) -> Bool[Array, ""]:
        """Not yet."""
        return jnp.zeros((), bool)

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Now, or before."""
        memory = memory | touched(view)
        return memory, memory
