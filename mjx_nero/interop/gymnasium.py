"""Environments for Gymnasium 1: ``VectorEnv`` with JAX, torch or numpy arrays, and ``Env``, one environment with numpy arrays.

Importing this module registers them: ``gymnasium.make("mjx_nero/nero_lift-v0")``. Without importing it first, use
``gymnasium.make("mjx_nero.interop.gymnasium:mjx_nero/nero_lift-v0")``.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import mjx_nero
from mjx_nero.config import bounds, values
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError, missing
from mjx_nero.interop import need
from mjx_nero.interop.batch import Batch
from mjx_nero.learn import device_memory
from mjx_nero.sim.render import Renderer
from mjx_nero.tasks import registry

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise UserError(missing(error)) from None

ARRAYS = ("numpy", "jax", "torch")


class VectorEnv(gymnasium.vector.VectorEnv, gymnasium.utils.EzPickle):
    """Many environments in one compiled program, with Gymnasium's vector API and same-step autoreset.

    When an episode ends, ``step`` returns the reward and flags of its last step, and the first observation of the next episode.
    ``info["final_obs"]`` holds the last observation and ``info["final_info"]`` the results (``success``, ``final_distance`` [m],
    ...). Both are valid where the masks ``info["_final_obs"]`` and ``info["_final_info"]`` are true. They are present at every
    step, so that the host need not wait for the device.

    The action space is bounded by the joint limits. A pickle holds only the arguments: unpickling makes a new environment, which
    must be reset.

    Args:
        env: name of an environment, or an environment.
        num_envs: number of environments.
        arrays: ``numpy``; or ``jax`` or ``torch``, which stay on JAX's device and are not copied.
        group: observation group to return; None: all groups, in a dict.
        render_mode: None or ``rgb_array``.
        num_rendered: number of environments that ``render`` draws.
        kwargs: further arguments of ``mjx_nero.make``.

    Raises:
        UserError: see ``mjx_nero.make``; or an argument is invalid.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}

    def __init__(
        self,
        env: str | ManipulationEnv,
        num_envs: int = 1,
        arrays: str = "numpy",
        group: str | None = "state",
        render_mode: str | None = None,
        num_rendered: int = 1,
        **kwargs: Any,
    ):
        gymnasium.utils.EzPickle.__init__(self, env, num_envs, arrays, group, render_mode, num_rendered, **kwargs)
        num_envs = values.read(bounds.Worlds, num_envs, "num_envs")
        self._num_rendered = values.read(bounds.Count, num_rendered, "num_rendered")
        self.env = _made(env, num_envs=num_envs, **kwargs)
        device_memory.check_batch(self.env, num_envs, "num_envs")
        self.num_envs, self.render_mode, self._group = num_envs, _render_mode(render_mode), group
        self.metadata = {**self.metadata, "render_fps": 1 / self.env.dt}
        self._out, self._device, self._packed = _converter(arrays), jax.devices()[0], arrays == "torch"
        self.single_observation_space, self.single_action_space = _spaces(self.env, group)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._batch = Batch(self.env, num_envs)
        self._reset, self._step = jax.jit(self._reset_all), jax.jit(self._step_all)
        self._renderer: Renderer | None = None
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts new episodes; returns observations and an empty info. A seed makes everything that follows reproducible."""
        seed = _checked(self.closed, seed, options)
        super().reset(seed=seed)
        self._state, self._key = self._reset(_key(self.np_random, seed))
        return jax.tree.map(self._out, _group(self._state.obs, self._group)), {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Makes one control step; returns observations, rewards, terminated, truncated, info.

        Raises:
            gymnasium.error.InvalidAction: the actions have another shape, or are not finite numbers. Values that are already on
                the device are not checked: if they are not finite, the episode ends with ``nan`` in its results.
        """
        _check_open(self.closed, "step", self._state)
        action = _to_jax(actions, self.action_space.shape, self._device)
        self._state, self._key, out = self._step(self._state, self._key, action)
        *given, done, results = jax.tree.map(self._out, out)
        results = dict(zip(_results(self.env), results, strict=True))
        info = {"final_obs": given.pop(), "_final_obs": done, "final_info": results, "_final_info": done}
        return *given, info

    def render(self) -> tuple[np.ndarray, ...]:
        """Draws the first ``num_rendered`` environments, uint8 [height, width, 3] each.

        Raises:
            UserError: the machine cannot draw offscreen.
        """
        _check_open(self.closed, "render", self._state)
        self._renderer = self._renderer or Renderer(self.env.mj_model)
        return tuple(_frame(self.env, self._renderer, self._state, i) for i in range(min(self._num_rendered, self.num_envs)))

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the renderer."""
        if self._renderer:
            self._renderer.__exit__()
            self._renderer = None

    def _reset_all(self, key):
        key, k_reset = jax.random.split(key)
        return self._batch.reset(k_reset), key

    def _step_all(self, state, key, action):
        key, k_reset = jax.random.split(key)
        state, last = self._batch.step(state, action, k_reset)
        done, truncated = last.done > 0, last.info["truncation"] > 0
        results = [last.metrics[name] for name in _results(self.env)]
        obs, final_obs = (_group(each.obs, self._group) for each in (state, last))
        # Passing an array to torch takes the host about 25 us; splitting one there takes 2 us.
        packed = jnp.stack(results) if self._packed else results
        return state, key, (obs, last.reward, done & ~truncated, truncated, final_obs, done, packed)


class Env(gymnasium.Env, gymnasium.utils.EzPickle):
    """One environment with numpy arrays, as made by ``gymnasium.make("mjx_nero/nero_lift-v0")``.

    The info of an episode's last step holds its results. Arguments, errors and pickles are as in ``VectorEnv``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(self, env: str | ManipulationEnv, group: str | None = "state", render_mode: str | None = None, **kwargs: Any):
        gymnasium.utils.EzPickle.__init__(self, env, group, render_mode, **kwargs)
        self.env = _made(env, **kwargs)
        self.render_mode, self._group, self._closed = _render_mode(render_mode), group, False
        self.metadata = {**self.metadata, "render_fps": 1 / self.env.dt}
        self.observation_space, self.action_space = _spaces(self.env, group)
        self._reset, self._step, self._device = jax.jit(self.env.reset), jax.jit(self.env.step), jax.devices()[0]
        self._renderer: Renderer | None = None
        self._state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Starts a new episode; returns the observation and an empty info."""
        seed = _checked(self._closed, seed, options)
        super().reset(seed=seed)
        self._state = self._reset(_key(self.np_random, seed))
        return jax.tree.map(np.asarray, _group(self._state.obs, self._group)), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Makes one control step; returns observation, reward, terminated, truncated, info."""
        _check_open(self._closed, "step", self._state)
        action = _to_jax(action, self.action_space.shape, self._device)
        self._state = state = self._step(self._state, action)
        done, truncated = bool(state.done), bool(state.info["truncation"])
        info = {name: float(state.metrics[name]) for name in _results(self.env) if done}
        obs = jax.tree.map(np.asarray, _group(state.obs, self._group))
        return obs, float(state.reward), done and not truncated, truncated, info

    def render(self) -> np.ndarray:
        """Draws the environment, uint8 [height, width, 3].

        Raises:
            UserError: the machine cannot draw offscreen.
        """
        _check_open(self._closed, "render", self._state)
        self._renderer = self._renderer or Renderer(self.env.mj_model)
        return _frame(self.env, self._renderer, jax.tree.map(lambda x: x[None], self._state), 0)

    def close(self) -> None:
        """Frees the renderer."""
        self._closed = True
        if self._renderer:
            self._renderer.__exit__()
            self._renderer = None


