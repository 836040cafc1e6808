"""Expert starts: what a task's expert gives a learner. It is a bank of visited states, in which ``wrappers.ExpertStarts`` begins
training episodes, and the expert's actions, to imitate.

The task's first controller plays one episode in each of several environments, side by side in one program, through the
task's own actions (``Chain.invert``). The program compiles and runs on the CPU while the device's programs compile, so every
machine gets the same states; ``kept`` saves them for the next run. States are taken along the whole of successful episodes. If
the expert rarely succeeds, or obstacles are in the way, they end shortly after the grasp. A state is at rest: joints, objects,
and the pressure of the fingers. Some noise in the actions makes the expert show how to recover (DART, Laskey et al. 2017).
"""

import concurrent.futures
import dataclasses
import functools
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from mjx_nero import config, control
from mjx_nero.config import bounds
from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import CurriculumCfg, EnvCfg, compensated
from mjx_nero.errors import UserError
from mjx_nero.learn.learner import DEMONSTRATIONS, ROWS, Learner
from mjx_nero.learn.machines import processor
from mjx_nero.mdp import fixtures
from mjx_nero.runs import kept
from mjx_nero.runs.helpers import wait_for
from mjx_nero.types import Bank, Shown

HALF, ENOUGH = 0.5, 0.25  # shares of episodes: see ``way`` and ``Way.enough``
# Maximum standard deviation of the noise on the expert's actions, by whether they are velocities: noisy positions shake the arm.
NOISE = {True: 0.1, False: 0.02}
_QUICK = {"ik.restarts": 0}  # restarts of inverse kinematics take most of the compiler's time
# A controller of 64 arms is thousands of operations that are too small to share among threads.
_ONE_THREAD: dict[str, str | bool] = {"xla_cpu_multi_thread_eigen": False}
# Programs of these controllers run for a moment, once, and XLA's first level compiles them in a third of the time. Programs of
# the others run for longer at that level than it saves.
_BRIEF, _COMPILED_FAST = ("pick_up", "pick_place", "grasp_thing"), {"xla_backend_optimization_level": 0}
COMING, LIFTED = 1.5, 0.3  # [s] time that the hand comes down before the grasp, and time after it until well above the table
_HOLD = "success.hold"


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


