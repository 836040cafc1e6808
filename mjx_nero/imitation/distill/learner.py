"""Distillation on the student's own states (DAgger: Ross, Gordon and Bagnell 2011), all in one compiled program.

The student acts in nearly all environments. The teacher labels every step with its own action, and the student learns the labels
from its sensors and cameras. Object positions are a second target, predicted from the same features. Pictures are drawn within
the step and kept for one iteration.

Read it from top to bottom.
"""

import dataclasses
import math
from typing import Any

from mjx_nero.sim.quiet import Env, State

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from flax import struct
from jaxtyping import Array, Float, Int

from mjx_nero import config
from mjx_nero.envs import wrappers
from mjx_nero.errors import UserError
from mjx_nero.imitation.distill import teachers
from mjx_nero.imitation.distill.cfg import PRESETS, DistillCfg
from mjx_nero.learn import device_memory, learner
from mjx_nero.learn.learner import HELD, Kind, Observation, repeated
from mjx_nero.learn.pixels import graph
from mjx_nero.learn.pixels.cfg import ENVS, differing
from mjx_nero.learn.pixels.networks import SEEN, SENSED, TRUTH, Student, apply, away, from_meta, init_params, seen_bytes, stored
from mjx_nero.types import Bank, Key, Shown

Metrics = dict[str, Float[Array, ""]]
_METRICS = ("loss", "action_loss", "truth_loss", "seen_error")


@struct.dataclass
class TrainState:
    """The whole state of a run. Training that resumes from a saved state continues bit for bit."""

    normalizer: running_statistics.RunningStatisticsState
    params: Any
    opt_state: optax.OptState
    env_state: State
    key: Key
    iteration: Int[Array, ""]
    pace: Float[Array, ""]  # factor of the learning rate, below 1 once a run has diverged


@struct.dataclass
class Batch:
    """The data of an update. Leaves are [step, ...]."""

    obs: dict[str, Any]  # the student's observations, and the truth
    label: jax.Array


