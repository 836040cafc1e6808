"""OnRobot's RG6 gripper, by Modbus TCP (pymodbus). Source of its compute box's registers: takuya-ki/onrobot.

Written: 0 force [0.1 N], 1 width [0.1 mm], 2 control (1 grips). Read: 267 width [0.1 mm], 268 status (bit 0: busy; bits 3 and 5:
tripped safety switches). The gripper accepts a width only when it is not busy, so it follows in steps.
"""

import math
from typing import Any

from mjx_nero.deploy.arm import ArmError
from mjx_nero.deploy.drivers.turning import Turning
from mjx_nero.errors import UserError

DEVICE, FORCE, WIDTH, GRIP = 65, 0, 267, 1
BUSY, TRIPPED = 1, 8 | 32
WIDEST = 0.16  # [m]
_NEWTONS = 40.0  # gripping force [N], of at most 120
_CRANK, _CLOSED, _OFFSET = 0.08, 0.6331, 0.000488  # the model's linkage: tasks/arms/cobotta_pro_900.py
_CHANGE = 0.002  # minimum change of the target for a new motion [m]
_PERIOD = 0.02  # time between requests [s]


def width(angle: float) -> float:
    """Computes the distance between the pads [m] from the driven joint's angle [rad]."""
    return 2 * (_CRANK * math.sin(_CLOSED - angle) - _OFFSET)


def angle(width: float) -> float:
    """Computes the driven joint's angle [rad] from the distance between the pads [m]."""
    return _CLOSED - math.asin(min(max((width / 2 + _OFFSET) / _CRANK, -1.0), 1.0))


class Rg6:
    """The gripper. A separate thread reads and commands it, because its answers take longer than a cycle of the arm.

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
            UserError: no gripper answers.
        """
        import pymodbus
        from pymodbus.client import ModbusTcpClient

        self._failures: Any = (pymodbus.ModbusException, OSError)
        self._client = ModbusTcpClient(self._host, port=self._port, timeout=0.3, retries=0)
        if not self._client.connect():
            raise UserError(f"no RG6 answers at {self._address}: give the address of its compute box")
        try:
            self._step()
        except ArmError as error:
            raise UserError(f"no RG6 answers at {self._address}: {error}") from None

    def engage(self) -> None:
        """Starts the thread."""
        self.turning.start()

    def _step(self) -> None:
        """Reads the gripper, and sends a new width if there is one and the gripper is not busy.

        Raises:
            ArmError: it does not answer, or a safety switch has tripped.
        """
        try:
            answer = self._client.read_holding_registers(WIDTH, count=2, device_id=DEVICE)
            if answer.isError():
                raise ArmError("the gripper refuses to be read")
            self._seen, status = answer.registers[0] * 1e-4, answer.registers[1]
            if status & TRIPPED:
                raise ArmError("a safety switch of the gripper has tripped: switch its power off and on")
            wanted = self._wanted
            if wanted >= 0 and not status & BUSY and abs(wanted - self._told) >= _CHANGE:
                values = [round(_NEWTONS * 10), round(wanted * 1e4), GRIP]
                if self._client.write_registers(FORCE, values, device_id=DEVICE).isError():
                    raise ArmError("the gripper refuses a width")
                self._told = wanted
        except self._failures as error:
            raise ArmError(f"the gripper does not answer: {error}") from None

    def read(self) -> float:
        """Returns the width [m].

        Raises:
            ArmError: the connection was lost.
        """
        self.turning.check()
        return self._seen

    def command(self, width: float) -> None:
        """Requests a width [m], which is sent as soon as the gripper is not busy."""
        self._wanted = min(max(width, 0.0), WIDEST)

    def close(self) -> None:
        """Ends the connection; the gripper keeps its grip."""
        self.turning.stop()
        self._client.close()
