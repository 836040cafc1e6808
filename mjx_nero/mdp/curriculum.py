"""Curriculum terms: (step count, level, weight, *, params) -> weight of a reward term; and levels of difficulty.

A level, from 0 to 1, scales everything that differs from episode to episode (``types.LEVEL``). None means the full difference; it
is used outside training.
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
    """Switches the weight to ``to`` after ``num_steps`` control steps of each environment.

    Isaac Lab's ``modify_reward_weight``.
    """
    return jnp.where(count > num_steps, to, weight)


def level_weight(count: Int[Array, ""], level: Level, weight: float, *, start: float) -> Float[Array, ""]:
    """Moves the weight from ``start`` at level 0 to its full value at level 1.

    Use it for costs that would keep an untrained policy from trying: they grow as it succeeds.
    """
    return jnp.asarray(toward(level, start, weight))


@dataclasses.dataclass(frozen=True, kw_only=True)
class BySuccess:
    """Adapts an environment's level: up after a success, down after a failure.

    The level is steady where ``up`` times the success rate equals ``down`` times the failure rate.

    Attributes:
        start: level of the first episode.
        up: step after a success.
        down: step after a failure.
    """

    start: Share = 0.0
    up: Share = 0.1
    down: Share = 0.02

    def step(self, level: Float[Array, ""], success: Float[Array, ""]) -> Float[Array, ""]:
        """Returns the next episode's level; ``success`` is 1 or 0."""
        return jnp.clip(level + jnp.where(success > 0, self.up, -self.down), 0.0, 1.0)


_UNSOLVED = 0.05  # floor of every phase's weight; p (1 - p) adds at most a quarter


def chances(last: Int[Array, " n"], won: Float[Array, " n"], share: Float[Array, ""], phases: int) -> Float[Array, " k"]:
    """Computes the probability that the next episode starts as usual, or in each of an expert's ``phases``.

    Let p_k be the success rate of the environments whose last episode began in phase k (phase 0: the usual start). Then

        chance_k = share * max(0, 1 - 2 p_0) * w_k / sum(w),  w_k = p_k (1 - p_k) + 0.05

    Most expert starts thus lie in phases where the policy succeeds sometimes. As it learns, they move back from the end of the
    task to its beginning. They stop once half of the usual starts succeed.

    Args:
        last: the phase in which each environment's last episode began; -1 if none has ended.
        won: 1 where that episode succeeded, else 0.
        share: greatest share of expert starts.
    """
    began = last[:, None] == jnp.arange(phases + 1)
    rate = jnp.sum(began * won[:, None], axis=0) / jnp.maximum(jnp.sum(began, axis=0), 1)
    weight = rate[1:] * (1 - rate[1:]) + _UNSOLVED
    expert = share * jnp.maximum(0.0, 1 - 2 * rate[0]) * weight / jnp.sum(weight)
    return jnp.concatenate([1 - jnp.sum(expert, keepdims=True), expert])


def toward(level: Level, plain: Tree, drawn: Tree) -> Tree:
    """Blends from ``plain`` to ``drawn`` by the level; None: fully drawn. Integers always come from ``drawn``."""

    def blend(a, b):
        return a + level * (b - a) if jnp.issubdtype(jnp.result_type(b), jnp.floating) else b

    return drawn if level is None else jax.tree.map(blend, plain, drawn)