def _made(env: Any, **kwargs: Any) -> ManipulationEnv:
    """Makes the named environment, or returns the given one.

    Raises:
        UserError: see ``mjx_nero.make``; or ``env`` is neither a name nor an environment.
    """
    if isinstance(env, str):
        return mjx_nero.make(env, **kwargs)
    if not isinstance(env, ManipulationEnv):
        raise UserError(f"env takes a name or an environment of mjx_nero.make, got {values.short(env)}")
    if given := [name for name in kwargs if name != "num_envs"]:
        raise UserError(f"{', '.join(given)} cannot change an environment that is already made: pass them to mjx_nero.make")
    return env


def _render_mode(mode: Any) -> str | None:
    if mode is not None and not (isinstance(mode, str) and mode == "rgb_array"):
        raise UserError(f"render_mode takes rgb_array or None, got {values.short(mode)}")
    return mode


def _check_open(closed: bool, what: str, state: Any = ()) -> None:
    """Raises Gymnasium's own errors if an environment is closed, or has no episode yet (``state`` is None)."""
    if closed:
        raise gymnasium.error.ClosedEnvironmentError(f"{what} after close: make a new environment")
    if state is None:
        raise gymnasium.error.ResetNeeded(f"call reset before {what}")


def _spaces(env: ManipulationEnv, group: Any) -> tuple[Any, Any]:
    sizes = env.observation_size
    if group is not None and not (isinstance(group, str) and group in sizes):
        raise UserError(f"no observation group {values.short(group)}: choose one of {', '.join(sizes)}, or None for all")
    boxes = {name: _space(env.state_shape.obs[name]) for name in sizes}
    observations = gymnasium.spaces.Dict(boxes) if group is None else boxes[group]
    return observations, gymnasium.spaces.Box(*env.actions.bounds(), dtype=np.float32)


