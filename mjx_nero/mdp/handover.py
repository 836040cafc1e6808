"""Terms for handing a long object from the first robot to another. They share ``Hands``.

The object's x axis points from the giver's end to the taker's. The rewards of earlier stages remain once the taker holds it.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Positive
from mjx_nero.mdp import success
from mjx_nero.mdp.actions import opening
from mjx_nero.mdp.memory import Latch
from mjx_nero.types import Key, View

Scalar = Float[Array, ""]
Fingers = tuple[float, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hands:
    """Two hands and an object: who holds it, and when.

    Attributes:
        object: the object's name.
        taker: name of the robot that takes it over from the first.
        along: distance of each hand's place from the object's middle [m].
        half: half the object's length [m].
        radius: greatest distance from its place of a hand that holds the object [m].
        minimal_height: least height of the middle of a held object [m].
        clearance: distance from the object's axis beyond which a hand has left it [m].
        giving, taking: targets of open and of closed fingers, of the giver and of the taker [rad or m].
    """

    object: str
    taker: str
    along: Positive
    half: Positive
    radius: Positive
    minimal_height: NonNegative
    clearance: Positive
    giving: tuple[Fingers, Fingers]
    taking: tuple[Fingers, Fingers]

    def axis(self, view: View) -> Float[Array, "3"]:
        """Direction from the giver's end to the taker's."""
        return math.rotate(view.objects[self.object].quat_w, jnp.array([1.0, 0.0, 0.0]))

    def place(self, view: View, taker: bool) -> Float[Array, "3"]:
        """Place of a hand on the object [m]."""
        return view.objects[self.object].pos_w + (self.along if taker else -self.along) * self.axis(view)

    def hand(self, view: View, taker: bool) -> View:
        """The view of one robot."""
        return view.of(self.taker) if taker else view.of()

    def way(self, view: View, taker: bool) -> Float[Array, "3"]:
        """Vector from a hand to its place on the object [m]."""
        return self.place(view, taker) - self.hand(view, taker).ee_pos_w

    def near(self, view: View, taker: bool) -> Bool[Array, ""]:
        """True if the hand is at its place on the object."""
        return jnp.linalg.norm(self.way(view, taker)) < self.radius

    def gap(self, view: View, taker: bool) -> Scalar:
        """Distance of a hand from the object's axis, between its ends [m]."""
        off = self.hand(view, taker).ee_pos_w - view.objects[self.object].pos_w
        along = jnp.clip(off @ self.axis(view), -self.half, self.half)
        return jnp.linalg.norm(off - along * self.axis(view))

    def lifted(self, view: View) -> Bool[Array, ""]:
        """True if the object is above the table."""
        return view.objects[self.object].pos_w[2] > self.minimal_height

    def gives(self, view: View) -> Bool[Array, ""]:
        """True if the object is in the giver's hand, above the table."""
        return self.near(view, False) & self.lifted(view)

    def told(self, view: View, taker: bool) -> Scalar:
        """Commanded opening of a hand's fingers: 0 closed, 1 open."""
        open, close = (np.array(ends, np.float32) for ends in (self.taking if taker else self.giving))
        targets = self.hand(view, taker).ctrl[-len(open) :]
        return jnp.clip(0.5 + 0.5 * opening(targets, open, close), 0.0, 1.0)

    def takes(self, view: View) -> Bool[Array, ""]:
        """True if the object is above the table in the taker's hand, and that hand is commanded to close."""
        return self.near(view, True) & self.lifted(view) & (self.told(view, True) < 0.5)

    def alone(self, view: View) -> Bool[Array, ""]:
        """True if the object is in the taker's hand, above the table, and the giver's hand has left it."""
        return self.near(view, True) & self.lifted(view) & (self.gap(view, False) > self.clearance)

    def passed(self, view: View) -> Bool[Array, ""]:
        """True if the taker holds the object, alone or not. A hand that leaves after that loses no reward."""
        return self.takes(view) | self.alone(view)


def way(view: View, *, hands: Hands, taker: bool) -> Float[Array, "3"]:
    """Vector from a hand to its place on the object [m]."""
    return hands.way(view, taker)


def axis(view: View, *, hands: Hands) -> Float[Array, "3"]:
    """Direction of the object, from the giver's end to the taker's."""
    return hands.axis(view)


def fingers(view: View, *, hands: Hands) -> Float[Array, "2"]:
    """Commanded opening of the giver's and the taker's fingers: 0 closed, 1 open."""
    return jnp.stack([hands.told(view, False), hands.told(view, True)])


def holders(view: View, *, hands: Hands) -> Float[Array, "3"]:
    """Three flags, each 0 or 1: the giver holds the object, the taker does, the taker alone does."""
    return jnp.stack([hands.gives(view), hands.takes(view), hands.alone(view)]).astype(jnp.float32)


