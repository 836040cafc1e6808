"""MuJoCo's own renderer: OpenGL on the host, called back by JAX. It draws world after world, so it suits few of them."""

import concurrent.futures
import contextlib
import copy
import itertools
import math
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool

from mjx_nero.sim import render
from mjx_nero.sim.cameras import Drawer
from mjx_nero.sim.cameras.cfg import MARK, CameraCfg
from mjx_nero.types import Picture

_TYPES = {"rgb": np.uint8, "depth": np.float32, "segmentation": np.int32}
_FAR = 0.999  # share of the farthest distance beyond which a pixel counts as empty
_NEAR = 1e-3  # distance [m] within which OpenGL draws nothing: the ray tracer draws all, also an object that touches a camera
_SQUARES = 8  # along each edge of a box: OpenGL lights their corners alone, the ray tracer every pixel
_PLAIN = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)  # switched off: the ray tracer has neither


class OpenGL(Drawer):
    """See ``cameras.Drawer``. One thread owns OpenGL's context and draws everything."""

    def __init__(self, model: mujoco.MjModel, cfg: Mapping[str, CameraCfg], fields: Sequence[str]):
        self._model, self._cfg = copy.copy(model), dict(cfg)
        self._model.vis.quality.offsamples = 0  # one sample per pixel, as in the ray tracer
        self._model.vis.map.znear = _NEAR / model.stat.extent
        self._model.vis.quality.numquads = _SQUARES
        screen = self._model.vis.global_
        screen.offwidth = max(screen.offwidth, *(c.size[0] for c in cfg.values()))
        screen.offheight = max(screen.offheight, *(c.size[1] for c in cfg.values()))
        self._fields = {name: np.shape(getattr(model, name)) for name in fields}
        self._far = model.vis.map.zfar * model.stat.extent
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "opengl")
        self._shapes = [
            jax.ShapeDtypeStruct((*c.shape, 3) if kind == "rgb" else c.shape, _TYPES[kind])
            for c in cfg.values()
            for kind in c.kinds
        ]
        self._data: Any = None
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        weakref.finalize(self, _close, self._thread, self._renderers)
        self._thread.submit(self._open).result()

    def __call__(
        self, qpos: jax.Array, fields: Mapping[str, Array], due: Bool[Array, "*n cameras"] | None = None
    ) -> dict[str, Picture]:
        """Draws the pictures of one world, or of a batch given by leading axes."""
        lead = qpos.shape[:-1]
        drawn = [fields[name].reshape(*lead, -1) for name in self._fields]
        wanted = jnp.ones((*lead, len(self._cfg))) if due is None else due
        packed = jnp.concatenate([x.astype(jnp.float32) for x in (wanted, qpos, *drawn)], axis=-1)
        shapes = [jax.ShapeDtypeStruct((*lead, *s.shape), s.dtype) for s in self._shapes]
        images = iter(jax.pure_callback(self._draw_all, shapes, packed, vmap_method="broadcast_all"))
        return {name: Picture(**dict(zip(c.kinds, images, strict=False))) for name, c in self._cfg.items()}

    def _open(self) -> None:
        self._data = mujoco.MjData(self._model)
        for shape in {c.shape for c in self._cfg.values()}:
            self._renderers[shape] = render.renderer(self._model, *shape)

    def _draw_all(self, packed: Array) -> list[np.ndarray]:
        """(which cameras are due, qpos, fields) of all worlds -> the images.

        JAX calls this function, so calling JAX in here would deadlock.
        """
        rows = np.asarray(packed).reshape(-1, packed.shape[-1])
        images = [np.zeros((len(rows), *s.shape), s.dtype) for s in self._shapes]
        self._thread.submit(self._draw_rows, rows, images).result()
        return [image.reshape(*packed.shape[:-1], *image.shape[1:]) for image in images]

    def _draw_rows(self, rows: np.ndarray, images: list[np.ndarray]) -> None:
        model, data, nq, cameras = self._model, self._data, self._model.nq, len(self._cfg)
        for i, (due, row) in enumerate(zip(rows[:, :cameras] > 0, rows[:, cameras:], strict=True)):
            if not due.any():
                continue
            data.qpos[:] = row[:nq]
            at = nq
            for name, shape in self._fields.items():
                getattr(model, name)[:] = row[at : at + math.prod(shape)].reshape(shape)
                at += math.prod(shape)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_camlight(model, data)
            out = iter(images)
            for wanted, (name, cfg) in zip(due, self._cfg.items(), strict=True):
                for kind, image in zip(cfg.kinds, itertools.islice(out, len(cfg.kinds)), strict=True):
                    if wanted:
                        image[i] = self._shot(self._renderers[cfg.shape], MARK + name, kind)

    def _shot(self, renderer: mujoco.Renderer, camera: str, kind: str) -> np.ndarray:
        renderer.disable_depth_rendering()
        renderer.disable_segmentation_rendering()
        if kind != "rgb":
            getattr(renderer, f"enable_{kind}_rendering")()
        renderer.update_scene(self._data, camera)
        for flag in _PLAIN:
            renderer.scene.flags[flag] = False
        image = renderer.render()
        if kind == "depth":
            return np.where(image < _FAR * self._far, image, 0.0)
        if kind == "segmentation":
            return np.where(image[..., 1] == mujoco.mjtObj.mjOBJ_GEOM, image[..., 0], -1)
        return image


def _close(thread: concurrent.futures.ThreadPoolExecutor, renderers: Mapping[Any, mujoco.Renderer]) -> None:
    """Frees contexts in the thread that made them, because no other thread may."""
    with contextlib.suppress(RuntimeError):  # the interpreter ends, and everything with it
        for renderer in renderers.values():
            thread.submit(renderer.close)
        thread.shutdown()
