"""Holes and posts: terms for objects that go into place from above and stay there unaided. See ``towers``."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_nero.config.bounds import Positive
from mjx_nero.mdp import success, towers
from mjx_nero.mdp.towers import Place, Scalar
from mjx_nero.types import View


def to_place(view: View, *, place: Place) -> Float[Array, "3"]:
    """Vector from the lowest object to be moved to its true place [m]."""
    below, object = next(place.steps)
    return towers.way(view, below=below, object=object, rise=place.rise)


def let_be(view: View, *, place: Place, max_speed: Positive) -> Bool[Array, ""]:
    """True if the tower is ``built`` and the finger sensors read no contact.

    Raises:
        UserError: the scene has no finger sensors.
    """
    return success.pads_are_free(view, "holes.let_be") & towers.built(view, place=place, max_speed=max_speed)


def lowered(view: View, *, place: Place, top: Positive, std: Positive, flat: Positive) -> Scalar:
    """1 - tanh(d / std) while the object is held or stands, where d is the length of its path into place from above [m].

    It is for holes and posts. An object more than ``flat`` [m] beside its place has to be ``top`` [m] above it first. So d is the
    distance along the table, plus the height, plus twice the height that such an object still lacks to ``top``.
    """

    def near(level: towers.Level) -> Scalar:
        aside, height = jnp.linalg.norm(level.way[:2]), -level.way[2]
        lacks = jnp.where(aside > flat, jnp.maximum(top - height, 0.0), 0.0)
        return towers.is_carried(view, level, place) * (1.0 - jnp.tanh((aside + jnp.abs(height) + 2.0 * lacks) / std))

    return towers.total(near(level) for level in towers.levels(view, place))