class Maker:
    """Makes from a seed what an expert gives a learner: arguments of ``Learner.init`` besides its key. If the task has no usable
    expert, it makes nothing and says so.

    Args:
        new: the run begins with a new policy. A run from a policy file imitates no expert: that policy knows more.
        elsewhere: the process that plays the first seed's episodes (see ``apart``); None: there is none.
    """

    def __init__(self, learner: Learner, say: Callable[[str], None], new: bool = True, elsewhere: BaseProcess | None = None):
        self.say, self._elsewhere = say, None
        self._begins = isinstance(learner.env, wrappers.ExpertStarts)
        self._imitates = new and getattr(learner, "imitates", False)
        self._player: _Player | None = None
        if self._begins or self._imitates:
            episodes = getattr(learner, "demonstrations", DEMONSTRATIONS)
            self._sizes = learner.num_envs, ROWS * episodes  # rows of the bank and of the steps
            self._player = _Player(learner.env.unwrapped, min(episodes, learner.num_envs))
            if self._player.keeps:  # otherwise the other process cannot hand anything over
                self._elsewhere = elsewhere

    def trace(self, seed: int) -> None:
        """Traces the expert's program now, if a call with this seed needs it."""
        if self._player is not None and self._player.able and self._elsewhere is None:
            with jax.default_device(processor()):
                self._player.trace(seed)

    def __call__(self, seed: int) -> dict[str, Any]:
        if self._player is None:
            return {}
        if self._elsewhere is not None and not self._player.kept(seed):
            wait_for(self._elsewhere)  # if it failed, this process plays
        self._elsewhere = None
        try:
            with jax.default_device(processor()):
                found, shown, seconds = self._player(seed)
        except UserError as error:
            self.say(f"no expert demonstrates: {error}")
            return {}
        did = f"the scripted expert grasps in {found.held:.0%} and succeeds in {found.won:.0%} of {len(found.ends)} noisy tries"
        uses = [f"{'some' if found.enough else 'no'} episodes start from its states"] if self._begins else []
        uses += ["it is imitated" if found.enough else "it is not imitated"] if self._imitates else []
        self.say(f"{did}: {', '.join(uses)} ({seconds:.1f} s)")
        if not found.enough:
            return {}
        n, k = self._sizes
        return self._asked(lambda: rows(found, n, wrappers.PHASES, seed), lambda: steps(found, shown, k, seed))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what it makes if the expert can do the task."""
        return (*(("bank",) if self._begins else ()), *(("shown",) if self._imitates else ()))

    def shapes(self) -> dict[str, Any]:
        """Returns the shapes of what it makes if the expert can do the task."""
        if self._player is None or not self._player.able:
            return {}
        states, _, _, shown = self._player.shapes()
        n, k = self._sizes
        return self._asked(lambda: _first_axes(states, 2, (n,)), lambda: _first_axes(shown, 2, (k,)))

    def _asked(self, bank: Callable[[], Any], shown: Callable[[], Any]) -> dict[str, Any]:
        return {**({"bank": bank()} if self._begins else {}), **({"shown": shown()} if self._imitates else {})}


def rows(way: Way, n: int, phases: int, seed: int) -> Bank:
    """Draws ``n`` states. Row i is from phase 1 + i % ``phases`` of any episode."""
    rng, phases = np.random.default_rng(seed), min(phases, n)
    episode = rng.choice(np.flatnonzero(way.ends), n)
    begin, end = way.begins[episode], way.ends[episode]
    step = begin + ((np.arange(n) % phases + rng.random(n)) / phases * (end - begin)).astype(int)
    return jax.tree.map(lambda x: np.asarray(x)[step, episode], way.states)


def steps(way: Way, shown: Shown, n: int, seed: int) -> Shown:
    """Draws ``n`` of the steps [steps, episodes, ...] of the useful episodes, each with the same probability."""
    rng, count = np.random.default_rng(seed), len(shown.action)
    at = rng.integers(count, size=n), rng.choice(np.flatnonzero(way.ends), n)
    return jax.tree.map(lambda x: np.asarray(x)[at], shown)


def playground(cfg: EnvCfg) -> EnvCfg:
    """Returns the task for the expert: with gravity compensation, without randomization, delays and pushes.

    Its states are valid states of the task itself.
    """
    plain: dict[str, Any] = {"randomization": {}, "sensors": {}, "pushes": {}, "curriculum": CurriculumCfg()}
    return dataclasses.replace(compensated(cfg).uncorrupted(), **plain)


class _Player:
    """Plays ``count`` episodes of the expert from a seed, or reads them if an earlier run has played them."""

    def __init__(self, own: ManipulationEnv, count: int):
        self._own, self._count = own, count
        self._name = next(iter(own.cfg.controllers), "")
        self.able = bool(self._name) and _milestone(own.cfg) is not None
        # Here, where nothing traces: each look at a file gives Python's lock away, and a thread that traces keeps it for 5 ms.
        self._kept = kept.Shelf("experts", own.cfg, control.CONTROLLERS.get(self._name), count)

    @property
    def keeps(self) -> bool:
        """True if episodes are kept for other processes."""
        return bool(self._kept)

    def kept(self, seed: int) -> bool:
        """True if the episodes have been played before."""
        return self._kept.has(seed)

    def trace(self, seed: int) -> None:
        """Traces the program that plays the episodes, unless an earlier run has played them."""
        if not self.kept(seed):
            self._lowered  # noqa: B018

    def __call__(self, seed: int) -> tuple[Way, Shown, float]:
        """Returns the episodes, their steps, and how long it took without compilation [s].

        Raises:
            UserError: the task has no expert.
        """
        begun, cfg = time.perf_counter(), self._own.cfg
        if read := self._kept.read(seed, lambda _: self.shapes()):
            (*arrays, shown), about = read
            return Way(*arrays, **about), shown, time.perf_counter() - begun
        run, env = self._compiled
        begun = time.perf_counter()
        found: Any = jax.device_get(run(jax.random.split(jax.random.PRNGKey(seed), self._count)))
        states, shown, grasped, won, hold = found
        coming, past = (round(time / env.dt) for time in (COMING, LIFTED))
        chosen = way(states, grasped, won, hold, coming, past, whole=cfg.obstacles is None)
        about = {"won": chosen.won, "held": chosen.held}
        self._kept.write(seed, (chosen.states, chosen.begins, chosen.ends, shown), about)
        return chosen, shown, time.perf_counter() - begun

    @functools.cached_property
    def _compiled(self) -> tuple[Callable[[Array], Any], ManipulationEnv]:
        compile, env = self._lowered
        return compile(), env

    @functools.cached_property
    def _lowered(self) -> tuple[Callable[[], Callable[[Array], Any]], ManipulationEnv]:
        """Lowers the programs that play the episodes. Returns a call that compiles them, and their environment."""
        cfg, name, count = self._own.cfg, self._name, self._count
        if not self.able:
            raise UserError("the task has no script that grasps")
        env = ManipulationEnv(playground(cfg), impl="native", num_envs=count)
        quick = _QUICK if set(_QUICK) <= set(config.flatten(control.CONTROLLERS[name][1])) else {}
        expert = control.make(name, env.cfg.robot, env.dt, {**cfg.controllers[name], **quick}, env.cfg.scene.robots)
        some = jax.random.split(jax.random.PRNGKey(0), count)
        options: Any = {**_ONE_THREAD, **(_COMPILED_FAST if name in _BRIEF else {})}
        # Two programs, of which the first compiles while the second is traced.
        begin = jax.jit(functools.partial(_begun, env, expert)).lower(some)
        beside = concurrent.futures.ThreadPoolExecutor(1)
        beginning = beside.submit(begin.compile, options)
        beside.shutdown(wait=False)
        play = jax.jit(functools.partial(_played, env, expert)).lower(some, begin.out_info)

        def compile() -> Callable[[Array], Any]:
            played, begun = play.compile(options), beginning.result()
            return lambda keys: played(keys, begun(keys))

        return compile, env

    def shapes(self) -> tuple[Any, ...]:
        """Returns the shapes of the states, of where they begin and end, and of the steps."""
        own, size = self._own, (self._own.episode_length, self._count)
        state, action = own.state_shape, np.zeros(own.action_size, np.float32)
        start, ends = jax.eval_shape(own.start, state), np.zeros(self._count, int)
        states = Bank(_first_axes(start, 0, size), np.zeros(size, bool))  # type: ignore[arg-type]
        return states, ends, ends, _first_axes(Shown(state.obs, action), 0, size)  # type: ignore[arg-type]


def _first_axes(tree: Any, old: int, new: tuple[int, ...]) -> Any:
    """Returns the shapes of a tree's arrays, with ``new`` in place of their first ``old`` axes."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((*new, *x.shape[old:]), x.dtype), tree)


