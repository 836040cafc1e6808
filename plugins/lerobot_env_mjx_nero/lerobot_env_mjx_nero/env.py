"""One environment for LeRobot's commands. It takes joint targets and returns states, in the units of a ``demos`` data set."""

import functools
from collections.abc import Callable
from typing import Any

import gymnasium
import jax
import numpy as np

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.imitation.recording.demonstrations import environment_state, joint_state, told
from mjx_nero.imitation.recording.pictures import Cameras
from mjx_nero.sim.render import Renderer
from mjx_nero.tasks import registry
from mjx_nero.tools import cli
from mjx_nero.tools.demos import making
from mjx_nero.types import UserError


class Programs:
    """The environment and its compiled functions, which ``Env``s with the same arguments share.

    Args:
        task, preset, robot: as in ``registry.env_cfg``.
        units: as in ``making.units_of``.
        velocities: include the joints' velocities in the state.
        through: what the data set's actions went through, as in ``demos --inspect``: task (a policy's) or drives (an expert's).
        cameras: comma-separated names.
        renderer: as in ``demos --renderer``.
        size: width and height of a picture [pixels].
    """

    def __init__(
        self,
        task: str,
        preset: str,
        robot: str | None,
        units: str,
        through: str,
        cameras: str,
        renderer: str,
        size: tuple[int, int],
        velocities: bool,
    ):
        cli.setup_jax()  # its cache lets the processes that LeRobot starts compile only once
        cfg = registry.env_cfg(task, preset, robot).uncorrupted()
        self.env = env = ManipulationEnv(making.by_drives(making.blind(cfg, renderer), through), impl="native")
        names = [name for name in cameras.split(",") if name]
        self.cameras = Cameras(env, names, size, renderer) if names else None
        self.units = making.units_of(env, units)

        def seen(state):
            view = env.view(state)
            return joint_state(view, self.units, velocities), environment_state(env, view, seen=bool(names))

        def reset(seed):
            state = env.reset(jax.random.PRNGKey(seed))
            return state, seen(state)

        def step(state, action):
            state = env.step(state, self.units.positions(action))
            return state, seen(state), (state.reward, state.done, state.info["truncation"], state.metrics["success"])

        self.reset, self.step, self.scenery = map(_on_cpu, (reset, step, env.scenery))

    def named(self, state: Any, seen: Any) -> dict[str, Any]:
        """Returns an observation in LeRobot's form; ``pixels`` has uint8 [height, width, 3] by camera."""
        out: dict[str, Any] = dict(zip(("agent_pos", "environment_state"), map(np.asarray, seen), strict=True))
        if self.cameras:
            shown = (
                np.asarray(state.pipeline_state.qpos)[None],
                jax.tree.map(lambda x: x[None], jax.device_get(self.scenery(state))),
            )
            out["pixels"] = {name: next(self.cameras.frames(name, *shown)) for name in self.cameras.names}
        return out


def _on_cpu(function: Callable) -> Callable:
    """Compiles a function for the CPU: a single environment is slower on a GPU, which runs the policy."""
    compiled = jax.jit(function)

    def call(*args: Any) -> Any:
        with jax.default_device(jax.devices("cpu")[0]):
            return compiled(*args)

    return call


made = functools.lru_cache(Programs)


class Env(gymnasium.Env):
    """A Gymnasium environment for LeRobot. Its arguments are those of ``Programs``."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        task: str,
        preset: str = "default",
        robot: str | None = None,
        units: str = "auto",
        through: str = "task",
        cameras: str = "",
        renderer: str = "auto",
        size: tuple[int, int] = (64, 64),
        velocities: bool = False,
        render_mode: str = "rgb_array",
    ):
        self._programs = made(task, preset, robot, units, through, cameras, renderer, tuple(size), velocities)
        env = self._programs.env
        self.render_mode, self.task, self.task_description = render_mode, task, making.sentence(task)
        self.metadata = {**self.metadata, "render_fps": round(1 / env.dt)}
        self._max_episode_steps = env.episode_length
        low, high = self._programs.units.shown(np.stack(env.actions.bounds()))
        self.action_space = gymnasium.spaces.Box(np.minimum(low, high), np.maximum(low, high), dtype=np.float32)
        poses = told(env, seen=bool(self._programs.cameras))
        boxes = {"agent_pos": len(env.cfg.robot.joints) * (1 + velocities), "environment_state": 7 * len(poses)}
        spaces: dict[str, Any] = {name: gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32) for name, n in boxes.items()}
        if drawn := self._programs.cameras:
            pictures = {n: gymnasium.spaces.Box(0, 255, (h, w, 3), np.uint8) for n, (w, h) in drawn.sizes.items()}
            spaces["pixels"] = gymnasium.spaces.Dict(pictures)
        self.observation_space = gymnasium.spaces.Dict(spaces)
        self._renderer: Renderer | None = None
        self._state: Any = None
        self._observed: dict[str, Any] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict]:
        """Starts an episode; a seed determines all of it."""
        super().reset(seed=seed)
        self._state, seen = self._programs.reset(int(self.np_random.integers(2**31)) if seed is None else seed)
        self._observed = self._programs.named(self._state, seen)
        return self._observed, {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict]:
        """Runs one control step. The info has ``is_success``, which can only be true at the end of an episode."""
        self._state, seen, out = self._programs.step(self._state, np.asarray(action, np.float32))
        reward, done, truncated, success = (float(x) for x in out)
        ended = done > 0
        self._observed = self._programs.named(self._state, seen)
        return (
            self._observed,
            reward,
            ended and not truncated,
            truncated > 0,
            {"is_success": ended and success > 0},
        )

    def render(self) -> np.ndarray:
        """Renders a frame, uint8 [height, width, 3]: the scene, or without OpenGL what the first camera sees.

        ``lerobot-eval`` films every evaluation, and a server that draws with the ray tracer need not have OpenGL.
        """
        try:
            self._renderer = self._renderer or Renderer(self._programs.env.mj_model)
        except UserError:
            if not self._programs.cameras:
                raise
            return next(iter(self._observed["pixels"].values()))
        scenery = jax.device_get(self._programs.scenery(self._state))
        return self._renderer.render(np.asarray(self._state.pipeline_state.qpos), scenery)

    def close(self) -> None:
        """Frees the renderer."""
        if self._renderer:
            self._renderer.__exit__()
            self._renderer = None
