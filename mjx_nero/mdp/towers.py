"""Towers: objects that belong at the goal or on one another. The terms of ``place`` and ``stack`` share this module.

An object *stands* while it is at its place, held or not, and all objects below it stand. Rewards sum over the objects to move,
each from the moment the ones below it stand. A standing object keeps the rewards of a held one, so letting go there costs
nothing. An object that flies through the air unheld earns nothing.
"""

import dataclasses
from collections.abc import Iterable, Iterator

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Positive
from mjx_nero.mdp.rewards import held, stillness
from mjx_nero.types import UserError, View

GOAL = "goal"  # the bottom of a tower that is not built on an object
Within = tuple[Positive, Positive, Positive]
Scalar = Float[Array, ""]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Place:
    """A tower to build: where its objects belong, and when they count as held, standing or left.

    Attributes:
        tower: the objects from the bottom up. ``("goal", "box")`` is a box at the goal; ``("blue", "red")`` is the red object on
            the blue one, wherever that is; ``("socket/hole", "peg")`` is the peg on a site of a fixture.
        rise: height from one object's centre, or from the site, to the next one's [m].
        within: tolerances of a standing object: along the table [m], in height [m], and at the goal in angle [rad].
        minimal_height: least height of a held object [m].
        grasp_radius: greatest distance of a held object from the grasp point [m] (see ``rewards.held``).
        clearance: distance of the grasp point from an object that the hand has left [m].
    """

    tower: tuple[str, ...]
    rise: float
    within: Within
    minimal_height: float
    grasp_radius: Positive
    clearance: NonNegative

    @property
    def steps(self) -> Iterator[tuple[str, str]]:
        """Pairs of neighbours: the lower object, and the one to put on it."""
        return zip(self.tower, self.tower[1:], strict=False)

    def holds(self, view: View, object: str, minimal_height: float | None = None) -> Bool[Array, ""]:
        """True if the object is held; ``minimal_height`` replaces the field of that name."""
        least = self.minimal_height if minimal_height is None else minimal_height
        return held(view, minimal_height=least, grasp_radius=self.grasp_radius, object=object)


@dataclasses.dataclass(frozen=True)
class Level:
    """One object to move, and its way to its place [m].

    Attributes:
        due: all objects below it stand.
        over: it is over its place, at any height.
        stands: it stands, and all objects below it do.
    """

    object: str
    below: str
    way: Float[Array, "3"]
    due: Bool[Array, ""]
    over: Bool[Array, ""]
    stands: Bool[Array, ""]


def way(view: View, *, below: str, object: str, rise: float) -> Float[Array, "3"]:
    """Vector from the object to its place on what is ``below``, or at the goal [m]."""
    (fixture, _, site), at = below.partition("/"), view.objects[object].pos_w
    if below == GOAL:
        return view.goal_pos_w - at
    under = view.fixtures[fixture].site_pos_w[site] if site else view.objects[below].pos_w
    return under + jnp.array([0.0, 0.0, rise]) - at


def turn_to_goal(view: View, *, object: str) -> Float[Array, "3"]:
    """Rotation vector that turns the object to the goal's orientation, in the object's frame [rad]."""
    return math.quat_log(math.quat_mul(math.quat_conj(view.objects[object].quat_w), view.goal_quat_w))


def turn_to_object(view: View, *, object: str, down: tuple[float, float, float, float]) -> Float[Array, "3"]:
    """Rotation vector that aligns the hand with the object, in the hand's frame [rad].

    ``down`` is the orientation of a hand that points straight down. An aligned hand points down and has the object's yaw.
    """
    wanted = math.quat_mul(view.objects[object].quat_w, jnp.array(down))
    return math.quat_log(math.quat_mul(math.quat_conj(view.ee_quat_w), wanted))


