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


def toward(level: Level, plain: Tree, drawn: Tree) -> Tree:
    """From what is plain to what was drawn, as far as the level; None: all the way. Integers are the drawn ones."""

    def blend(a, b):
        return a + level * (b - a) if jnp.issubdtype(jnp.result_type(b), jnp.floating) else b

    return drawn if level is None else jax.tree.map(blend, plain, drawn)
