"""Commands: sample(key, *, params) -> the goal, kept in the carry."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero.types import Key

Range = tuple[float, float]


def uniform_position(key: Key, *, x: Range, y: Range, z: Range) -> Float[Array, "3"]:
    """A point drawn uniformly from a box in the robot's root frame [m]."""
    low, high = jnp.array([x, y, z]).T
    return jax.random.uniform(key, (3,), minval=low, maxval=high)
