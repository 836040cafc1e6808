"""Terms about the joints of fixtures, such as drawers and doors: reset events, observations, rewards, success and a metric.

A way is the distance that the handle still has to travel, in metres for slides and hinges alike.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Places, Positive, Range
from mjx_nero.mdp.memory import Latch
from mjx_nero.types import FixtureStart, FixtureView, Key, Start, View

Quat = tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True)
class Handle:
    """A handle to take hold of, and the position that its joint has to reach.

    Attributes:
        fixture: name in ``SceneCfg.fixtures``.
        joint: name of the joint in the fixture's file.
        site: name of the site in the middle of the handle. Its x axis is the hand's approach, its z axis lies along the bar.
        grip: orientation of the hand in the site's frame, wxyz. Half a turn about the site's x axis also fits.
        target: position that the joint has to reach [rad or m]; None: the command's first number.
        share: read the target as a share of the joint's upper limit.
        lever: how far the handle moves when the joint moves by one: 1 for slides, the radius for hinges [m/rad].
    """

    fixture: str
    joint: str
    site: str
    grip: Quat = (1.0, 0.0, 0.0, 0.0)
    target: float | None = None
    share: bool = False
    lever: Positive = 1.0


# Reset events.


def stand_uniform(key: Key, start: Start, *, fixture: str, x: Places, y: Places, yaw: Range) -> Start:
    """Moves a fixture along the table by uniform ``x`` and ``y`` [m] and turns it about the vertical by ``yaw`` [rad]."""
    low, high = jnp.array([x, y, yaw]).T
    dx, dy, angle = jax.random.uniform(key, (3,), minval=low, maxval=high)
    seen = start.fixtures[fixture]
    turn = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), angle)
    moved = dataclasses.replace(
        seen, pos_w=seen.pos_w + jnp.stack([dx, dy, jnp.zeros(())]), quat_w=math.quat_mul(turn, seen.quat_w)
    )
    return _with(start, fixture, moved)


def stand_at_goal(key: Key, start: Start, *, fixture: str, off: NonNegative = 0.0, turn: NonNegative = 0.0) -> Start:
    """Puts a fixture below the goal, with the goal's yaw. The goal is an imperfect estimate of where the fixture is.

    Args:
        off: greatest error of the estimate along x and y [m].
        turn: greatest error about the vertical [rad].
    """
    wrong = jnp.array([off, off, turn]) * jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0)
    seen = start.fixtures[fixture]
    pos = jnp.append(start.goal_pos_w[:2] + wrong[:2], seen.pos_w[2])
    quat = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), math.yaw(start.goal_quat_w) + wrong[2])
    return _with(start, fixture, dataclasses.replace(seen, pos_w=pos, quat_w=quat))


def joint_uniform(key: Key, start: Start, *, fixture: str, joint: str, position: Range) -> Start:
    """Puts a fixture's joint at a uniform position [rad or m]. The caller clips to the joint's range."""
    at = jax.random.uniform(key, minval=position[0], maxval=position[1])
    seen = start.fixtures[fixture]
    return _with(start, fixture, dataclasses.replace(seen, joint_pos={**seen.joint_pos, joint: at}))


def _with(start: Start, name: str, fixture: FixtureStart) -> Start:
    return dataclasses.replace(start, fixtures={**start.fixtures, name: fixture})


# Building blocks of the terms.


def _fixture(view: View, handle: Handle) -> FixtureView:
    return view.fixtures[handle.fixture]


def distance(view: View, handle: Handle) -> Float[Array, ""]:
    """Distance from the grasp point to the handle [m]."""
    return jnp.linalg.norm(_fixture(view, handle).site_pos_w[handle.site] - view.ee_pos_w)


def target(view: View, handle: Handle) -> Float[Array, ""]:
    """Position that the joint has to reach [rad or m]."""
    wanted = view.command[0] if handle.target is None else jnp.asarray(handle.target)
    return wanted * _fixture(view, handle).joint_range[handle.joint][1] if handle.share else wanted


def turn(view: View, handle: Handle) -> Float[Array, "3"]:
    """Shortest rotation vector that turns the hand to the grip, in the world's axes [rad]."""
    site, grip = _fixture(view, handle).site_quat_w[handle.site], jnp.array(handle.grip)
    half = jnp.array([0.0, 1.0, 0.0, 0.0])  # half a turn about x
    now = math.quat_conj(view.ee_quat_w)
    ways = jnp.stack([math.quat_log(math.quat_mul(math.quat_mul(site, q), now)) for q in (grip, math.quat_mul(half, grip))])
    return ways[jnp.argmin(jnp.linalg.norm(ways, axis=1))]


