"""The simulation behind a view: environments that run in real time, in a thread, and take orders while they do."""

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
EPISODES = 100  # the last ones, of which the success rate is told


@dataclasses.dataclass(frozen=True)
class Frame:
    """One picture's data after a control step: arrays on the host, one row per environment.

    Attributes:
        qpos: [n, nq].
        scenery: [n, ...], what else there is to see (``ManipulationEnv.scenery``).
        curves: name -> [size] of the first environment: rewards by term, actions, observations by term.
    """

    qpos: np.ndarray
    scenery: Scenery
    step: int
    distance: float
    curves: dict[str, dict[str, np.ndarray]]


class Session:
    """Environments, who acts in them, and the orders of the user. All methods may be called from any thread.

    Args:
        env: with native physics.
        size: environments side by side.
        seed: of their episodes.
    """

    def __init__(self, env: ManipulationEnv, size: int, agent: rollout.Agent, params: Any = None, seed: int = 0):
        self.env, self.size = env, size
        self.running, self.speed = True, 1.0
        self.failure: BaseException | None = None
        self.successes: collections.deque[bool] = collections.deque(maxlen=EPISODES)
        self.recorders: list[Callable[[Record], None]] = []  # each gets the record of every step, of all environments
        self.history: collections.deque[Frame] = collections.deque(maxlen=CURVE)
        self._batch = Batch(env, size)
        self._key = jax.random.PRNGKey(seed)
        self._reset, self._step = jax.jit(self._batch.reset), jax.jit(self._step_all)
        self._see = jax.jit(self._see_all)
        self._lock, self._stop, self._single = threading.RLock(), threading.Event(), False
        self._changed = False
        self._tape: Iterator[Frame] = iter(())
        self._dragged = np.zeros(size, bool)
        self._command = np.zeros((size, 3), np.float32)  # of the goals that the user has dragged
        self._state = self._reset(self._split())
        self.play(agent, params)
        self.frame = self._look(jnp.zeros((size, env.action_size)))

    def play(self, agent: rollout.Agent, params: Any = None) -> None:
        """Lets another agent act from now on."""
        with self._lock:
            self._act, self._init, self.params = jax.jit(agent.act), jax.jit(agent.init), params
            self._memory = self._init(self._state)

    def reset(self) -> None:
        """Fresh episodes; goals are where the task draws them."""
        with self._lock:
            self._tape, self._dragged[:] = iter(()), False
            self.history.clear()
            self.successes.clear()
            self._state = self._reset(self._split())
            self._memory = self._init(self._state)
            self.frame = self._look(jnp.zeros((self.size, self.env.action_size)))
            self._changed = True

    def replay(self, tape: Iterator[Frame]) -> None:
        """Shows the frames of a tape, one a step; the physics stands still until it ends, or until ``reset``."""
        with self._lock:
            self._tape = itertools.chain(tape, [self.frame])

    def single_step(self) -> None:
        """One control step, also while paused."""
        self._single = True

    def move_goal(self, index: int, to: np.ndarray) -> None:
        """Puts the goal of an environment at a point of the world [m]; it stays there until ``reset``, also in new episodes."""
        with self._lock:
            command = self._state.info["carry"].command
            # A moving goal keeps to its path about the command, so the command goes as far as the goal does.
            self._command[index] = np.asarray(command[index]) + to - self.frame.scenery.goal_pos_w[index]
            self._dragged[index] = True
            self._replace_goals()
            self._changed = True

    def move_object(self, index: int, joint: str, to: np.ndarray) -> None:
        """Puts an object, by the name of its free joint, at a point of the world [m], at rest."""
        with self._lock:
            at, model, sim = self.env.physics_model.joint(joint), self.env.physics_model, self._state.pipeline_state
            dof = int(model.jnt_dofadr[at.id])
            qpos = sim.qpos.at[index, int(at.qposadr[0]) + jnp.arange(3)].set(jnp.asarray(to, jnp.float32))
            qvel = sim.qvel.at[index, dof : dof + 6].set(0.0)
            self._state = self._state.replace(pipeline_state=sim.replace(qpos=qpos, qvel=qvel))
            self.frame, self._changed = dataclasses.replace(self.frame, qpos=np.array(qpos, np.float64)), True

    def run(self, shown: Callable[[Frame], None]) -> None:
        """Steps in real time times ``speed`` until ``stop``, and shows each step. A failure ends it and is kept."""
        due = time.perf_counter()
        try:
            while not self._stop.is_set():
                if self.running or self._single:
                    self._single = False
                    self.step()
                    shown(self.frame)
                elif self._changed:
                    self._changed = False
                    shown(self.frame)  # what the user moves does so while all else stands still
                due = max(due + self.env.dt / self.speed, time.perf_counter() - 0.1)  # after a stall it does not race
                self._stop.wait(max(0.001, due - time.perf_counter()))
        except Exception as error:
            self.failure = error
            raise

    def stop(self) -> None:
        """Ends ``run``."""
        self._stop.set()

    def step(self) -> None:
        """One control step of all environments, or one frame of a tape."""
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
    """Body -> free joint: the things that lie about."""
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    return {model.body(model.jnt_bodyid[j]).name: model.joint(j).name for j in free}
