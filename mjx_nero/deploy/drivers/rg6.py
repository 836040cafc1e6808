"""OnRobot's RG6 gripper, by Modbus TCP (pymodbus): registers of its compute box as takuya-ki/onrobot has them.

Written: 0 force [0.1 N], 1 width [0.1 mm], 2 control (1 grips). Read: 267 width [0.1 mm], 268 status, whose bit 0 is busy, and
bits 3 and 5 are tripped safety switches. The gripper takes a width only when it is not busy, so it follows in steps.
"""

import math
from typing import Any

from mjx_nero.deploy.arm import ArmError
from mjx_nero.deploy.drivers.turning import Turning
from mjx_nero.errors import UserError

DEVICE, FORCE, WIDTH, GRIP = 65, 0, 267, 1
BUSY, TRIPPED = 1, 8 | 32
WIDEST = 0.16  # [m]
_NEWTONS = 40.0  # of 120
_CRANK, _CLOSED, _OFFSET = 0.08, 0.6331, 0.000488  # the model's linkage: tasks/arms/cobotta_pro_900.py
_CHANGE = 0.002  # [m] of the target that is worth a new motion
_PERIOD = 0.02  # [s] between questions


def width(angle: float) -> float:
    """Distance between the pads [m] at the driven joint's angle [rad]."""
    return 2 * (_CRANK * math.sin(_CLOSED - angle) - _OFFSET)


def angle(width: float) -> float:
    """The inverse of ``width``."""
    return _CLOSED - math.asin(min(max((width / 2 + _OFFSET) / _CRANK, -1.0), 1.0))


class Rg6:
    """The gripper, asked and told by a thread of its own, as its answers take longer than a cycle of the arm.

    Args:
        address: ``HOST`` or ``HOST:PORT``.
    """

    def __init__(self, address: str):
        self._address, (self._host, _, port) = address, address.partition(":")
        self._port = int(port or 502)
        self.turning = Turning(self._step, _PERIOD)
        self._seen, self._wanted, self._told = 0.0, -1.0, -1.0

    def connect(self) -> None:
        """Opens the connection and reads the width.

        Raises:
            UserError: no gripper is there.
        """
        import pymodbus
        from pymodbus.client import ModbusTcpClient

        self._failures: Any = (pymodbus.ModbusException, OSError)
        self._client = ModbusTcpClient(self._host, port=self._port, timeout=0.3, retries=0)
        if not self._client.connect():
            raise UserError(f"no RG6 answers at {self._address}: it is the address of its compute box")
        try:
            self._step()
        except ArmError as error:
            raise UserError(f"no RG6 answers at {self._address}: {error}") from None

    def engage(self) -> None:
        """Starts to ask and to tell it."""
        self.turning.start()

    def _step(self) -> None:
        """Reads it, and tells it a new width where there is one and it listens.

        Raises:
            ArmError: it does not answer, or a safety switch has tripped.
        """
        try:
            answer = self._client.read_holding_registers(WIDTH, count=2, device_id=DEVICE)
            if answer.isError():
                raise ArmError("the gripper refuses to be read")
            self._seen, status = answer.registers[0] * 1e-4, answer.registers[1]
            if status & TRIPPED:
                raise ArmError("a safety switch of the gripper has tripped: its power has to be switched off and on")
            wanted = self._wanted
            if wanted >= 0 and not status & BUSY and abs(wanted - self._told) >= _CHANGE:
                values = [round(_NEWTONS * 10), round(wanted * 1e4), GRIP]
                if self._client.write_registers(FORCE, values, device_id=DEVICE).isError():
                    raise ArmError("the gripper refuses a width")
                self._told = wanted
        except self._failures as error:
            raise ArmError(f"the gripper does not answer: {error}") from None

    def read(self) -> float:
        """The width [m].

        Raises:
            ArmError: it was lost.
        """
        self.turning.check()
        return self._seen

    def command(self, width: float) -> None:
        """A width to go to [m], as soon as it listens."""
        self._wanted = min(max(width, 0.0), WIDEST)

    def close(self) -> None:
        """Ends the connection; the gripper keeps its grip."""
        self.turning.stop()
        self._client.close()
