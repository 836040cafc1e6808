"""PPO from pictures alone. The policy is distillation's student; the critic observes where the objects are (Pinto et al. 2018).

The critic exists only in training, so the policy needs nothing but its cameras. The convolutions also learn to find the objects.
"""

import dataclasses
from typing import Any

from mjx_nero.sim.quiet import Env

import jax
import jax.numpy as jnp
from brax.training import networks as feed_forward
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses, networks
from brax.training.distribution import NormalDistribution
from flax import linen
from jaxtyping import Array, Float

from mjx_nero import config
from mjx_nero.errors import UserError
from mjx_nero.learn import device_memory
from mjx_nero.learn.learner import Kind, Observation, state_shape
from mjx_nero.learn.pixels import graph
from mjx_nero.learn.pixels.cfg import ENVS, PRESETS, PixelsCfg, differing
from mjx_nero.learn.pixels.networks import (
    SEEN,
    SENSED,
    TRUTH,
    Student,
    apply,
    away,
    from_meta,
    init_variables,
    seen_bytes,
    stored,
)
from mjx_nero.learn.ppo import learner as ppo
from mjx_nero.learn.ppo.cfg import fit
from mjx_nero.types import Key

TOLD = "teacher"  # the critic's observation group: the state with the objects' positions
_NUMBERS = (SENSED, TRUTH, TOLD)  # groups that are measured and normalized
_LOG_STD = "std_logparam"  # where ``ppo`` bounds deviations
_MEMORY = 10  # a policy from a file keeps a tenth of an iteration as the weight of its statistics, since the critic's are new


