"""Wrappers for training: a batch axis, and episodes that restart by themselves."""

import mjx_nero.sim.quiet  # noqa: F401

# isort: split
import jax
from brax.envs.base import Env, State, Wrapper

from mjx_nero.types import Key


class AutoReset(Wrapper):
    """Starts a fresh episode in an environment that is done (``ManipulationEnv.step_and_reset``)."""

    def step(self, state: State, action: jax.Array) -> State:
        return self.env.step_and_reset(state, action)


class Vectorize(Wrapper):
    """A batch of environments: ``reset`` takes keys [n, ...], ``step`` states and actions [n, ...]."""

    def reset(self, rng: Key) -> State:
        return jax.vmap(self.env.reset)(rng)

    def step(self, state: State, action: jax.Array) -> State:
        return jax.vmap(self.env.step)(state, action)


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
    return BraxEpisode(Vectorize(AutoReset(env)))
