"""Wrappers for training: a batch axis, and episodes that restart by themselves."""

import mjx_nero.sim.quiet  # noqa: F401

# isort: split
import jax
from brax.envs.base import Env, State, Wrapper

from mjx_nero.types import Carry, Key, Sim

Start = tuple[Sim, Carry]


class AutoReset(Wrapper):
    """Starts a fresh episode in an environment that is done (``ManipulationEnv.step_and_reset``), by the task's curriculum."""

    def reset(self, rng: Key) -> State:
        return self.env.reset(rng, self.env.first_level)

    def step(self, state: State, action: jax.Array, start: Start | None = None) -> State:
        return self.env.step_and_reset(state, action, start)


class Vectorize(Wrapper):
    """A batch of environments: ``reset`` takes keys [n, ...], ``step`` states and actions [n, ...]."""

    def reset(self, rng: Key) -> State:
        return jax.vmap(self.env.reset)(rng)

    def step(self, state: State, action: jax.Array, start: Start | None = None) -> State:
        return jax.vmap(self.env.step)(state, action, start)

    def following(self, state: State) -> Start:
        """The start of each environment's next episode: see ``ManipulationEnv.step_and_reset``."""
        return jax.vmap(self.env.following)(state)


class BraxEpisode(Wrapper):
    """The bookkeeping fields that Brax's PPO reads beside ``truncation``."""

    def reset(self, rng: Key) -> State:
        state = self.env.reset(rng)
        return state.replace(info={**state.info, "episode_metrics": {}, "episode_done": state.done})

    def step(self, state: State, action: jax.Array, start: Start | None = None) -> State:
        state = self.env.step(state, action, start)
        return state.replace(info={**state.info, "episode_done": state.done})


def for_training(env: Env) -> Env:
    """Vectorized, auto-resetting, with Brax's bookkeeping."""
    return BraxEpisode(Vectorize(AutoReset(env)))
