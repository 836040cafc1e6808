"""PPO from Brax's building blocks: its loss, networks, running statistics and adaptive learning rate, in a loop of our own.

Brax's own ``ppo.train`` keeps optimiser, environments and random keys to itself, so a run cannot be resumed exactly, reports
no training episodes without a host callback at every step, and in release 0.14.2 calls a function that JAX 0.10 removed.
This loop hands its whole state to the caller, is compiled ahead of time (compilation is timed apart), and the algorithm stays Brax's.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import optax
from brax.envs.base import Env, State
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses, networks, optimizer
from brax.training.types import Transition
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

    def __post_init__(self):
        if self.num_envs % self.num_minibatches:
            raise UserError(f"ppo.num_envs ({self.num_envs}) must be a multiple of ppo.num_minibatches ({self.num_minibatches})")


PRESETS = {
    "default": PpoCfg(),
    # The Isaac Lab recipe's runner settings (RSL-RL), word for word.
    "isaac": PpoCfg(num_minibatches=4, learning_rate=1e-4, desired_kl=0.01, entropy_cost=0.006),
}


def preset(name: str) -> PpoCfg:
    """The hyperparameters that go with an environment's preset."""
    return PRESETS.get(name, PRESETS["default"])


@struct.dataclass
class TrainState:
    """All of a run: saved and loaded as it is, training goes on bit for bit."""

    normalizer: running_statistics.RunningStatisticsState
    params: losses.PPONetworkParams
    opt_state: optax.OptState
    env_state: State
    key: Key
    iteration: Int[Array, ""]


class Learner:
    """PPO on a batch of environments.

    Args:
        env: from ``wrappers.for_training``.
        cfg: with ``num_envs`` filled in.
    """

    def __init__(self, env: Env, cfg: PpoCfg):
        self.env, self.cfg = env, cfg
        self.sizes = env.observation_size
        self.networks = make_networks(self.sizes, env.action_size, cfg.network)
        self.steps_per_iteration = cfg.num_envs * cfg.unroll_length
        adam = optax.inject_hyperparams(optax.adam)(learning_rate=cfg.learning_rate)
        self._optimizer = optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), adam)
        clip_value = cfg.clip_value or None
        self._make_policy = networks.make_inference_fn(self.networks, compute_value=clip_value is not None)
        self._loss = functools.partial(
            losses.compute_ppo_loss,
            ppo_network=self.networks,
            entropy_cost=cfg.entropy_cost,
            discounting=cfg.discounting,
            reward_scaling=cfg.reward_scaling,
            gae_lambda=cfg.gae_lambda,
            clipping_epsilon=cfg.clipping,
            vf_coefficient=cfg.value_loss,
            clipping_epsilon_value=clip_value,
        )

    def init(self, key: Key) -> TrainState:
        """Fresh networks and environments, the latter spread over their episodes so that they don't all end at once."""
        k_net, k_env, k_phase, key = jax.random.split(key, 4)
        normalizer, params = init_params(self.networks, self.sizes, k_net)
        env_state = self.env.reset(jax.random.split(k_env, self.cfg.num_envs))
        carry = env_state.info["carry"]
        phase = jax.random.randint(k_phase, carry.step.shape, 0, self.env.unwrapped.episode_length)  # type: ignore[attr-defined]
        env_state = env_state.replace(info={**env_state.info, "carry": carry.replace(step=phase)})
        opt_state = self._optimizer.init(params)  # type: ignore[arg-type]
        return TrainState(normalizer, params, opt_state, env_state, key, jnp.zeros((), jnp.int32))

    def run(self, state: TrainState, iterations: int) -> tuple[TrainState, Metrics]:
        """``iterations`` of rollout and update; metrics are means over them. Jit with ``iterations`` static, donate ``state``."""
        with jax.default_matmul_precision(self.cfg.matmul_precision):
            state, metrics = jax.lax.scan(lambda s, _: self._iterate(s), state, length=iterations)
        return state, {name: jnp.mean(value) for name, value in metrics.items()}

    def _iterate(self, state: TrainState) -> tuple[TrainState, Metrics]:
        key, k_roll, k_update = jax.random.split(state.key, 3)
        env_state, data, episodes = self._rollout(state, k_roll)
        params, opt_state, metrics = self._update(state, data, k_update)
        # After the update: the loss compares with log-probabilities made under the statistics that acted.
        normalizer = running_statistics.update(state.normalizer, data.observation)
        state = TrainState(normalizer, params, opt_state, env_state, key, state.iteration + 1)
        return state, {**episodes, **metrics}

    def _rollout(self, state: TrainState, key: Key) -> tuple[State, Transition, Metrics]:
        """Acts for ``unroll_length`` steps. Data leaves are [time, env, ...]."""
        policy = self._make_policy((state.normalizer, state.params.policy, state.params.value))

        def act(env_state: State, key: Key):
            action, extras = policy(env_state.obs, key)
            after = self.env.step(env_state, action)
            data = Transition(
                observation=env_state.obs,
                action=action,
                reward=after.reward,
                discount=1.0 - after.done,
                next_observation=(),
                extras={"policy_extras": extras, "state_extras": {"truncation": after.info["truncation"]}},
            )
            sums = {name: jnp.sum(value) for name, value in after.metrics.items()}
            return after, (data, {**sums, "reward": jnp.sum(after.reward), "episodes": jnp.sum(after.done)})

        env_state, (data, sums) = jax.lax.scan(act, state.env_state, jax.random.split(key, self.cfg.unroll_length))
        # The loss reads the last observation alone, to bootstrap from.
        data = data._replace(next_observation=jax.tree.map(lambda x: x[None], env_state.obs))
        return env_state, data, {f"sum/{name}": jnp.sum(value) for name, value in sums.items()}

    def _update(self, state: TrainState, data: Transition, key: Key) -> tuple[losses.PPONetworkParams, optax.OptState, Metrics]:
        cfg = self.cfg

        def minibatch(carry, envs_and_key):
            params, opt_state = carry
            envs, key = envs_and_key
            batch = jax.tree.map(lambda x: jnp.swapaxes(x[:, envs], 0, 1), data)
            grads, metrics = jax.grad(self._loss, has_aux=True)(params, state.normalizer, batch, key)
            if cfg.desired_kl:
                opt_state, _ = optimizer.adaptive_kl_learning_rate(
                    opt_state, metrics["kl_mean"], cfg.desired_kl, cfg.min_learning_rate, cfg.max_learning_rate
                )
            metrics["learning_rate"] = opt_state[-1].hyperparams["learning_rate"]  # type: ignore[index]
            updates, opt_state = self._optimizer.update(grads, opt_state)
            return (optax.apply_updates(params, updates), opt_state), metrics

        def epoch(carry, key):
            k_order, k_loss = jax.random.split(key)
            order = jax.random.permutation(k_order, cfg.num_envs).reshape(cfg.num_minibatches, -1)
            return jax.lax.scan(minibatch, carry, (order, jax.random.split(k_loss, cfg.num_minibatches)))

        start = (state.params, state.opt_state)
        (params, opt_state), metrics = jax.lax.scan(epoch, start, jax.random.split(key, cfg.num_epochs))
        return params, opt_state, {name: jnp.mean(value) for name, value in metrics.items()}
