"""Videos: as good as the machine draws within half a minute, unless flags say otherwise; several robots in one picture."""

import os
import resource

import imageio.v3 as imageio
import numpy as np
import pytest
from scipy import ndimage

import mjx_nero
from mjx_nero.runs import videos
from mjx_nero.sim.render import Renderer
from mjx_nero.types import Scenery, UserError

SCENERY = Scenery(np.zeros((150, 3, 3)), np.zeros((150, 3, 4)))
QPOS, DT = np.zeros((150, 3, 1)), 0.02  # three episodes of 3 s: 225 pictures at 25 a second


@pytest.fixture
def written(monkeypatch):
    """``written(seconds a megapixel, VideoCfg) -> (width, height, pictures, frames a second, progress)`` by our own clock."""
    clock = [0.0]

    def write(seconds: float, cfg: videos.VideoCfg):
        class Drawer:
            def __init__(self, model, width, height, **kwargs):
                self.size = width, height

            def __enter__(self):
                return self

            def __exit__(self, *_):
                pass

            def render(self, qpos, scenery):
                clock[0] += seconds * self.size[0] * self.size[1] / 1e6
                return self.size

            render_all = render

        found, progress = [], []
        monkeypatch.setattr(videos, "Renderer", Drawer)
        monkeypatch.setattr(videos.time, "perf_counter", lambda: clock[0])
        monkeypatch.setattr(videos, "write_video", lambda path, images, fps: found.extend([list(images), fps]))
        videos.write_episodes("x.mp4", None, QPOS, SCENERY, DT, cfg, lambda *done: progress.append(done))
        images, fps = found
        return *images[0], len(images), fps, progress

    return write


def test_where_a_gpu_draws_videos_are_720p_at_25(written):
    width, height, count, fps, progress = written(0.01, videos.VideoCfg())
    assert (width, height, count, fps) == (1280, 720, 225, pytest.approx(25))
    assert progress == [(i + 1, 225) for i in range(225)]


def test_where_software_draws_size_and_then_rate_fit_half_a_minute(written):
    assert written(0.2, videos.VideoCfg())[:3] == (960, 540, 225)  # 225 of 0.10 s; 720p would take 41 s
    assert written(0.5, videos.VideoCfg())[:3] == (640, 360, 225)  # 225 of 0.12 s
    width, height, count, fps, _ = written(2.0, videos.VideoCfg())  # 0.46 s each: 65 of them, every seventh step
    assert (width, height, count, fps) == (640, 360, 3 * 22, pytest.approx(1 / 0.14))


def test_flags_set_size_and_rate(written):
    assert written(2.0, videos.VideoCfg(size=(320, 240), fps=50))[:4] == (320, 240, 450, pytest.approx(50))
    assert written(0.01, videos.VideoCfg(envs=3))[2] == 75  # side by side: one picture of all


def test_robots_side_by_side_in_one_picture():
    env = mjx_nero.make("nero_lift", impl="native")
    try:
        renderer = Renderer(env.mj_model, 1280, 720, envs=4)
    except mjx_nero.UserError:
        assert not os.environ.get("CI")
        pytest.skip("no offscreen OpenGL")
    qpos = np.tile(env.physics_model.qpos0, (4, 1))
    with renderer:
        picture = renderer.render_all(qpos, Scenery(np.tile([0.3, 0.0, -1.0], (4, 1)), np.tile([1.0, 0, 0, 0], (4, 1)))).astype(
            int
        )
    cubes, count = ndimage.label((picture[:, :, 0] > 120) & (picture[:, :, 1:].max(axis=2) < 0.6 * picture[:, :, 0]))
    assert count == 4 and np.bincount(cubes.flat)[1:].min() > 20


def test_a_video_is_whole_or_not_there(tmp_path):
    """The encoder, a process of its own, fails in its last moment: it keeps the first pictures until then."""
    pictures, path = np.random.default_rng(0).integers(0, 255, (3, 90, 160, 3), np.uint8), tmp_path / "a.mp4"
    videos.write_video(path, pictures, 25.0)
    before = path.read_bytes()
    assert imageio.imread(path).shape == (3, 90, 160, 3)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, hard))  # as a full disk
    try:
        with pytest.raises(UserError, match="cannot write .*a.mp4: the encoder ended"):
            videos.write_video(path, pictures, 25.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
