"""Videos of played episodes, as good as the machine draws in time."""

import contextlib
import dataclasses
import itertools
import math
import pathlib
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Sequence

import mujoco
import numpy as np

from mjx_nero import files
from mjx_nero.sim.render import Renderer
from mjx_nero.types import Scenery

_CRF = 25  # quality of a video, from 0 (lossless) to 51
_ENOUGH_S = 30.0  # for drawing a video
# Width, height, samples per pixel and edge of the shadow map, the best first: OpenGL in software takes 0.1 s or more per frame.
_QUALITIES = ((1280, 720, 4, 4096), (960, 540, 0, 1024), (640, 360, 0, 1024))


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

    Args:
        images: uint8 [height, width, 3], at least one, with even height and width.

    Raises:
        UserError: the path cannot be written.
    """
    import imageio_ffmpeg  # needed only where a video is written

    images = iter(images)
    first = next(images)
    height, width = first.shape[:2]
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:.6f}", "-i", "-"]
    codec = ["-vcodec", "libx264", "-pix_fmt", "yuv420p", "-crf", str(_CRF)]
    pipe = subprocess.PIPE
    with files.whole(path) as part:
        argv = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *source, *codec, str(part)]
        with subprocess.Popen(argv, stdin=pipe, stderr=pipe, start_new_session=True) as encoder:  # Ctrl-C is not for it
            assert encoder.stdin
            with contextlib.suppress(BrokenPipeError):  # the encoder has failed, and says why
                for image in itertools.chain([first], images):
                    encoder.stdin.write(np.ascontiguousarray(image).data)
            said = encoder.communicate()[1].decode(errors="replace").splitlines()
        if encoder.returncode:
            raise OSError(said[-1].rpartition(": ")[2] if said else f"the encoder ended with status {encoder.returncode}")


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
