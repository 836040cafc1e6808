"""A batch of environments whose step is compiled once for all tests that take it."""

import jax
import jax.numpy as jnp

import mjx_nero
from mjx_nero.envs import wrappers

NUM_ENVS = 8


class Batch:
    """``NUM_ENVS`` auto-resetting environments with jitted ``reset`` and ``step``; ``traces`` counts compilations of the step."""

    def __init__(self, env: mjx_nero.ManipulationEnv):
        self.env = env
        self.train_env = wrappers.for_training(env)
        self.traces = 0
        self.reset = jax.jit(lambda seed: self.train_env.reset(jax.random.split(jax.random.PRNGKey(seed), NUM_ENVS)))
        self._jitted = jax.jit(self._step)

    def _step(self, state, action):
        self.traces += 1
        return self.train_env.step(state, action)

    def step(self, state, action):
        return self._jitted(state, jnp.asarray(action, jnp.float32))
