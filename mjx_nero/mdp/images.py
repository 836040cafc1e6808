"""Observation terms that read cameras: pictures of any shape, for groups whose terms stay apart."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt8

from mjx_nero.types import UserError, View


def rgb(view: View, *, camera: str) -> UInt8[Array, "height width 3"]:
    """What a camera sees: red, green and blue from 0 to 255."""
    return _seen(view, camera, "rgb")


def depth(view: View, *, camera: str) -> Float[Array, "height width 1"]:
    """How far away what a camera sees is, along its axis [m]; 0: nothing is there."""
    return _seen(view, camera, "depth")[..., None]


def rgbd(view: View, *, camera: str) -> Float[Array, "height width 4"]:
    """Red, green and blue from 0 to 1, then the depth [m]."""
    color = _seen(view, camera, "rgb").astype(jnp.float32) / 255
    return jnp.concatenate([color, _seen(view, camera, "depth")[..., None]], axis=-1)


def _seen(view: View, camera: str, kind: str) -> Any:
    if camera not in view.cameras:
        there = ", ".join(view.cameras) or "none"
        raise UserError(f"an observation reads the camera {camera!r}, and the scene's cameras (scene.cameras) are: {there}")
    image = getattr(view.cameras[camera], kind)
    if image is None:
        raise UserError(f"an observation reads {kind} of the camera {camera!r}: add it to scene.cameras.{camera}.kinds")
    return image
