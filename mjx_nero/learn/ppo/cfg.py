"""Hyperparameters of PPO and of its networks: plain data, readable without importing Brax, which takes seconds."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

from mjx_nero import config
from mjx_nero.config.bounds import Bounds, NonNegative, Positive, Share
from mjx_nero.config.values import hints, read, short
from mjx_nero.errors import UserError
from mjx_nero.learn.header import MAX_LAYERS, MAX_WIDTH
from mjx_nero.learn.learner import DEMONSTRATIONS

PRECISIONS = ("default", "bfloat16", "tensorfloat32", "float32", "high", "highest")
Rate = Annotated[float, Bounds(0.0, 1.0, above=True)]

MINIBATCH = 6144  # env steps per update on one device: more would leave too few updates, fewer would leave a GPU idle
ACTIVATIONS = ("elu", "swish", "relu", "tanh")


@dataclasses.dataclass(frozen=True)
class NetworkCfg:
    """The multilayer perceptrons of actor and critic, and the action distribution.

    Attributes:
        actor, critic: widths of the hidden layers.
        activation: elu, swish, relu or tanh.
        distribution: ``normal`` learns one log-std per action entry; ``tanh_normal`` squashes actions to +-1.
        init_std: initial standard deviation of a normal distribution.
        output_scale: scale of the initial weights in the actor's last layer; small, so that the policy starts near home.
        max_observation: bound on normalized observations; 0: none. Without it, observed past actions could feed back.
        encoders: pairs of observation term and encoder, for groups whose terms stay apart. Other terms use ``flat``.
        encoder_layers: layer widths of the encoder ``mlp``.
    """

    actor: tuple[int, ...] = (256, 128, 64)
    critic: tuple[int, ...] = (256, 128, 64)
    activation: str = "elu"
    distribution: str = "normal"
    init_std: Positive = 1.0
    output_scale: Positive = 0.01
    max_observation: NonNegative = 10.0
    encoders: tuple[tuple[str, str], ...] = ()
    encoder_layers: tuple[int, ...] = (64,)

    def __post_init__(self):
        if self.activation not in ACTIVATIONS:
            raise UserError(f"unknown activation {self.activation!r}: choose one of {', '.join(ACTIVATIONS)}")
        if self.distribution not in ("normal", "tanh_normal"):
            raise UserError(f"unknown distribution {self.distribution!r}: choose normal or tanh_normal")
        for name in ("actor", "critic", "encoder_layers"):
            layers = getattr(self, name)
            if len(layers) > MAX_LAYERS or not all(1 <= width <= MAX_WIDTH for width in layers):
                most = f"{MAX_LAYERS} layers of 1 to {MAX_WIDTH} neurons"
                raise UserError(f"network.{name} takes up to {most}, got {short(layers)}")
        if not 0 < self.init_std <= 100:
            raise UserError(f"network.init_std takes a number above 0, up to 100, got {self.init_std:g}")
        if len(dict(self.encoders)) < len(self.encoders):
            raise UserError(f"network.encoders takes each term once, got {short(self.encoders)}")


def described(network: Mapping[str, Any]) -> NetworkCfg:
    """Returns the config of the networks in a policy's file. Files of version 0.4 have no bound on observations.

    Raises:
        UserError: the file describes no networks.
    """
    return read(NetworkCfg, {"max_observation": 0.0, **network}, "network")


def differing(there: Mapping[str, Any], here: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the fields in which two files' networks differ, by dotted name, with the first file's values.

    ``output_scale`` is ignored: it only matters before there are weights.
    """
    if "network" not in there:  # of an older version
        return {}
    own, other = (config.flatten(described(meta["network"])) for meta in (there, here))
    return {f"network.{name}": x for name, x in own.items() if name != "output_scale" and x != other[name]}


