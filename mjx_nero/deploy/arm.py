"""The interface of an arm: radians, metres, seconds, and no way to cut its torque."""

import dataclasses
from typing import Protocol

import numpy as np


@dataclasses.dataclass(frozen=True)
class Feedback:
    """Readings of an arm's encoders and drives, as arrays along the arm's joints.

    Attributes:
        time: when they were read, on the runtime's clock [s].
        position: [rad or m].
        velocity: [rad/s or m/s].
        load: share of the drive's maximum torque, 0 to 1; None if the arm does not report it.
        temperature: of the drives [degrees C]; None if the arm does not report it.
    """

    time: float
    position: np.ndarray
    velocity: np.ndarray
    load: np.ndarray | None = None
    temperature: np.ndarray | None = None


class ArmError(Exception):
    """The bus does not answer, or its answer is damaged. The drives keep their last target."""


class Arm(Protocol):
    """An arm behind its driver.

    No method cuts torque: closing a driver leaves the drives at their last target.

    Attributes:
        joints: names of the joints, in the order of all arrays.
    """

    joints: tuple[str, ...]

    def connect(self) -> None:
        """Opens the bus and checks which arm answers; moves and changes nothing.

        Raises:
            UserError: the port does not exist, or another arm answers.
            ArmError: nothing answers.
        """

    def ranges(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Returns the lower and upper position limits of the connected arm [rad or m]; None: those of its model."""

    def engage(self) -> None:
        """Makes the drives hold their present positions.

        Raises:
            ArmError: the command cannot be sent.
        """

    def read(self) -> Feedback:
        """Returns the newest feedback.

        Raises:
            ArmError: it cannot be read.
        """

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Sends target positions of the joints [rad or m], and their velocities there [rad/s or m/s].

        Returns:
            the targets as sent to the drives, for the log.

        Raises:
            ArmError: the command cannot be sent.
        """

    def close(self) -> None:
        """Closes the bus. The drives keep holding."""


class Clock(Protocol):
    """A clock that can be waited for. In a simulation it need not be real time."""

    def now(self) -> float:
        """Returns the time [s]."""

    def sleep_until(self, time: float) -> None:
        """Waits until a time [s]."""
