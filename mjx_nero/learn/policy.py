"""Policies: networks, action selection, and the file they live in."""

import dataclasses
import functools
import hashlib
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

import mjx_nero.sim.quiet  # noqa: F401

# isort: split
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, networks
from flax import linen

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint, header, learner
from mjx_nero.learn.learner import Act, Observation
from mjx_nero.learn.ppo_cfg import NetworkCfg as NetworkCfg
from mjx_nero.sim import scene
from mjx_nero.sim.robot import ASSETS, RobotCfg

Sizes = Mapping[str, Any]  # shapes, an array a group; of a group whose terms stay apart, a dict of them


@dataclasses.dataclass(frozen=True)
class Policy:
    """A trained policy.

    Attributes:
        meta: what it was trained on: env, preset, robot, sizes, learner, env steps.
        params: what it acts by; of PPO (normalizer, network parameters), as Brax's inference function takes them.
        act: observation groups -> the deterministic action; single or batched.
    """

    meta: dict[str, Any]
    params: Any
    act: Callable[[Observation], jax.Array]


def _is_shape(node: Any) -> bool:
    return isinstance(node, tuple | list)


def shapes(sizes: Any) -> list[tuple[int, ...]]:
    """The shapes in ``Sizes``, or in a part of it: of all observations, also of groups whose terms stay apart."""
    return jax.tree.leaves(sizes, is_leaf=_is_shape)


def make_networks(sizes: Sizes, action_size: int, cfg: NetworkCfg) -> networks.PPONetworks:
    """Brax's PPO networks; the critic reads ``privileged_state`` where the environment has that group."""
    return networks.make_ppo_networks(
        dict(sizes),
        action_size,
        preprocess_observations_fn=functools.partial(running_statistics.normalize, max_abs_value=cfg.max_observation or None),
        policy_hidden_layer_sizes=tuple(cfg.actor),
        value_hidden_layer_sizes=tuple(cfg.critic),
        activation=getattr(linen, cfg.activation),
        value_obs_key="privileged_state" if "privileged_state" in sizes else "state",
        distribution_type=cfg.distribution,
        noise_std_type="log",
        init_noise_std=cfg.init_std,
        mean_kernel_init_fn=jax.nn.initializers.variance_scaling,  # LeCun's uniform one, as in the other layers, times a factor
        mean_kernel_init_kwargs={"scale": cfg.output_scale**2, "mode": "fan_in", "distribution": "uniform"},
    )


def init_params(nets: networks.PPONetworks, sizes: Sizes, key: jax.Array) -> tuple:
    """Fresh (normalizer, network parameters)."""
    k_actor, k_critic = jax.random.split(key)
    # The floor keeps a constant observation, whose deviation is 0, from being divided by nothing.
    normalizer = running_statistics.init_state(
        jax.tree.map(lambda size: specs.Array(size, jnp.dtype("float32")), dict(sizes), is_leaf=_is_shape)
    )
    normalizer = normalizer.replace(std_eps=jnp.float32(1e-4))
    params = losses.PPONetworkParams(policy=nets.policy_network.init(k_actor), value=nets.value_network.init(k_critic))
    return normalizer, params


def make_act(nets: networks.PPONetworks, params: tuple) -> Callable[[Observation], jax.Array]:
    """The deterministic policy: the mode of the action's distribution."""
    normalizer, net_params = params
    policy = networks.make_inference_fn(nets)((normalizer, net_params.policy), deterministic=True)
    return lambda obs: policy(obs, None)[0]


def from_meta(meta: Mapping[str, Any]) -> tuple[Any, Act]:
    """The networks that a policy file describes: a template of their parameters, and how they act."""
    network: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in meta["network"].items()}
    sizes = jax.tree.map(tuple, meta["observation_size"], is_leaf=_is_shape)
    # Files of version 0.4 know no bound on observations.
    nets = make_networks(sizes, meta["action_size"], NetworkCfg(**{"max_observation": 0.0, **network}))
    template = jax.eval_shape(functools.partial(init_params, nets, sizes), jax.random.PRNGKey(0))
    return template, lambda params, obs: make_act(nets, params)(obs)


def describe(env: ManipulationEnv, env_name: str, preset: str, by: str, learnt: Mapping[str, Any]) -> dict[str, Any]:
    """What a policy file says of the policy in it.

    Args:
        by: name of the learner.
        learnt: of ``Learner.describe``.
    """
    terms = {name: list(group.terms) for name, group in env.cfg.observations.items()}
    return {
        "kind": "policy",
        "env": env_name,
        "preset": preset,
        "robot": env.cfg.robot.name,
        "fingerprint": fingerprint(env.cfg.robot),
        "observation_size": jax.tree.map(list, env.observation_size, is_leaf=_is_shape),
        "observations": terms,
        "action_size": env.action_size,
        "actions": env.action_kinds,
        "learner": by,
        **learnt,
    }


