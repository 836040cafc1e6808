"""Views made by hand."""

import jax.numpy as jnp

from mjx_nero.types import View

STILL = jnp.array([1.0, 0.0, 0.0, 0.0])
_VECTORS = (
    *("joint_pos", "joint_vel", "default_joint_pos", "ctrl", "ee_pos_w", "root_pos_w", "command"),
    *("goal_pos_w", "goal_linvel_w", "action", "last_action"),
)


def blank(**fields) -> View:
    """A view of nothing, at rest at the origin, but for the given fields."""
    zeros = dict.fromkeys(_VECTORS, jnp.zeros(3))
    start = {"step": jnp.zeros((), jnp.int32), "time": jnp.zeros(()), "objects": {}}
    return View(**{**zeros, "ee_quat_w": STILL, "goal_quat_w": STILL, **start, **fields})
