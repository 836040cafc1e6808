"""Termination terms: (View, *, params) -> bool."""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from mjx_nero.config.bounds import Positive
from mjx_nero.types import View


def time_out(view: View) -> Bool[Array, ""]:
    """True once the episode has run its length."""
    return view.step >= view.max_steps


def object_below(view: View, *, minimum_height: float, object: str = "cube") -> Bool[Array, ""]:
    """True if the object's centre is below ``minimum_height`` [m]. Isaac Lab's ``root_height_below_minimum``."""
    return view.objects[object].pos_w[2] < minimum_height


def object_off_table(
    view: View, *, center: tuple[float, float], size: tuple[Positive, Positive], object: str = "cube"
) -> Bool[Array, ""]:
    """True if the object's centre is beyond the table top's edge [m].

    The supporting plane has no edge, so the object does not fall.
    """
    offset = jnp.abs(view.objects[object].pos_w[:2] - jnp.asarray(center))
    return jnp.any(offset > jnp.asarray(size) / 2)


def any_off_table(
    view: View, *, center: tuple[float, float], size: tuple[Positive, Positive], objects: tuple[str, ...], parked: Positive
) -> Bool[Array, ""]:
    """True if one of the objects has left the table top (see ``object_off_table``).

    Objects farther than ``parked`` from its centre along x or y [m] are ignored: they were never on it.
    """
    offset = jnp.stack([jnp.abs(view.objects[name].pos_w[:2] - jnp.asarray(center)) for name in objects])
    return jnp.any((offset > jnp.asarray(size) / 2).any(axis=1) & (offset < parked).all(axis=1))