def to_meeting(view: View, *, hands: Hands, meet: tuple[float, float, float]) -> Float[Array, "3"]:
    """Vector from the object's middle to the meeting point [m]. ``meet`` gives that point relative to the giver's root."""
    return view.root_pos_w + jnp.array(meet) - view.objects[hands.object].pos_w


def reached(view: View, *, hands: Hands, std: Positive) -> Scalar:
    """1 - tanh(d / std), where d is the distance of the giver's hand from its place; 1 once the taker holds the object."""
    near = 1.0 - jnp.tanh(jnp.linalg.norm(hands.way(view, False)) / std)
    return jnp.where(hands.passed(view), 1.0, near)


def held(view: View, *, hands: Hands) -> Scalar:
    """1 while either robot holds the object."""
    return (hands.gives(view) | hands.passed(view)).astype(jnp.float32)


def presented(view: View, *, hands: Hands, meet: tuple[float, float, float], std: Positive) -> Scalar:
    """1 - tanh(d / std) while the giver holds the object, where d is its way to the meeting point; 1 once the taker does."""
    near = 1.0 - jnp.tanh(jnp.linalg.norm(to_meeting(view, hands=hands, meet=meet)) / std)
    return jnp.where(hands.passed(view), 1.0, hands.gives(view) * near)


def pointed(view: View, *, hands: Hands, std: Positive) -> Scalar:
    """1 - tanh(angle / std) while the giver holds the object; 1 once the taker does.

    The angle is from the object's axis to the world's x axis [rad].
    """
    angle = jnp.arccos(jnp.clip(hands.axis(view)[0], -0.9999, 0.9999))
    return jnp.where(hands.passed(view), 1.0, hands.gives(view) * (1.0 - jnp.tanh(angle / std)))


def met(view: View, *, hands: Hands, std: Positive) -> Scalar:
    """1 - tanh(d / std) while either robot holds the object, where d is the distance of the taker's hand from its place."""
    near = 1.0 - jnp.tanh(jnp.linalg.norm(hands.way(view, True)) / std)
    return (hands.gives(view) | hands.passed(view)) * near


def taken(view: View, *, hands: Hands) -> Scalar:
    """1 while the taker holds the object."""
    return hands.takes(view).astype(jnp.float32)


def released(view: View, *, hands: Hands) -> Scalar:
    """Commanded opening of the giver's fingers, from 0 to 1, while the taker holds the object; 1 once the taker alone does."""
    return jnp.where(hands.alone(view), 1.0, hands.takes(view) * hands.told(view, False))


def left(view: View, *, hands: Hands) -> Scalar:
    """Distance of the giver's hand from the object, as a share of ``clearance``, at most 1, while the taker holds it."""
    return hands.takes(view) * jnp.minimum(hands.gap(view, False) / hands.clearance, 1.0)


def brought(view: View, *, hands: Hands, std: Positive) -> Scalar:
    """1 - tanh(d / std) while the taker alone holds the object, where d is the distance to the goal [m]."""
    return hands.alone(view) * (1.0 - jnp.tanh(success.object_distance(view, object=hands.object) / std))


def hands_clash(view: View, *, taker: str, apart: Positive) -> Bool[Array, ""]:
    """True if the two grasp points are closer than ``apart`` [m], where the hands would collide."""
    return jnp.linalg.norm(view.of().ee_pos_w - view.of(taker).ee_pos_w) < apart


@dataclasses.dataclass(frozen=True, kw_only=True)
class HandedOver:
    """1 once the taker alone has held the object, after the giver held it.

    Attributes:
        hands: the two hands and their object.
    """

    hands: Hands

    def init(self, key: Key, view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Starts with both false."""
        return jnp.zeros((), bool), jnp.zeros((), bool)

    def step(self, memory: tuple, view: View) -> tuple[tuple, Bool[Array, ""]]:
        """Records who holds the object."""
        gave = memory[0] | self.hands.gives(view)
        took = memory[1] | gave & self.hands.alone(view)
        return (gave, took), took


@dataclasses.dataclass(frozen=True, kw_only=True)
class HeldAtGoal(Latch):
    """True if the taker alone holds the object still at the goal, after the giver held it.

    Attributes:
        hands: the two hands and their object.
        threshold: greatest distance from the goal [m].
        max_speed: greatest speed of an object that counts as still [m/s].
    """

    hands: Hands
    threshold: Positive
    max_speed: Positive

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Records that the giver holds the object, and returns whether this step is a success."""
        memory = memory | self.hands.gives(view)
        seen = view.objects[self.hands.object]
        still = jnp.linalg.norm(seen.linvel_w) < self.max_speed
        there = success.object_at_goal(view, threshold=self.threshold, object=self.hands.object)
        return memory, memory & self.hands.alone(view) & there & still
