"""Cameras of a scene: their pictures as arrays, for terms and policies.

Each drawer is one module with one class; ``Cameras`` picks one. All drawers draw the same visual model and return ``Picture``s.
"""

import copy
import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float

from mjx_nero.sim.cameras.cfg import CameraCfg as CameraCfg
from mjx_nero.sim.cameras.look import Look as Look
from mjx_nero.sim.cameras.look import rows
from mjx_nero.sim.fields import nominal
from mjx_nero.types import Picture, Scenery, UserError

_DRAWERS = {"mujoco": ("opengl", "OpenGL"), "warp": ("raytracer", "RayTracer")}
_UNSEEN = 5  # geom group that no camera sees: the goal's marker is for people


class Drawer(Protocol):
    """Draws the pictures of a model's cameras."""

    def __call__(
        self, qpos: jax.Array, fields: Mapping[str, Array], due: Bool[Array, " cameras"] | None = None
    ) -> dict[str, Picture]:
        """Draws the pictures of one world, by camera; vmap it for many. Pure.

        Args:
            qpos: [nq].
            fields: fields of the drawn model that differ from world to world, by MuJoCo's names.
            due: False where a camera's picture is not used, and may be anything. None: all are used.
        """

    def prepare(self, num_envs: int, num_devices: int = 1) -> None:
        """See ``physics.Physics.prepare``."""

    def bytes(self) -> int:
        """Returns the memory of one world outside JAX's [bytes]."""
        return 0


class Cameras:
    """Draws the pictures of a scene's cameras, one world at a time.

    Args:
        model: the scene with visual shapes, from ``scene.build``.
        cfg: the cameras by name.
        renderer: ``mujoco`` (OpenGL) or ``warp`` (MuJoCo Warp's ray tracer).
        fields: names of the model's fields that differ from world to world.

    Raises:
        UserError: this machine cannot draw them.
    """

    def __init__(self, model: mujoco.MjModel, cfg: Mapping[str, CameraCfg], renderer: str, fields: Sequence[str] = ()):
        if renderer == "warp" and not _has_warp():
            raise UserError("the renderer warp needs the extra cuda (pip install 'mjx-nero[cuda]'): use mujoco or auto here")
        model = copy.copy(model)
        model.geom_group[model.geom_bodyid == model.body("goal").id] = _UNSEEN
        self._model, self._names = model, tuple(cfg)
        self._nominal = nominal(model, fields)
        module, kind = _DRAWERS[renderer]
        self.draw: Drawer = getattr(importlib.import_module(f"{__name__}.{module}"), kind)(model, cfg, tuple(self._nominal))

    def __call__(
        self, qpos: Float[Array, " nq"], scenery: Scenery, due: Mapping[str, Bool[Array, ""]] | None = None
    ) -> dict[str, Picture]:
        """Returns the pictures by camera.

        Args:
            due: by camera, False where the picture is not used, and may be anything.
        """
        now = {name: jnp.asarray(scenery.look.get(name, value)) for name, value in self._nominal.items()}
        for field, row, value in rows(self._model, scenery):
            now[field] = now[field].at[row].set(value)
        if not due:
            return self.draw(qpos, now)
        return self.draw(qpos, now, jnp.stack([due.get(name, jnp.ones((), bool)) for name in self._names]))


def renderer(asked: str, impl: str) -> str:
    """Returns the renderer for ``SceneCfg.renderer`` and the physics' ``impl``."""
    return ("mujoco" if impl == "native" or not _has_warp() else "warp") if asked == "auto" else asked


def _has_warp() -> bool:
    return importlib.util.find_spec("warp") is not None
