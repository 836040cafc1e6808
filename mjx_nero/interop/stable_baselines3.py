"""Environments for Stable-Baselines3: its vector environment, as a wrapper of ``gymnasium.VectorEnv``."""

from typing import Any

import gymnasium
import jax
import numpy as np

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError, missing
from mjx_nero.interop.gymnasium import VectorEnv, checked_seed

try:
    from stable_baselines3.common import vec_env
except ModuleNotFoundError as error:
    raise UserError(missing(error)) from None


class VecEnv(vec_env.VecEnv):
    """A vector environment: ``PPO("MlpPolicy", VecEnv("nero_reach", 256))``.

    The info of an ended episode has ``is_success``, which Stable-Baselines3 logs.

    Args:
        env: name of an environment, or an environment.
        num_envs: number of environments.
        kwargs: further arguments of ``VectorEnv``.

    Raises:
        UserError: see ``VectorEnv``; or ``arrays`` is not numpy.
    """

    def __init__(self, env: str | ManipulationEnv, num_envs: int, **kwargs: Any):
        if kwargs.get("arrays", "numpy") != "numpy":
            raise UserError("Stable-Baselines3 takes numpy arrays only: leave arrays out")
        self.envs = VectorEnv(env, num_envs, **kwargs)
        self._seed: int | None = None
        self._actions: np.ndarray | None = None
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)

    def seed(self, seed: int | None = None) -> list[int | None]:
        """Sets the seed of the next ``reset``."""
        self._seed = checked_seed(seed)
        return [seed] * self.num_envs

    def reset(self) -> np.ndarray:
        """Starts new episodes; returns their first observations [n, ...]."""
        obs, _ = self.envs.reset(seed=self._seed)
        self._seed = None
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Stores the actions [n, action_size] for ``step_wait``."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Makes one control step; returns observations, rewards, dones and infos.

        Raises:
            gymnasium.error.NoAsyncCallError: there are no actions.
        """
        if self._actions is None:
            raise gymnasium.error.NoAsyncCallError("call step_async before step_wait", "step")
        actions, self._actions = self._actions, None
        obs, rewards, terminated, truncated, info = self.envs.step(actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(info["_final_obs"]):
            infos[i] = {
                "terminal_observation": jax.tree.map(lambda x, i=i: x[i], info["final_obs"]),
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(info["final_info"]["success"][i]),
            }
        return obs, rewards, terminated | truncated, infos

    def close(self) -> None:
        """Frees the renderer."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Returns the same value for each environment, because all of them are one program."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of all environments."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Calls a method once for all environments."""
        return [getattr(self.envs, method_name)(*args, **kwargs)] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Returns False for each environment: none is wrapped."""
        return [False] * len(list(self._get_indices(indices)))