# Observations.


def ee_to_handle(view: View, *, handle: Handle) -> Float[Array, "3"]:
    """Vector from the grasp point to the handle [m]."""
    return _fixture(view, handle).site_pos_w[handle.site] - view.ee_pos_w


def turn_to_handle(view: View, *, handle: Handle) -> Float[Array, "3"]:
    """Rotation vector that turns the hand to the grip (see ``turn``) [rad]."""
    return turn(view, handle)


def joint(view: View, *, handle: Handle) -> Float[Array, "2"]:
    """Position of the joint, and its signed distance to the target [rad or m]."""
    at = _fixture(view, handle).joint_pos[handle.joint]
    return jnp.stack([at, target(view, handle) - at])


def joint_velocity(view: View, *, handle: Handle) -> Float[Array, "1"]:
    """Speed of the joint [rad/s or m/s]."""
    return _fixture(view, handle).joint_vel[handle.joint][None]


# Success, and the remaining ways that it judges.


def opening_way(view: View, *, handle: Handle) -> Float[Array, ""]:
    """Distance that the handle still has to travel to the target, 0 beyond it: ``lever * max(0, target - position)`` [m]."""
    return handle.lever * jnp.maximum(0.0, target(view, handle) - _fixture(view, handle).joint_pos[handle.joint])


def turning_way(view: View, *, handle: Handle) -> Float[Array, ""]:
    """Distance of the handle from the target, on either side: ``lever * |target - position|`` [m]."""
    return handle.lever * jnp.abs(target(view, handle) - _fixture(view, handle).joint_pos[handle.joint])


def opened(view: View, *, handle: Handle) -> Bool[Array, ""]:
    """True if the joint is at its target or beyond."""
    return opening_way(view, handle=handle) <= 0.0


def turned(view: View, *, handle: Handle, within: Positive) -> Bool[Array, ""]:
    """True if the joint is ``within`` its target [rad or m]."""
    return turning_way(view, handle=handle) < within * handle.lever


# Rewards.


def handle_distance(view: View, *, handle: Handle, std: Positive) -> Float[Array, ""]:
    """1 - tanh(d / std), where d is the distance from the grasp point to the handle [m]."""
    return 1.0 - jnp.tanh(distance(view, handle) / std)


def handle_turn(view: View, *, handle: Handle, std: Positive) -> Float[Array, ""]:
    """1 - tanh(angle / std), from the hand's orientation to the grip (see ``turn``) [rad]."""
    return 1.0 - jnp.tanh(jnp.linalg.norm(turn(view, handle)) / std)


def gripping(
    view: View, *, handle: Handle, near: Positive, open: tuple[float, ...], close: tuple[float, ...]
) -> Float[Array, ""]:
    """Closing of the fingers' targets, from 0 to 1, while the handle is within ``near`` [m] of the grasp point; else 0.

    Args:
        open, close: targets of open and of closed fingers [rad or m]. The fingers come last in ``View.ctrl``.
    """
    first, last = jnp.array(open), jnp.array(close)
    way = last - first
    share = jnp.sum((view.ctrl[-len(open) :] - first) * way) / jnp.sum(jnp.square(way))
    return jnp.where(distance(view, handle) < near, jnp.clip(share, 0.0, 1.0), 0.0)


def opening(view: View, *, handle: Handle) -> Float[Array, ""]:
    """Position of the joint as a share of its target, from 0 to 1."""
    return jnp.clip(_fixture(view, handle).joint_pos[handle.joint] / target(view, handle), 0.0, 1.0)


def turning(view: View, *, handle: Handle, std: Positive) -> Float[Array, ""]:
    """1 - tanh(d / std), where d is the joint's distance from its target [rad or m]."""
    return 1.0 - jnp.tanh(turning_way(view, handle=handle) / handle.lever / std)


def is_opened(view: View, *, handle: Handle) -> Float[Array, ""]:
    """1 while the joint is at its target or beyond."""
    return opened(view, handle=handle).astype(jnp.float32)


def is_turned(view: View, *, handle: Handle, within: Positive) -> Float[Array, ""]:
    """1 while the joint is ``within`` its target [rad or m]."""
    return turned(view, handle=handle, within=within).astype(jnp.float32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Moved(Latch):
    """1 once the joint has moved faster than ``speed`` [rad/s or m/s] with the handle within ``near`` [m] of the grasp point."""

    handle: Handle
    speed: Positive
    near: Positive

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Becomes true when the hand moves the joint."""
        fast = jnp.abs(_fixture(view, self.handle).joint_vel[self.handle.joint]) > self.speed
        memory = memory | fast & (distance(view, self.handle) < self.near)
        return memory, memory
