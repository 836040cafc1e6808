"""Memories that terms use: latches, delays and histories. All have ``init`` and ``step``, as every term with memory does."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from mjx_nero.config.bounds import Share, Steps
from mjx_nero.types import DelayMemory, Key, View


class Latch:
    """Base of terms that remember whether something has happened in the episode: false at its start."""

    def init(self, key: Key, view: View) -> Bool[Array, ""]:
        """Starts with False."""
        return jnp.zeros((), bool)


@dataclasses.dataclass(frozen=True)
class Delay:
    """Returns a value some control steps late; at the start, the first value.

    Attributes:
        steps: least and greatest delay, drawn uniformly at the start of an episode.
        hold: probability that a step keeps the previous delay; otherwise it draws a new one.
    """

    steps: Steps
    hold: Share = 1.0

    def init(self, key: Key, value: Array) -> DelayMemory:
        """Fills the line with ``value``, and draws the delay."""
        rng, k_lag = jax.random.split(key)
        return DelayMemory(rng, self._lag(k_lag), jnp.broadcast_to(value, (self.steps[1], *value.shape)))

    def step(self, memory: DelayMemory, value: Array) -> tuple[DelayMemory, Array]:
        """Takes a value in and returns an older one."""
        rng, lag = memory.rng, memory.lag
        if self.hold < 1 and self.steps[0] < self.steps[1]:
            rng, k_now = jax.random.split(rng)
            kept, anew = jax.random.uniform(k_now, (2,))  # one draw: on a GPU each draw costs several kernels
            span = self.steps[1] + 1 - self.steps[0]
            lag = jnp.where(kept < self.hold, lag, self.steps[0] + (anew * span).astype(lag.dtype))
        line = jnp.concatenate([value[None], memory.past])
        return DelayMemory(rng, lag, line[:-1]), line[-1] if self.steps[0] == self.steps[1] else line[lag]

    def _lag(self, key: Key) -> Int[Array, ""]:
        return jax.random.randint(key, (), self.steps[0], self.steps[1] + 1)


def delay(steps: Steps, hold: float) -> Delay | None:
    """Makes a delay; None if the delay is always 0."""
    return None if steps == (0, 0) else Delay(steps, hold)


@dataclasses.dataclass(frozen=True)
class History:
    """Returns the latest values as one vector, newest last.

    Attributes:
        length: number of values.
    """

    length: int

    def init(self, key: Key, value: Array) -> Any:
        """Fills the line with ``value``."""
        return jnp.broadcast_to(value, (self.length - 1, *value.shape))

    def step(self, memory: Array, value: Array) -> tuple[Array, Array]:
        """Takes a value in and returns all of them."""
        line = jnp.concatenate([memory, value[None]])
        return line[1:], line.reshape(-1, *value.shape[1:])
