"""Draws the pictures of played episodes afterwards, from the recorded positions.

MuJoCo's own renderer draws one picture after another, on several cores. On a GPU the ray tracer draws thousands at a time, for
the scene's own cameras.
"""

import concurrent.futures
import copy
import dataclasses
import functools
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Protocol

import jax
import numpy as np

from mjx_nero import cores
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.imitation.recording.batches import Batches
from mjx_nero.imitation.recording.page_locked import PageLocked
from mjx_nero.sim.cameras.cfg import MARK
from mjx_nero.sim.physics import warp_available
from mjx_nero.sim.render import Renderer
from mjx_nero.types import Scenery

SIZE = 128, 128  # default picture size of a model's other cameras [pixels]
SHADOWS = 0  # no shadow map, which takes three quarters of the time on a CPU
TOGETHER = 256  # maximum number of an episode's steps that are drawn at once
MOST = 8  # maximum number of OpenGL contexts
EPISODES, PIXELS = 8, 1 << 26  # maximum numbers that a GPU draws at once
_UNSEEN = 5  # a geom group that is not drawn


class Cameras:
    """Cameras of an environment: those of its scene, which do not see the goal's marker, and the model's others, which do.

    Args:
        names: names of cameras; ``front+wrist`` is one picture of both, side by side.
        size: width and height [pixels], even because encoders need it; None: each camera's own.
        renderer: ``mujoco``, or ``warp`` for the scene's own cameras. auto: warp if it is installed and JAX has a GPU.

    Attributes:
        sizes: width and height of each camera's pictures, by name.
        renderer: renderer of the scene's own cameras.

    Raises:
        UserError: a camera does not exist, or the machine cannot draw.
    """

    def __init__(self, env: ManipulationEnv, names: Sequence[str], size: tuple[int, int] | None = None, renderer: str = "auto"):
        model, own = env.mj_model, env.cfg.scene.cameras
        people = [name for i in range(model.ncam) if not (name := model.camera(i).name).startswith(MARK)]
        there = list(dict.fromkeys((*own, *people)))
        single = list(dict.fromkeys(part for name in names for part in name.split("+")))
        if unknown := [name for name in single if name not in there]:
            raise UserError(f"this environment has no camera {', '.join(unknown)}: choose from {', '.join(there)}")
        self.names = tuple(names)
        sizes = {name: size or (own[name].size if name in own else SIZE) for name in single}
        self.sizes = {name: _beside(name, [sizes[part] for part in name.split("+")]) for name in names}
        self.renderer = chosen(renderer)
        self._drawers: dict[str, _Drawer] = {}
        for name in single:
            traced = self.renderer == "warp" and name in own
            made = functools.partial(_Traced if traced else _Drawn, env, name, sizes[name])
            self._drawers[name] = made() if traced else _Several(made)

    def close(self) -> None:
        """Frees the renderers."""
        for drawer in self._drawers.values():
            drawer.close()

    def frames(self, name: str, qpos: np.ndarray, scenery: Scenery) -> Iterator[np.ndarray]:
        """Yields a camera's frames of an episode, uint8 [height, width, 3]. Any thread may call it.

        Args:
            qpos: [steps, nq].
            scenery: [steps, ...].
        """
        for first in range(0, len(qpos), TOGETHER):
            now = slice(first, first + TOGETHER)
            parts = [self._drawers[part](qpos[now], scenery[now]) for part in name.split("+")]
            yield from parts[0] if len(parts) == 1 else (np.concatenate(each, axis=1) for each in zip(*parts, strict=True))


def chosen(renderer: str) -> str:
    """Returns the renderer that draws the scene's own cameras; ``renderer`` may be auto."""
    return renderer if renderer != "auto" else "warp" if warp_available() else "mujoco"


def _beside(name: str, sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Returns width and height of pictures side by side.

    Raises:
        UserError: their heights differ.
    """
    widths, heights = zip(*sizes, strict=True)
    if len(set(heights)) > 1:
        raise UserError(f"{name}: pictures side by side need the same height, but these have {heights}: pass --picture")
    return sum(widths), heights[0]


class _Drawer(Protocol):
    """Draws a camera's frames for several steps, uint8 [height, width, 3] each."""

    def __call__(self, qpos: np.ndarray, scenery: Scenery) -> Iterable[np.ndarray]: ...
    def close(self) -> None: ...


class _Drawn:
    """MuJoCo's renderer in one thread, which owns the OpenGL context."""

    def __init__(self, env: ManipulationEnv, name: str, size: tuple[int, int]):
        model, camera = env.mj_model, name
        if name in env.cfg.scene.cameras:
            model, camera = copy.copy(model), MARK + name
            model.geom_group[model.geom_bodyid == model.body("goal").id] = _UNSEEN
        self._thread = concurrent.futures.ThreadPoolExecutor(1, "pictures")
        self._renderer = self._thread.submit(Renderer, model, *size, camera=camera, samples=0, shadows=SHADOWS).result()

    def __call__(self, qpos: np.ndarray, scenery: Scenery) -> Iterable[np.ndarray]:
        def draw() -> list[np.ndarray]:
            return [self._renderer.render(at.astype(np.float64), scenery[i]) for i, at in enumerate(qpos)]

        return self._thread.submit(draw).result()

    def close(self) -> None:
        self._thread.submit(self._renderer.__exit__).result()
        self._thread.shutdown()


class _Several:
    """Several drawers for simultaneous callers. A new one is made when all others are busy, up to the number of cores."""

    def __init__(self, make: Callable[[], _Drawer]):
        self._make, self._made, self._lock = make, [make()], threading.Lock()
        self._free: queue.SimpleQueue[_Drawer] = queue.SimpleQueue()
        self._free.put(self._made[0])

    def __call__(self, qpos: np.ndarray, scenery: Scenery) -> Iterable[np.ndarray]:
        drawer = self._take()
        try:
            return drawer(qpos, scenery)
        finally:
            self._free.put(drawer)

    def _take(self) -> _Drawer:
        with self._lock:
            if self._free.empty() and len(self._made) < min(MOST, cores()):
                self._made.append(self._make())
                return self._made[-1]
        return self._free.get()

    def close(self) -> None:
        for drawer in self._made:
            drawer.close()


class _Traced:
    """MuJoCo Warp's ray tracer. Each step is a world of one batch, and waiting episodes are drawn together."""

    def __init__(self, env: ManipulationEnv, name: str, size: tuple[int, int]):
        camera = dataclasses.replace(env.cfg.scene.cameras[name], size=size, kinds=("rgb",))
        seen = env.draw_by({name: camera}, "warp")
        draw = jax.jit(jax.vmap(lambda shown: seen(*shown)[name].rgb))
        episodes = max(1, min(EPISODES, PIXELS // (TOGETHER * size[0] * size[1])))
        sizes = sorted({1, TOGETHER, episodes * TOGETHER})
        for rows in sizes:  # now, because a graph cannot be captured while another thread's physics runs on the device
            seen.draw.prepare(rows)
        self._draw = Batches(draw, sizes, PageLocked(TOGETHER))

    def __call__(self, qpos: np.ndarray, scenery: Scenery) -> Iterable[np.ndarray]:
        return self._draw((qpos, scenery))

    def close(self) -> None:
        """Does nothing: the ray tracer owns the buffers."""
