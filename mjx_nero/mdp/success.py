"""Success: (View, *, params) -> whether the task is done at this step; and the distance that it is about."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.types import View


def object_distance(view: View) -> Float[Array, ""]:
    """From the object to the goal [m]."""
    return jnp.linalg.norm(view.goal_pos_w - view.object_pos_w)


def ee_distance(view: View) -> Float[Array, ""]:
    """From the end effector to the goal [m]."""
    return jnp.linalg.norm(view.goal_pos_w - view.ee_pos_w)


def ee_angle(view: View) -> Float[Array, ""]:
    """From the end effector's orientation to the goal's, the short way [rad]."""
    between = math.quat_mul(math.quat_conj(view.ee_quat_w), view.goal_quat_w)
    return 2.0 * jnp.arctan2(jnp.linalg.norm(between[1:]), jnp.abs(between[0]))


def object_at_goal(view: View, *, threshold: float) -> Bool[Array, ""]:
    """The object within ``threshold`` [m] of the goal."""
    return object_distance(view) < threshold


def ee_at_goal(view: View, *, threshold: float) -> Bool[Array, ""]:
    """The end effector within ``threshold`` [m] of the goal."""
    return ee_distance(view) < threshold


def ee_at_pose(view: View, *, threshold: float, angle: float) -> Bool[Array, ""]:
    """The end effector within ``threshold`` [m] and ``angle`` [rad] of the goal."""
    return ee_at_goal(view, threshold=threshold) & (ee_angle(view) < angle)


def object_placed(view: View, *, threshold: float, max_speed: float, clearance: float) -> Bool[Array, ""]:
    """The object within ``threshold`` [m] of the goal, slower than ``max_speed`` [m/s], and let go of: the grasp point is at
    least ``clearance`` [m] away."""
    still = jnp.linalg.norm(view.object_linvel_w) < max_speed
    free = jnp.linalg.norm(view.ee_pos_w - view.object_pos_w) > clearance
    return object_at_goal(view, threshold=threshold) & still & free
