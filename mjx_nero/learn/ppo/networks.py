"""PPO's networks: made from a config, and rebuilt from the description in a policy's file."""

import functools
from collections.abc import Callable, Mapping
from typing import Any

import mjx_nero.sim.quiet  # noqa: F401

import jax
import jax.numpy as jnp
from brax.training import networks as feed_forward
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, networks
from flax import linen

from mjx_nero.errors import UserError
from mjx_nero.learn import machines
from mjx_nero.learn.learner import Act, Observation
from mjx_nero.learn.ppo import encoders
from mjx_nero.learn.ppo.cfg import NetworkCfg, described
from mjx_nero.types import Key

Sizes = Mapping[str, Any]  # shape of each group; a dict of shapes for a group whose terms stay apart
Normalize = Callable[[Any, Any], Any]  # (observations, statistics; None: already normalised) -> normalised observations

ACTOR, CRITIC = (
    "state",
    "privileged_state",
)  # observation groups of actor and critic; without the second, the critic reads the first


def _is_shape(node: Any) -> bool:
    return isinstance(node, tuple | list)


def shapes(sizes: Any) -> list[tuple[int, ...]]:
    """Lists the shapes in ``Sizes`` or a part of it, including those of terms that stay apart."""
    return jax.tree.leaves(sizes, is_leaf=_is_shape)


def make_networks(sizes: Sizes, action_size: int, cfg: NetworkCfg) -> networks.PPONetworks:
    """Makes Brax's PPO networks. The critic reads ``privileged_state`` if the environment has that group.

    In a group whose terms stay apart, an encoder reads each term, and their features are concatenated.

    Raises:
        UserError: an encoder is unknown, or names a term that no network reads apart.
    """
    critic = CRITIC if CRITIC in sizes else ACTOR
    apart = {group: _encoders(sizes[group], cfg) for group in (ACTOR, critic) if isinstance(sizes[group], Mapping)}
    known = list(dict.fromkeys(term for group in apart.values() for term in group))
    if unknown := [term for term, _ in cfg.encoders if term not in known]:
        raise UserError(
            f"network.encoders names {', '.join(unknown)}: an encoder can only read a term of a group that is not concatenated, "
            f"and these are {', '.join(known) or 'none'}"
        )
    bounded = functools.partial(running_statistics.normalize, max_abs_value=cfg.max_observation or None)

    def normalize(obs, statistics):
        return obs if statistics is None else bounded(obs, statistics)

    with jax.default_device(machines.processor()):  # Brax makes examples; the first array on a GPU takes two seconds
        made = networks.make_ppo_networks(
            {name: (_width(apart[name], size),) if name in apart else size for name, size in sizes.items()},
            action_size,
            preprocess_observations_fn=normalize,
            policy_hidden_layer_sizes=tuple(cfg.actor),
            value_hidden_layer_sizes=tuple(cfg.critic),
            activation=getattr(linen, cfg.activation),
            value_obs_key=critic,
            distribution_type=cfg.distribution,
            noise_std_type="log",
            init_noise_std=cfg.init_std,
            mean_kernel_init_fn=jax.nn.initializers.variance_scaling,  # LeCun's uniform, as in the other layers, times a factor
            mean_kernel_init_kwargs={"scale": cfg.output_scale**2, "mode": "fan_in", "distribution": "uniform"},
        )
    through = functools.partial(_encoded, apart=apart, sizes=sizes, normalize=normalize)
    return made.replace(policy_network=through(made.policy_network, ACTOR), value_network=through(made.value_network, critic))


def _encoders(size: Mapping[str, Any], cfg: NetworkCfg) -> dict[str, encoders.Encoder]:
    """Makes one encoder per term of a group, sorted by name, because JAX trees keep no other order."""
    chosen = dict(cfg.encoders)
    return {term: encoders.make(chosen.get(term, encoders.FLAT), tuple(size[term]), cfg) for term in sorted(size)}


def _width(group: Mapping[str, encoders.Encoder], size: Mapping[str, Any]) -> int:
    """Returns the number of features of a group's terms."""

    def features():
        terms = {name: jnp.zeros((1, *size[name])) for name in group}
        made = {name: encoder.init(jax.random.PRNGKey(0), terms[name]) for name, encoder in group.items()}
        return [encoder.apply(made[name], terms[name]) for name, encoder in group.items()]

    return sum(x.shape[-1] for x in jax.eval_shape(features))


def _encoded(
    network: feed_forward.FeedForwardNetwork,
    group: str,
    apart: Mapping[str, Mapping[str, encoders.Encoder]],
    sizes: Sizes,
    normalize: Normalize,
) -> feed_forward.FeedForwardNetwork:
    """Puts the encoders of a group before the network that reads it; returns the network itself if the group is one vector."""
    if group not in apart:
        return network
    own = apart[group]

    def init(key: Key) -> dict[str, Any]:
        key, *keys = jax.random.split(key, 1 + len(own))
        made = zip(own.items(), keys, strict=True)
        return {
            **network.init(key),
            "encoders": {name: encoder.init(each, jnp.zeros((1, *sizes[group][name]))) for (name, encoder), each in made},
        }

    def apply(statistics: Any, params: dict[str, Any], obs: Any) -> Any:
        seen = normalize(obs[group], feed_forward.normalizer_select(statistics, group))
        features = [encoder.apply(params["encoders"][name], seen[name]) for name, encoder in own.items()]
        return network.apply(None, {"params": params["params"]}, jnp.concatenate(features, axis=-1))

    return feed_forward.FeedForwardNetwork(init=init, apply=apply)


def init_params(nets: networks.PPONetworks, sizes: Sizes, key: Key) -> tuple:
    """Makes new (normalizer, network parameters)."""
    k_actor, k_critic = jax.random.split(key)
    # The floor avoids dividing by the zero deviation of a constant observation.
    normalizer = running_statistics.init_state(
        jax.tree.map(lambda size: specs.Array(size, jnp.dtype("float32")), dict(sizes), is_leaf=_is_shape)
    )
    normalizer = normalizer.replace(std_eps=jnp.float32(1e-4))
    params = losses.PPONetworkParams(policy=nets.policy_network.init(k_actor), value=nets.value_network.init(k_critic))
    return normalizer, params


def make_act(nets: networks.PPONetworks, params: tuple) -> Callable[[Observation], jax.Array]:
    """Makes the deterministic policy, which returns the mode of the action distribution."""
    normalizer, net_params = params
    policy = networks.make_inference_fn(nets)((normalizer, net_params.policy), deterministic=True)
    return lambda obs: policy(obs, None)[0]


def from_meta(meta: Mapping[str, Any]) -> tuple[Any, Act]:
    """Rebuilds the networks that a policy file describes: a template of their parameters, and their act function."""
    sizes = jax.tree.map(tuple, meta["observation_size"], is_leaf=_is_shape)
    nets = make_networks(sizes, meta["action_size"], described(meta["network"]))
    template = jax.eval_shape(lambda: init_params(nets, sizes, jax.random.PRNGKey(0)))
    return template, lambda params, obs: make_act(nets, params)(obs)
