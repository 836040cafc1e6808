"""Hyperparameters of distillation and its student: plain data, read without Brax, which takes seconds to import."""

import dataclasses
from typing import Annotated

from mjx_nero.config.bounds import Bounds, NonNegative, Positive, Share
from mjx_nero.config.values import hints, read, short
from mjx_nero.errors import UserError
from mjx_nero.learn.header import MAX_LAYERS, MAX_WIDTH

ENVS = (32, 4096)  # that suit a CPU and a GPU


@dataclasses.dataclass(frozen=True)
class StudentCfg:
    """The student's networks: convolutions for each camera, then a multilayer perceptron for all that it senses.

    Attributes:
        channels: of the convolutions, each of which halves the picture's edges. The first looks at 5 x 5 pixels, the others at
            3 x 3.
        features: numbers that remain of a picture.
        layers: neurons of the hidden layers between what is sensed and the action.
    """

    channels: tuple[int, ...] = (32, 64, 64, 64)
    features: Annotated[int, Bounds(1, MAX_WIDTH)] = 256
    layers: tuple[int, ...] = (256, 128)

    def __post_init__(self):
        for name in ("channels", "layers"):
            given = getattr(self, name)
            if not 1 <= len(given) <= MAX_LAYERS or not all(1 <= width <= MAX_WIDTH for width in given):
                raise UserError(f"student.{name} takes 1 to {MAX_LAYERS} layers of 1 to {MAX_WIDTH}, got {short(given)}")


@dataclasses.dataclass(frozen=True)
class DistillCfg:
    """Hyperparameters. ``num_envs`` and ``num_timesteps`` 0: chosen for the machine."""

    num_envs: Annotated[int, Bounds(0, 1 << 24)] = 0  # on all devices together; 0: chosen for the machine
    num_timesteps: Annotated[int, Bounds(0, 10**15)] = 0  # env steps in all; 0: chosen for the machine
    teacher: str = ""  # policy file of who labels; empty: the bundled policy of the task with the same robot
    unroll_length: Annotated[int, Bounds(1, 10_000)] = 16  # control steps of every environment an iteration
    minibatch_size: Annotated[int, Bounds(1)] = 2048  # env steps of an update
    num_epochs: Annotated[int, Bounds(1, 1_000)] = 1  # times that an iteration learns from its steps
    learning_rate: Annotated[float, Bounds(0.0, 1.0, above=True)] = 1e-3  # of Adam, at first
    last_rate: Share = 0.1  # share of it that is left in the end, when all env steps are made
    max_grad_norm: Positive = 1.0  # longer gradients are shortened to this
    teacher_share: Share = 0.1  # of the environments in which the teacher acts in the end: it shows what the student never does
    teacher_first: Annotated[int, Bounds(0, 1_000_000)] = 20  # iterations in which its share falls to that from 1
    noise: NonNegative = 0.05  # deviation of what is added to the student's actions
    max_action: Positive = 1.0  # labels are bounded to this: what lies beyond changes nothing
    truth_cost: NonNegative = 0.1  # weight of the loss of where the objects are, in units of their deviation
    student: StudentCfg = StudentCfg()

    def __post_init__(self):
        for name, kind in hints(type(self)).items():
            if name != "student":
                read(kind, getattr(self, name), f"distill.{name}")


PRESETS = {"default": DistillCfg()}  # by the environment's preset
