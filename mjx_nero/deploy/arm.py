"""The arm as the runtime sees it: radians, metres, seconds, and no way to cut its torque."""

import dataclasses
from typing import Protocol

import numpy as np


@dataclasses.dataclass(frozen=True)
class Feedback:
    """Readings of an arm's encoders and drives, as arrays along the arm's joints.

    Attributes:
        time: when it was read, on the runtime's clock [s].
        position: [rad or m].
        velocity: [rad/s or m/s].
        load: share of the torque that a drive can give, 0 to 1; None where the arm does not tell.
        temperature: of the drives [degrees C]; None likewise.
    """

    time: float
    position: np.ndarray
    velocity: np.ndarray
    load: np.ndarray | None = None
    temperature: np.ndarray | None = None


class ArmError(Exception):
    """The bus does not answer, or what it answers is damaged. The drives keep to the last target that they got."""


class Arm(Protocol):
    """An arm behind its driver.

    No method cuts torque: a driver that is closed leaves the drives at their last target.

    Attributes:
        joints: names, in the order of all arrays.
    """

    joints: tuple[str, ...]

    def connect(self) -> None:
        """Opens the bus and looks who is there; moves and changes nothing.

        Raises:
            UserError: there is no such port, or another arm than expected answers.
            ArmError: nothing answers.
        """

    def ranges(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The least and the greatest positions that the arm, once connected, allows [rad or m]; None: those of its model."""

    def engage(self) -> None:
        """Lets the drives hold where they are.

        Raises:
            ArmError: it cannot be sent.
        """

    def read(self) -> Feedback:
        """The newest feedback.

        Raises:
            ArmError: it cannot be read.
        """

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Sends where the joints are to be [rad or m], and how fast they are to move there [rad/s or m/s].

        Returns:
            what the drives were told, for the log.

        Raises:
            ArmError: it cannot be sent.
        """

    def close(self) -> None:
        """Closes the bus. The drives hold on."""


class Clock(Protocol):
    """The time, and a way to wait for it; that of a simulation need not be the wall's."""

    def now(self) -> float:
        """[s]."""

    def sleep_until(self, time: float) -> None:
        """Waits."""
