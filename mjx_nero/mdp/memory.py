"""What actions and observations remember: how they were some steps ago. ``init`` and ``step`` as of any term with memory."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from mjx_nero.config.bounds import Share, Steps
from mjx_nero.types import DelayMemory, Key


@dataclasses.dataclass(frozen=True)
class Delay:
    """A value as it was some control steps ago; at the start, as it was there.

    Attributes:
        steps: the least and the most; drawn uniformly at the start of an episode.
        hold: the chance that a step keeps the delay of the one before; otherwise it is drawn anew.
    """

    steps: Steps
    hold: Share = 1.0

    def init(self, key: Key, value: Array) -> DelayMemory:
        """Before the first value, it has always been ``value``."""
        rng, k_lag = jax.random.split(key)
        return DelayMemory(rng, self._lag(k_lag), jnp.broadcast_to(value, (self.steps[1], *value.shape)))

    def step(self, memory: DelayMemory, value: Array) -> tuple[DelayMemory, Array]:
        """Takes a value in, gives an old one out."""
        rng, lag = memory.rng, memory.lag
        if self.hold < 1 and self.steps[0] < self.steps[1]:
            rng, k_now = jax.random.split(rng)
            kept, anew = jax.random.uniform(k_now, (2,))  # at once, as on a GPU each draw costs some kernels
            span = self.steps[1] + 1 - self.steps[0]
            lag = jnp.where(kept < self.hold, lag, self.steps[0] + (anew * span).astype(lag.dtype))
        line = jnp.concatenate([value[None], memory.past])
        return DelayMemory(rng, lag, line[:-1]), line[-1] if self.steps[0] == self.steps[1] else line[lag]

    def _lag(self, key: Key) -> Int[Array, ""]:
        return jax.random.randint(key, (), self.steps[0], self.steps[1] + 1)


@dataclasses.dataclass(frozen=True)
class History:
    """The last values of a vector in one, the newest at the end.

    Attributes:
        length: how many.
    """

    length: int

    def init(self, key: Key, value: Array) -> Any:
        """Before the first value, it has always been ``value``."""
        return jnp.broadcast_to(value, (self.length - 1, *value.shape))

    def step(self, memory: Array, value: Array) -> tuple[Array, Array]:
        """Takes a value in, gives all of them out."""
        line = jnp.concatenate([memory, value[None]])
        return line[1:], line.reshape(-1, *value.shape[1:])
