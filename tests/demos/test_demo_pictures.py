"""Both drawers of episodes' pictures, at steps that do not fill a batch, and several of one kind."""

import dataclasses
import threading
import types
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.imitation.recording import pictures
from mjx_nero.sim.cameras.cfg import CameraCfg
from mjx_nero.tasks import registry
from mjx_nero.tools.demos import making


@pytest.mark.slow
def test_the_ray_tracer_draws_what_mujoco_draws(monkeypatch):
    monkeypatch.setattr(pictures, "TOGETHER", 4)
    cfg = registry.env_cfg("nero_lift", "rgb").uncorrupted()
    env = ManipulationEnv(dataclasses.replace(cfg, observations={"state": cfg.observations["state"]}), impl="native")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 9))
    shown = np.asarray(state.pipeline_state.qpos), jax.device_get(jax.jit(jax.vmap(env.scenery))(state))
    drawn = {}
    for renderer in ("mujoco", "warp"):
        cameras = pictures.Cameras(env, ["front", "wrist", "front+wrist"], (48, 48), renderer)
        drawn[renderer] = {name: np.stack(list(cameras.frames(name, *shown))).astype(int) for name in cameras.names[:2]}
        both = np.stack(list(cameras.frames("front+wrist", *shown)))
        np.testing.assert_array_equal(both, np.concatenate([*drawn[renderer].values()], axis=2))
        assert cameras.sizes["front+wrist"] == (96, 48)
        cameras.close()
    for name, frames in drawn["warp"].items():
        off = np.abs(frames - drawn["mujoco"][name]).mean(axis=(1, 2, 3))
        assert frames.shape == (9, 48, 48, 3) and frames.std() > 30
        assert off.max() < 10 and off.max() < 0.2 * np.abs(frames - np.roll(drawn["mujoco"][name], 1, axis=0)).mean()


def test_each_caller_at_a_time_has_a_drawer_of_its_own(monkeypatch):
    """Three callers meet in three drawers, though only the first was there before. A fourth drawer is one too many."""
    monkeypatch.setattr(pictures, "MOST", 3)
    monkeypatch.setattr(pictures, "cores", lambda: 8)
    meet, made, closed = threading.Barrier(3), [], []

    class Drawer:
        def __init__(self):
            made.append(self)
            self.busy = threading.Lock()

        def __call__(self, qpos, scenery):
            assert self.busy.acquire(blocking=False)
            meet.wait(120)
            self.busy.release()
            return [qpos]

        def close(self):
            closed.append(self)

    several = pictures._Several(Drawer)
    assert len(made) == 1
    with ThreadPoolExecutor(6) as pool:
        assert list(pool.map(lambda i: several(i, None), range(6))) == [[i] for i in range(6)]
    several.close()
    assert len(made) == 3 and closed == made


def test_the_ray_tracer_is_prepared_for_all_sizes_before_threads_draw():
    """A graph that is captured at a first call, in a thread, fails if another thread's physics runs on the same stream."""
    prepared = []
    seen = types.SimpleNamespace(draw=types.SimpleNamespace(prepare=prepared.append))
    cfg = types.SimpleNamespace(scene=types.SimpleNamespace(cameras={"front": CameraCfg(size=(64, 64))}))
    drawer = pictures._Traced(types.SimpleNamespace(cfg=cfg, draw_by=lambda own, renderer: seen), "front", (64, 64))
    assert prepared == list(drawer._draw._sizes) and len(prepared) > 1


def test_an_environment_whose_pictures_come_later_asks_for_their_renderer_alone(monkeypatch):
    """A machine that draws by one renderer need not have the other."""
    cfg = registry.env_cfg("nero_lift", "rgb_fixed")
    for available, renderer in ((True, "warp"), (False, "mujoco")):
        monkeypatch.setattr(pictures, "warp_available", lambda available=available: available)
        for asked in ("auto", renderer):
            blind = making.blind(cfg, asked)
            assert blind.scene.renderer == renderer and blind.scene.cameras == cfg.scene.cameras
            assert set(blind.observations) == {"state", "teacher"} < set(cfg.observations)
