"""Evaluation: whole episodes with a policy or a controller."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import mjx_nero.sim.quiet  # noqa: F401

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State

from mjx_nero.control import Controller
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.types import Key, Scenery

# (parameters, observation groups [n, ...], key) -> actions [n, ...]
Act = Callable[[Any, dict[str, jax.Array], Key], jax.Array]


# Metrics of which ``Episodes.summary`` speaks in words of its own; of a task's others it gives the mean.
_KNOWN = ("success", "distance", "final_distance", "grasped", "grasp_time", "dropped", "nan", "overflow")


@dataclasses.dataclass(frozen=True)
class Agent:
    """Who plays a batch of environments.

    Attributes:
        act: (parameters, memory, states, key) -> (actions [n, ...], memory).
        init: states at the start -> memory.
    """

    act: Callable[[Any, Any, State, Key], tuple[jax.Array, Any]]
    init: Callable[[State], Any]


def policy_agent(act: Act) -> Agent:
    """A policy of the observations alone, without memory."""
    return Agent(act=lambda params, memory, state, key: (act(params, state.obs, key), memory), init=lambda state: ())


def controller_agent(env: ManipulationEnv, controller: Controller) -> Agent:
    """A controller in every environment of the batch; it has no parameters and draws nothing.

    The environment has to take drive targets (``actions.DriveTargets``).
    """

    def act(params, memory, state, key):
        memory, targets = jax.vmap(lambda m, s: controller.step(m, env.view(s)))(memory, state)
        return targets, memory

    return Agent(act, init=jax.vmap(lambda state: controller.init(env.view(state))))


@dataclasses.dataclass(frozen=True)
class Episodes:
    """One entry an episode.

    Attributes:
        metrics: name -> [n], each the sum over the episode's steps (see ``ManipulationEnv.finish``).
        returns: [n].
        lengths: [n] control steps.
        qpos: [steps, k, nq] of the first k environments, where asked for.
        scenery: [steps, k, ...], what else a picture of them shows (``ManipulationEnv.scenery``).
        distance: [steps, n], what the task's success is about [m]; an ended episode's stays.
        memory: the agent's, after the last step.
    """

    metrics: dict[str, np.ndarray]
    returns: np.ndarray
    lengths: np.ndarray
    qpos: np.ndarray
    scenery: Scenery
    distance: np.ndarray
    memory: Any

    def summary(self) -> dict:
        """Figures for people and for JSON: distances in m, times in s. An episode whose physics or policy left the numbers is a
        failure, and in no mean; None is the mean of none."""
        m, n = self.metrics, len(self.returns)
        whole, success = self._whole, self.success
        low, high = wilson(float(success.sum()), n)
        terms = {name.removeprefix("reward/"): value for name, value in m.items() if name.startswith("reward/")}
        return {
            "success_rate": float(success.mean()),
            "success_rate_95": [low, high],
            "final_distance_mean": _mean(m["final_distance"][whole]),
            "final_distance_median": float(np.median(m["final_distance"][whole])) if whole.any() else None,
            **self._grasps(),
            "dropped_rate": float((m["dropped"] * whole).mean()),
            "return_mean": _mean(self.returns[whole]),
            "return_by_term": {name: _mean(value[whole]) for name, value in terms.items()},
            "episode_length_mean": float(self.lengths.mean()),
            "diverged": int((~whole).sum()),
            "nan_count": int(m["nan"].sum()),
            "overflow_count": int(m["overflow"].sum()),
            **{f"{name}_mean": _mean(m[name][whole]) for name in m if name not in _KNOWN and not name.startswith("reward/")},
        }

    @property
    def success(self) -> np.ndarray:
        """Of each episode, bool [n]."""
        return (self.metrics["success"] > 0) & self._whole

    @property
    def _whole(self) -> np.ndarray:
        return ~(self.metrics["nan"] > 0) & np.isfinite(self.returns)

    def recorded(self, which: np.ndarray) -> "Episodes":
        """The same episodes, with the records of those named alone; ``which``: int [any], below the number of recorded ones."""
        return dataclasses.replace(self, qpos=self.qpos[:, which], scenery=self.scenery[:, which])

    def _grasps(self) -> dict[str, float | None]:
        if not {"grasped", "grasp_time"} <= set(self.metrics):
            return {}
        grasped = (self.metrics["grasped"] > 0) & self._whole
        return {"grasp_rate": float(grasped.mean()), "time_to_grasp_mean": _mean(self.metrics["grasp_time"][grasped])}


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if values.size else None


class Runner:
    """(parameters of the policy, seed) -> finished episodes, by one compiled program.

    Args:
        run: jitted, (parameters, keys of the episodes, key) -> what ``Episodes`` is made of.
        episodes: how many.
    """

    def __init__(self, run: Any, episodes: int):
        self._run, self._episodes = run, episodes

    def __call__(self, params: Any, seed: int) -> Episodes:
        return _collect(*self._run(params, *_keys(seed, self._episodes)))

    def compiler(self, params: Any) -> Callable[[], None]:
        """Traces the program; the call that comes back compiles it, in any thread."""
        lowered = self._run.lower(params, *_keys(0, self._episodes))

        def compile() -> None:
            self._run = lowered.compile()

        return compile


def wilson(successes: float, n: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's 95% interval of a proportion (Wilson 1927)."""
    p, zz = successes / n, z * z / n
    middle, half = (p + zz / 2) / (1 + zz), z * math.sqrt(p * (1 - p) / n + zz / (4 * n)) / (1 + zz)
    return max(0.0, middle - half), min(1.0, middle + half)


