"""Expert starts: the bank of visited states in which ``wrappers.ExpertStarts`` begins training episodes.

The task's first controller plays one episode in each of several environments, side by side in one program. The program compiles
and runs on the CPU while the device's programs compile, so every machine gets the same states. States are taken along the whole
of successful episodes. If the expert rarely succeeds, or obstacles are in the way, they end shortly after the grasp. A state is
at rest: joints, objects, and the pressure of the fingers.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State
from jaxtyping import Array

from mjx_nero import config, control
from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import CurriculumCfg, EnvCfg, for_controllers
from mjx_nero.errors import UserError
from mjx_nero.learn.learner import Learner
from mjx_nero.learn.play import rollout
from mjx_nero.types import Bank, Start

HALF, ENOUGH = 0.5, 0.25  # shares of episodes: see ``way`` and ``Way.enough``
EPISODES = 64
_QUICK = {"ik.restarts": 0}  # restarts of inverse kinematics take most of the compiler's time
COMING, LIFTED = 1.5, 0.3  # [s] the hand comes down so long before the grasp, and is well above the table so long after
_GRASPED, _HOLD = "metrics.grasped", "success.hold"

Make = Callable[[int], Bank | None]  # seed -> bank


@dataclasses.dataclass(frozen=True)
class Way:
    """The expert's episodes.

    Attributes:
        states: leaves [steps, episodes, ...].
        begins, ends: first and one past last step of each episode that are worth starting from; both 0 if none is.
        won, held: shares of episodes that succeed and that grasp.
    """

    states: Bank
    begins: np.ndarray
    ends: np.ndarray
    won: float
    held: float

    @property
    def enough(self) -> bool:
        """True if enough episodes are worth starting from to say that the expert can do the task."""
        return bool((self.ends > 0).mean() >= ENOUGH)


def none(seed: int) -> None:
    """Makes no bank: all episodes start as usual."""


def maker(learner: Learner, say: Callable[[str], None]) -> Make:
    """Returns a function that makes the bank of a learner's environments from a seed.

    It returns None, and says why in a line, if there can be none.
    """
    env = learner.env
    player = functools.cache(lambda: _player(env.unwrapped, learner.num_envs))

    def make(seed: int) -> Bank | None:
        if not isinstance(env, wrappers.ExpertStarts):
            return None
        try:
            with jax.default_device(_processor()):
                play = player()
                begun = time.perf_counter()
                found = play(seed)
        except UserError as error:
            say(f"no episodes start from an expert's states: {error}")
            return None
        did = f"the scripted expert grasps in {found.held:.0%} and succeeds in {found.won:.0%} of {len(found.ends)} episodes"
        say(f"{did}: {'some' if found.enough else 'no'} episodes start from its states ({time.perf_counter() - begun:.1f} s)")
        return rows(found, learner.num_envs, wrappers.PHASES, seed) if found.enough else None

    return make


def rows(way: Way, n: int, phases: int, seed: int) -> Bank:
    """Draws ``n`` states. Row i is from phase 1 + i % ``phases`` of any episode."""
    rng, phases = np.random.default_rng(seed), min(phases, n)
    episode = rng.choice(np.flatnonzero(way.ends), n)
    begin, end = way.begins[episode], way.ends[episode]
    step = begin + ((np.arange(n) % phases + rng.random(n)) / phases * (end - begin)).astype(int)
    return jax.tree.map(lambda x: np.asarray(x)[step, episode], way.states)


def playground(cfg: EnvCfg) -> EnvCfg:
    """Returns the task for the expert: drive targets, the arm's weight carried, no randomization, delays or obstacles.

    Its states are valid states of the task itself.
    """
    plain: dict[str, Any] = {"randomization": {}, "sensors": {}, "pushes": {}, "obstacles": None, "curriculum": CurriculumCfg()}
    return for_controllers(dataclasses.replace(cfg.uncorrupted(), **plain))


def _player(own: ManipulationEnv, most: int) -> Callable[[int], Way]:
    """Compiles a program that plays the expert's episodes of a seed.

    Raises:
        UserError: the task has no expert.
    """
    cfg, name = own.cfg, next(iter(own.cfg.controllers), None)
    if name is None or "grasped" not in cfg.metrics:
        raise UserError("the task has no script that grasps")
    count = min(most, EPISODES)
    env = ManipulationEnv(playground(cfg), impl="native", num_envs=count)
    quick = _QUICK if set(_QUICK) <= set(config.flatten(control.CONTROLLERS[name][1])) else {}
    expert = rollout.controller_agent(env, control.make(name, cfg.robot, env.dt, {**cfg.controllers[name], **quick}))
    some = jax.random.split(jax.random.PRNGKey(0), count)
    run = jax.jit(lambda keys: _play(env, expert, keys)).lower(some).compile()

    def play(seed: int) -> Way:
        found: Any = jax.device_get(run(jax.random.split(jax.random.PRNGKey(seed), count)))
        states, grasped, won, hold = found
        coming, past = (round(time / env.dt) for time in (COMING, LIFTED))
        return way(states, grasped, won, hold, coming, past, whole=cfg.obstacles is None)

    return play


def _processor() -> jax.Device | None:
    """Returns JAX's CPU device; None if JAX was told to do without."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def _play(env: ManipulationEnv, expert: rollout.Agent, keys: Array) -> tuple[Bank, Array, Array, Array]:
    """Plays one episode per key; returns the arguments of ``way``."""

    def step(carry: tuple, _: None) -> tuple:
        state, memory, alive = carry
        action, memory = expert.act(None, memory, state, keys)
        state = jax.vmap(env.step)(state, action)
        seen = jax.vmap(lambda s: _at_rest(env, s))(state), state.metrics["distance"]
        grasped = state.info["carry"].memory[_GRASPED] & (alive > 0)
        return (state, memory, alive * (1 - state.done)), (*seen, grasped, alive)

    first = jax.vmap(env.reset)(keys)
    begin = first, expert.init(first), jnp.ones(len(keys))
    played: Any = jax.lax.scan(step, begin, None, env.episode_length)
    (state, *_), (starts, distance, grasped, alive) = played
    won = (state.metrics["success"] > 0) & (alive[-1] > 0)
    return Bank(starts, distance < distance[0] / 2), grasped, won, state.info["carry"].memory[_HOLD]


