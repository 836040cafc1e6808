"""DENSO's b-CAP: packets over TCP or UDP, and a client.

Source: DENSORobot/orin_bcap (``Python/bCAPClient``, ``C/include/bcap_funcid.h``). All numbers are little-endian. A packet is

    0x01, u32 length of the whole packet, u16 serial, u16, i32 function or result, u16 count of arguments,
    u32 length and VARIANT of each argument, 0x04

and a VARIANT is u16 type, u32 count, then that many values; text is its length in bytes, then UTF-16. The second u16 is zero over
TCP. Over UDP it is the serial of a request's first try, by which the controller recognizes repeated requests. (Over a serial line
two bytes of CRC precede the last byte.)
"""

import socket
import struct
from collections.abc import Sequence
from typing import Any

from mjx_nero.deploy.arm import ArmError

PORT = 5007
SERVICE_START, SERVICE_STOP, CONNECT, DISCONNECT, GET_ROBOT, ROBOT_NAMES, EXECUTE, RELEASE = 1, 2, 3, 4, 7, 13, 64, 84
EXECUTING = 0x900  # the answer will follow
LONGEST = 1 << 16  # maximum bytes of a packet
_TRIES = 3  # number of times a datagram is sent
EMPTY, I2, I4, R4, R8, TEXT, BOOL, VARIANT, UI1, UI4, ARRAY = 0, 2, 3, 4, 5, 8, 11, 12, 17, 19, 0x2000
_FORMATS = {I2: "h", I4: "i", R4: "f", R8: "d", BOOL: "h", UI1: "B", UI4: "I", 10: "i", 18: "H", 20: "q", 21: "Q"}
_HEAD = struct.Struct("<BIHHiH")
# Meanings of results, as reported by users of slave mode.
ERRORS = {
    0x83201483: "its buffer of targets is full",
    0x84201482: "a target came too late",
    **{0x84204040 + joint: f"an acceleration of joint {joint} beyond its limits" for joint in range(1, 9)},
}


class Damaged(ValueError):
    """Bytes that are not a packet."""


def encode(value: Any) -> bytes:
    """Encodes a VARIANT: None, an integer, a float, text, or a list of one of these."""
    if value is None:
        return struct.pack("<HI", EMPTY, 1)
    if isinstance(value, list | tuple):
        kind, body = {int: I4, float: R8, str: TEXT}[type(value[0])], b"".join(map(_plain, value))
        return struct.pack("<HI", kind | ARRAY, len(value)) + body
    return struct.pack("<HI", {int: I4, float: R8, str: TEXT}[type(value)], 1) + _plain(value)


def _plain(value: Any) -> bytes:
    if isinstance(value, str):
        text = value.encode("utf-16le")
        return struct.pack("<I", len(text)) + text
    return struct.pack("<i" if isinstance(value, int) else "<d", value)


def decode(data: bytes) -> Any:
    """Decodes a VARIANT.

    Raises:
        Damaged: it is not a VARIANT, or has an unsupported type.
    """
    value, rest = _decode(data)
    if rest:
        raise Damaged("bytes too many")
    return value


def _decode(data: bytes, depth: int = 0) -> tuple[Any, bytes]:
    kind, count = _unpack("<HI", data)
    data, one = data[6:], kind & ~ARRAY
    if kind in (EMPTY, 1):
        return None, data
    if count > LONGEST or depth > 4:
        raise Damaged("too large")
    values = []
    for _ in range(count if kind & ARRAY else 1):
        if one == VARIANT:
            value, data = _decode(data, depth + 1)
        elif one == TEXT:
            size = 4 + _unpack("<I", data)[0]
            if size > len(data):
                raise Damaged("a text that ends too early")
            value, data = data[4:size].decode("utf-16le", "replace"), data[size:]
        elif one in _FORMATS:
            (value,) = _unpack(f"<{_FORMATS[one]}", data)
            data = data[struct.calcsize(f"<{_FORMATS[one]}") :]
        else:
            raise Damaged(f"a value of type {one}")
        values.append(value)
    return (values if kind & ARRAY else values[0]), data


