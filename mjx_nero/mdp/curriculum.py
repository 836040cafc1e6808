"""Curriculum: (step count, weight, *, params) -> weight of a reward term."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def step_weight(count: Int[Array, ""], weight: float, *, to: float, num_steps: int) -> Float[Array, ""]:
    """Changes the weight at once after ``num_steps`` control steps of every environment. Isaac Lab's ``modify_reward_weight``."""
    return jnp.where(count > num_steps, to, weight)
