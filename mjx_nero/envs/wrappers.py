"""Training wrappers: batches with automatic restarts, and expert starts."""

import dataclasses

from mjx_nero.sim.quiet import Env, State, Wrapper

import jax
import jax.numpy as jnp

from mjx_nero.envs.env import ManipulationEnv, Starts
from mjx_nero.mdp import curriculum
from mjx_nero.types import PHASE, Bank, Carry, Key, Progress, Sim

Start = tuple[Sim, Carry]
PHASES = 8  # equal parts of an expert's episode


class Batch(Wrapper):
    """Many environments side by side. An ended episode restarts in the same step, at the level of the task's curriculum.

    ``reset`` takes keys [n, ...], ``step`` states and actions [n, ...]. ``info`` also holds what Brax's PPO reads besides
    ``truncation``.
    """

    def reset(self, rng: Key, starts: Starts | None = None) -> State:
        state = jax.vmap(lambda key: self.env.reset(key, self.env.first_level, starts))(rng)
        return state.replace(info={**state.info, "episode_metrics": {}, "episode_done": state.done})

    def step(self, state: State, action: jax.Array, start: Start | None = None) -> State:
        state = jax.vmap(self.env.step_and_reset)(state, action, start)
        return state.replace(info={**state.info, "episode_done": state.done})

    def following(self, state: State, starts: Starts | None = None) -> Start:
        """Draws the start of each environment's next episode: see ``ManipulationEnv.step_and_reset``."""
        return jax.vmap(self.env.following, (0, None))(state, starts)


class ExpertStarts(Wrapper):
    """Starts some episodes from states that the task's expert has visited (``curriculum.chances``).

    ``reset`` takes the bank of states. Without one, all episodes start as usual, and so do those whose start the loop did not
    draw ahead.
    """

    def reset(self, rng: Key, bank: Bank | None = None) -> State:
        n, share = len(rng), self.unwrapped.cfg.curriculum.expert_starts if bank else 0.0
        rows = bank or jax.tree.map(lambda x: jnp.zeros((n, *x.shape), x.dtype), jax.eval_shape(self.unwrapped.blank))
        progress = Progress(rows, jnp.full(n, share, jnp.float32), jnp.full(n, -1, jnp.int32), jnp.zeros(n))
        state = self.env.reset(rng, _starts(progress))
        metrics = {**state.metrics, "visited": jnp.zeros(n), "visited_success": jnp.zeros(n)}
        return state.replace(info={**state.info, "starts": progress}, metrics=metrics)

    def following(self, state: State) -> Start:
        """Draws the start of each environment's next episode."""
        return self.env.following(state, _starts(state.info["starts"]))

    def step(self, state: State, action: jax.Array, start: Start | None = None) -> State:
        progress, phase = state.info["starts"], state.info["carry"].memory[PHASE]
        state = self.env.step(state, action, start)
        done = state.done > 0
        last, won = jnp.where(done, phase, progress.last), jnp.where(done, state.metrics["success"], progress.won)
        visited = state.done * (phase > 0)
        metrics = {**state.metrics, "visited": visited, "visited_success": visited * state.metrics["success"]}
        return state.replace(info={**state.info, "starts": dataclasses.replace(progress, last=last, won=won)}, metrics=metrics)


def _starts(progress: Progress) -> Starts:
    phases = min(PHASES, len(progress.last))
    return progress.bank, curriculum.chances(progress.last, progress.won, progress.share[0], phases)


def begun(env: Env, key: Key, k_phase: Key, num_envs: int, bank: Bank | None) -> State:
    """Resets a batch from ``for_training``. Episodes start at different phases, so that they do not all end at once."""
    state = env.reset(jax.random.split(key, num_envs), bank)
    carry = state.info["carry"]
    phase = jax.random.randint(k_phase, carry.step.shape, 0, env.unwrapped.episode_length)
    return state.replace(info={**state.info, "carry": carry.replace(step=phase)})


def for_training(env: ManipulationEnv) -> Env:
    """Wraps an environment for training: batched, restarting and, if the task asks, with expert starts."""
    return ExpertStarts(Batch(env)) if env.cfg.curriculum.expert_starts else Batch(env)