def levels(view: View, place: Place) -> Iterator[Level]:
    """Yields the objects to move, from the bottom up."""
    aside, height, angle = place.within
    due = jnp.ones((), bool)
    for below, object in place.steps:
        to = way(view, below=below, object=object, rise=place.rise)
        over = jnp.linalg.norm(to[:2]) < aside
        there = over & (jnp.abs(to[2]) < height)
        if below == GOAL:
            there &= jnp.linalg.norm(turn_to_goal(view, object=object)) < angle
        yield Level(object, below, to, due, over, due & there)
        due &= there


def distance(view: View, *, place: Place) -> Scalar:
    """Distance of the farthest object from its place [m]."""
    ways = [way(view, below=below, object=object, rise=place.rise) for below, object in place.steps]
    return jnp.max(jnp.stack([jnp.linalg.norm(to) for to in ways]))


def built(view: View, *, place: Place, max_speed: Positive) -> Bool[Array, ""]:
    """True if all objects stand at rest and the hand has let go.

    At rest: slower than ``max_speed`` [m/s] and ten times that [rad/s]. Let go: the grasp point is more than ``place.clearance``
    away.
    """
    met = [level.stands for level in levels(view, place)]
    for name in place.tower:
        if name not in view.objects:
            continue
        seen = view.objects[name]
        still = (jnp.linalg.norm(seen.linvel_w) < max_speed) & (jnp.linalg.norm(seen.angvel_local) < 10 * max_speed)
        met.append(still & (jnp.linalg.norm(view.ee_pos_w - seen.pos_w) > place.clearance))
    return jnp.all(jnp.stack(met))


def left_alone(view: View, *, place: Place, max_speed: Positive) -> Bool[Array, ""]:
    """True if the tower is ``built`` and the hand sensors read no contact with the objects.

    Raises:
        UserError: the scene has no hand sensors.
    """
    if "hand" not in view.readings:
        raise UserError("towers.left_alone needs 'hand' among scene.sensors, but this task has none")
    return built(view, place=place, max_speed=max_speed) & (view.readings["hand"] == 0)


def total(values: Iterable[Array]) -> Scalar:
    """Sums the values; zero if there are none."""
    return sum(values, start=jnp.zeros(()))


def reached(view: View, *, place: Place, std: Positive) -> Scalar:
    """1 - tanh(d / std), where d is the distance from the grasp point to the object; 1 once the object stands."""
    near = {name: 1.0 - jnp.tanh(jnp.linalg.norm(view.objects[name].pos_w - view.ee_pos_w) / std) for name in place.tower[1:]}
    return total(level.due * jnp.where(level.stands, 1.0, near[level.object]) for level in levels(view, place))


def is_carried(view: View, level: Level, place: Place) -> Bool[Array, ""]:
    """True if an object is due, and stands or is held. Over its place it may be held at any height."""
    # Otherwise the last centimetre down would cost the object its reward.
    lowered = level.over & place.holds(view, level.object, minimal_height=-jnp.inf)
    return level.due & (place.holds(view, level.object) | lowered | level.stands)


def carried(view: View, *, place: Place) -> Scalar:
    """1 while the object is held or stands, else 0."""
    return total(is_carried(view, level, place) for level in levels(view, place))


def approached(view: View, *, place: Place, over: Positive, std: Positive, flat: NonNegative = 0.0) -> Scalar:
    """1 - tanh(d / std) while the object is held or stands, where d is the distance to its place by way of a cone [m].

    The cone opens upwards at 45 degrees from the place, up to ``over`` [m]: the straight path would hit the object below from the
    side. d combines the distance along the table with the height above the cone, and is 0 only at the place.

    Args:
        flat: radius of the cone's flat tip [m]; inside it only height counts. Zero: a point, so an object slightly beside its
            place earns most if it is that much too high.
    """

    def near(level: Level) -> Scalar:
        aside = jnp.linalg.norm(level.way[:2])
        off = jnp.hypot(aside, level.way[2] + jnp.clip(aside - flat, 0.0, over))
        return is_carried(view, level, place) * (1.0 - jnp.tanh(off / std))

    return total(near(level) for level in levels(view, place))