class Learner(learner.Learner):
    """A student on a batch of environments.

    Args:
        env: batch of environments from ``wrappers.for_training``, with the observation groups of ``tasks.seeing``.
        cfg: hyperparameters, with ``num_envs`` filled in.
        num_devices: must be one.

    Raises:
        UserError: sizes conflict, there are several devices, or no policy can teach.
    """

    def __init__(self, env: Env, cfg: DistillCfg, num_devices: int = 1):
        if num_devices > 1:
            raise UserError(f"the learner distill learns on one device, got {num_devices}: leave out --num-devices")
        self.env, self.cfg, self.num_envs, self.num_devices = env, cfg, cfg.num_envs, 1
        self.sizes = env.observation_size
        if missing := [name for name in (SENSED, SEEN, TRUTH) if name not in self.sizes]:
            raise UserError(f"distillation needs the observation groups {', '.join(missing)}: pass --preset rgb")
        self._teacher = teachers.find(env.unwrapped, cfg.teacher)
        self.steps_per_iteration = cfg.num_envs * cfg.unroll_length
        self._minibatches = 1 << max(0, (self.steps_per_iteration // cfg.minibatch_size).bit_length() - 1)
        self.divisor = self._minibatches // math.gcd(self._minibatches, cfg.unroll_length)
        if not cfg.num_envs or cfg.num_envs % self.divisor:
            raise UserError(f"num_envs ({cfg.num_envs}) must be a multiple of {self.divisor}, because of distill.minibatch_size")
        self.network = Student(cfg.student, env.action_size, self.sizes[TRUTH][0])
        adam = optax.inject_hyperparams(optax.adam)(learning_rate=cfg.learning_rate)
        self._optimizer = optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), adam)

    def init(self, key: Key, bank: Bank | None = None, shown: Shown | None = None) -> TrainState:
        """Makes a new student and environments. Episodes start at different phases, so that they do not all end at once."""
        k_net, k_env, k_phase, key = jax.random.split(key, 4)
        normalizer, params = init_params(self.network, self.sizes, k_net)
        env_state = wrappers.begun(self.env, k_env, k_phase, self.num_envs, bank)
        state = TrainState(
            normalizer, params, self._optimizer.init(params), env_state, key, jnp.zeros((), jnp.int32), jnp.ones(())
        )
        return jax.tree.map(lambda x: jnp.asarray(x, x.dtype), state)  # strongly typed, like what ``run`` returns

    def slower(self, state: TrainState) -> TrainState:
        """Returns the state with a tenth of the learning rate, and other random draws."""
        return dataclasses.replace(state, pace=0.1 * state.pace, key=jax.random.fold_in(state.key, 1))

    def act(self, params: tuple[Any, Any], obs: Observation) -> jax.Array:
        """Computes the student's action."""
        return apply(self.network, params, obs)[0]

    def describe(self) -> dict[str, Any]:
        """Describes the student for the policy's file."""
        return {"student": config.to_dict(self.cfg.student)}

    def footprint(self) -> tuple[float, float]:
        """See ``learner.Learner``. A rollout keeps pictures; an update keeps the convolutions' outputs for the gradient."""
        cfg, env = self.cfg, self.env.unwrapped
        state = learner.state_shape(self)
        own, seen = device_memory.size(state.env_state), seen_bytes(cfg.student, self.sizes[SEEN])
        obs = device_memory.size({name: state.env_state.obs[name] for name in (SENSED, SEEN, TRUTH)}) / cfg.num_envs
        fixed = 2.0 * (device_memory.size(state) - own) + 3 * self.steps_per_iteration / self._minibatches * seen
        acting = max(env.physics.footprint().in_program, 2 * seen)
        return fixed, own / cfg.num_envs + 1.1 * cfg.unroll_length * (obs + 8 * env.action_size) + acting

    def run(self, state: TrainState, iterations: int) -> tuple[TrainState, Metrics]:
        """Makes ``iterations`` rollouts and updates; metrics are means over them.

        Jit with static ``iterations``, and donate ``state``.
        """
        return repeated(self._iterate, state, iterations)

    def _iterate(self, state: TrainState) -> tuple[TrainState, Metrics]:
        key, k_roll, k_update = jax.random.split(state.key, 3)
        env_state, batch, sums = self.rollout(state, k_roll)
        # Updated before the networks, because the first update would otherwise have no measured units.
        normalizer = running_statistics.update(state.normalizer, {name: batch.obs[name] for name in (SENSED, TRUTH)})
        state = dataclasses.replace(state, normalizer=normalizer)
        params, opt_state, metrics = self._update(state, batch, k_update)
        state = TrainState(normalizer, params, opt_state, env_state, key, state.iteration + 1, state.pace)
        return state, {**sums, **metrics}

    def _rate(self, state: TrainState) -> Float[Array, ""]:
        done = state.iteration * self.steps_per_iteration / max(1, self.cfg.num_timesteps)
        left = jnp.where(self.cfg.num_timesteps > 0, jnp.clip(1.0 - done, 0.0, 1.0), 1.0)
        return self.cfg.learning_rate * state.pace * (self.cfg.last_rate + (1.0 - self.cfg.last_rate) * left)

    def rollout(self, state: TrainState, key: Key) -> tuple[State, Batch, Metrics]:
        """Acts for ``unroll_length`` steps in every environment, labelled by the teacher.

        Returns:
            the environments, the batch (leaves [time * env, ...]), and sums of the environments' metrics over it.
        """
        cfg, following = self.cfg, self.env.following(state.env_state)
        begun = jnp.minimum(1.0, state.iteration / max(1, cfg.teacher_first))
        share = 1.0 - begun * (1.0 - cfg.teacher_share)
        shown = (jnp.arange(self.num_envs) < share * self.num_envs)[:, None]

        def act(carry: tuple[State, Metrics], key: Key):
            env_state, totals = carry
            obs = {name: env_state.obs[name] for name in (SENSED, SEEN, TRUTH)}
            label = self._teacher.act({"state": env_state.obs[teachers.GROUP]})
            own = self.act((state.normalizer, state.params), obs)
            own += cfg.noise * jax.random.normal(key, own.shape)
            after = self.env.step(env_state, jnp.where(shown, label, own), following)
            figures = {**after.metrics, "reward": after.reward, "episodes": after.done}
            return (after, jax.tree.map(jnp.add, totals, figures)), Batch(obs, label)

        zeros = {**state.env_state.metrics, "reward": 0.0, "episodes": 0.0}
        totals = {name: jnp.zeros(self.num_envs) for name in zeros}
        keys = jax.random.split(key, cfg.unroll_length)
        (env_state, totals), batch = jax.lax.scan(act, (state.env_state, totals), keys)
        batch = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), batch)
        return env_state, batch, {f"sum/{name}": jnp.sum(value) for name, value in totals.items()}

    def loss(self, params: Any, normalizer: Any, batch: Batch) -> tuple[Float[Array, ""], Metrics]:
        """Computes the squared error of the actions, plus ``truth_cost`` times that of the truth in units of its deviation."""
        action, where = apply(self.network, (normalizer, params), batch.obs)
        wanted = jnp.clip(batch.label, -self.cfg.max_action, self.cfg.max_action)
        action_loss, (truth_loss, seen_error) = jnp.mean(jnp.square(action - wanted)), away(where, batch.obs[TRUTH], normalizer)
        total = action_loss + self.cfg.truth_cost * truth_loss
        return total, dict(zip(_METRICS, (total, action_loss, truth_loss, seen_error), strict=True))

    def _update(self, state: TrainState, batch: Batch, key: Key) -> tuple[Any, optax.OptState, Metrics]:
        def minibatch(carry, rows):
            params, opt_state = carry
            part = jax.tree.map(lambda x: x[rows], batch)
            with jax.default_matmul_precision("tensorfloat32"):
                (_, metrics), grads = jax.value_and_grad(self.loss, has_aux=True)(params, state.normalizer, part)
            updates, opt_state = self._optimizer.update(grads, opt_state)
            return (optax.apply_updates(params, updates), opt_state), metrics

        clip, adam = state.opt_state
        adam = adam._replace(hyperparams={**adam.hyperparams, "learning_rate": self._rate(state)})
        count, epochs = self.steps_per_iteration, self.cfg.num_epochs
        orders = jax.vmap(lambda k: jax.random.permutation(k, count))(jax.random.split(key, epochs))
        orders = orders.reshape(epochs * self._minibatches, -1)
        (params, opt_state), metrics = jax.lax.scan(minibatch, (state.params, (clip, adam)), orders)
        return params, opt_state, {name: jnp.mean(value) for name, value in metrics.items()}


_PACE = "with two cameras an NVIDIA H100 makes 6 M steps of 4,096 environments in a minute, two CPU cores about 100 per second"

KIND = Kind(
    make=Learner,
    presets=PRESETS,
    policy=from_meta,
    stored=stored,
    envs=ENVS,
    pace=_PACE,
    held=HELD,
    differing=differing,
    graph=graph,
)