def _at_rest(env: ManipulationEnv, state: State) -> Start:
    """Takes joints, objects, goal and finger pressure from a state."""
    view = env.view(state)
    objects = {name: view.objects[name] for name in env.cfg.scene.objects}
    return Start(
        joint_pos=view.joint_pos,
        object_pos_w={name: seen.pos_w for name, seen in objects.items()},
        object_quat_w={name: seen.quat_w for name, seen in objects.items()},
        goal_pos_w=view.root_pos_w + view.command,
        goal_quat_w=view.goal_quat_w,
        target=jnp.zeros((), jnp.int32) if view.target is None else view.target,
        pull=(view.ctrl - view.joint_pos).at[: len(env.cfg.robot.arm.joints)].set(0.0),
    )


def way(states: Bank, grasped: np.ndarray, won: np.ndarray, hold: np.ndarray, coming: int, past: int, whole: bool = True) -> Way:
    """Selects the steps worth starting from.

    They are those of successful episodes, from shortly before the grasp until success. If fewer than half of the episodes
    succeed, episodes that only grasp count too, until shortly after the grasp.

    Args:
        states: leaves [steps, n, ...].
        grasped: the object is or has been held, bool [steps, n].
        won: the episode succeeded, bool [n].
        hold: number of steps up to the end in which the task was done, int [n].
        coming: steps that the hand takes to come down before the grasp.
        past: steps from the grasp until the object is well above the table.
        whole: use successful episodes to their end; otherwise only until shortly after the grasp.
    """
    steps, held = len(grasped), grasped.any(axis=0)
    lifted = np.where(held, np.minimum(grasped.argmax(axis=0) + past, steps), 0)
    through = np.where(won, np.maximum(steps - hold, 1), 0)
    ends = lifted if not whole else through if won.mean() >= HALF else np.where(won, through, lifted)
    begins = np.where(ends > 0, np.clip(grasped.argmax(axis=0) - coming, 0, np.maximum(ends - 1, 0)), 0)
    return Way(states, begins, ends, float(won.mean()), float(held.mean()))
