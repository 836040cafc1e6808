"""Physics and cameras of the Nero's lift that compile at once."""

import types

import jax.numpy as jnp
from kinematic import Kinematic

from mjx_nero import ManipulationEnv
from mjx_nero.types import Picture

EDGE = 16
SMALL = {"scene.cameras.front.size": (EDGE, EDGE), "scene.cameras.wrist.size": (EDGE, EDGE), "episode_length_s": 0.2}


def drawn(qpos, scenery):
    """Pictures of the table from above, 40 cm wide: where the cube is it is bright."""
    x, y = jnp.meshgrid(jnp.linspace(0.15, 0.55, EDGE), jnp.linspace(-0.2, 0.2, EDGE), indexing="ij")
    bright = jnp.exp(-((x - qpos[9]) ** 2 + (y - qpos[10]) ** 2) / 0.05**2)
    rgb = jnp.tile((255 * bright).astype(jnp.uint8)[..., None], (1, 1, 3))
    return {"front": Picture(rgb=rgb), "wrist": Picture(rgb=255 - rgb)}


def patch(monkeypatch):
    """Gives all environments physics and cameras that compile at once."""
    drawn.draw = types.SimpleNamespace(prepare=lambda *_: None, bytes=lambda: 0)
    monkeypatch.setattr(ManipulationEnv, "physics", Kinematic())
    monkeypatch.setattr(ManipulationEnv, "cameras", staticmethod(drawn))
