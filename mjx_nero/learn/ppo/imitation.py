"""PPO with an expert's demonstrations. The policy begins as a clone of the expert, and stays near it until it succeeds.

This follows DAPG (Rajeswaran et al. 2018) with two differences. The weight of the demonstrations falls with the policy's own
success, not with time. The loss compares actions, not their probabilities, because the deviations have their own bounds.

Imitation ends once half of the episodes succeed, and the policy is free to do better than its expert. A task that bears no noise
needs imitation to last (``PpoCfg.imitation_lasts``): its policy stops trying soon after the demonstrations stop.
"""

from collections.abc import Mapping
from typing import Any

import mjx_nero.sim.quiet  # noqa: F401

import jax
import jax.numpy as jnp
import optax
from brax.training.acme import running_statistics
from brax.training.agents.ppo import losses, networks
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn.learner import ROWS
from mjx_nero.learn.ppo.cfg import PpoCfg
from mjx_nero.learn.ppo.networks import ACTOR
from mjx_nero.types import Key, Shown

PASSES, BATCH, RATE = 125, 1024, 1e-3  # of cloning: passes over the demonstrated steps, minibatch size and learning rate
LONG = 3_276_800  # weight of demonstrations in the observations' statistics, because the first second of training is not typical
STILL = 0.2  # deviation of a cloned policy's actions: with 0.5 it grasps nothing, and unlearns its skill within 4 M env steps
BESIDE = 512  # demonstrated steps beside every minibatch
_SLOW = 0.1  # share of an iteration's success rate in the running one


@struct.dataclass
class School:
    """The demonstrated steps, and their weight."""

    shown: Shown
    weight: Float[Array, ""]  # from 1 to 0; 0 from the start if nobody demonstrates
    success: Float[Array, ""]  # running rate of training's episodes
    lasts: bool = struct.field(pytree_node=False, default=False)

    def after(self, sums: Mapping[str, Array]) -> "School":
        """Returns the school after an iteration, given its sums of episodes and successes.

        The weight falls as more episodes succeed, to 0 at half, and never rises. If it lasts, it is the share of episodes that
        fail, among those that did not begin in an expert's state, perhaps just before success.
        """
        episodes, successes = sums["sum/episodes"], sums["sum/success"]
        if self.lasts and "sum/visited" in sums:
            episodes, successes = episodes - sums["sum/visited"], successes - sums["sum/visited_success"]
        slow = jnp.where(episodes > 0, _SLOW, 0.0)
        rate = self.success + slow * (successes / jnp.maximum(episodes, 1.0) - self.success)
        if self.lasts:
            weight = jnp.where(self.weight > 0, 1.0 - rate, 0.0)
        else:
            weight = jnp.minimum(self.weight, jnp.maximum(0.0, 1.0 - 2.0 * rate))
        return School(self.shown, weight, rate, self.lasts)

    def waits(self, iteration: Int[Array, ""], cfg: PpoCfg) -> Bool[Array, ""]:
        """Says whether the policy waits for its critic.

        A new critic is untrained, so its advantages are noise, and a clone that follows them unlearns its skill. Only a clone
        waits: once the weight is 0, there is no reason to.
        """
        return (iteration < cfg.critic_first) & (self.weight > 0)


def school(env: ManipulationEnv, shown: Shown | None, cfg: PpoCfg) -> School:
    """Makes the school of a new run, with weight 0 if there are no demonstrations."""
    zero = jnp.zeros(())
    if shown is not None:
        return School(Shown({ACTOR: shown.obs[ACTOR]}, shown.action), zero + 1.0, zero, cfg.imitation_lasts)
    n = ROWS * cfg.demonstrations
    rows = jax.tree.map(lambda x: jnp.zeros((n, *x.shape), x.dtype), env.state_shape.obs[ACTOR])
    return School(Shown({ACTOR: rows}, jnp.zeros((n, env.action_size))), zero, zero, cfg.imitation_lasts)


def seen(normalizer: Any, shown: Shown) -> Any:
    """Updates the observations' statistics with the demonstrated observations."""
    normalizer = running_statistics.update(normalizer, {name: shown.obs[name] for name in normalizer.mean})
    longer = LONG // len(shown.action)
    count = normalizer.count.replace(lo=normalizer.count.lo * jnp.uint32(longer))
    return normalizer.replace(count=count, summed_variance=jax.tree.map(lambda x: x * longer, normalizer.summed_variance))


def cloned(
    nets: networks.PPONetworks, normalizer: Any, params: losses.PPONetworkParams, shown: Shown, key: Key
) -> losses.PPONetworkParams:
    """Returns a policy that acts as the expert does, with little noise; the critic stays as it is."""
    adam = optax.adam(RATE)

    def step(carry: tuple, key: Key) -> tuple:
        policy, memory = carry
        grads = jax.grad(lambda p: _distance(nets, normalizer, p, _some(shown, BATCH, key)))(policy)
        updates, memory = adam.update(grads, memory)
        return (optax.apply_updates(policy, updates), memory), None

    updates = int(PASSES * len(shown.action) / BATCH)
    (policy, _), _ = jax.lax.scan(step, (params.policy, adam.init(params.policy)), jax.random.split(key, updates))
    layers = dict(policy["params"])
    if "std_logparam" in layers:
        layers["std_logparam"] = jax.tree.map(lambda x: jnp.full_like(x, jnp.log(STILL)), layers["std_logparam"])
    return params.replace(policy={**policy, "params": layers})


def held_back(tree: losses.PPONetworkParams, waits: Bool[Array, ""]) -> losses.PPONetworkParams:
    """Returns a gradient or an update without the policy's part while the policy waits for its critic."""
    return tree.replace(policy=jax.tree.map(lambda x: x * (1.0 - waits), tree.policy))


def gradient(
    nets: networks.PPONetworks, normalizer: Any, params: losses.PPONetworkParams, school: School, key: Key
) -> losses.PPONetworkParams:
    """Computes the gradient of the policy's squared distance from some demonstrated actions, times the school's weight."""
    some = _some(school.shown, BESIDE, key)
    return jax.grad(lambda p: school.weight * _distance(nets, normalizer, p.policy, some))(params)


def _distance(nets: networks.PPONetworks, normalizer: Any, policy: Any, shown: Shown) -> Float[Array, ""]:
    mean = nets.parametric_action_distribution.create_dist(nets.policy_network.apply(normalizer, policy, shown.obs)).loc
    return jnp.mean(jnp.sum(jnp.square(mean - shown.action), axis=-1))


def _some(shown: Shown, n: int, key: Key) -> Shown:
    at = jax.random.randint(key, (n,), 0, len(shown.action))
    return jax.tree.map(lambda x: jnp.asarray(x)[at], shown)
