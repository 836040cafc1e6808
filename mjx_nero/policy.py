"""Policies: networks, action selection, and the file they live in."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, networks
from flax import linen

from mjx_nero import checkpoint
from mjx_nero.env import ManipulationEnv
from mjx_nero.robots import ASSETS
from mjx_nero.types import UserError

Observation = Mapping[str, jax.Array]
ACTIVATIONS = {"elu": linen.elu, "swish": linen.swish, "relu": linen.relu, "tanh": linen.tanh}


@dataclasses.dataclass(frozen=True)
class NetworkCfg:
    """Multilayer perceptrons of actor and critic, and the action's distribution.

    ``normal`` has one learnt log-std an action, from ``init_std``; ``tanh_normal`` squashes actions to +-1.
    """

    actor: tuple[int, ...] = (256, 128, 64)
    critic: tuple[int, ...] = (256, 128, 64)
    activation: str = "elu"
    distribution: str = "normal"
    init_std: float = 1.0

    def __post_init__(self):
        if self.activation not in ACTIVATIONS:
            raise UserError(f"unknown activation {self.activation!r}: choose one of {', '.join(ACTIVATIONS)}")
        if self.distribution not in ("normal", "tanh_normal"):
            raise UserError(f"unknown distribution {self.distribution!r}: choose normal or tanh_normal")


@dataclasses.dataclass(frozen=True)
class Policy:
    """A trained policy.

    Attributes:
        meta: what it was trained on: env, preset, sizes, network, env steps.
        params: (normalizer, network parameters), as Brax's inference function takes them.
        act: observation groups -> the deterministic action; single or batched.
    """

    meta: dict[str, Any]
    params: tuple
    act: Callable[[Observation], jax.Array]


def make_networks(sizes: Mapping[str, tuple[int, ...]], action_size: int, cfg: NetworkCfg) -> networks.PPONetworks:
    """Brax's PPO networks; the critic reads ``privileged_state`` where the environment has that group."""
    return networks.make_ppo_networks(
        {name: tuple(size) for name, size in sizes.items()},
        action_size,
        preprocess_observations_fn=running_statistics.normalize,
        policy_hidden_layer_sizes=tuple(cfg.actor),
        value_hidden_layer_sizes=tuple(cfg.critic),
        activation=ACTIVATIONS[cfg.activation],
        value_obs_key="privileged_state" if "privileged_state" in sizes else "state",
        distribution_type=cfg.distribution,
        noise_std_type="log",
        init_noise_std=cfg.init_std,
    )


def init_params(nets: networks.PPONetworks, sizes: Mapping[str, tuple[int, ...]], key: jax.Array) -> tuple:
    """Fresh (normalizer, network parameters)."""
    k_actor, k_critic = jax.random.split(key)
    # The floor keeps a constant observation, whose deviation is 0, from being divided by nothing.
    normalizer = running_statistics.init_state(
        {name: specs.Array(tuple(size), jnp.dtype("float32")) for name, size in sizes.items()}
    )
    normalizer = normalizer.replace(std_eps=jnp.float32(1e-4))
    params = losses.PPONetworkParams(policy=nets.policy_network.init(k_actor), value=nets.value_network.init(k_critic))
    return normalizer, params


def make_act(nets: networks.PPONetworks, params: tuple) -> Callable[[Observation], jax.Array]:
    """The deterministic policy: the mode of the action's distribution."""
    normalizer, net_params = params
    policy = networks.make_inference_fn(nets)((normalizer, net_params.policy), deterministic=True)
    return lambda obs: policy(obs, None)[0]


def describe(env: ManipulationEnv, env_name: str, preset: str, cfg: NetworkCfg) -> dict[str, Any]:
    """What a policy file says of the policy in it."""
    sizes = {name: list(size) for name, size in env.observation_size.items()}
    terms = {group: list(members) for group, members in env.cfg.observations.items()}
    return {
        "kind": "policy",
        "env": env_name,
        "preset": preset,
        "robot": env.cfg.robot.name,
        "observation_size": sizes,
        "observations": terms,
        "action_size": env.action_size,
        "network": dataclasses.asdict(cfg),
    }


def load(path: pathlib.Path | str) -> Policy:
    """Reads a policy file.

    Raises:
        UserError: missing, damaged, or not a policy.
    """
    path = pathlib.Path(path)
    meta = checkpoint.load_meta(path)
    try:
        network: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in meta["network"].items()}
        cfg = NetworkCfg(**network)
        sizes = {name: tuple(size) for name, size in meta["observation_size"].items()}
        nets = make_networks(sizes, meta["action_size"], cfg)
    except (KeyError, TypeError, AttributeError):
        raise UserError(f"{path} does not describe a policy: give the policy.safetensors of a run") from None
    template = jax.eval_shape(functools.partial(init_params, nets, sizes), jax.random.PRNGKey(0))
    params = checkpoint.load(path, template)
    return Policy(meta=meta, params=params, act=make_act(nets, params))


def load_for(env: ManipulationEnv, env_name: str, path: pathlib.Path | str | None) -> Policy:
    """Reads the policy at ``path`` (default: the one that ships for ``env_name``) and checks that it fits ``env``.

    Raises:
        UserError: missing, damaged, or trained on another environment or other observations.
    """
    if path is None and not shipped(env_name).is_file():
        raise UserError(f"no policy ships for {env_name}: train one (python train.py --env {env_name}) and pass --policy PATH")
    path = pathlib.Path(path or shipped(env_name))
    policy = load(path)
    if policy.meta["env"] != env_name:
        raise UserError(f"{path} is a policy of {policy.meta['env']}, not of {env_name}: pass --env {policy.meta['env']}")
    robot = env.cfg.robot.name
    if policy.meta.get("robot", robot) != robot:
        raise UserError(
            f"{path} is a policy for {policy.meta['robot']}, not for {robot}: pass the --robot that it was trained with"
        )
    terms = {group: list(members) for group, members in env.cfg.observations.items()}
    sizes = {name: list(size) for name, size in env.observation_size.items()}
    if (policy.meta["observations"]["state"], policy.meta["observation_size"]["state"]) != (terms["state"], sizes["state"]):
        raise UserError(
            f"{path} was trained on other observations (preset {policy.meta['preset']}): pass --preset {policy.meta['preset']}"
        )
    return policy


def shipped(env_name: str) -> pathlib.Path:
    """Where the package's own policy for an environment lies."""
    return ASSETS / "policies" / f"{env_name}.safetensors"
