"""Rollouts: whole episodes played with a policy or a controller."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

from mjx_nero.sim.quiet import State

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero.control import Controller
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn import device_memory, machines, waiting
from mjx_nero.learn.play import figures, recorder
from mjx_nero.learn.play.recorder import Record
from mjx_nero.types import Key, Scenery

# (parameters, observation groups [n, ...], key) -> actions [n, ...]
Act = Callable[[Any, dict[str, jax.Array], Key], jax.Array]


@dataclasses.dataclass(frozen=True)
class Agent:
    """A policy or controller that plays a batch of environments.

    Attributes:
        act: (parameters, memory, states, key) -> (actions [n, ...], memory).
        init: states at the start -> memory.
    """

    act: Callable[[Any, Any, State, Key], tuple[jax.Array, Any]]
    init: Callable[[State], Any]


def policy_agent(act: Act) -> Agent:
    """Makes an agent of a policy, which reads only observations and has no memory."""
    return Agent(act=lambda params, memory, state, key: (act(params, state.obs, key), memory), init=lambda state: ())


def controller_agent(env: ManipulationEnv, controller: Controller) -> Agent:
    """Makes an agent of a controller, one copy per environment. It has no parameters and draws nothing.

    The environment must take drive targets (``actions.DriveTargets``).
    """

    def act(params, memory, state, key):
        memory, targets = jax.vmap(lambda m, s: controller.step(m, env.view(s)))(memory, state)
        return targets, memory

    return Agent(act, init=jax.vmap(lambda state: controller.init(env.view(state))))


def through_actions(env: ManipulationEnv, agent: Agent) -> Agent:
    """Lets an agent of drive targets act in any environment, by the actions whose targets are the same or nearest."""

    def act(params, memory, state, key):
        targets, memory = agent.act(params, memory, state, key)
        joint_pos = jax.vmap(lambda each: env.view(each).joint_pos)(state)
        return env.actions.invert(targets, joint_pos, state.pipeline_state.ctrl), memory

    return dataclasses.replace(agent, act=act)


@dataclasses.dataclass(frozen=True)
class Totals:
    """Sums over played episodes, one entry each.

    Attributes:
        metrics: name -> sums over each episode's steps [n] (see ``ManipulationEnv.finish``).
        returns: returns of the episodes [n].
        lengths: lengths of the episodes in control steps [n].
        terms: the task's metric terms, which say how metrics become figures.
    """

    metrics: dict[str, np.ndarray]
    returns: np.ndarray
    lengths: np.ndarray
    terms: figures.Terms = dataclasses.field(default_factory=dict, kw_only=True)

    def summary(self) -> dict:
        """Computes the figures to show and to write as JSON: distances in m, times in s.

        An episode that became non-finite counts as a failure and is excluded from means; None if no episode remains.
        """
        m, n = self.metrics, len(self.returns)
        whole, success = self._whole, self.success
        low, high = wilson(float(success.sum()), n)
        terms = {name.removeprefix("reward/"): value for name, value in m.items() if name.startswith("reward/")}
        return {
            "success_rate": float(success.mean()),
            "success_rate_95": [low, high],
            "final_distance_mean": figures.mean(m["final_distance"][whole]),
            "final_distance_median": float(np.median(m["final_distance"][whole])) if whole.any() else None,
            **figures.of_episodes(self.terms, m, whole),
            "dropped_rate": float((m["dropped"] * whole).mean()),
            "return_mean": figures.mean(self.returns[whole]),
            "return_by_term": {name: figures.mean(value[whole]) for name, value in terms.items()},
            "episode_length_mean": float(self.lengths.mean()),
            "diverged": int((~whole).sum()),
            "nan_count": int(m["nan"].sum()),
            "overflow_count": int(m["overflow"].sum()),
        }

    @property
    def success(self) -> np.ndarray:
        """True for each episode that succeeded [n]."""
        return (self.metrics["success"] > 0) & self._whole

    @property
    def _whole(self) -> np.ndarray:
        return ~(self.metrics["nan"] > 0) & np.isfinite(self.returns)


@dataclasses.dataclass(frozen=True)
class Episodes(Totals):
    """Played episodes, one entry each.

    Attributes:
        record: records of the first k episodes [steps, k, ...], if asked for; an ended episode stands still.
        distance: the distance that success judges, in m [steps, n]; an ended episode's stays.
        memory: the agent's memory after the last step.
    """

    record: Record
    distance: np.ndarray
    memory: Any

    @property
    def qpos(self) -> np.ndarray:
        """Positions of the recorded episodes [steps, k, nq]."""
        return np.asarray(self.record.qpos)

    @property
    def scenery(self) -> Scenery:
        """Everything that a picture shows besides ``qpos`` [steps, k, ...]."""
        return self.record.scenery

    @property
    def pictures(self) -> list[np.ndarray]:
        """Colour pictures of the policy's cameras, uint8 [steps, k, height, width, 3], one entry per camera."""
        return [np.asarray(x) for x in jax.tree.leaves(self.record.obs) if x.ndim == 5 and x.dtype == np.uint8]

    def episode(self, index: int) -> Record:
        """Returns a recorded episode up to its end [steps, ...]."""
        return self.record[: int(self.lengths[index]), index]

    def recorded(self, which: np.ndarray) -> "Episodes":
        """Returns the same episodes with only the records at the indices ``which``: int [any]."""
        return dataclasses.replace(self, record=self.record[:, which])