def _milestone(cfg: EnvCfg) -> str | None:
    """Returns the name of the metric that says when the hard part is done; None if there is none."""
    return next((name for name, term in cfg.metrics.items() if term.milestone), None)


def _begun(env: ManipulationEnv, expert: control.Controller, keys: Array) -> tuple[Any, Any, Array]:
    """Begins one episode per key: states, the expert's memories, and which episodes go on."""
    first = jax.vmap(env.reset)(keys)
    return first, jax.vmap(lambda state: expert.init(env.view(state)))(first), jnp.ones(len(keys))


def _played(
    env: ManipulationEnv, expert: control.Controller, keys: Array, begun: tuple[Any, Any, Array]
) -> tuple[Bank, Shown, Array, Array, Array]:
    """Plays the episodes that begin so; returns the arguments of ``way``, and the steps as second."""
    grasp = f"metrics.{_milestone(env.cfg)}"
    noise = NOISE["JointVelocity" in env.action_kinds] * jnp.arange(len(keys))[:, None] / len(keys)

    def step(carry: tuple, key: Array) -> tuple:
        state, memory, alive = carry
        view = jax.vmap(env.view)(state)
        memory, targets = jax.vmap(expert.step)(memory, view)
        wanted = jax.vmap(env.actions.invert)(targets, view.joint_pos, view.ctrl)
        after = jax.vmap(env.step)(state, wanted + noise * jax.random.normal(key, wanted.shape))
        seen = jax.vmap(env.start)(after), after.metrics["distance"]
        grasped = after.info["carry"].memory[grasp] & (alive > 0)
        return (after, memory, alive * (1 - after.done)), (*seen, grasped, alive, Shown(state.obs, wanted))

    played: Any = jax.lax.scan(step, begun, jax.random.split(keys[0], env.episode_length))
    (state, *_), (starts, distance, grasped, alive, shown) = played
    won = (state.metrics["success"] > 0) & (alive[-1] > 0)
    return (
        Bank(starts, (distance < distance[0] / 2) | _goal_is_tied(env.cfg)),
        shown,
        grasped,
        won,
        state.info["carry"].memory[_HOLD],
    )


def _goal_is_tied(cfg: EnvCfg) -> bool:
    """True if an event places a fixture by the goal. A start that keeps one of them must keep the other."""
    return any(bounds.unwrapped(event.func) is fixtures.stand_at_goal for event in cfg.events.values())


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
    return Way(states, begins.astype(int), ends.astype(int), float(won.mean()), float(held.mean()))
