"""Pictures and videos with MuJoCo's own renderer."""

import pathlib
import warnings
from collections.abc import Iterable

import imageio.v3 as imageio
import mujoco
import numpy as np

from mjx_nero.types import UserError

NO_GL = (
    "no offscreen OpenGL here, so no pictures: install libegl1 (machines with a GPU) or libosmesa6 "
    "(Debian and Ubuntu: apt-get install libosmesa6)"
)


class Renderer:
    """Draws states of a model from one of its cameras. A context manager.

    Raises:
        UserError: the machine cannot draw offscreen.
    """

    def __init__(self, model: mujoco.MjModel, width: int = 640, height: int = 480, camera: str = "front"):
        self._data, self._model, self._camera = mujoco.MjData(model), model, camera
        try:
            self._renderer = mujoco.Renderer(model, height, width)
        except Exception as error:  # each GL binding fails in its own way: ImportError, RuntimeError, GLError, ...
            raise UserError(NO_GL) from error

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_) -> None:
        self._renderer.close()

    def draw(self, qpos: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """One frame, uint8 [height, width, 3].

        Args:
            qpos: [nq].
            goal: where the goal marker stands in the world [m] and how it is turned (wxyz), [7]; or [3], unturned.
        """
        self._data.qpos[:] = qpos
        self._data.mocap_pos[0], self._data.mocap_quat[0] = goal[:3], goal[3:] if len(goal) == 7 else (1, 0, 0, 0)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()


def frames(model: mujoco.MjModel, qpos: np.ndarray, goals: np.ndarray, every: int = 1, **kwargs) -> list[np.ndarray]:
    """Frames of recorded episodes, one after another.

    Args:
        qpos: [steps, episodes, nq]; goals: [steps, episodes, 7 or 3], as in ``rollout.Episodes``.
        every: draw each ``every``-th step.
        kwargs: of ``Renderer``.
    """
    with Renderer(model, **kwargs) as renderer:
        steps, episodes = qpos.shape[:2]
        return [renderer.draw(qpos[t, k], goals[t, k]) for k in range(episodes) for t in range(0, steps, every)]


def write_episodes(path: pathlib.Path, model: mujoco.MjModel, qpos: np.ndarray, goals: np.ndarray, dt: float) -> None:
    """Writes recorded episodes, one step each ``dt`` seconds, as an MP4 in real time that shows every third step.

    Raises:
        UserError: the machine cannot draw, or the path cannot be written.
    """
    write_video(path, frames(model, qpos, goals, every=3), fps=1 / (3 * dt))


def write_video(path: pathlib.Path, images: Iterable[np.ndarray], fps: float) -> None:
    """Writes an MP4; the file appears whole or not at all.

    Raises:
        UserError: the path cannot be written.
    """
    part = path.with_name(f".{path.stem}.part.mp4")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings():  # the encoder is a child process, and JAX warns of every fork
            warnings.simplefilter("ignore", RuntimeWarning)
            imageio.imwrite(part, np.stack(list(images)), fps=fps, codec="libx264", plugin="FFMPEG", macro_block_size=8)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise UserError(f"cannot write {path}: {error}") from None
