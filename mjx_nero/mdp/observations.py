"""Observation terms: (View, *, params) -> vector."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.types import View


def joint_pos(view: View) -> Float[Array, " nj"]:
    """Joint positions [rad, m]."""
    return view.joint_pos


def joint_pos_rel(view: View) -> Float[Array, " nj"]:
    """Joint positions relative to home [rad, m]."""
    return view.joint_pos - view.default_joint_pos


def joint_vel_rel(view: View) -> Float[Array, " nj"]:
    """Joint speeds; home stands still [rad/s, m/s]."""
    return view.joint_vel


def object_position(view: View) -> Float[Array, "3"]:
    """Object in the robot's root frame [m]."""
    return view.object_pos_w - view.root_pos_w


def command(view: View) -> Float[Array, "3"]:
    """Commanded point in the robot's root frame [m]."""
    return view.command


def pose_command(view: View) -> Float[Array, "7"]:
    """Commanded position [m] and orientation (wxyz) in the robot's root frame. Isaac Lab's ``generated_commands``."""
    return jnp.concatenate([view.command, view.goal_quat_w])


def last_action(view: View) -> Float[Array, " na"]:
    """The action that led here (zero after a reset)."""
    return view.action


def ee_position(view: View) -> Float[Array, "3"]:
    """Grasp point in the robot's root frame [m]."""
    return view.ee_pos_w - view.root_pos_w


def ee_to_object(view: View) -> Float[Array, "3"]:
    """From the grasp point to the object [m]."""
    return view.object_pos_w - view.ee_pos_w


def object_to_goal(view: View) -> Float[Array, "3"]:
    """From the object to the commanded point [m]."""
    return view.goal_pos_w - view.object_pos_w


def target_error(view: View) -> Float[Array, " nj"]:
    """How far the rate-limited position targets are ahead of the joints [rad, m]."""
    return view.ctrl - view.joint_pos


def object_velocity(view: View) -> Float[Array, "6"]:
    """Linear [m/s] and angular [rad/s] velocity of the object."""
    return jnp.concatenate([view.object_linvel_w, view.object_angvel_local])


def object_orientation(view: View) -> Float[Array, "4"]:
    """Orientation of the object, wxyz."""
    return view.object_quat_w


def ee_to_goal(view: View) -> Float[Array, "3"]:
    """From the end effector to the goal [m]."""
    return view.goal_pos_w - view.ee_pos_w


def ee_turn_to_goal(view: View) -> Float[Array, "3"]:
    """The rotation vector that turns the end effector to the goal's orientation, in its own frame [rad]."""
    return math.quat_log(math.quat_mul(math.quat_conj(view.ee_quat_w), view.goal_quat_w))


def ee_orientation(view: View) -> Float[Array, "4"]:
    """Orientation of the end effector, wxyz."""
    return view.ee_quat_w


def goal_position(view: View) -> Float[Array, "3"]:
    """Where the goal is now, in the robot's root frame [m]."""
    return view.goal_pos_w - view.root_pos_w


def goal_orientation(view: View) -> Float[Array, "4"]:
    """Orientation of the goal, wxyz."""
    return view.goal_quat_w
