"""Shared pytrees and aliases. Imports neither mujoco nor brax."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, UInt8

from mjx_nero.errors import UserError as UserError

Key = jax.Array  # a JAX random key
TARGET = "target"  # in ``View.objects``: the object of ``CommandTerm.targets`` that the episode commands
LEVEL = "level"  # in ``Carry.memory``: share of all episode-to-episode differences that an episode gets; absent: all
LOOK = "look"  # in ``Carry.memory``: the episode's fields of the drawn model (``Scenery.look``); absent: none
SHAPE = "shape"  # in ``Carry.memory``: index of the shape of each object with a bank; absent: no object has one
PHASE = "phase"  # in ``Carry.memory``: the expert's phase in which the episode began (``Start.phase``); absent: none


@struct.dataclass
class Sim:
    """The physics state of one environment: all that a backend needs to continue.

    Everything else in MuJoCo's data is a function of it, so a reset or a checkpoint replaces these few arrays.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    ctrl: Float[Array, " nu"]  # the current position targets [rad or m]
    warmstart: Float[Array, " nv"]  # the solver's last acceleration, its next first guess
    time: Float[Array, ""]  # since the start of the episode [s]
    # The model's fields that differ from world to world, by MuJoCo's names; the others are the compiled model's.
    fields: dict[str, Array] = struct.field(default_factory=dict)
    # What the scene's sensors measured in the last control step, by name; ``touch`` [N] comes from ``sim.touch``.
    readings: dict[str, Array] = struct.field(default_factory=dict)


@struct.dataclass
class Carry:
    """All memory of an episode besides the physics, which is reset together with it."""

    rng: Key
    step: Int[Array, ""]  # control steps since the start of the episode
    action: Float[Array, " na"]  # the last action, as the policy gave it
    command: Float[Array, "3"]  # goal in the robot's root frame [m]
    command_quat: Float[Array, "4"]  # the goal's orientation, wxyz
    memory: dict[str, Any]  # memory of the terms, by their dotted names in the task


@struct.dataclass
class DelayMemory:
    """Memory of ``mdp.memory.Delay``."""

    rng: Key
    lag: Int[Array, ""]  # [control steps]
    past: Array  # [longest delay, ...], newest first


@struct.dataclass
class FixtureStart:
    """A fixture's place and its joints' positions at the start of an episode."""

    pos_w: Float[Array, "3"]  # of its origin [m]
    quat_w: Float[Array, "4"]  # wxyz
    joint_pos: dict[str, Float[Array, ""]]  # by the names in its file [rad or m]


@struct.dataclass
class Start:
    """The start of an episode, as the reset events make it. Objects and fixtures by name."""

    joint_pos: Float[Array, " nj"]  # arm joints, then gripper joints [rad, m]
    object_pos_w: dict[str, Float[Array, "3"]]  # [m]
    object_quat_w: dict[str, Float[Array, "4"]]  # wxyz
    goal_pos_w: Float[Array, "3"] = struct.field(default_factory=lambda: jnp.zeros(3))  # the command, drawn before the events [m]
    goal_quat_w: Float[Array, "4"] = struct.field(default_factory=lambda: jnp.array([1.0, 0.0, 0.0, 0.0]))
    target: Int[Array, ""] = struct.field(default_factory=lambda: jnp.zeros((), jnp.int32))  # index in ``CommandTerm.targets``
    pull: Float[Array, " nj"] | float = 0.0  # offset of the drives' targets from the joints, with which fingers press [rad, m]
    phase: Int[Array, ""] = struct.field(default_factory=lambda: jnp.zeros((), jnp.int32))  # the expert's phase; 0: a usual start
    fixtures: dict[str, FixtureStart] = struct.field(default_factory=dict)
    shape: dict[str, Int[Array, ""]] = struct.field(default_factory=dict)  # index of the shape of each object with a bank


