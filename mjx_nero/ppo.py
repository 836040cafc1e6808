"""PPO from Brax's building blocks: networks, advantages, running statistics and adaptive learning rate, in a loop of our own.

Brax's own ``ppo.train`` keeps optimiser, environments and random keys to itself, so a run cannot be resumed exactly, reports
no training episodes without a host callback at every step, and in release 0.14.2 calls a function that JAX 0.10 removed.
This loop hands its whole state to the caller and is compiled ahead of time, so compilation is timed apart.

The loss is Brax's ``compute_ppo_loss`` but for one thing: advantages are computed once an iteration, as in RSL-RL, not anew in
each of its forty minibatches, as their loop over time is slow on a GPU. At the first minibatch both agree (tests/test_ppo.py).
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import optax
from brax.envs.base import Env, State
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses, networks, optimizer
from flax import struct
from jaxtyping import Array, Float, Int

from mjx_nero.policy import NetworkCfg, init_params, make_networks
from mjx_nero.types import Key, UserError

Metrics = dict[str, Float[Array, ""]]


@dataclasses.dataclass(frozen=True)
class PpoCfg:
    """Hyperparameters. ``num_envs`` and ``num_timesteps`` 0: chosen for the machine."""

    num_envs: int = 0
    num_timesteps: int = 0
    unroll_length: int = 24  # control steps of every environment an iteration
    num_epochs: int = 5
    num_minibatches: int = 8
    learning_rate: float = 3e-4
    desired_kl: float = 0.02  # adapts the learning rate; 0 keeps it fixed
    min_learning_rate: float = 1e-5
    max_learning_rate: float = 1e-2
    discounting: float = 0.98
    gae_lambda: float = 0.95
    clipping: float = 0.2
    clip_value: float = 0.2  # bound on the change of a value estimate; 0: none
    entropy_cost: float = 0.003
    value_loss: float = 1.0
    max_grad_norm: float = 1.0
    reward_scaling: float = 1.0
    matmul_precision: str = "float32"  # of the networks; TF32 products can spoil learning
    network: NetworkCfg = NetworkCfg()


PRESETS = {  # by the environment's preset
    "default": PpoCfg(),
    # The Isaac Lab recipe's runner settings (RSL-RL), word for word.
    "isaac": PpoCfg(num_minibatches=4, learning_rate=1e-4, desired_kl=0.01, entropy_cost=0.006),
}


@struct.dataclass
class TrainState:
    """All of a run: saved and loaded as it is, training goes on bit for bit."""

    normalizer: running_statistics.RunningStatisticsState
    params: losses.PPONetworkParams
    opt_state: optax.OptState
    env_state: State
    key: Key
    iteration: Int[Array, ""]


@struct.dataclass
class Batch:
    """What an update learns from. Leaves are [time, env, ...], or any part of that."""

    obs: dict[str, jax.Array]
    raw_action: jax.Array  # before the distribution's squashing, if it has one
    log_prob: jax.Array
    distribution: Any  # parameters of the distribution that acted
    value: jax.Array
    returns: jax.Array
    advantages: jax.Array


class Learner:
    """PPO on a batch of environments.

    Args:
        env: from ``wrappers.for_training``.
        cfg: with ``num_envs`` filled in.

    Raises:
        UserError: sizes or options that do not go together.
    """

    def __init__(self, env: Env, cfg: PpoCfg):
        if not cfg.num_envs or cfg.num_envs % cfg.num_minibatches:
            raise UserError(f"num_envs ({cfg.num_envs}) must be a multiple of ppo.num_minibatches ({cfg.num_minibatches})")
        if cfg.desired_kl and cfg.network.distribution != "normal":
            raise UserError("an adaptive learning rate needs the normal distribution: pass --ppo.desired_kl 0")
        self.env, self.cfg = env, cfg
        self.sizes = env.observation_size
        self.networks = make_networks(self.sizes, env.action_size, cfg.network)
        self.steps_per_iteration = cfg.num_envs * cfg.unroll_length
        adam = optax.inject_hyperparams(optax.adam)(learning_rate=cfg.learning_rate)
        self._optimizer = optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), adam)
        self._make_policy = networks.make_inference_fn(self.networks, compute_value=True)

    def init(self, key: Key) -> TrainState:
        """Fresh networks and environments, the latter spread over their episodes so that they don't all end at once."""
        k_net, k_env, k_phase, key = jax.random.split(key, 4)
        normalizer, params = init_params(self.networks, self.sizes, k_net)
        env_state = self.env.reset(jax.random.split(k_env, self.cfg.num_envs))
        carry = env_state.info["carry"]
        phase = jax.random.randint(k_phase, carry.step.shape, 0, self.env.unwrapped.episode_length)
        env_state = env_state.replace(info={**env_state.info, "carry": carry.replace(step=phase)})
        opt_state = self._optimizer.init(params)
        return TrainState(normalizer, params, opt_state, env_state, key, jnp.zeros((), jnp.int32))

    def run(self, state: TrainState, iterations: int) -> tuple[TrainState, Metrics]:
        """``iterations`` of rollout and update; metrics are means over them. Jit with ``iterations`` static, donate ``state``."""
        with jax.default_matmul_precision(self.cfg.matmul_precision):
            state, metrics = jax.lax.scan(lambda s, _: self._iterate(s), state, length=iterations)
        return state, {name: jnp.mean(value) for name, value in metrics.items()}

    def _iterate(self, state: TrainState) -> tuple[TrainState, Metrics]:
        key, k_roll, k_update = jax.random.split(state.key, 3)
        env_state, batch, episodes = self.rollout(state, k_roll)
        params, opt_state, metrics = self._update(state, batch, k_update)
        # After the update: the loss compares with log-probabilities made under the statistics that acted.
        normalizer = running_statistics.update(state.normalizer, batch.obs)
        state = TrainState(normalizer, params, opt_state, env_state, key, state.iteration + 1)
        return state, {**episodes, **metrics}

    def rollout(self, state: TrainState, key: Key) -> tuple[State, Batch, Metrics]:
        """Acts for ``unroll_length`` steps in every environment and computes returns and advantages.

        Returns:
            the environments, the batch (leaves [time, env, ...]), and sums of the environments' metrics over it.
        """
        cfg = self.cfg
        policy = self._make_policy((state.normalizer, state.params.policy, state.params.value))

        def act(env_state: State, key: Key):
            action, extras = policy(env_state.obs, key)
            after = self.env.step(env_state, action)
            sums = {name: jnp.sum(value) for name, value in after.metrics.items()}
            sums |= {"reward": jnp.sum(after.reward), "episodes": jnp.sum(after.done)}
            return after, (env_state.obs, extras, after.reward, after.done, after.info["truncation"], sums)

        keys = jax.random.split(key, cfg.unroll_length)
        env_state, (obs, extras, reward, done, truncation, sums) = jax.lax.scan(act, state.env_state, keys)
        last = self.networks.value_network.apply(state.normalizer, state.params.value, env_state.obs)
        returns, advantages = losses.compute_gae(
            truncation=truncation,
            termination=done * (1 - truncation),
            rewards=reward * cfg.reward_scaling,
            values=extras["value"],
            bootstrap_value=last,
            lambda_=cfg.gae_lambda,
            discount=cfg.discounting,
        )
        batch = Batch(
            obs, extras["raw_action"], extras["log_prob"], extras["distribution_params"], extras["value"], returns, advantages
        )
        return env_state, batch, {f"sum/{name}": jnp.sum(value) for name, value in sums.items()}

    def loss(
        self, params: losses.PPONetworkParams, normalizer: running_statistics.RunningStatisticsState, batch: Batch, key: Key
    ) -> tuple[Float[Array, ""], Metrics]:
        """Clipped surrogate, clipped value loss and entropy bonus. Schulman et al. 2017; the value's clipping as in RSL-RL."""
        cfg, nets = self.cfg, self.networks
        dist = nets.parametric_action_distribution
        logits = nets.policy_network.apply(normalizer, params.policy, batch.obs)
        value = nets.value_network.apply(normalizer, params.value, batch.obs)

        advantages = (batch.advantages - jnp.mean(batch.advantages)) / (jnp.std(batch.advantages) + 1e-8)
        ratio = jnp.exp(dist.log_prob(logits, batch.raw_action) - batch.log_prob)
        clipped = jnp.clip(ratio, 1 - cfg.clipping, 1 + cfg.clipping)
        policy_loss = -jnp.mean(jnp.minimum(ratio * advantages, clipped * advantages))

        error = jnp.square(batch.returns - value)
        if cfg.clip_value:
            near = batch.value + jnp.clip(value - batch.value, -cfg.clip_value, cfg.clip_value)
            error = jnp.maximum(error, jnp.square(batch.returns - near))
        value_loss = 0.5 * cfg.value_loss * jnp.mean(error)

        entropy = jnp.mean(dist.entropy(logits, key))
        new, old = dist.create_dist(logits), dist.create_dist(batch.distribution)
        kl = jnp.mean(new.kl_divergence(old)) if hasattr(new, "kl_divergence") else jnp.zeros(())
        total = policy_loss + value_loss - cfg.entropy_cost * entropy
        metrics = {"loss": total, "policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy, "kl": kl}
        return total, {**metrics, "action_std": jnp.mean(new.scale)}

    def _update(self, state: TrainState, batch: Batch, key: Key) -> tuple[losses.PPONetworkParams, optax.OptState, Metrics]:
        cfg = self.cfg

        def minibatch(carry, envs_and_key):
            params, opt_state = carry
            envs, key = envs_and_key
            part = jax.tree.map(lambda x: x[:, envs], batch)
            grads, metrics = jax.grad(self.loss, has_aux=True)(params, state.normalizer, part, key)
            if cfg.desired_kl:
                opt_state, _ = optimizer.adaptive_kl_learning_rate(
                    opt_state, metrics["kl"], cfg.desired_kl, cfg.min_learning_rate, cfg.max_learning_rate
                )
            metrics["learning_rate"] = opt_state[-1].hyperparams["learning_rate"]
            updates, opt_state = self._optimizer.update(grads, opt_state)
            return (optax.apply_updates(params, updates), opt_state), metrics

        def epoch(carry, key):
            k_order, k_loss = jax.random.split(key)
            order = jax.random.permutation(k_order, cfg.num_envs).reshape(cfg.num_minibatches, -1)
            return jax.lax.scan(minibatch, carry, (order, jax.random.split(k_loss, cfg.num_minibatches)))

        start = (state.params, state.opt_state)
        (params, opt_state), metrics = jax.lax.scan(epoch, start, jax.random.split(key, cfg.num_epochs))
        return params, opt_state, {name: jnp.mean(value) for name, value in metrics.items()}
