"""Judges whether a simulated or emulated arm has done its task, by the success term of the environment."""

import collections
import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.observe import Observer
from mjx_nero.deploy.places import Lost, Places
from mjx_nero.errors import UserError
from mjx_nero.tools import cli


class Witness:
    """An observer that remembers the last states of the arm and of the objects.

    Args:
        cfg: the environment's config.
        joints: names of the joints, in the order of feedback.
    """

    def __init__(self, observer: Observer, places: Places, cfg: Any, joints: Sequence[str]):
        self._observer, self._places, self._cfg, self._joints = observer, places, cfg, joints
        self._last = collections.deque[tuple[Feedback, Mapping[str, Any]]](maxlen=1 + self._steps)
        self.pictures, self.objects = observer.pictures, observer.objects

    @property
    def _steps(self) -> int:
        return max(1, round(self._cfg.success.hold_s / (self._cfg.sim.dt * self._cfg.sim.decimation)))

    def __call__(self, feedback: Feedback, targets: np.ndarray, action: np.ndarray, now: float) -> dict[str, np.ndarray]:
        """See ``Observer``."""
        with contextlib.suppress(Lost):  # an object that the policy does not observe
            self._last.append((feedback, {name: self._places.find(name, now) for name in self._cfg.scene.objects}))
        return self._observer(feedback, targets, action, now)

    def verdict(self) -> str:
        """Returns one line: whether the task has been done; empty if nothing was seen, or if poses do not show it."""
        if len(self._last) <= self._steps:
            return ""
        try:
            met, way = self._judged()
        except UserError:  # the term needs forces or the whole past
            return ""
        return f"the task {'succeeded' if met else 'failed'}: {1e3 * way:.0f} mm to go at the end"

    def _judged(self) -> tuple[bool, float]:
        import jax
        import jax.numpy as jnp

        from mjx_nero.envs.env import ManipulationEnv

        cli.setup_jax()
        env = ManipulationEnv(dataclasses.replace(self._cfg.uncorrupted(), randomization={}), impl="native")
        success = env.cfg.success
        if isinstance(success.condition.func, type) or env.cfg.scene.fixtures:
            raise UserError("poses of arm and objects do not show success")
        state = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), env.state_shape)  # a reset would take much longer to compile
        goal = {"command": jnp.asarray(self._observer.goal), "command_quat": jnp.asarray(self._observer.goal_quat)}
        carry, sim = state.info["carry"].replace(**goal), state.pipeline_state

        @jax.jit
        def judge(qpos, qvel):
            now = dataclasses.replace(sim, qpos=qpos, qvel=qvel)
            view = env.view(state.replace(pipeline_state=now, info={**state.info, "carry": carry}))
            view = dataclasses.replace(view, readings={})
            return tuple(term.func(view, **term.params) for term in (success.condition, success.distance))

        found = [judge(*self._state(env, *pair)) for pair in pairwise(self._last)]
        return all(bool(met) for met, _ in found), float(found[-1][1])

    def _state(self, env: Any, before: Any, after: Any) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions and velocities of the physics; an object's velocity is a difference of positions."""
        model, (feedback, places) = env.physics_model, after
        qpos, qvel = model.qpos0.copy(), np.zeros(model.nv)
        for name, at, speed in zip(self._joints, feedback.position, feedback.velocity, strict=True):
            qpos[model.joint(name).qposadr[0]], qvel[model.joint(name).dofadr[0]] = at, speed
        for name, place in places.items():
            at, to = int(model.joint(name).qposadr[0]), int(model.joint(name).dofadr[0])
            qpos[at : at + 7] = [*(place.position + env.cfg.robot.base_pos), *place.quaternion]
            qvel[to : to + 3] = (place.position - before[1][name].position) / env.dt
        return qpos, qvel
