"""Reward terms: (View, *, params) -> scalar. Terms are unsigned and unscaled; the task's config sets sign and weight."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import Count, Positive
from mjx_nero.mdp import success
from mjx_nero.types import View

Heights = float | tuple[float, ...]  # [m]


def _ee_distance(view: View, object: str) -> Float[Array, ""]:
    """Distance of the grasp point from the object's centre, or from the box around a mesh [m]."""
    seen = view.objects[object]
    if seen.shape is None:
        return jnp.linalg.norm(seen.pos_w - view.ee_pos_w)
    middle = seen.pos_w + math.rotate(seen.quat_w, seen.shape.middle)
    return jnp.maximum(math.box_distance(view.ee_pos_w, middle, seen.quat_w, seen.shape.edges), 0.0)


def _height(view: View, object: str) -> Float[Array, ""]:
    """Height of the object's centre above the table, or of the lowest point of a mesh [m]."""
    seen = view.objects[object]
    if seen.shape is None:
        return seen.pos_w[2]
    return seen.pos_w[2] + jnp.min(seen.shape.points @ math.rotation_matrix(seen.quat_w)[2])


def held(view: View, *, minimal_height: Heights, grasp_radius: Positive, object: str = "cube") -> Bool[Array, ""]:
    """True if the object's centre is above ``minimal_height`` [m] and within ``grasp_radius`` [m] of the grasp point.

    For a mesh, its lowest point and its bounding box count instead, so its size and the way it lies do not matter.

    A cube that was knocked into the air is above the height too, but only a gripped one stays at the grasp point. A tuple gives
    one height per object of ``CommandTerm.targets``; the commanded object's counts.
    """
    height = jnp.array(minimal_height)[view.target] if isinstance(minimal_height, tuple) else minimal_height
    return (_height(view, object) > height) & (_ee_distance(view, object) < grasp_radius)


def object_ee_distance(view: View, *, std: Positive, object: str = "cube") -> Float[Array, ""]:
    """1 - tanh(d / std), where d is the distance from the grasp point to the object [m]. Isaac Lab's lift task."""
    return 1.0 - jnp.tanh(_ee_distance(view, object) / std)


def behind_object_distance(
    view: View, *, std: Positive, behind: Positive, near: Positive = 0.02, object: str = "cube"
) -> Float[Array, ""]:
    """1 - tanh(d / std), where d is the distance from the grasp point to the spot to push the object from [m].

    The spot lies ``behind`` the object's centre [m], opposite the goal, along the table. Within about ``near`` of the goal [m] it
    moves in to the centre itself.
    """
    seen = view.objects[object].pos_w
    way = (view.goal_pos_w - seen).at[2].set(0.0)
    at = seen - behind * way / jnp.sqrt(jnp.sum(jnp.square(way)) + near**2)
    return 1.0 - jnp.tanh(jnp.linalg.norm(at - view.ee_pos_w) / std)


def object_is_lifted(view: View, *, minimal_height: float, object: str = "cube") -> Float[Array, ""]:
    """1 while the object's centre is above ``minimal_height`` [m]. Isaac Lab's lift task."""
    return (view.objects[object].pos_w[2] > minimal_height).astype(jnp.float32)


def object_goal_distance(view: View, *, std: Positive, minimal_height: float, object: str = "cube") -> Float[Array, ""]:
    """1 - tanh(d / std) while lifted, where d is the distance from the object to the goal [m]. Isaac Lab's lift task."""
    return object_is_lifted(view, minimal_height=minimal_height, object=object) * goal_distance(view, std=std, object=object)


def goal_distance(view: View, *, std: Positive, object: str = "cube") -> Float[Array, ""]:
    """1 - tanh(d / std), where d is the distance from the object to the goal [m]."""
    return 1.0 - jnp.tanh(success.object_distance(view, object=object) / std)


def ee_goal_distance(view: View, *, std: Positive) -> Float[Array, ""]:
    """1 - tanh(d / std), where d is the distance from the end effector to the goal [m]."""
    return 1.0 - jnp.tanh(success.ee_distance(view) / std)


def ee_position_error(view: View) -> Float[Array, ""]:
    """Distance of the end effector to the goal [m]. Isaac Lab's ``position_command_error``."""
    return success.ee_distance(view)


def ee_orientation_error(view: View) -> Float[Array, ""]:
    """Angle from the end effector's orientation to the goal's [rad]. Isaac Lab's ``orientation_command_error``."""
    return success.ee_angle(view)


