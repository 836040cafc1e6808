"""Towers: objects that belong at the goal, or onto one another; what the terms of ``place`` and ``stack`` have in common.

An object *stands* while it is at its place, whoever holds it there, and those below it stand. Rewards are sums over the objects
that are to be moved, each from when those below it stand. What is paid for an object that is held is paid on while it stands, so
nothing is lost by letting go of it there; for one that flies nothing is paid.
"""

import dataclasses
from collections.abc import Iterable, Iterator

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Positive
from mjx_nero.mdp.rewards import held
from mjx_nero.types import UserError, View

GOAL = "goal"  # at the bottom of a tower
Within = tuple[Positive, Positive, Positive]
Scalar = Float[Array, ""]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Place:
    """Where objects belong, how near is there, and how far away a hand is that holds or has left one.

    Attributes:
        tower: the objects from the bottom up: ``("goal", "box")`` is a box at the goal, ``("blue", "red")`` the red one on the
            blue one, wherever that is.
        rise: from the centre of an object to that of the next one on it [m].
        within: how far from its place an object stands: along the table [m], in height [m], and at the goal in angle [rad].
        minimal_height: an object that is held is this high [m] ...
        grasp_radius: ... and this near to the grasp point [m] (see ``rewards.held``).
        clearance: from an object to the grasp point of a hand that has left it [m].
    """

    tower: tuple[str, ...]
    rise: float
    within: Within
    minimal_height: float
    grasp_radius: Positive
    clearance: NonNegative

    @property
    def steps(self) -> Iterator[tuple[str, str]]:
        """Each object that is to be moved, after the one below it."""
        return zip(self.tower, self.tower[1:], strict=False)

    def holds(self, view: View, object: str, minimal_height: float | None = None) -> Bool[Array, ""]:
        """Whether the object is held; with another height than ``minimal_height``."""
        least = self.minimal_height if minimal_height is None else minimal_height
        return held(view, minimal_height=least, grasp_radius=self.grasp_radius, object=object)


@dataclasses.dataclass(frozen=True)
class _Level:
    """An object that is to be moved: the way to its place [m], whether those below it stand, whether it is over its place, and
    whether it stands."""

    object: str
    below: str
    way: Float[Array, "3"]
    due: Bool[Array, ""]
    over: Bool[Array, ""]
    stands: Bool[Array, ""]


def way(view: View, *, below: str, object: str, rise: float) -> Float[Array, "3"]:
    """From the object to its place on the one ``below``, or at the goal [m]."""
    place = view.goal_pos_w if below == GOAL else view.objects[below].pos_w + jnp.array([0.0, 0.0, rise])
    return place - view.objects[object].pos_w


def turn_to_goal(view: View, *, object: str) -> Float[Array, "3"]:
    """The rotation vector that turns the object to the goal's orientation, in its own frame [rad]."""
    return math.quat_log(math.quat_mul(math.quat_conj(view.objects[object].quat_w), view.goal_quat_w))


def turn_to_object(view: View, *, object: str, down: tuple[float, float, float, float]) -> Float[Array, "3"]:
    """The rotation vector that turns the hand, straight down where it is ``down``, to the object's orientation, in its own frame
    [rad]."""
    wanted = math.quat_mul(view.objects[object].quat_w, jnp.array(down))
    return math.quat_log(math.quat_mul(math.quat_conj(view.ee_quat_w), wanted))


def _levels(view: View, place: Place) -> Iterator[_Level]:
    aside, height, angle = place.within
    due = jnp.ones((), bool)
    for below, object in place.steps:
        to = way(view, below=below, object=object, rise=place.rise)
        over = jnp.linalg.norm(to[:2]) < aside
        there = over & (jnp.abs(to[2]) < height)
        if below == GOAL:
            there &= jnp.linalg.norm(turn_to_goal(view, object=object)) < angle
        yield _Level(object, below, to, due, over, due & there)
        due &= there


def distance(view: View, *, place: Place) -> Scalar:
    """Of the object that is farthest from its place [m]."""
    ways = [way(view, below=below, object=object, rise=place.rise) for below, object in place.steps]
    return jnp.max(jnp.stack([jnp.linalg.norm(to) for to in ways]))


def built(view: View, *, place: Place, max_speed: Positive) -> Bool[Array, ""]:
    """All objects stand, are slower than ``max_speed`` [m/s], turn by less than ten of it [rad/s], and have been let go of: the
    grasp point is at least ``place.clearance`` from each."""
    met = [level.stands for level in _levels(view, place)]
    for name in place.tower:
        if name == GOAL:
            continue
        seen = view.objects[name]
        still = (jnp.linalg.norm(seen.linvel_w) < max_speed) & (jnp.linalg.norm(seen.angvel_local) < 10 * max_speed)
        met.append(still & (jnp.linalg.norm(view.ee_pos_w - seen.pos_w) > place.clearance))
    return jnp.all(jnp.stack(met))


def left_alone(view: View, *, place: Place, max_speed: Positive) -> Bool[Array, ""]:
    """``built``, and the robot touches none of the objects, by the scene's sensors of the hand.

    Raises:
        UserError: the scene has none.
    """
    if "hand" not in view.readings:
        raise UserError("towers.left_alone needs scene.hand, and this task is without")
    return built(view, place=place, max_speed=max_speed) & (view.readings["hand"] == 0)


