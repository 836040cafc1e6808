"""Curriculum: (step count, level, weight, *, params) -> weight of a reward term; and what makes an environment's episodes harder.

A level is what share of all that makes them harder an episode has (``types.LEVEL``); None, outside of training: all of it.
"""

import dataclasses
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from mjx_nero.config.bounds import Share

Tree = TypeVar("Tree")
Level = Float[Array, ""] | None


def step_weight(count: Int[Array, ""], level: Level, weight: float, *, to: float, num_steps: int) -> Float[Array, ""]:
    """Changes the weight at once after ``num_steps`` control steps of every environment. Isaac Lab's ``modify_reward_weight``."""
    return jnp.where(count > num_steps, to, weight)


def level_weight(count: Int[Array, ""], level: Level, weight: float, *, start: float) -> Float[Array, ""]:
    """From ``start`` at level 0 to the weight itself at level 1: what would keep a beginner from trying counts as it succeeds."""
    return jnp.asarray(toward(level, start, weight))


@dataclasses.dataclass(frozen=True, kw_only=True)
class BySuccess:
    """What share of all that differs from episode to episode an environment has: more after a success, less after a failure.

    Where ``up`` times the success rate is ``down`` times the failures', it stays.

    Attributes:
        start: of the first episode.
        up: after a success.
        down: after a failure.
    """

    start: Share = 0.0
    up: Share = 0.1
    down: Share = 0.02

    def step(self, level: Float[Array, ""], success: Float[Array, ""]) -> Float[Array, ""]:
        """The next episode's level; ``success`` is 1 or 0."""
        return jnp.clip(level + jnp.where(success > 0, self.up, -self.down), 0.0, 1.0)


_UNSOLVED = 0.05  # of every phase's weight: the most that a rate of success adds to it is a quarter


def chances(last: Int[Array, " n"], won: Float[Array, " n"], share: Float[Array, ""], phases: int) -> Float[Array, " k"]:
    """How likely the next episodes begin as usual, and in each of an expert's ``phases``.

    Of the environments whose last episode began in phase k, p_k have succeeded (phase 0: the usual start). Then

        chance_k = share * max(0, 1 - 2 p_0) * w_k / sum(w),  w_k = p_k (1 - p_k) + 0.05

    So most begin where the policy succeeds now and then, which moves back from the end to the beginning of the task as it learns;
    none do from when half of the usual starts succeed.

    Args:
        last: the phase in which each environment's last episode began; -1: none has ended.
        won: 1 where that succeeded, else 0.
        share: of all episodes, at most.
    """
    began = last[:, None] == jnp.arange(phases + 1)
    rate = jnp.sum(began * won[:, None], axis=0) / jnp.maximum(jnp.sum(began, axis=0), 1)
    weight = rate[1:] * (1 - rate[1:]) + _UNSOLVED
    expert = share * jnp.maximum(0.0, 1 - 2 * rate[0]) * weight / jnp.sum(weight)
    return jnp.concatenate([1 - jnp.sum(expert, keepdims=True), expert])


def toward(level: Level, plain: Tree, drawn: Tree) -> Tree:
    """From what is plain to what was drawn, as far as the level; None: all the way. Integers are the drawn ones."""

    def blend(a, b):
        return a + level * (b - a) if jnp.issubdtype(jnp.result_type(b), jnp.floating) else b

    return drawn if level is None else jax.tree.map(blend, plain, drawn)