def _space(obs: Any) -> gymnasium.spaces.Space:
    """Makes the space of an observation group; pictures are integers from 0 to 255."""
    if isinstance(obs, dict):
        return gymnasium.spaces.Dict({name: _space(each) for name, each in obs.items()})
    low, high = (0, 255) if obs.dtype == np.uint8 else (-np.inf, np.inf)
    return gymnasium.spaces.Box(low, high, obs.shape, obs.dtype.type)


def _group(obs: Any, group: str | None) -> Any:
    return dict(obs) if group is None else obs[group]


def _results(env: ManipulationEnv) -> list[str]:
    """Returns the names of an ended episode's metrics."""
    own = [name for name, term in env.cfg.metrics.items() if term.at_end]
    return ["success", "final_distance", *own, "dropped", "nan"]


def _checked(closed: bool, seed: Any, options: Any) -> int | None:
    """Checks the arguments of a reset; returns the seed.

    Raises:
        gymnasium.error.Error: see ``checked_seed``; or the environment is closed, or options are given.
    """
    _check_open(closed, "reset")
    if options is not None and not (isinstance(options, dict) and not options):
        named = ", ".join(map(str, options)) if isinstance(options, dict) else values.short(options)
        raise gymnasium.error.Error(f"reset takes no options here, got {named}: leave them out, all episodes start anew")
    return checked_seed(seed)


def checked_seed(seed: Any) -> int | None:
    """Checks that a seed is a single one in JAX's range.

    Raises:
        gymnasium.error.Error: it is not.
    """
    try:
        return None if seed is None else values.read(bounds.Seed, seed, "seed")
    except UserError as error:
        raise gymnasium.error.Error(f"{error}: one seed is for all environments") from None


def _key(rng: np.random.Generator, seed: int | None) -> jax.Array:
    return jax.random.PRNGKey(int(rng.integers(2**31)) if seed is None else seed)


def _converter(arrays: str) -> Callable[[jax.Array], Any]:
    if not isinstance(arrays, str) or arrays not in ARRAYS:
        raise UserError(f"unknown arrays {values.short(arrays)}: choose one of {', '.join(ARRAYS)}")
    if arrays == "torch":
        return need("torch").from_dlpack
    return np.asarray if arrays == "numpy" else lambda array: array


def _to_jax(action: Any, shape: tuple[int, ...] | None, device: jax.Device) -> jax.Array:
    """Converts actions to JAX, float32; torch tensors are passed by DLPack.

    Raises:
        gymnasium.error.InvalidAction: they have another shape, or are not finite numbers (checked on the host only).
    """
    here = not (isinstance(action, jax.Array) or hasattr(action, "detach"))
    try:
        given = np.asarray(action) if here else action
        if tuple(given.shape) != shape:
            raise gymnasium.error.InvalidAction(f"actions take the shape {shape}, got {tuple(given.shape)}")
        if hasattr(given, "detach"):  # a torch tensor
            given = jax.dlpack.from_dlpack(given.detach().contiguous())
        if given.dtype.kind not in "fiub" and given.dtype != jnp.bfloat16:
            raise TypeError
        with np.errstate(over="ignore"):
            given = given.astype(np.float32) if here else given
        if here and not np.isfinite(given).all():
            raise gymnasium.error.InvalidAction("actions take finite numbers, got some that are not")
        array = jnp.asarray(given, jnp.float32)
        return array if array.devices() == {device} else jax.device_put(array, device)
    except (TypeError, ValueError, AttributeError, ArithmeticError, BufferError, RuntimeError) as error:
        what = values.short(action) if isinstance(error, TypeError) and here else " ".join(str(error).split())[:200]
        raise gymnasium.error.InvalidAction(f"actions take numbers of the shape {shape}, got {what}") from None


def _frame(env: ManipulationEnv, renderer: Renderer, state: Any, index: int) -> np.ndarray:
    one = jax.tree.map(lambda x: x[index], state)
    return renderer.render(np.asarray(one.pipeline_state.qpos), jax.device_get(env.scenery(one)))


def register() -> None:
    """Registers the environments of ``mjx_nero.list_envs``, with the suffix ``-v0``. Call it again after you add your own."""
    for name in registry.list_envs():
        if f"mjx_nero/{name}-v0" not in gymnasium.registry:
            gymnasium.register(
                id=f"mjx_nero/{name}-v0",
                entry_point=f"{__name__}:Env",
                vector_entry_point=f"{__name__}:VectorEnv",
                kwargs={"env": name},
            )


register()
