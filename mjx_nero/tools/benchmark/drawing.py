"""Measures frames per second of MuJoCo's offscreen renderer."""

import os
import time

import jax

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.sim import render
from mjx_nero.tools.benchmark.program import Row, spread


def measure_render(env: ManipulationEnv, count: int, repeats: int) -> Row:
    """Draws the first states of ``count`` episodes one by one, ``repeats`` times. Without OpenGL the row says so."""
    width, height = 640, 480
    row = {"what": "render", "gl": os.environ.get("MUJOCO_GL", "default"), "width": width, "height": height, "frames": count}
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), count))
    qpos, scenery = jax.device_get((states.pipeline_state.qpos, jax.vmap(env.scenery)(states)))
    rates = []
    try:
        with render.Renderer(env.mj_model, width, height) as renderer:
            renderer.render(qpos[0], scenery[0])  # loads textures and shaders
            for _ in range(repeats):
                begun = time.perf_counter()
                for i, at in enumerate(qpos):
                    renderer.render(at, scenery[i])
                rates.append(count / (time.perf_counter() - begun))
    except UserError as error:
        return {**row, "note": str(error)}
    return {**row, **spread("frames_per_s", rates)}