@dataclasses.dataclass(frozen=True)
class PpoCfg:
    """Hyperparameters. 0 for ``num_envs``, ``num_timesteps`` or ``minibatch_size`` lets the machine decide."""

    num_envs: Annotated[int, Bounds(0, 1 << 24)] = 0  # environments on all devices together; 0: chosen for the machine
    num_timesteps: Annotated[int, Bounds(0, 10**15)] = 0  # total env steps; 0: chosen for the machine
    unroll_length: Annotated[int, Bounds(1, 10_000)] = 24  # control steps per environment and iteration
    num_epochs: Annotated[int, Bounds(1, 1_000)] = 2  # passes over an iteration's steps
    num_minibatches: Annotated[int, Bounds(0, 1 << 20)] = 0  # updates per epoch; 0: a power of two, at least 8, by minibatch_size
    minibatch_size: Annotated[int, Bounds(0)] = 0  # env steps on all devices together; 0: 6,144 per device at the start
    learning_rate: Rate = 3e-4  # initial learning rate
    desired_kl: NonNegative = 0.02  # target KL that adapts the learning rate; 0: fixed rate
    min_learning_rate: Rate = 1e-5  # minimum adapted learning rate
    max_learning_rate: Rate = 1e-3  # maximum adapted learning rate; with thousands of environments the rate climbs to it
    discounting: Share = 0.98  # discount of rewards per control step
    gae_lambda: Share = 0.95  # generalized advantage estimation: 1 trusts returns, 0 trusts the critic
    clipping: Positive = 0.2  # bound on the relative change of an action's probability
    normalize_returns: bool = True  # the critic learns returns in units of their running standard deviation
    clip_value: NonNegative = 0.0  # bound on the change of a value estimate; 0: none
    entropy_cost: NonNegative = 0.01  # weight of the entropy bonus, which keeps the policy exploring
    change_cost: NonNegative = 0.0  # weight of the squared change of mean actions between steps, which keeps the policy calm
    imitation: NonNegative = 0.0  # weight of the distance from the expert's actions, until half of the episodes succeed
    imitation_lasts: bool = False  # ``imitation`` is weighted by the share of episodes that fail, to the end of training
    demonstrations: Annotated[int, Bounds(1, 4_096)] = DEMONSTRATIONS  # number of the expert's episodes to imitate
    critic_first: Annotated[int, Bounds(0, 10_000)] = 0  # iterations in which an imitating policy waits for its critic
    min_std: NonNegative = 0.2  # minimum standard deviation of actions, so that exploration lasts; 0: none
    max_std: NonNegative = 1.0  # maximum standard deviation, since noise costs nothing where targets saturate; 0: none
    averaging: Annotated[float, Bounds(0.0, 0.9999)] = 0.0  # share of the past in the mean policy that plays; 0: no mean
    value_loss: NonNegative = 1.0  # weight of the critic's loss
    max_grad_norm: Positive = 1.0  # maximum norm of the gradient
    reward_scaling: Positive = 1.0  # factor of rewards
    matmul_precision: str = "tensorfloat32"  # precision of networks' matrix products on a GPU; always full in environments
    network: NetworkCfg = NetworkCfg()

    def __post_init__(self):
        for name, kind in hints(type(self)).items():
            if not dataclasses.is_dataclass(kind):
                read(kind, getattr(self, name), f"ppo.{name}")
        if self.matmul_precision not in PRECISIONS:
            raise UserError(f"ppo.matmul_precision takes one of {', '.join(PRECISIONS)}, got {short(self.matmul_precision)}")
        if self.min_learning_rate > self.max_learning_rate:
            raise UserError("ppo.min_learning_rate is above ppo.max_learning_rate: lower it")


def fit(cfg: PpoCfg, num_devices: int) -> PpoCfg:
    """Fills in what the number of devices decides. The run keeps the result, so it learns alike on any number later."""
    return dataclasses.replace(cfg, minibatch_size=cfg.minibatch_size or MINIBATCH * num_devices)


PRESETS = {  # by preset of the environment
    "default": PpoCfg(),
    # The Isaac Lab recipe's own learner settings (RSL-RL).
    "isaac": PpoCfg(
        num_epochs=5,
        num_minibatches=4,
        learning_rate=1e-4,
        max_learning_rate=1e-2,
        desired_kl=0.01,
        entropy_cost=0.006,
        clip_value=0.2,
        normalize_returns=False,
        min_std=0.0,
        max_std=0.0,
        network=NetworkCfg(output_scale=1.0, max_observation=0.0),
    ),
}