class Learner(ppo.Learner):
    """PPO whose policy is a ``networks.Student``.

    Args:
        env: batch of environments from ``wrappers.for_training``, with the observation groups of ``tasks.seeing``.
        cfg: hyperparameters, with ``num_envs`` filled in.
        num_devices: number of each machine's devices to use.

    Raises:
        UserError: sizes or options conflict, or the environment has no pictures.
    """

    cfg: PixelsCfg

    def __init__(self, env: Env, cfg: PixelsCfg, num_devices: int = 1):
        if missing := [name for name in (*_NUMBERS, SEEN) if name not in env.observation_size]:
            raise UserError(f"the learner pixels needs the observation groups {', '.join(missing)}: pass --preset rgb")
        if cfg.imitation:
            raise UserError("the learner pixels imitates no expert, whose steps have no pictures: leave out --pixels.imitation")
        if cfg.network.distribution != "normal":
            raise UserError("the learner pixels acts with the normal distribution: leave out --pixels.network.distribution")
        super().__init__(env, cfg, num_devices)

    def make_networks(self) -> networks.PPONetworks:
        """Makes the student, with deviations that it learns, and the critic."""
        cfg, size = self.cfg, self.env.action_size
        self.student = Student(cfg.student, size, self.sizes[TRUTH][0])

        def normalize(obs: Any, statistics: Any) -> Any:
            return running_statistics.normalize(obs, statistics, max_abs_value=cfg.network.max_observation or None)

        def init(key: Key) -> dict[str, Any]:
            log_std = jnp.full(size, jnp.log(cfg.network.init_std))
            return {"params": {_LOG_STD: log_std}, "student": init_variables(self.student, self.sizes, key)}

        def act(statistics: Any, policy: dict[str, Any], obs: Observation) -> tuple[jax.Array, jax.Array]:
            return _with_std(policy, apply(self.student, (statistics, policy["student"]), obs)[0])

        critic = feed_forward.make_value_network(
            {TOLD: self.sizes[TOLD]},
            preprocess_observations_fn=normalize,
            hidden_layer_sizes=cfg.network.critic,
            activation=getattr(linen, cfg.network.activation),
            obs_key=TOLD,
        )
        return networks.PPONetworks(feed_forward.FeedForwardNetwork(init, act), critic, NormalDistribution(size))

    def measured(self, groups: Any) -> dict[str, Any]:
        """See ``ppo.Learner``: pictures have a known range."""
        return {name: groups[name] for name in _NUMBERS}

    def loss(
        self, params: losses.PPONetworkParams, normalizer: Any, batch: ppo.Batch, key: Key
    ) -> tuple[Float[Array, ""], ppo.Metrics]:
        """Adds ``truth_cost`` times the error of the predicted positions to PPO's loss."""
        mean, where = apply(self.student, (normalizer, params.policy["student"]), batch.obs)
        total, metrics = self.loss_of(_with_std(params.policy, mean), params, normalizer, batch, key)
        truth_loss, seen_error = away(where, batch.obs[TRUTH], normalizer)
        return total + self.cfg.truth_cost * truth_loss, {**metrics, "truth_loss": truth_loss, "seen_error": seen_error}

    def _update(self, state: ppo.TrainState, batch: ppo.Batch, key: Key) -> tuple[losses.PPONetworkParams, Any, ppo.Metrics]:
        """Leaves the policy as it was in the first iterations, while the critic learns from its steps."""
        params, opt_state, metrics = super()._update(state, batch, key)
        waits = state.iteration < self.cfg.critic_first
        policy = jax.tree.map(lambda old, new: jnp.where(waits, old, new), state.params.policy, params.policy)
        return params.replace(policy=policy), opt_state, metrics

    update_metrics = (*ppo.Learner.update_metrics, "truth_loss", "seen_error")

    def policy(self, state: ppo.TrainState) -> tuple:
        """Returns the student's statistics and variables."""
        normalizer, params = super().policy(state)
        return _part(normalizer, (SENSED, TRUTH)), params.policy["student"]

    def with_policy(self, state: ppo.TrainState, params: tuple) -> ppo.TrainState:
        """Returns a new state that starts from a student, with the least noise. Its critic is new."""
        given, variables = params
        count = max(1, self.steps_per_iteration // _MEMORY)
        own = state.normalizer
        normalizer = own.replace(
            mean={**own.mean, **given.mean},
            std={**own.std, **given.std},
            summed_variance={name: count * jnp.square(std) for name, std in {**own.std, **given.std}.items()},
            count=own.count.replace(hi=jnp.zeros_like(own.count.hi), lo=jnp.full_like(own.count.lo, count)),
        )
        least = jnp.full_like(state.params.policy["params"][_LOG_STD], jnp.log(self.cfg.min_std or self.cfg.network.init_std))
        policy = {"params": {_LOG_STD: least}, "student": variables}
        return self._averaging(dataclasses.replace(state, normalizer=normalizer, params=state.params.replace(policy=policy)))

    def act(self, params: tuple, obs: Observation) -> jax.Array:
        """Computes the student's action."""
        return apply(self.student, params, obs)[0]

    def describe(self) -> dict[str, Any]:
        """Describes the student for the policy's file."""
        return {"student": config.to_dict(self.cfg.student)}

    def footprint(self) -> tuple[float, float]:
        """See ``learner.Learner``. A rollout keeps pictures; an update keeps the convolutions' outputs for the gradient."""
        cfg, env = self.cfg, self.env.unwrapped
        state = state_shape(self)
        own, seen = device_memory.size(state.env_state), seen_bytes(cfg.student, self.sizes[SEEN])
        step = device_memory.size(state.env_state.obs) / cfg.num_envs + 4 * (3 * self.env.action_size + 7)
        updated = cfg.unroll_length * (step + 3 * seen) / cfg.num_minibatches
        rollout = max(env.physics.footprint(self.num_devices).in_program, 2 * seen)
        return 2.0 * (device_memory.size(state) - own), own / cfg.num_envs + 1.1 * cfg.unroll_length * step + max(
            rollout, updated
        )


def _with_std(policy: dict[str, Any], mean: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the parameters of the action distribution."""
    return mean, jnp.broadcast_to(jnp.exp(policy["params"][_LOG_STD]), mean.shape)


def _part(normalizer: Any, names: tuple[str, ...]) -> Any:
    """Returns the statistics of some groups."""
    kept = {field: {name: getattr(normalizer, field)[name] for name in names} for field in ("mean", "std", "summed_variance")}
    return normalizer.replace(**kept)


_PACE = "with two cameras of 32 x 32 pixels an NVIDIA H100 makes 10 M steps of 4,096 environments in a minute"
_HELD = {"[0]": ".normalizer", "[1]": ".params.policy['student']"}

KIND = Kind(
    make=Learner,
    presets=PRESETS,
    policy=from_meta,
    stored=stored,
    envs=ENVS,
    pace=_PACE,
    fit=fit,
    held=_HELD,
    differing=differing,
    graph=graph,
)