def _sum(values: Iterable[Array]) -> Scalar:
    return sum(values, start=jnp.zeros(()))


def reached(view: View, *, place: Place, std: Positive) -> Scalar:
    """1 - tanh(distance from the grasp point to the object / std); 1 where it stands."""
    near = {name: 1.0 - jnp.tanh(jnp.linalg.norm(view.objects[name].pos_w - view.ee_pos_w) / std) for name in place.tower[1:]}
    levels = _levels(view, place)
    return _sum(level.due * jnp.where(level.stands, 1.0, near[level.object]) for level in levels)


def _carried(view: View, level: _Level, place: Place) -> Bool[Array, ""]:
    # Over its place an object may be as low as it likes: else its last centimetre down would cost all that is paid.
    lowered = level.over & place.holds(view, level.object, minimal_height=-jnp.inf)
    return level.due & (place.holds(view, level.object) | lowered | level.stands)


def carried(view: View, *, place: Place) -> Scalar:
    """1 while the object is held or stands."""
    return _sum(_carried(view, level, place) for level in _levels(view, place))


def approached(view: View, *, place: Place, over: Positive, std: Positive, flat: NonNegative = 0.0) -> Scalar:
    """1 - tanh(distance from the way to its place / std), while the object is held or stands.

    The way comes down a cone of 45 degrees from ``over`` above the place [m]: straight to it would be through the side of what is
    below. The distance is that along the table and that in height from the cone, together: 0 at the place alone.

    Args:
        flat: radius of the cone's flat tip [m]; inside it only height counts. Zero: a point, so that an object a little beside
            its place is paid for as much height as that.
    """

    def near(level: _Level) -> Scalar:
        aside = jnp.linalg.norm(level.way[:2])
        off = jnp.hypot(aside, level.way[2] + jnp.clip(aside - flat, 0.0, over))
        return _carried(view, level, place) * (1.0 - jnp.tanh(off / std))

    return _sum(near(level) for level in _levels(view, place))


def aligned(view: View, *, place: Place, std: Positive) -> Scalar:
    """1 - tanh(angle of the lowest object from the goal's orientation / std), while it is held or stands."""
    level = next(_levels(view, place))
    angle = jnp.linalg.norm(turn_to_goal(view, object=level.object))
    return _carried(view, level, place) * (1.0 - jnp.tanh(angle / std))


def standing(view: View, *, place: Place) -> Scalar:
    """1 while the object stands."""
    return _sum(level.stands for level in _levels(view, place))


def _away(view: View, level: _Level, place: Place) -> Scalar:
    """How far the grasp point is from the object, from 0 to 1; where that is on another, above or beside it.

    Below is not away there: down a tower a hand slides that hardly opens, to hold what is there; up it takes the object along.
    """
    off = view.ee_pos_w - view.objects[level.object].pos_w
    off = off if level.below == GOAL else off.at[2].max(0.0)
    return jnp.minimum(jnp.linalg.norm(off) / place.clearance, 1.0)


def _let_go(view: View, level: _Level, place: Place, at: Array, open: tuple[float, ...], hold: tuple[float, ...]) -> Scalar:
    """How far fingers that are ``at`` are opened, from 0 to 1; below the top of a tower, where they have work elsewhere, or how
    far they are away, if that is more."""
    opens, holds = jnp.array(open), jnp.array(hold)
    share = jnp.clip(jnp.mean((at[-len(open) :] - holds) / (opens - holds)), 0.0, 1.0)
    return share if level.object == place.tower[-1] else jnp.maximum(share, _away(view, level, place))


def told_to_open(view: View, *, place: Place, open: tuple[float, ...], hold: tuple[float, ...]) -> Scalar:
    """How far the targets of the fingers are opened while the object stands, from 0 to 1: so a step to let go is paid at once.
    Below the top of a tower, or how far they are from it (see ``left``), if that is more: they have work elsewhere.

    Args:
        open, hold: targets of the gripper's drives, the last of all, wide open and where that begins to count [rad or m].
    """
    levels = _levels(view, place)
    return _sum(level.stands * _let_go(view, level, place, view.ctrl, open, hold) for level in levels)


def left(view: View, *, place: Place) -> Scalar:
    """How far the grasp point is from an object that stands, as a share of ``place.clearance``, at most 1; where that is on
    another one, above or beside it."""
    return _sum(level.stands * _away(view, level, place) for level in _levels(view, place))


def left_with_open_fingers(view: View, *, place: Place, open: tuple[float, ...], hold: tuple[float, ...]) -> Scalar:
    """``left`` times how far the fingers are open, so a hand that still holds the edge earns nothing; below the top of a tower as
    ``told_to_open``.

    Args:
        open, hold: positions of the gripper's joints, the last of all, wide open and where that begins to count [rad or m].
    """

    def gone(level: _Level) -> Scalar:
        return _let_go(view, level, place, view.joint_pos, open, hold) * _away(view, level, place)

    return _sum(level.stands * gone(level) for level in _levels(view, place))


def completed(view: View, *, place: Place, max_speed: Positive) -> Scalar:
    """1 while all is as it should be (see ``built``)."""
    return built(view, place=place, max_speed=max_speed).astype(jnp.float32)
