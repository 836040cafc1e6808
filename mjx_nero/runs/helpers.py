"""The processes that help a start (see ``apart``), and how a run waits for one."""

import dataclasses
from multiprocessing.process import BaseProcess

_PATIENCE = 120.0  # [s]


@dataclasses.dataclass(frozen=True)
class Helpers:
    """The processes that help a start; None: the run does that work itself.

    Attributes:
        expert: plays the episodes of the first seed's expert.
        kernels: builds the kernels of the physics.
    """

    expert: BaseProcess | None = None
    kernels: BaseProcess | None = None


ALONE = Helpers()


def wait_for(helper: BaseProcess) -> None:
    """Waits until a process has ended, or ends it if that takes too long. What it has not done is left to the run."""
    helper.join(_PATIENCE)
    helper.kill()
