"""The config of ``demos``."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Annotated, Any

from mjx_nero.config import bounds, flag
from mjx_nero.config.bounds import Bounds, NonNegative, OneOf, Seed
from mjx_nero.data.dataset import FORMS
from mjx_nero.errors import UserError

ACTIONS = ("joints", "hand")


@dataclasses.dataclass(frozen=True)
class DemosCfg:
    """A data set to write.

    Attributes:
        robot: robot instead of the environment's own, by name or folder.
        agent: who demonstrates: expert, policy, or the name of one of the task's controllers.
        policy: policy file (default: the environment's bundled policy).
        through: how an expert acts: through drives (it sets their targets), or through the task's actions, which a policy can
            then learn from as labels.
        episodes: total number of episodes in the data set.
        all: also keep episodes that fail.
        ends: when an episode ends: task (as the task says, usually after a fixed time), or success (as soon as success has held
            for as long as the task requires).
        noise: standard deviation of noise added to the arm's actions, smooth in time, in the action's unit (rad for experts);
            the data set has the clean action beside the executed one.
        actions: joints (targets of all drives), or hand (steps of the hand, and gripper targets).
        holds: what a step holds: all; arm (only what a real arm can also log, so that simulated and real data sets match); or
            lerobot (only what LeRobot's policies learn from, which loads faster).
        velocities: add the joints' velocities to the state, as ``<joint>.vel``.
        units: si (rad, m), or lerobot (degrees, grippers 0 to 100); auto: lerobot for arms that LeRobot drives itself.
        cameras: comma-separated cameras of the scene to draw and write as videos; front+wrist is one picture of both, side by
            side, which LeRobot reads faster than two.
        picture: width and height of a picture in pixels, even numbers (default: the camera's own, or 128x128).
        renderer: mujoco (OpenGL, one picture at a time) or warp (the ray tracer, for the scene's own cameras); auto: warp on a
            GPU.
        form: lerobot (LeRobotDataset v3.0, the extra demos) or arrays (safetensors).
        task: sentence that says what the robot does (default: the environment's).
        side_by_side: number of episodes played at once and written as one piece; episodes' last digits depend on it.
    """

    env_name: str
    preset: str = "default"
    robot: str | None = None
    seed: Seed = 0
    env_fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    agent: str = flag("expert")
    policy: pathlib.Path | None = flag(None)
    through: Annotated[str, OneOf("drives", "task")] = flag("drives")
    episodes: Annotated[int, Bounds(1, 10_000_000)] = flag(1000)
    all: bool = flag(False)
    ends: Annotated[str, OneOf("task", "success")] = flag("task")
    noise: NonNegative = flag(0.0)
    actions: Annotated[str, OneOf(*ACTIONS)] = flag("joints")
    holds: Annotated[str, OneOf("all", "arm", "lerobot")] = flag("all")
    velocities: bool = flag(False)
    units: Annotated[str, OneOf("auto", "si", "lerobot")] = flag("auto")
    cameras: str = flag("")
    picture: str = flag("")
    renderer: Annotated[str, OneOf("auto", "mujoco", "warp")] = flag("auto")
    form: Annotated[str, OneOf(*FORMS)] = flag("lerobot")
    task: str = flag("")
    side_by_side: Annotated[int, Bounds(1, 65536)] = flag(256)

    def __post_init__(self):
        bounds.check(self)
        if self.agent in ("zero", "random"):
            raise UserError(f"--agent {self.agent} demonstrates nothing: choose policy, expert or a controller of the task")
        if self.policy and self.agent != "policy":
            raise UserError("--policy needs --agent policy")
        if self.agent == "policy" and self.through != "drives":
            raise UserError("--through is for experts: a policy always acts through the task's actions, so leave it out")
