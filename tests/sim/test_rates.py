"""Cameras of a lower rate: what a policy sees, and that what nobody looks at is not drawn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import ManipulationEnv
from mjx_nero.mdp import images
from mjx_nero.mdp.images import Lens
from mjx_nero.mdp.terms import Term
from mjx_nero.sim.cameras import opengl
from mjx_nero.sim.physics.warp import kernels
from mjx_nero.tasks import registry

STEPS, EVERY = 7, 3


def played(renderer):
    """Front pictures of two environments over the steps; the camera at the wrist has every step's."""
    cfg = registry.env_cfg("nero_lift", "rgb_fixed")
    small = {name: dataclasses.replace(camera, size=(16, 12)) for name, camera in cfg.scene.cameras.items()}
    sensors = {"lens": Term(images.Lens, params={"camera": "front", "every": EVERY, "noise": 3.0})}
    cfg = dataclasses.replace(cfg, scene=dataclasses.replace(cfg.scene, cameras=small, renderer=renderer), sensors=sensors)
    env = ManipulationEnv(cfg, impl="native", num_envs=2)
    step, state = jax.jit(jax.vmap(env.step)), jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
    action = jnp.tile(jnp.asarray(env.home_action).at[0].set(1.0), (2, 1))
    seen = [state.obs["pictures"]]
    for _ in range(STEPS):
        state = step(state, action)
        seen.append(state.obs["pictures"])
    return {name: np.array([jax.device_get(each[name]) for each in seen]) for name in seen[0]}


def test_pictures_are_drawn_when_they_are_due(monkeypatch):
    """Every third step, and at the reset, by MuJoCo's renderer; what is seen is the same as if all were drawn."""
    shots, shoot = [], opengl.OpenGL._shot
    monkeypatch.setattr(
        opengl.OpenGL, "_shot", lambda self, r, camera, kind: (shots.append(camera), shoot(self, r, camera, kind))[1]
    )
    seen = played("mujoco")
    fronts, wrists = (sum(name in shot for shot in shots) for name in ("front", "wrist"))
    due = [t for t in range(STEPS + 1) if t % EVERY == 0]
    assert wrists - fronts == 2 * (STEPS + 1 - len(due))  # both are drawn as often at the start
    changed = [t for t in range(1, STEPS + 1) if (seen["front"][t] != seen["front"][t - 1]).any()]
    assert changed == due[1:]
    monkeypatch.setattr(Lens, "due", lambda self, memory: jnp.ones((), bool))
    always = played("mujoco")
    for name in seen:
        np.testing.assert_array_equal(seen[name], always[name])


@pytest.mark.slow
def test_the_ray_tracer_draws_all_worlds_or_none(monkeypatch):
    """It draws for the wrist each step, so the front's picture is there for nothing; with both rare, it rests."""
    runs, get = [], kernels.Programs.__call__
    monkeypatch.setattr(kernels.Programs, "__call__", lambda self, n: (runs.append(n), get(self, n))[1])
    seen = played("warp")
    changed = [t for t in range(1, STEPS + 1) if (seen["front"][t] != seen["front"][t - 1]).any()]
    assert changed == [3, 6] and len(runs) >= STEPS