@struct.dataclass
class Bank:
    """States that an expert has visited, in rows [n]. With ``k`` phases, row i belongs to phase 1 + i % k."""

    start: Start
    arrived: Bool[Array, " n"]  # the object is nearer to its goal than to its start, so the goal must stay


@struct.dataclass
class Shown:
    """Steps that an expert has shown, in rows [n, ...]."""

    obs: dict[str, Any]
    action: Float[Array, "n na"]  # the expert's action


@struct.dataclass
class Progress:
    """The state of ``envs.wrappers.ExpertStarts``.

    In a batch every field is [n, ...], spread over devices and saved like the environments.
    """

    bank: Bank  # one row per environment
    share: Float[Array, ""]  # greatest share of expert starts; 0: there is no bank
    last: Int[Array, ""]  # phase in which the environment's last episode began; -1: none has ended
    won: Float[Array, ""]  # 1 if that episode succeeded, else 0


@struct.dataclass
class ShapeView:
    """The shape of a mesh object, in its own frame."""

    index: Int[Array, ""]  # index in its bank
    points: Float[Array, "n 3"]  # corners of its hull [m]
    middle: Float[Array, "3"]  # middle of its bounding box [m]
    edges: Float[Array, "3"]  # edges of that box [m]
    code: Float[Array, " k"]  # description for policies (``sim.solids.shapes.code``) [m]


@struct.dataclass
class ObjectView:
    """An object of the scene, as terms may read it."""

    pos_w: Float[Array, "3"]  # [m]
    quat_w: Float[Array, "4"]  # wxyz
    linvel_w: Float[Array, "3"]  # [m/s]
    angvel_local: Float[Array, "3"]  # in the object's own frame [rad/s]
    shape: ShapeView | None = None  # only of a mesh


@struct.dataclass
class ObstacleView:
    """A box that stands still, as terms may read it."""

    pos_w: Float[Array, "3"]  # of its centre [m]
    quat_w: Float[Array, "4"]  # wxyz
    size: Float[Array, "3"]  # its edges [m]


@struct.dataclass
class FixtureView:
    """A fixture of the scene, as terms may read it. Joints and sites by the names in its file."""

    pos_w: Float[Array, "3"]  # of its origin [m]
    quat_w: Float[Array, "4"]  # wxyz
    joint_pos: dict[str, Float[Array, ""]]  # [rad or m]
    joint_vel: dict[str, Float[Array, ""]]  # [rad/s or m/s]
    joint_range: dict[str, Float[Array, "2"]]  # least and greatest position; infinite without limits [rad or m]
    site_pos_w: dict[str, Float[Array, "3"]]  # [m]
    site_quat_w: dict[str, Float[Array, "4"]]  # wxyz


@struct.dataclass
class Appearance:
    """Size and colour of a drawn object that differ from the model's."""

    size: Float[Array, "*n 3"]  # MuJoCo's size of its shape [m]
    rgba: Float[Array, "*n 4"]  # red, green, blue, alpha, each from 0 to 1


@struct.dataclass
class Scenery:
    """Everything that a picture shows besides ``qpos``. Leading axes are steps and environments."""

    goal_pos_w: Float[Array, "*n 3"]  # [m]
    goal_quat_w: Float[Array, "*n 4"]
    obstacles: dict[str, ObstacleView] = struct.field(default_factory=dict)  # by name
    objects: dict[str, Appearance] = struct.field(default_factory=dict)  # by name, those that differ from the model
    look: dict[str, Array] = struct.field(default_factory=dict)  # further fields of the drawn model, by MuJoCo's names

    def __getitem__(self, at: Any) -> "Scenery":
        """Selects steps or environments."""
        return jax.tree.map(lambda x: x[at], self)


@struct.dataclass
class Picture:
    """One camera's picture of each requested kind; None for the others."""

    rgb: UInt8[Array, "*n height width 3"] | None = None
    depth: Float[Array, "*n height width"] | None = None  # along the camera's axis [m]; 0: nothing is there
    segmentation: Int[Array, "*n height width"] | None = None  # the geom of ``ManipulationEnv.mj_model``; -1: none


