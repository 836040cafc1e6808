"""One environment as LeRobot's commands take it: joints' targets in, states out, in the units of a data set of ``demos``."""

import functools
from typing import Any

import gymnasium
import jax
import numpy as np

from mjx_nero.envs import registry
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import for_controllers
from mjx_nero.learn.play.demonstrations import environment_state
from mjx_nero.sim.render import Renderer
from mjx_nero.tools.demos import making


class Programs:
    """What environments of the same arguments share: the environment and its compiled functions.

    Args:
        task, preset, robot: of ``registry.env_cfg``.
        units: of ``making.units_of``.
    """

    def __init__(self, task: str, preset: str, robot: str | None, units: str):
        cfg = registry.env_cfg(task, preset, robot).uncorrupted()
        self.env = env = ManipulationEnv(for_controllers(cfg), impl="native")
        self.units = making.units_of(env, units)

        def seen(state):
            view = env.view(state)
            return self.units.shown(view.joint_pos), environment_state(env, view)

        def reset(seed):
            state = env.reset(jax.random.PRNGKey(seed))
            return state, seen(state)

        def step(state, action):
            state = env.step(state, self.units.positions(action))
            return state, seen(state), (state.reward, state.done, state.info["truncation"], state.metrics["success"])

        self.reset, self.step, self.scenery = jax.jit(reset), jax.jit(step), jax.jit(env.scenery)


made = functools.lru_cache(Programs)


class Env(gymnasium.Env):
    """See above. The arguments are those of ``Programs``."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(
        self, task: str, preset: str = "default", robot: str | None = None, units: str = "auto", render_mode: str = "rgb_array"
    ):
        self._programs = made(task, preset, robot, units)
        env = self._programs.env
        self.render_mode, self.task, self.task_description = render_mode, task, making.sentence(task)
        self.metadata = {**self.metadata, "render_fps": round(1 / env.dt)}
        self._max_episode_steps = env.episode_length
        low, high = self._programs.units.shown(np.stack(env.actions.bounds()))
        self.action_space = gymnasium.spaces.Box(np.minimum(low, high), np.maximum(low, high), dtype=np.float32)
        size = 7 * (2 + len(env.cfg.scene.objects))
        boxes = {"agent_pos": len(env.cfg.robot.joints), "environment_state": size}
        self.observation_space = gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32) for name, n in boxes.items()}
        )
        self._renderer: Renderer | None = None
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], dict]:
        """A fresh episode; a seed draws all of it."""
        super().reset(seed=seed)
        self._state, seen = self._programs.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        return _named(seen), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict]:
        """One control step. The info has ``is_success``, which an episode can only have at its end."""
        self._state, seen, out = self._programs.step(self._state, np.asarray(action, np.float32))
        reward, done, truncated, success = (float(x) for x in out)
        ended = done > 0
        return _named(seen), reward, ended and not truncated, truncated > 0, {"is_success": ended and success > 0}

    def render(self) -> np.ndarray:
        """A frame, uint8 [height, width, 3]."""
        self._renderer = self._renderer or Renderer(self._programs.env.mj_model)
        scenery = jax.device_get(self._programs.scenery(self._state))
        return self._renderer.render(np.asarray(self._state.pipeline_state.qpos), scenery)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer:
            self._renderer.__exit__()
            self._renderer = None


def _named(seen: Any) -> dict[str, np.ndarray]:
    return dict(zip(("agent_pos", "environment_state"), map(np.asarray, seen), strict=True))
