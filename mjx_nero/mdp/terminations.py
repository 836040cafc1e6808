"""Termination terms: (View, *, params) -> bool."""

import jax.numpy as jnp
from jaxtyping import Array, Bool

from mjx_nero.types import View


def time_out(view: View) -> Bool[Array, ""]:
    """The episode has run its length."""
    return view.step >= view.max_steps


def object_below(view: View, *, minimum_height: float) -> Bool[Array, ""]:
    """The object's centre is below ``minimum_height`` [m]. Isaac Lab's ``root_height_below_minimum``."""
    return view.object_pos_w[2] < minimum_height


def object_off_table(view: View, *, center: tuple[float, float], size: tuple[float, float]) -> Bool[Array, ""]:
    """The object's centre has left the table top, where it would fall (the plane that carries it has no edge) [m]."""
    offset = jnp.abs(view.object_pos_w[:2] - jnp.asarray(center))
    return jnp.any(offset > jnp.asarray(size) / 2)
