"""Measures success over a parameter. One compiled program plays every setting with the same start states."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from mjx_nero.sim.quiet import State

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg
from mjx_nero.learn import policy
from mjx_nero.learn.play import rollout
from mjx_nero.mdp import actions, sensors
from mjx_nero.mdp.terms import Term
from mjx_nero.sim.cameras.look import Look
from mjx_nero.sim.fields import Randomization, nominal
from mjx_nero.sim.physics import make_physics
from mjx_nero.tasks import sim2real
from mjx_nero.tools.robustness import seen
from mjx_nero.tools.robustness.sweeps import LONGEST, Point
from mjx_nero.types import LOOK


class Bench:
    """An environment whose randomized fields, delay and offset are set at the start of each episode.

    Args:
        cfg: the task that the policy was trained on, with that preset.
        path: the policy; None: the bundled one.
        episodes: number of episodes per setting.
    """

    def __init__(self, env_name: str, preset: str, cfg: EnvCfg, path: pathlib.Path | None, episodes: int, impl: str, seed: int):
        self._played: list[tuple[Point, dict[str, Any]]] = []
        self._episodes, self._seed, self._sees = episodes, seed, bool(cfg.scene.cameras)
        self._told = [] if self._sees else list(cfg.scene.objects)  # objects whose positions are told, not seen
        cfg = seen.prepared(cfg) if self._sees else cfg
        own = {name: term for name, term in cfg.actions.items() if name != "delay"}  # ours replaces the task's own delay
        late = {"delay": Term(actions.Delay, params={"steps": (0, LONGEST)})}
        told = {name: Term(sensors.ObjectPosition, params={"object": name}) for name in self._told}
        wanted = sim2real.randomized(cfg).randomization
        cfg = dataclasses.replace(cfg.uncorrupted(), actions={**late, **own}, sensors={**cfg.sensors, **told})
        self.env = ManipulationEnv(cfg, impl=impl, num_envs=episodes)
        # All fields that any setting changes, so that one program plays every setting.
        names = Randomization(self.env.physics_model, wanted).names
        self._nominal = {name: jnp.asarray(getattr(self.env.physics_model, name), jnp.float32) for name in names}
        self.env.physics = make_physics(self.env.physics_model, cfg.sim, self.env.impl, names)
        trained = policy.load_for(self.env, env_name, path, preset=preset)
        self._run = rollout.runner(self.env, lambda params, obs, key: trained.act(obs), episodes, start=self._start)

    def success(self, point: Point) -> dict[str, Any]:
        """Plays a setting, unless it was played before; returns the success rate with Wilson's 95% interval."""
        if known := next((found for played, found in self._played if played == point), None):
            return known
        summary = self._run(self._given(point), self._seed).summary()
        self._played.append((point, {name: summary[name] for name in ("success_rate", "success_rate_95", "diverged")}))
        return self._played[-1][1]

    def _given(self, point: Point) -> dict[str, Any]:
        """Draws fields, delay and offset of each episode."""
        n, keys = self._episodes, jax.random.split(jax.random.PRNGKey(self._seed), 3)
        fields = {name: jnp.broadcast_to(value, (n, *value.shape)) for name, value in self._nominal.items()}
        if point.terms:
            draw: Callable = Randomization(self.env.physics_model, point.terms)
            fields |= jax.jit(jax.vmap(draw))(jax.random.split(keys[0], n))
        rng = np.random.default_rng(self._seed)
        offset = rng.uniform(-point.offset, point.offset, (n, 3)).astype(np.float32)
        given = {"fields": fields, "lag": rng.integers(point.delay[0], point.delay[1] + 1, n).astype(np.int32), "offset": offset}
        if self._sees:
            model = self.env.mj_model
            every = {n: jnp.asarray(x) for n, x in nominal(model, self.env.state_shape.info["carry"].memory[LOOK]).items()}
            every = {name: jnp.broadcast_to(value, (n, *value.shape)) for name, value in every.items()}
            drawn = jax.jit(jax.vmap(Look(model, point.look.terms)))(jax.random.split(keys[1], n))
            given |= {"look": every | drawn, "late": np.full(n, point.look.late, np.int32)}
        return given

    def _start(self, given: Mapping[str, Any], state: State) -> State:
        """Returns the start states with the given values. Objects of another size still rest on the table."""
        sim, carry, fields = state.pipeline_state, state.info["carry"], given["fields"]
        memory, qpos = dict(carry.memory), sim.qpos
        memory["actions.delay"] = memory["actions.delay"].replace(lag=given["lag"])
        for name, item in self.env.cfg.scene.objects.items():
            if name in self._told:
                key, _, line = memory[f"sensors.{name}"]
                memory[f"sensors.{name}"] = key, given["offset"], line
            if "geom_size" in fields:
                geom, at = self.env.physics_model.geom(name).id, self.env.physics_model.joint(name).qposadr[0]
                factor = fields["geom_size"][:, geom, 0] / self._nominal["geom_size"][geom, 0]
                qpos = qpos.at[:, at + 2].add((factor - 1) * item.rest_height)
        sim = dataclasses.replace(sim, qpos=qpos, fields=dict(fields))
        state = state.replace(pipeline_state=sim, info={**state.info, "carry": carry.replace(memory=memory)})
        return self._looking(given, state) if self._sees else state

    def _looking(self, given: Mapping[str, Any], state: State) -> State:
        """Returns the states with the given look and picture delay, which already hold in the first pictures."""
        carry = state.info["carry"]
        memory = {**carry.memory, LOOK: given["look"]}
        state = state.replace(info={**state.info, "carry": carry.replace(memory=memory)})
        first = jax.vmap(lambda each: self.env.view(each).cameras)(state)
        for name, term in seen.lenses(self.env.cfg).items():
            *rest, lines = memory[f"sensors.{name}"]
            shown = {kind: getattr(first[term.params["camera"]], kind)[:, None] for kind in lines}
            late = {
                kind: line.replace(lag=given["late"], past=jnp.broadcast_to(shown[kind], line.past.shape))
                for kind, line in lines.items()
            }
            memory[f"sensors.{name}"] = *rest, late
        carry = carry.replace(memory=memory)
        obs, carry = jax.vmap(self.env.observe)(
            state.pipeline_state, carry, jax.vmap(jax.random.fold_in, (0, None))(carry.rng, 1)
        )
        return state.replace(obs=obs, info={**state.info, "carry": carry})