class Runner:
    """A compiled program: (policy parameters, seed) -> finished episodes.

    Args:
        run: jitted function (parameters, keys of the episodes, key) -> parts of ``Episodes``.
        episodes: number of episodes.
        terms: the task's metric terms.
    """

    def __init__(self, run: Any, episodes: int, terms: figures.Terms):
        self._run, self._episodes, self._terms = run, episodes, terms

    def __call__(self, params: Any, seed: int) -> Episodes:
        found, frames, memory = waiting.result_of(self._run, params, *keys_of(seed, self._episodes))
        totals, (record, distance) = totals_of(found, self._terms), jax.device_get(frames)
        return Episodes(totals.metrics, totals.returns, totals.lengths, record, distance, memory, terms=self._terms)


def wilson(successes: float, n: int) -> tuple[float, float]:
    """Computes Wilson's 95% interval of a proportion (Wilson 1927)."""
    z = 1.96
    p, zz = successes / n, z * z / n
    middle, half = (p + zz / 2) / (1 + zz), z * math.sqrt(p * (1 - p) / n + zz / (4 * n)) / (1 + zz)
    return max(0.0, middle - half), min(1.0, middle + half)


def _accumulate(state: State, after: State, totals: dict, active: jax.Array) -> tuple[State, dict, jax.Array]:
    """Adds a step's metrics to the running episodes; ended ones stay as they are."""
    step = {**after.metrics, "return": after.reward, "length": jnp.ones_like(after.reward)}
    totals = {name: totals[name] + jnp.where(active > 0, step[name], 0.0) for name in totals}

    def keep(old, new):
        return jnp.where(active.reshape(active.shape + (1,) * (new.ndim - 1)) > 0, new, old)

    return jax.tree.map(keep, state, after), totals, active * (1 - after.done)


def _start(env: ManipulationEnv, keys: Key) -> tuple[State, dict, jax.Array]:
    state = jax.vmap(env.reset)(keys)
    zeros = jnp.zeros(keys.shape[0])
    return state, dict.fromkeys((*state.metrics, "return", "length"), zeros), jnp.ones_like(zeros)


def _step_bytes(env: ManipulationEnv, episodes: int, record: int) -> int:
    """Bytes that ``runner`` keeps per step."""
    state, action = env.state_shape, jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
    kept = jax.eval_shape(lambda *step: recorder.of_step(env, *step), state, action, state) if record else ()
    return record * device_memory.size(kept) + episodes * device_memory.size(state.metrics["distance"])


def runner(
    env: ManipulationEnv,
    act: Act | Agent,
    episodes: int,
    record: int = 0,
    start: Callable[[Any, State], State] | None = None,
) -> Runner:
    """Compiles a program that plays ``episodes`` at once: see ``player``."""
    run = player(env, act, episodes, record, start)
    return Runner(jax.jit(run, compiler_options=machines.untuned()), episodes, env.cfg.metrics)


def player(
    env: ManipulationEnv,
    act: Act | Agent,
    episodes: int,
    record: int = 0,
    start: Callable[[Any, State], State] | None = None,
) -> Callable[[Any, Key, Key], tuple[dict, Any, Any]]:
    """Returns the function that plays ``episodes`` at once, on the environment's physics: the first argument of ``Runner``.

    Args:
        record: number of episodes whose steps are kept.
        start: (parameters, states after the reset) -> states to start from.

    Raises:
        UserError: the episodes do not fit into memory.
    """
    device_memory.check_batch(env, episodes, "episodes:", env.episode_length * _step_bytes(env, episodes, record))
    agent = act if isinstance(act, Agent) else policy_agent(act)

    def run(params, keys: Key, key: Key):
        def step(carry, key):
            (state, totals, active), memory = carry
            action, memory = agent.act(params, memory, state, key)
            episode = _accumulate(state, jax.vmap(env.step)(state, action), totals, active)
            kept = recorder.of_batch(env, *jax.tree.map(lambda x: x[:record], (state, action, episode[0])))
            return (episode, memory), (kept, episode[0].metrics["distance"])

        state, totals, active = _start(env, keys)
        state = start(params, state) if start else state
        keys = jax.random.split(key, env.episode_length)
        ((_, totals, _), memory), frames = jax.lax.scan(step, ((state, totals, active), agent.init(state)), keys)
        return totals, frames, memory

    return run


def keys_of(seed: int, episodes: int) -> tuple[Key, Key]:
    """Returns the keys of the episodes of a seed, and the key of what is drawn while they are played."""
    return _keys(np.uint32(seed), episodes)


@functools.partial(jax.jit, static_argnums=1)  # each operation would be a program of its own
def _keys(seed: jax.Array, episodes: int) -> tuple[Key, Key]:
    # Training folds nothing into its seed, so an evaluation never repeats the draws of training.
    key = jax.random.fold_in(jax.random.PRNGKey(seed), 0xE7A1)
    k_reset, key = jax.random.split(key)
    return jax.random.split(k_reset, episodes), key


def totals_of(found: dict[str, jax.Array], terms: figures.Terms) -> Totals:
    """Makes the totals of the first result of ``player``'s function."""
    metrics = {name: np.asarray(value, np.float64) for name, value in found.items()}
    return Totals(metrics, metrics.pop("return"), metrics.pop("length"), terms=terms)
