"""A batch of environments that restarts ended episodes, and returns how they ended."""

from mjx_nero.sim.quiet import State

import jax
import jax.numpy as jnp

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.types import Key


class Batch:
    """Environments side by side. Its methods are pure; the caller jits them.

    Args:
        env: one environment.
        size: number of environments.
    """

    def __init__(self, env: ManipulationEnv, size: int):
        self.env, self.size = env, size

    def reset(self, key: Key) -> State:
        """Starts a new episode in every environment."""
        return jax.vmap(self.env.reset)(jax.random.split(key, self.size))

    def step(self, state: State, action: jax.Array, key: Key) -> tuple[State, State]:
        """Makes one control step, and starts a new episode, drawn from ``key``, in each environment whose episode ended.

        Returns:
            the states to continue from, and the states before restarts, with last observations, rewards and results.
        """
        last = jax.vmap(self.env.step)(state, action)
        done = last.done > 0

        def restart(start):
            fresh = self.reset(key)
            return where(done, (fresh.pipeline_state, fresh.obs, fresh.info["carry"]), start)

        start = (last.pipeline_state, last.obs, last.info["carry"])
        if jax.default_backend() == "cpu":
            sim, obs, carry = jax.lax.cond(done.any(), restart, lambda start: start, start)
        else:  # with a branch the host would wait until the device knows ``done``, and could not prepare the next step meanwhile
            sim, obs, carry = restart(start)
        return last.replace(pipeline_state=sim, obs=obs, info={**last.info, "carry": carry}), last


def where(mask: jax.Array, new, old):
    """Selects rows of the tree ``new`` of arrays [n, ...] where ``mask`` [n] holds, and rows of ``old`` elsewhere."""
    return jax.tree.map(lambda a, b: jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b), new, old)
