"""Hyperparameters of cloning: plain data."""

import dataclasses
from typing import Annotated

from mjx_nero.config import bounds
from mjx_nero.config.bounds import Bounds, NonNegative
from mjx_nero.learn.ppo.cfg import NetworkCfg, Rate


@dataclasses.dataclass(frozen=True)
class CloneCfg:
    """Hyperparameters. ``num_envs`` and ``num_timesteps`` 0: chosen for the machine.

    Attributes:
        data: folder of the demonstrations (``demos --out``).
        num_envs: environments, which only evaluations step.
        num_timesteps: steps of demonstrations to learn from, each as often as it comes, in all.
        minibatch_size: steps of an update.
        updates: of an iteration.
        learning_rate: at first; it falls to nothing along half a cosine.
        max_grad_norm: longer gradients are shortened to this.
        weight_decay: how much of a weight is taken away, times the learning rate, in an update.
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