def fingerprint(robot: RobotCfg) -> str:
    """Tells robots apart that share a name: a hash of the compiled model's tree, joints and masses, of the drives and of home.

    Numbers count to four digits, so that another compiler or processor does not make another robot.
    """
    model = scene.robot_model(robot)
    bodies = ("body_pos", "body_quat", "body_mass", "body_inertia", "body_ipos", "site_pos")
    joints = ("jnt_type", "jnt_pos", "jnt_axis", "jnt_range", "dof_armature", "dof_damping", "dof_frictionloss")
    drives = [
        getattr(d, name) for d in (robot.arm, robot.gripper) for name in ("stiffness", "damping", "effort", "speed", "home")
    ]
    numbers = np.concatenate([np.ravel(getattr(model, name)) for name in bodies + joints] + [np.ravel(d) for d in drives])
    text = " ".join([*robot.joints, *(f"{x:.3e}" if abs(x) > 1e-9 else "0" for x in numbers.astype(float))])
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def load(path: pathlib.Path | str) -> Policy:
    """Reads a policy file.

    Raises:
        UserError: missing, damaged, or not a policy.
    """
    path = pathlib.Path(path)
    meta = checkpoint.load_meta(path)
    header.check(meta, path)
    size = path.stat().st_size
    if meta.get("kind") == "policy" and size > header.MAX_POLICY:
        raise UserError(f"{path} has {size / 1e6:.0f} MB: policies of more than {header.MAX_POLICY / 1e6:.0f} MB are not read")
    try:
        template, act = learner.find(meta.get("learner", "ppo")).policy(meta)
    except (KeyError, TypeError, AttributeError):
        raise UserError(f"{path} does not describe a policy: give the policy.safetensors of a run") from None
    params = checkpoint.load(path, template)
    if not all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(params)):
        raise UserError(f"{path} holds numbers that are not finite: train again or copy it anew")
    return Policy(meta=meta, params=params, act=functools.partial(act, params))


def load_for(
    env: ManipulationEnv,
    env_name: str,
    path: pathlib.Path | str | None,
    robot: str | None = None,
    any_robot: bool = False,
    preset: str = "default",
) -> Policy:
    """Reads the policy at ``path`` (default: the one that ships for ``env_name``) and checks that it fits ``env``.

    Args:
        preset: of the policy that ships, where it has one of its own.
        robot: what the user named for another than the environment's own, for the messages.
        any_robot: play it even if it was trained for another model of the robot.

    Raises:
        UserError: missing, damaged, or trained on another environment, robot or other observations.
    """
    if path is None and not shipped(env_name, preset).is_file():
        command = f"python train.py --env {env_name}" + (f" --robot {robot}" if robot else "")
        raise UserError(f"no policy ships for {env_name}: train one ({command}) and pass --policy PATH")
    path = pathlib.Path(path or shipped(env_name, preset))
    policy = load(path)
    if policy.meta["env"] != env_name:
        raise UserError(f"{path} is a policy of {policy.meta['env']}, not of {env_name}: pass --env {policy.meta['env']}")
    name = env.cfg.robot.name
    if policy.meta.get("robot", name) != name:
        raise UserError(
            f"{path} is a policy for {policy.meta['robot']}, not for {name}: pass the --robot that it was trained with"
        )
    here = fingerprint(env.cfg.robot)
    if not any_robot and policy.meta.get("fingerprint", here) != here:
        raise UserError(
            f"{path} is a policy for another model of {name} (other links, masses, joints or drives): pass the --robot that "
            "it was trained with, train one for this robot, or pass --any-robot to play it all the same"
        )
    terms = {name: list(group.terms) for name, group in env.cfg.observations.items()}
    sizes = jax.tree.map(list, env.observation_size, is_leaf=_is_shape)
    same_terms = policy.meta["observations"]["state"] == terms["state"]
    if same_terms and policy.meta["action_size"] != env.action_size:
        count = f"{policy.meta['action_size']} actions, {name} takes {env.action_size}"
        raise UserError(f"{path} is of another robot ({count}): leave out --robot, or train one with it and pass --policy")
    if not same_terms:
        raise UserError(
            f"{path} was trained on other observations (preset {policy.meta['preset']}): pass --preset {policy.meta['preset']}"
        )
    if (trained_on := policy.meta["observation_size"]["state"]) != sizes["state"]:
        raise UserError(
            f"{path} was trained on observations of size {trained_on}, here it is {sizes['state']}: pass the --preset (it had "
            f"{policy.meta['preset']}) and the --env fields that it was trained with, or train one and pass --policy"
        )
    if not header.acts_alike(policy.meta, {"actions": env.action_kinds}):
        given = policy.meta.get("actions", ["JointPosition"])
        raise UserError(
            f"{path} was trained on other actions ({', '.join(given)}; here {', '.join(env.action_kinds)}): "
            "pass the --preset that it was trained with, or train again"
        )
    return policy


def shipped(env_name: str, preset: str = "default") -> pathlib.Path:
    """Where the package's own policy for an environment lies: the preset's, or where it has none the default's."""
    own = ASSETS / "policies" / f"{env_name}_{preset}.safetensors"
    return own if own.is_file() else ASSETS / "policies" / f"{env_name}.safetensors"