def _unpack(form: str, data: bytes) -> tuple[Any, ...]:
    try:
        return struct.unpack_from(form, data)
    except struct.error:
        raise Damaged("too short") from None


def packet(serial: int, function: int, arguments: Sequence[Any], first: int = 0) -> bytes:
    """Makes a request or, with a result instead of the function, an answer. ``first``: serial of a datagram's first try."""
    values = [encode(value) for value in arguments]
    body = b"".join(struct.pack("<I", len(value)) + value for value in values)
    return _HEAD.pack(1, _HEAD.size + len(body) + 1, serial, first, function, len(values)) + body + b"\x04"


def parse(data: bytes) -> tuple[int, int, list[Any]]:
    """Parses a whole packet; returns serial, function or result, and arguments.

    Raises:
        Damaged: it is not a packet.
    """
    if len(data) < _HEAD.size + 1 or data[-1] != 4:
        raise Damaged("no end")
    start, length, serial, _, function, count = _HEAD.unpack_from(data)
    if start != 1 or length != len(data):
        raise Damaged("no beginning")
    rest, values = data[_HEAD.size : -1], []
    for _ in range(count):
        (size,) = _unpack("<I", rest)
        values.append(decode(rest[4 : 4 + size]))
        rest = rest[4 + size :]
    return serial, function, values


def receive(channel: socket.socket) -> bytes:
    """Receives the next packet; empty if the other side has closed the connection.

    Raises:
        Damaged: something else arrived.
        OSError: nothing arrived in time.
    """
    head = _exactly(channel, 5)
    if not head:
        return b""
    start, length = struct.unpack("<BI", head)
    if start != 1 or not _HEAD.size < length <= LONGEST:
        raise Damaged("no beginning")
    rest = _exactly(channel, length - 5)
    return head + rest if rest else b""


def _exactly(channel: socket.socket, count: int) -> bytes:
    out = b""
    while len(out) < count:
        part = channel.recv(count - len(out))
        if not part:
            return b""
        out += part
    return out


class Client:
    """A connection to a controller.

    Args:
        patience: time limit for an answer [s]; it may be changed later.
        udp: use datagrams; a request without an answer is sent up to three times.

    Raises:
        OSError: nothing answers.
    """

    def __init__(self, host: str, port: int, patience: float, udp: bool = False):
        self.patience, self._udp, self._serial = patience, udp, 0
        if udp:
            self._channel = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._channel.connect((host, port))
        else:
            self._channel = socket.create_connection((host, port), timeout=patience)
            self._channel.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def __call__(self, function: int, *arguments: Any) -> Any:
        """Calls a function and returns its result.

        Raises:
            ArmError: the controller refuses, or does not answer.
        """
        first = self._serial % 0xFFFF + 1
        try:
            for left in reversed(range(_TRIES if self._udp else 1)):
                try:
                    result, values = self._ask(function, arguments, first if self._udp else 0)
                    break
                except TimeoutError:
                    if not left:
                        raise
        except Damaged as error:
            raise ArmError(f"the controller's answer is damaged: {error}") from None
        except OSError as error:
            raise ArmError(f"the controller does not answer: {error}") from None
        if result < 0:
            code = result & 0xFFFFFFFF
            raise ArmError(f"the controller reports {ERRORS.get(code, 'an error')} (0x{code:08X})")
        return values[0] if values else None

    def _ask(self, function: int, arguments: Sequence[Any], first: int) -> tuple[int, list[Any]]:
        """Sends a request once; returns the result and its values."""
        self._serial = self._serial % 0xFFFF + 1
        self._channel.settimeout(self.patience)
        self._channel.sendall(packet(self._serial, function, arguments, first))
        while True:
            if not (data := self._channel.recv(LONGEST) if self._udp else receive(self._channel)):
                raise ArmError("the controller has closed the connection")
            serial, result, values = parse(data)
            if serial == self._serial and result != EXECUTING:
                return result, values

    def close(self) -> None:
        """Ends the connection."""
        self._channel.close()
