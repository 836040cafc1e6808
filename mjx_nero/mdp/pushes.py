"""Pushes: ``init(key, view) -> memory`` and ``step(memory, view) -> (memory, velocity)``, what is added to an object's [m/s]."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero.bounds import NonNegative, PositiveRange
from mjx_nero.types import Key, View


@dataclasses.dataclass(frozen=True, kw_only=True)
class Push:
    """Every now and then an object suddenly moves.

    Attributes:
        object: its name.
        speed: that it gets along each axis, at most [m/s].
        interval: from one push to the next [s].
    """

    object: str = "cube"
    speed: NonNegative
    interval: PositiveRange

    def init(self, key: Key, view: View) -> tuple[Key, Float[Array, ""]]:
        """When the first one comes."""
        key, k_wait = jax.random.split(key)
        return key, self._wait(k_wait)

    def step(self, memory: tuple[Key, Float[Array, ""]], view: View) -> tuple[tuple, Float[Array, "3"]]:
        """Zero between pushes."""
        key, due = memory
        new, k_wait, k_speed = jax.random.split(key, 3)
        now = view.time >= due
        speed = jax.random.uniform(k_speed, (3,), minval=-self.speed, maxval=self.speed)
        memory = jnp.where(now, new, key), jnp.where(now, view.time + self._wait(k_wait), due)
        return memory, jnp.where(now, speed, 0.0)

    def _wait(self, key: Key) -> Float[Array, ""]:
        return jax.random.uniform(key, (), minval=self.interval[0], maxval=self.interval[1])
