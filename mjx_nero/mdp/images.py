"""Observation terms that read cameras: pictures of any shape, for groups that keep their terms ``apart``."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt8

from mjx_nero.config.bounds import Count, NonNegative, PositiveRange, Share, Steps
from mjx_nero.mdp.memory import delay
from mjx_nero.types import Key, Picture, UserError, View

_KINDS = ("rgb", "depth", "segmentation")


def rgb(view: View, *, camera: str) -> UInt8[Array, "height width 3"]:
    """Colour picture of a camera: red, green and blue from 0 to 255."""
    return _seen(view, camera, "rgb")


def depth(view: View, *, camera: str) -> Float[Array, "height width 1"]:
    """Distances along a camera's axis [m]; 0 where nothing is in view."""
    return _seen(view, camera, "depth")[..., None]


def rgbd(view: View, *, camera: str) -> Float[Array, "height width 4"]:
    """Red, green and blue from 0 to 1, then the depth [m]."""
    color = _seen(view, camera, "rgb").astype(jnp.float32) / 255
    return jnp.concatenate([color, _seen(view, camera, "depth")[..., None]], axis=-1)


def _seen(view: View, camera: str, kind: str) -> Any:
    if camera not in view.cameras:
        there = ", ".join(view.cameras) or "none"
        raise UserError(f"an observation reads the camera {camera!r}, but the scene's cameras (scene.cameras) are: {there}")
    image = getattr(view.cameras[camera], kind)
    if image is None:
        raise UserError(f"an observation reads {kind} of the camera {camera!r}: add it to scene.cameras.{camera}.kinds")
    return image


@dataclasses.dataclass(frozen=True, kw_only=True)
class Lens:
    """A realistic camera, as a sensor (``mdp.sensors``): exposure and colours per episode, noise, blur, frame rate and delay.

    Attributes:
        camera: the camera's name.
        exposure: range of the factor of all colours, constant for an episode.
        white_balance: each channel is scaled by a factor within 1 +- this, constant for an episode.
        blur: greatest weight of a pixel's four neighbours in its colour. The weight is constant for an episode.
        noise: standard deviation of each channel in every picture, from 0 to 255.
        depth_noise: standard deviation of a depth, divided by its square [1/m].
        depth_step: resolution of depths [m]; 0: exact.
        holes: probability that a depth is missing.
        every: control steps per picture.
        delay: least and greatest delay of pictures [control steps].
        hold: probability that a step keeps the previous step's delay.
    """

    camera: str
    exposure: PositiveRange = (1.0, 1.0)
    white_balance: Share = 0.0
    blur: Share = 0.0
    noise: NonNegative = 0.0
    depth_noise: NonNegative = 0.0
    depth_step: NonNegative = 0.0
    holes: Share = 0.0
    every: Count = 1
    delay: Steps = (0, 0)
    hold: Share = 1.0

    def due(self, memory: tuple) -> Bool[Array, ""]:
        """True if the next ``step`` reads the picture. Otherwise it need not be rendered."""
        return memory[3][0] % self.every == 0 if self.every > 1 else jnp.ones((), bool)

    def init(self, key: Key, view: View) -> tuple:
        """Draws the episode's camera properties, and fills the memory with the first picture."""
        key, k_exposure, k_white, k_blur, k_delay = jax.random.split(key, 5)
        gain = jax.random.uniform(k_exposure, (), minval=self.exposure[0], maxval=self.exposure[1])
        gain *= 1 + self.white_balance * jax.random.uniform(k_white, (3,), minval=-1.0, maxval=1.0)
        blur = self.blur * jax.random.uniform(k_blur)
        seen = view.cameras[self.camera]
        last = (jnp.zeros((), jnp.int32), seen) if self.every > 1 else ()
        kinds = {kind: image for kind in _KINDS if (image := getattr(seen, kind)) is not None}
        line = delay(self.delay, self.hold)
        return key, gain, blur, last, {kind: line.init(k_delay, image) for kind, image in kinds.items()} if line else {}

    def step(self, memory: tuple, view: View) -> tuple[tuple, View]:
        """Replaces the view's picture by the one that the camera delivers."""
        key, gain, blur, last, late = memory
        key, k_noise = jax.random.split(key)
        seen = self._taken(view.cameras[self.camera], gain, blur, k_noise)
        if self.every > 1:
            count, before = last
            seen = jax.tree.map(lambda new, old: jnp.where(count % self.every == 0, new, old), seen, before)
            last = count + 1, seen
        if line := delay(self.delay, self.hold):
            passed = {kind: line.step(late[kind], getattr(seen, kind)) for kind in late}  # one key, so all are equally late
            late = {kind: memory for kind, (memory, _) in passed.items()}
            seen = dataclasses.replace(seen, **{kind: image for kind, (_, image) in passed.items()})
        return (key, gain, blur, last, late), dataclasses.replace(view, cameras={**view.cameras, self.camera: seen})

    def _taken(self, seen: Picture, gain: Array, blur: Array, key: Key) -> Picture:
        k_rgb, k_depth, k_holes = jax.random.split(key, 3)
        rgb, depth = seen.rgb, seen.depth
        if rgb is not None:
            color = rgb.astype(jnp.float32) * gain
            if self.blur:
                edges = jnp.pad(color, ((1, 1), (1, 1), (0, 0)), mode="edge")
                around = edges[:-2, 1:-1] + edges[2:, 1:-1] + edges[1:-1, :-2] + edges[1:-1, 2:]
                color = (1 - blur) * color + blur * around / 4
            if self.noise:
                color += self.noise * jax.random.normal(k_rgb, color.shape)
            rgb = jnp.clip(jnp.round(color), 0, 255).astype(jnp.uint8)
        if depth is not None:
            depth = depth + self.depth_noise * depth**2 * jax.random.normal(k_depth, depth.shape)
            depth = jnp.round(depth / self.depth_step) * self.depth_step if self.depth_step else depth
            depth = jnp.where(jax.random.bernoulli(k_holes, self.holes, depth.shape), 0.0, depth) if self.holes else depth
        return dataclasses.replace(seen, rgb=rgb, depth=depth)
