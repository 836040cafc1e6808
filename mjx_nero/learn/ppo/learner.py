"""PPO in our own loop, built from Brax's networks, advantages, running statistics and adaptive learning rate.

Brax's ``ppo.train`` hides its optimiser, environments and random keys, so a run cannot resume exactly. It reports training
episodes only through a host callback at every step, and release 0.14.2 calls a function that JAX 0.10 removed. This loop hands
its whole state to the caller, and is compiled ahead of time, so that compilation is timed separately.

The loss is Brax's ``compute_ppo_loss`` with one difference: advantages are computed once per iteration, as in RSL-RL, and not
again in each minibatch, because that loop over time is slow on a GPU. At the first minibatch both agree
(tests/learn/test_ppo.py).

The learner is in one file, longer than others, so that it reads from top to bottom.

Nothing depends on a task's scale or can grow without bound: the critic learns returns in units of their running deviation,
advantages are normalized, and the policy's deviations and the normalized observations are bounded.

Each of several devices gets an equal share of the environments and of every minibatch, and a copy of everything else. Sums and
means run over all devices, so their number changes only which environments share a minibatch, and the noise of the actions. A run
that starts on several devices uses minibatches larger by that factor (``cfg.fit``), since half an update does not take half the
time, and keeps them on any number of devices later.
"""

import dataclasses
import functools
import itertools
import math
from typing import Any, TypeVar

from mjx_nero.sim.quiet import Env, State

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, networks, optimizer
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Int

from mjx_nero import config
from mjx_nero.envs import wrappers
from mjx_nero.errors import UserError
from mjx_nero.learn import device_memory, learner, machines, products
from mjx_nero.learn.learner import HELD, Kind, Observation, Part, repeated, state_shape
from mjx_nero.learn.ppo import imitation
from mjx_nero.learn.ppo.cfg import PRESETS as PRESETS
from mjx_nero.learn.ppo.cfg import PpoCfg as PpoCfg
from mjx_nero.learn.ppo.cfg import differing, fit
from mjx_nero.learn.ppo.networks import from_meta, init_params, make_act, make_networks, shapes
from mjx_nero.types import Bank, Key, Shown

Metrics = dict[str, Float[Array, ""]]
Tree = TypeVar("Tree")

_AXIS = "devices"
UPDATE_METRICS = ("loss", "policy_loss", "value_loss", "entropy", "kl", "action_change", "action_std", "learning_rate")


@struct.dataclass
class TrainState:
    """The whole state of a run. Training that resumes from a saved state continues bit for bit."""

    normalizer: running_statistics.RunningStatisticsState
    params: losses.PPONetworkParams
    opt_state: optax.OptState
    env_state: State
    key: Key
    iteration: Int[Array, ""]
    returns: running_statistics.RunningStatisticsState  # statistics of all returns so far: the critic's unit
    school: imitation.School | None = None  # an expert's demonstrations; None: nothing is imitated
    acting: Any = None  # the newest policy, which learns, if ``params`` holds a running mean of it (``PpoCfg.averaging``)


_HERE: Any = PartitionSpec()
_SPREAD: Any = PartitionSpec(_AXIS)
_SPECS = TrainState(_HERE, _HERE, _HERE, _SPREAD, _HERE, _HERE, _HERE, _HERE, _HERE)


@struct.dataclass
class Batch:
    """The data of an update. Leaves are [time, env, ...], or any part of that."""

    obs: dict[str, jax.Array]
    raw_action: jax.Array  # before any squashing by the distribution
    log_prob: jax.Array
    distribution: Any  # parameters of the acting distribution
    last_mean: jax.Array  # mean of the previous step's distribution; at the start of an episode, this step's
    value: jax.Array  # the critic's output, in units of ``TrainState.returns``
    returns: jax.Array  # in the same units
    advantages: jax.Array


