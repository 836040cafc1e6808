"""Pushes of objects: ``init(key, view) -> memory`` and ``step(memory, view) -> (memory, added velocity [m/s])``."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero.config.bounds import NonNegative, PositiveRange
from mjx_nero.types import Key, View


@dataclasses.dataclass(frozen=True, kw_only=True)
class Push:
    """Gives an object a sudden velocity at random intervals.

    Attributes:
        object: the object's name.
        speed: greatest added speed along each axis [m/s].
        interval: range of the time between pushes [s].
    """

    object: str = "cube"
    speed: NonNegative
    interval: PositiveRange

    def init(self, key: Key, view: View) -> tuple[Key, Float[Array, ""]]:
        """Draws the time of the first push."""
        key, k_wait = jax.random.split(key)
        return key, self._wait(jax.random.uniform(k_wait))

    def step(self, memory: tuple[Key, Float[Array, ""]], view: View) -> tuple[tuple, Float[Array, "3"]]:
        """Returns the velocity to add, zero between pushes."""
        key, due = memory
        key, k_now = jax.random.split(key)
        drawn, now = jax.random.uniform(k_now, (4,)), view.time >= due
        memory = key, jnp.where(now, view.time + self._wait(drawn[3]), due)
        return memory, jnp.where(now, self.speed * (2.0 * drawn[:3] - 1.0), 0.0)

    def _wait(self, drawn: Float[Array, ""]) -> Float[Array, ""]:
        return self.interval[0] + drawn * (self.interval[1] - self.interval[0])