@struct.dataclass
class RobotView:
    """One of several robots, as terms may read it."""

    ee_pos_w: Float[Array, "3"]  # grasp point between the fingers [m]
    ee_quat_w: Float[Array, "4"]
    root_pos_w: Float[Array, "3"]
    joints: tuple[int, int] = struct.field(pytree_node=False)  # its first joint among all joints, and one past its last


@struct.dataclass
class View:
    """Everything that a term may read of one environment after the step. All poses are consistent with ``qpos``.

    ``_w`` is the world frame, ``_b`` the robot's root frame (at its mount, before the mount's rotation).
    Quaternions are wxyz. In a scene of several robots, joints and ``ctrl`` are those of all, one robot after another; hand and
    root are the first one's (see ``of``).
    """

    joint_pos: Float[Array, " nj"]  # arm joints, then gripper joints [rad, m]
    joint_vel: Float[Array, " nj"]  # [rad/s, m/s]
    default_joint_pos: Float[Array, " nj"]
    ctrl: Float[Array, " nu"]
    ee_pos_w: Float[Array, "3"]  # grasp point between the fingers [m]
    ee_quat_w: Float[Array, "4"]
    objects: dict[str, ObjectView]  # by name; if an episode commands one, that one also as ``TARGET``
    root_pos_w: Float[Array, "3"]
    command: Float[Array, "3"]  # goal in the robot's root frame, as drawn [m]
    goal_pos_w: Float[Array, "3"]  # where the goal is now: it may move
    goal_quat_w: Float[Array, "4"]
    goal_linvel_w: Float[Array, "3"]  # [m/s]
    action: Float[Array, " na"]  # this step's action
    last_action: Float[Array, " na"]  # the previous step's action
    step: Int[Array, ""]  # control steps since the start of the episode
    time: Float[Array, ""]  # since the start of the episode [s]
    # Encoder readings minus ``joint_pos`` [rad, m]; None: no bias.
    encoder_bias: Float[Array, " nj"] | None = None
    obstacles: dict[str, ObstacleView] = struct.field(default_factory=dict)  # by name
    fixtures: dict[str, FixtureView] = struct.field(default_factory=dict)  # by name
    robots: dict[str, RobotView] = struct.field(default_factory=dict)  # by name, if there are several; the first one is ""
    # What the scene's sensors measured in this step, by name. ``touch``: the strongest contact with an obstacle, or of the robot
    # with itself [N].
    readings: dict[str, Array] = struct.field(default_factory=dict)
    cameras: dict[str, Picture] = struct.field(default_factory=dict)  # by name; pictures that no term reads are not drawn
    # Index of the commanded object in ``CommandTerm.targets``; None: there are none.
    target: Int[Array, ""] | None = None
    max_steps: int = struct.field(pytree_node=False, default=0)

    def of(self, robot: str = "") -> "View":
        """Returns the view of one robot, as if it were the only one: its joints, hand, root and command. The action stays whole.

        Args:
            robot: its name; empty: the first.
        """
        if robot not in self.robots:
            if robot:
                raise UserError(f"no robot is called {robot!r}: the scene's are {', '.join(filter(None, self.robots)) or 'one'}")
            return self
        one = self.robots[robot]
        own = slice(*one.joints)
        return dataclasses.replace(
            self,
            joint_pos=self.joint_pos[own],
            joint_vel=self.joint_vel[own],
            default_joint_pos=self.default_joint_pos[own],
            ctrl=self.ctrl[own],
            ee_pos_w=one.ee_pos_w,
            ee_quat_w=one.ee_quat_w,
            root_pos_w=one.root_pos_w,
            command=self.command + self.root_pos_w - one.root_pos_w,
            encoder_bias=None if self.encoder_bias is None else self.encoder_bias[own],
            robots={},
        )
