"""The simulation behind a view: environments that run in real time, in a thread, and take orders meanwhile."""

import collections
import dataclasses
import functools
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.interop.batch import Batch, where
from mjx_nero.learn.play import recorder, rollout
from mjx_nero.learn.play.recorder import Record
from mjx_nero.types import Scenery

CURVE = 400  # control steps that the curves show
EPISODES = 100  # number of last episodes in the success rate


@dataclasses.dataclass(frozen=True)
class Frame:
    """The data of a picture after a control step: arrays on the host, one row per environment.

    Attributes:
        qpos: [n, nq].
        scenery: everything else that is visible (``ManipulationEnv.scenery``), [n, ...].
        step: control step in the first environment's episode.
        distance: distance to the goal in the first environment [m].
        curves: group -> name -> [size], of the first environment: rewards by term, actions, observations by term.
    """

    qpos: np.ndarray
    scenery: Scenery
    step: int
    distance: float
    curves: dict[str, dict[str, np.ndarray]]


class Session:
    """Environments, the agent that acts in them, and the user's orders. All methods may be called from any thread.

    Args:
        env: an environment with native physics.
        size: number of environments.
        seed: seed of their episodes.
    """

    def __init__(self, env: ManipulationEnv, size: int, agent: rollout.Agent, params: Any = None, seed: int = 0):
        self.env, self.size = env, size
        self.running, self.speed = True, 1.0
        self.failure: BaseException | None = None
        self.successes: collections.deque[bool] = collections.deque(maxlen=EPISODES)
        self.recorders: list[Callable[[Record], None]] = []  # called with the record of every step of all environments
        self.history: collections.deque[Frame] = collections.deque(maxlen=CURVE)
        self._batch = Batch(env, size)
        self._key = jax.random.PRNGKey(seed)
        self._reset, self._step = jax.jit(self._batch.reset), jax.jit(self._step_all)
        self._see = jax.jit(self._see_all)
        self._lock, self._stop, self._single = threading.RLock(), threading.Event(), False
        self._changed = False
        self._tape: Iterator[Frame] = iter(())
        self._dragged = np.zeros(size, bool)
        self._command = np.zeros((size, 3), np.float32)  # commands of the goals that the user has dragged
        self._state = self._reset(self._split())
        self.play(agent, params)
        self.frame = self._look(jnp.zeros((size, env.action_size)))

    def play(self, agent: rollout.Agent, params: Any = None) -> None:
        """Lets an agent act from now on."""
        with self._lock:
            self._act, self._init, self.params = jax.jit(agent.act), jax.jit(agent.init), params
            self._memory = self._init(self._state)

    def reset(self) -> None:
        """Starts new episodes, with goals drawn by the task."""
        with self._lock:
            self._tape, self._dragged[:] = iter(()), False
            self.history.clear()
            self.successes.clear()
            self._state = self._reset(self._split())
            self._memory = self._init(self._state)
            self.frame = self._look(jnp.zeros((self.size, self.env.action_size)))
            self._changed = True

    def replay(self, tape: Iterator[Frame]) -> None:
        """Shows the frames of a tape, one per step. The physics stands still until the tape ends, or until ``reset``."""
        with self._lock:
            self._tape = itertools.chain(tape, [self.frame])

    def single_step(self) -> None:
        """Requests one control step, which is done even while paused."""
        self._single = True

    def move_goal(self, index: int, to: np.ndarray) -> None:
        """Moves the goal of an environment to a point in the world [m]. It stays there until ``reset``, also in new episodes."""
        with self._lock:
            command = self._state.info["carry"].command
            # A moving goal follows a path about the command, so the command moves by the same vector as the goal.
            self._command[index] = np.asarray(command[index]) + to - self.frame.scenery.goal_pos_w[index]
            self._dragged[index] = True
            self._replace_goals()
            self._changed = True

    def move_object(self, index: int, joint: str, to: np.ndarray) -> None:
        """Moves an object, named by its free joint, to a point in the world [m], at rest."""
        with self._lock:
            at, model, sim = self.env.physics_model.joint(joint), self.env.physics_model, self._state.pipeline_state
            dof = int(model.jnt_dofadr[at.id])
            qpos = sim.qpos.at[index, int(at.qposadr[0]) + jnp.arange(3)].set(jnp.asarray(to, jnp.float32))
            qvel = sim.qvel.at[index, dof : dof + 6].set(0.0)
            self._state = self._state.replace(pipeline_state=sim.replace(qpos=qpos, qvel=qvel))
            self.frame, self._changed = dataclasses.replace(self.frame, qpos=np.array(qpos, np.float64)), True

    def run(self, shown: Callable[[Frame], None]) -> None:
        """Steps at ``speed`` times real time until ``stop``, and shows each step. An error ends it and is kept in ``failure``."""
        due = time.perf_counter()
        try:
            while not self._stop.is_set():
                if self.running or self._single:
                    self._single = False
                    self.step()
                    shown(self.frame)
                elif self._changed:
                    self._changed = False
                    shown(self.frame)  # what the user drags moves while everything else stands still
                due = max(due + self.env.dt / self.speed, time.perf_counter() - 0.1)  # does not catch up after a stall
                self._stop.wait(max(0.001, due - time.perf_counter()))
        except Exception as error:
            self.failure = error
            raise

    def stop(self) -> None:
        """Ends ``run``."""
        self._stop.set()

    def step(self) -> None:
        """Makes one control step in all environments, or shows one frame of a tape."""
        with self._lock:
            if (frame := next(self._tape, None)) is not None:
                self.frame = frame
                return
            key = self._split()
            action, memory = self._act(self.params, self._memory, self._state, key)
            self._state, record = self._step(self._state, action, key)
            ended = np.asarray(record.done)
            if ended.any():
                memory = where(record.done, self._init(self._state), memory)
                self.successes.extend(np.asarray(self._state.metrics["success"])[ended] > 0)
            self._memory = memory
            for consume in self.recorders:
                consume(record)
            self._replace_goals()
            self.frame = self._look(record.action)
            self.history.append(self.frame)

    def _step_all(self, state, action, key):
        after, last = self._batch.step(state, action, key)
        return after, recorder.of_batch(self.env, state, action, last)

    def _replace_goals(self) -> None:
        if self._dragged.any():
            carry = self._state.info["carry"]
            command = jnp.where(self._dragged[:, None], self._command, carry.command)
            self._state = self._state.replace(info={**self._state.info, "carry": carry.replace(command=command)})
            self.frame = dataclasses.replace(self.frame, scenery=jax.device_get(self._scenery(self._state)))

    @functools.cached_property
    def _scenery(self) -> Callable:
        return jax.jit(jax.vmap(self.env.scenery))

    def _see_all(self, state):
        first = jax.tree.map(lambda x: x[0], state)
        return state.pipeline_state.qpos, jax.vmap(self.env.scenery)(state), self.env.named_observations(first)["state"]

    def _look(self, action: jax.Array) -> Frame:
        state = self._state
        (qpos, scenery, observations), metrics = jax.device_get((self._see(state), state.metrics))
        rewards = {name.removeprefix("reward/"): value[:1] for name, value in metrics.items() if name.startswith("reward/")}
        return Frame(
            qpos=np.asarray(qpos, np.float64),
            scenery=scenery,
            step=int(state.info["carry"].step[0]),
            distance=float(metrics["distance"][0]),
            curves={"rewards": rewards, "actions": {"action": np.asarray(action[0])}, "observations": observations},
        )

    def _split(self) -> jax.Array:
        self._key, key = jax.random.split(self._key)
        return key


def free_joints(model: mujoco.MjModel) -> dict[str, str]:
    """Returns the free joints of a model, by the name of their body."""
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    return {model.body(model.jnt_bodyid[j]).name: model.joint(j).name for j in free}