class Learner(learner.Learner):
    """PPO on a batch of environments.

    Args:
        env: batch of environments, from ``wrappers.for_training``.
        cfg: hyperparameters, with ``num_envs`` filled in for all devices together.
        num_devices: number of each machine's devices to use.

    Raises:
        UserError: sizes or options conflict, or the machine has fewer devices.
    """

    update_metrics: tuple[str, ...] = UPDATE_METRICS

    def __init__(self, env: Env, cfg: PpoCfg, num_devices: int = 1):
        here = jax.local_devices()
        if num_devices > len(here):
            raise UserError(f"num_devices is {num_devices}, but JAX finds {len(here)} here ({here[0].platform})")
        devices = machines.devices(num_devices)
        num_devices = len(devices)
        cfg = fit(cfg, num_devices)  # a run's config is fitted already
        cfg = dataclasses.replace(cfg, num_minibatches=cfg.num_minibatches or _minibatches(cfg))
        parts = num_devices * cfg.num_minibatches
        if not cfg.num_envs or cfg.num_envs % parts:
            factors = f"ppo.num_minibatches ({cfg.num_minibatches})"
            factors += f" x num_devices ({num_devices}) = {parts}" if num_devices > 1 else ""
            raise UserError(f"num_envs ({cfg.num_envs}) must be a multiple of {factors}")
        if cfg.desired_kl and cfg.network.distribution != "normal":
            raise UserError("an adaptive learning rate needs the normal distribution: pass --ppo.desired_kl 0")
        if cfg.max_std and cfg.min_std > cfg.max_std:
            raise UserError(f"ppo.min_std ({cfg.min_std:g}) is above ppo.max_std ({cfg.max_std:g})")
        self.env, self.cfg, self.num_envs = env, cfg, cfg.num_envs
        self.num_devices, self.divisor = num_devices, parts
        self.imitates, self.demonstrations = cfg.imitation > 0, cfg.demonstrations
        self._axis = _AXIS if num_devices > 1 else None  # None: a program without any communication
        self._mesh = Mesh(np.array(devices), (_AXIS,))
        self.sizes = env.observation_size
        self.networks = self.make_networks()
        self.steps_per_iteration = cfg.num_envs * cfg.unroll_length
        adam = optax.inject_hyperparams(optax.adam)(learning_rate=cfg.learning_rate)
        # One flat vector: separate parameters would cost a hundred small kernels per minibatch.
        self._optimizer = optax.flatten(optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), adam))
        self._make_policy = networks.make_inference_fn(self.networks)

    def make_networks(self) -> networks.PPONetworks:
        """Makes actor and critic. A learner that differs in them overrides it.

        Raises:
            UserError: the task's policies see, and these would not.
        """
        if "pictures" in self.sizes:
            raise UserError("the learner ppo reads no pictures: pass --learner pixels, or leave out --learner to have a teacher")
        return make_networks(self.sizes, self.env.action_size, self.cfg.network)

    def measured(self, groups: Any) -> Any:
        """Returns those of the observation groups, or of their shapes, that are measured and normalized: all."""
        return groups

    def init(self, key: Key, bank: Bank | None = None, shown: Shown | None = None) -> TrainState:
        """Makes new networks and environments. Episodes start at different phases, so that they do not all end at once."""
        k_net, k_env, k_phase, key = jax.random.split(key, 4)
        normalizer, params = init_params(self.networks, self.measured(self.sizes), k_net)
        school = imitation.school(self.env.unwrapped, shown, self.cfg) if self.imitates else None
        if school and shown is not None:
            normalizer = imitation.seen(normalizer, shown)
            params = imitation.cloned(self.networks, normalizer, params, shown, k_net)
        env_state = wrappers.begun(self.env, k_env, k_phase, self.num_envs, bank)
        opt_state = self._optimizer.init(params)
        returns = running_statistics.init_state(specs.Array((), jnp.dtype("float32")), std_eps=jnp.float32(1e-6))
        state = TrainState(normalizer, params, opt_state, env_state, key, jnp.zeros((), jnp.int32), returns, school)
        state = self._averaging(state)
        # ``run`` returns weakly typed leaves as strong ones, so whatever takes the state would be compiled twice.
        return jax.tree.map(lambda x: jnp.asarray(x, x.dtype), state)

    def place(self, state: TrainState) -> TrainState:
        """Spreads the environments over the devices, and copies the rest to each. Takes the state or its shapes."""
        if not self._axis:
            return state

        def put(part, spec):
            sharding = NamedSharding(self._mesh, spec)
            if isinstance(jax.tree.leaves(part)[0], jax.ShapeDtypeStruct):
                return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), part)
            if machines.several():  # each process places its own part
                return jax.tree.map(lambda x: jax.make_array_from_callback(x.shape, sharding, np.asarray(x).__getitem__), part)
            return jax.device_put(part, sharding)

        parts = {f.name: getattr(state, f.name) for f in dataclasses.fields(TrainState)}
        placed: dict[str, Any] = {name: put(part, getattr(_SPECS, name)) for name, part in parts.items() if part is not None}
        return dataclasses.replace(state, **placed)

    def policy(self, state: TrainState) -> tuple:
        """Returns normalizer and network parameters from the first device, for programs that run only there; or their shapes."""
        params = super().policy(state)
        if not self._axis or isinstance(jax.tree.leaves(params)[0], jax.ShapeDtypeStruct):
            return params
        return jax.tree.map(lambda x: x.addressable_data(0), params)

    def with_policy(self, state: TrainState, params: tuple) -> TrainState:
        """Returns a new state that starts from a policy."""
        return self._averaging(super().with_policy(state, params))

    def _averaging(self, state: TrainState) -> TrainState:
        """Returns a new state whose policy is also the first one of the mean."""
        return dataclasses.replace(state, acting=jax.tree.map(jnp.copy, state.params.policy)) if self.cfg.averaging else state

    def slower(self, state: TrainState) -> TrainState:
        """Returns the state with a tenth of the learning rate, and other random draws."""
        *others, adam = state.opt_state
        rate = adam.hyperparams["learning_rate"]
        adam = adam._replace(
            hyperparams={**adam.hyperparams, "learning_rate": jnp.maximum(0.1 * rate, self.cfg.min_learning_rate)}
        )
        return dataclasses.replace(state, opt_state=(*others, adam), key=jax.random.fold_in(state.key, 1))

    def act(self, params: tuple, obs: Observation) -> jax.Array:
        """Returns the mode of the action distribution."""
        return make_act(self.networks, params)(obs)

    def describe(self) -> dict[str, Any]:
        """Describes the networks for the policy's file."""
        return {"network": config.to_dict(self.cfg.network)}

    def footprint(self) -> tuple[float, float]:
        """Estimates the memory of ``run`` (see ``learner.Learner.footprint``). Tests measured the factors on compiled programs.

        A rollout keeps every step's observations and other data. Its end evaluates two layers of the critic on all of them. An
        update copies a minibatch, and keeps all activations for the gradient.
        """
        cfg, env = self.cfg, self.env.unwrapped
        state = state_shape(self)
        own = device_memory.size(state.env_state)
        # Observations; actions, their means and deviations; log-probability, value, return, advantage, reward and two ends.
        obs = 4 * sum(map(math.prod, shapes(self.sizes)))
        step = obs + 4 * (3 * env.action_size + 7)
        encoded = 2 * len(cfg.network.encoders) * sum(cfg.network.encoder_layers)
        neurons = 4 * (sum(cfg.network.actor) + sum(cfg.network.critic) + encoded)
        layers = 4 * max(a + b for a, b in itertools.pairwise((*cfg.network.critic, 1)))
        rollout = max(env.physics.footprint(self.num_devices).in_program, cfg.unroll_length * (obs + layers))
        update = cfg.unroll_length * (step + 1.75 * neurons) / cfg.num_minibatches
        return 2.0 * (device_memory.size(state) - own), own / cfg.num_envs + 1.1 * cfg.unroll_length * step + max(rollout, update)

    def run(self, state: TrainState, iterations: int) -> tuple[TrainState, Metrics]:
        """Makes ``iterations`` rollouts and updates; metrics are means over them.

        Jit with static ``iterations``, and donate ``state``.
        """
        run = functools.partial(self._run, iterations=iterations)
        if self._axis:  # unchecked, because no check sees through calls of physics outside JAX
            run = jax.shard_map(run, mesh=self._mesh, in_specs=(_SPECS,), out_specs=(_SPECS, _HERE), check_vma=False)
        return run(state)

    def _run(self, state: TrainState, iterations: int) -> tuple[TrainState, Metrics]:
        return repeated(self._iterate, state, iterations)

    def parts(self) -> tuple[Part, ...]:
        """See ``learner.Learner``. On several devices an iteration is one program."""
        starts, rollout = Part("starts", self._with_starts, small=True), Part("rollout", self._rolled, plain=True)
        return () if self._axis else (starts, rollout, Part("update", self._updated, small=True))

    def _iterate(self, state: TrainState) -> tuple[TrainState, Metrics]:
        return self._updated(*self._rolled(*self._with_starts(state)))

    def _with_starts(self, state: TrainState, _: Any = None) -> tuple[TrainState, wrappers.Start]:
        """Draws the starts of the next episodes."""
        return state, self.env.following(state.env_state)

    def _rolled(self, state: TrainState, following: wrappers.Start) -> tuple[TrainState, tuple[Batch, Metrics, Key]]:
        """Plays; returns the state with other environments, the rest of what ``rollout`` returns, and the update's key."""
        key, k_roll, k_update = jax.random.split(state.key, 3)
        if self._axis:
            k_roll = jax.random.fold_in(k_roll, jax.lax.axis_index(self._axis))
        env_state, batch, sums = self.rollout(self._acts(state), k_roll, following)
        return dataclasses.replace(state, env_state=env_state, key=key), (batch, sums, k_update)

    def _acts(self, state: TrainState) -> TrainState:
        """Returns the state with the policy that acts and learns."""
        if not self.cfg.averaging:
            return state
        return dataclasses.replace(state, params=state.params.replace(policy=state.acting))

    def _updated(self, state: TrainState, given: tuple[Batch, Metrics, Key]) -> tuple[TrainState, Metrics]:
        """Learns from the batch."""
        batch, sums, k_update = given
        played = state.params.policy
        with self._networks_precision():
            params, opt_state, metrics = self._update(self._acts(state), batch, k_update)
        # Updated last: the loss compares with log-probabilities made under the acting statistics.
        normalizer = running_statistics.update(state.normalizer, self.measured(batch.obs), pmap_axis_name=self._axis)
        returns = state.returns
        if self.cfg.normalize_returns:  # otherwise they stay what they start as, mean 0 and deviation 1
            raw = running_statistics.denormalize(batch.returns, returns)
            returns = running_statistics.update(returns, raw, pmap_axis_name=self._axis)
        sums = jax.lax.psum(sums, self._axis) if self._axis else sums
        school = state.school and state.school.after(sums)
        acting = None
        if self.cfg.averaging:
            acting = params.policy
            params = params.replace(policy=optax.incremental_update(acting, played, 1 - self.cfg.averaging))
        iteration = state.iteration + 1
        state = TrainState(normalizer, params, opt_state, state.env_state, state.key, iteration, returns, school, acting)
        return state, {**sums, **metrics}

    def _networks_precision(self):
        return jax.default_matmul_precision(self.cfg.matmul_precision)

    def _mean(self, tree: Tree) -> Tree:
        """Averages over the devices in ``run``, where each has an equal share."""
        return jax.lax.pmean(tree, self._axis) if self._axis else tree

    def rollout(self, state: TrainState, key: Key, following: wrappers.Start) -> tuple[State, Batch, Metrics]:
        """Acts for ``unroll_length`` steps in every environment, and computes returns and advantages.

        Args:
            following: starts of the environments' next episodes.

        Returns:
            the environments, the batch (leaves [time, env, ...]), and the environments' metrics summed over it.
        """
        cfg = self.cfg
        policy = self._make_policy((state.normalizer, state.params.policy))

        def figures(env_state: State):
            return {**env_state.metrics, "reward": env_state.reward, "episodes": env_state.done}

        def act(carry: tuple[State, Metrics], key: Key):
            env_state, totals = carry
            with self._networks_precision():
                action, extras = policy(env_state.obs, key)
            after = self.env.step(env_state, action, following)
            totals = jax.tree.map(jnp.add, totals, figures(after))  # per environment: summing over them at every step costs more
            return (after, totals), (env_state.obs, extras, after.reward, after.done, after.info["truncation"])

        keys = jax.random.split(key, cfg.unroll_length)
        start = state.env_state, jax.tree.map(jnp.zeros_like, figures(state.env_state))
        (env_state, totals), (obs, extras, reward, done, truncation) = jax.lax.scan(act, start, keys)
        # All steps at once: a few large products instead of many small ones.
        with self._networks_precision():
            value, last = (
                self.networks.value_network.apply(state.normalizer, state.params.value, o) for o in (obs, env_state.obs)
            )
        raw_value, raw_last = (running_statistics.denormalize(x, state.returns) for x in (value, last))
        returns, advantages = losses.compute_gae(
            truncation=truncation,
            termination=done * (1 - truncation),
            rewards=reward * cfg.reward_scaling,
            values=raw_value,
            bootstrap_value=raw_last,
            lambda_=cfg.gae_lambda,
            discount=cfg.discounting,
        )
        returns = running_statistics.normalize(returns, state.returns)
        acted = extras["distribution_params"]
        last_mean = _before(self.networks.parametric_action_distribution.create_dist(acted).loc, done)
        batch = Batch(obs, extras["raw_action"], extras["log_prob"], acted, last_mean, value, returns, advantages)
        return env_state, batch, {f"sum/{name}": jnp.sum(value) for name, value in totals.items()}

    def loss(
        self, params: losses.PPONetworkParams, normalizer: running_statistics.RunningStatisticsState, batch: Batch, key: Key
    ) -> tuple[Float[Array, ""], Metrics]:
        """Computes the loss and its metrics on a minibatch."""
        logits = self.networks.policy_network.apply(normalizer, params.policy, batch.obs)
        return self.loss_of(logits, params, normalizer, batch, key)

    def loss_of(
        self, logits: Any, params: losses.PPONetworkParams, normalizer: Any, batch: Batch, key: Key
    ) -> tuple[Float[Array, ""], Metrics]:
        """Computes the clipped surrogate, value loss and entropy bonus. Schulman et al. 2017; value clipping as in RSL-RL.

        Args:
            logits: the policy's output on the minibatch.
        """
        cfg, nets = self.cfg, self.networks
        dist = nets.parametric_action_distribution
        value = nets.value_network.apply(normalizer, params.value, batch.obs)

        centred = batch.advantages - self._mean(jnp.mean(batch.advantages))
        advantages = centred / (jnp.sqrt(self._mean(jnp.mean(jnp.square(centred)))) + 1e-8)
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
        change = jnp.mean(jnp.sum(jnp.square(new.loc - batch.last_mean), axis=-1))
        kl = jnp.mean(new.kl_divergence(old)) if hasattr(new, "kl_divergence") else jnp.zeros(())
        total = policy_loss + value_loss - cfg.entropy_cost * entropy + cfg.change_cost * change
        metrics = {"loss": total, "policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy, "kl": kl}
        metrics["action_change"] = change
        return total, {**metrics, "action_std": jnp.mean(new.scale)}

    def _update(self, state: TrainState, batch: Batch, key: Key) -> tuple[losses.PPONetworkParams, optax.OptState, Metrics]:
        cfg, school = self.cfg, state.school
        waits = school.waits(state.iteration, cfg) if school else jnp.array(False)

        def minibatch(carry, envs_and_key):
            params, opt_state = carry
            envs, key = envs_and_key
            part = jax.tree.map(lambda x: x[:, envs].reshape(-1, *x.shape[2:]), batch)  # flat, for faster products on a CPU
            grads, metrics = jax.grad(self.loss, has_aux=True)(params, state.normalizer, part, key)
            if school:
                grads = grads if school.lasts else imitation.held_back(grads, waits)
                pull = imitation.gradient(self.networks, state.normalizer, params, school, key)
                grads = jax.tree.map(lambda own, to: own + cfg.imitation * to, grads, pull)
            grads, metrics = self._mean((grads, metrics))
            if cfg.desired_kl:
                kl = metrics["kl"]
                if school and school.lasts:  # a policy that stands still says nothing about the rate
                    kl = jnp.where(waits, cfg.desired_kl, kl)
                opt_state, _ = optimizer.adaptive_kl_learning_rate(
                    opt_state, kl, cfg.desired_kl, cfg.min_learning_rate, cfg.max_learning_rate
                )
            metrics["learning_rate"] = opt_state[-1].hyperparams["learning_rate"]
            updates, opt_state = self._optimizer.update(grads, opt_state)
            if school and school.lasts:  # Adam sees what it will move by, so that its first step is no blow
                updates = imitation.held_back(updates, waits)
            params = optax.apply_updates(params, updates)
            params = params.replace(policy=_bound_std(params.policy, cfg.min_std, cfg.max_std))
            return (params, opt_state), jnp.stack([metrics[name] for name in self.update_metrics])

        k_order, k_loss = jax.random.split(key)
        mine, updates = cfg.num_envs // self.num_devices, cfg.num_epochs * cfg.num_minibatches
        orders = jax.vmap(lambda k: jax.random.permutation(k, mine))(jax.random.split(k_order, cfg.num_epochs))
        each = orders.reshape(updates, -1), jax.random.split(k_loss, updates)
        (params, opt_state), metrics = products.scan(minibatch, state.params, state.opt_state, each)
        return params, opt_state, dict(zip(self.update_metrics, jnp.mean(metrics, 0), strict=True))


def _minibatches(cfg: PpoCfg) -> int:
    """Returns the number of minibatches per epoch for ``minibatch_size``."""
    wanted = cfg.num_envs * cfg.unroll_length // cfg.minibatch_size
    return max(8, 1 << wanted.bit_length() - 1 if wanted else 0)


def _before(mean: Float[Array, "time env na"], done: Float[Array, "time env"]) -> Float[Array, "time env na"]:
    """Returns the mean of the previous step; at the start of an episode or rollout, the step's own."""
    starts = jnp.concatenate([jnp.ones_like(done[:1]), done[:-1]])
    return jnp.where(starts[..., None] > 0, mean, jnp.concatenate([mean[:1], mean[:-1]]))


def _bound_std(policy: dict[str, Any], low: float, high: float) -> dict[str, Any]:
    """Bounds the policy's learnt deviations (0: no bound). ``tanh_normal`` has none to bound."""
    layers, name = policy["params"], "std_logparam"
    if name not in layers:
        return policy
    bounds = np.log(low) if low else -np.inf, np.log(high) if high else np.inf
    return {**policy, "params": {**layers, name: jax.tree.map(lambda x: jnp.clip(x, *bounds), layers[name])}}


KIND = Kind(make=Learner, presets=PRESETS, policy=from_meta, fit=fit, held=HELD, differing=differing)
