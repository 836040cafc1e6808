"""Pictures and videos with MuJoCo's own renderer."""

import copy
import dataclasses
import math
import pathlib
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import imageio.v2 as imageio
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.sim.cameras.look import rows
from mjx_nero.types import Scenery

NO_GL = (
    "no offscreen OpenGL here, so no pictures: install libegl1 (machines with a GPU) or libosmesa6 "
    "(Debian and Ubuntu: apt-get install libosmesa6)"
)
_ENOUGH_S = 30.0  # for drawing a video
# Width, height, samples per pixel and edge of the shadow map, the best first: OpenGL in software takes 0.1 s or more per frame.
_QUALITIES = ((1280, 720, 4, 4096), (960, 540, 0, 1024), (640, 360, 0, 1024))
_APART = 1.5  # [m] least distance between tables that share a picture


@dataclasses.dataclass(frozen=True)
class VideoCfg:
    """Options of a video. Those that are None or 0 depend on the machine's speed: 1280 x 720 at 25 frames per second at best.

    Attributes:
        size: width and height [pixels].
        fps: frames per second.
        envs: robots side by side in one picture; 1 shows episodes one after another.
        in_turn: number of episodes one after another, if ``envs`` is 1.
    """

    size: tuple[int, int] | None = None
    fps: float = 0.0
    envs: int = 1
    in_turn: int = 3

    @property
    def episodes(self) -> int:
        """Number of episodes to play."""
        return self.envs if self.envs > 1 else self.in_turn


