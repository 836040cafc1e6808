"""Wrappers for training: a batch axis, and episodes that restart by themselves."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper

from mjx_nero.types import Key


class Vectorize(Wrapper):
    """A batch of environments: ``reset`` takes keys [n, ...], ``step`` states and actions [n, ...]."""

    def reset(self, rng: Key) -> State:
        return jax.vmap(self.env.reset)(rng)

    def step(self, state: State, action: jax.Array) -> State:
        return jax.vmap(self.env.step)(state, action)


class AutoReset(Wrapper):
    """Starts a fresh episode, with fresh draws, in every environment that is done. Takes a vectorized environment.

    Reward, done and metrics are the ended episode's, physics, observation and carry the new one's. Caching the first
    state instead would replay one object and goal position per environment for ever.
    """

    def step(self, state: State, action: jax.Array) -> State:
        state = self.env.step(state, action)
        fresh = self.env.reset(state.info["carry"].rng)

        def pick(new, old):
            done = state.done.reshape(state.done.shape + (1,) * (new.ndim - 1))
            return jnp.where(done > 0, new, old)

        new = (fresh.pipeline_state, fresh.obs, fresh.info["carry"])
        old = (state.pipeline_state, state.obs, state.info["carry"])
        sim, obs, carry = jax.tree.map(pick, new, old)
        return state.replace(pipeline_state=sim, obs=obs, info={**state.info, "carry": carry})


class BraxEpisode(Wrapper):
    """The bookkeeping fields that Brax's PPO reads beside ``truncation``."""

    def reset(self, rng: Key) -> State:
        state = self.env.reset(rng)
        return state.replace(info={**state.info, "episode_metrics": {}, "episode_done": state.done})

    def step(self, state: State, action: jax.Array) -> State:
        state = self.env.step(state, action)
        return state.replace(info={**state.info, "episode_done": state.done})


def for_training(env: Env) -> Env:
    """Vectorized, auto-resetting, with Brax's bookkeeping."""
    return BraxEpisode(AutoReset(Vectorize(env)))
