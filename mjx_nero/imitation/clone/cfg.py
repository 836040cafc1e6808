"""Hyperparameters of cloning: plain data."""

import dataclasses
from typing import Annotated

from mjx_nero.config import bounds
from mjx_nero.config.bounds import Bounds, NonNegative
from mjx_nero.learn.ppo.cfg import NetworkCfg, Rate


@dataclasses.dataclass(frozen=True)
class CloneCfg:
    """Hyperparameters. 0 for ``num_envs`` or ``num_timesteps`` lets the machine decide.

    Attributes:
        data: comma-separated folders of demonstrations (``demos --out``, ``view --demos``).
        num_envs: number of environments; only evaluations step them.
        num_timesteps: total steps of demonstrations to learn from, repeats included.
        minibatch_size: steps per update.
        updates: updates per iteration.
        learning_rate: initial learning rate; it falls to zero along half a cosine.
        max_grad_norm: maximum norm of the gradient.
        weight_decay: share of each weight that an update subtracts, times the learning rate.
    """

    data: str = ""
    num_envs: Annotated[int, Bounds(0, 1 << 24)] = 0
    num_timesteps: Annotated[int, Bounds(0, 10**15)] = 0
    minibatch_size: Annotated[int, Bounds(1, 1 << 20)] = 512
    updates: Annotated[int, Bounds(1, 100_000)] = 200
    learning_rate: Rate = 2e-3
    max_grad_norm: bounds.Positive = 1.0
    weight_decay: NonNegative = 0.0
    network: NetworkCfg = NetworkCfg(output_scale=1.0)

    def __post_init__(self):
        bounds.check(self)


PRESETS = {"default": CloneCfg()}
