"""Holes and posts: terms of objects that go to their places from above, and stay there by themselves. See ``towers``."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero.config.bounds import Positive
from mjx_nero.mdp import success, towers
from mjx_nero.mdp.towers import Place, Scalar
from mjx_nero.types import View


def to_place(view: View, *, place: Place) -> Float[Array, "3"]:
    """Vector from the lowest object that moves to its true place [m]."""
    below, object = next(place.steps)
    return towers.way(view, below=below, object=object, rise=place.rise)


def let_be(view: View, *, place: Place, max_speed: Positive) -> Bool[Array, ""]:
    """``built``, and the pads touch nothing, by the scene's sensors of the fingers.

    Raises:
        UserError: the scene has none.
    """
    return success.pads_are_free(view, "holes.let_be") & towers.built(view, place=place, max_speed=max_speed)


def lowered(view: View, *, place: Place, top: Positive, std: Positive, flat: Positive) -> Scalar:
    """1 - tanh(d / std) while the object is held or stands, where d is the way to its place from above [m].

    The way is for holes and posts: beside its place by more than ``flat`` [m], the object has to be ``top`` above it [m]. So d is
    the distance along the table, plus the height, plus twice what the height lacks to ``top`` there.
    """

    def near(level: towers.Level) -> Scalar:
        aside, height = jnp.linalg.norm(level.way[:2]), -level.way[2]
        lacks = jnp.where(aside > flat, jnp.maximum(top - height, 0.0), 0.0)
        return towers.is_carried(view, level, place) * (1.0 - jnp.tanh((aside + jnp.abs(height) + 2.0 * lacks) / std))

    return towers.total(near(level) for level in towers.levels(view, place))
