"""The manipulation environment: pure ``reset`` and ``step`` of one environment, compatible with ``brax.envs.base.Env``.

It is one long class because ``reset`` and ``step`` share all their parts, and one reads what the other writes.
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from mjx_nero.sim.quiet import Env, State

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_nero.config import bounds, values
from mjx_nero.envs import identified, reach, things
from mjx_nero.envs.once import once
from mjx_nero.envs.task import EnvCfg
from mjx_nero.envs.view import Viewer
from mjx_nero.mdp import events, terms
from mjx_nero.mdp.actions import Chain, Drives
from mjx_nero.mdp.curriculum import toward
from mjx_nero.mdp.success import Hold
from mjx_nero.sim import cameras, linkage, readings, scene, team
from mjx_nero.sim.cameras import CameraCfg, Look
from mjx_nero.sim.fields import Fields, Randomization
from mjx_nero.sim.physics import Footprint, Physics, make_physics, resolve_impl
from mjx_nero.types import (
    LEVEL,
    LOOK,
    PHASE,
    SHAPE,
    Bank,
    Carry,
    Key,
    Picture,
    Scenery,
    Sim,
    Start,
    UserError,
    View,
)

MAX_SPEED = 1e3  # [rad/s, m/s] beyond it the physics has diverged, even if it is still finite
_LONGEST = 1_000_000  # control steps of an episode
_SLACK = 1e-3  # of a home beyond its joint's range, as written with fewer digits [rad or m]
# Folded into an episode's key, so that a draw of one part does not change those of the others.
_FIELDS, _MEMORY, _SENSORS, _FOLLOWING, _VISITED, _LOOK = 0xF1E1D5, 0x3E3087, 0x5E4504, 0xF0110E, 0x715173D, 0x1004

Starts = tuple[Bank, Float[Array, " phases"]]  # visited states, and the probabilities of their phases


def _precise(method: Callable) -> Callable:
    """Forces full float32 products, whatever the program has set: TF32 in the physics lowers the success rate."""

    @functools.wraps(method)
    def precise(*args, **kwargs):
        with jax.default_matmul_precision("highest"):
            return method(*args, **kwargs)

    return precise


class ManipulationEnv(Env):
    """A robot, a table, objects and a commanded point, with the MDP of an ``EnvCfg``.

    ``reset`` and ``step`` are pure and work on one environment: use ``jax.vmap`` for thousands, and ``jax.jit`` for speed.
    ``state.pipeline_state`` is the physics state (``types.Sim``), ``state.obs`` is a dict of observation groups, and
    ``state.info['carry']`` holds the rest of the episode's memory. ``info['truncation']`` is 1 where ``done`` is a time-out.
    A warning says if goals or objects lie out of every hand's reach (``envs.reach``).

    Args:
        cfg: the task.
        impl: ``auto``, ``warp``, ``jax`` or ``native``.
        num_envs: number of copies that will be stepped together.

    Attributes:
        actions: the task's action terms, as a chain that can also describe and invert itself.
        home_action: the action that keeps the robot at home [na].
        team: all robots of the scene by name (``sim.team.of``).

    Raises:
        UserError: ``impl`` is unknown or unavailable on this machine, or the task is impossible.
    """

    def __init__(self, cfg: EnvCfg, impl: str = "auto", num_envs: int = 1):
        cfg = things.laid(things.applied(identified.applied(cfg)))
        self.cfg, self.impl, self.num_envs = cfg, resolve_impl(impl), values.read(bounds.Worlds, num_envs, "num_envs")
        self.dt = cfg.sim.dt * cfg.sim.decimation
        if cfg.episode_length_s / self.dt > _LONGEST:
            raise UserError(
                f"episode_length_s is at most {_LONGEST:,} control steps of {self.dt:g} s, got {cfg.episode_length_s:g} s"
            )
        self.episode_length = round(cfg.episode_length_s / self.dt)
        if not self.episode_length:
            raise UserError(f"episode_length_s must be a control step ({self.dt:g} s) or more, got {cfg.episode_length_s:g}")
        model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False, fuse=True)
        self.physics_model = model
        if said := reach.beyond(cfg, model):
            warnings.warn(said, stacklevel=1)  # one place, so that a program says it once
        self._parts = scene.parts(
            cfg.scene, model, cfg.command.targets, cfg.obstacles, lambda: self.mj_model, lambda: self._randomization.names
        )
        sees = self._pictures if cfg.scene.cameras else None
        self.team = team.of(cfg.robot, cfg.scene.robots)
        self._viewer = Viewer(
            model, cfg.robot, self._parts, self.episode_length, self.dt, cfg.command, sees, others=cfg.scene.robots
        )
        self._coupled = linkage.couplings(model)
        self._qpos0 = np.array(model.qpos0, np.float32)
        self._range = np.array([model.joint(j).range for j in team.joints(self.team)], np.float32).T
        self.actions = Chain(cfg.actions, self._drives())
        self.home_action, self.action_kinds = self.actions.home, self.actions.kinds
        self._randomization = Randomization(model, cfg.randomization)
        self._hold = Hold(round(cfg.success.hold_s / self.dt))
        self._resample_steps = round(cfg.command.resample_s / self.dt)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles and copies hold only the arguments, and rebuild the environment."""
        return type(self), (self.cfg, self.impl, self.num_envs)

    def _drives(self) -> dict[str, Drives]:
        groups, at = {}, 0
        for name, cfg in team.drives(self.team).items():
            own, at = slice(at, at + len(cfg.joints)), at + len(cfg.joints)
            open, close = (getattr(cfg, end, cfg.home) for end in ("open", "close"))
            home, speed, open, close, lag = (np.array(x, np.float32) for x in (cfg.home, cfg.speed, open, close, cfg.lead))
            low, high = self._range[:, own]
            out = (low < high) & ((home < low - _SLACK) | (home > high + _SLACK))
            if out.any():
                i = int(np.argmax(out))
                raise UserError(f"home of {cfg.joints[i]} is {home[i]:g}, outside of its range from {low[i]:g} to {high[i]:g}")
            groups[name] = Drives(home, low, high, speed, open, close, lag, self.dt, cfg.joints)
        return groups

    @once
    def physics(self) -> Physics:
        """The physics backend, created at the first step."""
        with jax.ensure_compile_time_eval():  # the first step may run under a trace
            differ = tuple(dict.fromkeys((*self._randomization.names, *self._parts.fields)))
            return make_physics(self.physics_model, self.cfg.sim, self.impl, differ)

    @once
    def mj_model(self) -> mujoco.MjModel:
        """The whole scene compiled for MuJoCo, with visual shapes, lights and cameras, for rendering and inspection."""
        return scene.build(self.cfg.robot, self.cfg.scene, self.cfg.sim)

    def draw_by(self, own: Mapping[str, CameraCfg], renderer: str) -> cameras.Cameras:
        """Makes the cameras ``own``, such as the scene's with other sizes and kinds; ``renderer`` is ``mujoco`` or ``warp``."""
        with jax.ensure_compile_time_eval():
            seen = (*self._parts.seen, *self._look.names)
            return cameras.Cameras(self.mj_model, own, renderer, tuple(dict.fromkeys(seen)))

    @once
    def cameras(self) -> cameras.Cameras:
        """The scene's cameras; made when something is first drawn."""
        return self.draw_by(self.cfg.scene.cameras, cameras.renderer(self.cfg.scene.renderer, self.impl))

    @once
    def _look(self) -> Look:
        return Look(self.mj_model, self.cfg.look)

    def prepare(self, num_envs: int, num_devices: int = 1) -> None:
        """Prepares what steps need outside of JAX: see ``Physics.prepare``."""
        self.physics.prepare(num_envs, num_devices)
        if self.cfg.scene.cameras:
            self.cameras.draw.prepare(num_envs, num_devices)

    def footprint(self, num_devices: int = 1) -> Footprint:
        """The memory that one environment needs outside of its state: see ``Physics.footprint``."""
        need = self.physics.footprint(num_devices)
        if not self.cfg.scene.cameras:
            return need
        return Footprint(need.in_program, need.outside + self.cameras.draw.bytes(), need.free)

    @property
    def action_size(self) -> int:
        """Number of entries of an action."""
        return len(self.home_action)

    @once
    def state_shape(self) -> State:
        """The result of ``reset``, with shapes in place of arrays."""
        return jax.eval_shape(lambda: self.reset(jax.random.PRNGKey(0)))  # a key made outside would be compiled

    @once
    def observation_size(self) -> dict[str, Any]:
        """The shape of each observation group; a dict of shapes for a group whose terms stay apart."""
        obs = self.state_shape.obs
        return jax.tree.map(lambda value: value.shape, {name: obs[name] for name in self.cfg.observations})

    @property
    def backend(self) -> str:
        """The physics backend's name, in Brax's words."""
        return {"native": "mujoco", "jax": "mjx-jax", "warp": "mjx-warp"}.get(self.impl, self.impl)

    @_precise
    def reset(self, rng: Key, level: float | Float[Array, ""] | None = None, starts: Starts | None = None) -> State:
        """Starts a new episode: joints at home, objects and command drawn anew.

        Args:
            rng: the environment's random key.
            level: share of all episode-to-episode differences to apply; None: all.
            starts: states that an expert has visited, and the probabilities of starting there (``events.visited``).
        """
        k_sample, k_obs = jax.random.split(rng)
        sim, carry = self.sample(k_sample, None if level is None else jnp.asarray(level, jnp.float32), starts)
        obs, carry = self.observe(sim, carry, k_obs)
        names = [f"reward/{name}" for name in self.cfg.rewards]
        names += ["success", "distance", "final_distance", "dropped", "nan", "overflow", *self.cfg.metrics]
        names += [LEVEL] if level is not None else []
        names += [f"shape/{name}" for name in carry.memory.get(SHAPE, {})]
        zero = jnp.zeros(())
        info = {"carry": carry, "count": jnp.zeros((), jnp.int32), "truncation": zero, "steps": zero}
        return State(sim, obs, zero, zero, dict.fromkeys(names, zero), info)

    @_precise
    def sample(self, rng: Key, level: Float[Array, ""] | None = None, starts: Starts | None = None) -> tuple[Sim, Carry]:
        """Draws the start of an episode, before any observation. ``level`` and ``starts``: see ``reset``."""
        k_fields, k_memory, k_visited = (jax.random.fold_in(rng, apart) for apart in (_FIELDS, _MEMORY, _VISITED))
        rng, k_command, *k_events = jax.random.split(rng, 2 + len(self.cfg.events))
        command, command_quat = self._sample_command(k_command)
        base = jnp.asarray(self.cfg.robot.base_pos)
        start = dataclasses.replace(self.blank().start, goal_pos_w=base + command, goal_quat_w=command_quat)
        for key, event in zip(k_events, self.cfg.events.values(), strict=True):
            start = event(key, start)
        if starts:
            start = events.visited(k_visited, start, bank=starts[0], chances=starts[1])
            command = jnp.where(start.phase > 0, start.goal_pos_w - base, command)
        fields = self._randomization(k_fields, level, self._parts.given(start))
        qpos, nv = self._qpos(start, fields), self.physics_model.nv
        sim = Sim(
            qpos=qpos,
            qvel=jnp.zeros(nv),
            ctrl=qpos[self._viewer.qpos_ids] + start.pull,
            warmstart=jnp.zeros(nv),
            time=jnp.zeros(()),
            fields=fields,
            readings={name: jnp.zeros(each.shape) for name, each in readings.of(self.physics_model).items()},
        )
        carry = Carry(
            rng=rng,
            step=jnp.zeros((), jnp.int32),
            action=jnp.zeros(self.action_size),
            command=command,
            command_quat=start.goal_quat_w,
            memory={
                **self._parts.memory(start),
                **({} if level is None else {LEVEL: level}),
            },
        )
        if starts:  # as if the previous action had asked for these targets
            last = self.actions.invert(sim.ctrl, qpos[self._viewer.qpos_ids])
            memory = {**carry.memory, PHASE: start.phase}
            carry = dataclasses.replace(carry, action=jnp.where(start.phase > 0, last, carry.action), memory=memory)
        if self.cfg.look:
            look = self._look(jax.random.fold_in(rng, _LOOK), level)
            carry = dataclasses.replace(carry, memory={**carry.memory, LOOK: look})
        fields = self._parts.late(rng, functools.partial(self._viewer, sim, carry, carry.action), fields)
        sim = dataclasses.replace(sim, fields=fields)
        return sim, dataclasses.replace(carry, memory=self._memory(k_memory, sim, carry))

    def blank(self) -> Bank:
        """Returns one row of a bank: joints at home, everything else as in the scene, no goal."""
        home = jnp.asarray(team.home(self.team))
        return Bank(Start(joint_pos=home, pull=jnp.zeros(len(home)), **self._parts.blank()), jnp.zeros((), bool))

    def start(self, state: State) -> Start:
        """Returns the start of an episode that begins in this state, at rest, with the fingers pressing as they do now."""
        view = self.view(state)
        arms = [name not in robot.gripper.joints for robot in self.team.values() for name in robot.joints]
        return Start(
            joint_pos=view.joint_pos,
            goal_pos_w=view.root_pos_w + view.command,
            goal_quat_w=view.goal_quat_w,
            pull=(view.ctrl - view.joint_pos).at[np.flatnonzero(arms)].set(0.0),
            **self._parts.start(view, state.info["carry"]),
        )

    def _qpos(self, start: Start, fields: Fields) -> Float[Array, " nq"]:
        """Builds qpos: joints within their ranges, everything else in its place, linkages closed."""
        joints = jnp.clip(start.joint_pos, *self._range)
        qpos = jnp.asarray(self._qpos0).at[self._viewer.qpos_ids].set(joints)
        qpos = self._parts.qpos(qpos, start, fields)
        for coupling in self._coupled:
            qpos = qpos.at[coupling.follower].set(coupling.position(qpos))
        return qpos

    def _memory(self, key: Key, sim: Sim, carry: Carry) -> dict[str, Any]:
        k_actions, k_terms = jax.random.split(key)
        view = self._viewer(sim, carry, carry.action)
        apart = jax.random.fold_in(key, _SENSORS)
        acting = self.actions.init(k_actions, view.joint_pos)
        if PHASE in carry.memory:
            begun = self.actions.init(k_actions, view.joint_pos, carry.action)
            begun = self.actions.step({**carry.memory, **begun}, carry.action, view.joint_pos, sim.ctrl)[0]
            acting = {
                name: jax.tree.map(functools.partial(jnp.where, carry.memory[PHASE] > 0), begun[name], acting[name])
                for name in acting
            }
        return {
            **carry.memory,
            **acting,
            **terms.init({"sensors": self.cfg.sensors, "pushes": self.cfg.pushes}, apart, view),
            **terms.init(self.cfg.view_terms(), k_terms, view),
            "success.hold": self._hold.init(k_terms, view),
        }

    @_precise
    def view(self, state: State) -> View:
        """Returns what terms and controllers read of a state."""
        carry = state.info["carry"]
        return self._viewer(state.pipeline_state, carry, carry.action)

    @_precise
    def named_observations(self, state: State) -> dict[str, dict[str, Array]]:
        """Evaluates each term of each observation group by name, without noise or delay. Also works on a batch."""
        if jnp.ndim(state.done):
            return jax.vmap(self.named_observations)(state)
        view, recall = self.view(state), terms.Recall(state.info["carry"].memory)
        return {name: terms.by_name(group.terms, view, recall, name) for name, group in self.cfg.observations.items()}

    def scenery(self, state: State) -> Scenery:
        """Collects what a picture of the state shows besides the joint positions."""
        return self._scenery(state.pipeline_state, state.info["carry"])

    def _scenery(self, sim: Sim, carry: Carry) -> Scenery:
        goal, _ = self._viewer.goal(carry)
        return Scenery(goal, carry.command_quat, **self._parts.scenery(sim, carry, dict(carry.memory.get(LOOK, {}))))

    def _pictures(self, sim: Sim, carry: Carry, *due: Mapping[str, Bool[Array, ""]]) -> dict[str, Picture]:
        return self.cameras(sim.qpos, self._scenery(sim, carry), *due)

    def _due(self, carry: Carry) -> dict[str, Bool[Array, ""]]:
        """Says for each camera whose sensor skips pictures whether it reads the current one. Empty: none skips any."""
        lenses = {f"sensors.{name}": term.made for name, term in self.cfg.sensors.items()}
        rare = {name: lens for name, lens in lenses.items() if getattr(lens, "every", 1) > 1}
        return {lens.camera: lens.due(carry.memory[name]) for name, lens in rare.items()}

    @_precise
    def observe(self, sim: Sim, carry: Carry, key: Key) -> tuple[dict[str, Any], Carry]:
        """Computes the observation groups and their new memory; ``key`` draws their noise."""
        cfg, recall = self.cfg, terms.Recall(carry.memory)
        view = sensed = self._viewer(sim, carry, carry.action)
        if due := self._due(carry):  # terms that read ``view`` see the pictures of every step
            sensed = dataclasses.replace(view, cameras=self._pictures(sim, carry, due))
        for name, term in cfg.sensors.items():
            sensed = recall.through(f"sensors.{name}", term.made, sensed)
        if cfg.sensors:
            sensed = toward(carry.memory.get(LEVEL), view, sensed)
        obs = terms.observe(cfg.observations, view, sensed, key, recall)
        return obs, dataclasses.replace(carry, memory=recall.memory)

    @_precise
    def step(self, state: State, action: Float[Array, " na"]) -> State:
        """Makes one control step.

        Args:
            state: result of ``reset`` or ``step``.
            action: action entries [action_size], unbounded.

        Raises:
            UserError: the action has the wrong size.
        """
        state, ctrl = self.act(state, action)
        sim, overflow = self.physics.step(state.pipeline_state, ctrl)
        return self.finish(state, action, sim, overflow)

    @_precise
    def following(self, state: State, starts: Starts | None = None) -> tuple[Sim, Carry]:
        """Draws the start of the episode after the current one, before any observation. ``starts``: see ``reset``."""
        carry = state.info["carry"]
        return self.sample(jax.random.fold_in(carry.rng, _FOLLOWING), carry.memory.get(LEVEL), starts)

    @_precise
    def step_and_reset(self, state: State, action: Float[Array, " na"], start: tuple[Sim, Carry] | None = None) -> State:
        """Makes a step and, if that ends the episode, starts a new one with fresh draws.

        Reward, done and metrics belong to the ended episode; physics, observation and carry to the new one. Caching the first
        state instead would replay one object and one goal position per environment forever.

        Args:
            start: start of the new episode, from ``following``; None: drawn now. Few episodes end in one step, yet the whole
                batch draws starts. A loop that draws them once every few steps is faster.
        """
        state, ctrl = self.act(state, action)
        sim, overflow = self.physics.step(state.pipeline_state, ctrl)
        state = self.advance(state, action, sim, overflow)
        rng, k_sample, k_obs = jax.random.split(state.info["carry"].rng, 3)
        level, old = self._next_level(state), (state.pipeline_state, state.info["carry"].replace(rng=rng))
        sim, carry = start or self.sample(k_sample, level)
        usual = {PHASE: jnp.zeros((), jnp.int32)} if PHASE in old[1].memory else {}
        carry = dataclasses.replace(carry, memory={**usual, **carry.memory, **({} if level is None else {LEVEL: level})})
        sim, carry = jax.tree.map(lambda new, old: jnp.where(state.done > 0, new, old), (sim, carry), old)
        obs, carry = self.observe(sim, carry, k_obs)
        return state.replace(pipeline_state=sim, obs=obs, info={**state.info, "carry": carry})

    @property
    def first_level(self) -> float | None:
        """Level of the first training episodes: see ``CurriculumCfg.levels``."""
        levels = self.cfg.curriculum.levels
        return None if levels is None else levels.made.start

    def _next_level(self, state: State) -> Float[Array, ""] | None:
        level, levels = state.info["carry"].memory.get(LEVEL), self.cfg.curriculum.levels
        if level is None or levels is None:
            return level
        return levels.made.step(level, state.metrics["success"])

    def act(self, state: State, action: Float[Array, " na"]) -> tuple[State, Float[Array, " nu"]]:
        """Computes the drives' position targets for ``action`` [rad or m], and the state with the action terms' new memory.

        Raises:
            UserError: the action has the wrong size.
        """
        if jnp.shape(action) != (self.action_size,):
            shape = f"an action is {self.action_size} numbers, got an array of shape {jnp.shape(action)}"
            raise UserError(f"{shape}: jax.vmap the step for many environments")
        sim, carry = state.pipeline_state, state.info["carry"]
        joint_pos = sim.qpos[self._viewer.qpos_ids]
        memory, ctrl = self.actions.step(carry.memory, self._clip(action), joint_pos, sim.ctrl)
        sim, memory = self._push(sim, carry, memory)
        return state.replace(pipeline_state=sim, info={**state.info, "carry": carry.replace(memory=memory)}), ctrl

    def _push(self, sim: Sim, carry: Carry, memory: dict[str, Any]) -> tuple[Sim, dict[str, Any]]:
        """Adds the pushes to the objects' velocities."""
        if not self.cfg.pushes:
            return sim, memory
        recall, view, qvel = terms.Recall(memory), self._viewer(sim, carry, carry.action), sim.qvel
        for name, term in self.cfg.pushes.items():
            dof = int(self.physics_model.joint(term.params["object"]).dofadr[0])
            qvel = qvel.at[dof : dof + 3].add(toward(memory.get(LEVEL), jnp.zeros(3), recall(f"pushes.{name}", term, view)))
        return dataclasses.replace(sim, qvel=qvel), recall.memory

    def targets(self, state: State, action: Float[Array, " na"]) -> Float[Array, " nu"]:
        """Computes only the drives' position targets for ``action``. Raises the errors of ``act``."""
        return self.act(state, action)[1]

    @_precise
    def finish(self, state: State, action: Float[Array, " na"], sim: Sim, overflow: Float[Array, ""]) -> State:
        """Makes the second half of ``step``, given the new physics state ``sim``."""
        state = self.advance(state, action, sim, overflow)
        rng, k_obs = jax.random.split(state.info["carry"].rng)
        obs, carry = self.observe(state.pipeline_state, state.info["carry"], k_obs)
        return state.replace(obs=obs, info={**state.info, "carry": carry.replace(rng=rng)})

    @_precise
    def advance(self, state: State, action: Float[Array, " na"], sim: Sim, overflow: Float[Array, ""]) -> State:
        """Computes rewards, terminations, metrics and carry for the physics state ``sim``; leaves the observation as it was."""
        cfg, carry = self.cfg, state.info["carry"]
        sim, action, bad = self._guard(state, self._clip(action), sim)
        step, count, recall = carry.step + 1, state.info["count"] + 1, terms.Recall(carry.memory)
        view = self._viewer(sim, carry.replace(step=step), action)

        rewards = terms.rewards(cfg.rewards, cfg.curriculum.weights, view, count, self.dt, recall)
        bad |= ~jnp.isfinite(sum(rewards.values()))
        rewards = {name: jnp.where(bad, 0.0, value) for name, value in rewards.items()}
        terminated, truncated = terms.terminations(cfg.terminations, view, recall)
        terminated, truncated = terminated | bad, truncated & ~bad
        done = (terminated | truncated).astype(jnp.float32)
        met = recall("success.condition", cfg.success.condition, view)
        ends = {"success": truncated & recall.through("success.hold", self._hold, met), "dropped": terminated & ~bad}
        metrics = {f"reward/{name}": value for name, value in rewards.items()}
        if LEVEL in carry.memory:
            ends[LEVEL] = carry.memory[LEVEL]
        ends |= {f"shape/{name}": index.astype(jnp.float32) for name, index in carry.memory.get(SHAPE, {}).items()}
        metrics |= self._metrics(view, recall, ends, done, bad) | {"nan": bad.astype(jnp.float32), "overflow": overflow}

        carry = self._resample(carry.replace(step=step, action=jnp.where(bad, carry.action, action), memory=recall.memory))
        info = {"carry": carry, "count": count, "truncation": truncated.astype(jnp.float32), "steps": step.astype(jnp.float32)}
        return state.replace(
            pipeline_state=sim,
            reward=jnp.asarray(sum(rewards.values()), jnp.float32),
            done=done,
            metrics={**state.metrics, **metrics},
            info={**state.info, **info},
        )

    def _guard(self, state: State, action: Float[Array, " na"], sim: Sim) -> tuple[Sim, Float[Array, " na"], Bool[Array, ""]]:
        """Keeps a diverged environment at its last good state and marks it, so that nothing of the bad state spreads."""
        bad = ~(jnp.all(jnp.abs(sim.qpos) < jnp.inf) & jnp.all(jnp.abs(sim.qvel) < MAX_SPEED) & jnp.all(jnp.isfinite(action)))
        sim = jax.tree.map(lambda old, new: jnp.where(bad, old, new), state.pipeline_state, sim)
        return sim, jnp.where(bad, state.info["carry"].action, action), bad

    def _metrics(self, view: View, recall: terms.Recall, ends: dict, done: Array, bad: Array) -> dict[str, Float[Array, ""]]:
        """Computes the task's metrics; ``ends`` are further results of an episode."""
        distance = recall("success.distance", self.cfg.success.distance, view)
        values = {"distance": distance, "final_distance": distance, **ends}
        values |= {name: recall(f"metrics.{name}", term, view) for name, term in self.cfg.metrics.items()}
        # Episode results are 0 before the last step, so a sum over the episode gives them.
        at_end = {"final_distance", *ends, *(name for name, term in self.cfg.metrics.items() if term.at_end)}
        return {name: jnp.where(bad, 0.0, value * done if name in at_end else value) for name, value in values.items()}

    def _resample(self, carry: Carry) -> Carry:
        """Draws a new command when it is due."""
        if self._resample_steps >= self.episode_length:
            return carry
        rng, k_command = jax.random.split(carry.rng)
        pos, quat = (
            jnp.where(carry.step % self._resample_steps == 0, new, old)
            for new, old in zip(self._sample_command(k_command), (carry.command, carry.command_quat), strict=True)
        )
        return dataclasses.replace(carry, rng=rng, command=pos, command_quat=quat)

    def _sample_command(self, key: Key) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        goal = self.cfg.command(key)
        return goal if isinstance(goal, tuple) else (goal, jnp.array([1.0, 0.0, 0.0, 0.0]))

    def _clip(self, action: Float[Array, " na"]) -> Float[Array, " na"]:
        return jnp.clip(action, -self.cfg.action_clip, self.cfg.action_clip) if self.cfg.action_clip else action
