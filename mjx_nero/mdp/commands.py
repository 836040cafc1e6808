"""Commands: sample(key, *, params) -> the goal's position, or (position, orientation). Also paths along which a goal moves."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import Places, Range
from mjx_nero.types import Key

Pose = tuple[Float[Array, "3"], Float[Array, "4"]]


def uniform_position(key: Key, *, x: Places, y: Places, z: Places) -> Float[Array, "3"]:
    """Draws a point uniformly from a box in the robot's root frame [m]."""
    low, high = jnp.array([x, y, z]).T
    return jax.random.uniform(key, (3,), minval=low, maxval=high)


def nothing(key: Key) -> Float[Array, "3"]:
    """Returns the robot's root, for tasks without a goal."""
    return jnp.zeros(3)


def either_side(key: Key, *, size: Range) -> Float[Array, "3"]:
    """Draws a joint position of uniform magnitude and random sign [rad or m]. It is the first of the three numbers."""
    k_size, k_sign = jax.random.split(key)
    drawn = jax.random.uniform(k_size, minval=size[0], maxval=size[1])
    return jnp.array([1.0, 0.0, 0.0]) * jnp.where(jax.random.bernoulli(k_sign), drawn, -drawn)


def pose(key: Key, *, x: Places, y: Places, z: Places, quat: tuple[float, float, float, float]) -> Pose:
    """Draws a point uniformly from a box in the robot's root frame [m], with a fixed orientation (wxyz)."""
    return uniform_position(key, x=x, y=y, z=z), jnp.array(quat, jnp.float32)


def uniform_pose(key: Key, *, x: Places, y: Places, z: Places, roll: Range, pitch: Range, yaw: Range) -> Pose:
    """Draws a pose uniformly in the robot's root frame: position [m] and angles [rad]. Isaac Lab's ``UniformPoseCommand``."""
    low, high = jnp.array([x, y, z, roll, pitch, yaw]).T
    drawn = jax.random.uniform(key, (6,), minval=low, maxval=high)
    return drawn[:3], math.quat_from_euler(*drawn[3:])


def circle(position: Float[Array, "3"], time: Float[Array, ""], *, radius: float, frequency: float) -> Float[Array, "3"]:
    """Moves the goal on a vertical circle about ``position`` in the world's yz plane [m], at ``frequency`` turns per second."""
    phase = 2 * jnp.pi * frequency * time
    return position + radius * jnp.stack([jnp.zeros_like(phase), jnp.cos(phase), jnp.sin(phase)])
