"""Records of control steps: what ``step`` took and gave, kept before an ended episode restarts."""

from typing import Any

from mjx_nero.sim.quiet import State

import jax
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.types import Scenery


@struct.dataclass
class Record:
    """One control step: what the policy saw, what it did, and what came of it. Leading axes are steps and environments."""

    obs: dict[str, Any]  # as the policy saw it, with noise and delay; a dict of terms for a group that stays apart
    action: Float[Array, "*n na"]  # as the policy gave it
    targets: Float[Array, "*n nu"]  # position targets of the drives [rad or m]
    qpos: Float[Array, "*n nq"]  # after the step, as is everything below
    qvel: Float[Array, "*n nv"]
    readings: dict[str, Array]  # of the scene's sensors
    scenery: Scenery  # what a picture shows besides qpos
    reward: Float[Array, "*n"]
    terminated: Bool[Array, "*n"]
    truncated: Bool[Array, "*n"]

    def __getitem__(self, at: Any) -> "Record":
        """Selects steps or environments."""
        return jax.tree.map(lambda x: x[at], self)

    @property
    def done(self) -> Bool[Array, "*n"]:
        """True where the step ended its episode."""
        return self.terminated | self.truncated


def of_step(env: ManipulationEnv, before: State, action: jax.Array, after: State) -> Record:
    """Makes the record of one environment's step.

    Args:
        before: the state in which the policy acted.
        action: the policy's action [na].
        after: the result of ``step``, not restarted.
    """
    sim, truncated = after.pipeline_state, after.info["truncation"] > 0
    return Record(
        obs={name: before.obs[name] for name in env.cfg.observations},
        action=action,
        targets=sim.ctrl,
        qpos=sim.qpos,
        qvel=sim.qvel,
        readings=sim.readings,
        scenery=env.scenery(after),
        reward=after.reward,
        terminated=(after.done > 0) & ~truncated,
        truncated=truncated,
    )


def of_batch(env: ManipulationEnv, before: State, action: jax.Array, after: State) -> Record:
    """Makes the records of a batch's step: ``of_step`` with a leading axis."""
    return jax.vmap(lambda *step: of_step(env, *step))(before, action, after)


class Recorder:
    """Collects the records of a batch step by step, in the host's memory, and splits them into episodes."""

    def __init__(self) -> None:
        self._steps: list[Record] = []

    def __call__(self, record: Record) -> None:
        """Adds the records of one step [environments, ...]."""
        self._steps.append(jax.tree.map(np.array, record))

    def episodes(self) -> list[Record]:
        """Returns the ended episodes [steps, ...], in order, environment by environment. Running episodes are left out."""
        if not self._steps:
            return []
        all_steps = jax.tree.map(lambda *steps: np.stack(steps), *self._steps)
        found = []
        for i in range(all_steps.reward.shape[1]):
            own, begin = all_steps[:, i], 0
            for end in (np.flatnonzero(own.done) + 1).tolist():
                found.append(own[begin:end])
                begin = end
        return found
