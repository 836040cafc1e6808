"""Hyperparameters of policies that act on pictures, and of PPO for them: plain data, readable without importing Brax."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

from mjx_nero import config
from mjx_nero.config.bounds import Bounds, NonNegative, OneOf
from mjx_nero.config.values import read, short
from mjx_nero.errors import UserError
from mjx_nero.learn.header import MAX_LAYERS, MAX_WIDTH
from mjx_nero.learn.ppo.cfg import PpoCfg

ENVS = (32, 4096)  # numbers of environments for a CPU and a GPU


@dataclasses.dataclass(frozen=True)
class StudentCfg:
    """The student's networks: convolutions for each camera, then a multilayer perceptron for features and state.

    Attributes:
        channels: channels of the convolutions, each of which halves the picture's edges. The first has kernels of 5 x 5 pixels,
            the others 3 x 3.
        features: number of features per picture.
        precision: number format of the convolutions: bfloat16 or float32.
        layers: widths of the hidden layers before the action.
    """

    channels: tuple[int, ...] = (32, 64, 64, 64)
    features: Annotated[int, Bounds(1, MAX_WIDTH)] = 64
    layers: tuple[int, ...] = (256, 128)
    precision: Annotated[str, OneOf("bfloat16", "float32")] = "bfloat16"

    def __post_init__(self):
        for name in ("channels", "layers"):
            given = getattr(self, name)
            if not 1 <= len(given) <= MAX_LAYERS or not all(1 <= width <= MAX_WIDTH for width in given):
                raise UserError(f"student.{name} takes 1 to {MAX_LAYERS} layers of 1 to {MAX_WIDTH}, got {short(given)}")


def differing(there: Mapping[str, Any], here: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the fields in which two files' students differ, by dotted name, with the first file's values.

    ``precision`` is ignored: it changes no weight's shape.
    """
    if "student" not in there:  # the file is damaged, which its reader says
        return {}
    own, other = (config.flatten(read(StudentCfg, meta["student"], "student")) for meta in (there, here))
    return {f"student.{name}": x for name, x in own.items() if name != "precision" and x != other[name]}


@dataclasses.dataclass(frozen=True)
class PixelsCfg(PpoCfg):
    """PPO's hyperparameters, and the policy's networks. Of ``network`` only the critic's layers and ``init_std`` matter."""

    critic_first: Annotated[int, Bounds(0, 10_000)] = 0  # iterations in which the policy waits for its critic
    truth_cost: NonNegative = 0.1  # weight of the loss of predicted object positions, in units of their deviation
    student: StudentCfg = StudentCfg()


RGB = StudentCfg(features=128)  # of distillation in the preset rgb, the only one that was run with so many
PRESETS = {"default": PixelsCfg(), "rgb": PixelsCfg(student=RGB)}  # PPO in rgb goes on from such a student