class Renderer:
    """Draws states of a model. A context manager.

    Args:
        width, height: pixels.
        camera: name of a camera of the model, or a free camera.
        samples: samples per pixel; None: the model's setting.
        shadows: pixels along a side of the shadow map; None: the model's setting.
        envs: greatest number of robots in one picture.

    Raises:
        UserError: the machine cannot draw offscreen.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 640,
        height: int = 480,
        camera: str | mujoco.MjvCamera = "front",
        samples: int | None = None,
        shadows: int | None = None,
        envs: int = 1,
    ):
        model = copy.copy(model)
        screen, quality = model.vis.global_, model.vis.quality
        screen.offwidth, screen.offheight = max(width, screen.offwidth), max(height, screen.offheight)
        quality.offsamples = quality.offsamples if samples is None else samples
        quality.shadowsize = quality.shadowsize if shadows is None else shadows
        self._data, self._model, self._camera = mujoco.MjData(model), model, camera
        self._option, self._hand = mujoco.MjvOption(), mujoco.MjvPerturb()
        table = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "table_top")
        self._apart = max(_APART, 2 * float(model.geom_size[table, :2].max())) if table >= 0 else _APART
        try:
            self._renderer = mujoco.Renderer(model, height, width, max_geom=max(10_000, envs * (model.ngeom + 10)))
        except Exception as error:  # each GL binding fails in its own way: ImportError, RuntimeError, GLError, ...
            raise UserError(NO_GL) from error

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_) -> None:
        self._renderer.close()

    def render(self, qpos: np.ndarray, scenery: Scenery) -> np.ndarray:
        """Draws one frame, uint8 [height, width, 3].

        Args:
            qpos: [nq].
            scenery: goal, obstacles and looks (``ManipulationEnv.scenery``).
        """
        self._forward(qpos, scenery)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def render_all(self, qpos: np.ndarray, scenery: Scenery) -> np.ndarray:
        """Draws several robots in rows, each at its own table, into one frame; uint8 [height, width, 3].

        Args:
            qpos: [envs, nq].
            scenery: [envs, ...].
        """
        columns = math.ceil(math.sqrt(len(qpos)))
        rows = math.ceil(len(qpos) / columns)
        scene = self._renderer.scene
        for i, at in enumerate(qpos):
            self._forward(at, scenery[i])
            before = scene.ngeom if i else 0
            if i == 0:
                free = isinstance(self._camera, mujoco.MjvCamera)
                self._renderer.update_scene(self._data, self._camera if free else self._overview(columns, rows))
            else:
                mujoco.mjv_addGeoms(self._model, self._data, self._option, self._hand, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
            x, y = i // columns - (rows - 1) / 2, i % columns - (columns - 1) / 2
            for geom in scene.geoms[before : scene.ngeom]:
                geom.pos[:2] += self._apart * np.array([x, y])
        for light in scene.lights[: scene.nlight]:  # farther away, so that they light all robots
            light.pos[:] -= self._apart * (max(columns, rows) - 1) * light.dir
        return self._renderer.render()

    def _forward(self, qpos: np.ndarray, scenery: Scenery) -> None:
        for name, values in scenery.look.items():
            getattr(self._model, name)[:] = values
        for field, row, value in rows(self._model, scenery):
            getattr(self._model, field)[row] = value
        self._data.qpos[:] = qpos
        self._data.mocap_pos[0], self._data.mocap_quat[0] = scenery.goal_pos_w, scenery.goal_quat_w
        mujoco.mj_forward(self._model, self._data)

    def _overview(self, columns: int, rows: int) -> mujoco.MjvCamera:
        """Camera in front and above, far enough away to see all robots."""
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat = self._model.stat.center
        camera.distance = 1.3 * self._model.stat.extent + 1.2 * self._apart * (max(columns, rows) - 1)
        camera.azimuth, camera.elevation = 138, -32
        return camera


def unmarked(*shape: int) -> Scenery:
    """Scenery that hides the goal marker under the table; ``shape`` gives the leading axes."""
    return Scenery(jnp.tile(jnp.array([0.0, 0.0, -10.0]), (*shape, 1)), jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (*shape, 1)))


def frames(model: mujoco.MjModel, qpos: np.ndarray, scenery: Scenery, every: int = 1, **kwargs) -> list[np.ndarray]:
    """Draws recorded episodes, one after another.

    Args:
        qpos: [steps, episodes, nq]; scenery: [steps, episodes, ...], as in ``rollout.Episodes``.
        every: draw every ``every``-th step.
        kwargs: arguments of ``Renderer``.
    """
    with Renderer(model, **kwargs) as renderer:
        steps, episodes = qpos.shape[:2]
        return [renderer.render(qpos[t, k], scenery[t, k]) for k in range(episodes) for t in range(0, steps, every)]


def write_episodes(
    path: pathlib.Path,
    model: mujoco.MjModel,
    qpos: np.ndarray,
    scenery: Scenery,
    dt: float,
    cfg: VideoCfg = VideoCfg(),
    update: Callable[[int, int], None] = lambda done, total: None,
    seen: Sequence[np.ndarray] = (),
) -> None:
    """Writes recorded episodes as an MP4 that plays in real time.

    Args:
        qpos: [steps, episodes, nq]; scenery: [steps, episodes, ...], as in ``rollout.Episodes``.
        dt: time between steps [s].
        seen: pictures to show in a corner, uint8 [steps, episodes, height, width, 3], one entry per camera. They are left out if
            several robots share a picture.
        update: called with the numbers of frames drawn and of all frames.

    Raises:
        UserError: the machine cannot draw, or the path cannot be written.
    """
    together = cfg.envs > 1
    shots = len(qpos) * (1 if together else qpos.shape[1])
    width, height, samples, shadows, every = _quality(model, qpos, scenery, dt, cfg, shots)

    def pictures() -> Iterator[np.ndarray]:
        total, done = math.ceil(len(qpos) / every) * shots // len(qpos), 0
        with Renderer(model, width, height, samples=samples, shadows=shadows, envs=cfg.envs) as renderer:
            for k in range(1 if together else qpos.shape[1]):
                for t in range(0, len(qpos), every):
                    if together:
                        yield renderer.render_all(qpos[t], scenery[t])
                    else:
                        yield inset(renderer.render(qpos[t, k], scenery[t, k]), [each[t, k] for each in seen])
                    done += 1
                    update(done, total)

    write_video(path, pictures(), fps=1 / (every * dt))


def inset(frame: np.ndarray, pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Puts small pictures into the lower left corner of a frame, a third of its height each, side by side."""
    if not pictures:
        return frame
    frame, at = frame.copy(), 0
    for picture in pictures:
        times = max(1, len(frame) // 3 // len(picture))
        large = picture.repeat(times, 0).repeat(times, 1)[: len(frame), : frame.shape[1] - at]
        frame[len(frame) - len(large) :, at : at + large.shape[1]] = large
        at += large.shape[1]
    return frame


def write_video(path: pathlib.Path, images: Iterable[np.ndarray], fps: float) -> None:
    """Writes an MP4. The file appears whole or not at all.

    Raises:
        UserError: the path cannot be written.
    """
    with files.whole(path) as part, warnings.catch_warnings():  # the encoder is a child process, and JAX warns of every fork
        warnings.simplefilter("ignore", RuntimeWarning)
        writer: Any = imageio.get_writer(part, format="FFMPEG", fps=fps, codec="libx264", macro_block_size=2)
        with writer:
            for image in images:
                writer.append_data(image)


def _quality(
    model: mujoco.MjModel, qpos: np.ndarray, scenery: Scenery, dt: float, cfg: VideoCfg, shots: int
) -> tuple[int, int, int, int, int]:
    """Chooses the best quality that the machine draws in time: width, height, samples, shadows, and steps between frames."""
    every = max(1, round(1 / ((cfg.fps or 25) * dt)))
    seconds = math.inf
    for width, height, samples, shadows in _QUALITIES:
        width, height = cfg.size or (width, height)
        with Renderer(model, width, height, samples=samples, shadows=shadows, envs=cfg.envs) as renderer:
            shot: Callable = renderer.render_all if cfg.envs > 1 else renderer.render
            first = (qpos[0], scenery[0]) if cfg.envs > 1 else (qpos[0, 0], scenery[0, 0])
            shot(*first)  # loads textures and shaders
            begun = time.perf_counter()
            shot(*first)
            seconds = time.perf_counter() - begun
        if seconds * shots / every <= _ENOUGH_S:
            break
    if not cfg.fps:
        every = max(every, math.ceil(seconds * shots / _ENOUGH_S))
    return width, height, samples, shadows, every
