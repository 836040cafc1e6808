"""Commands: sample(key, *, params) -> the goal's position, or (position, orientation), kept in the carry; and paths of goals."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import Range
from mjx_nero.types import Key

Pose = tuple[Float[Array, "3"], Float[Array, "4"]]


def uniform_position(key: Key, *, x: Range, y: Range, z: Range) -> Float[Array, "3"]:
    """A point drawn uniformly from a box in the robot's root frame [m]."""
    low, high = jnp.array([x, y, z]).T
    return jax.random.uniform(key, (3,), minval=low, maxval=high)


def nothing(key: Key) -> Float[Array, "3"]:
    """No goal: the robot's root."""
    return jnp.zeros(3)


def pose(key: Key, *, x: Range, y: Range, z: Range, quat: tuple[float, float, float, float]) -> Pose:
    """A point drawn uniformly from a box in the robot's root frame [m], with one orientation (wxyz)."""
    return uniform_position(key, x=x, y=y, z=z), jnp.array(quat, jnp.float32)


def uniform_pose(key: Key, *, x: Range, y: Range, z: Range, roll: Range, pitch: Range, yaw: Range) -> Pose:
    """A pose drawn uniformly, position [m] and angles [rad], in the robot's root frame. Isaac Lab's ``UniformPoseCommand``."""
    low, high = jnp.array([x, y, z, roll, pitch, yaw]).T
    drawn = jax.random.uniform(key, (6,), minval=low, maxval=high)
    return drawn[:3], math.quat_from_euler(*drawn[3:])


def circle(position: Float[Array, "3"], time: Float[Array, ""], *, radius: float, frequency: float) -> Float[Array, "3"]:
    """A path: a vertical circle about ``position`` in the world's yz plane [m], ``frequency`` turns a second."""
    phase = 2 * jnp.pi * frequency * time
    return position + radius * jnp.stack([jnp.zeros_like(phase), jnp.cos(phase), jnp.sin(phase)])
