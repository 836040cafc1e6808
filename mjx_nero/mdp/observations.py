"""Observation terms: (View, *, params) -> vector."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import Count, Positive
from mjx_nero.mdp import success
from mjx_nero.types import UserError, View


def joint_pos(view: View) -> Float[Array, " nj"]:
    """Joint positions [rad, m]."""
    return view.joint_pos


def joint_pos_rel(view: View) -> Float[Array, " nj"]:
    """Joint positions relative to home [rad, m]."""
    return view.joint_pos - view.default_joint_pos


def joint_vel_rel(view: View) -> Float[Array, " nj"]:
    """Joint velocities relative to home, where they are zero [rad/s, m/s]."""
    return view.joint_vel


def reading(view: View, *, name: str) -> Float[Array, " n"]:
    """A reading of the scene's sensors, such as ``wrist`` (force [N] and torque [N m]) or ``fingers`` [N].

    Raises:
        UserError: the scene does not measure it.
    """
    if name not in view.readings:
        there = ", ".join(view.readings) or "none"
        raise UserError(f"the scene measures no {name!r}: its readings are {there} (scene.sensors)")
    return jnp.atleast_1d(view.readings[name])


def object_position(view: View, *, object: str = "cube") -> Float[Array, "3"]:
    """Position of the object in the robot's root frame [m]."""
    return view.objects[object].pos_w - view.root_pos_w


def command(view: View) -> Float[Array, "3"]:
    """Commanded point in the robot's root frame [m]."""
    return view.command


def pose_command(view: View) -> Float[Array, "7"]:
    """Commanded position [m] and orientation (wxyz) in the robot's root frame. Isaac Lab's ``generated_commands``."""
    return jnp.concatenate([view.command, view.goal_quat_w])


def last_action(view: View) -> Float[Array, " na"]:
    """Previous action; zero after a reset."""
    return view.action


def ee_position(view: View) -> Float[Array, "3"]:
    """Position of the grasp point in the robot's root frame [m]."""
    return view.ee_pos_w - view.root_pos_w


def ee_to_object(view: View, *, object: str = "cube") -> Float[Array, "3"]:
    """Vector from the grasp point to the object [m]."""
    return view.objects[object].pos_w - view.ee_pos_w


def ee_to_objects(view: View, *, objects: tuple[str, ...], limit: Positive) -> Float[Array, " n"]:
    """Vectors from the grasp point to each of the objects, each shortened to ``limit`` at most [m]."""
    ways = jnp.stack([view.objects[name].pos_w - view.ee_pos_w for name in objects])
    far = jnp.linalg.norm(ways, axis=1, keepdims=True)
    return (ways * jnp.minimum(1.0, limit / jnp.maximum(far, 1e-6))).reshape(-1)


def object_to_goal(view: View, *, object: str = "cube") -> Float[Array, "3"]:
    """Vector from the object to the commanded point [m]."""
    return view.goal_pos_w - view.objects[object].pos_w


def target_error(view: View) -> Float[Array, " nj"]:
    """Rate-limited position targets minus joint positions [rad, m]."""
    return view.ctrl - view.joint_pos


def object_velocity(view: View, *, object: str = "cube") -> Float[Array, "6"]:
    """Linear [m/s] and angular [rad/s] velocity of the object."""
    seen = view.objects[object]
    return jnp.concatenate([seen.linvel_w, seen.angvel_local])


def object_orientation(view: View, *, object: str = "cube") -> Float[Array, "4"]:
    """Orientation of the object, wxyz."""
    return view.objects[object].quat_w


def object_shape(view: View, *, object: str = "cube") -> Float[Array, " k"]:
    """Shape of a mesh object in its own frame: its extent in some directions, and its radii of gyration [m].

    Raises:
        UserError: the object is not a mesh.
    """
    shape = view.objects[object].shape
    if shape is None:
        raise UserError(f"object_shape reads the shape of a mesh, but {object!r} is not a mesh")
    return shape.code


def object_heading(view: View, *, object: str = "cube") -> Float[Array, "2"]:
    """Direction of the object's x axis seen from above: its x and y in the world frame."""
    return math.rotate(view.objects[object].quat_w, jnp.array([1.0, 0.0, 0.0]))[:2]


def object_turn_to_goal(view: View, *, fold: Count = 1, object: str = "cube") -> Float[Array, "3"]:
    """Rotation vector that turns the object to the goal's orientation (see ``success.object_turn``) [rad]."""
    return success.object_turn(view, fold=fold, object=object)


def ee_to_goal(view: View) -> Float[Array, "3"]:
    """Vector from the end effector to the goal [m]."""
    return view.goal_pos_w - view.ee_pos_w


def ee_turn_to_goal(view: View) -> Float[Array, "3"]:
    """Rotation vector that turns the end effector to the goal's orientation, in the end effector's frame [rad]."""
    return math.quat_log(math.quat_mul(math.quat_conj(view.ee_quat_w), view.goal_quat_w))


def ee_orientation(view: View) -> Float[Array, "4"]:
    """Orientation of the end effector, wxyz."""
    return view.ee_quat_w


def goal_position(view: View) -> Float[Array, "3"]:
    """Current position of the goal in the robot's root frame [m]."""
    return view.goal_pos_w - view.root_pos_w


def obstacle(view: View, *, obstacle: str) -> Float[Array, "10"]:
    """Position in the robot's root frame [m], orientation (wxyz) and edges [m] of an obstacle."""
    box = view.obstacles[obstacle]
    return jnp.concatenate([box.pos_w - view.root_pos_w, box.quat_w, box.size])


def goal_orientation(view: View) -> Float[Array, "4"]:
    """Orientation of the goal, wxyz."""
    return view.goal_quat_w
