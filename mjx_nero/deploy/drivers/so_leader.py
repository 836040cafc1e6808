"""SO-101's leader arm: the servos of a follower, limp, that a person moves by hand. It is read, and never commanded."""

import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.alone import alone
from mjx_nero.deploy.arm import ArmError, Clock
from mjx_nero.deploy.drivers.so_arm import SoArm, read_calibration
from mjx_nero.errors import UserError


class SoLeader(SoArm):
    """See ``SoArm``, whose calibration file it has."""

    def connect(self) -> None:
        """Opens the port, and cuts the servos' torque."""
        self._taken = alone(self._port)  # that of an arm which another program moves would drop it
        try:
            super().connect()
        except UserError:
            self._taken.close()
            raise
        for servo in self.ids:
            self._bus.write(servo, "torque_enable", 0)

    def close(self) -> None:
        """Closes the port, which others may have then."""
        super().close()
        self._taken.close()

    def engage(self) -> None:
        """Refuses.

        Raises:
            ArmError: always.
        """
        raise ArmError("a leader arm is moved by hand alone")

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Refuses.

        Raises:
            ArmError: always.
        """
        raise ArmError("a leader arm is moved by hand alone")


def of(metadata: Mapping[str, Any], port: str, calibration: pathlib.Path, clock: Clock) -> SoLeader:
    """The leader at a port, with positions as the robot's model has them [rad].

    Args:
        metadata: of the robot that has the leader's joints (``interop.description.robot``).

    Raises:
        UserError: there is no calibration file.
    """
    return SoLeader("so101", metadata, read_calibration(calibration, tuple(metadata["joints"]["names"])), port, clock)