def aligned(view: View, *, place: Place, std: Positive) -> Scalar:
    """1 - tanh(angle / std) while the lowest object is held or stands, where angle is its turn from the goal [rad]."""
    level = next(levels(view, place))
    angle = jnp.linalg.norm(turn_to_goal(view, object=level.object))
    return is_carried(view, level, place) * (1.0 - jnp.tanh(angle / std))


def standing(view: View, *, place: Place) -> Scalar:
    """1 while the object stands, else 0."""
    return total(level.stands for level in levels(view, place))


def _away(view: View, level: Level, place: Place) -> Scalar:
    """Distance of the grasp point from the object, from 0 to 1. On another object, only distance above or beside counts.

    A hand below has not left. It would slide down the tower with its fingers barely open, and take the object along on its way
    up.
    """
    off = view.ee_pos_w - view.objects[level.object].pos_w
    off = off.at[2].max(0.0) if level.below in view.objects else off
    return jnp.minimum(jnp.linalg.norm(off) / place.clearance, 1.0)


def _let_go(view: View, level: Level, place: Place, at: Array, open: tuple[float, ...], hold: tuple[float, ...]) -> Scalar:
    """Opening of the finger positions or targets ``at``, from 0 at ``hold`` to 1 at ``open``.

    Below the top of a tower the hand still has work to do, so its distance counts instead if that is larger.
    """
    opens, holds = jnp.array(open), jnp.array(hold)
    share = jnp.clip(jnp.mean((at[-len(open) :] - holds) / (opens - holds)), 0.0, 1.0)
    return share if level.object == place.tower[-1] else jnp.maximum(share, _away(view, level, place))


def told_to_open(view: View, *, place: Place, open: tuple[float, ...], hold: tuple[float, ...]) -> Scalar:
    """Commanded opening of the fingers while the object stands, from 0 to 1, so the first step of letting go pays at once.

    Below the top of a tower the hand's distance counts instead (see ``left``) if that is larger: the fingers have work elsewhere.

    Args:
        open, hold: targets of the gripper's drives (the last ones) where the reward is 1, and where it begins [rad or m].
    """
    return total(level.stands * _let_go(view, level, place, view.ctrl, open, hold) for level in levels(view, place))


def left(view: View, *, place: Place) -> Scalar:
    """Distance of the grasp point from a standing object, as a share of ``place.clearance``, at most 1.

    On another object, only distance above or beside counts.
    """
    return total(level.stands * _away(view, level, place) for level in levels(view, place))


def left_with_open_fingers(view: View, *, place: Place, open: tuple[float, ...], hold: tuple[float, ...]) -> Scalar:
    """``left`` times how far the fingers are open, so a hand that still holds the edge earns nothing.

    Below the top of a tower, as in ``told_to_open``.

    Args:
        open, hold: positions of the gripper's joints (the last ones) when wide open, and where the reward begins [rad or m].
    """

    def gone(level: Level) -> Scalar:
        return _let_go(view, level, place, view.joint_pos, open, hold) * _away(view, level, place)

    return total(level.stands * gone(level) for level in levels(view, place))


def completed(view: View, *, place: Place, max_speed: Positive) -> Scalar:
    """1 while the tower is built (see ``built``), else 0."""
    return built(view, place=place, max_speed=max_speed).astype(jnp.float32)


def rested(view: View, *, place: Place, max_speed: Positive, std: Positive) -> Scalar:
    """``rewards.stillness`` while the tower is built (see ``built``), else 0.

    Without it a hand that has finished has no reason to stay: it swings away, and sooner or later hits something.

    Args:
        std: speed at which most of the reward is lost [rad/s].
    """
    return completed(view, place=place, max_speed=max_speed) * stillness(view, std=std)
