"""Where a task's expert has been: the bank of states that ``wrappers.ExpertStarts`` begins training's episodes in.

The first of the task's controllers plays an episode in each of some environments, side by side in one program: on the processor's
cores, which compile it and run it while the device's own programs are compiled, and so that every machine comes to the same.
States are taken all along the episodes that succeed; of an arm that hardly gets to the goal, and with obstacles on the way, until
shortly after it has grasped. They are states at rest: joints, objects, and what the fingers press with.
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

HALF, ENOUGH = 0.5, 0.25  # of the episodes: see ``way`` and ``Way.enough``
EPISODES = 64
_QUICK = {"ik.restarts": 0}  # a controller's search for another way to reach takes most of the compiler's time
COMING, LIFTED = 1.5, 0.3  # [s] before an object is held the hand is on its way down to it; after, it is well above the table
_GRASPED, _HOLD = "metrics.grasped", "success.hold"

Make = Callable[[int], Bank | None]  # of a seed


@dataclasses.dataclass(frozen=True)
class Way:
    """What the expert did.

    Attributes:
        states: leaves [steps, episodes, ...].
        begins, ends: of each episode, the first step worth starting from, and the first after those; both 0: there is none.
        won, held: shares of the episodes that succeed and that grasp.
    """

    states: Bank
    begins: np.ndarray
    ends: np.ndarray
    won: float
    held: float

    @property
    def enough(self) -> bool:
        """Whether so many episodes are worth starting from that it can be said to do the task."""
        return bool((self.ends > 0).mean() >= ENOUGH)


def none(seed: int) -> None:
    """No bank: all episodes start as usual."""


def maker(learner: Learner, say: Callable[[str], None]) -> Make:
    """Makes the bank of a learner's environments, of a seed; None, and a line says why, where there is none."""
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
    """So many states, row i of phase 1 + i % ``phases``: of any of the episodes, at any step within that part of its way."""
    rng, phases = np.random.default_rng(seed), min(phases, n)
    episode = rng.choice(np.flatnonzero(way.ends), n)
    begin, end = way.begins[episode], way.ends[episode]
    step = begin + ((np.arange(n) % phases + rng.random(n)) / phases * (end - begin)).astype(int)
    return jax.tree.map(lambda x: np.asarray(x)[step, episode], way.states)


def playground(cfg: EnvCfg) -> EnvCfg:
    """The task as the expert plays it: by drive targets, the arm's weight carried, with nothing that differs, is late or in the
    way. What it passes through there are places for joints and objects in the task itself, too."""
    plain: dict[str, Any] = {"randomization": {}, "sensors": {}, "pushes": {}, "obstacles": None, "curriculum": CurriculumCfg()}
    return for_controllers(dataclasses.replace(cfg.uncorrupted(), **plain))


def _player(own: ManipulationEnv, most: int) -> Callable[[int], Way]:
    """Plays the expert's episodes of a seed, by a program that is compiled here.

    Raises:
        UserError: there is no expert.
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
    """JAX's own device of that name; None: it has been told to do without."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def _play(env: ManipulationEnv, expert: rollout.Agent, keys: Array) -> tuple[Bank, Array, Array, Array]:
    """An episode each: what ``way`` is made of."""

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
    """Where joints and objects are, the goal, and what the fingers press with."""
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
    """What is worth starting from: episodes that succeed, from a little before they grasp until they have succeeded; if fewer
    than half do, those that grasp, too, until a little after that.

    Args:
        states: leaves [steps, n, ...].
        grasped: the object is or has been held, bool [steps, n].
        won: bool [n].
        hold: for how many steps, up to the end, all has been as it should be, int [n].
        coming: steps before the object is held from which on the hand is on its way down to it.
        past: steps from when the object is held until it is well above the table.
        whole: else no further than that, whoever succeeds.
    """
    steps, held = len(grasped), grasped.any(axis=0)
    lifted = np.where(held, np.minimum(grasped.argmax(axis=0) + past, steps), 0)
    through = np.where(won, np.maximum(steps - hold, 1), 0)
    ends = lifted if not whole else through if won.mean() >= HALF else np.where(won, through, lifted)
    begins = np.where(ends > 0, np.clip(grasped.argmax(axis=0) - coming, 0, np.maximum(ends - 1, 0)), 0)
    return Way(states, begins, ends, float(won.mean()), float(held.mean()))
