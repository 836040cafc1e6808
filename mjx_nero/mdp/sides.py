"""Sides of a box: terms for turning a commanded side of a box up. The command is that side's normal, in the box's frame.

The box *stands* while that side is up and the box rests on the table, held or not. As with ``towers``, a standing box keeps the
rewards of a held one, so letting go costs nothing.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Positive, Range
from mjx_nero.mdp import success
from mjx_nero.mdp.rewards import held
from mjx_nero.types import Key, Start, View

NORMALS = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lying:
    """How a box has to lie, and when it counts as held or left.

    Attributes:
        object: the box.
        rest: height of its centre when it rests [m].
        within: tolerances of the side's tilt [rad] and of the height [m].
        minimal_height, grasp_radius: see ``rewards.held``.
        clearance: distance of the grasp point from a box that the hand has left [m].
    """

    object: str
    rest: Positive
    within: tuple[Positive, Positive]
    minimal_height: float
    grasp_radius: Positive
    clearance: NonNegative


@functools.cache
def cube_turns() -> np.ndarray:
    """The 24 rotations that map a cube onto itself, wxyz [24, 4]."""
    from scipy.spatial.transform import Rotation  # slow to import

    return np.roll(Rotation.create_group("O").as_quat(), 1, axis=1).astype(np.float32)


# Commands and reset events.


def any_side(key: Key) -> Float[Array, "3"]:
    """Draws the side that has to be up: one of six normals."""
    return jnp.asarray(NORMALS)[jax.random.randint(key, (), 0, 6)]


def other_side_up(key: Key, start: Start, *, base: tuple[float, float, float], yaw: Range, object: str) -> Start:
    """Lays a cube with a side other than the commanded one up, and turns it about the vertical by ``yaw`` [rad].

    Args:
        base: the robot's root, from which commands are measured [m].
    """
    k_turn, k_yaw = jax.random.split(key)
    wanted = start.goal_pos_w - jnp.array(base)
    turns = jnp.asarray(cube_turns())
    up = jax.vmap(lambda turn: math.rotate(turn, wanted)[2])(turns)
    index = jax.random.categorical(k_turn, jnp.where(up < 0.5, 0.0, -jnp.inf))
    about = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), jax.random.uniform(k_yaw, (), minval=yaw[0], maxval=yaw[1]))
    return dataclasses.replace(start, object_quat_w={**start.object_quat_w, object: math.quat_mul(about, turns[index])})


# Building blocks of the terms.


def normal(view: View, object: str) -> Float[Array, "3"]:
    """Direction of the commanded side in the world."""
    return math.rotate(view.objects[object].quat_w, view.command)


def angle(view: View, object: str) -> Float[Array, ""]:
    """Angle of the commanded side from straight up [rad]."""
    way = normal(view, object)
    return jnp.arctan2(jnp.linalg.norm(way[:2]), way[2])


def stands(view: View, lying: Lying) -> Bool[Array, ""]:
    """True if the box rests with the commanded side up, held or not."""
    tilt, height = lying.within
    return (angle(view, lying.object) < tilt) & (jnp.abs(view.objects[lying.object].pos_w[2] - lying.rest) < height)


def _carried(view: View, lying: Lying) -> Bool[Array, ""]:
    holds = held(view, minimal_height=lying.minimal_height, grasp_radius=lying.grasp_radius, object=lying.object)
    return holds | stands(view, lying)


def _away(view: View, lying: Lying) -> Float[Array, ""]:
    return jnp.linalg.norm(view.ee_pos_w - view.objects[lying.object].pos_w)


# Observations.


def side(view: View, *, object: str) -> Float[Array, "3"]:
    """Direction of the commanded side in the world."""
    return normal(view, object)


# Success, and the distance that it judges.


def tilt(view: View, *, object: str, lever: Positive) -> Float[Array, ""]:
    """Distance that the commanded side still has to turn: ``lever * angle`` [m]."""
    return lever * angle(view, object)


def turned_up(view: View, *, lying: Lying, max_speed: Positive) -> Bool[Array, ""]:
    """True if the box stands at rest, the grasp point is more than ``lying.clearance`` away and the pads touch nothing.

    At rest: slower than ``max_speed`` [m/s] and ten times that [rad/s].

    Raises:
        UserError: the scene has no finger sensors.
    """
    free = success.pads_are_free(view, "sides.turned_up")
    seen = view.objects[lying.object]
    still = (jnp.linalg.norm(seen.linvel_w) < max_speed) & (jnp.linalg.norm(seen.angvel_local) < 10 * max_speed)
    return stands(view, lying) & still & (_away(view, lying) > lying.clearance) & free


# Rewards.


def reached(view: View, *, lying: Lying, std: Positive) -> Float[Array, ""]:
    """1 - tanh(d / std), where d is the distance from the grasp point to the box [m]; 1 once the box stands."""
    return jnp.where(stands(view, lying), 1.0, 1.0 - jnp.tanh(_away(view, lying) / std))


def carried(view: View, *, lying: Lying) -> Float[Array, ""]:
    """1 while the box is held or stands, else 0."""
    return _carried(view, lying).astype(jnp.float32)


def turned(view: View, *, object: str, std: Positive) -> Float[Array, ""]:
    """1 - tanh(angle / std), where angle is from the commanded side's normal to straight up [rad]."""
    return 1.0 - jnp.tanh(angle(view, object) / std)


def lowered(view: View, *, lying: Lying, std: Positive, near: Positive) -> Float[Array, ""]:
    """1 - tanh(h / std) of a held or standing box whose side is within ``near`` [rad] of up; h is its height over rest [m]."""
    height = jnp.abs(view.objects[lying.object].pos_w[2] - lying.rest)
    return (_carried(view, lying) & (angle(view, lying.object) < near)) * (1.0 - jnp.tanh(height / std))


def standing(view: View, *, lying: Lying) -> Float[Array, ""]:
    """1 while the box stands, else 0."""
    return stands(view, lying).astype(jnp.float32)


def told_to_open(view: View, *, lying: Lying, open: tuple[float, ...], hold: tuple[float, ...]) -> Float[Array, ""]:
    """Commanded opening of the fingers while the box stands, from 0 to 1, so the first step of letting go pays at once.

    Args:
        open, hold: targets of the gripper's drives (the last ones) where the reward is 1, and where it begins [rad or m].
    """
    opens, holds = jnp.array(open), jnp.array(hold)
    share = jnp.mean((view.ctrl[-len(open) :] - holds) / (opens - holds))
    return stands(view, lying) * jnp.clip(share, 0.0, 1.0)


def left(view: View, *, lying: Lying) -> Float[Array, ""]:
    """Distance of the grasp point from a standing box, as a share of ``lying.clearance``, at most 1."""
    return stands(view, lying) * jnp.minimum(_away(view, lying) / lying.clearance, 1.0)


def completed(view: View, *, lying: Lying, max_speed: Positive) -> Float[Array, ""]:
    """1 while the box is turned up and left alone (see ``turned_up``), else 0."""
    return turned_up(view, lying=lying, max_speed=max_speed).astype(jnp.float32)
