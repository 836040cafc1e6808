"""The SO-101's leader arm: a follower's servos without torque, which a person moves by hand. It is only read."""

import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.alone import alone
from mjx_nero.deploy.arm import ArmError, Clock
from mjx_nero.deploy.drivers.so_arm import SoArm, read_calibration
from mjx_nero.errors import UserError


class SoLeader(SoArm):
    """A leader arm, with the same calibration file as ``SoArm``."""

    def connect(self) -> None:
        """Opens the port, and cuts the servos' torque."""
        self._taken = alone(self._port)  # cutting the torque of an arm that another program moves would drop it
        try:
            super().connect()
        except UserError:
            self._taken.close()
            raise
        for servo in self.ids:
            self._bus.write(servo, "torque_enable", 0)

    def close(self) -> None:
        """Closes the port, so that other programs can use it."""
        super().close()
        self._taken.close()

    def engage(self) -> None:
        """Refuses.

        Raises:
            ArmError: always.
        """
        raise ArmError("a leader arm can only be moved by hand")

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Refuses.

        Raises:
            ArmError: always.
        """
        raise ArmError("a leader arm can only be moved by hand")


def of(metadata: Mapping[str, Any], port: str, calibration: pathlib.Path, clock: Clock) -> SoLeader:
    """Makes the driver of the leader at a port, with positions in the robot model's convention [rad].

    Args:
        metadata: description of the robot that has the leader's joints (``interop.description.robot``).

    Raises:
        UserError: the calibration file does not exist or is invalid.
    """
    return SoLeader("so101", metadata, read_calibration(calibration, tuple(metadata["joints"]["names"])), port, clock)
