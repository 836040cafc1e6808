"""Hyperparameters of distillation: plain data, readable without importing Brax, which takes seconds."""

import dataclasses
from typing import Annotated

from mjx_nero.config.bounds import Bounds, NonNegative, Positive, Share
from mjx_nero.config.values import hints, read
from mjx_nero.learn.pixels.cfg import RGB, StudentCfg


@dataclasses.dataclass(frozen=True)
class DistillCfg:
    """Hyperparameters. 0 for ``num_envs`` or ``num_timesteps`` lets the machine decide."""

    num_envs: Annotated[int, Bounds(0, 1 << 24)] = 0  # number of environments; 0: chosen for the machine
    num_timesteps: Annotated[int, Bounds(0, 10**15)] = 0  # total env steps; 0: chosen for the machine
    teacher: str = ""  # the teacher's policy file; empty: the task's bundled policy for the same robot
    unroll_length: Annotated[int, Bounds(1, 10_000)] = 16  # control steps per environment and iteration
    minibatch_size: Annotated[int, Bounds(1)] = 2048  # env steps per update
    num_epochs: Annotated[int, Bounds(1, 1_000)] = 1  # passes over an iteration's steps
    learning_rate: Annotated[float, Bounds(0.0, 1.0, above=True)] = 1e-3  # initial learning rate of Adam
    last_rate: Share = 0.1  # final learning rate, as a share of the initial one
    max_grad_norm: Positive = 1.0  # maximum norm of the gradient
    teacher_share: Share = 0.1  # final share of environments where the teacher acts and shows states that the student misses
    teacher_first: Annotated[int, Bounds(0, 1_000_000)] = 20  # iterations in which the teacher's share falls from 1
    noise: NonNegative = 0.05  # standard deviation of noise on the student's actions
    max_action: Positive = 1.0  # bound on labels, beyond which nothing changes
    truth_cost: NonNegative = 0.1  # weight of the loss of predicted object positions, in units of their deviation
    student: StudentCfg = StudentCfg()

    def __post_init__(self):
        for name, kind in hints(type(self)).items():
            if name != "student":
                read(kind, getattr(self, name), f"distill.{name}")


PRESETS = {"default": DistillCfg(), "rgb": DistillCfg(student=RGB)}  # by preset of the environment