def ee_goal_pose(view: View, *, std: Positive, angle_std: Positive) -> Float[Array, ""]:
    """(1 - tanh(distance / std)) * (1 - tanh(angle / angle_std)), from the end effector to the goal.

    A sum would let the arm settle in the wrong place with the right orientation.
    """
    return ee_goal_distance(view, std=std) * (1.0 - jnp.tanh(success.ee_angle(view) / angle_std))


def object_is_held(view: View, *, minimal_height: Heights, grasp_radius: Positive, object: str = "cube") -> Float[Array, ""]:
    """1 while the object is held (see ``held``), else 0."""
    return held(view, minimal_height=minimal_height, grasp_radius=grasp_radius, object=object).astype(jnp.float32)


def held_goal_distance(
    view: View, *, std: Positive, minimal_height: Heights, grasp_radius: Positive, object: str = "cube"
) -> Float[Array, ""]:
    """1 - tanh(d / std) while held, where d is the distance from the object to the goal [m]."""
    gate = object_is_held(view, minimal_height=minimal_height, grasp_radius=grasp_radius, object=object)
    return gate * (1.0 - jnp.tanh(success.object_distance(view, object=object) / std))


def held_at_goal(
    view: View, *, threshold: Positive, minimal_height: Heights, grasp_radius: Positive, object: str = "cube"
) -> Float[Array, ""]:
    """1 while the object is held within ``threshold`` [m] of the goal."""
    gate = held(view, minimal_height=minimal_height, grasp_radius=grasp_radius, object=object)
    return (gate & success.object_at_goal(view, threshold=threshold, object=object)).astype(jnp.float32)


def object_goal_pose(
    view: View, *, std: Positive, angle_std: Positive, fold: Count = 1, object: str = "cube"
) -> Float[Array, ""]:
    """(1 - tanh(distance / std)) * (1 - tanh(angle / angle_std)), from the object to the goal (see ``success.object_turn``)."""
    angle = jnp.linalg.norm(success.object_turn(view, fold=fold, object=object))
    return goal_distance(view, std=std, object=object) * (1.0 - jnp.tanh(angle / angle_std))


def object_goal_turn(view: View, *, std: Positive, fold: Count = 1, object: str = "cube") -> Float[Array, ""]:
    """1 - tanh(angle / std), from the object's orientation to the goal's [rad], wherever the object is.

    See ``success.object_turn``.
    """
    return 1.0 - jnp.tanh(jnp.linalg.norm(success.object_turn(view, fold=fold, object=object)) / std)


def object_at_pose(
    view: View, *, threshold: Positive, angle: Positive, fold: Count = 1, object: str = "cube"
) -> Float[Array, ""]:
    """1 while the object is within ``threshold`` [m] and ``angle`` [rad] of the goal (see ``success.object_turn``)."""
    return success.object_at_pose(view, threshold=threshold, angle=angle, fold=fold, object=object).astype(jnp.float32)


def stillness(view: View, *, std: Positive) -> Float[Array, ""]:
    """exp(-(v / std)^2), where v is the joints' root-mean-square speed [rad/s]."""
    return jnp.exp(-jnp.mean(jnp.square(view.joint_vel)) / std**2)


def action_rate_l2(view: View) -> Float[Array, ""]:
    """Squared change of the action since the previous step."""
    return jnp.sum(jnp.square(view.action - view.last_action))


def gripper_action_l2(view: View) -> Float[Array, ""]:
    """Squared gripper action, the last entry. A binary gripper obeys only its sign."""
    return jnp.square(view.action[-1])


def joint_vel_l2(view: View) -> Float[Array, ""]:
    """Squared joint speeds, summed over all joints of the robot [rad^2/s^2, m^2/s^2]."""
    return jnp.sum(jnp.square(view.joint_vel))


def touching(view: View) -> Float[Array, ""]:
    """1 while the robot or its object touches an obstacle, or the robot touches itself."""
    return success.touched(view).astype(jnp.float32)


def obstacle_nearness(view: View, *, margin: Positive) -> Float[Array, ""]:
    """Depth of the end effector in the ``margin`` [m] around an obstacle: 0 at the margin's edge, 1 at the obstacle's surface."""
    far = [math.box_distance(view.ee_pos_w, box.pos_w, box.quat_w, box.size) for box in view.obstacles.values()]
    return jnp.clip(1.0 - jnp.min(jnp.stack(far)) / margin, 0.0, 1.0)
