"""A batch of environments that restarts what has ended, and keeps how it ended."""

import jax
import jax.numpy as jnp
from brax.envs.base import State

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.types import Key


class Batch:
    """Environments side by side; pure, to be jitted by its user.

    Args:
        env: one of them.
        size: how many.
    """

    def __init__(self, env: ManipulationEnv, size: int):
        self.env, self.size = env, size

    def reset(self, key: Key) -> State:
        """Fresh episodes everywhere."""
        return jax.vmap(self.env.reset)(jax.random.split(key, self.size))

    def step(self, state: State, action: jax.Array, key: Key) -> tuple[State, State]:
        """One control step, with fresh episodes drawn from ``key`` where it was the last.

        Returns:
            the states to go on from, and those before the restart: with the last observations, rewards and results.
        """
        last = jax.vmap(self.env.step)(state, action)
        done = last.done > 0

        def restart(start):
            fresh = self.reset(key)
            return where(done, (fresh.pipeline_state, fresh.obs, fresh.info["carry"]), start)

        start = (last.pipeline_state, last.obs, last.info["carry"])
        if jax.default_backend() == "cpu":
            sim, obs, carry = jax.lax.cond(done.any(), restart, lambda start: start, start)
        else:  # a branch would keep the host waiting until the device knows ``done``, with the next step's work undone meanwhile
            sim, obs, carry = restart(start)
        return last.replace(pipeline_state=sim, obs=obs, info={**last.info, "carry": carry}), last


def where(mask: jax.Array, new, old):
    """Takes rows of one tree of arrays [n, ...] where ``mask`` [n] holds, else those of another."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)
