"""Reset events: (key, joint_pos, object_pos, *, params) -> (joint_pos, object_pos), applied in order at every reset."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero.types import Key

Start = tuple[Float[Array, " nj"], Float[Array, "3"]]
Range = tuple[float, float]


def object_position_uniform(key: Key, joint_pos, object_pos, *, x: Range, y: Range, z: Range) -> Start:
    """Moves the object by a uniform offset from where it was [m]."""
    low, high = jnp.array([x, y, z]).T
    return joint_pos, object_pos + jax.random.uniform(key, (3,), minval=low, maxval=high)


def joints_by_scale(key: Key, joint_pos, object_pos, *, low: float, high: float) -> Start:
    """Multiplies every joint position by a uniform factor from ``low`` to ``high``. Isaac Lab's ``reset_joints_by_scale``."""
    return joint_pos * jax.random.uniform(key, joint_pos.shape, minval=low, maxval=high), object_pos


def joints_offset_uniform(key: Key, joint_pos, object_pos, *, offset: float) -> Start:
    """Moves every joint by a uniform offset of at most ``offset`` [rad or m]; ranges are kept by the caller."""
    return joint_pos + jax.random.uniform(key, joint_pos.shape, minval=-offset, maxval=offset), object_pos
