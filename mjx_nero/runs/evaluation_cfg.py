"""Settings of an evaluation. Imports neither Brax nor MJX, so that ``--help`` is fast."""

import dataclasses
import pathlib
from collections.abc import Iterable, Mapping
from typing import Annotated, Any

from mjx_nero.config import flag
from mjx_nero.config.bounds import Bounds, OneOf, Seed
from mjx_nero.errors import UserError

AGENTS = ("policy", "zero", "random")
EXPERT = "expert"  # the task's first controller
BACKENDS = ("auto", "mjx", "mujoco")


def expert_of(able: Iterable[str]) -> str:
    """Returns the name of the expert, which is the first of a task's controllers ``able``; ``EXPERT`` if there are none."""
    return next(iter(able), EXPERT)


def controller_of(agent: str, able: Iterable[str]) -> str | None:
    """Returns the name of the controller that an agent's name means; None if the agent is not a controller.

    Args:
        able: names of the task's controllers.
    """
    if agent in AGENTS:
        return None
    return expert_of(able) if agent == EXPERT else agent


@dataclasses.dataclass(frozen=True)
class EvalCfg:
    """Settings of an evaluation.

    Attributes:
        robot: robot instead of the environment's own, by name or folder.
        agent: who plays: policy, expert (the task's first controller), the name of one of its controllers, zero or random
            (default: the bundled policy, or the expert if there is none).
        policy: policy file (default: the environment's bundled policy).
        any_robot: also play a policy that was trained for another model of the robot.
        controller: the same as --agent with a controller's name.
        episodes: number of episodes, played side by side.
        backend: mjx, or mujoco (the C library on the CPU); auto: as --impl says.
        impl: physics, one of ``physics.impls()``.
        record: number of episodes whose steps are kept, for example for a video.
        env_fields, control_fields: fields of the environment's and the controller's config by dotted name.
    """

    env_name: str
    preset: str = flag("default")
    robot: str | None = flag(None)
    agent: str | None = flag(None)
    policy: pathlib.Path | None = flag(None)
    any_robot: bool = flag(False)
    controller: str | None = flag(None)
    episodes: Annotated[int, Bounds(1, 1_000_000)] = flag(64)
    seed: Seed = flag(1)
    backend: Annotated[str, OneOf(*BACKENDS)] = flag("auto")
    impl: str = flag("auto")
    record: int = 0
    env_fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    control_fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        if self.controller and (self.agent or self.policy) or self.policy and self.agent not in (None, "policy"):
            raise UserError("only one can play: pass --controller, --agent or --policy")
        if self.control_fields and (self.policy or self.player in AGENTS):
            raise UserError("--control.* needs --agent with a controller's name")

    @property
    def player(self) -> str | None:
        """Name of the agent or controller that plays; None: the default."""
        return self.controller or self.agent
