"""The serial bus of Feetech's STS servos: packets, and reads and writes of registers. It cannot write to a servo's EEPROM.

Source of registers and signs: huggingface/lerobot, ``src/lerobot/motors/feetech/tables.py`` (STS3215, protocol 0). A packet is

    0xFF 0xFF id length instruction-or-error parameters checksum,   checksum = ~(id + length + ... + parameters) & 0xFF
"""

import termios
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mjx_nero.deploy.arm import ArmError

BAUD = 1_000_000
MODEL = 777  # STS3215
_TRIES = 2  # number of times to send a request whose answer is wrong or missing
PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
EVERYONE = 0xFE
# Name -> (address, bytes).
REGISTERS = {
    "model": (3, 2),
    "id": (5, 1),
    "min_position": (9, 2),
    "max_position": (11, 2),
    "max_torque": (16, 2),
    "p": (21, 1),
    "d": (22, 1),
    "i": (23, 1),
    "protection_current": (28, 2),
    "homing_offset": (31, 2),
    "mode": (33, 1),
    "overload_torque": (36, 1),
    "torque_enable": (40, 1),
    "acceleration": (41, 1),
    "goal_position": (42, 2),
    "goal_velocity": (46, 2),
    "torque_limit": (48, 2),
    "lock": (55, 1),
    "position": (56, 2),
    "velocity": (58, 2),
    "load": (60, 2),
    "voltage": (62, 1),
    "temperature": (63, 1),
    "status": (65, 1),
    "current": (69, 2),
}
SIGNS = {"homing_offset": 11, "goal_position": 15, "goal_velocity": 15, "position": 15, "velocity": 15, "load": 10, "current": 15}
WRITABLE = ("torque_enable", "acceleration", "goal_position", "torque_limit")  # all in RAM
STATE = (56, 15)  # address and size of the block from position to current
ERRORS = {1: "voltage", 2: "angle", 4: "overheating", 8: "overcurrent", 32: "overload"}


def checksum(body: bytes) -> int:
    """Computes the checksum of all bytes between the header and the checksum."""
    return ~sum(body) & 0xFF


def packet(servo: int, instruction: int, parameters: bytes = b"") -> bytes:
    """Makes a request or, with an error instead of the instruction, an answer."""
    body = bytes([servo, len(parameters) + 2, instruction]) + parameters
    return b"\xff\xff" + body + bytes([checksum(body)])


def decode(name: str, data: bytes) -> int:
    """Decodes a register's value."""
    value = int.from_bytes(data, "little")
    sign = 1 << SIGNS[name] if name in SIGNS else 0
    return -(value & (sign - 1)) if sign and value & sign else value


def encode(name: str, value: int) -> bytes:
    """Encodes a register's value.

    Raises:
        ValueError: it does not fit.
    """
    size = REGISTERS[name][1]
    sign = 1 << SIGNS[name] if name in SIGNS else 1 << 8 * size
    if not (-sign if name in SIGNS else -1) < value < sign:
        raise ValueError(f"{value} does not fit register {name}")
    return (abs(value) | (sign if value < 0 else 0)).to_bytes(size, "little")


class Bus:
    """Servos behind a port.

    Args:
        port: has ``write``, ``read(count)``, which returns fewer bytes on a timeout, ``reset_input_buffer`` and ``close``.
    """

    def __init__(self, port: Any):
        self._port = port

    def close(self) -> None:
        """Closes the port; the servos keep holding."""
        self._port.close()

    def read(self, servo: int, name: str) -> int:
        """Reads a register of one servo.

        Raises:
            ArmError: it does not answer.
        """
        address, size = REGISTERS[name]
        return decode(name, self._ask([servo], packet(servo, READ, bytes([address, size])), size)[servo])

    def write(self, servo: int, name: str, value: int) -> None:
        """Writes a register of one servo.

        Raises:
            ArmError: it does not answer.
        """
        self._ask([servo], packet(servo, WRITE, bytes([_ram(name)]) + encode(name, value)), 0)

    def read_all(self, servos: Sequence[int], address: int, size: int) -> dict[int, bytes]:
        """Reads the same registers of several servos with one request.

        Raises:
            ArmError: a servo does not answer, or reports an error.
        """
        return self._ask(servos, packet(EVERYONE, SYNC_READ, bytes([address, size, *servos])), size)

    def write_all(self, name: str, values: Mapping[int, int]) -> None:
        """Writes a register of several servos with one request, which is not answered.

        Raises:
            ArmError: it cannot be sent.
        """
        parts = [bytes([servo]) + encode(name, value) for servo, value in values.items()]
        self._send(packet(EVERYONE, SYNC_WRITE, bytes([_ram(name), REGISTERS[name][1]]) + b"".join(parts)))

    def _send(self, request: bytes) -> None:
        try:
            self._port.reset_input_buffer()
            self._port.write(request)
        except (OSError, termios.error) as error:  # termios.error: pyserial raises it when it flushes a lost port
            raise ArmError(f"the port is gone: {error}") from None

    def _ask(self, servos: Sequence[int], request: bytes, size: int) -> dict[int, bytes]:
        """Sends a request and returns the answers by servo; repeats it if an answer is damaged."""
        for left in reversed(range(_TRIES)):
            self._send(request)
            try:
                return {servo: self._answer(servo, size) for servo in servos}
            except ArmError:
                self._quiet()
                if not left:
                    raise
        raise AssertionError

    def _quiet(self) -> None:
        """Waits until nothing more arrives, so that a late answer is not mistaken for the next one."""
        for _ in range(4):
            try:
                if not self._port.read(256):
                    return
            except OSError as error:
                raise ArmError(f"the port is gone: {error}") from None

    def _answer(self, servo: int, size: int) -> bytes:
        try:
            data = self._port.read(size + 6)
        except OSError as error:
            raise ArmError(f"the port is gone: {error}") from None
        if len(data) < size + 6:
            raise ArmError(f"servo {servo} does not answer")
        body = data[2:-1]
        if data[:2] != b"\xff\xff" or body[:2] != bytes([servo, size + 2]) or checksum(body) != data[-1]:
            raise ArmError(f"the answer of servo {servo} is damaged")
        if body[2]:
            what = " and ".join(text for bit, text in ERRORS.items() if body[2] & bit) or f"error {body[2]}"
            raise ArmError(f"servo {servo} reports {what}")
        return body[3:]


def _ram(name: str) -> int:
    """Returns the address of a register that may be written."""
    if name not in WRITABLE:
        raise ValueError(f"{name} must not be written: only calibration writes the EEPROM")
    return REGISTERS[name][0]


def registers(data: bytes, names: Iterable[str]) -> dict[str, int]:
    """Decodes registers from the block ``STATE``."""
    places = {name: (REGISTERS[name][0] - STATE[0], REGISTERS[name][1]) for name in names}
    return {name: decode(name, data[at : at + size]) for name, (at, size) in places.items()}
