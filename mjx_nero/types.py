"""Shared pytrees and aliases. Imports neither mujoco nor brax."""

from typing import Any

import jax
from flax import struct
from jaxtyping import Array, Float, Int

Key = jax.Array  # a JAX random key


class UserError(ValueError):
    """A mistake that the user can mend. Its message is one line that says what is wrong and what to do."""


@struct.dataclass
class Sim:
    """The physics state of one environment: all that a backend needs to go on from here.

    Everything else in MuJoCo's data is a function of it, so a reset or a checkpoint replaces these few arrays.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    ctrl: Float[Array, " nu"]  # the position targets now in force [rad or m]
    warmstart: Float[Array, " nv"]  # the solver's last acceleration, its next first guess
    time: Float[Array, ""]  # since the start of the episode [s]


@struct.dataclass
class Carry:
    """All memory of an episode beside the physics. Reset together with it."""

    rng: Key
    step: Int[Array, ""]  # control steps since the start of the episode
    action: Float[Array, " na"]  # the last action, as the policy gave it
    command: Float[Array, "3"]  # goal, robot root frame [m]
    command_quat: Float[Array, "4"]  # its orientation, wxyz
    hold: Int[Array, ""]  # consecutive control steps, up to now, of success
    grasp_time: Float[Array, ""]  # when the object was first held off the table [s]; inf: not yet


@struct.dataclass
class View:
    """What a term may read: one environment, after the step, all poses consistent with ``qpos``.

    ``_w`` is the world frame, ``_b`` the robot's root frame (where it is mounted, before the mounting turn).
    Quaternions are wxyz.
    """

    joint_pos: Float[Array, " nj"]  # arm joints, then gripper joints [rad, m]
    joint_vel: Float[Array, " nj"]  # [rad/s, m/s]
    default_joint_pos: Float[Array, " nj"]
    ctrl: Float[Array, " nu"]
    ee_pos_w: Float[Array, "3"]  # grasp point between the fingers [m]
    ee_quat_w: Float[Array, "4"]
    object_pos_w: Float[Array, "3"]  # the cube; in a scene without one the goal itself is the object
    object_quat_w: Float[Array, "4"]
    object_linvel_w: Float[Array, "3"]  # [m/s]
    object_angvel_local: Float[Array, "3"]  # in the object's own frame [rad/s]
    root_pos_w: Float[Array, "3"]
    command: Float[Array, "3"]  # goal in the robot's root frame, as drawn [m]
    goal_pos_w: Float[Array, "3"]  # where it is now: a goal may move
    goal_quat_w: Float[Array, "4"]
    goal_linvel_w: Float[Array, "3"]  # [m/s]
    action: Float[Array, " na"]  # this step's action
    last_action: Float[Array, " na"]  # the step's before
    step: Int[Array, ""]  # control steps since the start of the episode
    max_steps: int = struct.field(pytree_node=False, default=0)


Params = dict[str, Any]
