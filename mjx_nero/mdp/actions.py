"""Actions: from the policy's output to position targets."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def joint_targets(action: Float[Array, " n"], *, scale: float, offset: Float[Array, " n"]) -> Float[Array, " n"]:
    """Absolute joint targets: ``offset + scale * action`` [rad]. Isaac Lab's ``JointPositionAction``."""
    return offset + scale * action


def binary_gripper(action: Float[Array, ""], *, open: Float[Array, " n"], close: Float[Array, " n"]) -> Float[Array, " n"]:
    """Closed for a negative action, else open [rad or m]. Isaac Lab's ``BinaryJointPositionAction``."""
    return jnp.where(action < 0, close, open)


def rate_limit(target: Float[Array, " n"], ctrl: Float[Array, " n"], *, step: Float[Array, " n"]) -> Float[Array, " n"]:
    """Moves ``ctrl`` towards ``target`` by at most ``step`` [rad or m]: the drive's speed limit."""
    return ctrl + jnp.clip(target - ctrl, -step, step)
