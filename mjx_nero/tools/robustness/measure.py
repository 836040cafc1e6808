"""Success over a parameter: one compiled program plays every setting, each with the same starts."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import State

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg
from mjx_nero.learn import policy
from mjx_nero.learn.play import rollout
from mjx_nero.mdp import actions, sensors
from mjx_nero.mdp.terms import Term
from mjx_nero.sim.fields import Randomization
from mjx_nero.sim.physics import make_physics
from mjx_nero.tools.robustness.sweeps import LONGEST, Point, varied


class Bench:
    """An environment whose drawn fields, delay and offset are given at the start of each episode.

    Args:
        cfg: the task that the policy was trained on, of that preset.
        path: the policy; None: the one that ships.
        episodes: of a setting.
    """

    def __init__(self, env_name: str, preset: str, cfg: EnvCfg, path: pathlib.Path | None, episodes: int, impl: str, seed: int):
        self._episodes, self._seed, self._objects = episodes, seed, list(cfg.scene.objects)
        own = {name: term for name, term in cfg.actions.items() if name != "delay"}  # the task's own delay gives way
        late = {"delay": Term(actions.Delay, params={"steps": (0, LONGEST)})}
        seen = {name: Term(sensors.ObjectPosition, params={"object": name}) for name in self._objects}
        wanted = varied(cfg).randomization
        cfg = dataclasses.replace(cfg.uncorrupted(), actions={**late, **own}, sensors={**cfg.sensors, **seen})
        self.env = ManipulationEnv(cfg, impl=impl, num_envs=episodes)
        # All fields that some setting draws, so that one program plays them all.
        names = Randomization(self.env.physics_model, wanted).names
        self._nominal = {name: jnp.asarray(getattr(self.env.physics_model, name), jnp.float32) for name in names}
        self.env.physics = make_physics(self.env.physics_model, cfg.sim, self.env.impl, names)
        trained = policy.load_for(self.env, env_name, path, preset=preset)
        self._run = rollout.runner(self.env, lambda params, obs, key: trained.act(obs), episodes, start=self._start)

    def success(self, point: Point) -> dict[str, Any]:
        """Plays a setting: the rate with Wilson's 95% interval."""
        episodes = self._run(self._given(point), self._seed)
        summary = episodes.summary()
        return {name: summary[name] for name in ("success_rate", "success_rate_95", "diverged")}

    def _given(self, point: Point) -> dict[str, Any]:
        """Fields, delay and offset of each episode."""
        n, keys = self._episodes, jax.random.split(jax.random.PRNGKey(self._seed), 3)
        fields = {name: jnp.broadcast_to(value, (n, *value.shape)) for name, value in self._nominal.items()}
        if point.terms:
            draw: Callable = Randomization(self.env.physics_model, point.terms)
            fields |= jax.jit(jax.vmap(draw))(jax.random.split(keys[0], n))
        rng = np.random.default_rng(self._seed)
        offset = rng.uniform(-point.offset, point.offset, (n, 3)).astype(np.float32)
        return {"fields": fields, "lag": rng.integers(point.delay[0], point.delay[1] + 1, n).astype(np.int32), "offset": offset}

    def _start(self, given: Mapping[str, Any], state: State) -> State:
        """The states at the start, with what is given; objects of another size on the table."""
        sim, carry, fields = state.pipeline_state, state.info["carry"], given["fields"]
        memory, qpos = dict(carry.memory), sim.qpos
        memory["actions.delay"] = memory["actions.delay"].replace(lag=given["lag"])
        for name in self._objects:
            key, _, line = memory[f"sensors.{name}"]
            memory[f"sensors.{name}"] = key, given["offset"], line
            if "geom_size" in fields:
                geom, at = self.env.physics_model.geom(name).id, self.env.physics_model.joint(name).qposadr[0]
                factor = fields["geom_size"][:, geom, 0] / self._nominal["geom_size"][geom, 0]
                qpos = qpos.at[:, at + 2].add((factor - 1) * self.env.cfg.scene.objects[name].rest_height)
        sim = dataclasses.replace(sim, qpos=qpos, fields=dict(fields))
        return state.replace(pipeline_state=sim, info={**state.info, "carry": carry.replace(memory=memory)})
