"""The manipulation environment: single, pure ``reset`` and ``step``, compatible with ``brax.envs.base.Env``."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.envs.base import Env, State
from jaxtyping import Array, Float

from mjx_nero import scene, terms
from mjx_nero.mdp import actions, success
from mjx_nero.mdp.rewards import held
from mjx_nero.physics import Physics, make_physics, resolve_impl
from mjx_nero.robots import RobotCfg
from mjx_nero.scene import SceneCfg, SimCfg
from mjx_nero.terms import CommandTerm, DoneTerm, ObservationTerm, RewardTerm, Term
from mjx_nero.types import Carry, Key, Sim, UserError, View
from mjx_nero.view import Viewer

_MAX_SPEED = 1e3  # [rad/s, m/s]: beyond it the physics has diverged, though it may still be finite


@dataclasses.dataclass(frozen=True)
class ActionCfg:
    """One action an arm joint (``home + scale * action`` [rad]), then one for the gripper (negative closes).

    ``gripper`` False leaves the gripper at home, without an action. ``clip`` bounds every action to +-clip before use; 0 leaves
    them alone. ``absolute`` takes the drives' position targets
    themselves [rad or m], one a drive, and leaves their speed to whoever gives them: for controllers.
    """

    scale: float = 0.5
    clip: float = 0.0
    gripper: bool = True
    absolute: bool = False


@dataclasses.dataclass(frozen=True)
class SuccessCfg:
    """``condition`` has held for the last ``hold_s`` seconds of the episode; ``distance`` [m] is what it is about."""

    condition: Term = Term(success.object_at_goal, params={"threshold": 0.02})
    distance: Term = Term(success.object_distance)
    hold_s: float = 0.5
    minimal_height: float = 0.025  # with grasp_radius: what counts as a grasp in the metrics [m]
    grasp_radius: float = 0.04


@dataclasses.dataclass(frozen=True)
class EnvCfg:
    """All of a task. Read ``tasks/lift.py`` for an example; every field can be overridden by its dotted name.

    ``motion`` moves the goal: a path of ``mdp.commands``. ``controllers`` are those of ``mjx_nero.control`` that can do the task,
    the usual one first, each with fields of its config by dotted name. ``training`` are fields of the learner's config that suit
    the task, likewise.
    """

    robot: RobotCfg
    command: CommandTerm
    observations: Mapping[str, Mapping[str, ObservationTerm]]
    rewards: Mapping[str, RewardTerm]
    terminations: Mapping[str, DoneTerm]
    events: Mapping[str, Term]
    curriculum: Mapping[str, Term]
    scene: SceneCfg = SceneCfg()
    sim: SimCfg = SimCfg()
    action: ActionCfg = ActionCfg()
    success: SuccessCfg = SuccessCfg()
    episode_length_s: float = 5.0
    object_start: tuple[float, float, float] = (0.2, 0.0, 0.015)  # before the reset events [m]
    corruption: bool = True  # observation noise: on to train, off to play
    motion: Term | None = None
    controllers: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    training: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        unknown = set(self.curriculum) - set(self.rewards)
        if unknown:
            raise UserError(f"curriculum names {', '.join(unknown)}: not one of the rewards {', '.join(self.rewards)}")


Presets = Mapping[str, Callable[[RobotCfg], EnvCfg]]  # by name, the default first
Envs = dict[str, tuple[RobotCfg | None, Presets]]  # by name, with the robot each is meant for


class ManipulationEnv(Env):
    """A robot, a table, a cube and a commanded point, with the MDP of an ``EnvCfg``.

    ``reset`` and ``step`` work on one environment and are pure: ``jax.vmap`` them for thousands, ``jax.jit`` them for speed.
    ``state.pipeline_state`` is the physics state (``types.Sim``), ``state.obs`` a dict of groups, ``state.info['carry']`` the
    rest of the episode's memory. ``info['truncation']`` is 1 where ``done`` is a time-out.

    Args:
        cfg: the task.
        impl: ``auto``, ``warp``, ``jax`` or ``native``.
        num_envs: how many are meant to be stepped together.

    Raises:
        UserError: ``impl`` is unknown or not possible on this machine.
    """

    def __init__(self, cfg: EnvCfg, impl: str = "auto", num_envs: int = 1):
        self.cfg, self.impl, self.num_envs = cfg, resolve_impl(impl), num_envs
        self.dt = cfg.sim.dt * cfg.sim.decimation
        self.episode_length = round(cfg.episode_length_s / self.dt)
        model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False, fuse=True)
        self.physics_model = model
        motion = None if cfg.motion is None else functools.partial(cfg.motion.func, **cfg.motion.params)
        self._viewer = Viewer(model, cfg.robot, self.episode_length, self.dt, motion)
        ids = self._viewer.qpos_ids
        self._coupled = _couplings(model)
        self._qpos0 = np.array(model.qpos0, np.float32)
        self._qpos0[ids] = cfg.robot.home
        self._range = np.array([model.joint(j).range for j in cfg.robot.joints], np.float32).T
        self._max_ctrl_step = np.array(cfg.robot.arm.speed + cfg.robot.gripper.speed, np.float32) * self.dt
        self._acts_on_gripper = cfg.action.gripper and bool(cfg.robot.gripper.joints)
        self._hold_steps = round(cfg.success.hold_s / self.dt)
        self._resample_steps = round(cfg.command.resample_s / self.dt)

    @functools.cached_property
    def physics(self) -> Physics:
        """The backend; made when first stepped."""
        with jax.ensure_compile_time_eval():  # the first step may well be under a trace
            return make_physics(self.physics_model, self.cfg.sim, self.impl)

    @functools.cached_property
    def mj_model(self) -> mujoco.MjModel:
        """The whole scene with visual shapes, lights and cameras, compiled for MuJoCo (to render or to inspect)."""
        return scene.build(self.cfg.robot, self.cfg.scene, self.cfg.sim)

    @property
    def action_size(self) -> int:
        """One an arm joint and one for the gripper, or one a drive."""
        robot = self.cfg.robot
        return len(robot.joints) if self.cfg.action.absolute else len(robot.arm.joints) + self._acts_on_gripper

    @functools.cached_property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        """Shape of each observation group."""
        state = jax.eval_shape(self.reset, jax.random.PRNGKey(0))
        return {name: value.shape for name, value in state.obs.items()}

    @property
    def backend(self) -> str:
        """Name of the physics backend, as Brax asks for it."""
        return "mujoco" if self.impl == "native" else f"mjx-{self.impl}"

    def reset(self, rng: Key) -> State:
        """A fresh episode: joints at home, object and command drawn anew.

        Args:
            rng: random key of this environment.
        """
        k_draw, k_obs = jax.random.split(rng)
        sim, carry = self.draw(k_draw)
        names = [f"reward/{name}" for name in self.cfg.rewards]
        names += ["success", "distance", "final_distance", "grasped", "grasp_time", "dropped", "nan", "overflow"]
        zero = jnp.zeros(())
        info = {"carry": carry, "count": jnp.zeros((), jnp.int32), "truncation": zero, "steps": zero}
        return State(sim, self.observe(sim, carry, k_obs), zero, zero, dict.fromkeys(names, zero), info)

    def draw(self, rng: Key) -> tuple[Sim, Carry]:
        """The start of an episode, before it is observed."""
        rng, k_command, *k_events = jax.random.split(rng, 2 + len(self.cfg.events))
        joints, cube = jnp.asarray(self.cfg.robot.home), jnp.asarray(self.cfg.object_start)
        for key, event in zip(k_events, self.cfg.events.values(), strict=True):
            joints, cube = event.func(key, joints, cube, **event.params)
        joints = jnp.clip(joints, *self._range)
        qpos, nv = jnp.asarray(self._qpos0).at[self._viewer.qpos_ids].set(joints), self.physics_model.nv
        for follower, leader, offset, ratio in self._coupled:
            qpos = qpos.at[follower].set(offset + ratio * qpos[leader])
        at = self._viewer.object_qpos
        command, command_quat = self._draw_command(k_command)
        sim = Sim(
            qpos=qpos if at is None else qpos.at[at : at + 3].set(cube),
            qvel=jnp.zeros(nv),
            ctrl=qpos[self._viewer.qpos_ids],
            warmstart=jnp.zeros(nv),
            time=jnp.zeros(()),
        )
        carry = Carry(
            rng=rng,
            step=jnp.zeros((), jnp.int32),
            action=jnp.zeros(self.action_size),
            command=command,
            command_quat=command_quat,
            hold=jnp.zeros((), jnp.int32),
            grasp_time=jnp.array(jnp.inf),
        )
        return sim, carry

    def view(self, state: State) -> View:
        """What the terms and the controllers read of a state."""
        carry = state.info["carry"]
        return self._viewer(state.pipeline_state, carry, carry.action)

    def named_observations(self, state: State) -> dict[str, dict[str, Array]]:
        """Each term of each observation group by its name, without noise."""
        view = self.view(state)
        return {name: terms.by_name(group, view) for name, group in self.cfg.observations.items()}

    def goal(self, state: State) -> Float[Array, "7"]:
        """Where the goal is now: position [m] and orientation (wxyz) in the world frame."""
        carry = state.info["carry"]
        return jnp.concatenate([self._viewer.goal(carry)[0], carry.command_quat])

    def observe(self, sim: Sim, carry: Carry, key: Key) -> dict[str, Float[Array, " n"]]:
        """The observation groups; ``key`` draws their noise."""
        return terms.observe(self.cfg.observations, self._viewer(sim, carry, carry.action), key, self.cfg.corruption)

    def step(self, state: State, action: Float[Array, " na"]) -> State:
        """One control step.

        Args:
            state: from ``reset`` or ``step``.
            action: [action_size], unbounded.
        """
        ctrl = self.targets(state, action)
        sim, overflow = self.physics.step(state.pipeline_state, ctrl)
        return self.finish(state, action, sim, overflow)

    def step_and_reset(self, state: State, action: Float[Array, " na"]) -> State:
        """``step``, and where that ends the episode the start of a new one, with fresh draws.

        Reward, done and metrics are the ended episode's; physics, observation and carry the new one's. To cache the first
        state instead would replay one object and goal position per environment for ever.
        """
        ctrl = self.targets(state, action)
        sim, overflow = self.physics.step(state.pipeline_state, ctrl)
        state = self.advance(state, action, sim, overflow)
        rng, k_draw, k_obs = jax.random.split(state.info["carry"].rng, 3)
        old = (state.pipeline_state, state.info["carry"].replace(rng=rng))
        sim, carry = jax.tree.map(lambda new, old: jnp.where(state.done > 0, new, old), self.draw(k_draw), old)
        return state.replace(pipeline_state=sim, obs=self.observe(sim, carry, k_obs), info={**state.info, "carry": carry})

    def targets(self, state: State, action: Float[Array, " na"]) -> Float[Array, " nu"]:
        """The drives' position targets for ``action``: within the joint ranges and the drives' speed limits [rad, m]."""
        action, robot = self._clip(action), self.cfg.robot
        if self.cfg.action.absolute:
            return jnp.clip(action, *self._range)
        joints, gripper = action[: len(robot.arm.joints)], jnp.asarray(robot.gripper.home)
        arm = actions.joint_targets(joints, scale=self.cfg.action.scale, offset=jnp.asarray(robot.arm.home))
        if self._acts_on_gripper:
            open, close = jnp.asarray(robot.gripper.open), jnp.asarray(robot.gripper.close)
            gripper = actions.binary_gripper(action[-1], open=open, close=close)
        target = jnp.clip(jnp.concatenate([arm, gripper]), *self._range)
        return actions.rate_limit(target, state.pipeline_state.ctrl, step=jnp.asarray(self._max_ctrl_step))

    def finish(self, state: State, action: Float[Array, " na"], sim: Sim, overflow: Float[Array, ""]) -> State:
        """The second half of ``step``: what follows from the physics state ``sim``."""
        state = self.advance(state, action, sim, overflow)
        carry = state.info["carry"]
        rng, k_obs = jax.random.split(carry.rng)
        obs = self.observe(state.pipeline_state, carry, k_obs)
        return state.replace(obs=obs, info={**state.info, "carry": carry.replace(rng=rng)})

    def advance(self, state: State, action: Float[Array, " na"], sim: Sim, overflow: Float[Array, ""]) -> State:
        """Rewards, terminations, metrics and carry for the physics state ``sim``; the observation is left as it was."""
        cfg, carry = self.cfg, state.info["carry"]
        action = self._clip(action)
        # A diverged environment stays at its last good state and ends; nothing of the bad one gets any further.
        bad = ~(jnp.all(jnp.abs(sim.qpos) < jnp.inf) & jnp.all(jnp.abs(sim.qvel) < _MAX_SPEED) & jnp.all(jnp.isfinite(action)))
        sim = jax.tree.map(lambda old, new: jnp.where(bad, old, new), state.pipeline_state, sim)
        action = jnp.where(bad, carry.action, action)

        step = carry.step + 1
        count = state.info["count"] + 1
        view = self._viewer(sim, carry.replace(step=step), action)
        reward_terms = terms.rewards(cfg.rewards, cfg.curriculum, view, count, self.dt)
        reward_terms = {name: jnp.where(bad, 0.0, value) for name, value in reward_terms.items()}
        terminated, truncated = terms.terminations(cfg.terminations, view)
        terminated, truncated = terminated | bad, truncated & ~bad
        done = (terminated | truncated).astype(jnp.float32)

        hold = jnp.where(cfg.success.condition.func(view, **cfg.success.condition.params), carry.hold + 1, 0)
        distance = cfg.success.distance.func(view, **cfg.success.distance.params)
        grasp = held(view, minimal_height=cfg.success.minimal_height, grasp_radius=cfg.success.grasp_radius)
        grasp_time = jnp.minimum(carry.grasp_time, jnp.where(grasp, step * self.dt, jnp.inf))
        grasped = jnp.isfinite(grasp_time)
        # Episode results appear at the last step and are 0 before it: a sum over the episode gives them.
        ends = {
            "success": truncated & (hold >= self._hold_steps),
            "final_distance": distance,
            "grasped": grasped,
            "grasp_time": jnp.where(grasped, grasp_time, 0.0),
            "dropped": terminated & ~bad,
        }
        metrics = {f"reward/{name}": value for name, value in reward_terms.items()}
        metrics |= {name: jnp.where(bad, 0.0, value * done) for name, value in ends.items()}
        metrics |= {"distance": jnp.where(bad, 0.0, distance), "nan": bad.astype(jnp.float32), "overflow": overflow}

        carry = carry.replace(step=step, action=action, hold=hold, grasp_time=grasp_time)
        if self._resample_steps < self.episode_length:
            rng, k_command = jax.random.split(carry.rng)
            pos, quat = (
                jnp.where(step % self._resample_steps == 0, new, old)
                for new, old in zip(self._draw_command(k_command), (carry.command, carry.command_quat), strict=True)
            )
            carry = carry.replace(rng=rng, command=pos, command_quat=quat)
        info = {"carry": carry, "count": count, "truncation": truncated.astype(jnp.float32), "steps": step.astype(jnp.float32)}
        return state.replace(
            pipeline_state=sim,
            reward=sum(reward_terms.values()),
            done=done,
            metrics={**state.metrics, **metrics},
            info={**state.info, **info},
        )

    def _draw_command(self, key: Key) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        drawn = self.cfg.command.func(key, **self.cfg.command.params)
        return drawn if isinstance(drawn, tuple) else (drawn, jnp.array([1.0, 0.0, 0.0, 0.0]))

    def _clip(self, action: Float[Array, " na"]) -> Float[Array, " na"]:
        return jnp.clip(action, -self.cfg.action.clip, self.cfg.action.clip) if self.cfg.action.clip else action


def _couplings(model: mujoco.MjModel) -> list[tuple[int, int, float, float]]:
    """(follower, leader, offset, ratio) of the joints that equalities couple linearly: where a linkage starts closed."""
    joint = model.eq_type == mujoco.mjtEq.mjEQ_JOINT
    pairs = zip(model.eq_obj1id[joint], model.eq_obj2id[joint], model.eq_data[joint], strict=True)
    return [(int(model.jnt_qposadr[a]), int(model.jnt_qposadr[b]), float(c[0]), float(c[1])) for a, b, c in pairs]