def _accumulate(state: State, after: State, totals: dict, active: jax.Array) -> tuple[State, dict, jax.Array]:
    """Adds a step's metrics to the episodes still running; the others stay where they ended."""
    step = {**after.metrics, "return": after.reward, "length": jnp.ones_like(after.reward)}
    totals = {name: totals[name] + jnp.where(active > 0, step[name], 0.0) for name in totals}

    def keep(old, new):
        return jnp.where(active.reshape(active.shape + (1,) * (new.ndim - 1)) > 0, new, old)

    return jax.tree.map(keep, state, after), totals, active * (1 - after.done)


def _start(env: ManipulationEnv, keys: Key) -> tuple[State, dict, jax.Array]:
    state = jax.vmap(env.reset)(keys)
    zeros = jnp.zeros(keys.shape[0])
    return state, dict.fromkeys((*state.metrics, "return", "length"), zeros), jnp.ones_like(zeros)


def _frames(env: ManipulationEnv, state: State, record: int) -> tuple[jax.Array, Scenery, jax.Array]:
    first = jax.tree.map(lambda x: x[:record], state)
    return first.pipeline_state.qpos, jax.vmap(env.scenery)(first), state.metrics["distance"]


def runner(
    env: ManipulationEnv,
    act: Act | Agent,
    episodes: int,
    record: int = 0,
    start: Callable[[Any, State], State] | None = None,
) -> Runner:
    """Plays ``episodes`` at once, on the environment's physics: one compiled program, reused from call to call.

    Args:
        record: how many of the episodes to keep qpos and scenery of.
        start: (parameters, states after the reset) -> the states to start from.
    """
    agent = act if isinstance(act, Agent) else policy_agent(act)

    @jax.jit
    def run(params, keys: Key, key: Key):
        def step(carry, key):
            (state, totals, active), memory = carry
            action, memory = agent.act(params, memory, state, key)
            episode = _accumulate(state, jax.vmap(env.step)(state, action), totals, active)
            return (episode, memory), _frames(env, episode[0], record)

        state, totals, active = _start(env, keys)
        state = start(params, state) if start else state
        keys = jax.random.split(key, env.episode_length)
        ((_, totals, _), memory), frames = jax.lax.scan(step, ((state, totals, active), agent.init(state)), keys)
        return totals, frames, memory

    return Runner(run, episodes)


def _keys(seed: int, episodes: int) -> tuple[Key, Key]:
    # Training folds nothing into its seed, so no evaluation ever repeats a training episode's draws.
    key = jax.random.fold_in(jax.random.PRNGKey(seed), 0xE7A1)
    k_reset, key = jax.random.split(key)
    return jax.random.split(k_reset, episodes), key


def _collect(totals: dict, frames: tuple, memory: Any) -> Episodes:
    totals = {name: np.asarray(value, np.float64) for name, value in totals.items()}
    returns, lengths = totals.pop("return"), totals.pop("length")
    qpos, scenery, distance = jax.device_get(frames)
    return Episodes(totals, returns, lengths, qpos, scenery, distance, memory)
